"""Tables of a controller: gains, requirements, compliance, comparison with another one, and its certificate."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from autotune.formats.canonical import short
from autotune.formats.certificate_record import SoftRequirement
from autotune.formats.controller_record import Controller
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.plugins import find_requirement
from autotune.prediction.as_run_by import as_run_by, designed_for, led_speed_text, peak_per_speed
from autotune.prediction.law import PresentGains
from autotune.text import bound_text, compliance_remark, gain_rows, scenario_text, stiffness_text, value_text
from problems.design.requirements import BODY_REGIONS, MARGINS, AdmittanceRequirement, Margin, PeakForceLimit
from problems.design.uncertainty import SYMBOLS, UNCERTAIN
from problems.model.axis_kind import STRAIGHT, AxisKind
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.plant_parameters import PARAMETERS, PlantParameter
from problems.model.response import free_space_admittance
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins

from .axis_design import AxisDesign, contact_of
from .page import Block, Fact, Facts, Note, Table, TableCell, Tone, build_table

_NEARLY_USED = 0.99
_UNSTABLE = "unstable"
_BAND_POINTS = 100


def number(value: float | None, scale: float = 1.0) -> str:
    """Return a number with four digits; "no limit" where there is none."""
    return "no limit" if value is None or math.isinf(value) else f"{scale * value:.4g}"


def _with_unit(value: float | None, scale: float, unit: str) -> str:
    return f"{number(value, scale)} {unit}".strip()


def checksum_fact(checksum: str) -> Fact:
    """Return the checksum as people compare it, the whole of it below."""
    return Fact(label="checksum", value=short(checksum), detail=checksum, is_large=True)


def design_facts(designs: Sequence[AxisDesign]) -> Facts:
    """Return the largest peaks, margins and the admittance of every axis."""
    facts = []
    for design in designs:
        units, margins = design.units, design.margins
        mark = f"{design.name}: " if len(designs) > 1 else ""
        worst = design.worst_contact
        sensor = max(each.peak_sensor_force_n for each in design.predicted.scenarios)
        free = design.predicted.free_space_admittance
        for label, value, detail in (
            (
                "largest peak at the contact",
                f"{worst.peak_contact_force_n:.1f} {units.force}",
                f"at the sensor {sensor:.1f} {units.force}",
            ),
            ("modulus margin", f"{margins.modulus:.3f}", "over the whole domain"),
            (
                "gain, phase, delay",
                f"{number(margins.gain_db)} dB, {number(margins.phase_deg)}°, {number(margins.delay_s, 1e3)} ms",
                "",
            ),
            (
                "free-space admittance",
                f"{free.min_m_s_per_n:.3g} {units.admittance}",
                f"at least, {free.band_hz[0]:g} to {free.band_hz[1]:g} Hz",
            ),
        ):
            facts.append(Fact(label=mark + label, value=value, detail=detail))
    return Facts(facts=tuple(facts))


def target_facts(controller: Controller) -> Iterator[Facts | Table]:
    """Yield, of a file that was designed for an export target, what that runs and was certified to do."""
    found = {name: each for name in controller.axes if (each := as_run_by(controller, name)) is not None}
    facts, rows = [], []
    for name, target in found.items():
        units, mark = axis_units(name), f"{name}: " if len(found) > 1 else ""
        gain, phase, delay = (target.margins.get(key) for key in ("gain_db", "phase_deg", "delay_s"))
        facts += [
            Fact(label=f"{mark}largest peak at the contact", value=f"{target.peak:.1f} {units.force}"),
            Fact(label=f"{mark}modulus margin", value=number(target.margins.get("modulus"))),
            Fact(
                label=f"{mark}gain, phase, delay",
                value=f"{number(gain)} dB, {number(phase)}°, {number(delay, 1e3)} ms",
            ),
            Fact(
                label=f"{mark}free-space admittance",
                value=f"{target.least_admittance:.3g} {units.admittance}",
                detail=f"at least; a hand needs {target.hand_force:.4g} {units.hand}",
            ),
        ]
        rows.append((name, ", ".join(f"{key} {value:g}" for key, value in target.parameters.items())))
    if found:
        yield Facts(facts=tuple(facts))
        yield build_table(f"What {designed_for(controller)} is given", ("axis", "parameters"), rows)


def led_table(controller: Controller, designs: Sequence[AxisDesign]) -> Table | None:
    """Return up to which speed of a payload led by hand no certified contact exceeds a limit of ISO/TS 15066."""
    straight = (each.name for each in designs if each.name not in ROTATIONAL_AXES)
    led = ((name, peak_per_speed(controller, name)) for name in straight)
    columns = [(name, hand) for name, found in led if found is not None for hand in found.hands]
    if not columns:
        return None
    runs = f", as {target} runs it" if (target := designed_for(controller)) else ""
    heads = (f"{name}, hand {hand.replace('_', ' ')} [m/s]" for name, hand in columns)
    rows = [
        (
            region.replace("_", " "),
            f"{force:g}",
            *(led_speed_text(controller, name, force, hand) for name, hand in columns),
        )
        for region, force in BODY_REGIONS.items()
    ]
    capped = "; * the limit of the command" if any("*" in "".join(row) for row in rows) else ""
    return build_table(
        "Speed up to which no certified contact exceeds the force on a clamped part of the body (ISO/TS 15066:2016, "
        f"Table A.2, quasi-static){runs}{capped}",
        ("part of the body", "force [N]", *heads),
        rows,
        numbers=range(1, 2 + len(columns)),
    )


def gains_table(controller: Controller) -> Table:
    """Return the gains of every axis."""
    rows = []
    for name, gains in controller.axes.items():
        units = axis_units(name)
        rows.append(
            (
                name,
                f"{gains.mass:g} {units.mass}",
                f"{gains.damping:g} {units.damping}",
                f"{1e3 * gains.lead_s:g} ms",
                f"{1e3 * gains.feedback_damping_s:g} ms",
                f"{gains.deadband:g} {units.force}, {gains.deadband_type}",
            )
        )
    filters, collision = controller.filters, controller.collision
    response = ""
    if collision.threshold_n is not None:
        response = f", collision response {collision.response} at {collision.threshold_n:g} N"
    for name, variable in (controller.variable_damping or {}).items():
        response += (
            f", B_a of {name} from {variable.highest:g} at rest to {variable.lowest:g} {axis_units(name).damping}"
        )
    for name, gains in controller.axes.items():
        if gains.biquad is not None:
            response += f", biquad of {name}: {gains.biquad.describe()}"
    virtual = controller.compensation_mass_kg
    feedback = f", acceleration feedback P̂ {virtual:g} kg" if virtual else ""
    return build_table(
        f"The controller, every {1e3 * controller.sample_time_s:g} ms; filters {filters.velocity_rad_per_s:g} and "
        f"{filters.acceleration_rad_per_s:g} rad/s{feedback}{response}",
        ("axis", "mass M_a", "damping B_a", "lead K_l", "feedback damping B_fb", "deadband"),
        rows,
        numbers=range(1, 6),
    )


def compliance_tables(controller: Controller) -> Iterator[Table]:
    """Yield for each axis whose compliance was chosen every stiffness that was tried."""
    found = controller.provenance.get("compliance")
    for name, chosen in found.items() if isinstance(found, Mapping) else ():
        has_price = any("objective_n" in entry for entry in chosen["tried"])
        keys = ("peak_force_n", *(("objective_n",) if has_price else ()))
        heads = ("least worst peak [N]", "and the price of missed soft requirements [N]")
        yield build_table(
            f"Axis {name}: the compliance to build, to ± {100.0 * chosen['tolerance']:g} %",
            ("K_e [N/mm]", *heads[: len(keys)], ""),
            (_compliance_row(chosen, entry, keys) for entry in chosen["tried"]),
            numbers=range(1 + len(keys)),
        )


def _compliance_row(
    chosen: Mapping[str, Any], entry: Mapping[str, Any], keys: tuple[str, ...]
) -> tuple[str | TableCell, ...]:
    values = ("-" if entry.get(key) is None else f"{entry[key]:.2f}" for key in keys)
    tone: Tone = "" if entry["meets_all"] else "bad"
    stiffness = 1e-3 * entry["environment_stiffness_n_per_m"]
    return (f"{stiffness:.6g}", *values, TableCell(text=compliance_remark(chosen, entry), tone=tone))


def prices_of(optimality: Mapping[str, Any] | None) -> dict[str, float] | None:
    """Return what one percent of each active requirement or bound costs (N, N·m), from the file's optimality report."""
    if optimality is None:
        return None
    return {
        str(each["name"]): next(float(value) for key, value in each.items() if key.startswith("price_"))
        for each in optimality["active"]
    }


