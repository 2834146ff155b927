"""The search for a controller: how good, how fast, beside which others, and how it grows.

Usage: python benchmarks/bench_optimize.py [--write docs/optimizer_measured.md]

Five parts (`--parts`), one process, one compiled evaluator:
- problems: problems drawn at random; each is solved, held to a long differential evolution and checked at random on a
  grid twenty times denser than the search's own. A draw that is refused is drawn again, once the same evolution has
  looked for a design that holds.
- polish: the last digits by sequential quadratic programming and by IPOPT, the same local problem and start.
- peers: other optimizers on the paper's cell, with a budget of processor time each.
- growth: 1 to 1000 scenarios, by exchange and all at once.
- bits: one seed in several processes.

`--records FILE` keeps every number, a JSON object per line, added to what is there; `--from FILE` makes the tables of
such a file again. Times are of the processor unless they are called wall: what other processes do then hardly counts.
The exit code is 1 when a target is missed; which one is printed on stderr.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import hashlib
import json
import multiprocessing
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.errors import InfeasibleError
from autotune.formats.problem import Structure
from autotune.tuning.optimality_report import find_reference
from autotune.tuning.search import SearchResult, solve_design
from autotune.tuning.structure import equal_noise, limited_problem, solve_limited
from benchmarks.optimizer_authors import run_authors
from benchmarks.optimizer_ipopt import run_ipopt
from benchmarks.optimizer_judge import JUDGED, Trace, judge, judge_trace, screen_of
from benchmarks.optimizer_page import FIGURE, misses, put_between, tables
from benchmarks.optimizer_polish import compare_polishes
from benchmarks.optimizer_reference import bracket_best, check_densely, evolve_long
from benchmarks.optimizer_samplers import run_cma_es, run_differential_evolution, run_dual_annealing, run_tpe
from benchmarks.optimizer_scaling import ALL_AT_ONCE_UP_TO, Growth, draw_growth, measure_growth
from benchmarks.tuning_problems import draw_problem, paper_cell
from problems.design.hand import HandImpedance
from problems.design.problem import DesignProblem

Record = dict[str, Any]
Found = TypeVar("Found")

PARTS = ("problems", "polish", "peers", "growth", "bits")
STRUCTURES: tuple[Structure, ...] = ("gains", "noise", "biquad")
_CORNERS = (3, 2)
# The gap to the reference from which on `optimize` searches again, from the reference's design.
_WORTH_ANOTHER = 1e-3
_LIKE_OURS = "autotune"
# Six of the drawn problems that can be solved.
_POLISHED = (2, 3, 4, 6, 14, 16)
# A drawn problem that is solved in a second.
_TWO_POLES = 0
# Samplers and IPOPT's starts hang on the seed; the authors' formulation has one start.
PEERS: dict[str, Callable[[Trace, int], None]] = {
    "scipy differential evolution": run_differential_evolution,
    "scipy dual annealing": run_dual_annealing,
    "Optuna TPE": run_tpe,
    "Optuna CMA-ES": run_cma_es,
    "CasADi + IPOPT": run_ipopt,
}
ONE_START: dict[str, Callable[[Trace, int], None]] = {
    "authors' formulation, H2 of the contact force": partial(run_authors, goal="contact"),
    "authors' formulation, H2 of the admittance": partial(run_authors, goal="admittance"),
}


def main() -> int:
    """Run the parts, print the tables and write them."""
    options = _options()
    if options.kept is not None:
        records = [json.loads(line) for line in options.kept.read_text(encoding="utf-8").splitlines()]
    else:
        runs = {
            "problems": lambda: run_problems(options),
            "polish": run_polish,
            "peers": lambda: run_peers(options),
            "growth": lambda: run_growth(options.at_once),
            "bits": run_bits,
        }
        load_compiled_code()
        records = []
        for part in options.parts:
            for record in runs[part]():
                _print_record(record, options.records)
                records.append(record)
    text = tables(records)
    print(text)
    if options.write is not None:
        page = options.write.read_text(encoding="utf-8")
        options.write.write_text(put_between(page, text), encoding="utf-8")
        grown = [
            Growth(**{k: v for k, v in each.items() if k != "part"}) for each in records if each["part"] == "growth"
        ]
        if grown:
            draw_growth(sorted(grown, key=lambda each: each.scenarios), options.write.parent / FIGURE)
    missed = misses(records)
    for each in missed:
        print(f"missed: {each}", file=sys.stderr)
    return 1 if missed else 0


def load_compiled_code() -> None:
    """Solve a small problem of a robot with one pole and one with two, outside every measurement."""
    bounds = {
        "mass": (5.0, 5.0),
        "damping": (1010.0, 1020.0),
        "lead_s": (0.0195, 0.0205),
        "feedback_damping_s": (0.029, 0.030),
    }
    solve_design(replace(paper_cell((1e5, 1e5), (16.0, 16.0)), bounds=bounds))
    solve_design(draw_problem(_TWO_POLES))


def run_problems(options: argparse.Namespace) -> Iterator[Record]:
    """Draw until enough are feasible."""
    solved = 0
    for seed in count(options.first):
        record = run_problem(seed, options)
        yield record
        solved += not record["refused"]
        if solved == options.problems:
            return


def run_problem(seed: int, options: argparse.Namespace) -> Record:
    """Solve one drawn problem, and hold the outcome to the reference and to the denser grid."""
    problem = draw_problem(seed)
    search = {"seeds": options.seeds, "population": options.population, "generations": options.generations}
    search["rival"] = options.rival
    try:
        result, wall, processor = _timed(lambda: solve_structure(problem, options.structure))
    except InfeasibleError as error:
        found = evolve_long(problem, problem.scenarios(*_CORNERS), **search)
        feasible = bool(np.isfinite(found.objective_n))
        holds = feasible and check_densely(problem, found.design, seed=seed).holds
        known = {"structure": options.structure, "rival": options.rival, "refused": str(error)}
        return _record("problem", seed=seed, **known, rival_holds=holds, reference_n=found.objective_n)
    own, _, own_seconds = _timed(lambda: find_reference(result))
    problem = result.problem
    long = bracket_best(problem, result.active.scenarios, **search)
    # Of a rival that ends in another valley with more scenarios, the lower one counts.
    best = min(long.low.objective_n, long.high_n)
    dense = check_densely(problem, result.design, seed=seed)
    return _record(
        "problem",
        seed=seed,
        structure=options.structure,
        rival=options.rival,
        refused="",
        wall_s=wall,
        cpu_s=processor,
        design=result.design.tolist(),
        value_n=result.evaluation.cost,
        own_gap=own.gap(result.evaluation.cost),
        own_gap_s=own_seconds,
        reference_n=long.low.objective_n,
        reference_high_n=long.high_n,
        by_seed=long.low.by_seed,
        reference_design=long.low.design.tolist(),
        reference_scenarios=long.scenarios,
        reference_evaluations=long.evaluations,
        gap=result.evaluation.cost / best - 1.0 if np.isfinite(best) else None,
        unstable=dense.unstable,
        worst=dense.worst,
        worst_name=dense.worst_name,
        dense_n=dense.objective_n,
        dense_count=dense.count,
    )


def solve_structure(problem: DesignProblem, structure: Structure) -> SearchResult:
    """Return what `optimize` settles on: four gains in their bounds, or the structure at their noise, worth it or not.

    Of the structure it is what was found, of the problem that was then asked (the modulus in a hand may have joined).
    """
    plain = solve_design(problem)
    known = [plain]
    for each in STRUCTURES[1 : STRUCTURES.index(structure) + 1]:
        limited = limited_problem(plain.problem, equal_noise(plain), has_biquad=each == "biquad")
        found = solve_limited(plain, limited, HandImpedance(), known, seed=0)
        if found is None:
            raise InfeasibleError(f"No design of {each} was found.")
        known.append(found)
    result = known[-1]
    reference = find_reference(result)
    if reference.gap(result.evaluation.cost) <= _WORTH_ANOTHER:
        return result
    other = solve_design(result.problem, start=reference.design)
    return min(result, other, key=lambda each: each.evaluation.cost)


def run_polish() -> Iterator[Record]:
    """Polish the paper's cell and some drawn problems by both solvers."""
    for name, problem in {"the paper's cell": paper_cell(), **{str(i): draw_problem(i) for i in _POLISHED}}.items():
        yield from (_record("polish", **each) for each in compare_polishes(name, problem))


