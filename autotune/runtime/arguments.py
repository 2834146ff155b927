"""What a caller hands to `step`, as tuples of floats; what is none is refused, however large or strange it is."""

from collections.abc import Iterable, Sequence
from numbers import Integral

from problems.errors import ParameterError

from .frames import Place, Six

TICKS = 2**32
"""A count of periods begins again at 0 after so many, as one of 32 bits does."""

# What can be iterated over and yet gives no axis its number.
_UNORDERED = (dict, set, frozenset)


def six(name: str, values: Sequence[float]) -> Six:
    """Return 6 numbers; raises ParameterError."""
    numbers = _floats(name, values)
    if len(numbers) != 6:
        raise ParameterError(name, f"{len(numbers)} of them", "6 numbers")
    return each_of(numbers)


def each_of(values: Iterable[float]) -> Six:
    """Return six values as a tuple of six."""
    x, y, z, rx, ry, rz = values
    return x, y, z, rx, ry, rz


def place_of(position: Sequence[float], rows: Sequence[Sequence[float]]) -> Place:
    """Return position (3,) and R_WS (3, 3) as a place; raises ParameterError."""
    p = _floats("position_W_m", position)
    if len(p) != 3:
        raise ParameterError("position_W_m", f"{len(p)} of them", "3 numbers")
    if isinstance(rows, _UNORDERED) or not hasattr(rows, "__len__"):
        raise ParameterError("R_WS", type(rows).__name__, "3 rows of 3 numbers")
    try:
        lines = [_floats("R_WS", row) for row in rows]
    except TypeError as reason:
        raise ParameterError("R_WS", type(rows).__name__, "3 rows of 3 numbers") from reason
    sizes = [len(line) for line in lines]
    if sizes != [3, 3, 3]:
        found = f"rows of {', '.join(map(str, sizes[:9]))} numbers" if sizes else "no row"
        raise ParameterError("R_WS", found, "3 rows of 3 numbers")
    x, y, z = p
    (a, b, c), (d, e, f), (g, h, i) = lines
    return (x, y, z), (a, b, c, d, e, f, g, h, i)


def check_kind(name: str, value: object, kind: type) -> None:
    """Raise ParameterError unless a value is of a kind."""
    if not isinstance(value, kind):
        raise ParameterError(name, type(value).__name__, f"of type {kind.__name__}")


def _floats(name: str, values: Sequence[float]) -> list[float]:
    # A text is no number, although `float` reads it; what is refused may be too long to be shown.
    try:
        if isinstance(values, str | bytes) or any(isinstance(value, str | bytes) for value in values):
            raise ParameterError(name, "text", "numbers only")
        if isinstance(values, _UNORDERED):
            raise ParameterError(name, type(values).__name__, "a sequence of numbers")
        return [float(value) for value in values]
    except OverflowError as reason:
        raise ParameterError(name, "a number beyond double precision", "numbers only") from reason
    except (TypeError, ValueError) as reason:
        if isinstance(reason, ParameterError):
            raise
        raise ParameterError(name, f"another thing ({reason})", "numbers only") from reason


def tick_of(tick: int | None) -> int | None:
    """Return the caller's count as one of 32 bits; raises ParameterError for what is no whole number."""
    if tick is None:
        return None
    known: object = tick
    if isinstance(known, bool) or not isinstance(known, Integral):
        raise ParameterError("tick", type(known).__name__, "a whole number, or None")
    return int(tick) % TICKS
