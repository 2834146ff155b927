"""Read from a log the channels that `identify` needs."""

from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import numpy as np

from ..errors import LogError
from ..recording import FloatArray, PoseSignal, Recording, WrenchSignal
from ..result import Finding
from .channel import Channel, Keep, RawChannel, Scan
from .checks import frame_faults, pose_faults, stamp_faults, wrench_faults
from .containers import scan_log, sha256_of
from .definitions import JOINT_STATE, POSE, WRENCH
from .messages import POSE_FIELDS, WRENCH_FIELDS, Headers, decode_headers, decode_values
from .roles import Request, choose_command, choose_pose, choose_wrench


def read_recording(
    path: Path, *, wrench_topic: str | None = None, pose_topic: str | None = None, command_topic: str | None = None
) -> Recording:
    """Read wrench, measured pose and, where there is one, commanded pose, each on the clock of its header stamps.

    Channels are found by type and by the words in their topics, or named. Quaternions are normalised. Raises LogError
    when the file is damaged, a channel is missing or ambiguous, or its samples cannot be used.
    """
    request = Request(wrench_topic=wrench_topic, pose_topic=pose_topic, command_topic=command_topic)
    scan = scan_log(path, lambda channel: _keep(channel, request))
    try:
        wrench = choose_wrench(scan.channels, request, path.name)
    except LogError as error:
        raise _with_joint_states(error, scan) from None
    pose = choose_pose(scan.channels, request, path.name)
    command = choose_command(scan.channels, request, path.name)
    return Recording(
        wrench=_wrench_signal(wrench, scan.start_ns),
        pose=_pose_signal(pose, scan.start_ns),
        command=None if command is None else _pose_signal(command, scan.start_ns),
        sha256={str(path): sha256_of(path)},
    )


def _keep(channel: Channel, request: Request) -> Keep:
    named = {request.wrench_topic} if channel.type_name == WRENCH else {request.pose_topic, request.command_topic}
    if channel.type_name not in (WRENCH, POSE):
        return Keep.TIMES
    return Keep.ALL if None in named or channel.topic in named else Keep.TIMES


def _with_joint_states(error: LogError, scan: Scan) -> LogError:
    """Add to a missing wrench that a joint state may carry one; `inspect` tells what can be said about each."""
    topics = [raw.channel.topic for raw in scan.channels if raw.channel.type_name == JOINT_STATE]
    if not topics:
        return error
    return LogError(
        f"{error} The JointState of {', '.join(topics)} may carry a wrench, but its layout is not declared in the log; "
        "`autotune inspect` tells what it looks like."
    )


def since_start_s(raw: RawChannel, start_ns: int) -> FloatArray:
    """Return when each message was recorded, in seconds from the start of the log."""
    return (raw.log_ns - start_ns) / 1e9


def wrench_findings(raw: RawChannel, headers: Headers, values: FloatArray, start_ns: int) -> Iterable[Finding]:
    """List what makes a wrench channel unusable."""
    topic, when = raw.channel.topic, since_start_s(raw, start_ns)
    return chain(
        stamp_faults(topic, headers.stamp_ns, when), frame_faults(topic, headers), wrench_faults(topic, values, when)
    )


def pose_findings(raw: RawChannel, headers: Headers, values: FloatArray, start_ns: int) -> Iterable[Finding]:
    """List what makes a pose channel unusable."""
    topic, when = raw.channel.topic, since_start_s(raw, start_ns)
    return chain(
        stamp_faults(topic, headers.stamp_ns, when), frame_faults(topic, headers), pose_faults(topic, values, when)
    )


def _refuse(findings: Iterable[Finding]) -> None:
    for finding in findings:
        raise LogError(f"{finding.message} {finding.advice}")


def _wrench_signal(raw: RawChannel, start_ns: int) -> WrenchSignal:
    headers, values = decode_headers(raw), decode_values(raw, WRENCH_FIELDS)
    _refuse(wrench_findings(raw, headers, values, start_ns))
    return WrenchSignal(
        topic=raw.channel.topic,
        frame_id=headers.frame_ids[0],
        stamp_ns=headers.stamp_ns,
        force_n=values[:, :3],
        torque_n_m=values[:, 3:],
    )


def _pose_signal(raw: RawChannel, start_ns: int) -> PoseSignal:
    headers, values = decode_headers(raw), decode_values(raw, POSE_FIELDS)
    _refuse(pose_findings(raw, headers, values, start_ns))
    quaternion = values[:, 3:]
    return PoseSignal(
        topic=raw.channel.topic,
        frame_id=headers.frame_ids[0],
        stamp_ns=headers.stamp_ns,
        position_m=values[:, :3],
        quaternion_xyzw=quaternion / np.sqrt(np.sum(quaternion**2, axis=1, keepdims=True)),
    )
