"""A controller in tables: gains, what was asked and reached, and its certificate."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from autotune.formats.canonical import short
from autotune.formats.controller_record import AdmittanceRequirement, Controller, Proof, Requirement, SoftRequirement
from autotune.formats.units import AxisUnits, axis_units
from autotune.scenario_text import scenario_text, stiffness_text, value_text
from problems.design.requirements import NoiseLimit, PassivityTarget
from problems.design.uncertainty import SYMBOLS
from problems.model.plant import NO_FILTER

from .axis_design import AxisDesign
from .page import Cell, Fact, Facts, Table, Tone

_MARGINS = {
    "modulus_margin": ("modulus margin", "modulus", 1.0, ""),
    "gain_margin_db": ("gain margin", "gain_db", 1.0, "dB"),
    "phase_margin_deg": ("phase margin", "phase_deg", 1.0, "°"),
    "delay_margin_s": ("delay margin", "delay_s", 1e3, "ms"),
}
_FULL = 0.99


def number(value: float | None, scale: float = 1.0) -> str:
    """Return a number with four digits; "no limit" where there is none."""
    return "no limit" if value is None or math.isinf(value) else f"{scale * value:.4g}"


def checksum_fact(checksum: str) -> Fact:
    """Return the checksum as people compare it, the whole of it below."""
    return Fact(label="checksum", value=short(checksum), detail=checksum, is_large=True)


def design_facts(designs: Sequence[AxisDesign]) -> Facts:
    """Return the largest peaks, margins and the admittance of every axis."""
    facts = []
    for design in designs:
        units, margins = design.units, design.margins
        mark = f"{design.name}: " if len(designs) > 1 else ""
        worst = max(design.predicted.scenarios, key=lambda each: each.peak_contact_force_n)
        sensor = max(each.peak_sensor_force_n for each in design.predicted.scenarios)
        free = design.predicted.free_space_admittance
        facts += [
            Fact(
                label=f"{mark}largest peak at the contact",
                value=f"{worst.peak_contact_force_n:.1f} {units.force}",
                detail=f"at the sensor {sensor:.1f} {units.force}",
            ),
            Fact(label=f"{mark}modulus margin", value=f"{margins.modulus:.3f}", detail="over the whole domain"),
            Fact(
                label=f"{mark}gain, phase, delay",
                value=f"{number(margins.gain_db)} dB, {number(margins.phase_deg)}°, {number(margins.delay_s, 1e3)} ms",
            ),
            Fact(
                label=f"{mark}free-space admittance",
                value=f"{free.min_m_s_per_n:.3g} {units.admittance}",
                detail=f"at least, {free.band_hz[0]:g} to {free.band_hz[1]:g} Hz",
            ),
        ]
    return Facts(facts=tuple(facts))


def gains_table(controller: Controller) -> Table:
    """Return the gains of every axis."""
    rows = []
    for name, gains in controller.axes.items():
        units = axis_units(name)
        texts = (
            f"{gains.mass:g} {units.mass}",
            f"{gains.damping:g} {units.damping}",
            f"{1e3 * gains.lead_s:g} ms",
            f"{1e3 * gains.feedback_damping_s:g} ms",
            f"{gains.deadband:g} {units.force}, {gains.deadband_type}",
        )
        rows.append((Cell(text=name), *(Cell(text=text, is_number=True) for text in texts)))
    filters = controller.filters
    return Table(
        caption=f"The controller, every {1e3 * controller.sample_time_s:g} ms; filters {filters.velocity_rad_per_s:g} "
        f"and {filters.acceleration_rad_per_s:g} rad/s, compensated mass {controller.compensation_mass_kg:g} kg"
        f"{_response_told(controller)}",
        columns=("axis", "mass M_a", "damping B_a", "lead K_l", "feedback damping B_fb", "deadband"),
        rows=tuple(rows),
    )


def _response_told(controller: Controller) -> str:
    collision = controller.collision
    return (
        ""
        if collision.threshold_n is None
        else f", collision response {collision.response} at {collision.threshold_n:g} N"
    )


def response_table(design: AxisDesign) -> Table | None:
    """Return the predicted contacts with the collision response beside those without; None where there is none."""
    without = {each.scenario(): each for each in design.predicted.scenarios}
    rows = []
    for each in design.predicted.with_collision_response:
        plain = without.get(each.scenario())
        peaks = (
            None if plain is None else plain.peak_contact_force_n,
            each.peak_contact_force_n,
            None if plain is None else plain.peak_sensor_force_n,
            each.peak_sensor_force_n,
        )
        texts = ("" if peak is None else f"{peak:.1f} {design.units.force}" for peak in peaks)
        rows.append((Cell(text=each.name), *(Cell(text=text, is_number=True) for text in texts)))
    if not rows:
        return None
    heads = ("contact", "at the contact", "with the response", "at the sensor", "with the response")
    return Table(caption="Peaks without and with the collision response", columns=heads, rows=tuple(rows))


def prices_of(standing: Mapping[str, Any] | None) -> dict[str, float] | None:
    """Return what one percent of each active requirement or bound costs (N, N·m), from what the file says of it."""
    if standing is None:
        return None
    return {
        str(each["name"]): next(float(value) for key, value in each.items() if key.startswith("price_"))
        for each in standing["active"]
    }


def requirement_table(design: AxisDesign, active: Mapping[str, float] | None) -> Table:
    """Return what was asked beside what is reached, with the price of those that hold the peak up, if it is known."""
    wished = {name: claim.asked for name, claim in design.soft.items()}
    prices = dict(active or {})
    rows = []
    for name, asked in {**design.asked, **wished}.items():
        title, want, got, share = _standing(design, name, asked)
        rows.append(_row(title, want, got, share, prices.pop(name, None), design.units, is_wish=name in wished))
    for name, price in prices.items():
        rows.append(_row(name.replace("_", " "), "", "", None, price, design.units, is_wish=False))
    heads: tuple[str, ...] = ("requirement", "asked", "reached", "used")
    if active is not None:
        heads = (*heads, "1 % less would save")
        return Table(caption="What was asked, and what it costs", columns=heads, rows=tuple(rows))
    return Table(caption="What was asked", columns=heads, rows=tuple(row[:4] for row in rows))


def _row(
    title: str, want: str, got: str, share: float | None, price: float | None, units: AxisUnits, *, is_wish: bool
) -> tuple[Cell, ...]:
    tone: Tone = "warn" if share is not None and share > _FULL else ""
    saved = "" if price is None else ("nothing by itself" if price < 1e-3 else f"{price:.2f} {units.force}")
    return (
        Cell(text=f"{title} (wished)" if is_wish else title),
        Cell(text=want, is_number=True),
        Cell(text=got, is_number=True),
        Cell(text="" if share is None else f"{100.0 * share:.1f} %", is_number=True, tone=tone),
        Cell(text=saved, is_number=True),
    )


def _standing(design: AxisDesign, name: str, asked: Requirement) -> tuple[str, str, str, float | None]:
    """Return title, what was asked, what is reached, and asked/reached (of a limit reached/asked) where it is known."""
    units, soft = design.units, design.soft.get(name)
    if name in _MARGINS and isinstance(asked, int | float):
        title, key, scale, unit = _MARGINS[name]
        reached = getattr(design.margins, key)
        return (
            title,
            f"{scale * asked:g} {unit}".strip(),
            f"{number(reached, scale)} {unit}".strip(),
            _of(asked, reached),
        )
    if isinstance(asked, AdmittanceRequirement):
        low, high = asked.band_hz
        reached = design.predicted.free_space_admittance.min_m_s_per_n
        want = f"{asked.min_m_s_per_n:.4g} {units.admittance}, {low:g} to {high:g} Hz"
        return "free-space admittance", want, f"{reached:.4g} {units.admittance}", _of(asked.min_m_s_per_n, reached)
    if name == "max_peak_force_n" and isinstance(asked, int | float):
        reached = max(each.peak_contact_force_n for each in design.predicted.scenarios)
        return "peak", f"at most {asked:g} {units.force}", f"{reached:.4g} {units.force}", reached / asked
    if isinstance(asked, NoiseLimit):
        want = f"speed RMS at most {asked.max_speed_rms_m_s:.4g} {units.speed}"
        return "command noise", want, _achieved(soft, units.speed), None
    if isinstance(asked, PassivityTarget):
        return "passivity", f"up to {asked.passive_below_hz:g} Hz", _achieved(soft, "Hz"), None
    return name.replace("_", " "), f"{asked:g}", _achieved(soft, ""), None


def _of(asked: float, reached: float | None) -> float | None:
    return None if reached is None or reached <= 0.0 else asked / reached


def _achieved(soft: SoftRequirement | None, unit: str) -> str:
    return "met" if soft is None else f"{number(soft.achieved)} {unit}".strip()


def domain_table(design: AxisDesign) -> Table:
    """Return the plants that the certificate speaks of."""
    domain, units = design.domain, design.units
    uncertain: Mapping[str, tuple[float, float]] = domain.uncertain or {}
    stiffness, scale = ("N/mm", 1e-3) if units.stiffness == "N/m" else (units.stiffness, 1.0)
    entries: list[tuple[str, str, float | tuple[float, float], str]] = [
        ("environment stiffness", "K_e", domain.environment_stiffness_n_per_m, stiffness),
        (f"payload {units.mass_name}", "M_p", domain.payload_mass_kg, units.mass),
        ("coupling stiffness", "K_s", domain.coupling_stiffness_n_per_m, stiffness),
        ("coupling damping", "B_s", domain.coupling_damping_n_s_per_m, units.damping),
        ("drag", "B_p", domain.drag_n_s_per_m, units.damping),
        ("environment damping", "B_e", domain.environment_damping_n_s_per_m, units.damping),
        ("delay", "T_d", domain.delay_s, "ms"),
    ]
    spans, scales = {SYMBOLS[name]: span for name, span in uncertain.items()}, {"ms": 1e3, stiffness: scale}
    for name, symbol, title, unit in (
        ("robot_bandwidth_hz", "f_b", "robot bandwidth", "Hz"),
        ("robot_damping_ratio", "ζ_b", "robot damping ratio", ""),
    ):
        if name in uncertain:
            entries.append((title, symbol, uncertain[name], unit))
    wrench = domain.wrench_filter or NO_FILTER
    for name, title, value in (
        ("wrench_time_constant_s", "wrench filter, time constant", wrench.time_constant_s),
        ("wrench_delay_s", "wrench delay", wrench.delay_s),
    ):
        if value > 0.0 or name in uncertain:
            entries.append((title, SYMBOLS[name], value, "ms"))
    rows = [
        (Cell(text=title), Cell(text=symbol), *_span(spans.get(symbol, value), scales.get(unit, 1.0)), Cell(text=unit))
        for title, symbol, value, unit in entries
    ]
    approach = (
        f"{domain.approach_force_n:g} {units.force}"
        if domain.approach_force_n is not None
        else f"{domain.approach_speed_m_s:g} {units.speed}"
        if domain.approach_speed_m_s is not None
        else "none"
    )
    cut = "" if domain.confidence is None else f"; cut by the {100.0 * domain.confidence.level:g} % confidence set"
    return Table(
        caption=f"Domain of axis {design.name}: approach with {approach}{cut}",
        columns=("parameter", "", "from", "to", "unit"),
        rows=tuple(rows),
    )


def _span(value: float | tuple[float, float], scale: float) -> tuple[Cell, Cell]:
    low, high = (scale * end for end in (value if isinstance(value, tuple) else (value, value)))
    end = "" if low == high else f"{high:.6g}"
    return Cell(text=f"{low:.6g}", is_number=True), Cell(text=end, is_number=True)


def worst_table(design: AxisDesign) -> Table:
    """Return where each margin is smallest."""
    rows = []
    for title, key, scale, unit in _MARGINS.values():
        case = design.margins.worst.get(key, {})
        rows.append(
            (
                Cell(text=title),
                Cell(text=f"{number(getattr(design.margins, key), scale)} {unit}".strip(), is_number=True),
                Cell(text=_case(case, design.units)),
            )
        )
    worst = max(design.predicted.scenarios, key=lambda each: each.peak_contact_force_n)
    peak = Cell(text=f"{worst.peak_contact_force_n:.4g} {design.units.force}", is_number=True)
    rows.append((Cell(text="peak at the contact"), peak, Cell(text=scenario_text(worst.scenario(), design.units))))
    return Table(caption=f"Worst cases of axis {design.name}", columns=("", "value", "at"), rows=tuple(rows))


def _case(case: Mapping[str, Any], units: AxisUnits) -> str:
    told: list[str] = []
    for name, value in case.items():
        if name == "environment_stiffness_n_per_m" and value == 0.0:
            told.insert(0, "free space")
        elif isinstance(value, int | float):
            told.append(value_text(name, value, units) if name in SYMBOLS else f"{name} {value:.4g}")
    return ", ".join(told)


def reach_table(design: AxisDesign) -> Table | None:
    """Return how far the modulus is proved at all frequencies, None where the file does not say it."""
    if not design.reach:
        return None
    rows = []
    for reach in design.reach:
        low, high = reach.environment_stiffness_n_per_m
        tone: Tone = "good" if reach.share == 1.0 else "warn"
        rows.append(
            (
                Cell(text=", ".join(SYMBOLS.get(name, name) for name in reach.over)),
                Cell(text=f"{reach.modulus:.4g}", is_number=True),
                Cell(text=f"{100.0 * reach.slack:.3g} %", is_number=True),
                Cell(text=f"{100.0 * reach.share:.4g} %", is_number=True, tone=tone),
                Cell(text=f"{stiffness_text(low, design.units)} to {stiffness_text(high, design.units)}"),
                Cell(text=f"{reach.cells:.0f}, {reach.arcs:.0f}", is_number=True),
                Cell(text=f"{reach.run_time_s:.2f} s", is_number=True),
                Cell(text=reach.method, tone="quiet"),
            )
        )
    return Table(
        caption=f"Modulus margin of axis {design.name} that is proved at all frequencies, in contact and free space",
        columns=("over", "modulus", "slack", "of the set", "whole for K_e", "cells, arcs", "run time", "by"),
        rows=tuple(rows),
    )


def proof_table(controller: Controller) -> Table:
    """Return what is proved, and what is only sampled."""
    certificate = controller.certificate
    rows = [*_proofs(certificate.proved, "proved", "good"), *_proofs(certificate.sampled, "sampled", "quiet")]
    return Table(
        caption="What the certificate says: proved for every plant that is named, or looked for on many and not found",
        columns=("claim", "", "over", "by", "numbers"),
        rows=tuple(rows),
    )


def _proofs(proofs: Sequence[Proof], word: str, tone: Tone) -> Iterator[tuple[Cell, ...]]:
    for proof in proofs:
        over = proof.over if isinstance(proof.over, str) else ", ".join(f"{k} {v}" for k, v in proof.over.items())
        told = ", ".join(f"{name.replace('_', ' ')} {value:.4g}" for name, value in (proof.numbers or {}).items())
        yield (
            Cell(text=proof.claim),
            Cell(text=word, tone=tone),
            Cell(text=over),
            Cell(text=proof.method, tone="quiet"),
            Cell(text=told),
        )
