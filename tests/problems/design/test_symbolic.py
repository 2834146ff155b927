import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.arrays import FloatArray
from problems.contact.transient import Approach, build_sampled_contact, transient_from
from problems.design.symbolic import Structure, arguments_of, build_contact_forces, build_symbolic_form
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController, controller_blocks, needed_states
from problems.model.plant import Environment, Plant
from problems.model.response import loop_response, plant_response, rendered_admittance
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import LAW, PERIOD_S, admittance, between, one_pole, paper_plant
from tests.problems.whole_model import controller_of, plant_of, whole_controllers, whole_plants

SAMPLES = 40
FREQUENCIES = between(1.0, 0.99 * math.pi / PERIOD_S)
APPROACHES = [
    Approach(force_n=30.0),
    Approach(speed_m_s=0.05),
    Approach(force_n=30.0, driven_by="hand"),
    Approach(speed_m_s=0.05, driven_by="hand", after_impact_n=0.0),
]


def values_of(function: ca.Function, *arguments: Any) -> dict[str, FloatArray]:
    outputs = function.call([ca.DM(argument) for argument in arguments])
    return {name: np.squeeze(value.full()) for name, value in zip(function.name_out(), outputs, strict=True)}


def minimal(sampled: SampledPlant, controller: AdmittanceController) -> Structure:
    """Return the structure with the states that the numeric form keeps."""
    kept = needed_states(controller_blocks(controller, sampled.sample_time_s))
    return Structure.like(sampled, controller, controller_states=[int(i) for i in kept])


def assert_agree(found: FloatArray, expected: FloatArray) -> None:
    """Compare to 1e-10 of the largest entry: the same operations in another order."""
    size = np.max(np.abs(expected), initial=0.0)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10 * size if size > 0.0 else 1e-300)


@LAW
@given(whole_plants(), whole_controllers())
def test_the_matrices_are_those_of_the_numeric_form(plant: Plant, controller: AdmittanceController) -> None:
    sampled = build_sampled_plant(plant, PERIOD_S)
    form, loop = build_symbolic_form(minimal(sampled, controller)), build_loop(sampled, controller)
    arguments = arguments_of(sampled, controller)
    plant_found = values_of(form.plant, *arguments[:4])
    for name in set(plant_found) - {"gamma_old"}:
        assert_agree(plant_found[name], getattr(sampled, name))
    # A difference of two columns of this size; with a small fraction it is much smaller.
    both = np.max(np.abs(sampled.gamma + sampled.gamma_old))
    np.testing.assert_allclose(plant_found["gamma_old"], sampled.gamma_old, rtol=0.0, atol=1e-14 * both)
    found = values_of(form.loop, *arguments)
    assert found["a"].shape == loop.a.shape
    for name in ("a", "b", "b_push", "c_force", "d_force", "c_command", "d_command"):
        assert_agree(found[name], getattr(loop, name))


@LAW
@given(whole_plants(), whole_controllers(), FREQUENCIES)
def test_the_responses_are_those_of_the_numeric_form(
    plant: Plant, controller: AdmittanceController, omega: float
) -> None:
    sampled, at = build_sampled_plant(plant, PERIOD_S), np.array([omega])
    form = build_symbolic_form(Structure.like(sampled, controller))
    found = values_of(form.response, *arguments_of(sampled, controller), omega)
    expected, response = loop_response(sampled, controller, at), plant_response(sampled, at)
    for name, value in (
        ("at_force", expected.at_force),
        ("at_command", expected.at_command),
        ("admittance", rendered_admittance(response, controller, PERIOD_S)),
    ):
        assert complex(*found[name]) == pytest.approx(value[0], rel=1e-10)
    # 1 + L loses digits where it is small.
    size = 1.0 + abs(expected.at_force[0]) ** 2
    assert found["squared_distance_at_force"] == pytest.approx(abs(1.0 + expected.at_force[0]) ** 2, abs=1e-10 * size)
    size = 1.0 + abs(expected.at_command[0]) ** 2
    assert found["squared_distance_at_command"] == pytest.approx(
        abs(1.0 + expected.at_command[0]) ** 2, abs=1e-10 * size
    )


