import copy
import json
import pickle
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pytest

from problems.frozen import FrozenDict, freeze


@dataclass(frozen=True, kw_only=True)
class _Inner:
    number: float


@dataclass(frozen=True, kw_only=True)
class _Record:
    parts: "FrozenDict[str, _Inner] | dict[str, _Inner]"

    def __post_init__(self) -> None:
        freeze(self, "parts")


_CHANGES: tuple[Callable[[Any], object], ...] = (
    lambda frozen: frozen.__setitem__("b", 2),
    lambda frozen: frozen.__delitem__("a"),
    lambda frozen: frozen.__ior__({"b": 2}),
    lambda frozen: frozen.update(b=2),
    lambda frozen: frozen.setdefault("b", 2),
    lambda frozen: frozen.pop("a"),
    lambda frozen: frozen.popitem(),
    lambda frozen: frozen.clear(),
)


@pytest.mark.parametrize("change", _CHANGES)
def test_nothing_changes_it(change: Callable[[Any], object]) -> None:
    frozen = FrozenDict({"a": 1})
    with pytest.raises(TypeError, match="cannot be changed"):
        change(frozen)
    assert frozen == {"a": 1}


def test_a_frozen_field_is_a_copy() -> None:
    given = {"x": _Inner(number=1.0)}
    record = _Record(parts=given)
    given["y"] = _Inner(number=2.0)
    assert list(record.parts) == ["x"]


@pytest.mark.parametrize("twin", [copy.copy, copy.deepcopy, lambda each: pickle.loads(pickle.dumps(each))])
def test_copies_and_pickles_are_frozen_and_equal(twin: Callable[[Any], Any]) -> None:
    record = _Record(parts={"x": _Inner(number=np.pi)})
    again = twin(record)
    assert again == record
    with pytest.raises(TypeError):
        again.parts["y"] = 1


def test_asdict_and_json_take_it_to_the_last_record() -> None:
    record = _Record(parts={"x": _Inner(number=0.5)})
    assert asdict(record) == {"parts": {"x": {"number": 0.5}}}
    assert json.loads(json.dumps(asdict(record))) == {"parts": {"x": {"number": 0.5}}}


def test_equal_ones_have_one_hash_whatever_their_values_are() -> None:
    one, other = FrozenDict({"a": [1], "b": {"c": 2}}), FrozenDict({"b": FrozenDict({"c": 2}), "a": [1]})
    assert one == other
    assert hash(one) == hash(other)
    record = _Record(parts={"x": _Inner(number=0.5)})
    assert {record: "found"}[copy.deepcopy(record)] == "found"
    assert len({record, _Record(parts={"x": _Inner(number=0.6)})}) == 2
