"""`autotune optimize --schedule`: its option, the call, and what is printed of the table."""

import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._common import Output
from ._options import fields_with_unit, typed_range
from ._terminal import echo, painted, print_message, print_table, printable

if TYPE_CHECKING:
    from autotune.formats.schedule import ScheduleClass

Interval = tuple[float, float]

# Rounding of another machine may move a dwell time by a period of some.
_SAME = 0.02
_OPTION_OF = {"payload": "payload_mass", "stiffness": "environment_stiffness"}
_SHORT = {"payload_mass_kg": ("payload", "kg", 1.0), "environment_stiffness_n_per_m": ("K_e", "N/mm", 1e-3)}


def _tables(
    _context: click.Context, _option: click.Parameter, texts: Sequence[str]
) -> dict[str, tuple[Interval, ...]] | None:
    """Return the classes by kind, None where no schedule is asked."""
    found: dict[str, tuple[Interval, ...]] = {}
    for text in texts:
        kind, equals, listed = text.partition("=")
        if kind not in _OPTION_OF or not equals:
            raise click.BadParameter(
                f"give payload=CLASSES in kg or stiffness=CLASSES in N/m, for example payload=8,12:22; found {text!r}."
            )
        found[kind] = found.get(kind, ()) + tuple(_interval(part, kind) for part in listed.split(","))
    return found or None


def _interval(text: str, kind: str) -> Interval:
    parts = text.split(":")
    if len(parts) not in (1, 2):
        raise click.BadParameter(f"{text!r} is no {kind}; give a number, or a range as LOW:HIGH.")
    return typed_range(parts, "mass" if kind == "payload" else kind, _OPTION_OF[kind])


