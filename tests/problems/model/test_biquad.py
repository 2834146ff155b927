"""The law with a biquad: sampled as by scipy, in contact as by other simulations, derived as by differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import bilinear, freqz

from problems.arrays import FloatArray
from problems.contact.linear_controller_contact import simulate_linear_contact
from problems.contact.nonlinear_simulation import simulate_nonlinear
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.design.gradients import modulus_gradient, peak_gradient
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.python_control import to_control
from problems.model.response import controller_response, free_space_admittance, loop_response
from problems.model.sampled import build_loop, build_sampled_plant, controller_matrix, spectral_radius
from problems.stability.dwell import common_loop
from problems.stability.margins import find_margins
from tests.problems.axes import PERIOD_S, paper_plant
from tests.problems.random_loops import even

LAW = AdmittanceController(
    mass_kg=6.1364,
    damping_n_s_per_m=1428.6,
    lead_s=0.0301,
    feedback_damping_s=0.0333,
    biquad_zero_s=1.0 / 23.31,
    biquad_zero_damping_ratio=1.4273,
    biquad_pole_s=1.0 / 21.01,
    biquad_pole_damping_ratio=0.4207,
)
PLAIN = replace(LAW, biquad_zero_s=0.0, biquad_pole_s=0.0)
COMPENSATING = replace(LAW, compensation_mass_kg=2.0, damping_n_s_per_m=2500.0)
PRESS = Approach(force_n=30.0)
NAMES = (
    *("mass_kg", "damping_n_s_per_m", "lead_s", "feedback_damping_s"),
    *("velocity_filter_rad_per_s", "acceleration_filter_rad_per_s", "compensation_mass_kg"),
    *("biquad_zero_s", "biquad_zero_damping_ratio", "biquad_pole_s", "biquad_pole_damping_ratio"),
)


def section(law: AdmittanceController) -> tuple[FloatArray, FloatArray]:
    """Return N in powers of z⁻¹ by scipy's bilinear rule."""
    above = [law.biquad_zero_s**2, 2.0 * law.biquad_zero_damping_ratio * law.biquad_zero_s, 1.0]
    below = [law.biquad_pole_s**2, 2.0 * law.biquad_pole_damping_ratio * law.biquad_pole_s, 1.0]
    numerator, denominator = bilinear(above, below, fs=1.0 / PERIOD_S)
    return np.asarray(numerator), np.asarray(denominator)


def as_linear(law: AdmittanceController) -> LinearController:
    """Return the same difference equation as a matrix, which the other simulation steps."""
    matrix = controller_matrix(law, PERIOD_S)
    r = len(matrix) - 1
    left = np.vstack([matrix[:r, :r] - np.eye(r), matrix[r, :r]])
    right = np.append(-matrix[:r, r + 1], 1.0 - matrix[r, r + 1])
    rest = np.linalg.lstsq(left, right, rcond=None)[0]
    return LinearController(matrix=matrix, rest=rest, sample_time_s=PERIOD_S)


@pytest.mark.parametrize("law", [LAW, COMPENSATING])
def test_force_and_compensation_pass_the_tustin_form_of_the_biquad(law: AdmittanceController) -> None:
    omega = np.geomspace(0.5, 0.99 * np.pi / PERIOD_S, 200)
    z = np.exp(1j * omega * PERIOD_S)
    without = replace(law, biquad_zero_s=0.0, biquad_pole_s=0.0)
    undamped = replace(without, feedback_damping_s=0.0)
    _, shape = freqz(*section(law), worN=omega * PERIOD_S)
    forward, feedback = controller_response(law, z, PERIOD_S)
    plain_forward, plain_feedback = controller_response(without, z, PERIOD_S)
    _, compensation = controller_response(undamped, z, PERIOD_S)
    np.testing.assert_allclose(forward, plain_forward * shape, rtol=1e-9)
    np.testing.assert_allclose(feedback, plain_feedback + compensation * (shape - 1.0), rtol=1e-8, atol=1e-14)


def test_zero_and_pole_at_the_same_place_are_no_biquad() -> None:
    neutral = replace(
        LAW,
        biquad_zero_s=LAW.biquad_pole_s,
        biquad_zero_damping_ratio=LAW.biquad_pole_damping_ratio,
    )
    pair = build_sampled_contact(build_sampled_plant(paper_plant(stiffness=1e5), PERIOD_S))
    one, other = (simulate_contact(pair, law, PRESS) for law in (neutral, PLAIN))
    assert one.peak_contact_force_n == pytest.approx(other.peak_contact_force_n, rel=1e-12)
    margins = [find_margins(pair.contact, law).modulus for law in (neutral, PLAIN)]
    assert margins[0] == pytest.approx(margins[1], rel=1e-9)


