"""Write a simulated run as a ROS 2 MCAP through the official writer library."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from mcap_ros2.writer import Writer

from autotune.formats.atomic import sweep_leftovers, temporary_beside
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray

_HEADER = """std_msgs/Header header
{body}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_VECTOR = "float64 x\nfloat64 y\nfloat64 z\n"
_SEPARATOR = "=" * 80
WRENCH_STAMPED = _HEADER.format(body="geometry_msgs/Wrench wrench") + (
    f"{_SEPARATOR}\nMSG: geometry_msgs/Wrench\ngeometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n"
    f"{_SEPARATOR}\nMSG: geometry_msgs/Vector3\n{_VECTOR}"
)
POSE_STAMPED = _HEADER.format(body="geometry_msgs/Pose pose") + (
    f"{_SEPARATOR}\nMSG: geometry_msgs/Pose\ngeometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    f"{_SEPARATOR}\nMSG: geometry_msgs/Point\n{_VECTOR}"
    f"{_SEPARATOR}\nMSG: geometry_msgs/Quaternion\n{_VECTOR}float64 w\n"
)


@dataclass(frozen=True, kw_only=True)
class _Channel:
    topic: str
    schema_name: str
    schema_text: str
    stamps: list[int]
    message: Callable[[int], dict[str, Any]]


def write_mcap(recording: Recording, path: Path, *, progress: Callable[[int], None] | None = None) -> None:
    """Write wrench, pose and command as zstd-compressed CDR in the order of their stamps, whole or not at all.

    `progress` receives the number of messages written since the last call. Log and publish time equal the stamp.
    """
    sweep_leftovers(path.parent)
    partial, _ = temporary_beside(path)
    try:
        with partial.open("wb") as stream:
            _write(stream, _channels(recording), progress)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _write(stream: IO[bytes], channels: list[_Channel], progress: Callable[[int], None] | None) -> None:
    writer = Writer(stream)
    schemas = {c.schema_name: c.schema_text for c in channels}
    registered = {name: writer.register_msgdef(name, text) for name, text in schemas.items()}
    order = sorted((stamp, c, i) for c, channel in enumerate(channels) for i, stamp in enumerate(channel.stamps))
    since = 0
    for sequence, (stamp, c, i) in enumerate(order):
        channel = channels[c]
        writer.write_message(
            topic=channel.topic,
            schema=registered[channel.schema_name],
            message=channel.message(i),
            log_time=stamp,
            publish_time=stamp,
            sequence=sequence,
        )
        since += 1
        if progress is not None and since == 5000:
            progress(since)
            since = 0
    if progress is not None:
        progress(since)
    writer.finish()


def _channels(recording: Recording) -> list[_Channel]:
    return [
        _wrench_channel(recording.wrench),
        _pose_channel(recording.pose),
        *([] if recording.command is None else [_pose_channel(recording.command)]),
    ]


def _wrench_channel(signal: WrenchSignal) -> _Channel:
    parts = {"force": ("xyz", signal.force_n), "torque": ("xyz", signal.torque_n_m)}
    return _stamped_channel(signal, "wrench", WRENCH_STAMPED, parts)


def _pose_channel(signal: PoseSignal) -> _Channel:
    parts = {"position": ("xyz", signal.position_m), "orientation": ("xyzw", signal.quaternion_xyzw)}
    return _stamped_channel(signal, "pose", POSE_STAMPED, parts)


def _stamped_channel(
    signal: WrenchSignal | PoseSignal, name: str, schema_text: str, parts: Mapping[str, tuple[str, FloatArray]]
) -> _Channel:
    """Return the messages of type `<name>Stamped`, whose entry `name` holds `parts`: components and samples of each."""
    stamps = signal.stamp_ns.tolist()
    rows = {part: (components, samples.tolist()) for part, (components, samples) in parts.items()}

    def message(i: int) -> dict[str, Any]:
        stamp = {"sec": stamps[i] // 10**9, "nanosec": stamps[i] % 10**9}
        body = {part: dict(zip(components, values[i], strict=True)) for part, (components, values) in rows.items()}
        return {"header": {"stamp": stamp, "frame_id": signal.frame_id}, name: body}

    return _Channel(
        topic=signal.topic,
        schema_name=f"geometry_msgs/msg/{name.capitalize()}Stamped",
        schema_text=schema_text,
        stamps=stamps,
        message=message,
    )