def schedule_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--schedule` to `optimize`; with it the table is tuned instead of the one controller of `function`."""

    @click.option(
        "--schedule",
        multiple=True,
        callback=_tables,
        metavar="payload=A,B|stiffness=LO:HI,...",
        help="Tune a controller for every class of payload and stiffness, into a folder.",
    )
    @functools.wraps(function)
    def command(output: Output, **kwargs: Any) -> Any:
        tables, out = kwargs.pop("schedule"), kwargs.pop("out")
        if tables is not None:
            return _tune(output, tables, Path("schedule") if out is None else out, **kwargs)
        if out is not None and out.is_dir():
            raise click.UsageError(f"Invalid value for '-o' / '--output': File '{out}' is a directory.")
        return function(output, out=Path("controller.yaml") if out is None else out, **kwargs)

    return command


def _tune(
    output: Output,
    tables: Mapping[str, Sequence[Interval]],
    folder: Path,
    *,
    identified: Path,
    problem: Path | None,
    seed: int,
    **others: Any,
) -> None:
    _check_alone(tables, others)
    from autotune.formats.plant_file import read_plant
    from autotune.formats.problem import ProblemSpec, read_problem
    from autotune.formats.schedule import check_schedule_target, write_schedule
    from autotune.processes import count_processors
    from autotune.tuning.problems import is_identified_mass
    from autotune.tuning.schedule import build_classes, tune_schedule

    check_schedule_target(folder)
    classes = build_classes(tables.get("payload", ()), tables.get("stiffness", ()))
    plant = read_plant(identified)
    with output.progress(f"tuning {len(classes)} classes", 1.0) as advance:
        schedule = tune_schedule(
            plant,
            (ProblemSpec() if problem is None else read_problem(problem)).with_options(
                payload_mass=others["payload_mass"],
                environment_stiffness=others["environment_stiffness"],
                structure=others["structure"],
                with_unit=fields_with_unit(),
            ),
            classes,
            seed=seed,
            problem_path=problem,
            processes=count_processors(),
            progress=advance,
        )
    tree = write_schedule(folder, schedule)
    strange = [
        each.of.name for each in schedule.tuned if not is_identified_mass(plant.result, each.controller.payload.mass_kg)
    ]
    if strange:
        output.note(
            f"The runtime will compensate another mass than the identified one, with its centre of mass, in "
            f"{', '.join(strange)}; identify those payloads before they are led by hand."
        )
    output.result(tree, lambda: _print(tree, classes, folder))
    output.next_command("validate", folder / "schedule.yaml")


def _check_alone(tables: Mapping[str, Sequence[Interval]], others: Mapping[str, Any]) -> None:
    """Refuse options that speak of one controller, or of what the table says."""
    for name, option in (
        ("old", "compare"),
        ("pareto", "pareto"),
        ("report", "report"),
        ("target", "for"),
        ("limit", "limit"),
    ):
        if others[name]:
            instead = "; for the page of all: autotune report FOLDER/schedule.yaml" if name == "report" else ""
            raise click.UsageError(f"--{option} is about one controller, and --schedule tunes many{instead}.")
    if others["proof"] is not None:
        raise click.UsageError(
            "--slack, --proof-budget and --axes are about one controller, and --schedule tunes many."
        )
    for kind in tables:
        if others[_OPTION_OF[kind]] is not None:
            option = _OPTION_OF[kind].replace("_", "-")
            raise click.UsageError(f"--{option} and --schedule {kind}= both say the {kind}; give one of them.")


def _print(tree: Mapping[str, Any], classes: "Sequence[ScheduleClass]", folder: Path) -> None:
    print_schedule(tree)
    from autotune.formats.canonical import short

    files = len(classes) + (tree["common"]["file"] is not None)
    print_message(f"written: {folder}, {files} controllers and schedule.yaml, checksum {short(tree['checksum'])}")


def print_schedule(tree: Mapping[str, Any]) -> None:
    """Print the table of a schedule, what one controller for all costs, and what the classes cover."""
    from autotune.formats.canonical import short
    from autotune.formats.records import rename_axis_keys
    from autotune.formats.units import ROTATIONAL_AXES

    scheduled = [name for name in _SHORT if name in tree["covered"]]
    place = tree["objective"].removesuffix("_force")
    names = set(tree["classes"][0]["axes"])
    unit = {0: "N", len(names): "N·m"}.get(len(names & ROTATIONAL_AXES), "N, N·m")
    heads = ["class", *(f"{_SHORT[name][0]} [{_SHORT[name][1]}]" for name in scheduled), "axis"]
    rows = [(*heads, f"peak at {place} [{unit}]", "with all.yaml", "costs", "", "checksum")]
    costs: dict[str, tuple[float, float, str]] = {}
    for entry in tree["classes"]:
        for axis, of_axis in entry["axes"].items():
            values = rename_axis_keys(axis, of_axis, reading=True)
            ranges = (_range_text(entry[name], _SHORT[name][2]) for name in scheduled)
            rows.append((entry["name"], *ranges, axis, *_numbers(values), short(entry["checksum"])))
            if values["cost_n"] is not None:
                cost = (values["cost_percent"], values["cost_n"], entry["name"])
                costs[axis] = max(costs.get(axis, (-float("inf"), 0.0, "")), cost)
    first = len(heads)
    print_table(rows, left=(0, len(scheduled) + 1, first + 4), point=range(first, first + 3), stacks=True)
    common = tree["common"]
    if common["file"] is None:
        print_message(f"no controller serves all classes: {common['refusal']}")
    for axis, (percent, newton, name) in costs.items():
        unit = "N·m" if axis in ROTATIONAL_AXES else "N"
        most = (
            f"costs up to {percent:.1f} % of peak ({newton:.3g} {unit}), in {name}" if newton > 0.0 else "costs nothing"
        )
        print_message(f"axis {axis}: one controller for all, {common['file']}, {most}")
    for name in scheduled:
        print_message(_coverage(name, tree["covered"][name]))
    if "dwell_time_s" in tree:
        print_message(
            f"changes while it runs: each controller for {tree['dwell_time_s']:.3g} s at least, then any other may "
            f"take over, in free space or while a contact lasts{_proved(tree.get('dwell_proved_share'))}"
        )
    elif len(tree["classes"]) > 1:
        print_message("changes while it runs: no waiting time is known to be safe between these controllers")


def _proved(share: float | None) -> str:
    """Say of which plants a dwell time is proved; nothing of files of an earlier release."""
    if share == 1.0:
        return ", proved over K_e and M_p"
    where = "; sampled at the ends of K_e and M_p and in the middle of K_e"
    return where if not share else f"{where}, proved for {math.floor(1000.0 * share) / 10.0:g} % of them"


def _numbers(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the peaks and costs of a row; more digits for a small torque."""
    digits = 1 if values["peak_force_n"] >= 10.0 else 3
    if values["cost_n"] is None:
        return f"{values['peak_force_n']:.{digits}f}", "-", "-", ""
    peaks = (f"{values[name]:.{digits}f}" for name in ("peak_force_n", "peak_with_common_n"))
    return *peaks, f"{values['cost_n']:.{digits + 1}f}", f"{values['cost_percent']:.1f} %"


def validate_schedule(output: Output, path: Path, identified: Path | None) -> None:
    """Verify every controller of a schedule from the files alone; raises CertificateError where one does not hold."""
    from autotune.errors import CertificateError
    from autotune.formats.canonical import short
    from autotune.formats.schedule import read_schedule
    from autotune.processes import count_processors, map_in_processes
    from autotune.validation.dwell import dwell_time_s, proved_share
    from autotune.validation.validate import validate_controller

    if identified is not None:
        raise click.UsageError("--identified is compared with one controller; name one that the schedule lists.")
    read = read_schedule(path)
    files = read.controllers
    with output.progress(f"validating {len(files)} controllers", len(files)) as advance:
        work = [file.controller for file in files.values()]
        done = map_in_processes(validate_controller, work, count_processors(), each=lambda: advance(1.0))
    reports = dict(zip(files, done, strict=True))
    stated, found = read.tree.get("dwell_time_s"), dwell_time_s(work)
    if stated is not None and (found is None or stated < found * (1.0 - _SAME)):
        raise CertificateError(
            f"{path}: dwell_time_s is {stated:.4g} s, and changes are safe from "
            f"{'no dwell time on' if found is None else f'{found:.4g} s on'}."
        )
    share = read.tree.get("dwell_proved_share")
    if share and stated is not None and share > (again := proved_share(work, stated)) + _SAME:
        raise CertificateError(
            f"{path}: dwell_proved_share is {share:.4g}, and {again:.4g} is proved of {stated:.4g} s."
        )
    tree = {
        "path": str(path),
        "checksum": read.checksum,
        "short_checksum": short(read.checksum),
        "passed": all(report.passed for report in reports.values()),
        "controllers": {
            name: {
                "file": files[name].path.name,
                "checksum": files[name].checksum,
                "passed": report.passed,
                "checks": [each.to_dict() for each in report.checks],
            }
            for name, report in reports.items()
        },
    }
    output.result(tree, lambda: _print_validated(tree))
    if tree["passed"]:
        output.next_command("report", path)
    for name, report in reports.items():
        try:
            report.require()
        except CertificateError as error:
            raise CertificateError(f"{files[name].path.name}: {error}") from error


def _print_validated(tree: Mapping[str, Any]) -> None:
    for each in tree["controllers"].values():
        failed = [check for check in each["checks"] if not check["passed"]]
        faults = "; ".join(f"axis {check['axis']}, {check['name']}: {check['message']}" for check in failed)
        verdict = faults or f"{len(each['checks'])} checks passed"
        print_message(f"{each['file']}: {verdict}", verdict=f"{'FAILED' if failed else 'ok':6} ")
    verdict = painted("valid" if tree["passed"] else "NOT valid")
    echo(f"{printable(tree['path'])}: {verdict}, checksum {tree['short_checksum']}")


def _range_text(interval: Sequence[float], scale: float) -> str:
    low, high = (scale * each for each in interval)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _coverage(name: str, intervals: Sequence[Sequence[float]]) -> str:
    what, unit, scale = _SHORT[name]
    text = f"{what} covered: {', '.join(_range_text(each, scale) for each in intervals)} {unit}"
    gaps = [_range_text((before[1], after[0]), scale) for before, after in itertools.pairwise(intervals)]
    return f"{text}; no class from {', '.join(gaps)}" if gaps else text
