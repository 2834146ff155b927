"""The robot's loop and delay, against scipy on a clock fifty times finer."""

import numpy as np
import pytest
from scipy.signal import butter, cont2discrete, lfilter, sosfilt

from identification.errors import EstimateError
from identification.robot.position_loop import held_robot, identify_robot, robot_response
from problems.arrays import FloatArray
from problems.model.robot import RobotModel
from tests.identification.synthetic import sweep

H_S = 1e-3
PARTS = 50  # delays are drawn in fiftieths of a sample
NOISE_M = 2e-6

ONE_POLE = (np.array([20.0]), np.array([1.0, 20.0]))
TWO_POLES = (np.array([1600.0]), np.array([1.0, 56.0, 1600.0]))


def followed(polynomials: tuple[FloatArray, FloatArray], delay_parts: int, command: FloatArray) -> FloatArray:
    numerator, denominator, _ = cont2discrete(polynomials, H_S / PARTS, method="zoh")
    held = np.repeat(command, PARTS)
    late = np.concatenate([np.zeros(delay_parts), held[: len(held) - delay_parts]])
    return np.asarray(lfilter(np.squeeze(numerator), denominator, late)[::PARTS])


def noisy(position: FloatArray) -> FloatArray:
    return np.asarray(position + NOISE_M * np.random.default_rng(9).standard_normal(len(position)))


@pytest.mark.parametrize("samples", [0.0, 1.0, 2.4, 2.98, 7.5])
def test_one_pole_and_a_fractional_delay_are_found(samples: float) -> None:
    command = sweep(6.0, 1.0 / H_S)
    fit = identify_robot(command, noisy(followed(ONE_POLE, round(samples * PARTS), command)), H_S)
    # 2 µm on centimetres of motion: parts of a thousand are generous, and the order must not be larger than it is.
    assert fit.model.order == 1
    np.testing.assert_allclose(fit.model.denominator, ONE_POLE[1], rtol=2e-3)
    assert fit.model.delay_s / H_S == pytest.approx(samples, abs=0.02)
    assert abs(fit.model.denominator[1] - 20.0) < 5.0 * fit.denominator_std[1]
    assert fit.second_pole_s == 0.0
    assert fit.bandwidth_hz == pytest.approx(20.0 / (2.0 * np.pi), rel=2e-3)


@pytest.mark.parametrize("samples", [1.0, 3.36])
def test_two_poles_are_reported_from_one(samples: float) -> None:
    command = sweep(6.0, 1.0 / H_S)
    fit = identify_robot(command, noisy(followed(TWO_POLES, round(samples * PARTS), command)), H_S)
    assert fit.model.order == 2
    np.testing.assert_allclose(fit.model.denominator, TWO_POLES[1], rtol=5e-3)
    assert fit.model.delay_s / H_S == pytest.approx(samples, abs=0.02)
    # |r| = 1/√2 at u² + (4ζ²−2) u − 1 = 0 with u = (ω/ω_0)², here ω_0 = 40, ζ = 0.7.
    inner = 1.0 - 2.0 * 0.7**2
    expected = 40.0 * np.sqrt(inner + np.sqrt(inner**2 + 1.0)) / (2.0 * np.pi)
    assert fit.bandwidth_hz == pytest.approx(expected, rel=5e-3)


def led_by_hand(duration_s: float, rng: np.random.Generator) -> FloatArray:
    """Return the command (n,) of an admittance of 10 kg and 200 N·s/m under pushes of 0.3 to 1.5 s."""
    force = np.zeros(round(duration_s / H_S))
    begin = 500
    while begin < len(force) - 2000:
        count = int(rng.uniform(300, 1500))
        push = np.sin(np.pi * np.arange(count) / count) ** 2
        force[begin : begin + count] = rng.choice([-1.0, 1.0]) * rng.uniform(5.0, 25.0) * push
        begin += count + int(rng.uniform(0, 1000))
    return np.asarray(np.cumsum(lfilter([H_S / 10.0], [1.0, 20.0 * H_S - 1.0], force)) * H_S)


