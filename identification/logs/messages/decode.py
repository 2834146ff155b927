"""Compile what is wanted of a message type to a program for the kernel, and run it over batches of messages.

What a type means is the definition that the log carries, completed by the standard types that it leaves out.
"""

import re
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Typesdict
from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from problems.arrays import FloatArray

from ...errors import LogError, listed
from ...signals.recording import StampArray
from ..containers.channel import Batch, Channel
from .kernel import (
    ENCAPSULATION,
    END,
    FINE,
    FRAME,
    FRAMES_FULL,
    KINDS,
    LEFT_OVER,
    MAX_DEPTH,
    NANOSECONDS,
    PICK,
    REPEAT,
    RUN,
    SEQUENCE,
    SIZES,
    SKIP,
    STAMP,
    STRING,
    TERMINATOR,
    TIMES,
    TOO_FEW,
    TOO_SHORT,
    run_program,
)

HEADER = "std_msgs/msg/Header"
TIME = "builtin_interfaces/msg/Time"
ROS_ENCODINGS = ("cdr", "ros1")
FOREIGN = (TypesysError, ValueError, LookupError, AssertionError, RecursionError, SyntaxError)
"""What rosbags raises for a definition that it cannot use."""
_STEPS_AT_MOST = 4096
_TOKEN = re.compile(r"\.([A-Za-z_]\w*)|\[(0|[1-9]\d{0,8})\]", re.ASCII)
_FILLER = "structure_needs_at_least_one_member"
_REASONS = {
    TOO_SHORT: "a field at byte {at} does not fit into its {size} bytes",
    LEFT_OVER: "its type ends at byte {at}, the message has {size}",
    ENCAPSULATION: "its encapsulation {head} is not plain CDR (00 00 or 00 01), which the RMW should write",
    TERMINATOR: "a string should end with a zero at byte {at}",
    TOO_FEW: "the sequence at byte {at} has fewer entries than are wanted",
    NANOSECONDS: "its stamp has a second of more than 999999999 ns at byte {at}",
}

Token = str | int


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What is wanted of each message: numbers by path, and the path of the header that stamps it.

    A path is written with dots and indices: `wrench.force.x`, `effort[3]`, `mass.data[0]`. `header` is empty for
    messages without one. Messages without the bytes `only` are passed over.
    """

    fields: tuple[str, ...]
    header: str = "header"
    only: bytes = b""


@dataclass(frozen=True, kw_only=True)
class JointNames:
    """The names of joints in the order of their positions; `only` is in the messages that have them, empty for all."""

    names: tuple[str, ...]
    only: bytes = b""


@dataclass(frozen=True, kw_only=True)
class Series:
    """The wanted numbers of a channel in order of recording, of a role or of all that is wanted of it.

    `log_ns` (n,) recording clock; `stamp_ns` (n,) header stamps or None; `frame_ids` the different frame names in the
    headers, sorted; `values` (n, len(fields)) as the messages hold them (no unit is converted), NaN and infinities too,
    and NaN where a field is None: a role's number that the channel lacks.
    """

    channel: Channel
    fields: tuple[str | None, ...]
    log_ns: StampArray
    stamp_ns: StampArray | None
    frame_ids: tuple[str, ...]
    values: FloatArray

    @property
    def topic(self) -> str:
        """The channel's topic."""
        return self.channel.topic

    @property
    def times_ns(self) -> StampArray:
        """The header stamps, those of recording where there are none, (n,)."""
        return self.log_ns if self.stamp_ns is None else self.stamp_ns

    @property
    def has(self) -> tuple[bool, ...]:
        """Which of the fields the channel has."""
        return tuple(field is not None for field in self.fields)

    def part(self, keep: NDArray[np.bool_]) -> "Series":
        """Return the rows that a mask (n,) keeps; of rows one behind the other no copy is made."""
        first, count = int(np.argmax(keep)) if keep.size else 0, int(np.count_nonzero(keep))
        rows = slice(first, first + count) if bool(keep[first : first + count].all()) else keep
        stamps = None if self.stamp_ns is None else self.stamp_ns[rows]
        return replace(self, log_ns=self.log_ns[rows], stamp_ns=stamps, values=self.values[rows])


