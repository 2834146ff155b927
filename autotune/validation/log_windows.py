"""Contacts of logs of any length beside what a controller file predicts, of a long log window by window."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from autotune.formats.controller_record import Controller
from autotune.text import clock_text
from identification.errors import EstimateError, LogError, PayloadChangedError, listed
from identification.logs.long_logs import WindowSpan, windows_of_part
from identification.logs.read import LogSpan, read_checked_recording
from identification.logs.recording import build_frames
from identification.logs.roles.cell import Cell
from identification.signals.recording import Recording
from problems.progress import no_progress

from .against_log import MOST_DRAWN, ComparedContact, LogComparison, compare_with_log, refuse_other_law
from .log_touches import compare_touches_of_log

# A contact takes a second or two; one that the border of two windows cuts is whole in one of both.
_OVERLAP_S = 10.0
_SAME_CONTACT_S = 0.1
_MOST_CUTS = 4


@dataclass(frozen=True, kw_only=True)
class _Part:
    """What was compared in a part of a log, its first and last stamp [ns], and what of it is damaged."""

    found: LogComparison
    start_ns: int
    stop_ns: int
    damage: tuple[str, ...] = ()

    def onset_ns(self, contact: ComparedContact) -> float:
        """Return when a contact was, on the log's clock."""
        return self.start_ns + 1e9 * contact.onset_s

    def inside_ns(self, contact: ComparedContact) -> float:
        """Return how far a contact is from the nearer end of the part."""
        return min(1e9 * contact.onset_s, self.stop_ns - self.onset_ns(contact))


def compare_with_logs(
    controller: Controller,
    logs: Sequence[Path],
    cell: Cell | None = None,
    span: LogSpan | None = None,
    progress: Callable[[float], None] | None = None,
    *,
    salvage: bool = False,
) -> LogComparison:
    """Read the parts of one recording and compare every contact, of a long one with a window at a time in memory.

    A window that cannot be used, or was recorded with another controller, is a note where others hold contacts.

    Parameters
    ----------
    controller
        The file that was running.
    logs
        Parts of one recording.
    cell
        What is declared of the cell.
    span
        The part that is read.
    progress
        Receives the share of the work done since the last call.
    salvage
        Whether to read what is left of a log whose end or index is damaged.

    Raises
    ------
    LogError, EstimateError
        As `compare_with_log` and `compare_touches_of_log`, of all windows.
    UsageError
        A file with a collision response or variable damping.
    """
    cell, span, report = cell or Cell(), span or LogSpan(), progress or no_progress
    windows = windows_of_part(logs, cell, span, overlap_s=_OVERLAP_S, salvage=salvage)
    if len(windows) < 2:
        recording = read_checked_recording(logs, cell, salvage=salvage, span=windows[0].span if windows else span)
        return _compare(controller, recording, cell, report)
    refuse_other_law(controller)
    parts: list[_Part] = []
    faults: list[tuple[WindowSpan, LogError | EstimateError]] = []
    for window in windows:
        for each in _compared(controller, window, cell, _MOST_CUTS, salvage=salvage):
            if isinstance(each, LogError | EstimateError):
                faults.append((window, each))
            else:
                parts.append(each)
        parts = _with_strongest_traces(parts)
        report(1.0 / len(windows))
    if not parts:
        commonest = Counter(str(error) for _, error in faults).most_common(1)[0][0]
        raise next(error for _, error in faults if str(error) == commonest)
    return _joined(parts, faults)


def _with_strongest_traces(parts: list[_Part]) -> list[_Part]:
    """Return the parts with the traces that a picture may show: of a day's contacts they would fill the memory."""
    peaks = [each.measured_peak_n for part in parts for each in part.found.contacts if each.trace is not None]
    # One that two windows share counts twice.
    if len(peaks) <= 2 * MOST_DRAWN:
        return parts
    least = sorted(peaks, reverse=True)[2 * MOST_DRAWN - 1]
    kept = []
    for part in parts:
        contacts = tuple(
            each if each.trace is None or each.measured_peak_n >= least else replace(each, trace=None)
            for each in part.found.contacts
        )
        kept.append(replace(part, found=replace(part.found, contacts=contacts)))
    return kept


