"""Merged result of several logs of one cell, with findings where they disagree."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from ..axis_estimate import axis_priors
from ..errors import LogError
from ..given import Given, settle_axis, settle_cell
from ..joint_fit.estimates import SYMBOLS
from ..payload.gravity_verdicts import load_growth_findings
from ..result import (
    AxisEstimate,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    InertiaEstimate,
    NoiseSpectrum,
    PayloadEstimate,
    SensorEstimate,
    Status,
    Timeline,
    VectorEstimate,
    WrenchFilterEstimate,
)
from ..verdicts import missing, unidentifiable
from .axis import AxisRecord, merge_axis
from .values import ORDER, WEIGHED_MASS, Merge, is_stated

_CLEAR_STDS, _PROMPT_SHARE = 4.0, 0.5
_SAME_PERIOD = 1e-3
_PERIOD = "sample_time_s"
_SAME_SURFACE_STDS = 3.0


@dataclass(frozen=True, kw_only=True)
class NamedResult:
    """Result of one log; `name` is how findings call it.

    `gain_error_share` is the share by which the force's scale may be wrong, as the log shows it. `recorded_s` is when
    the log ends on an absolute clock, 0 where that is not known.
    """

    name: str
    result: Identified
    gain_error_share: float = 0.0
    recorded_s: float = 0.0


def combine_identified(parts: Sequence[NamedResult], given: Mapping[str, Given] | None = None) -> Identified:
    """Merge the results of several logs of one cell, then enter the prior knowledge once.

    Each axis is one joint record of its parameters: values, deviations, names of surfaces and covariance of the result
    are all taken from it. Noise averages; what the logs share (local gravity, the sensor's calibration) does not.
    Where the scatter of a parameter is larger than its noise lets expect (χ² test at 1e-3), a finding of severity
    `error` names it with its values, and its deviation is widened by √(χ²/(n − 1)). The bias of the sensor may change
    from log to log: where it does, that of the last log is taken, with a warning. Surfaces on one axis are one where
    their K_e agree within three deviations.

    Parameters
    ----------
    parts
        The result of each log with its name. One log is taken as it is, with what is given already in it.
    given
        Prior knowledge by name, as of `identify_cell`.

    Raises
    ------
    LogError
        The logs were recorded at different control periods.

    """
    if len(parts) == 1:
        return parts[0].result
    given = {} if given is None else given
    renamed = common_surfaces([part.result for part in parts])
    findings = [
        replace(finding, message=f"{part.name}: {rename_in_text(finding.message, names)}")
        for part, names in zip(parts, renamed, strict=True)
        for finding in part.result.findings
    ]
    findings += load_growth_findings([load for part in parts for load in _load(part.result)])
    merge = Merge(
        names=tuple(part.name for part in parts), findings=findings, ends_s=tuple(p.recorded_s for p in parts)
    )
    period = _sample_time(parts, findings, is_given=_PERIOD in given)
    results = [rename_surfaces(part.result, names) for part, names in zip(parts, renamed, strict=True)]
    gain_share = min(part.gain_error_share for part in parts)
    combined = Identified(
        sample_time_s=period,
        payload=PayloadEstimate(
            mass_kg=merge.scalars("payload mass [kg]", [r.payload.mass_kg for r in results], symbol=WEIGHED_MASS),
            com_m=merge.vectors("centre of mass [m]", [r.payload.com_m for r in results]),
            inertia_kg_m2=_inertia(merge, [r.payload.inertia_kg_m2 for r in results]),
        ),
        axes=_axes(merge, results, given, _seconds(period, results), gain_share),
        sensor=_sensor(merge, results),
        findings=(),
        timelines=tuple(
            replace(rename_timeline(line, names), log=part.name)
            for part, names in zip(parts, renamed, strict=True)
            for line in part.result.timelines
        ),
    )
    return settle_cell(replace(combined, findings=tuple(_without_settled(findings, combined))), given)


def _load(result: Identified) -> list[tuple[float, float]]:
    """Return the payload's mass and what its weight leaves, nothing where one of them is not identified."""
    mass, left = result.payload.mass_kg.value, result.sensor.gravity_residual_rms_n.value
    return [] if mass is None or left is None else [(mass, left)]


def _inertia(merge: Merge, tensors: Sequence[InertiaEstimate | None]) -> InertiaEstimate | None:
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


def _axes(
    merge: Merge, results: Sequence[Identified], given: Mapping[str, Given], period_s: float, gain_share: float
) -> dict[str, AxisEstimate]:
    names = sorted({axis for result in results for axis in result.axes}, key=["x", "y", "z", "rx", "ry", "rz"].index)
    found = {}
    for name in names:
        axes = [result.axes.get(name) for result in results]
        there = [axis for axis in axes if axis is not None]
        # The scale of the torque is not weighed.
        share = 0.0 if name.startswith("r") else gain_share
        record = merge_axis(merge, name, axes, period_s=period_s, gain_share=share)
        alone = there[0] if len(there) == 1 else record.estimate()
        found[name], about = settle_axis(name, alone, _with_priors(record, given), given)
        merge.findings.extend(about)
    return found


def _with_priors(record: AxisRecord, given: Mapping[str, Given]) -> AxisEstimate | None:
    priors = {SYMBOLS[name]: known for name, known in axis_priors(given, record.name).items()}
    return record.with_priors(priors).estimate() if priors else None


def _seconds(period: Estimate, results: Sequence[Identified]) -> float:
    """Return the period beside which a delay is judged, the shortest one where the logs have none in common."""
    if period.value is not None:
        return period.value
    return min(r.sample_time_s.value for r in results if r.sample_time_s.value is not None)


def _sensor(merge: Merge, results: Sequence[Identified]) -> SensorEstimate:
    sensors = [result.sensor for result in results]
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
        wrench_filter=_wrench_filter(merge, results),
        position_noise_rms_m=_largest_known([s.position_noise_rms_m for s in sensors]),
    )


