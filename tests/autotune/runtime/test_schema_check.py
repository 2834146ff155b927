"""The small checker says what jsonschema says of the controller's schema."""

import copy
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from autotune.formats.controller import controller_tree
from autotune.formats.limits import VariableDampingSettings
from autotune.formats.schema import explain, load_schema
from autotune.runtime.schema_check import KEYWORDS, breaches
from tests.autotune.formats.samples import make_controller, make_limits

SCHEMA = load_schema("controller")
ORACLE = Draft202012Validator(SCHEMA)
# They name or describe the schema.
SILENT = {"$schema", "$id", "$defs", "title", "description"}
WRONG: tuple[Any, ...] = (None, True, "text", "", 5e-5, 0, -1.0, 1, [], [1.0], [2.0, 1.0, 0.0, 0.0], {}, {"x": 1.0})

LARGE = {"certificate", "predicted"}


def keywords(schema: Any) -> Iterator[str]:
    if isinstance(schema, list):
        for part in schema:
            yield from keywords(part)
    if isinstance(schema, dict):
        for key, part in schema.items():
            yield key
            yield from keywords(list(part.values()) if key in ("properties", "$defs") else part)


def places(tree: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield at
    parts = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, part in parts:
        yield from places(part, (*at, key))


def changed(tree: Any, at: tuple[Any, ...], value: Any) -> Any:
    tree = copy.deepcopy(tree)
    spot = tree
    for key in at[:-1]:
        spot = spot[key]
    if value is KeyError:
        del spot[at[-1]]
    else:
        spot[at[-1]] = value
    return tree


def reported(tree: Any) -> tuple[set[str], set[str]]:
    ours = {f"{explain(breach)}" for breach in breaches(tree, SCHEMA)}
    theirs = {f"{explain(error)}" for error in ORACLE.iter_errors(tree)}
    return ours, theirs


def test_every_word_of_the_schema_is_understood() -> None:
    assert set(keywords(SCHEMA)) - SILENT <= KEYWORDS


@pytest.mark.parametrize("part", list(SCHEMA["properties"]))
def test_both_say_the_same_of_every_damage(part: str) -> None:
    controller = make_controller()
    damping = controller.axes["x"].damping
    varied = VariableDampingSettings(
        highest=2.0 * damping, lowest=0.5 * damping, decay_s_per_m=8.0, update_periods=10, largest_change=20.0
    )
    tree = controller_tree(replace(controller, limits=make_limits(), variable_damping={"x": varied}))
    assert reported(tree) == (set(), set())
    for turn, at in enumerate(places(tree[part], (part,))):
        # The oracle takes milliseconds for a file: in the large parts every entry meets some of the values in turn.
        few = [WRONG[(turn + 5 * i) % len(WRONG)] for i in range(3)]
        for value in (KeyError, *(few if part in LARGE else WRONG)):
            ours, theirs = reported(changed(tree, at, value))
            assert ours == theirs
