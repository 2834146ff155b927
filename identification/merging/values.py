"""How knowledge from several recordings goes together: noise averages, what the recordings share does not.

x_i = θ + n_i + s with independent n_i of covariance N_i and one s of covariance S in all recordings:
θ̂ = (Σ N_i⁻¹)⁻¹ Σ N_i⁻¹ x_i, with covariance (Σ N_i⁻¹)⁻¹ + S. Shared are local gravity (in a mass that was weighed) and
the calibration of the force sensor (in everything mechanical). A plan predicts with the same rule.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtrc

from problems.arrays import FloatArray
from problems.frozen import freeze
from problems.text import significant

from ..payload.gravity import LOCAL_GRAVITY_STD
from ..result import Estimate, Finding, Status, VectorEstimate
from ..verdicts import IDENTIFIED_SHARE, scatter, weak_at_best

WEIGHED_MASS = "mass"
# No sensor's scale is better known than this (`joint_covariance` adds as much to each of these).
_CALIBRATION_SHARE = 0.0003
_CALIBRATED = frozenset({"K_s", "B_p", "M_p"})
_MECHANICAL = frozenset({"K_s", "B_s", "B_p", "M_p", "K_e", "B_e", "M_e"})
_SPRINGS = frozenset({"K_s", "K_e"})
_NOT_NEGATIVE = frozenset({"B_s", "B_p", "B_e", "M_e", "T_d"})
# No log knows its own noise better than this against what it states in all.
_LEAST_NOISE_SHARE = 0.1
_SINGULAR, _DEFINITE = 1e-13, 1e-9
# Scatter that chance brings about once in a thousand is no chance.
_CHANCE = 1e-3
_WIDER = 1e-9
ORDER = (Status.GIVEN, Status.IDENTIFIED, Status.WEAK, Status.UNIDENTIFIABLE)
DISAGREE = "the logs disagree"


def shared_std(symbol: str, value: float, *, gain_share: float = 0.0) -> float:
    """Return the deviation that all recordings of one cell have in common for a parameter, in the value's unit.

    `symbol` is `WEIGHED_MASS`, or a name as in `Covariance`. `gain_share` is the share by which the force's scale may
    be wrong.
    """
    if symbol == WEIGHED_MASS:
        return LOCAL_GRAVITY_STD * abs(value)
    gain = gain_share if _kind(symbol) in _MECHANICAL else 0.0
    return float(np.hypot(gain, _CALIBRATION_SHARE if symbol in _CALIBRATED else 0.0)) * abs(value)


def noise_stds(stds: Sequence[float] | FloatArray, shared: float) -> tuple[FloatArray, float]:
    """Return the deviations (n,) without what is shared, and that: it is in each, so never above the least."""
    total = np.asarray(stds, dtype=np.float64)
    common = min(shared, float(np.min(total)))
    return np.sqrt(np.maximum(total**2 - common**2, (_LEAST_NOISE_SHARE * total) ** 2)), common


def merged_std(stds: Sequence[float] | FloatArray, shared: float = 0.0) -> float:
    """Return √(1/Σ(1/n_i²) + s²) for deviations σ_i² = n_i² + s² of which s does not average; 0 where one is exact."""
    if float(np.min(stds)) == 0.0:
        return 0.0
    noise, common = noise_stds(stds, shared)
    return min(float(np.hypot(np.sum(noise**-2.0) ** -0.5, common)), float(np.min(stds)))


@dataclass(frozen=True, kw_only=True)
class Normal:
    """Knowledge of one source about parameters: `values` (p,) with covariance `matrix` (p, p) in SI, by their names."""

    names: tuple[str, ...]
    values: FloatArray
    matrix: FloatArray

    @property
    def std(self) -> FloatArray:
        """Return the standard deviations (p,)."""
        return np.sqrt(np.maximum(np.diag(self.matrix), 0.0))

    def at(self, name: str) -> tuple[float, float]:
        """Return value and deviation of one parameter."""
        place = self.names.index(name)
        return float(self.values[place]), float(self.std[place])

    def select(self, names: Sequence[str]) -> "Normal":
        """Return the marginal of these parameters, in this order."""
        kept = [self.names.index(name) for name in names]
        return Normal(names=tuple(names), values=self.values[kept], matrix=self.matrix[np.ix_(kept, kept)])

    def added(self, variances: Mapping[str, float]) -> "Normal":
        """Return the same with independent variances added."""
        return replace(self, matrix=self.matrix + np.diag([variances.get(name, 0.0) for name in self.names]))


@dataclass(frozen=True, kw_only=True)
class Merged:
    """The merged knowledge; `square` and `freedom` hold χ² and its degrees of freedom of what several sources show."""

    normal: Normal
    square: Mapping[str, float]
    freedom: Mapping[str, int]

    def __post_init__(self) -> None:
        freeze(self, "square", "freedom")


def merge_normals(parts: Sequence[Normal], stated: Sequence[Collection[str]], *, gain_share: float = 0.0) -> Merged:
    """Merge what recordings of one cell show of an axis: generalised least squares over all names.

    Springs go in as compliances, since what a contact shows best, 1/K_s + 1/K_e, is linear in them. Where values
    scatter more than their noise lets expect, each of them gets the variance that is beyond (`scatter`), so that the
    mean is no log's own and its deviation reaches the logs; `stated` holds for each part the names that count there
    (what it hardly shows scatters by no normal law). `gain_share` is the smallest share by which the force's scale may
    be wrong in any of them.
    """
    noises = [_noise(part, gain_share) for part in parts]
    square, freedom, beyond = {}, {}, {}
    for name in dict.fromkeys(name for part in parts for name in part.names):
        seen = [part.at(name) for part, names in zip(noises, stated, strict=True) if name in names]
        if len(seen) > 1:
            values, stds = np.array(seen).T
            square[name], beyond[name] = scatter(values, stds)
            freedom[name] = len(seen) - 1
    merged = _least_squares([part.added(beyond) for part in noises])
    matrix = merged.matrix + _gain(merged, gain_share) + _calibration(merged)
    return Merged(normal=replace(merged, matrix=matrix), square=square, freedom=freedom)


def with_priors(known: Normal, priors: Mapping[str, tuple[float, float]]) -> Normal:
    """Return what is known together with independent normal knowledge, value and deviation by name (Bayes)."""
    alone = [
        Normal(names=(name,), values=np.array([value]), matrix=np.array([[std**2]]))
        for name, (value, std) in priors.items()
    ]
    return _least_squares([known, *alone])


def _kind(name: str) -> str:
    return name.rpartition(".")[2]


def _gain(part: Normal, gain_share: float) -> FloatArray:
    """Return what a scale of the force that is off does: everything mechanical moves together."""
    moved = np.array([gain_share if _kind(name) in _MECHANICAL else 0.0 for name in part.names]) * part.values
    return np.outer(moved, moved)


def _calibration(part: Normal) -> FloatArray:
    share = np.array([_CALIBRATION_SHARE if name in _CALIBRATED else 0.0 for name in part.names])
    return np.diag((share * part.values) ** 2)


def _noise(part: Normal, gain_share: float) -> Normal:
    """Return a part without what is shared, as far as it holds that."""
    std = part.std
    gain = _gain(part, gain_share)
    for shared in (gain + _calibration(part), gain):
        left = part.matrix - shared
        if np.all(std > 0.0) and np.linalg.eigvalsh(left / np.outer(std, std))[0] > _DEFINITE:
            return replace(part, matrix=left)
    return part


def _least_squares(parts: Sequence[Normal]) -> Normal:
    """Return (Σ N_i⁻¹)⁻¹ Σ N_i⁻¹ x_i with its covariance; logarithms of springs where compliances would leave 0."""
    solved = _solved([_mapped(part, lambda k: 1.0 / k, lambda k: -1.0 / k**2) for part in parts])
    if all(value > 0.0 for name, value in zip(solved.names, solved.values, strict=True) if _kind(name) in _SPRINGS):
        found = _mapped(solved, lambda c: 1.0 / c, lambda c: -1.0 / c**2)
    else:
        found = _mapped(_solved([_mapped(part, np.log, lambda k: 1.0 / k) for part in parts]), np.exp, np.exp)
    bounded = np.array([_kind(name) in _NOT_NEGATIVE for name in found.names])
    return replace(found, values=np.where(bounded, np.maximum(found.values, 0.0), found.values))


def _mapped(part: Normal, to: Callable[[float], float], derivative: Callable[[float], float]) -> Normal:
    """Return the same with its springs in another coordinate, the covariance to first order."""
    springs = [_kind(name) in _SPRINGS for name in part.names]
    pairs = list(zip(part.values.tolist(), springs, strict=True))
    values = np.array([to(value) if spring else value for value, spring in pairs])
    gradients = np.array([derivative(value) if spring else 1.0 for value, spring in pairs])
    return Normal(names=part.names, values=values, matrix=part.matrix * np.outer(gradients, gradients))


def _solved(parts: Sequence[Normal]) -> Normal:
    names = tuple(dict.fromkeys(name for part in parts for name in part.names))
    placed = [([names.index(name) for name in part.names], part, _positive(part)) for part in parts]
    # Stiffness and seconds lie nine decades apart: all count in the smallest deviation that is stated, from one value.
    scale, origin = np.full(len(names), np.inf), np.zeros(len(names))
    for places, part, std in reversed(placed):
        scale[places], origin[places] = np.minimum(scale[places], std), part.values
    information, pull = np.zeros((len(names), len(names))), np.zeros(len(names))
    for places, part, std in placed:
        exact = np.diag(std**2 - part.std**2)
        inverse = _inverse((part.matrix + exact) / np.outer(std, std)) * np.outer(
            scale[places] / std, scale[places] / std
        )
        information[np.ix_(places, places)] += inverse
        pull[places] += inverse @ ((part.values - origin[places]) / scale[places])
    covariance = _inverse(information)
    return Normal(names=names, values=origin + covariance @ pull * scale, matrix=covariance * np.outer(scale, scale))


def _positive(part: Normal) -> FloatArray:
    """Return the deviations (p,), none of them 0: what is exact is known to rounding."""
    return np.asarray(np.maximum(part.std, 1e-12 * np.maximum(np.abs(part.values), 1e-12)))


def _inverse(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a symmetric matrix of about 1 on its diagonal, finite where rounding leaves none."""
    scale = np.sqrt(np.diag(matrix))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, _SINGULAR)) @ vectors.T / np.outer(scale, scale)
    return np.asarray(0.5 * (inverse + inverse.T))