@pytest.mark.parametrize("noise_m", [1e-5, 4e-5])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_second_pole_that_slow_motion_hides_is_held_by_the_delay(noise_m: float, seed: int) -> None:
    """Poles of 38 and 262 rad/s: the second one looks like 3.8 ms of delay more, known to hundredths."""
    rng = np.random.default_rng(seed)
    command = led_by_hand(30.0, rng)
    robot = (np.array([1e4]), np.array([1.0, 300.0, 1e4]))
    position = followed(robot, round(3.0 * PARTS), command)
    fit = identify_robot(command, position + noise_m * rng.standard_normal(len(position)), H_S)
    assert abs(fit.model.delay_s - 3e-3) < 2.0 * fit.delay_std_s
    if fit.model.order == 1:
        assert 3.3e-3 < fit.second_pole_s <= fit.model.delay_s


def test_a_long_log_is_fitted_to_its_end() -> None:
    """The beginning only tells where to start: the deviations are those of the whole, and cover the truth."""
    once = sweep(25.0, 1.0 / H_S)
    command = np.tile(once, 6)
    position = noisy(followed(ONE_POLE, 120, command))
    whole = identify_robot(command, position, H_S)
    part = identify_robot(command[: 2 * len(once)], position[: 2 * len(once)], H_S)
    # The white noise of three times as many samples.
    assert whole.delay_std_s == pytest.approx(part.delay_std_s / np.sqrt(3.0), rel=0.05)
    assert abs(whole.model.delay_s - 2.4e-3) < 4.0 * whole.delay_std_s
    assert abs(whole.model.denominator[1] - 20.0) < 4.0 * whole.denominator_std[1]
    assert whole.model.order == 1


@pytest.mark.parametrize("friction_share", [0.005, 0.02])
def test_dry_friction_is_held_by_the_stated_deviations(friction_share: float) -> None:
    """A servo of second order with dry friction: what that does to the bandwidth is seen in the residual alone."""
    command = sweep(6.0, 1.0 / H_S)
    position, speed, steps = np.zeros(len(command)), 0.0, 4
    friction, here = friction_share * 1600.0 * float(np.max(np.abs(command))), 0.0
    for i, target in enumerate(command):
        position[i] = here
        for _ in range(steps):
            free = speed + H_S / steps * (1600.0 * (target - here) - 56.0 * speed)
            speed = float(np.sign(free) * max(abs(free) - H_S / steps * friction, 0.0))
            here += H_S / steps * speed
    fit = identify_robot(command, noisy(position), H_S)
    expected = identify_robot(command, followed(TWO_POLES, 0, command), H_S).bandwidth_hz
    assert abs(fit.bandwidth_hz - expected) < 1.96 * fit.bandwidth_std_hz
    # In SI, so that a fit of everything can hold it as well: ω in rad/s, ζ, T_d in s.
    omega, zeta, _ = fit.friction_shift
    assert -0.2 * expected * 2.0 * np.pi < omega < 0.2 * expected * 2.0 * np.pi
    assert zeta < 0.0  # what friction adds to the damping is not the servo's
    # Without it the deviations are the noise's: far from what friction does.
    assert abs(fit.bandwidth_hz / expected - 1.0) > 0.002


def test_stated_deviations_cover_what_noise_does() -> None:
    command = sweep(3.0, 1.0 / H_S)
    clean = followed(ONE_POLE, 120, command)
    rng, scores = np.random.default_rng(4), []
    for _ in range(20):
        fit = identify_robot(command, clean + NOISE_M * rng.standard_normal(len(clean)), H_S)
        scores.append(
            [
                (fit.model.denominator[1] - 20.0) / fit.denominator_std[1],
                (fit.model.delay_s - 2.4e-3) / fit.delay_std_s,
            ]
        )
    # A spread over 20 draws is known to 16 %: between a half and 1.6 is all that can be asked of it.
    spread = np.std(np.array(scores), axis=0)
    assert np.all(spread > 0.5)
    assert np.all(spread < 1.6)


def test_a_command_that_the_robot_does_not_follow_is_refused() -> None:
    rng = np.random.default_rng(2)
    sections = butter(2, 2.0, fs=1.0 / H_S, output="sos")
    command, position = (0.05 * sosfilt(sections, rng.standard_normal(6000)) for _ in range(2))
    with pytest.raises(EstimateError, match="check that the command topic is the position command"):
        identify_robot(command, position, H_S)


