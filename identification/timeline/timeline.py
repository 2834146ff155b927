"""Time line of a log: its phases without gaps or overlaps, and which surface each contact is on."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from problems.arrays import FloatArray, IntArray

from ..result import ContactPhase, LogPhase, PhaseKind
from ..signals.aligned import AlignedLog, Span, spans_of
from ..signals.recording import PoseSignal
from ..signals.segments import MotionSpans
from .contacts import ContactTimes, Pressed, find_contacts
from .moves import Scene, judge_moves, settle_moves
from .payload import AxisContacts, PayloadMotion, observe_payload

_SAME_ONSET_S = 0.3
_OFFSET_FACTOR = 3.0
_SMALLEST_OFFSET_N = 0.2


def build_timeline(
    log: AlignedLog,
    motion: MotionSpans,
    force_S_n: FloatArray,
    axes: Sequence[AxisContacts],
    command: PoseSignal | None,
    mass_kg: float,
    pressed: Sequence[Pressed] | None = None,
    payloads: Sequence[PayloadMotion] | None = None,
) -> tuple[LogPhase, ...]:
    """Label the whole log, without gaps or overlaps, from 0 to its length.

    `force_S_n` (n, 3) is free of weight and bias, `axes` hold the rests under force of each axis that moved, `payloads`
    and `pressed` what `observe_payload` and `find_contacts` found on them, where that is known already. Contacts are
    cut out first. Of the motion that is left, `turning` changes the orientation by more than 2 degrees, in a `hand-led-
    motion` the force does work on the flange, in a `commanded-motion` the flange follows a command that no admittance
    explains by the force, and `free-motion` is the rest, approaches under a desired force among them. Unknown is what a
    hole of the log hides, a rest under force whose beginning and end are not shown, and motion against a force that is
    neither the payload's nor a contact with a hold. A rest in a hand is a rest.
    """
    if payloads is None:
        payloads = [observe_payload(of, log.period_s) for of in axes]
    if pressed is None:
        pressed = [find_contacts(of, payload, motion, log.period_s) for of, payload in zip(axes, payloads, strict=True)]
    held = {hold for of in axes for hold in of.holds}
    free = tuple(span for span in motion.still if span not in held)
    scene = Scene(
        log=log,
        motion=motion,
        force_S_n=force_S_n,
        axes=axes,
        payloads=payloads,
        command=command,
        mass_kg=mass_kg,
        offset_n=_offset(force_S_n, free),
        rests=_rests(motion, [contact.span for each in pressed for contact in each.contacts]),
    )
    # Each sample bears the number of its phase; what comes later goes over what came before.
    number = np.zeros(len(log), dtype=np.int64)
    labels: list[tuple[PhaseKind, str | None, ContactTimes | None]] = [(PhaseKind.UNKNOWN, None, None)]
    for span in (*free, *(contact.hold for each in pressed for contact in each.by_hand)):
        number[span.slice] = len(labels)
        labels.append((PhaseKind.REST, None, None))
    for of, each in zip(axes, pressed, strict=True):
        for contact in each.contacts:
            number[contact.span.slice] = len(labels)
            labels.append((PhaseKind.CONTACT, of.axis.name, contact))
    moves = [
        move for span in motion.moving for piece in _pieces(span, number) for move in judge_moves(scene, span, piece)
    ]
    for piece, kind, axis in settle_moves(moves, log.period_s):
        number[piece.slice] = len(labels)
        labels.append((kind, axis, None))
    return tuple(_phase(span, *labels[index], log.period_s) for index, span in _runs(number))


def _rests(motion: MotionSpans, contacts: Sequence[Span]) -> tuple[Span, ...]:
    """Return the rests that are no part of a contact."""
    return tuple(s for s in motion.still if not any(c.start < s.stop and s.start < c.stop for c in contacts))


def _offset(force_S_n: FloatArray, free: Sequence[Span]) -> float:
    """Return by how much the force [N] may be off, from what it shows at rest without contact."""
    shown = [float(np.linalg.norm(np.median(force_S_n[span.slice], axis=0))) for span in free]
    return _OFFSET_FACTOR * float(np.median(shown)) + _SMALLEST_OFFSET_N if shown else np.inf


def _runs(number: IntArray) -> Iterator[tuple[int, Span]]:
    """Yield the stretches of equal numbers (n,)."""
    edges = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(number)]
    for start, stop in pairwise(edges):
        yield int(number[start]), Span(start=start, stop=stop)


def _phase(span: Span, kind: PhaseKind, axis: str | None, contact: ContactTimes | None, period_s: float) -> LogPhase:
    start, stop = span.start * period_s, span.stop * period_s
    if contact is None:
        return LogPhase(kind=kind, start_s=start, stop_s=stop, axis=axis)
    described = ContactPhase(
        onset_s=None if contact.onset is None else contact.onset * period_s,
        peak_s=contact.peak * period_s,
        peak_force_n=contact.peak_force_n,
        hold_s=None if not contact.is_held else (contact.hold.start * period_s, contact.hold.stop * period_s),
        release_s=None if contact.release is None else contact.release * period_s,
        bounces_s=tuple(left * period_s for left in contact.bounces),
        surface=None,
        hand_suspected=contact.hand_suspected,
    )
    return LogPhase(kind=kind, start_s=start, stop_s=stop, axis=axis, contact=described)


def _pieces(span: Span, number: IntArray) -> Iterator[Span]:
    """Yield what of a span is not labelled yet."""
    for part in spans_of(number[span.slice] == 0):
        yield Span(start=span.start + part.start, stop=span.start + part.stop)


def name_surfaces(phases: Sequence[LogPhase], axis: str, onsets_s: Sequence[Sequence[float]]) -> tuple[LogPhase, ...]:
    """Give the contacts of an axis the names of their surfaces, `x1` for the first one on axis x.

    `onsets_s` holds for each surface when it was touched, in s after the start of the log.
    """

    def surface(phase: LogPhase) -> str | None:
        within = [
            f"{axis}{index + 1}"
            for index, onsets in enumerate(onsets_s)
            if any(phase.start_s - _SAME_ONSET_S <= onset < phase.stop_s for onset in onsets)
        ]
        return within[0] if len(within) == 1 else None

    return tuple(
        replace(phase, contact=replace(phase.contact, surface=surface(phase)))
        if phase.contact is not None and phase.axis == axis
        else phase
        for phase in phases
    )
