"""What is identified on its own, a recording or a window of one, and what windows know of each other."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from autotune.drift import MASS, identified_values
from autotune.formats.kinds import name_of
from autotune.windows import Window, axes_shown, most_telling
from identification.errors import EstimateError, FewPosesError, LogError, OutsideSpanError, PayloadChangedError
from identification.evidence import Evidence
from identification.known_payload import KnownPayload
from identification.logs.checks.stamps import HOLE
from identification.logs.long_logs import WindowSpan, windows_of_part
from identification.logs.read import WINDOW_S, LogSpan
from identification.logs.roles.cell import Cell
from identification.merging.combine import NamedResult
from identification.result import CONTACT_UNEXPLAINED
from identification.verdicts import unidentifiable, unidentifiable_vector

_MOST_CUTS = 4
_TARES = ("bias-change", "tare-jump", "bias-step")
"""Codes of findings that the bias changed in a window; what changed is said of all windows together."""


@dataclass(frozen=True, kw_only=True)
class RunSource:
    """What the provenance keeps of a recording; windows leave the digests of their files to it.

    `wrench_offset_s` is how late the wrench's clock is against the pose's, value and deviation, None where unknown.
    """

    channels: Mapping[str, str | None]
    clocks: Mapping[str, str]
    sha256: Mapping[str, str]
    span_s: tuple[float, float]
    wrench_offset_s: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class PieceRun:
    """The result of one piece, and where it comes from; small, so that it passes from process to process.

    `payload` is what its own rests show, None where they do not; `payload_from` names the piece whose was taken.
    """

    named: NamedResult
    source: RunSource
    evidence: Evidence | None
    payload: KnownPayload | None = None
    payload_from: str = ""


PieceOutcome = PieceRun | EstimateError | LogError


@dataclass(frozen=True, kw_only=True)
class LogPiece:
    """What is identified on its own: a recording, or a window of it; `known` are payloads that others have shown."""

    files: tuple[Path, ...]
    span: LogSpan
    window: Window | None = None
    known: tuple[KnownPayload, ...] = ()

    @property
    def name(self) -> str:
        """How findings call it."""
        return ", ".join(map(name_of, self.files)) if self.window is None else self.window.name

    def cut(self, change: PayloadChangedError) -> "tuple[LogPiece, LogPiece]":
        """Return the two sides of a change of the payload in a window."""
        window = self.window or Window(start_s=0.0, stop_s=0.0)
        middle = window.start_s + change.time_s
        earlier, later = self.span.split(change.stamp_ns)
        text = f"{window.name}: {change.what} Both sides are identified on their own."
        before, after = replace(window, stop_s=middle), replace(window, start_s=middle, changed=text)
        return replace(self, span=earlier, window=before), replace(self, span=later, window=after)


def pieces_of(
    runs: Sequence[tuple[Path, ...]], cell: Cell, span: LogSpan, *, width_s: float | None, salvage: bool
) -> list[LogPiece]:
    """Return the part of each recording that is asked for, or its windows, as their width asks or one is long.

    Raises OutsideSpanError where no recording holds anything of the part, LogError where one cannot be read.
    """
    found, outside = [], []
    for run in runs:
        try:
            found.append((run, windows_of_part(run, cell, span, width_s=width_s, salvage=salvage)))
        except OutsideSpanError as error:
            outside.append(error)
    if not found:
        raise outside[0]
    if width_s is None and all(len(windows) < 2 for _, windows in found):
        # What lies outside is said where it is read.
        parts = {run: windows[0].span for run, windows in found if windows}
        return [LogPiece(files=run, span=parts.get(run, span)) for run in runs]
    return [
        piece
        for run, windows in found
        for piece in _windows(
            windows or windows_of_part(run, cell, span, width_s=WINDOW_S, salvage=salvage),
            run[0].name if len(runs) > 1 else "",
        )
    ]


def _windows(windows: Sequence[WindowSpan], log: str) -> Iterator[LogPiece]:
    for each in windows:
        window = Window(log=log, start_s=each.start_s, stop_s=each.stop_s)
        yield LogPiece(files=each.files, span=each.span, window=window)


_Worked = list[tuple[LogPiece, PieceOutcome]]
_Work = Callable[[Sequence[LogPiece]], Sequence[PieceOutcome]]


def work_on_windows(pieces: Sequence[LogPiece], work: _Work) -> _Worked:
    """Return the windows with what they show; one in which the payload changes is two.

    A window whose rests are too few to show the payload is worked on again with those of the others, the nearest before
    the farther: of them it takes the first that its force at rest agrees with.
    """
    done = _cut(pieces, work)
    known = [run.payload for _, run in done if isinstance(run, PieceRun) and run.payload is not None]
    wanting = [replace(piece, known=_nearest(piece, known)) for piece, each in done if isinstance(each, FewPosesError)]
    if not known or not wanting:
        return done
    others = [each for each in done if not isinstance(each[1], FewPosesError)]
    helped = _cut(wanting, work)
    order = {file: place for place, file in enumerate(dict.fromkeys(file for piece in pieces for file in piece.files))}
    return sorted(
        [*others, *helped], key=lambda each: (order[each[0].files[0]] * bool(_log(each[0])), _start_s(each[0]))
    )


def _log(piece: LogPiece) -> str:
    return "" if piece.window is None else piece.window.log


def _start_s(piece: LogPiece) -> float:
    return 0.0 if piece.window is None else piece.window.start_s


def _cut(pieces: Sequence[LogPiece], work: _Work) -> _Worked:
    """Work on pieces, and again on both sides of a change of the payload."""
    done = list(zip(pieces, work(pieces), strict=True))
    for _ in range(_MOST_CUTS):
        halves = [piece.cut(each) if isinstance(each, PayloadChangedError) else (piece,) for piece, each in done]
        new = [half for both in halves if len(both) > 1 for half in both]
        if not new:
            break
        worked = iter(zip(new, work(new), strict=True))
        done = [
            each
            for kept, both in zip(done, halves, strict=True)
            for each in ([kept] if len(both) == 1 else [next(worked), next(worked)])
        ]
    return done


def _nearest(piece: LogPiece, known: Sequence[KnownPayload]) -> tuple[KnownPayload, ...]:
    """Return known payloads, those first whose rests lie nearest on the clock of recording."""
    start, stop = piece.span.recorded_ns or (0, 0)
    return tuple(sorted(known, key=lambda each: max(each.start_ns - stop, start - each.stop_ns, 0)))


def telling(done: _Worked) -> tuple[list[PieceRun], tuple[Window, ...]]:
    """Return the windows that give the result, without what is only worth knowing of each, and all of them in short.

    Raises LogError where all of them are refused for the same fault, EstimateError where none identifies anything.
    """
    faults = [each for _, each in done if isinstance(each, LogError)]
    if len(faults) == len(done) and len({str(each) for each in faults}) == 1:
        raise faults[0]
    windows = [_described(piece.window or Window(start_s=0.0, stop_s=0.0), each) for piece, each in done]
    used = most_telling(windows)
    windows = [replace(each, is_used=k in used) for k, each in enumerate(windows)]
    known, _ = axes_shown([windows[k] for k in used])
    own = any(MASS in windows[k].values and not windows[k].payload_from for k in used)
    runs = []
    for k, (_, each) in enumerate(done):
        if k in used and isinstance(each, PieceRun):
            runs.append(_without_payload(each) if windows[k].payload_from and own else each)
            # A payload that is not the window's own counts once.
            own = own or bool(windows[k].payload_from)
    pressed = {
        name
        for run in runs
        for name, axis in run.named.result.axes.items()
        if any(each.stiffness_n_per_m.value is not None for each in axis.environments)
    }
    return [_of_a_window(_with_cut_contacts(run, pressed), known) for run in runs], tuple(windows)


def _described(window: Window, outcome: PieceOutcome) -> Window:
    if not isinstance(outcome, PieceRun):
        return replace(window, refused=str(outcome))
    found = outcome.named.result
    has_pauses = any(finding.code == HOLE for finding in found.findings)
    tares = (f"{window.name}: {finding.message}" for finding in found.findings if finding.code in _TARES)
    return replace(
        window,
        values=identified_values(found),
        payload_from=outcome.payload_from,
        changed=window.changed or next(tares, ""),
        has_pauses=has_pauses,
    )


def _without_payload(run: PieceRun) -> PieceRun:
    """Return a result without the payload that another window has shown, which would count twice."""
    result, note = run.named.result, "from another window"
    none = unidentifiable_vector(note)
    payload = replace(result.payload, mass_kg=unidentifiable(note=note), com_m=none)
    sensor = replace(
        result.sensor, force_bias_n=none, torque_bias_n_m=none, gravity_residual_rms_n=unidentifiable(note=note)
    )
    return replace(run, named=replace(run.named, result=replace(result, payload=payload, sensor=sensor)))


def _with_cut_contacts(run: PieceRun, pressed: Collection[str]) -> PieceRun:
    """Return a result whose contacts without a surface are no error: a border may cut them, and others know one."""
    result = run.named.result
    findings = tuple(
        replace(each, severity="warning") if each.code == CONTACT_UNEXPLAINED and each.axis in pressed else each
        for each in result.findings
    )
    return replace(run, named=replace(run.named, result=replace(result, findings=findings)))


def _of_a_window(run: PieceRun, axes: Collection[str]) -> PieceRun:
    """Return a window's result without what is only worth knowing of it, and without axes of which no window knows."""
    result = run.named.result
    found = {name: axis for name, axis in result.axes.items() if name in axes}
    dropped = tuple(f"Axis {name}:" for name in result.axes if name not in axes)
    kept = tuple(
        finding
        for finding in result.findings
        if finding.severity != "info"
        and finding.code not in (HOLE, *_TARES)
        and not finding.message.startswith(dropped)
    )
    return replace(run, named=replace(run.named, result=replace(result, axes=found, findings=kept)))
