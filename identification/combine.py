"""Several logs of one cell: one set of parameters, and a loud word where the logs disagree."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from .errors import LogError
from .gravity_verdicts import load_growth_findings
from .result import (
    AxisEstimate,
    CouplingEstimate,
    Covariance,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    InertiaEstimate,
    NoiseSpectrum,
    PayloadEstimate,
    RobotEstimate,
    SensorEstimate,
    Status,
    VectorEstimate,
    WrenchFilterEstimate,
)
from .verdicts import IDENTIFIED_SHARE, weak_at_best

FloatArray = NDArray[np.float64]

# Scatter that chance brings about once in a thousand is no chance.
_CHANCE = 1e-3
_SAME_SURFACE_STDS = 3.0
_SAME_PERIOD = 1e-3
_WIDER = 1e-9
_ORDER = (Status.GIVEN, Status.IDENTIFIED, Status.WEAK, Status.UNIDENTIFIABLE)


@dataclass(frozen=True, kw_only=True)
class NamedResult:
    """What one log told; `name` is how findings call it."""

    name: str
    result: Identified


def combine_identified(parts: Sequence[NamedResult]) -> Identified:
    """Average what several logs of one cell told, each parameter weighted by 1/σ² (least squares).

    The deviation of a mean is the smallest of its logs': what they share (local gravity, the sensor's calibration, what
    the model leaves out) does not average out.
    Where the scatter of a parameter is larger than its standard deviations let expect (χ² test at 1e-3), a finding of
    severity `error` names it with its values, and its deviation is widened by √(χ²/(n − 1)). The bias of the sensor may
    change from log to log: there it is a warning. Surfaces on one axis are one where their K_e agree within three
    deviations. Raises LogError when the logs were recorded at different control periods.
    """
    if len(parts) == 1:
        return parts[0].result
    findings = [
        replace(finding, message=f"{part.name}: {finding.message}")
        for part in parts
        for finding in part.result.findings
    ]
    findings += load_growth_findings([load for part in parts for load in _load(part.result)])
    merge = _Merge(names=tuple(part.name for part in parts), findings=findings)
    results = [part.result for part in parts]
    names = sorted({axis for result in results for axis in result.axes}, key=["x", "y", "z", "rx", "ry", "rz"].index)
    combined = Identified(
        sample_time_s=_sample_time(parts),
        payload=PayloadEstimate(
            mass_kg=merge.scalars("payload mass [kg]", [r.payload.mass_kg for r in results]),
            com_m=merge.vectors("centre of mass [m]", [r.payload.com_m for r in results]),
            inertia_kg_m2=_inertia(merge, [r.payload.inertia_kg_m2 for r in results]),
        ),
        axes={name: _axis(merge, name, results) for name in names},
        sensor=_sensor(merge, [r.sensor for r in results]),
        findings=(),
        timelines=tuple(replace(line, log=part.name) for part in parts for line in part.result.timelines),
    )
    return replace(combined, findings=tuple(_without_settled(findings, combined)))


def _load(result: Identified) -> list[tuple[float, float]]:
    """Return the payload's mass and what its weight leaves, nothing where one of them is not told."""
    mass, left = result.payload.mass_kg.value, result.sensor.gravity_residual_rms_n.value
    return [] if mass is None or left is None else [(mass, left)]


