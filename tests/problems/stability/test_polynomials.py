import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Environment, PayloadDynamics, Plant
from problems.model.response import plant_response
from problems.model.sampled import SampledPlant, build_loop, build_sampled_plant, stability_matrix
from problems.stability.margin_kernel import plant_at
from problems.stability.margins import loop_polynomials, response_polynomials
from problems.stability.polynomials import (
    CONTROLLER_POWERS,
    DOUBTFUL,
    STABLE,
    UNSTABLE,
    controller_polynomials,
    hurwitz,
    loop_polynomial,
)
from tests.problems.axes import LAW, PERIOD_S, WHOLE_DELAYS, admittance, one_pole, paper_plant
from tests.problems.random_loops import FORMS, are_stable, radius_of, random_controller, random_plant, sampled_of
from tests.problems.whole_model import whole_controllers, whole_plants


def closed_polynomial(sampled: SampledPlant, controller: AdmittanceController) -> tuple[FloatArray, int]:
    """Return the loop's characteristic polynomial (ascending powers of w) and the power of w that belongs to z = 1."""
    plant, factors = loop_polynomials(sampled), np.zeros((3, CONTROLLER_POWERS))
    degree = controller_polynomials(controller.parameters(), controller.is_ideal, factors)
    out = np.zeros(plant.shape[1] + CONTROLLER_POWERS)
    total = loop_polynomial(plant, factors, degree, sampled.sample_time_s, controller.theta, out)
    return out[: total + 1], 0 if sampled.plant.environment.is_anchored else 1


def verdict_of(sampled: SampledPlant, controller: AdmittanceController) -> int:
    polynomial, first = closed_polynomial(sampled, controller)
    return int(hurwitz(polynomial, len(polynomial) - 1, first))


def judged(*coefficients: float) -> int:
    """Judge a polynomial given in descending powers."""
    return int(hurwitz(np.array(coefficients[::-1]), len(coefficients) - 1, 0))


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("touching", [True, False])
def test_the_polynomials_are_the_responses_of_the_state_space_form(order: int, touching: bool) -> None:
    rng = np.random.default_rng(order)
    omega = np.geomspace(0.5, 0.999 * math.pi / PERIOD_S, 25)
    fractions, damped = set(), set()
    for _ in range(40):
        sampled = sampled_of(random_plant(rng, order=order, contact=touching))
        fractions.add(sampled.fraction > 0.0)
        damped.add(sampled.plant.coupling.damping_n_s_per_m > 0.0)
        expected, late = plant_response(sampled, omega), response_polynomials(sampled)
        denominator, force, position = loop_polynomials(sampled)
        for k, w in enumerate(1j * np.tan(0.5 * omega * PERIOD_S)):
            found = plant_at(late, w)
            # In free space F is a small difference at low frequency: the state-space form loses five digits there.
            assert found[0] == pytest.approx(expected.force[k], rel=1e-10)
            assert found[1] == pytest.approx(expected.position[k], rel=1e-10)
            below = np.polyval(denominator[::-1], w)
            # Five samples of delay multiplied out: powers of 1 + w lose at most 2^(5/2) against (1 + |w|)^5 and sum up.
            assert np.polyval(force[::-1], w) / below == pytest.approx(expected.force[k], rel=1e-10)
            assert np.polyval(position[::-1], w) / below == pytest.approx(expected.position[k], rel=1e-10)
    assert fractions == damped == {True, False}


@LAW
@given(whole_plants(WHOLE_DELAYS), st.integers(0, 300), st.floats(0.01, 0.99))
def test_a_long_delay_does_not_cost_the_response_its_digits(plant: Plant, samples: int, share: float) -> None:
    """Whole samples of delay multiply the response by z^−d: a power of a number, not a polynomial."""
    omega = np.array([share * math.pi / PERIOD_S])
    robots = [replace(plant.robot, delay_s=d * PERIOD_S) for d in (0, samples)]
    at_once, late = (sampled_of(replace(plant, robot=robot)) for robot in robots)
    expected = plant_response(at_once, omega).position[0] * np.exp(-1j * omega[0] * PERIOD_S * samples)
    # Rounding of the angle, times 300 samples, and that of the response itself.
    found = plant_at(response_polynomials(late), 1j * np.tan(0.5 * omega[0] * PERIOD_S))[1]
    assert found == pytest.approx(expected, rel=1e-10)


