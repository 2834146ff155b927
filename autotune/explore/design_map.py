"""Which designs around one hold, over two of its values: computed in parts beside the page."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from autotune.processes import count_processors
from problems.arrays import BoolArray, FloatArray
from problems.design.batch_evaluation import BatchEvaluator
from problems.design.problem import DesignProblem

_SMALLER, _LARGER, _LEAST = 0.6, 1.6, 0.1
# Designs of a part: few, so that the parts end together, and one that nobody waits for any more ends soon.
_PART = 10


@dataclass(frozen=True, kw_only=True)
class MapWindow:
    """Two variables and where they are looked at, ends included: `columns` values of x by equal ratios, `rows` of y."""

    x: str
    y: str
    x_ends: tuple[float, float]
    y_ends: tuple[float, float]
    columns: int
    rows: int

    def x_values(self) -> FloatArray:
        """Return the values (columns,) of x."""
        return np.asarray(np.geomspace(*self.x_ends, self.columns), dtype=np.float64)

    def y_values(self) -> FloatArray:
        """Return the values (rows,) of y."""
        return np.linspace(*self.y_ends, self.rows)

    def finer(self, factor: int) -> "MapWindow":
        """Return the same window with so many times as many values each way."""
        return replace(self, columns=factor * self.columns, rows=factor * self.rows)

    def holds(self, x: float, y: float) -> bool:
        """Whether a point lies in the window."""
        return self.x_ends[0] <= x <= self.x_ends[1] and self.y_ends[0] <= y <= self.y_ends[1]


@dataclass(frozen=True, kw_only=True)
class DesignMap:
    """What designs are, rows over y and columns over x: stable or not, and the worst peak [N], NaN unless feasible."""

    window: MapWindow
    is_stable: BoolArray
    peak_n: FloatArray

    @property
    def is_feasible(self) -> BoolArray:
        """Which designs meet every requirement on every plant."""
        return np.isfinite(self.peak_n)


class MapRun:
    """A map that is being computed, part by part, by threads beside the one that began it."""

    def __init__(self, evaluator: BatchEvaluator, design: FloatArray, window: MapWindow) -> None:
        """Begin to judge the designs that differ from `design` (n,) in two variables, on all plants of `evaluator`."""
        names = evaluator.prepared.problem.variables
        x, y = np.meshgrid(window.x_values(), window.y_values())
        designs = np.tile(design, (x.size, 1))
        designs[:, names.index(window.x)], designs[:, names.index(window.y)] = x.reshape(-1), y.reshape(-1)
        self.window = window
        parts = [designs[begin : begin + _PART] for begin in range(0, len(designs), _PART)]
        self._parts: list[Future[FloatArray]] = [_threads().submit(_judge, evaluator, part) for part in parts]

    def collect(self) -> DesignMap:
        """Wait for every part, and return the map. Raises what a part raised."""
        is_stable, peak = np.concatenate([part.result() for part in self._parts], axis=1)
        shape = self.window.rows, self.window.columns
        return DesignMap(window=self.window, is_stable=is_stable.reshape(shape) > 0.0, peak_n=peak.reshape(shape))

    def cancel(self) -> None:
        """Compute no part that has not begun."""
        for part in self._parts:
            part.cancel()

    @property
    def is_done(self) -> bool:
        """Whether every part is there."""
        return all(part.done() for part in self._parts)


def _judge(evaluator: BatchEvaluator, designs: FloatArray) -> FloatArray:
    """Return of designs (m, n) whether they are stable, and their worst peak, NaN unless feasible: (2, m)."""
    found = evaluator.evaluate(designs)
    worst = np.where(found.violation <= 0.0, np.max(found.objective_rows, axis=1), np.nan)
    return np.array([found.is_stable, np.where(np.isfinite(worst), worst, np.nan)])


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count_processors(), thread_name_prefix="map")


def compute_map(evaluator: BatchEvaluator, design: FloatArray, window: MapWindow) -> DesignMap:
    """Judge the designs that differ from `design` (n,) in two variables, on all plants of `evaluator`."""
    return MapRun(evaluator, design, window).collect()


def map_pairs(problem: DesignProblem) -> tuple[tuple[str, str], ...]:
    """Return which variables a map can be over, (x, y): those with bounds of some width."""
    turned = {name for name, (low, high) in problem.bounds.items() if high > low}
    pairs = ((x, y) for x in ("damping", "mass") for y in ("lead_s", "feedback_damping_s"))
    return tuple(pair for pair in pairs if turned.issuperset(pair))


def build_window(
    problem: DesignProblem, design: FloatArray, pair: tuple[str, str], *, columns: int, rows: int
) -> MapWindow:
    """Return a window around a design (n,): from 0.6 to 1.6 times each of two values (x, y), within their bounds."""
    ends = []
    for name in pair:
        low, high = problem.bounds[name]
        value = float(design[problem.variables.index(name)])
        # A gain of nothing would have a window of no width.
        ends.append((max(low, _SMALLER * value), min(high, max(_LARGER * value, _LEAST * high))))
    return MapWindow(
        x=pair[0],
        y=pair[1],
        x_ends=ends[0],
        y_ends=ends[1],
        columns=columns,
        rows=rows,
    )
