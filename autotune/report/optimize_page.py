"""The page of a tuned controller: requirements, figures, the search, the front, and the certificate."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.charts.chart import Chart, Element, Line, Panel, Points, Scale
from autotune.formats.canonical import short
from autotune.formats.controller_record import Controller
from autotune.formats.units import axis_units
from autotune.prediction.as_run_by import as_run_by, designed_for
from autotune.prediction.before_after import BeforeAndAfter
from autotune.prediction.law import PresentGains
from autotune.text import NOTHING_BEFORE
from autotune.validation.false_triggers import describe_false_triggers
from problems.arrays import FloatArray
from problems.model.axis_kind import AxisKind
from problems.text import significant

from .axis_design import AxisDesign, axis_designs
from .controller_charts import admittance_chart, contact_chart, map_chart, nyquist_chart, stiffness_chart
from .controller_tables import (
    checksum_fact,
    compared_blocks,
    compliance_tables,
    constraint_title,
    design_facts,
    domain_table,
    gains_table,
    law_before,
    led_table,
    number,
    prices_of,
    proof_table,
    regions_table,
    requirement_table,
    target_facts,
    worst_table,
)
from .coupled_section import coupled_section
from .page import Block, Fact, Facts, Note, Page, Section, Table, TableCell, build_table
from .strategy_chart import response_table, strategy_chart

if TYPE_CHECKING:
    from autotune.tuning.search import SearchStep

_LEAST_PRICE = 1e-3
_NO_LIMIT = Note(
    text="What any linear controller could reach here, and the force that none gets below: optimize --limit, or "
    "autotune limit for the file.",
    tone="quiet",
)


def build_optimize_page(
    controller: Controller,
    checksum: str,
    *,
    steps: Mapping[str, Sequence["SearchStep"]] | None = None,
    old: PresentGains | None = None,
    before_after: Mapping[str, BeforeAndAfter] | None = None,
    fronts: Mapping[str, Any] | None = None,
    limits: Mapping[str, Sequence[Block]] | None = None,
) -> Page:
    """Build the report of a controller from its file alone, or with what only the search knows.

    `steps` adds by axis how the search converged, `old` is drawn beside it on the same plants, `before_after` are the
    contacts of the log replayed, `fronts` are the axes of `pareto.yaml`, `limits` says
    and shows how far each axis is from any linear controller.
    """
    designs, target = axis_designs(controller), designed_for(controller)
    replayed = before_after or {}
    sections = [
        Section(
            key="before-after",
            title="Before and after"
            if old is not None or any(each.surfaces for each in replayed.values())
            else "The contact",
            blocks=tuple(block for design in designs for block in _first_blocks(design, old, replayed, target)),
        ),
        Section(key="target", title=f"As {target} runs it", blocks=tuple(target_facts(controller))),
        *own_law_sections(
            target,
            [
                _result_section(controller, designs, () if target or limits else (_NO_LIMIT,)),
                *(
                    design_section(design, optimality_of(controller, design.name), old, checksum, replayed)
                    for design in designs
                ),
                Section(
                    key="limit",
                    title="How far from the limit",
                    blocks=tuple(block for blocks in (limits or {}).values() for block in blocks),
                ),
                *([] if fronts is None else [front_section(fronts)]),
                Section(
                    key="led",
                    title="Led by hand",
                    blocks=tuple(each for each in (led_table(controller, designs),) if each is not None),
                    is_folded=True,
                ),
                coupled_section(controller),
                replace(search_section(controller, steps or {}), is_folded=True),
                replace(certificate_section(controller, designs), is_folded=True),
            ],
        ),
        Section(
            key="provenance",
            title="Checksum and origin",
            blocks=tuple(_origin(controller, checksum, old)),
            is_folded=True,
        ),
    ]
    return Page(
        title="The controller and what it changes",
        lead=_lead(controller, designs, replayed),
        tone="good" if controller.status.value == "validated" else "bad",
        sections=tuple(section for section in sections if section.blocks),
        footer=footer(controller, checksum),
    )


def own_law_sections(target: str, sections: Sequence[Section]) -> Iterator[Section]:
    """Yield sections of our own law: of a file for an export target folded, and headed as what does not run there."""
    for each in sections:
        title = f"Our own law, not that of {target}: {each.title}"
        yield replace(each, title=title, is_folded=True) if target else each


def _lead(controller: Controller, designs: Sequence[AxisDesign], replayed: Mapping[str, BeforeAndAfter]) -> str:
    """Return three sentences: what it changes, what is certified, and what holds it back."""
    many = len(designs) > 1
    recorded = controller.provenance.get("before_after", {})
    texts = {each.name: recorded[each.name]["text"] if each.name in recorded else NOTHING_BEFORE for each in designs}
    texts |= {name: each.sentence() for name, each in replayed.items() if name in texts and not each.is_empty}
    changes = ((f"axis {name}: " if many else "") + text for name, text in texts.items())
    axes = ((f"axis {each.name} " if many else "") + _certified_text(controller, each) for each in designs)
    target = designed_for(controller)
    status = f"certified as {target} runs it" if target else f"{controller.status.value} over all that is certified"
    certified = f"{status}: {'; '.join(axes)}"
    limits = [] if target else [note.text for note in active_notes(controller)]
    sentences = ("; ".join(changes), certified, *((" ".join(limits),) if limits else ()))
    return " ".join(f"{each[0].upper()}{each[1:]}".rstrip(".") + "." for each in sentences)


def _certified_text(controller: Controller, design: AxisDesign) -> str:
    """Return largest peak and modulus margin of one axis, as what runs has them."""
    target = as_run_by(controller, design.name)
    peak = design.worst_contact.peak_contact_force_n if target is None else target.peak
    modulus = design.margins.modulus if target is None else target.margins.get("modulus")
    return f"at most {peak:.1f} {design.units.force} at the contact, modulus margin {number(modulus)}"


def _first_blocks(
    design: AxisDesign, old: PresentGains | None, replayed: Mapping[str, BeforeAndAfter], target: str
) -> Iterator[Block]:
    """Yield the figure of the hardest contact before and after, of the log or else of the certified plants."""
    found = replayed.get(design.name)
    chart = None if found is None else found.chart()
    if found is None or chart is None:
        if target:
            return
        chart = contact_chart(design, law_before(old, design.name))
        yield from () if chart is None else (chart,)
        return
    yield chart
    for text in (*found.further(), *found.notes):
        yield Note(text=text, kind="note", tone="quiet")


def _origin(controller: Controller, checksum: str, old: PresentGains | None) -> Iterator[Block]:
    """Yield what the files are compared by and what was asked."""
    yield Facts(facts=(checksum_fact(checksum), *_before_fact(old)))
    asked = controller.provenance.get("options", {})
    said = [(str(name).replace("_", " "), str(value)) for name, value in asked.items() if value is not None]
    if said:
        yield build_table("What was asked on the command line", ("option", "value"), said)


def _before_fact(old: PresentGains | None) -> Iterator[Fact]:
    if old is not None:
        detail = "" if old.file is None else f"checksum {short(old.file.checksum)}"
        yield Fact(label="before, in grey", value=old.name, detail=detail)


def _result_section(controller: Controller, designs: Sequence[AxisDesign], further: Sequence[Note]) -> Section:
    """Return gains, margins and peaks, and what holds them up."""
    blocks: list[Block] = [design_facts(designs), gains_table(controller), *_notes(controller), *further]
    return Section(key="result", title="Result", blocks=tuple(blocks))


def _notes(controller: Controller) -> Iterator[Note]:
    """Say what holds the result, how often the collision response begins without a collision, and the file's notes."""
    yield from active_notes(controller)
    found = controller.collision.false_triggers
    if found is not None:
        text = describe_false_triggers(found)
        yield Note(text=f"{text[0].upper()}{text[1:]}.")
    for text in controller.provenance.get("notes", ()):
        yield Note(text=str(text), kind="note", tone="quiet")


