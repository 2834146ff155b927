"""What a channel can serve as, from its type and name, and how to say what is missing or ambiguous."""

import re
from collections.abc import Sequence
from itertools import pairwise

from ..errors import listed
from .cell import Source
from .containers.channel import Channel
from .heads import Head
from .layouts import (
    ADMITTANCE_STATE,
    FLOAT_ARRAY,
    JOINT_STATE,
    LAYOUTS,
    POSE_STAMPED,
    TRANSFORMS,
    UNDECLARED,
    WRENCH_STAMPED,
    Role,
)

COMMAND_WORDS = frozenset({"command", "cmd", "commanded", "desired", "target", "reference", "setpoint", "goal"})
PROCESSED_WORDS = frozenset(
    {"compensated", "filtered", "filter", "unbiased", "zeroed", "tared", "external", "contact", "processed"}
)

ENTRY = {
    Role.WRENCH: "wrench",
    Role.POSE: "pose",
    Role.COMMAND: "command",
    Role.TWIST: "twist",
    Role.GAINS: "gains",
    Role.DESIRED_FORCE: "desired_force",
}
"""The entry of cell.yaml that declares a role."""
LABEL = {
    Role.WRENCH: "wrench",
    Role.POSE: "measured pose",
    Role.COMMAND: "commanded pose",
    Role.TWIST: "twist",
    Role.GAINS: "controller's gains",
    Role.DESIRED_FORCE: "desired force",
}
OPTION = {Role.WRENCH: "--wrench-topic", Role.POSE: "--pose-topic", Role.COMMAND: "--command-topic"}
_RECORD = {
    Role.WRENCH: f"record the force/torque sensor as {WRENCH_STAMPED}, raw (gravity, bias and no deadband), "
    "with header stamps, at the control rate",
    Role.POSE: f"record the measured flange pose as {POSE_STAMPED} with header stamps, at the control rate",
    Role.COMMAND: f"record the commanded flange pose as {POSE_STAMPED} on a topic whose name says so "
    "(e.g. /commanded_pose), or name it with --command-topic",
}
NEEDS = {Role.WRENCH: WRENCH_STAMPED, Role.POSE: POSE_STAMPED, Role.COMMAND: POSE_STAMPED}


def roles_of(channel: Channel) -> tuple[Role, ...]:
    """Return what a channel can serve as by its type and the words in its topic."""
    if channel.encoding not in ("cdr", "ros1"):
        return ()
    if channel.type_name == JOINT_STATE:
        return (Role.JOINT_STATE,)
    if channel.type_name == FLOAT_ARRAY:
        return (Role.NUMBERS,)
    by_type = [role for role, layouts in LAYOUTS.items() if channel.type_name in layouts]
    return tuple(role for role in by_type if _fits_name(role, channel))


def is_command_name(topic: str) -> bool:
    """Tell whether a word of the topic says that it carries a command."""
    words = _words(topic)
    pairs = {first + second for first, second in pairwise(words)}
    return bool(COMMAND_WORDS & ({*words} | (pairs & {"setpoint"})))


def is_processed_name(topic: str) -> bool:
    """Tell whether a word of the topic says that a wrench is not as the sensor showed it."""
    return bool(PROCESSED_WORDS & {*_words(topic)})


def missing_sentence(role: Role, log: str, heads: Sequence[Head], source: Source | None = None) -> str:
    """Say that a log has no channel for a role, what it has instead and what to record.

    Where what the cell declares (`source`) rules channels of the right type out, that is said instead.
    """
    ruled_out = _ruled_out(role, log, heads, source)
    if ruled_out:
        return ruled_out
    types = sorted({head.channel.type_name for head in heads if head.count and head.channel.type_name})
    empty = sorted(head.channel.topic for head in heads if not head.count and role in roles_of(head.channel))
    silent = f" ({listed(empty)} is there but without messages)" if empty else ""
    sentence = (
        f"{log} has no channel for the {LABEL[role]}{silent}: it needs {NEEDS.get(role, 'one')}, "
        f"the log holds {listed(types, empty='nothing')}; {_RECORD.get(role, 'record it')}."
    )
    undeclared = [head.channel.topic for head in heads if head.count and is_undeclared(head)]
    if role is Role.COMMAND or not undeclared:
        return sentence
    return (
        f"{sentence} {listed(undeclared)} may carry it, but what the numbers mean is not told in the log: declare "
        f"`{ENTRY[role]}: {{topic: …, fields: …}}` in cell.yaml; `autotune inspect LOG --write-cell cell.yaml` begins "
        "such a file."
    )


def _ruled_out(role: Role, log: str, heads: Sequence[Head], source: Source | None) -> str:
    """Say why channels of the type that a role needs do not serve it, nothing where there are none."""
    typed = [head for head in heads if head.count and head.channel.type_name == NEEDS.get(role)]
    if not typed:
        return ""
    start = f"None of {listed(typed)} in {log} serves as the {LABEL[role]}"
    if source is not None and getattr(source, "fields", None) is not None:
        return (
            f"{start}: `{ENTRY[role]}: {{fields: …}}` is for messages whose type does not tell their meaning; name "
            "the `topic` as well if those of a typed one are meant, or leave `fields` out."
        )
    if source is not None and source.frame is not None:
        return f"{start}: cell.yaml asks for the frame {source.frame!r}; correct `{ENTRY[role]}: {{frame: …}}`."
    if role is Role.POSE and all(is_command_name(head.channel.topic) for head in typed):
        return (
            f"{start}, since by their names they are commands; record the measured flange pose as {POSE_STAMPED} too, "
            "or name it with --pose-topic if one of them is measured."
        )
    return ""


def is_undeclared(head: Head) -> bool:
    """Tell whether a channel holds numbers whose meaning has to be declared."""
    return head.channel.type_name in UNDECLARED or head.channel.encoding not in ("cdr", "ros1")


def _words(topic: str) -> list[str]:
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", topic).lower()
    return re.findall(r"[a-z]+", spaced)


def _fits_name(role: Role, channel: Channel) -> bool:
    if channel.type_name == ADMITTANCE_STATE or channel.type_name in TRANSFORMS - {
        "geometry_msgs/msg/TransformStamped"
    }:
        return role is not Role.COMMAND
    is_command = is_command_name(channel.topic)
    if role in (Role.COMMAND, Role.DESIRED_FORCE):
        return is_command
    return not is_command


def ambiguous_sentence(role: Role, found: Sequence[Head], log: str) -> str:
    """List the candidates for a role and say what chooses among them."""
    names = ", ".join(map(str, found))
    option = f"{OPTION[role]} or " if role in OPTION else ""
    also = " (and, if another is the command, --command-topic)" if role is Role.POSE else ""
    return (
        f"{len(found)} channels of {log} could be the {LABEL[role]}: {names}; say which one with "
        f"{option}`{ENTRY[role]}: {{topic: …}}` in cell.yaml{also}."
    )
