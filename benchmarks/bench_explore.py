"""How long a change by hand takes in `autotune explore`: computing, and until the browser has it and has drawn it.

Usage: python benchmarks/bench_explore.py [IDENTIFIED_OR_CONTROLLER]

Without a file the controller of the demo is explored. The round trip needs playwright and Chromium.
"""

import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.explore.design_map import build_window, compute_map
from autotune.explore.sliders import nominal_values, scenario_at
from autotune.explore.source import AxisStart, read_exploration
from autotune.explore.view import compute_view, prepare_view
from benchmarks.timing import best

COLUMNS, ROWS = 8, 6
RUNS = 20
RESTS_S = 1.0
# A slider is moved in the page, and the clock stops when the loop's new curve (or the new map) has arrived, and again
# when the first frame is done whose picture of the figure holds it: the frame in which the figure is painted, or, where
# that happens outside of one, the next.
WATCH = """() => {
  const ask = window.requestAnimationFrame.bind(window);
  window.isInFrame = false;
  window.requestAnimationFrame = call => ask(time => {
    window.isInFrame = true;
    try { call(time); } finally { window.isInFrame = false; }
  });
}"""
MOVE = """([slider, source, figure, share]) => new Promise(done => {
  const page = Bokeh.documents[0], control = page.get_model_by_name(slider), shown = page.get_model_by_name(source);
  const view = Bokeh.index.get(page.get_model_by_name(figure)), frame = new MessageChannel();
  const begin = performance.now(), gone = () => performance.now() - begin;
  let has = null;
  const arrived = () => {
    shown.properties.data.change.disconnect(arrived);
    has = gone();
  };
  frame.port1.onmessage = () => done([has, gone()]);
  view.paint = () => {
    Object.getPrototypeOf(view).paint.call(view);
    if (has === null) return;
    delete view.paint;
    const painted = () => frame.port2.postMessage(null);
    if (window.isInFrame) painted(); else requestAnimationFrame(painted);
  };
  shown.properties.data.change.connect(arrived);
  control.value = control.start + share * (control.end - control.start);
})"""
READY = "() => window.Bokeh && Bokeh.documents[0] && Bokeh.documents[0].get_model_by_name('data-map').data.x.length > 0"


def main(arguments: list[str]) -> int:
    with tempfile.TemporaryDirectory() as folder:
        source = Path(arguments[0]) if arguments else make_source(Path(folder))
        exploration = read_exploration(source)
        start = next(iter(exploration.axes.values()))
        print("computing                                       ms")
        for name, run in steps(start).items():
            print(f"{name:44}{1e3 * best(run, RUNS):7.1f}")
        if shutil.which("chromium") is None:
            print("no chromium: no round trip")
            return 0
        print("until the browser                       has it: shortest  median   drew it: shortest  median ms")
        for name, times in round_trips(source, Path(folder)).items():
            columns = "".join(f"{min(each):18.1f}{statistics.median(each):8.1f}" for each in zip(*times, strict=True))
            print(f"{name:38}{columns}")
    return 0


def make_source(folder: Path) -> Path:
    """Run the demo's chain and return its controller."""
    from autotune.demo import run_demo

    return run_demo(folder / "demo").files.controller


def steps(start: AxisStart) -> dict[str, Callable[[], object]]:
    problem, design = start.problem, start.design
    values = nominal_values(problem)
    ready = prepare_view(problem, scenario_at(problem, values), start.scenarios)
    window = build_window(problem, design, ("damping", "lead_s"), columns=COLUMNS, rows=ROWS)
    moved = scenario_at(problem, {**values, "drag_n_s_per_m": 1.1 * values["drag_n_s_per_m"] + 1.0})

    def plant() -> None:
        other = prepare_view(problem, moved, start.scenarios)
        compute_view(other, design)
        compute_map(other.screen, design, window)

    def gain() -> None:
        compute_view(ready, design)
        compute_map(ready.screen, design, window)

    return {
        "a gain of the map's axes: the view": lambda: compute_view(ready, design),
        "another gain: view and map": gain,
        "the plant: sampling, view and map": plant,
        "a moment later: the map twice as fine": lambda: compute_map(ready.screen, design, window.finer(2)),
        "at rest: the map five times as fine": lambda: compute_map(ready.screen, design, window.finer(5)),
    }


def round_trips(source: Path, folder: Path) -> dict[str, list[list[float]]]:
    from playwright.sync_api import sync_playwright

    command = [sys.executable, "-m", "autotune", "explore", str(source.resolve()), "--json", "-o", "tried.yaml"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parent.parent)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder, env=environment) as server:
        assert server.stdout is not None
        answer = "".join(iter(server.stdout.readline, "}\n")) + "}"
        with sync_playwright() as tools:
            browser = tools.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
            page = browser.new_page(viewport={"width": 1280, "height": 900})
            page.add_init_script(f"({WATCH})()")
            page.goto(json.loads(answer)["url"])
            page.wait_for_function(READY)
            found: dict[str, list[list[float]]] = {}
            for name, slider, shown, figure in (
                ("damping to loops", "damping", "data-command", "nyquist"),
                ("feedback damping to map", "feedback_damping_s", "data-map", "map"),
                ("drag to map", "drag_n_s_per_m", "data-map", "map"),
            ):
                found[name] = []
                # What is in view is drawn first.
                page.evaluate("key => document.getElementById(key).scrollIntoView()", figure)
                for share in np.linspace(0.3, 0.6, RUNS):
                    found[name].append(page.evaluate(MOVE, [slider, shown, figure, float(share)]))
                    # Until the finer maps of this move are there, of which none may be taken for that of the next one.
                    time.sleep(RESTS_S)
            browser.close()
        server.terminate()
    return found


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
