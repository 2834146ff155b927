"""Logs for tests, written by other libraries: MCAP by the official ROS 2 writer, ROS 1 bags by rosbags."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from identification.logs.roles.registry import POSE_STAMPED as POSE
from identification.logs.roles.registry import WRENCH_STAMPED as WRENCH

ROS2 = get_typestore(Stores.ROS2_HUMBLE)
ROS1 = get_typestore(Stores.ROS1_NOETIC)
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, kw_only=True)
class Stream:
    """Messages of one topic: `values` are the six of a wrench or the seven of a pose (position, quaternion xyzw)."""

    topic: str
    type_name: str
    stamp_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    log_ns: NDArray[np.int64]
    frame_id: str = "tool0"

    def with_values(self, values: NDArray[np.float64]) -> "Stream":
        return replace(self, values=values)

    def with_stamps(self, stamp_ns: NDArray[np.int64]) -> "Stream":
        return replace(self, stamp_ns=stamp_ns)


@dataclass(frozen=True, kw_only=True)
class Options:
    """How the MCAP writer is set."""

    compression: CompressionType = CompressionType.ZSTD
    chunk_size: int = 16 * 1024
    enable_crcs: bool = True
    extra: tuple[tuple[str, str], ...] = field(default=(("/camera/image", "sensor_msgs/msg/Image"),))


def wrench_stream(topic: str = "/ft/wrench", *, rate_hz: float = 500.0, duration_s: float = 0.4) -> Stream:
    stamps = _stamps(rate_hz, duration_s)
    values = np.random.default_rng(1).normal(size=(stamps.size, 6)) * [5, 5, 5, 1, 1, 1] + [0, 0, -157, 1, 2, 0]
    return Stream(topic=topic, type_name=WRENCH, stamp_ns=stamps, values=values, log_ns=stamps + 300_000)


def pose_stream(topic: str = "/robot/pose", *, rate_hz: float = 250.0, duration_s: float = 0.4) -> Stream:
    stamps = _stamps(rate_hz, duration_s)
    values = np.random.default_rng(2).normal(size=(stamps.size, 7))
    values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    return Stream(
        topic=topic, type_name=POSE, stamp_ns=stamps, values=values, log_ns=stamps + 200_000, frame_id="base_link"
    )


def command_stream(topic: str = "/robot/pose_command", *, rate_hz: float = 250.0) -> Stream:
    return pose_stream(topic, rate_hz=rate_hz)


def complete() -> list[Stream]:
    return [wrench_stream(), pose_stream(), command_stream()]


def write_mcap(path: Path, streams: Sequence[Stream], options: Options | None = None) -> Path:
    """Write the streams in order of recording, with camera-like messages among them."""
    chosen = options or Options()
    with path.open("wb") as file:
        writer = Writer(
            file,
            chunk_size=chosen.chunk_size,
            compression=chosen.compression,
            enable_crcs=chosen.enable_crcs,
        )
        names = {stream.type_name for stream in streams} | {name for _, name in chosen.extra}
        schemas = {
            name: writer.register_msgdef(name, ROS2.generate_msgdef(name, ros_version=2)[0]) for name in sorted(names)
        }
        for topic, name in chosen.extra:
            for number in range(3):
                writer.write_message(topic, schemas[name], _image(number), log_time=START_NS + number)
        for _, stream, index in _in_order(streams):
            writer.write_message(
                stream.topic, schemas[stream.type_name], as_dict(stream, index), log_time=int(stream.log_ns[index])
            )
        writer.finish()
    return path


def write_bag(
    path: Path,
    streams: Sequence[Stream],
    compression: BagWriter.CompressionFormat | None = None,
    chunk_size: int | None = None,
) -> Path:
    """Write a ROS 1 bag."""
    bag = BagWriter(path)
    if chunk_size is not None:
        bag.chunk_threshold = chunk_size
    if compression is not None:
        bag.set_compression(compression)
    with bag:
        connections = {s.topic: bag.add_connection(s.topic, s.type_name, typestore=ROS1) for s in streams}
        for log_ns, stream, index in _in_order(streams):
            message = ROS1.serialize_ros1(as_object(ROS1, stream, index), stream.type_name)
            bag.write(connections[stream.topic], log_ns, message)
    return path


def as_dict(stream: Stream, index: int) -> dict[str, Any]:
    """One message as the MCAP writer takes it."""
    v = stream.values[index].tolist()
    header = _header(int(stream.stamp_ns[index]), stream.frame_id)
    if stream.type_name == WRENCH:
        return {"header": header, "wrench": {"force": _xyz(v[:3]), "torque": _xyz(v[3:])}}
    return {"header": header, "pose": {"position": _xyz(v[:3]), "orientation": {**_xyz(v[3:6]), "w": v[6]}}}


def as_object(store: Any, stream: Stream, index: int) -> object:
    """One message as rosbags takes it."""
    return _build(store, stream.type_name, as_dict(stream, index))


def _build(store: Any, name: str, tree: dict[str, Any]) -> object:
    arguments = {
        field_name: _build(store, kind[1], tree[field_name]) if isinstance(tree.get(field_name), dict)
        else tree.get(field_name, 0)
        for field_name, kind in store.fielddefs[name][1]
    }  # fmt: skip
    return store.types[name](**arguments)


def _header(stamp_ns: int, frame_id: str) -> dict[str, Any]:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame_id}


def _xyz(values: list[float]) -> dict[str, float]:
    return dict(zip("xyz", values, strict=True))


def _image(number: int) -> SimpleNamespace:
    return SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=number + 1, nanosec=0), frame_id="camera"),
        height=1,
        width=4000,
        encoding="mono8",
        is_bigendian=0,
        step=4000,
        data=bytes(np.random.default_rng(number).integers(0, 256, 4000, dtype=np.uint8)),
    )


def _stamps(rate_hz: float, duration_s: float) -> NDArray[np.int64]:
    return START_NS + np.round(np.arange(int(rate_hz * duration_s)) * 1e9 / rate_hz).astype(np.int64)


def _in_order(streams: Sequence[Stream]) -> list[tuple[int, Stream, int]]:
    every = [(int(log_ns), stream, index) for stream in streams for index, log_ns in enumerate(stream.log_ns)]
    return sorted(every, key=lambda item: (item[0], item[1].topic))
