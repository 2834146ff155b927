"""Studies: the same trials from the same seed, gone on with after a kill, shared by processes, on any storage."""

import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import optuna
import pytest
from numpy.typing import NDArray
from optuna.trial import FrozenTrial, TrialState
from sqlalchemy import create_engine, text

from autotune.errors import InfeasibleError, UsageError
from autotune.studies.plugins import ObjectiveLimit
from autotune.studies.points import STRUCTURES, Judge, Sampler, build_controller, check_choices
from autotune.studies.storage import Storage, close_storage, open_storage, quiet_optuna
from autotune.studies.study import StudyPlan, is_feasible, run_study
from autotune.tuning.bounds import LINEAR_VARIABLES, presentable
from problems.design.evaluation import build_scenarios
from problems.design.objectives import HandForce, PeakForce
from problems.design.problem import VARIABLES
from tests.autotune.own_process import OwnProcess
from tests.autotune.studies.small import START, small_plan, small_problem, start_worker

FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


def trials_of(storage: Storage, name: str = "shared") -> list[FrozenTrial]:
    return optuna.load_study(study_name=name, storage=storage).get_trials()


def url_of(path: Path) -> str:
    return f"sqlite:///{path}"


def wait_for(storage: Storage, count: int, worker: OwnProcess, limit_s: float = 60.0) -> None:
    """Return once `count` trials are finished and another one runs."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        assert worker.returncode is None, worker.communicate()
        try:
            states = [trial.state for trial in trials_of(storage)]
        except KeyError:
            states = []
        if sum(state in FINISHED for state in states) >= count and TrialState.RUNNING in states:
            return
        time.sleep(0.005)
    raise AssertionError(f"{count} trials took more than {limit_s} s")


def beats(url: str) -> set[int]:
    """Trials that have had a heartbeat; one that dies before its first cannot be told from one that lives."""
    engine = create_engine(url)
    with engine.connect() as connection:
        found = {int(row[0]) for row in connection.execute(text("SELECT trial_id FROM trial_heartbeats"))}
    engine.dispose()
    return found


def stop_in_trial(url: str, storage: Storage, worker: OwnProcess) -> None:
    """Stop the worker in the middle of a trial whose heart has beaten."""
    for _ in range(2000):
        worker.send_signal(signal.SIGSTOP)
        running = {t._trial_id for t in trials_of(storage) if t.state is TrialState.RUNNING}
        if running & beats(url):
            return
        worker.send_signal(signal.SIGCONT)
        time.sleep(0.005)
    raise AssertionError("no trial was caught")


def kill(worker: OwnProcess) -> None:
    worker.send_signal(signal.SIGKILL)
    worker.communicate()
    assert worker.returncode == -signal.SIGKILL


# --- trials -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
def test_the_same_seed_makes_the_same_trials_and_a_pause_changes_none(tmp_path: Path, sampler: Sampler) -> None:
    plan = replace(small_plan(16), sampler=sampler)
    storages = [open_storage(None, tmp_path / f"{i}.db") for i in range(3)]
    for trials in (9, 16):
        run_study(small_problem(), replace(plan, trials=trials), storages[0], start=START, name="shared")
    run_study(small_problem(), plan, storages[1], start=START, name="shared")
    run_study(small_problem(), replace(plan, seed=4, trials=8), storages[2], start=START, name="shared")
    paused, whole, other = ([(t.params, t.values, t.state) for t in trials_of(s)] for s in storages)
    assert paused == whole
    assert len(whole) == 16
    assert whole[0] == other[0]  # the solver's design, whatever the seed
    assert whole[5:8] != other[5:]


def test_the_solvers_design_is_first_and_then_stands_in_every_other_structure(tmp_path: Path) -> None:
    choices = ("discretization", "lead")
    storage = open_storage(None, tmp_path / "study.db")
    run_study(small_problem(), small_plan(8, choices=choices), storage, start=START, name="shared")
    seen = [(t.params["discretization"], t.params["lead"]) for t in trials_of(storage)[:6]]
    assert seen[0] == ("tustin", "on")
    assert set(seen) == {(form, lead) for form in STRUCTURES["discretization"] for lead in STRUCTURES["lead"]}
    assert all(t.params["damping"] == START[1] for t in trials_of(storage)[:6])


def test_an_unstable_trial_has_no_numbers(tmp_path: Path) -> None:
    storage = open_storage(None, tmp_path / "study.db")
    problem = replace(small_problem(), bounds={**small_problem().bounds, "damping": (100.0, 1600.0)})
    run_study(problem, small_plan(12), storage, start=START, name="shared")
    prepared = build_scenarios(problem, problem.scenarios(3, 2))
    unstable = 0
    for trial in trials_of(storage):
        design = presentable(problem, np.array([trial.params[name] for name in VARIABLES]))
        is_stable = prepared.evaluate(design).is_stable
        assert trial.state is (TrialState.COMPLETE if is_stable else TrialState.PRUNED)
        assert (trial.values is None) is not is_stable
        assert (trial.constraints["stable"] <= 0.0) is is_stable
        unstable += not is_stable
    assert unstable > 0


def test_an_unstable_trial_misses_more_than_any_stable_one(tmp_path: Path) -> None:
    """What a sampler sorts by, the sum of what is missed: an unstable loop a hair outside is not the best of all."""
    storage = open_storage(None, tmp_path / "study.db")
    problem = replace(
        small_problem(),
        bounds={**small_problem().bounds, "damping": (100.0, 1600.0)},
        requirements=replace(small_problem().requirements, max_peak_force_n=31.0),
    )
    with pytest.raises(InfeasibleError, match="max_peak_force_n"):
        run_study(problem, small_plan(16), storage, start=START, name="shared")
    missed: dict[bool, list[float]] = {True: [], False: []}
    for trial in trials_of(storage):
        total = sum(value for value in trial.constraints.values() if value > 0.0)
        missed[trial.state is TrialState.COMPLETE].append(total)
    assert missed[True]
    assert missed[False]
    assert max(missed[True]) < min(missed[False])


SEEDS = ((1270.0, 0.018), (1280.0, 0.019), (1290.0, 0.019))
"""Damping and lead of further designs of the small problem that meet every requirement."""


def seeds_beside_the_start() -> list[NDArray[np.float64]]:
    return [np.array([6.0, damping, lead, 0.005]) for damping, lead in SEEDS]


def test_seeds_follow_the_start_and_are_asked_once(tmp_path: Path) -> None:
    storage, asked = open_storage(None, tmp_path / "study.db"), []

    def seeds() -> list[NDArray[np.float64]]:
        asked.append(1)
        return seeds_beside_the_start()

    for trials in (2, 6):
        run_study(small_problem(), small_plan(trials), storage, start=START, name="shared", seeds=seeds)
    assert asked == [1]
    dampings = [trial.params["damping"] for trial in trials_of(storage)[:4]]
    assert dampings == [START[1], *(damping for damping, _ in SEEDS)]


@pytest.mark.parametrize("sampler", ["tpe", "nsga2"])
def test_where_few_designs_are_feasible_half_of_the_trials_are_drawn_beside_them(
    tmp_path: Path, sampler: Sampler
) -> None:
    """In a box much wider than what is feasible, the neighbours of feasible trials are feasible more often."""
    problem = replace(small_problem(), bounds={**small_problem().bounds, "damping": (100.0, 100000.0)})
    storage = open_storage(None, tmp_path / "study.db")
    plan = replace(small_plan(44), sampler=sampler)
    front = run_study(problem, plan, storage, start=START, name="shared", seeds=seeds_beside_the_start)
    drawn = [t for t in trials_of(storage)[4:] if t.number < 44]
    beside = [is_feasible(t) for t in drawn if t.number % 2 == 0]
    alone = [is_feasible(t) for t in drawn if t.number % 2]
    assert len(beside) == len(alone) == 20
    assert sum(beside) > 2 * sum(alone)
    assert front.study is not None
    assert front.study.feasible == sum(is_feasible(t) for t in trials_of(storage))


def test_the_front_holds_what_a_judge_finds_again_and_nothing_infeasible(tmp_path: Path) -> None:
    plan = small_plan(40, choices=("discretization",))
    front = run_study(small_problem(), plan, open_storage(None, tmp_path / "s.db"), start=START, name="a", points=4)
    assert front.study is not None
    assert 1 <= len(front.points) <= 4
    assert front.study.trials == 40
    judge = Judge(small_problem(), plan.objectives)
    for point in front.points:
        again = judge.judge(point.controller)
        assert (again.values, again.requirements) == (point.values, point.requirements)
        assert point.is_feasible


def test_a_limit_holds_on_every_point_and_one_that_nothing_meets_is_infeasible(tmp_path: Path) -> None:
    storage = open_storage(None, tmp_path / "study.db")
    plan = StudyPlan(
        objectives=(PeakForce(),), demands=(ObjectiveLimit(objective=HandForce(), value=1955.0),), trials=30
    )
    front = run_study(small_problem(), plan, storage, start=START, name="held")
    assert all(HandForce.name + "_limit" in point.requirements for point in front.points)
    assert len(front.points) == 1  # one objective has one best
    hopeless = replace(plan, demands=(ObjectiveLimit(objective=HandForce(), value=1.0),), trials=5)
    with pytest.raises(InfeasibleError, match=r"None of 5 trials .* hand_force_limit \(0\.0"):
        run_study(small_problem(), hopeless, storage, start=START, name="hopeless")


def test_a_study_of_something_else_is_not_gone_on_with(tmp_path: Path) -> None:
    storage = open_storage(None, tmp_path / "study.db")
    run_study(small_problem(), small_plan(1), storage, start=START, name="shared")
    for plan in (small_plan(1, seed=9), small_plan(1, choices=("lead",)), replace(small_plan(1), sampler="nsga2")):
        with pytest.raises(UsageError, match="a study shared of another problem"):
            run_study(small_problem(), plan, storage, start=START, name="shared")
    assert len(trials_of(storage)) == 1


# --- structures ---------------------------------------------------------------------------------------------------


def test_a_structure_changes_what_it_names_and_nothing_else() -> None:
    problem = small_problem()
    plain = problem.controller(START)
    assert build_controller(problem, START, {}) == plain
    chosen = {"discretization": "backward_euler", "compensation": "filtered", "lead": "off", "feedback": "off"}
    assert build_controller(problem, START, chosen) == replace(
        plain, discretization="backward_euler", compensation_mass_kg=16.0, lead_s=0.0, feedback_damping_s=0.0
    )
    for wrong in (("wheels",), ("lead", "lead")):
        with pytest.raises(UsageError):
            check_choices(wrong)


# --- processes and storages ---------------------------------------------------------------------------------------


def check_kill_and_resume(url: str, tmp_path: Path) -> None:
    """Kill a worker in the middle of a trial; the next one goes on, and tries the lost trial again."""
    with quiet_optuna():
        storage = open_storage(url, tmp_path / "unused.db", heartbeat_s=1)
        # More than it can do before it is stopped, however quick it is.
        worker = start_worker(tmp_path, url, 500)
        wait_for(storage, 4, worker)
        stop_in_trial(url, storage, worker)
        kill(worker)
        left = trials_of(storage)
        (lost,) = [t for t in left if t.state is TrialState.RUNNING]
        finished = [(t.params, t.values) for t in left if t.state in FINISHED]
        assert len(finished) >= 4
        trials = len(finished) + 3
        time.sleep(4.5)  # longer than the grace of three heartbeats
        run_study(small_problem(), small_plan(trials), storage, start=START, name="shared")
        now = trials_of(storage)
        close_storage(storage)
    assert [(t.params, t.values) for t in now[: len(finished)]] == finished
    assert sum(t.state in FINISHED for t in now) == trials
    assert now[lost.number].state is TrialState.FAIL
    (again,) = [t for t in now if t.system_attrs.get("failed_trial") == lost.number]
    assert again.state in FINISHED
    assert {name: again.params[name] for name in lost.params} == lost.params


def finished_by_another(storage: Storage, number: int, state: TrialState) -> None:
    """Finish a trial as another process does that took it, too, or that gives it up because its heart has stopped."""
    study = optuna.load_study(study_name="shared", storage=storage)
    trial = study.get_trials()[number]
    if state is TrialState.FAIL:
        study.tell(number, state=state)
        try_again = storage.get_heartbeat_stale_trial_callback()
        assert try_again is not None
        try_again(study, trial)
        return
    other, plan = optuna.Trial(study, trial._trial_id), small_plan(1)
    for name in VARIABLES:
        low, high = small_problem().bounds[name]
        other.suggest_float(name, low, high, log=name not in LINEAR_VARIABLES)
    design = presentable(small_problem(), np.array([other.params[name] for name in VARIABLES]))
    judged = Judge(small_problem(), plan.objectives).judge(small_problem().controller(design))
    study.tell(number, [judged.values[each.name] for each in plan.objectives])


@pytest.mark.parametrize("moment", ["suggest_float", "set_constraint", "before it is reported"])
@pytest.mark.parametrize("state", [TrialState.COMPLETE, TrialState.FAIL])
def test_a_trial_that_another_process_has_finished_is_left_as_it_is(
    tmp_path: Path, moment: str, state: TrialState, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process sleeps at some moment of its third trial, and another one finishes it or gives it up meanwhile."""
    storage, trials, taken = open_storage(None, tmp_path / "study.db"), 4, 2
    slept: list[int] = []

    def sleep(number: int) -> None:
        if number == taken and not slept:
            slept.append(number)
            finished_by_another(storage, number, state)

    if moment == "before it is reported":
        tell = optuna.Study.tell

        def tell_later(study: optuna.Study, trial: Any, *arguments: Any, **options: Any) -> FrozenTrial:
            if isinstance(trial, optuna.Trial):
                sleep(trial.number)
            return tell(study, trial, *arguments, **options)

        monkeypatch.setattr(optuna.Study, "tell", tell_later)
    else:
        write = getattr(optuna.Trial, moment)

        def write_later(trial: optuna.Trial, *arguments: Any, **options: Any) -> Any:
            sleep(trial.number)
            return write(trial, *arguments, **options)

        monkeypatch.setattr(optuna.Trial, moment, write_later)
    run_study(small_problem(), small_plan(trials), storage, start=START, name="shared")
    found = trials_of(storage)
    assert slept == [taken]
    assert found[taken].state is state
    assert sum(t.state in FINISHED for t in found) == trials
    assert all(t.state in {*FINISHED, TrialState.FAIL} for t in found)
    assert len({tuple(t.params.items()) for t in found if t.state in FINISHED}) == trials
    if state is TrialState.FAIL:
        (again,) = [t for t in found if t.system_attrs.get("failed_trial") == taken]
        assert again.state in FINISHED


