"""What the fit of an axis says of a turn: units, weight, inertia, and a simulated cell found again."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import StateSpace, lsim

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.axes.straight import commanded_motion, find_axes, free_motions, unguided_spans
from identification.axes.turning import AxisTurn, find_turns, rests_after, unroll
from identification.axis_command import CellSignals
from identification.joint_fit.data import build_joint_data
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.latency import WrenchLatency
from identification.joint_fit.model import COUPLING_NAMES, ParameterLayout
from identification.joint_fit.result import JointFit, JointSurface
from identification.joint_fit.segments import find_holds
from identification.payload.gravity import identify_gravity
from identification.payload.inertia import InertiaFit
from identification.payload.static_poses import collect_static_poses
from identification.result import Estimate, Status
from identification.robot.coupling import CouplingFit, FreeMotion, Noise, identify_coupling
from identification.robot.position_loop import identify_robot
from identification.signals.aligned import align
from identification.signals.segments import Span, find_motion
from identification.turn_estimate import fit_about_axis, identify_turn, inertia_findings, is_change_of_pose, path_of
from identification.verdicts import unidentifiable
from problems.arrays import FloatArray
from problems.model.axis_kind import LEVER_M
from problems.model.controller import AdmittanceController
from problems.model.robot import RobotModel
from tests.autotune.formats.samples import FIT
from tests.identification.synthetic import Load, felt_force, sweep
from tests.identification.turned import H_S, RATE_HZ, WEIGHTLESS, recorded, to_and_fro, turns_of


def joint_fit(names: tuple[str, ...], values: FloatArray) -> JointFit:
    return JointFit(
        names=names,
        values=values,
        covariance=np.diag((1e-3 * values) ** 2),
        ci95={"drag_n_s_per_m": (1.0, 3.0)},
        robot=None,
        surfaces=(
            JointSurface(
                sign=1,
                first_parameter=len(names) - 3,
                secant_n_per_m=5e4,
                secant_std_n_per_m=50.0,
                onsets=(7,),
                peak_force_n=(40.0,),
            ),
        ),
        latency=WrenchLatency(seconds=0.0, std_s=1e-5, applied_s=0.0),
        quality=FIT,
    )


def any_turn(weight_n_m_per_rad: float) -> AxisTurn:
    (turn,) = turns_of(recorded(np.outer(to_and_fro(), [1.0, 0.0, 0.0])))
    return replace(turn, weight_n_m_per_rad=weight_n_m_per_rad)


def test_a_fit_is_reported_in_the_units_of_a_rotation() -> None:
    names = ParameterLayout(robot_order=2, surfaces=1).names
    values = np.array([2e5, 100.0, 200.0, 12.0, 20.0, 0.7, 3e-3, 8e4, 30.0, 0.5])
    reported = fit_about_axis(joint_fit(names, values), any_turn(0.0))
    square = LEVER_M**2
    np.testing.assert_allclose(
        reported.values[[0, 1, 2, 3, 7, 8, 9]], square * values[[0, 1, 2, 3, 7, 8, 9]], rtol=1e-12
    )
    # A robot has no unit of length.
    np.testing.assert_array_equal(reported.values[4:7], values[4:7])
    np.testing.assert_allclose(reported.std / reported.values, 1e-3, rtol=1e-9)
    assert reported.ci95["drag_n_s_per_m"] == pytest.approx((square, 3.0 * square))
    (surface,) = reported.surfaces
    assert surface.secant_n_per_m == pytest.approx(square * 5e4)
    assert surface.secant_std_n_per_m == pytest.approx(square * 50.0)
    assert surface.peak_force_n == pytest.approx((LEVER_M * 40.0,))
    assert path_of((3.0, 0.1)) == pytest.approx((3.0 / LEVER_M**2, 0.1 / LEVER_M**2))


def no_inertia() -> InertiaFit:
    unknown = unidentifiable(note="not turned")
    return InertiaFit(
        components=6 * (unknown,), mass_kg=unknown, lag_s=0.0, lag_std_s=0.0, moves=4, left_out=0, findings=()
    )


def test_a_rest_is_a_hold_under_more_than_six_residuals_of_the_torque(monkeypatch: pytest.MonkeyPatch) -> None:
    residual_n_m, angle = 0.5, to_and_fro()
    # The tool rests four times after a turn: twice with the angle, with a little less and a little more than 3 N·m.
    torque = np.where(angle > 0.059, 2.7, 0.0)
    torque[len(torque) // 2 :] *= 3.3 / 2.7
    about_x = np.array([1.0, 0.0, 0.0])
    recording = recorded(np.outer(angle, about_x), torque=np.outer(torque, about_x))
    log = align(recording)
    motion = find_motion(log)
    gravity = replace(WEIGHTLESS, torque_residual_rms_n_m=residual_n_m)
    (turn,) = find_turns(recording, log, motion, gravity)
    held: list[Span] = []

    def fit_axis(*arguments: Any) -> SimpleNamespace:
        held.extend(arguments[2])
        return SimpleNamespace(fit=None)

    monkeypatch.setattr("identification.turn_estimate.fit_axis", fit_axis)
    cell = CellSignals(
        recording=recording,
        log=log,
        motion=motion,
        gravity=gravity,
        noise_rms_n=0.0,
        rest_residual_n=0.0,
        force_S_n=np.zeros((len(angle), 3)),
        given={},
        robots={},
    )
    assert identify_turn(cell, turn, no_inertia()) is None
    assert [float(np.median(torque[span.slice])) for span in held] == [pytest.approx(3.3)]


@pytest.mark.parametrize(("value", "std", "agrees"), [(0.48, 5e-3, True), (0.6, 5e-3, False), (0.6, 0.1, True)])
def test_the_inertia_of_a_turn_is_compared_with_the_tensors(value: float, std: float, agrees: bool) -> None:
    values = np.array([2e5, 100.0, 200.0, 12.0])
    turn = any_turn(0.0)
    fit = fit_about_axis(joint_fit(COUPLING_NAMES, values), turn)
    xx = Estimate(value=value, std=std, status=Status.IDENTIFIED)
    unknown = no_inertia()
    tensor = replace(unknown, components=(xx, *unknown.components[1:]))
    found = inertia_findings(fit, turn, tensor)
    assert [f.code for f in found] == ([] if agrees else ["inertia-disagreement"])
    if found:
        assert "Axis rx" in found[0].message
        assert "0.48 ± 0.00048" in found[0].message
    assert inertia_findings(fit, turn, unknown) == ()


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, True),
        ({"is_swept": True}, False),
        ({"holds": (Span(start=5, stop=9),)}, False),
        ({"stiffness": replace(unidentifiable(), ci95=(1.0, 9.0))}, False),
        ({"stiffness": Estimate(value=6e3, std=60.0, status=Status.IDENTIFIED)}, False),
    ],
    ids=["turned", "swept", "pressed", "bounded", "identified"],
)
def test_a_change_of_pose_is_no_sweep_with_a_bad_fit(change: dict[str, Any], expected: bool) -> None:
    turn = replace(any_turn(0.0), is_swept=change.get("is_swept", False))
    result: Any = SimpleNamespace(
        estimate=SimpleNamespace(
            coupling=SimpleNamespace(stiffness_n_per_m=change.get("stiffness", unidentifiable(note="not swept")))
        ),
        contacts=SimpleNamespace(holds=change.get("holds", ())),
    )
    assert is_change_of_pose(turn, result) is expected


def held_up(angle: FloatArray, load: Load, weight: float) -> FloatArray:
    """Torque without the weight at the flange's angle, of a payload whose weight turns back what the payload turns."""
    time = np.arange(len(angle)) * H_S / 4.0
    rate = CubicSpline(time, angle)(time, 1)
    k, b, p, j = load.vector()
    system = StateSpace(
        np.array([[0.0, 1.0], [-(k + weight) / j, -(b + p) / j]]),
        np.array([[0.0, 0.0], [k / j, b / j]]),
        np.array([[k, b]]),
        np.array([[-k, -b]]),
    )
    _, felt, _ = lsim(system, np.column_stack([angle, rate]), time)
    return np.asarray(felt + weight * angle)


