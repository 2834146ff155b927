"""A peer that takes exact gradients and nothing else: CasADi and IPOPT on the sampled loop, from several starts.

min t under F(k) ≤ t at the first ticks k of every scenario's contact, |1 + L|² at both break points and |G|² on grids
of frequency: the problem as one writes it down. Neither stability nor the other margins are smooth, so they are left
out, and whether they hold is for the judge. Ticks, and frequencies, are enough to see every peak of the paper's cell.
"""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from scipy.stats import qmc

from autotune.tuning.bounds import Box
from benchmarks.optimizer_judge import DIMENSION, SEEN, Trace, solution_noter
from problems.arrays import FloatArray
from problems.design.evaluation import PreparedScenarios, build_scenarios
from problems.design.objectives import force_of
from problems.design.problem import VARIABLES, DesignProblem
from problems.design.symbolic import Structure, arguments_of, build_contact_forces, build_symbolic_form
from problems.model.controller import PAPER_ACCELERATION_FILTER_RAD_PER_S
from problems.model.sampled import SampledPlant

_TICKS = 700
_MARGIN_HZ = np.geomspace(0.3, 60.0, 60)
_BAND_POINTS = 20
# Forces count in units of this many newtons, so that all of IPOPT's variables are near one.
_FORCE_UNIT_N = 100.0
_HIGHEST, _HIGHEST_AT_START = 100.0, 3.0
# The middle of what the paper tried on the robot (docs/method.md, "The loop"): where an engineer would begin.
PAPER_DESIGN = (15.0, 1400.0, 0.0125, 0.00375)


def run_ipopt(trace: Trace, seed: int) -> None:
    """Solve from the paper's gains, then from seeded starts, until the budget is over."""
    problem = trace.problem
    unknowns = ca.MX.sym("unknowns", DIMENSION + 1)
    design, highest = design_of(problem, unknowns[:DIMENSION]), unknowns[DIMENSION]
    rows = constraints(problem, design, highest)
    shape = {"x": unknowns, "f": highest, "g": rows}
    highest_values = np.array([*[1.0] * DIMENSION, _HIGHEST])
    to_design = ca.Function("to_design", [unknowns], [design])
    starts = qmc.Sobol(DIMENSION, rng=np.random.default_rng(seed))
    solved, called, iterations = 0, 0, 0
    first, note = Box(problem).unit(np.array(PAPER_DESIGN)), solution_noter(trace)
    while trace.left_s() > 0.0:
        solver = ca.nlpsol("solver", "ipopt", shape, ipopt_options(trace.left_s()))
        start = first if called == 0 else starts.random(1)[0]
        found = solver(x0=np.append(start, _HIGHEST_AT_START), lbx=0.0, ubx=highest_values, lbg=0.0, ubg=np.inf)
        called += 1
        iterations += solver.stats()["iter_count"]
        solved += solver.stats()["return_status"] == "Solve_Succeeded"
        note(to_design(found["x"]).full().ravel())
    trace.note = f"{called} starts, {solved} of them solved, {iterations} iterations"


def ipopt_options(seconds: float) -> dict[str, Any]:
    """Return options of a silent run without second derivatives that ends in time."""
    return {
        "print_time": False,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "ipopt.hessian_approximation": "limited-memory",
        "ipopt.max_iter": 200,
        "ipopt.max_cpu_time": max(seconds, 0.1),
    }


def design_of(problem: DesignProblem, unit: ca.MX) -> ca.MX:
    """Return (M_a, B_a, K_l, B_fb) of a point of the unit cube, as `Box` maps it."""
    bounds = [problem.bounds[name] for name in VARIABLES]
    ratios = [low * ca.exp(unit[i] * np.log(high / low)) for i, (low, high) in enumerate(bounds[:2])]
    steps = [low + unit[i + 2] * (high - low) for i, (low, high) in enumerate(bounds[2:])]
    return ca.vertcat(*ratios, *steps)


def constraints(problem: DesignProblem, design: ca.MX, highest: ca.MX) -> ca.MX:
    """Return what must not be negative, with forces and `highest` in units of 100 N."""
    prepared = build_scenarios(problem, problem.scenarios(*SEEN))
    structure = structure_of(prepared)
    controller = ca.vertcat(design, problem.velocity_filter_rad_per_s, PAPER_ACCELERATION_FILTER_RAD_PER_S, 0.0)
    forces = build_contact_forces(structure, problem.approach, _TICKS)
    response, asked = build_symbolic_form(structure).response, problem.requirements
    wanted = 1 if force_of(problem.objective).place == "contact" else 0
    rows = []
    for pair in prepared.pairs:
        outputs = forces(*_numbers(pair.contact, problem), controller)
        rows.append(highest - outputs[wanted] / _FORCE_UNIT_N)
    if asked.modulus_margin is not None:
        for plant in prepared.plants:
            found = over(response, [*_numbers(plant.sampled, problem), controller], 2.0 * np.pi * _MARGIN_HZ)
            rows += [found[2].T - asked.modulus_margin**2, found[3].T - asked.modulus_margin**2]
    target = asked.free_space_admittance
    if target is not None:
        omega = 2.0 * np.pi * np.geomspace(*target.band_hz, _BAND_POINTS)
        gain = over(response, [*_numbers(prepared.free[0], problem), controller], omega)[4]
        rows.append(ca.sum1(gain**2).T / target.min_m_s_per_n**2 - 1.0)
    return ca.vertcat(*rows)


def structure_of(prepared: PreparedScenarios) -> Structure:
    """Return a structure whose exponentials are exact for every scenario."""
    controller = prepared.problem.controller(np.array([10.0, 1000.0, 0.01, 0.01]))
    found = [Structure.like(pair.contact, controller) for pair in prepared.pairs]
    return max(found, key=lambda structure: structure.squarings)


def over(response: ca.Function, numbers: Sequence[Any], omega: FloatArray) -> list[ca.MX]:
    """Call a response at every frequency; each output has one column per frequency."""
    repeated = [
        ca.repmat(ca.MX(ca.DM(each) if not isinstance(each, ca.MX) else each), 1, len(omega)) for each in numbers
    ]
    found: list[ca.MX] = response.map(len(omega)).call([*repeated, ca.MX(ca.DM(omega).T)])
    return found


def _numbers(sampled: SampledPlant, problem: DesignProblem) -> list[Any]:
    return list(arguments_of(sampled, problem.controller(np.array([10.0, 1000.0, 0.01, 0.01])))[:4])
