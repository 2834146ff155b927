"""A wrench that is stamped late, commands that the logger lost: they cost a little certainty and no truth."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.joint_fit.data import HeldCommand, JointData
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.latency import WrenchLatency, advance_in_time, find_wrench_filter, is_significant_latency
from identification.joint_fit.path import SensorDynamics, low_passed
from identification.joint_fit.result import JointFit
from identification.result import Status
from identification.robot.logged_command import restore_commands
from identification.signals.recording import PoseSignal, Recording
from identification.signals.segments import Span
from problems.model.robot import RobotModel
from tests.identification.synthetic import Load, sweep

from .test_fit import SHORT, gathered, scores

H_S = SimulatedCell().sample_time_s
LOAD = Load()
OMEGA, DELAY_SAMPLES = 25.0, 3
NOISE_N, JITTER_M = 0.14, 2e-6
TRUTH = {
    "stiffness_n_per_m": LOAD.stiffness,
    "damping_n_s_per_m": LOAD.damping,
    "drag_n_s_per_m": LOAD.drag,
    "mass_kg": LOAD.mass,
    "robot_frequency_rad_per_s": OMEGA,
    "delay_s": DELAY_SAMPLES * H_S,
}


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate_cell(SimulatedCell(), SHORT, seed=7).recording


@pytest.fixture(scope="module")
def whole(recording: Recording) -> JointFit:
    return identify_joint(gathered(recording))


@pytest.mark.parametrize("samples", [-1.3, 0.4])
def test_a_late_wrench_is_reported_and_taken_out(recording: Recording, whole: JointFit, samples: float) -> None:
    late = recording.wrench.stamp_ns + round(samples * H_S * 1e9)
    fit = identify_joint(
        gathered(dataclasses.replace(recording, wrench=dataclasses.replace(recording.wrench, stamp_ns=late)))
    )
    assert abs(fit.latency.seconds - samples * H_S) < 4.4 * fit.latency.std_s
    assert fit.latency.std_s < 0.05 * H_S
    # 4.4 deviations: the quantile of 1e-4 for nine values. A latency that is left in costs tens.
    assert np.max(np.abs(scores(fit, SimulatedCell()))) < 4.4
    assert whole.latency.applied_s == 0.0


def test_the_force_is_shifted_as_time_is() -> None:
    ticks = np.arange(200.0)
    force = np.sin(0.05 * ticks)
    # A cubic spline of a wave of 126 samples: 0.05⁴/384.
    np.testing.assert_allclose(advance_in_time(force, 0.4)[5:-5], np.sin(0.05 * (ticks + 0.4))[5:-5], atol=1e-7)
    assert advance_in_time(force, 0.0) is force


def lossy(command: PoseSignal, share: float) -> PoseSignal:
    kept = np.random.default_rng(3).random(len(command.stamp_ns)) >= share
    kept[[0, -1]] = True
    return dataclasses.replace(
        command,
        stamp_ns=command.stamp_ns[kept],
        position_m=command.position_m[kept],
        quaternion_xyzw=command.quaternion_xyzw[kept],
    )


def test_commands_that_only_the_logger_lost_are_restored(recording: Recording) -> None:
    command = recording.command
    assert command is not None
    restored = restore_commands(lossy(command, 0.02))
    np.testing.assert_array_equal(restored.stamp_ns, command.stamp_ns)
    # The command has no jumps of its own: a spline misses it by less than the encoder's noise.
    np.testing.assert_allclose(restored.position_m, command.position_m, atol=2e-6)
    assert restore_commands(command) is command


@pytest.mark.parametrize("late", [[0.8], [0.6], [2.5, 1.6, 0.7]], ids=["one", "little", "a queue of three"])
def test_a_late_command_is_not_a_lost_one(recording: Recording, late: list[float]) -> None:
    """A message that comes late is there: one more between it and the one before never went to the robot."""
    command = recording.command
    assert command is not None
    stamps = command.stamp_ns.copy()
    period = int(np.median(np.diff(stamps)))
    for at in (100, 500, 2000):
        stamps[at : at + len(late)] += np.round(np.array(late) * period).astype(np.int64)
    delayed = dataclasses.replace(command, stamp_ns=stamps)
    assert restore_commands(delayed) is delayed
    # Beside the late ones a lost one is still missed.
    kept = np.arange(len(stamps)) != 1000
    lost = dataclasses.replace(
        delayed,
        stamp_ns=stamps[kept],
        position_m=command.position_m[kept],
        quaternion_xyzw=command.quaternion_xyzw[kept],
    )
    np.testing.assert_array_equal(restore_commands(lost).stamp_ns, stamps)


def test_a_hole_of_the_log_is_not_filled(recording: Recording) -> None:
    command = recording.command
    assert command is not None
    seconds = (command.stamp_ns - command.stamp_ns[0]) * 1e-9
    kept = (seconds < 3.0) | (seconds > 3.5)
    holed = dataclasses.replace(
        command,
        stamp_ns=command.stamp_ns[kept],
        position_m=command.position_m[kept],
        quaternion_xyzw=command.quaternion_xyzw[kept],
    )
    assert restore_commands(holed) is holed


def test_lost_commands_do_not_make_the_robot_slower(recording: Recording) -> None:
    command = recording.command
    assert command is not None
    fit = identify_joint(gathered(dataclasses.replace(recording, command=restore_commands(lossy(command, 0.01)))))
    assert np.max(np.abs(scores(fit, SimulatedCell()))) < 4.4


def moved(corner_hz: float | None = None, late_samples: int = 0, shifted_s: float = 0.0) -> JointData:
    """A sweep of 5 s between two rests: x' = ω (u − x), the payload on its spring, τ f' = F − f, all held over h."""
    rest = np.zeros(round(1.5 / H_S))
    command = np.concatenate([rest, 4.0 * sweep(5.0, 1.0 / H_S), rest])
    k, b, p, m = LOAD.vector()
    tau = 1e-3 if corner_hz is None else 1.0 / (2.0 * np.pi * corner_hz)
    # x, x_p, v_p, f over u; F = K_s (x_p − x) + B_s (v_p − x').
    force = np.array([-k + b * OMEGA, k, b, 0.0])
    a = np.array(
        [
            [-OMEGA, 0.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
            [*(-force[:2] / m), (-b - p) / m, 0.0],
            [*(force[:3] / tau), -1.0 / tau],
        ]
    )
    drive = np.array([[OMEGA], [0.0], [b * OMEGA / m], [-b * OMEGA / tau]])
    step, push, *_ = cont2discrete((a, drive, np.eye(4), np.zeros((4, 1))), H_S)
    acting = np.concatenate([np.zeros(DELAY_SAMPLES), command[:-DELAY_SAMPLES]])
    states = np.zeros((len(command), 4))
    for i in range(len(command) - 1):
        states[i + 1] = step @ states[i] + push[:, 0] * acting[i]
    felt = states[:, 3] if corner_hz is not None else states @ force - b * OMEGA * acting
    shown = np.concatenate([np.zeros(late_samples), felt[: len(felt) - late_samples]])
    rng = np.random.default_rng(5)
    shown = shown + NOISE_N * rng.standard_normal(len(shown))
    # What was read as an offset of clocks was taken off the stamps: the grid shows the force advance_in_time by it.
    advance_in_time = np.interp(np.arange(len(shown)) + round(shifted_s / H_S), np.arange(len(shown)), shown)
    moving = Span(start=len(rest), stop=len(command) - len(rest))
    return JointData(
        period_s=H_S,
        position_m=states[:, 0] + JITTER_M * rng.standard_normal(len(shown)),
        force_n=advance_in_time,
        command=HeldCommand(command_m=command, shift_s=0.0),
        rests=(Span(start=0, stop=len(rest) - 50), Span(start=moving.stop + 400, stop=len(command))),
        moving=(moving,),
        free=(moving,),
        holds=(),
        coupling=1.1 * LOAD.vector(),
        robot=RobotModel.from_bandwidth(bandwidth_rad_per_s=1.02 * OMEGA, delay_s=2.5e-3),
        mass_kg=LOAD.mass,
        shifted_s=shifted_s,
    )


@pytest.mark.parametrize(("corner_hz", "shifted_s"), [(200.0, 0.0), (50.0, 4 * H_S)])
def test_the_corner_of_a_low_pass_is_found_and_biases_nothing(corner_hz: float, shifted_s: float) -> None:
    fit = identify_joint(moved(corner_hz, shifted_s=shifted_s))
    assert fit.latency.is_filter
    assert fit.latency.evidence is not None
    assert fit.latency.evidence > 25.0
    truth_s = 1.0 / (2.0 * np.pi * corner_hz)
    # One value: 3.3 deviations are the quantile of 1e-3. A share of a sample is what the steps of the command cost.
    assert abs(fit.latency.seconds - truth_s) < 3.3 * fit.latency.std_s
    assert fit.latency.std_s < 0.05 * H_S
    off = {name: (fit.value(name)[0] - value) / fit.value(name)[1] for name, value in TRUTH.items()}
    # Six values, 4.2 deviations: the quantile of 1e-4 for all of them.
    assert max(map(abs, off.values())) < 4.2, off
    found, (finding,) = find_wrench_filter({"x": fit.latency}, shifted_s, H_S)
    assert found is not None
    assert found.corner_hz is not None
    assert found.corner_hz.value is not None
    assert found.corner_hz.std is not None
    assert found.corner_hz.status is Status.IDENTIFIED
    assert abs(found.corner_hz.value - corner_hz) < 3.3 * found.corner_hz.std
    assert (finding.code, finding.severity) == ("wrench-filter", "info")


def test_a_low_pass_that_a_driver_computes_sample_by_sample_is_found() -> None:
    plain, share = moved(), 1.0 - float(np.exp(-2.0 * np.pi * 50.0 * H_S))
    smoothed = lfilter([share], [1.0, share - 1.0], plain.force_n)
    fit = identify_joint(replace(plain, force_n=smoothed))
    assert fit.latency.is_filter
    # Between the samples it follows no equation; a fifth of the 10 % up to which a corner is called identified.
    assert fit.latency.seconds == pytest.approx(1.0 / (2.0 * np.pi * 50.0), rel=0.02)
    off = {name: (fit.value(name)[0] - value) / fit.value(name)[1] for name, value in TRUTH.items()}
    # Six values, 4.2 deviations: the quantile of 1e-4 for all of them.
    assert max(map(abs, off.values())) < 4.2, off


@pytest.mark.parametrize(("samples", "shifted_s"), [(1, 0.0), (2, 2 * H_S)])
def test_a_delay_is_a_delay(samples: int, shifted_s: float) -> None:
    fit = identify_joint(moved(late_samples=samples, shifted_s=shifted_s))
    assert not fit.latency.is_filter
    found, _ = find_wrench_filter({"x": fit.latency}, shifted_s, H_S)
    assert found is not None
    assert found.corner_hz is None
    assert found.delay_s is not None
    assert found.delay_s.value is not None
    assert found.delay_s.std is not None
    assert abs(found.delay_s.value - samples * H_S) < 3.3 * found.delay_s.std
    assert found.delay_s.std < 0.2 * H_S
    assert found.delay_s.status is Status.IDENTIFIED


def test_a_wrench_that_is_not_late_has_no_filter() -> None:
    fit = identify_joint(moved())
    assert (fit.latency.is_filter, fit.latency.evidence) == (False, None)
    assert find_wrench_filter({"x": fit.latency}, 0.0, H_S) == (None, ())


def test_what_is_early_or_does_not_matter_is_no_filter() -> None:
    # A fifth of a sample, or 0.2 ms, what is less; and four deviations.
    assert not is_significant_latency(0.15 * H_S, 1e-6, H_S)
    assert is_significant_latency(0.25 * H_S, 1e-6, H_S)
    assert is_significant_latency(2.1e-4, 1e-6, 4e-3)
    assert not is_significant_latency(1e-3, 3e-4, H_S)
    assert find_wrench_filter({"x": latency(-2e-3)}, 0.0, H_S) == (None, ())
    # 50 ms are a clock's; 3 ms that were taken off the stamps may be the sensor's.
    assert find_wrench_filter({"x": latency(0.0)}, 0.05, H_S) == (None, ())
    found, _ = find_wrench_filter({"x": latency(0.0)}, 3e-3, H_S)
    assert found is not None
    assert found.delay_s is not None
    assert found.delay_s.value == 3e-3


def latency(
    seconds: float, std_s: float = 1e-5, *, is_filter: bool = False, evidence: float | None = None
) -> WrenchLatency:
    return WrenchLatency(seconds=seconds, std_s=std_s, applied_s=0.0, is_filter=is_filter, evidence=evidence)


def test_the_kind_with_more_evidence_counts_and_a_near_draw_is_weak() -> None:
    filtered, delayed = latency(1e-3, is_filter=True, evidence=400.0), latency(1e-3, evidence=-30.0)
    found, _ = find_wrench_filter({"x": filtered, "y": delayed}, 0.0, H_S)
    assert found is not None
    assert found.corner_hz is not None
    assert found.corner_hz.value == pytest.approx(1.0 / (2.0 * np.pi * 1e-3))
    near, (finding,) = find_wrench_filter({"x": latency(1e-3, evidence=-3.0)}, 0.0, H_S)
    assert near is not None
    assert near.delay_s is not None
    assert near.delay_s.status is Status.WEAK
    assert finding.severity == "warning"


def test_axes_of_one_kind_are_averaged_and_where_they_disagree_the_latest_counts() -> None:
    alike = {"x": latency(1e-3, evidence=-99.0), "y": latency(1.02e-3, evidence=-99.0)}
    found, _ = find_wrench_filter(alike, 0.0, H_S)
    assert found is not None
    assert found.delay_s is not None
    assert found.delay_s.value == pytest.approx(1.01e-3)
    found, (finding,) = find_wrench_filter({**alike, "y": latency(2e-3, evidence=-99.0)}, 0.0, H_S)
    assert found is not None
    assert found.delay_s is not None
    assert (found.delay_s.value, found.delay_s.status) == (2e-3, Status.WEAK)
    assert "disagree" in finding.message


def test_the_low_pass_is_that_of_its_equation_and_a_shift_is_one_in_time() -> None:
    time, tau = np.arange(400) * H_S, 3e-3
    omega = 2.0 * np.pi * 20.0
    shown = low_passed(np.sin(omega * time)[None], tau, H_S)[0]
    exact = np.sin(omega * time - np.arctan(omega * tau)) / np.hypot(1.0, omega * tau)
    # Lagrange's cubic between samples of a wave: 9/16 of (ω h)⁴/24 at most; the start has died away after 20 τ.
    np.testing.assert_allclose(shown[80:-2], exact[80:-2], atol=(omega * H_S) ** 4 / 40.0)
    constant = np.full((2, 9), 4.0)
    np.testing.assert_allclose(low_passed(constant, tau, H_S), constant, rtol=1e-12)
    for delay in (0.4 * H_S, 2.0 * H_S, -1.3 * H_S):
        later = SensorDynamics(delay_s=delay).felt(np.sin(omega * time), H_S)
        # Lagrange's cubic: 9/16 of (ω h)⁴/24 at most.
        np.testing.assert_allclose(later[5:-5], np.sin(omega * (time - delay))[5:-5], atol=(omega * H_S) ** 4 / 40.0)
    assert SensorDynamics().unknown(H_S) == 0
    assert replace(SensorDynamics(), time_constant_s=1e-3).unknown(H_S) == 8


@pytest.mark.parametrize("share", [1e-3, 0.3, 0.999, 1.001, 8.0])
def test_a_low_passed_cubic_is_exact_however_long_a_sample_is(share: float) -> None:
    """Behind 1/(τ s + 1) a cubic p is Σ (−τ)^k p^(k), and what dies away; samples of 1 s."""
    cubic, ticks, tau = np.polynomial.Polynomial([0.3, -1.0, 0.5, 0.25]), np.arange(9.0), 1.0 / share
    steady = cubic - tau * cubic.deriv(1) + tau**2 * cubic.deriv(2) - tau**3 * cubic.deriv(3)
    shown = low_passed(cubic(ticks), tau, 1.0)
    # The first sample and the last have no other before, or behind.
    dying = (shown[1] - steady(1.0)) * np.exp(-share * (ticks - 1.0))
    np.testing.assert_allclose(shown[1:-1], (steady(ticks) + dying)[1:-1], rtol=0.0, atol=1e-14 * max(tau, 10.0) ** 3)
    assert shown[0] == cubic(0.0)
