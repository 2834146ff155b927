"""What a design is held to: a long search from elsewhere, and a random grid twenty times denser than the search's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import differential_evolution

from autotune.tuning.bounds import Box
from autotune.tuning.scenario_exchange import DENSE_MASS, DENSE_STIFFNESS
from benchmarks.optimizer_judge import is_peak, ranked_costs
from problems.arrays import FloatArray
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.evaluation import PreparedScenarios, build_scenarios
from problems.design.problem import DesignProblem
from problems.design.uncertainty import Scenario
from problems.model.response import free_space_admittance
from problems.stability.margins import UnstableLoopError

DENSER = 20
_BAND_POINTS = 800
_AT_A_TIME = 500
# Rounding between two computations of one margin.
_ROUNDING = 1e-9
# The evolution walks up to its limits on a grid of frequencies, which flatters a margin by less than this.
_MISSED = 1e-4
_ROUNDS, _SAME = 4, 1e-3
# The usual population of CMA-ES in four dimensions, 4 + 3 ln n.
_SMALLEST = 8


@dataclass(frozen=True, kw_only=True)
class Reference:
    """The least worst peak [N] that the evolutions found (infinite: nothing feasible), its design, and each seed's."""

    objective_n: float
    design: FloatArray
    by_seed: tuple[float, ...]
    evaluations: int


