"""Optuna as the study layer: discrete choices, any objectives, many workers on one storage, resumed after a crash.

Only this module and the sampler import Optuna, which takes half a second.
"""

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from numpy.typing import NDArray
from optuna.storages import BaseStorage, JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback
from optuna.storages.journal import JournalFileBackend, JournalRedisBackend
from optuna.trial import FrozenTrial, Trial, TrialState
from sqlalchemy import event
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from autotune import __version__
from autotune.errors import InfeasibleError, UsageError
from autotune.formats.canonical import checksum
from autotune.formats.records import record_tree
from autotune.tuning.bounds import LINEAR_VARIABLES
from autotune.tuning.search import presentable
from problems.design.problem import DesignProblem
from problems.model.controller import AdmittanceController
from problems.stability.margins import UnstableLoopError

from .plugins import Demand, Limit, Objective
from .points import Front, Judge, Judgement, StudyRecord, index_of, thinned, undominated
from .sampler import NumberedSampler, Sampler, is_feasible
from .structures import STRUCTURES, build_controller

FloatArray = NDArray[np.float64]
Storage = BaseStorage

HEARTBEAT_S = 10
_GRACE_BEATS = 3
_RETRIES = 3
_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
# Two workers that meet a new storage both lay its tables; the slower one finds them a moment later.
_OPENINGS, _OPENING_PAUSE_S = 5, 0.5
_SQLITE_PATIENCE_S = 60
# Constraints are logarithms of required/achieved: an unstable trial misses more than any stable one.
_LARGEST_MISS = math.log(1e6)
_UNSTABLE_MISS = 2.0 * _LARGEST_MISS


@dataclass(frozen=True, kw_only=True)
class StudyPlan:
    """What a study looks at: objectives, demands, choices (names of `STRUCTURES`), trials in all, and a seed."""

    objectives: tuple[Objective, ...]
    demands: tuple[Demand, ...] = ()
    choices: tuple[str, ...] = ()
    trials: int = 200
    sampler: Sampler = "tpe"
    seed: int = 0


def open_storage(url: str | None, beside: Path, *, heartbeat_s: int = HEARTBEAT_S) -> BaseStorage:
    """Open the storage of a study: `url`, or the SQLite file `beside`.

    Relational storages get a heartbeat every `heartbeat_s` seconds, and a trial whose worker fell silent for three of
    them is tried again, three times at most. Journals have no heartbeat: `journal:///FILE` and `redis://HOST/DB`.
    Raises UsageError when the storage cannot be opened; the message hides the password.
    """
    try:
        address = URL.create("sqlite", database=str(beside)) if url is None else make_url(url)
    except SQLAlchemyError as error:
        # The text is not repeated: whatever it is, it may hold a password.
        raise UsageError("--storage is no URL; an example is sqlite:///study.db.") from error
    try:
        return _opened(address, heartbeat_s)
    except Exception as error:
        # Every driver has errors of its own, whose first line says what is wrong.
        reason = next(iter(str(error.__cause__ or error).splitlines()), repr(error)).rstrip(".")
        raise UsageError(
            f"The study's storage {address.render_as_string(hide_password=True)} cannot be used: {reason}."
        ) from error


def close_storage(storage: Storage) -> None:
    """Close the connections of a storage; it opens new ones when it is used again."""
    if isinstance(storage, RDBStorage):
        storage.remove_session()
        storage.engine.dispose()


def _opened(address: URL, heartbeat_s: int) -> BaseStorage:
    text = address.render_as_string(hide_password=False)
    kind = address.get_backend_name()
    if kind == "redis":
        with _quiet():
            return JournalStorage(JournalRedisBackend(text))
    if kind == "journal":
        with _quiet():
            return JournalStorage(JournalFileBackend(address.database or ""))
    for opening in itertools.count(1):
        try:
            with _quiet():
                storage = RDBStorage(
                    text,
                    engine_kwargs={"connect_args": {"timeout": _SQLITE_PATIENCE_S}} if kind == "sqlite" else None,
                    heartbeat_interval=heartbeat_s,
                    grace_period=_GRACE_BEATS * heartbeat_s,
                    heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(max_retry=_RETRIES),
                )
            if kind == "sqlite":
                event.listen(storage.engine, "connect", _write_ahead)
                storage.engine.dispose()  # what is open already was opened without
            return storage
        except (DBAPIError, optuna.exceptions.StorageInternalError):
            if opening == _OPENINGS:
                raise
            time.sleep(_OPENING_PAUSE_S)
    raise AssertionError("unreachable")


