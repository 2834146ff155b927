"""The page of how accurate and how honest identification is."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.cell_outcomes import Outcome
from benchmarks.insufficient_cells import CASES, Untold

_FARTHEST_DEVIATIONS = 5.0
_COVERED = (0.90, 0.99)

_HEAD = """# How accurate identification is

Errors and stated intervals of every parameter beside the truth, for who decides whether to trust `identify`.
Measured over {cells} simulated cells by `python benchmarks/bench_identification.py --table docs/accuracy.md`, through
log files and the library call behind `autotune identify --allow-partial`.

Drawn at random, what spans a decade log-uniformly: mass 2 to 60 kg and its centre, K_s 5e4 to 1e6 N/m, B_s 1 to 10 %
of the critical damping, B_p 60 to 600 N·s/m, one to three surfaces of K_e 5e3 to 3e5 N/m with B_e 10 to 500 N·s/m, a
quarter of them with a mass of 0.3 to 5 kg; robot of one or two poles at 1 to 8 Hz, delay 0.5 to 6 samples, h 0.8 to
4 ms; force noise 0.05 to 0.5 N, encoder noise 0.5 to 10 µm, bias, the cell's own deadband, approach along x, y or z.
The log: rosbag2 (MCAP or SQLite), ROS 1 bag or CSV, `PoseStamped` or `TransformStamped`, three sets of topic names, a
wrench of the other sign, a turned sensor, pose or wrench at a half or a third of the control rate, up to 1 % of the
messages lost, a gap of up to 10 periods, a wrench stamped up to 1.5 samples early or late; in half of the cells
cell.yaml names the controller's period, without which the delay of a log slower than 1.5 ms is known to a quarter of a
sample. The controller is the fastest of a ladder of dampings that touches all surfaces with a modulus margin of 0.55.
"""
_PARAMETERS = """Errors are of everything that has a value; a share is of the true value. *Covered*: how often the
stated 95 % interval holds the truth (target 90 to 99 %). *Worst*: the largest |error| in stated standard deviations of
what is `identified`, with the cell's seed (target: 5). Bold is what misses its target.

| parameter | unit | identified | weak | not identified | median (target) | 95th percentile (target) | covered | worst |
|---|---|---|---|---|---|---|---|---|"""
_INSUFFICIENT = """## Logs that do not suffice

Each is a cell as above whose recording lacks what the named parameters need. *Refused*: no result at all;
*marked*: none of them `identified`; *right*: `identified`, and within three stated deviations of the truth;
*wrong*: `identified`, and farther off (must be none).

| case | parameters | cells | refused | marked | right | wrong |
|---|---|---|---|---|---|---|"""


@dataclass(frozen=True, kw_only=True)
class Run:
    """One cell: its outcomes, or why its log was refused; `case` names what it cannot determine, if anything."""

    seed: int
    case: str
    outcomes: tuple[Outcome, ...]
    refusal: str
    findings: tuple[str, ...]
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Row:
    """A parameter of the table: its unit, how errors are scaled to it, and targets of median and 95th percentile."""

    name: str
    unit: str
    scale: float = 1.0
    targets: tuple[float, float] | None = None


ROWS = (
    Row(name="mass", unit="%", scale=100.0, targets=(0.1, 0.5)),
    Row(name="centre of mass", unit="mm", targets=(0.5, 2.0)),
    Row(name="mass from motion", unit="%", scale=100.0),
    Row(name="K_s", unit="%", scale=100.0, targets=(1.0, 4.0)),
    Row(name="B_s", unit="%", scale=100.0, targets=(5.0, 15.0)),
    Row(name="B_p", unit="%", scale=100.0),
    Row(name="K_e", unit="%", scale=100.0, targets=(1.5, 5.0)),
    Row(name="secant", unit="%", scale=100.0),
    Row(name="B_e", unit="%", scale=100.0),
    Row(name="M_e", unit="kg"),
    Row(name="bandwidth", unit="%", scale=100.0, targets=(1.5, 5.0)),
    Row(name="delay", unit="samples", targets=(0.1, 0.4)),
)


@dataclass(frozen=True, kw_only=True)
class Score:
    """One parameter over all cells; errors in the row's unit, None where there is no value at all."""

    row: Row
    identified: int
    weak: int
    insufficient: int
    median: float | None
    percentile_95: float | None
    covered: float | None
    worst: float | None
    worst_seed: int | None

    @property
    def misses(self) -> tuple[str, ...]:
        """Which targets are missed."""
        missed = []
        if self.row.targets is not None:
            for name, value, target in zip(
                ("median", "95th percentile"), (self.median, self.percentile_95), self.row.targets, strict=True
            ):
                if value is None or value > target:
                    missed.append(name)
        if self.covered is not None and not _COVERED[0] <= self.covered <= _COVERED[1]:
            missed.append("coverage")
        if self.worst is not None and self.worst > _FARTHEST_DEVIATIONS:
            missed.append("worst")
        return tuple(missed)


