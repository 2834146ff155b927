"""Decode every message of a batch by running the program of its type over it, compiled.

The program says, step by step, what a message of one type holds: what is skipped, what becomes a column of the
values, what is header. Every access is checked against the end of the message.
"""

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.compiled import inlined, unlocked

from ...signals.recording import StampArray
from ..containers.channel import ByteArray, big32, little32, little64

BOOL, INT8, UINT8, INT16, UINT16, INT32, UINT32, INT64, UINT64, FLOAT32, FLOAT64 = range(11)
KINDS = {
    "bool": BOOL,
    "byte": INT8,
    "char": UINT8,
    "int8": INT8,
    "uint8": UINT8,
    "int16": INT16,
    "uint16": UINT16,
    "int32": INT32,
    "uint32": UINT32,
    "int64": INT64,
    "uint64": UINT64,
    "float32": FLOAT32,
    "float64": FLOAT64,
}
SIZES = (1, 1, 1, 2, 2, 4, 4, 8, 8, 4, 8)
FINE, TOO_SHORT, LEFT_OVER, ENCAPSULATION, TERMINATOR, TOO_FEW, NANOSECONDS, FRAMES_FULL = range(8)
"""What a kernel says of a message."""
BILLION = 1_000_000_000
SKIP, RUN, STAMP, STRING, FRAME, SEQUENCE, PICK, REPEAT, TIMES, END = range(10)
"""What a step does. Its other numbers, as far as it needs them, are size, count, kind and first column.

SKIP and RUN pass over or take `count` numbers of `size` bytes; STAMP takes a time; STRING passes over a text, FRAME
takes it; SEQUENCE passes over numbers behind their count, PICK takes those that `picks` names from the second number
to the third; what is between REPEAT and END is done once per entry of a sequence, or as often as TIMES says
(second number; the first is the step behind END).
"""
MAX_DEPTH = 16
# Columns of a program by what its steps do: of numbers, of the entries of a sequence, of loops.
OP, SIZE, COUNT, KIND, COLUMN = 0, 1, 2, 3, 4
FIRST_PICK, LAST_PICK, ENTRY_KIND = 2, 3, 4
BEHIND, TURNS = 1, 2
# Columns of picks, frames and open loops.
ENTRY, TARGET = 0, 1
PLACE, LENGTH, FRAMES = 0, 1, 0
STEP, LEFT = 0, 1
Out = tuple[FloatArray, NDArray[np.uint64], NDArray[np.uint32], NDArray[np.float32]]
"""Where numbers go: the values, the same memory as bits, and one place to turn 32 bits into a float."""
_PADDING_BYTES = 3


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


@inlined
def _store(data: ByteArray, at: int, kind: int, is_big: bool, row: int, column: int, out: Out) -> None:
    values, bits, word, short = out
    if kind == FLOAT64:
        bits[row, column] = bits64(data, at, is_big)
    else:
        values[row, column] = number(data, at, kind, is_big, word, short)


@inlined
def _numbers(
    data: ByteArray,
    at: int,
    end: int,
    program: StampArray,
    index: int,
    is_big: bool,
    row: int,
    out: Out,
) -> tuple[int, int]:
    size, count = program[index, SIZE], program[index, COUNT]
    kind, column = program[index, KIND], program[index, COLUMN]
    if size * count > end - at:
        return TOO_SHORT, at
    if program[index, OP] == RUN:
        for entry in range(count):
            _store(data, at + size * entry, kind, is_big, row, column + entry, out)
    return FINE, at + size * count


@inlined
def _entries(
    data: ByteArray,
    at: int,
    end: int,
    origin: int,
    is_cdr: bool,
    program: StampArray,
    index: int,
    picks: StampArray,
    is_big: bool,
    row: int,
    out: Out,
) -> tuple[int, int]:
    size, kind = program[index, SIZE], program[index, ENTRY_KIND]
    code, at, count = _count(data, at, end, size, origin, is_cdr, is_big)
    if code != FINE:
        return code, at
    if program[index, OP] == PICK:
        for pick in range(program[index, FIRST_PICK], program[index, LAST_PICK]):
            if picks[pick, ENTRY] >= count:
                return TOO_FEW, at
            _store(data, at + size * picks[pick, ENTRY], kind, is_big, row, picks[pick, TARGET], out)
    return FINE, at + count * size


