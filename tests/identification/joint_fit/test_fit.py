"""The joint refinement over simulated cells: the truth within what is stated, and honest where it cannot tell."""

import dataclasses

import numpy as np
import pytest

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.axes.straight import commanded_motion, find_axes, free_motions, unguided_spans
from identification.errors import EstimateError
from identification.joint_fit.data import JointData, build_joint_data, hold_command, uncovered
from identification.joint_fit.estimates import JointEstimates
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.result import JointFit, with_gain_error, without_aliases
from identification.joint_fit.segments import find_holds
from identification.joint_fit.solve import stiffest_seen_n_per_m
from identification.payload.gravity import identify_gravity
from identification.payload.static_poses import collect_static_poses
from identification.result import Status
from identification.robot.coupling import Noise, identify_coupling
from identification.robot.position_loop import identify_robot
from identification.signals.aligned import align
from identification.signals.recording import PoseSignal, Recording
from identification.signals.segments import find_motion
from problems.arrays import FloatArray
from problems.model.plant import Environment
from problems.model.robot import RobotModel
from problems.progress import ProgressSlice

SHORT = Program(pose_count=5, jogging_s=0.0, sweep_s=7.0, contact_count=2)
SLOW = SimulatedCell(
    sample_time_s=4e-3,
    payload_mass_kg=9.0,
    robot=RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 48.0, 900.0]), delay_s=6.3e-3),
)


def gathered(recording: Recording, *, with_command: bool = True) -> JointData:
    """What the stages hand on."""
    log = align(recording)
    motion = find_motion(log)
    gravity = identify_gravity(collect_static_poses(log, motion.still))
    (axis,) = find_axes(log, motion, gravity.compensated_force_S_n(log)).axes
    noise = Noise(force_rms_n=gravity.noise_rms_n, position_rms_m=2e-6)
    free = free_motions(axis, unguided_spans(axis), log.period_s)
    coupling = identify_coupling(free, log.period_s, log.pose_rate_hz, noise)
    assert recording.command is not None
    moved = commanded_motion(recording, recording.command, log, axis)
    robot = identify_robot(moved.command_m, moved.position_m, moved.period_s).model
    holds = find_holds(motion.still, axis.force_n, 4.0)
    command = recording.command if with_command else None
    return build_joint_data(log, motion, axis, holds, coupling, robot, command, gravity.mass_kg)


def truth(cell: SimulatedCell, names: tuple[str, ...]) -> FloatArray:
    k, e = cell.coupling, cell.environment
    known = {
        "stiffness_n_per_m": k.stiffness_n_per_m,
        "damping_n_s_per_m": k.damping_n_s_per_m,
        "drag_n_s_per_m": cell.drag_n_s_per_m,
        "mass_kg": cell.payload_mass_kg,
        "delay_s": cell.robot.delay_s,
        "robot_frequency_rad_per_s": cell.robot.denominator[-1] ** (1.0 / cell.robot.order),
        "robot_damping_ratio": 0.5 * cell.robot.denominator[1] / np.sqrt(cell.robot.denominator[-1]),
        "environment1_stiffness_n_per_m": e.stiffness_n_per_m,
        "environment1_damping_n_s_per_m": e.damping_n_s_per_m,
        "environment1_mass_kg": e.mass_kg,
    }
    return np.array([known[name] for name in names])


def scores(fit: JointFit, cell: SimulatedCell) -> FloatArray:
    return np.asarray((fit.values - truth(cell, fit.names)) / fit.std)


@pytest.fixture(scope="module")
def demo_recording() -> Recording:
    """The demo cell through a shorter program."""
    return simulate_cell(SimulatedCell(), dataclasses.replace(SHORT, contact_count=3), seed=1).recording


@pytest.fixture(scope="module")
def demo_data(demo_recording: Recording) -> JointData:
    return gathered(demo_recording)


@pytest.fixture(scope="module")
def demo_fit(demo_data: JointData) -> JointFit:
    return identify_joint(demo_data)


