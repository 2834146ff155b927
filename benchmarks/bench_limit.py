"""Peak, noise and time of four gains, of structures at their noise, of any order, and the force that none gets below.

`python benchmarks/bench_limit.py` prints a table (Markdown) of the paper's nominal cell with once and three times the
design's noise, and of drawn problems; `--drawn 20` says how many. The structures are those of `optimize --structure`:
the noise of the command in the place of the bounds of M_a, K_l and B_fb, and a biquad too. They may approach more
slowly than the four gains, as far as the admittance allows; the last three columns keep the speed of these.
`--observer` prints instead what a disturbance observer of the payload (P̂, ω_a and ω_v free) reaches at the same noise,
alone and beside a biquad. `--write docs/limit.md` makes both tables and the figure of that page anew.
"""

import argparse
import contextlib
import io
import itertools
import math
import statistics
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np

from autotune.charts.chart import Chart, Line, Panel, Points, Role, Scale
from autotune.charts.matplotlib_renderer import render
from autotune.errors import InfeasibleError
from autotune.formats.kinds import PICTURE_MARK
from autotune.formats.problem import Structure
from autotune.limit.limit import LimitResult, find_limit, hardest
from autotune.tuning.search import SearchResult, solve_design
from autotune.tuning.structure import choose_structure, equal_noise, limited_problem, nearest_gains, solve_limited
from benchmarks.tuning_problems import draw_problem, paper_cell
from problems.arrays import FloatArray
from problems.design.hand import HandImpedance
from problems.design.problem import DesignProblem

_NOMINAL = paper_cell((5e5, 5e5), (16.0, 16.0))
_GRID = (3, 2)
_OBSERVER = {"velocity_filter_rad_per_s": (20.0, 1500.0), "acceleration_filter_rad_per_s": (20.0, 1500.0)}
_SHARES = (0.0, 0.3, 0.7)
# So many draws are looked at with an observer.
_OBSERVED = 9
# What a structure is meant to save.
_WORTH = 0.1
_FIGURE = "figures/structures.svg"
_FACTORS = (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)


def _cases(drawn: int) -> Iterator[tuple[str, DesignProblem, float]]:
    yield "paper's nominal cell", _NOMINAL, 1.0
    yield "the same, three times the noise", _NOMINAL, 3.0
    for seed in range(drawn):
        yield f"drawn {seed}", draw_problem(seed), 1.0


def _row(name: str, problem: DesignProblem, noise: float) -> tuple[str, LimitResult | None, tuple[float, float]]:
    begun = time.process_time()
    try:
        found = solve_design(problem)
    except InfeasibleError:
        return _row_without_gains(name, problem, begun)
    law, searched = problem.controller(found.design), time.process_time()
    structures: dict[Structure, float] = {"noise": math.nan, "biquad": math.nan}
    if noise == 1.0:
        _, choice = choose_structure(found, "biquad", HandImpedance(), seed=0)
        structures = {each: choice.costs[each] or math.nan for each in structures}
    structured = time.process_time()
    limit = find_limit(problem, law, hardest(problem, law, problem.scenarios(*_GRID), 1), noise_factor=noise)
    ended = time.process_time()
    columns = (
        f"{limit.design.peak_force_n:.2f}",
        *(f"{each:.2f}" if math.isfinite(each) else "" for each in structures.values()),
        f"{limit.reached_n:.2f}",
        f"{limit.bound.force_n:.2f}",
        f"{1e3 * limit.asked.noise_m_s_per_n:.2f}",
        f"{searched - begun:.1f}",
        f"{structured - searched:.1f}",
        f"{ended - structured:.1f}",
    )
    shares = [each / found.evaluation.cost if math.isfinite(each) else 1.0 for each in structures.values()]
    return f"| {name} | {' | '.join(columns)} |", limit, (min(shares[0], 1.0), min(*shares, 1.0))


