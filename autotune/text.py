"""Numbers, parameters and plants as people read them: rounded to their deviation, with symbol and unit."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from autotune.formats.units import axis_units
from identification.result import (
    AxisEstimate,
    EnvironmentEstimate,
    Estimate,
    Identified,
    Timeline,
    TouchCause,
    VectorEstimate,
    WrenchFilterEstimate,
)
from problems.design.uncertainty import Scenario
from problems.model.axis_kind import AxisKind, for_people
from problems.model.controller import AdmittanceController
from problems.model.plant_parameters import PARAMETERS
from problems.text import significant

COMPARE_EXAMPLE = "--compare mass=10,damping=1500"
NOTHING_BEFORE = (
    f"nothing to compare with: say the gains that run now, as in {COMPARE_EXAMPLE}, or identify a log with contacts"
)
NO_GAINS_BEFORE = f"for free motion beside today's say the gains that run now, as in {COMPARE_EXAMPLE}"
_MOST_DECIMALS = 6
_SMALL = 1e-3


def held_out_lines(name: str, axis: AxisEstimate) -> Iterator[str]:
    """Yield in a sentence each how well contacts are predicted without themselves, and without their log."""
    for without, what in (("contact", "from the other contacts"), ("log", "from the other logs")):
        errors = [math.expm1(each.log_ratio) for each in axis.held_out if each.without == without]
        if errors:
            rms = math.sqrt(sum(error**2 for error in errors) / len(errors))
            yield (
                f"axis {name}: {len(errors)} {'peak' if len(errors) == 1 else 'peaks'} predicted {what}, RMS error "
                f"{significant(100.0 * rms)} %, largest {significant(100.0 * max(map(abs, errors)))} %"
            )


def with_deviation(value: float | None, std: float | None, scale: float = 1.0) -> tuple[str, str]:
    """Return `value` and `std`, both times `scale`, as texts with the same decimals: two digits of the deviation.

    Without a deviation the value has four decimals. Where both are small and would need more than six decimals, they
    are written with the power of ten of the larger; what is not known is `-`.
    """
    if value is None:
        return "-", "-"
    scaled, spread = value * scale, 0.0 if std is None else std * scale
    if not 0.0 < spread < math.inf:
        return f"{scaled:.4f}", "-" if std is None else "0"
    decimals = _decimals(spread)
    larger = max(abs(scaled), spread)
    if decimals <= _MOST_DECIMALS or larger >= _SMALL:
        return _plain(scaled, decimals), _plain(spread, decimals)
    power = math.floor(math.log10(larger))
    decimals += power
    texts = [f"{_plain(each * 10.0**-power, decimals)}e{power:+03d}" for each in (scaled, spread)]
    return texts[0], texts[1]


def rounded_to(std: float, value: float) -> str:
    """Return `value` with the decimals that two digits of the deviation `std` have."""
    return _plain(value, _decimals(std)) if 0.0 < std < math.inf else f"{value:.4f}"


def _decimals(std: float) -> int:
    # Two digits first: 0.0996 is 0.10, not 0.100.
    return max(1 - math.floor(math.log10(float(f"{std:.1e}"))), 0)


def _plain(value: float, decimals: int) -> str:
    text = f"{value:.{decimals}f}"
    # Nothing is negative about a zero.
    return text.lstrip("-") if float(text) == 0.0 else text


@dataclass(frozen=True, kw_only=True)
class ParameterRow:
    """One parameter in the unit in which it is shown; texts, empty where there is nothing to say."""

    name: str
    value: str
    std: str = ""
    unit: str = ""
    verdict: str = ""
    method: str = ""
    note: str = ""


def parameter_rows(result: Identified) -> Iterator[ParameterRow]:
    """Yield every parameter of a result, the cell's own first, then axis by axis."""
    yield _row("payload mass", result.payload.mass_kg, "kg")
    yield from _vector_rows("centre of mass", result.payload.com_m, "mm", 1e3)
    if result.payload.inertia_kg_m2 is not None:
        for name, component in vars(result.payload.inertia_kg_m2).items():
            yield _row(f"inertia {name} about sensor", component, "kg·m²")
    yield from _vector_rows("force bias", result.sensor.force_bias_n, "N", 1.0)
    yield _row("force noise", result.sensor.force_noise_rms_n, "N rms")
    yield _row("gravity residual", result.sensor.gravity_residual_rms_n, "N rms")
    if result.sensor.position_noise_rms_m is not None:
        yield _row("pose noise", result.sensor.position_noise_rms_m, "µm rms", 1e6)
    if result.sensor.wrench_filter is not None:
        yield from _filter_rows(result.sensor.wrench_filter)
    if result.sensor.mounting_rad is not None:
        yield from _vector_rows("sensor turned about", result.sensor.mounting_rad, "°", 180.0 / math.pi)
    if result.sensor.base_tilt_rad is not None:
        yield from _vector_rows("base tilted about", result.sensor.base_tilt_rad, "°", 180.0 / math.pi)
    yield _row("control period", result.sample_time_s, "ms", 1e3)
    for name, axis in result.axes.items():
        yield from axis_rows(name, axis)


