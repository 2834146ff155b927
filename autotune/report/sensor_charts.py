"""Charts of the sensor: its wrench over the phases of a log, and its noise at rest."""

from collections.abc import Iterator, Sequence

import numpy as np

from autotune.charts.chart import Chart, Element, Line, Panel, Role, Scale, Stretch
from identification.evidence import Evidence
from identification.result import NoiseSpectrum, PhaseKind, Timeline
from identification.signals.recording import Recording
from problems.arrays import FloatArray

_TIME = "time [s]"
_ROLES: dict[PhaseKind, Role] = {
    PhaseKind.TURNING: "other",
    PhaseKind.FREE_MOTION: "good",
    PhaseKind.COMMANDED_MOTION: "after",
    PhaseKind.HAND_LED_MOTION: "residual",
    PhaseKind.CONTACT: "bad",
    PhaseKind.UNKNOWN: "before",
}


def wrench_charts(evidence: Evidence, timeline: Timeline | None, mark: str) -> Iterator[Chart]:
    """Draw force and torque of the sensor, as logged and without weight and bias; the force over the log's phases."""
    time = np.asarray(evidence.period_s * np.arange(len(evidence.raw_S_n)), dtype=np.float64)
    shades = () if timeline is None else tuple(_shades(timeline))
    yield Chart(
        key=f"wrench-{mark}",
        title="Force of the sensor, and what happened when",
        alternative=f"Curves over {time[-1]:.3g} s, Fx, Fy, Fz in the sensor frame, as logged"
        f"{_without_weight('force', evidence.raw_S_n, evidence.compensated_S_n, 'N')}. {_phases(timeline)}",
        caption="Shaded: the phases that were found. What is not shaded is rest.",
        panels=_panels(time, "F", "N", evidence.raw_S_n, evidence.compensated_S_n, shades),
        linked=True,
    )
    if not np.isfinite(evidence.raw_torque_S_n_m).any():
        return
    yield Chart(
        key=f"torque-{mark}",
        title="Torque of the sensor",
        alternative=f"Curves over {time[-1]:.3g} s, Tx, Ty, Tz about the sensor's origin, as logged"
        f"{_without_weight('torque', evidence.raw_torque_S_n_m, evidence.compensated_torque_S_n_m, 'N·m')}.",
        panels=_panels(time, "T", "N·m", evidence.raw_torque_S_n_m, evidence.compensated_torque_S_n_m, ()),
        linked=True,
    )


def _without_weight(what: str, logged: FloatArray, compensated: FloatArray | None, unit: str) -> str:
    """Say what the curves reach."""
    if compensated is None:
        return f", its weight removed before; the {what} reaches {_largest(np.nan_to_num(logged)):.3g} {unit}"
    return f" and without weight and bias; without them the {what} reaches {_largest(compensated):.3g} {unit}"


def logged_charts(recording: Recording) -> tuple[Chart, ...]:
    """Draw force and torque of a log of which no more is known, as they were logged."""
    wrench = recording.wrench
    time = np.asarray(1e-9 * (wrench.stamp_ns - wrench.stamp_ns[0]), dtype=np.float64)
    return tuple(
        Chart(
            key=key,
            title=f"{what} of the sensor, as logged",
            alternative=f"Three curves over {time[-1]:.0f} s, {what.lower()} along x, y and z as logged, up to "
            f"{_largest(values):.3g} {unit}.",
            panels=_panels(time, letter, unit, values, None, ()),
            linked=True,
        )
        for key, what, letter, unit, values in (
            ("wrench-1", "Force", "F", "N", wrench.force_n),
            ("torque-1", "Torque", "T", "N·m", wrench.torque_n_m),
        )
        if np.isfinite(values).any()
    )


def _panels(
    time: FloatArray,
    letter: str,
    unit: str,
    logged: FloatArray,
    compensated: FloatArray | None,
    shades: Sequence[Stretch],
) -> tuple[Panel, ...]:
    panels = []
    for i, name in enumerate("xyz"):
        if not np.isfinite(logged[:, i]).any():
            continue
        lines = [
            Line(x=time, y=logged[:, i], label="as logged", role="before" if compensated is not None else "measured")
        ]
        if compensated is not None:
            lines.append(Line(x=time, y=compensated[:, i], label="without weight and bias", role="measured"))
        elements: tuple[Element, ...] = (*shades, *lines)
        panels.append(Panel(x=Scale(label=_TIME), y=Scale(label=f"{letter}{name} [{unit}]"), elements=elements))
    return tuple(panels)


def _largest(values: FloatArray) -> float:
    known = values[np.isfinite(values).all(axis=1)]
    return float(np.max(np.linalg.norm(known, axis=1), initial=0.0))


def _shades(timeline: Timeline) -> Iterator[Stretch]:
    for phase in timeline.phases:
        if phase.kind in _ROLES:
            label = phase.kind.value.replace("-", " ")
            yield Stretch(low=phase.start_s, high=phase.stop_s, label=label, role=_ROLES[phase.kind])


def _phases(timeline: Timeline | None) -> str:
    if timeline is None:
        return ""
    contacts = [p for p in timeline.phases if p.kind is PhaseKind.CONTACT]
    kinds = ", ".join(dict.fromkeys(p.kind.value.replace("-", " ") for p in timeline.phases))
    return f"Phases: {kinds}; {len(contacts)} contacts."


def noise_chart(noise: NoiseSpectrum) -> Chart:
    """Draw the sensor's noise at rest, of force and torque."""
    x = Scale(label="frequency [Hz]", spacing="log")
    of = "force and torque" if noise.torque_n2_m2_per_hz else "force"
    return Chart(
        key="noise",
        title="Noise of the sensor at rest",
        alternative=f"Power density of the noise of {of} from {noise.frequency_hz[0]:.2g} to "
        f"{noise.frequency_hz[-1]:.3g} Hz, each the mean of three axes.",
        panels=tuple(
            Panel(
                x=x,
                y=Scale(label=label, spacing="log"),
                elements=(Line(x=np.array(noise.frequency_hz), y=np.array(values), role="measured"),),
            )
            for label, values in (
                ("force [N²/Hz]", noise.force_n2_per_hz),
                ("torque [(N·m)²/Hz]", noise.torque_n2_m2_per_hz),
            )
            if values
        ),
        linked=True,
    )
