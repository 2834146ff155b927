"""What a robot's state message holds and nobody fills: a desired pose without a command, torques that are zero."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...result import Finding
from ..messages.decode import Series
from ..roles.registry import ROBOT_STATES, Role
from .samples import joined


def drop_idle_command(parts: Sequence[dict[Role, Series]]) -> tuple[Finding, ...]:
    """Take a command out that a robot's state holds though nobody commands poses: it rests, or repeats the measured."""
    if Role.COMMAND not in parts[0] or parts[0][Role.COMMAND].channel.type_name not in ROBOT_STATES:
        return ()
    command, pose = (joined([part[role].values for part in parts]) for role in (Role.COMMAND, Role.POSE))
    is_same = bool(np.array_equal(command, pose, equal_nan=True))
    if not is_same and bool(np.any(command != command[:1])):
        return ()
    topic = parts[0][Role.COMMAND].channel.topic
    for part in parts:
        del part[Role.COMMAND]
    why = "repeats the measured pose" if is_same else "stays the same"
    return (
        Finding.warning(
            "idle-command",
            f"The desired pose of {topic} {why} in all {len(command)} samples, so it is not what moved the robot; it "
            "is left out.",
            "Record the command that the robot followed, and name it with --command-topic.",
        ),
    )


def drop_zero_torques(parts: Sequence[dict[Role, Series]]) -> tuple[Finding, ...]:
    """Leave the torques of a robot's state out that are 0 in every sample: its driver does not fill them."""
    if Role.WRENCH not in parts[0]:
        return ()
    kept, found = without_zero_torques([part[Role.WRENCH] for part in parts])
    for part, series in zip(parts, kept, strict=True):
        part[Role.WRENCH] = series
    return found


def without_zero_torques(parts: Sequence[Series]) -> tuple[Sequence[Series], tuple[Finding, ...]]:
    """Return the wrench (n, 6) of a robot's state without torques that are 0 in every sample, and say so."""
    topic, kind = parts[0].topic, parts[0].channel.type_name
    torques = [part.values[:, 3:6] for part in parts]
    is_whole = kind in ROBOT_STATES and all(len(part.fields) == 6 and all(part.has[3:]) for part in parts)
    if not is_whole or not any(each.size for each in torques) or any(bool(np.any(each != 0.0)) for each in torques):
        return parts, ()
    kept = [
        replace(
            part,
            fields=(*part.fields[:3], None, None, None),
            values=np.hstack([part.values[:, :3], np.full((len(part.values), 3), np.nan)]),
        )
        for part in parts
    ]
    return kept, (
        Finding.warning(
            "zero-torques",
            f"The torques of {topic} are 0 in all {sum(len(each) for each in torques)} samples, so they are taken as "
            "not measured and left out; nothing about turning axes follows from this log.",
            "Record a driver that fills them, where turning axes matter.",
        ),
    )
