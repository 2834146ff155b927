"""Optuna studies: discrete choices, any objectives, many workers on one storage, resumed after a crash."""

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.exceptions import UpdateFinishedTrialError
from optuna.samplers import BaseSampler, NSGAIISampler, TPESampler
from optuna.search_space import intersection_search_space
from optuna.storages._heartbeat import get_heartbeat_thread
from optuna.trial import FrozenTrial, Trial, TrialState

from autotune.database import named_failures
from autotune.errors import InfeasibleError, UsageError
from autotune.formats.canonical import checksum
from autotune.formats.records import record_tree
from autotune.tuning.bounds import LINEAR_VARIABLES, presentable
from autotune.version import __version__
from problems.arrays import FloatArray
from problems.design.objectives import Objective
from problems.design.problem import DesignProblem
from problems.model.controller import AdmittanceController
from problems.progress import no_progress
from problems.stability.margins import UnstableLoopError

from .plugins import Demand, ObjectiveLimit
from .points import (
    STRUCTURES,
    Front,
    Judge,
    Judgement,
    Sampler,
    StudyRecord,
    build_controller,
    index_of,
    thinned,
    undominated,
)
from .storage import Storage, quiet_optuna

_FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
# Constraints are logarithms of required/achieved: an unstable trial misses more than any stable one.
_LARGEST_MISS = math.log(1e6)
_UNSTABLE_MISS = 2.0 * _LARGEST_MISS
_FEWEST_NEIGHBOURS = 3
_LOCAL_SHARE = 0.02  # of a variable's range, so that neighbours that agree in it do not fix it


@dataclass(frozen=True, kw_only=True)
class StudyPlan:
    """The settings of a study: objectives, demands, choices (names of `STRUCTURES`), trials in all, and a seed."""

    objectives: tuple[Objective, ...]
    demands: tuple[Demand, ...] = ()
    choices: tuple[str, ...] = ()
    trials: int = 200
    sampler: Sampler = "tpe"
    seed: int = 0


def run_study(
    problem: DesignProblem,
    plan: StudyPlan,
    storage: Storage,
    *,
    start: FloatArray,
    name: str,
    points: int | None = None,
    seeds: Callable[[], Sequence[FloatArray]] = tuple,
    progress: Callable[[float], None] | None = None,
) -> Front:
    """Run the study until it has `plan.trials` finished trials, and return its front, at most `points` of it.

    `start` is the solver's design, tried first, and then in every other structure; then come the designs that `seeds`
    returns, called once in the life of a study. A study of this name in the storage is continued, also by
    several processes at a time. A trial judges its controller over the dense grid; unstable
    ones are pruned, since no number of them means anything. The front is judged anew and not taken from the storage.

    Raises UsageError when the study of this name was made for something else, InfeasibleError when no trial meets
    every requirement.
    """
    report = progress or no_progress
    judge = Judge(problem, plan.objectives, plan.demands)
    plan = replace(plan, objectives=judge.objectives)
    with quiet_optuna(), named_failures("study", optuna.exceptions.StorageInternalError):
        study = _open_study(problem, plan, storage, start, name)
        _seed(study, problem, plan, seeds)
        done = len(study.get_trials(deepcopy=False, states=_FINISHED))
        report(min(1.0, done / plan.trials))
        while done < plan.trials:
            _run_trial(study, storage, judge, plan)
            before, done = done, len(study.get_trials(deepcopy=False, states=_FINISHED))
            report(min(done, plan.trials) / plan.trials - before / plan.trials)
        trials = study.get_trials(deepcopy=False, states=_FINISHED)
    return _front(trials, judge, plan, start, name, points)


def _open_study(
    problem: DesignProblem, plan: StudyPlan, storage: Storage, start: FloatArray, name: str
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
        "problem": {**record_tree(problem), "objective": problem.objective.name},
        "objectives": [each.name for each in plan.objectives],
        "demands": [
            each.name + (f"={each.value!r}" if isinstance(each, ObjectiveLimit) else "") for each in plan.demands
        ],
        "choices": list(plan.choices),
        "sampler": plan.sampler,
        "constraints": "logarithms",
        "seed": plan.seed,
        "start": [float(value) for value in start],
    }
    return checksum(tree)


