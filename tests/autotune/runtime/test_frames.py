import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from autotune.runtime.frames import LARGEST_WAY, Nine, Place, external_wrench, is_rotation, way_between
from tests.autotune.runtime.cases import PAYLOAD

vectors = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


def nine(matrix: np.ndarray) -> Nine:
    a, b, c, d, e, f, g, h, i = map(float, matrix.ravel())
    return a, b, c, d, e, f, g, h, i


def place(position: np.ndarray, rotation: Rotation) -> Place:
    x, y, z = position.tolist()
    return (x, y, z), nine(rotation.as_matrix())


@settings(max_examples=60)
@given(start=vectors, rotvec=vectors, path=vectors, turn=vectors)
def test_the_way_is_the_vector_and_the_rotation_in_the_sensor_frame(
    start: tuple[float, ...], rotvec: tuple[float, ...], path: tuple[float, ...], turn: tuple[float, ...]
) -> None:
    before, way = Rotation.from_rotvec(3.0 * np.array(rotvec)), 0.05 * np.array([*path, *turn])
    now = before * Rotation.from_rotvec(way[3:])
    found = way_between(place(np.array(start), before), place(np.array(start) + now.apply(way[:3]), now))
    assert found is not None
    # The series leaves out 2e-13 rad at the largest way; positions of 1 m are rounded to 1e-16.
    np.testing.assert_allclose(found, way, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("share", [0.999, 1.001])
@pytest.mark.parametrize("axis", range(6))
def test_a_way_is_refused_from_the_largest_on(axis: int, share: float) -> None:
    way = np.zeros(6)
    # The limit on an angle is on its sine.
    way[axis] = share * (LARGEST_WAY if axis < 3 else np.arcsin(LARGEST_WAY))
    start = Rotation.from_rotvec([0.3, -0.2, 1.0])
    now = start * Rotation.from_rotvec(way[3:])
    found = way_between(place(np.zeros(3), start), place(now.apply(way[:3]), now))
    assert (found is None) == (share > 1.0)


@settings(max_examples=60)
@given(rotvec=vectors, force=vectors, torque=vectors)
def test_weight_and_bias_are_taken_off_in_any_pose(
    rotvec: tuple[float, ...], force: tuple[float, ...], torque: tuple[float, ...]
) -> None:
    rotation, reported = Rotation.from_rotvec(3.0 * np.array(rotvec)), np.array([*force, *torque])
    weight = 16.0 * rotation.inv().apply([0.0, 0.0, -9.80665])
    moment = np.cross(PAYLOAD.com_S_m, weight)
    raw = reported + np.array([*(weight + PAYLOAD.force_bias_S_n), *(moment + PAYLOAD.torque_bias_S_n_m)])
    a, b, c, d, e, f = map(float, raw)
    left = external_wrench(PAYLOAD, (a, b, c, d, e, f), nine(rotation.as_matrix()))
    np.testing.assert_allclose(left, reported, rtol=0.0, atol=1e-12)


def test_what_is_no_rotation() -> None:
    good = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    assert is_rotation(nine(good))
    # Orientations of single precision are good enough.
    assert is_rotation(nine(np.array(good, dtype=np.float32)))
    swapped = good[:, [1, 0, 2]]
    skewed = np.array(good + np.diag([0.0, 0.01, 0.0]))
    wrong: tuple[np.ndarray, ...] = (np.zeros((3, 3)), -good, np.array(1.001 * good), swapped, skewed)
    for bad in wrong:
        assert not is_rotation(nine(bad))