def reached(values: FloatArray) -> FloatArray:
    """Return the largest force so far: some of the random loops are unstable."""
    return np.maximum.accumulate(np.abs(values))


@LAW
@given(st.sampled_from(APPROACHES), whole_plants(contact=True), whole_controllers())
def test_until_the_payload_leaves_the_forces_are_the_contact_transients(
    approach: Approach, plant: Plant, controller: AdmittanceController
) -> None:
    sampled = build_sampled_plant(plant, PERIOD_S)
    expected = transient_from(build_sampled_contact(sampled), controller, approach, samples=SAMPLES)
    found = values_of(
        build_contact_forces(Structure.like(sampled, controller), approach, SAMPLES), *arguments_of(sampled, controller)
    )
    assert found["speed"] == pytest.approx(expected.contact_speed_m_s, rel=1e-10)
    # A surface without damper and mass is touched with no force, and a command that jumps at a tick may press on a
    # surface with mass again that the payload has left just before.
    has_left = (expected.contact_force_n == 0.0) & (np.arange(SAMPLES) > 0)
    away = np.flatnonzero((found["contact_force"] < 0.0) | has_left)
    stays = int(away[0]) if away.size else SAMPLES
    # F is a difference of forces K_s x, with x about the way made within the lag of the robot, 0.1 s.
    size = 1e-14 * plant.coupling.stiffness_n_per_m * expected.contact_speed_m_s * 0.1
    # What is rounding at first grows as the loop does.
    growth = max(1.0, spectral_radius(build_loop(sampled, controller))) ** np.arange(stays)
    for name in ("sensor_force", "contact_force"):
        values = getattr(expected, f"{name}_n")[:stays]
        assert np.all(np.abs(found[name][:stays] - values) < 1e-10 * reached(values) + size * growth)


@pytest.mark.parametrize("order", [5, 6])
def test_a_robot_of_many_slow_poles_keeps_its_digits(order: int) -> None:
    """Its steady motion is known to few digits only; the error must be one that moves on steadily."""
    denominator = np.real(np.poly(-np.linspace(10.0, 80.0, order)))
    robot = RobotModel(numerator=denominator[-1:], denominator=denominator, delay_s=1.5 * PERIOD_S)
    controller = replace(FILTERED, compensation="ideal")
    sampled = build_sampled_plant(cell(robot), PERIOD_S)
    structure, arguments = Structure.like(sampled, controller), arguments_of(sampled, controller)
    expected = transient_from(build_sampled_contact(sampled), controller, APPROACHES[0], samples=SAMPLES)
    found = values_of(build_contact_forces(structure, APPROACHES[0], SAMPLES), *arguments)
    # Pivots on the diagonal would leave 6e-11 of five poles and 2e-9 of six.
    assert np.all(np.abs(found["contact_force"] - expected.contact_force_n) < 1e-11 * reached(expected.contact_force_n))
    omega = 30.0
    response = values_of(build_symbolic_form(structure).response, *arguments, omega)
    loop = loop_response(sampled, controller, np.array([omega]))
    assert complex(*response["at_command"]) == pytest.approx(loop.at_command[0], rel=1e-10)


@LAW
@given(whole_plants(contact=False), whole_controllers())
def test_a_surface_that_gives_way_leaves_the_approach_steady(plant: Plant, controller: AdmittanceController) -> None:
    """The frozen limit K_e → 0: nothing happens at the impact, and F^d + F goes on to be B_a v."""
    frozen = build_sampled_plant(plant.in_contact_with(Environment(stiffness_n_per_m=1e-9)), PERIOD_S)
    function = build_contact_forces(Structure.like(frozen, controller), Approach(force_n=30.0), 5)
    found = values_of(function, *arguments_of(frozen, controller))
    # Differences of K_s x: 1e6 N/m times the rounding of a millimetre; some of these loops are unstable.
    np.testing.assert_allclose(
        30.0 - found["sensor_force"], controller.damping_n_s_per_m * found["speed"], rtol=1e-7, atol=1e-7
    )


