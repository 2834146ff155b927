"""The report of a controller as it was tuned: what it promises, what that rests on, and what it costs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from autotune.files.controller_record import Controller
from autotune.files.units import axis_units
from autotune.validation.validate import admittance_controller

from .axis_design import AxisDesign, axis_designs
from .controller_tables import (
    checksum_fact,
    design_facts,
    domain_table,
    gains_table,
    proof_table,
    requirement_table,
    worst_table,
)
from .map_charts import map_chart
from .optimize_charts import admittance_chart, contact_charts, nyquist_chart, stiffness_chart
from .page import Block, Cell, Facts, Note, Page, Section, Table, Tone
from .search_charts import convergence_chart, front_chart

if TYPE_CHECKING:
    from autotune.tuning.optimize import Optimized


def build_optimize_page(
    controller: Controller,
    checksum: str,
    *,
    found: "Optimized | None" = None,
    old: Controller | None = None,
    fronts: Mapping[str, Any] | None = None,
) -> Page:
    """Build the report of a controller from its file alone, or with what only the search knows.

    `found` adds prices and convergence, `old` is drawn beside it on the same plants, `fronts` are the axes of
    `pareto.yaml`.
    """
    designs = axis_designs(controller)
    sections = [
        Section(
            key="result",
            title="Result",
            blocks=(
                Facts(facts=(checksum_fact(checksum),)),
                design_facts(designs),
                gains_table(controller),
                *active_notes(found),
            ),
        ),
        *(design_section(design, found, old) for design in designs),
        *([] if fronts is None else [front_section(fronts)]),
        *([] if found is None else search_section(found)),
        certificate_section(controller, designs),
    ]
    return Page(
        title="The controller and what it rests on",
        lead=_lead(controller, designs),
        tone=_tone(controller),
        sections=tuple(section for section in sections if section.blocks),
        footer=footer(controller, checksum),
    )


def _lead(controller: Controller, designs: Sequence[AxisDesign]) -> str:
    told = "; ".join(
        f"axis {each.name}: at most {max(s.peak_contact_force_n for s in each.predicted.scenarios):.1f} "
        f"{each.units.force} at the contact, modulus margin {each.margins.modulus:.3f}"
        for each in designs
    )
    return f"{controller.status.value.capitalize()}; {told}." if told else f"{controller.status.value.capitalize()}."


def _tone(controller: Controller) -> Tone:
    return "good" if controller.status.value == "validated" else "bad"


def footer(controller: Controller, checksum: str) -> str:
    """Return where a controller comes from."""
    tool, identified = controller.provenance.get("tool", ""), controller.provenance.get("identified")
    source = f"from {identified['path']} (sha256 {str(identified['sha256'])[:12]}…)" if identified else ""
    return " · ".join(part for part in (str(tool), source, f"checksum {checksum}") if part)


def active_notes(found: "Optimized | None") -> Iterator[Note]:
    """Yield what holds the peak of each axis up, in a sentence."""
    if found is None:
        return
    for name, active in found.active.items():
        paid = [each for each in active if each.price_n > 1e-3]
        told = ", ".join(each.name.replace("_", " ") for each in paid)
        text = (
            f"Axis {name}: what holds the peak up is {told}."
            if paid
            else f"Axis {name}: no requirement holds the peak up."
        )
        yield Note(text=text, kind="why", tone="quiet")


def design_section(design: AxisDesign, found: "Optimized | None", old: Controller | None) -> Section:
    """Return requirements and figures of one axis."""
    before = None if old is None or design.name not in old.axes else admittance_controller(old, design.name)
    active = None if found is None else found.active.get(design.name)
    blocks: list[Block] = [requirement_table(design, active), *contact_charts(design, before)]
    blocks += [stiffness_chart(design, before), admittance_chart(design, before), nyquist_chart(design, before)]
    blocks.append(map_chart(design))
    return Section(key=f"axis-{design.name}", title=f"Axis {design.name}", blocks=tuple(blocks))


def search_section(found: "Optimized") -> list[Section]:
    """Return how the search went, axis by axis."""
    blocks: list[Block] = []
    for name, search in found.searches.items():
        chart = convergence_chart(name, axis_units(name), search.steps)
        blocks += [] if chart is None else [chart]
        blocks.append(_optimality_table(name, found))
    return [Section(key="search", title="The search", blocks=tuple(blocks))]


def _optimality_table(name: str, found: "Optimized") -> Table:
    search, holds = found.searches[name], found.optimality[name]
    rows = (
        ("designs evaluated", f"{search.evaluations}"),
        ("scenarios that the result was evaluated on", f"{search.scenario_count}"),
        ("rounds of adding the worst scenarios", f"{search.rounds}"),
        ("scenarios at the top together", f"{holds.scenarios}"),
        ("residual of the optimality conditions", f"{100.0 * holds.relative_residual:.2g} % of the gradient"),
        ("what unused slack could still save", f"{100.0 * holds.slack:.2g} % of the peak"),
    )
    return Table(
        caption=f"Axis {name}: whether it is optimal",
        columns=("", "value"),
        rows=tuple((Cell(text=what), Cell(text=value, is_number=True)) for what, value in rows),
    )


def front_section(fronts: Mapping[str, Any]) -> Section:
    """Return the fronts of `pareto.yaml`, figure and table."""
    blocks: list[Block] = []
    for axis, tree in fronts.items():
        blocks += [front_chart(axis, tree), _front_table(axis, tree)]
    return Section(key="front", title="What can be traded", blocks=tuple(blocks))


def _front_table(axis: str, tree: Mapping[str, Any]) -> Table:
    objectives = tree["objectives"]
    heads = tuple(f"{each['name'].replace('_', ' ')} [{each['unit']}]".replace(" []", "") for each in objectives)
    rows = []
    for index, point in enumerate(tree["points"]):
        values = [point["values"][each["name"]] for each in objectives]
        gains = [point[key] for key in ("mass", "damping", "lead_s", "feedback_damping_s")]
        numbers = [Cell(text=f"{value:.5g}", is_number=True) for value in (*values, *gains)]
        mark = "the controller written" if index == tree["chosen"] else ""
        rows.append((Cell(text=str(index + 1)), *numbers, Cell(text=mark, tone="good")))
    return Table(
        caption=f"Controllers of axis {axis}",
        columns=("", *heads, "M_a", "B_a", "K_l [s]", "B_fb [s]", ""),
        rows=tuple(rows),
    )


def build_front_page(tree: Mapping[str, Any]) -> Page:
    """Build the report of a `pareto.yaml`."""
    axes = tree["axes"]
    told = "; ".join(f"axis {axis}: {len(front['points'])} controllers" for axis, front in axes.items())
    return Page(
        title="What can be traded against what",
        lead=f"{told}.".capitalize(),
        sections=(front_section(axes),),
        footer=str(tree["provenance"].get("tool", "")),
    )


def certificate_section(controller: Controller, designs: Sequence[AxisDesign]) -> Section:
    """Return what is proved, over which plants, and the worst of them."""
    blocks: list[Block] = [proof_table(controller)]
    for design in designs:
        blocks += [domain_table(design), worst_table(design)]
    return Section(key="certificate", title="Certificate", blocks=tuple(blocks))
