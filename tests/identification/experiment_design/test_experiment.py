"""Sweep, taps, contacts and the order of the phases; what is predicted is what a simulated recording gives."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.errors import EstimateError
from identification.experiment_design.contacts import ContactPlan, plan_contacts, plan_taps, through_coupling
from identification.experiment_design.experiment import allowed_std, coupling_binds, plan_experiment
from identification.experiment_design.poses import PosePlan
from identification.experiment_design.result import ExperimentLimits, ExperimentPlan, StepKind
from identification.experiment_design.sweep import (
    Sweep,
    SweepLimits,
    SweepPlan,
    plan_sweep,
    robot_limit_hz,
    sweep_information,
)
from identification.experiment_design.values import Known, PlanValues, usual_values, values_of
from identification.identify import identify_cell
from identification.result import Estimate, Status
from identification.robot.position_loop import robot_response
from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.robot import RobotModel
from tests.autotune.formats.samples import make_identified
from tests.identification.synthetic import Load, felt_force, tapered

CELL = SimulatedCell()


def exact_cell() -> PlanValues:
    """The values of the simulated cell, nothing known of them, and a model that misses nothing."""
    assert CELL.coupling.stiffness_n_per_m == 3.1e5
    reported = {
        "damping_n_s_per_m": CELL.coupling.damping_n_s_per_m,
        "drag_n_s_per_m": CELL.drag_n_s_per_m,
        "environment_stiffness_n_per_m": CELL.environment.stiffness_n_per_m,
        "environment_damping_n_s_per_m": CELL.environment.damping_n_s_per_m,
        "force_noise_rms_n": CELL.force_noise_rms_n,
        "torque_noise_rms_n_m": CELL.torque_noise_rms_n_m,
        "position_noise_rms_m": CELL.position_noise_rms_m,
        "sample_time_s": CELL.sample_time_s,
        "misfit_share": 0.0,
        "pose_force_std_n": 1e-6,
        "pose_torque_std_n_m": 1e-7,
    }
    usual = usual_values(mass_kg=CELL.payload_mass_kg, stiffness_n_per_m=3.1e5)
    return with_known(usual, {name: Known(value=value) for name, value in reported.items()})


def with_known(values: PlanValues, entries: Mapping[str, Known]) -> PlanValues:
    return replace(values, **entries)  # type: ignore[arg-type]  # every field but the robot is of this kind


def known(values: PlanValues, **std: float) -> PlanValues:
    """The same values, each known to a tenth of what is allowed unless told otherwise."""
    allowed = allowed_std(values)
    changed = {name: replace(values.known()[name], std=std.get(name, 0.1 * limit)) for name, limit in allowed.items()}
    return with_known(values, changed)


def after(plan: ExperimentPlan) -> dict[str, float]:
    return {entry.name: entry.std_after or np.inf for step in plan.steps for entry in step.predictions}


def settings_of(plan: ExperimentPlan, kind: StepKind) -> object:
    return next((step.settings for step in plan.steps if step.kind is kind), None)


@pytest.mark.slow
def test_the_planned_recording_gives_the_predicted_deviations() -> None:
    plan = plan_experiment("x", exact_cell(), ExperimentLimits())
    sweep, contacts = settings_of(plan, StepKind.SWEEP), settings_of(plan, StepKind.CONTACTS)
    assert isinstance(sweep, SweepPlan)
    assert isinstance(contacts, ContactPlan)
    assert sweep.repeat is not None
    # The program's command grows as sqrt(1 + (f/3 Hz)²), which is 1/|r| of the cell's robot of 3.2 Hz within 6 %.
    program = Program(
        pose_count=6,
        pose_hold_s=0.7,
        pose_move_s=0.6,
        jogging_s=0.0,
        sweep_s=sweep.sweep.duration_s,
        sweep_hz=(sweep.sweep.low_hz, sweep.sweep.high_hz),
        sweep_speed_m_s=sweep.repeat.expected_factor * sweep.sweep.flange_speed_m_s,
        contact_count=contacts.count,
        contact_force_n=contacts.hold_force_n,
    )
    run = simulate_cell(CELL, program, seed=6)
    assert float(np.max(np.abs(run.axis.force_n))) < 100.0  # --max-force
    axis = identify_cell(run.recording).axes["x"]
    assert axis.mass_kg is not None
    predicted = after(plan)
    stated = {
        "stiffness_n_per_m": axis.coupling.stiffness_n_per_m,
        "damping_n_s_per_m": axis.coupling.damping_n_s_per_m,
        "drag_n_s_per_m": axis.drag_n_s_per_m,
        "motion_mass_kg": axis.mass_kg,
        "bandwidth_hz": axis.robot.bandwidth_hz,
        "delay_s": axis.robot.delay_s,
    }
    ratios = {name: (estimate.std or np.inf) / predicted[name] for name, estimate in stated.items()}
    assert {name: ratio for name, ratio in ratios.items() if not 0.5 < ratio < 2.0} == {}
    # Identification widens K_e and B_e by what its model leaves out of the impact, and tells by how much at most.
    surface = axis.environments[0]
    stiffness = (surface.stiffness_n_per_m.std or np.inf) / predicted["environment_stiffness_n_per_m"]
    damping = (surface.damping_n_s_per_m.std or np.inf) / predicted["environment_damping_n_s_per_m"]
    assert min(stiffness, damping) > 0.5
    assert max(stiffness, damping) < 2.0 * axis.fits[0].widening


def test_the_sweeps_information_is_that_of_the_samples() -> None:
    """Derivatives of pose and force by differences of simulations, summed over the samples of a real sweep."""
    values, load = exact_cell(), Load(stiffness=3.1e5, damping=150.0, drag=330.0, mass=16.2)
    sweep, h = Sweep(low_hz=1.0, high_hz=35.0, flange_speed_m_s=0.01, duration_s=8.0), values.sample_time_s.value
    t = np.arange(round(sweep.duration_s / h)) * h
    rate = np.log(sweep.high_hz / sweep.low_hz) / sweep.duration_s
    frequency = sweep.low_hz * np.exp(rate * t)
    speed = np.interp(frequency, sweep.frequency_hz(), sweep.command_speed_m_s(values.robot))
    phase = 2.0 * np.pi * sweep.low_hz * np.expm1(rate * t) / rate
    command = tapered(len(t), len(t) // 40) * speed / (2.0 * np.pi * frequency) * np.sin(phase)

    def moved(pole: float, delay: float) -> FloatArray:
        robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0 * pole, delay_s=2.4e-3 * delay)
        return robot_response(robot, command, h)

    driven = moved(1.0, 1.0)

    def measured(theta: FloatArray) -> FloatArray:
        k, b, p, m = theta[:4]
        # The force is that of the pose that was measured, whatever robot brought it there.
        force = felt_force(driven, h, replace(load, stiffness=k, damping=b, drag=p, mass=m))
        position = moved(theta[4], theta[5])
        return np.concatenate([position / values.position_noise_rms_m.value, force / values.force_noise_rms_n.value])

    theta = np.append(load.vector(), [1.0, 1.0])
    steps = np.diag(1e-3 * theta)
    slopes = np.stack([(measured(theta + d) - measured(theta - d)) / (2.0 * np.sum(d)) for d in steps], axis=1)
    expected = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    found = np.sqrt(np.diag(np.linalg.inv(sweep_information(values, sweep))))
    # The tapers and the payload's lag behind a moving frequency are left out of the prediction.
    np.testing.assert_allclose(found, expected, rtol=0.12)


def test_a_robot_without_a_delay_is_planned_for_as_one_with_hardly_any() -> None:
    known_robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=0.0)
    found = []
    for delay_s in (0.0, 1e-6):
        values = replace(exact_cell(), robot=replace(known_robot, delay_s=delay_s), delay_s=Known(value=delay_s))
        found.append(sweep_information(values, Sweep(low_hz=0.5, high_hz=50.0, flange_speed_m_s=0.01, duration_s=10.0)))
        assert plan_sweep(values, SweepLimits(), {"delay_s": 1e-4}).std["delay_s"] > 0.0
    np.testing.assert_allclose(found[0], found[1], rtol=1e-3)


def test_taps_show_what_their_samples_show() -> None:
    values = exact_cell()
    plan = plan_taps(values, max_force_n=80.0, mass_std_kg=0.05)
    h = values.sample_time_s.value
    t = np.arange(round(2.0 / h)) * h

    def ringing(theta: FloatArray) -> FloatArray:
        k, b, m, impulse = theta
        found = solve_ivp(
            lambda _, y: [y[1], -(k * y[0] + b * y[1]) / m], (0.0, t[-1]), [0.0, impulse / m], t_eval=t, rtol=1e-10
        )
        return np.asarray(k * found.y[0] / values.force_noise_rms_n.value)

    theta = np.array([3.1e5, 480.0, 16.2, plan.impulse_n_s])
    steps = np.diag(1e-3 * theta)
    slopes = np.stack([(ringing(theta + d) - ringing(theta - d)) / (2.0 * np.sum(d)) for d in steps], axis=1)
    information = plan.count * slopes.T @ slopes
    information[2, 2] += 1.0 / 0.05**2
    alone = float(np.sqrt(np.linalg.inv(information)[0, 0]))
    # The prediction adds 2 % for the flange that yields.
    assert plan.std["stiffness_n_per_m"] == pytest.approx(np.hypot(alone, 0.02 * 3.1e5), rel=0.02)
    peak = float(np.max(ringing(theta))) * values.force_noise_rms_n.value
    assert 0.5 * plan.peak_force_n < peak <= plan.peak_force_n <= 80.0


def test_a_sweep_that_cannot_reach_the_payloads_swing_is_helped_by_taps() -> None:
    values = usual_values()
    slow = replace(
        values, robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=1.0, delay_s=2.4e-3), misfit_share=Known(value=0.05)
    )
    assert robot_limit_hz(slow.robot) < 0.2 * slow.payload_frequency_hz
    assert settings_of(plan_experiment("x", values, ExperimentLimits()), StepKind.TAPS) is None
    plan = plan_experiment("x", slow, ExperimentLimits())
    (taps,) = [step for step in plan.steps if step.kind is StepKind.TAPS]
    assert "taps on the payload identify coupling K_s better" in taps.why
    sweep = settings_of(plan, StepKind.SWEEP)
    assert isinstance(sweep, SweepPlan)
    assert after(plan)["stiffness_n_per_m"] < sweep.std["stiffness_n_per_m"]


@pytest.mark.parametrize(
    ("limit", "bound_by"),
    [
        ({"max_speed_m_s": 1e-3}, "max-speed"),
        ({"max_force_n": 5.0}, "max-force"),
        ({"max_stroke_m": 2e-6}, "max-stroke"),
    ],
)
def test_no_sweep_passes_a_limit(limit: dict[str, float], bound_by: str) -> None:
    limits = ExperimentLimits(**{"max_stroke_m": 0.004, **limit})  # type: ignore[arg-type]  # all of them floats
    found = settings_of(plan_experiment("x", usual_values(), limits), StepKind.SWEEP)
    assert isinstance(found, SweepPlan)
    assert found.bound_by == bound_by
    robot = usual_values().robot
    largest = 1.0 if found.repeat is None else found.repeat.largest_factor
    speed, frequency = largest * found.sweep.command_speed_m_s(robot), found.sweep.frequency_hz()
    assert np.max(speed) <= limits.max_speed_m_s * (1.0 + 1e-9)
    assert found.peak_force_n <= found.worst_peak_force_n <= found.abort_force_n * (1.0 + 1e-9)
    assert found.abort_force_n < limits.max_force_n
    stroke = largest * found.sweep.flange_speed_m_s / (2.0 * np.pi * frequency[0])
    assert stroke <= limits.max_stroke_m * (1.0 + 1e-9)


@pytest.mark.parametrize(("mass", "stiffness"), [(0.05, 1e8), (1000.0, 1e3), (16.0, 3e5)])
@pytest.mark.parametrize("highest", [2.0, 60.0])
def test_the_worst_case_is_never_less_than_what_is_expected(mass: float, stiffness: float, highest: float) -> None:
    """Also where no resonance lies in the band, and the drag makes the force."""
    values = usual_values(mass_kg=mass, stiffness_n_per_m=stiffness)
    found = settings_of(
        plan_experiment("x", values, ExperimentLimits(max_frequency_hz=highest, pose_count=0)), StepKind.SWEEP
    )
    assert isinstance(found, SweepPlan)
    assert found.peak_force_n <= found.worst_peak_force_n * (1.0 + 1e-12)
    assert found.worst_peak_force_n <= found.abort_force_n * (1.0 + 1e-9)


def test_what_is_known_of_the_coupling_makes_the_first_sweep_louder_and_spares_the_repeat() -> None:
    """A coupling within 3 % and a robot within 1 % leave no surprise: the limit itself holds the speed down."""
    usual = usual_values()
    sharp = {name: replace(usual.known()[name], std=0.03 * usual.known()[name].value) for name in allowed_std(usual)}
    sharp["bandwidth_hz"] = replace(usual.bandwidth_hz, std=0.01 * usual.bandwidth_hz.value)
    reported = with_known(usual, sharp)
    first, later = (settings_of(plan_experiment("x", v, ExperimentLimits()), StepKind.SWEEP) for v in (usual, reported))
    assert isinstance(first, SweepPlan)
    assert isinstance(later, SweepPlan)
    assert first.repeat is not None
    assert later.repeat is None
    assert later.sweep.flange_speed_m_s > 5.0 * first.sweep.flange_speed_m_s
    assert later.worst.damping_ratio > 0.05
    assert later.worst_peak_force_n <= 90.0 * (1.0 + 1e-9)


@pytest.mark.parametrize("stiffness", [2e4, 1e5, 4e5])
def test_contacts_stay_below_the_force_that_is_allowed(stiffness: float) -> None:
    values = replace(exact_cell(), environment_stiffness_n_per_m=Known(value=stiffness))
    for limit in (40.0, 150.0):
        plan = plan_contacts(values, max_force_n=limit, allowed=allowed_std(values))
        assert plan is not None
        assert max(plan.peak_contact_force_n, plan.peak_sensor_force_n) <= limit
        # An impact on the wall's spring alone is the size of it: the robot behind the coupling presses on or gives way.
        assert 0.5 < plan.peak_contact_force_n / plan.rigid_peak_n < 2.0
    assert plan_contacts(values, max_force_n=5.0, allowed=allowed_std(values)) is None


def test_a_first_recording_needs_everything_and_begins_with_the_poses() -> None:
    plan = plan_experiment("x", usual_values(), ExperimentLimits())
    assert [step.kind for step in plan.steps] == [StepKind.POSES, StepKind.SWEEP, StepKind.CONTACTS]
    assert all(step.is_needed for step in plan.steps)
    assert isinstance(settings_of(plan, StepKind.POSES), PosePlan)
    sweep = settings_of(plan, StepKind.SWEEP)
    assert isinstance(sweep, SweepPlan)
    # The robot reaches beyond the payload's swing, both sides of which identification needs.
    assert sweep.robot_limit_hz > 1.15 * plan.values.payload_frequency_hz
    assert sweep.sweep.high_hz >= 1.15 * plan.values.payload_frequency_hz
    allowed = allowed_std(plan.values)
    assert all(std <= allowed[name] for name, std in after(plan).items())
    assert set(plan.values.assumed) >= {"mass_kg", "stiffness_n_per_m", "force_noise_rms_n", "position_noise_rms_m"}


@pytest.mark.parametrize(
    ("worst", "first"),
    [("mass_kg", "poses"), ("drag_n_s_per_m", "sweep"), ("environment_damping_n_s_per_m", "contacts")],
)
def test_what_is_known_worst_comes_first(worst: str, first: str) -> None:
    values = usual_values()
    plan = plan_experiment("x", known(values, **{worst: 3.0 * allowed_std(values)[worst]}), ExperimentLimits())
    assert plan.binding == worst
    assert plan.steps[0].kind == first
    assert [step.is_needed for step in plan.steps] == [True, False, False]
    entry = next(entry for entry in plan.steps[0].predictions if entry.name == worst)
    assert entry.std_now is not None
    assert entry.std_after is not None
    assert entry.std_after < entry.allowed_std < entry.std_now
    assert entry.urgency == pytest.approx(3.0)


def test_where_the_coupling_binds_the_sweep_comes_first_and_contacts_do_not_help() -> None:
    values = replace(usual_values(), environment_stiffness_n_per_m=Known(value=6e5))
    share = through_coupling(values, 0.04 * 3e5)  # identified, yet 16 % of a K_e twice as stiff, less 1/1
    assert share == pytest.approx(4.0 * 0.04 * 3e5)
    stuck = known(values, stiffness_n_per_m=0.04 * 3e5, environment_stiffness_n_per_m=1.05 * share)
    assert coupling_binds(stuck)
    plan = plan_experiment("x", stuck, ExperimentLimits(max_force_n=300.0))
    assert plan.binding == "environment_stiffness_n_per_m"
    assert plan.steps[0].kind is StepKind.SWEEP
    assert "sweep" in plan.steps[0].why
    contacts = next(step for step in plan.steps if step.kind is StepKind.CONTACTS)
    assert not contacts.is_needed
    assert "more contacts do not help" in contacts.why
    assert after(plan)["environment_stiffness_n_per_m"] < 0.5 * share
    assert not coupling_binds(known(values, stiffness_n_per_m=0.01 * 3e5, environment_stiffness_n_per_m=1e5))


def test_two_degrees_are_refused_where_poses_are_needed_and_only_there() -> None:
    values = usual_values()
    with pytest.raises(EstimateError, match="it takes 15 degrees"):
        plan_experiment("x", values, ExperimentLimits(max_tilt_deg=2.0))
    kinds = [step.kind for step in plan_experiment("x", values, ExperimentLimits(max_tilt_deg=2.0, pose_count=0)).steps]
    assert kinds == [StepKind.SWEEP, StepKind.CONTACTS]
    enough = plan_experiment("x", known(values), ExperimentLimits(max_tilt_deg=2.0))
    assert settings_of(enough, StepKind.POSES) is None
    assert not any(step.is_needed for step in enough.steps)


def test_an_identified_file_gives_its_values_and_usual_ones_where_it_is_silent() -> None:
    found = make_identified()
    axis = found.axes["x"]
    name, values = values_of(found)
    assert name == "x"
    assert values.mass_kg == Known(value=16.0, std=0.0, is_assumed=False)  # given without a deviation is exact
    assert values.com_m.value == pytest.approx(np.sqrt(0.01**2 + 0.02**2 + 0.1**2))
    assert values.com_m.std == 0.01
    assert values.force_noise_rms_n.value == 0.3
    assert values.pose_force_std_n.value == 1.1
    assert axis.drag_n_s_per_m.value is None
    assert values.drag_n_s_per_m.std is None
    assert values.drag_n_s_per_m.is_assumed
    weak = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
    no_stiffness = replace(axis, coupling=replace(axis.coupling, stiffness_n_per_m=weak))
    _, values = values_of(replace(found, axes={"x": no_stiffness}))
    assert values.stiffness_n_per_m == Known(value=3e5)
    with pytest.raises(ParameterError, match="--axis"):
        values_of(replace(found, axes={"x": axis, "y": axis}))


def test_the_noise_of_the_pose_that_was_measured_is_planned_with() -> None:
    """A delay is told by the pose: at four times the noise of the usual one a sweep tells it less well."""
    found = make_identified()
    noisy = Estimate(value=2e-5, std=1e-7, status=Status.IDENTIFIED)
    reported = replace(found, sensor=replace(found.sensor, position_noise_rms_m=noisy))
    (_, before), (_, values) = values_of(found), values_of(reported)
    assert before.position_noise_rms_m == Known(value=5e-6)
    assert values.position_noise_rms_m == Known(value=2e-5, std=1e-7, is_assumed=False)
    sweep = Sweep(low_hz=1.0, high_hz=35.0, flange_speed_m_s=0.01, duration_s=8.0)
    quiet, loud = (np.linalg.inv(sweep_information(v, sweep)) for v in (before, values))
    assert loud[-1, -1] > quiet[-1, -1]
    # The pose alone tells the delay: four times the noise, 16 times the variance.
    assert loud[-1, -1] == pytest.approx(16.0 * quiet[-1, -1], rel=1e-6)


@pytest.mark.parametrize(
    "wrong", [{"pose_count": 3}, {"max_tilt_deg": 0.0}, {"max_force_n": float("nan")}, {"max_speed_m_s": -1.0}]
)
def test_limits_that_leave_nothing_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ParameterError):
        ExperimentLimits(**wrong)  # type: ignore[arg-type]  # on purpose
