"""Turning and slerp by columns against the rotation library."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from identification.signals.recording import slerp, turn_vectors_rad, turned_rad
from problems.arrays import FloatArray


def walk(count: int, largest_rad: float, seed: int = 0) -> FloatArray:
    """Orientations one turn of up to `largest_rad` after the other, with quaternions of either sign."""
    rng = np.random.default_rng(seed)
    turn, found = Rotation.random(rng=rng), []
    for sign in rng.choice([-1.0, 1.0], count):
        found.append(sign * turn.as_quat())
        turn = turn * Rotation.from_rotvec(largest_rad * rng.uniform(-0.5, 0.5, 3))
    return np.array(found)


@pytest.mark.parametrize("largest_rad", [1e-9, 1e-6, 1e-2, 1.0, 3.0])
def test_the_angle_between_orientations_is_the_librarys(largest_rad: float) -> None:
    turns = walk(300, largest_rad)
    before, after = Rotation.from_quat(turns[:-1]), Rotation.from_quat(turns[1:])
    # Some roundings of numbers of size 1, whatever the angle: no cosine takes part.
    np.testing.assert_allclose(
        turned_rad(turns[:-1], turns[1:]), (before.inv() * after).magnitude(), rtol=0.0, atol=2e-15
    )


@pytest.mark.parametrize("largest_rad", [0.0, 1e-9, 1e-6, 1e-2, 1.0, 3.0])
def test_the_turn_between_orientations_is_the_librarys_vector(largest_rad: float) -> None:
    turns = walk(300, largest_rad)
    before, after = Rotation.from_quat(turns[:-1]), Rotation.from_quat(turns[1:])
    # Some roundings of numbers of size 1, times the largest angle.
    np.testing.assert_allclose(
        turn_vectors_rad(turns[:-1], turns[1:]), (before.inv() * after).as_rotvec(), rtol=0.0, atol=4e-15
    )


def test_what_rests_turns_by_nothing() -> None:
    rests = np.tile([0.0, 0.0, 0.0, 1.0], (3, 1))
    np.testing.assert_array_equal(turn_vectors_rad(rests, rests), np.zeros((3, 3)))


@pytest.mark.parametrize("largest_rad", [0.0, 1e-7, 1e-3, 1.0])
def test_slerp_is_the_librarys(largest_rad: float) -> None:
    turns, rng = walk(50, largest_rad), np.random.default_rng(1)
    time = np.cumsum(rng.uniform(0.5, 1.5, 50))
    at = np.concatenate([time, rng.uniform(time[0], time[-1], 200)])
    found, expected = Rotation.from_quat(slerp(time, turns, at)), Slerp(time, Rotation.from_quat(turns))(at)
    assert np.max((found.inv() * expected).magnitude()) < 1e-14


def test_slerp_goes_half_the_way_in_half_the_time() -> None:
    quarter = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2.0]]).as_quat()
    (half,) = slerp(np.array([0.0, 1.0]), quarter * np.array([[1.0], [-1.0]]), np.array([0.5]))
    np.testing.assert_allclose(half, [0.0, 0.0, np.sin(np.pi / 8.0), np.cos(np.pi / 8.0)], rtol=0.0, atol=1e-15)


def test_slerp_leaves_its_input_alone() -> None:
    turns = walk(5, 1.0)
    before = turns.copy()
    slerp(np.arange(5.0), turns, np.array([0.5, 3.5]))
    np.testing.assert_array_equal(turns, before)
