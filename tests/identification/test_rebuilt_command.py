"""Logged gains without a command: the command that they make of the wrench, and what the joint fit makes of it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import chirp

from identification.identify import identify_cell
from identification.rebuilt_command import rebuilt_command
from identification.result import Estimate, Status
from identification.robot.admittance_estimates import identify_admittance_robots
from identification.signals.aligned import on_one_clock
from identification.signals.recording import GainsSignal, Recording, WrenchSignal
from identification.signals.segments import find_motion
from problems.arrays import FloatArray

from .commanded_cell import TOOL_DOWN, CommandedCell, Logger, logged

MASS_KG, DAMPING_N_S_PER_M, LEAD_S = 20.0, 1500.0, 0.015
AXIS = 1
WITHIN_STDS = 2.5


def desired_force(cell: CommandedCell, duration_s: float) -> FloatArray:
    """Return a sweep of F^d from rest to rest [N], at the ticks."""
    t = np.arange(0.0, duration_s, cell.tick_s)
    edge = np.clip(np.minimum(t, duration_s - t) / 0.5, 0.0, 1.0)
    rest = np.zeros(round(1.5 / cell.tick_s))
    sweep = 50.0 * edge**2 * (3.0 - 2.0 * edge) * chirp(t, 0.3, duration_s, 12.0, method="logarithmic", phi=-90)
    return np.concatenate([rest, sweep, rest])


def led(cell: CommandedCell, duration_s: float) -> Recording:
    """Log a cell that F^d drives through the admittance, with the command that ran, at the controller's rate."""
    desired_n = desired_force(cell, duration_s)
    logger = Logger(rate_hz=1.0 / cell.tick_s, axis=AXIS)
    # What the log shows beside the force drove the controller too.
    noise = np.random.default_rng(logger.seed).standard_normal((len(desired_n) - 2, 3))[:, AXIS]
    beside_n = logger.left_n + logger.force_noise_n * np.append(noise, [0.0, 0.0])
    command = cell.led((MASS_KG, DAMPING_N_S_PER_M, LEAD_S), desired_n + beside_n)
    recording = logged(cell, command, logger)
    stamps = recording.wrench.stamp_ns
    ticks = np.round((stamps - stamps[0]) * 1e-9 / cell.tick_s).astype(int)
    return replace(
        recording,
        gains=GainsSignal(
            topic="",
            stamp_ns=stamps[:1],
            mass=np.full((1, 6), MASS_KG),
            damping=np.full((1, 6), DAMPING_N_S_PER_M),
            lead_s=(LEAD_S,) * 6,
        ),
        desired_force=WrenchSignal(
            topic="/desired",
            frame_id="tool",
            stamp_ns=stamps,
            force_n=desired_n[ticks, None] * np.eye(3)[AXIS],
            torque_n_m=np.zeros((len(ticks), 3)),
            gravity_compensated=True,
        ),
    )


def covers(estimate: Estimate, truth: float) -> bool:
    assert estimate.value is not None
    assert estimate.std is not None
    return abs(estimate.value - truth) < WITHIN_STDS * estimate.std


def test_coupling_follows_from_the_command_that_wrench_and_gains_make() -> None:
    cell = CommandedCell()
    recording = led(cell, 12.0)
    result = identify_cell(replace(recording, command=None))
    axis = result.axes["y"]
    known = (
        (axis.robot.bandwidth_hz, cell.bandwidth_hz, 0.005),
        # What the stamps of wrench and pose leave open is a part of it.
        (axis.robot.delay_s, cell.delay_s, 0.25),
        (axis.coupling.stiffness_n_per_m, cell.stiffness, 0.05),
        (axis.drag_n_s_per_m, cell.drag, 0.05),
        (result.payload.mass_kg, cell.mass, 0.02),
    )
    for estimate, truth, share in known:
        assert covers(estimate, truth)
        assert estimate.std is not None
        assert estimate.std < share * truth
    assert axis.robot.bandwidth_hz.status is Status.WEAK
    assert "the command that the known gains make of the wrench" in axis.robot.bandwidth_hz.note
    assert axis.robot.denominator.status is Status.WEAK


def every(recording: Recording, count: int) -> Recording:
    """Return what a logger that keeps one of `count` samples writes."""
    wrench, pose, desired = recording.wrench, recording.pose, recording.desired_force
    assert desired is not None
    kept = slice(None, None, count)

    def fewer(signal: WrenchSignal) -> WrenchSignal:
        return replace(
            signal,
            stamp_ns=signal.stamp_ns[kept],
            force_n=signal.force_n[kept],
            torque_n_m=signal.torque_n_m[kept],
        )

    return replace(
        recording,
        wrench=fewer(wrench),
        desired_force=fewer(desired),
        pose=replace(
            pose,
            stamp_ns=pose.stamp_ns[kept],
            position_m=pose.position_m[kept],
            quaternion_xyzw=pose.quaternion_xyzw[kept],
        ),
    )


def test_a_log_ten_times_slower_than_the_controller_shows_the_coupling_from_wrench_and_gains() -> None:
    """At 125 Hz nothing was held from sample to sample, and the axes that do not move hold only noise."""
    cell = CommandedCell(robot=(28.0, 0.9))
    recording = every(replace(led(cell, 20.0), command=None), 10)
    result = identify_cell(recording)
    axis = result.axes["y"]
    assert covers(axis.coupling.stiffness_n_per_m, cell.stiffness)
    assert covers(result.payload.mass_kg, cell.mass)
    assert covers(axis.robot.bandwidth_hz, cell.bandwidth_hz)
    assert not any("against the force" in finding.message for finding in result.findings)


def test_the_command_that_wrench_and_gains_make_is_the_one_that_ran() -> None:
    cell = CommandedCell()
    recording = led(cell, 5.0)
    log = on_one_clock(recording)
    beside = identify_admittance_robots(replace(recording, command=None)).beside
    found = rebuilt_command(recording, beside, log, find_motion(log))
    assert found is not None
    assert recording.command is not None
    along_B = TOOL_DOWN.apply(np.eye(3)[AXIS])
    ran = recording.command.position_m @ along_B
    made = np.interp(recording.command.stamp_ns, found.stamp_ns, found.position_m @ along_B)
    # Wiener's filter takes the noise off: 0.3 N through 1500 N·s/m walk by 0.3/1500 √(8e-4 s · 8 s) = 16 µm.
    assert np.ptp(ran) > 0.01
    assert np.std(made - ran) < 3e-5


@pytest.mark.parametrize("share", [0.8, 1.25])
def test_no_command_is_made_of_gains_that_do_not_explain_the_speed(share: float) -> None:
    cell = CommandedCell()
    recording = replace(led(cell, 5.0), command=None)
    assert recording.gains is not None
    other = replace(recording.gains, mass=share * recording.gains.mass, damping=share * recording.gains.damping)
    found = identify_admittance_robots(replace(recording, gains=other))
    assert not found.beside
    assert "admittance-gain" in {finding.code for finding in found.findings}