def test_every_parameter_of_the_demo_cell_is_where_it_is_said_to_be(demo_fit: JointFit) -> None:
    cell = SimulatedCell()
    # Nine values, none beyond the quantile of 1e-4 in all of them: 4.4 deviations.
    assert np.max(np.abs(scores(demo_fit, cell))) < 4.4
    # Half a percent is what a tuner can use without thinking of it.
    for name in ("stiffness_n_per_m", "mass_kg", "drag_n_s_per_m", "environment1_stiffness_n_per_m", "delay_s"):
        value, std = demo_fit.value(name)
        assert std < 5e-3 * value
    k_s, k_e = cell.coupling.stiffness_n_per_m, cell.environment.stiffness_n_per_m
    (surface,) = demo_fit.surfaces
    assert abs(surface.secant_n_per_m - k_s * k_e / (k_s + k_e)) < 4.4 * surface.secant_std_n_per_m
    assert surface.sign == 1
    assert len(surface.onsets) == len(surface.peak_force_n) == demo_fit.quality.contacts > 1


def test_what_remains_is_the_sensors_noise(demo_fit: JointFit) -> None:
    reported = demo_fit.quality
    assert reported.whiteness_contact is not None
    assert reported.explained_contact is not None
    assert (reported.noise_ratio_free, reported.noise_ratio_contact) == pytest.approx((1.0, 1.0), abs=0.1)
    assert min(reported.whiteness_free, reported.whiteness_contact) > 1e-3
    assert min(reported.explained_free, reported.explained_contact) > 0.999
    # A contact that took no part is predicted to its noise: 0.14 N of some 15 N.
    assert reported.left_out_contact == pytest.approx(0.01, abs=0.01)


def test_the_stiffest_spring_that_shows_swings_once_in_two_samples() -> None:
    stiffest = stiffest_seen_n_per_m(3.2, 4e-3)
    assert 2.0 * np.pi / np.sqrt(stiffest / 3.2) == pytest.approx(2.0 * 4e-3)


def test_a_spring_that_swings_faster_than_it_is_sampled_is_not_reported_and_nor_is_k_e_alone(
    demo_fit: JointFit,
) -> None:
    values = demo_fit.values.copy()
    stiffest = stiffest_seen_n_per_m(float(values[3]), 8e-4)
    assert np.array_equal(without_aliases(values, demo_fit.covariance, 8e-4), demo_fit.covariance)
    values[0] = 2.0 * stiffest
    covariance = without_aliases(values, demo_fit.covariance, 8e-4)
    assert np.array_equal(covariance[1:, 1:], demo_fit.covariance[1:, 1:])
    assert not np.any(covariance[0, 1:])
    reported = JointEstimates(
        name="x", fit=dataclasses.replace(demo_fit, values=values, covariance=covariance), period_s=8e-4
    )
    assert reported.coupling.stiffness_n_per_m.status is Status.UNIDENTIFIABLE
    (surface,) = reported.environments
    assert surface.stiffness_n_per_m.status is Status.UNIDENTIFIABLE
    assert "K_s is not identified" in surface.stiffness_n_per_m.note
    assert surface.secant_stiffness_n_per_m.status is Status.IDENTIFIED


def test_the_covariance_is_a_covariance(demo_fit: JointFit) -> None:
    np.testing.assert_allclose(demo_fit.covariance, demo_fit.covariance.T, rtol=1e-9, atol=1e-30)
    scaled = demo_fit.covariance / np.outer(demo_fit.std, demo_fit.std)
    assert np.min(np.linalg.eigvalsh(scaled)) > 0.0
    with pytest.raises(ValueError, match="read-only"):
        demo_fit.covariance[0, 0] = 1.0


def test_without_a_command_there_is_no_robot_and_less_certainty(demo_recording: Recording, demo_fit: JointFit) -> None:
    fit = identify_joint(gathered(demo_recording, with_command=False))
    assert fit.robot is None
    assert "delay_s" not in fit.names
    assert np.max(np.abs(scores(fit, SimulatedCell()))) < 4.4
    for name in ("stiffness_n_per_m", "mass_kg"):
        assert fit.value(name)[1] > demo_fit.value(name)[1]
    (surface,) = JointEstimates(name="x", fit=fit, period_s=8e-4).environments
    assert surface.stiffness_n_per_m.status is Status.WEAK
    # What a part that no log shows may do to B_e is nearly as much as B_e itself, of which the interval is left.
    low, high = surface.damping_n_s_per_m.ci95 or (0.0, 0.0)
    assert surface.damping_n_s_per_m.status is Status.UNIDENTIFIABLE
    assert low <= SimulatedCell().environment.damping_n_s_per_m <= high