@dataclass(frozen=True, kw_only=True)
class _Merge:
    """Averages, and the findings that they give rise to; `names` are those of the logs."""

    names: tuple[str, ...]
    findings: list[Finding]

    def scalars(self, what: str, estimates: Sequence[Estimate | None], *, may_change: bool = False) -> Estimate:
        """Return the weighted mean of what is told, the first estimate where nothing is."""
        told = [(name, e) for name, e in zip(self.names, estimates, strict=True) if e is not None and _tells(e)]
        if len(told) < 2:
            return told[0][1] if told else next(e for e in estimates if e is not None)
        values = np.array([[e.value] for _, e in told], dtype=np.float64)
        mean, std = self._mean(what, [name for name, _ in told], values, _stds([e.std for _, e in told]), may_change)
        combined = Estimate(value=float(mean[0]), std=float(std[0]), status=_sharpest(told), method=_method(told))
        # Where the logs scatter, the mean may be nobody's value.
        scatter = std[0] > (1.0 + _WIDER) * min(e.std for _, e in told if e.std is not None)
        if scatter and not std[0] <= IDENTIFIED_SHARE * abs(mean[0]):
            return weak_at_best(combined, "the logs disagree")
        return combined

    def vectors(self, what: str, estimates: Sequence[VectorEstimate], *, may_change: bool = False) -> VectorEstimate:
        """Return the same for vectors, component by component."""
        told = [(name, e) for name, e in zip(self.names, estimates, strict=True) if e.value is not None]
        if len(told) < 2 or len({len(e.value) for _, e in told if e.value is not None}) > 1:
            return told[0][1] if told else estimates[0]
        values = np.array([e.value for _, e in told], dtype=np.float64)
        stds = np.array([e.std if e.std is not None else np.zeros(values.shape[1]) for _, e in told])
        mean, std = self._mean(what, [name for name, _ in told], values, stds, may_change)
        return VectorEstimate(
            value=tuple(float(v) for v in mean),
            std=tuple(float(s) for s in std),
            status=_best([e.status for _, e in told]),
            method=_method(told),
        )

    def _mean(
        self, what: str, names: Sequence[str], values: FloatArray, stds: FloatArray, may_change: bool
    ) -> tuple[FloatArray, FloatArray]:
        """Return mean and deviation of (n, k) values, and tell where they scatter more than they should."""
        # What is known exactly counts as known to rounding; 1/0 would leave no mean.
        spread = np.maximum(stds, 1e-12 * np.maximum(np.abs(values), 1e-12))
        weights = spread**-2.0
        mean = np.sum(weights * values, axis=0) / np.sum(weights, axis=0)
        squares = np.sum(((values - mean) / spread) ** 2, axis=0)
        freedom = len(values) - 1
        std = np.min(stds, axis=0) * np.sqrt(np.maximum(squares / freedom, 1.0))
        if bool(np.any(chdtrc(freedom, squares) < _CHANCE / len(squares))):
            self.findings.append(_disagreement(what, names, values, stds, int(np.argmax(squares)), may_change))
        return mean, std


def _disagreement(
    what: str, names: Sequence[str], values: FloatArray, stds: FloatArray, worst: int, may_change: bool
) -> Finding:
    told = ", ".join(
        f"{value[worst]:.5g} ± {std[worst]:.2g} ({name})" for name, value, std in zip(names, values, stds, strict=True)
    )
    part = f", component {worst + 1}" if values.shape[1] > 1 else ""
    return Finding(
        code="logs-differ" if may_change else "logs-disagree",
        severity="warning" if may_change else "error",
        message=f"The logs disagree on the {what}{part}: {told}.",
        advice=""
        if may_change
        else "Leave out the log of another payload, tool or surface, or identify each on its own.",
    )


def _inertia(merge: _Merge, tensors: Sequence[InertiaEstimate | None]) -> InertiaEstimate | None:
    if all(tensor is None for tensor in tensors):
        return None
    return InertiaEstimate(
        **{
            name: merge.scalars(
                f"inertia {name} [kg·m²]", [None if tensor is None else getattr(tensor, name) for tensor in tensors]
            )
            for name in (field.name for field in fields(InertiaEstimate))
        }
    )


def _axis(merge: _Merge, name: str, results: Sequence[Identified]) -> AxisEstimate:
    axes = [result.axes.get(name) for result in results]

    def scalar(what: str, pick: Callable[[AxisEstimate], Estimate]) -> Estimate:
        return merge.scalars(f"{what} of axis {name}", [None if axis is None else pick(axis) for axis in axes])

    there = [axis for axis in axes if axis is not None]
    combined = AxisEstimate(
        coupling=CouplingEstimate(
            stiffness_n_per_m=scalar("coupling stiffness K_s", lambda a: a.coupling.stiffness_n_per_m),
            damping_n_s_per_m=scalar("coupling damping B_s", lambda a: a.coupling.damping_n_s_per_m),
        ),
        drag_n_s_per_m=scalar("payload drag B_p", lambda a: a.drag_n_s_per_m),
        environments=_environments(merge, name, axes),
        robot=_robot(merge, name, there, axes),
        mass_kg=_mass(merge, name, axes),
        fits=tuple(fit for axis in there for fit in axis.fits),
    )
    return replace(combined, covariance=_covariance(combined, there))


