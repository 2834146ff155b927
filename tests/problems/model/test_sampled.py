import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy import signal
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.controller import CONTROLLER_STATES, AdmittanceController, controller_blocks, needed_states
from problems.model.hold import hold
from problems.model.plant import FREE_SPACE, Coupling, Environment, PayloadDynamics, Plant, build_plant_matrices
from problems.model.response import loop_response
from problems.model.sampled import (
    CutLoop,
    SampledLoop,
    build_cut_loop,
    build_loop,
    build_sampled_plant,
    controller_matrices,
    spectral_radius,
    split_delay,
    stability_matrix,
    write_open_loop,
)
from tests.problems.axes import (
    LAW,
    PERIOD_S,
    STRUCTURES,
    WHOLE_DELAYS,
    admittance,
    any_controllers,
    any_plants,
    environments,
    one_pole,
    paper_plant,
)
from tests.problems.reference import (
    SampledLaw,
    closed_loop,
    continuous_motion,
    fine_step_response,
    step_response,
    surplus_poles,
)

SAMPLES = 300


def loop_of(plant: Plant, controller: AdmittanceController) -> SampledLoop:
    return build_loop(build_sampled_plant(plant, PERIOD_S), controller)


def iterate(loop: SampledLoop, desired: FloatArray) -> FloatArray:
    state, out = np.zeros(len(loop.b)), []
    for value in desired:
        out.append(loop.c_force @ state + loop.d_force * value)
        state = loop.a @ state + loop.b * value
    return np.array(out)


def assert_agree(ours: FloatArray, theirs: FloatArray, radius: float = 1.0) -> None:
    """Compare two responses relative to what they have reached so far: some of the random loops are unstable.

    300 products with matrices of size 10, each exact to 1e-15 of a state whose parts (K_s x) exceed F by up to 1e3; the
    first few values are differences of such parts (up to 1e-5 N per newton) and may be nothing but rounding. What
    rounding (1e-15 of some mN) puts into a mode outside of the unit circle, at `radius`, grows with it, and the step
    may excite that mode hardly more.
    """
    reached = np.maximum.accumulate(np.abs(theirs))
    rounding = 1e-17 * max(radius, 1.0) ** np.arange(len(ours))
    assert np.max(np.abs(ours - theirs) / (1e-9 * (reached + 1e-6) + rounding)) < 1.0


def whole_samples(plant: Plant) -> int:
    return round(plant.robot.delay_s / PERIOD_S)


@LAW
@given(any_plants(WHOLE_DELAYS), any_controllers())
def test_a_step_of_the_desired_force_gives_what_python_control_gives(
    plant: Plant, controller: AdmittanceController
) -> None:
    step = np.ones(SAMPLES)
    theirs = step_response(closed_loop(plant, controller, PERIOD_S, whole_samples(plant)), step)
    assert_agree(iterate(loop_of(plant, controller), step), theirs)


@LAW
@given(
    any_plants(),
    any_controllers(),
    st.integers(0, 4),
    st.sampled_from([(1, 2), (1, 3), (2, 3), (1, 5), (4, 5), (0, 1)]),
)
def test_a_fraction_of_a_sample_is_what_a_finer_grid_gives(
    plant: Plant, controller: AdmittanceController, whole: int, fraction: tuple[int, int]
) -> None:
    p, q = fraction
    delayed = replace(plant, robot=one_pole((whole + p / q) * PERIOD_S, 30.0))
    if whole + p == 0:
        delayed = replace(delayed, coupling=replace(plant.coupling, damping_n_s_per_m=0.0))
    fine = fine_step_response(delayed, controller, PERIOD_S, (whole, p, q), SAMPLES)
    assert_agree(iterate(loop_of(delayed, controller), np.ones(SAMPLES)), fine)


