"""Transforms between frames: of all that a topic holds, those of one pair of frames.

A transform is a header, the name of the child frame and seven doubles: translation x y z and rotation x y z w. A
TFMessage is a sequence of them. In the kernel every access is checked against the end of the message.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from problems.arrays import FloatArray
from problems.compiled import inlined, unlocked

from ...errors import LogError
from ...signals.recording import StampArray
from ..containers.channel import Batch, ByteArray, Channel
from .decode import (
    ROS_ENCODINGS,
    MessageError,
    Series,
    fault,
    name_at,
    needed_types,
    parse_path,
    standard_types,
)
from .kernel import FINE, FRAMES_FULL, LEFT_OVER, TOO_SHORT, aligned, bits64, opened, same, stamp, text, u32
from .objects import LackingError, as_number, build_object_parser, either, header_of, messages_of, pick

TRANSFORM = "geometry_msgs/msg/TransformStamped"
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
FIELDS = tuple(f"translation.{axis}" for axis in "xyz") + tuple(f"rotation.{axis}" for axis in "xyzw")
Pair = tuple[str, str]
# Columns of pairs, and entries of `found`.
PARENT, PARENT_BYTES, CHILD, CHILD_BYTES = 0, 1, 2, 3
PAIRS, TAKEN = 0, 1
NUMBERS = 7
SMALLEST_BYTES = 72
"""A transform takes at least this: stamp, two names of no characters, seven doubles."""
_PADDING_BYTES = 3


@dataclass(frozen=True, kw_only=True)
class _Found:
    """The transforms of a batch (m,): message, stamp, pair of frames by its number, numbers (m, 7)."""

    message_of: StampArray
    stamp_ns: StampArray
    pair_of: StampArray
    pairs: tuple[Pair, ...]
    values: FloatArray


@dataclass(frozen=True, kw_only=True)
class TransformDecoder:
    """Decode batches of transforms and keep those of one pair of frames; may be called in several threads."""

    find: Callable[[Batch], _Found]
    wanted: Pair | None
    pairs: set[Pair] = field(default_factory=set)

    def __call__(self, batch: Batch) -> Series:
        """Decode a batch; raise MessageError for the first message that is not as its type says."""
        found = self.find(batch)
        self.pairs.update(found.pairs)
        chosen = np.zeros(found.pair_of.size, dtype=bool)
        if self.wanted in found.pairs:
            chosen = found.pair_of == found.pairs.index(self.wanted)
        return Series(
            channel=batch.channel,
            fields=FIELDS,
            log_ns=batch.log_ns[found.message_of[chosen]],
            stamp_ns=found.stamp_ns[chosen],
            frame_ids=(self.wanted[0],) if self.wanted is not None and chosen.any() else (),
            values=found.values[chosen],
        )


def build_transform_decoder(channel: Channel, wanted: Pair | None) -> TransformDecoder:
    """Return what decodes batches of transforms and keeps those of one pair, or of none to find out the pairs."""
    if channel.type_name not in (TRANSFORM, *TRANSFORMS):
        raise LogError(f"Topic {channel.topic} holds {channel.type_name}, no transforms; name one of type TFMessage.")
    if channel.encoding in ROS_ENCODINGS and _has_standard_layout(channel):
        return TransformDecoder(find=_find_compiled, wanted=wanted)
    parse = build_object_parser(channel)
    return TransformDecoder(find=lambda batch: _find_objects(batch, parse), wanted=wanted)


def _has_standard_layout(channel: Channel) -> bool:
    if channel.type_name == TRANSFORM:
        return _is_standard(channel)
    types = needed_types(channel)
    descriptions = [description for _, description in types[channel.type_name][1]]
    below = Channel(
        topic=channel.topic,
        type_name=TRANSFORM,
        encoding=channel.encoding,
        schema_encoding="",
        schema=b"",
    )
    return descriptions == [(Nodetype.SEQUENCE, ((Nodetype.NAME, TRANSFORM), 0))] and all(
        types[name][1] == fields[1] for name, fields in needed_types(below).items()
    )


def _is_standard(channel: Channel) -> bool:
    """Return whether the log's own definition, if there is one, has the fields of the standard type."""
    known = standard_types(channel.encoding).fielddefs
    try:
        types = needed_types(channel)
    except LogError:
        return False
    return all(
        name in known and [tuple(field) for field in known[name][1]] == [tuple(field) for field in fields]
        for name, (_, fields) in types.items()
    )


def _find_compiled(batch: Batch) -> _Found:
    room = int(batch.sizes.sum()) // SMALLEST_BYTES + 1
    values = np.empty((room, NUMBERS))
    stamps, message_of, pair_of = np.empty((3, room), dtype=np.int64)
    found = np.zeros(2, dtype=np.int64)
    code, pair_room = FRAMES_FULL, 32
    while code == FRAMES_FULL:
        pair_room *= 2
        pairs = np.empty((pair_room, 4), dtype=np.int64)
        code, index, at = take_transforms(
            batch.data,
            batch.starts,
            batch.sizes,
            batch.channel.encoding == "cdr",
            batch.channel.type_name != TRANSFORM,
            values.view(np.uint64),
            stamps,
            message_of,
            pair_of,
            pairs,
            found,
        )
    if code != FINE:
        raise MessageError(batch, index, fault(code, at, batch, index))
    pair_count, count = found.tolist()
    return _Found(
        message_of=message_of[:count],
        stamp_ns=stamps[:count],
        pair_of=pair_of[:count],
        pairs=tuple(
            (name_at(batch, place[0], place[1]), name_at(batch, place[2], place[3]))
            for place in pairs[:pair_count].tolist()
        ),
        values=values[:count],
    )


