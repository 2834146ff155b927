"""Check a tree against what the controller's schema uses of JSON Schema, where there is no library that does."""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from problems.frozen import FrozenDict

Place = tuple[str | int, ...]
Schema = Mapping[str, Any]


@dataclass(frozen=True, kw_only=True)
class BrokenRule:
    """A rule that an entry breaks, in the form that `autotune.formats.schema.explain` reads."""

    absolute_path: Place
    validator: str
    validator_value: Any
    instance: Any
    schema: Schema


def breaches(tree: object, schema: Schema) -> Iterator[BrokenRule]:
    """Yield every rule of `schema` (draft 2020-12) that `tree` breaks.

    The keywords are those in `KEYWORDS`; `$ref` leads into the schema's own `$defs` only.
    """
    yield from _breaches(tree, schema, (), schema)


def _breaches(value: Any, schema: Schema, place: Place, root: Schema) -> Iterator[BrokenRule]:
    if "$ref" in schema:
        yield from _breaches(value, root["$defs"][schema["$ref"].removeprefix("#/$defs/")], place, root)
    for rule, limit in schema.items():
        holds = _RULES.get(rule)
        if holds is not None and not holds(value, limit):
            yield BrokenRule(absolute_path=place, validator=rule, validator_value=limit, instance=value, schema=schema)
    if isinstance(value, dict):
        yield from _in_mapping(value, schema, place, root)
    if isinstance(value, list) and "items" in schema:
        for index, item in enumerate(value):
            yield from _breaches(item, schema["items"], (*place, index), root)
    yield from _choices(value, schema, place, root)


def _in_mapping(value: dict[str, Any], schema: Schema, place: Place, root: Schema) -> Iterator[BrokenRule]:
    known = schema.get("properties", {})
    rest = schema.get("additionalProperties", True)
    for key, item in value.items():
        if key in known:
            yield from _breaches(item, known[key], (*place, key), root)
        elif isinstance(rest, dict):
            yield from _breaches(item, rest, (*place, key), root)
    if rest is False and not value.keys() <= known.keys():
        yield BrokenRule(
            absolute_path=place, validator="additionalProperties", validator_value=rest, instance=value, schema=schema
        )


def _choices(value: Any, schema: Schema, place: Place, root: Schema) -> Iterator[BrokenRule]:
    options = schema.get("anyOf")
    if options is not None and all(_is_broken(value, option, root) for option in options):
        yield BrokenRule(absolute_path=place, validator="anyOf", validator_value=options, instance=value, schema=schema)
    if "if" in schema:
        branch = "else" if _is_broken(value, schema["if"], root) else "then"
        yield from _breaches(value, schema.get(branch, {}), place, root)


def _is_broken(value: Any, schema: Schema, root: Schema) -> bool:
    return next(_breaches(value, schema, (), root), None) is not None


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_whole(value: object) -> bool:
    return _is_number(value) and float(value).is_integer()  # type: ignore[arg-type]  # a number, as just seen


_TYPES: Mapping[str, Callable[[Any], bool]] = FrozenDict(
    {
        "array": lambda value: isinstance(value, list),
        "boolean": lambda value: isinstance(value, bool),
        "integer": _is_whole,
        "null": lambda value: value is None,
        "number": _is_number,
        "object": lambda value: isinstance(value, dict),
        "string": lambda value: isinstance(value, str),
    }
)


def _is_of_type(value: object, names: str | list[str]) -> bool:
    return any(_TYPES[name](value) for name in ([names] if isinstance(names, str) else names))


def _is_same(value: object, other: object) -> bool:
    # In Python true is 1, in JSON it is not.
    return isinstance(value, bool) == isinstance(other, bool) and value == other


def _of(kind: type, holds: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    return lambda value, limit: not isinstance(value, kind) or holds(value, limit)


def _bound(holds: Callable[[Any, Any], bool]) -> Callable[[Any, Any], bool]:
    return lambda value, limit: not _is_number(value) or holds(value, limit)


_RULES: Mapping[str, Callable[[Any, Any], bool]] = FrozenDict(
    {
        "type": _is_of_type,
        "const": _is_same,
        "enum": lambda value, options: any(_is_same(value, option) for option in options),
        "minimum": _bound(lambda value, limit: value >= limit),
        "exclusiveMinimum": _bound(lambda value, limit: value > limit),
        "maximum": _bound(lambda value, limit: value <= limit),
        "exclusiveMaximum": _bound(lambda value, limit: value < limit),
        "minItems": _of(list, lambda value, limit: len(value) >= limit),
        "maxItems": _of(list, lambda value, limit: len(value) <= limit),
        "minLength": _of(str, lambda value, limit: len(value) >= limit),
        "pattern": _of(str, lambda value, pattern: re.search(pattern, value) is not None),
        "required": _of(dict, lambda value, keys: value.keys() >= set(keys)),
        "minProperties": _of(dict, lambda value, limit: len(value) >= limit),
    }
)

KEYWORDS = frozenset(_RULES) | {"$ref", "properties", "additionalProperties", "items", "anyOf", "if", "then", "else"}
"""What `breaches` understands; other words of a schema must be such that say nothing about a tree."""
