"""The page in a real browser: drawn, not overflowing, asking nobody else, following the hand, saving."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from autotune.files.controller import read_controller, write_controller
from tests.autotune.tuning.cases import small_controller

FIGURES = ("contact", "admittance", "nyquist", "requirements", "map")
READY = "() => window.Bokeh && Bokeh.documents[0] && Bokeh.documents[0].get_model_by_name('data-map').data.x.length > 0"
# The share of a figure's pixels that are painted: what the engine draws lies on canvases inside of shadow roots.
PAINTED = """key => {
  const canvases = [];
  const walk = node => {
    if (node.tagName === 'CANVAS') canvases.push(node);
    for (const child of [...(node.shadowRoot ? node.shadowRoot.children : []), ...node.children]) walk(child);
  };
  walk(document.getElementById(key));
  let painted = 0, all = 0;
  for (const canvas of canvases.filter(each => each.width > 0 && each.height > 0)) {
    const pixels = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
    for (let i = 3; i < pixels.length; i += 4) { all += 1; painted += pixels[i] > 0; }
  }
  return all ? painted / all : 0;
}"""
CONTACT = "() => Array.from(Bokeh.documents[0].get_model_by_name('data-contact').data.y)"


def chromium() -> str:
    found = shutil.which("chromium")
    if found is None:
        if os.environ.get("CI") == "true":
            pytest.fail("Chromium must be there in CI; install Debian's package chromium.")
        pytest.skip("needs Debian's chromium")
    return found


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
        told = ""
        while not told.endswith("}\n"):
            line = server.stdout.readline()
            assert line, "the server ended before it told its address"
            told += line
        yield json.loads(told)["url"], folder / "tried.yaml"
        server.send_signal(signal.SIGINT)
        # Also with a visitor there.
        _, complaints = server.communicate(timeout=20)
        assert (server.returncode, complaints) == (0, "Ended.\n")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    path = chromium()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as tools:
        opened = tools.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield opened
        opened.close()


class Visit:
    """One opened page, and what it asked for and complained of."""

    def __init__(self, browser: Any, url: str, width: int, scheme: str) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        self.requests: list[str] = []
        self.complaints: list[str] = []
        self.page.on("request", lambda asked: self.requests.append(asked.url))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", lambda told: self.complaints.extend([told.text] if told.type == "error" else []))
        self.page.goto(url)
        self.page.wait_for_function(READY, timeout=60_000)


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_every_figure_is_drawn_and_nothing_overflows(
    browser: Any, served: tuple[str, Path], width: int, scheme: str
) -> None:
    url, _ = served
    visit = Visit(browser, url, width, scheme)
    for key in FIGURES:
        visit.page.wait_for_function(f"() => ({PAINTED})('{key}') > 0.005", timeout=30_000)
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= width
    assert all(each.startswith((url, "data:", "blob:")) for each in visit.requests), visit.requests
    assert visit.complaints == []
    visit.page.close()


def test_the_hand_is_followed_and_what_holds_is_saved(browser: Any, served: tuple[str, Path]) -> None:
    url, out = served
    visit = Visit(browser, url, 1280, "light")
    page = visit.page
    before = page.evaluate(CONTACT)
    # The second handle is that of the damping; an arrow key turns it by a few per cent.
    handle = page.get_by_role("slider").nth(1)
    handle.focus()
    for _ in range(4):
        handle.press("PageUp")
    page.wait_for_function(f"before => JSON.stringify(({CONTACT})()) !== JSON.stringify(before)", arg=before)
    page.get_by_text("misses free-space admittance").wait_for()
    save = page.get_by_role("button", name="Validate and save tried.yaml")
    save.click()
    page.get_by_text("Not written.").wait_for(timeout=60_000)
    assert not out.exists()
    page.get_by_role("button", name="Back to the start").click()
    page.wait_for_function(f"before => JSON.stringify(({CONTACT})()) === JSON.stringify(before)", arg=before)
    save.click()
    page.get_by_text("Validated (").wait_for(timeout=120_000)
    assert read_controller(out).controller.axes == small_controller().axes
    assert visit.complaints == []


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
    upgraded = f"{address.path}ws"
    assert status(upgraded, {**upgrade, "Origin": "http://elsewhere.example"}) == 403
