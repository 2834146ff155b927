"""What the pages show works: every command, the tutorial, the C loop, and the site that is built of them."""

import ast
import csv
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from autotune.charts.chart import Chart
from autotune.formats.controller import read_controller, write_controller
from autotune.report import page as report_page
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from autotune.simulation.write_bags import write_ros1_bag
from identification.signals.recording import Recording
from problems.model.controller import AdmittanceController
from tests.autotune.cli.test_help import examples_in
from tests.autotune.simulation.runs import SHORT_LOG, shorten_logs
from tests.autotune.tuning.cases import share_results, shorten_checks, small_controller
from tests.conftest import RunCli

# What runs for ever, or whole chains that have tests of their own (test_explore, test_demo, test_warm).
ELSEWHERE = {"explore", "demo", "warm"}
# The same options with less work.
SHORTER = (
    ("payload=8,16.2,22", "payload=16.2"),
    ("stiffness=2e4:1e5,1e5:5e5", "stiffness=2e4:1e5"),
    ("--pareto 12 ", "--pareto 2 "),
    ("identified.yaml --pareto  ", "identified.yaml --pareto 2 "),
    ("--trials 400", "--trials 4"),
    ("--choose", "--trials 4 --choose"),
    ("validate controller.yaml", "validate controller.yaml --samples 20"),
    ("--scheduler dask --jobs 4", "--jobs 1"),
    ("--storage postgresql+psycopg://autotune@db/plant", "--storage sqlite:///plant.db"),
    ("--for ros2_control", "--for ros2_control --payload-mass 16.2 --environment-stiffness 1e5:1.2e5"),
    ("campaign logs", "campaign logs --no-optimize"),
)


@pytest.fixture(scope="module")
def pages(repository: Path) -> dict[str, str]:
    found = [repository / "README.md", *sorted((repository / "docs").glob("*.md"))]
    return {page.name: page.read_text(encoding="utf-8") for page in found}


@pytest.mark.slow
def test_every_command_of_the_pages_runs(
    pages: dict[str, str], run_cli: RunCli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_checks(monkeypatch)
    share_results(monkeypatch)
    _draw_one_figure(monkeypatch)
    monkeypatch.setattr("autotune.studies.front._SEED_POINTS", 2)
    lines = list(dict.fromkeys(_commands(pages)))
    assert len(lines) > 30
    _make_logs(tmp_path)
    first = ("identify run7.mcap", "optimize identified.yaml")
    for line in (*first, *(line for line in lines if line not in first)):
        if line.startswith("validate") and "run8" in line:
            _record_with_the_controller(tmp_path)
        if "--write-cell" in line:
            (tmp_path / "cell.yaml").unlink(missing_ok=True)
        shorter = f"{line}  "
        for long, short in SHORTER:
            shorter = shorter.replace(long, short)
        done = run_cli(*shorter.split())
        # Another controller's law may not reach what the own one does: that is an answer, and nothing is written.
        is_translated = any(target in line for target in ("ros2_control", "fzi_cartesian"))
        assert done.returncode in ((0, 5) if is_translated else (0,)), f"{shorter}\n{done.stdout[-500:]}\n{done.stderr}"
        if line == first[1]:
            shutil.copytree(
                tmp_path,
                tmp_path / "autotune-demo",
                dirs_exist_ok=True,
                ignore=shutil.ignore_patterns("*.mcap", "autotune-demo"),
            )
            shutil.copy(tmp_path / "controller.yaml", tmp_path / "old.yaml")


def _draw_one_figure(patch: pytest.MonkeyPatch) -> None:
    """Show one figure for all of as many pictures; tests/autotune/cli/test_report.py draws those of each page."""
    for name in ("_stills", "_live"):
        patch.setattr(report_page, name, _drawn_once(getattr(report_page, name)))


def _drawn_once(draw: Callable[[Chart], Any]) -> Callable[[Chart], Any]:
    drawn: dict[tuple[int, bool], Any] = {}

    def figure(chart: Chart) -> Any:
        kind = len(chart.panels), chart.beside
        if kind not in drawn:
            drawn[kind] = draw(chart)
        return drawn[kind]

    return figure


def _commands(pages: dict[str, str]) -> Iterator[str]:
    """Yield each command line once, as it is written in a block of a page."""
    for text in pages.values():
        for block in re.findall(r"```\n(.*?)```", text, re.DOTALL):
            for words in examples_in(block.replace("\\\n", " ")):
                if words[0] not in ELSEWHERE:
                    yield " ".join(words)


def _make_logs(folder: Path) -> None:
    """Write the logs that the pages name, all of one recording, and the keys of a signature."""
    recording = simulate_cell(SimulatedCell(), SHORT_LOG, seed=2).recording
    write_mcap(recording, folder / "run7.mcap")
    (folder / "logs" / "press").mkdir(parents=True)
    shutil.copy(folder / "run7.mcap", folder / "logs" / "press" / "run7.mcap")
    write_ros1_bag(recording, folder / "run7.bag", rows=len(recording.wrench.stamp_ns))
    _write_foreign_table(recording, folder / "run7.csv")
    key = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    (folder / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    (folder / "key.pem").chmod(0o600)
    (folder / "pub.pem").write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))


