"""Figures of results for scripts and notebooks: charts of the reports, drawn by matplotlib on axes of the caller."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from autotune.charts.chart import Chart, Element, Line, Panel, Points, Role, Scale
from autotune.errors import UsageError
from problems.contact.transient import ContactTransient
from problems.model.response import loop_response
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import frequency_grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from autotune.formats.units import AxisUnits
    from autotune.report.axis_design import AxisDesign
    from identification.signals.recording import Recording

    AxesLike = Axes | Sequence[Axes]

_POINTS = 700


def show(chart: Chart, ax: "AxesLike | None" = None, *, panel: int = 0) -> "Figure":
    """Draw a chart and return its figure.

    Parameters
    ----------
    chart
        What to draw.
    ax
        Axes to draw on: one for each panel of the chart, or a single one, which takes the panel number `panel`. None
        makes a figure that `matplotlib.pyplot.show` and notebooks show.
    panel
        Which panel a single axes takes.

    Raises
    ------
    UsageError
        The number of axes is neither one nor that of the panels.

    """
    from matplotlib.axes import Axes  # noqa: PLC0415 - half a second, which only who draws pays

    from autotune.charts.matplotlib_renderer import draw  # noqa: PLC0415

    if ax is None:
        from matplotlib import pyplot as plt  # noqa: PLC0415

        return draw(chart, make=plt.figure)
    given = [ax] if isinstance(ax, Axes) else list(ax)
    if len(given) not in {1, len(chart.panels)}:
        raise UsageError(f"{chart.title!r} takes one axes, or {len(chart.panels)} for its panels; found {len(given)}.")
    one = Chart(key=chart.key, title=chart.title, alternative=chart.alternative, panels=(chart.panels[panel],))
    return draw(one if len(given) == 1 else chart, given)


def bode_chart(design: "AxisDesign") -> Chart:
    """Draw gain and phase of the open loop, cut at the force, for the ends of the domain and its worst plant.

    L is that of the exact sampled loop (MODEL.md, "Continuous blocks"), to half the sampling rate.
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


def contact_chart(contact: ContactTransient, units: "AxisUnits", title: str) -> Chart:
    """Draw one predicted contact: the force at the surface and at the sensor over the time after touching."""
    time = 1e3 * contact.time_s
    peak = np.array([1e3 * contact.time_of_peak_s]), np.array([contact.peak_contact_force_n])
    return Chart(
        key="contact",
        title=title,
        alternative=f"The force after touching; its peak is {contact.peak_contact_force_n:.4g} {units.force}.",
        panels=(
            Panel(
                x=Scale(label="time after touching [ms]"),
                y=Scale(label=f"{units.force_name} [{units.force}]"),
                elements=(
                    Line(x=time, y=contact.contact_force_n, label="at the surface", role="after"),
                    Line(x=time, y=contact.sensor_force_n, label="at the sensor", role="after", dashed=True),
                    Points(x=peak[0], y=peak[1], role="after", marker="diamond", label="peak", names=("peak",)),
                ),
            ),
        ),
    )


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
