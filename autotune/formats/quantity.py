"""A number that a person gives: exact, as a range that must all be safe, or with its standard deviation."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from autotune.shown import Said
from problems.errors import ParameterError

DEVIATIONS = 3.0
"""A value with a deviation is taken over so many of them to each side."""

Interval = tuple[float, float]


@dataclass(frozen=True, repr=False)
class Uncertain(Said):
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
        One of them is no finite number, or the deviation is not positive.

    """

    value: float
    std: float

    def __post_init__(self) -> None:
        for name in ("value", "std"):
            object.__setattr__(self, name, as_number(name, getattr(self, name)))
        if not self.std > 0.0:
            raise ParameterError("std", self.std, "greater than 0 (a number without a deviation is exact)")


Quantity = float | Interval | Uncertain
"""A plain number (exact), a range (low, high) that must all be safe, or a value with its deviation."""


def as_number(name: str, given: object) -> float:
    """Return a finite number, also that of numpy; raises ParameterError for anything else."""
    try:
        if isinstance(given, str | bytes | bool) or getattr(getattr(given, "dtype", None), "kind", "") == "b":
            raise TypeError(name)
        value = float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise ParameterError(name, given, "one number") from None
    if not math.isfinite(value):
        raise ParameterError(name, value, "a finite number")
    return value


def as_numbers(name: str, given: object, count: int | None = None) -> tuple[float, ...]:
    """Return finite numbers, `count` of them if that is said; raises ParameterError for anything else."""
    must = "a list of numbers" if count is None else f"a list of {count} numbers"
    if isinstance(given, str | bytes | Mapping) or not isinstance(given, Iterable) or getattr(given, "ndim", 1) != 1:
        raise ParameterError(name, given, must)
    found = tuple(as_number(name, each) for each in given)
    if not found or len(found) != (count or len(found)):
        raise ParameterError(name, given, must)
    return found


def as_quantity(name: str, given: object, *, may_vanish: bool) -> Quantity:
    """Return a quantity as floats: a number, (low, high) or an `Uncertain`; raises ParameterError for anything else."""
    if isinstance(given, Uncertain):
        found: Quantity = given
    else:
        try:
            is_range = isinstance(given, Iterable) and getattr(given, "ndim", 1) == 1
            found = as_numbers(name, given, 2) if is_range else as_number(name, given)  # type: ignore[assignment]
        except ParameterError:
            raise ParameterError(name, given, "a number, a range (low, high) or Uncertain(value, std)") from None
    as_interval(name, found, may_vanish=may_vanish)
    return found


def as_interval(name: str, given: Quantity, *, may_vanish: bool) -> Interval:
    """Return the lowest and the highest value of a quantity; raises ParameterError for one that is out of range."""
    least = "at least 0" if may_vanish else "greater than 0"
    if isinstance(given, Uncertain):
        low, high = given.value - DEVIATIONS * given.std, given.value + DEVIATIONS * given.std
        low = max(low, 0.0) if may_vanish else low
    else:
        low, high = given if isinstance(given, tuple) else (given, given)
    if isinstance(given, Uncertain) and low <= 0.0 and not (may_vanish and low == 0.0):
        raise ParameterError(name, given, f"{least} three deviations below its value, which is {low:g}")
    if low > high:
        raise ParameterError(name, (low, high), "a range from low to high")
    if low < 0.0 or (low == 0.0 and not may_vanish):
        raise ParameterError(name, low if low == high else (low, high), least)
    return low, high


def nominal_value(given: Quantity, interval: Interval) -> float:
    """Return the value as given; of a range the middle, the geometric one where it covers a factor of three or more."""
    if isinstance(given, Uncertain):
        return float(given.value)
    low, high = interval
    return math.sqrt(low * high) if low > 0.0 and high > 3.0 * low else 0.5 * (low + high)