def run_peers(options: argparse.Namespace) -> list[Record]:
    """Run everyone on the paper's cell; all are judged together, because the best of all is what counts as best."""
    problem, screen = paper_cell(), screen_of(paper_cell(), JUDGED)
    traces: list[tuple[str, int, Trace, float]] = []
    for seed in range(options.seeds):
        traces.append((_LIKE_OURS, seed, *_ours(problem, seed)))
        for name, run in {**PEERS, **(ONE_START if seed == 0 else {})}.items():
            trace = Trace(problem=problem, budget_s=options.budget)
            run(trace, seed)
            traces.append((name, seed, trace, trace.clock.seconds()))
            print(f"{name}, seed {seed}: {trace.note}", file=sys.stderr, flush=True)
    judged = [judge(screen, each.design) for _, _, trace, _ in traces for each in trace.incumbents]
    best = min(verdict.objective_n for verdict in judged if verdict.is_feasible)
    records = []
    for name, seed, trace, seconds in traces:
        outcome = judge_trace(trace, screen, best)
        final = outcome.final
        records.append(
            _record(
                "peer",
                name=name,
                seed=seed,
                budget_s=options.budget,
                best_n=best,
                to_one_percent_s=outcome.to_one_percent_s,
                cpu_s=seconds,
                value_n=None if final is None else final.objective_n,
                is_stable=final is not None and final.is_stable,
                violation=None if final is None else final.violation,
                design=trace.incumbents[-1].design.tolist() if trace.incumbents else None,
                note=outcome.note,
            )
        )
    return records


