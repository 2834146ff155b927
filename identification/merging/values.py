"""Numbers of several logs as one: a mean by the rule of `merging`, and a finding where they disagree."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from ..result import Estimate, Finding, Status, VectorEstimate
from ..verdicts import IDENTIFIED_SHARE, weak_at_best
from .merging import noise_stds, scatter, shared_std

FloatArray = NDArray[np.float64]

# Scatter that chance brings about once in a thousand is no chance.
_CHANCE = 1e-3
_WIDER = 1e-9
ORDER = (Status.GIVEN, Status.IDENTIFIED, Status.WEAK, Status.UNIDENTIFIABLE)
DISAGREE = "the logs disagree"


@dataclass(frozen=True, kw_only=True)
class Merge:
    """Averages, and the findings that they give rise to; `names` are those of the logs."""

    names: tuple[str, ...]
    findings: list[Finding]

    def scalars(self, what: str, estimates: Sequence[Estimate | None], *, symbol: str = "") -> Estimate:
        """Return the weighted mean of what is told, the first estimate where nothing is.

        `symbol` says what the logs share of it (`merging.shared_std`).
        """
        told = [(name, e) for name, e in zip(self.names, estimates, strict=True) if e is not None and is_told(e)]
        if len(told) < 2:
            return told[0][1] if told else next(e for e in estimates if e is not None)
        values = np.array([[e.value] for _, e in told], dtype=np.float64)
        stds = np.array([[e.std] for _, e in told], dtype=np.float64)
        mean, std = self._mean(what, [name for name, _ in told], values, stds, may_change=False, symbol=symbol)
        combined = Estimate(
            value=float(mean[0]),
            std=float(std[0]),
            status=sharpest([e for _, e in told]).status,
            method=_method([e for _, e in told]),
        )
        # Where the logs scatter, the mean may be nobody's value.
        widened = std[0] > (1.0 + _WIDER) * min(e.std for _, e in told if e.std is not None)
        if widened and not std[0] <= IDENTIFIED_SHARE * abs(mean[0]):
            return weak_at_best(combined, DISAGREE)
        return combined

    def vectors(self, what: str, estimates: Sequence[VectorEstimate], *, may_change: bool = False) -> VectorEstimate:
        """Return the same for vectors, component by component.

        What `may_change` from log to log (a bias) does not average: its deviation is the smallest of the logs'.
        """
        told = [(name, e) for name, e in zip(self.names, estimates, strict=True) if e.value is not None]
        if len(told) < 2 or len({len(e.value) for _, e in told if e.value is not None}) > 1:
            return told[0][1] if told else estimates[0]
        values = np.array([e.value for _, e in told], dtype=np.float64)
        stds = np.array([e.std if e.std is not None else np.zeros(values.shape[1]) for _, e in told])
        mean, std = self._mean(what, [name for name, _ in told], values, stds, may_change=may_change, symbol="")
        return VectorEstimate(
            value=tuple(float(v) for v in mean),
            std=tuple(float(s) for s in std),
            status=min((e.status for _, e in told), key=ORDER.index),
            method=_method([e for _, e in told]),
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
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and deviation of (n, k) values, and tell where they scatter more than their noise lets expect."""
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
        if any(is_beyond_chance(float(square), len(values) - 1, len(squares)) for square in squares):
            worst = int(np.argmax(squares))
            self.tell(what, names, values[:, worst], stds[:, worst], worst, values.shape[1], may_change=may_change)
        return mean, std

    def tell(
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
        told = ", ".join(
            f"{value:.5g} ± {std:.2g} ({name})" for name, value, std in zip(names, values, stds, strict=True)
        )
        part = f", component {component + 1}" if of > 1 else ""
        self.findings.append(
            Finding(
                code="logs-differ" if may_change else "logs-disagree",
                severity="warning" if may_change else "error",
                message=f"The logs disagree on the {what}{part}: {told}.",
                advice=""
                if may_change
                else "Leave out the log of another payload, tool or surface, or identify each on its own.",
            )
        )


def is_beyond_chance(square: float, freedom: int, tests: int = 1) -> bool:
    """Whether chance makes such a χ² in fewer than one of a thousand sets of tests."""
    return bool(chdtrc(freedom, square) < _CHANCE / tests)


def is_told(estimate: Estimate) -> bool:
    """Whether a value is stated with its deviation."""
    return estimate.value is not None and estimate.std is not None


def sharpest(told: Sequence[Estimate]) -> Estimate:
    """Return the estimate of the log that knows best."""
    return min(told, key=lambda e: np.inf if e.std is None else e.std)


def with_verdict(fresh: Estimate, value: float, std: float, logs: Sequence[Estimate], *, scatters: bool) -> Estimate:
    """Return a merged estimate with its verdict, value and deviation kept where the logs only scatter.

    A log may call a sharp number weak for a reason of its own; where that log knows best, so is the mean.
    """
    told = [e for e in logs if is_told(e)]
    if fresh.value is None and fresh.ci95 is None and scatters:
        fresh = replace(fresh, value=value, std=std, status=Status.WEAK, note="")
    if scatters and not std <= IDENTIFIED_SHARE * abs(value):
        fresh = weak_at_best(replace(fresh, note=DISAGREE), DISAGREE) if fresh.status is Status.WEAK else fresh
    if not told:
        return fresh
    fresh = replace(fresh, method=_method(told))
    best = sharpest(told)
    if best.status is Status.WEAK and best.std is not None and best.std <= IDENTIFIED_SHARE * abs(best.value or 0.0):
        return weak_at_best(fresh, best.note)
    return fresh


def _method(told: Sequence[Estimate] | Sequence[VectorEstimate]) -> str:
    return told[0].method if len(told) == 1 else f"{told[0].method}; mean of {len(told)} logs"
