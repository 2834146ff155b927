"""A search that is begun on the page."""

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bokeh.document import Document

from autotune.errors import InfeasibleError
from autotune.explore import searching
from autotune.explore.page import ExplorePage, build_page
from autotune.explore.saving import Target
from autotune.tuning.search import solve_design
from problems.design.problem import DesignProblem
from tests.autotune.explore.start import DESIGN, small_exploration, solved_exploration


def begun(page: ExplorePage) -> ExplorePage:
    page.searcher._clicked()
    return page


@pytest.fixture
def page(tmp_path: Path) -> ExplorePage:
    return build_page(small_exploration(), Target(tmp_path / "controller.yaml"), Document())


def test_what_is_found_from_the_present_design_goes_to_the_sliders(tmp_path: Path) -> None:
    page = build_page(solved_exploration(), Target(tmp_path / "controller.yaml"), Document())
    start = np.array(page.designs["x"])
    page.sliders["damping"].value = page.ranges["damping"].position(1.1 * start[1])
    page._answer()
    present, problem = np.array(page.designs["x"]), page.problem
    asyncio.run(begun(page).searcher.search())
    expected = solve_design(problem, start=present)
    assert page.designs["x"].tolist() == expected.design.tolist()
    assert page.ranges["damping"].value(page.sliders["damping"].value) == expected.design[1]
    assert f"{expected.evaluation.objective_cost:.4g} N in the worst case" in page.searcher.status.text
    assert page.searcher.button.label == "Optimize from here"


def test_a_search_is_cancelled_and_leaves_the_gains(page: ExplorePage, monkeypatch: pytest.MonkeyPatch) -> None:
    reached = threading.Event()

    def endless(_problem: DesignProblem, *, start: np.ndarray, progress: Callable[[float], None]) -> Any:
        assert start.tolist() == DESIGN.tolist()
        for _ in range(100_000):
            progress(1e-5)
            reached.set()
            # Once it is cancelled the next word on progress ends it.
            threading.Event().wait(0.001)

    monkeypatch.setattr(searching, "solve_design", endless)

    async def run() -> None:
        task = asyncio.create_task(begun(page).searcher.search())
        await asyncio.to_thread(reached.wait, 30.0)
        page.searcher._clicked()
        await asyncio.wait_for(task, 30.0)

    asyncio.run(run())
    assert "cancelled; the gains are as they were" in page.searcher.status.text
    assert page.designs["x"].tolist() == DESIGN.tolist()


def test_the_button_shows_how_far_the_search_is_until_it_is_cancelled(
    page: ExplorePage, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks = list[Callable[[], None]]()
    monkeypatch.setattr(page.document, "add_next_tick_callback", ticks.append)
    monkeypatch.setattr(searching, "_EVERY_S", -1.0)
    searcher = begun(page).searcher
    cancelled = searcher._cancelled
    assert cancelled is not None
    assert searcher.button.label == "Cancel the search (0 %)"
    progress = searcher._progress(cancelled)
    for more, label in ((0.25, "25 %"), (0.5, "75 %"), (0.5, "100 %")):
        progress(more)
        ticks[-1]()
        assert searcher.button.label == f"Cancel the search ({label})"
    searcher._clicked()
    ticks[-1]()
    assert searcher.button.label == "Cancelling …"
    with pytest.raises(searching.SearchCancelledError):
        progress(0.1)


def test_why_nothing_is_found_is_reported(page: ExplorePage, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object, **__: object) -> None:
        raise InfeasibleError("It misses <everything>.")

    monkeypatch.setattr(searching, "solve_design", none)
    asyncio.run(begun(page).searcher.search())
    assert "Nothing found. It misses &lt;everything&gt;." in page.searcher.status.text
    assert page.designs["x"].tolist() == DESIGN.tolist()


def test_what_was_found_under_other_requirements_is_not_taken(page: ExplorePage) -> None:
    task = page._search_task()
    page.sliders["asked-modulus_margin"].value = page.ranges["asked-modulus_margin"].position(0.45)
    page._answer()
    found: Any = None
    assert "not taken" in page._found(task, found)
    assert page.designs["x"].tolist() == DESIGN.tolist()
