"""Commands on the clock of a log: held from one message to the next, sample by sample."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.axes.straight import AxisMotion
from identification.joint_fit.data import hold_command
from identification.signals.aligned import AlignedLog
from identification.signals.recording import PoseSignal
from problems.arrays import FloatArray

PERIOD_NS, SAMPLES, EIGHTHS = 4_000_000, 60, 8
START_NS = 10**18
ALONG = np.array([0.6, 0.0, 0.8])


def held(eighths: FloatArray, issued_m: FloatArray, *, is_smooth: bool = False) -> tuple[FloatArray, float, bool]:
    """Return what `hold_command` makes of values along an axis, issued so many eighths of a sample after the first."""
    count = len(issued_m)
    position_m = np.outer(np.ones(SAMPLES), [0.1, 0.2, 0.3])
    log = AlignedLog(
        start_ns=START_NS,
        period_s=PERIOD_NS * 1e-9,
        time_s=PERIOD_NS * 1e-9 * np.arange(SAMPLES, dtype=np.float64),
        force_S_n=np.zeros((SAMPLES, 3)),
        torque_S_n_m=np.zeros((SAMPLES, 3)),
        position_B_m=position_m,
        orientation_BS=Rotation.identity(SAMPLES),
        pose_rate_hz=250.0,
    )
    command = PoseSignal(
        topic="/c",
        frame_id="base",
        stamp_ns=START_NS + np.round(eighths * PERIOD_NS / EIGHTHS).astype(np.int64),
        position_m=position_m[0] + np.outer(issued_m, ALONG),
        quaternion_xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
    )
    axis = AxisMotion(name="x", direction_B=ALONG, position_m=np.zeros(SAMPLES), force_n=np.zeros(SAMPLES), spans=())
    found = hold_command(command, log, axis, is_smooth=is_smooth)
    return found.command_m, found.shift_s, found.is_mean


def steps(eighths: FloatArray, issued_m: FloatArray) -> FloatArray:
    """Return the command in every eighth of a sample (SAMPLES, EIGHTHS): the latest one, before the first that one."""
    latest = np.searchsorted(eighths, np.arange(SAMPLES * EIGHTHS), side="right") - 1
    return issued_m[np.maximum(latest, 0)].reshape(SAMPLES, EIGHTHS)


@pytest.mark.parametrize("seed", range(5))
def test_a_command_at_any_phase_is_its_mean_over_every_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # From after the log's begin to before its end.
    eighths = np.sort(rng.choice(np.arange(20, 440), 50, replace=False)).astype(np.float64)
    issued = rng.normal(size=50)
    found, shift_s, is_mean = held(eighths, issued)
    np.testing.assert_allclose(found, np.mean(steps(eighths, issued), axis=1), atol=1e-9)
    assert (shift_s, is_mean) == (0.0, True)


@pytest.mark.parametrize("every", [1, 2, 3])
@pytest.mark.parametrize("phase", [0, 1, 5])
def test_a_command_at_one_phase_is_held_from_there(every: int, phase: int) -> None:
    eighths = np.arange(phase, SAMPLES * EIGHTHS, every * EIGHTHS, dtype=np.float64)
    issued = np.random.default_rng(1).normal(size=len(eighths))
    found, shift_s, is_mean = held(eighths, issued)
    # What is issued within a sample is that sample's, and the answer comes later by the phase.
    np.testing.assert_allclose(found, steps(eighths, issued)[:, -1], atol=1e-9)
    assert shift_s == pytest.approx(phase / EIGHTHS * PERIOD_NS * 1e-9, abs=1e-9)
    assert not is_mean


def test_a_smooth_command_is_read_off_between_its_samples() -> None:
    eighths = np.arange(3.0, 460.0, 12.0)
    found, _, _ = held(eighths, (eighths / 100.0) ** 3, is_smooth=True)
    # A spline of the third degree through a cubic is that cubic; outside it stays where it is.
    at = np.clip(EIGHTHS * np.arange(SAMPLES, dtype=np.float64), eighths[0], eighths[-1])
    np.testing.assert_allclose(found, (at / 100.0) ** 3, atol=1e-9)
