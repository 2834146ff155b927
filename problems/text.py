"""Numbers as a sentence holds them."""

import math


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