def test_a_judge_that_fails_ends_the_study_and_its_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = open_storage(None, tmp_path / "study.db")
    monkeypatch.setattr(Judge, "judge", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_study(small_problem(), small_plan(4), storage, start=START, name="shared")
    assert [t.state for t in trials_of(storage)] == [TrialState.FAIL]


def check_two_workers(url: str, tmp_path: Path) -> None:
    """Two processes share one study, begun by both at once: all trials are done, none twice."""
    trials = 8
    workers = [start_worker(tmp_path, url, trials) for _ in range(2)]
    for worker in workers:
        reported, wrong = worker.communicate(timeout=120)
        assert worker.returncode == 0, wrong
        assert int(reported) >= 1
    with quiet_optuna():
        storage = open_storage(url, tmp_path / "unused.db")
        found = trials_of(storage)
        close_storage(storage)
    finished = [t for t in found if t.state in FINISHED]
    assert trials <= len(finished) <= trials + 1  # the last two may end together
    drawn = [tuple(sorted(t.params.items())) for t in finished]
    assert len(drawn) - len(set(drawn)) <= 1  # both may have laid the solver's design ready


@pytest.mark.slow
def test_a_killed_study_goes_on_where_it_stood(tmp_path: Path) -> None:
    check_kill_and_resume(url_of(tmp_path / "study.db"), tmp_path)


@pytest.mark.slow
def test_two_processes_share_a_study(tmp_path: Path) -> None:
    check_two_workers(url_of(tmp_path / "study.db"), tmp_path)


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("nonsense", "is no URL"),
        ("redis://user:secret@host/0", "must be SQLite (sqlite:///FILE) or PostgreSQL"),
        ("journal:///study.log", "found journal://."),
        ("mysql+pymysql://user:secret@host/x", "found mysql+pymysql://."),
        ("postgresql+foo://user:secret@host/x", "postgresql+foo://user:***@host/x cannot be used"),
        ("sqlite:////nonexistent/folder/x.db", "unable to open database file"),
    ],
)
def test_a_storage_that_does_not_open_is_named_without_its_password(tmp_path: Path, url: str, said: str) -> None:
    with pytest.raises(UsageError) as refused:
        open_storage(url, tmp_path / "x")
    assert said in str(refused.value)
    assert "secret" not in str(refused.value)
