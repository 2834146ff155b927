"""Numbers and words for pictures, data files and the command line."""

from problems.contact.transient import Approach
from problems.model.axis_kind import for_people

WHERE = {"contact": "in contact", "free_space": "in free space", "both": "in contact and in free space"}

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float) -> str:
    """Return a number for people: 0.0125, 913, 3×10⁵."""
    if value == 0.0 or 1e-3 <= abs(value) < 9999.5:
        return f"{value:.4g}"
    mantissa, _, exponent = f"{value:.3e}".partition("e")
    power, factor = "10" + str(int(exponent)).translate(_SUPERSCRIPTS), f"{float(mantissa):.4g}"
    return power if factor == "1" else f"{factor}×{power}"


def with_unit(text: str, unit: str) -> str:
    """Return text and unit, or the text alone for a number without unit."""
    return f"{text}{'' if unit == '°' else ' '}{unit}" if unit else text


def shown(value: float, unit: str) -> str:
    """Return a number of an SI unit, and its unit, for people."""
    factor, its_unit = for_people(unit)
    return with_unit(number(factor * value), its_unit)


def approach_text(approach: Approach, *, rotational: bool) -> str:
    """Return how the contact is made."""
    if approach.speed_m_s is not None:
        return f"approach at {number(approach.speed_m_s)} {'rad/s' if rotational else 'm/s'}"
    return f"approach with {number(approach.force_n or 0.0)} {'N·m' if rotational else 'N'}"