def _mass(merge: _Merge, name: str, axes: Sequence[AxisEstimate | None]) -> Estimate | None:
    masses = [None if axis is None else axis.mass_kg for axis in axes]
    if all(mass is None for mass in masses):
        return None
    return merge.scalars(f"payload mass from motion of axis {name}", masses)


def _covariance(combined: AxisEstimate, there: Sequence[AxisEstimate]) -> Covariance | None:
    """Return the correlations of the log that tells most parameters, with the combined values and deviations.

    Surfaces of that log which another one names differently keep their own values.
    """
    told = [axis for axis in there if axis.covariance is not None]
    if not told:
        return None
    best = max(told, key=lambda axis: len(axis.covariance.names) if axis.covariance is not None else 0)
    if best.covariance is None or len(told) == 1:
        return best.covariance
    known: dict[str, Estimate | None] = {
        "K_s": combined.coupling.stiffness_n_per_m,
        "B_s": combined.coupling.damping_n_s_per_m,
        "B_p": combined.drag_n_s_per_m,
        "M_p": combined.mass_kg,
        "T_d": combined.robot.delay_s,
    }
    for surface, mine in zip(combined.environments, best.environments, strict=False):
        if surface.name == mine.name and _alike(surface, mine):
            known[f"{surface.name}.K_e"] = surface.stiffness_n_per_m
            known[f"{surface.name}.B_e"] = surface.damping_n_s_per_m
            known[f"{surface.name}.M_e"] = surface.mass_kg
    matrix = np.array(best.covariance.matrix)
    std = np.sqrt(np.diag(matrix))
    values, scale = list(best.covariance.values), np.ones(len(std))
    for i, name in enumerate(best.covariance.names):
        estimate = known.get(name)
        if estimate is not None and estimate.value is not None and estimate.std is not None and std[i] > 0.0:
            values[i], scale[i] = estimate.value, estimate.std / std[i]
    scaled = 0.5 * (matrix + matrix.T) * np.outer(scale, scale)
    return Covariance(
        names=best.covariance.names,
        values=tuple(values),
        matrix=tuple(tuple(float(v) for v in row) for row in scaled),
    )


def _robot(
    merge: _Merge, name: str, there: Sequence[AxisEstimate], axes: Sequence[AxisEstimate | None]
) -> RobotEstimate:
    """Average robots of one order; those of different orders do not compare, there the best known one counts."""
    orders = {len(a.robot.denominator.value) for a in there if a.robot.denominator.value is not None}
    if len(orders) != 1:
        told = [a.robot for a in there if _tells(a.robot.delay_s)] or [there[0].robot]
        return min(told, key=lambda r: r.delay_s.std if r.delay_s.std is not None else np.inf)
    known = [None if a is None else a.robot for a in axes]
    empty = VectorEstimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
    return RobotEstimate(
        numerator=merge.vectors(
            f"robot numerator of axis {name}", [empty if r is None else r.numerator for r in known]
        ),
        denominator=merge.vectors(
            f"robot denominator of axis {name}", [empty if r is None else r.denominator for r in known]
        ),
        delay_s=merge.scalars(f"delay T_d [s] of axis {name}", [None if r is None else r.delay_s for r in known]),
        bandwidth_hz=merge.scalars(
            f"robot bandwidth [Hz] of axis {name}", [None if r is None else r.bandwidth_hz for r in known]
        ),
    )