@LAW
@given(any_plants(st.integers(1, 4).map(lambda whole: whole * PERIOD_S)), any_controllers())
def test_a_hand_on_the_payload_gives_what_scipys_held_plant_gives(
    plant: Plant, controller: AdmittanceController
) -> None:
    loop, law = loop_of(plant, controller), SampledLaw(controller, PERIOD_S)
    si = continuous_motion(plant)
    a, b, c, d = signal.cont2discrete((si.a, si.b, si.c, si.d), PERIOD_S, "zoh")[:4]
    state, theirs, past = np.zeros(len(loop.a)), np.zeros(len(a)), [0.0] * whole_samples(plant)
    ours, expected = [], []
    for _ in range(SAMPLES):
        inputs = np.array([past.pop(), 1.0])
        force, position, _ = c @ theirs + d @ inputs
        past.insert(0, law.step(force, position))
        ours.append(loop.c_force @ state)
        expected.append(force)
        state, theirs = loop.a @ state + loop.b_push, a @ theirs + b @ inputs
    assert_agree(np.array(ours), np.array(expected), np.max(np.abs(np.linalg.eigvals(loop.a))))


@LAW
@given(any_plants(WHOLE_DELAYS), any_controllers(), st.floats(0.0, math.pi), st.sampled_from([0.8, 1.05, 1.3]))
def test_the_characteristic_polynomial_is_python_controls(
    plant: Plant, controller: AdmittanceController, angle: float, radius: float
) -> None:
    """Both matrices have all modes and no other but for poles that cancel in python-control's controller.

    Equal monic polynomials, compared where no root is.
    """
    z = radius * np.exp(1j * angle)
    ours = loop_of(plant, controller).a
    theirs, surplus = (
        closed_loop(plant, controller, PERIOD_S, whole_samples(plant)).A,
        surplus_poles(controller, PERIOD_S),
    )
    assert len(ours) == len(theirs) - len(surplus)
    hidden = np.prod([z - pole for pole in surplus])
    ratio = hidden * np.linalg.det(z * np.eye(len(ours)) - ours) / np.linalg.det(z * np.eye(len(theirs)) - theirs)
    # python-control's matrices hold entries up to K_s = 1e6 beside ones: six digits are lost there.
    assert abs(ratio - 1.0) < 1e-7


@LAW
@given(any_plants(WHOLE_DELAYS), any_controllers())
def test_the_largest_eigenvalue_is_python_controls(plant: Plant, controller: AdmittanceController) -> None:
    loop = loop_of(plant, controller)
    poles = closed_loop(plant, controller, PERIOD_S, whole_samples(plant)).poles()
    for hidden in surplus_poles(controller, PERIOD_S) + ([] if loop.is_anchored else [1.0]):
        poles = np.delete(poles, np.argmin(np.abs(poles - hidden)))
    # Slow poles cluster near 1; two that meet are known to the square root of the rounding of 1e-13.
    assert spectral_radius(loop) == pytest.approx(float(np.max(np.abs(poles))), abs=1e-6)


@LAW
@given(any_plants(), any_controllers(), st.floats(0.0, math.pi))
def test_the_states_that_are_left_out_would_add_their_own_poles_only(
    plant: Plant, controller: AdmittanceController, angle: float
) -> None:
    """det(z − a) of a loop with all four controller states is that of `build_loop` times (z − pole) of the rest."""
    sampled, z = build_sampled_plant(plant, PERIOD_S), 1.2 * np.exp(1j * angle)
    blocks, loop = controller_blocks(controller, PERIOD_S), build_loop(sampled, controller)
    size = sampled.state_count + sampled.chain_length + CONTROLLER_STATES
    m = np.zeros((size + 2, size + 3))
    parts = (sampled.phi, sampled.gamma, sampled.gamma_old, sampled.gamma_push, sampled.c_position, sampled.c_force)
    every = controller_matrices(blocks, np.arange(CONTROLLER_STATES))
    write_open_loop(m, (*parts, sampled.d_force), sampled.whole_delay, sampled.chain_length, every)
    whole = CutLoop(matrix=m, state_count=size).closed_at(size + 1, size)[:size, :size]
    rest = np.setdiff1d(np.arange(CONTROLLER_STATES), needed_states(blocks))
    assert len(loop.a) + len(rest) == size
    # Without a biquad its two states only pass on what never comes.
    poles = np.append(blocks[:4, 1], [0.0, 0.0])
    expected = np.linalg.det(z * np.eye(size) - whole) / np.prod(z - poles[rest])
    # Determinants of some hundred, of matrices whose states span 1e6.
    assert np.linalg.det(z * np.eye(len(loop.a)) - loop.a) == pytest.approx(expected, rel=1e-9)