def axis_rows(name: str, axis: AxisEstimate) -> Iterator[ParameterRow]:
    """Yield the parameters of one axis."""
    units = axis_units(name)
    scale, stiffness = units.shown_stiffness
    yield _row(f"{name}: coupling K_s", axis.coupling.stiffness_n_per_m, stiffness, scale)
    yield _row(f"{name}: coupling B_s", axis.coupling.damping_n_s_per_m, units.damping)
    yield _row(f"{name}: drag B_p", axis.drag_n_s_per_m, units.damping)
    if axis.mass_kg is not None:
        yield _row(f"{name}: {units.mass_name} from motion", axis.mass_kg, units.mass)
    yield _row(f"{name}: robot bandwidth", axis.robot.bandwidth_hz, "Hz")
    yield _row(f"{name}: delay T_d", axis.robot.delay_s, "ms", 1e3)
    for surface in axis.environments:
        yield from _surface_rows(name, surface)


def _surface_rows(name: str, surface: EnvironmentEstimate) -> Iterator[ParameterRow]:
    units = axis_units(name)
    scale, stiffness = units.shown_stiffness
    label = f"{name}: {surface.name}, {surface.contacts} contact{'' if surface.contacts == 1 else 's'}"
    yield _row(f"{label}: K_e", surface.stiffness_n_per_m, stiffness, scale)
    yield _row(f"{label}: secant", surface.secant_stiffness_n_per_m, stiffness, scale)
    if surface.relaxed_stiffness_n_per_m is not None:
        yield _row(f"{label}: held", surface.relaxed_stiffness_n_per_m, stiffness, scale)
    if surface.impact_n_s_per_m is not None:
        yield _row(f"{label}: blow per speed", surface.impact_n_s_per_m, units.damping)
    yield _row(f"{label}: B_e", surface.damping_n_s_per_m, units.damping)
    yield _row(f"{label}: M_e", surface.mass_kg, units.mass)
    lowest, highest = min(surface.peak_force_n, default=None), max(surface.peak_force_n, default=None)
    if lowest is not None and highest is not None:
        peaks = f"{highest:.1f}" if lowest == highest else f"{lowest:.1f} to {highest:.1f}"
        yield ParameterRow(name=f"{label}: peak", value=peaks, unit=units.force)


_MOST_ABOVE = 1.005
_ABOVE = (
    "largest is the largest sample; sensor's peak is what the peak of the force itself may be, between the samples and "
    "without the sensor's noise, which lifts the largest of many samples above it"
)


def touch_columns(timeline: Timeline) -> tuple[str, ...]:
    """Return the columns of the touches of a log, with the units of the axes that were touched."""
    kinds = dict.fromkeys(axis_units(touch.axis) for touch in timeline.touches)
    force, speed = (" or ".join(units) for units in ([k.force for k in kinds], [f"m{k.speed}" for k in kinds]))
    return (
        "touch",
        "cause",
        "from [s]",
        f"speed [{speed}]",
        f"largest [{force}]",
        f"sensor's peak [{force}]",
        f"held [{force}]",
        "later blows",
        "surface",
    )


