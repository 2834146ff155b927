"""Write docs/real_logs.md: what each log of a folder of real logs shows, and predicted beside measured peaks.

    python examples/nj60/real_logs.py [FOLDER] [-o docs/real_logs.md]

FOLDER is that of the Comau NJ60 (https://github.com/Jackyyaojk/gp_mpc, folder data). Nothing here is tuned: what comes
out is written down.
"""

import argparse
import csv
import io
import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from autotune.errors import AutotuneError
from autotune.formats.atomic import write_atomic
from autotune.formats.cell import read_cell
from autotune.formats.quantity import Uncertain
from autotune.formats.yaml12 import dump_yaml, load_yaml
from autotune.pipeline import IdentifyOptions, identify_log
from autotune.predicting import ContactRequest, compare_with_touches
from autotune.prediction.against_touches import ComparedTouch, Running, compared_row
from autotune.prediction.contact import AnyLaw, simulate_on
from autotune.prediction.law import law_of_gains
from autotune.prediction.plants import Surface, build_plants
from autotune.prediction.series_plant import series_plant
from autotune.results import Identification
from identification.result import AxisEstimate, Estimate, TouchCause
from problems.contact.transient import Approach
from problems.errors import ParameterError
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel
from problems.stability.margins import UnstableLoopError

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
# Robots of a trace and of two bags, with dampers [N·s/m] and masses [kg] that no log shows, behind a coupling [N/m].
VARIED = ("yellow_feet_imco.csv", "yellow_table_1.bag", "hard_low_2.bag")
DAMPINGS, MASSES, COUPLING = (0.0, 100.0, 300.0, 1000.0), (8.0, 16.0, 30.0), 1e5
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
{estimates}

## Predicted beside measured peaks

At the measured speed of the approach, with gains and F^d of the contact (traces: M_a 13 kg, B_a 1000 N·s/m, K_l 20 ms,
30 N). A trace `_coll` ran with a collision response: it gives a stiffness and is no contact to predict. What a log
predicts of itself with the stiffness of another is "in part"; "held out" is what took part on neither side. "and more":
on some of the plants inside the uncertainty the loop is unstable; "unstable": on the most likely one, so there is no
peak; "no r(s)": neither command nor gains identify the robot. The bags do not say K_l, so the robot of a bag holds
what lead it had, and the robot of a trace does not: for a contact of a bag that loop lacks the lead and may be
unstable. [Every prediction](real_logs_peaks.csv); what was held out:

| robot from | surface from | contact of | measured [N] | predicted [N] | error [%] | {interval} |
|---|---|---|---|---|---|---|
{rows}

{summary}

## A damper in the surface, or a mass before it?

Most peaks of the traces are predicted 3 to 17 % too low. Neither a damper B_e [N·s/m] in the surface nor a payload M_p
before it (K_s 100 N/mm, surface and coupling together as stiff as measured, a drag of 20 N·s/m, a fiftieth of the
critical damping in the coupling) removes that in all rows: peaks in N, the nominal plant alone.

| robot from | contact of | measured | B_e 0 | B_e 100 | B_e 300 | B_e 1000 | M_p 8 kg | M_p 16 kg | M_p 30 kg |
|---|---|---|---|---|---|---|---|---|---|
{variants}

A damper of 100 to 300 N·s/m lowers every peak. One of 1000, the whole first blow of yellow_feet over its speed, raises
the peaks of that surface by 2 to 9 %; but no damper lets the force fall to nothing while the flange still goes in at
25 mm/s, as three of the traces show within 40 ms of it: masses met. So no damping of a surface is identified
from such traces, and no moving mass either: fits of K_s, B_s, M_p, K_e and B_e to one trace with its own travel (made
once, beside this script) left 16 to 53 % of its force, with masses of 13 to 90 kg. Swings of the payload on its own
spring lift the measured peak, and a trace of force and travel of the flange does not say of which mass. Held at one
depth the force of `yellow_feet_coll.csv` does not relax within its 0.4 s (51 N at 2.85 mm), but after a rebound that of
`yellow_feet_imco.csv` is about 30 N at that depth: the way there counts, not the time, so no relaxation in time is
stated. What is written of a surface is its loading, where it is held, and the force of the first blow over its speed.
"""


def identified(folder: Path, name: str, scratch: Path) -> Identification | str:
    """Return what a log shows, or the sentence why it shows nothing."""
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


def estimate_rows(found: dict[str, Identification | str]) -> Iterator[str]:
    """Yield a row of the first table for each log."""
    for name, result in found.items():
        if isinstance(result, str):
            yield f"| `{name}` | {result} | |"
            continue
        axes = "<br>".join(axis_text(axis, each) for axis, each in result.result.axes.items())
        touches = [touch for line in result.result.timelines for touch in line.touches]
        causes = [f"{sum(t.cause is cause for t in touches)} {cause.value}" for cause in TouchCause]
        largest = max(touches, key=lambda touch: touch.peak_force, default=None)
        kinds = ", ".join(each for each in causes if not each.startswith("0 "))
        net = largest is not None and largest.cause is TouchCause.WALL and largest.is_led
        force = "" if largest is None else f"{largest.peak_force:.1f} N{' less what a hand pushed' if net else ''}"
        yield f"| `{name}` | {axes or 'no axis'} | {f'{kinds}; up to {force}' if touches else 'none'} |"


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
        return "one of the logs shows nothing"
    stiffness = None if surface is None else stiffness_of(found[surface])
    if surface is not None and stiffness is None:
        return f"{surface} shows no stiffness"
    try:
        asked = ContactRequest(stiffness=stiffness, axis="z")
        return [*compare_with_touches(source.file(), [(test, other.result)], {}, None, asked).contacts]
    except AutotuneError as error:
        return str(error)


HEAD = (
    *("robot from", "surface from", "contact of", "measured [N]", "between samples [N]", "predicted [N]"),
    *("error [%]", "95 % interval [N]", "inside", "part"),
)


def pair_rows(
    found: dict[str, Identification | str], contacts: list[tuple[str, ComparedTouch]]
) -> Iterator[tuple[str, ...]]:
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
        head = training, surface or training, test
        result = compared(found, training, test, surface)
        if isinstance(result, str):
            yield (*head, *[""] * (len(HEAD) - len(head) - 1), why_not(result))
            continue
        for each in result:
            _, _, _, _, measured, between, predicted, error, interval, inside = compared_row(each)
            part = "in part" if test in (training, surface) else "held out"
            yield (*head, measured, between, predicted, error, interval, inside, part)
            contacts.append((part, each))


def why_not(refusal: str) -> str:
    """Return in a word or two why a contact has no prediction."""
    words = {"loop is unstable": "unstable", "r(s) on axis": "no r(s)"}
    return next((short for part, short in words.items() if part in refusal), refusal)


def held_out_rows(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """Yield the lines of the page's table: what took part on neither side, without what is only in the file."""
    for *head, measured, _between, predicted, error, interval, _inside, part in rows:
        if part == "held out":
            names = " | ".join(f"`{name}`" for name in head)
            yield f"| {names} | {measured} | {predicted} | {error} | {interval} |"