def _ours(problem: DesignProblem, seed: int) -> tuple[Trace, float]:
    """Return a trace with one entry: when the search returned, with everything verified over its dense grid."""
    trace = Trace(problem=problem, budget_s=np.inf)
    result = solve_design(problem, seed=seed)
    trace.add(result.design, result.evaluation.cost)
    trace.note = f"{result.evaluations} evaluations"
    return trace, trace.incumbents[-1].seconds


def run_growth(at_once: int) -> Iterator[Record]:
    """Grow the number of scenarios."""
    for each in measure_growth(up_to=at_once):
        yield _record("growth", **asdict(each))


def run_bits() -> Iterator[Record]:
    """Solve the paper's cell with one seed in two processes of their own."""
    context = multiprocessing.get_context("spawn")
    found = []
    for _ in range(2):
        with ProcessPoolExecutor(1, mp_context=context) as pool:
            found.append(pool.submit(design_sha256, 0).result())
    yield _record("bits", sha256=found)


def design_sha256(seed: int) -> str:
    """Return the checksum of the paper's cell's design."""
    return hashlib.sha256(solve_design(paper_cell(), seed=seed).design.tobytes()).hexdigest()


def _timed(run: Callable[[], Found]) -> tuple[Found, float, float]:
    """Return a result with its wall and processor seconds."""
    wall, processor = time.perf_counter(), time.process_time()
    found = run()
    return found, time.perf_counter() - wall, time.process_time() - processor


def _record(part: str, **values: Any) -> Record:
    return {"part": part, **values}


def _print_record(record: Record, path: Path | None) -> None:
    line = json.dumps(record)
    print(line[:300], file=sys.stderr, flush=True)
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--problems", type=int, default=20, help="how many feasible ones")
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--seeds", type=int, default=3, help="of the long evolution and of every peer")
    parser.add_argument("--population", type=int, default=100, help="of the long evolution")
    parser.add_argument("--generations", type=int, default=300, help="of the long evolution, at most")
    parser.add_argument(
        "--rival",
        choices=("evolution", "cma"),
        default="evolution",
        help="what drawn problems are held to; cma: CMA-ES with restarts, population times generations evaluations",
    )
    parser.add_argument(
        "--structure",
        choices=STRUCTURES,
        default="gains",
        help="of the laws of drawn problems, at the four gains' noise",
    )
    parser.add_argument("--budget", type=float, default=15.0, help="processor seconds of a peer")
    parser.add_argument(
        "--at-once", type=int, default=ALL_AT_ONCE_UP_TO, help="the largest grid solved with all scenarios at once"
    )
    parser.add_argument("--write", type=Path, help="the page whose measured part is replaced")
    parser.add_argument("--records", type=Path, help="where every number goes")
    parser.add_argument("--from", dest="kept", type=Path, help="records of an earlier run")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
