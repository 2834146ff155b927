import math

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.controller import (
    AdmittanceController,
    check_feedback_damping,
    controller_blocks,
    feedback_damping_from_paper_mm,
    first_order_tustin,
)
from problems.errors import ParameterError
from problems.response import controller_response
from tests.problems.axes import LAW, PERIOD_S, admittance, between, controllers
from tests.problems.reference import DifferenceEquation

PERIODS = between(2e-4, 8e-3)


@LAW
@given(controllers(), PERIODS, st.floats(0.01, 0.99))
def test_the_blocks_are_pythons_controls_tustin(controller: AdmittanceController, h: float, share: float) -> None:
    z = np.array([np.exp(1j * np.pi * share)])
    m, b, corner = controller.mass_kg, controller.damping_n_s_per_m, controller.velocity_filter_rad_per_s
    forward, feedback = controller_response(controller, z, h)
    # As state space: multiplied out, python-control's numerator is a small difference of polynomials of size one.
    expected = control.c2d(control.tf2ss([controller.lead_s, 1.0], [m, b, 0.0]), h, "tustin")(z[0])
    per_second = control.c2d(control.tf2ss([corner, 0.0], [1.0, corner]), h, "tustin")(z[0])
    # Near z = 1 the solve loses |z − 1|², here at worst 1e-3, out of 1e-16; near z = −1 the sum cancels.
    direct = (2.0 / h * controller.lead_s + 1.0) / (m * (2.0 / h) ** 2 + b * 2.0 / h)
    np.testing.assert_allclose(forward[0], expected, rtol=1e-11, atol=1e-12 * direct)
    np.testing.assert_allclose(feedback[0], controller.feedback_damping_s * per_second, rtol=1e-11)


@LAW
@given(controllers(), PERIODS, st.floats(1e-4, 0.99))
def test_the_blocks_are_the_continuous_form_at_the_bilinear_point(
    controller: AdmittanceController, h: float, share: float
) -> None:
    angle = np.pi * share
    s = 2j / h * math.tan(angle / 2.0)
    forward, feedback = controller_response(controller, np.array([np.exp(1j * angle)]), h)
    m, b, corner = controller.mass_kg, controller.damping_n_s_per_m, controller.velocity_filter_rad_per_s
    # z − 1 has an absolute rounding of 1e-16 and is 3e-4 at the lowest.
    np.testing.assert_allclose(forward, (1.0 + controller.lead_s * s) / (m * s * s + b * s), rtol=1e-10)
    np.testing.assert_allclose(feedback, controller.feedback_damping_s * corner * s / (s + corner), rtol=1e-10)


@LAW
@given(controllers(), st.integers(0, 2**32 - 1))
def test_the_blocks_run_like_the_papers_difference_equation(controller: AdmittanceController, seed: int) -> None:
    rng = np.random.default_rng(seed)
    forces, positions = 50.0 * rng.standard_normal(600), 0.01 * rng.standard_normal(600)
    blocks, states = controller_blocks(controller.parameters(), PERIOD_S), np.zeros(3)
    printed, ours, theirs = DifferenceEquation(controller, PERIOD_S), [], []
    for force, position in zip(forces, positions, strict=True):
        inputs = np.array([force, force, position])
        outputs = blocks[:, 0] * inputs + states
        states = blocks[:, 1] * states + blocks[:, 2] * inputs
        ours.append(outputs[0] + outputs[1] - outputs[2])
        theirs.append(printed.step(force, position))
    # The printed form sums rounding errors of 1e-16 twice: at most n²/2 = 2e5 of them.
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-10 * np.max(np.abs(theirs)))


def test_a_constant_force_moves_at_force_over_damping() -> None:
    blocks = controller_blocks(admittance(mass=13.0, damping=1000.0, lead=0.02).parameters(), PERIOD_S)
    (integrator, lag, _), states, outputs = blocks, np.zeros(2), []
    for _ in range(2000):  # 1.6 s are 120 time constants M_a/B_a
        outputs.append((integrator[0] + lag[0]) * 30.0 + states.sum())
        states = blocks[:2, 1] * states + blocks[:2, 2] * 30.0
    # A difference of positions of 0.05 m over one period: 1e-17/8e-4 against 0.03 m/s.
    assert (outputs[-1] - outputs[-2]) / PERIOD_S == pytest.approx(0.03, rel=1e-11)


def test_tustin_of_an_integrator_is_the_trapezoidal_rule() -> None:
    assert first_order_tustin(0.0, 1.0, 1.0, 0.0, 0.5) == (0.25, 1.0, 0.5)


@pytest.mark.parametrize("printed", [2e-5, 7.5e-6])
def test_the_printed_feedback_damping_is_refused_with_an_explanation(printed: float) -> None:
    """MODEL.md, erratum 2."""
    with pytest.raises(ParameterError, match="feedback_damping_from_paper_mm"):
        admittance(feedback=printed)


def test_the_named_conversion_takes_the_printed_value() -> None:
    # One product of two rounded numbers.
    assert feedback_damping_from_paper_mm(7.5e-6) == pytest.approx(7.5e-3, rel=1e-15)
    assert feedback_damping_from_paper_mm(0.0) == 0.0
    with pytest.raises(ParameterError):
        feedback_damping_from_paper_mm(1e-8)


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
    ],
)
def test_values_that_cannot_be_are_refused(name: str, value: float) -> None:
    values = {"mass_kg": 10.0, "damping_n_s_per_m": 1000.0, name: value}
    with pytest.raises(ParameterError, match=name):
        AdmittanceController(**values)


def test_the_kernels_get_the_parameters_in_their_order() -> None:
    controller = AdmittanceController(
        mass_kg=1.0, damping_n_s_per_m=2.0, lead_s=3.0, feedback_damping_s=4.0, velocity_filter_rad_per_s=5.0
    )
    assert controller.parameters().tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
