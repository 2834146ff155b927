"""What the runtime enforces of `limits`: every one has its own fault, which holds the command until the start."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autotune.errors import CertificateError, UsageError
from autotune.formats.controller import controller_tree, write_controller
from autotune.formats.controller_record import CollisionSettings
from autotune.formats.limits import CollisionResponse as FileResponse
from autotune.runtime import (
    START,
    AxisLimits,
    CollisionResponse,
    Command,
    Fault,
    Limits,
    RuntimeController,
    State,
    load_controller,
    step,
)
from autotune.runtime.guard import Watch, missing_mass_kg, weigh
from autotune.runtime.load import default_limits
from problems.errors import ParameterError
from tests.autotune.formats.samples import make_controller, make_limits
from tests.autotune.runtime.cases import PAYLOAD, PERIOD_S, STARTED, Reading, along, make_axis, make_runtime
from tests.autotune.tuning.responding import responding

LEVEL = Rotation.identity()
LIMITS = Limits(
    force_n=400.0,
    torque_n_m=80.0,
    axes={"x": AxisLimits(speed=0.25, acceleration=1e4), "rz": AxisLimits(speed=1.25, acceleration=1e4)},
    pose_speed_m_s=1.0,
    pose_speed_rad_s=5.0,
    stale_wrench_s=0.02,
    stale_pose_s=0.1,
    rest_samples=20,
    rest_force_n=1.0,
    rest_torque_n_m=0.5,
)
CONTROLLER = make_runtime(make_axis("x", deadband=5.0), make_axis("rz", deadband=1.0), limits=LIMITS)
RNG = np.random.default_rng(0)


def reading(force: float = 0.0, way: float = 0.0, *, axis: int = 0, noise: bool = True) -> Reading:
    wrench = 0.01 * RNG.standard_normal(6) if noise else np.zeros(6)
    wrench[axis] += force
    return along(axis, LEVEL, way, PAYLOAD, wrench)


def fed(state: State, *readings: Reading, controller: RuntimeController = CONTROLLER) -> tuple[State, Command]:
    for each in readings:
        state, command = step(controller, state, **each.arguments())  # type: ignore[arg-type]  # lists of numbers
    return state, command


def moving(force: float, count: int) -> Reading:
    """A reading without noise of a tool that goes on slowly."""
    return reading(force, 1e-7 * count, noise=False)


def with_limits(**change: Any) -> RuntimeController:
    return replace(CONTROLLER, limits=replace(LIMITS, **change))


ANY_COMMAND = with_limits(axes=dict.fromkeys(("x", "rz"), AxisLimits(speed=1e3, acceleration=1e6)))


@pytest.mark.parametrize(("axis", "limit", "fault"), [(1, 400.0, Fault.FORCE_RANGE), (4, 80.0, Fault.TORQUE_RANGE)])
def test_a_wrench_at_the_end_of_the_range_is_none(axis: int, limit: float, fault: Fault) -> None:
    raw = reading(noise=False)
    for sign in (-1.0, 1.0):
        wrench = raw.wrench_S.copy()
        wrench[axis] = sign * limit
        state, command = fed(STARTED, raw, replace(raw, wrench_S=wrench))
        assert (command.fault, command.twist_S) == (fault, (0.0,) * 6)
        wrench[axis] = sign * np.nextafter(limit, 0.0)
        assert fed(STARTED, raw, replace(raw, wrench_S=wrench))[1].fault is not fault
    # It lasts, whatever follows, until the start.
    assert fed(state, raw, raw)[1].fault is fault
    assert fed(START, raw)[1].fault is Fault.NONE


def test_a_command_beyond_its_speed_is_not_sent() -> None:
    # B_a is 1400 N·s/m: 300 N make 0.21 m/s, and 380 N would make 0.27 m/s.
    for force, fault in ((300.0, Fault.NONE), (380.0, Fault.SPEED)):
        state, speeds = STARTED, []
        # Pushed up slowly: K_l lets a force that rises at once make a step of the speed.
        for k in range(600):
            state, command = fed(state, reading(force * min(1.0, k / 400), 1e-7 * k))
            speeds.append(command.twist_S[0])
        assert command.fault is fault
        assert max(speeds) <= 0.25
        assert max(speeds) > 0.2


LAGGING = with_limits(
    axes={**LIMITS.axes, "x": AxisLimits(speed=10.0, acceleration=1e6, followed_speed=0.1, followed_lag_s=0.05)}
)


def test_a_lead_may_command_more_for_a_moment_than_a_robot_may_go() -> None:
    """120 N at once make 0.12 m/s of K_l at first, and 0.086 m/s in the end; 150 N end at 0.107 m/s, a fault."""
    for force, fault in ((120.0, Fault.NONE), (150.0, Fault.SPEED)):
        state, commands = STARTED, []
        for k in range(1500):
            state, command = fed(state, reading(force, 1e-7 * k), controller=LAGGING)
            commands.append(command)
        assert commands[-1].fault is fault
        assert max(each.twist_S[0] for each in commands) > 0.115


@pytest.mark.parametrize("seed", range(4))
def test_a_robot_of_one_pole_goes_no_faster_than_the_limit_behind_its_lag(seed: int) -> None:
    """Whatever hand leads it, until the fault and after; the robot's answer to each step of the command is exact."""
    rng = np.random.default_rng(seed)
    state, sent, position, speeds, force = STARTED, 0.0, 0.0, [], 0.0
    decay = np.exp(-PERIOD_S / 0.05)
    for k in range(3000):
        if rng.random() < 0.01:
            force = rng.uniform(-180.0, 180.0)
        state, command = fed(state, reading(force, 1e-7 * k), controller=LAGGING)
        sent += command.increment_S[0]
        # The speed is largest as the step comes.
        speeds.append((sent - position) / 0.05)
        position = sent + (position - sent) * decay
    assert state.fault is Fault.SPEED
    # The hold adds half a period of the lag.
    assert 0.08 < max(map(abs, speeds)) <= 0.1 * (1.0 + 0.51 * PERIOD_S / 0.05)