UNANCHORED = st.one_of(st.just(FREE_SPACE), environments().map(lambda wall: replace(wall, stiffness_n_per_m=0.0)))


@LAW
@given(any_plants(touched=UNANCHORED), any_controllers(), st.floats(0.0, math.pi))
def test_the_deflated_matrix_lacks_the_integrator_and_nothing_else(
    plant: Plant, controller: AdmittanceController, angle: float
) -> None:
    """det(z − a) = (z − 1) det(z − stability_matrix), without environment and on dampers and masses alone."""
    loop, z = loop_of(plant, controller), 1.2 * np.exp(1j * angle)
    reduced = stability_matrix(loop)
    assert not loop.is_anchored
    assert len(reduced) == len(loop.a) - 1
    whole = np.linalg.det(z * np.eye(len(loop.a)) - loop.a)
    # States span 1e6 (force per position); a determinant keeps the remaining digits.
    assert (z - 1.0) * np.linalg.det(z * np.eye(len(reduced)) - reduced) == pytest.approx(whole, rel=1e-8)


@LAW
@given(any_plants(touched=UNANCHORED), any_controllers())
def test_without_an_anchor_everything_may_stand_elsewhere(plant: Plant, controller: AdmittanceController) -> None:
    """The translation is the eigenvector at z = 1 of every structure; it moves x, x_p and x^d by one metre."""
    loop = loop_of(plant, controller)
    # Rows hold gains of K_s h²/M_p and below, and of 4/h for the derivative of the ideal form.
    np.testing.assert_allclose(loop.a @ loop.translation, loop.translation, atol=1e-9)
    assert abs(loop.c_force @ loop.translation) < 1e-9 * plant.coupling.stiffness_n_per_m
    assert loop.c_command @ loop.translation == pytest.approx(1.0, rel=1e-9)
    n = plant.robot.order + 2
    assert build_sampled_plant(plant, PERIOD_S).c_position @ loop.translation[:n] == pytest.approx(1.0, rel=1e-12)
    assert loop.translation[n - 2] == 1.0


@pytest.mark.parametrize("name", STRUCTURES)
def test_an_anchored_loop_has_no_pole_at_one(name: str) -> None:
    """On a spring the same translation is resisted: the loop pulls back."""
    loop = loop_of(paper_plant(stiffness=1e3), STRUCTURES[name])
    assert loop.is_anchored
    assert np.min(np.abs(np.linalg.eigvals(loop.a) - 1.0)) > 1e-5


@LAW
@given(any_plants(touched=st.just(FREE_SPACE)), any_controllers(), st.floats(0.3, math.pi))
def test_a_wall_of_almost_no_stiffness_is_almost_free_space(
    plant: Plant, controller: AdmittanceController, angle: float
) -> None:
    """The frozen limit K_e → 0: the characteristic polynomials become one, the integrator's pole included."""
    soft = loop_of(plant.in_contact_with(Environment(stiffness_n_per_m=1e-6)), controller)
    free, z = loop_of(plant, controller), 1.1 * np.exp(1j * angle)
    found, expected = (np.linalg.det(z * np.eye(len(a)) - a) for a in (soft.a, free.a))
    # Changes of K_e h²/M_p = 3e-13 per entry, and the determinant's own rounding.
    assert found == pytest.approx(expected, rel=1e-8)
    # The pole that is left moves from 1 by K_e h/B_a = 3e-12 at the most.
    assert np.min(np.abs(np.linalg.eigvals(soft.a) - 1.0)) < 1e-6