def _run_trial(study: optuna.Study, storage: Storage, judge: Judge, plan: StudyPlan) -> None:
    """Try one design and record what it achieves, unless another process has finished the trial meanwhile.

    It may: two processes can take the same design from the queue of a SQLite file, and the trial of one that sleeps
    longer than three heartbeats is given up and tried again by others.
    """
    optuna.storages.fail_stale_trials(study)
    values: tuple[float, ...] | None = None
    state = TrialState.FAIL
    with suppress(UpdateFinishedTrialError):
        trial = study.ask()
        try:
            with get_heartbeat_thread(trial._trial_id, storage):  # noqa: SLF001 - the storage knows it by that only
                values = _try(trial, judge, plan)
            state = TrialState.COMPLETE
        except optuna.TrialPruned:
            state = TrialState.PRUNED
        finally:
            study.tell(trial, values, state, skip_if_finished=True)
    storage.remove_session()


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
    recorded = [
        Judgement(
            controller=_controller(trial.params, judge.problem, plan),
            values=dict(zip((each.name for each in plan.objectives), trial.values, strict=True)),
            requirements={},
        )
        for trial in feasible
    ]
    judged = [judge.judge(point.controller) for point in undominated(recorded, plan.objectives)]
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
    missed = (
        f"{name} ({100.0 * math.exp(-value):.3g} % of what is asked)" for name, value in closest.items() if value > 0.0
    )
    return f"the closest one misses {', '.join(missed)}"


class NumberedSampler(BaseSampler):
    """A sampler whose random numbers follow from the seed and the trial's number alone.

    A resumed study draws what an uninterrupted one would have drawn, and two workers never draw the same. Where the
    designs that meet every requirement are few in the whole box, each second trial is drawn beside them: from one of
    them along the difference of two others, a step of differential evolution (Storn and Price 1997).
    """

    def __init__(self, kind: Sampler, seed: int) -> None:
        self._kind, self._seed = kind, seed
        self._inner = self._build(0)

    def _build(self, number: int) -> BaseSampler:
        seed = int(np.random.SeedSequence([self._seed, number]).generate_state(1)[0])
        return NSGAIISampler(seed=seed) if self._kind == "nsga2" else TPESampler(seed=seed)

    def before_trial(self, study: optuna.Study, trial: FrozenTrial) -> None:
        """Draw anew for this number."""
        self._inner = self._build(trial.number)
        self._inner.before_trial(study, trial)

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """Return what the sampler draws together: everything beside a neighbour."""
        if _beside_neighbours(study, trial):
            return intersection_search_space(study.get_trials(deepcopy=False))
        return self._inner.infer_relative_search_space(study, trial)

    def sample_relative(
        self, study: optuna.Study, trial: FrozenTrial, search_space: dict[str, BaseDistribution]
    ) -> dict[str, Any]:
        """Draw that."""
        neighbours = _beside_neighbours(study, trial)
        if neighbours:
            return _drawn_beside(neighbours, search_space, np.random.default_rng([self._seed, trial.number]))
        return self._inner.sample_relative(study, trial, search_space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """Draw one value by itself."""
        return self._inner.sample_independent(study, trial, param_name, param_distribution)

    def after_trial(
        self, study: optuna.Study, trial: FrozenTrial, state: TrialState, values: Sequence[float] | None
    ) -> None:
        """Let the sampler note the outcome."""
        self._inner.after_trial(study, trial, state, values)


def is_feasible(trial: FrozenTrial) -> bool:
    """Return whether a finished trial is stable and meets every requirement."""
    return trial.state is TrialState.COMPLETE and all(value <= 0.0 for value in trial.constraints.values())


def _beside_neighbours(study: optuna.Study, trial: FrozenTrial) -> list[FrozenTrial]:
    """Return the feasible trials beside which this one is drawn, none where it is not its turn."""
    if trial.number % 2:
        return []
    found = [other for other in study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)) if is_feasible(other)]
    return found if len(found) >= _FEWEST_NEIGHBOURS else []


def _drawn_beside(
    neighbours: Sequence[FrozenTrial], space: dict[str, BaseDistribution], rng: np.random.Generator
) -> dict[str, Any]:
    """Return a design moved from one neighbour along the difference of two others; choices are those of the first."""
    from_, one, other = (neighbours[i] for i in rng.choice(len(neighbours), 3, replace=False))
    step = rng.uniform(0.0, 1.0)
    drawn: dict[str, Any] = {}
    for name, distribution in space.items():
        if not isinstance(distribution, FloatDistribution):
            drawn[name] = from_.params[name]
            continue
        low, high = _unit(distribution, distribution.low), _unit(distribution, distribution.high)
        unit = _unit(distribution, from_.params[name])
        unit += step * (_unit(distribution, one.params[name]) - _unit(distribution, other.params[name]))
        unit += _LOCAL_SHARE * (high - low) * rng.standard_normal()
        value = float(np.exp(unit)) if distribution.log else float(unit)
        drawn[name] = float(np.clip(value, distribution.low, distribution.high))
    return drawn


def _unit(distribution: FloatDistribution, value: float) -> float:
    """Return the value as the study counts it: by its logarithm where the distribution does."""
    return float(np.log(value)) if distribution.log else float(value)