def _wrench_filter(merge: Merge, results: Sequence[Identified]) -> WrenchFilterEstimate | None:
    """Average filters of one kind; where logs show different kinds, or one shows none, the latest wrench counts."""
    filters = [result.sensor.wrench_filter for result in results]
    stated = [(name, f) for name, f in zip(merge.names, filters, strict=True) if f is not None]
    if not stated:
        return None
    prompt = [name for name, result in zip(merge.names, results, strict=True) if _is_prompt(result, stated)]
    corners = [None if f is None else f.corner_hz for f in filters]
    delays = [None if f is None else f.delay_s for f in filters]
    if not any(delays) and not prompt:
        return WrenchFilterEstimate(corner_hz=merge.scalars("wrench filter's corner [Hz]", corners))
    if not any(corners) and not prompt:
        return WrenchFilterEstimate(delay_s=merge.scalars("delay of the wrench [s]", delays))
    late = ", ".join(
        [f"{1e3 * _lateness_s(f):.3g} ms late ({name})" for name, f in stated]
        + [f"not late ({name})" for name in prompt]
    )
    merge.findings.append(
        Finding(
            code="logs-disagree",
            severity="error",
            message=f"The logs disagree on whether the wrench is filtered or delayed: {late}.",
            advice="Identify logs of different sensors, or of different filters in one, each on its own.",
        )
    )
    return max((f for _, f in stated), key=_lateness_s)


def _is_prompt(result: Identified, late: Sequence[tuple[str, WrenchFilterEstimate]]) -> bool:
    """Return whether a log without a filter shows that its wrench is not as late as that of the others."""
    lags = [fit.wrench_lag_s + _CLEAR_STDS * fit.wrench_lag_std_s for axis in result.axes.values() for fit in axis.fits]
    least = min(_lateness_s(each) for _, each in late)
    return result.sensor.wrench_filter is None and bool(lags) and max(lags) < _PROMPT_SHARE * least


def _lateness_s(wrench_filter: WrenchFilterEstimate) -> float:
    """Return how late a slow change of the force arrives: 1/(2π corner) of a filter, or the delay."""
    corner, delay = wrench_filter.corner_hz, wrench_filter.delay_s
    if corner is not None and corner.value is not None:
        return float(1.0 / (2.0 * np.pi * corner.value))
    return 0.0 if delay is None or delay.value is None else delay.value


def _noisiest(sensors: Sequence[SensorEstimate]) -> NoiseSpectrum | None:
    """Return the spectrum of the log with most noise, as its rms is what is known."""
    stated = [s for s in sensors if s.noise is not None]
    return max(stated, key=lambda s: s.force_noise_rms_n.value or 0.0).noise if stated else None


def _optional(merge: Merge, what: str, estimates: Sequence[VectorEstimate | None]) -> VectorEstimate | None:
    """Average vectors of which logs may know nothing; what changes with the day is a warning."""
    if all(estimate is None for estimate in estimates):
        return None
    empty = VectorEstimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
    return merge.vectors(what, [empty if e is None else e for e in estimates], may_change=True)


def _largest(estimates: Sequence[Estimate]) -> Estimate:
    """Return the worst of noises and residuals that is known: what any of the logs shows is there."""
    known = [estimate for estimate in estimates if estimate.value is not None]
    if not known:
        return estimates[0]
    worst = max(known, key=lambda e: e.value if e.value is not None else -1.0)
    if len(known) == len(estimates):
        return worst
    note = f"known from {len(known)} of {len(estimates)} logs"
    return replace(worst, note=f"{worst.note}; {note}" if worst.note else note)


def _largest_known(estimates: Sequence[Estimate | None]) -> Estimate | None:
    """Return the worst of those that have a value, None where none has."""
    stated = [estimate for estimate in estimates if estimate is not None and estimate.value is not None]
    return max(stated, key=lambda e: 0.0 if e.value is None else e.value, default=None)