def _environments(merge: _Merge, name: str, axes: Sequence[AxisEstimate | None]) -> tuple[EnvironmentEstimate, ...]:
    """Put surfaces of several logs together whose K_e agree; each log has a surface at most once."""
    groups: list[dict[int, EnvironmentEstimate]] = []
    for log, axis in enumerate(axes):
        for surface in () if axis is None else axis.environments:
            fitting = [g for g in groups if log not in g and all(_alike(surface, other) for other in g.values())]
            if fitting:
                fitting[0][log] = surface
            else:
                groups.append({log: surface})
    return tuple(_surface(merge, f"{name}{i + 1}", group) for i, group in enumerate(groups))


def _alike(one: EnvironmentEstimate, other: EnvironmentEstimate) -> bool:
    first, second = one.secant_stiffness_n_per_m, other.secant_stiffness_n_per_m
    if not _tells(first) or not _tells(second):
        first, second = one.stiffness_n_per_m, other.stiffness_n_per_m
    if first.value is None or second.value is None or first.std is None or second.std is None:
        return False
    return abs(first.value - second.value) <= _SAME_SURFACE_STDS * float(np.hypot(first.std, second.std))


def _surface(merge: _Merge, name: str, group: Mapping[int, EnvironmentEstimate]) -> EnvironmentEstimate:
    def scalar(what: str, pick: Callable[[EnvironmentEstimate], Estimate]) -> Estimate:
        return merge.scalars(
            f"{what} of surface {name}", [pick(group[i]) if i in group else None for i in range(len(merge.names))]
        )

    return EnvironmentEstimate(
        name=name,
        stiffness_n_per_m=scalar("stiffness K_e", lambda s: s.stiffness_n_per_m),
        secant_stiffness_n_per_m=scalar("secant stiffness", lambda s: s.secant_stiffness_n_per_m),
        damping_n_s_per_m=scalar("damping B_e", lambda s: s.damping_n_s_per_m),
        mass_kg=scalar("mass M_e", lambda s: s.mass_kg),
        contacts=sum(surface.contacts for surface in group.values()),
        peak_force_n=tuple(peak for _, surface in sorted(group.items()) for peak in surface.peak_force_n),
    )


def _sensor(merge: _Merge, sensors: Sequence[SensorEstimate]) -> SensorEstimate:
    return SensorEstimate(
        force_bias_n=merge.vectors("force bias [N]", [s.force_bias_n for s in sensors], may_change=True),
        torque_bias_n_m=merge.vectors("torque bias [N·m]", [s.torque_bias_n_m for s in sensors], may_change=True),
        force_noise_rms_n=_largest([s.force_noise_rms_n for s in sensors]),
        gravity_residual_rms_n=_largest([s.gravity_residual_rms_n for s in sensors]),
        deadband_n=_largest([s.deadband_n for s in sensors]),
        torque_noise_rms_n_m=_optional(merge, "torque noise [N·m]", [s.torque_noise_rms_n_m for s in sensors]),
        mounting_rad=_optional(merge, "mounting of the sensor [rad]", [s.mounting_rad for s in sensors]),
        base_tilt_rad=_optional(merge, "tilt of the base [rad]", [s.base_tilt_rad for s in sensors]),
        noise=_noisiest(sensors),
        wrench_filter=_wrench_filter(merge, [s.wrench_filter for s in sensors]),
        position_noise_rms_m=_largest_told([s.position_noise_rms_m for s in sensors]),
    )


def _wrench_filter(merge: _Merge, filters: Sequence[WrenchFilterEstimate | None]) -> WrenchFilterEstimate | None:
    """Average filters of one kind; where logs show different kinds, the latest wrench counts."""
    told = [(name, f) for name, f in zip(merge.names, filters, strict=True) if f is not None]
    if not told:
        return None
    corners = [None if f is None else f.corner_hz for f in filters]
    delays = [None if f is None else f.delay_s for f in filters]
    if not any(delays):
        return WrenchFilterEstimate(corner_hz=merge.scalars("wrench filter's corner [Hz]", corners))
    if not any(corners):
        return WrenchFilterEstimate(delay_s=merge.scalars("delay of the wrench [s]", delays))
    late = ", ".join(f"{1e3 * _lateness_s(f):.3g} ms late ({name})" for name, f in told)
    merge.findings.append(
        Finding(
            code="logs-disagree",
            severity="error",
            message=f"The logs disagree on whether the wrench is filtered or delayed: {late}.",
            advice="Identify logs of different sensors, or of different filters in one, each on its own.",
        )
    )
    return max((f for _, f in told), key=_lateness_s)


