"""The last digits by two solvers: sequential quadratic programming, as the search has it, and IPOPT.

Both get the same local problem (`autotune.tuning.descent.LocalProblem`: the epigraph form over what is within 1 % of
its limit, values by the compiled evaluator, exact gradients) and the same start, where a descent by differences ended
on the scenarios that the search ended with. IPOPT takes its second derivatives from the gradients it has seen.
"""

import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from autotune.tuning.bounds import Box
from autotune.tuning.descent import LocalProblem, descend, polish_exactly
from autotune.tuning.optimality import check_optimality
from autotune.tuning.search import solve_design
from problems.arrays import FloatArray
from problems.design.batch_evaluation import BatchEvaluator, build_batch_evaluator
from problems.design.problem import DesignProblem

RESERVE = 5e-6
_REPEATS = 3


class _Slack(ca.Callback):
    """The constraints of a local problem as a CasADi function; its derivative is another one."""

    def __init__(self, problem: LocalProblem, size: int, *, is_derivative: bool = False) -> None:
        ca.Callback.__init__(self)
        self._problem, self._size, self._is_derivative = problem, size, is_derivative
        self._rows = len(problem.slack(problem.start()))
        self._derivatives: list[_Slack] = []
        self.construct("gradients" if is_derivative else "slack", {})

    def get_n_in(self) -> int:
        return 2 if self._is_derivative else 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self._size, 1) if i == 0 else ca.Sparsity(self._rows, 1)

    def get_sparsity_out(self, i: int) -> Any:
        del i
        return ca.Sparsity.dense(self._rows, self._size if self._is_derivative else 1)

    def eval(self, arguments: Any) -> list[Any]:
        x = np.asarray(arguments[0]).ravel()
        return [self._problem.slack_gradients(x) if self._is_derivative else self._problem.slack(x)]

    def has_jacobian(self) -> bool:
        return not self._is_derivative

    def get_jacobian(self, name: str, inames: Any, onames: Any, opts: Any) -> Any:
        del name, inames, onames, opts
        # CasADi asks more than once and keeps none of them alive.
        self._derivatives.append(_Slack(self._problem, self._size, is_derivative=True))
        return self._derivatives[-1]


def polish_by_ipopt(screen: BatchEvaluator, design: FloatArray) -> FloatArray:
    """Return what IPOPT makes of the local problem of a design; without soft requirements."""
    problem, count = LocalProblem(screen, design, backoff={}, reserve=RESERVE), len(design)
    x, slack = ca.MX.sym("x", count + 1), _Slack(problem, count + 1)
    solver = ca.nlpsol("polish", "ipopt", {"x": x, "f": x[count], "g": slack(x)}, _options())
    moves, start = np.array(problem.moves), problem.start()
    found = solver(
        x0=start,
        lbx=np.append(moves[:, 0], -np.inf),
        ubx=np.append(moves[:, 1], np.inf),
        lbg=0.0,
        ubg=np.inf,
    )
    return problem.at(found["x"].full().ravel()[:count])


def _options() -> dict[str, Any]:
    """Return what suits a start that is nearly there: a small barrier, and no push away from the bounds."""
    return {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.max_iter": 60,
        "ipopt.tol": 1e-8,
        "ipopt.mu_init": 1e-6,
        "ipopt.bound_push": 1e-9,
        "ipopt.bound_frac": 1e-9,
        "ipopt.bound_relax_factor": 0.0,
    }


def compare_polishes(name: str, problem: DesignProblem) -> list[dict[str, Any]]:
    """Polish one problem by both; the least processor time of a few runs each."""
    result = solve_design(problem)
    screen, box = build_batch_evaluator(result.active), Box(problem)
    start = box.design(descend(screen, box, box.unit(result.design)).unit)
    solvers: dict[str, Callable[[], FloatArray]] = {
        "before": lambda: start,
        "SLSQP": lambda: polish_exactly(screen, start, backoff={}, reserve=RESERVE),
        "IPOPT": lambda: polish_by_ipopt(screen, start),
    }
    records = []
    for solver, run in solvers.items():
        design, seconds = _timed(run)
        found = result.active.evaluate(design, peaks_if_missed=True)
        optimality = check_optimality(result.active, design)
        records.append(
            {
                "name": name,
                "solver": solver,
                "seconds": seconds,
                "value_n": found.cost,
                "violation": found.violation,
                "residual": optimality.relative_residual,
                "slack": optimality.slack,
            }
        )
    return records


def _timed(run: Callable[[], FloatArray]) -> tuple[FloatArray, float]:
    least = np.inf
    for _ in range(_REPEATS):
        begun = time.process_time()
        found = run()
        least = min(least, time.process_time() - begun)
    return found, float(least)
