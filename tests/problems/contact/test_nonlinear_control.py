import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.arrays import FloatArray
from problems.contact.nonlinear_kernel import seen_force
from problems.contact.nonlinear_simulation import NonlinearRun, build_controller, simulate_nonlinear
from problems.contact.nonlinearities import (
    Collision,
    CommandLimits,
    Deadband,
    DeadbandType,
    Nonlinearities,
    VariableDamping,
)
from problems.contact.transient import Approach
from problems.model.controller import AdmittanceController
from tests.problems.axes import LAW, PERIOD_S, PRESS, admittance, one_pole, paper_plant
from tests.problems.nonlinear_runs import (
    COMPENSATING,
    FIRM,
    PRINTED,
    SUBTRACTIVE,
    THRESHOLD,
    light_plant,
    simulate,
)


@pytest.mark.parametrize(
    ("effects", "expected"),
    [
        (Nonlinearities(), [-40.0, -5.0, -4.0, 0.0, 5.0, 5.5, 40.0]),
        (Nonlinearities(deadband=THRESHOLD), [-40.0, 0.0, 0.0, 0.0, 0.0, 5.5, 40.0]),
        (Nonlinearities(deadband=SUBTRACTIVE), [-35.0, 0.0, 0.0, 0.0, 0.0, 0.5, 35.0]),
        (Nonlinearities(force_limit_n=30.0), [-30.0, -5.0, -4.0, 0.0, 5.0, 5.5, 30.0]),
        (Nonlinearities(force_limit_n=30.0, deadband=SUBTRACTIVE), [-25.0, 0.0, 0.0, 0.0, 0.0, 0.5, 25.0]),
    ],
)
def test_clipping_and_then_the_deadband_shape_the_force(effects: Nonlinearities, expected: list[float]) -> None:
    law = build_controller(FIRM, effects, PERIOD_S)
    assert [seen_force(law, force)[0] for force in (-40.0, -5.0, -4.0, 0.0, 5.0, 5.5, 40.0)] == expected


@pytest.mark.parametrize("kind", DeadbandType)
def test_the_controller_sees_what_clipping_and_deadband_leave(kind: DeadbandType) -> None:
    deadband = Deadband(width_n=8.0, kind=kind)
    plant, effects = paper_plant(stiffness=3e4), Nonlinearities(deadband=deadband, force_limit_n=28.0)
    approach = Approach(force_n=27.0 if kind == "threshold" else 19.0, after_impact_n=None)
    run = simulate(plant, admittance(damping=1000.0), approach, effects=effects, distance=0.002, duration=2.0)
    clipped = np.clip(run.sensor_force_n, -28.0, 28.0)
    size = np.abs(clipped)
    through = clipped if kind == "threshold" else np.sign(clipped) * (size - 8.0)
    np.testing.assert_array_equal(run.seen_force_n, np.where(size > 8.0, through, 0.0))
    np.testing.assert_array_equal(run.is_clipped, np.abs(run.sensor_force_n) > 28.0)
    np.testing.assert_array_equal(run.is_dead, size <= 8.0)
    assert np.any(run.is_clipped)
    assert np.any(run.is_dead)


@LAW
@given(st.floats(0.004, 0.05), st.floats(0.05, 20.0), st.sampled_from([None, 0.005]))
def test_the_command_never_exceeds_its_limits(speed: float, acceleration: float, distance: float | None) -> None:
    effects = Nonlinearities(limits=CommandLimits(speed_m_s=speed, acceleration_m_s2=acceleration))
    run = simulate(paper_plant(stiffness=2e5), PRINTED, effects=effects, distance=distance, duration=0.8)
    first = run.command_m[0] - (0.0 if distance is None else -distance)
    steps = np.diff(run.command_m) if distance is None else np.concatenate([[0.0, first], np.diff(run.command_m)])
    # Differences of positions of up to 0.03 m.
    assert np.max(np.abs(steps)) <= speed * PERIOD_S + 1e-17
    assert np.max(np.abs(np.diff(steps))) <= acceleration * PERIOD_S**2 + 3e-17
    assert np.any(run.is_limited) or np.max(np.abs(steps)) < speed * PERIOD_S


