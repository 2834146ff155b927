"""Checks that every value of this floor makes once, in its constructor."""

import math
from collections.abc import Sequence
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from .errors import ParameterError


def number(name: str, value: object) -> float:
    """Return `value` as a float if it is a real number and not a truth value."""
    if type(value) is float:  # nearly always, and asking the abstract class takes most of a constructor's time
        return value
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise ParameterError(name, value, "a number")
    return float(value)


def positive(name: str, value: float) -> float:
    """Return `value` if it is finite and above zero."""
    if not (math.isfinite(number(name, value)) and value > 0.0):
        raise ParameterError(name, value, "finite and above 0")
    return float(value)


def non_negative(name: str, value: float) -> float:
    """Return `value` if it is finite and not below zero."""
    if not (math.isfinite(number(name, value)) and value >= 0.0):
        raise ParameterError(name, value, "finite and not below 0")
    return float(value)


def finite(name: str, value: float) -> float:
    """Return `value` if it is finite."""
    if not math.isfinite(number(name, value)):
        raise ParameterError(name, value, "finite")
    return float(value)


def interval(name: str, bounds: Sequence[float], *, lowest: float = 0.0) -> tuple[float, float]:
    """Return `(low, high)` if both are finite, in order and not below `lowest`."""
    if len(bounds) == 2 and bounds[0] > bounds[1]:
        raise ParameterError(name, tuple(bounds), "an interval from low to high")
    if len(bounds) != 2 or not all(math.isfinite(b) for b in bounds) or not lowest <= bounds[0] <= bounds[1]:
        raise ParameterError(name, tuple(bounds), f"an interval low..high of finite numbers not below {lowest:g}")
    return float(bounds[0]), float(bounds[1])


def frozen_vector(name: str, values: Sequence[float] | NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a read-only copy of a non-empty vector of finite numbers."""
    vector = np.array(values, dtype=np.float64)
    if vector.ndim != 1 or vector.size == 0 or not np.all(np.isfinite(vector)):
        raise ParameterError(name, values, "a non-empty vector of finite numbers")
    vector.setflags(write=False)
    return vector
