"""Figures of results for scripts and notebooks: charts of the reports, drawn by matplotlib on axes of the caller."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from autotune.charts.chart import Chart, Element, Line, Panel, Role, Scale
from problems.model.response import loop_response
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import frequency_grid

if TYPE_CHECKING:
    from autotune.report.axis_design import AxisDesign
    from identification.signals.recording import Recording


_POINTS = 700
# A law by Tustin's rule has a zero at the Nyquist frequency itself, whose dB would set the scale.
_NYQUIST_SHARE = 0.9


def bode_chart(design: "AxisDesign") -> Chart:
    """Draw gain and phase of the open loop, cut at the force, for the ends of the domain and its worst plant.

    L is that of the exact sampled loop (docs/method.md, "The loop"), to 0.9 of the Nyquist frequency.
    """
    worst = design.worst_plant() or design.corners()[-1]
    cases: list[tuple[str, Role, Any]] = [
        ("" if i else "ends of the domain", "quiet", plant) for i, plant in enumerate(design.corners())
    ]
    gains: list[Element] = []
    phases: list[Element] = []
    for name, role, plant in [*cases, ("worst plant", "after", worst)]:
        sampled = build_sampled_plant(plant, design.sample_time_s)
        frequency = frequency_grid(sampled, _POINTS)
        frequency = frequency[frequency <= _NYQUIST_SHARE * np.pi / design.sample_time_s]
        loop = loop_response(sampled, design.law, frequency).at_force
        hertz = frequency / (2.0 * np.pi)
        gains.append(Line(x=hertz, y=20.0 * np.log10(np.abs(loop)), label=name, role=role))
        phases.append(Line(x=hertz, y=_phase_deg(loop), label=name, role=role))
    x = Scale(label="frequency [Hz]", spacing="log")
    return Chart(
        key=f"{design.name}-bode",
        title="Open loop, cut at the force: Bode",
        alternative="Gain and phase of the open loop over frequency.",
        panels=(
            Panel(x=x, y=Scale(label="|L| [dB]"), elements=tuple(gains)),
            Panel(x=x, y=Scale(label="phase of L [°]"), elements=tuple(phases)),
        ),
        linked=True,
    )


def _phase_deg(loop: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Return the continuous phase on the branch that begins between −315° and 45°, so that a gain begins at 0°."""
    phase = np.degrees(np.unwrap(np.angle(loop)))
    return np.asarray(phase - 360.0 * np.ceil((phase[0] - 45.0) / 360.0))


def log_chart(recording: "Recording") -> Chart:
    """Draw force, torque, and where the flange went, over the time from the first wrench on."""
    start = int(recording.wrench.stamp_ns[0])

    def seconds(stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(1e-9 * (stamps - start).astype(np.float64))

    wrench, pose = recording.wrench, recording.pose
    roles: tuple[Role, ...] = ("after", "model", "good")
    x = Scale(label="time [s]")

    def panel(label: str, stamps: NDArray[np.int64], values: NDArray[np.float64]) -> Panel:
        lines = (Line(x=seconds(stamps), y=values[:, i], label="xyz"[i], role=roles[i]) for i in range(values.shape[1]))
        return Panel(x=x, y=Scale(label=label), elements=tuple(lines))

    moved = 1e3 * (pose.position_m - pose.position_m[0])
    return Chart(
        key="log",
        title="Log: " + ", ".join(path.rpartition("/")[2] for path in recording.sha256),
        alternative="Force, torque and position over time.",
        panels=(
            panel("force [N]", wrench.stamp_ns, wrench.force_n),
            panel("torque [N·m]", wrench.stamp_ns, wrench.torque_n_m),
            panel("flange [mm]", pose.stamp_ns, moved),
        ),
        linked=True,
    )