def _find_objects(batch: Batch, parse: Callable[[bytes], object]) -> _Found:
    rows: list[tuple[int, int, int, list[float]]] = []
    pairs: dict[Pair, int] = {}
    for index, message in enumerate(messages_of(batch)):
        try:
            for stamp_ns, pair, numbers in _transforms_of(parse(message)):
                rows.append((index, stamp_ns, pairs.setdefault(pair, len(pairs)), numbers))
        except (LogError, LackingError) as error:
            raise MessageError(batch, index, str(error).rstrip(".")) from error
    return _Found(
        message_of=np.array([row[0] for row in rows], dtype=np.int64),
        stamp_ns=np.array([row[1] for row in rows], dtype=np.int64),
        pair_of=np.array([row[2] for row in rows], dtype=np.int64),
        pairs=tuple(pairs),
        values=np.array([row[3] for row in rows], dtype=np.float64).reshape(-1, NUMBERS),
    )


def _transforms_of(thing: Any) -> Iterator[tuple[int, Pair, list[float]]]:
    several = either(thing, ("transforms",))
    for each in [thing] if several is None else several:
        stamp_ns, parent = header_of(each, ("header",))
        child = pick(each, ("child_frame_id",))
        if not isinstance(child, str):
            raise LackingError(f"{child!r} is no name of a frame")
        numbers = [as_number(pick(each, ("transform", *parse_path(path)))) for path in FIELDS]
        yield stamp_ns, (parent, child), numbers


@inlined
def _note_pair(
    data: ByteArray, parent: int, parent_bytes: int, child: int, child_bytes: int, pairs: StampArray, found: StampArray
) -> int:
    """Return the number of a pair of frame names, added to `pairs` unless it is there, or -1 where there is no room."""
    for index in range(found[PAIRS]):
        if (
            pairs[index, PARENT_BYTES] == parent_bytes
            and pairs[index, CHILD_BYTES] == child_bytes
            and same(data, pairs[index, PARENT], parent, parent_bytes)
            and same(data, pairs[index, CHILD], child, child_bytes)
        ):
            return index
    if found[PAIRS] == pairs.shape[0]:
        return -1
    index = found[PAIRS]
    pairs[index, PARENT] = parent
    pairs[index, PARENT_BYTES] = parent_bytes
    pairs[index, CHILD] = child
    pairs[index, CHILD_BYTES] = child_bytes
    found[PAIRS] += 1
    return int(index)


@inlined
def _transform(
    data: ByteArray,
    at: int,
    end: int,
    origin: int,
    is_cdr: bool,
    is_big: bool,
    bits: NDArray[np.uint64],
    stamps: StampArray,
    pair_of: StampArray,
    pairs: StampArray,
    found: StampArray,
) -> tuple[int, int]:
    """Take the transform at `at`; return a code and where it ends."""
    row = found[TAKEN]
    if not is_cdr:
        at += 4  # the sequence number of a ROS 1 header
    code, at, stamp_ns = stamp(data, at, end, origin, is_cdr, is_big)
    if code != FINE:
        return code, at
    code, parent, parent_bytes, at = text(data, at, end, origin, is_cdr, is_big)
    if code != FINE:
        return code, at
    code, child, child_bytes, at = text(data, at, end, origin, is_cdr, is_big)
    if code != FINE:
        return code, at
    at = aligned(at, 8, origin, is_cdr)
    if end - at < 8 * NUMBERS:
        return TOO_SHORT, at
    for index in range(NUMBERS):
        bits[row, index] = bits64(data, at + 8 * index, is_big)
    stamps[row] = stamp_ns
    pair_of[row] = _note_pair(data, parent, parent_bytes, child, child_bytes, pairs, found)
    found[TAKEN] = row + 1
    return FRAMES_FULL if pair_of[row] < 0 else FINE, at + 8 * NUMBERS


@unlocked
def take_transforms(
    data: ByteArray,
    starts: StampArray,
    sizes: StampArray,
    is_cdr: bool,
    is_sequence: bool,
    bits: NDArray[np.uint64],
    stamps: StampArray,
    message_of: StampArray,
    pair_of: StampArray,
    pairs: StampArray,
    found: StampArray,
) -> tuple[int, int, int]:
    """Fill `bits` (m, 7), `stamps`, `message_of` and `pair_of` (m,) and `pairs` (p, 4): places and lengths of names.

    `found` (2,) counts pairs and transforms. Returns a code, the message it belongs to and the position inside it.
    """
    found[PAIRS] = 0
    found[TAKEN] = 0
    for row in range(starts.size):
        begin = starts[row]
        end = begin + sizes[row]
        code, at, is_big = opened(data, begin, end, is_cdr)
        origin, count = at, 1
        if code == FINE and is_sequence:
            if end - at < 4:
                return TOO_SHORT, row, at - begin
            count = u32(data, at, is_big)
            at += 4
            if count * SMALLEST_BYTES > end - at:
                return TOO_SHORT, row, at - begin
        while code == FINE and count > 0:
            at = aligned(at, 4, origin, is_cdr)
            message_of[found[TAKEN]] = row
            code, at = _transform(data, at, end, origin, is_cdr, is_big, bits, stamps, pair_of, pairs, found)
            count -= 1
        if code == FINE and end - at > (_PADDING_BYTES if is_cdr else 0):
            code = LEFT_OVER
        if code != FINE:
            return code, row, at - begin
    return FINE, starts.size, 0
