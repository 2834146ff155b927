"""Decode messages one by one through libraries: JSON, Protobuf, and ROS types that no compiled program covers."""

import json
import keyword
import struct
from collections.abc import Callable, Collection, Sequence
from functools import cache, reduce
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from ...errors import LogError, listed
from ..containers.channel import Batch, Channel, Container
from .decode import (
    FOREIGN,
    ROS_ENCODINGS,
    JointNames,
    MessageError,
    Series,
    Token,
    Wanted,
    build_program,
    needed_types,
    parse_path,
)

_LIMIT_BYTES = 2**26
_SECONDS, _NANOSECONDS = ("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos")
_BILLION = 10**9
_MOST_PUBLISHERS = 16


def parse_json(data: bytes) -> object:
    """Parse one JSON message of UTF-8 text into mappings, lists, texts and numbers.

    `NaN`, `Infinity` and `-Infinity`, which many writers use though the standard has none, become such numbers: as
    those of any other encoding they are for the checks of a signal to report. Raises LogError for everything else that
    is not JSON, for a key that occurs twice, and for messages that are too large or nested too deeply.
    """
    if len(data) > _LIMIT_BYTES:
        raise LogError(f"A JSON message of {len(data)} bytes is larger than the {_LIMIT_BYTES} that are allowed.")
    try:
        return json.loads(data.decode(), object_pairs_hook=_mapping)
    except UnicodeDecodeError as error:
        raise _refusal(f"it is not UTF-8 text at byte {error.start}") from error
    except json.JSONDecodeError as error:
        raise _refusal(f"{error.msg[:1].lower()}{error.msg[1:]} at character {error.pos}") from error
    except RecursionError as error:
        raise _refusal("it is nested too deeply") from error
    except ValueError as error:
        raise _refusal("it holds a number with too many digits") from error


def _mapping(pairs: Sequence[tuple[str, object]]) -> dict[str, object]:
    tree = dict(pairs)
    if len(tree) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise _refusal(f"the key {twice[:60]!r} occurs twice")
    return tree


def _refusal(reason: str) -> LogError:
    return LogError(f"A JSON message cannot be used: {reason}; correct the writer and record again.")


class ObjectDecoder:
    """Decode batches of one channel of any encoding that is known; may be called in several threads."""

    def __init__(self, channel: Channel, wanted: Wanted) -> None:
        self._parse = build_object_parser(channel)
        # In ROS and Protobuf a boolean is a field like any other; a JSON `true` where a number belongs is a mistake.
        self._number = as_number if channel.encoding != "json" else _as_json_number
        self._paths = [parse_path(path) for path in wanted.fields]
        self._fields = wanted.fields
        self._header = parse_path(wanted.header) if wanted.header else None

    def __call__(self, batch: Batch) -> Series:
        """Decode a batch; raise MessageError for the first message that cannot be decoded or lacks something."""
        values = np.empty((batch.count, len(self._paths)))
        stamps = np.empty(batch.count, dtype=np.int64)
        frames: dict[str, None] = {}
        for index, message in enumerate(messages_of(batch)):
            try:
                thing = self._parse(message)
                for column, path in enumerate(self._paths):
                    values[index, column] = self._number(pick(thing, path))
                if self._header is not None:
                    stamps[index], frame = header_of(thing, self._header)
                    frames[frame] = None
            except (LogError, LackingError) as error:
                raise MessageError(batch, index, str(error).rstrip(".")) from error
        return Series(
            channel=batch.channel,
            fields=self._fields,
            log_ns=batch.log_ns.copy(),
            stamp_ns=None if self._header is None else stamps,
            frame_ids=tuple(frames),
            values=values,
        )


class LackingError(Exception):
    """A message has no such number, header or time."""


def messages_of(batch: Batch) -> list[bytes]:
    """Return the messages of a batch one by one."""
    return [
        batch.data[start : start + size].tobytes()
        for start, size in zip(batch.starts.tolist(), batch.sizes.tolist(), strict=True)
    ]


def strings_block(strings: Sequence[str], message: bytes, encoding: str) -> bytes:
    """Return the bytes of a list of strings as they are in a message like `message`, of ROS 1 or CDR."""
    if encoding == "ros1":
        return struct.pack("<I", len(strings)) + b"".join(
            struct.pack("<I", len(text)) + text for text in (each.encode() for each in strings)
        )
    order = "<" if message[1:2] == b"\1" else ">"
    block = struct.pack(f"{order}I", len(strings))
    for text in (each.encode() + b"\0" for each in strings):
        block += bytes(-len(block) % 4) + struct.pack(f"{order}I", len(text)) + text
    return block


