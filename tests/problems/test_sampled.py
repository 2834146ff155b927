import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from problems.controller import AdmittanceController, controller_blocks
from problems.errors import ParameterError
from problems.plant import Plant
from problems.sampled import (
    SampledLoop,
    build_loop,
    build_sampled_plant,
    hold,
    spectral_radius,
    split_delay,
    stability_matrix,
)
from tests.problems.axes import (
    LAW,
    PERIOD_S,
    WHOLE_DELAYS,
    admittance,
    controllers,
    one_pole,
    paper_plant,
    plants,
)
from tests.problems.reference import closed_loop, fine_step_response, step_response

SAMPLES = 300


def loop_of(plant: Plant, controller: AdmittanceController) -> SampledLoop:
    return build_loop(build_sampled_plant(plant, PERIOD_S), controller)


def iterate(loop: SampledLoop, desired: np.ndarray) -> np.ndarray:
    state, out = np.zeros(len(loop.b)), []
    for value in desired:
        out.append(loop.c_force @ state + loop.d_force * value)
        state = loop.a @ state + loop.b * value
    return np.array(out)


def agree(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Compare two responses relative to what they have reached so far: some of the random loops are unstable.

    300 products with matrices of size 10, each exact to 1e-15 of a state whose parts (K_s x) exceed F by up to 1e3.
    """
    reached = np.maximum.accumulate(np.abs(theirs))
    assert np.max(np.abs(ours - theirs) / (reached + 1e-9)) < 1e-9


@LAW
@given(plants(WHOLE_DELAYS), controllers())
def test_a_step_of_the_desired_force_gives_what_python_control_gives(
    plant: Plant, controller: AdmittanceController
) -> None:
    whole = round(plant.robot.delay_s / PERIOD_S)
    step = np.ones(SAMPLES)
    agree(
        iterate(loop_of(plant, controller), step), step_response(closed_loop(plant, controller, PERIOD_S, whole), step)
    )


@LAW
@given(plants(), controllers(), st.integers(0, 4), st.sampled_from([(1, 2), (1, 3), (2, 3), (1, 5), (4, 5), (0, 1)]))
def test_a_fraction_of_a_sample_is_what_a_finer_grid_gives(
    plant: Plant, controller: AdmittanceController, whole: int, fraction: tuple[int, int]
) -> None:
    p, q = fraction
    delayed = paper_plant(
        stiffness=plant.environment.stiffness_n_per_m,
        environment_damping=plant.environment.damping_n_s_per_m,
        mass=plant.payload.mass_kg,
        drag=plant.payload.drag_n_s_per_m,
        coupling=plant.coupling.stiffness_n_per_m,
        coupling_damping=0.0 if whole + p == 0 else plant.coupling.damping_n_s_per_m,
        robot=one_pole((whole + p / q) * PERIOD_S, 30.0),
    )
    fine = fine_step_response(delayed, controller, PERIOD_S, (whole, p, q), SAMPLES)
    agree(iterate(loop_of(delayed, controller), np.ones(SAMPLES)), fine)


@LAW
@given(plants(WHOLE_DELAYS), controllers(), st.floats(0.0, math.pi), st.sampled_from([0.8, 1.05, 1.3]))
def test_the_characteristic_polynomial_is_python_controls(
    plant: Plant, controller: AdmittanceController, angle: float, radius: float
) -> None:
    """Both matrices have all modes and no other: equal monic polynomials, compared where no root is."""
    z = radius * np.exp(1j * angle)
    ours = loop_of(plant, controller).a
    theirs = closed_loop(plant, controller, PERIOD_S, round(plant.robot.delay_s / PERIOD_S)).A
    assert ours.shape == theirs.shape
    ratio = np.linalg.det(z * np.eye(len(ours)) - ours) / np.linalg.det(z * np.eye(len(ours)) - theirs)
    # python-control's matrices hold entries up to K_s = 1e6 beside ones: six digits are lost there.
    assert abs(ratio - 1.0) < 1e-7


@LAW
@given(plants(WHOLE_DELAYS), controllers())
def test_the_largest_eigenvalue_is_python_controls(plant: Plant, controller: AdmittanceController) -> None:
    loop = loop_of(plant, controller)
    poles = closed_loop(plant, controller, PERIOD_S, round(plant.robot.delay_s / PERIOD_S)).poles()
    if loop.is_free_space:
        poles = np.delete(poles, np.argmin(np.abs(poles - 1.0)))
    # Slow poles cluster near 1; two that meet are known to the square root of the rounding of 1e-13.
    assert spectral_radius(loop) == pytest.approx(float(np.max(np.abs(poles))), abs=1e-6)


@LAW
@given(plants(contact=False), controllers(), st.floats(0.0, math.pi))
def test_the_deflated_matrix_lacks_the_integrator_and_nothing_else(
    plant: Plant, controller: AdmittanceController, angle: float
) -> None:
    """det(z − a) = (z − 1) det(z − stability_matrix)."""
    loop, z = loop_of(plant, controller), 1.2 * np.exp(1j * angle)
    reduced = stability_matrix(loop)
    assert len(reduced) == len(loop.a) - 1
    whole = np.linalg.det(z * np.eye(len(loop.a)) - loop.a)
    # States span 1e6 (force per position); a determinant keeps the remaining digits.
    assert (z - 1.0) * np.linalg.det(z * np.eye(len(reduced)) - reduced) == pytest.approx(whole, rel=1e-8)


@LAW
@given(plants(contact=False), controllers())
def test_in_free_space_everything_may_stand_elsewhere(plant: Plant, controller: AdmittanceController) -> None:
    loop = loop_of(plant, controller)
    # One metre of translation: rows hold gains of K_s h²/M_p and below.
    np.testing.assert_allclose(loop.a @ loop.translation, loop.translation, atol=1e-9)
    assert abs(loop.c_force @ loop.translation) < 1e-9 * plant.coupling.stiffness_n_per_m


def test_in_contact_all_eigenvalues_count() -> None:
    loop = loop_of(paper_plant(), admittance())
    assert stability_matrix(loop) is loop.a
    assert spectral_radius(loop) == np.max(np.abs(np.linalg.eigvals(loop.a)))


def test_the_printed_example_is_unstable_in_contact() -> None:
    """MODEL.md, erratum 4."""
    printed = admittance(mass=10.0, damping=1000.0, lead=0.0)
    assert spectral_radius(loop_of(paper_plant(), printed)) > 1.001
    assert spectral_radius(loop_of(paper_plant(), admittance(mass=10.0, damping=1000.0, lead=0.02))) < 1.0


def test_the_uncancelled_robot_would_hide_the_true_radius() -> None:
    """MODEL.md, erratum 1: with the pole at s = −4 left in, every good design had the radius exp(−4 h)."""
    hidden = math.exp(-4.0 * PERIOD_S)
    assert spectral_radius(loop_of(paper_plant(), admittance(damping=3000.0, lead=0.02))) < hidden - 1e-3


def free_space_radius(lead: float, drag: float) -> float:
    plant = paper_plant(stiffness=0.0, drag=drag)
    return spectral_radius(loop_of(plant, admittance(mass=10.0, damping=1000.0, lead=lead)))


def test_in_free_space_too_much_lead_is_unstable_at_the_payload_resonance() -> None:
    """MODEL.md, erratum 7: at B_p = 630 from about K_l = 0.047, at 33 Hz."""
    low, high = 0.03, 0.06
    for _ in range(30):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if free_space_radius(middle, 630.0) < 1.0 else (low, middle)
    # "Near", and with two digits.
    assert low == pytest.approx(0.047, abs=1e-3)
    plant = paper_plant(stiffness=0.0, drag=630.0)
    poles = np.linalg.eigvals(stability_matrix(loop_of(plant, admittance(mass=10.0, damping=1000.0, lead=high))))
    leaving = poles[int(np.argmax(np.abs(poles)))]
    assert abs(np.angle(leaving)) / (2.0 * math.pi * PERIOD_S) == pytest.approx(33.0, abs=0.5)


@pytest.mark.parametrize(
    ("lead", "stable"), [(0.0, False), (0.005, False), (0.0065, True), (0.02, True), (0.0325, True), (0.0345, False)]
)
def test_with_less_drag_only_an_interval_of_lead_is_stable(lead: float, stable: bool) -> None:
    """MODEL.md, errata 5 and 7: at B_p = 300 only about 0.006 to 0.033."""
    assert (free_space_radius(lead, 300.0) < 1.0) is stable


@pytest.mark.parametrize("lead", np.linspace(0.0, 0.06, 13))
def test_with_little_drag_nothing_is_stable(lead: float) -> None:
    """MODEL.md, erratum 7: B_p = 100."""
    assert free_space_radius(lead, 100.0) > 1.0


@pytest.mark.parametrize("bandwidth", [20.0, 200.0])
def test_a_massless_payload_on_a_wall_is_stable_up_to_a_known_stiffness(bandwidth: float) -> None:
    """Closed form: F = −K x, x_k+1 = a x_k + (1 − a) u_k, u = (h/2B)(z + 1)/(z − 1) F.

    The polynomial z² + (g (1 − a) − 1 − a) z + a + g (1 − a) with g = K h/(2B) leaves the unit circle at g = 1.
    """
    robot = one_pole(0.0, bandwidth)
    plant = paper_plant(stiffness=2e4, mass=1e-12, drag=2e-3, coupling=1e6, robot=robot)
    series = 1.0 / (1.0 / 2e4 + 1.0 / 1e6)
    a = math.exp(-bandwidth * PERIOD_S)
    for g in (0.5, 0.999, 1.001, 1.5):
        damping = series * PERIOD_S / (2.0 * g)
        loop = loop_of(plant, admittance(mass=0.01 * damping, damping=damping, lead=0.01))
        roots = np.roots([1.0, g * (1.0 - a) - 1.0 - a, a + g * (1.0 - a)])
        # What is left of the drag that quiets the payload: B_p ω_b/K_e = 2e-5.
        assert spectral_radius(loop) == pytest.approx(float(np.max(np.abs(roots))), abs=2e-5)
        assert (spectral_radius(loop) < 1.0) is (g < 1.0)


@LAW
@given(st.floats(0.0, 3.0))
def test_two_holds_are_one_longer_hold(share: float) -> None:
    a, b = np.array([[0.0, 1.0], [-0.3, -0.1]]), np.array([0.2, 0.5])
    (one, drive), (rest, late), (both, whole) = hold(a, b, share), hold(a, b, 3.0 - share), hold(a, b, 3.0)
    # Matrices of size one: rounding.
    np.testing.assert_allclose(rest @ one, both, atol=1e-14)
    np.testing.assert_allclose(rest @ drive + late, whole, atol=1e-14)


@pytest.mark.parametrize(
    ("delay_s", "whole", "fraction"),
    [
        (0.0, 0, 0.0),
        (2.4e-3, 3, 0.0),
        (3 * 8e-4, 3, 0.0),
        (2.4e-3 - 1e-15, 3, 0.0),
        (2.4e-3 + 1e-15, 3, 0.0),
        (2.0e-3, 2, 0.5),
        (1e-4, 0, 0.125),
        (0.04, 50, 0.0),
    ],
)
def test_a_delay_is_split_into_samples_and_a_fraction(delay_s: float, whole: int, fraction: float) -> None:
    found = split_delay(delay_s, PERIOD_S)
    assert found[0] == whole
    # A quotient of two rounded numbers.
    assert found[1] == pytest.approx(fraction, abs=1e-12)


@LAW
@given(plants(WHOLE_DELAYS, contact=True), controllers())
def test_the_radius_does_not_jump_where_the_fraction_vanishes(plant: Plant, controller: AdmittanceController) -> None:
    """A delay of n samples and one of n samples and a millionth are nearly the same loop."""
    robot = plant.robot
    later = type(robot)(
        numerator=robot.numerator, denominator=robot.denominator, delay_s=robot.delay_s + 1e-6 * PERIOD_S
    )
    moved = Plant(robot=later, coupling=plant.coupling, payload=plant.payload, environment=plant.environment)
    # A robot of one pole has a direct path to the coupling's damper, and only at exactly zero delay.
    assume(robot.delay_s > 0.0 or plant.coupling.damping_n_s_per_m == 0.0)
    a, b = loop_of(plant, controller), loop_of(moved, controller)
    assert len(b.a) == len(a.a) + 1
    # Poles that meet split by the square root of the change.
    assert spectral_radius(b) == pytest.approx(spectral_radius(a), abs=1e-3)


@pytest.mark.parametrize("period_s", [0.0, -8e-4, math.nan, math.inf])
def test_the_period_must_be_positive(period_s: float) -> None:
    with pytest.raises(ParameterError, match="sample_time_s"):
        build_sampled_plant(paper_plant(), period_s)


def test_the_state_is_plant_then_commands_then_controller() -> None:
    sampled = build_sampled_plant(paper_plant(robot=one_pole(2.2e-3)), PERIOD_S)
    assert (sampled.state_count, sampled.whole_delay, sampled.chain_length) == (3, 2, 3)
    loop = build_loop(sampled, admittance())
    blocks = controller_blocks(admittance().parameters(), PERIOD_S)
    # The newest command is the controller's output; the older ones are shifted.
    np.testing.assert_array_equal(loop.a[3, 6:], [1.0, 1.0, -1.0])
    np.testing.assert_array_equal(loop.a[4:6, 3:5], np.eye(2))
    assert loop.b[3] == blocks[0, 0] + blocks[1, 0]