def _write_foreign_table(recording: Recording, path: Path) -> None:
    """Write a table with a laboratory's own column names, positions in mm and a semicolon."""
    wrench, poses = recording.wrench, (recording.pose, recording.command)
    names = ["time", *(f"{kind}{axis}" for kind in "ft" for axis in "xyz")]
    columns = [1e-9 * (wrench.stamp_ns - wrench.stamp_ns[0]), *wrench.force_n.T, *wrench.torque_n_m.T]
    for prefix, pose in zip(("tcp", "goal"), poses, strict=True):
        assert pose is not None
        names += [f"{prefix}_pos_{axis}" for axis in "xyz"] + [f"{prefix}_q{part}" for part in "xyzw"]
        columns += [*(1e3 * pose.position_m.T), *pose.quaternion_xyzw.T]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, delimiter=";")
        writer.writerow(names)
        writer.writerows(zip(*columns, strict=True))


def _record_with_the_controller(folder: Path) -> None:
    """Write the logs of contacts that the controller of the file made."""
    gains = read_controller(folder / "controller.yaml").controller.axes["x"]
    controller = AdmittanceController(
        mass_kg=gains.mass,
        damping_n_s_per_m=gains.damping,
        lead_s=gains.lead_s,
        feedback_damping_s=gains.feedback_damping_s,
    )
    recording = simulate_cell(replace(SimulatedCell(), controller=controller), SHORT_LOG, seed=3).recording
    write_mcap(recording, folder / "run8.mcap")
    shutil.copy(folder / "run8.mcap", folder / "first_contacts.mcap")


@pytest.mark.slow
def test_the_tutorial_runs_and_shows_what_it_shows(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    book = json.loads((repository / "docs" / "tutorial.ipynb").read_text(encoding="utf-8"))
    cells = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
    kinds = [output["output_type"] for cell in cells for output in cell["outputs"]]
    assert "error" not in kinds
    assert all(output.get("name") != "stderr" for cell in cells for output in cell["outputs"])
    assert kinds.count("display_data") >= 5  # its figures
    shorten_checks(monkeypatch)
    share_results(monkeypatch)
    shorten_logs(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(mpl.rcParams, "backend", "agg")
    names: dict[str, object] = {}
    for cell in cells:
        *statements, last = ast.parse("".join(cell["source"])).body
        exec(compile(ast.Module(statements, []), "cell", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
            is_shown = any(output["output_type"] == "execute_result" for output in cell["outputs"])
            assert value is not None or not is_shown
        else:
            exec(compile(ast.Module([last], []), "cell", "exec"), names)
    plt.close("all")
    assert {"run7.mcap", "controller.yaml"} <= {path.name for path in tmp_path.iterdir()}
    assert names["validation"].passed is True  # type: ignore[attr-defined]


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs a C compiler")
def test_the_c_loop_of_the_page_compiles_and_stops_without_a_payload(
    pages: dict[str, str], run_cli: RunCli, tmp_path: Path
) -> None:
    write_controller(tmp_path / "controller.yaml", small_controller())
    assert run_cli("export", "controller.yaml", "--target", "c", "-o", "cell.c").returncode == 0
    (block,) = re.findall(r"```c\n(.*?)```", pages["your_robot.md"], re.DOTALL)
    (tmp_path / "loop.c").write_text(block, encoding="utf-8")
    flags = ("-std=c99", "-Wall", "-Wextra", "-Werror")
    subprocess.run(["gcc", *flags, "loop.c", "cell.c", "-o", "loop"], cwd=tmp_path, check=True)
    # The page says so: a sensor that reads nothing where the payload's weight is expected is a fault.
    assert subprocess.run(["./loop"], cwd=tmp_path, check=False).returncode == 2


def test_the_site_asks_for_nothing_from_elsewhere(repository: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path / "site")]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(repository)}
    built = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    pages = sorted((tmp_path / "site").rglob("*.html"))
    assert {"index.html", "tutorial.html", "api.html", "commands.html"} <= {page.name for page in pages}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(r"<(?:script|img|iframe)[^>]*\ssrc=\"?(https?:[^\"> ]+)", text)
        fetched += re.findall(r"<link[^>]*rel=\"?stylesheet[^>]*href=\"?(https?:[^\"> ]+)", text)
        assert fetched == [], page.name
    assert "--compare" in (tmp_path / "site" / "commands.html").read_text(encoding="utf-8")