def score(row: Row, outcomes: Sequence[Outcome]) -> Score:
    """Sum one parameter up; errors and coverage are of all that have a value, the worst of what is `identified`."""
    mine = [o for o in outcomes if o.name == row.name]
    errors = [abs(o.error) * row.scale for o in mine if o.error is not None]
    covered = [o.is_covered for o in mine if o.is_covered is not None]
    claimed = [(o.deviations, o.seed) for o in mine if o.status == "identified" and o.deviations is not None]
    worst = max(claimed, default=(None, None))
    return Score(
        row=row,
        identified=sum(o.status == "identified" for o in mine),
        weak=sum(o.status == "weak" for o in mine),
        insufficient=sum(o.value is None for o in mine),
        median=float(np.median(errors)) if errors else None,
        percentile_95=float(np.percentile(errors, 95.0)) if errors else None,
        covered=float(np.mean(covered)) if covered else None,
        worst=worst[0],
        worst_seed=worst[1],
    )


def all_targets_met(runs: Sequence[Run]) -> bool:
    """Return whether nothing is missed, nothing hidden is claimed, and no log was refused that suffices."""
    judged = [run for run in runs if not run.case]
    scores = [score(row, [o for run in judged for o in run.outcomes]) for row in ROWS]
    claims = [claim for case in CASES for claim in wrong_claims(case, runs)]
    return not claims and not any(each.misses for each in scores) and not any(run.refusal for run in judged)


def wrong_claims(case: Untold, runs: Sequence[Run]) -> list[Outcome]:
    """Return what is `identified` although the log hides it, and which is off by more than three deviations.

    A value that is within its deviations is no harm: where a weak recording shows a little, that may be said.
    """
    hidden = [o for run in runs if run.case == case.name for o in run.outcomes if o.name in case.hidden]
    return [o for o in hidden if o.status == "identified" and (o.deviations or 0.0) > 3.0]


def page(runs: Sequence[Run]) -> str:
    """Return the page as Markdown."""
    return "\n".join([_head(runs), *_parameters(runs), *_refused(runs), *_insufficient(runs), *_outliers(runs)]) + "\n"


def _head(runs: Sequence[Run]) -> str:
    return _HEAD.format(cells=sum(not run.case for run in runs))


def _parameters(runs: Sequence[Run]) -> Iterator[str]:
    outcomes = [o for run in runs if not run.case for o in run.outcomes]
    yield _PARAMETERS
    for row in ROWS:
        if any(o.name == row.name for o in outcomes):
            yield _line(score(row, outcomes))
    extra = sum(o.name == "surfaces beside the true ones" for o in outcomes)
    yield from ("", f"Surfaces that were found but are not there: {extra}.", "")


def _line(each: Score) -> str:
    def shown(name: str, text: str) -> str:
        return f"**{text}**" if name in each.misses else text

    targets = each.row.targets
    cells = [each.row.name, each.row.unit, str(each.identified), str(each.weak), str(each.insufficient)]
    for i, (name, value) in enumerate((("median", each.median), ("95th percentile", each.percentile_95))):
        text = "-" if value is None else f"{value:.2g}"
        cells.append(shown(name, text) + ("" if targets is None else f" ({targets[i]:g})"))
    cells.append("-" if each.covered is None else shown("coverage", f"{100.0 * each.covered:.0f} %"))
    cells.append("-" if each.worst is None else shown("worst", f"{each.worst:.1f}") + f" ({each.worst_seed})")
    return "| " + " | ".join(cells) + " |"


def _refused(runs: Sequence[Run]) -> Iterator[str]:
    refused = [run for run in runs if not run.case and run.refusal]
    if refused:
        yield from ("Logs that were refused although they suffice:", "")
        yield from (f"- {run.seed}: {run.refusal}" for run in refused)
        yield ""


def _insufficient(runs: Sequence[Run]) -> Iterator[str]:
    if not any(run.case for run in runs):
        return
    yield _INSUFFICIENT
    for case in CASES:
        mine = [run for run in runs if run.case == case.name]
        wrong = {o.seed for o in wrong_claims(case, runs)}
        claimed = {o.seed for run in mine for o in run.outcomes if o.name in case.hidden and o.status == "identified"}
        refused = sum(bool(run.refusal) for run in mine)
        marked = len(mine) - refused - len(claimed)
        counts = f"{len(mine)} | {refused} | {marked} | {len(claimed - wrong)} | "
        yield f"| {case.name} | {', '.join(case.hidden)} | {counts}" + (f"**{len(wrong)}** |" if wrong else "0 |")
    yield ""


def _outliers(runs: Sequence[Run]) -> Iterator[str]:
    far = [
        o
        for run in runs
        if not run.case
        for o in run.outcomes
        if o.status == "identified" and (o.deviations or 0.0) > _FARTHEST_DEVIATIONS
    ]
    if far:
        yield from ("## Identified, and off by more than five deviations", "")
        for o in sorted(far, key=lambda o: -(o.deviations or 0.0)):
            yield f"- seed {o.seed}, {o.name}: {o.value:.6g} ± {o.std:.2g}, true {o.truth:.6g}"
        yield ""