def build_object_parser(channel: Channel) -> Callable[[bytes], object]:
    """Return what turns a message of a channel into an object or dict; raise LogError for unknown encodings."""
    if channel.encoding == "json":
        return parse_json
    if channel.encoding == "protobuf":
        from .protobuf_objects import build_parser  # noqa: PLC0415 - most logs need no Protobuf, which takes 30 ms to start

        return build_parser(channel)
    if channel.encoding not in ROS_ENCODINGS:
        raise LogError(
            f"Topic {channel.topic} holds messages in the encoding {channel.encoding!r}; "
            "cdr, ros1, json and protobuf are read."
        )
    store = _store_for(channel)
    decode = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr

    def parse(data: bytes) -> object:
        try:
            return decode(data, channel.type_name)
        except (SerdeError, LookupError, ValueError, AssertionError, MemoryError, RecursionError, TypeError) as error:
            raise LogError(f"it is no {channel.type_name}: {error}") from error

    return parse


@cache
def _store_for(channel: Channel) -> Typestore:
    """Build a type store from the log's own definition, completed by standard types it leaves out."""
    types = needed_types(channel)
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(types)
    except FOREIGN as error:
        raise LogError(f"The definition of {channel.type_name} in the log cannot be used: {error}.") from error
    return store


def _step(thing: Any, token: Token) -> Any:
    if isinstance(token, int):
        return thing[token]
    if isinstance(thing, dict):
        return thing[token]
    return getattr(thing, f"{token}_" if keyword.iskeyword(token) and hasattr(thing, f"{token}_") else token)


def pick(thing: object, path: tuple[Token, ...]) -> Any:
    """Return what is at a path; raise LackingError where there is nothing."""
    try:
        return reduce(_step, path, thing)
    except (LookupError, TypeError, AttributeError) as error:
        raise LackingError(f"it lacks {_written(path)}") from error


def _written(path: tuple[Token, ...]) -> str:
    return "".join(f"[{token}]" if isinstance(token, int) else f".{token}" for token in path).lstrip(".")


def as_number(value: Any) -> float:
    """Return a number as a double; raise LackingError for anything else."""
    if not isinstance(value, bool | int | float | np.bool_ | np.number):
        raise LackingError(f"{value!r} is no number")
    try:
        return float(value)
    except OverflowError as error:
        raise LackingError(f"a number of {len(str(value))} digits is too large") from error


def _as_json_number(value: Any) -> float:
    if isinstance(value, bool):
        raise LackingError(f"{str(value).lower()} is no number")
    return as_number(value)


def either(thing: Any, names: tuple[str, ...]) -> Any:
    """Return the first of these fields that there is, or None."""
    for name in names:
        try:
            return _step(thing, name)
        except (LookupError, TypeError, AttributeError):
            continue
    return None


def header_of(thing: object, path: tuple[Token, ...]) -> tuple[int, str]:
    """Return stamp in ns and frame name of a header, or of what takes its place: a time beside the numbers."""
    header: Any
    try:
        header = pick(thing, path)
    except LackingError:
        header = thing
    time = either(header, ("stamp", "timestamp"))
    if time is None:
        time = header
    frame = either(header, ("frame_id",))
    if frame is None:
        frame = either(thing, ("frame_id",))
    return _time(time, path), frame if isinstance(frame, str) else ""


def _time(time: object, path: tuple[Token, ...]) -> int:
    seconds, nanoseconds = either(time, _SECONDS), either(time, _NANOSECONDS)
    if not _is_whole(seconds) or not _is_whole(nanoseconds):
        raise LackingError(f"it has no {_written(path)} with a stamp, nor a timestamp, of seconds and nanoseconds")
    if not 0 <= int(nanoseconds) < _BILLION:
        raise LackingError(f"its stamp has a second of {nanoseconds} ns")
    total = int(seconds) * _BILLION + int(nanoseconds)
    if not -(2**63) <= total < 2**63:
        raise LackingError(f"its stamp of {seconds} s is out of range")
    return total


def _is_whole(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def joint_names(container: Container, channel: Channel, needed: Collection[str], log: str) -> JointNames:
    """Return the names in those messages of a channel of joint states that hold the joints that are needed.

    Arm and gripper may publish in turn. Raises LogError where joints that are needed are named in several ways.
    """
    parse = build_object_parser(channel)
    kinds: dict[bytes, tuple[str, ...]] = {}

    def look(batch: Batch) -> int:
        for message in messages_of(batch):
            if not any(block in message for block in kinds) and len(kinds) < _MOST_PUBLISHERS:
                names = tuple(getattr(parse(message), "name", ()))
                kinds[strings_block(names, message, channel.encoding)] = names
        return batch.count

    for _ in container.read((channel,), look):
        pass
    having = [(block, names) for block, names in kinds.items() if {*needed} <= {*names}]
    if len(having) > 1:
        raise LogError(
            f"Topic {channel.topic} of {log} must name the joints {listed(sorted(needed))} in one "
            f"order, found {len(having)}: several robots publish on it; record each on a topic of its own."
        )
    block, names = having[0] if having else next(iter(kinds.items()))
    return JointNames(names=names, only=block if len(kinds) > 1 else b"")


def build_decoder(channel: Channel, wanted: Wanted) -> Callable[[Batch], Series]:
    """Return what decodes batches of a channel; raise LogError where its type has no such numbers."""
    return build_program(channel, wanted) or ObjectDecoder(channel, wanted)