@pytest.mark.parametrize("moving_kg", [0.0, 4.0])
def test_a_slow_loop_with_two_poles_and_an_environment_with_mass(moving_kg: float) -> None:
    """At 4 ms the resonance of 30 Hz lies beyond the band of the stages."""
    environment = Environment(stiffness_n_per_m=4.0e4, damping_n_s_per_m=200.0, mass_kg=moving_kg)
    cell = dataclasses.replace(SLOW, environment=environment)
    fit = identify_joint(gathered(simulate_cell(cell, dataclasses.replace(SHORT, contact_count=1), seed=2).recording))
    assert np.max(np.abs(scores(fit, cell))) < 4.4
    mass, std = fit.value("environment1_mass_kg")
    assert std < 1.0
    assert abs(mass - moving_kg) < 4.4 * std


def test_a_parameter_near_zero_has_an_interval_that_ends_there(demo_fit: JointFit) -> None:
    low, high = demo_fit.ci95["environment1_mass_kg"]
    assert low == 0.0
    assert demo_fit.value("environment1_mass_kg")[0] < high < 0.2
    assert "stiffness_n_per_m" not in demo_fit.ci95


def test_outside_knowledge_enters_as_a_prior(demo_data: JointData, demo_fit: JointFit) -> None:
    mass, std = demo_fit.value("mass_kg")
    known = mass + 2.0 * std, 0.01 * std
    fit = identify_joint(dataclasses.replace(demo_data, priors={"mass_kg": known}))
    # A hundred times surer than the log: what is known decides, and K_s goes with it (K_s/M_p is what a log tells).
    assert fit.value("mass_kg")[0] == pytest.approx(known[0], abs=0.1 * std)
    assert fit.value("stiffness_n_per_m")[0] > demo_fit.value("stiffness_n_per_m")[0]


def test_a_contact_with_a_hand_in_it_is_left_out(demo_data: JointData, demo_fit: JointFit) -> None:
    force = demo_data.force_n.copy()
    hold = demo_data.holds[1]
    time = np.arange(len(force)) * demo_data.period_s
    pushed = slice(hold.start - round(0.4 / demo_data.period_s), hold.stop)
    force[pushed] += 12.0 * np.sin(2.0 * np.pi * 3.0 * time[pushed])
    fit = identify_joint(dataclasses.replace(demo_data, force_n=force))
    assert fit.quality.contacts == demo_fit.quality.contacts - 1
    assert np.max(np.abs(scores(fit, SimulatedCell()))) < 4.4


def test_a_start_far_off_leads_to_the_same_place(demo_data: JointData, demo_fit: JointFit) -> None:
    """As where the stage refuses the coupling: the mass and a resonance of 25 Hz are all that is known."""
    mass, omega = 16.0, 2.0 * np.pi * 25.0
    start = np.array([mass * omega**2, 0.1 * mass * omega, 200.0, mass])
    fit = identify_joint(dataclasses.replace(demo_data, coupling=start))
    # The last steps end within hundredths of a deviation.
    assert np.max(np.abs(fit.values - demo_fit.values) / demo_fit.std) < 0.1


def test_nothing_to_fit_is_refused_and_reported(demo_data: JointData) -> None:
    with pytest.raises(EstimateError, match=r"Of 0 spans of motion.*record a commanded sweep"):
        identify_joint(dataclasses.replace(demo_data, free=(), mixed=()))
    with pytest.raises(EstimateError, match="measured at rest without contact"):
        identify_joint(dataclasses.replace(demo_data, rests=()))


def test_a_log_without_contact_still_has_a_coupling(demo_data: JointData) -> None:
    shares: list[float] = []
    fit = identify_joint(dataclasses.replace(demo_data, holds=()), ProgressSlice(shares.append))
    # What is done is reported after each of four parts, none of which is more than half of it.
    assert len(shares) == 4
    assert max(shares) < 0.5
    assert 0.7 < sum(shares) < 1.0
    assert fit.surfaces == ()
    assert fit.quality.contacts == 0
    assert np.max(np.abs(scores(fit, SimulatedCell()))) < 4.4


@pytest.mark.parametrize("shift_s", [0.0, 3e-4])
def test_a_command_issued_later_in_the_sample_shortens_the_delay(
    demo_recording: Recording, demo_fit: JointFit, shift_s: float
) -> None:
    command = demo_recording.command
    assert command is not None
    late = dataclasses.replace(command, stamp_ns=command.stamp_ns + int(shift_s * 1e9))
    fit = identify_joint(gathered(dataclasses.replace(demo_recording, command=late)))
    # The same numbers reach the fit; only where the delay counts from differs.
    assert fit.value("delay_s")[0] == pytest.approx(demo_fit.value("delay_s")[0] - shift_s, abs=1e-8)


