"""Simulated recordings as files: rosbag2 and ROS 1 by rosbags, CSV with its cell.yaml."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from benchmarks.cells import DrawnCell, Writing
from identification.signals.recording import PoseSignal, Recording, WrenchSignal

# Flange from sensor, where the sensor is turned.
TURN = Rotation.from_euler("z", np.pi / 2.0)
_TURNED = "sensor: {orientation: [0.0, 0.0, 90.0], orientation_as: euler_xyz, angle: deg}\n"
_COLUMNS = "t,fx,fy,fz,tx,ty,tz,px,py,pz,qw,qx,qy,qz,cx,cy,cz,dw,dx,dy,dz"
_HEAD = "format: autotune/cell\nversion: 1\n"
_TABLE = """table: {time: t, time_unit: us}
wrench:
  fields: {force: [fx, fy, fz], torque: [tx, ty, tz]}
  exerted_by: %s
pose:
  fields: {position: [px, py, pz], orientation: [qw, qx, qy, qz]}
  orientation_as: quaternion_wxyz
  units: {position: mm}
command:
  fields: {position: [cx, cy, cz], orientation: [dw, dx, dy, dz]}
  orientation_as: quaternion_wxyz
  units: {position: mm}
"""


def write_cell_log(recording: Recording, drawn: DrawnCell, folder: Path) -> tuple[Path, Path | None]:
    """Write log and, where the log cannot say it, cell.yaml; return both paths."""
    writing, rng = drawn.writing, np.random.default_rng([drawn.seed, 7])
    logged = _as_logged(recording, writing)
    text = _HEAD + (_TURNED if writing.turned_sensor else "")
    text += f"sample_time_s: {drawn.cell.sample_time_s!r}\n" if writing.names_period else ""
    if writing.container == "csv":
        text += _TABLE % ("sensor" if writing.reversed_wrench else "payload")
        path = _write_table(folder / "log.csv", logged, _kept(len(logged.wrench.stamp_ns), writing, rng))
    else:
        path = _write_bag(folder, _thinned(logged, writing, rng), writing)
    if text == _HEAD:
        return path, None
    cell = folder / "cell.yaml"
    cell.write_text(text)
    return path, cell


def _as_logged(recording: Recording, writing: Writing) -> Recording:
    """Express the wrench as it is logged."""
    turn = TURN.inv() if writing.turned_sensor else Rotation.identity()
    sign = -1.0 if writing.reversed_wrench else 1.0
    wrench = recording.wrench
    return replace(
        recording,
        wrench=replace(
            wrench,
            topic=writing.topics[0],
            stamp_ns=wrench.stamp_ns + round(writing.wrench_late_s * 1e9),
            force_n=sign * turn.apply(np.array(wrench.force_n)),
            torque_n_m=sign * turn.apply(np.array(wrench.torque_n_m)),
        ),
        pose=replace(recording.pose, topic=writing.topics[1]),
        command=None if recording.command is None else replace(recording.command, topic=writing.topics[2]),
    )


def _kept(count: int, writing: Writing, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which messages of a channel are there; the first and the last always are."""
    kept = rng.random(count) >= writing.lost_share
    if writing.gap_periods:
        first = int(rng.integers(count // 10, count - count // 10))
        kept[first : first + writing.gap_periods - 1] = False
    kept[[0, -1]] = True
    return kept


def _thinned(recording: Recording, writing: Writing, rng: np.random.Generator) -> Recording:
    def rows(count: int, every: int) -> NDArray[np.int64]:
        chosen = np.arange(0, count, every)
        return chosen[_kept(len(chosen), writing, rng)]

    wrench, pose, command = recording.wrench, recording.pose, recording.command
    at = rows(len(wrench.stamp_ns), writing.wrench_every)
    wrench = replace(wrench, stamp_ns=wrench.stamp_ns[at], force_n=wrench.force_n[at], torque_n_m=wrench.torque_n_m[at])
    return replace(
        recording,
        wrench=wrench,
        pose=_rows_of(pose, rows(len(pose.stamp_ns), writing.pose_every)),
        command=None if command is None else _rows_of(command, rows(len(command.stamp_ns), 1)),
    )


def _rows_of(signal: PoseSignal, at: NDArray[np.int64]) -> PoseSignal:
    return replace(
        signal,
        stamp_ns=signal.stamp_ns[at],
        position_m=signal.position_m[at],
        quaternion_xyzw=signal.quaternion_xyzw[at],
    )


def _write_table(path: Path, recording: Recording, kept: NDArray[np.bool_]) -> Path:
    wrench, poses = recording.wrench, [p for p in (recording.pose, recording.command) if p is not None]
    time_us = (wrench.stamp_ns - wrench.stamp_ns[0]) * 1e-3
    columns = [time_us[:, None], wrench.force_n, wrench.torque_n_m]
    for pose in poses:
        columns += [1e3 * pose.position_m, pose.quaternion_xyzw[:, [3, 0, 1, 2]]]
    np.savetxt(path, np.hstack(columns)[kept], fmt="%.10g", delimiter=",", header=_COLUMNS, comments="")
    return path


def _write_bag(folder: Path, recording: Recording, writing: Writing) -> Path:
    """Write all messages in the order of their stamps."""
    ros1 = writing.container == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    path = folder / ("log.bag" if ros1 else "log")
    plugin = StoragePlugin.SQLITE3 if writing.container == "sqlite" else StoragePlugin.MCAP
    writer = BagWriter(path) if ros1 else FolderWriter(path, version=9, storage_plugin=plugin)
    signals = [s for s in (recording.wrench, recording.pose, recording.command) if s is not None]
    with writer:
        links, bodies = [], []
        for signal in signals:
            name = f"geometry_msgs/msg/{'WrenchStamped' if isinstance(signal, WrenchSignal) else writing.pose_type}"
            links.append(writer.add_connection(signal.topic, name, typestore=store))
            serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
            bodies.append([serialize(message, name) for message in _messages(store.types, signal, name, ros1=ros1)])
        stamps = np.concatenate([s.stamp_ns for s in signals])
        owner = np.repeat(np.arange(len(signals)), [len(s.stamp_ns) for s in signals])
        place = np.concatenate([np.arange(len(s.stamp_ns)) for s in signals])
        for i in np.argsort(stamps, kind="stable").tolist():
            writer.write(links[owner[i]], int(stamps[i]), bodies[owner[i]][place[i]])
    return path


def _messages(types: dict[str, Any], signal: WrenchSignal | PoseSignal, name: str, *, ros1: bool) -> list[Any]:
    kind, header, time = types[name], types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    wrench, pose = types["geometry_msgs/msg/Wrench"], types["geometry_msgs/msg/Pose"]
    point, transform = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Transform"]
    first, second = (
        (signal.force_n, signal.torque_n_m)
        if isinstance(signal, WrenchSignal)
        else (signal.position_m, signal.quaternion_xyzw)
    )
    out = []
    rows = zip(signal.stamp_ns.tolist(), first.tolist(), second.tolist(), strict=True)
    for number, (stamp, a, b) in enumerate(rows):
        counted = {"seq": number} if ros1 else {}
        head = header(**counted, stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=signal.frame_id)
        if isinstance(signal, WrenchSignal):
            out.append(kind(header=head, wrench=wrench(force=vector(*a), torque=vector(*b))))
        elif name.endswith("PoseStamped"):
            out.append(kind(header=head, pose=pose(position=point(*a), orientation=quaternion(*b))))
        else:
            child = transform(translation=vector(*a), rotation=quaternion(*b))
            out.append(kind(header=head, child_frame_id="flange", transform=child))
    return out