def constraint_title(name: str) -> str:
    """Return a requirement or a bound by its name in the optimality report in words."""
    requirement = find_requirement(name)
    return bound_text(name, None, STRAIGHT) if requirement is None else requirement.title


def requirement_table(design: AxisDesign, active: Mapping[str, float] | None) -> Table:
    """Return what was required beside what is reached, with the price of the active ones, if it is known."""
    soft = {name: claim.asked for name, claim in design.soft.items()}
    prices = dict(active or {})
    rows: list[tuple[str | TableCell, ...]] = []
    for name, required in {**design.asked, **soft}.items():
        title, want, got, share = _achievement(design, name, required)
        tone: Tone = "warn" if share is not None and share > _NEARLY_USED else ""
        used = TableCell(text="" if share is None else f"{100.0 * share:.1f} %", tone=tone)
        price = _price(prices.pop(name, None), design.units)
        rows.append((f"{title} (soft)" if name in soft else title, want, got, used, price))
    rows += [(constraint_title(name), "", "", "", _price(price, design.units)) for name, price in prices.items()]
    heads: tuple[str, ...] = ("requirement", "asked", "reached", "used", "1 % less would save")
    caption = "What was asked, and what it costs"
    if active is None:
        heads, rows, caption = heads[:4], [row[:4] for row in rows], "What was asked"
    return build_table(caption, heads, rows, numbers=range(1, 5))


