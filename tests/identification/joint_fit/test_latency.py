"""A wrench that is stamped late, commands that the logger lost: they cost a little certainty and no truth."""

import dataclasses

import numpy as np
import pytest

from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import Cell
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.latency import sooner
from identification.joint_fit.result import JointFit
from identification.signals.lost_commands import restore_commands
from identification.signals.recording import PoseSignal, Recording
from tests.identification.joint_fit.test_fit import SHORT, gathered, scores

H_S = Cell().sample_time_s


@pytest.fixture(scope="module")
def recording() -> Recording:
    return simulate_cell(Cell(), SHORT, seed=7).recording


@pytest.fixture(scope="module")
def whole(recording: Recording) -> JointFit:
    return identify_joint(gathered(recording))


@pytest.mark.parametrize("samples", [-1.3, 0.4, 1.0])
def test_a_late_wrench_is_told_and_taken_out(recording: Recording, whole: JointFit, samples: float) -> None:
    late = recording.wrench.stamp_ns + round(samples * H_S * 1e9)
    fit = identify_joint(
        gathered(dataclasses.replace(recording, wrench=dataclasses.replace(recording.wrench, stamp_ns=late)))
    )
    assert abs(fit.lag.seconds - samples * H_S) < 4.4 * fit.lag.std_s
    assert fit.lag.std_s < 0.05 * H_S
    # 4.4 deviations: the quantile of 1e-4 for nine values. A lag that is left in costs tens.
    assert np.max(np.abs(scores(fit, Cell()))) < 4.4
    assert whole.lag.applied_s == 0.0


def test_the_force_is_shifted_as_time_is() -> None:
    ticks = np.arange(200.0)
    force = np.sin(0.05 * ticks)
    # A cubic spline of a wave of 126 samples: 0.05⁴/384.
    np.testing.assert_allclose(sooner(force, 0.4)[5:-5], np.sin(0.05 * (ticks + 0.4))[5:-5], atol=1e-7)
    assert sooner(force, 0.0) is force


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
    assert np.max(np.abs(scores(fit, Cell()))) < 4.4
