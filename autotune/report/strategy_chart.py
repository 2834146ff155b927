"""What a controller does beside its gains, collision response and variable damping: a contact drawn, and the peaks."""

from collections.abc import Iterator

from autotune.charts.chart import Chart, Element, Limit, Line, Panel, Scale
from autotune.text import scenario_text
from problems.contact.nonlinear_simulation import NonlinearRun, needed_substeps, simulate_nonlinear
from problems.contact.nonlinearities import NO_NONLINEARITIES, Nonlinearities
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.stability.margins import UnstableLoopError

from .axis_design import AxisDesign
from .page import Table, build_table

_PEAKS_LATER, _SHORTEST_S, _LONGEST_S = 4.0, 0.15, 2.0


def strategy_chart(design: AxisDesign) -> Chart | None:
    """Draw the hardest contact with the strategies and without, and what B_a does; None where there are none.

    None, too, where the full simulation takes no such contact.
    """
    strategy = design.strategy
    if strategy == NO_NONLINEARITIES:
        return None
    worst = design.worst_contact
    duration = min(max(_PEAKS_LATER * worst.time_of_peak_s, _SHORTEST_S), _LONGEST_S)
    try:
        plain, run = (_contact(design, worst.scenario(), each, duration) for each in (NO_NONLINEARITIES, strategy))
    except (ParameterError, UnstableLoopError):
        return None
    units, time = design.units, 1e3 * plain.time_s
    x = Scale(label="time after touching [ms]", limits=(0.0, 1e3 * duration))
    force: list[Element] = [
        Line(x=time, y=plain.contact_force_n, label="without", role="before"),
        Line(x=time, y=run.contact_force_n, label="with", role="after"),
        *_detected(run),
    ]
    panels = [Panel(x=x, y=Scale(label=f"{units.force_name} at the surface [{units.force}]"), elements=tuple(force))]
    if strategy.variable_damping is not None:
        damping = Line(x=time, y=run.damping_n_s_per_m, role="after", steps=True)
        own = Limit(value=design.law.damping_n_s_per_m, label="of the design", role="before")
        panels.append(
            Panel(x=x, y=Scale(label=f"B_a [{units.damping}]"), elements=(own, damping, *_detected(run)), height=0.6)
        )
    return Chart(
        key=f"{design.name}-strategy",
        title="What it does beside its gains, in the hardest contact",
        alternative=f"The largest {units.force_name} at the surface goes from {plain.peak_contact_force_n:.4g} without "
        f"to {run.peak_contact_force_n:.4g} {units.force} with {_named(strategy)}, {_when(run)}.",
        caption=f"{scenario_text(worst.scenario(), units)}; {_named(strategy)}; {_when(run)}.",
        panels=tuple(panels),
        linked=len(panels) > 1,
    )


def _contact(design: AxisDesign, scenario: Scenario, effects: Nonlinearities, duration_s: float) -> NonlinearRun:
    plant = design.plant(scenario)
    return simulate_nonlinear(
        plant,
        design.law,
        design.approach,
        sample_time_s=design.sample_time_s,
        duration_s=duration_s,
        effects=effects,
        substeps=needed_substeps(plant, design.sample_time_s),
    )


def _detected(run: NonlinearRun) -> Iterator[Element]:
    if run.collision_time_s is not None:
        yield Limit(value=1e3 * run.collision_time_s, along="x", label="detected", role="target")


def _named(strategy: Nonlinearities) -> str:
    collision, variable = strategy.collision, strategy.variable_damping
    names = [] if collision is None else [f"a {collision.response} at {collision.threshold_n:g} N against the motion"]
    if variable is not None:
        low, high = variable.bounds_n_s_per_m
        names.append(f"B_a from {high:g} at rest to {low:g} under way")
    return " and ".join(names)


def _when(run: NonlinearRun) -> str:
    found = "no collision is detected" if run.collision_time_s is None else "the collision is detected"
    return found if run.collision_time_s is None else f"{found} {1e3 * run.collision_time_s:.1f} ms after the touch"


def response_table(design: AxisDesign) -> Table | None:
    """Return the predicted contacts with all strategies beside those without; None where there are none."""
    without, predicted = {each.scenario(): each for each in design.predicted.scenarios}, design.predicted
    rows = []
    for each in predicted.with_collision_response or predicted.with_variable_damping:
        both = (without.get(each.scenario()), each)
        peaks = (
            None if run is None else getattr(run, name)
            for name in ("peak_contact_force_n", "peak_sensor_force_n")
            for run in both
        )
        rows.append((each.name, *("" if peak is None else f"{peak:.1f} {design.units.force}" for peak in peaks)))
    heads = ("contact", "at the contact", "with it", "at the sensor", "with it")
    names = ("variable damping", "collision response")
    asked = (predicted.with_variable_damping, predicted.with_collision_response)
    caption = f"Peaks without and with {' and '.join(name for name, of in zip(names, asked, strict=True) if of)}"
    return build_table(caption, heads, rows, numbers=range(1, 5)) if rows else None