def test_a_command_that_starts_too_hard_is_not_sent() -> None:
    slow = with_limits(axes={**LIMITS.axes, "x": AxisLimits(speed=0.25, acceleration=5.0)})
    slow = replace(slow, axes=(make_axis("x"),))
    state, command = fed(STARTED, reading(noise=False), reading(100.0), controller=slow)
    assert (command.fault, command.increment_S) == (Fault.ACCELERATION, (0.0,) * 6)
    # Slowly pushed up to the same force it goes: M_a is 12.5 kg and K_l 12.5 ms.
    state = STARTED
    for k in range(400):
        state, command = fed(state, moving(0.25 * k, k), controller=slow)
    assert command.fault is Fault.NONE
    assert command.twist_S[0] > 0.05


def test_a_response_may_stop_the_command_at_once() -> None:
    """The paper's reset takes all speed in one period: no acceleration is too large for that."""
    gentle = {"x": AxisLimits(speed=0.25, acceleration=40.0)}
    controller = make_runtime(
        make_axis("x"), response=CollisionResponse.RESET, threshold_n=30.0, limits=replace(LIMITS, axes=gentle)
    )
    state = STARTED
    for k in range(500):
        state, command = fed(state, moving(0.25 * min(k, 400) + 1e-3 * k, k), controller=controller)
    assert command.fault is Fault.NONE
    assert command.twist_S[0] / PERIOD_S > 40.0
    _, command = fed(state, moving(-31.0, 500), controller=controller)
    assert (command.fault, command.twist_S[0]) == (Fault.NONE, 0.0)
    unwatched = replace(controller, response=CollisionResponse.NONE)
    assert fed(state, moving(-31.0, 500), controller=unwatched)[1].fault is Fault.ACCELERATION