def _price(price: float | None, units: AxisKind) -> str:
    if price is None:
        return ""
    return "nothing by itself" if price < 1e-3 else f"{price:.2f} {units.force}"


def _achievement(design: AxisDesign, name: str, required: Any) -> tuple[str, str, str, float | None]:
    """Return title, what is required, what is reached, and required/reached (of a limit reached/required) if known."""
    soft, requirement, turning = design.soft.get(name), find_requirement(name), design.name in ROTATIONAL_AXES
    if requirement is None:
        return name.replace("_", " "), f"{required:g}", _soft_text(soft, ""), None
    want, unit = requirement.describe(required, turning=turning), requirement.unit_on(turning=turning)
    reached: float | None
    if isinstance(requirement, Margin):
        reached = getattr(design.margins, requirement.margin)
    elif isinstance(requirement, AdmittanceRequirement):
        reached = design.predicted.free_space_admittance.min_m_s_per_n
    elif isinstance(requirement, PeakForceLimit):
        reached = design.worst_contact.peak_contact_force_n
    else:
        return requirement.title, want, _soft_text(soft, unit, requirement.shown_scale), None
    share = None if reached is None or reached <= 0.0 else requirement.ratio(required, reached)
    return requirement.title, want, _with_unit(reached, requirement.shown_scale, unit), share


def _soft_text(soft: SoftRequirement | None, unit: str, scale: float = 1.0) -> str:
    return "met" if soft is None else _with_unit(soft.achieved, scale, unit)


def law_before(old: PresentGains | None, axis: str) -> AdmittanceController | None:
    """Return what runs on an axis today, None where it is not known."""
    return None if old is None or axis not in old.laws else old.laws[axis].controller


