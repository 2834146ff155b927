"""Which roles a channel can have by its type and name, and the messages about missing or ambiguous ones."""

import re
from itertools import pairwise

from ...errors import listed
from ..containers.channel import Channel, ChannelInfo, Infos
from .cell import Source
from .registry import (
    ADMITTANCE_STATE,
    FLOAT_ARRAY,
    JOINT_STATE,
    POSE_STAMPED,
    ROBOT_STATES,
    ROLES,
    TRANSFORM_STAMPED,
    TRANSFORMS,
    UNDECLARED,
    Role,
)

COMMAND_WORDS = frozenset({"command", "cmd", "commanded", "desired", "target", "reference", "setpoint", "goal"})
PROCESSED_WORDS = frozenset(
    {"compensated", "filtered", "filter", "unbiased", "zeroed", "tared", "external", "ext", "contact", "processed"}
)

_NEVER_COMMANDS = frozenset({ADMITTANCE_STATE, *TRANSFORMS} - {TRANSFORM_STAMPED})
"""Types that hold what was measured, whatever the topic is called."""


def roles_of(channel: Channel) -> tuple[Role, ...]:
    """Return what a channel can serve as by its type and the words in its topic."""
    if channel.encoding not in ("cdr", "ros1"):
        return ()
    if channel.type_name == JOINT_STATE:
        return (Role.JOINT_STATE,)
    if channel.type_name == FLOAT_ARRAY:
        return (Role.NUMBERS,)
    is_command = is_command_name(channel.topic) and channel.type_name not in _NEVER_COMMANDS
    return tuple(
        role
        for role, kind in ROLES.items()
        if channel.type_name in kind.layouts and (channel.type_name in ROBOT_STATES or kind.is_command == is_command)
    )


def is_command_name(topic: str) -> bool:
    """Return whether a word of the topic says that it carries a command."""
    words = _words(topic)
    pairs = {first + second for first, second in pairwise(words)}
    return bool(COMMAND_WORDS & ({*words} | (pairs & {"setpoint"})))


def is_processed_name(topic: str) -> bool:
    """Return whether a word of the topic says that a wrench is not as the sensor showed it."""
    return bool(PROCESSED_WORDS & {*_words(topic)})


def missing_sentence(role: Role, log: str, infos: Infos, source: Source | None = None) -> str:
    """Say that a log has no channel for a role, what it has instead and what to record.

    Where what the cell declares (`source`) rules channels of the right type out, that is said instead.
    """
    ruled_out = _ruled_out(role, log, infos, source)
    if ruled_out:
        return ruled_out
    types = sorted({info.channel.type_name for info in infos if info.count and info.channel.type_name})
    empty = sorted(info.channel.topic for info in infos if not info.count and role in roles_of(info.channel))
    silent = f" ({listed(empty)} is there but without messages)" if empty else ""
    sentence = (
        f"{log} has no channel for the {ROLES[role].label}{silent}: it needs {ROLES[role].main_type}, "
        f"the log holds {listed(types, empty='nothing')}; {ROLES[role].record}."
    )
    undeclared = [info.channel.topic for info in infos if info.count and is_undeclared(info)]
    if role is Role.COMMAND or not undeclared:
        return sentence
    return (
        f"{sentence} {listed(undeclared)} may carry it, but the log does not say what its numbers mean: declare "
        f"`{ROLES[role].entry}: {{topic: …, fields: …}}` in cell.yaml; `autotune inspect LOG --write-cell cell.yaml` "
        "begins such a file."
    )


def _ruled_out(role: Role, log: str, infos: Infos, source: Source | None) -> str:
    """Say why channels of the type that a role needs do not serve it, nothing where there are none."""
    typed = [info for info in infos if info.count and info.channel.type_name == ROLES[role].main_type]
    if not typed:
        return ""
    start = f"None of {listed(typed)} in {log} serves as the {ROLES[role].label}"
    if source is not None and getattr(source, "fields", None) is not None:
        return (
            f"{start}: `{ROLES[role].entry}: {{fields: …}}` is for messages whose type does not say what they mean; "
            "name the `topic` as well if those of a typed one are meant, or leave `fields` out."
        )
    if source is not None and source.frame is not None:
        return f"{start}: cell.yaml asks for the frame {source.frame!r}; correct `{ROLES[role].entry}: {{frame: …}}`."
    if role is Role.POSE and all(is_command_name(info.channel.topic) for info in typed):
        return (
            f"{start}, since by their names they are commands; record the measured flange pose as {POSE_STAMPED} too, "
            "or name it with --pose-topic if one of them is measured."
        )
    return ""


def is_undeclared(info: ChannelInfo) -> bool:
    """Return whether a channel holds numbers whose meaning has to be declared."""
    return info.channel.type_name in UNDECLARED or info.channel.encoding not in ("cdr", "ros1")


def _words(topic: str) -> list[str]:
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", topic).lower()
    return re.findall(r"[a-z]+", spaced)


def ambiguous_sentence(role: Role, found: Infos, log: str) -> str:
    """List the candidates for a role and say what chooses among them."""
    names = ", ".join(map(str, found))
    option = f"{ROLES[role].option} or " if ROLES[role].option else ""
    also = " (and, if another is the command, --command-topic)" if role is Role.POSE else ""
    return (
        f"{len(found)} channels of {log} could be the {ROLES[role].label}: {names}; say which one with "
        f"{option}`{ROLES[role].entry}: {{topic: …}}` in cell.yaml{also}."
    )