@LAW
@given(whole_plants(), whole_controllers())
def test_the_roots_are_the_eigenvalues_of_the_exact_loop(plant: Plant, controller: AdmittanceController) -> None:
    """z = (1 + w)/(1 − w), each root one eigenvalue and each eigenvalue one root: nothing hidden, nothing more."""
    sampled = sampled_of(plant)
    polynomial, first = closed_polynomial(sampled, controller)
    roots = np.roots(polynomial[first:][::-1])
    eigenvalues = np.linalg.eigvals(stability_matrix(build_loop(sampled, controller)))
    assert len(roots) == len(eigenvalues)
    # Compared as products: where roots crowd (the delay's, near w = −1) each is found badly and all of them well.
    for z in (-2.0, 1.5, 3.0 + 1.0j, 0.6 + 1.1j, 1.0 + 0.02j):
        w = (z - 1.0) / (z + 1.0)
        # w − w_i = 2 (z − z_i)/((z + 1)(z_i + 1)).
        by_loop = np.prod(2.0 * (z - eigenvalues) / ((z + 1.0) * (eigenvalues + 1.0)))
        # Five decades between the loop's slowest and fastest root, and rounding: 1e-16 · 1e5, and room.
        assert np.prod(w - roots) == pytest.approx(by_loop, rel=1e-8)


@pytest.mark.parametrize("form", FORMS)
def test_the_verdict_is_that_of_the_eigenvalues(form: str) -> None:
    rng = np.random.default_rng(FORMS.index(form))
    kinds = ("none", "filtered") if form == "forward_euler" else ("none", "filtered", "ideal")
    seen = {(kind, stable): 0 for kind in kinds for stable in (True, False)}
    for _ in range(600):
        sampled, controller = sampled_of(random_plant(rng)), random_controller(rng, forms=(form,), compensations=kinds)
        stable = radius_of(sampled, controller) < 1.0
        verdict = verdict_of(sampled, controller)
        assert verdict in (DOUBTFUL, STABLE if stable else UNSTABLE), (sampled.plant, controller)
        kind = controller.compensation if controller.compensates else "none"
        seen[kind, stable] += verdict != DOUBTFUL
    # Both answers were given for every kind of controller, many times.
    assert min(seen.values()) >= 20, seen


@pytest.mark.parametrize(
    ("coefficients", "verdict"),
    [
        pytest.param((1.0, 6.0, 11.0, 6.0), STABLE, id="(w + 1)(w + 2)(w + 3)"),
        pytest.param((-1.0, -6.0, -11.0, -6.0), STABLE, id="the sign of the whole does not matter"),
        pytest.param((1.0, 2.0, 3.0, 4.0, 5.0), UNSTABLE, id="Routh's textbook array: two sign changes"),
        pytest.param((1.0, 1.0, 2.0, 8.0), UNSTABLE, id="(w + 2)(w² − w + 4)"),
        pytest.param((1.0, 2.0, -1.0), UNSTABLE, id="a negative coefficient"),
        pytest.param((1.0, 1.0, 4.0, 4.0), DOUBTFUL, id="(w + 1)(w² + 4): on the axis"),
        pytest.param((1.0, 3.0, 2.0, 0.0), DOUBTFUL, id="w (w + 1)(w + 2): at the origin"),
        pytest.param((1.0, 1.0, 5.0, 5.0, 4.0, 4.0), DOUBTFUL, id="(w + 1)(w² + 1)(w² + 4)"),
        pytest.param((1.0, 0.0, 4.0), DOUBTFUL, id="w² + 4"),
        pytest.param((1.0, 1.0, 1.0, 1.0, 1.0), DOUBTFUL, id="an array that begins a row with zero"),
        pytest.param((3.0, 5.0), STABLE, id="first order"),
        pytest.param((3.0, -5.0), UNSTABLE, id="first order, right"),
        pytest.param((2.0,), STABLE, id="no root"),
        pytest.param((1.0, math.nan, 1.0), DOUBTFUL, id="not a number"),
    ],
)
def test_textbook_polynomials(coefficients: tuple[float, ...], verdict: int) -> None:
    assert judged(*coefficients) == verdict


@LAW
@given(st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=5), st.lists(st.floats(-3.0, 3.0), max_size=3))
def test_a_polynomial_of_chosen_roots_is_judged_by_them(real: list[float], pairs: list[float]) -> None:
    roots = [*map(complex, real), *(complex(re, sign * (1.0 + abs(re))) for re in pairs for sign in (1.0, -1.0))]
    verdict, worst = judged(*np.real(np.poly(roots))), max(root.real for root in roots)
    # A coefficient of zero (roots in balance) or a root within a millionth of the axis may be left open.
    assert verdict in (DOUBTFUL, STABLE if worst < 0.0 else UNSTABLE)
    if worst < -0.05:
        assert verdict == STABLE