@pytest.mark.parametrize(
    ("way", "axis", "fault"),
    [(0.0079, 0, Fault.NONE), (0.0009, 0, Fault.JUMP), (0.0039, 5, Fault.NONE), (0.0041, 5, Fault.JUMP)],
)
def test_the_pose_goes_no_faster_than_a_robot(way: float, axis: int, fault: Fault) -> None:
    """1 m/s and 5 rad/s are 0.8 mm and 4 mrad in a period of 0.8 ms, ten times that after ten without another pose."""
    held = [reading(axis=axis)] * 10 if way == 0.0079 else [reading(axis=axis)]
    assert fed(STARTED, *held, reading(way=way, axis=axis), controller=ANY_COMMAND)[1].fault is fault


def test_a_pose_that_rests_long_may_not_go_anywhere_then() -> None:
    held = [reading(noise=False)] * 2000
    assert fed(STARTED, *held, reading(way=0.0079), controller=ANY_COMMAND)[1].fault is Fault.NONE
    assert fed(STARTED, *held, reading(way=0.09), controller=ANY_COMMAND)[1].fault is Fault.JUMP


def test_a_wrench_that_stands_still_while_the_command_moves_is_stale() -> None:
    state, pushed = fed(STARTED, reading(50.0))[0], reading(50.0)
    faults = []
    for k in range(40):
        state, command = fed(state, replace(pushed, position_W_m=pushed.position_W_m + 1e-6 * k))
        faults.append(command.fault)
    # 25 repetitions are 20 ms.
    assert faults.index(Fault.STALE_WRENCH) == 25
    assert faults[-1] is Fault.STALE_WRENCH


def test_a_sudden_force_meets_the_speed_by_the_lead() -> None:
    """At first a step of F makes F K_l/M_a, 0.25 m/s at 250 N; risen slowly it makes F/B_a, 0.25 m/s at 350 N."""
    controller = with_limits(axes={**LIMITS.axes, "x": AxisLimits(speed=0.25, acceleration=1e6)})
    # At 300 N a period of 0.8 ms, in which the step decays by 9 %, leaves more than 0.25 m/s on its mean.
    for force, slow, fault in ((240.0, 1, Fault.NONE), (300.0, 400, Fault.NONE), (300.0, 1, Fault.SPEED)):
        state = STARTED
        for k in range(600):
            state, command = fed(state, reading(force * min(1.0, k / slow), 1e-7 * k), controller=controller)
        assert command.fault is fault


def test_a_robot_that_stands_is_not_noticed_where_its_pose_has_noise() -> None:
    """As the page on the runtime says: the controller must be stopped from the robot's own state."""
    state = STARTED
    for k in range(200):
        state, command = fed(state, reading(50.0, 1e-6 * (k % 2)))
    assert command.fault is Fault.NONE
    assert command.twist_S[0] > 0.0


def test_a_pose_that_stands_still_while_the_command_moves_is_stale() -> None:
    state, faults = STARTED, []
    for _ in range(200):
        state, command = fed(state, reading(50.0))
        faults.append(command.fault)
    assert faults.index(Fault.STALE_POSE) == 125


def test_readings_that_stand_still_at_rest_are_those_of_a_coarse_sensor() -> None:
    still = reading(noise=False)
    assert fed(STARTED, *[still] * 2000)[1].fault is Fault.NONE


@pytest.mark.parametrize("mass_kg", [-16.0, -0.8, 0.8, 3.2])
def test_the_first_readings_show_the_missing_mass(mass_kg: float) -> None:
    tilted, actual = Rotation.from_euler("xyz", [0.4, -0.3, 0.2]), replace(PAYLOAD, mass_kg=16.0 + mass_kg)
    heavy = [along(0, tilted, 0.0, actual, 0.1 * RNG.standard_normal(6)) for _ in range(20)]
    state = START
    for each in heavy[:-1]:
        state, command = fed(state, each)
        assert (command.fault, command.is_started, command.twist_S) == (Fault.NONE, False, (0.0,) * 6)
    state, command = fed(state, heavy[-1])
    assert command.fault is Fault.RESIDUAL_WRENCH
    # Noise of 0.1 N over 20 readings is 0.0023 kg of deviation; five of them.
    assert command.missing_mass_kg == pytest.approx(mass_kg, abs=0.0115)
    assert fed(state, heavy[0])[1].missing_mass_kg == command.missing_mass_kg