def in_other_units(plant: Plant, controller: AdmittanceController, factor: float) -> tuple[Plant, AdmittanceController]:
    """Measure lengths in units of 1/factor metre; newton and second stay (mm: 1000; a lever arm makes it rotation)."""
    wall = plant.environment
    other = Plant(
        robot=plant.robot,
        coupling=Coupling(
            stiffness_n_per_m=plant.coupling.stiffness_n_per_m / factor,
            damping_n_s_per_m=plant.coupling.damping_n_s_per_m / factor,
        ),
        payload=PayloadDynamics(
            mass_kg=plant.payload.mass_kg / factor, drag_n_s_per_m=plant.payload.drag_n_s_per_m / factor
        ),
        environment=Environment(
            stiffness_n_per_m=wall.stiffness_n_per_m / factor,
            damping_n_s_per_m=wall.damping_n_s_per_m / factor,
            mass_kg=wall.mass_kg / factor,
        ),
    )
    return other, replace(
        controller,
        mass_kg=controller.mass_kg / factor,
        damping_n_s_per_m=controller.damping_n_s_per_m / factor,
        compensation_mass_kg=controller.compensation_mass_kg / factor,
    )


@LAW
@given(any_plants(), any_controllers(), st.sampled_from([1000.0, 1.0 / 0.16, 0.02]))
def test_forces_do_not_know_the_unit_of_length(plant: Plant, controller: AdmittanceController, factor: float) -> None:
    """The same F for millimetres, and for a rotation about an axis 0.16 m away read as force at that radius."""
    one, other = loop_of(plant, controller), loop_of(*in_other_units(plant, controller, factor))
    assert spectral_radius(other) == pytest.approx(spectral_radius(one), abs=1e-6)  # two poles that meet: a square root
    assert_agree(iterate(other, np.ones(SAMPLES)), iterate(one, np.ones(SAMPLES)))


def test_in_contact_all_eigenvalues_count() -> None:
    loop = loop_of(paper_plant(), admittance())
    assert stability_matrix(loop) is loop.a
    assert spectral_radius(loop) == np.max(np.abs(np.linalg.eigvals(loop.a)))


def test_the_printed_example_is_unstable_in_contact() -> None:
    """docs/method.md, erratum 4."""
    printed = admittance(mass=10.0, damping=1000.0, lead=0.0)
    assert spectral_radius(loop_of(paper_plant(), printed)) > 1.001
    assert spectral_radius(loop_of(paper_plant(), admittance(mass=10.0, damping=1000.0, lead=0.02))) < 1.0


def test_the_uncancelled_robot_would_hide_the_true_radius() -> None:
    """docs/method.md, erratum 1: with the pole at s = −4 left in, every good design had the radius exp(−4 h)."""
    hidden = math.exp(-4.0 * PERIOD_S)
    assert spectral_radius(loop_of(paper_plant(), admittance(damping=3000.0, lead=0.02))) < hidden - 1e-3


def free_space_radius(lead: float, drag: float) -> float:
    plant = paper_plant(stiffness=0.0, drag=drag)
    return spectral_radius(loop_of(plant, admittance(mass=10.0, damping=1000.0, lead=lead)))


def test_in_free_space_too_much_lead_is_unstable_at_the_payload_resonance() -> None:
    """docs/method.md, erratum 7: at B_p = 630 from about K_l = 0.047, at 33 Hz."""
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
    """docs/method.md, errata 5 and 7: at B_p = 300 only about 0.006 to 0.033."""
    assert (free_space_radius(lead, 300.0) < 1.0) is stable


@pytest.mark.parametrize("lead", np.linspace(0.0, 0.06, 13))
def test_with_little_drag_nothing_is_stable(lead: float) -> None:
    """docs/method.md, erratum 7: B_p = 100."""
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


