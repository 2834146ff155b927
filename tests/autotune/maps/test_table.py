"""The data files of maps."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.maps.make import _interval_summary, table_text
from autotune.maps.setup import MapSetup
from problems.maps.search import IntervalRequest, IntervalResult, StableInterval, find_stable_intervals
from tests.autotune.maps.map_cases import plan_of, small_map


def rows_of(text: str) -> tuple[list[str], list[dict[str, str]]]:
    lines = text.splitlines()
    header = [line for line in lines if line.startswith("#")]
    return header, list(csv.DictReader(lines[len(header) :]))


def test_the_csv_holds_every_point_to_the_last_bit(folder: Path) -> None:
    setup, result = small_map(folder)
    assert {bool(np.any(test(result.values))) for test in (np.isnan, np.isinf)} == {True}
    header, rows = rows_of(table_text(setup, result, Path("map.csv")))
    assert "# fixed: mass (M_a) = 12.5 kg" in header
    assert "# fixed: sample time h = 0.0008 s" in header
    assert any(line.startswith("# varied: lead_s (K_l) from 0.0 to 0.06 s, 5 values") for line in header)
    read_back = np.array([float(row["delay"] or "nan") for row in rows]).reshape(5, 7)
    assert np.array_equal(read_back, result.values, equal_nan=True)
    assert {row["delay"] == "" for row in rows if row["is_stable"] == "0"} == {True}
    assert [row["is_stable"] == "1" for row in rows] == result.is_stable.ravel().tolist()
    x, y = np.meshgrid(result.request.x.values(), result.request.y.values())
    assert [float(row["damping"]) for row in rows] == x.ravel().tolist()
    assert [float(row["lead_s"]) for row in rows] == y.ravel().tolist()


def test_the_json_says_the_same(folder: Path) -> None:
    setup, result = small_map(folder)
    tree = json.loads(table_text(setup, result, Path("map.json")), parse_constant=pytest.fail)
    assert (tree["format"], tree["show"], tree["unit"]) == ("autotune/map", "delay", "s")
    assert tree["x"]["values"] == result.request.x.values().tolist()
    assert tree["is_stable"] == result.is_stable.tolist()
    known = np.array([[math.nan if value is None else value for value in row] for row in tree["values"]])
    assert np.array_equal(known, np.where(np.isfinite(result.values), result.values, np.nan), equal_nan=True)
    assert tree["fixed"]["coupling_stiffness"] == {"value": 3e5, "unit": "N/m"}


def test_a_map_of_stability_has_no_values(folder: Path) -> None:
    setup, result = small_map(folder, "stability")
    _, rows = rows_of(table_text(setup, result, Path("map.csv")))
    assert list(rows[0]) == ["damping", "lead_s", "is_stable"]
    assert "values" not in json.loads(table_text(setup, result, Path("map.json")))


def small_intervals(folder: Path, **asked: Any) -> tuple[MapSetup, IntervalResult]:
    asked = {"show": "stable-lead", "x": "drag=60:700:6", "y": "damping=400:1200:2", **asked}
    setup = plan_of(folder, where="free_space", settings=["coupling_damping=0", "feedback_damping_s=0"], **asked)
    assert isinstance(setup.request, IntervalRequest)
    return setup, find_stable_intervals(setup.request)


def test_the_intervals_are_in_the_files(folder: Path) -> None:
    setup, result = small_intervals(folder)
    header, rows = rows_of(table_text(setup, result, Path("map.csv")))
    assert any(line.startswith("# searched: lead_s (K_l) from 0.0 to 0.1 s, 401 values") for line in header)
    tree = json.loads(table_text(setup, result, Path("map.json")))
    counts = set()
    for name, columns in result.intervals.items():
        for value, column, reported in zip(
            result.request.along.values(), columns, tree["intervals"][name], strict=True
        ):
            here = [row for row in rows if row["case"] == name and float(row["drag"]) == value]
            counts.add(len(column))
            if not column:
                assert [(row["interval"], row["lower"]) for row in here] == [("0", "")]
            else:
                ends = [(float(row["lower"]), float(row["upper"])) for row in here]
                assert ends == [(each.lower, each.upper) for each in column]
                bounds = [(row["lower_is_bound"] == "1", row["upper_is_bound"] == "1") for row in here]
                assert bounds == [(each.lower_is_bound, each.upper_is_bound) for each in column]
            assert [(each["lower"], each["upper"]) for each in reported] == [
                (each.lower, each.upper) for each in column
            ]
    assert counts == {0, 1}


def test_the_summary_of_intervals_has_the_ends_of_the_lowest_and_highest(folder: Path) -> None:
    setup = plan_of(folder, show="stable-lead", x="drag=60:700:4", y="damping=400:1200:2", where="free_space")
    assert isinstance(setup.request, IntervalRequest)

    def between(*ends: tuple[float, float]) -> tuple[StableInterval, ...]:
        return tuple(StableInterval(lower=a, upper=b, lower_is_bound=False, upper_is_bound=False) for a, b in ends)

    columns = (between((1.0, 2.0)), (), between((0.5, 3.0), (4.0, 5.0), (6.0, 7.0)), between((2.0, 9.0)))
    result = IntervalResult(request=setup.request, intervals={"soft": columns, "hard": ((), (), (), ())})
    tree = _interval_summary(setup, result)
    assert tree["cases"] == {
        "soft": {"stable_share": 0.75, "most_intervals": 3, "smallest": [0.5, 2.0], "largest": [2.0, 9.0]},
        "hard": {"stable_share": 0.0, "most_intervals": 0, "smallest": None, "largest": None},
    }
    np.testing.assert_array_equal(result.smallest("soft"), [1.0, np.nan, 0.5, 2.0])
    np.testing.assert_array_equal(result.largest("soft"), [2.0, np.nan, 7.0, 9.0])
