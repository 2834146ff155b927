"""Compare the ranges asked for with what was identified: a mistaken unit, a contradiction, a contact left out."""

import math
from collections.abc import Iterator, Mapping, Sequence

from autotune.errors import UsageError
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from identification.result import CONTACT_UNEXPLAINED, AxisEstimate, Finding, Identified
from problems.design.problem import DesignProblem

Interval = tuple[float, float]
_SAID = {
    "environment_stiffness": ("--environment-stiffness", "environment_stiffness_n_per_m"),
    "payload_mass": ("--payload-mass", "payload_mass_kg"),
}

# A range this many times off what was identified, and near it a factor of a thousand further on, is in another unit;
# one that is off by far more is wrong whatever its unit.
_OFF, _NEAR, _UNIT = 30.0, 3.0, 1e3
_HEAVIEST_KG = 1000.0
_FAR_OFF = {"stiffness": 1e4, "mass": 100.0}
# Three happen by chance in some of many parameters, five in none.
_MOST_STDS = 5.0


def check_plausible(identified: Identified, names: Sequence[str], straight: ProblemSpec, turned: ProblemSpec) -> None:
    """Raise UsageError for a range of K_e or of the payload that a mistaken unit would explain.

    `straight` and `turned` hold the ranges of translational and rotational axes; where the unit was typed they are
    meant. Where nothing was identified nothing is compared.
    """
    for name in names:
        turns, spec = name in ROTATIONAL_AXES, turned if name in ROTATIONAL_AXES else straight
        axis, units = identified.axes[name], axis_units(name)
        known = [e.stiffness_n_per_m.value for e in axis.environments]
        mass = (axis.mass_kg.value if axis.mass_kg is not None else None) if turns else identified.payload.mass_kg.value
        stiffness = [value for value in known if value is not None and value > 0.0]
        masses = [mass] if mass is not None and mass > 0.0 else []
        said = "rotational.environment_stiffness_n_m_per_rad" if turns else _said(spec, "environment_stiffness")
        if "environment_stiffness" not in spec.with_unit:
            _check(spec.environment_stiffness, stiffness, said, "stiffness", units.stiffness)
        said = "rotational.payload_inertia_kg_m2" if turns else _said(spec, "payload_mass")
        if "payload_mass" not in spec.with_unit:
            _check(spec.payload_mass, masses, said, "mass", units.mass)
    heaviest = max(straight.payload_mass or (0.0,))
    if heaviest > _HEAVIEST_KG:
        raise UsageError(
            f"{_said(straight, 'payload_mass')} asks for {heaviest:g} kg; a payload of {_HEAVIEST_KG:g} kg is the "
            "heaviest that a controller file holds."
        )


def _said(spec: ProblemSpec, name: str) -> str:
    """Return the option that said a range, or the key of the file."""
    option, key = _SAID[name]
    return option if name in spec.options else key


def _check(asked: Interval | None, known: Sequence[float], name: str, kind: str, unit: str) -> None:
    if asked is None or not known:
        return
    off = _distance(asked, known)
    if off <= _OFF:
        return
    shifted = {factor: _distance((factor * asked[0], factor * asked[1]), known) for factor in (_UNIT, 1.0 / _UNIT)}
    factor = min(shifted, key=lambda each: shifted[each])
    likely = shifted[factor] <= _NEAR
    if not likely and off <= _FAR_OFF[kind]:
        return
    meant = f"; did you mean {_range_text((factor * asked[0], factor * asked[1]), kind)}?" if likely else "."
    said = ""
    for option, key in _SAID.values():
        typed = f"{option} {_range_text(asked, kind)}{unit}"
        if name in (option, key):
            said = f" If it is meant, say its unit: {typed if name == option else f'`autotune optimize … {typed}`'}."
    wanted = f"{name} asks for {_range_text(asked, kind)} {unit}"
    raise UsageError(f"{wanted}, and the plant has {_identified(known, kind, unit)}{meant}{said}")