def compared_blocks(design: AxisDesign, old: PresentGains | None, checksum: str) -> Iterator[Block]:
    """Yield the comparison of one axis with another controller, nothing where there is none; `checksum` is its own."""
    if old is None:
        return
    law = law_before(old, design.name)
    if law is None:
        yield Note(text=f"{old.name} has no axis {design.name} to compare with.", kind="before", tone="quiet")
        return
    if law == design.law:
        same = f"{old.name} has the same gains: what is drawn for before lies under what is drawn for after."
        yield Note(text=same, kind="before", tone="warn")
    yield _compared_table(design, law, old, checksum)


def _compared_table(design: AxisDesign, law: AdmittanceController, old: PresentGains, checksum: str) -> Table:
    units = design.units
    worst = (design.worst_plant(each.margin) for each in MARGINS)
    found = (*design.corners(), design.free_plant(), *(each for each in worst if each is not None))
    plants = tuple(dict.fromkeys(found))
    rows: list[tuple[str, ...]] = []
    if old.file is not None:
        rows.append(("checksum", short(old.file.checksum), short(checksum)))
    rows += gain_rows(units, law, design.law)
    titles = (
        f"largest peak at the contact [{units.force}]",
        f"largest peak at the sensor [{units.force}]",
        *(each.heading for each in MARGINS),
        f"least free-space admittance [{units.admittance}]",
    )
    rows += zip(titles, *(_reached(design, each, plants) for each in (law, design.law)), strict=True)
    return build_table(
        f"Axis {design.name}, before and after on the same {len(design.predicted.scenarios)} contacts and "
        f"{len(plants)} plants of the domain, its ends and its worst cases; before is {old.name}",
        ("", "before", "after"),
        (
            (title, *(TableCell(text=text, tone="bad" if text == _UNSTABLE else "") for text in (before, after)))
            for title, before, after in rows
        ),
        numbers=(1, 2),
    )


def _reached(design: AxisDesign, law: AdmittanceController, plants: Sequence[Plant]) -> tuple[str, ...]:
    """Return peaks, margins and admittance of one controller; of a loop that is unstable somewhere there are none."""
    runs = [contact_of(design, law, each.scenario()) for each in design.predicted.scenarios]
    stable = [run for run in runs if run is not None]
    texts = [_UNSTABLE, _UNSTABLE]
    if len(stable) == len(runs):
        peaks = [(run.peak_contact_force_n, run.peak_sensor_force_n) for run in stable]
        texts = [f"{max(each):.4g}" for each in zip(*peaks, strict=True)]
    h = design.sample_time_s
    try:
        found = [find_margins(build_sampled_plant(plant, h), law) for plant in plants]
    except UnstableLoopError:
        return (*texts, *(_UNSTABLE for _ in MARGINS), _UNSTABLE)
    texts += [number(min(getattr(each, of.margin) for each in found), of.shown_scale) for of in MARGINS]
    band = 2.0 * np.pi * np.geomspace(*design.predicted.free_space_admittance.band_hz, _BAND_POINTS)
    least = np.min(np.abs(free_space_admittance(build_sampled_plant(design.free_plant(), h), law, band)))
    return (*texts, f"{least:.4g}")


def domain_table(design: AxisDesign) -> Table:
    """Return the plants that the certificate covers."""
    domain, units = design.domain, design.units
    entries = [
        (
            each.label.replace("mass", units.mass_name),
            each.symbol,
            domain.plants.range_of(each.name),
            *units.shown(each.kind),
        )
        for each in (PARAMETERS[name] for name in UNCERTAIN)
        if each.name in domain.plants.ranges or _is_said(each, domain.plants.nominal)
    ]
    has_approach = domain.approach_force_n is not None or domain.approach_speed_m_s is not None
    approach = domain.approach.text(units) if has_approach else "none"
    cut = "" if domain.confidence is None else f"; cut by the {100.0 * domain.confidence.level:g} % confidence set"
    return build_table(
        f"Domain of axis {design.name}: approach with {approach}{cut}",
        ("parameter", "", "from", "to", "unit"),
        ((title, symbol, *_span(span, scale), unit) for title, symbol, span, scale, unit in entries),
        numbers=(2, 3),
    )


