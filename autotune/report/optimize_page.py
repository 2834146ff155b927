"""The report of a controller as it was tuned: what it promises, what that rests on, and what it costs."""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from autotune.formats.canonical import short
from autotune.formats.controller import ControllerFile
from autotune.formats.controller_record import Controller
from autotune.formats.units import axis_units

from .axis_design import AxisDesign, axis_designs
from .compared_tables import compared_blocks, law_before
from .compliance_table import compliance_tables
from .controller_tables import (
    checksum_fact,
    design_facts,
    domain_table,
    gains_table,
    prices_of,
    proof_table,
    reach_table,
    requirement_table,
    response_table,
    worst_table,
)
from .map_charts import map_chart
from .optimize_charts import admittance_chart, contact_charts, nyquist_chart, stiffness_chart
from .page import Block, Cell, Fact, Facts, Note, Page, Section, Table, Tone
from .search_charts import convergence_chart, front_chart

if TYPE_CHECKING:
    from autotune.tuning.search import SearchStep

_LEAST_PRICE = 1e-3


def build_optimize_page(
    controller: Controller,
    checksum: str,
    *,
    steps: Mapping[str, Sequence["SearchStep"]] | None = None,
    old: ControllerFile | None = None,
    fronts: Mapping[str, Any] | None = None,
) -> Page:
    """Build the report of a controller from its file alone, or with what only the search knows.

    `steps` adds by axis how the search converged, `old` is drawn beside it on the same plants, `fronts` are the axes of
    `pareto.yaml`.
    """
    designs = axis_designs(controller)
    sections = [
        Section(
            key="result",
            title="Result",
            blocks=(
                Facts(facts=(checksum_fact(checksum), *_before_fact(old))),
                design_facts(designs),
                gains_table(controller),
                *active_notes(controller),
            ),
        ),
        *(design_section(design, standing_of(controller, design.name), old, checksum) for design in designs),
        *([] if fronts is None else [front_section(fronts)]),
        search_section(controller, steps or {}),
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


def _before_fact(old: ControllerFile | None) -> Iterator[Fact]:
    if old is not None:
        yield Fact(label="before, in grey", value=old.path.name, detail=f"checksum {short(old.checksum)}")


def _tone(controller: Controller) -> Tone:
    return "good" if controller.status.value == "validated" else "bad"


def footer(controller: Controller, checksum: str) -> str:
    """Return where a controller comes from."""
    tool, identified = controller.provenance.get("tool", ""), controller.provenance.get("identified")
    source = f"from {identified['path']} (sha256 {str(identified['sha256'])[:12]}…)" if identified else ""
    return " · ".join(part for part in (str(tool), source, f"checksum {checksum}") if part)


def active_notes(controller: Controller) -> Iterator[Note]:
    """Yield what holds the peak of each axis up, in a sentence."""
    for name in controller.axes:
        prices = prices_of(standing_of(controller, name))
        if prices is not None:
            told = ", ".join(each.replace("_", " ") for each, price in prices.items() if price > _LEAST_PRICE)
            text = f"what holds the peak up is {told}." if told else "no requirement holds the peak up."
            yield Note(text=f"Axis {name}: {text}", kind="why", tone="quiet")


def standing_of(controller: Controller, name: str) -> Mapping[str, Any] | None:
    """Return what the file says of how near one axis is to the best, None where it does not."""
    told = controller.provenance.get("optimality")
    found = told.get(name) if isinstance(told, Mapping) else None
    return found if isinstance(found, Mapping) else None


def design_section(
    design: AxisDesign, standing: Mapping[str, Any] | None, old: ControllerFile | None, checksum: str
) -> Section:
    """Return requirements, comparison and figures of one axis."""
    before = law_before(old, design.name)
    blocks: list[Block] = [requirement_table(design, prices_of(standing)), *compared_blocks(design, old, checksum)]
    blocks += contact_charts(design, before)
    blocks += [stiffness_chart(design, before), admittance_chart(design, before), nyquist_chart(design, before)]
    blocks.append(map_chart(design))
    responses = response_table(design)
    blocks += [] if responses is None else [responses]
    return Section(key=f"axis-{design.name}", title=f"Axis {design.name}", blocks=tuple(blocks))


def search_section(controller: Controller, steps: Mapping[str, Sequence["SearchStep"]]) -> Section:
    """Return how the search went, as far as it is known, and how near each axis is to the best."""
    blocks: list[Block] = [*compliance_tables(controller)]
    for name in controller.axes:
        chart, standing = convergence_chart(name, axis_units(name), steps.get(name, ())), standing_of(controller, name)
        blocks += [] if chart is None else [chart]
        blocks += [] if standing is None else [_standing_table(name, standing)]
    return Section(key="search", title="The search", blocks=tuple(blocks))


def _standing_table(name: str, standing: Mapping[str, Any]) -> Table:
    against, force = standing["gap_against"], axis_units(name).force
    least, elsewhere = (
        next(value for key, value in against.items() if key.startswith(f"{what}_"))
        for what in ("least", "from_elsewhere")
    )
    rows = [
        ("requirements", "all met" if standing["feasible"] else "missed"),
        ("contacts that this was seen on", str(standing["scenarios"])),
        ("left over of the conditions of an optimum", f"at most {standing['kkt_residual']:.2g} of the gradient"),
        ("unused slack is worth", f"at most {100.0 * standing['unused_slack']:.2g} % of the peak"),
        ("gap to the least that was found", f"at most {100.0 * standing['gap']:.2g} %"),
        ("the least, over the hardest contacts alone", f"{least:.4g} {force}"),
        (
            f"by {against['descents']} descents from the best of {against['designs']} other designs",
            "none met the requirements" if elsewhere is None else f"{elsewhere:.4g} {force}",
        ),
    ]
    return Table(
        caption=f"Axis {name}: how near it is to the best",
        columns=("", "found"),
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
        reach = reach_table(design)
        blocks += [] if reach is None else [reach]
        blocks += [domain_table(design), worst_table(design)]
    return Section(key="certificate", title="Certificate", blocks=tuple(blocks))
