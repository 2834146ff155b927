"""Charts refuse shapes that do not fit; decimation loses no peak; pictures keep their numbers."""

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.collections import QuadMesh
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure

from autotune.charts import bokeh_renderer, matplotlib_renderer
from autotune.charts.bokeh_renderer import _cells, draw_live
from autotune.charts.chart import (
    Band,
    Bars,
    Chart,
    Heat,
    Limit,
    Line,
    Panel,
    Points,
    Scale,
    Stretch,
    decimate,
    level_panels,
)
from autotune.charts.matplotlib_renderer import draw, draw_element
from autotune.charts.palette import colour_variables, dark_colours
from autotune.report.page import build_legend
from autotune.report.stills import draw_stills, fitted_limits


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        (Line, {"x": [0.0, 1.0], "y": [0.0]}, "found 1 and 2"),
        (Band, {"x": [0.0, 1.0], "low": [0.0, 1.0], "high": [1.0]}, "as many low and high"),
        (Points, {"x": [0.0], "y": [0.0], "names": ("a", "b")}, "names if any"),
        (Bars, {"edges": [0.0, 1.0], "heights": [1.0, 2.0]}, "one edge more"),
        (Heat, {"x": [0.0, 1.0], "y": [0.0], "values": [[1.0], [2.0]], "label": "m"}, "1 rows and 2 columns"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(kind: Any, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**values)


def test_what_a_chart_holds_cannot_be_changed_behind_it() -> None:
    given_y = np.array([1.0, 2.0])
    line = Line(x=np.array([0.0, 1.0]), y=given_y)
    given_y[0] = 9.0
    assert line.y[0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        line.y[0] = 5.0


@given(y=st.lists(st.floats(-1e6, 1e6, width=32), min_size=5, max_size=400), most=st.integers(4, 60), gap=st.booleans())
def test_decimation_keeps_every_peak_the_ends_and_the_gaps(y: list[float], most: int, gap: bool) -> None:
    values, x = np.array(y), np.arange(len(y), dtype=np.float64)
    if gap:
        values[len(y) // 2] = np.nan
    kept_x, kept = decimate(x, values, most)
    assert len(kept) <= max(most, 4)
    assert (kept_x[0], kept_x[-1]) == (x[0], x[-1])
    assert np.all(np.diff(kept_x) > 0.0)
    # Nothing is made up, and where the curve was broken it is.
    np.testing.assert_array_equal(kept, values[kept_x.astype(int)])
    assert np.any(np.isnan(kept)) == gap
    if not gap:
        assert (np.min(kept), np.max(kept)) == (np.min(values), np.max(values))
    else:
        # Beside a gap the larger of both signs stays.
        assert np.nanmax(np.abs(kept)) == np.nanmax(np.abs(values))


def test_a_single_spike_in_ten_minutes_stays() -> None:
    time = np.arange(750_000) * 8e-4
    force = 0.1 * np.sin(time)
    force[123_456] = 80.0
    x, y = decimate(time, force, 1400)
    assert len(x) <= 1400
    assert x[np.argmax(y)] == time[123_456]


def everything() -> Chart:
    """Return a chart with one of each element."""
    x = np.array([1.0, 2.0, 4.0])
    heat = Heat(x=x, y=x[:2], values=np.array([[0.1, np.nan, 0.3], [0.4, 0.5, 0.6]]), label="margin", limits=(0.0, 1.0))
    plain = Panel(
        title="plain",
        x=Scale(label="x", spacing="log"),
        y=Scale(label="y", limits=(0.0, 0.006)),
        elements=(
            Line(x=x, y=x / 1e3, label="line"),
            Band(x=x, low=x / 2e3, high=x / 1e3, label="band"),
            Points(x=x, y=x / 1e3, names=("a", "b", "c"), label="points"),
            Bars(edges=np.array([0.5, 1.0]), heights=np.array([0.002])),
            Stretch(low=1.0, high=2.0, label="stretch"),
            Limit(value=0.005, label="limit"),
        ),
    )
    mapped = Panel(x=Scale(label="a"), y=Scale(label="b"), elements=(heat,))
    return Chart(key="all", title="All", alternative="One of each.", panels=(plain, mapped), beside=True)


def test_both_pictures_are_the_same_each_time_and_say_the_numbers_in_full() -> None:
    chart = everything()
    stills = draw_stills(chart)
    assert stills == draw_stills(chart)
    assert len(stills) == len(chart.panels)
    drawn = "".join(still.svg for still in stills)
    # Coordinates are shortened; what people read is not: ticks 0.001 and 0.002 must not both be 0.00.
    assert ">0.001<" in drawn
    assert ">0.002<" in drawn
    reported = [json.dumps(draw_live(chart), sort_keys=True) for _ in range(2)]
    assert reported[0] == reported[1]
    assert all(label in reported[0] for label in ("line", "points", "margin"))
    # The legend stands beside both pictures.
    assert [each.label for each in build_legend(chart).panels[0]] == ["line", "band", "points", "stretch", "limit"]
    # No colour of a drawing is fixed but those of a map, which stay on any paper.
    assert not [colour for colour in dark_colours() if colour in drawn]


def test_a_logarithmic_side_within_a_decade_has_numbers() -> None:
    line = Line(x=np.array([2e-4, 8e-4]), y=np.array([3e-4, 7e-4]))
    sides = Scale(label="f", spacing="log"), Scale(label="G", spacing="log")
    chart = Chart(key="g", title="G", alternative="A line.", panels=(Panel(x=sides[0], y=sides[1], elements=(line,)),))
    (still,) = draw_stills(chart)
    assert still.svg.count(">5e-4<") == 2


def luminance(colour: str) -> float:
    """The relative luminance of the accessibility guidelines (WCAG 2.2)."""
    shares = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    red, green, blue = (each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in shares)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@pytest.mark.parametrize("dark", [False, True])
def test_every_colour_stands_out_from_its_paper(dark: bool) -> None:
    reported = dict(each.split(": ") for each in colour_variables(dark=dark).rstrip(";").split("; "))
    paper = luminance(reported.pop("--draw-paper"))
    assert (paper < 0.1) == dark
    for name, colour in reported.items():
        low, high = sorted((luminance(colour), paper))
        contrast = (high + 0.05) / (low + 0.05)
        # Text as the guidelines ask for; strokes that carry data; the grid is meant to stay behind.
        least = 7.0 if name == "--draw-ink" else 1.2 if name == "--draw-grid" else 1.6
        assert contrast > least, (name, contrast)


def test_a_legend_is_reported_once_and_panel_by_panel_only_where_panels_share_nothing() -> None:
    x = np.array([0.0, 1.0])
    side = Scale(label="s")

    def panel(*names: str) -> Panel:
        return Panel(x=side, y=side, elements=tuple(Line(x=x, y=x, label=name) for name in names))

    def legend(*panels: Panel, beside: bool) -> tuple[list[str], list[list[str]]]:
        found = build_legend(Chart(key="k", title="t", alternative="a", panels=panels, beside=beside))
        return [each.label for each in found.whole], [[each.label for each in part] for part in found.panels]

    assert legend(panel("a", "b", "a"), panel("a"), beside=True) == (["a", "b"], [[], []])
    assert legend(panel("a"), panel("b"), beside=True) == ([], [["a"], ["b"]])
    # Below each other the panels are one drawing.
    assert legend(panel("a"), panel("b"), beside=False) == (["a", "b"], [[], []])


@given(
    x=st.tuples(st.floats(-5.0, 5.0), st.floats(0.1, 9.0)),
    y=st.tuples(st.floats(-5.0, 5.0), st.floats(0.1, 9.0)),
    shape=st.floats(0.3, 3.0),
)
def test_fitted_limits_keep_circles_round_and_lose_nothing(
    x: tuple[float, float], y: tuple[float, float], shape: float
) -> None:
    wanted = (x[0], x[0] + x[1]), (y[0], y[0] + y[1])
    found = fitted_limits(*wanted, shape)
    lengths = [high - low for low, high in found]
    assert lengths[0] / lengths[1] == pytest.approx(shape)
    for (low, high), (least, most) in zip(found, wanted, strict=True):
        assert low <= least + 1e-9
        assert high >= most - 1e-9


def test_panels_beside_each_other_have_one_scale_that_holds_them_all() -> None:
    x, side = np.array([0.0, 1.0]), Scale(label="force [N]")
    curves = (np.array([0.0, -70.0]), np.array([3.0, np.nan]))
    levelled = level_panels([Panel(x=side, y=side, elements=(Line(x=x, y=y),)) for y in curves])
    first, second = (panel.y.limits for panel in levelled)
    assert first == second
    assert first is not None
    assert first[0] < -70.0
    assert first[1] > 3.0


def test_the_numbers_in_a_table_of_names_have_no_sign_where_they_are_nothing() -> None:
    names = (("a", "b"), ("c",))
    values = np.array([[-0.001, -0.7]])
    heat = Heat(
        x=np.arange(2.0), y=np.zeros(1), values=values, label="r", limits=(-1.0, 1.0), names=names, written=True
    )
    assert list(heat.writings()) == [(0.0, 0.0, "0", False), (1.0, 0.0, "−.70", True)]


def test_a_chart_is_drawn_on_given_axes_or_as_a_figure_of_its_own() -> None:
    chart = everything()
    figure = draw(chart)
    assert [axes.get_xlabel() for axes in figure.axes[:2]] == ["x", "a"]
    given = Figure().subplots(1, 2)
    assert draw(chart, given) is given[0].figure
    plain, mapped = given
    assert (plain.get_xscale(), plain.get_ylim(), plain.get_title()) == ("log", (0.0, 0.006), "plain")
    assert {text.get_text() for text in plain.get_legend().get_texts()} == {
        *("line", "band", "points", "stretch", "limit")
    }
    # The map has no named lines, and a scale of colours beside it.
    assert mapped.get_legend() is None
    assert [axes.get_ylabel() for axes in given[0].figure.axes] == ["y", "b", "margin"]
    drawn = {tuple(line.get_xdata()) for line in plain.lines}
    assert (1.0, 2.0, 4.0) in drawn
    alone = Chart(key="one", title="One", alternative="A panel.", panels=chart.panels[:1])
    axes = Figure().add_subplot()
    assert draw(alone, axes, legend=False) is axes.figure
    assert axes.get_legend() is None


def test_axes_that_hold_something_below_zero_are_drawn_on_too() -> None:
    line = Line(x=np.array([2e-4, 8e-4]), y=np.array([3e-4, 7e-4]))
    sides = Scale(label="f", spacing="log"), Scale(label="G", spacing="log")
    chart = Chart(key="g", title="G", alternative="A line.", panels=(Panel(x=sides[0], y=sides[1], elements=(line,)),))
    axes = Figure().add_subplot()
    axes.set_ylim(-2.0, 3.0)
    axes.set_autoscale_on(False)
    draw(chart, axes)
    assert axes.get_yscale() == "log"
    assert len(axes.lines) == 1


def test_axes_and_panels_must_be_as_many() -> None:
    with pytest.raises(ValueError, match="has 2 panels and needs as many axes, found 1"):
        draw(everything(), Figure().add_subplot())


@pytest.mark.parametrize(("last", "expected"), [(np.nan, ["unstable"]), (3.0, [])])
def test_a_hole_of_a_map_is_in_its_legend(last: float, expected: list[str]) -> None:
    heat = Heat(x=np.arange(2.0), y=np.arange(1.0), values=np.array([[1.0, last]]), label="margin", hole="unstable")
    panel = Panel(x=Scale(label="x"), y=Scale(label="y"), elements=(heat,))
    figure = draw(Chart(key="map", title="Map", alternative="", panels=(panel,)))
    assert [each.get_text() for legend in figure.legends for each in legend.get_texts()] == expected


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_numbers_of_classes_have_no_ticks_between_them(count: int) -> None:
    numbers = np.arange(1.0, count + 1.0)
    side = Scale(label="class", limits=(0.5, count + 0.5), counts=True)
    panel = Panel(x=side, y=Scale(label="peak [N]"), elements=(Points(x=numbers, y=numbers),))
    axes = Figure().subplots()
    matplotlib_renderer.draw_panel(axes, panel)
    shown = [tick for tick in axes.get_xticks() if 0.5 <= tick <= count + 0.5]
    assert shown
    assert all(float(tick).is_integer() for tick in shown)
    ticker = bokeh_renderer.draw_panel(panel, False).xaxis[0].ticker
    assert ticker.min_interval == 1.0


@pytest.mark.parametrize("spacing", ["linear", "log"])
def test_lines_of_equal_value_lie_where_the_values_are_theirs(spacing: Any) -> None:
    x, y = np.linspace(1.0, 9.0, 33), np.linspace(0.0, 1.0, 5)
    values = np.outer(np.ones(5), x)
    values[4, 20] = np.nan
    heat = Heat(x=x, y=y, values=values, label="force", smooth=True, spacing=spacing, limits=(1.0, 8.0))
    axes = Figure().add_subplot()
    draw_element(heat, axes)
    (lines,) = (each for each in axes.collections if isinstance(each, ContourSet))
    # The values are x, so each line is upright; none lies at an end of the colours or beyond.
    levels = [float(each) for each in lines.levels]
    assert len(levels) >= 2
    assert all(1.0 < level < 8.0 for level in levels)
    for level, path in zip(levels, lines.get_paths(), strict=True):
        np.testing.assert_allclose(np.asarray(path.vertices)[:, 0], level, rtol=1e-9)
    assert {text.get_text() for text in axes.texts} <= {f"{level:.3g}" for level in levels}
    (colours,) = (each for each in axes.collections if isinstance(each, QuadMesh))
    # What is above the limits has their colour, and no hole is left between the colours.
    drawn = np.asarray(colours.get_array())
    assert (float(np.min(drawn)), float(np.max(drawn))) == (1.0, 8.0)
    assert not np.any(np.isnan(drawn))


def test_cells_of_a_heat_map_touch_and_have_their_middles_inside() -> None:
    for is_log, middles in ((False, np.array([1.0, 1.5, 2.0])), (True, np.array([1.0, 10.0, 100.0]))):
        left, right = _cells(middles, is_log)
        assert right[:-1] == pytest.approx(left[1:])
        assert (np.sqrt(left * right) if is_log else 0.5 * (left + right)) == pytest.approx(middles)
    # One cell alone is as wide as a step of one, on its axis.
    assert np.concatenate(_cells(np.array([3.0]), False)) == pytest.approx([2.5, 3.5])
    assert np.log(np.concatenate(_cells(np.array([3.0]), True))) == pytest.approx(np.log(3.0) + np.array([-0.5, 0.5]))
