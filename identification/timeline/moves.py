"""Causes of a motion: a hand, a command, a desired force, or none that the log shows."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import nnls

from problems.arrays import FloatArray

from ..payload.gravity import orientation_spread_rad
from ..result import PhaseKind
from ..signals.aligned import AlignedLog, Span, spans_of
from ..signals.recording import PoseSignal
from ..signals.segments import MotionSpans, low_pass, without_pauses, without_short
from .payload import AxisContacts, PayloadMotion, pushed, unexplained_share

_FOLLOWED_SHARE = 0.3
_SMALLEST_TRAVEL_M = 5e-4
_BAND_HZ = 8.0
_LAG_S = 0.05
_EVERY_S = 5e-3
_ROUNDS = 20
_WRENCH_DRIVEN = 0.5
_UNEXPLAINED = 0.5
_SHORTEST_S = 0.2
_FEWEST = 10
_FEWEST_FILTERED = 30
_STEPPED = 0.2
_TURNING_RAD = np.radians(2.0)
_ALONG_ONE_AXIS = 0.97
_UNEXPLAINED_SHARE = 0.5
_SHORTEST_PART_S = 0.5
_RESTING_M_S, _RESTING_S = 3e-5, 0.08


def is_hand_led(position_m: FloatArray, force_n: FloatArray, period_s: float, mass_kg: float, offset_n: float) -> bool:
    """Return whether the force does more work on the flange than the payload brought along, (n,) each.

    ∫ F dx ≤ ½ M_p v² at the start for a payload that nobody drives; `offset_n` is what the force at rest may be off.
    """
    if len(position_m) < 3:
        return False
    work = float(np.sum(force_n[:-1] * np.diff(position_m)))
    count = max(2, min(len(position_m), round(0.02 / period_s)))
    speed = float(position_m[count - 1] - position_m[0]) / ((count - 1) * period_s)
    travel = float(np.sum(np.abs(np.diff(position_m[:: max(1, round(0.02 / period_s))]))))
    return work > 0.5 * mass_kg * speed**2 + offset_n * travel


@dataclass(frozen=True, kw_only=True)
class FoundAdmittance:
    """M_a and B_a as the command shows them."""

    mass_kg: float
    damping_n_s_per_m: float


def find_admittance(command_m: FloatArray, force_n: FloatArray, period_s: float) -> FoundAdmittance | None:
    """Return the admittance that explains how the command moves, M_a a + B_a v = F + F^d, (n,) each; None if none.

    Changes over 50 ms below 8 Hz, fitted by least absolute deviations with M_a, B_a ≥ 0: F^d may step a few times. A
    passive payload that follows a program has the opposite sign, F = −M_p a − B_p v, and is not explained.
    """
    changes = _changes(command_m, force_n, period_s)
    if len(changes) < _FEWEST:
        return None
    rows, target = changes[:, :2], changes[:, 2]
    size = np.maximum(np.std(rows, axis=0), 1e-300)
    floor = 1e-3 * float(np.mean(np.abs(target))) + 1e-300
    weight, found, left = np.ones(len(target)), np.zeros(2), target
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found, _ = nnls(rows / size * root[:, None], target * root)
        left = target - rows / size @ found
        weight = 1.0 / np.maximum(np.abs(left), floor)
    # Where the force changes counts, and not where F^d steps.
    explained = np.abs(left) < _UNEXPLAINED * np.abs(target)
    if not np.sum(np.abs(target)[explained]) > _WRENCH_DRIVEN * np.sum(np.abs(target)):
        return None
    mass, damping = (found / size).tolist()
    return FoundAdmittance(mass_kg=mass, damping_n_s_per_m=damping)


def is_stepped(command_m: FloatArray, force_n: FloatArray, period_s: float, law: FoundAdmittance) -> bool:
    """Return whether all that drives the command through an admittance, beyond the force, is F^d that steps.

    M_a a + B_a v − F then changes at few instants and rests in between.
    """
    changes = _changes(command_m, force_n, period_s)
    if len(changes) < _FEWEST:
        return False
    desired = np.abs(changes @ np.array([law.mass_kg, law.damping_n_s_per_m, -1.0]))
    return bool(np.median(desired) < _STEPPED * np.mean(desired))


def _changes(command_m: FloatArray, force_n: FloatArray, period_s: float) -> FloatArray:
    """Return changes of acceleration, speed and force over 50 ms, (m, 3), every 5 ms."""
    if len(command_m) < max(_FEWEST_FILTERED, _SHORTEST_S / period_s):
        return np.zeros((0, 3))
    velocity = np.gradient(low_pass(command_m - command_m[0], period_s, _BAND_HZ), period_s)
    signals = np.column_stack([np.gradient(velocity, period_s), velocity, low_pass(force_n, period_s, _BAND_HZ)])
    lag, every = max(1, round(_LAG_S / period_s)), max(1, round(_EVERY_S / period_s))
    return np.asarray((signals[lag:] - signals[:-lag])[::every])


def follows(command_m: FloatArray, position_m: FloatArray) -> bool:
    """Return whether the command moves as far as to explain the flange's motion, (n,) each."""
    moved = float(np.std(command_m))
    return moved > _SMALLEST_TRAVEL_M and moved > _FOLLOWED_SHARE * float(np.std(position_m))


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What judging a motion needs: `rests` without contact, and by how much the force may be off."""

    log: AlignedLog
    motion: MotionSpans
    force_S_n: FloatArray
    axes: Sequence[AxisContacts]
    payloads: Sequence[PayloadMotion]
    command: PoseSignal | None
    mass_kg: float
    offset_n: float
    rests: tuple[Span, ...]


@dataclass(frozen=True, kw_only=True)
class Move:
    """A piece of motion; `law` is the admittance that drives its command, `signals` command and force without one."""

    piece: Span
    kind: PhaseKind
    axis: str | None
    law: FoundAdmittance | None = None
    signals: tuple[FloatArray, FloatArray] | None = None


def judge_moves(scene: Scene, span: Span, piece: Span) -> list[Move]:
    """Return what a piece of a moving span is, cut where a hand comes or goes and where the command rests.

    Parts of it are judged by themselves: who pushed before says nothing of what moves the payload now.
    """
    parts = _by_cause(scene, span, piece)
    if len(parts) == 1:
        return [_judge_move(scene, span, piece, _group(scene, piece))]
    return [_judge_move(scene, span, part, part) for part in parts]


def _by_cause(scene: Scene, span: Span, piece: Span) -> list[Span]:
    """Cut a piece at every change between half a second or more with and without a push, and in the command's rests."""
    log, shortest = scene.log, round(_SHORTEST_PART_S / scene.log.period_s)
    mover = next((i for i, of in enumerate(scene.axes) if span in of.axis.spans), None)
    if mover is None or orientation_spread_rad(log.orientation_BS[piece.slice]) > _TURNING_RAD:
        return [piece]
    by_hand = without_pauses(pushed(scene.axes[mover], scene.payloads[mover], piece, log.period_s), shortest)
    edges = {0, len(piece), *(np.flatnonzero(np.diff(without_short(by_hand, shortest).astype(int))) + 1).tolist()}
    command = _command(scene, piece)
    if command is not None:
        steps = np.linalg.norm(np.diff(command, axis=0, prepend=command[:1]), axis=1)
        rests = spans_of(without_short(steps < _RESTING_M_S * log.period_s, round(_RESTING_S / log.period_s)))
        edges |= {(rest.start + rest.stop) // 2 for rest in rests}
    cuts = [0]
    for edge in sorted(edges):
        if edge - cuts[-1] >= shortest and (len(piece) - edge >= shortest or edge == len(piece)):
            cuts.append(int(edge))
    return [Span(start=piece.start + a, stop=piece.start + b) for a, b in pairwise(cuts)] or [piece]


def _judge_move(scene: Scene, span: Span, piece: Span, group: Span) -> Move:
    """Return what a piece of a moving span is, and the axis that it goes along; `group` shows the admittance."""
    log = scene.log
    mover = next((i for i, of in enumerate(scene.axes) if span in of.axis.spans), None)
    if orientation_spread_rad(log.orientation_BS[piece.slice]) > _TURNING_RAD:
        return Move(piece=piece, kind=PhaseKind.TURNING, axis=None if mover is None else scene.axes[mover].axis.name)
    velocity = scene.motion.velocity_S_m_s[piece.slice]
    _, directions = np.linalg.eigh(velocity.T @ velocity)
    direction_S = directions[:, -1]
    index = int(np.argmax(np.abs(direction_S)))
    axis = "xyz"[index] if abs(direction_S[index]) > _ALONG_ONE_AXIS else None
    direction_B = log.orientation_BS[(piece.start + piece.stop) // 2].apply(direction_S)
    origin = log.position_B_m[piece.start]
    position = (log.position_B_m[group.slice] - origin) @ direction_B
    force = scene.force_S_n[group.slice] @ direction_S
    mine = slice(piece.start - group.start, piece.stop - group.start)
    command = _command(scene, group)
    commanded = None if command is None else (command - origin) @ direction_B
    is_followed = commanded is not None and follows(commanded[mine], position[mine])
    law = find_admittance(commanded, force, log.period_s) if commanded is not None and is_followed else None
    move = Move(piece=piece, kind=PhaseKind.FREE_MOTION, axis=axis, law=law)
    if is_hand_led(position[mine], force[mine], log.period_s, scene.mass_kg, scene.offset_n):
        return replace(move, kind=PhaseKind.HAND_LED_MOTION)
    if mover is not None:
        of, payload = scene.axes[mover], scene.payloads[mover]
        if unexplained_share(of, payload, piece, log.period_s) > _UNEXPLAINED_SHARE:
            return replace(move, kind=PhaseKind.UNKNOWN, law=None)
    if commanded is None or not is_followed or law is not None:
        return move
    return replace(move, kind=PhaseKind.COMMANDED_MOTION, signals=(commanded, force))


def settle_moves(moves: Sequence[Move], period_s: float) -> Iterator[tuple[Span, PhaseKind, str | None]]:
    """Yield the moves; where other moves show the admittance, one that a desired force alone drives is free too."""
    laws = [move.law for move in moves if move.law is not None]
    middle = sorted(laws, key=lambda law: law.damping_n_s_per_m)[len(laws) // 2] if laws else None
    for move in moves:
        kind = move.kind
        if kind is PhaseKind.COMMANDED_MOTION and middle is not None and move.signals is not None:
            kind = PhaseKind.FREE_MOTION if is_stepped(*move.signals, period_s, middle) else kind
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
