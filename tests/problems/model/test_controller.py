import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.controller import (
    CONTROLLER_STATES,
    AdmittanceController,
    Compensation,
    Discretization,
    check_feedback_damping,
    controller_blocks,
    controller_step,
    feedback_damping_from_paper_mm,
    feedback_damping_from_paper_per_sample,
    needed_states,
    write_first_order,
)
from problems.model.response import controller_response
from problems.model.sampled import controller_matrices
from tests.problems.axes import LAW, PERIOD_S, STRUCTURES, admittance, any_controllers, between, controllers
from tests.problems.reference import DifferenceEquation, SampledLaw, sampled_controller, transfer

PERIODS = between(2e-4, 8e-3)
EVERY_STRUCTURE = pytest.mark.parametrize("name", STRUCTURES)


def sizes(controller: AdmittanceController, s: complex, h: float) -> tuple[float, float]:
    """Return how large the terms are that the two transfer functions are sums of."""
    m, b, lead = controller.mass_kg, controller.damping_n_s_per_m, controller.lead_s
    forward = (h + 1.0 / abs(s)) / b + abs(lead - m / b) / abs(m * s + b)
    corner, second = controller.velocity_filter_rad_per_s, controller.acceleration_filter_rad_per_s
    velocity = abs(corner * s / (s + corner))
    filtered = forward * velocity * abs(second * s / (s + second))
    ideal = abs(lead * s / m) + abs((1.0 - lead * b / m) / m)
    compensation = controller.compensation_mass_kg * (ideal if controller.compensation == "ideal" else filtered)
    return forward, controller.feedback_damping_s * velocity + compensation


def point(controller: AdmittanceController, h: float, s: complex) -> complex:
    """Return z with s = (z − 1)/(h (θ z + 1 − θ))."""
    return (1.0 + (1.0 - controller.theta) * h * s) / (1.0 - controller.theta * h * s)


@LAW
@given(any_controllers(), PERIODS, between(1.0, 3000.0), st.floats(-1.5, 1.5))
def test_the_blocks_are_the_continuous_form_at_the_substituted_point(
    controller: AdmittanceController, h: float, size: float, angle: float
) -> None:
    """A(1 + C_ff) and C_fb − A(1 + C_ff) P̂ O_a as docs/method.md writes them, for all three rules, at complex s."""
    c, s = controller, complex(size * np.exp(1j * angle))
    m, b, corner, second = c.mass_kg, c.damping_n_s_per_m, c.velocity_filter_rad_per_s, c.acceleration_filter_rad_per_s
    acceleration = s * s if c.compensation == "ideal" else corner * second * s * s / ((s + second) * (s + corner))
    a = (1.0 + c.lead_s * s) / (m * s * s + b * s)
    feedback = c.feedback_damping_s * corner * s / (s + corner) - a * c.compensation_mass_kg * acceleration
    found = controller_response(c, np.array([point(c, h, s)]), h)
    # z − 1 has an absolute rounding of 1e-16 and is 2e-4 at the lowest; 1 − θ h s may be nearly zero.
    for value, expected, terms in zip(found, (a, feedback), sizes(c, s, h), strict=True):
        assert abs(value[0] - expected) <= 1e-9 * (abs(expected) + terms)


@LAW
@given(any_controllers(), PERIODS, st.floats(0.01, 0.99))
def test_the_blocks_are_scipys_sampled_forms(controller: AdmittanceController, h: float, share: float) -> None:
    """scipy's generalized bilinear transformation with α = θ, put together by python-control."""
    z = complex(np.exp(1j * np.pi * share))
    found = controller_response(controller, np.array([z]), h)
    s = (z - 1.0) / (h * (controller.theta * z + 1.0 - controller.theta))
    for value, system, terms in zip(found, sampled_controller(controller, h), sizes(controller, s, h), strict=True):
        # Near z = 1 the solve loses |z − 1|², here at worst 1e-3, and the frequency scale of s² at z = −1.
        assert abs(value[0] - transfer(system, z)[0, 0]) <= 1e-9 * (abs(value[0]) + terms)


