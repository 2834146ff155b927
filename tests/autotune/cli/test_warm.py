"""`autotune warm`: which commands it runs, and what it and a cold command say of compiling."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import pytest

from autotune.cli import _common, demo, warm
from autotune.cli.main import main
from autotune.formats.identified import write_identified
from autotune.shown import COMPILING, reporting
from problems.compiled import _Compilations
from problems.compiling import many_compilations, on_compilation
from problems.design.batch_kernel import times_spectral_ratios
from tests.autotune.tuning.cases import identified_plant


@pytest.fixture
def runs(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """The command lines that `warm` runs, in place of running them."""
    found: list[tuple[str, ...]] = []
    monkeypatch.setattr(warm, "_run", lambda *arguments: found.append(arguments))
    monkeypatch.setattr(warm, "_write_logs", lambda *paths: found.append(("logs", *(path.suffix for path in paths))))
    monkeypatch.setattr(warm, "_explore", lambda *paths: found.append(("explore", *(path.name for path in paths))))
    monkeypatch.setattr(warm, "_coloured_noise", lambda path: found.append(("noise", str(path))))
    return found


def test_every_command_and_every_kind_of_log_is_run(runs: list[tuple[str, ...]], tmp_path: Path) -> None:
    shares: list[float] = []

    def advance(share: float, doing: str | None = None, /) -> None:
        assert doing is None or doing.startswith("compiling: ")
        shares.append(share)

    warm._warm(tmp_path, advance)
    assert {name for name, *_ in runs} == {
        "demo",
        "logs",
        "inspect",
        "plan",
        "validate",
        "predict",
        "map",
        "explore",
        "noise",
    }
    assert {Path(words[1]).suffix for words in runs if words[0] == "inspect"} == {".mcap", ".bag", "", ".csv"}
    # Nothing is written beside the folder that is removed.
    assert all(
        str(tmp_path) in word
        for words in runs
        for word in words
        if word.endswith((".yaml", ".svg")) and words[0] != "explore"
    )
    assert sum(shares) == pytest.approx(1.0)


def test_it_says_how_many_kernels_were_compiled(
    runs: list[tuple[str, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["warm", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"compiled": 0}
    assert main(["warm"]) == 0
    assert capsys.readouterr().out == "Everything was compiled already.\n"
    assert runs


def test_noise_that_is_not_white_is_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The demo's is white: a first log of another sensor would compile what sums over its spectrum."""
    seen: list[int] = []
    real = times_spectral_ratios

    def counted(*arguments: Any) -> None:
        real(*arguments)
        seen.append(len(arguments[-1]))

    monkeypatch.setattr("problems.design.batch_evaluation.times_spectral_ratios", counted)
    path = tmp_path / "identified.yaml"
    write_identified(path, identified_plant(), {"tool": "by hand"})
    warm._coloured_noise(path)
    assert seen == [1]


def test_several_compilations_are_announced_once() -> None:
    said: list[str] = []
    on_compilation(lambda: said.append("an earlier command"))
    on_compilation(lambda: said.append("compiling"))
    counter = _Compilations()
    for expected in ([], [], ["compiling"], ["compiling"]):
        counter.on_start(None)
        counter.on_end(None)
        assert said == expected
    assert counter.count == 4
    many_compilations()
    assert said == ["compiling"]


def test_a_cold_call_from_python_says_once_that_it_compiles(caplog: pytest.LogCaptureFixture) -> None:
    with reporting(progress=False, doing="searching"):
        many_compilations()
        many_compilations()
    assert [(each.name, each.message) for each in caplog.records] == [("autotune", COMPILING)]


@pytest.mark.parametrize(("options", "times"), [([], 1), (["--quiet"], 0)])
def test_a_cold_command_says_once_at_a_terminal_that_it_compiles(
    options: list[str], times: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("autotune.cli._terminal._is_terminal", lambda _: True)

    @click.command()
    @_common.output_options
    def command(output: _common.Output) -> None:
        many_compilations()
        many_compilations()
        output.result({"done": True}, lambda: None)

    command.main(["--json", *options], standalone_mode=False)
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"done": True}
    assert printed.err.count("Compiling once") == times


def test_the_bar_of_a_cold_demo_moves_with_its_kernels_and_that_of_a_warm_one_with_the_work_alone() -> None:
    moved: list[float] = []

    def advance(share: float, doing: str | None = None, /) -> None:
        assert doing is None
        moved.append(share)

    with demo._counting_kernels(advance) as work:
        work(0.5)
        assert moved == [0.5]
        compilations = _Compilations()
        for _ in range(2 * demo._KERNELS):
            compilations.on_start(None)
        kernels = moved[1:]
        assert len(kernels) == demo._KERNELS
        work(1.0)
        # All of the bar, and no more.
        assert sum(kernels) + moved[-1] == pytest.approx(1.0)
    compilations.on_start(None)
    assert len(moved) == 2 + demo._KERNELS


def test_a_cold_demo_compiles_in_a_process_of_its_own_that_ends_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []

    def start(command: list[str], **_options: object) -> subprocess.Popen[bytes]:
        assert command[1:4] == ["-m", "autotune", "optimize"]
        assert Path(command[4]).is_file()
        started.append(open_process([sys.executable, "-c", "import time; time.sleep(60)"]))
        return started[0]

    open_process = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr("autotune.processes.count_processors", lambda: 2)
    with demo._compiling_beside(_common.Output(quiet=True)):
        assert not started  # nothing had to be compiled yet
        many_compilations()
        assert started[0].poll() is None
    assert started[0].poll() is not None
    many_compilations()  # heard by nobody any more
    assert len(started) == 1