def parse_path(path: str) -> tuple[Token, ...]:
    """Split `a.b[3]` into names and indices; raise LogError if it is no path."""
    tokens: list[Token] = []
    text, position = f".{path}", 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise LogError(f"{path!r} is no path to a number; write it like `wrench.force.x` or `effort[3]`.")
        tokens.append(match.group(1) if match.group(1) is not None else int(match.group(2)))
        position = match.end()
    return tuple(tokens)


@cache
def standard_types(encoding: str) -> Typestore:
    """Return the types that are known without a definition."""
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


@cache
def types_of(channel: Channel) -> Typesdict:
    """Parse the definition that the log carries, empty when it carries none; raise LogError if it cannot be parsed."""
    if not channel.schema or channel.schema_encoding not in ("ros2msg", "ros1msg", "ros2idl"):
        return {}
    try:
        text = channel.schema.decode()
        if channel.schema_encoding == "ros2idl":
            return get_types_from_idl(text)
        return get_types_from_msg(text, channel.type_name)
    except FOREIGN as error:
        raise LogError(
            f"The definition of {channel.type_name} in the log, for topic {channel.topic}, cannot be parsed: {error}."
        ) from error


@cache
def needed_types(channel: Channel) -> Typesdict:
    """Return the definition of a ROS type and of all types inside it; raise LogError where one is missing."""
    own = types_of(channel)
    found: Typesdict = {}
    missing = [channel.type_name]
    while missing:
        name = missing.pop()
        if name in found:
            continue
        definition = own.get(name) or standard_types(channel.encoding).fielddefs.get(name)
        if definition is None:
            raise LogError(f"Type {name} of topic {channel.topic} is not defined in the log and is no standard type.")
        found[name] = definition
        for _, description in found[name][1]:
            missing += _names_in(description)
    return found


def _names_in(description: Any) -> list[str]:
    """Return the type that a field consists of, if it is no primitive one."""
    kind, inside = description
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return _names_in(inside[0])
    return [inside] if kind == Nodetype.NAME else []


class _NotKnownError(Exception):
    """The type holds something that the kernel has no step for."""


@dataclass
class _Node:
    """What is wanted below a field: the column of a number, or more fields and entries."""

    column: int | None = None
    inside: dict[Token, "_Node"] = field(default_factory=dict)
    is_header: bool = False

    def node_at(self, tokens: tuple[Token, ...]) -> "_Node":
        node = self
        for token in tokens:
            node = node.inside.setdefault(token, _Node())
        return node