@pytest.mark.parametrize("law", [LAW, COMPENSATING])
@pytest.mark.parametrize("stiffness", [2e4, 5e5])
def test_the_contact_is_that_of_the_other_two_simulations(law: AdmittanceController, stiffness: float) -> None:
    plant = paper_plant(stiffness=stiffness)
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    exact = simulate_contact(pair, law, PRESS)
    stepped = simulate_linear_contact(pair, as_linear(law), PRESS)
    assert exact.peak_contact_force_n == pytest.approx(stepped.peak_contact_force_n, rel=1e-4)
    assert exact.peak_sensor_force_n == pytest.approx(stepped.peak_sensor_force_n, rel=1e-9)
    integrated = simulate_nonlinear(plant, law, PRESS, sample_time_s=PERIOD_S, duration_s=4.0)
    assert integrated.peak_contact_force_n == pytest.approx(exact.peak_contact_force_n, rel=1e-3)


def test_the_polynomial_loop_has_the_margins_of_the_response_and_the_verdict_of_eigenvalues() -> None:
    rng, stable = np.random.default_rng(4), 0
    for _ in range(40):
        law = replace(
            LAW,
            damping_n_s_per_m=even(rng, 600.0, 4000.0),
            biquad_zero_s=even(rng, 1e-3, 8e-2),
            biquad_zero_damping_ratio=even(rng, 0.1, 1.5),
            biquad_pole_s=even(rng, 1e-3, 8e-2),
            biquad_pole_damping_ratio=even(rng, 0.4, 2.0),
            compensation_mass_kg=float(rng.choice([0.0, 3.0])),
        )
        plant = build_sampled_plant(paper_plant(stiffness=even(rng, 1e4, 5e5)), PERIOD_S)
        if not spectral_radius(build_loop(plant, law)) < 1.0:
            continue
        stable += 1
        omega = np.geomspace(0.1, 0.999 * np.pi / PERIOD_S, 20_000)
        response = loop_response(plant, law, omega)
        swept = min(np.min(np.abs(1.0 + each)) for each in (response.at_force, response.at_command))
        assert find_margins(plant, law).modulus == pytest.approx(swept, rel=2e-4)
    assert stable >= 10


def test_gradients_are_those_of_differences() -> None:
    pair = build_sampled_contact(build_sampled_plant(paper_plant(stiffness=5e5), PERIOD_S))
    run = simulate_contact(pair, LAW, PRESS)
    peak = peak_gradient(pair.contact, LAW, PRESS, run.time_of_peak_s, "contact").by_controller
    modulus = modulus_gradient(pair.contact, LAW).by_controller
    for place, name in enumerate(NAMES):
        value = getattr(LAW, name)
        if value == 0.0 or name.startswith("acceleration"):
            continue
        ends = [replace(LAW, **{name: value * share}) for share in (1.0 - 1e-4, 1.0 + 1e-4)]
        peaks = [simulate_contact(pair, law, PRESS).peak_contact_force_n for law in ends]
        assert peak[place] == pytest.approx((peaks[1] - peaks[0]) / (2e-4 * value), rel=2e-3)
        moduli = [find_margins(pair.contact, law).modulus for law in ends]
        assert modulus[place] == pytest.approx((moduli[1] - moduli[0]) / (2e-4 * value), rel=2e-3, abs=1e-6)


def test_python_control_holds_the_biquad_in_its_forward_block() -> None:
    plant = build_sampled_plant(paper_plant(stiffness=1e5), PERIOD_S)
    forward, plain = (to_control(plant, law).forward for law in (LAW, PLAIN))
    s = 1j * np.geomspace(1.0, 300.0, 20)
    above = 1.0 + 2.0 * LAW.biquad_zero_damping_ratio * LAW.biquad_zero_s * s + (LAW.biquad_zero_s * s) ** 2
    below = 1.0 + 2.0 * LAW.biquad_pole_damping_ratio * LAW.biquad_pole_s * s + (LAW.biquad_pole_s * s) ** 2
    np.testing.assert_allclose(forward(s), plain(s) * above / below, rtol=1e-9)


def test_it_does_not_change_what_a_slow_hand_feels() -> None:
    plant = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    slow = np.array([0.05])
    with_it, without = (abs(free_space_admittance(plant, law, slow)[0]) for law in (LAW, PLAIN))
    assert with_it == pytest.approx(without, rel=1e-4)


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"biquad_zero_s": 0.01, "biquad_pole_s": 0.0}, "biquad_pole_s"),
        ({"biquad_pole_damping_ratio": 0.0}, "biquad_pole_damping_ratio"),
        ({"biquad_zero_s": -0.01}, "biquad_zero_s"),
        ({"compensation_mass_kg": 2.0, "compensation": "ideal"}, "filtered beside a biquad"),
        ({"discretization": "forward_euler"}, "tustin or backward_euler"),
    ],
)
def test_what_is_no_biquad_is_refused(numbers: dict[str, Any], said: str) -> None:
    with pytest.raises(ParameterError, match=said):
        replace(LAW, **numbers)


def test_a_change_to_another_controller_has_no_common_memory_with_a_biquad() -> None:
    with pytest.raises(ParameterError, match="without one"):
        common_loop(build_sampled_plant(paper_plant(stiffness=1e5), PERIOD_S), LAW)
