"""Which axis of the base each tuned axis of the sensor lies along, for programs whose gains act along the base's.

What is certified along an axis of the sensor then holds in one orientation only, unless all three are alike.
"""

import math
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from autotune.errors import UsageError

from .ros_yaml import Quaternion

KINDS = (("x", "y", "z"), ("rx", "ry", "rz"))
# How far an orientation may be from a turn by right angles: at 1° an axis keeps cos² = 0.9997 of its gain.
_TOLERANCE_DEG = 1.0


class MissingOrientationError(UsageError):
    """The gains act along another frame's axes, and nobody says how that lies."""


def check_kinds(tuned: Iterable[str], orientation: Quaternion | None) -> None:
    """Raise UsageError where one or two axes of three are tuned and `orientation` is none or no turn by right angles.

    Whether three are alike is known only once their gains are.
    """
    for kind in KINDS:
        found = [axis for axis in kind if axis in tuned]
        if 0 < len(found) < len(kind):
            if orientation is None:
                still = [axis for axis in kind if axis not in found]
                raise MissingOrientationError(_needed(f"{', '.join(found)} must move and {', '.join(still)} must not"))
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
                raise MissingOrientationError(_needed(_unequal(gains, kind)))
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


def orientation_notes(
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
    numbers = (
        f"{axis} has {', '.join(f'{key} {value:g}' for key, value in gains.get(axis, {}).items())}" for axis in kind
    )
    return "; ".join(numbers)


def _needed(why: str) -> str:
    return (
        f"The gains of that controller act along the base's axes, those of the file along the sensor's, and {why}: "
        "what is certified holds in one orientation only. Give that of the sensor in the base where it is used with "
        "--orientation QX,QY,QZ,QW, a turn by right angles."
    )