def largest_errors(rows: Sequence[tuple[str, ...]]) -> Iterator[str]:
    """Yield the largest error of a trace that took no part, with the robot of another trace, and with that of a bag."""
    for kind, ending in (("traces from each other", ".csv"), ("traces with the robot of a bag", ".bag")):
        mine = [
            (float(error), robot, contact)
            for robot, _surface, contact, *_between, error, _interval, _inside, part in rows
            if part == "held out" and contact.endswith(".csv") and robot.endswith(ending) and error
        ]
        if mine:
            error, robot, contact = max(mine, key=lambda each: abs(each[0]))
            yield f"- {kind}: largest error {error:+.1f} % (robot of `{robot}`, contact of `{contact}`)."


def page(folder: Path) -> tuple[str, str]:
    """Return the page, and every prediction as CSV."""
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
    summary += largest_errors(rows)
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([HEAD, *rows])
    return frame([*estimate_rows(found)], [*held_out_rows(rows)], summary, [*variant_rows(found)]), stream.getvalue()


def variant_rows(found: dict[str, Identification | str]) -> Iterator[str]:
    """Yield the peaks of each trace with dampers and masses that no log shows."""
    for name in VARIED:
        for test in TRACES:
            source, contact = found[name], found[f"{test}_imco.csv"]
            surface = stiffness_of(found[f"{test}_coll.csv"])
            if isinstance(source, str) or isinstance(contact, str) or surface is None:
                continue
            (touch,) = (each for line in contact.result.timelines for each in line.touches)
            plants = build_plants(source.file(), Surface(stiffness=surface.value), axis="z")
            running = Running(law=law_of_gains({"mass": 1.0, "damping": 1.0}))
            law, approach, period_s = running.law_at(touch), running.approach_at(touch), plants.sample_time_s
            assert plants.nominal is not None
            robot = plants.nominal.robot
            tried = [series_plant(robot, surface.value, period_s, damping_n_s_per_m=each) for each in DAMPINGS]
            tried += [with_payload(robot, surface.value, mass) for mass in MASSES]
            peaks = " | ".join(peak_text(plant, law, approach, period_s) for plant in tried)
            yield f"| `{name}` | `{test}_imco.csv` | {touch.peak_force:.1f} | {peaks} |"


def with_payload(robot: RobotModel, stiffness: float, mass: float) -> Plant:
    """Return a plant of that stiffness over robot travel with a payload on a coupling."""
    return Plant(
        robot=robot,
        coupling=Coupling(stiffness_n_per_m=COUPLING, damping_n_s_per_m=0.04 * math.sqrt(COUPLING * mass)),
        payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=20.0),
        environment=Environment(stiffness_n_per_m=stiffness * COUPLING / (COUPLING - stiffness)),
    )


def peak_text(plant: Plant, law: AnyLaw, approach: Approach, period_s: float) -> str:
    """Return the peak at the sensor, or that there is none."""
    try:
        return f"{simulate_on(plant, law, approach, period_s).peak_sensor_force_n:.1f}"
    except UnstableLoopError:
        return "unstable"
    except ParameterError:
        return "too fast to follow"


def frame(estimates: list[str], rows: list[str], summary: list[str], variants: list[str]) -> str:
    """Return the page of its rows."""
    parts = {"estimates": estimates, "rows": rows, "summary": summary, "variants": variants}
    return PAGE.format(
        interval="95 % interval [N]",
        **{name: "\n".join(lines) for name, lines in parts.items()},
    )


def main() -> None:
    """Read the arguments and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "nj60")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "real_logs.md")
    asked = parser.parse_args()
    text, peaks = page(asked.folder)
    write_atomic(asked.output, text)
    write_atomic(asked.output.with_name(f"{asked.output.stem}_peaks.csv"), peaks)
    print(f"written: {asked.output}")


if __name__ == "__main__":
    main()
