"""Three numbers that are an orientation: which way to read them the force at rest shows."""

import numpy as np
import pytest

from identification.logs.roles.orientation import THREE_NUMBERS, read_by_weight, weight_misfits
from problems.arrays import FloatArray

NAMED = ("euler_xyz", "by name")


def about(axis: str, angle: float) -> FloatArray:
    """The matrix of a turn about x, y or z, written down."""
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first], matrix[first, second] = np.sin(angle), -np.sin(angle)
    return matrix


def rests(kind: str, *, mass: float = 5.0, count: int = 12, spread: float = 1.2) -> tuple[FloatArray, FloatArray]:
    """Angles (n, 3) and the force of a payload at rest: f = m R^T g + b."""
    rng = np.random.default_rng(11)
    angles, force = rng.uniform(-spread, spread, (count, 3)), []
    for three in angles:
        if kind == "rotation_vector":
            size = float(np.linalg.norm(three))
            x, y, z = three / size
            cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            turned = np.eye(3) + np.sin(size) * cross + (1.0 - np.cos(size)) * cross @ cross
        else:
            axes = kind.removeprefix("euler_")
            a, b, c = (about(axis.lower(), angle) for axis, angle in zip(axes, three, strict=True))
            turned = a @ b @ c if axes.isupper() else c @ b @ a
        force.append(mass * turned.T @ [0.0, 0.0, -9.81] + [4.0, -2.0, 7.0])
    return angles, np.array(force) + 0.02 * rng.standard_normal((count, 3))


@pytest.mark.parametrize("kind", THREE_NUMBERS)
def test_the_way_in_which_an_orientation_is_written_shows_in_the_weight(kind: str) -> None:
    angles, force = rests(kind)
    plain, _ = weight_misfits(angles, force)
    assert [each for each, left in plain.items() if left < 0.1] == [kind]
    # One rest in four in contact.
    touched = force + np.where(np.arange(len(force)) % 4 == 0, 60.0, 0.0)[:, None] * [0.0, 0.0, 1.0]
    plain, _ = weight_misfits(angles, touched)
    assert min(plain, key=lambda each: plain[each]) == kind
    # The other body's wrench, and a sensor that is a quarter turn away from the flange: ZYZ may be ZXZ then.
    _, turned = weight_misfits(angles, -force[:, [1, 0, 2]] * [1.0, -1.0, 1.0])
    assert turned[kind] < 0.1
    assert sum(left < 0.1 for left in turned.values()) <= 2


def test_what_the_weight_does_not_decide_is_named() -> None:
    # Of small angles the order does not show: all sequences with these three axes are alike.
    kind, why = read_by_weight(*rests("euler_XYZ", spread=0.01), NAMED, are_rests=True)
    assert kind == "euler_xyz"
    assert "as do" in why
    assert "euler_XYZ" in why
    angles, force = rests("euler_ZYZ")
    assert read_by_weight(angles[:4], force[:4], NAMED, are_rests=True) == NAMED
    kind, why = read_by_weight(angles, 0.01 * force[::-1], NAMED, are_rests=True)
    assert kind == "euler_xyz"
    assert "gravity may have been taken off" in why


def test_rests_are_found_among_moves() -> None:
    angles, force = rests("euler_ZYZ", count=9)
    # Each held for 100 rows, 100 rows on the way to the next.
    at = np.repeat(np.arange(8.0), 200) + np.tile(np.concatenate([np.zeros(100), np.linspace(0.0, 1.0, 100)]), 8)
    held = np.column_stack([np.interp(at, np.arange(9.0), column) for column in angles.T])
    pulled = np.column_stack([np.interp(at, np.arange(9.0), column) for column in force.T])
    pulled += 0.5 * np.random.default_rng(2).standard_normal(pulled.shape)
    kind, why = read_by_weight(held, pulled, NAMED, are_rests=False)
    assert kind == "euler_ZYZ"
    assert "quarter turn from the flange, euler_ZXZ would too" in why