@pytest.mark.parametrize(
    ("force", "axis", "fault"),
    [(0.9, 1, Fault.NONE), (1.1, 1, Fault.RESIDUAL_WRENCH), (0.4, 4, Fault.NONE), (0.6, 4, Fault.RESIDUAL_WRENCH)],
)
def test_a_bias_that_drifted_is_no_rest_either(force: float, axis: int, fault: Fault) -> None:
    drifted = [replace(each, wrench_S=each.wrench_S + force * np.eye(6)[axis]) for each in [reading()] * 20]
    assert fed(START, *drifted)[1].fault is fault


def test_after_the_first_readings_the_law_begins() -> None:
    state, command = fed(START, *[reading(noise=False)] * 20)
    assert not command.is_started
    _, begun = fed(state, reading(50.0, noise=False))
    _, expected = fed(STARTED, reading(50.0, noise=False))
    assert begun.is_started
    assert begun.increment_S == expected.increment_S


def carrying(share: float, tilt_rad: float, count: int) -> list[Reading]:
    """Readings of a tool that turned about y, creeps, and carries a share of its payload."""
    tilted = Rotation.from_rotvec([0.0, tilt_rad, 0.0])
    actual = replace(PAYLOAD, mass_kg=share * PAYLOAD.mass_kg)
    return [along(0, tilted, 1e-7 * (k % 2), actual, np.zeros(6)) for k in range(count)]


def upward(each: Reading, force: float) -> np.ndarray:
    """A force against gravity, N, in the axes of the tool, and no torque."""
    return np.array([*(force * each.R_WS.T[:, 2]), 0.0, 0.0, 0.0])


def noisy(readings: list[Reading], rms: float = 0.14) -> list[Reading]:
    return [replace(each, wrench_S=each.wrench_S + rms * RNG.standard_normal(6)) for each in readings]


@pytest.mark.parametrize("share", [0.0, 0.5, 1.3])
def test_a_payload_that_changes_on_the_way_is_noticed_once_it_moves_the_command(share: float) -> None:
    state, command = fed(STARTED, *noisy(carrying(1.0, 0.5, 200)), controller=ANY_COMMAND)
    assert command.fault is Fault.NONE
    state, command = fed(state, *noisy(carrying(share, 0.5, 1200)), controller=ANY_COMMAND)
    assert command.fault is Fault.OTHER_PAYLOAD
    assert command.missing_mass_kg == pytest.approx((share - 1.0) * 16.0, abs=0.1)


def test_a_hand_that_lifts_is_no_payload() -> None:
    """60 N upwards, which no hand holds to 1 N for half a second."""
    state = STARTED
    for k, each in enumerate(noisy(carrying(1.0, 0.5, 4000))):
        force = 60.0 * min(1.0, k / 200) * (1.0 + 0.1 * np.sin(2.0 * np.pi * 1.1 * k * PERIOD_S))
        state, command = fed(state, replace(each, wrench_S=each.wrench_S + upward(each, force)))
    assert command.fault is Fault.NONE
    assert abs(command.twist_S[0]) > 0.01


def test_an_approach_against_its_drag_is_no_payload() -> None:
    """A constant force straight up for seconds, but against the motion, as the payload's drag is under F^d."""
    state = STARTED
    for k, each in enumerate(noisy(carrying(1.0, np.pi / 2.0, 3000))):
        drag, down = upward(each, 25.0 * min(1.0, k / 200)), upward(each, -90.0 * min(1.0, k / 200))
        state, command = fed(state, replace(each, wrench_S=each.wrench_S + drag, desired_S=down))
    assert command.fault is Fault.NONE
    assert abs(command.twist_S[0]) > 0.02


