"""Studies on a PostgreSQL server: killed, shared, and gone on with after the server was started again."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from optuna.trial import TrialState
from sqlalchemy import create_engine, text

from autotune.studies.storage import close_storage, open_storage, quiet_optuna
from autotune.studies.study import run_study
from tests.autotune.studies.small import START, small_plan, small_problem, start_worker

from .test_study import FINISHED, check_kill_and_resume, check_two_workers, trials_of, wait_for


@dataclass(frozen=True)
class Server:
    """A server of its own on a socket in a folder; `user` are the words that run a command as its account."""

    folder: Path
    user: tuple[str, ...]

    def run(self, *command: str) -> None:
        """Run one of PostgreSQL's tools."""
        subprocess.run([*self.user, *command], check=True, stdout=subprocess.DEVNULL, cwd=self.folder)

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-k {self.folder} -h ''"
        self.run(
            "pg_ctl", "-D", str(self.folder / "data"), "-w", "-l", str(self.folder / "log"), "-o", options, "start"
        )

    def stop(self) -> None:
        """Stop it at once, as a power failure would."""
        self.run("pg_ctl", "-D", str(self.folder / "data"), "-m", "immediate", "stop")

    def new_database(self, name: str) -> str:
        """Return the URL of a new database; another test leaves its studies in another one."""
        url = f"postgresql+psycopg://tester@/{{}}?host={self.folder}"
        engine = create_engine(url.format("postgres"), isolation_level="AUTOCOMMIT")
        with engine.connect() as connection:
            connection.execute(text(f"create database {name}"))
        engine.dispose()
        return url.format(name)


@pytest.fixture(scope="module")
def postgresql() -> Iterator[Server]:
    """Start a server from Debian's packages."""
    if shutil.which("initdb") is None or shutil.which("pg_ctl") is None:
        pytest.skip("needs PostgreSQL's initdb and pg_ctl")
    # Not one of pytest's folders: the server refuses to run as root, and no other account may enter those.
    folder = Path(tempfile.mkdtemp(prefix="autotune-pg-"))
    is_root = os.geteuid() == 0
    if is_root:
        shutil.chown(folder, "postgres")  # the account that Debian's package makes
    server = Server(folder, ("runuser", "-u", "postgres", "--") if is_root else ())
    server.run("initdb", "-D", str(folder / "data"), "-U", "tester", "--auth=trust", "--no-sync")
    server.start()
    try:
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder)


@pytest.mark.slow
def test_postgresql_a_killed_study_goes_on(postgresql: Server, tmp_path: Path) -> None:
    check_kill_and_resume(postgresql.new_database("killed"), tmp_path)


@pytest.mark.slow
def test_postgresql_two_processes_share_a_study(postgresql: Server, tmp_path: Path) -> None:
    check_two_workers(postgresql.new_database("workers"), tmp_path)


def test_a_server_that_is_started_again_costs_no_finished_trial(postgresql: Server, tmp_path: Path) -> None:
    """The study ends with a sentence, and the same again does the rest: no finished trial is lost, none doubled."""
    trials, url = 20, postgresql.new_database("restarted")
    with quiet_optuna():
        storage = open_storage(url, tmp_path / "unused.db")
        worker = start_worker(url, trials)
        wait_for(storage, 5, worker)
        finished = [(t.number, t.params, t.values) for t in trials_of(storage) if t.state in FINISHED]
        close_storage(storage)
        postgresql.stop()
        _, errors = worker.communicate(timeout=50)
        postgresql.start()
        assert worker.returncode == 1
        assert "What is finished is kept; the same command goes on from there." in errors
        storage = open_storage(url, tmp_path / "unused.db", heartbeat_s=1)
        run_study(small_problem(), small_plan(trials), storage, start=START, name="shared")
        now = trials_of(storage)
        close_storage(storage)
    assert 5 <= len(finished) < trials
    assert [(t.number, t.params, t.values) for t in now if t.number in {each[0] for each in finished}] == finished
    assert sum(t.state in FINISHED for t in now) == trials
    assert len({tuple(t.params.values()) for t in now if t.state is TrialState.COMPLETE}) == sum(
        t.state is TrialState.COMPLETE for t in now
    )