def run(controller: AdmittanceController, forces: FloatArray, positions: FloatArray, h: float) -> FloatArray:
    """Iterate `controller_step` from rest at zero."""
    blocks, state, out = controller_blocks(controller, h), (0.0,) * 6, []
    for force, position in zip(forces, positions, strict=True):
        command, state = controller_step(blocks, state, force, position)
        out.append(command)
    return np.array(out)


def shaken(seed: int, samples: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    return 50.0 * rng.standard_normal(samples), 0.01 * rng.standard_normal(samples)


@LAW
@given(controllers(), st.integers(0, 2**32 - 1))
def test_the_step_is_the_papers_difference_equation(controller: AdmittanceController, seed: int) -> None:
    forces, positions = shaken(seed, 600)
    printed = DifferenceEquation(controller, PERIOD_S)
    theirs = [printed.step(force, position) for force, position in zip(forces, positions, strict=True)]
    # The printed form sums rounding errors of 1e-16 twice: at most n²/2 = 2e5 of them.
    tolerance = 1e-10 * np.max(np.abs(theirs))
    np.testing.assert_allclose(run(controller, forces, positions, PERIOD_S), theirs, rtol=0.0, atol=tolerance)


@LAW
@given(any_controllers(), PERIODS, st.integers(0, 2**32 - 1))
def test_the_step_is_a_difference_equation_of_multiplied_out_polynomials(
    controller: AdmittanceController, h: float, seed: int
) -> None:
    """Every structure and rule against direct forms, whose coefficients are those of the substituted polynomials."""
    forces, positions = shaken(seed, 300)
    law = SampledLaw(controller, h)
    theirs = [law.step(force, position) for force, position in zip(forces, positions, strict=True)]
    # Direct forms sum rounding twice, n²/2 = 5e4; the ideal Tustin form has (z + 1)² below on top.
    tolerance = 1e-9 * np.max(np.abs(theirs))
    np.testing.assert_allclose(run(controller, forces, positions, h), theirs, rtol=0.0, atol=tolerance)


@LAW
@given(any_controllers(), st.floats(0.02, 3.1), st.sampled_from([0.9, 1.02]))
def test_the_gains_are_those_of_the_step(controller: AdmittanceController, angle: float, radius: float) -> None:
    z, r = radius * np.exp(1j * angle), len(needed_states(controller_blocks(controller, PERIOD_S)))
    m = matrices(controller)
    states = np.linalg.solve(z * np.eye(r) - m[:r, :r], m[:r, r:].astype(complex))
    forward, feedback = controller_response(controller, np.array([z]), PERIOD_S)
    found = m[r, :r] @ states + m[r, r:]
    # A sum of four blocks of order one, each within rounding over |z − pole|.
    np.testing.assert_allclose(found, [forward[0], -feedback[0]], rtol=1e-10, atol=1e-12 * np.max(np.abs(m[r])))


def matrices(controller: AdmittanceController, kept: list[int] | None = None) -> FloatArray:
    """Return rows (states, command) over columns (states, e, x) of the difference equation."""
    blocks = controller_blocks(controller, PERIOD_S)
    return controller_matrices(blocks, needed_states(blocks) if kept is None else np.array(kept))


@LAW
@given(any_controllers(), st.integers(0, 2**32 - 1))
def test_the_states_that_are_dropped_are_those_that_the_command_never_sees(
    controller: AdmittanceController, seed: int
) -> None:
    m, outputs = matrices(controller), []
    r, state = len(m) - 1, np.zeros(len(m) - 1)
    inputs = np.array(shaken(seed, 200)).T
    for both in inputs:
        outputs.append(m[r, :r] @ state + m[r, r:] @ both)
        state = m[:r, :r] @ state + m[:r, r:] @ both
    whole = run(controller, inputs[:, 0], inputs[:, 1], PERIOD_S)
    # The same products in another order.
    np.testing.assert_allclose(outputs, whole, rtol=0.0, atol=1e-12 * np.max(np.abs(whole)))


@EVERY_STRUCTURE
def test_no_needed_state_can_be_left_out(name: str) -> None:
    """Every pole is seen by the command and moved by the inputs (Hautus), so the realisation is minimal."""
    m = matrices(STRUCTURES[name])
    r = len(m) - 1
    a, b, c = m[:r, :r], m[:r, r:], m[r:, :r]
    # Only relative sizes count: inputs that act, every state in the size that they give it, and the output in its own.
    b = b[:, np.any(b != 0.0, axis=0)]
    b = b / np.max(np.abs(b), axis=0)
    scale = np.max(np.abs(b), axis=1)
    a, b, c = a * scale / scale[:, None], b / scale[:, None], c * scale
    for pole in np.linalg.eigvals(a):
        seen = np.vstack([a - pole * np.eye(r), c / np.max(np.abs(c))])
        moved = np.hstack([a - pole * np.eye(r), b])
        # A hidden pole would leave rounding; B_fb moves the command a million times less than the derivative of x.
        assert np.linalg.svd(seen)[1][-1] > 1e-9
        assert np.linalg.svd(moved)[1][-1] > 1e-9


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("plain", 2),
        ("lead", 2),
        ("feedback", 3),
        ("filtered", 4),
        ("filtered, feedback", 4),
        ("ideal", 2),
        ("ideal, lead", 3),
        ("ideal, lead, feedback", 4),
    ],
)
def test_the_number_of_states_is_that_of_the_poles(name: str, count: int) -> None:
    assert len(needed_states(controller_blocks(STRUCTURES[name], PERIOD_S))) == count


