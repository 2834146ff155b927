"""Gravity, bias and centre of mass from wrenches written down by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identification.aligned import AlignedLog
from identification.errors import EstimateError
from identification.gravity import (
    LOCAL_GRAVITY_STD,
    StaticPose,
    collect_static_poses,
    identify_gravity,
    orientation_spread_rad,
)
from identification.segments import Span
from tests.identification.synthetic import tilted

FloatArray = NDArray[np.float64]

G_M_S2 = 9.80665
MASS_KG = 16.2
COM_M = np.array([0.02, -0.015, 0.14])
FORCE_BIAS_N = np.array([4.0, -7.0, 11.0])
TORQUE_BIAS_N_M = np.array([0.3, -0.2, 0.1])
SAMPLES = 1000


def poses_at(
    orientation: Rotation,
    rng: np.random.Generator | None = None,
    *,
    noise_n: float = 0.0,
    torque_noise_n_m: float = 0.0,
    com_m: FloatArray = COM_M,
    sign: float = 1.0,
) -> tuple[StaticPose, ...]:
    """Rests of `SAMPLES` samples; the means carry noise over its square root."""
    found = []
    for turn in orientation:
        gravity = turn.as_matrix().T @ np.array([0.0, 0.0, -G_M_S2])
        force, torque = MASS_KG * gravity + FORCE_BIAS_N, np.cross(com_m, MASS_KG * gravity) + TORQUE_BIAS_N_M
        if rng is not None:
            force = force + noise_n / np.sqrt(SAMPLES) * rng.standard_normal(3)
            torque = torque + torque_noise_n_m / np.sqrt(SAMPLES) * rng.standard_normal(3)
        found.append(
            StaticPose(
                span=Span(start=0, stop=SAMPLES),
                gravity_S_m_s2=gravity,
                force_S_n=sign * force,
                torque_S_n_m=sign * torque,
                force_noise_n=noise_n,
            )
        )
    return tuple(found)


def test_without_noise_the_truth_comes_back_exactly() -> None:
    fit = identify_gravity(poses_at(tilted(8, 1.0)))
    # Rounding of numbers near 160 N times a condition number near 3.
    assert fit.mass_kg == pytest.approx(MASS_KG, rel=1e-12)
    np.testing.assert_allclose(fit.com_S_m, COM_M, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(fit.force_bias_S_n, FORCE_BIAS_N, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(fit.torque_bias_S_n_m, TORQUE_BIAS_N_M, rtol=0.0, atol=1e-11)
    assert (fit.pose_count, fit.rejected) == (8, 0)
    assert fit.residual_rms_n < 1e-11


def test_gravity_that_is_not_known_stays_in_the_masss_deviation() -> None:
    fit = identify_gravity(poses_at(tilted(8, 1.0)))
    assert fit.mass_std_kg == pytest.approx(LOCAL_GRAVITY_STD * MASS_KG, rel=1e-6)
    # 9.780 at the equator and 9.832 at the poles lie within two deviations of the standard value.
    assert max(G_M_S2 - 9.780, 9.832 - G_M_S2) < 2.0 * LOCAL_GRAVITY_STD * G_M_S2


@pytest.mark.parametrize("push_n", [3.0, 30.0, 200.0])
def test_rests_that_something_touches_are_left_out(push_n: float) -> None:
    sound = poses_at(tilted(9, 1.0))
    touched = tuple(replace(p, force_S_n=p.force_S_n + np.array([-push_n, 0.2 * push_n, 0.0])) for p in sound[:1] * 4)
    fit = identify_gravity(sound + touched)
    assert fit.rejected == 4
    # Nothing of the touched rests may be left: the same digits as without them.
    assert fit.mass_kg == pytest.approx(MASS_KG, rel=1e-12)
    np.testing.assert_allclose(fit.force_bias_S_n, FORCE_BIAS_N, rtol=0.0, atol=1e-11)


def test_stated_deviations_are_those_that_repetition_shows() -> None:
    draws, orientation, rng = 200, tilted(9, 1.0), np.random.default_rng(21)
    scores: dict[str, list[FloatArray]] = {"mass": [], "com": [], "force": [], "torque": []}
    for _ in range(draws):
        fit = identify_gravity(poses_at(orientation, rng, noise_n=0.3, torque_noise_n_m=0.02))
        from_fit = np.sqrt(fit.mass_std_kg**2 - (LOCAL_GRAVITY_STD * fit.mass_kg) ** 2)
        scores["mass"].append(np.array([fit.mass_kg - MASS_KG]) / from_fit)
        scores["com"].append((fit.com_S_m - COM_M) / fit.com_std_m)
        scores["force"].append((fit.force_bias_S_n - FORCE_BIAS_N) / fit.force_bias_std_n)
        scores["torque"].append((fit.torque_bias_S_n_m - TORQUE_BIAS_N_M) / fit.torque_bias_std_n_m)
    for name, values in scores.items():
        # A spread over 200 draws is known to 5 %; 23 degrees of freedom in the variance add 5 % at most, and never
        # going below the noise takes up to 10 % away. Four deviations around that.
        assert 0.75 < float(np.std(values)) < 1.25, name
        assert abs(float(np.mean(values))) < 4.0 / np.sqrt(draws), name


def test_one_pose_tells_nothing() -> None:
    alike = poses_at(Rotation.concatenate([tilted(1, 0.0)] * 6))
    with pytest.raises(
        EstimateError,
        match=r"at least 4 clearly different tool orientations, each at rest for 0.7 s or more, found 1; record",
    ):
        identify_gravity(alike)


def test_no_rest_at_all_is_told() -> None:
    with pytest.raises(EstimateError, match="never at rest in this log; record"):
        identify_gravity(())


def test_poses_that_hardly_tilt_are_refused_and_told_to_tilt() -> None:
    angles = np.radians(2.0) * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]])
    turns = np.column_stack([angles, np.zeros(len(angles))])
    with pytest.raises(EstimateError, match="tilted by 30 to 70 degrees about two axes"):
        identify_gravity(poses_at(Rotation.from_rotvec(turns)))


def test_a_flipped_sign_is_refused() -> None:
    with pytest.raises(EstimateError, match="opposite sign") as caught:
        identify_gravity(poses_at(tilted(8, 1.0), sign=-1.0))
    assert f"{-MASS_KG:.3f} kg" in str(caught.value)


def test_a_centre_of_mass_out_of_reach_is_refused() -> None:
    with pytest.raises(EstimateError, match=r"2\.59 m .* torque unit"):
        identify_gravity(poses_at(tilted(8, 1.0), com_m=np.array([0.0, 0.0, 2.59])))


def test_rests_that_fit_no_common_mass_are_refused() -> None:
    sound = poses_at(tilted(4, 1.0))
    touched = replace(sound[1], force_S_n=sound[1].force_S_n + np.array([0.0, 0.0, -150.0]))
    with pytest.raises(EstimateError, match=r"Of 4 rests, 1 do not fit one payload mass; .* nothing touching"):
        identify_gravity((sound[0], touched, *sound[2:]))


def test_scatter_that_noise_does_not_explain_widens_the_deviation() -> None:
    rng = np.random.default_rng(3)
    shaken = tuple(
        replace(pose, force_S_n=pose.force_S_n + 40.0 * rng.standard_normal(3)) for pose in poses_at(tilted(8, 1.0))
    )
    fit = identify_gravity(shaken)
    assert fit.residual_rms_n > 20.0
    assert fit.mass_std_kg > 0.05 * fit.mass_kg  # no longer `identified`
    assert abs(fit.mass_kg - MASS_KG) < 5.0 * fit.mass_std_kg


def log_of(orientation: Rotation, seconds: float, rate_hz: float, rng: np.random.Generator) -> AlignedLog:
    """One rest after the other, without the moves between them."""
    each = round(seconds * rate_hz)
    turns = Rotation.from_quat(np.repeat(orientation.as_quat(), each, axis=0))
    gravity = turns.inv().apply([0.0, 0.0, -G_M_S2])
    return AlignedLog(
        start_ns=0,
        period_s=1.0 / rate_hz,
        time_s=np.arange(len(gravity)) / rate_hz,
        force_S_n=MASS_KG * gravity + FORCE_BIAS_N + 0.2 * rng.standard_normal(gravity.shape),
        torque_S_n_m=np.cross(COM_M, MASS_KG * gravity) + TORQUE_BIAS_N_M,
        position_B_m=np.zeros((len(gravity), 3)),
        orientation_BS=turns,
        pose_rate_hz=rate_hz,
    )


def test_rests_are_averaged_without_their_edges() -> None:
    log = log_of(tilted(6, 1.0), 1.0, 500.0, np.random.default_rng(5))
    spans = tuple(Span(start=500 * i, stop=500 * (i + 1)) for i in range(6))
    poses = collect_static_poses(log, (*spans, Span(start=0, stop=100)))
    assert len(poses) == 6  # 100 samples are gone when 0.12 s are cut off on both sides
    for pose in poses:
        # 380 samples of 0.2 N: the mean is known to 0.01 N, the spread to 4 %.
        np.testing.assert_allclose(pose.force_S_n, MASS_KG * pose.gravity_S_m_s2 + FORCE_BIAS_N, rtol=0.0, atol=0.05)
        assert pose.force_noise_n == pytest.approx(0.2, rel=0.12)
    fit = identify_gravity(poses)
    rest = fit.compensated_force_S_n(log)
    assert float(np.sqrt(np.mean(rest**2))) == pytest.approx(0.2, rel=0.03)  # 9000 numbers: 1 %
    assert fit.noise_rms_n == pytest.approx(0.2, rel=0.05)


def test_a_payload_that_comes_alone_is_no_number_of_poses() -> None:
    many = poses_at(Rotation.concatenate([tilted(4, 1.0)] * 3))
    assert identify_gravity(many).pose_count == 4


def test_the_spread_of_orientations_is_the_largest_turn_from_their_mean() -> None:
    turns = Rotation.from_rotvec([[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert orientation_spread_rad(turns) == pytest.approx(0.1, rel=1e-9)