def _row_without_gains(
    name: str, problem: DesignProblem, begun: float
) -> tuple[str, LimitResult | None, tuple[float, float]]:
    """Return the row of a problem that four gains in their bounds do not meet; a structure that does saves all."""
    searched, nearest = time.process_time(), nearest_gains(problem, 0)
    costs: Mapping[Structure, float | None] = {}
    noise = ""
    if nearest is not None:
        with contextlib.suppress(InfeasibleError):
            _, choice = choose_structure(nearest, "biquad", HandImpedance(), seed=0)
            costs, noise = choice.costs, f"{1e3 * choice.noise_m_s_per_n:.2f}"
    found = [costs.get(each) for each in ("noise", "biquad")]
    peaks = " | ".join("none" if each is None else f"{each:.2f}" for each in found)
    times = f"{searched - begun:.1f} | {time.process_time() - searched:.1f}"
    alone, both = (float(each is None) for each in found)
    return f"| {name} | none | {peaks} | | | {noise} | {times} | |", None, (alone, min(alone, both))


def print_observers(drawn: int) -> None:
    """Print the peaks of four gains and, as shares of them, of the observer and of the biquad, alone and together."""
    print("| problem | four gains [N] | at their noise | an observer | a biquad | both |")
    print("|---|---|---|---|---|---|")
    for name, problem, noise in _cases(drawn):
        try:
            plain = solve_design(problem)
        except InfeasibleError:
            continue
        if noise == 1.0:
            shares = [each / plain.evaluation.cost for each in _observer_peaks(plain)]
            print(
                f"| {name} | {plain.evaluation.cost:.2f} | {' | '.join(f'{each:.3f}' for each in shares)} |", flush=True
            )


def _observer_peaks(plain: SearchResult) -> tuple[float, ...]:
    """Return the worst peaks of gains at equal noise, of an observer, of a biquad, and of both; NaN of no design."""
    gains, noise, hand = plain.problem, equal_noise(plain), HandImpedance()
    limits = [limited_problem(gains, noise, has_biquad=each) for each in (False, True)]
    bare, known = list[SearchResult | None](), [plain]
    for limit in limits:
        found = solve_limited(plain, limit, hand, known, seed=0)
        known += [] if found is None else [found]
        bare.append(found)
    observed = list[SearchResult | None]()
    observer = {**_OBSERVER, "compensation_mass_kg": (0.0, 0.95 * gains.plants.payload_mass_kg[0])}
    for limit, simpler in zip(limits, bare, strict=True):
        # A biquad is held by a hand.
        asked = limit.requirements if simpler is None else simpler.problem.requirements
        problem = replace(limit, bounds={**limit.bounds, **observer}, requirements=asked)
        starts = [] if simpler is None else [_with_observer(problem, simpler, share) for share in _SHARES]
        try:
            found = solve_design(problem, others=starts, explores=limit is limits[0])
        except InfeasibleError:
            found = None
        observed.append(found)
    peaks = [math.nan if each is None else each.evaluation.cost for each in (*bare, *observed)]
    return peaks[0], peaks[2], peaks[1], peaks[3]


def _with_observer(problem: DesignProblem, simpler: SearchResult, share: float) -> FloatArray:
    """Return a design with the paper's filters and a share of the payload's mass in the observer."""
    values = dict(zip(simpler.problem.variables, simpler.design.tolist(), strict=True))
    values |= {"velocity_filter_rad_per_s": 120.0, "acceleration_filter_rad_per_s": 200.0}
    values |= {"compensation_mass_kg": share * problem.bounds["compensation_mass_kg"][1]}
    return np.array([values[name] for name in problem.variables])


