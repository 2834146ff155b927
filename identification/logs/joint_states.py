"""What can be said of a `sensor_msgs/JointState` without being told its layout."""

import numpy as np

from ..errors import LogError
from ..recording import FloatArray
from ..result import Finding
from .channel import RawChannel
from .definitions import JOINT_STATE
from .messages import decode_objects

_AT_MOST = 20_000
_WRENCH_ENTRIES = 6
_DEADBAND_SHARE = 0.02
"""Exact zeros beyond this share do not come from a sensor with noise, whose samples hardly ever are exactly zero."""


def joint_state_findings(raw: RawChannel) -> tuple[Finding, ...]:
    """Describe a joint state: how many entries, names, and whether six efforts look as if a deadband was applied."""
    if raw.channel.type_name != JOINT_STATE or not raw.count:
        return ()
    messages = list(decode_objects(raw, step=-(-raw.count // _AT_MOST)))
    counts = {part: _entries(messages, part) for part in ("name", "position", "velocity", "effort")}
    told = ", ".join(f"{' or '.join(map(str, count))} {part}" for part, count in counts.items())
    topic = raw.channel.topic
    layout = Finding(
        code="layout-undeclared",
        severity="warning",
        message=f"{topic} is a JointState with {told} entries; what they mean is not told in the log, "
        "so a layout would have to be declared before it can serve as pose or wrench.",
        advice="Record the wrench as WrenchStamped and the flange pose as PoseStamped.",
    )
    if counts["effort"] != [_WRENCH_ENTRIES]:
        return (layout,)
    effort = np.array([message.effort for message in messages], dtype=np.float64)  # type: ignore[attr-defined]
    return (layout, _effort_finding(topic, effort))


def _entries(messages: list[object], part: str) -> list[int]:
    try:
        return sorted({len(getattr(message, part)) for message in messages})
    except (AttributeError, TypeError) as error:
        raise LogError(f"The JointState of this log lacks the list {part}: {error}.") from error


def _effort_finding(topic: str, effort: FloatArray) -> Finding:
    zeros = np.mean(effort == 0.0, axis=0)
    shares = ", ".join(f"{100 * share:.1f}" for share in zeros)
    message = f"The 6 effort entries of {topic} may be a wrench; exact zeros in each: {shares} %."
    if not bool(np.any(zeros > _DEADBAND_SHARE)):
        return Finding(
            code="effort-may-be-wrench",
            severity="info",
            message=message,
            advice="Nothing in the values says whether gravity and bias are still in them.",
        )
    return Finding(
        code="effort-deadband",
        severity="warning",
        message=f"{message} So many exact zeros are what a deadband applied before "
        "recording leaves: samples cut to zero tell nothing about gravity and bias.",
        advice="Record the sensor's wrench before gravity compensation and deadband.",
    )