def touch_rows(timeline: Timeline) -> list[tuple[str, ...]]:
    """Return a row of `touch_columns` for each touch of a log and each of its later blows, which only walls have."""
    rows: list[tuple[str, ...]] = []
    for touch in timeline.touches:
        start = touch.peak_s if touch.onset_s is None else touch.onset_s
        name, surface = f"{'+' if touch.sign > 0 else '-'}{touch.axis}", touch.surface or "-"
        rows.append(
            (
                name,
                f"{touch.cause.value}{', led' if touch.is_led else ''}{', withdrawn' if touch.is_withdrawn else ''}",
                f"{start:.2f}",
                "-" if touch.approach_speed is None else f"{1e3 * touch.approach_speed:.1f}",
                *_peak_texts(touch.peak_force, touch.peak_interval),
                "-" if touch.held_force is None else f"{touch.held_force:.1f}",
                f"{len(touch.later_blows)}" if touch.cause is TouchCause.WALL else "-",
                surface,
            )
        )
        rows += [
            (
                name,
                f"later blow {i + 1}",
                f"{blow.onset_s:.2f}",
                f"{1e3 * blow.approach_speed:.1f}",
                *_peak_texts(blow.peak_force, blow.peak_interval),
                "-",
                "-",
                surface,
            )
            for i, blow in enumerate(touch.later_blows)
        ]
    return rows


def _peak_texts(largest: float, interval: tuple[float, float | None] | None) -> tuple[str, str]:
    low, high = interval or (largest, largest)
    return f"{largest:.1f}", f"{low:.1f} and more" if high is None else f"{low:.1f} to {high:.1f}"


def touch_note(timeline: Timeline) -> str:
    """Return why the largest sample of a touch lies above what its peak may be, "" where none does."""
    ends = [(touch.peak_force, touch.peak_interval[1]) for touch in timeline.touches if touch.peak_interval is not None]
    return _ABOVE if any(high is not None and largest > _MOST_ABOVE * high for largest, high in ends) else ""


def _filter_rows(wrench_filter: WrenchFilterEstimate) -> Iterator[ParameterRow]:
    if wrench_filter.corner_hz is not None:
        yield _row("wrench filter corner", wrench_filter.corner_hz, "Hz")
    if wrench_filter.delay_s is not None:
        yield _row("wrench delay", wrench_filter.delay_s, "ms", 1e3)


def _row(name: str, estimate: Estimate, unit: str, scale: float = 1.0) -> ParameterRow:
    value, std = with_deviation(estimate.value, estimate.std, scale)
    if estimate.value is None and estimate.ci95 is not None:
        low, high = estimate.ci95
        value, std = f"{low * scale:.4g} to {high * scale:.4g}", "-"
    return ParameterRow(
        name=name,
        value=value,
        std=std,
        unit=unit,
        verdict=estimate.status.value,
        method=estimate.method,
        note=estimate.note,
    )


def _vector_rows(name: str, estimate: VectorEstimate, unit: str, scale: float) -> Iterator[ParameterRow]:
    for i, axis in enumerate("xyz" if estimate.value is None else "xyz"[: len(estimate.value)]):
        value, std = with_deviation(
            None if estimate.value is None else estimate.value[i],
            None if estimate.std is None else estimate.std[i],
            scale,
        )
        yield ParameterRow(
            name=f"{name} {axis}",
            value=value,
            std=std,
            unit=unit,
            verdict=estimate.status.value,
            method=estimate.method,
            note=estimate.note,
        )


@dataclass(frozen=True, kw_only=True)
class SiParameter:
    """One number of a parameter in SI, NaN where it is not known."""

    name: str
    value: float
    std: float
    status: str
    unit: str


# Longest first: a key ends in its unit.
_SI_UNITS = {
    "_n_m_s_per_rad": "N·m·s/rad",
    "_n_m_per_rad": "N·m/rad",
    "_n_s_per_m": "N·s/m",
    "_n_per_m": "N/m",
    "_kg_m2": "kg·m²",
    "_n_m": "N·m",
    "_rad": "rad",
    "_kg": "kg",
    "_hz": "Hz",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}