def held(recording: Recording, command: PoseSignal) -> FloatArray:
    """The command on the log's clock along the axis that moves."""
    log = align(recording)
    motion = find_motion(log)
    gravity = identify_gravity(collect_static_poses(log, motion.still))
    (axis,) = find_axes(log, motion, gravity.compensated_force_S_n(log)).axes
    return hold_command(command, log, axis).command_m


def test_a_command_at_no_steady_phase_is_taken_by_its_mean_over_every_sample(demo_recording: Recording) -> None:
    command = demo_recording.command
    assert command is not None
    exact = held(demo_recording, command)
    late = command.stamp_ns + np.where(np.arange(len(command.stamp_ns)) % 2 == 0, 0, 2 * 10**5)
    shaken = held(demo_recording, dataclasses.replace(command, stamp_ns=late))
    # Every second message comes a quarter of a sample late: that quarter still has the command before it.
    step = np.diff(exact, prepend=exact[0])
    expected = exact - np.where(np.arange(len(exact)) % 2 == 0, 0.0, 0.25) * step
    np.testing.assert_allclose(shaken[1:-1], expected[1:-1], atol=1e-12)


@pytest.mark.parametrize("control_period_s", [7e-4, 1.1e-3])
def test_a_command_at_another_rate_than_the_log_costs_little(control_period_s: float) -> None:
    cell = dataclasses.replace(SimulatedCell(), sample_time_s=control_period_s)
    program = dataclasses.replace(SHORT, sweep_s=10.0)
    recording = resampled_wrench(simulate_cell(cell, program, seed=4).recording, 1e-3)
    fit = identify_joint(gathered(recording))
    assert np.max(np.abs(scores(fit, cell))) < 4.4
    # What is `identified` needs 5 %, and the environment is known through K_s.
    for name in ("stiffness_n_per_m", "mass_kg", "environment1_stiffness_n_per_m"):
        value, std = fit.value(name)
        assert std < 0.02 * value


def resampled_wrench(recording: Recording, period_s: float) -> Recording:
    """The wrench at another rate, as a sensor with its own clock has it: the nearest sample's noise, moved in time."""
    wrench = recording.wrench
    stamp_ns = np.arange(wrench.stamp_ns[0], wrench.stamp_ns[-1], round(period_s * 1e9))

    def at(values: FloatArray) -> FloatArray:
        return np.array([np.interp(stamp_ns, wrench.stamp_ns, column) for column in values.T]).T

    return dataclasses.replace(
        recording,
        wrench=dataclasses.replace(
            wrench, stamp_ns=stamp_ns, force_n=at(wrench.force_n), torque_n_m=at(wrench.torque_n_m)
        ),
    )


def test_what_a_command_says_nothing_about_is_not_used(demo_recording: Recording) -> None:
    command = demo_recording.command
    assert command is not None
    seconds = (command.stamp_ns - command.stamp_ns[0]) * 1e-9
    data = gathered(demo_recording)
    begins = data.moving[-1].start * data.period_s - 0.5
    early = dataclasses.replace(
        command,
        **{name: getattr(command, name)[seconds < begins] for name in ("stamp_ns", "position_m", "quaternion_xyzw")},
    )
    log = align(demo_recording)
    (behind,) = uncovered(early, log)
    assert behind.start * log.period_s == pytest.approx(begins, abs=0.01)
    assert behind.stop == len(log)
    assert uncovered(command, log) == ()


def test_a_doubtful_scale_is_common_to_everything_mechanical(demo_fit: JointFit) -> None:
    doubted = with_gain_error(demo_fit, 0.1)
    for name in ("stiffness_n_per_m", "mass_kg", "environment1_stiffness_n_per_m"):
        value, std = doubted.value(name)
        assert std == pytest.approx(0.1 * value, rel=0.01)
    assert doubted.value("delay_s") == demo_fit.value("delay_s")
    # The scale does not move the payload's own frequency: K_s and M_p go together.
    scaled = doubted.covariance / np.outer(doubted.values, np.maximum(doubted.values, 1e-12))
    i, j = (doubted.names.index(name) for name in ("stiffness_n_per_m", "mass_kg"))
    assert scaled[i, i] + scaled[j, j] - 2.0 * scaled[i, j] < 1e-5
    assert with_gain_error(demo_fit, 0.0) is demo_fit