def fitted(angle: FloatArray, torque: FloatArray) -> CouplingFit:
    motion = FreeMotion(position_m=LEVER_M * angle, force_n=torque / LEVER_M)
    noise = Noise(force_rms_n=0.05, position_rms_m=1e-6)
    return identify_coupling([motion], H_S / 4.0, 4.0 * RATE_HZ, noise)


def vector(fit: CouplingFit) -> FloatArray:
    return np.array([fit.stiffness_n_per_m, fit.damping_n_s_per_m, fit.drag_n_s_per_m, fit.mass_kg])


def test_a_turning_payload_is_found_on_its_path() -> None:
    load = Load(stiffness=6.0e3, damping=4.0, drag=9.0, mass=0.4)
    angle = 5.0 * sweep(8.0, 4.0 * RATE_HZ)
    found = LEVER_M**2 * vector(fitted(angle, felt_force(angle, H_S / 4.0, load)))
    # Signals without noise: what is left is their interpolation between samples, (ω h)²/12 at 50 Hz.
    np.testing.assert_allclose(found, load.vector(), rtol=3e-3)


def test_the_weight_of_the_payload_costs_as_much_as_is_added_for_it() -> None:
    load = Load(stiffness=2.0e3, damping=2.0, drag=7.0, mass=0.3)
    weight, angle = 40.0, 5.0 * sweep(8.0, 4.0 * RATE_HZ)
    share = weight / load.stiffness
    shifts = vector(fitted(angle, held_up(angle, load, weight))) / vector(fitted(angle, held_up(angle, load, 0.0))) - 1
    # To first order in κ = 2 %; B_s, a thirtieth of the critical damping, also takes what no model holds.
    np.testing.assert_allclose(shifts[[0, 2, 3]], [-share, -2.0 * share, -2.0 * share], rtol=0.15)
    fit = joint_fit(COUPLING_NAMES, load.vector() / LEVER_M**2)
    reported = fit_about_axis(fit, any_turn(weight))
    np.testing.assert_allclose(reported.values, load.vector(), rtol=1e-12)
    added = np.sqrt(reported.std**2 - (LEVER_M**2 * fit.std) ** 2) / reported.values
    np.testing.assert_allclose(added, [share, share, 2.0 * share, 2.0 * share], rtol=1e-9)
    correlation = reported.covariance[0, 3] / (share * reported.values[0] * 2.0 * share * reported.values[3])
    assert correlation == pytest.approx(1.0, rel=1e-9)