def si_parameters(tree: Mapping[str, Any], place: tuple[str, ...] = ()) -> Iterator[SiParameter]:
    """Yield every parameter of the tree of `identified.yaml`, a row for each component of a vector."""
    for key, node in tree.items():
        if isinstance(node, list):
            named = {str(each["name"]): each for each in node if isinstance(each, Mapping) and "name" in each}
            yield from si_parameters(named, (*place, key))
        elif isinstance(node, Mapping) and {"value", "std", "status"} <= node.keys():
            yield from _si_rows((*place, key), node)
        elif isinstance(node, Mapping):
            yield from si_parameters(node, (*place, key))


def _si_rows(place: tuple[str, ...], node: Mapping[str, Any]) -> Iterator[SiParameter]:
    # Components of the inertia are named behind the key that bears the unit.
    keys = [key for key in reversed(place) if any(key.endswith(end) for end in _SI_UNITS)]
    unit = next((unit for end, unit in _SI_UNITS.items() if keys and keys[0].endswith(end)), "")
    values, stds = node["value"], node["std"]
    if not isinstance(values, list):
        yield SiParameter(
            name=".".join(place), value=_or_nan(values), std=_or_nan(stds), status=str(node["status"]), unit=unit
        )
        return
    names = "xyz" if unit else "0123456789"
    for i, value in enumerate(values):
        std = _or_nan(None if stds is None else stds[i])
        name = f"{'.'.join(place)}.{names[i] if i < len(names) else i}"
        yield SiParameter(name=name, value=float(value), std=std, status=str(node["status"]), unit=unit)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)


def stiffness_text(value: float, units: AxisKind) -> str:
    """Return a stiffness (SI of the axis) in the unit in which people read it."""
    scale, unit = units.shown_stiffness
    return f"{scale * value:.4g} {unit}"


def value_text(name: str, value: float, units: AxisKind) -> str:
    """Return the value of a parameter of the plant with its symbol and unit."""
    scale, unit = units.shown(PARAMETERS[name].kind)
    return f"{PARAMETERS[name].symbol} {scale * value:.4g} {unit}".rstrip()


def off_nominal(scenario: Scenario, units: AxisKind) -> str:
    """Return what a scenario says beyond K_e and M_p, as `K_s 310.2 N/mm, T_d 2.4 ms`; empty if nothing."""
    return ", ".join(value_text(name, value, units) for name, value in scenario.further().items())


def scenario_text(scenario: Scenario, units: AxisKind) -> str:
    """Return a whole scenario, as `K_e 500 N/mm, M_p 16 kg`."""
    always = (
        value_text("environment_stiffness_n_per_m", scenario.environment_stiffness_n_per_m, units),
        value_text("payload_mass_kg", scenario.payload_mass_kg, units),
    )
    return ", ".join(part for part in (*always, off_nominal(scenario, units)) if part)


def compliance_remark(compliance: Mapping[str, Any], tried: Mapping[str, Any]) -> str:
    """Say what one stiffness in `provenance.compliance` is."""
    stiffness, bound, remarks = tried["environment_stiffness_n_per_m"], compliance["active_bound"], []
    if stiffness == compliance["chosen_n_per_m"]:
        remarks.append("chosen" if bound is None else f"chosen, at the {bound} bound")
    elif stiffness == compliance["stiffest_within_one_percent_n_per_m"]:
        remarks.append("the stiffest within 1 % of that")
    if stiffness == compliance["stiffest_that_meets_all_n_per_m"]:
        remarks.append("the stiffest that meets everything")
    if not tried["meets_all"]:
        is_none = tried["peak_force_n"] is None
        remarks.append("no controller meets the requirements" if is_none else "above max_peak_force_n")
    return ", ".join(remarks)