def test_near_the_boundary_the_polynomial_is_right_or_leaves_it_to_the_eigenvalues() -> None:
    """Bisect the smallest stable B_a, then step away from it on both sides by 10^−2 to 10^−11 of itself."""
    rng = np.random.default_rng(11)
    verdicts: list[list[int]] = []
    while len(verdicts) < 20:
        sampled, controller = sampled_of(random_plant(rng)), random_controller(rng)
        if radius_of(sampled, replace(controller, damping_n_s_per_m=50.0)) < 1.0:
            continue
        low, high = 50.0, 2e5
        if radius_of(sampled, replace(controller, damping_n_s_per_m=high)) >= 1.0:
            continue
        for _ in range(45):
            middle = math.sqrt(low * high)
            stable = radius_of(sampled, replace(controller, damping_n_s_per_m=middle)) < 1.0
            low, high = (low, middle) if stable else (middle, high)
        row = []
        for exponent, sign in itertools.product(range(2, 12), (1.0, -1.0)):
            near = replace(controller, damping_n_s_per_m=high * (1.0 + sign * 10.0**-exponent))
            stable, verdict = radius_of(sampled, near) < 1.0, verdict_of(sampled, near)
            assert verdict in (DOUBTFUL, STABLE if stable else UNSTABLE), (exponent, sign)
            # The batch asks the eigenvalues where the polynomial is in doubt.
            assert are_stable([sampled], [near])[0, 0] == stable
            row.append(verdict)
        verdicts.append(row)
    # A thousandth away it decides by itself nearly always; a hundred-billionth away it should not dare to.
    assert np.mean(np.array(verdicts)[:, :6] != DOUBTFUL) > 0.95
    assert np.mean(np.array(verdicts)[:, -2:] == DOUBTFUL) > 0.95


def test_without_an_anchor_the_integrator_is_divided_out_exactly() -> None:
    rng = np.random.default_rng(3)
    for environment in (Environment(stiffness_n_per_m=0.0), Environment(stiffness_n_per_m=0.0, damping_n_s_per_m=30.0)):
        for _ in range(20):
            sampled = sampled_of(random_plant(rng, contact=False).in_contact_with(environment))
            polynomial, first = closed_polynomial(sampled, random_controller(rng))
            assert first == 1
            assert polynomial[0] == 0.0
            assert polynomial[1] != 0.0


@pytest.mark.parametrize("samples", [40, 80, 90, 110, 200])
def test_a_delay_of_many_samples_is_judged_rightly_or_left_to_the_eigenvalues(samples: int) -> None:
    """The hundredth power of 1 + w has other roots once its coefficients are rounded."""
    sampled = sampled_of(paper_plant(stiffness=2e4, robot=one_pole(samples * PERIOD_S)))
    designs = [admittance(damping=damping, lead=0.0) for damping in np.geomspace(300.0, 30_000.0, 15)]
    expected = [radius_of(sampled, design) < 1.0 for design in designs]
    assert set(expected) == {True, False}
    assert are_stable([sampled], designs)[:, 0].tolist() == expected


def test_a_rigid_payload_on_a_spring_has_its_closed_form() -> None:
    """Tustin, robot at once, no delay: L = K h (z + 1)/(2 B_a (z − 1) z), so 2 B_a z (z − 1) + K h (z + 1) = 0.

    Its roots lie inside the circle exactly for K h < 2 B_a (their product is K h/(2 B_a)).
    """
    robot = one_pole(0.0, 40.0 / PERIOD_S)  # settles to e^−40 within a sample
    plant = replace(
        paper_plant(stiffness=2e4, coupling=1e6, robot=robot), payload=PayloadDynamics(mass_kg=1e-6, drag_n_s_per_m=1.0)
    )
    series = 1.0 / (1.0 / 2e4 + 1.0 / 1e6)
    limit = 0.5 * series * PERIOD_S
    for share, verdict in ((1.001, STABLE), (2.0, STABLE), (0.999, UNSTABLE), (0.5, UNSTABLE)):
        # A lead of M_a/B_a cancels the admittance's lag.
        damping = share * limit
        controller = admittance(mass=0.01 * damping, damping=damping, lead=0.01)
        assert verdict_of(build_sampled_plant(plant, PERIOD_S), controller) == verdict