def _is_said(parameter: PlantParameter, plant: Plant) -> bool:
    """Whether a nominal value has a row: a robot's is in its coefficients, and a wrench that is not late has none."""
    if parameter.part == "wrench_filter":
        return parameter.value(plant) > 0.0
    return parameter.part != "robot" or parameter.kind == "time"


def _span(span: tuple[float, float], scale: float) -> tuple[str, str]:
    low, high = (scale * end for end in span)
    return f"{low:.6g}", "" if low == high else f"{high:.6g}"


def worst_table(design: AxisDesign) -> Table:
    """Return where each margin is smallest."""
    rows = [
        (
            each.title,
            _with_unit(getattr(design.margins, each.margin), each.shown_scale, each.unit),
            _case(design.margins.worst.get(each.margin, {}), design.units),
        )
        for each in MARGINS
    ]
    worst = design.worst_contact
    peak = f"{worst.peak_contact_force_n:.4g} {design.units.force}"
    rows.append(("peak at the contact", peak, scenario_text(worst.scenario(), design.units)))
    return build_table(f"Worst cases of axis {design.name}", ("", "value", "at"), rows, numbers=(1,))


def _case(case: Mapping[str, Any], units: AxisKind) -> str:
    parts: list[str] = []
    for name, value in case.items():
        if name == "environment_stiffness_n_per_m" and value == 0.0:
            parts.insert(0, "free space")
        elif isinstance(value, int | float):
            parts.append(value_text(name, value, units) if name in SYMBOLS else f"{name} {value:.4g}")
    return ", ".join(parts)


def regions_table(design: AxisDesign) -> Table | None:
    """Return how far the modulus is proved at all frequencies, None where the file does not say it."""
    if not design.regions:
        return None
    rows: list[tuple[str | TableCell, ...]] = []
    for region in design.regions:
        low, high = region.environment_stiffness_n_per_m
        rows.append(
            (
                ", ".join(SYMBOLS.get(name, name) for name in region.over),
                f"{region.modulus:.4g}",
                f"{100.0 * region.slack:.3g} %",
                TableCell(text=f"{100.0 * region.share:.4g} %", tone="good" if region.share == 1.0 else "warn"),
                f"{stiffness_text(low, design.units)} to {stiffness_text(high, design.units)}",
                f"{region.cells:.0f}, {region.arcs:.0f}",
                f"{region.run_time_s:.2f} s",
                TableCell(text=region.method, tone="quiet"),
            )
        )
    return build_table(
        f"Modulus margin of axis {design.name} that is proved at all frequencies, in contact and free space",
        ("over", "modulus", "slack", "of the set", "whole for K_e", "cells, arcs", "run time", "by"),
        rows,
        numbers=(1, 2, 3, 5, 6),
    )


def proof_table(controller: Controller) -> Table:
    """Return what is proved, and what is only sampled."""
    certificate = controller.certificate
    rows: list[tuple[str | TableCell, ...]] = []
    kinds: tuple[tuple[Any, str, Tone], ...] = (
        ((*certificate.proved, *certificate.proved_further), "proved", "good"),
        ((*certificate.sampled, *certificate.sampled_further), "sampled", "quiet"),
    )
    for proofs, word, tone in kinds:
        for proof in proofs:
            # Whole numbers, such as counts and the seed, are written whole.
            shown = {key: f"{value:.{4 if value % 1.0 else 12}g}" for key, value in (proof.numbers or {}).items()}
            numbers = (f"{key.replace('_', ' ')} {text}" for key, text in shown.items())
            method, whole = TableCell(text=proof.method, tone="quiet"), (proof.numbers or {}).get("share", 1.0) == 1.0
            verdict = TableCell(text=word, tone=tone) if whole else TableCell(text=f"{word} in part", tone="warn")
            rows.append((proof.claim, verdict, proof.over_text(), method, ", ".join(numbers)))
    return build_table(
        "What the certificate says: proved for every plant that is named, or looked for on many and not found",
        ("claim", "", "over", "by", "numbers"),
        rows,
    )
