import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from autotune.formats.controller import write_controller
from autotune.runtime import (
    AXES,
    CollisionResponse,
    Command,
    Fault,
    Phase,
    RuntimeController,
    State,
    load_controller,
    rearm,
    step,
)
from problems.contact.nonlinear_simulation import NonlinearRun, simulate_nonlinear
from problems.contact.nonlinearities import Collision, Deadband, Nonlinearities
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController, controller_blocks, controller_step
from problems.model.plant import Environment, Plant
from problems.model.sampled import build_sampled_plant
from tests.autotune.runtime.cases import (
    PAYLOAD,
    PERIOD_S,
    STARTED,
    WALL,
    Contact,
    Reading,
    along,
    make_axis,
    make_runtime,
    random_readings,
    random_runtime,
    run_contact,
)
from tests.autotune.tuning.cases import small_controller

TURNED = Rotation.from_euler("xyz", [2.5, 0.3, -0.8])
STILL = along(0, TURNED, 0.0, PAYLOAD, np.zeros(6))


def law_of(compensation_mass_kg: float = 0.0) -> AdmittanceController:
    """The ground floor's controller with the gains of `make_axis`."""
    return AdmittanceController(
        mass_kg=12.5,
        damping_n_s_per_m=1400.0,
        lead_s=0.0125,
        feedback_damping_s=2e-2,
        compensation_mass_kg=compensation_mass_kg,
    )


def stepped(controller: RuntimeController, readings: list[Reading]) -> list[Command]:
    state, commands = STARTED, []
    for reading in readings:
        state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]  # lists of numbers
        commands.append(command)
    return commands


