"""`autotune validate`: verify a controller file from the file alone."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.formats.kinds import LOG, name_of
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.processes import MOST_SAMPLES

from ._common import Output, output_options
from ._optimized import limit_lines
from ._options import (
    KEYS,
    LOGS,
    SETTINGS,
    FilePath,
    FiniteRange,
    GroupedCommand,
    bumper_option,
    cell_option,
    salvage_option,
    span_options,
    urdf_options,
)
from ._proved import led_lines, print_samples
from ._report import check_report, print_report_path, report_option, report_refusal, write_report
from ._schedule import validate_schedule
from ._terminal import echo, painted, print_message, print_table, printable

if TYPE_CHECKING:
    from autotune.formats.controller import ControllerFile
    from autotune.formats.controller_record import Controller
    from autotune.formats.identified import IdentifiedFile
    from autotune.report.page import Page
    from autotune.validation.against_log import ComparedContact, LogComparison
    from autotune.validation.disturbances import Disturbances
    from autotune.validation.monte_carlo import AxisMonteCarlo
    from autotune.validation.report import ValidationReport

_EPILOG = """\b
Examples:
  autotune validate controller.yaml
  autotune validate controller.yaml --identified identified.yaml
  autotune validate controller.yaml --log first_contacts.mcap --report contacts.html
  autotune validate controller.yaml --sign key.pem
  autotune validate controller.yaml --public-key pub.pem
  autotune validate schedule/schedule.yaml
