"""What drives a motion, on motions whose driver is written down."""

import numpy as np
import pytest
from scipy.signal import butter, lsim, sosfilt

from identification.timeline.moves import FoundAdmittance, find_admittance, follows, is_hand_led, is_stepped
from problems.arrays import FloatArray
from tests.identification.synthetic import Load, felt_force, ramp, sweep

H_S = 2e-3
LAW = FoundAdmittance(mass_kg=14.0, damping_n_s_per_m=1100.0)


def slow_force(seconds: float, size_n: float, seed: int = 0) -> FloatArray:
    noise = np.random.default_rng(seed).standard_normal(round(seconds / H_S))
    force = sosfilt(butter(2, 1.5, fs=1.0 / H_S, output="sos"), noise)
    return np.asarray(size_n * force / np.std(force))


def driven(force: FloatArray) -> FloatArray:
    """x^d of M_a a + B_a v = force, by scipy."""
    time = np.arange(len(force)) * H_S
    _, position, _ = lsim(([1.0], [LAW.mass_kg, LAW.damping_n_s_per_m, 0.0]), force, time)
    return np.asarray(position)


def steps(seconds: float, size_n: float) -> FloatArray:
    count = round(seconds / H_S)
    return size_n * np.concatenate([np.ones(count // 2), -0.5 * np.ones(count // 4), np.zeros(count - 3 * count // 4)])


def test_the_admittance_behind_a_command_is_found_although_the_desired_force_steps() -> None:
    force = slow_force(8.0, 20.0)
    law = find_admittance(driven(force + steps(8.0, 30.0)), force, H_S)
    assert law is not None
    # The filter smears each of the three steps; half of the samples would have to be hit to matter to the fit.
    assert law.mass_kg == pytest.approx(LAW.mass_kg, rel=0.05)
    assert law.damping_n_s_per_m == pytest.approx(LAW.damping_n_s_per_m, rel=0.01)


@pytest.mark.parametrize("mass", [3.0, 14.0, 50.0])
def test_a_passive_payload_on_a_commanded_sweep_is_no_admittance(mass: float) -> None:
    command = sweep(8.0, 1.0 / H_S)
    force = felt_force(command, H_S, Load(mass=mass))
    assert find_admittance(command, force, H_S) is None
    assert not is_stepped(command, force, H_S, LAW)


def test_a_commanded_move_is_driven_by_nothing_that_steps() -> None:
    command = np.concatenate([np.zeros(50), 0.08 * ramp(600), np.full(50, 0.08)])
    force = felt_force(command, H_S, Load())
    assert find_admittance(command, force, H_S) is None
    assert not is_stepped(command, force, H_S, LAW)


def test_a_desired_force_that_steps_is_reported_from_the_force() -> None:
    command = driven(steps(4.0, 30.0))
    assert is_stepped(command, np.zeros(len(command)), H_S, LAW)
    force = slow_force(4.0, 20.0)
    assert is_stepped(driven(force + steps(4.0, 30.0)), force, H_S, LAW)
    assert not is_stepped(driven(force), np.zeros(len(force)), H_S, LAW)


def test_what_is_too_short_is_not_judged() -> None:
    few = np.linspace(0.0, 1e-3, 40)
    assert find_admittance(few, few, H_S) is None
    assert not is_stepped(few, few, H_S, LAW)


def test_a_payload_gives_back_no_more_than_its_speed_is_worth() -> None:
    """½ M v² at the start is all that a payload without a hand can do: 16 kg at 0.1 m/s are 0.08 J, 8 N over 10 mm."""
    position = np.linspace(0.0, 0.01, 51)  # 0.1 m/s at 2 ms
    for force, led in ((7.0, False), (9.0, True), (-9.0, False)):
        assert is_hand_led(position, np.full(51, force), H_S, 16.0, 0.0) is led
    # A force that may be off by 2 N explains 0.02 J more.
    assert not is_hand_led(position, np.full(51, 9.0), H_S, 16.0, 2.0)


def test_a_command_that_rests_is_not_followed() -> None:
    path = 0.02 * ramp(500)
    assert follows(path, path)
    assert follows(0.5 * path, path)
    assert not follows(0.1 * path, path)
    assert not follows(1e-2 * path, 1e-2 * path)
