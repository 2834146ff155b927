"""The laws that a simulated cell obeys, checked by other means than the simulator's."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import cont2discrete, lfilter

from autotune.simulation.phases import Program, Script, build_script
from autotune.simulation.simulate import AxisRun, CellRun, run_axis, simulate_cell
from autotune.simulation.truth import SimulatedCell
from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.plant import FREE_SPACE
from problems.model.robot import RobotModel
from tests.autotune.simulation.runs import SHORT, TWO_POLES, demo_run, silent, silent_short_run

G_M_S2 = 9.81
AXES = ("x", "y", "z")
TINY = Program(pose_count=1, pose_hold_s=0.2, pose_move_s=0.2, jogging_s=1.0, sweep_s=0.5, contact_count=0, rest_s=0.2)


def signal_bytes(run: CellRun) -> list[bytes]:
    recording = run.recording
    assert recording.command is not None
    arrays = [recording.wrench.stamp_ns, recording.wrench.force_n, recording.wrench.torque_n_m]
    for pose in (recording.pose, recording.command):
        arrays += [pose.stamp_ns, pose.position_m, pose.quaternion_xyzw]
    return [array.tobytes() for array in arrays]


def rotation_matrices(quaternion_xyzw: FloatArray) -> FloatArray:
    """Base from sensor, (n, 3, 3), by the textbook formula."""
    x, y, z, w = quaternion_xyzw.T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
        [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
        [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def weight_S_n(run: CellRun) -> FloatArray:
    """m Rᵀ g from the recorded orientation (that of the command has no noise)."""
    assert run.recording.command is not None
    down = np.array([0.0, 0.0, -G_M_S2])
    turned = np.swapaxes(rotation_matrices(run.recording.command.quaternion_xyzw), 1, 2) @ down
    return np.asarray(run.cell.payload_mass_kg * turned)


def holds(run: CellRun) -> list[slice]:
    """Where the program holds a tilted pose, without the first and last 50 ms."""
    still = np.all(np.diff(run.script.rotation_rad, axis=0, prepend=0.0) == 0.0, axis=1)
    tilted = still & np.any(run.script.rotation_rad != 0.0, axis=1)
    edges = np.diff(np.concatenate([[0], tilted.astype(int), [0]]))
    margin = round(0.05 / run.cell.sample_time_s)
    spans = zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)
    return [slice(int(a) + margin, int(b) - margin) for a, b in spans if b - a > 4 * margin]


def without_turning(run: CellRun) -> NDArray[np.bool_]:
    """Samples after the tilted poses: constant orientation."""
    mask = np.ones(len(run.script), dtype=bool)
    mask[: int(np.flatnonzero(np.any(run.script.rotation_rad != 0.0, axis=1))[-1]) + 5] = False
    return mask


def test_the_same_seed_gives_the_same_run_byte_for_byte() -> None:
    first, second = (simulate_cell(SimulatedCell(), TINY, seed=5) for _ in range(2))
    assert signal_bytes(first) == signal_bytes(second)


def test_another_seed_gives_other_noise_on_every_measured_channel() -> None:
    first, second = (simulate_cell(SimulatedCell(), TINY, seed=seed) for seed in (5, 6))
    resting = slice(0, 200)
    for one, other in (
        (first.recording.wrench.force_n, second.recording.wrench.force_n),
        (first.recording.wrench.torque_n_m, second.recording.wrench.torque_n_m),
        (first.recording.pose.position_m, second.recording.pose.position_m),
    ):
        assert np.all(one[resting] != other[resting])


def test_static_poses_show_weight_and_bias_and_their_moment() -> None:
    run = simulate_cell(
        silent(SimulatedCell()), Program(pose_count=6, jogging_s=0.0, sweep_s=0.0, contact_count=0), seed=2
    )
    wrench, weight = run.recording.wrench, weight_S_n(run)
    spans = holds(run)
    assert len(spans) == 6
    for span in spans:
        force = wrench.force_n[span].mean(axis=0) - run.cell.force_bias_S_n
        torque = wrench.torque_n_m[span].mean(axis=0) - run.cell.torque_bias_S_n_m
        # Perfect sensors: only rounding of numbers near 160 N and 20 N·m, and of quaternions, is left.
        np.testing.assert_allclose(force, weight[span].mean(axis=0), rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(torque, np.cross(run.cell.com_S_m, weight[span].mean(axis=0)), rtol=0.0, atol=1e-9)


def test_noise_has_the_size_that_the_cell_says() -> None:
    run = demo_run()
    spans = holds(run)
    force = np.concatenate(
        [run.recording.wrench.force_n[s] - run.recording.wrench.force_n[s].mean(axis=0) for s in spans]
    )
    measured = run.recording.pose.position_m - np.array(run.cell.base_position_m)
    # A spread over n samples is known to 1/sqrt(2n): n is above 10⁴ here, so 3 % are more than four deviations.
    assert np.std(force) == pytest.approx(run.cell.force_noise_rms_n, rel=0.03)
    assert np.std(measured[spans[0]], axis=0) == pytest.approx(run.cell.position_noise_rms_m, rel=0.15)


@pytest.mark.parametrize("axis", AXES)
def test_the_payload_obeys_its_equation_of_motion(axis: str) -> None:
    """M dv/dt = F_hand − F_e − B_p v − F, integrated over every period by the trapezoid rule."""
    run = silent_short_run(axis)
    a, cell, h = run.axis, run.cell, run.cell.sample_time_s
    held = np.concatenate([np.zeros(3), a.command_m[:-3]])  # T_d is three periods
    # A one-pole robot's velocity jumps with the hold, and the coupling's damping shows it: F just before the tick.
    jump = cell.coupling.damping_n_s_per_m * cell.robot.denominator[1] * np.diff(held)
    load = a.contact_force_n + cell.drag_n_s_per_m * a.payload_velocity_m_s
    mean_load = 0.5 * (load[1:] + load[:-1]) + 0.5 * (a.force_n[1:] + jump + a.force_n[:-1])
    residual = cell.payload_mass_kg * np.diff(a.payload_velocity_m_s) / h - (a.hand_force_n[:-1] - mean_load)
    touching = a.contact_force_n > 0.0
    switching = touching[1:] != touching[:-1]
    assert np.any(touching)
    # The trapezoid rule errs by (ω h)²/12 of the force; the coupling rings at ω = sqrt(K_s/M).
    trapezoid = cell.coupling.stiffness_n_per_m / cell.payload_mass_kg * h**2 / 12.0
    assert np.max(np.abs(residual[~switching])) < 2.0 * trapezoid * np.max(np.abs(a.force_n))


@pytest.mark.parametrize("axis", AXES)
def test_the_wall_pushes_only_what_is_behind_it_and_never_pulls(axis: str) -> None:
    run = silent_short_run(axis)
    a, wall = run.axis, run.cell.environment
    depth = a.payload_m - run.cell.wall_distance_m
    assert np.min(a.contact_force_n) >= 0.0
    assert np.all(a.contact_force_n[depth < 0.0] == 0.0)
    expected = wall.stiffness_n_per_m * depth + wall.damping_n_s_per_m * a.payload_velocity_m_s
    behind = depth > 0.0
    assert np.max(a.contact_force_n) > 25.0
    # Positions near 25 mm carry rounding of 1e-17 m, times K_e = 1.2e5 N/m.
    np.testing.assert_allclose(a.contact_force_n[behind], np.maximum(expected[behind], 0.0), rtol=0.0, atol=1e-9)


def test_the_payload_can_leave_the_wall_and_come_back() -> None:
    touching = demo_run().axis.contact_force_n > 0.0
    assert np.count_nonzero(touching[1:] & ~touching[:-1]) >= Program().contact_count
    assert np.count_nonzero(~touching[1:] & touching[:-1]) >= Program().contact_count


def robot_by_scipy(robot: RobotModel, command_m: FloatArray, h: float, parts: int) -> FloatArray:
    """r(s) behind hold and delay on a clock `parts` times finer, where the delay is whole."""
    numerator, denominator, _ = cont2discrete((robot.numerator, robot.denominator), h / parts, method="zoh")
    late = round(robot.delay_s / h * parts)
    held = np.concatenate([np.zeros(late), np.repeat(command_m, parts)[: parts * len(command_m) - late]])
    return np.asarray(lfilter(np.atleast_1d(np.squeeze(numerator)), denominator, held)[::parts])


@pytest.mark.parametrize(
    ("robot", "parts"),
    [
        (SimulatedCell().robot, 1),
        (RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.5 * 8e-4), 2),
        (RobotModel(numerator=TWO_POLES.numerator, denominator=TWO_POLES.denominator, delay_s=1.75 * 8e-4), 4),
    ],
    ids=["whole delay", "half a sample", "two poles"],
)
def test_the_flange_follows_the_command_through_robot_and_delay(robot: RobotModel, parts: int) -> None:
    cell = silent(SimulatedCell(robot=robot))
    script = build_script(SHORT, cell.sample_time_s, np.random.default_rng(0))
    # Free motion only: what the payload touches does not reach a position-controlled robot, so the length is enough.
    samples = round(12.0 / cell.sample_time_s)
    cut = Script(**{name: value[:samples] for name, value in script.__dict__.items()})
    run = run_axis(cell, cut, np.zeros(samples))
    expected = robot_by_scipy(robot, run.command_m, cell.sample_time_s, parts)
    assert np.ptp(run.flange_m) > 1e-3
    # Both are exact; 15 000 steps of rounding on numbers near 25 mm stay far below a picometre.
    np.testing.assert_allclose(run.flange_m, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("axis", AXES)
def test_motion_and_force_lie_on_the_approach_axis_of_the_sensor(axis: str) -> None:
    run = silent_short_run(axis)
    recording, a, index = run.recording, run.axis, AXES.index(axis)
    assert recording.command is not None
    straight = without_turning(run)
    direction_B = rotation_matrices(recording.pose.quaternion_xyzw[-1:])[0][:, index]
    travelled = recording.pose.position_m - np.array(run.cell.base_position_m)
    commanded = recording.command.position_m - np.array(run.cell.base_position_m)
    np.testing.assert_allclose(travelled, a.flange_m[:, None] * direction_B, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(commanded, a.command_m[:, None] * direction_B, rtol=0.0, atol=1e-12)
    shown = (recording.wrench.force_n - run.cell.force_bias_S_n - weight_S_n(run))[straight]
    expected = np.zeros_like(shown)
    expected[:, index] = a.force_n[straight]
    np.testing.assert_allclose(shown, expected, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("axis", AXES)
def test_pressing_twists_the_sensor_about_the_contact_point(axis: str) -> None:
    run = silent_short_run(axis)
    a, direction_S = run.axis, np.eye(3)[AXES.index(axis)]
    # Nothing accelerates at the end of a hold: the whole of F comes from the wall.
    settled = (np.abs(a.force_n + a.contact_force_n) < 0.05) & (a.contact_force_n > 20.0)
    assert np.count_nonzero(settled) > 200
    moment = np.cross(run.cell.com_S_m, weight_S_n(run)) + run.cell.torque_bias_S_n_m
    shown = (run.recording.wrench.torque_n_m - moment)[settled]
    expected = -a.contact_force_n[settled, None] * np.cross(run.cell.contact_point_S_m, direction_S)
    # What is left of F + F_e (0.05 N) acts at the centre of mass, 0.15 m away.
    np.testing.assert_allclose(shown, expected, rtol=0.0, atol=0.05 * 0.15)


def test_turning_adds_the_inertia_of_the_payload() -> None:
    """τ = ∫ r × (g − a) dm for point masses whose inertia is the cell's, their accelerations by differences."""
    cell = silent(SimulatedCell(com_S_m=(0.0, 0.0, 0.0), inertia_S_kg_m2=(0.5, 0.4, 0.3), payload_mass_kg=20.0))
    run = simulate_cell(cell, Program(pose_count=2, jogging_s=0.0, sweep_s=0.0, contact_count=0), seed=4)
    assert run.recording.command is not None
    turned = rotation_matrices(run.recording.command.quaternion_xyzw)
    second_moment = 0.5 * np.sum(cell.inertia_S_kg_m2) - np.array(cell.inertia_S_kg_m2)
    expected = np.zeros((len(turned), 3))
    for axis in range(3):
        for side in (-1.0, 1.0):
            point_S = side * np.sqrt(3.0 * second_moment[axis] / cell.payload_mass_kg) * np.eye(3)[axis]
            path = turned @ point_S
            acceleration = np.gradient(np.gradient(path, cell.sample_time_s, axis=0), cell.sample_time_s, axis=0)
            force_S = np.einsum("nji,nj->ni", turned, -cell.payload_mass_kg / 6.0 * acceleration)
            expected += np.cross(point_S, force_S)
    shown = run.recording.wrench.torque_n_m - run.cell.torque_bias_S_n_m
    # Differences at h err by (ω h)² of the torque with moves of 0.8 s; where a move begins, jerk jumps: an h-th of it.
    assert np.max(np.abs(expected)) > 2.0
    assert np.max(np.abs(shown - expected)) < 0.02 * np.max(np.abs(expected))