FULL = Environment(stiffness_n_per_m=2e5, damping_n_s_per_m=80.0, mass_kg=0.7)
FILTERED = replace(admittance(mass=15.0, damping=2500.0, lead=0.012, feedback=6e-3), compensation_mass_kg=8.0)
TWO_POLES = RobotModel(
    numerator=np.array([9.0, 1600.0]), denominator=np.array([1.0, 64.0, 1600.0]), delay_s=2.0 * PERIOD_S
)


def cell(robot: RobotModel) -> Plant:
    return paper_plant(coupling_damping=150.0, robot=robot).in_contact_with(FULL)


CASES = [
    pytest.param(cell(one_pole(3.25 * PERIOD_S)), FILTERED, id="fraction, filtered compensation"),
    pytest.param(cell(TWO_POLES), replace(FILTERED, discretization="forward_euler"), id="two poles, forward Euler"),
    pytest.param(cell(one_pole(0.0)), replace(FILTERED, compensation="ideal"), id="no delay, ideal compensation"),
    pytest.param(
        cell(one_pole(0.5 * PERIOD_S)),
        replace(FILTERED, discretization="backward_euler", compensation="ideal"),
        id="half a sample, backward Euler",
    ),
]
INPUTS = ("plant", "numerator", "denominator", "fraction", "controller")


def jacobian(function: ca.Function, output: str, by: str, *arguments: Any) -> FloatArray:
    inputs = [ca.SX.sym(f"i{i}", function.sparsity_in(i)) for i in range(function.n_in())]
    value = function.call(inputs)[function.index_out(output)]
    # Column by column of a matrix, as numpy flattens with order F.
    derivative = ca.Function(
        "derivative", inputs, [ca.jacobian(ca.vec(ca.densify(value)), inputs[function.index_in(by)])]
    )
    return np.asarray(derivative(*arguments).full())


