"""Values of a plant as a person writes them, a number, a range, a value with its deviation or a list: for tables."""

import math
from collections.abc import Iterator, Mapping
from typing import Any

from problems.frozen import FrozenDict

from .quantity import Uncertain, as_interval

UNITS: Mapping[str, str] = FrozenDict(
    {
        "mass": "kg",
        "environment_stiffness": "N/m",
        "coupling_stiffness": "N/m",
        "coupling_damping": "N·s/m",
        "drag": "N·s/m",
        "robot.bandwidth": "Hz",
        "robot.delay": "s",
        "sample_time": "s",
        "centre_of_mass": "m",
        "force_bias": "N",
        "torque_bias": "N·m",
        "force_noise": "N RMS",
        "wrench_corner": "Hz",
        "wrench_delay": "s",
    }
)
"""Unit of a number by its name, `robot.` before those of the robot."""
_LISTS = ("centre_of_mass", "force_bias", "torque_bias", "robot.numerator", "robot.denominator")


def _is_range(name: str, value: Any) -> bool:
    return isinstance(value, list) and name not in _LISTS


def value_texts(name: str, value: Any) -> tuple[str, str]:
    """Return a value of the tree as text, and how it is taken."""
    if isinstance(value, Mapping):
        return f"{value['value']:g} ± {value['std']:g}", "three deviations to each side"
    if _is_range(name, value):
        return f"{value[0]:g} to {value[1]:g}", "a range"
    return ", ".join(map("{:g}".format, value if isinstance(value, list) else [value])), "exact"


def value_numbers(name: str, value: Any) -> Iterator[tuple[str, tuple[float, float, float, float]]]:
    """Yield value, deviation, lowest and highest of a value of the tree, of a list each component."""
    if isinstance(value, Mapping):
        low, high = as_interval(name, Uncertain(**value), may_vanish=True)
        yield name, (value["value"], value["std"], low, high)
    elif _is_range(name, value):
        yield name, (math.nan, math.nan, *value)
    elif isinstance(value, list):
        places = range(len(value)) if name.startswith("robot.") else "xyz"
        yield from ((f"{name}.{place}", (each, 0.0, each, each)) for place, each in zip(places, value, strict=True))
    else:
        yield name, (value, 0.0, value, value)
