"""Write docs/real_logs.md: what each log of a folder of real logs tells, and predicted beside measured peaks.

    python examples/nj60/real_logs.py [FOLDER] [-o docs/real_logs.md]

FOLDER is that of the Comau NJ60 (https://github.com/Jackyyaojk/gp_mpc, folder data). Nothing here is tuned: what comes
out is written down.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from autotune.errors import AutotuneError
from autotune.formats.atomic import write_atomic
from autotune.formats.cell import read_cell
from autotune.formats.quantity import Uncertain
from autotune.formats.yaml12 import dump_yaml, load_yaml
from autotune.pipeline import IdentifyOptions, identify_log
from autotune.predicting import ContactRequest, compare_with_touches
from autotune.prediction.against_touches import ComparedTouch, compared_row
from autotune.results import Identification
from identification.result import AxisEstimate, Estimate, TouchCause

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
# Which trace without the collision response is of which surface; the one with it (_coll) gives the stiffness.
TRACES = ("flex_jt", "yellow_feet")
# Every log that shows the cell's robot on z.
ROBOTS = (
    "flex_jt_imco.csv",
    "yellow_feet_imco.csv",
    "single_mode_middle.bag",
    "yellow_table_1.bag",
    "hard_low_2.bag",
    "soft_low_1.bag",
)
# Logs of one surface each; the rest of the bags with contacts show no stiffness, or have a surface of their own.
REPEATS = (
    ("hard_low_1.bag", "hard_low_2.bag"),
    ("hard_low_2.bag", "hard_low_1.bag"),
    ("man_00.bag", "man_00_contact.bag"),
    ("man_00_contact.bag", "man_00.bag"),
)
# Topics of other bags that these do not have.
WITHOUT_GAINS = ("man_00.bag", "man_00_contact.bag")
PAGE = """# Real logs

Made by `python examples/nj60/real_logs.py` from the logs of a Comau NJ60 (public repository Jackyyaojk/gp_mpc, BSD-3;
the logs are not part of this project). Gravity was taken off in all of them. Nothing is tuned to these numbers.

## What each log yields

Robot bandwidth and surfaces over robot travel, value ± standard deviation and verdict; touches by cause.

| log | axes | touches |
|---|---|---|
{told}

## Predicted beside measured peaks

At the measured speed of the approach, with gains and F^d of the contact (traces: M_a 13 kg, B_a 1000 N·s/m, K_l 0.02 s,
30 N). A trace `_coll` ran with a collision response: it gives a stiffness and is no contact to predict. What a log
predicts of itself with the stiffness of another is "in part"; "held out" is what took part on neither side. "and more":
on some of the plants inside the uncertainty the loop is unstable. The bags do not say K_l, so the robot of a bag holds
what lead it had, and the robot of a trace does not: for a contact of a bag that loop lacks the lead and may be
unstable.

| robot from | surface from | contact of | measured [N] | {between} | predicted [N] | error [%] | {interval} | in |
|---|---|---|---|---|---|---|---|---|
{rows}