def _write_ahead(connection: Any, _record: object) -> None:
    """Let SQLite write ahead: a trial is 25 commits, each of which would otherwise wait for the disk.

    A killed process loses nothing and a power failure at most the last trials, not the file.
    """
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=NORMAL")
    cursor.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Optuna's progress lines and its notes on experimental parts (the heartbeat is one) off the terminal."""
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)


def run_study(
    problem: DesignProblem,
    plan: StudyPlan,
    storage: BaseStorage,
    *,
    start: FloatArray,
    name: str,
    points: int | None = None,
    seeds: Callable[[], Sequence[FloatArray]] = tuple,
    progress: Callable[[float], None] | None = None,
) -> Front:
    """Run the study until it has `plan.trials` finished trials, and return its front, at most `points` of it.

    `start` is the solver's design, tried first, and then in every other structure; then come the designs that `seeds`
    returns, which is asked once in the life of a study. A study of this name in the storage is continued, also by
    several processes at a time. A trial judges its controller over the dense grid; unstable
    ones are pruned, since no number of them means anything. The front is judged anew and not taken from the storage.

    Raises UsageError when the study of this name was made for something else, InfeasibleError when no trial meets
    every requirement.
    """
    report = progress if progress is not None else _silent
    judge = Judge(problem, plan.objectives, plan.demands)
    with _quiet(), _told_by_the_storage():
        study = _open_study(problem, plan, storage, start, name)
        _seed(study, problem, plan, seeds)
        done = len(study.get_trials(deepcopy=False, states=_FINISHED))
        report(min(1.0, done / plan.trials))
        while done < plan.trials:
            study.optimize(lambda trial: _try(trial, judge, plan), n_trials=1)
            before, done = done, len(study.get_trials(deepcopy=False, states=_FINISHED))
            report(min(done, plan.trials) / plan.trials - before / plan.trials)
        trials = study.get_trials(deepcopy=False, states=_FINISHED)
    return _front(trials, judge, plan, start, name, points)


