"""Work on many runs: once each, the same whatever is killed meanwhile, by any executor."""

import json
import os
import pickle
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import pytest

from autotune.campaign import work
from autotune.campaign.dask_pool import dask_executor
from autotune.campaign.manifest import STATE, LoggedRun, read_manifest
from autotune.campaign.options import RunOptions
from autotune.campaign.result import run_campaign
from autotune.campaign.run import work_on_runs
from autotune.campaign.tables import campaign_rows, write_tables
from autotune.campaign.work import RunOutcome, RunTask, build_task, parse_outcome, work_on
from autotune.errors import UsageError
from autotune.pipeline import IdentifyOptions
from autotune.processes import worker_environment
from identification.errors import LogError
from identification.logs.containers.formats import sha256_of
from tests.autotune.own_process import FORKED

TEXT = "no log at all\n"


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """Twelve tables that `identify` refuses at once: what is tried here is the work around it."""
    for i in range(12):
        folder = tmp_path / "logs" / f"cell{i // 3}"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"run{i}.csv").write_text(f"t,a\n0,{i}\n1,2\n", encoding="utf-8")
    return tmp_path / "logs"


class Counting(Executor):
    """Works at once in this thread and counts; breaks where it is told to."""

    def __init__(self) -> None:
        self.worked: list[str] = []

    def submit(self, fn: Any, /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.worked.append(arguments[0].run.name)
        future.set_result(fn(*arguments, **named))
        return future


def test_what_is_finished_is_not_done_again_and_what_changed_is(logs: Path, tmp_path: Path) -> None:
    runs, first, again, other = read_manifest(logs), Counting(), Counting(), Counting()
    notes = list[str]()
    outcomes = work_on_runs(runs, tmp_path / "out", executor=first, note=notes.append)
    assert [f"{each.cell}/{each.run}" for each in outcomes] == [run.name for run in runs] == first.worked
    assert {each.refused for each in outcomes} == {"log"}
    assert notes == []
    assert work_on_runs(runs, tmp_path / "out", executor=again, note=notes.append) == outcomes
    assert again.worked == []
    assert notes == ["Nothing to do: 12 of 12 runs done with these inputs, options and version."]
    (logs / "cell1" / "run4.csv").write_text("t,a\n0,9\n1,2\n", encoding="utf-8")
    work_on_runs(runs, tmp_path / "out", executor=other, note=notes.append)
    assert other.worked == ["cell1/run4"]
    assert notes[1:] == ["1 of 12 runs to do: 11 are done with these inputs, options and version."]
    work_on_runs(runs, tmp_path / "out", executor=again, note=notes.append, is_another_look=True)
    assert (again.worked, len(notes)) == ([], 2)


def test_results_of_other_options_are_named_before_they_are_replaced_and_no_controller_is_lost(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, out, notes = read_manifest(logs)[:2], tmp_path / "out", list[str]()
    monkeypatch.setattr("autotune.campaign.work._identify_and_tune", _made)
    work_on_runs(runs, out, executor=Counting())
    made = out / "cells" / "cell0" / "run0" / "controller.yaml"
    said = (
        f"{out} has controllers of 2 runs that would be removed, and not made again without optimizing: cell0/run0, "
        "cell0/run1. Name another folder with -o, or leave --no-optimize out."
    )
    with pytest.raises(UsageError) as refused:
        work_on_runs(runs, out, RunOptions(optimize=False), executor=Counting())
    assert str(refused.value) == said
    assert made.is_file()
    work_on_runs(runs, out, RunOptions(seed=1), executor=Counting(), note=notes.append)
    assert made.is_file()
    said = "Done again, since inputs, options or version are not those of their results in the folder, "
    assert notes == [f"{said}which are replaced: cell0/run0, cell0/run1."]


def _made(task: RunTask, files: dict[str, str]) -> RunOutcome:
    """A run that is identified and tuned, where that is asked."""
    files["identified.yaml"] = f"{task.key}\n"
    if task.options.optimize:
        files["controller.yaml"] = f"{task.key}\n"
    return RunOutcome(cell=task.run.cell, run=task.run.run, key=task.key)


def test_a_table_that_cannot_be_written_anew_does_not_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "campaign.parquet").write_bytes(b"of another time")
    monkeypatch.setattr("autotune.campaign.tables.find_spec", lambda _name: None)
    assert write_tables(tmp_path, [RunOutcome(cell="a", run="b", key="k")]) == (tmp_path / "campaign.csv",)
    assert not (tmp_path / "campaign.parquet").exists()


def test_options_and_settings_are_part_of_the_key(logs: Path, tmp_path: Path) -> None:
    run = read_manifest(logs)[0]
    cell = tmp_path / "cell.yaml"
    cell.write_text("format: autotune/cell\nversion: 1\n", encoding="utf-8")
    with_cell = LoggedRun(cell=run.cell, run=run.run, logs=run.logs, cell_file=cell)
    tasks = [
        build_task(each, tmp_path, options)
        for each, options in (
            (run, RunOptions()),
            (run, RunOptions(seed=1)),
            (run, RunOptions(salvage=True)),
            (run, RunOptions(allow_partial=True)),
            (with_cell, RunOptions()),
        )
    ]
    assert len({task.key for task in tasks}) == 5
    assert build_task(run, tmp_path / "elsewhere", RunOptions()).key == tasks[0].key


def test_what_the_manifest_says_of_a_run_goes_before_the_options_of_the_campaign(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = read_manifest(logs)[0]
    (urdf := tmp_path / "arm.urdf").write_text("<robot/>", encoding="utf-8")
    seeded, spanned, jointed = (
        replace(run, options=options) for options in ({"seed": 1}, {"stop": 30.0, "salvage": False}, {"urdf": urdf})
    )
    keys = [build_task(each, tmp_path, RunOptions()).key for each in (run, seeded, spanned, jointed)]
    assert len(set(keys)) == 4
    assert keys[1] == build_task(run, tmp_path, RunOptions(seed=1)).key
    assert keys[2] == build_task(spanned, tmp_path, RunOptions(salvage=True)).key
    urdf.write_text("<robot name='b'/>", encoding="utf-8")
    assert build_task(jointed, tmp_path, RunOptions()).key != keys[3]
    seen: list[IdentifyOptions] = []

    def refusing(_: Any, options: IdentifyOptions) -> None:
        seen.append(options)
        raise LogError("seen")

    monkeypatch.setattr("autotune.campaign.work.identify_log", refusing)
    work_on(build_task(spanned, tmp_path, RunOptions(salvage=True, allow_partial=True)))
    assert seen == [IdentifyOptions(stop=30.0, allow_partial=True)]


def _all_read(task: RunTask, files: dict[str, str]) -> RunOutcome:
    """A run of which every file is read, of whichever path a message may speak."""
    named = (*task.run.logs, task.run.cell_file, task.run.problem, task.run.controller, task.options.urdf)
    files["identified.yaml"] = "".join(f"{path}: {sha256_of(path)}\n" for path in named if path is not None)
    return RunOutcome(cell=task.run.cell, run=task.run.run, key=task.key, damage=files["identified.yaml"])


def _elsewhere(folder: Path) -> None:
    os.chdir(folder)
    work._identify_and_tune = _all_read


def test_workers_in_another_folder_read_and_write_the_same(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (elsewhere := tmp_path / "elsewhere").mkdir()
    for name in ("cell", "problem", "controller"):
        (logs / f"{name}.yaml").write_text(f"format: autotune/{name}\nversion: 1\n", encoding="utf-8")
    (logs / "arm.urdf").write_text("<robot/>", encoding="utf-8")
    (logs / "runs.csv").write_text(
        "cell,log,cell_file,problem,controller,urdf\n"
        "a,cell0/run0.csv;cell0/run1.csv,cell.yaml,problem.yaml,controller.yaml,arm.urdf\n",
        encoding="utf-8",
    )
    monkeypatch.setattr("autotune.campaign.work._identify_and_tune", _all_read)
    runs = read_manifest(Path("logs/runs.csv"))
    here = work_on_runs(runs, Path("here"), executor=Counting())
    with ProcessPoolExecutor(1, mp_context=FORKED, initializer=_elsewhere, initargs=(elsewhere,)) as executor:
        there = work_on_runs(runs, Path("there"), executor=executor)
    assert [f"{os.sep}{name}: " in here[0].damage for name in ("run1.csv", "cell.yaml", "arm.urdf")] == [True] * 3
    written = []
    for folder, outcomes in (("here", here), ("there", there)):
        write_tables(tmp_path / folder, outcomes)
        files = ("campaign.csv", "cells/a/run0/identified.yaml")
        written.append([(tmp_path / folder / name).read_bytes() for name in files])
    assert written[0] == written[1]
    assert list(elsewhere.iterdir()) == []


@pytest.mark.parametrize(("outside", "holds"), [(None, None), ((), True), (("axis x",), False)])
def test_a_certificate_holds_where_nothing_lies_outside_of_it(
    outside: tuple[str, ...] | None, holds: bool | None
) -> None:
    columns, (row,) = campaign_rows([RunOutcome(cell="a", run="b", key="k", outside=outside)])
    assert row[columns.index("certificate_holds")] is holds


@pytest.mark.parametrize(
    ("outside", "refusal", "said"),
    [
        ((), "", None),
        (("axis x, mass: 20 kg", "axis y, delay: 4 ms"), "", "axis x, mass: 20 kg; axis y, delay: 4 ms"),
        (None, "a.mcap is empty.", "a.mcap is empty."),
        (("c.yaml is altered",), "a.mcap is empty.", "a.mcap is empty. c.yaml is altered"),
    ],
)
def test_the_table_says_why_a_certificate_does_not_hold_and_why_a_run_is_refused(
    outside: tuple[str, ...] | None, refusal: str, said: str | None
) -> None:
    outcome = RunOutcome(cell="a", run="b", key="k", outside=outside, refused=refusal and "log", reason=refusal)
    columns, (row,) = campaign_rows([outcome])
    assert row[columns.index("reason")] == said


def test_a_result_that_is_half_or_of_another_release_is_none() -> None:
    outcome = RunOutcome(
        cell="a",
        run="b",
        key="k",
        values={"x": (1.0, 0.1)},
        peaks_n={"x": (None, 50.0)},
        outside=("w",),
        files={"f": "d"},
    )
    assert parse_outcome(outcome.text()) == outcome
    for wrong in (None, outcome.text()[:-9], "[]", json.dumps({**json.loads(outcome.text()), "colour": 1})):
        assert parse_outcome(wrong) is None


def test_what_was_not_foreseen_ends_the_run_and_not_the_campaign(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr("autotune.campaign.work.identify_log", broken)
    runs, pools = read_manifest(logs)[:2], [Counting(), Counting()]
    for pool in pools:
        outcomes = work_on_runs(runs, tmp_path, executor=pool)
        assert {each.reason for each in outcomes} == {"Unforeseen ZeroDivisionError: by zero"}
        assert pool.worked == [run.name for run in runs]  # by the next campaign again


@pytest.mark.slow
def test_the_same_tables_come_of_a_campaign_whose_workers_are_killed(logs: Path, tmp_path: Path) -> None:
    """Thirty times kill -9, in the midst of work or of starting; each run has one result at the end, and the same."""
    runs = read_manifest(logs)
    calm = work_on_runs(runs, tmp_path / "calm", executor=ThreadPoolExecutor(1))
    killed, over = 0, threading.Event()

    def kill() -> None:
        nonlocal killed
        while killed < 30 and not over.wait(0.4):
            for process in active_children()[:1]:
                if process.pid is not None:
                    os.kill(process.pid, signal.SIGKILL)
                    killed += 1

    killer = threading.Thread(target=kill)
    killer.start()
    folders: list[Path] = []
    try:
        # Until all the kills are done; who is hit five times is named, and the same command goes on, as a user's would.
        while killed < 30:
            folders.append(tmp_path / f"wild{len(folders)}")
            outcomes = work_on_runs(runs, folders[-1], jobs=2)
            while any(each.refused == "killed" for each in outcomes):
                outcomes = work_on_runs(runs, folders[-1], jobs=2)
            assert outcomes == calm
    finally:
        over.set()
        killer.join()
    assert killed == 30
    write_tables(tmp_path / "calm", calm)
    for folder in (tmp_path / "calm", *folders):
        with closing(sqlite3.connect(folder / STATE)) as state:
            kept = state.execute("select count(*) from autotune_runs where state = 'refused' and result is not null")
            assert kept.fetchone() == (12,)
        assert list(folder.rglob(".autotune-*")) == []
    write_tables(folders[-1], outcomes)
    assert (folders[-1] / "campaign.csv").read_text() == (tmp_path / "calm" / "campaign.csv").read_text()


class Deadly(Executor):
    """A pool whose worker dies of one run, at once or when it is asked for the next."""

    def __init__(self, deadly: str, refuses: bool) -> None:
        self.deadly, self.refuses, self.worked = deadly, refuses, list[str]()

    def submit(self, fn: Any, /, *arguments: Any, **named: Any) -> Future[Any]:
        name, future = arguments[0].run.name, Future[Any]()
        self.worked.append(name)
        if name != self.deadly:
            future.set_result(fn(*arguments, **named))
        elif self.refuses:
            raise BrokenExecutor("gone")
        else:
            future.set_exception(BrokenExecutor("gone"))
        return future


@pytest.mark.parametrize("refuses", [False, True])
def test_only_the_run_that_ends_its_process_is_given_up(logs: Path, tmp_path: Path, refuses: bool) -> None:
    pool = Deadly("cell1/run4", refuses)
    outcomes = work_on_runs(read_manifest(logs), tmp_path / "out", executor=pool, jobs=3)
    assert [f"{each.cell}/{each.run}" for each in outcomes if each.refused == "killed"] == ["cell1/run4"]
    assert {each.refused for each in outcomes} == {"log", "killed"}
    again = Counting()
    assert {each.refused for each in work_on_runs(read_manifest(logs), tmp_path / "out", executor=again)} == {"log"}
    assert again.worked == ["cell1/run4"]


@pytest.mark.parametrize("is_file", [True, False])
def test_a_script_that_its_processes_cannot_import_ends_at_the_first_of_them_with_the_reason(
    logs: Path, tmp_path: Path, is_file: bool
) -> None:
    out, script = tmp_path / "out", tmp_path / "script.py"
    call = f"autotune.run_campaign({str(logs)!r}, {str(out)!r}, optimize=False, jobs=1)"
    # What a process reads from standard input none that it starts can import.
    script.write_text(
        f"import autotune\n{call}\n" if is_file else f"if __name__ == '__main__':\n import autotune\n {call}\n"
    )
    done = subprocess.run(
        [sys.executable, script if is_file else "-"],
        input=script.read_text(),
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(
        "autotune.errors.UsageError: The processes that are to work on the runs end before they begin"
    )
    assert 'have what it does under `if __name__ == "__main__":`.' in done.stderr
    # None is tried again.
    with closing(sqlite3.connect(out / STATE)) as state:
        kept = state.execute("select distinct attempts from autotune_runs where attempts > 0 or result is not null")
        assert kept.fetchall() == [(1,)]


@pytest.mark.filterwarnings("ignore:Exception ignored in. <socket")  # Dask leaves that of a port which is taken open
def test_a_dask_cluster_gives_the_same(logs: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    runs = read_manifest(logs)[:3]
    with socket.socket() as other:
        with suppress(OSError):  # the usual port of the dashboard is this one's, or already somebody else's
            other.bind(("", 8787))
            other.listen()
        with dask_executor("dask", 1) as (executor, dashboard):
            assert dashboard.startswith("http://")
            assert ":8787/" not in dashboard
            outcomes = work_on_runs(runs, tmp_path / "dask", executor=executor, jobs=1)
    assert outcomes == work_on_runs(runs, tmp_path / "here", executor=ThreadPoolExecutor(1))


def test_progress_is_of_what_is_left_so_that_the_time_is_too(logs: Path, tmp_path: Path) -> None:
    runs, seen = read_manifest(logs), list[str]()

    @contextmanager
    def show(what: str, total: int) -> Iterator[Callable[..., None]]:
        seen.append(f"{what} {total}")
        yield lambda n, doing="": seen.append(f"{n} {doing}")

    work_on_runs(runs[:9], tmp_path / "out", executor=Counting())
    work_on_runs(runs, tmp_path / "out", executor=Counting(), progress=show)
    done = [f"1 {run.name}" for run in runs]
    assert seen == ["checksums 12", *done, "campaign 3", *done[9:]]


def test_a_campaign_from_python_takes_any_executor_and_shows_what_came_of_it(logs: Path, tmp_path: Path) -> None:
    shares: list[float] = []
    with ThreadPoolExecutor(2) as executor:
        found = run_campaign(logs, tmp_path / "out", optimize=False, executor=executor, progress=shares.append)
    assert sum(shares) == pytest.approx(1.0)
    assert list(found.outcomes) == list(
        work_on_runs(
            read_manifest(logs), tmp_path / "again", RunOptions(optimize=False), executor=ThreadPoolExecutor(1)
        )
    )
    assert repr(pickle.loads(pickle.dumps(found))) == repr(found)
    assert found._repr_html_().count("<tr>") == 1 + len(found.outcomes)
    assert [run["run"] for run in found.to_dict()["runs"]] == [each.run for each in found.outcomes]
    assert (tmp_path / "out" / "campaign.csv").is_file()
    assert list(found.to_pandas()["run"]) == [each.run for each in found.outcomes]
    shares.clear()
    run_campaign(logs, tmp_path / "out", optimize=False, progress=shares.append)
    assert sum(shares) == pytest.approx(1.0)
    with pytest.raises(UsageError, match="nothing is not there; name a folder of logs"):
        run_campaign(tmp_path / "nothing", tmp_path / "out")
    with pytest.raises(UsageError, match=r"^scheduler must be dask, or an address as in tcp://head:8786; found 3\.$"):
        run_campaign(logs, tmp_path / "out", scheduler=3)  # type: ignore[arg-type]


def test_from_python_logs_in_deeper_folders_are_warned_of_where_the_campaign_is_called(
    logs: Path, tmp_path: Path
) -> None:
    (logs / "cell0" / "old").mkdir()
    (logs / "cell0" / "old" / "run.csv").write_text("t,a\n0,1\n", encoding="utf-8")
    with ThreadPoolExecutor(1) as executor, pytest.warns(UserWarning, match="Passed over 1 log deeper") as seen:
        found = run_campaign(logs, tmp_path / "out", optimize=False, executor=executor)
    assert (len(found.outcomes), [each.filename for each in seen]) == (12, [__file__])


def test_processes_of_a_campaign_have_worker_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("MKL_NUM_THREADS", "3")
    with worker_environment():
        assert (os.environ["OMP_NUM_THREADS"], os.environ["MKL_NUM_THREADS"]) == ("1", "3")
    assert "OMP_NUM_THREADS" not in os.environ


def test_a_scheduler_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed")
    monkeypatch.setattr("autotune.campaign.dask_pool._ANSWERS_WITHIN_S", 0.5)
    started = time.monotonic()
    with pytest.raises(UsageError, match="no Dask scheduler answers there"), dask_executor("tcp://127.0.0.1:9", 1):
        pass
    assert time.monotonic() - started < 60.0
