"""What can be said of channels whose numbers must be declared before they mean anything."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby

from problems.arrays import FloatArray

from ..errors import LogError, listed
from ..result import Finding
from .containers.channel import Channel, Held
from .messages.decode import Wanted
from .messages.first import decode_first
from .messages.objects import build_object_parser
from .opened import OpenedLog, OpenedLogs
from .roles.registry import FLOAT_ARRAY, JOINT_STATE

_MOST_ENTRIES = 256
_MOST_NAMES = 30
_WRENCH_ENTRIES = 6
_DEADBAND_SHARE = 0.02
"""Exact zeros beyond this share do not come from a sensor with noise, whose samples hardly ever are exactly zero."""
_LISTS = {JOINT_STATE: ("position", "velocity", "effort"), FLOAT_ARRAY: ("data",)}


@dataclass(frozen=True, kw_only=True)
class NumberFields:
    """The paths of the numbers in the first message of a channel, such as `effort[0]`, or the columns of a table."""

    topic: str
    type: str
    paths: tuple[str, ...]

    @property
    def is_complete(self) -> bool:
        """Whether all numbers are listed: of long lists only the first entries are."""
        return len(self.paths) < _MOST_ENTRIES

    @property
    def short(self) -> str:
        """The paths for a message, the entries of a list as one: `effort[0] to effort[5]`."""
        names = []
        for _, entries in groupby(self.paths, key=lambda path: re.sub(r"\[\d+\]$", "[]", path)):
            listed = list(entries)
            names.append(listed[0] if len(listed) == 1 else f"{listed[0]} to {listed[-1]}")
        return ", ".join(names[:_MOST_NAMES]) + (", …" if len(names) > _MOST_NAMES else "")


def number_fields(part: OpenedLog) -> Iterator[NumberFields]:
    """Yield the paths of every channel of a log that must be declared."""
    for info in part.infos:
        if info.columns:
            yield NumberFields(topic=info.channel.topic, type=info.channel.type_name, paths=info.columns)
    for held in part.survey.held:
        paths = _paths(held) if held.count else ()
        if paths:
            yield NumberFields(topic=held.channel.topic, type=held.channel.type_name, paths=paths)


def number_findings(
    logs: OpenedLogs, numbers: Sequence[NumberFields], declared: Collection[Channel]
) -> Iterator[Finding]:
    """Describe channels that nobody declared, and whether six efforts look as if a deadband was applied."""
    channels = {info.channel.topic: info.channel for info in logs.infos}
    for found in numbers:
        if channels[found.topic] in declared:
            continue
        kind = found.type.rpartition("/")[2] or "channel of no type"
        yield Finding.warning(
            "layout-undeclared",
            f"{found.topic} is a {kind} with {_counts(found)}; the log does not say what they mean, "
            "so a layout has to be declared in cell.yaml before it can serve as pose or wrench.",
            "Declare `fields` (`autotune inspect LOG --write-cell cell.yaml` begins a file), or record the "
            "wrench as WrenchStamped and the flange pose as PoseStamped.",
        )
        efforts = tuple(path for path in found.paths if path.startswith("effort["))
        if found.type == JOINT_STATE and len(efforts) == _WRENCH_ENTRIES:
            channel = channels[found.topic]
            values = logs.read({channel: Wanted(fields=efforts)})[channel].values
            yield _effort_finding(found.topic, values)


def _counts(found: NumberFields) -> str:
    if found.type in ("csv", "parquet"):
        return f"the columns {listed(found.paths)}"
    lists: dict[str, int] = {}
    for path in found.paths:
        name = path.partition("[")[0]
        lists[name] = lists.get(name, 0) + 1
    if len(lists) > 6:
        return f"{len(found.paths)} numbers ({', '.join(found.paths[:6])}, …)"
    return ", ".join(f"{count} {name}" for name, count in lists.items())


def _paths(held: Held) -> tuple[str, ...]:
    channel = held.channel
    try:
        if channel.type_name in _LISTS and channel.encoding in ("cdr", "ros1"):
            return tuple(path for name in _LISTS[channel.type_name] for path in _entries(held, name))
        if channel.encoding in ("json", "protobuf"):
            return tuple(_leaves(build_object_parser(channel)(held.first_message)))
    except LogError:
        return ()
    return ()


def _entries(held: Held, name: str) -> list[str]:
    """Return the paths of a list's entries; the list ends where the next cannot be read."""
    paths: list[str] = []
    while len(paths) < _MOST_ENTRIES:
        path = f"{name}[{len(paths)}]"
        try:
            decode_first(held, Wanted(fields=(path,), header=""))
        except LogError:
            break
        paths.append(path)
    return paths


def _leaves(value: object, path: str = "") -> Iterator[str]:
    """Yield the paths of all numbers in a tree of objects, at most 256 of a list."""
    if isinstance(value, bool):
        return
    if isinstance(value, int | float):
        yield path
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        for index, item in enumerate(value[:_MOST_ENTRIES]):
            yield from _leaves(item, f"{path}[{index}]")
    elif hasattr(value, "ListFields"):
        for field, item in value.ListFields():
            yield from _leaves(item, f"{path}.{field.name}" if path else str(field.name))


def _effort_finding(topic: str, effort: FloatArray) -> Finding:
    zeros = (effort == 0.0).mean(axis=0)
    shares = ", ".join(f"{100 * share:.1f}" for share in zeros)
    message = f"The 6 effort entries of {topic} may be a wrench; exact zeros in each: {shares} %."
    if not bool((zeros > _DEADBAND_SHARE).any()):
        return Finding.info(
            "effort-may-be-wrench", message, "Nothing in the values says whether gravity and bias are still in them."
        )
    return Finding.warning(
        "effort-deadband",
        f"{message} So many exact zeros are what a deadband applied before "
        "recording leaves: samples cut to zero hold nothing of gravity and bias.",
        "Record the sensor's wrench before gravity compensation and deadband.",
    )
