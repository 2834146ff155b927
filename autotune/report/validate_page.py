"""The report of a validation: the verdict, every check, and the contacts that it simulated or found in a log."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from autotune.formats.controller_record import Controller
from autotune.formats.records import ROTATIONAL_AXES
from autotune.formats.units import axis_units
from autotune.validation.against_log import ComparedContact, LogComparison
from autotune.validation.monte_carlo import QUANTILES, AxisMonteCarlo
from autotune.validation.report import ValidationReport

from .axis_design import axis_designs
from .controller_tables import checksum_fact, design_facts
from .optimize_charts import contact_charts, stiffness_chart
from .optimize_page import certificate_section, footer
from .page import Block, Cell, Fact, Facts, Page, Section, Table, Tone
from .validate_charts import band_chart, measured_charts


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
        *(
            Section(
                key=f"axis-{design.name}",
                title=f"Axis {design.name}",
                blocks=(design_facts((design,)), *contact_charts(design, None), stiffness_chart(design, None)),
            )
            for design in designs
            if validated.report.passed
        ),
        certificate_section(controller, designs),
    ]
    return Page(
        title="Whether the controller keeps what it promises",
        lead=lead(validated),
        tone="good" if validated.report.passed else "bad",
        sections=tuple(sections),
        footer=footer(controller, checksum),
    )


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
    rows = []
    for check in report.checks:
        tone: Tone = ("warn" if check.warns else "good") if check.passed else "bad"
        verdict = Cell(text=check.verdict, tone=tone)
        rows.append((Cell(text=check.name), Cell(text=check.axis), verdict, Cell(text=check.message)))
    return Table(caption="Checks", columns=("check", "axis", "", "found"), rows=tuple(rows))


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
            f"{1e3 * each.speed_m_s:.1f}",
            "" if each.stiffness_n_per_m is None else f"{1e-3 * each.stiffness_n_per_m:.{digits}f}",
            f"{each.measured_peak_n:.{digits}f}",
            f"{each.predicted_peak_n:.{digits}f}",
            f"{100.0 * each.peak_error_n / each.measured_peak_n:+.1f}",
            f"{low:.{digits}f} to {high:.{digits}f}",
            f"{100.0 * each.share_inside:.1f}",
        )
        where = Cell(text=f"{each.axis} at {each.onset_s:.2f} s")
        rows.append((where, *(Cell(text=text, is_number=True) for text in numbers)))
    return Table(
        caption="Turns of the log that ended in contact" if turns else "Contacts of the log",
        columns=(
            "contact",
            f"speed [m{units.speed}]",
            f"K_e [{'N·m/mrad' if turns else 'N/mm'}]",
            f"measured [{units.force}]",
            f"predicted [{units.force}]",
            "error [%]",
            f"certified set [{units.force}]",
            "inside [%]",
        ),
        rows=tuple(rows),
    )


def simulated_section(validated: Validated) -> Iterator[Section]:
    """Yield the simulated contacts, if there are any."""
    blocks: list[Block] = []
    for each in validated.simulated:
        chart = band_chart(each)
        blocks += [] if chart is None else [chart]
    if blocks:
        yield Section(key="simulated", title="Simulated contacts", blocks=(*blocks, _peaks_table(validated.simulated)))


def _peaks_table(simulated: Sequence[AxisMonteCarlo]) -> Table:
    rows = []
    for each in simulated:
        force = axis_units(each.axis).force
        for what, of in (("contact", each.contact), ("sensor", each.sensor)):
            if of is not None:
                values = (of.predicted, of.linear.largest, *of.observed.quantiles, of.observed.largest, of.limit)
                numbers = tuple(Cell(text=f"{value:.2f}", is_number=True) for value in values)
                rows.append((Cell(text=f"{each.axis}, {what} [{force}]"), *numbers))
    quantiles = tuple(f"{100.0 * share:g} %" for share in QUANTILES)
    return Table(
        caption="Peaks: what the file predicts, its own model on the sampled plants, and the full simulation",
        columns=("force", "predicted", "own model, largest", *quantiles, "largest", "may reach"),
        rows=tuple(rows),
    )
