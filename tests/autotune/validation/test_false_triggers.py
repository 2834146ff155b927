"""False triggers: closed forms, Rice's rate, Monte Carlo, and an operator whose hand brakes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from autotune.formats.controller_record import admittance_controller
from autotune.validation.false_triggers import (
    MOST_PER_HOUR,
    MOVEMENTS_PER_HOUR,
    braked,
    braking_share,
    correlation_of,
    crossings,
    describe_false_triggers,
    needed_deviations,
    noise_in_free_space,
    noise_per_hour,
    wrong_false_triggers,
)
from identification.result import NoiseSpectrum
from problems.model.sampled import build_loop, build_sampled_plant
from tests.autotune.tuning.responding import responding, varied
from tests.problems.axes import PERIOD_S


def tail(deviations: float) -> float:
    return 0.5 * math.erfc(deviations / math.sqrt(2.0))


@pytest.mark.parametrize("deviations", [0.0, 2.0, 6.5])
def test_white_noise_crosses_as_often_as_two_independent_ticks(deviations: float) -> None:
    assert crossings(deviations, 0.0) == pytest.approx(tail(deviations) * (1.0 - tail(deviations)), rel=1e-9)


@pytest.mark.parametrize("deviations", [0.0, 2.0, 4.0])
def test_slow_noise_crosses_at_the_rate_of_rice(deviations: float) -> None:
    """Per tick √(−r''(0))/2π e^(−u²/2), with r''(0) ≈ −2(1 − r); what is left falls with 1 − r."""
    correlation = 0.9999
    rice = math.sqrt(2.0 * (1.0 - correlation)) / (2.0 * math.pi) * math.exp(-0.5 * deviations**2)
    assert crossings(deviations, correlation) == pytest.approx(rice, rel=1e-3)


@pytest.mark.parametrize("correlation", [0.0, 0.6, 0.95])
def test_the_rate_is_what_a_long_simulation_counts(correlation: float) -> None:
    count, level = 2_000_000, 2.5
    rng, apart = np.random.default_rng(1), math.sqrt(1.0 - correlation**2)
    # Many short stationary runs of the first order, all at once.
    now, crossed = rng.standard_normal(20_000), 0
    for _ in range(count // 20_000):
        following = correlation * now + apart * rng.standard_normal(20_000)
        crossed += int(np.sum((now <= level) & (following > level)))
        now = following
    expected = count * crossings(level, correlation)
    # Four deviations of a count, more where crossings come in groups.
    assert abs(crossed - expected) < 6.0 * math.sqrt(expected)


@pytest.mark.parametrize("correlation", [0.0, 0.6])
def test_the_rate_is_what_the_closed_loop_counts(correlation: float) -> None:
    """Noise that the robot moves by and the payload answers, tick by tick; the sensor's alone passes less often."""
    controller = responding().controller
    law, plants, h = admittance_controller(controller, "x"), controller.certificate.domain["x"].plants, PERIOD_S
    felt = noise_in_free_space(controller, "x", correlation)
    loop = build_loop(build_sampled_plant(plants.at(plants.payload_mass_kg[0], 0.0), h), law)
    rng, runs, ticks, begin = np.random.default_rng(5), 3000, 4000, 1000
    state, noise = np.zeros((len(loop.a), runs)), rng.standard_normal(runs)
    level, before, crossed, squares = 3.5, np.zeros(runs), 0, 0.0
    for tick in range(ticks + begin):
        read = loop.c_force @ state + (1.0 + loop.d_force) * noise
        if tick >= begin:
            crossed += int(np.sum((before <= level) & (read > level)) + np.sum((-before <= level) & (-read > level)))
            squares += float(read @ read)
        before, state = read, loop.a @ state + np.outer(loop.b, noise)
        noise = correlation * noise + math.sqrt(1.0 - correlation**2) * rng.standard_normal(runs)
    assert math.sqrt(squares / (runs * ticks)) == pytest.approx(felt.gain, rel=2e-3)
    hours = runs * ticks * h / 3600.0
    expected = hours * noise_per_hour(level, 0.0, felt.gain, felt.correlation, h, 1)
    alone = hours * noise_per_hour(level, 0.0, 1.0, correlation, h, 1)
    # Four deviations of a count; the sensor's own noise passes less often by more than that.
    assert abs(crossed - expected) < 4.0 * math.sqrt(expected)
    assert crossed - alone > 4.0 * math.sqrt(expected)


def test_the_least_threshold_is_passed_as_rarely_as_it_says_on_all_axes_together() -> None:
    for correlation, axes in ((0.0, 1), (0.0, 3), (0.9, 2)):
        deviations = needed_deviations(correlation, PERIOD_S, axes)
        rate = noise_per_hour(9.0 + deviations * 0.2, 9.0, 0.2, correlation, PERIOD_S, axes)
        assert rate == pytest.approx(MOST_PER_HOUR, rel=1e-3)
        assert noise_per_hour(9.0, 9.0, 0.0, correlation, PERIOD_S, axes) == 0.0


def test_the_correlation_is_that_of_the_spectrum() -> None:
    """A flat one to f_1 has sin(2πf_1 h)/(2πf_1 h); the trapezium of 400 bands is within 1e-4 of it."""
    frequency = np.linspace(0.0, 300.0, 400)
    flat = NoiseSpectrum(
        frequency_hz=tuple(frequency.tolist()),
        force_n2_per_hz=(1e-4,) * 400,
        torque_n2_m2_per_hz=(),
        resolution=(None,) * 6,
    )
    angle = 2.0 * math.pi * 300.0 * PERIOD_S
    assert correlation_of(flat, PERIOD_S) == pytest.approx(math.sin(angle) / angle, abs=1e-4)
    assert correlation_of(None, PERIOD_S) == 0.0


def test_a_hand_that_goes_back_opposes_the_motion_and_one_that_slows_down_does_not() -> None:
    """The admittance stops by itself within M_a/B_a = 16 ms, so that a hand pushes on until it turns."""
    opposing = braked(responding().controller, "x")
    straight = [float(np.max(each)) for i, each in enumerate(opposing) if i % 4 < 2]
    back = [float(np.max(each)) for i, each in enumerate(opposing) if i % 4 > 1]
    assert max(straight) <= 0.0
    assert max(back) > 10.0
    shares = [braking_share(opposing, threshold, 0.14) for threshold in (5.0, 10.0, 20.0, 100.0)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.2
    assert shares[-1] == 0.0
    # Without noise a movement passes, or it does not.
    largest = np.array([float(np.max(each)) for each in opposing])
    assert braking_share(opposing, 10.0, 0.0) == pytest.approx(float(np.mean(largest > 10.0)))


def test_the_file_says_it_and_what_is_said_too_low_is_found_out() -> None:
    for controller in (responding().controller, varied()):
        stated = controller.collision.false_triggers
        assert stated is not None
        assert stated.noise_per_hour < MOST_PER_HOUR
        assert stated.braking_per_hour == pytest.approx(1.0 - (1.0 - stated.braking_share) ** MOVEMENTS_PER_HOUR)
        assert "times an hour" in describe_false_triggers(stated)
    controller = responding().controller
    assert wrong_false_triggers(controller, 9.0) == []
    for name, wrong in (("noise_per_hour", 0.0), ("braking_share", 0.0), ("free_motion_n", 5.0)):
        assert controller.collision.false_triggers is not None
        changed = replace(controller.collision.false_triggers, **{name: wrong})
        false = replace(controller, collision=replace(controller.collision, false_triggers=changed))
        assert any(f"false_triggers.{name} is stated" in each for each in wrong_false_triggers(false, 9.1))
