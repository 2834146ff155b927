"""How the search grows with the number of scenarios: by exchange, and with all of them at once."""

import time
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy.stats import qmc

from autotune.tuning import scenario_exchange, search
from autotune.tuning.bounds import Box
from benchmarks.optimizer_judge import DIMENSION, screen_of
from benchmarks.tuning_problems import paper_cell
from problems.design.problem import DesignProblem

# (stiffnesses, masses) of each grid; one scenario is the paper's own payload on its stiffest wall.
GRIDS = {1: (2, 2), 10: (5, 2), 100: (25, 4), 1000: (125, 8)}
ALL_AT_ONCE_UP_TO = 10
_DESIGNS = 32


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Processor seconds of the search over `scenarios`, by exchange and with all at once, and what came out.

    `is_projected`: the second number is that of the largest grid which was run, times the ratio of what a population
    costs on the two grids.
    """

    scenarios: int
    exchange_s: float
    exchange_n: float
    active: int
    rounds: int
    at_once_s: float
    at_once_n: float | None
    is_projected: bool


def measure_growth(*, up_to: int = ALL_AT_ONCE_UP_TO) -> list[Growth]:
    """Solve the paper's cell over each grid; all scenarios at once only on grids of `up_to` and fewer."""
    found: list[Growth] = []
    cost = {count: _population_seconds(_problem(count), grid) for count, grid in GRIDS.items()}
    for count, grid in GRIDS.items():
        problem = _problem(count)
        begin = time.process_time()
        with mock.patch.multiple(scenario_exchange, DENSE_STIFFNESS=grid[0], DENSE_MASS=grid[1]):
            result = search.solve_design(problem)
        exchange = time.process_time() - begin
        if count <= up_to:
            at_once, value = _all_at_once(problem, grid)
        else:
            measured = max((each for each in found if not each.is_projected), key=lambda each: each.scenarios)
            at_once, value = measured.at_once_s * cost[count] / cost[measured.scenarios], None
        found.append(
            Growth(
                scenarios=count,
                exchange_s=exchange,
                exchange_n=result.evaluation.cost,
                active=len(result.active.scenarios),
                rounds=result.rounds,
                at_once_s=at_once,
                at_once_n=value,
                is_projected=count > up_to,
            )
        )
    return found


def _problem(count: int) -> DesignProblem:
    return paper_cell() if count > 1 else paper_cell((5e5, 5e5), (16.0, 16.0))


def _all_at_once(problem: DesignProblem, grid: tuple[int, int]) -> tuple[float, float]:
    """Return seconds and worst peak of the search's own two stages, with every scenario active from the start."""
    begin = time.process_time()
    run, scenarios = search.Search(problem, 0), problem.scenarios(*grid)
    unit = run.polish(scenarios, run.explore(scenarios, lambda _share: None))
    seconds = time.process_time() - begin
    return seconds, float(screen_of(problem, grid).evaluate(run.box.design(unit)[None]).cost[0])


def _population_seconds(problem: DesignProblem, grid: tuple[int, int]) -> float:
    """Return what it costs to look at designs that are stable and close to what is asked, every peak included."""
    screen, box = screen_of(problem, grid), Box(problem)
    points = qmc.Sobol(DIMENSION, rng=np.random.default_rng(0)).random(_DESIGNS)
    designs = box.design(np.array([0.02, 0.5, 0.66, 0.5]) + np.array([0.05, 0.1, 0.1, 0.4]) * (points - 0.5))
    screen.evaluate(designs[:2], peaks_if_missed=True)
    begin = time.process_time()
    screen.evaluate(designs, peaks_if_missed=True)
    return time.process_time() - begin


def draw_growth(growth: list[Growth], path: Path) -> None:
    """Draw processor time over the number of scenarios; the same numbers give the same bytes."""
    x = [each.scenarios for each in growth]
    measured = [each for each in growth if not each.is_projected]
    projected = [each for each in growth if each.is_projected]
    with mpl.rc_context({"svg.hashsalt": "autotune", "svg.fonttype": "path", "font.size": 9.0}):
        figure = Figure(figsize=(5.6, 3.4), layout="constrained")
        axes = figure.add_subplot()
        (line,) = axes.loglog(x, [each.exchange_s for each in growth], "o-", label="scenario exchange")
        (other,) = axes.loglog(
            [each.scenarios for each in measured], [each.at_once_s for each in measured], "s-", label="all at once"
        )
        if projected:
            joined = [measured[-1], *projected]
            axes.loglog(
                [each.scenarios for each in joined],
                [each.at_once_s for each in joined],
                "s--",
                color=other.get_color(),
                markerfacecolor="white",
                markevery=slice(1, None),
                label="all at once, projected",
            )
        axes.loglog(x, [growth[0].exchange_s * n for n in x], ":", color="0.6", label="in proportion")
        axes.set_xlabel("scenarios")
        axes.set_ylabel("processor time [s]")
        axes.set_ylim(top=3.0 * max(max(each.at_once_s, each.exchange_s) for each in growth))
        axes.legend(frameon=False)
        line.set_zorder(3)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="svg", metadata={"Date": None, "Creator": None})
