"""Whole numbers out of bytes of either order, for compiled kernels.

Positions become unsigned first: with them the compiler sees one load where eight bytes are put together, with signed
ones it sees eight loads and asks at each whether the index counts from the end.
"""

import numpy as np

from problems.compiled import inlined

from .channel import ByteArray

_1, _2, _3, _4, _8, _16, _24, _32 = (np.uint64(value) for value in (1, 2, 3, 4, 8, 16, 24, 32))


@inlined
def little16(data: ByteArray, at: int) -> np.uint64:
    """Return 2 bytes, the lowest first."""
    place = np.uint64(at)
    return np.uint64(data[place]) | np.uint64(data[place + _1]) << _8


@inlined
def little32(data: ByteArray, at: int) -> np.uint64:
    """Return 4 bytes, the lowest first."""
    place = np.uint64(at)
    low = np.uint64(data[place]) | np.uint64(data[place + _1]) << _8
    return low | np.uint64(data[place + _2]) << _16 | np.uint64(data[place + _3]) << _24


@inlined
def little64(data: ByteArray, at: int) -> np.uint64:
    """Return 8 bytes, the lowest first."""
    place = np.uint64(at)
    return little32(data, place) | little32(data, place + _4) << _32  # type: ignore[arg-type]


@inlined
def big32(data: ByteArray, at: int) -> np.uint64:
    """Return 4 bytes, the highest first."""
    place = np.uint64(at)
    high = np.uint64(data[place]) << _24 | np.uint64(data[place + _1]) << _16
    return high | np.uint64(data[place + _2]) << _8 | np.uint64(data[place + _3])


@inlined
def u16(data: ByteArray, at: int) -> int:
    """Return an unsigned number of 2 bytes, the lowest first."""
    return int(np.int64(little16(data, at)))


@inlined
def u32(data: ByteArray, at: int) -> int:
    """Return an unsigned number of 4 bytes, the lowest first."""
    return int(np.int64(little32(data, at)))


@inlined
def u64(data: ByteArray, at: int) -> int:
    """Return a number of 8 bytes, the lowest first; 2^63 and more come out negative, as no length or time is."""
    return int(np.int64(little64(data, at)))