def test_turning_adds_the_force_that_swings_the_centre_of_mass() -> None:
    """F = m (g − a) of the centre of mass, its acceleration by differences of its path."""
    run = simulate_cell(
        silent(SimulatedCell()), Program(pose_count=2, jogging_s=0.0, sweep_s=0.0, contact_count=0), seed=4
    )
    assert run.recording.command is not None
    h, turned = run.cell.sample_time_s, rotation_matrices(run.recording.command.quaternion_xyzw)
    path = turned @ np.array(run.cell.com_S_m)
    acceleration = np.gradient(np.gradient(path, h, axis=0), h, axis=0)
    expected = np.einsum("nji,nj->ni", turned, -run.cell.payload_mass_kg * acceleration)
    shown = run.recording.wrench.force_n - run.cell.force_bias_S_n - weight_S_n(run)
    # As above: (ω h)², and one sample where the jerk jumps.
    assert np.max(np.abs(expected)) > 10.0
    assert np.max(np.abs(shown - expected)) < 0.02 * np.max(np.abs(expected))


@pytest.mark.parametrize("delay_samples", [3.0, 2.4])
def test_a_hand_pushes_on_while_the_contact_begins(delay_samples: float) -> None:
    robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=delay_samples * 8e-4)
    cell, n = silent(SimulatedCell(robot=robot, wall_distance_m=1e-4)), 1000
    zeros, hand = np.zeros(n), np.full(n, 60.0)
    script = Script(
        rotation_rad=np.zeros((n, 3)),
        admittance=np.zeros(n, dtype=bool),
        command_m=zeros,
        desired_force_n=zeros,
        hand_force_n=hand,
        homing_n_per_m=zeros,
    )
    a = run_axis(cell, script, zeros)
    touching = a.contact_force_n > 0.0
    assert np.any(touching[1:] & ~touching[:-1])
    assert np.ptp(a.flange_m) < 1e-15  # a position-controlled robot does not give way; rounding is left
    load = a.contact_force_n + cell.drag_n_s_per_m * a.payload_velocity_m_s + a.force_n
    balance = cell.payload_mass_kg * np.diff(a.payload_velocity_m_s) / cell.sample_time_s
    residual = balance - (hand[:-1] - 0.5 * (load[1:] + load[:-1]))
    # Where contact begins F_e jumps by B_e v and bends by K_e v h: at 10 mm/s less than 2 N of the hand's 60.
    assert np.max(np.abs(residual)) < 2.0


