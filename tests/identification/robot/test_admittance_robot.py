"""The robot seen through a known admittance, against scipy on a clock fifty times finer."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.errors import EstimateError
from identification.robot.admittance_motion import admittance_motions
from identification.robot.admittance_robot import AdmittanceRobotFit, identify_admittance_robot
from identification.signals.recording import Recording
from problems.arrays import FloatArray
from tests.identification.led_robot import (
    DAMPING_N_S_PER_M,
    FINE_S,
    MASS_KG,
    ONE_POLE,
    TOOL_DOWN,
    TWO_POLES,
    hand_force,
    led,
    recorded,
)

DELAY_S = 0.0123


def fitted(recording: Recording, axis: int = 0) -> AdmittanceRobotFit:
    return identify_admittance_robot(admittance_motions(recording)[axis])


def lively(seed: int = 1, duration_s: float = 12.0) -> FloatArray:
    return hand_force(duration_s, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("robot", "bandwidth_hz"),
    # 20/(s + 20); and |r| = 1/√2 at u² + (4ζ² − 2) u − 1 = 0, u = (ω/30)², ζ = 0.6.
    [(ONE_POLE, 20.0 / (2 * np.pi)), (TWO_POLES, 30.0 / (2 * np.pi) * np.sqrt(0.28 + np.sqrt(0.28**2 + 1.0)))],
    ids=["one pole", "two poles"],
)
def test_robot_and_delay_are_found(robot: tuple[FloatArray, FloatArray], bandwidth_hz: float) -> None:
    fit = fitted(recorded(led(robot, DELAY_S, lively())))
    assert fit.model.order == len(robot[1]) - 1
    # 5 ms samples of a 4 Hz hand: linear between samples costs (ωh)²/12 = 1e-3 of the force.
    np.testing.assert_allclose(fit.model.denominator, robot[1], rtol=0.02)
    assert fit.model.delay_s == pytest.approx(DELAY_S, abs=5e-4)
    assert fit.bandwidth_hz == pytest.approx(bandwidth_hz, rel=0.01)
    assert fit.gain == pytest.approx(1.0, abs=2e-3)
    assert fit.lag_s == pytest.approx(DELAY_S + robot[1][-2] / robot[1][-1], abs=5e-4)
    assert fit.lever_m.size == 0
    # The encoder's 2 µm, differenced over 10 ms, are 0.28 mm/s beside 11 mm/s of motion.
    assert fit.fit_error < 0.03


def test_deviations_cover_what_an_unlogged_push_does() -> None:
    scores = []
    for seed in range(12):
        extra = hand_force(8.0, np.random.default_rng(100 + seed), band_hz=1.0, rms_n=1.5)
        fit = fitted(recorded(led(ONE_POLE, DELAY_S, lively(seed, 8.0), extra)))
        scores.append(
            [
                (fit.bandwidth_hz - 20.0 / (2 * np.pi)) / fit.bandwidth_std_hz,
                (fit.model.delay_s - DELAY_S) / fit.delay_std_s,
                (fit.lag_s - DELAY_S - 0.05) / fit.lag_std_s,
            ]
        )
    spread = np.sqrt(np.mean(np.square(scores), axis=0))
    # √(χ²_0.999(12)/12) = 1.65 if the deviations were exact; what a second, fast pole would change makes them larger,
    # of the delay above all, which it replaces.
    assert np.all(spread < 1.65)
    assert np.all(spread[[0, 2]] > 0.1)


def test_other_gains_than_those_that_ran_show_as_gain() -> None:
    run = led(ONE_POLE, DELAY_S, lively())
    fit = fitted(recorded(run, mass_kg=0.5 * MASS_KG, damping_n_s_per_m=0.5 * DAMPING_N_S_PER_M))
    assert fit.gain == pytest.approx(0.5, abs=2e-3)
    assert fit.model.denominator[1] == pytest.approx(20.0, rel=0.02)


def test_a_point_off_the_controlled_one_is_found_with_its_lever() -> None:
    run, lever_S = led(ONE_POLE, DELAY_S, lively()), np.array([0.0, 0.15, 0.4])
    time = np.arange(len(run.force_n)) * 50 * FINE_S
    turned = TOOL_DOWN * Rotation.from_rotvec(
        np.column_stack([0 * time, 0.05 * np.sin(time), 0.04 * np.cos(1.7 * time)])
    )
    fit = fitted(recorded(run, turned=turned, offset_B_m=-turned.apply(lever_S)))
    # The tool turns by 3 degrees, so its axes are 0.1 % short of the direction of travel, and a bit of it goes across.
    np.testing.assert_allclose(fit.lever_m, lever_S[[2, 1]], atol=5e-3)
    assert fit.model.denominator[1] == pytest.approx(20.0, rel=0.03)


def test_a_reversed_wrench_is_refused() -> None:
    with pytest.raises(EstimateError, match="moves against the force"):
        fitted(recorded(led(ONE_POLE, DELAY_S, lively()), force_sign=-1.0))


def test_an_axis_that_hardly_moves_is_refused_with_its_travel() -> None:
    with pytest.raises(EstimateError, match=r"travels 0\.0 mm"):
        fitted(recorded(led(ONE_POLE, DELAY_S, lively()), axis=1, noise_m=0.0))


def test_a_motion_of_another_cause_is_refused_with_its_residual() -> None:
    run = led(ONE_POLE, DELAY_S, lively(1), lively(2))
    with pytest.raises(EstimateError, match=r"residual \d\d % of it, 20 % at most"):
        fitted(recorded(run))


def test_a_robot_later_than_the_search_is_refused() -> None:
    with pytest.raises(EstimateError, match=r"later than 300 ms"):
        fitted(recorded(led(ONE_POLE, 0.31, hand_force(12.0, np.random.default_rng(1), band_hz=0.5))))


def test_a_slow_hand_shows_the_lag_but_not_its_parts() -> None:
    extra = hand_force(12.0, np.random.default_rng(7), band_hz=1.0, rms_n=1.0)
    run = led(TWO_POLES, DELAY_S, hand_force(12.0, np.random.default_rng(5), band_hz=0.4), extra)
    fit = fitted(recorded(run))
    assert fit.delay_std_s > 0.25 * fit.model.delay_s
    assert abs(fit.lag_s - DELAY_S - 0.04) < 3.0 * fit.lag_std_s
    assert fit.lag_std_s < 0.35 * fit.lag_s


@pytest.mark.parametrize("force", [0.0, 7.3], ids=["within the deadband", "constant"])
def test_a_wrench_that_never_changes_is_refused_for_what_it_is(force: float) -> None:
    """A robot that someone moved by another way than the force: its response to a constant is not to be had."""
    moved = led(ONE_POLE, DELAY_S, lively())
    with pytest.raises(EstimateError, match="no change of speed on this axis"):
        fitted(recorded(replace(moved, force_n=np.full(len(moved.force_n), force))))


def test_an_axis_that_holds_noise_alone_did_not_move() -> None:
    """A minute of 2 µm of noise is 13 mm of steps of 10 ms; whichever way it seems to go, it follows no force."""
    recording = recorded(led(ONE_POLE, DELAY_S, lively(duration_s=60.0)))
    noise = np.random.default_rng(8).standard_normal((len(recording.wrench.force_n), 3))
    wrench = replace(recording.wrench, force_n=recording.wrench.force_n + 0.1 * noise)
    for axis in (1, 2):
        with pytest.raises(EstimateError, match="too little to identify"):
            fitted(replace(recording, wrench=wrench), axis)
