"""What the limits of the runtime follow from: closed forms beside what is chosen."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.limits import AxisLimits, LimitsNoise, ResidualPeaks
from autotune.validation.limits import (
    choose_axis_limits,
    choose_limits,
    commanded_motion,
    rounded_up,
    step_motion,
    verify_limits,
    with_residual,
)
from problems.model.response import controller_response
from tests.autotune.formats.samples import DOMAIN, GAINS, PREDICTION, make_controller, make_limits

H, GRAVITY, LEVER_M = 8e-4, 9.80665, 0.2
QUIET = LimitsNoise()
LIMITS = AxisLimits(speed=0.1, acceleration=60.0)


def is_just_above(found: float, value: float) -> bool:
    """Whether a number is the least of two digits that is not below a value."""
    unit = 10.0 ** (math.floor(math.log10(found) + 1e-12) - 1)
    return found == float(f"{found:.2g}") and found - unit < value * (1.0 + 1e-9) and value <= found * (1.0 + 1e-9)


@given(st.floats(1e-9, 1e9))
def test_two_digits_are_never_below_the_number_and_less_than_one_unit_above(value: float) -> None:
    assert is_just_above(rounded_up(value), value)
    assert rounded_up(rounded_up(value)) == rounded_up(value)


def test_the_sensors_range_is_twice_weight_bias_and_the_worst_peak() -> None:
    """The heaviest payload has 18 kg; a force at the lever, and that of the axis that turns, are torques."""
    worst = replace(PREDICTION.scenarios[0], peak_sensor_force_n=12.0)
    turning = replace(PREDICTION, scenarios=(worst,))
    controller = replace(make_controller(), predicted={"x": PREDICTION, "rz": turning})
    found = choose_limits(controller, QUIET, {"x": LIMITS, "rz": LIMITS}, {})
    weight, peak = 18.0 * GRAVITY, PREDICTION.scenarios[0].peak_sensor_force_n
    bias, torque_bias = math.sqrt(1.5**2 + 0.25**2 + 3.0**2), math.hypot(0.1, 0.2)
    assert is_just_above(found.force_n, 2.0 * (weight + bias + peak))
    com = math.sqrt(0.01**2 + 0.02**2 + 0.1**2)
    assert is_just_above(found.torque_n_m, 2.0 * (weight * com + torque_bias + 12.0 + LEVER_M * peak))
    # Without the torque of an axis that turns, and with a payload heavier than the domain's.
    alone = replace(make_controller(("x",)), payload=replace(controller.payload, mass_kg=40.0))
    found = choose_limits(alone, QUIET, {"x": LIMITS}, {})
    assert is_just_above(found.force_n, 2.0 * (40.0 * GRAVITY + bias + peak))
    assert is_just_above(found.torque_n_m, 2.0 * (40.0 * GRAVITY * com + torque_bias + LEVER_M * peak))
    assert set(found.reasons) >= {"force_n", "torque_n_m", "pose_speed_m_s", "rest_force_n", "rest_torque_n_m"}


@pytest.mark.parametrize(
    ("straight", "turning", "speeds"), [(0.1, 0.5, (1.0, 5.0)), (0.4, 0.5, (1.6, 5.0)), (0.1, 2.0, (1.0, 8.0))]
)
@pytest.mark.parametrize("position_m", [0.0, 5e-5])
def test_the_pose_may_go_four_times_as_fast_as_the_command_and_shake(
    straight: float, turning: float, speeds: tuple[float, float], position_m: float
) -> None:
    axes = {"x": replace(LIMITS, speed=straight), "rz": replace(LIMITS, speed=turning)}
    found = choose_limits(make_controller(), LimitsNoise(position_m=position_m), axes, {})
    shaken = 6.0 * math.sqrt(2.0) * position_m / H
    assert is_just_above(found.pose_speed_m_s, speeds[0] + shaken)
    assert is_just_above(found.pose_speed_rad_s, speeds[1] + shaken / LEVER_M)


@pytest.mark.parametrize(
    ("sample_time_s", "times"),
    [(8e-4, (0.02, 0.1, 125)), (5e-3, (0.05, 0.1, 20)), (0.02, (0.2, 0.2, 5)), (0.5, (5.0, 5.0, 1))],
)
def test_what_is_stale_and_what_rests_is_counted_in_time_and_in_periods(
    sample_time_s: float, times: tuple[float, float, int]
) -> None:
    certificate = replace(make_controller().certificate, sample_time_s=sample_time_s)
    controller = replace(make_controller(), sample_time_s=sample_time_s, delay_samples=1.0, certificate=certificate)
    found = choose_limits(controller, QUIET, {"x": LIMITS, "rz": LIMITS}, {})
    assert (found.stale_wrench_s, found.stale_pose_s, found.rest_samples) == pytest.approx(times)


@pytest.mark.parametrize(
    ("deadband", "left_n", "rest_n"),
    [
        (5.0, 0.0, 1.0),
        (8.0, 0.0, 1.6),
        (5.0, 1.1, 3.3),
        (5.0, 4.0, 5.0),
        (0.5, 0.0, 0.5),
        (0.0, 0.0, 1.0),
        (0.0, 2.0, 6.0),
    ],
)
def test_at_the_start_a_fifth_of_the_deadband_may_be_left_or_what_the_log_left(
    deadband: float, left_n: float, rest_n: float
) -> None:
    gains = replace(GAINS, deadband=deadband)
    noise = LimitsNoise(gravity_residual_n=left_n)
    turning = replace(make_controller(), axes={"x": gains, "rz": replace(GAINS, deadband=0.6)})
    found = choose_limits(turning, noise, {"x": LIMITS, "rz": LIMITS}, {})
    # 0.2 N·m at least, of the axis that turns alone.
    assert (found.rest_force_n, found.rest_torque_n_m) == pytest.approx((rest_n, 0.2))
    straight = replace(make_controller(("x",)), axes={"x": gains})
    found = choose_limits(straight, noise, {"x": LIMITS}, {})
    # No axis turns: the weight of 16 kg at 2 cm.
    assert (found.rest_force_n, found.rest_torque_n_m) == pytest.approx((rest_n, 3.2))
    light = replace(straight, payload=replace(straight.payload, mass_kg=1.0))
    assert choose_limits(light, noise, {"x": LIMITS}, {}).rest_torque_n_m == 1.0


def direct_gains(controller: Controller, name: str) -> tuple[float, float]:
    """Return what a force and a position change of the command in the same period: the response at z = ∞."""
    law = admittance_controller(controller, name)
    forward, feedback = controller_response(law, np.array([1e9 + 0j]), controller.sample_time_s)
    return abs(complex(forward[0])), abs(complex(feedback[0]))


@pytest.mark.parametrize("name", ["x", "rz"])
@pytest.mark.parametrize(("feedback_s", "compensated_kg"), [(0.0, 0.0), (0.02, 0.0), (0.02, 3.0)])
def test_noise_shakes_the_command_by_its_direct_gain(name: str, feedback_s: float, compensated_kg: float) -> None:
    """d n of each period are independent: √2 d n/h of speed and √6 d n/h² of acceleration, six deviations of them."""
    controller = replace(make_controller(), compensation_mass_kg=compensated_kg)
    controller = replace(controller, axes=dict.fromkeys(("x", "rz"), replace(GAINS, feedback_damping_s=feedback_s)))
    noise = LimitsNoise(force_n=0.3, torque_n_m=0.05, position_m=2e-5)
    force, pose = direct_gains(controller, name)
    lever = LEVER_M if name == "rz" else 1.0
    each = math.hypot(force * (0.05 if name == "rz" else 0.3), pose * 2e-5 / lever)
    speed, acceleration = step_motion(controller, name, 7.0)
    assert (speed, acceleration) == pytest.approx((7.0 * force / H, 7.0 * force / H**2), rel=1e-6)
    reasons: dict[str, str] = {}
    found = choose_axis_limits(controller, name, noise, (3.0, 4000.0), reasons)
    assert is_just_above(found.speed, 6.0 + 6.0 * math.sqrt(2.0) * each / H)
    assert is_just_above(found.acceleration, 8000.0 + 6.0 * math.sqrt(6.0) * each / H**2)
    assert set(reasons) == {f"axes.{name}.speed", f"axes.{name}.acceleration"}
    # At least as fast as a robot is led by hand, at the lever.
    assert choose_axis_limits(controller, name, QUIET, (1e-3, 1.0), {}).speed == rounded_up(0.25 / lever)


def test_motion_is_counted_from_tick_to_tick() -> None:
    command = np.array([0.0, 1e-3, 4e-3, 4e-3, 2e-3])
    assert commanded_motion(command, 1e-3) == pytest.approx((3.0, 3000.0))
    assert commanded_motion(-command, 1e-3) == pytest.approx((3.0, 3000.0))
    assert commanded_motion(command[:1], 1e-3) == (0.0, 0.0)
    assert commanded_motion(command[:2], 1e-3) == pytest.approx((1.0, 0.0))


@pytest.mark.parametrize("name", ["x", "rz"])
def test_what_is_left_over_raises_peaks_by_its_share_of_the_driving_force(name: str) -> None:
    controller, left = make_controller(), {"x": 1.5, "rz": 0.5}[name]
    assert with_residual(controller, name) == (0.0, 1.0)
    limited = replace(controller, limits=make_limits())
    assert with_residual(limited, name) == pytest.approx((left, 1.0 + left / 30.0))
    by_speed = replace(DOMAIN, approach_force_n=None, approach_speed_m_s=0.02)
    certificate = replace(controller.certificate, domain=dict.fromkeys(("x", "rz"), by_speed))
    limited = replace(limited, certificate=certificate)
    force = 0.02 * (GAINS.damping + 630.0)
    assert with_residual(limited, name) == pytest.approx((left, 1.0 + left / force))


@pytest.mark.parametrize(("share", "is_enough"), [(1.001, True), (0.999, False)])
def test_a_sensor_that_the_worst_peak_saturates_is_found(share: float, is_enough: bool) -> None:
    """One component of the wrench: the weight of 16 kg, the largest bias and the peak with what is left over."""
    peak = PREDICTION.scenarios[0].peak_sensor_force_n
    needed = 16.0 * GRAVITY + 3.0 + (1.0 + 1.5 / 30.0) * peak
    controller = replace(make_controller(("x",)), limits=replace(make_limits(("x",)), force_n=share * needed))
    law = admittance_controller(controller, "x")
    _, wrong = verify_limits(controller, "x", controller.certificate.domain["x"], law)
    assert any(each.startswith("limits.force_n is ") and "make" in each for each in wrong) is not is_enough


@pytest.mark.parametrize(
    ("short", "wrong"),
    [
        ({}, []),
        ({"peak_sensor_force_n": 0.9999}, ["with_residual_weight.peak_sensor_force_n must be at least 74.8"]),
        ({"peak_contact_force_n": 0.9999}, ["with_residual_weight.peak_contact_force_n must be at least 97.75"]),
        ({"force_n": 0.9}, ["with_residual_weight.peak_sensor_", "with_residual_weight.peak_contact_"]),
    ],
)
@pytest.mark.parametrize(("deadband", "moves"), [(5.0, False), (1.5, False), (0.4, True), (0.0, False)])
def test_peaks_with_what_is_left_over_are_those_without_by_the_share(
    short: dict[str, float], wrong: list[str], deadband: float, moves: bool
) -> None:
    """1 + 1.5/30 times 71.23 N at the sensor and 93.1 N at the contact; what passes a deadband moves by itself."""
    share = 1.0 + 1.5 / 30.0
    stated = {"force_n": 1.5, "peak_sensor_force_n": share * 71.23456789012345, "peak_contact_force_n": share * 93.1}
    peaks = ResidualPeaks(**{name: short.get(name, 1.0) * value for name, value in stated.items()})
    controller = replace(
        make_controller(("x",)),
        limits=make_limits(("x",)),
        axes={"x": replace(GAINS, deadband=deadband)},
        predicted={"x": replace(PREDICTION, with_residual_weight=peaks)},
    )
    said, found = verify_limits(controller, "x", DOMAIN, admittance_controller(controller, "x"))
    about = [each for each in found if "residual" in each or "left over" in each]
    expected = ["at the start 1.5 N may be left over, more than the deadband of 0.4"] if moves else []
    assert len(about) == len(expected) + len(wrong)
    assert all(each.startswith(begin) for each, begin in zip(about, [*expected, *wrong], strict=True))
    assert "with 1.5 N of weight left over the worst peak is 97.8 N; the file does not say for which noise" in said
    quiet = replace(controller, limits=replace(make_limits(("x",)), noise=QUIET))
    assert "for which noise" not in verify_limits(quiet, "x", DOMAIN, admittance_controller(quiet, "x"))[0]
