"""Plain trees: their canonical bytes, on which the checksum of a file rests, and their text as YAML and JSON."""

import io
import json
import math
import re
import struct
from collections.abc import Mapping, Sequence
from hashlib import sha256
from numbers import Integral, Real
from os import PathLike, fspath
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.nodes import ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter

from problems.errors import ParameterError

LARGEST_INTEGER = 2**53
"""Whole numbers up to here are the same number for every reader, those that only know doubles included."""

DEEPEST = 32
"""Levels of lists and mappings that a file may hold."""

Place = tuple[str | int, ...]
"""Where an entry is in a tree: keys of mappings and indices of lists, from the top."""


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
    r"""Return the one byte sequence that represents the content of a plain tree.

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


_LONGEST_FLOW_LIST = 12
_WIDTH = 2**24
_SURELY_TEXT = re.compile(r"[A-Za-z_][A-Za-z0-9_/.+-]*( [A-Za-z0-9_/.+-]+)*")
_WORDS = frozenset({"yes", "no", "on", "off", "true", "false", "null", "nan", "inf", "infinity"})
"""Plain words that YAML 1.1, or a careless reader, takes for something other than text."""


class _Representer(SafeRepresenter):
    """Quotes whatever another parser could take for something else; repeats shared parts instead of naming them."""

    def ignore_aliases(self, data: Any) -> bool:
        del data
        return True

    def text(self, data: str) -> ScalarNode:
        is_safe = _SURELY_TEXT.fullmatch(data) is not None and data.lower() not in _WORDS
        return self.represent_scalar("tag:yaml.org,2002:str", data, style=None if is_safe else '"')

    def number(self, data: float) -> ScalarNode:
        return self.represent_scalar("tag:yaml.org,2002:float", number_text(data))

    def items(self, data: list[Any]) -> SequenceNode:
        is_flow = len(data) <= _LONGEST_FLOW_LIST and not any(_is_block(item) for item in data)
        return self.represent_sequence("tag:yaml.org,2002:seq", data, flow_style=is_flow)


_Representer.add_representer(str, _Representer.text)
_Representer.add_representer(float, _Representer.number)
_Representer.add_representer(list, _Representer.items)


def _is_block(item: object) -> bool:
    return isinstance(item, dict) or (isinstance(item, list) and any(isinstance(part, dict | list) for part in item))


def number_text(number: float) -> str:
    """Return the shortest decimal that reads back to the same double, with a point: `1.0e-05`, not `1e-05`."""
    text = repr(number)
    return text if "." in text else text.replace("e", ".0e")


def lines_to_paste(tree: Mapping[str, object]) -> tuple[str, ...]:
    """Return a part of a file as lines of YAML that are pasted into it, one for each of its keys."""
    return tuple(f"{key}: {_flow(value)}" for key, value in tree.items())


def place_to_paste(tree: Mapping[str, object]) -> str:
    """Say where those lines belong in a file that has their keys already: twice the same key is refused."""
    return f"(where it has {' or '.join(map(str, tree))} already, into that)"


def _flow(value: object) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(lines_to_paste(value))}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_flow, value))}]"
    return number_text(value) if isinstance(value, float) else str(value)


def dump_yaml(tree: Mapping[str, object]) -> str:
    """Return `tree` as YAML, keys in the given order, numbers exact to the last bit, short lists on one line.

    Raises ParameterError: a number is not finite, or something has no plain form.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Representer = _Representer
    yaml.default_flow_style = False
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]  # annotated by its default alone
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.width = _WIDTH
    stream = io.StringIO()
    yaml.dump(plain(tree), stream)
    return stream.getvalue()


def dump_json(tree: Mapping[str, object]) -> str:
    """Return `tree` as indented ASCII JSON, keys in the given order, numbers exact to the last bit.

    Raises ParameterError: a number is not finite, or something has no plain form.
    """
    text = json.dumps(plain(tree), indent=2, allow_nan=False)
    return text.replace("\x7f", "\\u007f") + "\n"
