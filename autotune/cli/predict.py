"""`autotune predict`: the contact of any gains on a known plant, alone or beside the contacts of a log."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.formats.kinds import LOG, PLANTS, name_of

from ._common import Output, output_options
from ._options import (
    LOGS,
    SETTINGS,
    FilePath,
    GroupedCommand,
    bumper_option,
    cell_option,
    salvage_option,
    span_options,
    urdf_options,
)
from ._report import check_report, print_report_path, report_option, report_refusal, write_report
from ._terminal import print_message, print_table

if TYPE_CHECKING:
    from autotune.prediction.against_touches import TouchComparison
    from autotune.prediction.result import PredictedContact
    from autotune.report.page import Page
    from autotune.shown import Shown

_EPILOG = """\b
Examples:
  autotune predict identified.yaml --gains mass=13,damping=1000,lead=0.02 --surface x1 --approach force=30
  autotune predict plant.yaml --gains mass=13,damping=1000 --surface 20N/mm --approach speed=28mm/s --plot contact.svg
  autotune predict identified.yaml --controller controller.yaml --surface 20±2N/mm --approach force=30
  autotune predict controller.yaml --surface 20N/mm
  autotune predict identified.yaml --controller controller.yaml --log contacts.bag --report contacts.html
"""
_GROUPS = {
    "Contact": ("surface", "approach", "axis", "payload_mass", "bumper", "sample_time"),
    "Comparison with logs": ("logs", "cell_path", "urdf", "tip", "start", "stop", "salvage"),
}
_SOURCE = FilePath(*SETTINGS, kinds=(*PLANTS, "controller"))


@click.command("predict", cls=GroupedCommand, groups=_GROUPS, epilog=_EPILOG)
@click.argument("identified", type=_SOURCE)
@click.option(
    "--gains",
    metavar="NAME=VALUE,...",
    help="Gains: mass, damping; lead, feedback_damping, deadband, each 0 unless said.",
)
@click.option("--controller", type=FilePath(*SETTINGS, kinds=("controller",)), help="Controller file with the gains.")
@click.option("--surface", metavar="NAME|STIFFNESS", help="Surface of the plant, or a stiffness such as 20N/mm.")
@click.option(
    "--approach", metavar="force=F|speed=V", help="How the contact begins; with both, F acts after the impact."
)
@click.option("--axis", metavar="NAME", help="x, y, z, rx, ry or rz; needed where the surface does not say it.")
@click.option("--payload-mass", metavar="KG", help="Another payload than that of the plant.")
@bumper_option("The payload touches with this part of its mass, behind a spring and a damper: 0.5kg,100N/mm,50Ns/m.")
@click.option("--sample-time", metavar="S", help="Period of the controller, where the plant does not know it.")
@click.option(
    "--log",
    "logs",
    type=FilePath(*LOGS, kinds=(LOG,), dir_okay=True),
    multiple=True,
    help="Predict every contact of this log at its own speed and desired force; may be repeated.",
)
@cell_option
@urdf_options
@span_options
@salvage_option
@click.option(
    "--plot", type=click.Path(path_type=Path, dir_okay=False), metavar="F.svg", help="Also draw it, .svg or .png."
)
@report_option
@output_options
def command(output: Output, /, identified: Path, **options: Any) -> None:
    """Predict the peak force of a contact with an interval, from the plant in IDENTIFIED.

    IDENTIFIED is what identify wrote, a plant.yaml, or a controller.yaml, which brings its own gains and certified
    plants: the interval is then over all of these, and a contact begins as certified unless --approach says otherwise.
    Else the interval holds the joint deviations of the parameters, the
    spread between contacts and the error of the model on contacts that took no part. With --log every contact of the
    log is predicted, beside what was measured; gains and desired force are those in the log unless they are said. Exit
    code 3: a log cannot be used. 4: the plant lacks what the prediction needs. 5: the loop is unstable, and its
    peak no number.
    """
    from autotune.formats.atomic import check_target

    logs, plot, report = options["logs"], options["plot"], options["report"]
    if plot is not None and plot.suffix.lower() not in {".svg", ".png"}:
        raise click.UsageError(f"--plot {plot} must end in .svg or .png.")
    others = [each for each in (options["controller"], options["cell_path"]) if each is not None]
    sources = [identified, *others, *logs]
    if plot is not None:
        check_target(plot, sources, kind="picture", option="--plot")
    check_report(report, [*sources, *([] if plot is None else [plot])])
    seen = _Seen()
    with report_refusal(output, report, sources, seen.refused_page):
        seen.found = _found(output, identified, options)
    tree = seen.found.to_dict()
    if plot is not None:
        _write_plot(output, plot, seen.found)
        tree["plot"] = str(plot)
    tree |= write_report(output, report, seen.page)

    def text() -> None:
        for lines in _printed(seen.shown):
            print_message(lines) if isinstance(lines, str) else print_table(lines)
        if plot is not None:
            print_message(f"written: {plot}")
        print_report_path(report)

    output.result(tree, text)
    _name_next(output, identified, options, seen.shown)


def _name_next(
    output: Output, identified: Path, options: dict[str, Any], found: "PredictedContact | TouchComparison"
) -> None:
    from autotune.formats.yaml12 import kind_of_file
    from autotune.prediction.result import PredictedContact

    contact = found if isinstance(found, PredictedContact) else found.contacts[0].predicted
    if not isinstance(found, PredictedContact) and not any(each.is_inside for each in found.contacts):
        # Another plant, surface or law than that of the log: what it shows itself says which.
        cell = () if options["cell_path"] is None else ("--cell", options["cell_path"])
        output.next_command("identify", *options["logs"], *cell, "--allow-partial", "-o", "of_this_log.yaml")
    elif kind_of_file(identified) == "controller":
        output.next_command("explore", identified)
    elif not contact.has_payload:
        output.next_command("plan", identified)
    else:
        parts = [part.strip() for part in (options["gains"] or "").split(",")]
        is_whole = {"mass", "damping"} <= {part.partition("=")[0] for part in parts}
        gains = ",".join(f"{contact.axis}.{part}" for part in parts)
        output.next_command("optimize", identified, *(("--compare", gains) if is_whole else ()))


@dataclass(kw_only=True)
class _Seen:
    """What a run shows; None until it was computed."""

    found: "PredictedContact | TouchComparison | None" = None

    @property
    def shown(self) -> "PredictedContact | TouchComparison":
        if self.found is None:
            raise ValueError("nothing was predicted yet")
        return self.found

    def page(self) -> "Page":
        """Build the page of the prediction."""
        from autotune.report.predict_page import build_predict_page

        return build_predict_page(self.shown)

    def refused_page(self, error: Exception) -> "Page":
        """Build the page of what was refused."""
        from autotune.report.refused_page import NOT_PREDICTED, refuse

        return refuse(NOT_PREDICTED, error)


def _printed(found: "Shown") -> Iterator[str | list[tuple[str, ...]]]:
    """Yield the headline, the tables and the notes."""
    headline, tables, notes = found.parts()
    yield headline
    for table in tables:
        yield [table.columns, *table.rows]
    for note in notes:
        yield f"note: {note}"


def _found(output: Output, identified: Path, options: dict[str, Any]) -> "PredictedContact | TouchComparison":
    """Predict one contact, or those of logs, as the file and the options say."""
    from autotune.errors import InfeasibleError
    from autotune.formats.yaml12 import kind_of_file
    from problems.stability.margins import UnstableLoopError

    if options["logs"]:
        return _compared(output, identified, options)
    of_file = _certified if kind_of_file(identified) == "controller" else _predicted
    try:
        return of_file(identified, options)
    except UnstableLoopError as error:
        raise InfeasibleError(f"On the plant of {identified}: {error}") from error


def _certified(path: Path, options: dict[str, Any]) -> "PredictedContact":
    from autotune.design import Design
    from autotune.formats.controller import read_controller
    from autotune.predicting import predict_any

    for name in ("gains", "controller", "sample_time"):
        if options[name] is not None:
            raise click.UsageError(
                f"--{name.replace('_', '-')} does not go with a controller file, which brings gains, period and "
                "certified plants: leave it out, or predict on an identified.yaml or plant.yaml."
            )
    if options["surface"] is None:
        raise click.UsageError("Say what is touched: --surface 20N/mm.")
    read, axis = read_controller(path), options["axis"]
    if axis not in read.controller.axes and (axis is not None or len(read.controller.axes) > 1):
        raise click.UsageError(f"{path} holds the axes {', '.join(read.controller.axes)}; say one of them with --axis.")
    return predict_any(Design(controller=read.controller, file=read), None, _request(options, None))


def _predicted(identified: Path, options: dict[str, Any]) -> "PredictedContact":
    from autotune.formats.plant_file import read_plant
    from autotune.predicting import predict_any
    from autotune.prediction.said_gains import parse_gains

    file, axis = read_plant(identified), options["axis"]
    asked = _request(options, file.result)
    gains, controller = options["gains"], options["controller"]
    if (gains is None) == (controller is None):
        raise click.UsageError("Give the gains with --gains, or with --controller.")
    if asked.approach() is None:
        raise click.UsageError("Say how the contact begins: --approach force=30 or speed=0.02.")
    return predict_any(file, controller if gains is None else parse_gains(gains, axis), asked)


def _compared(output: Output, identified: Path, options: dict[str, Any]) -> "TouchComparison":
    from autotune.formats.cell import read_cell
    from autotune.formats.controller import read_controller
    from autotune.formats.plant_file import read_plant
    from autotune.formats.units import ROTATIONAL_AXES
    from autotune.pipeline import IdentifyOptions, identify_log, identify_windows
    from autotune.predicting import compare_with_touches
    from autotune.prediction.said_gains import parse_gains

    file, controller, cell = read_plant(identified), options["controller"], options["cell_path"]
    asked = _request(options, file.result)
    gains = {} if options["gains"] is None else parse_gains(options["gains"], options["axis"])
    if gains and controller is not None:
        raise click.UsageError("Give the gains with --gains, or with --controller.")
    law = None if controller is None else read_controller(controller).controller
    logs = options["logs"]
    with output.progress(f"comparing with {', '.join(map(name_of, logs))}", 2.0) as advance:
        reading = {name: options[name] for name in ("urdf", "tip", "start", "stop", "salvage")}
        # A wall differs from a hand by the speed that the gains make of F^d.
        said = () if options["axis"] in ROTATIONAL_AXES else ("mass", "damping", "lead")
        ran = {name: float(gains[name]) for name in said if name in gains} or None
        of_cell = None if cell is None else read_cell(cell)
        declared = IdentifyOptions(cell=of_cell, allow_partial=True, gains=ran, **reading)
        shown = identify_windows(logs, declared, progress=advance)
        if not shown:
            found = identify_log(logs, declared, progress=advance)
            shown = ((", ".join(map(name_of, logs)), found.result),)
        return compare_with_touches(file, shown, gains, law, asked, advance)


def _request(options: dict[str, Any], result: Any) -> Any:
    from autotune.predicting import ContactRequest, parse_approach, parse_surface

    axis = options["axis"]
    name, stiffness = ("", None) if options["surface"] is None else parse_surface(options["surface"], result)
    approach = {} if options["approach"] is None else parse_approach(options["approach"], axis)
    return ContactRequest(
        surface=name,
        stiffness=stiffness,
        axis=axis,
        payload_mass=_number(options["payload_mass"], "mass", "--payload-mass"),
        bumper=options["bumper"],
        sample_time=_number(options["sample_time"], "time", "--sample-time"),
        # Every unit of a stiffness is a quotient.
        has_unit="/" in (options["surface"] or ""),
        **approach,
    )


def _number(text: str | None, kind: str, option: str) -> float | None:
    from autotune.quantities import parse_quantity

    if text is None:
        return None
    try:
        return parse_quantity(text, kind).value
    except ValueError as error:
        raise click.UsageError(f"{option}: {error}") from None


def _write_plot(output: Output, path: Path, found: "PredictedContact | TouchComparison") -> None:
    from autotune.charts.matplotlib_renderer import render
    from autotune.formats.atomic import write_atomic
    from autotune.formats.kinds import PICTURE_MARK

    picture = render(found.chart(), path.suffix, mark=PICTURE_MARK)
    with output.replacing(path, "picture"):
        write_atomic(path, picture)
