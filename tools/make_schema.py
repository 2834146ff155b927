"""Make the JSON Schemas of the files that the tool writes, and of cell.yaml, from their records: types and `Rule`s.

What has no default is required, and null is allowed where nothing else says that there is none. A number that is named
like a parameter of the plant has the bounds of `PARAMETER_BOUNDS` unless it has a rule of its own.
"""

import dataclasses
import json
import types
from collections.abc import Mapping
from enum import Enum
from functools import reduce
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from autotune.formats import cell, controller, identified, plan, schedule
from autotune.formats.certificate_record import PARAMETER_BOUNDS
from autotune.formats.controller_record import Controller
from autotune.formats.records import ROTATIONAL_KEYS
from autotune.formats.schema import VERSION
from autotune.formats.units import ROTATIONAL_AXES
from autotune.studies import pareto_file
from identification.logs.roles.cell import Cell
from identification.result import Identified
from problems.frozen import NO_ENTRY, Rule

Node = dict[str, Any]
_TYPES = {float: "number", int: "integer", bool: "boolean", str: "string", Path: "string", types.NoneType: "null"}
_RECORD, _WIDTH = "$record", 110
_CHECKSUM: Node = {"description": "64 hexadecimal digits", "type": "string", "pattern": "^[0-9a-f]{64}$"}
_PROVENANCE: Node = {"type": "object"}


def controller_schema() -> Node:
    """Return the schema of `controller.yaml`."""
    title = "A tuned admittance controller and its certificate"
    return _file(Controller, controller.FORMAT, title, {"checksum": _CHECKSUM})


def identified_schema() -> Node:
    """Return the schema of `identified.yaml`."""
    return _file(Identified, identified.FORMAT, "Plant parameters identified from logs", {"provenance": _PROVENANCE})


def schedule_schema() -> Node:
    """Return the schema of `schedule.yaml`."""
    title, last = "A table of controllers over payload and surface classes", {"provenance": _PROVENANCE}
    return _file(schedule.ScheduleTable, schedule.FORMAT, title, {**last, "checksum": _CHECKSUM})


def pareto_schema() -> Node:
    """Return the schema of `pareto.yaml`."""
    title = "Controllers that no other one beats"
    return _file(pareto_file.ParetoTable, pareto_file.FORMAT, title, {"provenance": _PROVENANCE})


def plan_schema() -> Node:
    """Return the schema of `plan.yaml`."""
    return _file(plan.PlanTable, plan.FORMAT, "What to record next", {"provenance": _PROVENANCE})


def cell_schema() -> Node:
    """Return the schema of `cell.yaml`."""
    return _file(Cell, cell.FORMAT, "What the logs of a cell cannot say of themselves; every entry is optional", {})


def _file(record: type, name: str, title: str, last: Node) -> Node:
    """Return the schema of a file that holds a record, and `last` behind it."""
    definitions: dict[str, Node] = {}
    node = _record(record, turning=False)
    first = {"format": {"const": name}, "version": {"const": VERSION}}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"urn:autotune:schema:{name.partition('/')[2]}:{VERSION}",
        "title": f"{title} ({name}, version {VERSION})",
        "type": "object",
        "properties": {**first, **_with_references(node["properties"], definitions), **last},
        "required": [*first, *node["required"], *last],
        "additionalProperties": False,
        "$defs": dict(sorted(definitions.items())),
    }


def _record(record: type, *, turning: bool) -> Node:
    hints = get_type_hints(record, include_extras=True)
    properties, required = dict[str, Node](), list[str]()
    # What is not compared is not written either (`autotune.formats.records`).
    for field in (each for each in dataclasses.fields(record) if each.compare):
        has_default = not field.default is field.default_factory is dataclasses.MISSING
        hint, turns = hints[field.name], turning or field.name.startswith("rotational_")
        node = _node(_without_none(hint) if has_default else hint, field.name, turning=turns)
        if node is not None:
            properties[field.name] = _renamed(node) if turns and not turning else node
            required += [] if has_default else [field.name]
    found: Node = {_RECORD: record.__name__, "type": "object", "properties": properties}
    return {**found, "required": required, "additionalProperties": False, **getattr(record, "RULE", {})}