def evolve_long(
    problem: DesignProblem,
    scenarios: Sequence[Scenario],
    *,
    seeds: int,
    population: int,
    generations: int,
    rival: str = "evolution",
) -> Reference:
    """Run the rival over fewer scenarios than all, so that its best can only come out lower.

    Differential evolution ends before `generations` once the whole population agrees to 1e-7; "cma" is CMA-ES,
    restarted with twice the population each time until it has made as many evaluations.
    """
    box, screen = Box(problem), build_batch_evaluator(build_scenarios(problem, scenarios))
    costs, evaluations, cube = ranked_costs(screen, box), 0, [(0.0, 1.0)] * len(problem.variables)

    def counted(units: FloatArray) -> FloatArray:
        nonlocal evaluations
        evaluations += units.shape[1]
        return np.asarray(np.log(costs(units.T)))

    found = []
    for seed in range(seeds):
        if rival == "cma":
            value, unit = _restarted_cma_es(counted, cube, seed, population * generations)
        else:
            result = differential_evolution(
                counted,
                cube,
                popsize=max(population // len(cube), 2),
                maxiter=generations,
                init="sobol",
                tol=0.0,
                atol=1e-7,
                rng=np.random.default_rng([seed, 77]),
                polish=False,
                vectorized=True,
                updating="deferred",
            )
            value, unit = float(result.fun), np.asarray(result.x)
        found.append((float(np.exp(value)), box.design(unit)))
    best = min(found, key=lambda pair: pair[0])
    values = tuple(value if is_peak(value) else np.inf for value, _ in found)
    return Reference(
        objective_n=best[0] if is_peak(best[0]) else np.inf,
        design=best[1],
        by_seed=values,
        evaluations=evaluations,
    )


def _restarted_cma_es(
    costs: Callable[[FloatArray], FloatArray], cube: list[tuple[float, float]], seed: int, evaluations: int
) -> tuple[float, FloatArray]:
    """Return the least cost and where it is: IPOP-CMA-ES (Auger and Hansen 2005), begun anywhere each time."""
    from cmaes import CMA  # of the extra `benchmarks`; the evolution does without

    rng, size, used = np.random.default_rng([seed, 78]), _SMALLEST, 0
    best, place = np.inf, np.full(len(cube), 0.5)
    while used < evaluations:
        search = CMA(
            mean=rng.random(len(cube)), sigma=0.3, bounds=np.array(cube), population_size=size,
            seed=int(rng.integers(2**31)),
        )  # fmt: skip
        while used < evaluations and not search.should_stop():
            units = np.array([search.ask() for _ in range(size)])
            values, used = costs(units.T), used + size
            search.tell([(unit, float(value)) for unit, value in zip(units, values, strict=True)])
            least = int(np.argmin(values))
            if values[least] < best:
                best, place = float(values[least]), units[least]
        size *= 2
    return best, place


@dataclass(frozen=True, kw_only=True)
class Bracket:
    """What the best over the dense grid lies between, as far as the evolutions show.

    `low` over fewer scenarios, hence too low; `high_n` the worst peak [N] of its design over the whole grid, infinite
    where that design does not hold there; `scenarios` that were needed, `evaluations` of all rounds.
    """

    low: Reference
    high_n: float
    scenarios: int
    evaluations: int


def bracket_best(
    problem: DesignProblem,
    scenarios: Sequence[Scenario],
    *,
    seeds: int,
    population: int,
    generations: int,
    rival: str = "evolution",
) -> Bracket:
    """Evolve over a few scenarios, add what is worst for the outcome on the dense grid, and again until that is nil."""
    dense = build_scenarios(problem, problem.scenarios(DENSE_STIFFNESS, DENSE_MASS))
    known, evaluations, low, high = tuple(scenarios), 0, None, np.inf
    for _ in range(_ROUNDS):
        found = evolve_long(problem, known, seeds=seeds, population=population, generations=generations, rival=rival)
        evaluations += found.evaluations
        low = found if low is None or found.objective_n > low.objective_n else low
        added, high = _worst(dense, found.design)
        fresh = tuple(each for each in dict.fromkeys(added) if each not in known)
        if not fresh or high <= (1.0 + _SAME) * found.objective_n:
            break
        known = (*known, *fresh)
    assert low is not None
    return Bracket(low=low, high_n=high, scenarios=len(known), evaluations=evaluations)


def _worst(dense: PreparedScenarios, design: FloatArray) -> tuple[list[Scenario], float]:
    """Return the scenarios of the highest peak and of the largest miss, and the peak (infinite: missed)."""
    problem, controller = dense.problem, dense.problem.controller(design)
    try:
        found = dense.evaluate_exactly(controller)
    except UnstableLoopError:
        radii = dense.radii(controller)[: len(dense.scenarios)]
        return [dense.scenarios[int(np.argmax(radii))]], np.inf
    worst = [problem.objective.worst_scenario(problem.requirements, dense.stable(controller))]
    misses = [max(each.ratios.values(), default=0.0) for each in found.margins[: len(dense.scenarios)]]
    if max(misses) > 1.0 + _MISSED:
        return [*worst, dense.scenarios[int(np.argmax(misses))]], np.inf
    return worst, found.evaluation.cost if found.evaluation.violation <= _MISSED else np.inf


@dataclass(frozen=True, kw_only=True)
class DenseCheck:
    """A design over random points of its ranges: how many are unstable, the largest required/achieved, the peak [N]."""

    count: int
    unstable: int
    worst: float
    worst_name: str
    objective_n: float

    @property
    def holds(self) -> bool:
        """Whether nothing is unstable or above a limit."""
        return self.unstable == 0 and self.worst <= 1.0 + _ROUNDING


def check_densely(problem: DesignProblem, design: FloatArray, *, seed: int, denser: int = DENSER) -> DenseCheck:
    """Check a design at `denser` times as many random points as the search's own grid has, and the corners.

    Stability by the eigenvalues of every loop, margins exactly, the admittance at 800 frequencies.
    """
    scenarios = random_scenarios(problem, denser * DENSE_STIFFNESS * DENSE_MASS, seed)
    controller, unstable, highest, worst = problem.controller(design), 0, 0.0, (0.0, "")
    for first in range(0, len(scenarios), _AT_A_TIME):
        prepared = build_scenarios(problem, scenarios[first : first + _AT_A_TIME])
        try:
            found = prepared.evaluate_exactly(controller).evaluation
        except UnstableLoopError:
            unstable += int(np.sum(prepared.radii(controller) >= 1.0))
            continue
        highest = max(highest, found.cost)
        asked = {**found.requirements, **_admittance(prepared, design)}
        worst = max(worst, *((value, name) for name, value in asked.items()))
    return DenseCheck(count=len(scenarios), unstable=unstable, worst=worst[0], worst_name=worst[1], objective_n=highest)


def random_scenarios(problem: DesignProblem, count: int, seed: int) -> tuple[Scenario, ...]:
    """Draw scenarios from the ranges, stiffness by equal ratios and mass by equal steps; the corners come first."""
    rng = np.random.default_rng([seed, 31])
    (soft, stiff), (light, heavy) = problem.plants.environment_stiffness_n_per_m, problem.plants.payload_mass_kg
    stiffness = soft * (stiff / soft) ** rng.random(count)
    mass = light + (heavy - light) * rng.random(count)
    drawn = [
        Scenario(environment_stiffness_n_per_m=float(np.clip(k, soft, stiff)), payload_mass_kg=float(m))
        for k, m in zip(stiffness, mass, strict=True)
    ]
    return (*problem.scenarios(2, 2), *drawn)


def _admittance(prepared: PreparedScenarios, design: FloatArray) -> dict[str, float]:
    target = prepared.problem.requirements.free_space_admittance
    if target is None:
        return {}
    omega = 2.0 * np.pi * np.geomspace(*target.band_hz, _BAND_POINTS)
    controller = prepared.problem.controller(design)
    least = float(np.min(np.abs(free_space_admittance(prepared.free[0], controller, omega))))
    return {"free_space_admittance": target.min_m_s_per_n / least}
