"""Orientations: what they tell, that the chosen ones tell more than others, and that small tilts are refused."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.errors import EstimateError
from identification.experiment_design.poses import (
    LARGEST_CONDITION,
    PosePlan,
    design_condition,
    naive_turns,
    plan_poses,
    pose_information,
    pose_rows,
    predicted_std,
    smallest_tilt_deg,
)
from identification.experiment_design.values import Known, PlanValues, usual_values
from identification.payload import gravity
from identification.payload.gravity import LOCAL_GRAVITY_STD, identify_gravity
from tests.identification.rests import PAYLOAD, SAMPLES, poses_at

DOWN = Rotation.from_euler("xz", [np.pi, 0.7])


def noisy(force_n: float = 10.0, torque_n_m: float = 1.0) -> PlanValues:
    """White noise alone, large enough to hide that local gravity is not known."""
    return replace(
        usual_values(mass_kg=PAYLOAD.mass_kg),
        com_m=Known(value=float(np.linalg.norm(PAYLOAD.com_m))),
        force_noise_rms_n=Known(value=force_n),
        torque_noise_rms_n_m=Known(value=torque_n_m),
        pose_force_std_n=Known(value=1e-9),
        pose_torque_std_n_m=Known(value=1e-9),
        sample_time_s=Known(value=1.0 / SAMPLES),
    )


def planned(values: PlanValues, count: int, tilt: float) -> PosePlan:
    plan = plan_poses(values, count=count, max_tilt_deg=tilt)
    assert plan is not None
    return plan


def log_det(turns: Rotation, values: PlanValues) -> float:
    return float(np.linalg.slogdet(pose_information(turns, values, 1.0).sum(axis=0))[1])


@pytest.mark.parametrize("tilt", [15.0, 30.0, 60.0, 90.0])
@pytest.mark.parametrize("count", [6, 9, 12])
def test_the_plan_beats_equal_steps_and_random_poses(count: int, tilt: float) -> None:
    values, rng = usual_values(), np.random.default_rng(3)
    plan = planned(values, count, tilt)
    chosen = log_det(Rotation.from_quat(plan.quaternion_xyzw), values)
    assert chosen > log_det(naive_turns(count, tilt), values)
    assert plan.mass_std_kg < plan.naive_mass_std_kg
    angle, axis = np.radians(tilt) * np.sqrt(rng.random((200, count))), 2.0 * np.pi * rng.random((200, count))
    for a, b in zip(angle, axis, strict=True):
        turns = Rotation.from_rotvec(np.column_stack([a * np.cos(b), a * np.sin(b), np.zeros(count)]))
        assert chosen > log_det(turns, values)


def test_what_is_predicted_is_the_scatter_of_least_squares() -> None:
    values, rng = noisy(), np.random.default_rng(5)
    plan = planned(values, 8, 45.0)
    turns = Rotation.from_quat(plan.quaternion_xyzw) * DOWN
    force, torque = pose_rows(turns)
    mass, moment = [], []
    for _ in range(600):
        noise = rng.standard_normal((2, 8 * 3)) * np.array([[10.0], [1.0]]) / np.sqrt(SAMPLES)
        mass.append(np.linalg.lstsq(force.reshape(-1, 4), noise[0], rcond=None)[0][0])
        moment.append(np.linalg.lstsq(torque.reshape(-1, 6), noise[1], rcond=None)[0][:3])
    alone = float(np.sqrt(plan.mass_std_kg**2 - (LOCAL_GRAVITY_STD * PAYLOAD.mass_kg) ** 2))
    # The deviation of 600 draws is itself known to 2.9 %: three of those.
    assert np.std(mass) == pytest.approx(alone, rel=0.09)
    com = np.hypot(np.std(moment, axis=0), np.abs(PAYLOAD.com_m) * np.std(mass)) / PAYLOAD.mass_kg
    assert plan.com_std_m >= 0.91 * np.max(com)
    assert plan.com_std_m <= 1.4 * np.max(com)  # the plan does not know which component turns up where


def test_identification_states_what_was_predicted() -> None:
    values = noisy()
    plan = planned(values, 9, 60.0)
    turns = Rotation.from_quat(plan.quaternion_xyzw) * DOWN
    for seed in range(5):
        rng = np.random.default_rng(seed)
        fit = identify_gravity(poses_at(turns, rng, noise_n=10.0, torque_noise_n_m=1.0))
        assert 0.5 < fit.mass_std_kg / plan.mass_std_kg < 2.0
        assert 0.5 < np.max(fit.com_std_m) / plan.com_std_m < 2.0
        assert fit.pose_count == 9


def test_two_degrees_are_refused_by_plan_and_by_identification_alike() -> None:
    values = noisy(force_n=0.1, torque_n_m=0.01)
    assert plan_poses(values, count=9, max_tilt_deg=2.0) is None
    few = plan_poses(values, count=4, max_tilt_deg=3.0)
    assert few is not None
    assert not few.is_excited
    with pytest.raises(EstimateError):
        identify_gravity(
            poses_at(Rotation.from_quat(few.quaternion_xyzw) * DOWN, np.random.default_rng(1), noise_n=0.1)
        )
    assert gravity._LARGEST_CONDITION == LARGEST_CONDITION


def test_the_smallest_tilt_that_would_do_does_and_five_degrees_less_do_not() -> None:
    values, asked = usual_values(), {"mass_std_kg": 0.3, "com_std_m": 2e-3}
    tilt = smallest_tilt_deg(values, count=6, **asked)
    assert tilt is not None
    assert tilt > 10.0
    good, bad = planned(values, 6, tilt), planned(values, 6, tilt - 5.0)
    assert good.mass_std_kg <= 0.3
    assert good.com_std_m <= 2e-3
    assert bad.mass_std_kg > 0.3 or bad.com_std_m > 2e-3
    assert smallest_tilt_deg(values, count=6, mass_std_kg=1e-6, com_std_m=1e-9) is None


def test_the_reference_orientation_does_not_matter() -> None:
    values = noisy()
    turns = Rotation.from_quat(planned(values, 7, 50.0).quaternion_xyzw)
    for reference in Rotation.random(5, random_state=11):
        assert predicted_std(turns * reference, values)[0] == pytest.approx(predicted_std(turns, values)[0], rel=1e-9)
        assert design_condition(turns * reference) == pytest.approx(design_condition(turns), rel=1e-9)


def test_the_quaternions_tilt_by_what_the_table_says_about_horizontal_axes() -> None:
    plan = planned(usual_values(), 9, 35.0)
    turns = Rotation.from_quat(plan.quaternion_xyzw)
    np.testing.assert_allclose(np.degrees(turns.magnitude()), plan.tilt_deg, atol=1e-9)
    np.testing.assert_allclose(turns.as_rotvec()[:, 2], 0.0, atol=1e-12)
    vertical = turns.apply([0.0, 0.0, 1.0])
    np.testing.assert_allclose(np.degrees(np.arccos(vertical[:, 2])), plan.tilt_deg, atol=1e-6)
    assert np.all(plan.tilt_deg <= 35.0 + 1e-9)


def test_the_path_is_shorter_than_the_same_poses_in_random_order() -> None:
    turns = list(Rotation.from_quat(planned(usual_values(), 10, 60.0).quaternion_xyzw))
    rng = np.random.default_rng(2)

    def length(order: list[int]) -> float:
        path = [Rotation.identity(), *[turns[i] for i in order]]
        return sum(float((a.inv() * b).magnitude()) for a, b in pairwise(path))

    own = length(list(range(10)))
    assert all(own <= length(list(rng.permutation(10))) for _ in range(300))


def test_what_is_known_already_counts() -> None:
    values = noisy()
    knows = replace(values, mass_kg=Known(value=PAYLOAD.mass_kg, std=0.03), com_m=Known(value=0.14, std=2e-4))
    before, after = planned(values, 6, 30.0), planned(knows, 6, 30.0)
    assert after.mass_std_kg < min(before.mass_std_kg, 0.03)
    assert after.com_std_m < before.com_std_m
    # Local gravity is in every recording: no number of poses takes it away.
    assert after.mass_std_kg > LOCAL_GRAVITY_STD * PAYLOAD.mass_kg