@pytest.mark.parametrize("mass", [0.01, 2.0, 60.0])
@pytest.mark.parametrize("stiffness", [1e3, 1e6, 1e8])
@pytest.mark.parametrize("period_s", [8e-4, 8e-3])
def test_the_hold_is_scipys_exponential_for_soft_and_very_stiff_contacts(
    mass: float, stiffness: float, period_s: float
) -> None:
    plant = paper_plant(stiffness=stiffness, mass=mass, robot=one_pole(1.3 * period_s))
    m, sampled = build_plant_matrices(plant, period_s), build_sampled_plant(plant, period_s)
    augmented = np.zeros((5, 5))
    augmented[:3, :3], augmented[:3, 3], augmented[:3, 4] = m.a, m.b, m.push
    whole, part = expm(augmented), expm(0.7 * augmented)
    # Up to 2e3 rad per sample, and squaring once per factor of two of its square: 2^20 roundings.
    tolerance = 1e-9 * np.max(np.abs(whole))
    np.testing.assert_allclose(sampled.phi, whole[:3, :3], atol=tolerance)
    np.testing.assert_allclose(sampled.gamma + sampled.gamma_old, whole[:3, 3], atol=tolerance)
    np.testing.assert_allclose(sampled.gamma, part[:3, 3], atol=tolerance)
    np.testing.assert_allclose(sampled.gamma_push, whole[:3, 4], atol=tolerance)


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
@given(any_plants(WHOLE_DELAYS), any_controllers())
def test_the_radius_does_not_jump_where_the_fraction_vanishes(plant: Plant, controller: AdmittanceController) -> None:
    """A delay of n samples and one of n samples and a millionth are nearly the same loop."""
    robot = plant.robot
    later = replace(robot, delay_s=robot.delay_s + 1e-6 * PERIOD_S)
    moved = replace(plant, robot=later)
    # A robot whose velocity follows a step of the command at once passes the step on to the coupling's damper: there F
    # jumps at the tick, and a whole delay means that it is read just after, any fraction that it is read before.
    assume(plant.coupling.damping_n_s_per_m == 0.0 or len(robot.numerator) < robot.order)
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
    loop, law = build_loop(sampled, admittance(lead=0.02)), admittance(lead=0.02)
    blocks = controller_blocks(law, PERIOD_S)
    # The newest command is the controller's output, integrator and lag; the older ones are shifted.
    np.testing.assert_array_equal(loop.a[3, 6:], [1.0, 1.0])
    np.testing.assert_array_equal(loop.a[4:6, 3:5], np.eye(2))
    assert loop.b[3] == blocks[0, 0] + blocks[1, 0]
    np.testing.assert_array_equal(loop.c_command, loop.a[3])
    assert loop.d_command == loop.b[3]


@pytest.mark.parametrize("signal_at", ["force", "command"])
def test_a_loop_that_is_cut_has_the_open_loop_between_its_ends(signal_at: str) -> None:
    """Closed at one break point, the transfer from the other's input to its output is −L there."""
    sampled, controller = build_sampled_plant(paper_plant(robot=one_pole(2.2e-3)), PERIOD_S), STRUCTURES["filtered"]
    cut, omega = build_cut_loop(sampled, controller), 60.0
    at, other = (cut.force, cut.command) if signal_at == "force" else (cut.command, cut.force)
    m, n, z = cut.closed_at(other), cut.state_count, np.exp(1j * omega * PERIOD_S)
    found = m[at, :n] @ np.linalg.solve(z * np.eye(n) - m[:n, :n], m[:n, at].astype(complex)) + m[at, at]
    loop = loop_response(sampled, controller, np.array([omega]))
    expected = loop.at_force if signal_at == "force" else loop.at_command
    # A solve with states that span 1e6.
    assert -found == pytest.approx(expected[0], rel=1e-8)