def test_the_controller_ignores_forces_inside_its_deadband() -> None:
    cell = silent(SimulatedCell())
    n = 2000
    zeros = np.zeros(n)
    still = {"rotation_rad": np.zeros((n, 3)), "command_m": zeros, "desired_force_n": zeros, "homing_n_per_m": zeros}

    def pushed(force_n: float) -> AxisRun:
        script = Script(**still, admittance=np.ones(n, dtype=bool), hand_force_n=np.full(n, force_n))
        return run_axis(cell, script, zeros)

    # A suddenly applied push rings up to twice its size before it settles: 0.4 of the deadband stays inside.
    assert np.ptp(pushed(0.4 * cell.deadband_n).command_m) == 0.0
    assert np.ptp(pushed(4.0 * cell.deadband_n).command_m) > 1e-3


@pytest.mark.parametrize(
    "wrong",
    [
        {"approach_axis": "r"},
        {"environment": FREE_SPACE},
        {"deadband_n": -1.0},
        {"force_noise_rms_n": float("nan")},
        {"wall_distance_m": 0.0},
    ],
)
def test_a_cell_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ParameterError, match=next(iter(wrong))):
        SimulatedCell(**{**SimulatedCell().__dict__, **wrong})


@pytest.mark.parametrize(
    "wrong", [{"pose_count": 0}, {"contact_count": -1}, {"sweep_hz": (5.0, 5.0)}, {"sweep_hz": (0.0, 5.0)}]
)
def test_a_program_that_cannot_be_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ParameterError):
        Program(**{**Program().__dict__, **wrong})


