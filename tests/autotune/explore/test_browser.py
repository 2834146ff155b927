"""The page in a real browser: drawn, not overflowing, asking nobody else, following the hand, saving."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from bokeh.core.types import ID
from bokeh.util.token import generate_jwt_token

from autotune.charts.palette import dark_colours
from autotune.formats.canonical import short
from autotune.formats.controller import read_controller, write_controller
from tests.autotune.browser import PAINTED, Visit
from tests.autotune.tuning.cases import small_controller

FIGURES = ("contact", "admittance", "nyquist", "requirements", "map")
READY = "() => window.Bokeh && Bokeh.documents[0] && Bokeh.documents[0].get_model_by_name('data-map').data.x.length > 0"
STAR = "x => Math.abs(Bokeh.documents[0].get_model_by_name('data-own').data.x[0] / x - 1) < 1e-3"
# Pixels to a unit, both ways.
SCALES = """() => {
  const plot = Bokeh.documents[0].get_model_by_name('nyquist'), { x_range: x, y_range: y } = plot;
  return [plot.inner_width / (x.end - x.start), plot.inner_height / (y.end - y.start)];
}"""
# Paints a figure again, without what the engine's pen has traced since; whether that changes a pixel.
CHANGES_WHEN_PAINTED_AGAIN = """key => {
  const view = Bokeh.index.get(Bokeh.documents[0].get_model_by_name(key)), { ctx } = view.canvas_view.primary;
  const pixels = () => ctx.getImageData(0, 0, ctx.canvas.width, ctx.canvas.height).data;
  const before = pixels();
  ctx.beginPath();
  view.invalidate_painters();
  view.repaint();
  return pixels().some((value, i) => value !== before[i]);
}"""
# Pixels of a figure's frame to the right of a word's place, and above it.
ROOM = """name => {
  const plot = Bokeh.documents[0].get_model_by_name('contact'), { x_range: x, y_range: y } = plot;
  const across = plot.inner_width / (x.end - x.start), up = plot.inner_height / (y.end - y.start);
  const { data } = Bokeh.documents[0].get_model_by_name(name);
  return [...data.x].map((_each, i) => [(x.end - data.x[i]) * across, (y.end - data.y[i]) * up]);
}"""
DRAWN_COLOURS = """() => [...Bokeh.documents[0].all_models].map(
  model => ["line_color", "fill_color", "text_color"].map(key => key in model && model[key])
).flat().map(given => given && given.value || given).filter(each => typeof each === "string")"""
CONTACT = "() => Array.from(Bokeh.documents[0].get_model_by_name('data-contact').data.y)"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> Iterator[tuple[str, Path]]:
    """The address of a server of its own process, and the file that it may write."""
    folder = tmp_path_factory.mktemp("explore")
    write_controller(folder / "old.yaml", small_controller())
    arguments = ["explore", "old.yaml", "-o", "tried.yaml", "--json"]
    environment = {**os.environ, "PYTHONPATH": str(repository), "BOKEH_RESOURCES": "cdn"}
    with subprocess.Popen(
        [sys.executable, "-m", "autotune", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env=environment,
    ) as server:
        assert server.stdout is not None
        reported = ""
        while not reported.endswith("}\n"):
            line = server.stdout.readline()
            assert line, "the server ended before it printed its address"
            reported += line
        yield json.loads(reported)["url"], folder / "tried.yaml"
        server.send_signal(signal.SIGINT)
        # Also with a visitor there.
        _, complaints = server.communicate(timeout=20)
        assert (server.returncode, complaints) == (0, "Ended.\n")


def visit_of(browser: Any, url: str, width: int, scheme: str) -> Visit:
    visit = Visit(browser, url, width, scheme)
    visit.page.wait_for_function(READY, timeout=60_000)
    return visit


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_every_figure_is_drawn_and_nothing_overflows(
    browser: Any, served: tuple[str, Path], width: int, scheme: str
) -> None:
    url, _ = served
    visit = visit_of(browser, url, width, scheme)
    for key in FIGURES:
        visit.page.wait_for_function(f"() => ({PAINTED})('{key}') > 0.005", timeout=30_000)
    across, up = visit.page.evaluate(SCALES)
    # A frame is a whole number of pixels wide.
    assert across == pytest.approx(up, rel=0.02)
    ink = "getComputedStyle(document.documentElement).getPropertyValue('--ink').trim()"
    assert visit.page.evaluate(f"{ink} === Bokeh.documents[0].get_model_by_name('ratios').text_color.value")
    visit.check()
    visit.page.close()


def test_the_hand_is_followed_and_what_holds_is_saved(browser: Any, served: tuple[str, Path]) -> None:
    url, out = served
    visit = visit_of(browser, url, 1280, "light")
    page = visit.page
    before = page.evaluate(CONTACT)
    # A key turns the damping by a few per cent.
    handle = page.get_by_role("slider", name="B_a admittance damping")
    assert handle.get_attribute("aria-valuetext") == f"{small_controller().axes['x'].damping:.4g} N·s/m"
    handle.focus()
    for _ in range(4):
        handle.press("PageUp")
    page.wait_for_function(f"before => JSON.stringify(({CONTACT})()) !== JSON.stringify(before)", arg=before)
    page.get_by_text("misses free-space admittance").wait_for()
    turned = handle.get_attribute("aria-valuetext")
    assert turned is not None
    assert float(turned.removesuffix(" N·s/m")) > small_controller().axes["x"].damping
    field = page.get_by_role("textbox", name="B_a admittance damping")
    assert float(field.input_value()) == pytest.approx(float(turned.removesuffix(" N·s/m")), rel=1e-3)
    # The map lies further down, and follows once the hand rests.
    page.wait_for_function(STAR, arg=float(turned.removesuffix(" N·s/m")))
    save = page.get_by_role("button", name="Validate and save tried.yaml")
    save.click()
    page.get_by_text("Not written.").wait_for(timeout=60_000)
    assert not out.exists()
    page.get_by_text("Writes tried.yaml, which does not exist yet.").wait_for()
    page.get_by_role("button", name="Back to the start").click()
    page.wait_for_function(f"before => JSON.stringify(({CONTACT})()) === JSON.stringify(before)", arg=before)
    page.get_by_text("Of an earlier design:").wait_for()
    save.click()
    page.get_by_text("Validated (").wait_for(timeout=120_000)
    read = read_controller(out)
    assert read.controller.axes == small_controller().axes
    page.get_by_text(f"Replaces tried.yaml, the controller of checksum {short(read.checksum)}.").wait_for()
    assert visit.complaints == []


def test_a_number_that_is_typed_moves_its_slider_and_what_is_none_is_put_back(
    browser: Any, served: tuple[str, Path]
) -> None:
    visit = visit_of(browser, served[0], 1280, "light")
    page = visit.page
    field, handle = (page.get_by_role(role, name="B_a admittance damping") for role in ("textbox", "slider"))
    field.fill("1412")
    field.press("Enter")
    page.wait_for_function(STAR, arg=1412.0)
    assert handle.get_attribute("aria-valuetext") == "1412 N·s/m"
    for typed in ("1e9", "12,5", "", "fast"):
        field.fill(typed)
        field.press("Tab")
        reported = page.get_by_text(f"must be a number from 100 to 10000; “{typed}” was put back.")
        reported.wait_for()
        assert (field.input_value(), field.get_attribute("aria-invalid")) == ("1412", "true")
    field.fill("1300")
    field.press("Tab")
    page.wait_for_function(STAR, arg=1300.0)
    assert not reported.is_visible()
    # A requirement is typed alike, and the circle of the picture follows.
    margin = page.get_by_role("textbox", name="Modulus margin at least")
    margin.fill("0.9")
    margin.press("Enter")
    page.get_by_text("misses modulus margin").wait_for()
    assert visit.complaints == []
    page.close()


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_a_turned_figure_has_nothing_of_the_last_one_and_its_words_in_the_frame(
    browser: Any, served: tuple[str, Path], width: int, scheme: str
) -> None:
    visit = visit_of(browser, served[0], width, scheme)
    page = visit.page
    legend = page.locator("#contact + ul li")
    labels = "all => all.filter(each => !each.hidden).map(each => each.textContent)"
    shown = legend.evaluate_all(labels)
    assert shown == ["as begun", "at the sensor", "at the contact"]
    # Nothing is said of a save yet: no line is left free for it.
    status = page.locator(".now[role=status] .bk-Div").last
    assert status.evaluate("each => each.getBoundingClientRect().height") == 0
    page.get_by_role("button", name="Keep this design").click()
    page.get_by_role("button", name="Return to design 1").wait_for()
    field = page.get_by_role("textbox", name="B_a admittance damping")
    for typed in ("900", "300", "110"):
        field.fill(typed)
        field.press("Enter")
        page.wait_for_function(STAR, arg=float(typed))
    page.get_by_text("Unstable on the plant that you look at").wait_for()
    assert legend.evaluate_all(labels) == ["kept, by number", "as begun", "unstable"]
    for key in ("contact", "admittance", "nyquist"):
        page.locator(f"#{key}").scroll_into_view_if_needed()
        page.wait_for_function(f"() => ({PAINTED})('{key}') > 0.005", timeout=30_000)
        assert not page.evaluate(f"({CHANGES_WHEN_PAINTED_AGAIN})('{key}')"), key
    # A word of 12 px and what lies between it and its place; the longest is 90 px wide.
    ((right, above),) = page.evaluate(ROOM, "data-ending")
    assert above > 18
    aligned = page.evaluate("() => Bokeh.documents[0].get_model_by_name('data-ending').data.align[0]")
    frame = page.evaluate("() => Bokeh.documents[0].get_model_by_name('contact').inner_width")
    assert (right if aligned == "left" else frame - right) > 90
    assert all(above > 18 for _right, above in page.evaluate(ROOM, "data-kept"))
    drawn = set(page.evaluate(DRAWN_COLOURS)) & set(dark_colours())
    assert bool(drawn) == (scheme == "light"), drawn
    visit.check()
    page.close()


def test_a_kept_design_is_returned_to_and_removed_by_a_click(browser: Any, served: tuple[str, Path]) -> None:
    visit = visit_of(browser, served[0], 390, "light")
    page = visit.page
    keep, field = (
        page.get_by_role("button", name="Keep this design"),
        page.get_by_role("textbox", name="B_a admittance"),
    )
    began = field.input_value()
    keep.click()
    back = page.get_by_role("button", name="Return to design 1")
    back.wait_for()
    field.fill("1500")
    field.press("Enter")
    page.wait_for_function(STAR, arg=1500.0)
    back.click()
    page.wait_for_function(STAR, arg=float(began))
    assert field.input_value() == began
    page.get_by_role("button", name="Remove design 1").click()
    back.wait_for(state="detached")
    visit.check()
    page.close()


def test_a_server_that_has_gone_is_reported_and_nothing_can_be_turned(browser: Any, served: tuple[str, Path]) -> None:
    url, _ = served
    page, kept = browser.new_page(), []
    page.route_web_socket("**/ws", lambda socket: kept.append((socket, socket.connect_to_server())))
    page.goto(url)
    page.wait_for_function(READY, timeout=60_000)
    handle, banner = page.get_by_role("slider", name="B_a admittance damping"), page.get_by_role("alert")
    assert not banner.is_visible()
    before = handle.get_attribute("aria-valuetext")
    # Turned, and not answered any more.
    page.evaluate("Bokeh.documents[0].get_model_by_name('damping').setv({value: 3.3}, {sync: false})")
    for socket, _server in kept:
        socket.close()
    banner.wait_for(timeout=20_000)
    assert banner.inner_text() == "The server has ended; what you see is of the last design."
    assert handle.get_attribute("aria-valuetext") == before
    handle.press("PageUp")
    assert handle.get_attribute("aria-valuetext") == before
    assert page.get_by_role("button", name="Validate and save tried.yaml").is_disabled()
    page.close()


@pytest.mark.slow
def test_only_who_knows_the_address_and_comes_from_it_is_served(served: tuple[str, Path]) -> None:
    url, _ = served
    address = urlsplit(url)
    upgrade = {
        "Upgrade": "websocket",
        "Connection": "Upgrade",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "MTIzNDU2Nzg5MDEyMzQ1Ng==",
    }

    def status(path: str, headers: dict[str, str]) -> int:
        connection = HTTPConnection(str(address.hostname), address.port, timeout=20)
        connection.request("GET", path, headers=headers)
        found = connection.getresponse().status
        connection.close()
        return found

    assert status(address.path, {}) == 200
    assert [status(path, {}) for path in ("/", "/guess/", "/static/js/bokeh.min.js")] == [404, 404, 404]
    called = [f"{name}:{address.port}" for name in ("127.0.0.1", "localhost", "evil.example")] + ["127.0.0.1"]
    assert [status(address.path, {"Host": host}) for host in called] == [200, 200, 403, 403]
    upgraded = f"{address.path}ws"

    def opens(name: str, origin: str, *offered: str) -> bool:
        host = f"{name}:{address.port}"
        given = {"Host": host, "Origin": f"http://{origin or host}", "Sec-WebSocket-Protocol": ", ".join(offered)}
        found = status(upgraded, {**upgrade, **given})
        assert found in {101, 403}
        return found == 101

    # Such a token is in the page; one that is made up is refused without a word on the terminal.
    token, old = (generate_jwt_token(ID("id"), expiration=seconds) for seconds in (60, -60))
    assert [opens(name, "", "bokeh", token) for name in ("127.0.0.1", "localhost", "evil.example")] == [1, 1, 0]
    assert not opens("127.0.0.1", "elsewhere.example", "bokeh", token)
    for offered in ((), ("bokeh",), ("other", token), ("bokeh", old), ("bokeh", "nonsense")):
        assert not opens("127.0.0.1", "", *offered)