def test_a_limit_that_is_never_reached_changes_nothing() -> None:
    plant, effects = paper_plant(), Nonlinearities(limits=CommandLimits(speed_m_s=1.0, acceleration_m_s2=1e3))
    run, plain = simulate(plant, COMPENSATING, effects=effects), simulate(plant, COMPENSATING)
    assert not np.any(run.is_limited)
    np.testing.assert_array_equal(run.command_m, plain.command_m)


def replay(run: NonlinearRun, controller: AdmittanceController, desired: float, response: str) -> FloatArray:
    """Return x^d as the paper's difference equation and Algorithm 1 make it from what the controller saw.

    With feedback damping x^d = x_a − C_fb x, and the equation and the algorithm are those of x_a.
    """
    h, m, lead, corner = PERIOD_S, controller.mass_kg, 2.0 * controller.lead_s / PERIOD_S, 120.0
    force, position = desired - run.seen_force_n, run.flange_position_m
    event = -1 if run.collision_time_s is None or response == "none" else round(run.collision_time_s / h)
    assert run.impact_speed_m_s is not None
    back = [controller.feedback_damping_s * run.impact_speed_m_s]
    for rise in np.diff(position):
        gain = 2.0 / h * controller.feedback_damping_s * corner
        back.append((gain * rise - (corner - 2.0 / h) * back[-1]) / (corner + 2.0 / h))
    out = [float(run.command_m[0]), float(run.command_m[1])]
    now, before = out[1] + back[1], out[0] + back[0]
    for t in range(1, len(force) - 1):
        if t + 1 == event or (response == "stop" and t + 1 > event):
            now = before = out[-1] + back[t + 1]
        else:
            ratio = run.damping_n_s_per_m[t + 1] * h / (2.0 * m)
            push = (1.0 + lead) * force[t + 1] + 2.0 * force[t] + (1.0 - lead) * force[t - 1]
            following = (2.0 * now - (1.0 - ratio) * before + h**2 / (4.0 * m) * push) / (1.0 + ratio)
            now, before = following, now
        out.append(now - back[t + 1])
    return np.array(out)


@pytest.mark.parametrize("response", ["none", "reset", "stop"])
@pytest.mark.parametrize("variable", [None, VariableDamping()])
@pytest.mark.parametrize("controller", [admittance(damping=800.0, lead=0.013), PRINTED])
def test_the_commands_are_those_of_the_papers_difference_equation_and_algorithm(
    response: str, variable: VariableDamping | None, controller: AdmittanceController
) -> None:
    """Variable damping and the collision response act on x^d_t and x^d_{t−1}: the equation goes on from these."""
    collision = Collision(response=response, threshold_n=7.0)  # type: ignore[arg-type]
    effects = Nonlinearities(deadband=Deadband(width_n=5.0), collision=collision, variable_damping=variable)
    run = simulate(light_plant(3.2e4), controller, effects=effects, duration=1.6)
    assert run.collision_time_s is not None
    assert variable is None or np.ptp(run.damping_n_s_per_m) > 50.0
    # Sums rounding errors of 1e-18 twice over 2000 ticks: n²/2 = 2e6 of them.
    np.testing.assert_allclose(run.command_m, replay(run, controller, 30.0, response), rtol=0.0, atol=5e-12)


@pytest.mark.parametrize(
    ("discretization", "compensation"),
    [
        *((rule, kind) for rule in ("tustin", "backward_euler") for kind in ("none", "filtered", "ideal")),
        *(("forward_euler", kind) for kind in ("none", "filtered")),
    ],
)
def test_going_on_from_the_last_two_commands_changes_nothing_by_itself(discretization: str, compensation: str) -> None:
    """A constant B_a that is written anew at every tick is the constant B_a, whatever the form of the controller."""
    controller = AdmittanceController(
        mass_kg=13.0,
        damping_n_s_per_m=3000.0,
        lead_s=0.02,
        feedback_damping_s=5e-3,
        compensation_mass_kg=0.0 if compensation == "none" else 6.0,
        compensation="ideal" if compensation == "ideal" else "filtered",
        discretization=discretization,  # type: ignore[arg-type]
    )
    plant, constant = paper_plant(stiffness=1e5, robot=one_pole(2.0e-3)), (3000.0, 0.0, 100.0)
    variable = VariableDamping(
        scale_n_s_per_m=constant[0],
        decay_s_per_m=constant[1],
        floor_n_s_per_m=constant[2],
        update_period_s=PERIOD_S,
    )
    plain = simulate(plant, controller)
    again = simulate_nonlinear(
        plant,
        controller,
        PRESS,
        sample_time_s=PERIOD_S,
        duration_s=0.32,
        effects=Nonlinearities(variable_damping=variable),
        even_if_unstable=True,  # at the floor, which is never reached
    )
    # Rounding of 1e-17 m at each of 400 ticks, divided by 1 − p = 0.17; as a force, times 1e5 N/m.
    np.testing.assert_allclose(again.command_m, plain.command_m, atol=1e-13)
    np.testing.assert_allclose(again.sensor_force_n, plain.sensor_force_n, atol=1e-8)