def test_a_lead_that_cancels_the_admittance_mass_leaves_an_integrator() -> None:
    """K_l = M_a/B_a: A(1 + C_ff) = 1/(B_a s)."""
    controller = admittance(mass=10.0, damping=1000.0, lead=0.01)
    assert needed_states(controller_blocks(controller, PERIOD_S)).tolist() == [0]


@EVERY_STRUCTURE
def test_a_constant_force_moves_at_force_over_damping(name: str) -> None:
    controller = STRUCTURES[name]
    # 1.6 s are 120 time constants M_a/B_a; the flange stands still.
    outputs = run(controller, np.full(2000, 30.0), np.zeros(2000), PERIOD_S)
    # A difference of positions of 0.05 m over one period: 1e-17/8e-4 against 0.03 m/s.
    assert (outputs[-1] - outputs[-2]) / PERIOD_S == pytest.approx(30.0 / controller.damping_n_s_per_m, rel=1e-11)


@pytest.mark.parametrize("name", ["filtered", "filtered, forward Euler", "ideal", "ideal, backward Euler"])
def test_the_compensation_adds_the_payloads_mass_times_the_acceleration(name: str) -> None:
    """A steady acceleration a is answered as a steady force P̂ a: the command's speed grows by P̂ a/B_a in the end.

    With a force −P̂ a at the sensor, as the payload's inertia gives it, nothing is left of it.
    """
    controller, steps = STRUCTURES[name], 6000
    times, acceleration = PERIOD_S * np.arange(steps), 0.4
    inertia = np.full(steps, -controller.compensation_mass_kg * acceleration)
    outputs = run(
        replace(controller, feedback_damping_s=0.0), inertia, np.asarray(0.5 * acceleration * times**2), PERIOD_S
    )
    # After 4.8 s all filters (slowest: 1/77 s) have decayed; positions of 5 m lose 1e-15/h² in second differences.
    speed = np.diff(outputs[-1000:]) / PERIOD_S
    assert np.max(np.abs(speed)) < 1e-7 * controller.compensation_mass_kg * acceleration * 4.8


@pytest.mark.parametrize(
    ("theta", "expected"), [(0.5, (0.25, 1.0, 0.5)), (0.0, (0.0, 1.0, 0.5)), (1.0, (0.5, 1.0, 0.5))]
)
def test_an_integrator_is_summed_by_the_trapezoidal_or_a_rectangular_rule(
    theta: float, expected: tuple[float, float, float]
) -> None:
    block: Any = np.zeros((1, 3))
    write_first_order(block, 0, 0.0, 1.0, 1.0, 0.0, 0.5, theta)
    assert tuple(block[0]) == expected


