"""The page of a validation: the verdict, every check, and the contacts that were simulated or found in a log."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.charts.chart import Band, Bars, Chart, Limit, Line, Panel, Scale, level_panels
from autotune.formats.controller_record import Controller
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.prediction.as_run_by import designed_for
from autotune.text import scenario_text
from autotune.validation.against_log import MOST_DRAWN, ComparedContact, ContactTrace, LogComparison, share_text
from autotune.validation.monte_carlo import BAND, QUANTILES, AxisMonteCarlo
from autotune.validation.monte_carlo_checks import violations_text
from autotune.validation.report import ValidationReport

from .axis_design import AxisDesign, axis_designs
from .controller_charts import contact_chart, stiffness_chart
from .controller_tables import checksum_fact, design_facts
from .optimize_page import certificate_section, footer, own_law_sections
from .page import Block, Fact, Facts, Page, Section, Table, TableCell, Tone, build_table

_PANELS = 3


@dataclass(frozen=True, kw_only=True)
class Validated:
    """What a validation found: all checks, the contacts that it simulated, those of a log, and who signed."""

    report: ValidationReport
    simulated: tuple[AxisMonteCarlo, ...] = ()
    compared: LogComparison | None = None
    signed_by: str | None = None


def build_validate_page(controller: Controller, checksum: str, validated: Validated) -> Page:
    """Build the report of what `validate` found of a controller."""
    designs = axis_designs(controller)
    sections = [
        verdict_section(checksum, validated),
        *measured_section(validated),
        *simulated_section(validated),
        *own_law_sections(
            designed_for(controller),
            [
                *(
                    Section(
                        key=f"axis-{design.name}",
                        title=f"Axis {design.name}",
                        blocks=(design_facts((design,)), *_charts(design)),
                    )
                    for design in designs
                    if validated.report.passed
                ),
                certificate_section(controller, designs),
            ],
        ),
    ]
    return Page(
        title="Whether the controller keeps what it promises",
        lead=lead(validated),
        tone="good" if validated.report.passed else "bad",
        sections=tuple(sections),
        footer=footer(controller, checksum),
    )


def _charts(design: AxisDesign) -> Iterator[Chart]:
    contact = contact_chart(design)
    yield from () if contact is None else (contact,)
    yield stiffness_chart(design, None)


def lead(validated: Validated) -> str:
    """Return the verdict in a sentence."""
    checks = validated.report.checks
    failed = [check for check in checks if not check.passed]
    if failed:
        first = f"axis {failed[0].axis}, {failed[0].name}: {failed[0].message}"
        return f"NOT valid: {len(failed)} of {len(checks)} checks failed, first {first}."
    return f"Valid: all {len(checks)} checks passed."


def verdict_section(checksum: str, validated: Validated) -> Section:
    """Return checksum, unless it is empty, verdict and the table of checks."""
    passed = validated.report.passed
    facts = [] if not checksum else [checksum_fact(checksum)]
    facts.append(Fact(label="verdict", value="valid" if passed else "NOT valid", tone="good" if passed else "bad"))
    if validated.signed_by is not None:
        facts.append(Fact(label="signed by the key", value=validated.signed_by))
    return Section(key="verdict", title="Verdict", blocks=(Facts(facts=tuple(facts)), checks_table(validated.report)))


def checks_table(report: ValidationReport) -> Table:
    """Return every check with its verdict."""
    rows: list[tuple[str | TableCell, ...]] = []
    for check in report.checks:
        tone: Tone = ("warn" if check.warns else "good") if check.passed else "bad"
        rows.append((check.name, check.axis, TableCell(text=check.verdict, tone=tone), check.message))
    return build_table("Checks", ("check", "axis", "", "found"), rows)


def measured_section(validated: Validated) -> Iterator[Section]:
    """Yield the contacts of a log beside the prediction, if there was a log."""
    found = validated.compared
    if found is None or not found.contacts:
        return
    kinds = ([each for each in found.contacts if (each.axis in ROTATIONAL_AXES) == turns] for turns in (False, True))
    tables = (_measured_table(contacts) for contacts in kinds if contacts)
    yield Section(key="measured-contacts", title="Measured contacts", blocks=(*measured_charts(found), *tables))


def _measured_table(contacts: Sequence[ComparedContact]) -> Table:
    """Return the table of contacts that are all along, or all about, an axis."""
    units = axis_units(contacts[0].axis)
    turns = contacts[0].axis in ROTATIONAL_AXES
    digits = 2 if turns else 1
    rows = []
    for each in contacts:
        low, high = each.band_peaks_n
        numbers = (
            f"{each.axis} at {each.onset_s:.2f} s",
            f"{1e3 * each.speed_m_s:.1f}",
            "" if each.stiffness_n_per_m is None else f"{1e-3 * each.stiffness_n_per_m:.{digits}f}",
            f"{each.measured_peak_n:.{digits}f}",
            f"{each.predicted_peak_n:.{digits}f}",
            f"{100.0 * each.peak_error_n / each.measured_peak_n:+.1f}",
            f"{low:.{digits}f} to {high:.{digits}f}",
            share_text(each),
        )
        rows.append(numbers)
    return build_table(
        "Turns of the log that ended in contact" if turns else "Contacts of the log",
        (
            "contact",
            f"speed [m{units.speed}]",
            f"K_e [{'N·m/mrad' if turns else 'N/mm'}]",
            f"measured [{units.force}]",
            f"predicted [{units.force}]",
            "error [%]",
            f"certified set [{units.force}]",
            "inside [%]",
        ),
        rows,
        numbers=range(1, 8),
    )


def simulated_section(validated: Validated) -> Iterator[Section]:
    """Yield the simulated contacts, if there are any."""
    blocks: list[Block] = []
    for each in validated.simulated:
        blocks += [chart for chart in (band_chart(each), distribution_chart(each)) if chart is not None]
    if blocks:
        worst = (_worst_table(each) for each in validated.simulated if each.worst)
        tables = (_peaks_table(validated.simulated), *worst)
        yield Section(key="simulated", title="Simulated contacts", blocks=(*blocks, *tables))


def _peaks_table(simulated: Sequence[AxisMonteCarlo]) -> Table:
    rows = []
    for each in simulated:
        force = axis_units(each.axis).force
        for what, of in (("contact", each.contact), ("sensor", each.sensor)):
            if of is not None:
                values = (of.predicted, of.linear.largest, *of.observed.quantiles, of.observed.largest, of.limit)
                rows.append((f"{each.axis}, {what} [{force}]", *(f"{value:.2f}" for value in values)))
    quantiles = tuple(f"{100.0 * share:g} %" for share in QUANTILES)
    columns = ("force", "predicted", "own model, largest", *quantiles, "largest", "may reach")
    caption = "Peaks: what the file predicts, its own model on the sampled plants, and the full simulation"
    return build_table(caption, columns, rows, numbers=range(1, len(columns)))


def _worst_table(found: AxisMonteCarlo) -> Table:
    """Return the plants with the largest contact forces."""
    units = axis_units(found.axis)
    rows = [(scenario_text(each.plant, units), f"{each.contact:.2f}", f"{each.sensor:.2f}") for each in found.worst]
    columns = ("plant", f"contact [{units.force}]", f"sensor [{units.force}]")
    caption = f"Axis {found.axis}: the {len(rows)} plants of {found.count} with the largest contact forces"
    return build_table(caption, columns, rows, numbers=range(1, 3))


def distribution_chart(found: AxisMonteCarlo) -> Chart | None:
    """Draw how the largest contact forces of the simulated plants are distributed; None without any."""
    if found.distribution is None or found.contact is None:
        return None
    units, observed = axis_units(found.axis), found.contact.observed
    quantiles = ", ".join(
        f"{100.0 * share:g} % of them at most {value:.4g} {units.force}"
        for share, value in zip(QUANTILES, observed.quantiles, strict=True)
    )
    return Chart(
        key=f"{found.axis}-distribution",
        title=f"Largest contact {units.force_name} of {found.count} plants",
        alternative=f"How many of {found.count} plants drawn from the certified set have which largest contact "
        f"{units.force_name}: {quantiles}, the largest {observed.largest:.4g} {units.force}.",
        caption=f"{violations_text(found).capitalize()}, drawn from the certified set like these.",
        panels=(
            Panel(
                x=Scale(label=f"largest contact {units.force_name} [{units.force}]"),
                y=Scale(label="plants"),
                elements=(
                    Bars(
                        edges=np.array(found.distribution.edges),
                        heights=np.array(found.distribution.counts, dtype=np.float64),
                        label="with everything that disturbs",
                        role="after",
                    ),
                    Limit(value=found.contact.predicted, along="x", label="largest predicted", role="target"),
                    Limit(value=found.contact.limit, along="x", label="limit", role="bad"),
                ),
            ),
        ),
    )


def band_chart(found: AxisMonteCarlo) -> Chart | None:
    """Draw the contact force of the simulated plants over time; None where nothing could be simulated."""
    if found.band is None or found.contact is None:
        return None
    units, time = axis_units(found.axis), 1e3 * found.band.time_s
    lowest, low, middle, high, highest = found.band.levels
    promised, limit, shown = found.contact.predicted, found.contact.limit, found.band.count
    which = "" if shown == found.count else f", {shown} of {found.count}"
    return Chart(
        key=f"{found.axis}-band",
        title=f"Contacts simulated with everything that disturbs{which}",
        alternative=f"Contact {units.force_name} over time of {shown} plants of the certified set with deadband, "
        f"noise, clipping and late commands; of {found.count} the largest is {found.contact.observed.largest:.4g} "
        f"{units.force}, where {promised:.4g} {units.force} is predicted.",
        caption=f"Dark: {100.0 * BAND[0]:g} to {100.0 * BAND[-1]:g} % of the contacts; pale: all that are drawn. What "
        f"is disturbed may reach {limit:.4g} {units.force}.",
        panels=(
            Panel(
                x=Scale(label="time after touching [ms]"),
                y=Scale(label=f"{units.force_name} [{units.force}]"),
                elements=(
                    Band(x=time, low=lowest, high=highest, label="all", role="quiet"),
                    Band(x=time, low=low, high=high, label=f"{100.0 * (BAND[-1] - BAND[0]):g} %", role="after"),
                    Line(x=time, y=middle, label="median", role="after"),
                    Limit(value=promised, label="largest predicted", role="target"),
                    Limit(value=limit, label="limit", role="bad"),
                ),
            ),
        ),
    )


def measured_charts(found: LogComparison) -> Iterator[Chart]:
    """Draw the contacts of a log beside the prediction and what the certified set allows, in the order of time."""
    traced = [each for each in found.contacts if each.trace is not None]
    strongest = sorted(traced, key=lambda each: -each.measured_peak_n)[:MOST_DRAWN]
    shown = sorted(strongest, key=lambda each: each.onset_s)
    errors = [100.0 * abs(each.peak_error_n) / each.measured_peak_n for each in found.contacts]
    inside = sum(each.is_inside for each in found.contacts)
    summary = (
        f"of {len(found.contacts)} contacts the predicted peak is within {max(errors):.1f} % of the measured one; "
        f"{inside} lie inside the band all the time."
    )
    followed = sum(each.share_inside is not None for each in found.contacts)
    # What is beyond is in the table.
    which = "" if len(shown) == followed else f" The strongest {len(shown)} are drawn; the table has all."
    panels = level_panels([_measured_panel(each, each.trace) for each in shown if each.trace is not None])
    for number, start in enumerate(range(0, len(shown), _PANELS), 1):
        is_last = start + _PANELS >= len(shown)
        yield Chart(
            key="measured" + (f"-{number}" if number > 1 else ""),
            title="Measured contacts beside the prediction" + (f" ({number})" if len(shown) > _PANELS else ""),
            alternative=f"Force at the sensor over time after touching, measured and predicted: {summary}",
            caption=f"O{summary[1:]} Shaded: what the certified set allows.{which}" if is_last else "",
            panels=panels[start : start + _PANELS],
            beside=True,
        )


def _measured_panel(contact: ComparedContact, trace: ContactTrace) -> Panel:
    units = axis_units(contact.axis)
    last = min(float(trace.measured_s[-1]), float(trace.time_s[-1]))
    used = trace.time_s <= last
    time = 1e3 * trace.time_s[used]
    return Panel(
        title=f"{contact.axis} at {contact.onset_s:.2f} s",
        x=Scale(label="time after touching [ms]", limits=(0.0, 1e3 * last)),
        y=Scale(label=f"{units.force_name} at the sensor [{units.force}]"),
        elements=(
            Band(x=time, low=trace.low[used], high=trace.high[used], label="certified", role="target"),
            Line(x=1e3 * np.asarray(trace.measured_s), y=trace.measured, label="measured", wide=True),
            Line(x=time, y=trace.predicted[used], label="predicted", role="model", dashed=True),
        ),
    )