def _node(hint: Any, name: str = "", *, turning: bool) -> Node | None:
    """Return the schema of a type, None where there is no such entry; `name` is that of the number."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        rules = arguments[1:]
        if NO_ENTRY in rules or (turning and any(rule.get("turning", rule) is None for rule in rules)):
            return None
        return reduce(_merged, (_words(rule, turning=turning) for rule in rules), _inner(arguments[0], turning=turning))
    if origin in (types.UnionType, Union):
        return _union([_inner(each, name, turning=turning) for each in arguments])
    if origin is tuple:
        size = {} if arguments[-1] is Ellipsis else {"minItems": len(arguments), "maxItems": len(arguments)}
        kinds: Any = Union[tuple(each for each in arguments if each is not Ellipsis)]  # noqa: UP007 - of a tuple
        return {"type": "array", "items": _inner(kinds, name, turning=turning), **size}
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return _mapping(*arguments, turning=turning)
    return _single(hint, name, turning=turning)


def _inner(hint: Any, name: str = "", *, turning: bool) -> Node:
    return _node(hint, name, turning=turning) or {}


def _single(hint: Any, name: str, *, turning: bool) -> Node:
    """Return the schema of a record, a number, a text, one of some words, or anything."""
    if hint is Any:
        return {}
    if get_origin(hint) is Literal:
        return {"enum": list(get_args(hint))}
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return _record(hint, turning=turning)
    if issubclass(hint, Enum):
        return {"enum": [each.value for each in hint]}
    bounds = _words(PARAMETER_BOUNDS.get(name, Rule()), turning=turning) if hint is float else {}
    return {"type": _TYPES[hint], **bounds}


def _words(rule: Rule, *, turning: bool) -> Node:
    words = {_RECORD if key == "record" else key: each for key, each in rule.items() if key != "turning"}
    return _merged(words, rule.get("turning", {})) if turning else words


def _mapping(key: Any, value: Any, *, turning: bool) -> Node:
    """Return a mapping of the names that the type of its keys lists, or of any names."""
    if get_origin(key) is not Annotated:
        inside = _node(value, turning=turning)
        return {"type": "object", **({"additionalProperties": inside} if inside else {})}
    properties = {}
    for name in get_args(key)[1]["enum"]:
        turns = name in ROTATIONAL_AXES
        node = _node(value, name, turning=turning or turns)
        properties[name] = _renamed(node) if turns else node
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _union(nodes: list[Node]) -> Node:
    """Return what may be any of several types: numbers, texts and the like as one, records each for itself."""
    simple, records = [each for each in nodes if _RECORD not in each], [each for each in nodes if _RECORD in each]
    kinds = [each["type"] for each in simple]
    words = {key: value for each in simple for key, value in each.items() if key != "type"}
    together = [{"type": kinds[0] if len(kinds) == 1 else kinds, **words}] if simple else []
    choices = [*together, *records]
    return choices[0] if len(choices) == 1 else {"anyOf": choices}


def _without_none(hint: Any) -> Any:
    if get_origin(hint) is Annotated:
        return Annotated[(_without_none(get_args(hint)[0]), *get_args(hint)[1:])]
    if get_origin(hint) not in (types.UnionType, Union):
        return hint
    return Union[tuple(each for each in get_args(hint) if each is not types.NoneType)]  # noqa: UP007 - of a tuple


def _merged(node: Node, words: Mapping[str, Any]) -> Node:
    inner = {key: _merged(node[key], each) for key, each in words.items() if isinstance(each, dict) and key in node}
    return {**node, **words, **inner}


def _renamed(node: Any) -> Any:
    """Return a schema with the names of a turning axis."""
    if isinstance(node, dict):
        return {ROTATIONAL_KEYS.get(key, key): _renamed(each) for key, each in node.items()}
    if isinstance(node, list):
        return [_renamed(each) for each in node]
    return ROTATIONAL_KEYS.get(node, node) if isinstance(node, str) else node


def _with_references(node: Any, definitions: dict[str, Node]) -> Any:
    """Return a schema with each record as a reference to its definition, which is added."""
    if isinstance(node, list):
        return [_with_references(each, definitions) for each in node]
    if not isinstance(node, dict):
        return node
    found = {key: _with_references(each, definitions) for key, each in node.items() if key != _RECORD}
    if _RECORD not in node:
        return found
    name = node[_RECORD] if definitions.get(node[_RECORD], found) == found else f"Rotational{node[_RECORD]}"
    if definitions.setdefault(name, found) != found:
        raise ValueError(f"{name} reads in more than two ways; give the record words of its own.")
    return {"$ref": f"#/$defs/{name}"}


def texts() -> dict[str, str]:
    """Return the files by the names of what they describe."""
    made = {
        "controller": controller_schema(),
        "identified": identified_schema(),
        "cell": cell_schema(),
        "schedule": schedule_schema(),
        "pareto": pareto_schema(),
        "plan": plan_schema(),
    }
    return {name: _written(each, "") + "\n" for name, each in made.items()}


def _written(node: Any, indent: str) -> str:
    """Return a node as JSON, on one line where it fits."""
    line = json.dumps(node, ensure_ascii=False)
    if len(indent) + len(line) <= _WIDTH or not isinstance(node, dict | list):
        return line
    deeper = indent + "  "
    if isinstance(node, list):
        return "[\n" + ",\n".join(f"{deeper}{_written(each, deeper)}" for each in node) + f"\n{indent}]"
    parts = (f"{deeper}{json.dumps(key)}: {_written(each, deeper)}" for key, each in node.items())
    return "{\n" + ",\n".join(parts) + f"\n{indent}}}"
