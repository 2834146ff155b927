"""Reports in a real browser: every figure is there, still and zoomed; nothing overflows; nothing leaves the page."""

from itertools import combinations
from pathlib import Path
from typing import Any

import pytest

from autotune.cli.main import main
from autotune.formats.controller import write_controller
from tests.autotune.browser import PAINTED, Visit
from tests.autotune.tuning.cases import small_controller

# The box of a text holds room above and below its letters, which may touch that of the next line.
_LINE_BOX = 4.0
STILL = """() => [...document.querySelectorAll('.still')].map(
  each => [each.querySelectorAll('svg path').length, each.offsetWidth])"""
# Every text of a drawing that can be seen, with its place on the screen.
TEXTS = """() => [...document.querySelectorAll('.still svg')].map(drawing =>
  [...drawing.querySelectorAll('text')].filter(each => !/rotate/.test(each.getAttribute('transform') ?? ''))
    .map(each => { const box = each.getBoundingClientRect();
      return [each.textContent, box.left, box.top, box.right, box.bottom]; }))"""
# Legends that lie on a drawing, panels and tables that are wider than the screen, verdicts that cannot be seen.
MISPLACED = """() => {
  const boxes = query => [...document.querySelectorAll(query)].map(each => [each, each.getBoundingClientRect()]);
  const drawings = boxes('.still svg');
  const apart = (a, b) => a.right <= b.left || b.right <= a.left || a.bottom <= b.top || b.bottom <= a.top;
  return [
    ...boxes('figure > .legend, .still .legend').filter(([, a]) => drawings.some(([, b]) => !apart(a, b))),
    ...boxes('.panel, .legend li, td.good, td.warn, td.bad').filter(([, a]) => a.right > window.innerWidth),
  ].map(([each]) => each.textContent.slice(0, 40));
}"""
INK = """() => {
  const sides = window.Bokeh.documents.flatMap(each => each.roots()).map(each => each.below[0]);
  return [getComputedStyle(document.documentElement).getPropertyValue('--draw-ink').trim(),
    ...new Set(sides.map(each => each.properties.major_label_text_color.get_value()))];
}"""


def overlaps(texts: list[tuple[str, float, float, float, float]]) -> list[tuple[str, str]]:
    """Return pairs of texts of one drawing of which one lies on the other by more than a pixel."""
    return [
        (a[0], b[0])
        for a, b in combinations(texts, 2)
        if min(a[3], b[3]) - max(a[1], b[1]) > 1.0 and min(a[4], b[4]) - max(a[2], b[2]) > _LINE_BOX
    ]


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory, identified_page: Path) -> dict[str, Path]:
    """The page of a log and that of a controller, written by the commands."""
    folder = tmp_path_factory.mktemp("pages")
    controller, out = folder / "controller.yaml", folder / "report.html"
    write_controller(controller, small_controller())
    assert main(["report", str(controller), "--samples", "8", "-o", str(out), "--quiet"]) == 0
    return {"identify": identified_page / "page.html", "report": out}


@pytest.mark.parametrize("name", ["identify", "report"])
@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_every_figure_is_drawn_still_and_zoomed(
    browser: Any, pages: dict[str, Path], name: str, width: int, scheme: str
) -> None:
    visit = Visit(browser, pages[name].as_uri(), width, scheme)
    page = visit.page
    stills = page.evaluate(STILL)
    assert len(stills) >= 5
    assert all(strokes > 10 and shown > 100 for strokes, shown in stills)
    visit.check()
    for texts in page.evaluate(TEXTS):
        assert all(left >= 0.0 and right <= width for _, left, _, right, _ in texts), texts
        assert overlaps(texts) == []
    assert page.evaluate(MISPLACED) == []
    buttons = page.get_by_role("button", name="Zoom and read values")
    keys = [each.get_attribute("data-chart") for each in buttons.all()]
    assert len(keys) == len(stills)
    # By keyboard, as those do who have no mouse.
    for each in buttons.all():
        each.press("Enter")
    for key in keys:
        page.wait_for_function(f"() => ({PAINTED})('{key}') > 0.005", timeout=30_000)
    assert not any(shown for _, shown in page.evaluate(STILL))
    visit.check()
    assert page.evaluate(MISPLACED) == []
    ink, *painted = page.evaluate(INK)
    assert painted == [ink]
    # Its state is given by its being pressed, and its name stays what it was.
    assert len(page.get_by_role("button", pressed=True).all()) == len(keys)
    buttons.first.press("Enter")
    assert sum(shown > 100 for _, shown in page.evaluate(STILL)) == 1
    page.close()


def test_on_paper_the_pictures_are_there_and_the_buttons_are_not(browser: Any, pages: dict[str, Path]) -> None:
    visit = Visit(browser, pages["report"].as_uri(), 1000, "dark")
    visit.page.get_by_role("button", name="Zoom and read values").first.press("Enter")
    visit.page.emulate_media(media="print")
    assert all(shown > 100 for _, shown in visit.page.evaluate(STILL))
    ink = visit.page.evaluate("getComputedStyle(document.querySelector('.still text')).fill")
    assert ink == "rgb(51, 51, 51)"
    assert not visit.page.get_by_role("button").first.is_visible()
    assert visit.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    visit.page.close()