{summary}
"""


def identified(folder: Path, name: str, scratch: Path) -> Identification | str:
    """Return what a log tells, or the sentence why it tells nothing."""
    tree = load_yaml(HERE / ("traces.yaml" if name.endswith(".csv") else "cell.yaml"))
    if name in WITHOUT_GAINS:
        tree = {key: value for key, value in tree.items() if key not in ("gains", "desired_force")}
    cell = scratch / "cell.yaml"
    cell.write_text(dump_yaml(tree), encoding="utf-8")
    try:
        return identify_log(folder / name, IdentifyOptions(cell=read_cell(cell), allow_partial=True))
    except AutotuneError as error:
        return str(error)


def text(estimate: Estimate | None, factor: float, unit: str) -> str:
    """Return value, deviation and verdict, or nothing."""
    if estimate is None or estimate.value is None or estimate.std is None:
        return ""
    return f"{factor * estimate.value:.3g} ± {factor * estimate.std:.2g} {unit} ({estimate.status.value})"


def axis_text(name: str, axis: AxisEstimate) -> str:
    """Return what is known of an axis."""
    parts = [text(axis.robot.bandwidth_hz, 1.0, "Hz")]
    for surface in axis.environments:
        stiffness = text(surface.secant_stiffness_n_per_m, 1e-3, "N/mm")
        blow = text(surface.impact_n_s_per_m, 1.0, "N·s/m")
        parts.append(f"{surface.name} {stiffness or 'stiffness not shown'}" + (f", first blow {blow}" if blow else ""))
    return f"{name}: {'; '.join(part for part in parts if part) or 'nothing'}"


def told_rows(found: dict[str, Identification | str]) -> Iterator[str]:
    """Yield a row of the first table for each log."""
    for name, result in found.items():
        if isinstance(result, str):
            yield f"| `{name}` | {result} | |"
            continue
        axes = "<br>".join(axis_text(axis, each) for axis, each in result.result.axes.items())
        touches = [touch for line in result.result.timelines for touch in line.touches]
        causes = [f"{sum(t.cause is cause for t in touches)} {cause.value}" for cause in TouchCause]
        largest = max((touch.peak_force for touch in touches), default=0.0)
        kinds = ", ".join(each for each in causes if not each.startswith("0 "))
        yield f"| `{name}` | {axes or 'no axis'} | {f'{kinds}; up to {largest:.1f} N' if touches else 'none'} |"


def stiffness_of(source: Identification | str) -> Uncertain | None:
    """Return the loading stiffness of a trace with its deviation."""
    if isinstance(source, str):
        return None
    secant = source.result.axes["z"].environments[0].secant_stiffness_n_per_m
    return None if secant.value is None or secant.std is None else Uncertain(secant.value, secant.std)


def compared(
    found: dict[str, Identification | str], training: str, test: str, surface: str | None
) -> list[ComparedTouch] | str:
    """Return the contacts of a log as another one predicts them, or the sentence why it does not."""
    source, other = found[training], found[test]
    if isinstance(source, str) or isinstance(other, str):
        return "one of the logs tells nothing"
    stiffness = None if surface is None else stiffness_of(found[surface])
    if surface is not None and stiffness is None:
        return f"{surface} shows no stiffness"
    try:
        asked = ContactRequest(stiffness=stiffness, axis="z")
        return [*compare_with_touches(source.file(), [(test, other.result)], {}, None, asked).contacts]
    except AutotuneError as error:
        return str(error)


def pair_rows(found: dict[str, Identification | str], contacts: list[tuple[str, ComparedTouch]]) -> Iterator[str]:
    """Yield a row for each contact of each pair, and collect those that took no part on either side."""
    pairs = [
        (robot, f"{test}_imco.csv", f"{test}_{kind}.csv")
        for test in TRACES
        for robot in ROBOTS
        for kind in ("coll", "imco")
        if (robot, kind) != (f"{test}_imco.csv", "imco")
    ]
    pairs += [(robot, "soft_low_1.bag", "soft_low_1.bag") for robot in ROBOTS]
    for training, test, surface in [*pairs, *((a, b, None) for a, b in REPEATS)]:
        head = f"| `{training}` | `{surface or training}` | `{test}` |"
        result = compared(found, training, test, surface)
        if isinstance(result, str):
            yield f"{head} {result} | | | | | |"
            continue
        for each in result:
            _, _, _, _, measured, between, predicted, error, interval, inside = compared_row(each)
            yield f"{head} {measured} | {between} | {predicted} | {error} | {interval} | {inside} |"
            held_out = test not in (training, surface)
            contacts.append(("held out" if held_out else "in part", each))


def page(folder: Path) -> str:
    """Return the page."""
    names = sorted(path.name for path in folder.iterdir() if path.suffix in {".bag", ".csv"})
    with tempfile.TemporaryDirectory() as scratch:
        found = {name: identified(folder, name, Path(scratch)) for name in names}
    contacts: list[tuple[str, ComparedTouch]] = []
    rows = [*pair_rows(found, contacts)]
    summary = []
    for kind in ("held out", "in part"):
        mine = [each for held, each in contacts if held == kind]
        if mine:
            errors = np.array([each.error_share for each in mine])
            inside, open_ended = (
                sum(e.is_inside for e in mine),
                sum(e.predicted.interval.sensor[1] is None for e in mine),
            )
            summary.append(
                f"- {kind}: {len(mine)} predictions, RMS error {100.0 * np.sqrt(np.mean(errors**2)):.0f} %, largest "
                f"{100.0 * np.max(np.abs(errors)):.0f} %; {inside} of {len(mine)} inside their 95 % interval, of which "
                f"{open_ended} have no upper end."
            )
    return frame([*told_rows(found)], rows, summary)


def frame(told: list[str], rows: list[str], summary: list[str]) -> str:
    """Return the page of its rows."""
    parts = {"told": told, "rows": rows, "summary": summary}
    return PAGE.format(
        between="between samples [N]",
        interval="95 % interval [N]",
        **{name: "\n".join(lines) for name, lines in parts.items()},
    )


def main() -> None:
    """Read the arguments and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "nj60")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "real_logs.md")
    asked = parser.parse_args()
    write_atomic(asked.output, page(asked.folder))
    print(f"written: {asked.output}")


if __name__ == "__main__":
    main()
