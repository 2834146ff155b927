import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from jsonschema import Draft202012Validator

from autotune.formats.canonical import dump_json
from autotune.formats.controller import controller_tree
from autotune.formats.identified import identified_tree
from autotune.formats.records import ROTATIONAL_KEYS
from autotune.formats.schema import load_schema, violations
from identification.result import Identified
from tests.autotune.formats.samples import identified_results, make_controller, make_identified

NAMES = pytest.mark.parametrize("name", ["controller", "identified"])


def trees() -> dict[str, dict[str, Any]]:
    return {
        "controller": controller_tree(make_controller(("x", "y", "z", "rx", "ry", "rz"))),
        "identified": identified_tree(make_identified(), {"log": "x"}),
    }


@NAMES
def test_the_schema_is_one(name: str) -> None:
    schema = load_schema(name)
    Draft202012Validator.check_schema(schema)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"


@NAMES
def test_what_is_written_satisfies_the_schema(name: str) -> None:
    tree = json.loads(dump_json(trees()[name]))
    assert list(Draft202012Validator(load_schema(name)).iter_errors(tree)) == []


@settings(deadline=None, max_examples=30)
@given(identified_results())
def test_any_result_satisfies_the_schema(result: Identified) -> None:
    tree = json.loads(dump_json(identified_tree(result, {})))
    assert Draft202012Validator(load_schema("identified")).is_valid(tree)


def _objects(schema: object) -> list[dict[str, Any]]:
    if isinstance(schema, list):
        return [found for item in schema for found in _objects(item)]
    if not isinstance(schema, dict):
        return []
    own = [schema] if "properties" in schema and schema.get("type") == "object" else []
    return own + [found for item in schema.values() for found in _objects(item)]


@NAMES
def test_no_mapping_with_named_keys_takes_others(name: str) -> None:
    found = _objects(load_schema(name))
    assert len(found) > 5
    assert [each for each in found if each.get("additionalProperties") is not False] == []


@NAMES
def test_each_key_that_is_written_is_required_or_has_a_default(name: str) -> None:
    validator = Draft202012Validator(load_schema(name))
    optional = {"approach_force_n", "approach_torque_n_m", "method", "note", "numbers"}
    tree = trees()[name]
    for key in tree:
        assert not validator.is_valid({k: v for k, v in tree.items() if k != key}), key
    part = tree["certificate"]["proved"][0] if name == "controller" else tree["axes"]["x"]["environments"][0]
    for key in set(part) - optional:
        kept = part.pop(key)
        assert not validator.is_valid(tree), key
        part[key] = kept


def test_every_rotational_key_has_one_translational_key() -> None:
    assert len(set(ROTATIONAL_KEYS.values())) == len(ROTATIONAL_KEYS)
    assert set(ROTATIONAL_KEYS).isdisjoint(ROTATIONAL_KEYS.values())


def test_the_readers_are_imported_without_the_slow_libraries(repository: Path) -> None:
    code = "import sys, autotune.formats, autotune.formats.controller; print('jsonschema' in sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], cwd=repository, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("given", "found"),
    [({}, "neither"), ({"max_force_n": 140.0, "body_region": "hand"}, "max_force_n and body_region")],
)
def test_keys_of_which_exactly_one_belongs_are_named(given: dict[str, Any], found: str) -> None:
    tree = {"requirements": {"contact_at_speed": {"speed_m_s": 0.05, **given}}}
    (violation,) = violations(tree, "problem")
    assert violation.place == ("requirements", "contact_at_speed")
    assert (violation.must, violation.found) == ("given exactly one of max_force_n and body_region", found)
