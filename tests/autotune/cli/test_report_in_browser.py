"""Reports in a real browser: every figure is there, still and zoomed; nothing overflows; nothing leaves the page."""

from pathlib import Path
from typing import Any

import pytest

from autotune.cli.main import main
from autotune.files.controller import write_controller
from tests.autotune.browser import PAINTED, Visit
from tests.autotune.tuning.cases import small_controller

STILL = "() => [...document.querySelectorAll('img')].map(each => [each.complete, each.naturalWidth, each.offsetWidth])"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, good_log: Path) -> dict[str, Path]:
    """The page of a log and that of a controller, written by the commands."""
    folder = tmp_path_factory.mktemp("pages")
    told, controller = folder / "identified.yaml", folder / "controller.yaml"
    write_controller(controller, small_controller())
    out = {name: folder / f"{name}.html" for name in ("identify", "report")}
    assert main(["identify", str(good_log), "-o", str(told), "--report", str(out["identify"]), "--quiet"]) == 0
    assert main(["report", str(controller), "--samples", "8", "-o", str(out["report"]), "--quiet"]) == 0
    return out


@pytest.mark.parametrize("name", ["identify", "report"])
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_every_figure_is_drawn_still_and_zoomed(
    browser: Any, pages: dict[str, Path], name: str, width: int, scheme: str
) -> None:
    visit = Visit(browser, pages[name].as_uri(), width, scheme)
    page = visit.page
    stills = page.evaluate(STILL)
    assert len(stills) >= 5
    assert all(complete and own > 100 and shown > 100 for complete, own, shown in stills)
    visit.check()
    buttons = page.get_by_role("button", name="Zoom and read values")
    keys = [each.get_attribute("data-chart") for each in buttons.all()]
    assert len(keys) == len(stills)
    # By keyboard, as those do who have no mouse; every click takes its button out of the list.
    for _ in keys:
        buttons.first.press("Enter")
    for key in keys:
        page.wait_for_function(f"() => ({PAINTED})('{key}') > 0.005", timeout=30_000)
    assert not any(shown for _, _, shown in page.evaluate(STILL))
    visit.check()
    page.get_by_role("button", name="Back to the picture").first.press("Enter")
    assert sum(shown > 100 for _, _, shown in page.evaluate(STILL)) == 1
    page.close()


def test_on_paper_the_pictures_are_there_and_the_buttons_are_not(browser: Any, pages: dict[str, Path]) -> None:
    visit = Visit(browser, pages["report"].as_uri(), 1000, "dark")
    visit.page.get_by_role("button", name="Zoom and read values").first.press("Enter")
    visit.page.emulate_media(media="print")
    assert all(shown > 100 for _, _, shown in visit.page.evaluate(STILL))
    assert not visit.page.get_by_role("button").first.is_visible()
    assert visit.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    visit.page.close()
