"""Gravity, bias and centre of mass from wrenches written down by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.errors import EstimateError
from identification.payload.gravity import (
    COM_TILT_STD_RAD,
    LOCAL_GRAVITY_STD,
    _joint_covariance,
    _solve,
    identify_gravity,
    orientation_spread_rad,
)
from identification.payload.static_poses import collect_static_poses
from identification.signals.aligned import AlignedLog
from identification.signals.segments import Span
from problems.arrays import FloatArray
from tests.identification.rests import G_M_S2, PAYLOAD, Truth, poses_at
from tests.identification.synthetic import tilted

MASS_KG, COM_M = PAYLOAD.mass_kg, PAYLOAD.com_m
FORCE_BIAS_N, TORQUE_BIAS_N_M = PAYLOAD.force_bias_n, PAYLOAD.torque_bias_n_m


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
        noise_m = np.sqrt(fit.com_std_m**2 - (COM_TILT_STD_RAD * fit.com_S_m) ** 2)
        scores["com"].append((fit.com_S_m - COM_M) / noise_m)
        scores["force"].append((fit.force_bias_S_n - FORCE_BIAS_N) / fit.force_bias_std_n)
        scores["torque"].append((fit.torque_bias_S_n_m - TORQUE_BIAS_N_M) / fit.torque_bias_std_n_m)
    for name, values in scores.items():
        # A spread over 200 draws is known to 5 %. Of the widenings (Student's law 5 %, never below the noise 10 %,
        # poses that scatter unlike each other up to 20 %) each makes it smaller, none larger: four
        # deviations above, and as far below as all of them together.
        assert 0.65 < float(np.std(values)) < 1.2, name
        assert abs(float(np.mean(values))) < 4.0 / np.sqrt(draws), name


@pytest.mark.parametrize("turning_n_m_per_rad", [2e4, 1e5])
def test_a_payload_that_tilts_in_its_coupling_is_covered(turning_n_m_per_rad: float) -> None:
    """At rest the payload is turned by c × m g/K_r, which draws c towards the hanging: no rest shows it."""
    poses = []
    for pose in poses_at(tilted(9, 1.0)):
        weight = MASS_KG * pose.gravity_S_m_s2
        turned = Rotation.from_rotvec(np.cross(COM_M, weight) / turning_n_m_per_rad).apply(COM_M)
        poses.append(replace(pose, torque_S_n_m=np.cross(turned, weight) + TORQUE_BIAS_N_M))
    fit = identify_gravity(tuple(poses))
    error = fit.com_S_m - COM_M
    assert np.max(np.abs(error / fit.com_std_m)) < 2.0
    # It is far from nothing: without a share of the lever in the deviations they would not hold the truth.
    assert np.linalg.norm(error) > 0.2 * np.linalg.norm(COM_M) ** 2 * MASS_KG * G_M_S2 / turning_n_m_per_rad


def test_one_pose_shows_nothing() -> None:
    alike = poses_at(Rotation.concatenate([tilted(1, 0.0)] * 6))
    with pytest.raises(
        EstimateError,
        match=r"at least 4 clearly different tool orientations, each at rest for 0.7 s or more, found 1; record",
    ):
        identify_gravity(alike)


def test_no_rest_at_all_is_reported() -> None:
    with pytest.raises(EstimateError, match="never at rest in this log; record"):
        identify_gravity(())


def test_poses_that_hardly_tilt_are_refused_and_reported_to_tilt() -> None:
    angles = np.radians(2.0) * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1]])
    turns = np.column_stack([angles, np.zeros(len(angles))])
    with pytest.raises(EstimateError, match="tilted by 30 to 70 degrees about two axes"):
        identify_gravity(poses_at(Rotation.from_rotvec(turns)))


def test_a_flipped_sign_is_refused() -> None:
    with pytest.raises(EstimateError, match="opposite sign") as caught:
        identify_gravity(poses_at(tilted(8, 1.0), sign=-1.0))
    assert f"{-MASS_KG:.3f} kg" in str(caught.value)


def test_a_centre_of_mass_out_of_reach_is_refused() -> None:
    with pytest.raises(EstimateError, match=r"2\.59 m .* for 16\.200 ± .* torque unit"):
        identify_gravity(poses_at(tilted(8, 1.0), truth=Truth(com_m=np.array([0.0, 0.0, 2.59]))))


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


def test_the_covariance_holds_between_the_parameters() -> None:
    draws, orientation, rng = 400, tilted(9, 1.0), np.random.default_rng(8)
    found = []
    for _ in range(draws):
        fit = identify_gravity(poses_at(orientation, rng, noise_n=3.0, torque_noise_n_m=0.3))
        found.append(np.concatenate([[fit.mass_kg], fit.com_S_m, fit.force_bias_S_n, fit.torque_bias_S_n_m]))
    stated = fit.covariance - np.diag([(LOCAL_GRAVITY_STD * fit.mass_kg) ** 2, *np.zeros(9)])
    stated[1:4, 1:4] -= COM_TILT_STD_RAD**2 * np.outer(fit.com_S_m, fit.com_S_m)
    size = np.sqrt(np.diag(stated))
    reported, seen = stated / np.outer(size, size), np.corrcoef(np.array(found), rowvar=False)
    # A correlation over 400 draws is known to 0.05; four deviations and what the fit's own scatter moves it.
    assert float(np.max(np.abs(reported - seen))) < 0.25
    assert float(np.max(np.abs(reported - np.eye(10)))) > 0.5  # mass and bias, bias and centre are not independent
    assert fit.mass_std_kg == pytest.approx(np.sqrt(fit.covariance[0, 0]), rel=1e-12)


def test_contacts_in_one_orientation_do_not_outvote_the_others() -> None:
    sound = poses_at(tilted(6, 1.0))
    pressing = np.array([0.0, 0.0, -30.0])
    contacts = tuple(replace(p, force_S_n=p.force_S_n + pressing) for p in sound[:1] * 12)
    fit = identify_gravity(sound + contacts)
    assert fit.rejected == 12
    assert fit.inliers == (0, 1, 2, 3, 4, 5)
    assert fit.mass_kg == pytest.approx(MASS_KG, rel=1e-12)


def test_a_pure_torque_by_a_hand_is_left_out() -> None:
    sound = poses_at(tilted(9, 1.0))
    twisted = replace(sound[4], torque_S_n_m=sound[4].torque_S_n_m + np.array([0.0, 2.0, 0.0]))
    fit = identify_gravity((*sound[:4], twisted, *sound[5:]))
    assert fit.rejected == 1
    np.testing.assert_allclose(fit.com_S_m, COM_M, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("split", [3, 6, 9])
def test_a_tare_between_rests_splits_the_bias_and_nothing_else(split: int) -> None:
    step_n, step_n_m = np.array([-4.0, 7.0, -11.0]), np.array([-0.3, 0.2, -0.1])
    poses = tuple(
        replace(p, force_S_n=p.force_S_n + step_n, torque_S_n_m=p.torque_S_n_m + step_n_m) if i >= split else p
        for i, p in enumerate(poses_at(tilted(12, 1.0)))
    )
    fit = identify_gravity(poses)
    assert fit.rejected == 0
    assert fit.bias_step is not None
    assert fit.bias_step.after_s == poses[split - 1].time_s
    assert fit.mass_kg == pytest.approx(MASS_KG, rel=1e-11)
    np.testing.assert_allclose(fit.force_bias_S_n, FORCE_BIAS_N + step_n, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(fit.bias_step.force_before_S_n, -step_n, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(fit.bias_step.torque_before_S_n_m, -step_n_m, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(fit.com_S_m, COM_M, rtol=0.0, atol=1e-11)


def test_a_tare_is_taken_out_on_both_sides_of_it() -> None:
    rng = np.random.default_rng(6)
    log = log_of(tilted(8, 1.0), 1.0, 500.0, rng)
    half = 4 * 500
    log.force_S_n[half:] += np.array([5.0, -3.0, 8.0])
    log.torque_S_n_m[half:] += np.array([0.5, 0.1, -0.2])
    fit = identify_gravity(collect_static_poses(log, tuple(Span(start=500 * i, stop=500 * (i + 1)) for i in range(8))))
    assert fit.bias_step is not None
    assert fit.bias_step.sample == half
    left = fit.compensated_force_S_n(log)
    assert float(np.sqrt(np.mean(left**2))) == pytest.approx(0.2, rel=0.03)  # 12000 numbers: 1 %
    assert float(np.max(np.abs(fit.compensated_torque_S_n_m(log)))) < 1e-6 + 5.0 * float(np.max(fit.com_std_m)) * 160.0


@pytest.mark.parametrize("axis", [0, 1])
def test_tilts_about_one_axis_show_mass_and_only_then_a_centre_if_they_are_large(axis: int) -> None:
    down = Rotation.from_euler("x", np.pi)
    small = down * Rotation.from_rotvec(np.outer(np.linspace(-0.35, 0.35, 8), np.eye(3)[axis]))
    fit = identify_gravity(poses_at(small))
    assert fit.mass_kg == pytest.approx(MASS_KG, rel=1e-11)
    assert not fit.com_is_excited
    assert identify_gravity(poses_at(tilted(8, 1.0))).com_is_excited


def test_a_centre_that_the_torques_do_not_show_is_unknown_and_the_mass_keeps_its_deviation() -> None:
    # One orientation: torque and bias are one column times a constant each.
    rows, alike = np.tile(np.concatenate([np.diag([1.0, 2.0, 3.0]), np.eye(3)], axis=1), (5, 1, 1)), np.arange(5)
    torque = _solve(rows, np.ones((5, 3)), alike, [1e-3] * 5, 3)
    assert torque.condition == np.inf
    force = np.diag([0.04, 0.1, 0.2, 0.3])
    covariance = _joint_covariance(MASS_KG, np.zeros(3), force, torque.covariance)
    expected = [0.04 + (LOCAL_GRAVITY_STD * MASS_KG) ** 2, *[np.inf] * 3, 0.1, 0.2, 0.3, *[np.inf] * 3]
    np.testing.assert_allclose(np.diag(covariance), expected, rtol=1e-15)
    assert not np.any(covariance[~np.eye(10, dtype=bool)])


def test_a_far_centre_that_small_tilts_suggest_is_no_reason_to_refuse_the_mass() -> None:
    far = Truth(com_m=np.array([0.0, 0.0, 2.0]))
    down = Rotation.from_euler("x", np.pi)
    small = down * Rotation.from_rotvec(np.outer(np.linspace(-0.35, 0.35, 8), [1.0, 0.0, 0.0]))
    fit = identify_gravity(poses_at(small, truth=far))
    assert not fit.com_is_excited
    assert fit.mass_kg == pytest.approx(MASS_KG, rel=1e-11)
    with pytest.raises(EstimateError, match=r"The centre of mass comes out 2\.00 m"):
        identify_gravity(poses_at(tilted(8, 1.0), truth=far))


def test_a_mass_that_its_own_deviation_covers_is_refused() -> None:
    rng = np.random.default_rng(2)
    weak = tuple(
        replace(p, force_S_n=p.force_S_n + 8.0 * rng.standard_normal(3))
        for p in poses_at(tilted(8, 1.0), truth=Truth(mass_kg=0.3))
    )
    with pytest.raises(EstimateError, match=r"hardly changes with the tool's orientation \(it would be -?\d\.\d+ ± "):
        identify_gravity(weak)


def test_the_light_tool_with_a_far_centre_is_refused() -> None:
    light = poses_at(tilted(8, 1.0), truth=Truth(mass_kg=0.072, com_m=np.array([0.0, 0.0, 2.59])))
    with pytest.raises(EstimateError, match=r"0\.072 ± 0\.000 kg"):
        identify_gravity(light)


def test_slow_noise_counts_for_more_than_white_noise_of_the_same_size() -> None:
    rng = np.random.default_rng(11)
    log = log_of(tilted(4, 1.0), 4.0, 500.0, rng)
    spans = tuple(Span(start=2000 * i, stop=2000 * (i + 1)) for i in range(4))
    white = collect_static_poses(log, spans)
    slow = np.repeat(0.2 * rng.standard_normal((len(log) // 100, 3)), 100, axis=0)
    log.force_S_n[:] += slow
    coloured = collect_static_poses(log, spans)
    # 1880 white samples against 19 independent values: ten times, known to a factor from 7 × 3 degrees of freedom.
    for before, after in zip(white, coloured, strict=True):
        assert before.force_mean_std_n == pytest.approx(0.2 / np.sqrt(1880), rel=0.6)
        assert after.force_mean_std_n > 4.0 * before.force_mean_std_n


def test_the_spread_of_orientations_is_the_largest_turn_from_their_mean() -> None:
    turns = Rotation.from_rotvec([[-0.1, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    assert orientation_spread_rad(turns) == pytest.approx(0.1, rel=1e-9)