# One tick is 4 ms, and the delay no whole number of them; so slow a loop needs more damping to press without bouncing.
TURNING = SimulatedCell.turning(
    "ry",
    sample_time_s=4e-3,
    controller=AdmittanceController(mass_kg=0.35, damping_n_s_per_m=110.0),
    wall_distance_m=0.05,
    robot=RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 48.0, 900.0]), delay_s=6.3e-3),
)
PROGRAM = Program.turning(pose_count=5, jogging_s=0.0, sweep_s=7.0, contact_count=2)


@pytest.fixture(scope="module")
def found_again() -> JointFit:
    """The simulated cell through the stages and the joint fit."""
    recording = simulate_cell(TURNING, PROGRAM, seed=5).recording
    log = align(recording)
    motion = find_motion(log)
    gravity = identify_gravity(collect_static_poses(log, motion.still))
    assert find_axes(log, motion, gravity.compensated_force_S_n(log)).axes == ()
    (turn,) = find_turns(recording, log, motion, gravity)
    assert turn.name == "ry"
    straight = unroll(turn, recording, log)
    axis, command = straight.axis, straight.recording.command
    noise = Noise(force_rms_n=TURNING.torque_noise_rms_n_m / LEVER_M, position_rms_m=1e-6)
    coupling = identify_coupling(free_motions(axis, unguided_spans(axis), log.period_s), log.period_s, 250.0, noise)
    assert command is not None
    moved = commanded_motion(straight.recording, command, straight.log, axis)
    robot = identify_robot(moved.command_m, moved.position_m, moved.period_s).model
    holds = rests_after(axis.spans, find_holds(motion.still, axis.force_n, 4.0))
    data = build_joint_data(straight.log, motion, axis, holds, coupling, robot, command, coupling.mass_kg)
    return fit_about_axis(identify_joint(data), turn)


def test_a_cell_that_turns_is_found_again(found_again: JointFit) -> None:
    wall, spring = TURNING.environment, TURNING.coupling
    truths = {
        "stiffness_n_per_m": spring.stiffness_n_per_m,
        "damping_n_s_per_m": spring.damping_n_s_per_m,
        "drag_n_s_per_m": TURNING.drag_n_s_per_m,
        "mass_kg": TURNING.moved_mass_kg,
        "robot_frequency_rad_per_s": 30.0,
        "robot_damping_ratio": 0.8,
        "delay_s": 6.3e-3,
        "environment1_stiffness_n_per_m": wall.stiffness_n_per_m,
        "environment1_damping_n_s_per_m": wall.damping_n_s_per_m,
    }
    usable = {"damping_n_s_per_m": 0.06, "environment1_damping_n_s_per_m": 0.35}
    for name, truth in truths.items():
        value, std = found_again.value(name)
        # Nine values, none beyond the quantile of 1e-4 in all of them: 4.4 deviations.
        assert abs(value - truth) < 4.4 * std, name
        # Deviations that a tuner can use; a wall's damping is the hardest to tell, and the coupling's holds what a part
        # of the payload that no log shows may do to it.
        assert std < usable.get(name, 0.03) * truth, name
    assert (found_again.quality.free_spans, found_again.quality.contacts) == (1, 2)
    (surface,) = found_again.surfaces
    k_s, k_e = spring.stiffness_n_per_m, wall.stiffness_n_per_m
    assert abs(surface.secant_n_per_m - k_s * k_e / (k_s + k_e)) < 4.4 * surface.secant_std_n_per_m


def test_the_peak_of_a_contact_is_a_torque(found_again: JointFit) -> None:
    run = simulate_cell(TURNING, PROGRAM, seed=5)
    (surface,) = found_again.surfaces
    # The largest of some hundred noisy samples exceeds the true one by up to four deviations.
    assert max(surface.peak_force_n) == pytest.approx(-np.min(run.axis.force_n), abs=4.0 * 0.012)