def _sample_time(parts: Sequence[NamedResult], findings: list[Finding], *, is_given: bool) -> Estimate:
    """Return the control period, which commands show: without one the rate of the wrench is taken, if all have one."""
    times = [(part.name, part.result.sample_time_s) for part in parts if part.result.sample_time_s.value is not None]
    if not times:
        return parts[0].result.sample_time_s
    best = min((t.status for _, t in times), key=ORDER.index)
    sure = best in (Status.GIVEN, Status.IDENTIFIED)
    counted = [(name, t) for name, t in times if not sure or t.status in (Status.GIVEN, Status.IDENTIFIED)]
    values = [t.value for _, t in counted if t.value is not None]
    if max(values) - min(values) <= _SAME_PERIOD * min(values):
        return min((t for _, t in counted), key=lambda t: ORDER.index(t.status))
    stated = ", ".join(f"{1e3 * t.value:.4f} ms ({name})" for name, t in counted if t.value is not None)
    if sure:
        raise LogError(
            f"Logs that are combined must come from one control period, found {stated}; identify each on its own."
        )
    if not is_given:
        findings.append(
            missing(
                "control-period",
                f"No log has a command, and their wrenches come every {stated}: the control period may be another.",
                f"Record the position command, or give the period with --given {_PERIOD}=VALUE.",
            )
        )
    return unidentifiable(note=f"no log has a command, and the wrenches come every {stated}")


def _without_settled(findings: Sequence[Finding], combined: Identified) -> list[Finding]:
    """Leave out what one log lacks and another has: the combination shows it."""
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


def common_surfaces(results: Sequence[Identified]) -> list[dict[str, str]]:
    """Return for each log what its surfaces are called among those of all logs.

    Surfaces whose secant (else K_e, else first blow) agrees within three deviations are one; each log has a surface at
    most once.
    """
    renamed: list[dict[str, str]] = [{} for _ in results]
    for axis in dict.fromkeys(name for result in results for name in result.axes):
        groups: list[dict[int, EnvironmentEstimate]] = []
        for log, result in enumerate(results):
            for surface in result.axes[axis].environments if axis in result.axes else ():
                fitting = [g for g in groups if log not in g and all(_alike(surface, other) for other in g.values())]
                if fitting:
                    fitting[0][log] = surface
                else:
                    groups.append({log: surface})
        for i, group in enumerate(groups):
            for log, surface in group.items():
                renamed[log][surface.name] = f"{axis}{i + 1}"
    return renamed


def rename_surfaces(result: Identified, names: Mapping[str, str]) -> Identified:
    """Return a result with its surfaces renamed, in the table and in the covariance."""
    return replace(result, axes={name: _renamed(axis, names) for name, axis in result.axes.items()})


def rename_timeline(line: Timeline, names: Mapping[str, str]) -> Timeline:
    """Return a time line with the surfaces of its contacts and touches renamed."""
    touches = tuple(
        touch if touch.surface is None else replace(touch, surface=names.get(touch.surface, touch.surface))
        for touch in line.touches
    )
    phases = tuple(
        phase
        if phase.contact is None or phase.contact.surface is None
        else replace(
            phase, contact=replace(phase.contact, surface=names.get(phase.contact.surface, phase.contact.surface))
        )
        for phase in line.phases
    )
    return replace(line, phases=phases, touches=touches)


def rename_in_text(text: str, names: Mapping[str, str]) -> str:
    """Return a message with the surfaces that it names under their common names."""
    return re.sub(r"\b\w+\b", lambda word: names.get(word[0], word[0]), text)


def _renamed(axis: AxisEstimate, names: Mapping[str, str]) -> AxisEstimate:
    covariance = axis.covariance
    if covariance is not None:
        covariance = replace(covariance, names=tuple(_symbol(symbol, names) for symbol in covariance.names))
    surfaces = tuple(replace(s, name=names.get(s.name, s.name)) for s in axis.environments)
    return replace(axis, environments=surfaces, covariance=covariance)


def _symbol(symbol: str, names: Mapping[str, str]) -> str:
    surface, dot, kind = symbol.rpartition(".")
    return f"{names.get(surface, surface)}{dot}{kind}"


def _alike(one: EnvironmentEstimate, other: EnvironmentEstimate) -> bool:
    first, second = one.secant_stiffness_n_per_m, other.secant_stiffness_n_per_m
    if not is_stated(first) or not is_stated(second):
        first, second = one.stiffness_n_per_m, other.stiffness_n_per_m
    here, there = one.impact_n_s_per_m, other.impact_n_s_per_m
    if (first.value is None or second.value is None) and here is not None and there is not None:
        first, second = here, there
    if first.value is None or second.value is None or first.std is None or second.std is None:
        return False
    return abs(first.value - second.value) <= _SAME_SURFACE_STDS * float(np.hypot(first.std, second.std))