@pytest.mark.parametrize("printed", [2e-5, 7.5e-6])
def test_the_printed_feedback_damping_is_refused_with_an_explanation(printed: float) -> None:
    """docs/method.md, erratum 2."""
    with pytest.raises(ParameterError, match="feedback_damping_from_paper_mm"):
        admittance(feedback=printed)


def test_the_named_conversion_takes_the_printed_value() -> None:
    # One product of two rounded numbers.
    assert feedback_damping_from_paper_mm(7.5e-6) == pytest.approx(7.5e-3, rel=1e-15)
    assert feedback_damping_from_paper_mm(0.0) == 0.0
    with pytest.raises(ParameterError):
        feedback_damping_from_paper_mm(1e-8)


def test_the_other_reading_of_the_printed_value_divides_by_the_period() -> None:
    assert feedback_damping_from_paper_per_sample(8e-6, 8e-4) == pytest.approx(0.01, rel=1e-15)
    with pytest.raises(ParameterError, match="sample_time_s"):
        feedback_damping_from_paper_per_sample(8e-6, 0.0)


def test_no_feedback_damping_is_allowed_and_so_is_the_smallest() -> None:
    assert check_feedback_damping(0.0) == 0.0
    assert check_feedback_damping(1e-4) == 1e-4


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mass_kg", 0.0),
        ("mass_kg", math.nan),
        ("damping_n_s_per_m", 0.0),
        ("damping_n_s_per_m", -5.0),
        ("lead_s", -1e-3),
        ("lead_s", math.inf),
        ("feedback_damping_s", -1e-3),
        ("feedback_damping_s", math.nan),
        ("velocity_filter_rad_per_s", 0.0),
        ("acceleration_filter_rad_per_s", -200.0),
        ("compensation_mass_kg", -1.0),
        ("compensation_mass_kg", math.inf),
    ],
)
def test_values_that_cannot_be_are_refused(name: str, value: float) -> None:
    with pytest.raises(ParameterError, match=name):
        replace(admittance(), **{name: value})  # type: ignore[arg-type]


def test_an_ideal_compensation_has_no_forward_euler_form() -> None:
    """s² ahead of time is none; without compensation the word says nothing."""
    with pytest.raises(ParameterError, match="discretization"):
        replace(STRUCTURES["ideal"], discretization="forward_euler")
    assert not replace(admittance(), compensation="ideal", discretization="forward_euler").is_ideal


@pytest.mark.parametrize(("name", "value"), [("compensation", "perfect"), ("discretization", "zoh")])
def test_unknown_words_are_refused(name: str, value: str) -> None:
    with pytest.raises(ParameterError, match=name):
        replace(admittance(), **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(("rule", "theta"), [("tustin", 0.5), ("forward_euler", 0.0), ("backward_euler", 1.0)])
def test_the_rule_is_a_theta(rule: Discretization, theta: float) -> None:
    assert replace(admittance(), discretization=rule).theta == theta


@pytest.mark.parametrize(
    ("compensation", "mass", "compensates", "ideal"),
    [("filtered", 0.0, False, False), ("filtered", 8.0, True, False), ("ideal", 8.0, True, True)],
)
def test_a_mass_is_what_turns_the_compensation_on(
    compensation: Compensation, mass: float, compensates: bool, ideal: bool
) -> None:
    controller = replace(admittance(), compensation=compensation, compensation_mass_kg=mass)
    assert (controller.compensates, controller.is_ideal) == (compensates, ideal)


@pytest.mark.parametrize("period_s", [0.0, -8e-4, math.nan])
def test_the_period_must_be_positive(period_s: float) -> None:
    with pytest.raises(ParameterError, match="sample_time_s"):
        controller_blocks(admittance(), period_s)


def test_the_equations_get_the_parameters_in_their_order() -> None:
    controller = AdmittanceController(
        mass_kg=1.0,
        damping_n_s_per_m=2.0,
        lead_s=3.0,
        feedback_damping_s=4.0,
        velocity_filter_rad_per_s=5.0,
        acceleration_filter_rad_per_s=6.0,
        compensation_mass_kg=7.0,
    )
    assert controller.parameters().tolist() == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert controller_blocks(controller, PERIOD_S).shape == (CONTROLLER_STATES + 2, 3)
