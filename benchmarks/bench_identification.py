"""Identification of simulated cells drawn at random, through log files: how far off, and how honest.

Usage: python benchmarks/bench_identification.py [--cells 100] [--seed 0] [--table docs/accuracy.md]

Every cell is simulated, written to a log of its own kind and read back by the library call behind `autotune identify
--allow-partial`. `--records FILE` keeps every number, a JSON object per line and cell, added to what is there; `--from
FILE` makes the table of such a file again. The exit code is 1 when a target of the table is missed.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from autotune.errors import AutotuneError
from autotune.formats.cell import read_cell
from autotune.pipeline import IdentifyOptions, identify_log
from benchmarks.accuracy_table import Run, all_targets_met, page
from benchmarks.cell_logs import write_cell_log
from benchmarks.cell_outcomes import Outcome, compare
from benchmarks.cells import DrawnCell, draw_cell, simulate
from benchmarks.insufficient_cells import CASES
from identification.signals.recording import Recording

_SIMULATE: Callable[[DrawnCell], Recording] = simulate


def main() -> int:
    """Run, print the table and write it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=100)
    parser.add_argument("--insufficient", type=int, default=10, help="cells of each case that do not suffice")
    parser.add_argument("--seed", type=int, default=0, help="of the first cell")
    parser.add_argument("--processes", type=int, default=max(1, os.cpu_count() or 1))
    parser.add_argument("--table", type=Path, help="the page to write")
    parser.add_argument("--records", type=Path, help="where every number goes")
    parser.add_argument("--from", dest="kept", type=Path, help="records of an earlier run")
    options = parser.parse_args()
    if options.kept is not None:
        kept = [_read_run(line) for line in options.kept.read_text(encoding="utf-8").splitlines()]
        runs = sorted(kept, key=lambda run: (run.case, run.seed))
    else:
        jobs = [partial(run_cell, seed) for seed in range(options.seed, options.seed + options.cells)]
        jobs += [
            partial(run_cell, seed, case)
            for case in range(len(CASES))
            for seed in range(options.seed, options.seed + options.insufficient)
        ]
        done = _print_runs(_run_all(jobs, options.processes), len(jobs), options.records)
        runs = sorted(done, key=lambda run: (run.case, run.seed))
    text = page(runs)
    print(text)
    if options.table is not None:
        options.table.write_text(text, encoding="utf-8")
    return 0 if all_targets_met(runs) else 1


def run_cell(seed: int, case: int | None = None) -> Run:
    """Draw, simulate, write, identify and compare one cell, made insufficient by a case where one is named."""
    drawn, simulated = draw_cell(seed), _SIMULATE
    if case is not None:
        drawn, simulated = CASES[case].changed(drawn), CASES[case].simulated
    begin = time.perf_counter()
    outcomes, refusal, findings = _identified(drawn, simulated)
    return Run(
        seed=seed,
        case="" if case is None else CASES[case].name,
        outcomes=outcomes,
        refusal=refusal,
        findings=findings,
        seconds=time.perf_counter() - begin,
    )


def _identified(
    drawn: DrawnCell, simulated: Callable[[DrawnCell], Recording]
) -> tuple[tuple[Outcome, ...], str, tuple[str, ...]]:
    """Return what was found, or why the log was refused, and the findings that are no mere information."""
    with tempfile.TemporaryDirectory() as folder:
        log, cell = write_cell_log(simulated(drawn), drawn, Path(folder))
        try:
            found = identify_log(
                log, IdentifyOptions(cell=None if cell is None else read_cell(cell), allow_partial=True)
            ).result
        except AutotuneError as error:
            return (), f"{type(error).__name__}: {error}".replace(folder, ""), ()
    findings = tuple(f"{f.severity} {f.code}: {f.message}" for f in found.findings if f.severity != "info")
    return compare(drawn, found), "", findings


def _run_all(jobs: Iterable[Callable[[], Run]], processes: int) -> Iterator[Run]:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        for future in as_completed([pool.submit(job) for job in jobs]):
            yield future.result()


def _print_runs(runs: Iterator[Run], count: int, records: Path | None) -> Iterator[Run]:
    """Tell of each run as it comes, and keep its numbers."""
    for number, run in enumerate(runs, 1):
        if records is not None:
            with records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(run)) + "\n")
        what = run.refusal[:90] if run.refusal else f"{len(run.outcomes)} parameters"
        print(f"{number}/{count} seed {run.seed} {run.case} {run.seconds:.1f} s: {what}", file=sys.stderr, flush=True)
        yield run


def _read_run(line: str) -> Run:
    tree: dict[str, Any] = json.loads(line)
    outcomes = tuple(
        Outcome(**{**each, "ci95": None if each["ci95"] is None else tuple(each["ci95"])}) for each in tree["outcomes"]
    )
    return Run(**{**tree, "outcomes": outcomes, "findings": tuple(tree["findings"])})


if __name__ == "__main__":
    sys.exit(main())
