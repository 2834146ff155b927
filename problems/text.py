"""Numbers and names as a sentence holds them."""

import math
from collections.abc import Iterable
from difflib import get_close_matches


def significant(value: float, digits: int = 2) -> str:
    """Return a number with so many significant digits, a large one written out: 370, and not 3.7e+02."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text else text


def rounded_down(value: float, digits: int = 2) -> float:
    """Return the largest number of so many digits that a positive one is not below; an infinite one as it is."""
    if not math.isfinite(value):
        return value
    unit = 10.0 ** (math.floor(math.log10(value)) - digits + 1)
    return float(f"{math.floor(value / unit * (1.0 + 1e-9)) * unit:.{digits}g}")


def meant(name: object, known: Iterable[str]) -> str:
    """Return how a sentence about an unknown name ends: with the nearest of those that are known, if one is near."""
    near = get_close_matches(str(name), known, n=1, cutoff=0.5)
    return f"; {near[0]} may be meant" if near else ""
