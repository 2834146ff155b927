"""The page without a browser: what happens in its document when something is turned."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bokeh.document import Document
from bokeh.document.events import ModelChangedEvent
from bokeh.events import DocumentReady
from bokeh.server.callbacks import TimeoutCallback

from autotune.explore.page import ExplorePage, build_page
from autotune.explore.saving import Target, refused_line
from tests.autotune.explore.start import small_exploration


@pytest.fixture
def page(tmp_path: Path) -> ExplorePage:
    return build_page(small_exploration(), Target(tmp_path / "controller.yaml"), Document())


def turn(page: ExplorePage, name: str, value: float) -> None:
    page.sliders[name].value = page.ranges[name].position(value)
    page._answer()


def data(page: ExplorePage, name: str) -> np.ndarray:
    return np.array(page.figures.sources[name].data["y"], dtype=np.float64)


def test_every_slider_has_a_range_that_a_browser_takes_one_of_another_axis_too(tmp_path: Path) -> None:
    free = small_exploration().axes["y"]
    held = replace(free.problem, bounds={**free.problem.bounds, "mass": (6.0, 6.0)})
    axes = {"x": replace(free, problem=held), "y": free}
    page = build_page(replace(small_exploration(), axes=axes), Target(tmp_path / "controller.yaml"), Document())
    assert not all(slider.visible for slider in page.sliders.values())
    for slider in page.sliders.values():
        assert slider.start < slider.end
        assert slider.start <= slider.value <= slider.end
        assert 0.0 < slider.step <= slider.end - slider.start


@pytest.mark.parametrize(("name", "value"), [("damping", 1400.0), ("mass", 7.0), ("payload_mass_kg", 20.0)])
def test_turning_changes_the_transient_and_the_loops(page: ExplorePage, name: str, value: float) -> None:
    before = {key: data(page, key) for key in ("contact", "force", "begun")}
    turn(page, name, value)
    assert not np.array_equal(data(page, "contact"), before["contact"])
    assert not np.array_equal(data(page, "force"), before["force"])
    assert np.array_equal(data(page, "begun"), before["begun"])


def test_the_map_is_computed_again_only_where_it_is_another_one(page: ExplorePage) -> None:
    def cells() -> np.ndarray:
        return np.asarray(np.nan_to_num(page.figures.sources["map"].data["peak"][0]))

    first = cells()
    turn(page, "damping", 1310.0)
    assert cells() is not first
    assert np.array_equal(cells(), first)
    assert page.figures.sources["own"].data["x"] == [1310.0]
    turn(page, "feedback_damping_s", 0.008)
    assert not np.array_equal(cells(), first)


def test_a_finer_map_follows_when_the_hand_rests(page: ExplorePage) -> None:
    rows, columns = page.figures.sources["map"].data["peak"][0].shape
    page.map_panel.refine()
    while page.map_panel.map is None or page.map_panel.map.window.rows == rows:
        page.map_panel.look()
    assert page.figures.sources["map"].data["peak"][0].shape == (2 * rows, 2 * columns)


def test_a_finer_map_that_was_due_before_the_next_turn_is_not_begun_after_it(page: ExplorePage) -> None:
    def due() -> list[TimeoutCallback]:
        return [each for each in page.document.session_callbacks if isinstance(each, TimeoutCallback)]

    (before,) = due()
    turn(page, "feedback_damping_s", 0.008)
    assert before not in due()
    coarse = page.map_panel.map
    before.callback()
    assert page.map_panel.map is coarse
    for _ in range(1000):
        for callback in due():
            callback.callback()
        if not due():
            break
        time.sleep(0.01)
    assert page.map_panel.map is not None
    assert coarse is not None
    assert page.map_panel.map.window.rows == 5 * coarse.window.rows
    before.callback()


def test_a_page_that_is_shown_gets_one_message_for_all_that_a_turn_changes(page: ExplorePage) -> None:
    page.document.callbacks.trigger_event(DocumentReady())
    seen: list[ModelChangedEvent] = []
    page.document.on_change(lambda event: seen.append(event) if isinstance(event, ModelChangedEvent) else None)
    before = data(page, "contact")
    turn(page, "damping", 1310.0)
    by_hand, (sent,) = seen[:1], seen[1:]
    assert (by_hand[0].model, sent.attr) == (page.sliders["damping"], "content")
    changed = json.loads(sent.new["text"])
    assert {"data-contact", "data-command", "data-bars", "data-own", "verdict", "facts"} <= set(changed)
    begin, (count,) = changed["data-contact"]["data"]["y"]["numbers"]
    assert not np.array_equal(sent.new["numbers"][begin : begin + count], before)
    assert np.array_equal(data(page, "contact"), before)


def test_an_unstable_design_shows_no_peak_and_says_so(page: ExplorePage) -> None:
    turn(page, "drag_n_s_per_m", 0.0)
    turn(page, "coupling_damping_n_s_per_m", 0.0)
    turn(page, "damping", 900.0)
    assert "Unstable" in page.verdict.text
    assert "|z|" in page.verdict.text
    assert len(data(page, "contact")) == len(data(page, "peak")) == 0
    assert "peak at the contact</dt><dd>–" in page.facts.text
    diverging = page.figures.sources["diverging"].data
    assert len(diverging["x"]) > 10
    ending = page.figures.sources["ending"].data
    assert list(ending["text"]) in (["diverges"], ["does not settle"])
    assert [list(ending[key]) for key in ("x", "y")] == [[diverging[key][-1]] for key in ("x", "y")]
    assert np.max(np.abs(diverging["y"])) <= page.figures.largest_n
    offered = [page.way_back.visible]
    page._go_back()
    assert len(data(page, "diverging")) == len(data(page, "ending")) == 0
    assert [*offered, page.way_back.visible] == [True, False]
    assert "Meets every requirement" in page.verdict.text
    assert page.designs["x"].tolist() == small_exploration().axes["x"].design.tolist()


def test_what_is_turned_between_two_pictures_is_computed_once(page: ExplorePage) -> None:
    before = len(page.document.session_callbacks)
    for value in (1310.0, 1320.0, 1330.0):
        page.sliders["damping"].value = page.ranges["damping"].position(value)
    assert len(page.document.session_callbacks) == before + 1


def test_the_cell_of_the_star_says_what_the_page_says(page: ExplorePage) -> None:
    start = small_exploration().axes["x"].design
    plot = page.figures.plots["map"]
    assert plot.yaxis.axis_label.endswith("[ms]")
    seen = set()
    for damping, lead in ((1250.0, 0.018), (1180.0, 0.0185), (1400.0, 0.018), (1300.0, 0.013), (1100.0, 0.012)):
        page.sliders["lead_s"].value = page.ranges["lead_s"].position(lead)
        turn(page, "damping", damping)
        assert page.prepared is not None
        said = page.prepared[1].screen.prepared.evaluate(np.array([start[0], damping, lead, start[3]]))
        cell = {name: float(values[0]) for name, values in page.figures.sources["own"].data.items()}
        # The axis of the lead is in milliseconds.
        assert (cell["x"], cell["y"], cell["stable"]) == (damping, 1e3 * lead, said.is_stable)
        assert cell["left"] < damping < cell["right"]
        assert plot.y_range.start <= cell["bottom"] < 1e3 * lead < cell["top"] <= plot.y_range.end
        assert ("Meets every requirement" in page.verdict.text) == said.is_feasible == bool(np.isfinite(cell["peak"]))
        if said.is_feasible:
            assert cell["peak"] == said.cost
            low, high = page.figures.colours.low, page.figures.colours.high
            assert low is not None
            assert high is not None
            assert low <= cell["peak"] <= high
        seen.add(said.is_feasible)
    assert seen == {True, False}


def test_a_map_without_a_feasible_design_has_no_scale(page: ExplorePage) -> None:
    assert page.figures.bar.visible
    turn(page, "delay_s", page.ranges["delay_s"].high)
    assert not np.isfinite(page.figures.sources["map"].data["peak"][0]).any()
    assert not page.figures.bar.visible


def test_words_about_an_earlier_design_say_so(page: ExplorePage) -> None:
    page.saver.show("<p>Validated.</p>", {name: np.array(design) for name, design in page.designs.items()})
    page.update()
    assert page.saver.status.text == "<p>Validated.</p>"
    turn(page, "payload_mass_kg", 20.0)
    assert page.saver.status.text == "<p>Validated.</p>"
    turn(page, "damping", 1310.0)
    assert "Of an earlier design:" in page.saver.status.text
    page.choice.value = "y"
    page._go_back()
    assert "Of an earlier design:" in page.saver.status.text
    page.choice.value = "x"
    page._go_back()
    assert page.saver.status.text == "<p>Validated.</p>"


def test_each_axis_keeps_its_own_design(page: ExplorePage) -> None:
    turn(page, "damping", 1400.0)
    page.choice.value = "y"
    assert page.ranges["damping"].value(page.sliders["damping"].value) == 1250.0
    page.choice.value = "x"
    assert page.ranges["damping"].value(page.sliders["damping"].value) == 1400.0
    assert page.designs["x"].tolist() == [6.0, 1400.0, 0.018, 0.005]


def test_two_visitors_share_nothing(page: ExplorePage, tmp_path: Path) -> None:
    other = build_page(small_exploration(), Target(tmp_path / "controller.yaml"), Document())
    turn(page, "damping", 1400.0)
    assert other.designs["x"][1] == 1250.0


def test_a_page_about_torques_says_so(tmp_path: Path) -> None:
    axes = small_exploration().axes
    for names, reported in ((["rx"], "Torque over time"), (["x", "rx"], "Force or torque over time")):
        document = Document()
        exploration = replace(small_exploration(), axes=dict.fromkeys(names, axes["x"]))
        build_page(exploration, Target(tmp_path / "controller.yaml"), document)
        assert document.template_variables["figures"]["contact"][1].startswith(reported)


def test_requirements_that_are_set_are_judged_drawn_and_shared_by_axes_of_a_kind(page: ExplorePage) -> None:
    before = np.nan_to_num(page.figures.sources["map"].data["peak"][0])
    circle, limit = data(page, "circle"), data(page, "target")
    assert (circle.max(), limit.tolist()) == (pytest.approx(0.4), [6.5e-4] * 2)
    turn(page, "asked-modulus_margin", 0.9)
    assert "misses modulus margin" in page.verdict.text
    assert data(page, "circle").max() == pytest.approx(0.9)
    assert not np.array_equal(np.nan_to_num(page.figures.sources["map"].data["peak"][0]), before)
    turn(page, "asked-free_space_admittance", 1e-3)
    assert data(page, "target").tolist() == [1e-3] * 2
    assert "free-space admittance" in page.verdict.text
    for name in ("x", "y"):
        asked = page.present().axes[name].problem.requirements
        assert asked.modulus_margin == 0.9
        assert asked.free_space_admittance is not None
        assert asked.free_space_admittance.min_m_s_per_n == 1e-3
    page._go_back()
    assert page.present() is page.exploration
    assert "Meets every requirement" in page.verdict.text


def test_the_nearest_feasible_design_is_one_and_is_reported(page: ExplorePage) -> None:
    page.sliders["lead_s"].value = page.ranges["lead_s"].position(0.0)
    turn(page, "damping", 450.0)
    assert "Meets" not in page.verdict.text
    page.map_panel.refine()
    while page.map_panel.map is None or page.map_panel.map.window.columns < 16:
        page.map_panel.look()
    page._go_to_feasible()
    assert "Meets every requirement" in page.verdict.text
    assert "Moved to the nearest feasible cell of the map." in page.searcher.status.text
    assert not page.way_back.visible
    turn(page, "damping", 1310.0)
    assert page.searcher.status.text == ""


def test_text_from_files_is_text() -> None:
    assert "<script" not in refused_line("<script>")