def gain_rows(units: AxisKind, *laws: AdmittanceController) -> Iterator[tuple[str, ...]]:
    """Yield for each of the four gains its symbol with its unit, and its value in each of the laws."""
    for symbol, name, scale in (
        (f"M_a [{units.mass}]", "mass_kg", 1.0),
        (f"B_a [{units.damping}]", "damping_n_s_per_m", 1.0),
        ("K_l [ms]", "lead_s", 1e3),
        ("B_fb [ms]", "feedback_damping_s", 1e3),
    ):
        yield symbol, *(f"{scale * getattr(each, name):.6g}" for each in laws)
    if any(each.has_biquad for each in laws):
        times = ([1e3 * each.biquad_zero_s, 1e3 * each.biquad_pole_s] for each in laws)
        yield "biquad τ_z, τ_p [ms]", *(f"{zero:.4g}, {pole:.4g}" if pole else "none" for zero, pole in times)


_TIMES = ("lead_s", "feedback_damping_s", "biquad_zero_s", "biquad_pole_s")
_GAIN_SYMBOLS = {
    "mass": "M_a",
    "damping": "B_a",
    "lead_s": "K_l",
    "feedback_damping_s": "B_fb",
    "velocity_filter_rad_per_s": "ω_v",
    "acceleration_filter_rad_per_s": "ω_a",
    "compensation_mass_kg": "P̂",
    "biquad_zero_s": "the biquad's τ_z",
    "biquad_zero_damping_ratio": "the biquad's ζ_z",
    "biquad_pole_s": "the biquad's τ_p",
    "biquad_pole_damping_ratio": "the biquad's ζ_p",
}


def bound_text(name: str, bounds: Mapping[str, tuple[float, float]] | None, units: AxisKind) -> str:
    """Return an active bound, as `upper bound of lead_s`, in words: `upper bound of K_l, 30 ms`.

    Without bounds it has no number; another name is returned as it is.
    """
    side, _, variable = name.partition(" bound of ")
    if not variable:
        return name
    text = f"{side} bound of {_GAIN_SYMBOLS.get(variable, variable)}"
    if bounds is None:
        return text
    of = {**dict.fromkeys(_TIMES, "s"), "damping": units.damping}
    if variable.endswith("_damping_ratio"):
        return f"{text}, {bounds[variable][0 if side == 'lower' else 1]:g}"
    is_mass = variable in {"mass", "compensation_mass_kg"}
    scale, unit = for_people(units.mass if is_mass else of.get(variable, "rad/s"))
    return f"{text}, {scale * bounds[variable][0 if side == 'lower' else 1]:g} {unit}"


def margins_text(values: Mapping[str, float]) -> str:
    """Return margins by name in words, as `modulus 0.5, gain 9.88 dB, phase 37.6°, delay 3.09 ms`."""
    shown = {"modulus": (1.0, ""), "gain_db": (1.0, " dB"), "phase_deg": (1.0, "°"), "delay_s": (1e3, " ms")}
    return ", ".join(
        f"{name.partition('_')[0]} {scale * values[name]:.4g}{unit}"
        for name, (scale, unit) in shown.items()
        if name in values
    )


def range_text(low: float, high: float) -> str:
    """Return a range of peaks, one number where both ends are written alike."""
    digits = 1 if high >= 10.0 else 2
    ends = [f"{low:.{digits}f}", f"{high:.{digits}f}"]
    return "–".join(dict.fromkeys(ends))


def speed_text(speed: float, force: str) -> str:
    """Return a speed in thousandths, straight or turning as the unit of force says."""
    return f"{1e3 * speed:.3g} {'mm/s' if force == 'N' else 'mrad/s'}"


def span_text(speeds: Sequence[float], force: str) -> str:
    """Return the range of speeds, in thousandths."""
    if not speeds:
        return "of unknown speed"
    low, high = (f"{1e3 * each:.3g}" for each in (min(speeds), max(speeds)))
    unit = "mm/s" if force == "N" else "mrad/s"
    return f"{high} {unit}" if low == high else f"{low} to {high} {unit}"


def clock_text(seconds: float) -> str:
    """Return a time in a long log as people read it: hours, minutes and seconds."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"
