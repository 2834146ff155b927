"""Motion without contact: who leads it, and along which axis."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..payload.gravity import orientation_spread_rad
from ..phases import Kind
from ..signals.aligned import AlignedLog, Span
from ..signals.recording import PoseSignal
from ..signals.segments import Motion
from .motion import Admittance, find_admittance, follows, is_hand_led, is_stepped
from .payload import AxisContacts, Payload, unexplained_share

FloatArray = NDArray[np.float64]

_TURNING_RAD = np.radians(2.0)
_ALONG_ONE_AXIS = 0.97
_UNEXPLAINED_SHARE = 0.5


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What judging a motion needs: `rests` without contact, and by how much the force may be off."""

    log: AlignedLog
    motion: Motion
    force_S_n: FloatArray
    axes: Sequence[AxisContacts]
    payloads: Sequence[Payload]
    command: PoseSignal | None
    mass_kg: float
    offset_n: float
    rests: tuple[Span, ...]


@dataclass(frozen=True, kw_only=True)
class Move:
    """A piece of motion; `law` is the admittance that drives its command, `signals` command and force without one."""

    piece: Span
    kind: Kind
    axis: str | None
    law: Admittance | None = None
    signals: tuple[FloatArray, FloatArray] | None = None


def judge_move(scene: Scene, span: Span, piece: Span) -> Move:
    """Tell what a piece of a moving span is, and the axis that it goes along."""
    log = scene.log
    mover = next((i for i, of in enumerate(scene.axes) if span in of.axis.spans), None)
    if orientation_spread_rad(log.orientation_BS[piece.slice]) > _TURNING_RAD:
        return Move(piece=piece, kind=Kind.TURNING, axis=None if mover is None else scene.axes[mover].axis.name)
    velocity = scene.motion.velocity_S_m_s[piece.slice]
    _, directions = np.linalg.eigh(velocity.T @ velocity)
    direction_S = directions[:, -1]
    index = int(np.argmax(np.abs(direction_S)))
    axis = "xyz"[index] if abs(direction_S[index]) > _ALONG_ONE_AXIS else None
    direction_B = log.orientation_BS[(piece.start + piece.stop) // 2].apply(direction_S)
    group = _group(scene, piece)
    origin = log.position_B_m[piece.start]
    position = (log.position_B_m[group.slice] - origin) @ direction_B
    force = scene.force_S_n[group.slice] @ direction_S
    mine = slice(piece.start - group.start, piece.stop - group.start)
    command = _command(scene, group)
    commanded = None if command is None else (command - origin) @ direction_B
    is_followed = commanded is not None and follows(commanded[mine], position[mine])
    law = find_admittance(commanded, force, log.period_s) if commanded is not None and is_followed else None
    move = Move(piece=piece, kind=Kind.FREE_MOTION, axis=axis, law=law)
    if is_hand_led(position[mine], force[mine], log.period_s, scene.mass_kg, scene.offset_n):
        return replace(move, kind=Kind.HAND_LED_MOTION)
    if mover is not None:
        of, payload = scene.axes[mover], scene.payloads[mover]
        if unexplained_share(of, payload, piece, log.period_s) > _UNEXPLAINED_SHARE:
            return replace(move, kind=Kind.UNKNOWN, law=None)
    if commanded is None or not is_followed or law is not None:
        return move
    return replace(move, kind=Kind.COMMANDED_MOTION, signals=(commanded, force))


def settle_moves(moves: Sequence[Move], period_s: float) -> Iterator[tuple[Span, Kind, str | None]]:
    """Yield the moves; where other moves tell the admittance, one that a desired force alone drives is free too."""
    laws = [move.law for move in moves if move.law is not None]
    middle = sorted(laws, key=lambda law: law.damping_n_s_per_m)[len(laws) // 2] if laws else None
    for move in moves:
        kind = move.kind
        if kind is Kind.COMMANDED_MOTION and middle is not None and move.signals is not None:
            kind = Kind.FREE_MOTION if is_stepped(*move.signals, period_s, middle) else kind
        yield move.piece, kind, move.axis


def _group(scene: Scene, piece: Span) -> Span:
    """Return all that belongs to one motion, contacts too: from rest to rest, or up to a hole."""
    bounds = [(s.start, s.stop) for s in (*scene.rests, *scene.log.holes)]
    start = max([0, *(stop for _, stop in bounds if stop <= piece.start)])
    return Span(start=start, stop=min([len(scene.log), *(begin for begin, _ in bounds if begin >= piece.stop)]))


def _command(scene: Scene, span: Span) -> FloatArray | None:
    """Return the commanded position (n, 3) over a span, None where it is not covered."""
    if scene.command is None:
        return None
    stamps = scene.command.stamp_ns
    first, last = scene.log.start_ns + np.round(scene.log.time_s[[span.start, span.stop - 1]] * 1e9).astype(np.int64)
    begin, end = int(np.searchsorted(stamps, first, side="right")) - 1, int(np.searchsorted(stamps, last)) + 1
    if begin < 0 or end > len(stamps):
        return None
    time = (stamps[begin:end] - scene.log.start_ns) * 1e-9
    at = scene.log.time_s[span.slice]
    position = scene.command.position_m[begin:end]
    return np.column_stack([np.interp(at, time, column) for column in position.T])