def respond(response: str, stiffness: float, controller: AdmittanceController = PRINTED) -> NonlinearRun:
    collision = Collision(response=response, threshold_n=7.0)  # type: ignore[arg-type]
    plant = light_plant(stiffness)
    return simulate(plant, controller, effects=Nonlinearities(collision=collision), duration=2.0)


@pytest.mark.parametrize("stiffness", [1.5e4, 2.4e4, 3.2e4])
def test_the_collision_response_lowers_the_peak_and_keeps_pressing(stiffness: float) -> None:
    """Paper, "Collision Detection": 6.3 kg, B_a = 800, K_e of 15 to 32 N/mm; there 44 N become 36 N."""
    plain, reset, stop = (respond(response, stiffness) for response in ("none", "reset", "stop"))
    assert reset.peak_sensor_force_n < plain.peak_sensor_force_n
    assert reset.peak_contact_force_n < plain.peak_contact_force_n
    # Admittance control goes on: 2 s are ten of the slowest time constants and more.
    assert reset.sensor_force_n[-1] == pytest.approx(30.0, rel=1e-3)
    # A full stop leaves what the robot has already been sent: no force above the one it comes to rest with.
    assert stop.peak_sensor_force_n == pytest.approx(stop.sensor_force_n[-1], rel=5e-3)
    assert plain.collision_time_s == reset.collision_time_s == stop.collision_time_s


def first_opposed(run: NonlinearRun, threshold: float) -> int:
    """Return the first tick with −F·sign(v) above the threshold, v the way since the tick before."""
    moving = np.sign(np.diff(run.flange_position_m))
    return int(np.argmax(run.seen_force_n[1:] * moving > threshold)) + 1


@pytest.mark.parametrize(
    ("approach", "stiffness"),
    [
        # A hand of 20 N moves the flange along, until the wall opposes it.
        pytest.param(Approach(force_n=20.0, driven_by="hand"), 3.2e4, id="a force along the motion is none"),
        # It touches softly and goes back, against 60·150/950 = 9 N of drag.
        pytest.param(Approach(force_n=10.0, after_impact_n=-60.0), 1e3, id="on the way back"),
    ],
)
def test_a_collision_is_a_force_against_the_motion(approach: Approach, stiffness: float) -> None:
    effects = Nonlinearities(collision=Collision(response="none", threshold_n=7.0))
    run = simulate(light_plant(stiffness), PRINTED, approach, effects=effects, distance=0.002, duration=2.0)
    event = first_opposed(run, 7.0)
    assert run.impact_time_s is not None
    assert run.impact_time_s < event * PERIOD_S
    assert run.collision_time_s == pytest.approx(event * PERIOD_S, rel=1e-12)
    assert np.max(np.abs(run.seen_force_n[:event])) > 7.0 or run.flange_velocity_m_s[event] < 0.0


@pytest.mark.parametrize("response", ["reset", "stop"])
@pytest.mark.parametrize("controller", [admittance(damping=800.0, lead=0.013), PRINTED])
def test_the_response_holds_the_command_at_the_first_force_above_the_threshold(
    response: str, controller: AdmittanceController
) -> None:
    run, plain = respond(response, 3.2e4, controller), respond("none", 3.2e4, controller)
    event = first_opposed(run, 7.0)
    assert run.collision_time_s == pytest.approx(event * PERIOD_S, rel=1e-12)
    np.testing.assert_array_equal(run.command_m[:event], plain.command_m[:event])
    assert run.command_m[event] == run.command_m[event - 1]
    steps = np.abs(np.diff(run.command_m))
    if response == "stop":
        assert np.all(steps[event - 1 :] == 0.0)
    else:
        # What is left is the contribution of the forces, and of C_fb as the flange slows down: no jump.
        assert np.max(steps[event - 1 : event + 5]) < 0.5 * steps[event - 2]
        assert steps[event] > 0.0


