"""Inertia from moves: Newton's and Euler's laws written for point masses, and what no distribution of mass has."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from identification.payload.gravity import GravityFit, identify_gravity
from identification.payload.inertia import (
    PAIRS,
    InertiaFit,
    _model_std,
    _unfold,
    _unfold_jacobian,
    identify_inertia,
    inertia_matrix,
    inertial_sign,
    is_consistent,
    nearest_consistent,
    parameters_of,
    pseudo_inertia,
)
from identification.payload.static_poses import StaticPose, collect_static_poses
from identification.result import Status
from identification.signals.aligned import AlignedLog
from identification.signals.segments import MotionSpans, find_motion
from problems.arrays import FloatArray
from tests.identification.synthetic import ramp

RATE_HZ = 500.0
G_B = np.array([0.0, 0.0, -9.80665])
# A payload of point masses: what it weighs and how it turns follows from sums over them alone.
MASSES_KG = np.array([4.0, 3.0, 2.0, 5.0, 1.5])
POINTS_S_M = np.array([[0.1, 0.0, 0.1], [-0.12, 0.05, 0.2], [0.0, -0.15, 0.12], [0.03, 0.04, 0.3], [0.2, 0.1, 0.05]])
BIAS = np.array([4.0, -7.0, 11.0, 0.3, -0.2, 0.1])
MOVE, HOLD = round(0.8 * RATE_HZ), round(1.0 * RATE_HZ)


def true_inertia() -> FloatArray:
    square = np.sum(POINTS_S_M**2, axis=1)[:, None, None] * np.eye(3)
    return np.asarray(np.tensordot(MASSES_KG, square - POINTS_S_M[:, :, None] * POINTS_S_M[:, None, :], axes=1))


def turns(axes: FloatArray, angle_rad: float = 0.9) -> Rotation:
    """From a tool that points down to a tilt about each axis and back, at rest between the moves."""
    pieces = [np.zeros((HOLD, 3))]
    for axis in axes:
        way = angle_rad * ramp(MOVE)[:, None] * axis
        pieces += [way, np.tile(way[-1], (HOLD, 1)), way[::-1], np.zeros((HOLD, 3))]
    return Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(np.concatenate(pieces))


@dataclass(frozen=True, kw_only=True)
class Scene:
    log: AlignedLog
    motion: MotionSpans
    poses: tuple[StaticPose, ...]
    gravity: GravityFit

    def fit(self) -> InertiaFit:
        return identify_inertia(self.log, self.motion, self.poses, self.gravity)


def scene(
    orientation: Rotation,
    *,
    position_B_m: FloatArray | None = None,
    noise: float = 0.0,
    seed: int = 0,
    sign: float = 1.0,
    lag: int = 0,
    hand: FloatArray | None = None,
    origin_S_m: FloatArray | None = None,
) -> Scene:
    """Each point mass is led along its path; the sensor carries the sum of their weights less their accelerations."""
    rng = np.random.default_rng(seed)
    count = len(orientation)
    origin = np.zeros((count, 3)) if position_B_m is None else position_B_m
    offset = np.zeros(3) if origin_S_m is None else origin_S_m
    force, torque = np.zeros((count, 3)), np.zeros((count, 3))
    for mass, point in zip(MASSES_KG, POINTS_S_M, strict=True):
        path = origin + orientation.apply(point + offset)
        acceleration = np.gradient(np.gradient(path, 1.0 / RATE_HZ, axis=0), 1.0 / RATE_HZ, axis=0)
        pull = orientation.inv().apply(mass * (G_B - sign * acceleration))
        force += pull
        torque += np.cross(point, pull)
    wrench = np.hstack([force, torque]) + BIAS
    if hand is not None:
        wrench += hand
    wrench = np.roll(wrench, lag, axis=0)
    wrench += noise * rng.standard_normal(wrench.shape) * np.repeat([1.0, 0.1], 3)
    log = AlignedLog(
        start_ns=0,
        period_s=1.0 / RATE_HZ,
        time_s=np.asarray(np.arange(count) / RATE_HZ),
        force_S_n=wrench[:, :3],
        torque_S_n_m=wrench[:, 3:],
        position_B_m=origin + 1e-7 * rng.standard_normal((count, 3)),
        orientation_BS=orientation,
        pose_rate_hz=RATE_HZ,
    )
    motion = find_motion(log)
    poses = collect_static_poses(log, motion.still)
    return Scene(log=log, motion=motion, poses=poses, gravity=identify_gravity(poses))


ALL_AXES = np.array([[1.0, 0, 0], [0, 1.0, 0], [0.7, 0.7, 0], [0.5, 0, 0.8], [0, -0.6, 0.8], [0, 0, 1.0]])


def test_point_masses_have_the_tensor_of_their_sums() -> None:
    fit = scene(turns(ALL_AXES), noise=0.05).fit()
    expected = true_inertia()
    for estimate, (i, j) in zip(fit.components, PAIRS, strict=True):
        assert estimate.status is Status.IDENTIFIED
        assert estimate.value is not None
        assert estimate.std is not None
        # A fixed draw: four of the stated deviations, which hold 1 % for what a rigid model leaves out.
        assert abs(estimate.value - expected[i, j]) < 4.0 * estimate.std
        assert estimate.value == pytest.approx(expected[i, j], abs=0.005 * np.trace(expected))
    assert fit.findings == ()
    assert fit.moves == 2 * len(ALL_AXES)
    assert fit.mass_kg.status is Status.UNIDENTIFIABLE  # the origin was never accelerated
    assert abs(fit.lag_s) < 1e-3


def test_an_axis_that_nothing_turns_about_is_not_reported() -> None:
    fit = scene(turns(np.array([[1.0, 0, 0], [0, 1.0, 0], [0.7, 0.7, 0], [0.7, -0.7, 0]])), noise=0.05).fit()
    assert fit.components[0].status is Status.IDENTIFIED
    assert fit.components[1].status is Status.IDENTIFIED
    assert fit.components[2].status is Status.UNIDENTIFIABLE
    (reported,) = fit.findings
    assert reported.code == "inertia-not-excited"
    assert "zz" in reported.message
    assert "xx" not in reported.message


def test_the_mass_is_reported_by_acceleration_where_the_origin_moves() -> None:
    orientation = turns(ALL_AXES)
    there_and_back = np.concatenate([ramp(MOVE), np.ones(HOLD), ramp(MOVE)[::-1], np.zeros(HOLD)])
    leap = np.concatenate([np.zeros(HOLD), np.tile(there_and_back, len(ALL_AXES))])
    moving = scene(orientation, position_B_m=np.outer(leap, [0.15, -0.1, 0.2]), noise=0.05)
    fit = moving.fit()
    assert fit.mass_kg.status is Status.IDENTIFIED
    assert fit.mass_kg.value == pytest.approx(MASSES_KG.sum(), rel=0.01)
    assert fit.findings == ()
    # Weight and acceleration of a payload with a mass twice as large as the rests are given would disagree.
    lighter = replace(moving.gravity, mass_kg=0.8 * moving.gravity.mass_kg)
    disagreeing = identify_inertia(moving.log, moving.motion, moving.poses, lighter)
    assert "mass-disagreement" in {finding.code for finding in disagreeing.findings}
    assert all(each.status is not Status.IDENTIFIED for each in disagreeing.components)


def test_a_lag_of_the_wrench_is_reported_and_taken_out() -> None:
    fit = scene(turns(ALL_AXES), noise=0.05, lag=2).fit()
    assert fit.lag_s == pytest.approx(2.0 / RATE_HZ, abs=4.0 * fit.lag_std_s + 1e-4)
    expected = true_inertia()
    assert fit.components[0].value == pytest.approx(expected[0, 0], rel=0.02)


def test_a_pose_of_another_origin_is_reported() -> None:
    fit = scene(turns(ALL_AXES), noise=0.05, origin_S_m=np.array([0.0, 0.0, 0.1])).fit()
    (reported,) = (finding for finding in fit.findings if finding.code == "origin-offset")
    assert "+100) mm" in reported.message
    assert all(each.status is not Status.IDENTIFIED for each in fit.components)


def test_moves_that_something_touches_are_left_out() -> None:
    orientation = turns(ALL_AXES)
    hand = np.zeros((len(orientation), 6))
    first = HOLD + MOVE + HOLD  # the way back of the first tilt
    hand[first : first + MOVE, 4] = 6.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, MOVE)) ** 2
    fit = scene(orientation, noise=0.05, hand=hand).fit()
    assert fit.left_out + fit.moves <= 2 * len(ALL_AXES)
    assert fit.moves < 2 * len(ALL_AXES)
    assert fit.components[1].value == pytest.approx(true_inertia()[1, 1], rel=0.02)


def test_without_moves_nothing_is_reported() -> None:
    still = scene(turns(ALL_AXES), noise=0.05)
    fit = identify_inertia(still.log, replace(still.motion, moving=()), still.poses, still.gravity)
    assert {each.status for each in fit.components} == {Status.UNIDENTIFIABLE}
    assert [finding.code for finding in fit.findings] == ["inertia-not-excited"]


def test_the_sign_of_acceleration_shows_reversed_gravity() -> None:
    for sign in (1.0, -1.0):
        found = scene(turns(ALL_AXES), noise=0.05, sign=sign)
        score = inertial_sign(found.log, found.motion, found.poses, found.gravity)
        assert sign * score > 5.0


def test_a_tensor_that_no_payload_has_is_refused() -> None:
    found = scene(turns(ALL_AXES), noise=0.05, sign=-1.0)
    fit = found.fit()
    assert {each.status for each in fit.components} == {Status.UNIDENTIFIABLE}
    assert "inertia-unphysical" in {finding.code for finding in fit.findings}


points = st.lists(
    st.tuples(*[st.floats(-0.4, 0.4) for _ in range(3)], st.floats(0.2, 10.0)), min_size=5, max_size=9, unique=True
)


def parameters(bodies: list[tuple[float, float, float, float]]) -> FloatArray:
    at, mass = np.array([body[:3] for body in bodies]), np.array([body[3] for body in bodies])
    inertia = np.tensordot(mass, np.sum(at**2, axis=1)[:, None, None] * np.eye(3) - at[:, :, None] * at[:, None], 1)
    return np.concatenate([[mass.sum()], mass @ at, [inertia[i, j] for i, j in PAIRS]])


@pytest.mark.parametrize("about", np.eye(3))
def test_a_frame_that_is_a_few_tenths_of_a_milliradian_off_stays_within_the_deviation(about: FloatArray) -> None:
    """Products near 0 turn up from the moments beside them: by the angle times their difference."""
    tensor = np.diag([0.55, 0.52, 0.21])
    turned = Rotation.from_rotvec(3e-4 * about).as_matrix()
    off = (turned @ tensor @ turned.T - tensor)[tuple(np.transpose(PAIRS))]
    assert np.max(np.abs(off)) > 5e-6
    assert np.all(np.abs(off) <= _model_std(tensor[tuple(np.transpose(PAIRS))]))


@settings(max_examples=60, deadline=None)
@given(bodies=points)
def test_the_pseudo_inertia_is_the_second_moment_of_the_mass(bodies: list[tuple[float, float, float, float]]) -> None:
    reported = parameters(bodies)
    at = np.array([[*body[:3], 1.0] for body in bodies])
    mass = np.array([body[3] for body in bodies])
    moment = (at * mass[:, None]).T @ at
    np.testing.assert_allclose(pseudo_inertia(reported), moment, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(parameters_of(pseudo_inertia(reported)), reported, rtol=0.0, atol=1e-10)
    np.testing.assert_array_equal(inertia_matrix(reported[4:]), inertia_matrix(reported[4:]).T)
    if float(np.min(np.linalg.eigvalsh(moment))) > 1e-9:
        assert is_consistent(reported)
        nearest, distance = nearest_consistent(reported, np.eye(10))
        np.testing.assert_array_equal(nearest, reported)
        assert distance == 0.0


def test_the_nearest_consistent_tensor_is_consistent_and_stationary() -> None:
    reported = parameters(
        [(0.1, 0, 0, 1.0), (0, 0.2, 0, 1.0), (0, 0, 0.3, 2.0), (-0.1, -0.1, 0.1, 1.0), (0, 0, 0, 1.0)]
    )
    wrong = reported.copy()
    wrong[6] = 3.0 * (reported[4] + reported[5])  # no principal moment exceeds the sum of the others
    assert not is_consistent(wrong)
    std = np.concatenate([[0.1], np.full(3, 0.01), np.full(6, 0.05)])
    nearest, distance = nearest_consistent(wrong, np.diag(std**2))
    assert np.linalg.eigvalsh(pseudo_inertia(nearest))[0] > -1e-9
    assert distance == pytest.approx(float(np.sum(((nearest - wrong) / std) ** 2)), rel=1e-6)
    # No point on the way to a consistent one is both consistent and nearer: the set is convex.
    for share in np.linspace(0.02, 1.0, 50):
        between = (1.0 - share) * nearest + share * reported
        assert float(np.sum(((between - wrong) / std) ** 2)) > distance * (1.0 - 1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_the_slope_of_the_free_numbers_is_that_of_finite_differences(seed: int) -> None:
    free, step = np.random.default_rng(seed).normal(size=10), 1e-6
    reported = [
        (parameters_of(_unfold(free + change)) - parameters_of(_unfold(free - change))) / (2.0 * step)
        for change in step * np.eye(10)
    ]
    # Central differences of numbers of size 10: steps squared, and rounding over the step.
    np.testing.assert_allclose(_unfold_jacobian(free), np.array(reported).T, rtol=1e-7, atol=2e-8)


def test_parameters_and_matrix_are_each_others_inverse() -> None:
    parameters = np.array([3.0, 0.1, -0.2, 0.3, 0.5, 0.6, 0.4, 0.01, -0.02, 0.03])
    found = parameters_of(pseudo_inertia(parameters))
    # A sum and a difference of numbers below 1.
    np.testing.assert_allclose(found, parameters, rtol=0.0, atol=1e-15)


def test_a_moment_that_is_not_known_is_filled_consistently_at_no_cost() -> None:
    # 20 kg at 0.1 m along z turn about x and y; nothing turned about z, whose moment is a guess of the fit.
    reported = np.array([20.0, 0.0, 0.0, 2.0, 0.6, 0.55, -40.0, 0.0, 0.0, 0.0])
    std = np.array([0.01, 0.01, 0.01, 0.01, 2e-3, 2e-3, 100.0, 1e-3, 1e-3, 1e-3])
    found, distance = nearest_consistent(reported, np.diag(std**2))
    assert is_consistent(found)
    # A consistent moment about z lies within 0.41 standard deviations of the guess, and costs nothing else.
    assert distance < 0.41**2
    np.testing.assert_allclose(found[[0, 3, 4, 5]], reported[[0, 3, 4, 5]], rtol=0.0, atol=1e-3)
