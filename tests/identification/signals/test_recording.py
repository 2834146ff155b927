"""Signals are values: checked once, copied, read-only."""

import dataclasses

import numpy as np
import pytest

from identification.errors import EstimateError, LogError
from identification.signals.recording import GainsSignal, PoseSignal, Recording, TwistSignal, WrenchSignal, unmeasured

STAMPS = np.array([0, 10, 20])


def wrench(**other: object) -> WrenchSignal:
    values: dict[str, object] = {"stamp_ns": STAMPS, "force_n": np.ones((3, 3)), "torque_n_m": np.ones((3, 3))}
    return WrenchSignal(topic="/ft", frame_id="ft", **{**values, **other})  # type: ignore[arg-type]  # wrong on purpose


def pose(**other: object) -> PoseSignal:
    values: dict[str, object] = {
        "stamp_ns": STAMPS,
        "position_m": np.ones((3, 3)),
        "quaternion_xyzw": np.tile([0.0, 0.0, 0.0, 1.0], (3, 1)),
    }
    return PoseSignal(topic="/p", frame_id="base", **{**values, **other})  # type: ignore[arg-type]  # wrong on purpose


def test_arrays_are_copied_and_read_only() -> None:
    mine = np.ones((3, 3))
    signal = wrench(force_n=mine)
    mine[0, 0] = 7.0
    assert signal.force_n[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        signal.force_n[0, 0] = 2.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        signal.topic = "/other"  # type: ignore[misc]  # frozen


def test_axes_that_are_not_measured_take_no_memory_and_rows_that_are_repeated_are_copied() -> None:
    signal = wrench(torque_n_m=unmeasured(3))
    assert signal.torque_n_m.strides == (0, 0)
    assert np.isnan(signal.torque_n_m).all()
    mine = np.ones(3)
    signal = wrench(torque_n_m=np.broadcast_to(mine, (3, 3)))
    mine[0] = 7.0
    assert signal.torque_n_m.tolist() == [[1.0] * 3] * 3


@pytest.mark.parametrize("wrong", [np.ones((3, 2)), np.ones(3), np.ones((3, 3, 1))])
def test_wrong_shapes_are_refused_by_name(wrong: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
    with pytest.raises(LogError, match="force_n must have"):
        wrench(force_n=wrong)
    with pytest.raises(LogError, match="quaternion_xyzw must have"):
        pose(quaternion_xyzw=wrong)


def test_stamps_are_one_column_of_integers() -> None:
    with pytest.raises(LogError, match="stamp_ns must have"):
        wrench(stamp_ns=np.ones((3, 1)))
    assert wrench(stamp_ns=[1, 2, 3]).stamp_ns.dtype == np.int64


def test_digests_cannot_be_changed() -> None:
    digests = {"run.mcap": "00"}
    recording = Recording(wrench=wrench(), pose=pose(), command=None, sha256=digests)
    digests["run.mcap"] = "ff"
    assert recording.sha256["run.mcap"] == "00"
    with pytest.raises(TypeError):
        recording.sha256["run.mcap"] = "ff"  # type: ignore[index]  # a view


def test_every_column_has_a_row_per_stamp() -> None:
    with pytest.raises(LogError, match=r"force_n must have a row per stamp \(3\), found 2"):
        wrench(force_n=np.ones((2, 3)))
    with pytest.raises(LogError, match="angular_rad_s must have"):
        TwistSignal(topic="/t", frame_id="", stamp_ns=STAMPS, linear_m_s=np.ones((3, 3)), angular_rad_s=np.ones((3, 4)))
    with pytest.raises(LogError, match="mass must have"):
        GainsSignal(topic="/g", stamp_ns=STAMPS, mass=np.ones((3, 3)), damping=np.ones((3, 6)))


def test_only_a_raw_wrench_and_a_whole_pose_identify() -> None:
    Recording(wrench=wrench(), pose=pose(), command=None).require_raw()
    for signals, reported in (
        ({"wrench": wrench(gravity_compensated=True)}, "Gravity is already removed from the force of topic /ft"),
        ({"wrench": wrench(measured_axes=("z",))}, "/ft must have forces along x, y and z, found none for x, y;"),
        ({"pose": pose(is_displacement=True)}, "Topic /p shows a displacement"),
        ({"pose": pose(measured_axes=("x", "y", "z"))}, "The pose of topic /p .* found none for rx, ry, rz"),
    ):
        recording = Recording(**{"wrench": wrench(), "pose": pose(), "command": None, **signals})  # type: ignore[arg-type]  # by name
        with pytest.raises(EstimateError, match=reported):
            recording.require_raw()
    Recording(wrench=wrench(measured_axes=("x", "y", "z")), pose=pose(), command=None).require_raw()
    with pytest.raises(EstimateError) as refused:
        Recording(wrench=wrench(measured_axes=("y", "z", "rx", "ry", "rz")), pose=pose(), command=None).require_raw()
    assert "found none for x" in str(refused.value)
    # A raw wrench is not to be declared as one whose weight was removed.
    assert "gravity_compensated" not in str(refused.value)