@pytest.mark.parametrize("axis", range(6))
def test_each_axis_is_the_linear_controller_of_the_ground_floor(axis: int) -> None:
    """Along and about its own axis, in a tool turned anyhow, under its weight and the sensor's bias."""
    rng, count = np.random.default_rng(axis), 400
    compensation = 8.0 if axis < 3 else 0.0
    controller = make_runtime(make_axis(AXES[axis], compensation_mass_kg=compensation))
    position = np.concatenate([[0.0], np.cumsum(1e-4 * rng.standard_normal(count - 1))])
    force = 20.0 * rng.standard_normal(count)
    wrenches = np.zeros((count, 6))
    wrenches[:, axis] = force
    readings = [along(axis, TURNED, x, PAYLOAD, wrench) for x, wrench in zip(position, wrenches, strict=True)]
    commands = stepped(controller, readings)
    blocks, states, expected = controller_blocks(law_of(compensation), PERIOD_S), (0.0,) * 6, []
    for x, drive in zip(position, force, strict=True):
        command, states = controller_step(blocks, states, drive, x)
        expected.append(command)
    sent = np.cumsum([command.increment_S for command in commands], axis=0)
    # 157 N of weight were added and taken away again: some 1e-14 N, times a compliance far below 1 m/N.
    np.testing.assert_allclose(sent[:, axis], expected, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(np.delete(sent, axis, axis=1), 0.0)
    np.testing.assert_allclose([command.wrench_S[axis] for command in commands], force, rtol=0.0, atol=1e-11)
    np.testing.assert_array_equal(commands[-1].twist_S, np.array(commands[-1].increment_S) / PERIOD_S)


@settings(max_examples=50)
@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_a_tool_that_hangs_still_in_any_pose_stays_where_it_is(rotvec: tuple[float, float, float]) -> None:
    controller = make_runtime(*[make_axis(name, deadband=1e-9) for name in AXES])
    reading = along(0, Rotation.from_rotvec(rotvec), 0.0, PAYLOAD, np.zeros(6))
    (command,) = stepped(controller, [reading])
    assert command.fault is Fault.NONE
    assert command.increment_S == (0.0,) * 6


@pytest.mark.parametrize(("is_subtractive", "driving"), [(False, (0.0, 0.0, 6.0, -6.0)), (True, (0.0, 0.0, 1.0, -1.0))])
def test_the_deadband_is_of_the_kind_that_the_file_says(is_subtractive: bool, driving: tuple[float, ...]) -> None:
    through = make_runtime(make_axis("y", deadband=5.0, is_subtractive=is_subtractive))
    straight = make_runtime(make_axis("y"))
    for force, drive in zip((4.9, -4.9, 6.0, -6.0), driving, strict=True):
        readings = [
            along(1, TURNED, 0.0, PAYLOAD, np.array([0.0, each, 0.0, 0.0, 0.0, 0.0])) for each in (force, drive)
        ]
        (command,), (expected,) = stepped(through, readings[:1]), stepped(straight, readings[1:])
        assert command.increment_S[1] == pytest.approx(expected.increment_S[1], abs=1e-15)


@pytest.mark.parametrize("response", ["none", "reset", "stop"])
def test_collision_and_response_are_those_of_the_full_simulation(response: str) -> None:
    """The same force and motion, tick by tick, as the full simulation recorded them."""
    effects = Nonlinearities(
        deadband=Deadband(width_n=5.0),
        collision=Collision(response=response, threshold_n=60.0),  # type: ignore[arg-type]  # one of the three
    )
    run: NonlinearRun = simulate_nonlinear(
        WALL,
        law_of(),
        Approach(force_n=60.0),
        sample_time_s=PERIOD_S,
        duration_s=0.4,
        effects=effects,
        start_distance_m=2e-3,
    )
    assert run.collision_time_s is not None
    threshold = np.inf if response == "none" else 60.0
    kind = CollisionResponse(response)
    controller = make_runtime(make_axis("x", deadband=5.0), response=kind, threshold_n=threshold)
    wrench = np.zeros((len(run.time_s), 6))
    wrench[:, 0] = -run.sensor_force_n
    pushed = np.array([60.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    readings = [
        dataclasses.replace(along(0, TURNED, x + 2e-3, PAYLOAD, each), desired_S=pushed)
        for x, each in zip(run.flange_position_m, wrench, strict=True)
    ]
    commands = stepped(controller, readings)
    sent = np.cumsum([command.increment_S[0] for command in commands]) - 2e-3
    np.testing.assert_allclose(sent, run.command_m, rtol=0.0, atol=1e-12)
    begun = [k for k, command in enumerate(commands) if command.phase is not Phase.WATCHING]
    assert (begun[:1] == []) if response == "none" else (begun[0] * PERIOD_S == pytest.approx(run.collision_time_s))


def collide(response: CollisionResponse) -> tuple[RuntimeController, State, list[Reading]]:
    """Move along x while z is driven, until a force stands against the motion; return what follows, too."""
    controller = make_runtime(make_axis("x"), make_axis("z"), response=response, threshold_n=50.0)
    drive = np.array([0.0, 0.0, 20.0, 0.0, 0.0, 0.0])
    against = np.array([-60.0, 0.0, 20.0, 0.0, 0.0, 0.0])
    state = STARTED
    for k in range(20):
        state, command = step(controller, state, **along(0, TURNED, 1e-4 * k, PAYLOAD, drive).arguments())  # type: ignore[arg-type]
    assert command.phase is Phase.WATCHING
    assert command.increment_S[2] > 0.0
    return controller, state, [along(0, TURNED, 1e-4 * k, PAYLOAD, against) for k in range(20, 25)]


def test_a_reset_holds_all_axes_for_one_period_and_happens_once_until_it_is_rearmed() -> None:
    controller, state, after = collide(CollisionResponse.RESET)
    phases, moved = [], []
    for reading in after[:3]:
        state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]
        phases.append(command.phase)
        moved.append(command.increment_S[0] != 0.0 or command.increment_S[2] != 0.0)
    assert phases == [Phase.RESPONDED] * 3
    assert moved == [False, True, True]
    state, command = step(controller, rearm(state), **after[3].arguments())  # type: ignore[arg-type]
    assert command.increment_S == (0.0,) * 6


def test_a_full_stop_lasts_until_it_is_rearmed() -> None:
    controller, state, after = collide(CollisionResponse.STOP)
    for reading in after:
        state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]
        assert (command.phase, command.increment_S) == (Phase.STOPPED, (0.0,) * 6)
    calm = along(0, TURNED, 2.4e-3, PAYLOAD, np.array([0.0, 0.0, 20.0, 0.0, 0.0, 0.0]))
    _, command = step(controller, rearm(state), **calm.arguments())  # type: ignore[arg-type]
    assert command.phase is Phase.WATCHING
    # It starts from rest, not at the speed that it had: 20 N move 12.5 kg by some nanometres in the first period.
    assert 0.0 < command.increment_S[2] < 20.0 / 1400.0 * PERIOD_S


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["wrench_S", "position_W_m", "R_WS", "desired_S"])
def test_no_number_that_is_not_finite_ever_moves_the_robot(name: str, bad: float) -> None:
    controller = make_runtime(*map(make_axis, AXES))
    pushed = dataclasses.replace(STILL, wrench_S=STILL.wrench_S + 10.0)
    moving, command = step(controller, STARTED, **pushed.arguments())  # type: ignore[arg-type]
    assert min(command.increment_S) > 0.0
    for place in range(getattr(pushed, name).size):
        spoiled = getattr(pushed, name).copy()
        spoiled.flat[place] = bad
        state, command = step(controller, moving, **dataclasses.replace(pushed, **{name: spoiled}).arguments())  # type: ignore[arg-type]
        assert (command.fault, command.increment_S, command.twist_S) == (Fault.NOT_FINITE, (0.0,) * 6, (0.0,) * 6)
        # It does not go on by itself when the numbers are good again, only from the start.
        state, command = step(controller, state, **pushed.arguments())  # type: ignore[arg-type]
        assert (command.fault, command.increment_S) == (Fault.NOT_FINITE, (0.0,) * 6)
    assert stepped(controller, [pushed])[0].fault is Fault.NONE


