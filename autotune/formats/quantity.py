"""A number that a person gives: exact, as a range that must all be safe, or with its standard deviation."""

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any

from problems.errors import ParameterError

DEVIATIONS = 3.0
"""A value with a deviation is taken over so many of them to each side."""

Interval = tuple[float, float]


@dataclass(frozen=True)
class Uncertain:
    """A value with one standard deviation; what is designed for it must hold over three of them to each side.

    Parameters
    ----------
    value
        The expected value, in the unit of what it describes.
    std
        One standard deviation, in the same unit, above 0.

    Raises
    ------
    ParameterError
        The deviation is not positive, or not finite.

    """

    value: float
    std: float

    def __post_init__(self) -> None:
        if not 0.0 < self.std < math.inf:
            raise ParameterError("std", self.std, "greater than 0 (a number without a deviation is exact)")


Quantity = float | Interval | Uncertain
"""A plain number (exact), a range (low, high) that must all be safe, or a value with its deviation."""


def as_interval(name: str, given: Any, *, may_vanish: bool) -> Interval:
    """Return the lowest and the highest value of a quantity; raises ParameterError for one that is none."""
    least = "at least 0" if may_vanish else "greater than 0"
    if isinstance(given, Uncertain):
        given = (given.value - DEVIATIONS * given.std, given.value + DEVIATIONS * given.std)
        if may_vanish:
            given = (max(given[0], 0.0), given[1])
    try:
        if isinstance(given, str | bool):
            raise TypeError(name)
        low, high = (given, given) if isinstance(given, Real) else given
        low, high = float(low), float(high)
    except (TypeError, ValueError):
        raise ParameterError(name, given, "a number, a range (low, high) or Uncertain(value, std)") from None
    if not (low <= high < math.inf and (low > 0.0 or (may_vanish and low == 0.0))):
        raise ParameterError(name, low if low == high else given, f"{least}, and a range from low to high")
    return low, high


def nominal_value(given: Any, interval: Interval) -> float:
    """Return the value as given; of a range the middle, the geometric one where it covers a factor of three or more."""
    if isinstance(given, Uncertain):
        return float(given.value)
    low, high = interval
    return math.sqrt(low * high) if low > 0.0 and high > 3.0 * low else 0.5 * (low + high)
