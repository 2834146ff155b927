"""Numbers and texts out of bytes, in either byte order, for compiled kernels; every access is checked by the caller."""

import numpy as np
from numpy.typing import NDArray

from problems.compiled import inlined

from ..containers.byte_order import big32, little32, little64
from ..containers.channel import ByteArray

BOOL, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64, FLOAT32, FLOAT64 = range(11)
SIZES = (1, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8)
FINE, TOO_SHORT, LEFT_OVER, ENCAPSULATION, TERMINATOR, TOO_FEW, NANOSECONDS, FRAMES_FULL = range(8)
"""What a kernel says of a message."""
BILLION = 1_000_000_000


@inlined
def aligned(at: int, size: int, origin: int, is_cdr: bool) -> int:
    """Return the next position that is a multiple of `size` from `origin`; ROS 1 aligns nothing."""
    return origin + ((at - origin + size - 1) & -size) if is_cdr else at


@inlined
def u32(data: ByteArray, at: int, is_big: bool) -> int:
    """Return an unsigned number of 4 bytes."""
    return int(np.int64(big32(data, at) if is_big else little32(data, at)))


@inlined
def bits64(data: ByteArray, at: int, is_big: bool) -> np.uint64:
    """Return 8 bytes as they are."""
    if is_big:
        return big32(data, at) << np.uint64(32) | big32(data, at + 4)
    return little64(data, at)


@inlined
def number(
    data: ByteArray, at: int, kind: int, is_big: bool, bits: NDArray[np.uint32], floats: NDArray[np.float32]
) -> float:
    """Return a primitive number, no float64, as a double; `bits` and `floats` (1,) are two views of the same bytes."""
    if kind == FLOAT32:
        bits[0] = u32(data, at, is_big)
        return float(floats[0])
    if kind == UINT64:
        return float(bits64(data, at, is_big))
    if kind == INT64:
        return float(np.int64(bits64(data, at, is_big)))
    if kind in (INT32, UINT32):
        value, limit = u32(data, at, is_big), 2**31
    elif kind in (INT16, UINT16):
        first, second = np.int64(data[np.uint64(at)]), np.int64(data[np.uint64(at + 1)])
        value, limit = int(first << 8 | second if is_big else second << 8 | first), 2**15
    else:
        value, limit = int(np.int64(data[np.uint64(at)])), 2**7
    if kind == BOOL:
        return 1.0 if value != 0 else 0.0
    if kind in (INT8, INT16, INT32) and value >= limit:
        value -= 2 * limit
    return float(value)


@inlined
def opened(data: ByteArray, begin: int, end: int, is_cdr: bool) -> tuple[int, int, bool]:
    """Return a code, where the content of a message starts and whether it is big-endian."""
    if not is_cdr:
        return FINE, begin, False
    if end - begin < 4:
        return TOO_SHORT, begin, False
    if data[begin] != 0 or data[begin + 1] > 1:
        return ENCAPSULATION, begin, False
    return FINE, begin + 4, data[begin + 1] == 0


@inlined
def text(data: ByteArray, at: int, end: int, origin: int, is_cdr: bool, is_big: bool) -> tuple[int, int, int, int]:
    """Return a code, where the characters of a string start, how many bytes they have, and where the string ends."""
    at = aligned(at, 4, origin, is_cdr)
    if end - at < 4:
        return TOO_SHORT, at, 0, at
    length = u32(data, at, is_big)
    if length > end - at - 4 or (is_cdr and length == 0):
        return TOO_SHORT, at, 0, at
    stop = at + 4 + length
    if not is_cdr:
        return FINE, at + 4, length, stop
    if data[stop - 1] != 0:
        return TERMINATOR, at + 4, 0, stop - 1
    return FINE, at + 4, length - 1, stop


@inlined
def stamp(data: ByteArray, at: int, end: int, origin: int, is_cdr: bool, is_big: bool) -> tuple[int, int, int]:
    """Return a code, where a time ends, and the time in ns; its seconds may be negative."""
    at = aligned(at, 4, origin, is_cdr)
    if end - at < 8:
        return TOO_SHORT, at, 0
    seconds, nanoseconds = u32(data, at, is_big), u32(data, at + 4, is_big)
    if nanoseconds >= BILLION:
        return NANOSECONDS, at + 4, 0
    if seconds >= 2**31:
        seconds -= 2**32
    return FINE, at + 8, seconds * BILLION + nanoseconds


@inlined
def same(data: ByteArray, first: int, second: int, length: int) -> bool:
    """Return whether the bytes at two places are the same."""
    one, other = np.uint64(first), np.uint64(second)
    for offset in range(np.uint64(length)):  # noqa: SIM110 - a compiled kernel has no generators
        if data[one + offset] != data[other + offset]:
            return False
    return True
