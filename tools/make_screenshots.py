"""Make the screenshots of the documentation: the demo's report and `autotune explore`, in Debian's Chromium.

Usage: python tools/make_screenshots.py [FOLDER]     (docs/pictures by default; takes about a minute)
"""

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

ROOT = Path(__file__).resolve().parent.parent
AUTOTUNE = (sys.executable, "-m", "autotune")
# Of the report: name of the picture, the figure that it begins with, its height in pixels.
SHOTS = (
    ("report-log", "part-2-wrench-1", 700),
    ("report-contacts", "part-2-x-x1-contacts", 830),
    ("report-design", "part-1-x-nyquist", 760),
)
READY = "() => window.Bokeh && Bokeh.documents[0] && Bokeh.documents[0].get_model_by_name('data-map').data.x.length > 0"


def main() -> int:
    """Run the demo, open its pages and write the pictures."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    chromium = shutil.which("chromium")
    if chromium is None:
        raise SystemExit("Install Debian's package chromium.")
    with tempfile.TemporaryDirectory() as work, sync_playwright() as tools:
        demo = Path(work) / "demo"
        subprocess.run([*AUTOTUNE, "demo", str(demo), "--quiet"], check=True, cwd=ROOT)
        browser = tools.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        shoot_report(browser, demo / "report.html", folder)
        shoot_explore(browser, demo / "controller.yaml", folder)
        browser.close()
    return 0


def shoot_report(browser: Any, report: Path, folder: Path) -> None:
    """Take each figure of `SHOTS` with what stands below it."""
    page = browser.new_page(viewport={"width": 1000, "height": 900}, color_scheme="light")
    page.goto(report.as_uri())
    for name, figure, height in SHOTS:
        box = page.locator(f"#{figure}").bounding_box()
        clip = {"x": 0, "y": box["y"] - 10, "width": 1000, "height": height}
        page.screenshot(path=folder / f"{name}.png", full_page=True, clip=clip)


def shoot_explore(browser: Any, controller: Path, folder: Path) -> None:
    """Take the page of `autotune explore` when its map is there."""
    command = [
        *AUTOTUNE,
        "explore",
        str(controller),
        "--no-open",
        "--json",
        "-o",
        "own.yaml",
    ]
    # Beside the controller, so that the picture shows no path of this machine.
    beside: dict[str, Any] = {"cwd": controller.parent, "env": {**os.environ, "PYTHONPATH": str(ROOT)}}
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, **beside) as server:
        answer = ""
        while not answer.endswith("}\n"):
            line = "" if server.stdout is None else server.stdout.readline()
            if not line:
                raise SystemExit("autotune explore ended before it printed its address.")
            answer += line
        page = browser.new_page(viewport={"width": 1280, "height": 1000}, color_scheme="light")
        page.goto(json.loads(answer)["url"])
        page.wait_for_function(READY, timeout=60_000)
        page.wait_for_timeout(1500)
        page.screenshot(path=folder / "explore.png")
        server.send_signal(signal.SIGINT)
        server.wait(timeout=20)


if __name__ == "__main__":
    sys.exit(main())
