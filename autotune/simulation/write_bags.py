"""Write the beginning of a simulated run as ROS 1 bag, as rosbag2 folder with SQLite, and as CSV table."""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_typestore

from identification.signals.recording import PoseSignal, Recording, WrenchSignal

_COLUMNS = "t,fx,fy,fz,tx,ty,tz,x,y,z,qx,qy,qz,qw"


def write_ros1_bag(recording: Recording, path: Path, *, rows: int) -> None:
    """Write the first `rows` messages of wrench, pose and command as a ROS 1 bag."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = BagWriter(path)
    writer.set_compression(BagWriter.CompressionFormat.LZ4)
    with writer:
        for signal in _signals(recording):
            name = _type_of(signal)
            link = writer.add_connection(signal.topic, name, typestore=store)
            for stamp, message in _messages(store.types, signal, rows, ros1=True):
                writer.write(link, stamp, store.serialize_ros1(message, name))


def write_rosbag2(recording: Recording, folder: Path, *, rows: int) -> None:
    """Write the first `rows` messages of wrench, pose and command as a rosbag2 folder that SQLite stores."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    with FolderWriter(folder, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for signal in _signals(recording):
            name = _type_of(signal)
            link = writer.add_connection(signal.topic, name, typestore=store)
            for stamp, message in _messages(store.types, signal, rows, ros1=False):
                writer.write(link, stamp, store.serialize_cdr(message, name))


def write_csv(recording: Recording, path: Path, *, rows: int) -> None:
    """Write the first `rows` samples of the wrench, and the pose beside them, as a table with one head line."""
    wrench, pose = recording.wrench, recording.pose
    count = min(rows, len(wrench.stamp_ns), len(pose.stamp_ns))
    columns = (wrench.force_n, wrench.torque_n_m, pose.position_m, pose.quaternion_xyzw)
    time_s = (wrench.stamp_ns[:count] - wrench.stamp_ns[0])[:, None] * 1e-9
    table = np.hstack([time_s, *(each[:count] for each in columns)])
    np.savetxt(path, table, fmt="%.10g", delimiter=",", header=_COLUMNS, comments="")


def _signals(recording: Recording) -> list[WrenchSignal | PoseSignal]:
    return [signal for signal in (recording.wrench, recording.pose, recording.command) if signal is not None]


def _type_of(signal: WrenchSignal | PoseSignal) -> str:
    return f"geometry_msgs/msg/{'WrenchStamped' if isinstance(signal, WrenchSignal) else 'PoseStamped'}"


def _messages(
    types: dict[str, Any], signal: WrenchSignal | PoseSignal, rows: int, *, ros1: bool
) -> list[tuple[int, Any]]:
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    out = []
    for i, stamp in enumerate(signal.stamp_ns[:rows].tolist()):
        counted = {"seq": i} if ros1 else {}
        head = header(**counted, stamp=time(sec=stamp // 10**9, nanosec=stamp % 10**9), frame_id=signal.frame_id)
        if isinstance(signal, WrenchSignal):
            force, torque = vector(*signal.force_n[i].tolist()), vector(*signal.torque_n_m[i].tolist())
            body = {"wrench": types["geometry_msgs/msg/Wrench"](force=force, torque=torque)}
        else:
            turn = types["geometry_msgs/msg/Quaternion"](*signal.quaternion_xyzw[i].tolist())
            place = point(*signal.position_m[i].tolist())
            body = {"pose": types["geometry_msgs/msg/Pose"](position=place, orientation=turn)}
        out.append((stamp, types[_type_of(signal)](header=head, **body)))
    return out