@pytest.mark.parametrize(
    ("ticks", "fault"),
    [
        ([5, 6, 7], Fault.NONE),
        ([2**32 - 1, 0, 1], Fault.NONE),
        ([2**40, 2**40 + 1], Fault.NONE),
        ([5, 7], Fault.MISSED_TICK),
        ([2**32 - 1, 1], Fault.MISSED_TICK),
        ([5, None], Fault.MISSED_TICK),
        ([5, 5], Fault.REPEATED_TICK),
        ([5, 4], Fault.REPEATED_TICK),
        ([None, 9, 10], Fault.NONE),
    ],
)
def test_periods_are_counted_where_the_caller_counts(ticks: list[int | None], fault: Fault) -> None:
    assert fed(STARTED, *[replace(reading(), tick=tick) for tick in ticks])[1].fault is fault


HUGE = 10**5000


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("wrench_S", [10**400] * 6),
        ("wrench_S", [HUGE] * 6),
        ("wrench_S", "123456"),
        ("wrench_S", ["1"] * 6),
        ("wrench_S", 5.0),
        ("wrench_S", None),
        ("position_W_m", [0.0, 0.0, HUGE]),
        ("R_WS", [[HUGE] * 3] * 3),
        ("R_WS", 5),
        ("R_WS", [1.0, 2.0, 3.0]),
        ("R_WS", ((1.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0))),  # nine numbers, and no three rows of three
        ("R_WS", (row for row in np.eye(3))),
        ("R_WS", {(1.0, 0.0, 0.0): 0, (0.0, 1.0, 0.0): 0, (0.0, 0.0, 1.0): 0}),
        ("wrench_S", dict.fromkeys(range(6), 0.0)),
        ("wrench_S", {0.0, 1.0, 2.0, 3.0, 4.0, 5.0}),
        ("desired_S", [{}] * 6),
        ("tick", 1.0),
        ("tick", True),
        ("tick", "1"),
    ],
)
def test_what_is_no_number_is_a_parameter_error_however_large(name: str, value: Any) -> None:
    with pytest.raises(ParameterError, match=name):
        step(CONTROLLER, STARTED, **{**reading().arguments(), name: value})


@pytest.mark.parametrize(("controller", "state", "name"), [(CONTROLLER, None, "state"), (None, STARTED, "controller")])
def test_a_step_without_state_or_controller_is_a_parameter_error(controller: Any, state: Any, name: str) -> None:
    with pytest.raises(ParameterError, match=f"{name} must be of type .*, found 'NoneType'"):
        step(controller, state, **reading().arguments())  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["public_key", "payload", "payload_inertia_kg_m2", "path"])
def test_an_argument_of_another_type_is_a_usage_error_of_the_loader(tmp_path: Path, name: str) -> None:
    write_controller(tmp_path / "c.yaml", make_controller(("x",)))
    arguments: dict[str, Any] = {"path": tmp_path / "c.yaml", "sample_time_s": 8e-4, "payload_mass_kg": 16.0, name: 3}
    with pytest.raises(UsageError, match=name):
        load_controller(**arguments)


def test_a_cell_that_is_reported_in_numbers_beyond_any_is_a_usage_error(tmp_path: Path) -> None:
    write_controller(tmp_path / "c.yaml", make_controller(("x",)))
    with pytest.raises(UsageError, match="payload_mass_kg must be a number, found one of 1329 bits"):
        load_controller(tmp_path / "c.yaml", sample_time_s=8e-4, payload_mass_kg=10**400)
    with pytest.raises(ParameterError, match="com_S_m"):
        replace(PAYLOAD, com_S_m=(10**400, 0.0, 0.0))


