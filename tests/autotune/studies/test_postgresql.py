"""Studies on a PostgreSQL server: killed, shared, and gone on with after the server was started again."""

from pathlib import Path

import pytest
from optuna.trial import TrialState

from autotune.studies.storage import close_storage, open_storage, quiet_optuna
from autotune.studies.study import run_study
from tests.autotune.postgresql import Server
from tests.autotune.studies.small import START, small_plan, small_problem, start_worker

from .test_study import FINISHED, check_kill_and_resume, check_two_workers, trials_of, wait_for


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
        worker = start_worker(tmp_path, url, trials)
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