def footer(controller: Controller, checksum: str) -> str:
    """Return where a controller comes from."""
    tool, identified = controller.provenance.get("tool", ""), controller.provenance.get("identified")
    source = f"from {identified['path']} (sha256 {str(identified['sha256'])[:12]}…)" if identified else ""
    return " · ".join(part for part in (str(tool), source, f"checksum {checksum}") if part)


def active_notes(controller: Controller) -> Iterator[Note]:
    """Yield what holds the peak of each axis up, in a sentence."""
    for name in controller.axes:
        prices = prices_of(optimality_of(controller, name))
        if prices is not None:
            active = ", ".join(constraint_title(each) for each, price in prices.items() if price > _LEAST_PRICE)
            words, _, _ = _objective_of(optimality_of(controller, name), axis_units(name))
            verb = "holds the peak up" if words.startswith("peak") else f"holds the {words} back"
            text = f"what {verb} is {active}." if active else f"no requirement {verb}."
            yield Note(text=f"Axis {name}: {text}", kind="why", tone="quiet")


def optimality_of(controller: Controller, name: str) -> Mapping[str, Any] | None:
    """Return what the file says of how near one axis is to the best, None where it does not."""
    axes = controller.provenance.get("optimality")
    found = axes.get(name) if isinstance(axes, Mapping) else None
    return found if isinstance(found, Mapping) else None


