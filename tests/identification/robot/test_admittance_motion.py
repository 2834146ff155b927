"""What an admittance asks of the robot, and what the robot did."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from identification.errors import EstimateError
from identification.robot.admittance_motion import admittance_motions
from identification.signals.recording import GainsSignal, WrenchSignal
from tests.identification.led_robot import (
    DAMPING_N_S_PER_M,
    LOG_S,
    MASS_KG,
    ONE_POLE,
    TOOL_DOWN,
    Led,
    hand_force,
    led,
    recorded,
)

SAMPLES = 1000
TIME_S = np.arange(SAMPLES) * LOG_S


def standing(force: float | np.ndarray = 0.0) -> Led:
    return Led(force_n=np.zeros(SAMPLES) + force, position_m=np.zeros(SAMPLES))


def test_a_ramp_of_force_gives_the_closed_form() -> None:
    asked = admittance_motions(recorded(standing(5.0 * TIME_S)))[0].asked_m_s
    tau = MASS_KG / DAMPING_N_S_PER_M
    expected = 5.0 / DAMPING_N_S_PER_M * (TIME_S - tau * (1.0 - np.exp(-TIME_S / tau)))
    # Exact for a force that is linear between samples; a thousand steps of rounding are left.
    np.testing.assert_allclose(asked, expected, rtol=0.0, atol=1e-13)


def test_gains_hold_from_one_message_to_the_next() -> None:
    recording = recorded(standing(10.0))
    late = recording.wrench.stamp_ns[[0, 500]]
    gains = GainsSignal(
        topic="/gains",
        stamp_ns=late,
        mass=np.array([[12.0] * 6, [60.0] * 6]),
        damping=np.array([[900.0] * 6, [400.0] * 6]),
    )
    asked = admittance_motions(replace(recording, gains=gains))[0].asked_m_s
    behind = solve_ivp(
        lambda _, v: (10.0 - 400.0 * v) / 60.0, (0.0, 2.4), [10.0 / 900.0], t_eval=TIME_S[:480], rtol=1e-10, atol=1e-14
    )
    np.testing.assert_allclose(asked[:501], 10.0 / 900.0, rtol=1e-12)
    np.testing.assert_allclose(asked[500:980], behind.y[0], rtol=1e-7)  # the integrator's own tolerance


def test_the_desired_force_drives_too() -> None:
    recording = recorded(standing(4.0))
    desired = WrenchSignal(
        topic="/desired",
        frame_id="",
        stamp_ns=recording.wrench.stamp_ns[:1],
        force_n=np.array([[5.0, 0.0, 0.0]]),
        torque_n_m=np.zeros((1, 3)),
    )
    asked = admittance_motions(replace(recording, desired_force=desired))[0].asked_m_s
    np.testing.assert_allclose(asked, 9.0 / DAMPING_N_S_PER_M, rtol=1e-12)


def test_the_motion_is_reported_in_the_axes_of_the_wrench() -> None:
    run = Led(force_n=np.zeros(SAMPLES), position_m=np.asarray(0.02 * TIME_S))
    for axis, name in enumerate("xyz"):
        for motion in admittance_motions(recorded(run, axis=axis, noise_m=0.0)):
            expected = 0.02 if motion.axis == name else 0.0
            np.testing.assert_allclose(motion.moved_m_s, expected, atol=1e-10)


def test_turning_is_what_a_lever_adds() -> None:
    lever_S, turned = (
        np.array([0.1, -0.3, 0.4]),
        TOOL_DOWN * Rotation.from_rotvec(np.outer(TIME_S, [0.02, -0.01, 0.03])),
    )
    # The controlled point stands still, lever_S off the logged one, which goes round it.
    recording = recorded(standing(), noise_m=0.0, turned=turned, offset_B_m=-turned.apply(lever_S))
    for i, motion in enumerate(admittance_motions(recording)[:3]):
        components = lever_S[[(i + 2) % 3, (i + 1) % 3]]
        # Mean velocities over 10 ms in the middle's axes: an arc for a chord, (0.4 mrad)²/24 of it.
        np.testing.assert_allclose(motion.moved_m_s, motion.turning_rad_s @ components, rtol=1e-6, atol=1e-9)


def test_a_robot_that_stands_while_the_admittance_asks_is_left_out() -> None:
    force = hand_force(6.0, np.random.default_rng(1))
    run = led(ONE_POLE, 0.01, force)
    stopped = run.position_m.copy()
    stopped[600:] = stopped[600]
    pushed = np.where(np.arange(1200) > 600, 20.0, run.force_n)
    motion = admittance_motions(recorded(Led(force_n=pushed, position_m=stopped)))[0]
    assert motion.halted_s == pytest.approx(3.0, abs=0.1)
    assert not np.any(motion.used[motion.edge_s[:-1] > 2.75])
    assert np.all(motion.used[(motion.edge_s[:-1] > 0.6) & (motion.edge_s[1:] < 2.65)])
    assert admittance_motions(recorded(run))[0].halted_s == 0.0


def test_what_is_missing_is_named() -> None:
    recording = recorded(standing())
    with pytest.raises(EstimateError, match=r"declare `gains` in cell\.yaml"):
        admittance_motions(replace(recording, gains=None))
    pose = replace(recording.pose, quaternion_xyzw=np.full((SAMPLES, 4), np.nan), measured_axes=("x", "y", "z"))
    with pytest.raises(EstimateError, match="has no orientation"):
        admittance_motions(replace(recording, pose=pose))
    later = replace(recording.pose, stamp_ns=recording.pose.stamp_ns + 2_995_000_000)
    with pytest.raises(EstimateError, match=r"found 2\.00 s; record longer"):
        admittance_motions(replace(recording, pose=later))


def test_a_fast_log_is_averaged_about_the_middle() -> None:
    recording = recorded(standing(5.0 * TIME_S))
    stamps = recording.wrench.stamp_ns[0] + np.arange(SAMPLES * 5) * 1_000_000
    force = np.zeros((len(stamps), 3))
    force[:, 0] = 5e-3 * np.arange(len(stamps))
    wrench = replace(recording.wrench, stamp_ns=stamps, force_n=force, torque_n_m=np.zeros_like(force))
    motion = admittance_motions(replace(recording, wrench=wrench))[0]
    assert motion.period_s == pytest.approx(3e-3)  # the largest odd number of milliseconds within 4
    tau = MASS_KG / DAMPING_N_S_PER_M
    time = 1e-3 + 3e-3 * np.arange(len(motion.asked_m_s))
    # Past the start the answer to a ramp is a ramp, whose mean over a block is its middle.
    settled = time > 20.0 * tau
    np.testing.assert_allclose(motion.asked_m_s[settled], (5.0 * (time - tau) / DAMPING_N_S_PER_M)[settled], rtol=1e-6)
