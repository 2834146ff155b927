"""Another controller takes over while the cell runs: what is sent goes on, at its speed, and as the matrices say."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.runtime import AxisLaw, RuntimeController, change, step
from autotune.runtime.step import State
from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.sampled import build_sampled_plant
from problems.stability.dwell import common_loop
from tests.autotune.runtime.cases import (
    PERIOD_S,
    STARTED,
    WALL,
    Reading,
    make_axis,
    make_runtime,
    random_readings,
    run_contact,
)

HEAVY = make_runtime(make_axis("x"))
LIGHT = make_runtime(
    replace(
        make_axis("x"), mass=7.0, damping=900.0, lead_s=0.02, feedback_damping_s=0.01, velocity_filter_rad_per_s=90.0
    )
)


class Driver:
    """Steps one of two controllers; at the given periods the other one takes over, bare or with its memory."""

    def __init__(self, *controllers: RuntimeController, at: tuple[int, ...], bare: bool = False) -> None:
        self.controllers, self.at, self.bare, self.count = controllers, at, bare, 0
        self.running, self.state, self.increments = controllers[0], STARTED, list[float]()

    def increment(self, reading: Reading) -> FloatArray:
        if self.count in self.at:
            other = self.controllers[1 - self.controllers.index(self.running)]
            if self.bare:
                self.running = other
            else:
                self.state, self.running = change(self.running, other, self.state, dwell_time_s=0.0)
        self.state, command = step(self.running, self.state, **reading.arguments())  # type: ignore[arg-type]
        self.count += 1
        self.increments.append(command.increment_S[0])
        return np.array(command.increment_S)


def bump(driver: Driver, at: int) -> float:
    """The change of the command's speed at one period [m/s], beside the largest one before it."""
    speeds = np.array(driver.increments) / PERIOD_S
    return float(abs(speeds[at] - speeds[at - 1]))


def press(driver: Driver, distance_m: float = 0.02) -> FloatArray:
    return run_contact(driver.increment, 0, force_n=60.0, distance_m=distance_m, duration_s=0.6).sensor_n


def test_the_speed_of_the_command_goes_on_where_without_the_memory_it_jumps() -> None:
    """Free motion at 30 mm/s: a bare change sends what the other one's states happen to say, for one period."""
    at = 250
    smooth, jumping, alone = (
        Driver(HEAVY, LIGHT, at=(at,)),
        Driver(HEAVY, LIGHT, at=(at,), bare=True),
        Driver(HEAVY, at=()),
    )
    for driver in (smooth, jumping, alone):
        press(driver)
    speed = abs(alone.increments[at - 1]) / PERIOD_S
    assert speed > 0.02
    # The new law's damping acts from this period on: h/M_a (F^d − B_a v) of it, and what its lead makes of the forces.
    assert bump(smooth, at) < 0.1 * speed
    assert bump(jumping, at) > 10.0 * bump(smooth, at)


def test_the_same_controller_takes_over_without_a_trace() -> None:
    alone, often = Driver(HEAVY, at=()), Driver(HEAVY, replace(HEAVY, checksum="cd" * 32), at=tuple(range(20, 600, 7)))
    one, other = press(alone, 0.005), press(often, 0.005)
    assert max(one) > 50.0
    # Rounding of the filters' outputs, read back from their states, in a contact that is stable.
    np.testing.assert_allclose(often.increments, alone.increments, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-6)


def test_there_and_back_within_a_period_is_nothing() -> None:
    state = STARTED
    for reading in random_readings(np.random.default_rng(2), 50):
        state, _ = step(HEAVY, state, **reading.arguments())  # type: ignore[arg-type]
    # Of another filter the last speed but one is not kept: the next period makes it anew.
    like = make_runtime(replace(LIGHT.axes[0], velocity_filter_rad_per_s=120.0))
    there, running = change(HEAVY, like, state, dwell_time_s=0.0)
    back, again = change(running, HEAVY, replaced(there), dwell_time_s=0.0)
    assert again is HEAVY
    now, then = state.axes[0], back.axes[0]
    scale = max(map(abs, (*now.control, now.output)))
    np.testing.assert_allclose(then.control, now.control, rtol=0.0, atol=1e-9 * scale)
    np.testing.assert_allclose((then.output, *then.older), (now.output, *now.older), rtol=0.0, atol=1e-9 * scale)


def replaced(state: State) -> State:
    return state._replace(since_change=10**6)


def test_a_change_before_the_dwell_time_is_put_off() -> None:
    state, running = change(HEAVY, LIGHT, STARTED, dwell_time_s=0.1)
    assert running is LIGHT
    periods = 0
    for reading in random_readings(np.random.default_rng(3), 200):
        state, _ = step(running, state, **reading.arguments())  # type: ignore[arg-type]
        periods += 1
        same, running = change(LIGHT, HEAVY, state, dwell_time_s=0.1)
        if running is HEAVY:
            break
        assert same is state
    assert periods == round(0.1 / PERIOD_S)


def test_other_axes_and_periods_are_refused() -> None:
    with pytest.raises(ParameterError, match="a controller of the same axes, x"):
        change(HEAVY, make_runtime(make_axis("y")), STARTED, dwell_time_s=0.0)
    with pytest.raises(ParameterError, match="dwell_time_s"):
        change(HEAVY, LIGHT, STARTED, dwell_time_s=float("nan"))


def law_of(axis: AxisLaw) -> AdmittanceController:
    return AdmittanceController(
        mass_kg=axis.mass,
        damping_n_s_per_m=axis.damping,
        lead_s=axis.lead_s,
        feedback_damping_s=axis.feedback_damping_s,
        velocity_filter_rad_per_s=axis.velocity_filter_rad_per_s,
        acceleration_filter_rad_per_s=axis.acceleration_filter_rad_per_s,
        compensation_mass_kg=axis.compensation_mass_kg,
    )


def test_the_runtime_does_what_the_shared_coordinates_say() -> None:
    """In contact from a bent coupling, changed every 40 periods: products of the matrices send the same commands."""
    sampled = build_sampled_plant(WALL, PERIOD_S)
    loops = [common_loop(sampled, law_of(each.axes[0])) for each in (HEAVY, LIGHT)]
    n = sampled.state_count
    z = np.zeros(len(loops[0]))
    z[n - 2] = 1e-4
    plant, past, state, running = z[:n].copy(), [0.0] * (sampled.chain_length + 1), STARTED, 0
    sent = moved = 0.0
    no_weight = replace(HEAVY.payload, mass_kg=0.0, force_bias_S_n=(0.0,) * 3, torque_bias_S_n_m=(0.0,) * 3)
    controllers = [replace(each, payload=no_weight) for each in (HEAVY, LIGHT)]
    for k in range(400):
        if k % 40 == 39:
            state, law = change(controllers[running], controllers[1 - running], state, dwell_time_s=0.0)
            running = controllers.index(law)
        position = float(sampled.c_position @ plant)
        force = float(sampled.c_force @ plant) + sampled.d_force * past[sampled.chain_length - 1]
        state, command = step(
            controllers[running],
            state,
            wrench_S=(force, 0.0, 0.0, 0.0, 0.0, 0.0),
            position_W_m=(position, 0.0, 0.0),
            R_WS=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
        )
        sent += command.increment_S[0]
        past = [sent, *past[:-1]]
        plant = sampled.phi @ plant + sampled.gamma * past[sampled.whole_delay]
        z = loops[running] @ z
        moved = max(moved, abs(sent))
        assert z[n] == pytest.approx(sent, abs=1e-9 * max(moved, 1e-6))
    assert moved > 1e-6