"""
_KEY = FilePath(*KEYS)
_GROUPS = {
    "Comparison with a log": ("logs", "cell_path", "command_topic", "urdf", "tip", "start", "stop", "salvage"),
    "Simulation of the certified set": ("samples", "seed", "noise", "sensor_range", "speed_limit", "late", "bumper"),
    "Signature": ("public_key", "sign"),
}


def _pair(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float | None, float | None] | None:
    """Read a number for x, y, z and, after a comma, one for rx, ry, rz."""
    if value is None:
        return None
    try:
        numbers = [float(part) for part in value.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in {1, 2}:
        must = "must be a number, or two with a comma between: for x, y, z and for rx, ry, rz"
        raise click.BadParameter(f"{value!r} {must}.", ctx, param)
    return numbers[0], (numbers[1] if len(numbers) == 2 else None)


def _force_limit(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[float, str] | None:
    """Read a force, or the name of a part of the body."""
    if value is None:
        return None
    from autotune.quantities import parse_quantity
    from problems.design.requirements import BODY_REGIONS

    if value in BODY_REGIONS:
        return BODY_REGIONS[value], f"ISO/TS 15066, clamped {value.replace('_', ' ')}"
    try:
        force = parse_quantity(value, "force").value
    except ValueError as error:
        raise click.BadParameter(f"{error} Or name one of {', '.join(BODY_REGIONS)}.", ctx, param) from None
    if not 0.0 < force < math.inf:
        raise click.BadParameter(f"{value!r} must be greater than 0.", ctx, param)
    return force, "--force-limit"


@click.command("validate", cls=GroupedCommand, groups=_GROUPS, epilog=_EPILOG)
@click.argument("controller", type=FilePath(*SETTINGS, kinds=("controller", "schedule")))
@click.option(
    "--identified",
    type=FilePath(*SETTINGS, kinds=("identified",)),
    help="Check that this identified plant lies inside the certified domain, and |1 + L| on its measured response.",
)
@click.option(
    "--log",
    "logs",
    type=FilePath(*LOGS, kinds=(LOG,), dir_okay=True),
    multiple=True,
    help="Compare every contact in this log, recorded under this controller; several are parts of one recording.",
)
@cell_option
@click.option("--command-topic", help="Channel of the commanded pose in the log.")
@urdf_options
@span_options
@salvage_option
@click.option(
    "--samples",
    type=click.IntRange(0, MOST_SAMPLES),
    default=256,
    show_default=True,
    help="Plants drawn from the certified set to simulate with deadband, noise, clipping and late commands; 0: none.",
)
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of the plants and the noise.")
@click.option(
    "--noise", callback=_pair, help="Noise of the sensor, N RMS[,N·m RMS].  [default: of the file, else 0.2,0.02]"
)
@click.option("--sensor-range", callback=_pair, help="Range of the sensor, N[,N·m].  [default: unlimited]")
@click.option("--speed-limit", callback=_pair, help="Speed limit of the command, m/s[,rad/s].  [default: 0.25 m/s]")
@click.option("--late", type=FiniteRange(0, 1, max_open=True), help="Share of late commands.  [default: 0.01]")
@click.option(
    "--force-limit",
    callback=_force_limit,
    metavar="N|REGION",
    help="Say up to which speed of a led payload no contact exceeds this force, or that of ISO/TS 15066 for a part of "
    "the body: 140, chest, face.  [default: contact_at_speed of the file, else hand]",
)
@bumper_option(
    "Hold the file against a payload that touches with this part of its mass, behind a spring and a damper: "
    "0.5kg,100N/mm,50Ns/m. A bumper of the file is held without it."
)
@click.option("--public-key", type=_KEY, help="Require the signature CONTROLLER.sig by this public key.")
@click.option("--sign", type=_KEY, help="Write CONTROLLER.sig with this private key, if every check passes.")
@report_option
@output_options
def command(output: Output, /, controller: Path, identified: Path | None, **options: Any) -> None:
    """Verify CONTROLLER from the file alone, by other code than the optimizer's.

    Checks checksum, schema and ranges, proves stability anew over the whole domain, computes margins and free-space
    admittance by a second method, replays every predicted contact, and simulates contacts of many plants with deadband,
    noise, clipping and late commands. Of a schedule, verifies every controller that it lists. Exit code 6: a claim or
    a signature does not hold, or the file was altered. 3: the log cannot be used, or another controller was running.
    """
    from autotune.formats.schedule import is_schedule

    if is_schedule(controller):
        given = [name for name in ("logs", "public_key", "sign", "report") if options[name]]
        if given == ["report"]:
            raise click.UsageError(
                f"--report is for one controller file; the page of all: autotune report {controller}."
            )
        if given:
            raise click.UsageError(f"--{given[0].replace('_', '-').removesuffix('s')} is for one controller file.")
        validate_schedule(output, controller, identified)
        return
    _validate(output, controller, identified, options)


def _validate(output: Output, path: Path, identified_path: Path | None, options: dict[str, Any]) -> None:
    from autotune.formats.canonical import short
    from autotune.formats.identified import read_identified
    from autotune.validation.bumper import check_bumper
    from autotune.validation.domain import check_domain
    from autotune.validation.law import of_own_law
    from autotune.validation.measured_loop import measured_checks
    from autotune.validation.monte_carlo_checks import monte_carlo_tree
    from autotune.validation.report import ValidationReport
    from autotune.validation.verify import verify

    sources = [path, *options["logs"], *([] if identified_path is None else [identified_path])]
    check_report(options["report"], sources)
    seen = _Seen(path=path, force_limit=options["force_limit"])
    with report_refusal(output, options["report"], sources, seen.refused_page):
        private, public = _keys(path, options)
        read = _read(path, options)
        seen.signed_by = None if public is None else _signed_by(read, public)
        identified = None if identified_path is None else read_identified(identified_path)
        settings, samples = _disturbances(options, identified), options["samples"]
        with output.progress(f"validating {path.name}", 2.0 if samples else 1.0) as advance:
            found = verify(
                read.controller, samples=samples, seed=options["seed"], disturbances=settings, progress=advance
            )
        checks = [*found.checks, *check_bumper(read.controller, options["bumper"])]
        measured: dict[str, Any] = {}
        if identified is not None:
            of_measured, measured = measured_checks(read.controller, identified.result)
            checks += of_own_law(read.controller, [*check_domain(read.controller, identified.result), *of_measured])
        seen.read, seen.simulated, seen.report = read, found.simulated, ValidationReport(checks=tuple(checks))
        compared = seen.compared = _compared(output, read, options) if seen.report.passed else None
        if compared is not None:
            from autotune.validation.against_log import log_checks

            seen.report = ValidationReport(checks=(*checks, *log_checks(compared)))
        if private is not None and seen.report.passed:
            seen.signed_by = _sign(output, read, private)
    tree = {
        "path": str(path),
        "checksum": read.checksum,
        "short_checksum": short(read.checksum),
        "passed": seen.report.passed,
        "signed_by": seen.signed_by,
        "checks": checks_tree(seen.report),
        "measured": measured,
        "monte_carlo": monte_carlo_tree(found.simulated),
        "log": None if compared is None else comparison_tree(compared),
    }
    if seen.signed_by is None:
        _note_unverified(output, path)
    tree |= write_report(output, options["report"], seen.page)
    output.result(tree, lambda: seen.print(options["report"]))
    if seen.report.passed:
        _name_export(output, read)
    seen.report.require()


def _read(path: Path, options: Mapping[str, Any]) -> "ControllerFile":
    from autotune.formats.controller import read_controller
    from autotune.prediction.as_run_by import designed_for

    read = read_controller(path)
    if (target := designed_for(read.controller)) and options["force_limit"] is not None:
        raise click.UsageError(f"--force-limit is of our own law, and {path} was designed for {target}.")
    return read


def _name_export(output: Output, read: "ControllerFile") -> None:
    from autotune.export.designing import example_export
    from autotune.export.targets import TARGETS
    from autotune.prediction.as_run_by import designed_for

    output.next_line(example_export(TARGETS[designed_for(read.controller) or "c"], read.path))


@dataclass(kw_only=True)
class _Seen:
    """What a run shows, on its page also where it is refused midway; `report` is None until the checks are done."""

    path: Path
    force_limit: tuple[float, str] | None = None
    read: "ControllerFile | None" = None
    report: "ValidationReport | None" = None
    simulated: "tuple[AxisMonteCarlo, ...]" = ()
    compared: "LogComparison | None" = None
    signed_by: str | None = None

    def page(self) -> "Page":
        """Build the page of what was verified."""
        from autotune.report.validate_page import Validated, build_validate_page

        if self.read is None or self.report is None:
            raise ValueError("nothing was verified yet")
        validated = Validated(
            report=self.report, simulated=self.simulated, compared=self.compared, signed_by=self.signed_by
        )
        return build_validate_page(self.read.controller, self.read.checksum, validated)

    def refused_page(self, error: Exception) -> "Page":
        """Build the page of what was refused: the file, or after it was verified the log."""
        from autotune.report.refused_page import VALID_NOT_COMPARED, refuse, refused_controller_page

        if self.report is None:
            return refused_controller_page(error, self.path)
        # A log is only read once every claim of the file was verified.
        return refuse(VALID_NOT_COMPARED, error, self.page(), tone="warn")

    def print(self, page: Path | None) -> None:
        """Print what was verified, and where the page is."""
        from autotune.formats.canonical import short

        if self.read is None or self.report is None:
            raise ValueError("nothing was verified yet")
        for line in (*led_lines(self.read.controller, self.force_limit), *limit_lines(self.read.controller)):
            print_message(line)
        print_samples(self.simulated)
        _print(self.report, self.path, short(self.read.checksum), self.compared, self.signed_by)
        print_report_path(page)


def _keys(path: Path, options: dict[str, Any]) -> tuple[Any, Any]:
    """Read the keys before the long work."""
    if options["sign"] is None and options["public_key"] is None:
        return None, None
    from autotune.formats.signature import check_signature_target, read_private_key, read_public_key

    if options["sign"] is not None:
        check_signature_target(path)
    private = None if options["sign"] is None else read_private_key(options["sign"])
    return private, None if options["public_key"] is None else read_public_key(options["public_key"])


def _sign(output: Output, read: "ControllerFile", private: Any) -> str:
    """Sign the file, say which signature was replaced, and return the fingerprint of the key."""
    from autotune.formats.signature import check_signature_target, sign_file, signature_path

    was = check_signature_target(read.path)
    signed_by = sign_file(read.path, private, read.sha256)
    if was:
        output.note(f"{signature_path(read.path)}: replaced {was}.")
    return signed_by


def _note_unverified(output: Output, path: Path) -> None:
    """Say that there is a signature which was not looked at."""
    from autotune.formats.signature import unverified_signature

    if remark := unverified_signature(path):
        output.note(remark)


def _signed_by(read: "ControllerFile", public: Any) -> str:
    from autotune.formats.signature import check_signature

    return check_signature(read.path, public, read.sha256)


def _disturbances(options: dict[str, Any], identified: "IdentifiedFile | None") -> "Disturbances":
    """Return what is known of the cell: what the options say, else the noise that was identified."""
    from autotune.validation.disturbances import Disturbances

    nothing = (None, None)
    noise = options["noise"]
    if noise is None and identified is not None:
        sensor = identified.result.sensor
        torque = None if sensor.torque_noise_rms_n_m is None else sensor.torque_noise_rms_n_m.value
        noise = sensor.force_noise_rms_n.value, None if torque is None else max(torque)
    return Disturbances(
        noise_rms=noise or nothing,
        sensor_range=options["sensor_range"] or nothing,
        speed_limit=options["speed_limit"] or nothing,
        late_share=options["late"],
    )


def _compared(output: Output, read: "ControllerFile", options: dict[str, Any]) -> "LogComparison | None":
    if not options["logs"]:
        return None
    return compare_logs(output, read.controller, options["logs"], options)


def checks_tree(report: "ValidationReport") -> list[dict[str, Any]]:
    """Return the checks as plain data, with the plant to blame where there is one."""
    return [each.to_dict() for each in report.checks]


def _print(
    report: "ValidationReport", path: Path, checksum: str, compared: "LogComparison | None", signed_by: str | None
) -> None:
    """Print one line per check, the contacts of the log as a table."""
    for check in report.checks:
        print_message(f"axis {check.axis}, {check.name}: {check.message}", verdict=f"{check.verdict:6} ")
    if compared is not None:
        print_comparison(compared)
    signed = "" if signed_by is None else f", signed by the key {signed_by}"
    echo(f"{printable(str(path))}: {painted('valid' if report.passed else 'NOT valid')}, checksum {checksum}{signed}")


def compare_logs(
    output: Output, controller: "Controller", logs: tuple[Path, ...], options: Mapping[str, Any]
) -> "LogComparison":
    """Compare every contact of logs, the parts of one recording, as the options of the command say."""
    from autotune.formats.cell import read_cell
    from autotune.validation.log_windows import compare_with_logs
    from identification.logs.read import LogSpan
    from identification.logs.roles.cell import Cell

    cell = Cell() if options["cell_path"] is None else read_cell(options["cell_path"]).cell
    cell = cell.with_topics(wrench=None, pose=None, command=options["command_topic"])
    cell, span = cell.with_urdf(options["urdf"], options["tip"]), LogSpan(start=options["start"], stop=options["stop"])
    with output.progress(f"comparing with {', '.join(map(name_of, logs))}", 1.0) as advance:
        return compare_with_logs(controller, logs, cell, span, advance, salvage=options["salvage"])


def comparison_tree(found: "LogComparison") -> dict[str, Any]:
    """Return the comparison as plain data."""
    return {
        "payload_mass_kg": found.mass_kg,
        "payload_from": "log" if found.is_weighed else "file",
        "inside_share": found.inside_share,
        "passed_over": found.passed_over,
        "notes": list(found.notes),
        "contacts": [
            {
                **{name: value for name, value in vars(each).items() if name != "trace"},
                "band_peaks_n": list(each.band_peaks_n),
                "outside": each.outside or None,
                "is_inside": each.is_inside,
                "peak_error_n": each.peak_error_n,
                "peak_error_percent": 100.0 * each.peak_error_n / each.measured_peak_n,
            }
            for each in found.contacts
        ],
    }


def print_comparison(found: "LogComparison") -> None:
    """Print a line per contact, and what holds for all of them."""
    for turns in (False, True):
        mine = [each for each in found.contacts if (each.axis in ROTATIONAL_AXES) == turns]
        if mine:
            print_table([*_contact_rows(mine)])
    inside = sum(each.is_inside for each in found.contacts)
    is_followed = all(each.share_inside is not None for each in found.contacts)
    what = "traces lie inside the predicted band all the time" if is_followed else "peaks lie inside the certified set"
    print_message(f"{inside} of {len(found.contacts)} {what}")
    if not is_followed:
        print_message("the log holds no command or no weight: that this controller was running is taken on trust")
    if found.passed_over:
        alone = all(each.law_left_share is None for each in found.contacts)
        why = "no wall, or neither speed nor F^d known" if alone else "another law drove the command there"
        print_message(f"{found.passed_over} more contacts passed over: {why}")
    for note in found.notes:
        print_message(note)


def _contact_rows(contacts: "Sequence[ComparedContact]") -> Iterator[tuple[str, ...]]:
    """Yield the rows of contacts that are all along, or all about, an axis."""
    from autotune.validation.against_log import share_text

    units = axis_units(contacts[0].axis)
    # A torque is a force at 0.2 m: it takes a digit more.
    digits = 1 if units.force == "N" else 2
    desired = "F^d" if units.force == "N" else "T^d"
    yield ("contact", "speed", desired, "K_e", "measured", "predicted", "error", "", "certified set", "inside", "rms")
    force, stiffness_unit = units.force, "N/mm" if units.force == "N" else "N·m/mrad"
    yield ("", f"m{units.speed}", force, stiffness_unit, force, force, force, "%", force, "%", force)
    for each in contacts:
        stiffness = each.stiffness_n_per_m
        low, high = each.band_peaks_n
        yield (
            f"{each.axis} at {each.onset_s:.2f} s",
            f"{1e3 * each.speed_m_s:.1f}",
            f"{each.desired_force_n:.{digits}f}",
            "?" if stiffness is None else f"{1e-3 * stiffness:.{digits}f}",
            f"{each.measured_peak_n:.{digits}f}",
            f"{each.predicted_peak_n:.{digits}f}",
            f"{each.peak_error_n:+.{digits}f}",
            f"{100.0 * each.peak_error_n / each.measured_peak_n:+.1f}",
            f"{low:.{digits}f} to {high:.{digits}f}",
            share_text(each),
            "" if each.rms_error_n is None else f"{each.rms_error_n:.{digits + 1}f}",
        )
