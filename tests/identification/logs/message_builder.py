"""MCAP logs of any ROS 2 message type and of JSON, written by the official writer with bytes from rosbags."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000_000_000_000
DELAY_NS = 300_000
"""Time of recording less header stamp."""

ADMITTANCE_STATE = "control_msgs/msg/AdmittanceControllerState"
_ADMITTANCE_TEXT = """\
sensor_msgs/JointState joint_state
std_msgs/Float64MultiArray damping
std_msgs/Float64MultiArray mass
std_msgs/Int8MultiArray selected_axes
std_msgs/Float64MultiArray stiffness
geometry_msgs/WrenchStamped wrench_base
geometry_msgs/TwistStamped admittance_acceleration
geometry_msgs/TwistStamped admittance_velocity
geometry_msgs/TransformStamped admittance_position
geometry_msgs/Quaternion rot_base_control
geometry_msgs/TransformStamped ref_trans_base_ft
std_msgs/String ft_sensor_frame
"""
STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE.register(get_types_from_msg(_ADMITTANCE_TEXT, ADMITTANCE_STATE))

Tree = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Topic:
    """A topic of `count` messages at `rate_hz`; `message` makes one from number and stamp; JSON without a type."""

    topic: str
    type_name: str
    message: Callable[[int, int], Tree]
    count: int = 200
    rate_hz: float = 200.0

    @property
    def stamps(self) -> NDArray[np.int64]:
        return START_NS + np.round(np.arange(self.count) * 1e9 / self.rate_hz).astype(np.int64)


def write_log(path: Path, topics: Sequence[Topic]) -> Path:
    """Write the topics in order of recording."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = [_register(writer, topic) for topic in topics]
        order = sorted((int(stamp), t, i) for t, topic in enumerate(topics) for i, stamp in enumerate(topic.stamps))
        for stamp, t, i in order:
            tree, name = topics[t].message(i, stamp), topics[t].type_name
            data = bytes(STORE.serialize_cdr(build(name, tree), name)) if name else json.dumps(tree).encode()
            writer.add_message(channels[t], stamp + DELAY_NS, data, stamp)
        writer.finish()
    return path


def _register(writer: Writer, topic: Topic) -> int:
    if not topic.type_name:
        schema = writer.register_schema("Sample", "jsonschema", b'{"type": "object"}')
        return writer.register_channel(topic.topic, "json", schema)
    text = STORE.generate_msgdef(topic.type_name, ros_version=2)[0]
    schema = writer.register_schema(topic.type_name, "ros2msg", text.encode())
    return writer.register_channel(topic.topic, "cdr", schema)


def build(name: str, tree: Tree) -> Any:
    """Return the message of rosbags that a tree tells; what it leaves out is zero, empty or no turn."""
    fields = {}
    for field, (kind, details) in STORE.fielddefs[name][1]:
        value = tree.get(field)
        if int(kind) == 2:
            fields[field] = build(str(details), value or {})
        elif int(kind) in (3, 4):
            fields[field] = _sequence(details, value or [])
        else:
            fields[field] = value if value is not None else ("" if details[0] == "string" else 0)
    return STORE.types[name](**fields)


def _sequence(details: Any, values: Sequence[Any]) -> Any:
    inner = details[0]
    if int(inner[0]) == 2:
        return [build(str(inner[1]), value) for value in values]
    if inner[1][0] == "string":
        return list(values)
    return np.array(values, dtype=inner[1][0])


def header(stamp_ns: int, frame_id: str = "base") -> Tree:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame_id}


def xyz(values: Sequence[float] | NDArray[np.float64]) -> Tree:
    return dict(zip("xyz", map(float, values), strict=True))


def xyzw(values: Sequence[float] | NDArray[np.float64]) -> Tree:
    return dict(zip("xyzw", map(float, values), strict=True))
