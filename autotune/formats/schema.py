"""Check a tree against its JSON Schema (draft 2020-12) and say what is wrong, where, and what must hold."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Protocol

from problems.errors import ParameterError
from problems.text import meant

from .canonical import Place, spell
from .yaml12 import Document, describe

VERSION = 1

_TYPE_NAMES = {
    "array": "a list",
    "boolean": "true or false",
    "integer": "a whole number",
    "null": "null",
    "number": "a number",
    "object": "a mapping",
    "string": "text",
}
_BOUNDS = {
    "minimum": "at least {}",
    "maximum": "at most {}",
    "exclusiveMinimum": "greater than {}",
    "exclusiveMaximum": "less than {}",
    "minItems": "at least {} entries long",
    "maxItems": "at most {} entries long",
    "minLength": "at least {} characters long",
}


@cache
def load_schema(name: str) -> dict[str, Any]:
    """Return the JSON Schema `controller` or `identified`."""
    text = files("autotune.formats").joinpath("schemas", f"{name}.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def head_of(name: str) -> str:
    """Return how a file of `autotune/<name>` begins, in words."""
    return f"the lines `format: autotune/{name}` and `version: {VERSION}`"


def check_format(document: Document, name: str) -> None:
    """Raise the document's error unless its first two keys say `autotune/<name>`, version 1."""
    wanted = f"autotune/{name}"
    found = document.tree.get("format")
    if "format" not in document.tree or found != wanted:
        stated = describe(found) if "format" in document.tree else f"no such key; begin the file with {head_of(name)}"
        document.refuse(("format",), f"format must be {wanted}, found {stated}.")
    if "version" not in document.tree:
        document.refuse(
            ("version",), f"version must be {VERSION}, found no such key; begin the file with {head_of(name)}."
        )
    version = document.tree["version"]
    if isinstance(version, bool) or version != VERSION:
        document.refuse(
            ("version",), f"version must be {VERSION}, which this release reads, found {describe(version)}."
        )


@dataclass(frozen=True, kw_only=True)
class Violation:
    """An entry that the schema does not allow: where it is, what must hold, what was found."""

    place: Place
    must: str
    found: str
    rule: str

    @property
    def entry(self) -> str:
        """The place as text."""
        return spell(self.place)


def check_document(document: Document, schema: str | Mapping[str, Any]) -> None:
    """Raise the document's error, with its line, for the first entry that the schema, or that of a name, refuses."""
    refuse_first(document, violations(document.tree, schema))


def refuse_first(document: Document, found: Iterable[Violation]) -> None:
    """Raise the document's error, with its line, for the first violation in the order of the lines, if there is one."""
    found = tuple(found)
    # A key that is missing beside an unknown one is most often that one, misspelt.
    unknown_in = {each.place[:-1] for each in found if each.rule == "additionalProperties"}
    named = (each for each in found if each.rule != "required" or each.place[:-1] not in unknown_in)
    first = min(named, key=lambda violation: (document.line(violation.place), len(violation.place)), default=None)
    if first is not None:
        document.refuse(first.place, f"{first.entry} must be {first.must}, found {first.found}.")


def check_tree(tree: Mapping[str, Any], name: str) -> None:
    """Raise ParameterError for the first entry of a tree to be written that the schema `name` does not allow."""
    found = next(iter(violations(tree, name)), None)
    if found is not None:
        raise ParameterError(found.entry, found.found, found.must)


def violations(tree: Mapping[str, Any], schema: str | Mapping[str, Any]) -> Iterator[Violation]:
    """Yield everything in `tree` that the schema, or that of a name, does not allow."""
    from jsonschema import Draft202012Validator  # noqa: PLC0415 - slow to import, and not every command reads a file

    for problem in Draft202012Validator(load_schema(schema) if isinstance(schema, str) else schema).iter_errors(tree):
        yield explain(problem)


class Breach(Protocol):
    """A rule of a schema that an entry breaks, as jsonschema reports it."""

    @property
    def absolute_path(self) -> Sequence[str | int]:
        """Keys and indices that lead to the entry."""

    @property
    def validator(self) -> str:
        """The rule's keyword."""

    @property
    def validator_value(self) -> Any:
        """What the rule says."""

    @property
    def instance(self) -> Any:
        """The entry."""

    @property
    def schema(self) -> Mapping[str, Any]:
        """The part of the schema that holds the rule."""


def explain(problem: Breach) -> Violation:
    """Return what is wrong in words: where it is, what must hold, what was found."""
    place: Place = tuple(problem.absolute_path)
    rule, limit, found = str(problem.validator), problem.validator_value, problem.instance
    if rule == "required":
        missing = next(key for key in limit if key not in found)
        return Violation(place=(*place, missing), must="present", found="no such key", rule=rule)
    if rule == "additionalProperties":
        known = problem.schema.get("properties", {})
        unknown = next(key for key in found if key not in known)
        must, key = f"one of {', '.join(known)}", f"the key {unknown}{meant(unknown, known)}"
        return Violation(place=(*place, unknown), must=must, found=key, rule=rule)
    if rule == "oneOf" and all(set(alternative) == {"required"} for alternative in limit):
        keys = [key for alternative in limit for key in alternative["required"]]
        given = " and ".join(key for key in keys if key in found) or "neither"
        return Violation(place=place, must=f"given exactly one of {' and '.join(keys)}", found=given, rule=rule)
    if rule == "maxProperties":
        return Violation(place=place, must=_must(rule, limit, problem), found=" and ".join(map(str, found)), rule=rule)
    if rule == "anyOf" and isinstance(found, Mapping):
        # Only one of the kinds is a mapping: what is wrong is within it.
        within = [
            each for each in getattr(problem, "context", None) or () if each.validator != "type" or len(each.path)
        ]
        if len({each.schema_path[0] for each in within}) == 1:
            return explain(within[0])
    return Violation(place=place, must=_must(rule, limit, problem), found=describe(found), rule=rule)


def _must(rule: str, limit: Any, problem: Breach) -> str:
    if rule == "type":
        names = " or ".join(_TYPE_NAMES[name] for name in ([limit] if isinstance(limit, str) else limit))
        comma = isinstance(problem.instance, str) and re.fullmatch(r"[-+]?\d*,\d+", problem.instance)
        return f"{names} (with a decimal point, not a comma)" if comma else names
    if rule in _BOUNDS:
        return _BOUNDS[rule].format(limit)
    if rule == "enum":
        return f"one of {', '.join(map(str, limit))}"
    if rule == "const":
        return str(limit)
    return str(problem.schema.get("description", f"as its schema says ({rule} {limit})"))
