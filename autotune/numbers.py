"""Numbers as people read them: as far as their deviation tells."""

import math

_MOST_DECIMALS = 6
_SMALL = 1e-3


def with_deviation(value: float | None, std: float | None, scale: float = 1.0) -> tuple[str, str]:
    """Return `value` and `std`, both times `scale`, as texts with the same decimals: two digits of the deviation.

    Without a deviation the value has four decimals. Where both are small and would need more than six decimals, they
    are written with the power of ten of the larger; what is not known is `-`.
    """
    if value is None:
        return "-", "-"
    told, spread = value * scale, 0.0 if std is None else std * scale
    if not 0.0 < spread < math.inf:
        return f"{told:.4f}", "-" if std is None else "0"
    decimals = _decimals(spread)
    larger = max(abs(told), spread)
    if decimals <= _MOST_DECIMALS or larger >= _SMALL:
        return _plain(told, decimals), _plain(spread, decimals)
    power = math.floor(math.log10(larger))
    decimals += power
    texts = [f"{_plain(each * 10.0**-power, decimals)}e{power:+03d}" for each in (told, spread)]
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
