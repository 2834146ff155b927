"""Peers that only ask for values: Optuna's samplers and scipy's global methods, on the compiled evaluator."""

import contextlib
import warnings
from collections.abc import Callable

import numpy as np
import optuna
from scipy.optimize import differential_evolution, dual_annealing

from benchmarks.optimizer_judge import DIMENSION, BudgetError, Trace, traced_costs

_CUBE = [(0.0, 1.0)] * DIMENSION


def run_tpe(trace: Trace, seed: int) -> None:
    """Optuna's default sampler, over all variables together."""
    _run_study(trace, lambda: optuna.samplers.TPESampler(seed=seed, multivariate=True))


def run_cma_es(trace: Trace, seed: int) -> None:
    """Optuna's covariance matrix adaptation with its defaults, one run."""
    _run_study(trace, lambda: optuna.samplers.CmaEsSampler(seed=seed))


def _run_study(trace: Trace, sampler: Callable[[], optuna.samplers.BaseSampler]) -> None:
    costs = traced_costs(trace)
    optuna.logging.set_verbosity(optuna.logging.ERROR)

    def objective(trial: optuna.Trial) -> float:
        unit = np.array([trial.suggest_float(f"x{i}", 0.0, 1.0) for i in range(DIMENSION)])
        # The order is what counts; on a logarithm the walls between the kinds are no cliffs.
        return float(np.log(costs(unit[None])[0]))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        study = optuna.create_study(sampler=sampler())
    with contextlib.suppress(BudgetError):
        study.optimize(objective, n_trials=None)
    trace.note = f"{len(study.trials)} trials"


def run_differential_evolution(trace: Trace, seed: int) -> None:
    """scipy's differential evolution with its default strategy, a generation per call, restarted when it ends."""
    costs, runs = traced_costs(trace), 0
    with contextlib.suppress(BudgetError):
        while True:
            runs += 1
            differential_evolution(
                lambda units: costs(units.T),
                _CUBE,
                maxiter=10_000,
                rng=np.random.default_rng([seed, runs]),
                polish=False,
                vectorized=True,
                updating="deferred",
            )
    trace.note = f"{runs} runs"


def run_dual_annealing(trace: Trace, seed: int) -> None:
    """scipy's dual annealing without its gradient search, which the jumps of the costs would mislead."""
    costs, runs = traced_costs(trace), 0
    with contextlib.suppress(BudgetError):
        while True:
            runs += 1
            dual_annealing(
                lambda unit: float(np.log(costs(unit[None])[0])),
                _CUBE,
                maxiter=10_000,
                no_local_search=True,
                rng=np.random.default_rng([seed, runs]),
            )
    trace.note = f"{runs} runs"