def test_the_program_decides_what_the_log_holds() -> None:
    run = simulate_cell(SimulatedCell(), TINY, seed=0)
    assert np.all(run.axis.contact_force_n == 0.0)
    assert len(run.recording.wrench.stamp_ns) == len(run.script)
    np.testing.assert_array_equal(np.diff(run.recording.wrench.stamp_ns), 800_000)


def test_a_wall_with_mass_is_at_rest_again_before_the_next_contact() -> None:
    """Each contact shares the payload's momentum with a wall that stands still: v falls to M_p/(M_p + M_e) of it."""
    cell = silent(SimulatedCell())
    cell = replace(cell, environment=replace(cell.environment, mass_kg=3.0, damping_n_s_per_m=60.0))
    program = Program(pose_count=1, pose_hold_s=0.2, pose_move_s=0.2, jogging_s=0.0, sweep_s=0.0, contact_count=3)
    run = simulate_cell(cell, program, seed=1)
    force, speed = run.axis.contact_force_n, run.axis.payload_velocity_m_s
    begins = np.flatnonzero((force[1:] > 0.0) & (force[:-1] == 0.0))
    # Touches of one contact follow each other within a second.
    first = begins[np.concatenate([[True], np.diff(begins) * cell.sample_time_s > 1.0])]
    assert len(first) == 3
    kept = cell.payload_mass_kg / (cell.payload_mass_kg + 3.0)
    # Within the rest of the sample, 0.8 ms, spring and drag slow the payload by less than a percent.
    np.testing.assert_allclose(speed[first + 1] / speed[first], kept, rtol=0.01)


def test_a_scripted_move_begins_where_the_controller_left_the_command() -> None:
    """The script counts its command from the instant it takes over, wherever that instant has it."""
    cell, n = silent(SimulatedCell(wall_distance_m=1.0)), 600
    running, zeros = np.arange(n) % 300 < 150, np.zeros(n)
    script = Script(
        rotation_rad=np.zeros((n, 3)),
        admittance=running,
        command_m=np.asarray(0.02 + 1e-5 * np.arange(n), dtype=np.float64),
        desired_force_n=np.full(n, 30.0),
        hand_force_n=zeros,
        homing_n_per_m=zeros,
    )
    command = run_axis(cell, script, zeros).command_m
    moved = np.diff(command)
    takes_over = np.flatnonzero(running[:-1] & ~running[1:])
    np.testing.assert_allclose(moved[takes_over], 0.0, atol=1e-15)
    scripted = ~running[:-1] & ~running[1:]
    np.testing.assert_allclose(moved[scripted], 1e-5, rtol=1e-9)
    # The controller starts from where the script has left it as well, and moves on: no jump.
    assert np.max(np.abs(moved)) < 1e-3
    assert command[149] > command[1]