@dataclass(frozen=True, kw_only=True)
class Merge:
    """Averages, and the findings that they give rise to; `names` are those of the logs.

    `ends_s` is when each log ends on an absolute clock, 0 where that is not known: the last log ends last, of those
    that are not known it is the one that is named last.
    """

    names: tuple[str, ...]
    findings: list[Finding]
    ends_s: tuple[float, ...] = ()

    def scalars(
        self, what: str, estimates: Sequence[Estimate | None], *, differs_by_contact: bool = False, symbol: str = ""
    ) -> Estimate:
        """Return the weighted mean of what is known, the first estimate where nothing is.

        What `differs_by_contact` does not average: the deviation, of one more contact, is at least the smallest stated.
        `symbol` says what the logs share of it (`merging.shared_std`).
        """
        stated = [(name, e) for name, e in zip(self.names, estimates, strict=True) if e is not None and is_stated(e)]
        if len(stated) < 2:
            return stated[0][1] if stated else next(e for e in estimates if e is not None)
        values = np.array([[e.value] for _, e in stated], dtype=np.float64)
        stds = np.array([[e.std] for _, e in stated], dtype=np.float64)
        mean, std, _ = self._mean(what, [name for name, _ in stated], values, stds, may_change=False, symbol=symbol)
        if differs_by_contact:
            std = np.maximum(std, np.min(stds, axis=0))
        combined = Estimate(
            value=float(mean[0]),
            std=float(std[0]),
            status=sharpest([e for _, e in stated]).status,
            method=_method([e for _, e in stated]),
        )
        # Where the logs scatter, the mean may be nobody's value.
        widened = std[0] > (1.0 + _WIDER) * min(e.std for _, e in stated if e.std is not None)
        if widened and not std[0] <= IDENTIFIED_SHARE * abs(mean[0]):
            return weak_at_best(combined, DISAGREE)
        return combined

    def vectors(self, what: str, estimates: Sequence[VectorEstimate], *, may_change: bool = False) -> VectorEstimate:
        """Return the same for vectors, component by component.

        What `may_change` from log to log (a bias) does not average: its deviation is the smallest of the logs'. Where
        they differ beyond chance it is that of the last log.
        """
        stated = [(name, e) for name, e in zip(self.names, estimates, strict=True) if e.value is not None]
        if len(stated) < 2 or len({len(e.value) for _, e in stated if e.value is not None}) > 1:
            return stated[0][1] if stated else estimates[0]
        values = np.array([e.value for _, e in stated], dtype=np.float64)
        stds = np.array([e.std if e.std is not None else np.zeros(values.shape[1]) for _, e in stated])
        names = [name for name, _ in stated]
        mean, std, differ = self._mean(what, names, values, stds, may_change=may_change, symbol="")
        if may_change and differ:
            return dict(stated)[self._last(names)]
        return VectorEstimate(
            value=tuple(float(v) for v in mean),
            std=tuple(float(s) for s in std),
            status=min((e.status for _, e in stated), key=ORDER.index),
            method=_method([e for _, e in stated]),
        )

    def _mean(
        self,
        what: str,
        names: Sequence[str],
        values: FloatArray,
        stds: FloatArray,
        *,
        may_change: bool,
        symbol: str,
    ) -> tuple[FloatArray, FloatArray, bool]:
        """Return mean and deviation of (n, k) values, and whether they scatter beyond chance, which is reported."""
        # What is known exactly counts as known to rounding; 1/0 would leave no mean.
        noise = np.maximum(stds, 1e-12 * np.maximum(np.abs(values), 1e-12))
        common = np.zeros(values.shape[1])
        if symbol:
            noise[:, 0], common[0] = noise_stds(noise[:, 0], shared_std(symbol, float(np.mean(values))))
        found = [scatter(value, std) for value, std in zip(values.T, noise.T, strict=True)]
        squares, beyond = np.array(found).T
        spread = np.sqrt(noise**2 + beyond)
        mean = np.sum(values * spread**-2.0, axis=0) / np.sum(spread**-2.0, axis=0)
        std = np.hypot(np.sum(spread**-2.0, axis=0) ** -0.5, common)
        least = np.min(stds, axis=0)
        if may_change:
            std = np.maximum(std, least)
        else:
            # A log that states its noise coarsely must not make the mean less sure than it was.
            std = np.where(beyond > 0.0, std, np.minimum(std, least))
        differ = any(is_beyond_chance(float(square), len(values) - 1, len(squares)) for square in squares)
        if differ:
            worst = int(np.argmax(squares))
            self.report(what, names, values[:, worst], stds[:, worst], worst, values.shape[1], may_change=may_change)
        return mean, std, differ

    def _last(self, names: Sequence[str]) -> str:
        """Return which of some logs is the last."""
        ends = dict(zip(self.names, self.ends_s, strict=True)) if self.ends_s else {}
        return max(enumerate(names), key=lambda each: (ends.get(each[1], 0.0), each[0]))[1]

    def report(
        self,
        what: str,
        names: Sequence[str],
        values: Sequence[float] | FloatArray,
        stds: Sequence[float] | FloatArray,
        component: int = 0,
        of: int = 1,
        *,
        may_change: bool = False,
    ) -> None:
        """Add the finding that logs disagree on a number, with what each says."""
        stated = ", ".join(
            f"{value:.5g} ± {significant(std)} ({name})" for name, value, std in zip(names, values, stds, strict=True)
        )
        part = f", component {component + 1}" if of > 1 else ""
        self.findings.append(
            Finding(
                code="logs-differ" if may_change else "logs-disagree",
                severity="warning" if may_change else "error",
                message=f"The logs disagree on the {what}{part}: {stated}.",
                advice=f"That of the last, {self._last(names)}, is taken; the sensor was tared or has drifted before."
                if may_change
                else "Leave out the log of another payload, tool or surface, or identify each on its own.",
            )
        )