class _Compiler:
    def __init__(self, channel: Channel, types: Typesdict) -> None:
        self._channel, self._types = channel, types
        self.steps: list[tuple[int, int, int, int, int]] = []
        self.picks: list[tuple[int, int]] = []

    def add_struct(self, name: str, node: _Node, depth: int) -> None:
        """Add the steps of a message type, below which `node` says what is wanted."""
        if depth > MAX_DEPTH or len(self.steps) > _STEPS_AT_MOST:
            raise _NotKnownError
        fields = self._types[name][1]
        self._check(name, node, {field_name for field_name, _ in fields})
        if not fields or fields[0][0] == _FILLER:
            # A message without fields takes one byte on the wire of ROS 2 and none on that of ROS 1.
            if self._channel.encoding == "cdr":
                self._skip(1, 1)
            return
        for field_name, description in fields:
            below = node.inside.get(field_name, _Node())
            if node.is_header:
                below = _Node(is_header=field_name in ("stamp", "frame_id"))
            self._add_field(description, below, depth + 1)

    def _check(self, name: str, node: _Node, fields: set[str]) -> None:
        if node.column is not None:
            raise self._lacking(f"{name} is no number")
        if node.is_header and name != HEADER:
            raise self._lacking(f"{name} is no {HEADER}")
        for token in node.inside:
            if token not in fields:
                raise self._lacking(f"{name} has no {token!r}, only {listed(sorted(fields))}")

    def _lacking(self, why: str) -> LogError:
        return LogError(
            f"{self._channel.type_name}, as the log defines it for topic {self._channel.topic}, "
            f"lacks what is wanted of it: {why}."
        )

    def _add_field(self, description: Any, node: _Node, depth: int) -> None:
        kind, inside = description
        if kind == Nodetype.NAME:
            if inside == TIME and node.is_header:
                self._step(STAMP)
            else:
                self.add_struct(inside, node, depth)
        elif kind == Nodetype.BASE:
            self._add_base(inside[0], node)
        elif kind == Nodetype.ARRAY:
            self._add_array(inside[0], inside[1], node, depth)
        else:
            self._add_sequence(inside[0], node, depth)

    def _add_base(self, name: str, node: _Node) -> None:
        if node.inside:
            raise self._lacking(f"a {name} has nothing inside")
        if name == "string":
            if node.column is not None:
                raise self._lacking("a string is no number")
            self._step(FRAME if node.is_header else STRING)
        elif name not in KINDS:
            raise _NotKnownError
        elif node.column is None:
            self._skip(SIZES[KINDS[name]], 1)
        else:
            self._run(KINDS[name], node.column)

    def _add_array(self, inner: Any, length: int, node: _Node, depth: int) -> None:
        if node.column is not None:
            raise self._lacking("an array is no number, an entry of it may be")
        for token in node.inside:
            if not isinstance(token, int) or token >= length:
                raise self._lacking(f"an array of {length} entries has no {token!r}")
        if not node.inside and inner[0] == Nodetype.BASE and inner[1][0] in KINDS:
            if length:
                self._skip(SIZES[KINDS[inner[1][0]]], length)
        elif node.inside:
            for index in range(length):
                self._add_field(inner, node.inside.get(index, _Node()), depth)
        elif length:
            self._enter(depth)
            self._step(TIMES, 0, length)
            self._add_field(inner, node, depth + 1)
            self._step(END)

    def _add_sequence(self, inner: Any, node: _Node, depth: int) -> None:
        if node.column is not None:
            raise self._lacking("a sequence is no number, an entry of it may be")
        for token in node.inside:
            if not isinstance(token, int):
                raise self._lacking(f"a sequence has entries like [0], but no {token!r}")
        if inner[0] == Nodetype.BASE and inner[1][0] in KINDS:
            self._add_numbers(KINDS[inner[1][0]], node)
        elif node.inside:
            raise _NotKnownError
        else:
            self._enter(depth)
            position = len(self.steps)
            self._step(REPEAT)
            self._add_field(inner, node, depth + 1)
            if len(self.steps) == position + 1:
                raise _NotKnownError  # entries without any byte
            self._step(END)
            self.steps[position] = (REPEAT, len(self.steps), 0, 0, 0)

    def _add_numbers(self, kind: int, node: _Node) -> None:
        first = len(self.picks)
        for index, entry in node.inside.items():
            if entry.inside or entry.column is None:
                raise self._lacking("an entry of a sequence of numbers has nothing inside")
            self.picks.append((int(index), entry.column))
        if len(self.picks) == first:
            self._step(SEQUENCE, SIZES[kind])
        else:
            self._step(PICK, SIZES[kind], first, len(self.picks), kind)

    def _enter(self, depth: int) -> None:
        if depth >= MAX_DEPTH - 1:
            raise _NotKnownError

    def _step(self, op: int, a: int = 0, b: int = 0, c: int = 0, d: int = 0) -> None:
        self.steps.append((op, a, b, c, d))

    def _skip(self, size: int, count: int) -> None:
        if self.steps and self.steps[-1][:2] == (SKIP, size):
            count += self.steps.pop()[2]
        self._step(SKIP, size, count)

    def _run(self, kind: int, column: int) -> None:
        """Add a number to the run before it where it takes the column behind that."""
        if self.steps and self.steps[-1][0] == RUN and self.steps[-1][3] == kind:
            op, size, count, _, first = self.steps[-1]
            if first + count == column:
                self.steps[-1] = (op, size, count + 1, kind, first)
                return
        self._step(RUN, SIZES[kind], 1, kind, column)