def _objective_of(optimality: Mapping[str, Any] | None, units: AxisKind) -> tuple[str, str, bool]:
    """Return what was minimised, or maximised (True): its name in words and its unit."""
    found = (optimality or {}).get("objective")
    if found is None:
        return f"peak {units.force_name}", units.force, False
    return _title(found), found["unit"], found["direction"] == "maximize"


def design_section(
    design: AxisDesign,
    optimality: Mapping[str, Any] | None,
    old: PresentGains | None,
    checksum: str,
    replayed: Mapping[str, BeforeAndAfter],
) -> Section:
    """Return requirements, comparison and figures of one axis."""
    before = law_before(old, design.name)
    blocks: list[Block] = [requirement_table(design, prices_of(optimality)), *compared_blocks(design, old, checksum)]
    if design.name in replayed and replayed[design.name].surfaces:
        # Without contacts of a log this figure is the first of the page.
        chart = contact_chart(design, before)
        blocks += [] if chart is None else [chart]
    blocks += [stiffness_chart(design, before), admittance_chart(design, before), nyquist_chart(design, before)]
    blocks.append(map_chart(design))
    blocks += [each for each in (strategy_chart(design), response_table(design)) if each is not None]
    return Section(key=f"axis-{design.name}", title=f"Axis {design.name}", blocks=tuple(blocks))


def search_section(controller: Controller, steps: Mapping[str, Sequence["SearchStep"]]) -> Section:
    """Return how the search went, as far as it is known, and how near each axis is to the best."""
    blocks: list[Block] = [*compliance_tables(controller)]
    for name in controller.axes:
        optimality = optimality_of(controller, name)
        chart = convergence_chart(name, _objective_of(optimality, axis_units(name)), steps.get(name, ()))
        blocks += [] if chart is None else [chart]
        blocks += [] if optimality is None else [_optimality_table(name, optimality)]
    return Section(key="search", title="The search", blocks=tuple(blocks))


def _optimality_table(name: str, optimality: Mapping[str, Any]) -> Table:
    against = optimality["gap_against"]
    words, unit, is_maximised = _objective_of(optimality, axis_units(name))
    best, elsewhere = (
        next(value for key, value in against.items() if key.startswith(what))
        for what in (("best", "least"), "from_elsewhere")
    )
    most = "most" if is_maximised else "least"
    rows = [
        ("requirements", "all met" if optimality["feasible"] else "missed"),
        ("contacts that this was seen on", str(optimality["scenarios"])),
        (
            "left over of the conditions of an optimum",
            f"at most {significant(optimality['kkt_residual'])} of the gradient",
        ),
        (
            "unused slack is worth",
            f"at most {significant(100.0 * optimality['unused_slack'])} % of the {words}",
        ),
        (f"gap to the {most} that was found", f"at most {significant(100.0 * optimality['gap'])} %"),
        (f"the {most}, over the hardest contacts alone", f"{best:.4g} {unit}".rstrip()),
        (
            f"by {against['descents']} descents from the best of {against['designs']} other designs",
            "none met the requirements" if elsewhere is None else f"{elsewhere:.4g} {unit}".rstrip(),
        ),
    ]
    return build_table(f"Axis {name}: how near it is to the best", ("", "found"), rows, numbers=(1,))


def front_section(fronts: Mapping[str, Any]) -> Section:
    """Return the fronts of `pareto.yaml`, figure and table."""
    blocks: list[Block] = []
    for axis, tree in fronts.items():
        blocks += [front_chart(axis, tree), _front_table(axis, tree)]
    return Section(key="front", title="What can be traded", blocks=tuple(blocks))


def _front_table(axis: str, tree: Mapping[str, Any]) -> Table:
    objectives = tree["objectives"]
    heads = tuple(_side(each).label for each in objectives)
    rows: list[tuple[str | TableCell, ...]] = []
    for index, point in enumerate(tree["points"]):
        values = [point["values"][each["name"]] for each in objectives]
        values += [point["mass"], point["damping"], 1e3 * point["lead_s"], 1e3 * point["feedback_damping_s"]]
        mark = TableCell(text="the controller written" if index == tree["chosen"] else "", tone="good")
        rows.append((str(index + 1), *(f"{value:.5g}" for value in values), mark))
    columns = ("", *heads, "M_a", "B_a", "K_l [ms]", "B_fb [ms]", "")
    return build_table(f"Controllers of axis {axis}", columns, rows, numbers=range(1, len(columns) - 1))


def build_front_page(tree: Mapping[str, Any]) -> Page:
    """Build the report of a `pareto.yaml`."""
    axes = tree["axes"]
    counts = "; ".join(f"axis {axis}: {len(front['points'])} controllers" for axis, front in axes.items())
    return Page(
        title="What can be traded against what",
        lead=f"{counts}.".capitalize(),
        sections=(front_section(axes),),
        footer=str(tree["provenance"].get("tool", "")),
    )