def is_beyond_chance(square: float, freedom: int, tests: int = 1) -> bool:
    """Whether chance makes such a χ² in fewer than one of a thousand sets of tests."""
    return bool(chdtrc(freedom, square) < _CHANCE / tests)


def is_stated(estimate: Estimate) -> bool:
    """Whether a value is stated with its deviation."""
    return estimate.value is not None and estimate.std is not None


def sharpest(stated: Sequence[Estimate]) -> Estimate:
    """Return the estimate of the log that knows best."""
    return min(stated, key=lambda e: np.inf if e.std is None else e.std)


def with_verdict(fresh: Estimate, value: float, std: float, logs: Sequence[Estimate], *, scatters: bool) -> Estimate:
    """Return a merged estimate with its verdict, value and deviation kept where the logs only scatter.

    A log may call a sharp number weak for a reason of its own; where that log knows best, so is the mean.
    """
    stated = [e for e in logs if is_stated(e)]
    if fresh.value is None and fresh.ci95 is None and scatters:
        fresh = replace(fresh, value=value, std=std, status=Status.WEAK, note="")
    if scatters and not std <= IDENTIFIED_SHARE * abs(value):
        fresh = weak_at_best(replace(fresh, note=DISAGREE), DISAGREE) if fresh.status is Status.WEAK else fresh
    if not stated:
        return fresh
    fresh = replace(fresh, method=_method(stated))
    best = sharpest(stated)
    if best.status is Status.WEAK and best.std is not None and best.std <= IDENTIFIED_SHARE * abs(best.value or 0.0):
        return weak_at_best(fresh, best.note)
    return fresh


def _method(stated: Sequence[Estimate] | Sequence[VectorEstimate]) -> str:
    return stated[0].method if len(stated) == 1 else f"{stated[0].method}; mean of {len(stated)} logs"