def _distance(asked: Interval, known: Sequence[float]) -> float:
    """Return the factor from a range to the nearest of the known values, 1 where it holds one."""
    return min(math.exp(max(math.log(asked[0] / each), math.log(each / asked[1]), 0.0)) for each in known)


def _range_text(asked: Interval, kind: str) -> str:
    (low, high), between = map(_digits, asked), ":" if kind == "stiffness" else ","
    return low if low == high else f"{low}{between}{high}"


def _digits(value: float) -> str:
    """Return four digits in the shorter form, 1.2e5 or 120."""
    mantissa, exponent = f"{value:.3e}".split("e")
    scientific = f"{mantissa.rstrip('0').rstrip('.')}e{int(exponent)}"
    plain = f"{float(f'{value:.4g}'):f}".rstrip("0").rstrip(".")
    return min(plain, scientific, key=len)


def _identified(known: Sequence[float], kind: str, unit: str) -> str:
    """Return the known values, of a wall in N/mm too, as it is printed elsewhere."""
    listed = ", ".join(
        f"{_digits(each / 1e3)} N/mm = {_digits(each)} {unit}" if unit == "N/m" else f"{_digits(each)} {unit}"
        for each in known[:10]
    )
    return f"{listed}" if kind == "stiffness" else f"a payload of {listed}"


def doubtful_ranges(problem: DesignProblem, axis: AxisEstimate, name: str) -> Iterator[str]:
    """Yield a sentence for each range of problem.yaml that leaves out what was identified by many deviations."""
    plants = problem.plants
    of_confidence = () if plants.ellipsoid is None else plants.ellipsoid.names
    for key, estimate in axis.plant_estimates().items():
        if key not in plants.ranges or key in of_confidence or estimate.value is None or not estimate.std:
            continue
        low, high = plants.ranges[key]
        off = max(low - estimate.value, estimate.value - high) / estimate.std
        if off > _MOST_STDS:
            given = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            yield (
                f"axis {name}: {key} in problem.yaml, {given}, lies {off:.0f} deviations off what was identified, "
                f"{estimate.value:.4g} ± {estimate.std:.2g}; the controller is certified for what problem.yaml says."
            )


def left_out_contacts(problem: DesignProblem, identified: Identified, name: str) -> Iterator[str]:
    """Yield a sentence for each contact in the log that the certified range of K_e may leave out."""
    units = axis_units(name)
    low, high = problem.plants.environment_stiffness_n_per_m
    scale, unit = units.shown_stiffness
    certified = f"{scale * low:g} to {scale * high:g} {unit}"
    for surface in identified.axes[name].environments:
        value = surface.stiffness_n_per_m.value
        if value is None or low <= value <= high:
            continue
        most = max(surface.peak_force_n, default=0.0)
        touched = f", touched with up to {most:.1f} {units.force} in the log," if most > 0.0 else ""
        yield (
            f"axis {name}: surface {surface.name}{touched} has K_e = {scale * value:.4g} {unit}, and the controller "
            f"is certified for {certified} only: keep it off that surface."
        )
    for finding in unexplained_contacts(identified, name):
        yield (f"{finding.message} Whether {certified}, the range that was said, holds it is not known from the log.")


def left_out_tree(problems: Mapping[str, DesignProblem], identified: Identified) -> dict[str, list[str]]:
    """Return `left_out_contacts` of all axes as a plain tree, for the provenance of a controller; empty without any."""
    lines = [line for name, problem in problems.items() for line in left_out_contacts(problem, identified, name)]
    return {"left_out_contacts": lines} if lines else {}


def unexplained_contacts(identified: Identified, name: str) -> tuple[Finding, ...]:
    """Return the findings that something was touched along or about an axis whose stiffness is not known."""
    return tuple(f for f in identified.findings if f.code == CONTACT_UNEXPLAINED and f.axis in ("", name))
