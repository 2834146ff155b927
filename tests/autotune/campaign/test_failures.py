"""What a campaign survives: a killed scheduler and a full disk. Nothing finished is lost or doubled."""

import resource
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from sqlalchemy import Connection, Engine
from sqlalchemy.exc import OperationalError

from autotune.campaign.dask_pool import dask_executor
from autotune.campaign.manifest import STATE, read_manifest
from autotune.campaign.options import RunOptions
from autotune.campaign.result import run_campaign
from autotune.campaign.run import work_on_runs
from autotune.campaign.state import open_state
from autotune.campaign.work import build_task
from autotune.errors import UsageError
from tests.autotune.campaign.sharing import campaign, identified_at_once, table, until, written_logs
from tests.autotune.postgresql import Server


def results(folder: Path) -> dict[str, tuple[int, str, str]]:
    """How often each run was tried that has a result, when it ended, and what it says."""
    path = folder / STATE
    if not path.exists():
        return {}
    with closing(sqlite3.connect(path)) as state:
        if not state.execute("select 1 from sqlite_master").fetchall():
            return {}
        asked = "select cell, run, attempts, ended, result from autotune_runs where result is not null"
        return {f"{cell}/{run}": (*rest,) for cell, run, *rest in state.execute(asked)}


class Cluster:
    """A scheduler and a worker of Dask, each a process of its own, that can be killed and started again."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.address, self._folder, self._stack = f"tcp://127.0.0.1:{self.port}", folder, stack
        self.scheduler = self._started("dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port))
        self.worker = self._started("dask_worker", self.address, "--nthreads", "1", "--no-nanny")

    def _started(self, what: str, *words: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", f"distributed.cli.{what}", *words, "--no-dashboard"]
        with (self._folder / f"{what}.log").open("ab") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self._folder)
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        return process

    def restart(self) -> None:
        """Kill scheduler and worker, and start both again at the same address."""
        for process in (self.scheduler, self.worker):
            process.send_signal(signal.SIGKILL)
            process.wait()
        self.scheduler = self._started("dask_scheduler", "--host", "127.0.0.1", "--port", str(self.port))
        self.worker = self._started("dask_worker", self.address, "--nthreads", "1", "--no-nanny")


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed", reason="Dask is not installed")
    (tmp_path / "dask").mkdir()
    with ExitStack() as stack:
        yield Cluster(tmp_path / "dask", stack)


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return written_logs(tmp_path / "logs", 24)


def test_a_scheduler_that_is_killed_ends_the_campaign_and_the_next_one_does_the_rest(
    cluster: Cluster, logs: Path, tmp_path: Path
) -> None:
    runs, out = read_manifest(logs), tmp_path / "out"
    calm = campaign(logs, tmp_path / "calm")

    def kill() -> None:
        until(lambda: len(results(out)) >= 3)
        cluster.scheduler.send_signal(signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with (
        dask_executor(cluster.address, 1) as (executor, _),
        pytest.raises(UsageError, match="the Dask scheduler is gone"),
    ):
        work_on_runs(runs, out, executor=executor)
    killer.join()
    left = results(out)
    assert 3 <= len(left) < len(runs)
    outcomes = campaign(logs, out)
    assert {path: left[path] for path in left} == {path: results(out)[path] for path in left}
    assert table(tmp_path / "a", outcomes) == table(tmp_path / "b", calm)


def test_a_scheduler_that_comes_back_goes_on_with_what_it_has_forgotten(
    cluster: Cluster, logs: Path, tmp_path: Path
) -> None:
    runs, out = read_manifest(logs), tmp_path / "out"

    def kill() -> None:
        until(lambda: len(results(out)) >= 3)
        cluster.restart()

    killer = threading.Thread(target=kill)
    killer.start()
    with dask_executor(cluster.address, 1) as (executor, _):
        outcomes = work_on_runs(runs, out, executor=executor)
    killer.join()
    assert table(tmp_path / "a", outcomes) == table(tmp_path / "b", campaign(logs, tmp_path / "calm"))
    assert len(results(out)) == len(runs)


@contextmanager
def small_disk(folder: Path, kib: int) -> Iterator[None]:
    """Mount a file system of a few KiB, which only root may."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={kib}k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, check=False, capture_output=True).returncode:
        pytest.skip("may not mount a small file system")
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.parametrize("kib", [160, 256])
def test_a_full_disk_ends_the_campaign_whose_results_stay_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kib: int
) -> None:
    """Files take whole pages of the file system, so that some of the results have room, or the state alone has none."""
    logs, disk = written_logs(tmp_path / "logs", 24), tmp_path / "disk"
    monkeypatch.setattr("autotune.campaign.work._identify_and_tune", identified_at_once)
    with small_disk(disk, kib):
        with pytest.raises(UsageError, match=r"No space left on device|database or disk is full"):
            campaign(logs, disk / "out")
        left = results(disk / "out")
        assert 0 < len(left) < 24
        assert list(disk.rglob(".autotune-*")) == []
        subprocess.run(["mount", "-o", "remount,size=4096k", str(disk)], check=True)
        outcomes = campaign(logs, disk / "out")
        assert {path: left[path] for path in left} == {path: results(disk / "out")[path] for path in left}
        assert len(results(disk / "out")) == 24
    assert table(tmp_path / "a", outcomes) == table(tmp_path / "b", campaign(logs, tmp_path / "calm"))