@inlined
def _count(
    data: ByteArray, at: int, end: int, size: int, origin: int, is_cdr: bool, is_big: bool
) -> tuple[int, int, int]:
    """Return a code, where the entries of a sequence start and how many there are, each of at least `size` bytes."""
    at = aligned(at, 4, origin, is_cdr)
    if end - at < 4:
        return TOO_SHORT, at, 0
    count = u32(data, at, is_big)
    start = at + 4
    if count > 0:
        start = aligned(start, size, origin, is_cdr)
    if count * size > end - start:
        return TOO_SHORT, at, 0
    return FINE, start, count


@inlined
def _note_frame(data: ByteArray, at: int, length: int, frames: StampArray, found: StampArray) -> int:
    """Add a frame name to `frames` unless it is there; the one added last is looked at first."""
    for index in range(found[FRAMES] - 1, -1, -1):
        if frames[index, LENGTH] == length and same(data, frames[index, PLACE], at, length):
            return FINE
    if found[FRAMES] == frames.shape[0]:
        return FRAMES_FULL
    frames[found[FRAMES], PLACE] = at
    frames[found[FRAMES], LENGTH] = length
    found[FRAMES] += 1
    return FINE


@inlined
def _turn(op: int, index: int, depth: int, turns: int, behind: int, loops: StampArray) -> tuple[int, int]:
    """Begin or end a loop; return the next step and how many loops are open."""
    if op != END:
        if turns == 0:
            return behind - 1, depth
        loops[depth, STEP] = index
        loops[depth, LEFT] = turns
        return index, depth + 1
    loops[depth - 1, LEFT] -= 1
    if loops[depth - 1, LEFT] > 0:
        return loops[depth - 1, STEP], depth
    return index, depth - 1


@inlined
def _message(
    data: ByteArray,
    begin: int,
    end: int,
    is_cdr: bool,
    program: StampArray,
    picks: StampArray,
    row: int,
    out: Out,
    stamps: StampArray,
    frames: StampArray,
    found: StampArray,
    loops: StampArray,
) -> tuple[int, int]:
    """Take one message; return a code and the position up to which it came."""
    code, at, is_big = opened(data, begin, end, is_cdr)
    origin, index, depth = at, 0, 0
    while code == FINE and index < program.shape[0]:
        op = program[index, OP]
        if op <= RUN:
            at = aligned(at, program[index, SIZE], origin, is_cdr)
            code, at = _numbers(data, at, end, program, index, is_big, row, out)
        elif op == STAMP:
            code, at, stamps[row] = stamp(data, at, end, origin, is_cdr, is_big)
        elif op <= FRAME:
            code, place, length, at = text(data, at, end, origin, is_cdr, is_big)
            if op == FRAME and code == FINE:
                code = _note_frame(data, place, length, frames, found)
        elif op <= PICK:
            code, at = _entries(data, at, end, origin, is_cdr, program, index, picks, is_big, row, out)
        else:
            turns = program[index, TURNS]
            if op == REPEAT:
                code, at, turns = _count(data, at, end, 1, origin, is_cdr, is_big)
            index, depth = _turn(op, index, depth, turns, program[index, BEHIND], loops)
        index += 1
    if code == FINE and end - at > (_PADDING_BYTES if is_cdr else 0):
        code = LEFT_OVER
    return code, at


@unlocked
def run_program(
    data: ByteArray,
    starts: StampArray,
    sizes: StampArray,
    is_cdr: bool,
    program: StampArray,
    picks: StampArray,
    out: Out,
    stamps: StampArray,
    frames: StampArray,
    found: StampArray,
    loops: StampArray,
) -> tuple[int, int, int]:
    """Fill the values, `stamps` (n,) and `frames` (m, 2): place and length of each different frame name.

    Returns a code, the message it belongs to and the position inside that message; `found` (1,) counts how many frame
    names there are; `loops` (MAX_DEPTH, 2) is room for the loops that are open.
    """
    found[FRAMES] = 0
    for row in range(starts.size):
        begin = starts[row]
        code, at = _message(
            data,
            begin,
            begin + sizes[row],
            is_cdr,
            program,
            picks,
            row,
            out,
            stamps,
            frames,
            found,
            loops,
        )
        if code != FINE:
            return code, row, at - begin
    return FINE, starts.size, 0
