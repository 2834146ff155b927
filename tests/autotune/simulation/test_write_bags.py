"""The beginning of a run as ROS 1 bag, rosbag2 folder and table, read back by the log readers."""

from pathlib import Path

import numpy as np
import pytest

from autotune.simulation.write_bags import write_csv, write_ros1_bag, write_rosbag2
from identification.logs.inspect import inspect_log
from identification.signals.recording import PoseSignal, Recording, WrenchSignal

COUNT, ROWS = 60, 40


def recording() -> Recording:
    stamps = np.arange(COUNT, dtype=np.int64) * 800_000
    force, turn = np.linspace(0.0, 1.0, 3 * COUNT).reshape(COUNT, 3), np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))
    return Recording(
        wrench=WrenchSignal(topic="/ft", frame_id="S", stamp_ns=stamps, force_n=force, torque_n_m=force),
        pose=PoseSignal(topic="/pose", frame_id="B", stamp_ns=stamps, position_m=force, quaternion_xyzw=turn),
        command=None,
    )


@pytest.mark.parametrize("write", [write_ros1_bag, write_rosbag2])
def test_a_bag_holds_the_first_messages_of_wrench_and_pose(write: object, tmp_path: Path) -> None:
    path = tmp_path / ("log.bag" if write is write_ros1_bag else "log")
    write(recording(), path, rows=ROWS)  # type: ignore[operator]
    channels = {channel.topic: channel.count for channel in inspect_log(path).channels}
    assert channels == {"/ft": ROWS, "/pose": ROWS}


def test_a_table_has_one_line_for_each_sample(tmp_path: Path) -> None:
    write_csv(recording(), tmp_path / "log.csv", rows=ROWS)
    head, *rows = (tmp_path / "log.csv").read_text().splitlines()
    assert head.split(",") == ["t", "fx", "fy", "fz", "tx", "ty", "tz", "x", "y", "z", "qx", "qy", "qz", "qw"]
    table = np.array([[float(value) for value in row.split(",")] for row in rows])
    assert table.shape == (ROWS, 14)
    # Ten digits are written.
    np.testing.assert_allclose(table[:, 1:4], recording().wrench.force_n[:ROWS], atol=1e-10)