def certificate_section(controller: Controller, designs: Sequence[AxisDesign]) -> Section:
    """Return what is proved, over which plants, and the worst of them."""
    blocks: list[Block] = [proof_table(controller)]
    for design in designs:
        regions = regions_table(design)
        blocks += [] if regions is None else [regions]
        blocks += [domain_table(design), worst_table(design)]
    return Section(key="certificate", title="Certificate", blocks=tuple(blocks))


def convergence_chart(name: str, of: tuple[str, str, bool], steps: Sequence["SearchStep"]) -> Chart | None:
    """Draw the best value over the designs evaluated; None where nothing was recorded.

    `of` is what `_objective_of` returns.
    """
    if not steps:
        return None
    rounds = [step for step in steps if step.whole_cost is not None]
    count = np.array([step.evaluations for step in steps], dtype=np.float64)
    words, unit, is_maximised = of

    def values(costs: Sequence[float]) -> FloatArray:
        return 1.0 / np.array(costs) if is_maximised else np.array(costs, dtype=np.float64)

    best = values([step.best_cost for step in steps])
    elements: list[Element] = [Line(x=count, y=best, label="over the working scenarios", role="after", steps=True)]
    whole = [step for step in rounds if step.whole_cost is not None and np.isfinite(step.whole_cost)]
    names = tuple(f"round {i}: {step.scenarios} scenarios" for i, step in enumerate(rounds, 1))
    if whole:
        elements.append(
            Points(
                x=np.array([step.evaluations for step in whole], dtype=np.float64),
                y=values([step.whole_cost or 0.0 for step in whole]),
                label="over the whole set, at the end of a round",
                role="model",
                marker="diamond",
                names=names[-len(whole) :],
            )
        )
    rounds_text = f"{len(rounds)} round{'' if len(rounds) == 1 else 's'} of adding the worst scenarios"
    return Chart(
        key=f"{name}-convergence",
        title="How the search converged",
        alternative=f"The best {words} over {int(count[-1])} evaluated designs, "
        f"from {best[0]:.4g} to {f'{best[-1]:.4g} {unit}'.rstrip()}, with {rounds_text}.",
        caption=f"{int(count[-1])} designs evaluated; {rounds_text}, the last with {steps[-1].scenarios} scenarios.",
        panels=(
            Panel(
                x=Scale(label="designs evaluated"),
                y=Scale(label=f"{words} [{unit}]" if unit else words),
                elements=tuple(elements),
            ),
        ),
    )


def front_chart(axis: str, tree: Mapping[str, Any]) -> Chart:
    """Draw the first two objectives of a front of `pareto.yaml` against each other, the chosen controller marked."""
    objectives, points, chosen = tree["objectives"], tree["points"], tree["chosen"]
    y, x = objectives[0], objectives[min(1, len(objectives) - 1)]
    values = {each["name"]: np.array([point["values"][each["name"]] for point in points]) for each in (x, y)}
    names = tuple(
        f"M_a {point['mass']:.4g}, B_a {point['damping']:.4g}, K_l {1e3 * point['lead_s']:.4g} ms, "
        f"B_fb {1e3 * point['feedback_damping_s']:.4g} ms"
        for point in points
    )
    order = np.argsort(values[x["name"]], kind="stable")
    at, of = values[x["name"]], values[y["name"]]
    elements: list[Element] = [
        Line(x=at[order], y=of[order], role="quiet"),
        Points(x=at, y=of, label="controllers", role="after", names=names),
    ]
    if chosen is not None:
        one = slice(chosen, chosen + 1)
        elements.append(Points(x=at[one], y=of[one], label="chosen", role="bad", marker="star", names=names[one]))
    return Chart(
        key=f"{axis}-front",
        title=f"What can be traded: {_title(y)} against {_title(x)}",
        alternative=f"{len(points)} controllers of axis {axis} of which none is beaten by another: {_title(y)} from "
        f"{np.min(of):.4g} to {np.max(of):.4g} {y['unit']}, {_title(x)} from {np.min(at):.4g} to {np.max(at):.4g} "
        f"{x['unit']}.",
        caption=f"Every point holds in {tree['scenarios']} scenarios."
        + (" Further objectives are in the table." if len(objectives) > 2 else ""),
        panels=(Panel(x=_side(x), y=_side(y), elements=tuple(elements), height=1.4),),
    )


def _title(objective: Mapping[str, Any]) -> str:
    return str(objective["name"]).replace("_", " ")


def _side(objective: Mapping[str, Any]) -> Scale:
    unit = f" [{objective['unit']}]" if objective["unit"] else ""
    return Scale(label=f"{_title(objective)}{unit}")
