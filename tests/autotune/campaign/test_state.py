"""The state of a campaign: claimed once, shared, killed, gone back, and kept by SQLite or a real PostgreSQL server."""

import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import create_engine, text

from autotune.campaign.manifest import STATE, read_manifest
from autotune.campaign.options import RunOptions
from autotune.campaign.run import work_on_runs
from autotune.campaign.state import CampaignState, open_state
from autotune.campaign.work import RunTask, build_task
from autotune.errors import UsageError
from problems.errors import MissingExtraError
from tests.autotune.campaign.sharing import (
    PLANT,
    Slow,
    campaign,
    identified_at_once,
    start_campaign,
    table,
    until,
    worked,
    written_logs,
)
from tests.autotune.postgresql import Server
from tests.conftest import RunCli

COUNT = 12


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    return written_logs(tmp_path / "logs", COUNT)


@pytest.fixture(autouse=True)
def identified(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every log be identified at once in this process; workers of a pool do the real work."""
    monkeypatch.setattr("autotune.campaign.work._identify_and_tune", identified_at_once)


@pytest.fixture
def calm(logs: Path, tmp_path: Path) -> str:
    """The table of a campaign that nothing happens to."""
    return table(tmp_path / "calm-table", campaign(logs, tmp_path / "calm"))


@pytest.fixture
def tasks(logs: Path, tmp_path: Path) -> list[RunTask]:
    return [build_task(run, tmp_path / "out", RunOptions()) for run in read_manifest(logs)]


@pytest.fixture(params=["sqlite", "postgresql"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of an empty database of each kind."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'shared.db'}"
    server: Server = request.getfixturevalue("postgresql")
    return server.new_database(re.sub(r"\W+", "_", request.node.name.lower())[-40:])


def rows(storage: str) -> list[dict[str, Any]]:
    engine = create_engine(storage)
    with engine.connect() as connection:
        found = [
            dict(row._mapping) for row in connection.execute(text("select * from autotune_runs order by cell, run"))
        ]
    engine.dispose()
    return found


def change(storage: str, statement: str) -> None:
    engine = create_engine(storage)
    with engine.begin() as connection:
        connection.execute(text(statement))
    engine.dispose()


def done(storage: str) -> dict[str, tuple[Any, ...]]:
    """What is finished, and when: what may not change any more."""
    kept = [row for row in rows(storage) if row["result"] is not None]
    return {f"{row['cell']}/{row['run']}": (row["attempts"], row["ended"], row["result"]) for row in kept}


# --- what is in the table ----------------------------------------------------------------------------------------


def test_without_more_the_state_is_a_sqlite_file_in_the_folder(logs: Path, tmp_path: Path) -> None:
    outcomes = campaign(logs, tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [STATE, "cells"]
    found = rows(f"sqlite:///{tmp_path / 'out' / STATE}")
    assert {(row["folder"], row["state"], row["attempts"], row["lease"]) for row in found} == {(".", "done", 1, None)}
    assert all(row["host"] and row["started"] <= row["ended"] for row in found)
    # The folder is a whole: moved, it is still known.
    shutil.move(tmp_path / "out", tmp_path / "moved")
    assert campaign(logs, tmp_path / "moved", names=tmp_path / "worked") == outcomes
    assert worked(tmp_path) == []


def test_a_folder_of_its_own_has_rows_of_its_own(logs: Path, tmp_path: Path, storage: str) -> None:
    for folder in ("a", "b", "a"):
        campaign(logs, tmp_path / folder, storage=storage)
    assert Counter(row["folder"] for row in rows(storage)) == {str(tmp_path / name): COUNT for name in "ab"}
    assert {row["attempts"] for row in rows(storage)} == {1}
    assert not (tmp_path / "a" / STATE).exists()


# --- claims ------------------------------------------------------------------------------------------------------


@contextmanager
def two_processes(storage: str, folder: Path) -> Iterator[tuple[CampaignState, CampaignState]]:
    with ExitStack() as stack:
        a, b = (stack.enter_context(open_state(storage, folder)) for _ in range(2))
        yield a, b


def test_of_two_who_saw_a_run_free_one_has_it(storage: str, tasks: list[RunTask], tmp_path: Path) -> None:
    with two_processes(storage, tmp_path / "out") as (a, b):
        assert a.look(tasks).free == b.look(tasks).free == tasks
        assert (a.claim(tasks[0]), b.claim(tasks[0]), a.claim(tasks[0])) == (True, False, True)
        assert b.look(tasks).hosts
        outcome = tasks[0].refused("log", "no log")
        assert a.finish(tasks[0], outcome)
        assert b.look(tasks).known == [(tasks[0], outcome)]
        # Seen as it was before, it is not taken either.
        c = tasks[1]
        assert a.claim(c)
        assert a.finish(c, c.refused("log", "no log"))
        assert not b.claim(c)


def test_a_claim_that_is_not_renewed_is_taken_and_what_comes_later_does_not_count(
    storage: str, tasks: list[RunTask], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, first, other = tasks[0], tasks[0].refused("log", "first"), tasks[0].refused("log", "other")
    with two_processes(storage, tmp_path / "out") as (a, b):
        a.look(tasks)
        assert a.claim(task)
        assert task not in b.look(tasks).free
        change(storage, "update autotune_runs set lease = '2001-01-01 00:00:00.000000' where state = 'running'")
        monkeypatch.setattr("autotune.campaign.state._RENEWAL_S", 0.0)
        stale = b.look(tasks)
        assert task in stale.free
        assert a.renew()
        assert not b.claim(task)  # it was renewed since it was seen
        change(storage, "update autotune_runs set lease = '2001-01-01 00:00:00.000000' where state = 'running'")
        assert task in b.look(tasks).free
        assert b.claim(task)
        assert not a.finish(task, first)
        assert b.finish(task, other)
        assert a.look([task]).known == [(task, other)]
        assert rows(storage)[0]["attempts"] == 2


def test_what_is_given_back_is_free_at_once(storage: str, tasks: list[RunTask], tmp_path: Path) -> None:
    with two_processes(storage, tmp_path / "out") as (a, b):
        a.look(tasks)
        assert all(a.claim(task) for task in tasks[:3])
        a.release()
        assert b.look(tasks).free == tasks


def test_a_campaign_that_is_interrupted_gives_its_claims_back(
    storage: str, tasks: list[RunTask], tmp_path: Path
) -> None:
    def interrupted() -> None:
        with open_state(storage, tmp_path / "out") as state:
            state.look(tasks)
            assert all(state.claim(task) for task in tasks[:3])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert {(row["state"], row["lease"]) for row in rows(storage)} == {("waiting", None)}


def test_a_run_that_was_killed_is_tried_by_the_next_campaign_and_by_none_that_runs(
    storage: str, tasks: list[RunTask], tmp_path: Path
) -> None:
    killed = tasks[0].refused("killed", "out of memory")
    with two_processes(storage, tmp_path / "out") as (a, b):
        for each in (a, b):
            each.look(tasks)
        assert a.claim(tasks[0])
        a.finish(tasks[0], killed)
        assert a.look(tasks).known == b.look(tasks).known == [(tasks[0], killed)]
    with open_state(storage, tmp_path / "out") as c:
        assert c.look(tasks).free == tasks
        assert c.look(tasks).free == tasks


# --- several processes, and kills --------------------------------------------------------------------------------


def test_two_processes_share_the_runs(logs: Path, tmp_path: Path, storage: str, calm: str) -> None:
    tables = tmp_path / "tables"
    both = [start_campaign(logs, tmp_path / "out", storage, tables, 0.3) for _ in range(2)]
    until(lambda: all(each.out.read_text(encoding="utf-8") == "ready\n" for each in both))
    tables.mkdir()
    assert [each.communicate(timeout=60)[1] for each in both] == ["", ""]
    assert Counter(name for _, name in worked(tables)) == {run.name: 1 for run in read_manifest(logs)}
    assert {process for process, _ in worked(tables)} == {each.pid for each in both}
    assert {(row["state"], row["attempts"]) for row in rows(storage)} == {("done", 1)}
    for each in both:
        assert (tables / str(each.pid) / "campaign.csv").read_text(encoding="utf-8") == calm


def test_the_runs_of_a_campaign_that_is_killed_are_taken_at_once(
    logs: Path, tmp_path: Path, storage: str, calm: str
) -> None:
    """What it had finished stays; what it had claimed is free, since its process is gone from this machine."""
    tables = tmp_path / "tables"
    tables.mkdir()
    process = start_campaign(logs, tmp_path / "out", storage, tables, 0.3)
    until(lambda: len(worked(tables)) >= 4)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    left = done(storage)
    assert 3 <= len(left) < COUNT
    assert "running" in {row["state"] for row in rows(storage)}
    begun = time.monotonic()
    outcomes = campaign(logs, tmp_path / "out", storage=storage)
    assert time.monotonic() - begun < 40.0  # of 120 s for which a claim lasts
    assert {name: done(storage)[name] for name in left} == left
    assert {row["state"] for row in rows(storage)} == {"done"}
    assert table(tmp_path / "table", outcomes) == calm


def test_the_runs_of_another_machine_are_waited_for_until_it_is_silent(
    logs: Path, tmp_path: Path, storage: str, calm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, notes = read_manifest(logs), list[str]()
    with open_state(storage, tmp_path / "out") as state:
        state.look([build_task(run, tmp_path / "out", RunOptions()) for run in runs])
    soon = "datetime('now', '+4 seconds') || '.000000'" if "sqlite" in storage else "now() + interval '4 seconds'"
    theirs = f"state = 'running', owner = '0badcafe-1-0123456789abcdef', host = 'plant-2', lease = {soon}"
    change(storage, f"update autotune_runs set {theirs} where run = 'run03'")
    monkeypatch.setattr("autotune.campaign.run._WAIT_S", 0.2)
    outcomes = campaign(logs, tmp_path / "out", names=tmp_path / "worked", storage=storage, note=notes.append)
    assert worked(tmp_path)[-1][1] == "cell3/run03"
    assert notes == ["Waiting for plant-2 to finish 1 run."]
    assert table(tmp_path / "table", outcomes) == calm


# --- state and folder that disagree ------------------------------------------------------------------------------


def test_a_result_whose_files_are_missing_or_altered_is_done_again(logs: Path, tmp_path: Path, storage: str) -> None:
    out, notes = tmp_path / "out", list[str]()

    def again() -> list[str]:
        (tmp_path / "worked").unlink(missing_ok=True)
        assert campaign(logs, out, names=tmp_path / "worked", storage=storage, note=notes.append) == first
        return sorted(name for _, name in worked(tmp_path))

    first = campaign(logs, out, storage=storage)
    files = {path: path.read_bytes() for path in out.rglob("identified.yaml")}
    (out / "cells" / "cell0" / "run00" / "note.txt").write_text("of the user", encoding="utf-8")
    assert (len(files), again(), notes) == (
        COUNT,
        [],
        [f"Nothing to do: {COUNT} of {COUNT} runs done with these inputs, options and version."],
    )
    (out / "cells" / "cell1" / "run01" / "identified.yaml").write_text("key: other\n", encoding="utf-8")
    shutil.rmtree(out / "cells" / "cell2")
    names = ["cell1/run01", "cell2/run02", "cell2/run06", "cell2/run10"]
    assert again() == names
    assert notes[1] == f"Done again, since files of their results are missing or altered: {', '.join(names)}."
    assert notes[2:] == [f"4 of {COUNT} runs to do: {COUNT - 4} are done with these inputs, options and version."]
    assert {path: path.read_bytes() for path in out.rglob("identified.yaml")} == files
    assert again() == []


def test_a_state_that_is_restored_from_an_older_copy_claims_nothing_that_is_not_there(
    logs: Path, tmp_path: Path
) -> None:
    runs, out = read_manifest(logs), tmp_path / "out"

    def worked_on() -> list[str]:
        (tmp_path / "worked").unlink(missing_ok=True)
        outcomes = campaign(logs, out, names=tmp_path / "worked")
        for run, each in zip(runs, outcomes, strict=True):
            files = out / "cells" / run.cell / run.run
            assert (files / "identified.yaml").read_text(encoding="utf-8") == f"{PLANT}key: {each.key}\n"
        return [name for _, name in worked(tmp_path)]

    worked_on()
    shutil.copy(out / STATE, tmp_path / "copy")
    old = runs[5].logs[0].read_bytes()
    runs[5].logs[0].write_text("t,a\n0,99\n1,2\n", encoding="utf-8")
    assert worked_on() == [runs[5].name]
    shutil.copy(tmp_path / "copy", out / STATE)
    assert worked_on() == [runs[5].name]  # of which the copy knows the former log only
    shutil.copy(tmp_path / "copy", out / STATE)
    runs[5].logs[0].write_bytes(old)
    assert worked_on() == [runs[5].name]  # which the copy knows, but the folder is of the other log
    assert worked_on() == []
    (out / STATE).unlink()
    assert worked_on() == [run.name for run in runs]


@pytest.mark.usefixtures("forked")
def test_a_run_that_is_refused_leaves_no_files_of_a_former_log(logs: Path, tmp_path: Path) -> None:
    run = read_manifest(logs)[0]
    task = build_task(run, tmp_path / "out", RunOptions())
    task.folder.mkdir(parents=True)
    (task.folder / "identified.yaml").write_text(PLANT, encoding="utf-8")
    assert work_on_runs([run], tmp_path / "out")[0].files == {}
    assert not task.folder.exists()


# --- what is wrong with a storage --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("nonsense", "--storage is no URL"),
        ("sqlite:///", "--storage names no file, and what is kept in memory is lost"),
        ("sqlite:///:memory:", "--storage names no file, and what is kept in memory is lost"),
        ("mysql+pymysql://user:secret@host/x", "--storage must be SQLite (sqlite:///FILE) or PostgreSQL"),
        ("postgresql+foo://user:secret@host/x", "storage postgresql+foo://user:***@host/x cannot be used: Can't load"),
        ("sqlite:////nonexistent/folder/x.db", "cannot be used: unable to open database file."),
        ("sqlite:///{}/text.db", "cannot be used: file is not a database."),
        ("postgresql://user:secret@127.0.0.1:9/x", "user:***@127.0.0.1:9/x cannot be used: connection failed"),
    ],
)
def test_a_storage_that_cannot_be_used_is_exit_code_2_and_nothing_is_written(
    run_cli: RunCli, logs: Path, tmp_path: Path, url: str, said: str
) -> None:
    (tmp_path / "text.db").write_text("no database, but a text of some length" * 20, encoding="utf-8")
    refused = run_cli("campaign", logs, "-o", "out", "--storage", url.format(tmp_path))
    assert refused.returncode == 2
    assert said in refused.stderr.replace("\n", " ")
    assert "secret" not in refused.stderr
    assert not (tmp_path / "out").exists()


def test_without_the_driver_its_extra_is_named(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("problems.errors.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=re.escape("pip install 'robot-autotune[postgresql]'")):
        campaign(logs, tmp_path / "out", storage="postgresql://user@host/x")


def test_a_wrong_password_is_named(postgresql: Server, logs: Path, tmp_path: Path) -> None:
    url = postgresql.new_database("guarded")
    change(url, "create role guarded login password 'right'")
    change(url, "grant all on schema public to guarded")
    with pytest.raises(
        UsageError, match=r"cannot be used: connection failed: .*password authentication failed"
    ) as seen:
        campaign(logs, tmp_path / "out", storage=url.replace("tester@", "guarded:secret@"))
    assert "secret" not in str(seen.value)
    campaign(logs, tmp_path / "out", storage=url.replace("tester@", "guarded:right@"))
    assert {row["state"] for row in rows(url)} == {"done"}


def test_a_file_that_may_only_be_read_or_that_another_keeps_locked_is_named(
    logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "state.db"
    campaign(logs / "cell0", tmp_path / "out", storage=f"sqlite:///{path}")
    read_only = f"sqlite:///file:{path}?mode=ro&uri=true"
    # Everything is known, so that nothing is to be written.
    assert len(campaign(logs / "cell0", tmp_path / "out", storage=read_only)) == 3
    with pytest.raises(UsageError, match=r"storage failed: attempt to write a readonly database\. What is finished is"):
        campaign(logs, tmp_path / "out", storage=read_only)
    monkeypatch.setattr("autotune.database._SQLITE_TIMEOUT_S", 0.2)
    with sqlite3.connect(path) as other:
        other.execute("begin immediate")
        with pytest.raises(
            UsageError, match=r"The campaign's storage failed: database is locked\. What is finished is"
        ):
            campaign(logs, tmp_path / "out", storage=f"sqlite:///{path}")
        other.rollback()
    assert len(campaign(logs, tmp_path / "out", storage=f"sqlite:///{path}")) == COUNT


# --- a server that is started again ------------------------------------------------------------------------------


def test_a_server_that_is_started_again_costs_nothing(
    postgresql: Server, logs: Path, tmp_path: Path, calm: str
) -> None:
    url, tables = postgresql.new_database("away"), tmp_path / "tables"
    tables.mkdir()
    process = start_campaign(logs, tmp_path / "out", url, tables, 0.3)
    until(lambda: len(worked(tables)) >= 3)
    postgresql.stop()
    time.sleep(1.0)
    postgresql.start()
    left = done(url)
    assert process.communicate(timeout=100)[1] == ""
    assert Counter(name for _, name in worked(tables)) == {run.name: 1 for run in read_manifest(logs)}
    assert {name: done(url)[name] for name in left} == left
    assert {(row["state"], row["attempts"]) for row in rows(url)} == {("done", 1)}
    assert (tables / str(process.pid) / "campaign.csv").read_text(encoding="utf-8") == calm


def test_a_server_that_stays_away_ends_the_campaign_and_the_same_again_does_the_rest(
    postgresql: Server, logs: Path, tmp_path: Path, calm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, runs = postgresql.new_database("gone"), read_manifest(logs)
    monkeypatch.setattr("autotune.campaign.state._PATIENCE_S", 0.5)

    def stop() -> None:
        until(lambda: len(worked(tmp_path)) >= 4)
        postgresql.stop()

    stopper = threading.Thread(target=stop)
    stopper.start()
    with (
        Slow(0.3, tmp_path / "worked") as executor,
        pytest.raises(UsageError, match=r"The campaign's storage failed: .*; the same command goes on from there\."),
    ):
        work_on_runs(runs, tmp_path / "out", executor=executor, storage=url)
    stopper.join()
    postgresql.start()
    left = done(url)
    assert 1 <= len(left) < COUNT
    outcomes = campaign(logs, tmp_path / "out", storage=url)
    assert {name: done(url)[name] for name in left} == left
    assert table(tmp_path / "table", outcomes) == calm


# --- imports -----------------------------------------------------------------------------------------------------


def test_workers_and_other_commands_do_without_a_database() -> None:
    code = (
        "import sys; from autotune.cli.main import main; import autotune.campaign.work, autotune.cli.campaign; "
        "main(['campaign', '--help']); assert 'sqlalchemy' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
