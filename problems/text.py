"""Numbers as a sentence holds them."""


def significant(value: float, digits: int = 2) -> str:
    """Return a number with so many significant digits, a large one written out: 370, and not 3.7e+02."""
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text else text
