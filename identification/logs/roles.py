"""Decide what a channel can serve as, from its type and name, and which channels `identify` reads. Never guess."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

from ..errors import LogError
from .channel import Channel, RawChannel
from .definitions import JOINT_STATE, POSE, WRENCH

COMMAND_WORDS = frozenset({"command", "cmd", "commanded", "desired", "target", "reference", "setpoint", "goal"})


class Role(StrEnum):
    """What a channel can be used for."""

    WRENCH = "wrench"
    POSE = "pose measured"
    COMMAND = "pose commanded"
    JOINT_STATE = "joint state"


_RECORD = {
    Role.WRENCH: f"record the force/torque sensor as {WRENCH}, raw (gravity, bias and no deadband), "
    "with header stamps, at the control rate",
    Role.POSE: f"record the measured flange pose as {POSE} with header stamps, at the control rate",
    Role.COMMAND: f"record the commanded flange pose as {POSE} on a topic whose name says so "
    "(e.g. /commanded_pose), or name it with --command-topic",
}
_LABEL = {Role.WRENCH: "wrench", Role.POSE: "measured pose", Role.COMMAND: "commanded pose"}
_OPTION = {Role.WRENCH: "--wrench-topic", Role.POSE: "--pose-topic", Role.COMMAND: "--command-topic"}
_TYPE = {Role.WRENCH: WRENCH, Role.POSE: POSE, Role.COMMAND: POSE}


@dataclass(frozen=True, kw_only=True)
class Request:
    """Topics that the user named, None where the log must tell by itself."""

    wrench_topic: str | None = None
    pose_topic: str | None = None
    command_topic: str | None = None


def roles_of(channel: Channel) -> tuple[Role, ...]:
    """Return what a channel can serve as by its type and, for poses, by the words in its topic."""
    if channel.encoding not in ("cdr", "ros1"):
        return ()
    if channel.type_name == WRENCH:
        return (Role.WRENCH,)
    if channel.type_name == POSE:
        return (Role.COMMAND,) if is_command_name(channel.topic) else (Role.POSE,)
    return (Role.JOINT_STATE,) if channel.type_name == JOINT_STATE else ()


def is_command_name(topic: str) -> bool:
    """Tell whether a word of the topic says that it carries a command."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", topic).lower()
    words = re.findall(r"[a-z]+", spaced)
    pairs = {first + second for first, second in pairwise(words)}
    return bool(COMMAND_WORDS & ({*words} | (pairs & {"setpoint"})))


def choose_wrench(channels: Sequence[RawChannel], request: Request, log: str) -> RawChannel:
    """Return the wrench channel; raise LogError when there is none or more than one."""
    if request.wrench_topic is not None:
        return _named(channels, request.wrench_topic, Role.WRENCH, log)
    return _only(_filled(channels, WRENCH), channels, Role.WRENCH, log)


def choose_pose(channels: Sequence[RawChannel], request: Request, log: str) -> RawChannel:
    """Return the measured pose channel; raise LogError when there is none or more than one."""
    if request.pose_topic is not None:
        return _named(channels, request.pose_topic, Role.POSE, log)
    poses = [raw for raw in _filled(channels, POSE) if raw.channel.topic != request.command_topic]
    return _only([raw for raw in poses if not is_command_name(raw.channel.topic)], channels, Role.POSE, log)


def choose_command(channels: Sequence[RawChannel], request: Request, log: str) -> RawChannel | None:
    """Return the commanded pose channel, None without one; raise LogError when there is more than one."""
    if request.command_topic is not None:
        if request.command_topic == request.pose_topic:
            raise LogError(f"Topic `{request.pose_topic}` cannot be the measured and the commanded pose at once.")
        return _named(channels, request.command_topic, Role.COMMAND, log)
    poses = [raw for raw in _filled(channels, POSE) if raw.channel.topic != request.pose_topic]
    commands = [raw for raw in poses if is_command_name(raw.channel.topic)]
    return _only(commands, channels, Role.COMMAND, log) if commands else None


def missing_sentence(role: Role, log: str, channels: Sequence[RawChannel]) -> str:
    """Say that a log has no channel for a role, what it has instead and what to record."""
    types = sorted({raw.channel.type_name for raw in channels if raw.count and raw.channel.type_name})
    empty = sorted(raw.channel.topic for raw in channels if not raw.count and role in roles_of(raw.channel))
    silent = f" ({', '.join(empty)} is there but without messages)" if empty else ""
    return (
        f"{log} has no channel for the {_LABEL[role]}{silent}: it needs {_TYPE[role]}, "
        f"the log holds {', '.join(types) or 'nothing'}; {_RECORD[role]}."
    )


def _filled(channels: Sequence[RawChannel], type_name: str) -> list[RawChannel]:
    return [raw for raw in channels if raw.count and raw.channel.type_name == type_name and roles_of(raw.channel)]


def _named(channels: Sequence[RawChannel], topic: str, role: Role, log: str) -> RawChannel:
    fitting = _filled(channels, _TYPE[role])
    found = [raw for raw in fitting if raw.channel.topic == topic]
    if len(found) == 1:
        return found[0]
    others = ", ".join(raw.channel.topic for raw in fitting) or "none"
    same_name = [raw for raw in channels if raw.channel.topic == topic]
    if found:
        reason = f"Topic `{topic}` is in {log} more than once, with different definitions of {_TYPE[role]}"
    elif not same_name:
        reason = f"Topic `{topic}` is not in {log}"
    elif not any(raw.count for raw in same_name):
        reason = f"Topic `{topic}` holds no message in {log}"
    else:
        is_type = same_name[0].channel.type_name or "of no known type"
        reason = f"Topic `{topic}` in {log} is {is_type}, the {_LABEL[role]} must be {_TYPE[role]}"
    raise LogError(f"{reason}; topics of that type: {others}.")


def _only(found: list[RawChannel], channels: Sequence[RawChannel], role: Role, log: str) -> RawChannel:
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(raw.channel.topic for raw in found)
        raise LogError(
            f"{len(found)} channels of {log} could be the {_LABEL[role]}: {names}; say which one with {_OPTION[role]}"
            + (" and, if another is the command, --command-topic." if role is Role.POSE else ".")
        )
    raise LogError(missing_sentence(role, log, channels))