def test_the_response_comes_once() -> None:
    run = respond("reset", 3.2e4)
    still = np.flatnonzero(np.diff(run.command_m[: round(0.5 / PERIOD_S)]) == 0.0) + 1
    assert run.collision_time_s is not None
    assert still.tolist() == [round(run.collision_time_s / PERIOD_S)]


def velocities(run: NonlinearRun) -> FloatArray:
    return np.asarray(np.diff(run.command_m) / PERIOD_S)


def test_with_a_limited_acceleration_the_response_lasts_until_the_command_rests() -> None:
    effects = Nonlinearities(collision=Collision(threshold_n=7.0), limits=CommandLimits(acceleration_m_s2=2.0))
    run = simulate(light_plant(3.2e4), PRINTED, effects=effects, duration=0.2)
    assert run.collision_time_s is not None
    event, speed = round(run.collision_time_s / PERIOD_S), velocities(run)
    ticks = math.ceil(speed[event - 2] / (2.0 * PERIOD_S)) - 1
    assert ticks > 5
    # Differences of positions of 1e-3 m over 8e-4 s.
    expected = speed[event - 2] - 2.0 * PERIOD_S * np.arange(1, ticks + 1)
    np.testing.assert_allclose(speed[event - 1 : event - 1 + ticks], expected, atol=1e-14)
    assert speed[event - 1 + ticks] == 0.0


@LAW
@given(
    st.floats(100.0, 1500.0),
    st.floats(0.0, 60.0),
    st.floats(400.0, 1000.0),
    st.floats(1e-3, 0.03),
    st.floats(1.0, 80.0),
)
def test_the_damping_stays_within_its_law_and_changes_little_by_little(
    scale: float, decay: float, floor: float, period: float, change: float
) -> None:
    variable = VariableDamping(
        scale_n_s_per_m=scale,
        decay_s_per_m=decay,
        floor_n_s_per_m=floor,
        update_period_s=period,
        largest_change_n_s_per_m=change,
    )
    run = simulate_nonlinear(
        light_plant(1e4),
        PRINTED,
        Approach(force_n=60.0),
        sample_time_s=PERIOD_S,
        duration_s=0.6,
        effects=Nonlinearities(variable_damping=variable),
        start_distance_m=0.01,
        even_if_unstable=True,
    )
    damping = run.damping_n_s_per_m
    low, high = variable.bounds_n_s_per_m
    assert low <= np.min(damping) <= np.max(damping) <= high
    assert damping[0] == high
    steps = np.diff(damping)
    # Rounding of numbers of 1e3.
    assert np.max(np.abs(steps)) <= change + 1e-12
    due = np.zeros(len(steps), dtype=bool)
    updates = np.ceil(np.arange(1, 0.6 / period + 1) * (period / PERIOD_S) - 1e-6).astype(int)
    due[updates[updates <= len(steps)] - 1] = True
    assert np.all(steps[~due] == 0.0)
    # Towards the law at each update, as far as the step allows.
    moves = np.flatnonzero(due)
    moves = moves[moves > 0]
    speed = np.diff(run.flange_position_m)[moves] / PERIOD_S
    wanted = np.maximum(scale * np.exp(-decay * np.abs(speed)), floor)
    expected = damping[moves] + np.clip(wanted - damping[moves], -change, change)
    # The speed is a difference of positions of 0.01 m: 1e-18/8e-4 times the slope of the law, 1e5.
    np.testing.assert_allclose(damping[moves + 1], expected, rtol=1e-11)


def test_variable_damping_is_back_up_only_after_the_peak() -> None:
    """Paper, "Variable Admittance": the damping comes up after the initial collision peak."""
    effects = Nonlinearities(variable_damping=VariableDamping())
    plant = light_plant(3.2e4)
    run = simulate(plant, PRINTED, Approach(speed_m_s=0.08), effects=effects, duration=1.0)
    after = run.damping_n_s_per_m[round(run.time_of_peak_s / PERIOD_S)]
    constant = simulate(plant, PRINTED, Approach(speed_m_s=0.08), duration=1.0)
    assert run.damping_n_s_per_m[0] == 550.0
    assert after < 0.9 * 800.0
    assert run.damping_n_s_per_m[-1] > 0.95 * 800.0
    assert constant.damping_n_s_per_m.tolist() == [800.0] * len(constant.time_s)