def _compare(
    controller: Controller, recording: Recording, cell: Cell, report: Callable[[float], None] = no_progress
) -> LogComparison:
    # Without a command the law cannot be held against it, without the weight no contact be followed.
    is_whole = recording.command is not None and not recording.wrench.gravity_compensated
    compare = compare_with_log if is_whole else compare_touches_of_log
    found = compare(controller, recording, build_frames(cell), report)
    return replace(found, notes=(*_damage(recording), *found.notes))


def _damage(recording: Recording) -> tuple[str, ...]:
    return tuple(finding.message for finding in recording.findings if finding.code == "salvaged")


def _compared(
    controller: Controller, window: WindowSpan, cell: Cell, most_cuts: int, *, salvage: bool
) -> Iterator[_Part | LogError | EstimateError]:
    """Yield what a window holds, of both sides where the payload changes in it."""
    try:
        recording = read_checked_recording(window.files, cell, salvage=salvage, span=window.span)
        ends = [(stamps[0], stamps[-1]) for stamps in (recording.wrench.stamp_ns, recording.pose.stamp_ns)]
        start, stop = max(int(first) for first, _ in ends), min(int(last) for _, last in ends)
        found = _compare(controller, recording, cell)
        yield _Part(found=found, start_ns=start, stop_ns=stop, damage=_damage(recording))
    except PayloadChangedError as change:
        if not most_cuts:
            yield change
            return
        for half in window.span.split(change.stamp_ns):
            yield from _compared(controller, replace(window, span=half), cell, most_cuts - 1, salvage=salvage)
    except (LogError, EstimateError) as error:
        yield error


def _joined(parts: Sequence[_Part], faults: Sequence[tuple[WindowSpan, LogError | EstimateError]]) -> LogComparison:
    """Return the contacts of all parts, each once, with times from the first part on."""
    found: list[tuple[_Part, ComparedContact]] = []
    for new in [(part, contact) for part in parts for contact in part.found.contacts]:
        same = [k for k, each in enumerate(found) if _is_same(each, new)]
        if not same:
            found.append(new)
        elif new[0].inside_ns(new[1]) > found[same[0]][0].inside_ns(found[same[0]][1]):
            found[same[0]] = new
    zero = min(part.start_ns for part in parts)
    contacts = (replace(each, onset_s=(part.onset_ns(each) - zero) / 1e9) for part, each in found)
    weighed = [part.found for part in parts if part.found.is_weighed] or [part.found for part in parts]
    return LogComparison(
        contacts=tuple(sorted(contacts, key=lambda each: each.onset_s)),
        passed_over=sum(part.found.passed_over for part in parts),
        mass_kg=weighed[0].mass_kg,
        is_weighed=weighed[0].is_weighed,
        notes=tuple(dict.fromkeys([*(note for part in parts for note in part.damage), *_notes(faults)])),
    )


def _is_same(one: tuple[_Part, ComparedContact], other: tuple[_Part, ComparedContact]) -> bool:
    apart = one[0].onset_ns(one[1]) - other[0].onset_ns(other[1])
    return one[1].axis == other[1].axis and abs(apart) < 1e9 * _SAME_CONTACT_S


def _notes(faults: Sequence[tuple[WindowSpan, LogError | EstimateError]]) -> Iterator[str]:
    """Yield each reason why nothing was compared, with the windows that it holds of."""
    for reason, windows in {str(error): [w for w, e in faults if str(e) == str(error)] for _, error in faults}.items():
        names = [f"{clock_text(each.start_s)} to {clock_text(each.stop_s)}" for each in windows]
        yield f"nothing compared in {listed(names)}: {reason}"
