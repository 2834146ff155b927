"""What a design could be missing: the least peak that descents from elsewhere find where less is asked.

Less is asked in two ways: of all scenarios only those count that the search ended with, and nothing is kept in reserve.
Whatever is best for the whole uncertainty is allowed there too, so the best design there is at least as low: a lower
bound, as far as the descents find it. They start from the best of a Sobol' sequence over the bounds, of which the
search knows nothing, and from the design itself.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from problems.design.batch_evaluation import BatchEvaluation, build_batch_evaluator

from .bounds import Box, spread_out
from .descent import descend
from .search import SearchResult

FloatArray = NDArray[np.float64]

_LOG2_OF_DESIGNS = 7
_DESCENTS = 4
_APART = 0.3
# What a descent that keeps nothing in reserve misses by its last step; a lower bound may.
_HAIR = 1e-4
_SAME = 1e-3
_MISSED, _UNSTABLE = 1e12, 1e15


@dataclass(frozen=True, kw_only=True)
class Reference:
    """What was found over `scenarios`, the hardest of all, with nothing in reserve, and where it was looked for.

    `elsewhere_n` is the least objective (N) of the `descents` from the best of `designs` spread over the bounds,
    infinite where none of them met the requirements; `arrived` is how many of them ended within 0.1 % of the least;
    `from_here_n` is that of the descent from the design itself, `design` (n,) the one of the least objective.
    """

    elsewhere_n: float
    from_here_n: float
    designs: int
    descents: int
    arrived: int
    scenarios: int
    design: FloatArray = field(default_factory=lambda: np.zeros(0), compare=False)

    @property
    def least_n(self) -> float:
        """The lower of both."""
        return min(self.elsewhere_n, self.from_here_n)

    def gap(self, objective_n: float) -> float:
        """Return the share by which an objective lies above the least that was found, at least 0."""
        return max(objective_n / self.least_n - 1.0, 0.0)


def find_reference(search: SearchResult) -> Reference:
    """Look for a better design than the search's, where less is asked; the same for the same search."""
    problem, screen, box = search.problem, build_batch_evaluator(search.active), Box(search.problem)
    units = qmc.Sobol(len(problem.variables), scramble=False).random_base2(_LOG2_OF_DESIGNS)
    order = np.argsort(_costs(screen.evaluate(box.design(units))), kind="stable")
    starts = spread_out(units[order], _APART, _DESCENTS)
    ends = [descend(screen, box, start, reserve=0.0).unit for start in (box.unit(search.design), *starts)]
    found = screen.evaluate(box.design(np.array(ends)), peaks_if_missed=True)
    values = np.where(found.violation <= _HAIR, found.objective_n, np.inf)
    # The design itself is allowed here: a descent from it that went astray is no worse.
    here, elsewhere = min(float(values[0]), search.evaluation.objective_n), values[1:]
    least = min(here, float(np.min(elsewhere)))
    return Reference(
        elsewhere_n=float(np.min(elsewhere)),
        from_here_n=here,
        designs=len(units),
        descents=len(starts),
        arrived=int(np.sum(elsewhere <= (1.0 + _SAME) * least)),
        scenarios=len(search.active.scenarios),
        design=box.design(ends[int(np.argmin(values))]) if float(np.min(values)) < here else search.design,
    )


def _costs(found: BatchEvaluation) -> FloatArray:
    """Order designs (m,): feasible ones by the objective, before the others by what they miss, before unstable ones."""
    with np.errstate(invalid="ignore"):
        judged = np.where(
            found.violation > 0.0, _MISSED * (1.0 + np.minimum(found.violation, 500.0)), found.objective_n
        )
    return np.where(found.is_stable, judged, _UNSTABLE * found.radius)
