"""The axes of a cell and of which kind each is: straight ones x, y, z; turning ones rx, ry, rz."""

from typing import Annotated

from problems.frozen import Rule
from problems.model.axis_kind import STRAIGHT, TURNING, AxisKind, rotational_name

AXES = ("x", "y", "z", "rx", "ry", "rz")
ROTATIONAL_AXES = frozenset({"rx", "ry", "rz"})
Axis = Annotated[str, Rule(enum=AXES)]
"""An axis as an entry of a file."""


def axis_units(axis: str) -> AxisKind:
    """Return the units of the axis `axis`, one of x, y, z, rx, ry, rz."""
    return TURNING if axis in ROTATIONAL_AXES else STRAIGHT


def axis_key(axis: str, name: str) -> str:
    """Return what the entry `name` of a straight axis is called in the files of `axis`."""
    return rotational_name(name) if axis in ROTATIONAL_AXES else name