@contextmanager
def _told_by_the_storage() -> Iterator[None]:
    try:
        yield
    except (SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
        reason = next(iter(str(error.__cause__ or error).splitlines()), repr(error)).rstrip(".")
        raise UsageError(
            f"The study's storage failed: {reason}. What is finished is kept; the same command goes on from there."
        ) from error


def _open_study(
    problem: DesignProblem, plan: StudyPlan, storage: BaseStorage, start: FloatArray, name: str
) -> optuna.Study:
    study = optuna.create_study(
        storage=storage,
        study_name=name,
        load_if_exists=True,
        directions=[objective.direction for objective in plan.objectives],
        sampler=NumberedSampler(plan.sampler, plan.seed),
    )
    mark = fingerprint(problem, plan, start)
    if study.user_attrs.setdefault("made_for", mark) != mark:
        raise UsageError(
            f"The storage holds a study {name} of another problem, seed, version, or other objectives; say another "
            "--study, or another --storage."
        )
    study.set_user_attr("made_for", mark)
    for values in itertools.product(*(STRUCTURES[choice] for choice in plan.choices)):
        chosen = dict(zip(plan.choices, values, strict=True))
        study.enqueue_trial({**_named(problem, start), **chosen}, skip_if_exists=True)
    return study


def _seed(
    study: optuna.Study, problem: DesignProblem, plan: StudyPlan, seeds: Callable[[], Sequence[FloatArray]]
) -> None:
    """Put designs to begin with into the queue, once in the life of a study, in the structure of the solver."""
    if study.user_attrs.get("seeded"):
        return
    usual = {choice: STRUCTURES[choice][0] for choice in plan.choices}
    for design in seeds():
        study.enqueue_trial({**_named(problem, design), **usual}, skip_if_exists=True)
    study.set_user_attr("seeded", value=True)


def _named(problem: DesignProblem, design: FloatArray) -> dict[str, float]:
    return {variable: float(value) for variable, value in zip(problem.variables, design, strict=True)}


def fingerprint(problem: DesignProblem, plan: StudyPlan, start: FloatArray) -> str:
    """Return the digest of all that decides the trials of a study, their number excepted."""
    tree = {
        "version": __version__,
        "optuna": optuna.__version__,
        "problem": record_tree(problem),
        "objectives": [each.name for each in plan.objectives],
        "demands": [each.name + (f"={each.value!r}" if isinstance(each, Limit) else "") for each in plan.demands],
        "choices": list(plan.choices),
        "sampler": plan.sampler,
        "constraints": "logarithms",
        "seed": plan.seed,
        "start": [float(value) for value in start],
    }
    return checksum(tree)


def _try(trial: Trial, judge: Judge, plan: StudyPlan) -> tuple[float, ...]:
    for name in judge.problem.variables:
        low, high = judge.problem.bounds[name]
        trial.suggest_float(name, low, high, log=name not in LINEAR_VARIABLES)
    for choice in plan.choices:
        trial.suggest_categorical(choice, STRUCTURES[choice])
    try:
        judged = judge.judge(_controller(trial.params, judge.problem, plan))
    except UnstableLoopError as error:
        beyond = max(error.spectral_radius - 1.0, 0.0)
        _constrain(trial, {"stable": _UNSTABLE_MISS + min(beyond, _LARGEST_MISS)})
        raise optuna.TrialPruned(str(error)) from error
    _constrain(trial, {"stable": 0.0, **{name: _missed(ratio) for name, ratio in judged.requirements.items()}})
    return tuple(judged.values[each.name] for each in plan.objectives)


def _missed(ratio: float) -> float:
    """Return the logarithm of required/achieved, above 0 exactly where the requirement is missed."""
    return min(math.log(ratio), _LARGEST_MISS) if ratio > 0.0 else -_LARGEST_MISS


def _constrain(trial: Trial, values: Mapping[str, float]) -> None:
    """Set the constraints of a trial; one that was killed while it did so and is tried again holds some already."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*already set", category=UserWarning)
        for name, value in values.items():
            trial.set_constraint(name, value)


def _controller(params: Mapping[str, Any], problem: DesignProblem, plan: StudyPlan) -> AdmittanceController:
    design = presentable(problem, np.array([params[name] for name in problem.variables]))
    return build_controller(problem, design, {choice: params[choice] for choice in plan.choices})


def _front(
    trials: Sequence[FrozenTrial], judge: Judge, plan: StudyPlan, start: FloatArray, name: str, points: int | None
) -> Front:
    feasible = [trial for trial in trials if is_feasible(trial)]
    if not feasible:
        raise InfeasibleError(
            f"None of {len(trials)} trials of the study {name} meets every requirement; {_closest(trials)}. Ask for "
            "less, or for more trials."
        )
    told = [
        Judgement(
            controller=_controller(trial.params, judge.problem, plan),
            values=dict(zip((each.name for each in plan.objectives), trial.values, strict=True)),
            requirements={},
        )
        for trial in feasible
    ]
    judged = [judge.judge(point.controller) for point in undominated(told, plan.objectives)]
    first, front = judge.problem.controller(start), undominated(judged, plan.objectives)
    kept = thinned(front, plan.objectives, points, index_of(first, front))
    return Front(
        problem=judge.problem,
        objectives=plan.objectives,
        points=kept,
        scenario_count=judge.scenario_count,
        chosen=index_of(first, kept),
        study=StudyRecord(name=name, sampler=plan.sampler, trials=len(trials), feasible=len(feasible)),
    )


def _closest(trials: Sequence[FrozenTrial]) -> str:
    """Say what the trial that misses its worst requirement by the least misses."""
    judged = [trial.constraints for trial in trials if trial.state is TrialState.COMPLETE]
    if not judged:
        return "none of them is stable in every scenario"
    closest = min(judged, key=lambda missed: max(missed.values()))
    told = (
        f"{name} ({100.0 * math.exp(-value):.3g} % of what is asked)" for name, value in closest.items() if value > 0.0
    )
    return f"the closest one misses {', '.join(told)}"


def _silent(_: float) -> None:
    return None
