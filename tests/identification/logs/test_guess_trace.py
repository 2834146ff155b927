"""A test along one axis, whose columns have two names or none: which is the way, which the force, and of whom."""

from collections.abc import Mapping

import numpy as np
import pytest

from identification.logs.guess_trace import NamedChannel, guess_trace
from identification.logs.names import Meaning, Named, NamedVector
from identification.logs.roles.registry import Role
from problems.arrays import FloatArray

N = 400
INTO = np.concatenate([np.zeros(50), np.linspace(0.0, 3e-3, 150), np.full(100, 3e-3), np.linspace(3e-3, 0.0, 100)])
PRESSED = 2e4 * np.maximum(INTO - 1e-3, 0.0)


def single(kind: Meaning, path: str, unit: str = "", components: str = "") -> NamedVector:
    return NamedVector(kind=kind, paths=(path,), words=(), unit=unit, components=components)


def guessed(columns: Mapping[str, FloatArray], *singles: NamedVector) -> Mapping[Role, Mapping[str, object]]:
    others = () if singles else tuple(columns)
    named = Named(vectors=(), times={}, others=others, singles=singles)
    found = guess_trace(NamedChannel(topic="press", named=named, columns=columns))
    return {role: {entry.key: entry.value for entry in entries} for role, entries in found.items()}


def evidence(columns: Mapping[str, FloatArray], key: str, role: Role, *singles: NamedVector) -> str:
    named = Named(vectors=(), times={}, others=() if singles else tuple(columns), singles=singles)
    entries = guess_trace(NamedChannel(topic="press", named=named, columns=columns))[role]
    (found,) = (entry.evidence for entry in entries if entry.key == key)
    return found


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_force_is_whose_it_points_for(sign: float) -> None:
    place, force = single(Meaning.POSITION, "way", "mm"), single(Meaning.FORCE, "load", "kN")
    found = guessed({"way": 1e3 * INTO, "load": sign * PRESSED}, place, force)
    assert found[Role.POSE] == {
        "topic": "press",
        "fields": {"position": [None, None, "way"]},
        "units": {"position": "mm"},
    }
    assert found[Role.WRENCH] == {
        "topic": "press",
        "fields": {"force": [None, None, "load"]},
        "units": {"force": "kN"},
        "exerted_by": "sensor" if sign > 0.0 else "payload",
        "gravity_compensated": True,
    }


@pytest.mark.parametrize(("components", "axis"), [("x", 0), ("y", 1), ("z", 2)])
def test_a_component_of_either_says_the_axis_of_both(components: str, axis: int) -> None:
    for which in range(2):
        said = [components if which == i else "" for i in range(2)]
        singles = single(Meaning.POSITION, "way", components=said[0]), single(Meaning.FORCE, "load", components=said[1])
        found = guessed({"way": INTO, "load": PRESSED}, *singles)
        assert found[Role.POSE]["fields"] == {"position": ["way" if i == axis else None for i in range(3)]}
        assert found[Role.WRENCH]["fields"] == {"force": ["load" if i == axis else None for i in range(3)]}


@pytest.mark.parametrize(("deepest", "unit"), [(0.49, "m"), (0.51, "mm")])
def test_without_a_unit_half_a_metre_is_the_deepest_press(deepest: float, unit: str) -> None:
    singles = single(Meaning.POSITION, "way"), single(Meaning.FORCE, "load")
    found = guessed({"way": -INTO / 3e-3 * deepest, "load": PRESSED}, *singles)
    assert found[Role.POSE]["units"] == {"position": unit}
    assert found[Role.WRENCH]["units"] == {"force": "N"}
    assert found[Role.WRENCH]["exerted_by"] == "payload"


@pytest.mark.parametrize(("first", "compensated"), [(9.9, True), (10.1, False)])
def test_a_force_that_begins_above_a_tenth_of_its_range_holds_a_weight(first: float, compensated: bool) -> None:
    load = np.concatenate([[first], np.linspace(0.0, 100.0, N - 1)])
    found = guessed({"way": INTO, "load": load}, single(Meaning.POSITION, "way"), single(Meaning.FORCE, "load"))
    assert ("gravity_compensated" in found[Role.WRENCH]) == compensated


def test_of_two_columns_without_names_the_one_that_goes_its_way_less_often_is_the_way() -> None:
    """Less than three times, and the other three times as often at least."""
    time = np.linspace(0.0, 1.0, 4001)

    def swings(count: float) -> FloatArray:
        """Return what goes its whole range `count` times."""
        return np.asarray(np.abs((time * count + 1.0) % 2.0 - 1.0))

    for slow, fast, is_found in ((2.0, 6.2, True), (2.0, 5.8, False), (2.9, 9.0, True), (3.1, 12.0, False)):
        for order in (("0", "1"), ("1", "0")):
            columns = dict(sorted(zip(order, (swings(slow), 50.0 * swings(fast)), strict=True)))
            found = guessed(columns)
            assert bool(found) == is_found
            if found:
                assert found[Role.POSE]["fields"] == {"position": [None, None, order[0]]}
                assert found[Role.WRENCH]["fields"] == {"force": [None, None, order[1]]}
    assert guessed({"a": swings(2.0), "b": swings(9.0)}) == {}


@pytest.mark.parametrize(
    ("begins", "back", "said"), [(0.09, 0.0, True), (0.11, 0.0, False), (0.0, 0.24, True), (0.0, 0.3, False)]
)
def test_a_displacement_begins_near_0_and_goes_to_one_side(begins: float, back: float, said: bool) -> None:
    """From less than a tenth of its range; back by less than a quarter of it, and as far until the force begins."""
    way = np.concatenate(
        [np.linspace(begins, begins - back, 100), np.linspace(begins - back, begins - back + 1.0, 300)]
    )
    load = np.concatenate([np.zeros(100), np.linspace(0.0, 60.0, 300)])
    singles = single(Meaning.POSITION, "way", "mm", "x"), single(Meaning.FORCE, "load", "N", "x")
    text = evidence({"way": way, "load": load}, "fields", Role.POSE, *singles)
    assert text == ("by name; a displacement: it begins near 0" if said else "by name; a place")
