"""How a study draws: by Optuna's samplers, and in turn beside trials that meet every requirement."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, FloatDistribution
from optuna.samplers import BaseSampler, NSGAIISampler, TPESampler
from optuna.search_space import intersection_search_space
from optuna.trial import FrozenTrial, TrialState

Sampler = Literal["tpe", "nsga2"]

_FEWEST_NEIGHBOURS = 3
_LOCAL_SHARE = 0.02  # of a variable's range, so that neighbours that agree in it do not fix it


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
