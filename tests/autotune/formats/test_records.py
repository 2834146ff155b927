"""Records and their plain trees: what is written is read back, whatever shape a field has."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import pytest

from autotune.formats.records import EntryError, read_record, record_tree
from problems.errors import ParameterError


class _Kind(StrEnum):
    SOFT = "soft"
    HARD = "hard"


@dataclass(frozen=True, kw_only=True)
class _Part:
    stiffness: float

    def __post_init__(self) -> None:
        if not self.stiffness > 0.0:
            raise ParameterError("stiffness", self.stiffness, "above 0")


@dataclass(frozen=True, kw_only=True)
class _Other:
    length: float


@dataclass(frozen=True, kw_only=True)
class _Record:
    number: float
    count: int = 0
    kind: _Kind = _Kind.SOFT
    point: tuple[float, int, str] = (0.0, 0, "")
    many: tuple[float, ...] = ()
    parts: tuple[_Part, ...] = ()
    by_name: Mapping[str, float] = field(default_factory=dict)
    parts_by_name: Mapping[str, tuple[_Part, ...]] = field(default_factory=dict)
    one: _Part | None = None
    either: _Part | _Other | None = None
    value: float | str | bool | None = None
    path: str = field(default="", compare=False)


FULL = _Record(
    number=1.5,
    count=3,
    kind=_Kind.HARD,
    point=(0.5, 2, "a"),
    many=(1.0, 2.0, 3.0),
    parts=(_Part(stiffness=1.0), _Part(stiffness=2.0)),
    by_name={"x": 1.0, "y": 2.0},
    parts_by_name={"x": (_Part(stiffness=3.0),), "y": ()},
    one=_Part(stiffness=4.0),
    either=_Other(length=5.0),
    value="text",
    path="not written",
)


@pytest.mark.parametrize(
    "record",
    [
        FULL,
        _Record(number=0.0),
        _Record(number=1.0, value=True),
        _Record(number=1.0, value=2.5),
        _Record(number=1.0, either=_Part(stiffness=1.0)),
    ],
    ids=["every field", "none beside what must be there", "a truth", "a number", "the other kind"],
)
def test_what_is_written_is_read_back(record: _Record) -> None:
    found = read_record(_Record, json.loads(json.dumps(record_tree(record))))
    assert found == record
    assert isinstance(found.kind, _Kind)
    assert type(found.value) is type(record.value)


def test_only_what_differs_from_its_default_and_is_compared_is_written() -> None:
    # A mapping that is made for each record is no default to compare with.
    mappings: dict[str, Any] = {"by_name": {}, "parts_by_name": {}}
    assert record_tree(_Record(number=0.0, path="somewhere")) == {"number": 0.0, **mappings}
    assert set(record_tree(FULL)) == set(_Record.__annotations__) - {"path"}


@pytest.mark.parametrize(
    ("tree", "place"),
    [
        ({"one": {"stiffness": 0.0}}, "one.stiffness"),
        ({"parts": [{"stiffness": 1.0}, {"stiffness": -1.0}]}, "parts[1].stiffness"),
        ({"parts_by_name": {"y": [{"stiffness": 0.0}]}}, "parts_by_name.y[0].stiffness"),
    ],
)
def test_a_refused_entry_is_named_by_its_path(tree: dict[str, Any], place: str) -> None:
    with pytest.raises(EntryError, match=r"above 0") as refused:
        read_record(_Record, {"number": 1.0, **tree})
    assert refused.value.name == place


@pytest.mark.parametrize(
    ("record", "place"),
    [
        (_Record(number=math.nan), "number"),
        (_Record(number=1.0, many=(0.0, math.inf)), r"many\[1\]"),
        (_Record(number=1.0, by_name={"z": math.nan}), r"by_name\.z"),
    ],
)
def test_a_number_that_is_not_finite_is_named_by_its_path(record: _Record, place: str) -> None:
    with pytest.raises(ParameterError, match=rf"^{place} "):
        record_tree(record)
