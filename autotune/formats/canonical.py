"""Plain trees and their canonical bytes, on which the checksum of a file rests."""

import json
import math
import struct
from collections.abc import Mapping, Sequence
from hashlib import sha256
from numbers import Integral, Real
from os import PathLike, fspath
from typing import Any

from problems.errors import ParameterError

LARGEST_INTEGER = 2**53
"""Whole numbers up to here are the same number for every reader, those that only know doubles included."""

DEEPEST = 32
"""Levels of lists and mappings that a file may hold."""

Place = tuple[str | int, ...]
"""Where an entry stands in a tree: keys of mappings and indices of lists, from the top."""


def spell(place: Place) -> str:
    """Return a place as text, such as `axes.x.mass` or `payload.com_m[2]`."""
    spelled = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place)
    return spelled.lstrip(".") or "the file"


def plain(value: object, name: str = "tree", depth: int = 0) -> Any:
    """Copy `value` as dict, list, str, bool, int, float and None only; `name` is the path for messages.

    Numpy scalars become Python numbers, enumerations and paths their text, tuples and arrays lists.

    Raises ParameterError: a number is not finite or too large, or something has no plain form.
    """
    if depth > DEEPEST:
        raise ParameterError(name, "...", f"nested at most {DEEPEST} levels deep")
    if isinstance(value, Mapping):
        return {_key(key, name): plain(item, f"{name}.{key}", depth + 1) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist(), name, depth)
    if isinstance(value, Sequence) and not isinstance(value, str | bytes | bytearray):
        return [plain(item, f"{name}[{index}]", depth + 1) for index, item in enumerate(value)]
    return _plain_scalar(value, name)


def _plain_scalar(value: object, name: str) -> str | bool | int | float | None:
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, PathLike):
        return str(fspath(value))
    if isinstance(value, Real):
        return _plain_number(value, name)
    raise ParameterError(name, value, "text, a number, a list or a mapping")


def _key(key: object, name: str) -> str:
    if not isinstance(key, str):
        raise ParameterError(name, key, "a mapping whose keys are text")
    return str.__str__(key)


def _plain_number(value: Real, name: str) -> int | float:
    if isinstance(value, Integral):
        if abs(int(value)) > LARGEST_INTEGER:
            raise ParameterError(name, int(value), "at most 2^53 in magnitude")
        return int(value)
    if not math.isfinite(value):
        raise ParameterError(name, float(value), "finite")
    return float(value)


def canonical_bytes(tree: object) -> bytes:
    r"""Return the one byte sequence that stands for the content of a plain tree.

    JSON without white space, with keys sorted by code point and text in ASCII with `\uXXXX` escapes; every number,
    whole or not, is the 16 hexadecimal digits of its big-endian IEEE 754 double. So layout, order of keys, comments,
    `10` or `10.0` do not matter, and every bit of every number does.
    """
    return _canonical(tree).encode("ascii")


def _canonical(value: object) -> str:
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{json.dumps(key)}:{_canonical(value[key])}" for key in sorted(value)) + "}"
    if isinstance(value, list):
        return "[" + ",".join(_canonical(item) for item in value) + "]"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return struct.pack(">d", value).hex()
    return json.dumps(value)


def checksum(tree: Mapping[str, object]) -> str:
    """Return the sha256 (64 hexadecimal digits) of the canonical bytes of everything but the key `checksum`."""
    return sha256(canonical_bytes({key: value for key, value in tree.items() if key != "checksum"})).hexdigest()


def short(digest: str) -> str:
    """Return the first 8 characters of a checksum, for people to compare."""
    return digest[:8]