def test_a_state_that_has_no_room_ends_the_campaign(tmp_path: Path) -> None:
    """Of these runs nothing but the state is written."""
    logs, disk = written_logs(tmp_path / "logs", 24), tmp_path / "disk"
    with small_disk(disk, 128):
        with pytest.raises(UsageError, match=r"The campaign's storage failed: database or disk is full\. What is fin"):
            campaign(logs, disk / "out")
        left = results(disk / "out")
        subprocess.run(["mount", "-o", "remount,size=4096k", str(disk)], check=True)
        outcomes = campaign(logs, disk / "out")
        assert {path: left[path] for path in left} == {path: results(disk / "out")[path] for path in left}
    assert table(tmp_path / "a", outcomes) == table(tmp_path / "b", campaign(logs, tmp_path / "calm"))


def test_a_table_that_has_no_room_leaves_the_former_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The logs are new, and their checksums are to be kept all the same.
    monkeypatch.setattr("autotune.campaign.checksums._RESTED_NS", 0)
    logs, out = written_logs(tmp_path / "logs", 4), tmp_path / "out"
    first = table_of_campaign(logs, out)
    written_logs(logs, 400)
    assert len(table_of_campaign(logs, out)) > 80_000
    (out / "campaign.csv").write_text(first, encoding="utf-8")
    # Nothing is new, so that the table alone is written, and what SQLite shares between processes (32 KiB).
    done = run_campaign_of(logs, out, limit=65_536)
    assert done.returncode == 2
    assert "campaign.csv" in done.stderr
    assert "File too large" in done.stderr
    assert (out / "campaign.csv").read_text(encoding="utf-8") == first
    assert len(table_of_campaign(logs, out)) > 80_000


def table_of_campaign(logs: Path, out: Path) -> str:
    with ThreadPoolExecutor(1) as executor:
        run_campaign(logs, out, optimize=False, executor=executor)
    return (out / "campaign.csv").read_text(encoding="utf-8")


def run_campaign_of(logs: Path, out: Path, *, limit: int) -> "subprocess.CompletedProcess[str]":
    """Run the command where no file may have more bytes than `limit`, as on a disk with no more room."""
    command = [sys.executable, "-m", "autotune", "campaign", str(logs), "-o", str(out), "--no-optimize", "--jobs", "1"]

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    return subprocess.run(command, check=False, capture_output=True, text=True, preexec_fn=limited)


def test_a_server_that_goes_away_after_a_change_and_before_its_answer_costs_no_attempt(
    postgresql: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run, *_), out = read_manifest(written_logs(tmp_path / "logs", 1)), tmp_path / "out"
    task, lost, begin = build_task(run, out, RunOptions()), list[str](), Engine.begin

    @contextmanager
    def changed_without_an_answer(engine: Engine) -> Iterator[Connection]:
        with begin(engine) as connection:
            yield connection
        if lost:
            raise OperationalError(lost.pop(), {}, Exception("server closed the connection unexpectedly"))

    monkeypatch.setattr(Engine, "begin", changed_without_an_answer)
    with open_state(postgresql.new_database("answer"), out) as state:
        outcome = task.refused("log", "no log")
        assert state.look([task]).free == [task]
        lost.append("claim")
        assert state.claim(task)
        lost.append("finish")
        assert state.finish(task, outcome)
        assert not lost
        assert state.look([task]).known == [(task, outcome)]
        assert [row.attempts for row in state._seen.values()] == [1]