def test_finite_numbers_whose_command_is_not_finite_move_nothing_either() -> None:
    controller = make_runtime(*map(make_axis, AXES))
    huge = dataclasses.replace(STILL, wrench_S=np.full(6, 1e308), desired_S=np.full(6, 1e308))
    (command,) = stepped(controller, [huge])
    assert (command.fault, command.increment_S) == (Fault.NOT_FINITE, (0.0,) * 6)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"R_WS": np.zeros((3, 3))}, Fault.NOT_A_ROTATION),
        ({"R_WS": -STILL.R_WS}, Fault.NOT_A_ROTATION),
        ({"R_WS": 1.001 * STILL.R_WS}, Fault.NOT_A_ROTATION),
        ({"position_W_m": STILL.position_W_m + 0.2}, Fault.JUMP),
        ({"R_WS": STILL.R_WS @ Rotation.from_rotvec([0.0, 0.2, 0.0]).as_matrix()}, Fault.JUMP),
        # Half a turn has the sine of none.
        ({"R_WS": STILL.R_WS @ Rotation.from_rotvec([0.0, 0.0, np.pi]).as_matrix()}, Fault.JUMP),
    ],
)
def test_a_pose_that_cannot_be_holds_the_command(change: dict[str, np.ndarray], fault: Fault) -> None:
    commands = stepped(make_runtime(make_axis("x")), [STILL, dataclasses.replace(STILL, **change)])  # type: ignore[arg-type]  # arrays
    assert [command.fault for command in commands] == [Fault.NONE, fault]


@pytest.mark.parametrize(
    "change",
    [{"wrench_S": [0.0] * 5}, {"position_W_m": [0.0] * 4}, {"R_WS": [[1.0] * 3] * 2}, {"desired_S": [None] * 6}],
)
def test_an_argument_of_another_shape_is_reported(change: dict[str, list[float]]) -> None:
    with pytest.raises(ParameterError, match=next(iter(change))):
        step(make_runtime(make_axis("x")), STARTED, **{**STILL.arguments(), **change})  # type: ignore[arg-type]


def test_the_step_is_a_function_of_its_arguments_alone() -> None:
    rng = np.random.default_rng(3)
    controller, readings = random_runtime(rng, CollisionResponse.RESET), random_readings(rng, 30)
    assert stepped(controller, readings) == stepped(controller, readings)


def met_with(controller: RuntimeController, axis: int, plant: Plant) -> Contact:
    """Press with 30 N on the wall of the simulated cell."""
    state = STARTED

    def increment(reading: Reading) -> np.ndarray:
        nonlocal state
        state, command = step(controller, state, **reading.arguments())  # type: ignore[arg-type]
        return np.array(command.increment_S)

    reported = {"force_n": 30.0, "distance_m": 5e-3, "duration_s": 0.8}
    return run_contact(increment, axis, plant=plant, payload=controller.payload, **reported)


def test_in_the_cell_the_peak_is_the_predicted_one() -> None:
    """Six axes, weight and bias in the raw wrench, an approach from rest, against the linear model's prediction."""
    met = met_with(make_runtime(*map(make_axis, AXES)), 2, WALL)
    pair = build_sampled_contact(build_sampled_plant(WALL, PERIOD_S))
    predicted = simulate_contact(pair, law_of(), Approach(force_n=30.0))
    # The prediction touches at a tick and looks between the ticks; the run touches anywhere, and is seen at the ticks.
    assert np.max(met.sensor_n) == pytest.approx(predicted.peak_sensor_force_n, rel=5e-3)
    assert np.max(met.contact_n) == pytest.approx(predicted.peak_contact_force_n, rel=5e-3)
    assert np.max(met.contact_n) > 31.0


def test_the_peaks_that_a_file_predicts_are_met_by_the_runtime_that_loads_it(tmp_path: Path) -> None:
    file = small_controller()
    write_controller(tmp_path / "controller.yaml", file)
    controller = load_controller(tmp_path / "controller.yaml", sample_time_s=PERIOD_S, payload_mass_kg=16.0)
    for scenario in file.predicted["x"].scenarios:
        plant = dataclasses.replace(
            file.certificate.domain["x"].plants.nominal,
            environment=Environment(stiffness_n_per_m=scenario.environment_stiffness_n_per_m),
        )
        met = met_with(controller, 0, plant)
        # After 5 mm the approach is 0.4 % short of its steady speed; its drag passes the threshold deadband whole.
        assert np.max(met.sensor_n) == pytest.approx(scenario.peak_sensor_force_n, rel=5e-3)
        assert np.max(met.contact_n) == pytest.approx(scenario.peak_contact_force_n, rel=5e-3)