def _lateness_s(wrench_filter: WrenchFilterEstimate) -> float:
    """Return how late a slow change of the force arrives: 1/(2π corner) of a filter, or the delay."""
    corner, delay = wrench_filter.corner_hz, wrench_filter.delay_s
    if corner is not None and corner.value is not None:
        return float(1.0 / (2.0 * np.pi * corner.value))
    return 0.0 if delay is None or delay.value is None else delay.value


def _noisiest(sensors: Sequence[SensorEstimate]) -> NoiseSpectrum | None:
    """Return the spectrum of the log with most noise, as its rms is what is told."""
    told = [s for s in sensors if s.noise is not None]
    return max(told, key=lambda s: s.force_noise_rms_n.value or 0.0).noise if told else None


def _optional(merge: _Merge, what: str, estimates: Sequence[VectorEstimate | None]) -> VectorEstimate | None:
    """Average vectors of which logs may know nothing; what changes with the day is a warning."""
    if all(estimate is None for estimate in estimates):
        return None
    empty = VectorEstimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
    return merge.vectors(what, [empty if e is None else e for e in estimates], may_change=True)


def _largest(estimates: Sequence[Estimate]) -> Estimate:
    """Return the worst of noises and residuals: what any of the logs shows is there."""
    return max(estimates, key=lambda e: np.inf if e.value is None else e.value)


def _largest_told(estimates: Sequence[Estimate | None]) -> Estimate | None:
    """Return the worst of those that have a value, None where none has."""
    told = [estimate for estimate in estimates if estimate is not None and estimate.value is not None]
    return max(told, key=lambda e: 0.0 if e.value is None else e.value, default=None)


def _sample_time(parts: Sequence[NamedResult]) -> Estimate:
    times = [(part.name, part.result.sample_time_s) for part in parts]
    values = [t.value for _, t in times if t.value is not None]
    if max(values) - min(values) > _SAME_PERIOD * min(values):
        told = ", ".join(f"{1e3 * t.value:.4f} ms ({name})" for name, t in times if t.value is not None)
        raise LogError(f"Logs that are combined must come from one control period, found {told}; identify each apart.")
    return min((t for _, t in times), key=lambda t: _ORDER.index(t.status))


def _without_settled(findings: Sequence[Finding], combined: Identified) -> list[Finding]:
    """Leave out what one log lacks and another has: the combination tells it."""
    axes = combined.axes.values()
    settled = {
        "no-command": bool(axes) and all(axis.robot.delay_s.value is not None for axis in axes),
        "robot": bool(axes) and all(axis.robot.delay_s.value is not None for axis in axes),
        "coupling": bool(axes) and all(axis.coupling.stiffness_n_per_m.value is not None for axis in axes),
        "no-contact": bool(axes) and all(axis.environments for axis in axes),
        "no-travel": bool(axes),
    }
    return [
        replace(f, severity="info") if f.severity == "error" and settled.get(f.code, False) else f for f in findings
    ]


def _tells(estimate: Estimate) -> bool:
    return estimate.value is not None and estimate.std is not None


def _stds(values: Sequence[float | None]) -> FloatArray:
    return np.array([[0.0 if value is None else value] for value in values])


def _best(statuses: Sequence[Status]) -> Status:
    return min(statuses, key=_ORDER.index)


def _sharpest(told: Sequence[tuple[str, Estimate]]) -> Status:
    """Return the verdict of the log that knows best: a prior is in each of them."""
    return min((e for _, e in told), key=lambda e: np.inf if e.std is None else e.std).status


def _method(told: Sequence[tuple[str, Estimate]] | Sequence[tuple[str, VectorEstimate]]) -> str:
    return f"{told[0][1].method}; mean of {len(told)} logs"
