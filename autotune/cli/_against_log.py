"""`autotune validate --log`: the contacts of a log beside what the controller file predicts of them."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotune.formats.records import ROTATIONAL_AXES
from autotune.formats.units import axis_units

from ._common import Output
from ._table import print_table
from ._terminal import tell

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller
    from autotune.validation.against_log import ComparedContact, LogComparison


def compare_logs(
    output: Output, controller: "Controller", logs: tuple[Path, ...], cell_path: Path | None, command_topic: str | None
) -> "LogComparison":
    """Read the logs as the parts of one recording and compare every contact."""
    from autotune.formats.cell import read_cell
    from autotune.validation.against_log import compare_with_log
    from identification.logs import read_checked_recording
    from identification.logs.cell import Cell
    from identification.logs.interpret import build_frames

    cell = Cell() if cell_path is None else read_cell(cell_path).cell
    cell = cell.with_topics(wrench=None, pose=None, command=command_topic)
    with output.progress(f"comparing with {', '.join(log.name for log in logs)}", 1.0) as advance:
        recording = read_checked_recording(logs, cell)
        return compare_with_log(controller, recording, build_frames(cell), advance)


def comparison_tree(found: "LogComparison") -> dict[str, Any]:
    """Return the comparison as plain data."""
    return {
        "payload_mass_kg": found.mass_kg,
        "payload_from": "log" if found.is_weighed else "file",
        "inside_share": found.inside_share,
        "passed_over": found.passed_over,
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
            print_table([*_rows(mine)])
    inside = sum(each.is_inside for each in found.contacts)
    tell(f"{inside} of {len(found.contacts)} traces lie inside the predicted band all the time")
    if found.passed_over:
        tell(f"{found.passed_over} more contacts passed over: another law drove the command there")


def _rows(contacts: "Sequence[ComparedContact]") -> Iterator[tuple[str, ...]]:
    """Yield the rows of contacts that are all along, or all about, an axis."""
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
            f"{100.0 * each.share_inside:.1f}",
            f"{each.rms_error_n:.{digits + 1}f}",
        )
