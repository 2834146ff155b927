"""Extract every transform from a batch of `tf2_msgs/TFMessage` or `geometry_msgs/TransformStamped`.

A transform is a header, the name of the child frame and seven doubles: translation x y z and rotation x y z w. A
TFMessage is a sequence of them. Every access is checked against the end of the message.
"""

import numpy as np
from numpy.typing import NDArray

from problems.compiled import inlined, unlocked

from ...signals.recording import StampArray
from ..containers.channel import ByteArray
from .kernel_bytes import FINE, FRAMES_FULL, LEFT_OVER, TOO_SHORT, aligned, bits64, opened, same, stamp, text, u32

# Columns of pairs, and entries of `found`.
PARENT, PARENT_BYTES, CHILD, CHILD_BYTES = 0, 1, 2, 3
PAIRS, TRANSFORMS = 0, 1
NUMBERS = 7
SMALLEST_BYTES = 72
"""A transform takes at least this: stamp, two names of no characters, seven doubles."""
_PADDING_BYTES = 3


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
    row = found[TRANSFORMS]
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
    found[TRANSFORMS] = row + 1
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
    found[TRANSFORMS] = 0
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
            message_of[found[TRANSFORMS]] = row
            code, at = _transform(data, at, end, origin, is_cdr, is_big, bits, stamps, pair_of, pairs, found)
            count -= 1
        if code == FINE and end - at > (_PADDING_BYTES if is_cdr else 0):
            code = LEFT_OVER
        if code != FINE:
            return code, row, at - begin
    return FINE, starts.size, 0