def draw_trade(path: Path) -> None:
    """Draw what the paper's nominal cell reaches with more and less noise of the command, and print the numbers."""
    found = solve_design(_NOMINAL)
    law, noise, peak = _NOMINAL.controller(found.design), equal_noise(found), found.evaluation.cost
    worst = hardest(_NOMINAL, law, _NOMINAL.scenarios(*_GRID), 1)
    rows: list[tuple[float, ...]] = []
    known = list[SearchResult]()
    for factor in _FACTORS:
        peaks = []
        for has_biquad in (False, True):
            asked = limited_problem(_NOMINAL, factor * noise, has_biquad=has_biquad)
            # What is quiet enough for less noise is so for more.
            result = solve_limited(found, asked, HandImpedance(), known, seed=0)
            known += [] if result is None or has_biquad else [result]
            peaks.append(math.nan if result is None else result.evaluation.cost)
        limit = find_limit(_NOMINAL, law, worst, noise_factor=factor)
        reached = math.nan if limit.attained is None else limit.attained.peak_force_n
        rows.append((1e3 * factor * noise, *peaks, reached, limit.bound.force_n))
        print(" | ".join(f"{each:.2f}" for each in rows[-1]), flush=True)
    numbers = np.array(rows)
    names = ("four gains", "and a biquad", "any order", "none below")
    roles: tuple[Role, ...] = ("model", "after", "measured", "target")
    lines = [
        Line(x=numbers[:, 0], y=numbers[:, index + 1], label=name, role=role, dashed=index == 3)
        for index, (name, role) in enumerate(zip(names, roles, strict=True))
    ]
    design = Points(x=np.array([1e3 * noise]), y=np.array([peak]), label="in their bounds", role="before")
    panel = Panel(
        x=Scale(label="noise of the command [mm/s per N]", spacing="log"),
        y=Scale(label="worst peak [N]"),
        elements=(*lines, design),
    )
    alternative = "Worst peak over the noise of the command; each curve falls, that of more freedom lies lower."
    chart = Chart(key="structures", title="Peak against noise", alternative=alternative, panels=(panel,))
    path.write_bytes(render(chart, path.suffix, mark=PICTURE_MARK))


def print_limits(drawn: int) -> None:
    """Print peaks, noise and times of four gains, structures and limit, and what they come to in the median."""
    print(
        "| problem | four gains [N] | at their noise [N] | and a biquad [N] | any order reaches [N] | none below [N] "
        "| noise [mm/s/N] | search [s] | structures [s] | limit [s] |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    reached, bound, saved, rescued = list[float](), list[float](), list[tuple[float, float]](), list[float]()
    for name, problem, noise in _cases(drawn):
        row, limit, shares = _row(name, problem, noise)
        print(row, flush=True)
        if not name.startswith("drawn"):
            continue
        if limit is None:
            rescued.append(min(shares))
            continue
        reached.append(limit.reached_n / limit.design.peak_force_n)
        bound.append(limit.bound.force_n / limit.design.peak_force_n)
        saved.append(shares)
    if reached:
        both = [biquad for _, biquad in saved]
        print(
            f"\nMedian of {len(reached)} drawn problems that four gains meet: any order reaches "
            f"{100.0 * statistics.median(reached):.0f} %, none gets below {100.0 * statistics.median(bound):.0f} % of "
            f"their peak; at their noise the structures reach "
            f"{100.0 * statistics.median(one for one, _ in saved):.0f} %, with a biquad "
            f"{100.0 * statistics.median(both):.0f} %. Of the other {len(rescued)} a biquad meets "
            f"{rescued.count(0.0)}: of all {drawn} it saves {100.0 * _WORTH:g} % or more, or has the only design, in "
            f"{sum(each <= 1.0 - _WORTH for each in (*both, *rescued))}."
        )


def write_page(page: Path, drawn: int) -> None:
    """Replace the tables of the page by new ones, and its figure."""
    text = page.read_text(encoding="utf-8")
    for fill, count in ((print_limits, drawn), (print_observers, min(drawn, _OBSERVED))):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            fill(count)
        table = [line for line in printed.getvalue().splitlines() if line.startswith("|")]
        before, head, rest = text.partition(table[0])
        if not head:
            raise ValueError(f"The page has no table that begins with {table[0]}")
        after = itertools.dropwhile(lambda line: line.startswith("|"), rest.splitlines()[1:])
        text = "\n".join((before + table[0], *table[1:], *after, ""))
        print(printed.getvalue(), flush=True)
    page.write_text(text, encoding="utf-8")
    draw_trade(page.parent / _FIGURE)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drawn", type=int, default=20, help="how many drawn problems")
    parser.add_argument("--picture", type=Path, help="draw peak against noise of the paper's nominal cell there")
    parser.add_argument("--observer", action="store_true", help="print what a disturbance observer reaches instead")
    parser.add_argument("--write", type=Path, help="the page whose tables and figure are replaced, docs/limit.md")
    options = parser.parse_args()
    if options.write is not None:
        write_page(options.write, options.drawn)
    elif options.observer:
        print_observers(options.drawn)
    elif options.picture is not None:
        draw_trade(options.picture)
    else:
        print_limits(options.drawn)
    return 0


if __name__ == "__main__":
    sys.exit(main())
