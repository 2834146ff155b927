"""`autotune validate --log`: the contacts of a log beside what the controller file predicts of them."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ._common import Output
from ._table import print_table
from ._terminal import tell

if TYPE_CHECKING:
    from autotune.files.controller_record import Controller
    from autotune.validation.against_log import LogComparison


def compare_logs(
    output: Output, controller: "Controller", logs: tuple[Path, ...], cell_path: Path | None, command_topic: str | None
) -> "LogComparison":
    """Read the logs as the parts of one recording and compare every contact."""
    from autotune.files.cell import read_cell
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
    print_table([*_rows(found)])
    inside = sum(each.is_inside for each in found.contacts)
    tell(f"{inside} of {len(found.contacts)} traces lie inside the predicted band all the time")
    if found.passed_over:
        tell(f"{found.passed_over} more contacts passed over: another law drove the command there")


def _rows(found: "LogComparison") -> Iterator[tuple[str, ...]]:
    yield ("contact", "speed", "F^d", "K_e", "measured", "predicted", "error", "", "certified set", "inside", "rms")
    yield ("", "mm/s", "N", "N/mm", "N", "N", "N", "%", "N", "%", "N")
    for each in found.contacts:
        stiffness = each.stiffness_n_per_m
        yield (
            f"{each.axis} at {each.onset_s:.2f} s",
            f"{1e3 * each.speed_m_s:.1f}",
            f"{each.desired_force_n:.1f}",
            "?" if stiffness is None else f"{1e-3 * stiffness:.1f}",
            f"{each.measured_peak_n:.1f}",
            f"{each.predicted_peak_n:.1f}",
            f"{each.peak_error_n:+.1f}",
            f"{100.0 * each.peak_error_n / each.measured_peak_n:+.1f}",
            "{:.1f} to {:.1f}".format(*each.band_peaks_n),
            f"{100.0 * each.share_inside:.1f}",
            f"{each.rms_error_n:.2f}",
        )
