"""Which axis of the robot's base each tuned axis lies along: FZI's force controller has its gains there."""

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from autotune.errors import UsageError

Quaternion = tuple[float, float, float, float]

KINDS = (("x", "y", "z"), ("rx", "ry", "rz"))
# How far an orientation may be from a turn by right angles: at 1° an axis keeps cos² = 0.9997 of its gain.
_TOLERANCE_DEG = 1.0
# How far from 1 the length of a quaternion may be that a person types.
_UNIT = 0.01


def parse_orientation(text: str) -> Quaternion:
    """Return the quaternion (x, y, z, w) of a text as "0,0,0,1"; raises UsageError for one that is none."""
    try:
        numbers = [float(each) for each in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len("xyzw"):
        raise UsageError(f"--orientation must be four numbers QX,QY,QZ,QW, a quaternion; found {text}.")
    return numbers[0], numbers[1], numbers[2], numbers[3]


def check_orientation(orientation: Quaternion) -> None:
    """Raise UsageError for a quaternion that is not of length 1."""
    length = math.hypot(*orientation)
    if not abs(length - 1.0) <= _UNIT:
        raise UsageError(
            f"--orientation must be a quaternion QX,QY,QZ,QW of length 1, found {orientation} of length {length:.6g}."
        )


def check_kinds(tuned: Iterable[str], orientation: Quaternion | None) -> None:
    """Raise UsageError where one or two axes of three are tuned and `orientation` is no turn by right angles.

    Whether three are alike is known only once their gains are.
    """
    for kind in KINDS:
        found = [axis for axis in kind if axis in tuned]
        if 0 < len(found) < len(kind):
            if orientation is None:
                still = [axis for axis in kind if axis not in found]
                raise UsageError(_needed(f"{', '.join(found)} must move and {', '.join(still)} must not"))
            right_angles(orientation)


def base_axes(gains: Mapping[str, Mapping[str, float]], orientation: Quaternion | None) -> dict[str, str]:
    """Return by tuned axis the axis of the base whose gains are to be those; all stay where three are alike.

    A gain along an axis does not ask for its direction, so a base's axis may point either way. Raises UsageError for
    unequal gains of a kind without an orientation, or with one that is not a turn by right angles.
    """
    found = dict[str, str]()
    for kind in KINDS:
        places: tuple[str, ...] = kind
        if not _alike(gains, kind):
            if orientation is None:
                raise UsageError(_needed(_unequal(gains, kind)))
            places = tuple(kind[each] for each in right_angles(orientation))
        found |= {axis: place for axis, place in zip(kind, places, strict=True) if axis in gains}
    return found


def right_angles(orientation: Quaternion) -> tuple[int, int, int]:
    """Return which axis of the base each axis of the sensor lies along; raises UsageError if one does not."""
    turn = np.abs(rotation(orientation))
    places = np.argmax(turn, axis=0)
    off = np.degrees(np.arccos(np.minimum(np.max(turn, axis=0), 1.0)))
    if np.max(off) > _TOLERANCE_DEG:
        worst = int(np.argmax(off))
        raise UsageError(
            f"--orientation must be a turn by right angles: the sensor's {'xyz'[worst]} is {off[worst]:.3g}° off the "
            f"nearest axis of the base, more than {_TOLERANCE_DEG:g}°, and gains along the base's axes cannot be "
            "unequal along the sensor's there; hold the tool otherwise, or tune x, y, z alike."
        )
    return int(places[0]), int(places[1]), int(places[2])


def rotation(orientation: Quaternion) -> NDArray[np.float64]:
    """Return R_BS (3, 3), which takes a vector from the sensor's axes to the base's."""
    x, y, z, w = np.array(orientation) / math.hypot(*orientation)
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def axes_told(
    gains: Mapping[str, Mapping[str, float]], orientation: Quaternion | None, base_link: str
) -> Iterator[str]:
    """Say along which axes of the base the gains act, and what turning the wrist does to that."""
    places = base_axes(gains, orientation)
    turned = [axis for kind in KINDS if not _alike(gains, kind) for axis in kind if axis in gains]
    if not turned or orientation is None:
        yield (
            f"The gains act along the axes of {base_link}. They are alike for all straight axes, and for all turning "
            "ones, so that they hold in every orientation of the sensor."
        )
        return
    along = ", ".join(f"{axis} along its {places[axis]}" for axis in turned)
    yield (
        f"The gains act along the axes of {base_link}, not the sensor's, and were assigned for the orientation "
        f"({', '.join(f'{each:g}' for each in orientation)}) of the sensor in it: {along}. The file holds in that "
        "orientation only: 8° beside it an axis that moves alone moves 2 % less, and 14 % as far sideways; after a "
        "quarter turn the wrong axis moves."
    )


def _alike(gains: Mapping[str, Mapping[str, float]], kind: tuple[str, ...]) -> bool:
    rows = [gains.get(axis) for axis in kind]
    return all(row == rows[0] for row in rows)


def _unequal(gains: Mapping[str, Mapping[str, float]], kind: tuple[str, ...]) -> str:
    told = (
        f"{axis} has {', '.join(f'{key} {value:g}' for key, value in gains.get(axis, {}).items())}" for axis in kind
    )
    return "; ".join(told)


def _needed(why: str) -> str:
    return (
        f"The gains of that controller act along the base's axes, those of the file along the sensor's, and {why}: "
        "what is certified holds in one orientation only. Give that of the sensor in the base where it is used with "
        "--orientation QX,QY,QZ,QW, a turn by right angles."
    )
