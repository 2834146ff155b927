import json
import math
import struct
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given

from autotune.formats.canonical import canonical_bytes, checksum, plain, short
from identification.result import Status
from problems.errors import ParameterError
from problems.frozen import FrozenDict
from tests.autotune.formats.samples import PLAIN, TREES


def test_the_canonical_form_is_the_documented_one() -> None:
    one, tenth = struct.pack(">d", 1.0).hex(), struct.pack(">d", 0.1).hex()
    tree = {"b": [1, 1.0, 0.1], "a": {"é": None, "Z": True}, "c": '"'}
    expected = f'{{"a":{{"Z":true,"\\u00e9":null}},"b":[{one},{one},{tenth}],"c":"\\""}}'
    assert canonical_bytes(tree) == expected.encode("ascii")


def test_the_checksum_is_that_of_everything_but_itself() -> None:
    assert checksum({"a": 1, "checksum": "old"}) == checksum({"a": 1}) == sha256(canonical_bytes({"a": 1})).hexdigest()
    assert short("0123456789") == "01234567"


@given(TREES)
def test_order_of_keys_does_not_matter(tree: dict[str, object]) -> None:
    assert checksum(tree) == checksum(dict(reversed(tree.items())))


@given(PLAIN, PLAIN)
def test_equal_bytes_mean_equal_content(one: object, other: object) -> None:
    same_bytes = canonical_bytes(one) == canonical_bytes(other)
    # JSON text tells True from 1 and -0.0 from 0.0, as the canonical form does, but 1 from 1.0 as well.
    same_text = json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)
    assert same_bytes or not same_text
    assert one == other or not same_bytes


def test_every_bit_of_a_number_counts() -> None:
    numbers = [0.0, -0.0, 5e-324, 0.1, math.nextafter(0.1, 1), 1e308]
    assert len({checksum({"a": number}) for number in numbers}) == len(numbers)


def test_foreign_values_become_plain_ones() -> None:
    value: Mapping[str, object] = FrozenDict(
        {
            "array": np.array([1.5, 2.0]),
            "double": np.float64(0.1),
            "count": np.int64(3),
            "flag": np.bool_(True),
            "status": Status.WEAK,
            "path": Path("a") / "b",
            "tuple": (1, None),
        }
    )
    tree = plain(value)
    assert tree == {
        "array": [1.5, 2.0],
        "double": 0.1,
        "count": 3,
        "flag": True,
        "status": "weak",
        "path": str(Path("a") / "b"),
        "tuple": [1, None],
    }
    kinds = [type(item) for item in tree.values()]
    assert kinds == [list, float, int, bool, str, str, list]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 2**53 + 1, np.float64("nan"), b"x", object(), {1: 2}])
def test_what_has_no_plain_form_is_refused_with_its_place(value: object) -> None:
    with pytest.raises(ParameterError, match=r"^top\.entry\[0\] must be"):
        plain({"entry": [value]}, "top")


def test_endless_nesting_is_refused() -> None:
    value: list[object] = []
    value.append(value)
    with pytest.raises(ParameterError, match="levels deep"):
        plain(value)