def central(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Return central differences by relative changes of 1e-6, times the parameter."""
    columns = []
    for i in range(len(at)):
        up, down = at.copy(), at.copy()
        up[i], down[i] = at[i] * (1.0 + 1e-6), at[i] * (1.0 - 1e-6)
        columns.append((function(up) - function(down)) / 2e-6)
    return np.stack(columns, axis=-1)


def check_derivatives(
    function: ca.Function,
    output: str,
    numeric: Callable[[Plant, AdmittanceController], FloatArray],
    plant: Plant,
    controller: AdmittanceController,
    *extra: float,
) -> None:
    """Compare all derivatives by plant and controller with those of the numeric form."""
    arguments: list[Any] = [*arguments_of(build_sampled_plant(plant, PERIOD_S), controller), *extra]
    size = np.max(np.abs(numeric(plant, controller)))
    by_plant = central(lambda p: numeric(plant_of(plant, p), controller), arguments[0])
    by_controller = central(lambda p: numeric(plant, controller_of(controller, p)), arguments[4])
    for name, values, expected in (("plant", arguments[0], by_plant), ("controller", arguments[4], by_controller)):
        found = jacobian(function, output, name, *arguments) * values
        assert np.all(np.max(np.abs(expected), axis=0)[: 5 if name == "plant" else 4] > 0.0)
        # Rounding of 1e-16 (times the number of steps) over a change of 1e-6; the cubic term is 1e-12.
        np.testing.assert_allclose(found, expected, atol=2e-8 * size, rtol=1e-7)


@pytest.mark.parametrize(("plant", "controller"), CASES)
def test_the_derivatives_of_the_loop_are_the_differences(plant: Plant, controller: AdmittanceController) -> None:
    def matrix(plant: Plant, controller: AdmittanceController) -> FloatArray:
        return build_loop(build_sampled_plant(plant, PERIOD_S), controller).a.ravel(order="F")

    form = build_symbolic_form(minimal(build_sampled_plant(plant, PERIOD_S), controller))
    check_derivatives(form.loop, "a", matrix, plant, controller)


@pytest.mark.parametrize(("plant", "controller"), CASES)
@pytest.mark.parametrize("approach", [APPROACHES[0], APPROACHES[2]])
def test_the_derivatives_of_the_forces_are_the_differences(
    plant: Plant, controller: AdmittanceController, approach: Approach
) -> None:
    def force(name: str) -> Callable[[Plant, AdmittanceController], FloatArray]:
        def simulated(plant: Plant, controller: AdmittanceController) -> FloatArray:
            pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
            return np.asarray(getattr(transient_from(pair, controller, approach, samples=SAMPLES), name))

        return simulated

    function = build_contact_forces(Structure.like(build_sampled_plant(plant, PERIOD_S), controller), approach, SAMPLES)
    for output in ("sensor_force", "contact_force"):
        check_derivatives(function, output, force(f"{output}_n"), plant, controller)


@pytest.mark.parametrize(("plant", "controller"), CASES)
@pytest.mark.parametrize("hertz", [2.0, 25.0, 200.0])
def test_the_derivatives_of_the_margins_are_the_differences(
    plant: Plant, controller: AdmittanceController, hertz: float
) -> None:
    omega = 2.0 * math.pi * hertz

    def squared(name: str) -> Callable[[Plant, AdmittanceController], FloatArray]:
        def distance(plant: Plant, controller: AdmittanceController) -> FloatArray:
            loop = loop_response(build_sampled_plant(plant, PERIOD_S), controller, np.array([omega]))
            return np.asarray(np.abs(1.0 + getattr(loop, name)) ** 2)

        return distance

    form = build_symbolic_form(Structure.like(build_sampled_plant(plant, PERIOD_S), controller))
    for name in ("at_force", "at_command"):
        check_derivatives(form.response, f"squared_distance_{name}", squared(name), plant, controller, omega)


@pytest.mark.parametrize(("plant", "controller"), [CASES[0], CASES[3]])
def test_the_derivatives_by_delay_and_robot_are_the_differences(plant: Plant, controller: AdmittanceController) -> None:
    """T_d enters through the fraction; a bandwidth through numerator and denominator, r(0) = 1 kept."""

    def matrix(numbers: FloatArray) -> FloatArray:
        robot = one_pole(float(numbers[0]), float(numbers[1]))
        return build_loop(build_sampled_plant(replace(plant, robot=robot), PERIOD_S), controller).a.ravel(order="F")

    sampled, delay = build_sampled_plant(plant, PERIOD_S), plant.robot.delay_s
    form, arguments = build_symbolic_form(minimal(sampled, controller)), arguments_of(sampled, controller)
    expected = central(matrix, np.array([delay, 20.0]))
    by_delay = jacobian(form.loop, "a", "fraction", *arguments)[:, 0] * delay / PERIOD_S
    by_robot = jacobian(form.loop, "a", "numerator", *arguments)[:, 0]
    by_robot = 20.0 * (by_robot + jacobian(form.loop, "a", "denominator", *arguments)[:, 0])
    size = np.max(np.abs(matrix(np.array([delay, 20.0]))))
    np.testing.assert_allclose(by_delay, expected[:, 0], atol=2e-8 * size)
    np.testing.assert_allclose(by_robot, expected[:, 1], atol=2e-8 * size)


def test_a_feedback_damping_of_zero_has_a_derivative() -> None:
    """The numeric form drops a filter that nobody sees; the symbolic one keeps it, for the optimizer to find."""
    plant, controller = cell(one_pole()), replace(FILTERED, compensation_mass_kg=0.0, feedback_damping_s=0.0)
    sampled, approach = build_sampled_plant(plant, PERIOD_S), APPROACHES[0]
    function = build_contact_forces(Structure.like(sampled, controller), approach, SAMPLES)
    found = jacobian(function, "contact_force", "controller", *arguments_of(sampled, controller))[:, 3]
    step, pair = 1e-4, build_sampled_contact(sampled)
    without, one, two = (
        transient_from(pair, replace(controller, feedback_damping_s=k * step), approach, samples=SAMPLES)
        for k in range(3)
    )
    slope = (4.0 * one.contact_force_n - 3.0 * without.contact_force_n - two.contact_force_n) / (2.0 * step)
    # One-sided differences of second order: (step/B_fb,scale)² with a scale of 0.01 s.
    np.testing.assert_allclose(found, slope, atol=1e-3 * np.max(np.abs(slope)))
    assert np.max(np.abs(found)) > 1.0


def test_the_structure_follows_plant_and_controller() -> None:
    sampled = build_sampled_plant(cell(replace_delay(TWO_POLES, 2.5 * PERIOD_S)), PERIOD_S)
    structure = Structure.like(sampled, admittance())
    assert (structure.robot_order, structure.whole_delay, structure.chain_length) == (2, 2, 3)
    assert structure.controller_states == (0, 1, 2)
    assert structure.state_count == 4 + 3 + 3
    assert Structure.like(sampled, FILTERED).controller_states == (0, 1, 2, 3)


def replace_delay(robot: RobotModel, delay_s: float) -> RobotModel:
    return RobotModel(numerator=robot.numerator, denominator=robot.denominator, delay_s=delay_s)


def test_the_reserve_of_the_exponentials_is_known() -> None:
    sampled = build_sampled_plant(cell(one_pole()), PERIOD_S)
    structure = Structure.like(sampled, admittance())
    assert structure.covers(sampled.plant)
    heavier = sampled.plant.in_contact_with(Environment(stiffness_n_per_m=1e9))
    assert not structure.covers(heavier)
    wide = Structure.like(build_sampled_plant(heavier, PERIOD_S), admittance(), spare_squarings=0)
    assert wide.covers(heavier)
    phi = values_of(
        build_symbolic_form(wide).plant, *arguments_of(build_sampled_plant(heavier, PERIOD_S), FILTERED)[:4]
    )
    # Nine squarings of a matrix that swings with 8 kHz multiply rounding by 2^9.
    np.testing.assert_allclose(phi["phi"], build_sampled_plant(heavier, PERIOD_S).phi, atol=1e-11)


@pytest.mark.parametrize("states", [(), (0, 2), (1, 0), (0, 1, 3), (0, 1, 2, 4)])
def test_states_without_their_source_are_refused(states: tuple[int, ...]) -> None:
    sampled = build_sampled_plant(cell(one_pole()), PERIOD_S)
    with pytest.raises(ParameterError, match="controller_states"):
        Structure.like(sampled, FILTERED, controller_states=states)


def test_an_ideal_acceleration_has_no_forward_euler_form() -> None:
    sampled = build_sampled_plant(cell(one_pole()), PERIOD_S)
    structure = Structure.like(sampled, replace(FILTERED, compensation="ideal"))
    with pytest.raises(ParameterError, match="theta"):
        replace(structure, theta=0.0)


IDEAL = replace(FILTERED, compensation="ideal")


@pytest.mark.parametrize(
    ("controller", "states", "left"),
    [
        (FILTERED, (0, 1), replace(FILTERED, feedback_damping_s=0.0, compensation_mass_kg=0.0)),
        (FILTERED, (0, 1, 2), replace(FILTERED, compensation_mass_kg=0.0)),
        (IDEAL, (0, 1, 2), replace(IDEAL, lead_s=0.0)),
        (IDEAL, (0, 1, 3), replace(IDEAL, feedback_damping_s=0.0)),
    ],
)
def test_a_state_left_out_is_a_parameter_of_zero(
    controller: AdmittanceController, states: tuple[int, ...], left: AdmittanceController
) -> None:
    sampled = build_sampled_plant(cell(one_pole()), PERIOD_S)
    form = build_symbolic_form(Structure.like(sampled, controller, controller_states=states))
    found = values_of(form.loop, *arguments_of(sampled, controller))["a"]
    assert_agree(found, build_loop(sampled, left).a)


def test_outputs_are_named() -> None:
    sampled = build_sampled_plant(cell(one_pole()), PERIOD_S)
    form = build_symbolic_form(Structure.like(sampled, FILTERED))
    assert tuple(form.loop.name_in()) == INPUTS
    assert tuple(form.response.name_in()) == (*INPUTS, "frequency_rad_per_s")
    assert "c_contact" in form.loop.name_out()