class MessageError(Exception):
    """A message of a batch, by its `index`, is not what its type says."""

    def __init__(self, batch: Batch, index: int, reason: str) -> None:
        super().__init__(reason)
        self.channel, self.index, self.reason = batch.channel, index, reason


@dataclass(frozen=True, kw_only=True)
class CompiledDecoder:
    """Decode batches of one channel by steps (s, 5) and picks (p, 2), as the kernel takes them, in any thread."""

    fields: tuple[str, ...]
    is_cdr: bool
    has_header: bool
    steps: StampArray
    picks: StampArray

    def __call__(self, batch: Batch) -> Series:
        """Decode a batch; raise MessageError for the first message that is not as its type says."""
        values = np.empty((batch.count, len(self.fields)))
        stamps = np.empty(batch.count, dtype=np.int64)
        bits = np.empty(1, dtype=np.uint32)
        out = (values, values.view(np.uint64), bits, bits.view(np.float32))
        found, loops = np.zeros(1, dtype=np.int64), np.empty((MAX_DEPTH, 2), dtype=np.int64)
        code, room = FRAMES_FULL, 32
        while code == FRAMES_FULL:
            room *= 2
            frames = np.empty((room, 2), dtype=np.int64)
            code, index, at = run_program(
                batch.data,
                batch.starts,
                batch.sizes,
                self.is_cdr,
                self.steps,
                self.picks,
                out,
                stamps,
                frames,
                found,
                loops,
            )
        if code != FINE:
            raise MessageError(batch, index, fault(code, at, batch, index))
        return Series(
            channel=batch.channel,
            fields=self.fields,
            log_ns=batch.log_ns.copy(),
            stamp_ns=stamps if self.has_header else None,
            frame_ids=tuple({name_at(batch, *frame): None for frame in frames[: found[0]].tolist()}),
            values=values,
        )


def build_program(channel: Channel, wanted: Wanted) -> CompiledDecoder | None:
    """Compile what is wanted of a ROS type, None where the kernel cannot do it; raise LogError where nothing could."""
    if channel.encoding not in ROS_ENCODINGS:
        return None
    types = needed_types(channel)
    root = _Node()
    for column, path in enumerate(wanted.fields):
        node = root.node_at(parse_path(path))
        if node.column is not None:
            raise LogError(f"{path} of topic {channel.topic} is wanted twice; name it once.")
        node.column = column
    if wanted.header:
        header = root.node_at(parse_path(wanted.header))
        if header.inside or header.column is not None:
            return None
        header.is_header = True
    compiler = _Compiler(channel, types)
    try:
        compiler.add_struct(channel.type_name, root, 0)
    except _NotKnownError:
        return None
    return CompiledDecoder(
        fields=wanted.fields,
        is_cdr=channel.encoding == "cdr",
        has_header=bool(wanted.header),
        steps=np.array(compiler.steps, dtype=np.int64).reshape(-1, 5),
        picks=np.array(compiler.picks, dtype=np.int64).reshape(-1, 2),
    )


def fault(code: int, at: int, batch: Batch, index: int) -> str:
    """Say what a kernel found in a message."""
    start, size = int(batch.starts[index]), int(batch.sizes[index])
    head = batch.data[start : start + min(4, size)].tobytes().hex(" ")
    return _REASONS[code].format(at=at, size=size, head=head)


def name_at(batch: Batch, place: int, length: int) -> str:
    """Return the name at a place in the data of a batch; raise MessageError if it is no text."""
    try:
        return batch.data[place : place + length].tobytes().decode()
    except UnicodeDecodeError as error:
        index = int(np.flatnonzero((batch.starts <= place) & (place <= batch.starts + batch.sizes))[0])
        raise MessageError(batch, index, f"a frame name is no text: {error}") from error