def test_the_limits_of_a_file_are_those_of_the_runtime(tmp_path: Path) -> None:
    path, cell = tmp_path / "c.yaml", {"sample_time_s": 8e-4, "payload_inertia_kg_m2": {"rz": 16.0}}
    write_controller(path, replace(make_controller(), limits=make_limits()))
    assert load_controller(path, payload_mass_kg=16.0, **cell).limits == make_limits()  # type: ignore[arg-type]
    # 1.5 N are what the predicted peaks of this file hold; 0.2 kg are 1.96 N.
    with pytest.raises(CertificateError, match=r"would leave 1\.96 N .* more than the 1\.5 N that the predicted peaks"):
        load_controller(path, payload_mass_kg=16.2, **cell)  # type: ignore[arg-type]


def test_an_older_file_has_the_limits_of_the_runtime(tmp_path: Path) -> None:
    tree = controller_tree(make_controller())
    limits = default_limits(tree)
    assert set(limits.axes) == {"x", "rz"}
    assert limits.axes["x"].speed == 0.25
    assert limits.rest_force_n == limits.rest_torque_n_m == 5.0
    write_controller(tmp_path / "c.yaml", make_controller())
    cell = {"sample_time_s": 8e-4, "payload_mass_kg": 16.0, "payload_inertia_kg_m2": {"rz": 16.0}}
    assert load_controller(tmp_path / "c.yaml", **cell).limits == limits  # type: ignore[arg-type]
    # Twice weight, bias and the worst predicted peak.
    bias = np.linalg.norm(make_controller().payload.force_bias_n)
    assert limits.force_n == pytest.approx(2.0 * (16.0 * 9.80665 + bias + 71.23456789012345), rel=1e-12)


def test_the_defaults_leave_room_for_certified_contacts() -> None:
    """The approach of a controller with a response is within the limits that its file would get, had it none."""
    whole = responding().controller
    calm = replace(
        whole,
        limits=None,
        collision=CollisionSettings(response=FileResponse.NONE, threshold_n=None),
        predicted={name: replace(each, with_collision_response=()) for name, each in whole.predicted.items()},
    )
    from autotune.tuning.limits import largest_motion

    limits = default_limits(controller_tree(calm))
    speed, acceleration = largest_motion(calm, "x")
    assert speed < limits.axes["x"].speed
    assert acceleration < limits.axes["x"].acceleration


def test_a_controller_has_limits_for_every_axis() -> None:
    with pytest.raises(ParameterError, match=r"limits\.axes.*given for rz too"):
        with_limits(axes={"x": LIMITS.axes["x"]})


def test_a_weight_in_the_sensor_does_work_and_what_lies_across_it_makes_it_none() -> None:
    """Gravity along x of the sensor, a force along it that did not change: F·Δx is counted, a side force ends it."""
    guard, down = CONTROLLER.guard, (0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0)
    light, increment = 4.0 * math.hypot(*PAYLOAD.gravity_W_m_s2), (1e-6, 2e-6, 3e-6)
    before = Watch(missing_kg=-4.0, weight_kg=-4.0, weight_since=7, weight_work=0.25)

    def weighed(x: float, y: float, z: float) -> tuple[Watch, bool]:
        return weigh(guard, PAYLOAD, before, (x, y, z, 5.0, 70.0, 90.0), down, (*increment, 0.0, 0.0, 0.0))

    sign = -1.0 if missing_mass_kg(PAYLOAD, (light, 0.0, 0.0, 0.0, 0.0, 0.0), down) > 0.0 else 1.0
    force = (sign * light, 0.4, -0.3)
    assert missing_mass_kg(PAYLOAD, (*force, 5.0, 70.0, 90.0), down) == pytest.approx(-4.0)
    watch, is_other = weighed(*force)
    assert not is_other
    assert (watch.weight_since, watch.weight_kg) == (8, -4.0)
    assert watch.weight_work == pytest.approx(0.25 + np.dot(force, increment), rel=1e-12)
    for across in ((8.0, 0.0), (0.0, 8.0), (0.0, -8.0)):
        watch, is_other = weighed(sign * light, *across)
        assert (watch.weight_since, watch.weight_work, is_other) == (0, 0.0, False)
