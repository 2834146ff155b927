"""The pictures, and the whole way from a file to them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from autotune.charts.chart import Heat
from autotune.charts.matplotlib_renderer import render
from autotune.errors import UsageError
from autotune.formats.kinds import HEAD_BYTES, PICTURE_MARK
from autotune.maps.charts import _pieces, has_lower_limits_only, map_chart
from autotune.maps.make import make_map, summary_tree
from autotune.maps.options import MapOptions
from autotune.maps.text import number
from problems.maps.maps import MapAxis, MapResult
from problems.maps.parameters import MapQuantity
from problems.maps.search import IntervalResult, StableInterval
from tests.autotune.maps.map_cases import small_map


def written(folder: Path, **asked: Any) -> str:
    """Return the SVG of a request; texts stand in it as comments beside their outlines."""
    options = MapOptions(source=folder / "controller.yaml", picture=folder / "map.svg", **asked)
    make_map(options)
    return options.picture.read_text(encoding="utf-8")


@pytest.mark.parametrize("show", ["stability", "modulus", "delay", "peak-contact"])
def test_a_picture_has_names_units_and_what_is_fixed(folder: Path, show: str) -> None:
    picture = written(folder, show=show, x="damping=100:5000:9", y="lead_s=0:0.06:7")
    for text in (
        "admittance damping $B_{a}$ [N·s/m]",
        "lead gain $K_{l}$ [ms]",
        "$M_{p}$ = 16 kg",
        "$h$ = 0.8 ms",
        "design: ",
    ):
        assert text in picture
    quantity = MapQuantity(show)
    units = {"delay": " [ms]", "peak-contact": " [N]"}
    if quantity is not MapQuantity.STABILITY:
        assert f"<!-- {quantity.label}{units.get(show, '')} -->" in picture
    assert ("approach with 30 N" in picture) == quantity.is_peak


def test_a_picture_has_times_in_milliseconds_and_its_map_in_seconds(folder: Path) -> None:
    setup, result = small_map(folder)
    (panel,), lead = map_chart(setup, result, None).panels, result.request.y
    assert panel.y.limits == (1e3 * lead.low, 1e3 * lead.high)
    heat = next(each for each in panel.elements if isinstance(each, Heat))
    assert np.allclose(heat.y, 1e3 * lead.values(), rtol=1e-12)
    assert np.array_equal(heat.x, result.request.x.values())


@pytest.mark.parametrize("suffix", [".svg", ".png"])
def test_the_same_picture_has_the_same_bytes_and_no_date(folder: Path, suffix: str) -> None:
    setup, result = small_map(folder)
    pictures = {render(map_chart(setup, result, None), suffix, mark=PICTURE_MARK) for _ in range(2)}
    assert len(pictures) == 1
    (picture,) = pictures
    assert picture.startswith(b"\x89PNG" if suffix == ".png" else b"<?xml")
    assert not any(word in picture for word in (b"dc:date", b"Matplotlib v"))
    # What made it is in its first bytes, without a version: by it a later map knows what it may replace.
    assert b"autotune map" in picture[:HEAD_BYTES]


@pytest.mark.parametrize(
    ("damping", "show", "message"),
    [
        ("damping=1:5:5", "modulus", "unstable everywhere"),
        ("damping=5e3:9e3:5", "modulus", ""),
        ("damping=5e3:9e3:5", "stability", ""),
    ],
)
def test_all_stable_and_all_unstable_can_be_drawn(folder: Path, damping: str, show: str, message: str) -> None:
    picture = written(folder, show=show, x=damping, y="lead_s=0:0.002:4", settings=["feedback_damping_s=0"])
    assert ("unstable everywhere" in picture) == bool(message)
    assert "limit of stability" not in picture
    assert ("<!-- unstable -->" in picture) == bool(message)


def test_a_margin_that_nothing_limits_can_be_drawn(folder: Path) -> None:
    """B_a is above B_p and there is little lead: no crossover in free space, see the maps of the ground floor."""
    quiet = ["feedback_damping_s=0", "damping=8500", "lead_s=0.0005"]
    picture = written(
        folder, show="phase", where="free_space", x="damping=8e3:9e3:4", y="lead_s=0:0.001:4", settings=quiet
    )
    assert "design: no limit" in picture


def test_lower_limits_alone_are_lines_and_all_else_is_panels(folder: Path) -> None:
    lines = written(folder, show="stable-damping", where="contact", x="K_e=1e5:1e6:7")
    assert "smallest stable admittance damping $B_{a}$ [N·s/m]" in lines
    assert all(f"<!-- {name} -->" in lines for name in ("standard", "lead", "feedback damping", "design"))
    panels = written(folder, show="stable-lead", x="payload_frequency_rad_per_s=40:400:7")
    assert "lead gain $K_{l}$ [ms]" in panels
    assert "smallest" not in panels
    assert panels.count("payload frequency") == 2
    assert r"$\zeta$ = 0.1438" in panels


def test_what_has_several_intervals_is_never_reported_by_one_line() -> None:
    whole = StableInterval(lower=1.0, upper=9.0, lower_is_bound=False, upper_is_bound=True)
    island = StableInterval(lower=0.1, upper=0.5, lower_is_bound=False, upper_is_bound=False)

    def only(*columns: Sequence[StableInterval]) -> bool:
        stub = object.__new__(IntervalResult)
        object.__setattr__(stub, "intervals", {"": columns})
        return has_lower_limits_only(stub)

    assert only([whole], [], [whole])
    assert not only([whole], [island, whole])
    assert not only([island])
    assert not only([], [])


def interval(lower: float, upper: float) -> StableInterval:
    return StableInterval(lower=lower, upper=upper, lower_is_bound=False, upper_is_bound=False)


def area(polygon: Sequence[tuple[float, float]]) -> float:
    x, y = np.array(polygon).T
    return float(0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))


@pytest.mark.parametrize(
    ("here", "there", "expected"),
    [
        # A trapezium; two of them; a triangle of half the width; nothing.
        ([interval(1.0, 3.0)], [interval(2.0, 6.0)], 3.0),
        ([interval(0.0, 1.0), interval(4.0, 6.0)], [interval(0.0, 1.0), interval(4.0, 6.0)], 3.0),
        ([interval(1.0, 3.0)], [], 0.5),
        ([], [], 0.0),
        # Two that meet: the half with the gap of 2, which closes to a tip, and the half without.
        ([interval(0.0, 4.0), interval(6.0, 10.0)], [interval(0.0, 10.0)], 4.5 + 5.0),
        ([interval(0.0, 10.0)], [interval(0.0, 4.0), interval(6.0, 10.0)], 4.5 + 5.0),
    ],
)
def test_the_area_between_two_columns_is_that_of_straight_lines(
    here: list[StableInterval], there: list[StableInterval], expected: float
) -> None:
    along = MapAxis(name="drag", low=1.0, high=2.0, count=2)
    pieces = list(_pieces(along, [here, there]))
    assert sum(area(polygon) for polygon, _ in pieces) == pytest.approx(expected)
    # Every piece has a lower and an upper edge, since no end here is a bound of the search.
    assert all(len(edges) == 2 for _, edges in pieces)


def test_a_gap_between_intervals_that_meet_closes_to_a_tip() -> None:
    """Half way from two intervals to one that holds both, the gap from 4 to 8 ends at 6."""
    along = MapAxis(name="drag", low=1.0, high=2.0, count=2)
    columns = [[interval(0.0, 4.0), interval(8.0, 10.0)], [interval(0.0, 10.0)]]
    edges = [set(edge) for _, lines in _pieces(along, columns) for edge in lines]
    assert {(1.0, 4.0), (1.5, 6.0)} in edges
    assert {(1.0, 8.0), (1.5, 6.0)} in edges


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.0125, "0.0125"),
        (913.0000000000001, "913"),
        (3e5, "3×10⁵"),
        (1e6, "10⁶"),
        (1.234e-7, "1.234×10⁻⁷"),
    ],
)
def test_numbers_are_written_for_people(value: float, text: str) -> None:
    assert number(value) == text


def test_the_summary_names_extremes_and_the_design(folder: Path) -> None:
    options = MapOptions(
        source=folder / "controller.yaml",
        picture=folder / "map.png",
        show="modulus",
        x="damping=100:5000:9",
        y="lead_s=0:0.06:7",
    )
    made = make_map(options)
    tree = summary_tree(made)
    assert isinstance(made.result, MapResult)
    values = made.result.values
    assert tree["smallest"]["value"] == np.nanmin(values)
    assert tree["largest"]["value"] == np.nanmax(values)
    assert tree["stable_share"] == np.mean(made.result.is_stable)
    assert (tree["design"]["damping"], tree["design"]["is_stable"]) == (913.0000000000001, True)
    assert made.design is not None
    assert tree["design"]["value"] == made.design.value
    assert {path.name for path in folder.iterdir()} >= {"map.png", "map.csv"}


def test_nothing_is_written_when_the_request_is_refused(folder: Path) -> None:
    before = sorted(path.name for path in folder.iterdir())
    with pytest.raises(UsageError):
        make_map(MapOptions(source=folder / "controller.yaml", picture=folder / "map.svg", x="mass=2:1"))
    assert sorted(path.name for path in folder.iterdir()) == before