def test_a_command_in_another_unit_is_refused() -> None:
    command = sweep(4.0, 1.0 / H_S)
    with pytest.raises(EstimateError, match="in the same frame and unit"):
        identify_robot(1000.0 * command, followed(ONE_POLE, 120, command), H_S)


def test_a_robot_that_was_not_moved_is_reported_with_its_travel() -> None:
    command = 1e-5 * np.sin(np.arange(4000) * 0.01)
    with pytest.raises(EstimateError, match=r"moves by 0\.020 mm only.*record a commanded sweep"):
        identify_robot(command, command, H_S)


def padded(numerator: FloatArray, length: int) -> FloatArray:
    return np.concatenate([numerator, np.zeros(length - len(numerator))])


@pytest.mark.parametrize(
    "polynomials",
    [
        ONE_POLE,
        TWO_POLES,
        (np.array([900.0]), np.array([1.0, 60.0, 900.0])),  # a double pole
        (np.array([30.0, 900.0]), np.array([1.0, 42.0, 900.0])),  # with a zero
    ],
    ids=["one pole", "two poles", "double pole", "zero"],
)
def test_the_held_robot_is_that_of_scipy(polynomials: tuple[FloatArray, FloatArray]) -> None:
    model = RobotModel(numerator=polynomials[0], denominator=polynomials[1], delay_s=0.0)
    numerator, denominator = held_robot(model, H_S, 0.0)
    expected, expected_denominator, _ = cont2discrete(polynomials, H_S, method="zoh")
    # Partial fractions of nearly equal poles cancel: six digits are lost at the double pole, none elsewhere.
    np.testing.assert_allclose(denominator, expected_denominator, rtol=1e-9)
    np.testing.assert_allclose(numerator, padded(np.squeeze(expected), len(numerator)), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("fraction", [0.2, 0.5, 0.98])
@pytest.mark.parametrize("polynomials", [ONE_POLE, TWO_POLES], ids=["one pole", "two poles"])
def test_a_fraction_of_a_sample_shifts_the_step_response(
    polynomials: tuple[FloatArray, FloatArray], fraction: float
) -> None:
    model = RobotModel(numerator=polynomials[0], denominator=polynomials[1], delay_s=fraction * H_S)
    step = robot_response(model, np.ones(200), H_S)
    # Both are exact under a hold; 10⁴ steps of rounding are left.
    np.testing.assert_allclose(step, followed(polynomials, round(fraction * PARTS), np.ones(200)), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("late", [0, 1, 5], ids=["at once", "one sample late", "five samples late"])
def test_an_echo_of_the_command_is_no_robot(late: int) -> None:
    command = sweep(6.0, 1.0 / H_S)
    echo = np.concatenate([np.zeros(late), command[: len(command) - late]])
    with pytest.raises(EstimateError, match="no echo of the command"):
        identify_robot(command, noisy(echo), H_S)


def test_a_delay_beyond_the_search_is_refused() -> None:
    command = sweep(6.0, 1.0 / H_S)
    with pytest.raises(EstimateError, match=r"later than 50 ms.*one clock"):
        identify_robot(command, followed(ONE_POLE, 60 * PARTS, command), H_S)


@pytest.mark.parametrize("offset_m", [2e-4, -5e-3])
def test_a_constant_offset_says_nothing_of_the_robot(offset_m: float) -> None:
    command = sweep(6.0, 1.0 / H_S)
    fit = identify_robot(command, noisy(followed(ONE_POLE, 120, command)) + offset_m, H_S)
    assert fit.model.order == 1
    assert fit.model.delay_s / H_S == pytest.approx(2.4, abs=0.02)


def test_without_noise_the_simplest_robot_is_chosen() -> None:
    command = sweep(6.0, 1.0 / H_S)
    fit = identify_robot(command, followed(ONE_POLE, 120, command), H_S)
    assert fit.model.order == 1
    assert fit.model.denominator[1] == pytest.approx(20.0, rel=1e-6)
