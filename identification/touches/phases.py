"""Phases of a log without the payload's mass: touches, motion that a force leads, free motion, and rests."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from ..result import ContactPhase, Finding, LogPhase, PhaseKind, Touch, TouchCause
from ..signals.segments import without_pauses, without_short
from .find import BEFORE_S, AxisTouches
from .signals import mean_speed

_MOVING_M_S = 1e-3
_SHORTEST_S = 0.2


def build_phases(found: Sequence[AxisTouches], touches: Sequence[Touch]) -> tuple[LogPhase, ...]:
    """Label a log from its start to its end, each instant once.

    Of touches at one time the harder one counts, and all are in `touches`; what is neither moving nor pressing is a
    rest, motion without force but that of the payload's own mass is free, or turning; what a force leads along is led
    by a hand; the rest is unknown.
    """
    if not found:
        return ()
    time, period = found[0].signals.time_s, found[0].signals.period_s
    travel = np.column_stack([np.nan_to_num(each.signals.travel_m) for each in found])
    speed = np.linalg.norm(mean_speed(travel, time), axis=1)
    pressed = np.any([np.abs(each.signals.force_n) > each.signals.level_n for each in found], axis=0)
    shortest = max(1, round(_SHORTEST_S / period))
    number = np.zeros(len(time), dtype=np.int64)
    labels: list[tuple[PhaseKind, str | None, Touch | None]] = [(PhaseKind.UNKNOWN, None, None)]
    moving = speed > _MOVING_M_S
    for mask, kind in ((~moving & ~pressed, PhaseKind.REST), (moving & ~pressed, PhaseKind.FREE_MOTION)):
        number[without_short(np.asarray(mask), shortest)] = len(labels)
        labels.append((kind, None, None))
    for kind, own in (
        (PhaseKind.FREE_MOTION, [span for each in found for span in each.inert]),
        (PhaseKind.TURNING, [span for each in found for span in each.turned]),
    ):
        mask = np.zeros(len(time), dtype=np.bool_)
        for span in own:
            mask[span.slice] = True
        # Where such a force changes its sign it is below the level for a while.
        number[without_pauses(mask, shortest)] = len(labels)
        labels.append((kind, None, None))
    hands = len(labels)
    for each in found:
        for span in each.led:
            number[span.slice] = hands
    labels.append((PhaseKind.HAND_LED_MOTION, None, None))
    spans = {(each.signals.axis, one.touch.peak_s): one.felt for each in found for one in each.touches}
    for touch in sorted(touches, key=lambda touch: touch.peak_force):
        if touch.cause is not TouchCause.HAND:
            number[spans[touch.axis, touch.peak_s].slice] = len(labels)
            labels.append((PhaseKind.CONTACT, touch.axis, touch))
    edges = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(number)]
    end = float(time[-1]) + period
    return tuple(
        _phase(*labels[int(number[start])], float(time[start]), float(time[stop]) if stop < len(time) else end)
        for start, stop in pairwise(edges)
    )


def _phase(kind: PhaseKind, axis: str | None, touch: Touch | None, start_s: float, stop_s: float) -> LogPhase:
    if touch is None:
        return LogPhase(kind=kind, start_s=start_s, stop_s=stop_s)
    contact = ContactPhase(
        onset_s=touch.onset_s,
        peak_s=touch.peak_s,
        peak_force_n=touch.peak_force,
        hold_s=touch.hold_s,
        release_s=touch.release_s,
        bounces_s=touch.bounces_s,
        surface=touch.surface,
        hand_suspected=None if touch.cause is TouchCause.UNDETERMINED else bool(touch.is_led),
    )
    return LogPhase(kind=kind, start_s=start_s, stop_s=stop_s, axis=axis, contact=contact)


def about_led_walls(axis: AxisTouches) -> list[Finding]:
    """Say of walls into which a hand led what of their force the sensor shows: the wall's less that of the hand.

    Both act on the payload; how hard the hand led is the largest force along the motion within 0.3 s before the touch.
    """
    shown = []
    for each in axis.touches:
        if each.touch.cause is not TouchCause.WALL or not each.touch.is_led:
            continue
        signals, start = axis.signals, each.span.start
        first = int(np.searchsorted(signals.time_s, signals.time_s[start] - BEFORE_S))
        led = float(np.max(each.touch.sign * signals.force_n[first : start + 1], initial=0.0))
        shown.append(f"{each.touch.peak_s:.2f} s ({each.touch.peak_force:.1f} N, led with up to {led:.1f} N)")
    if not shown:
        return []
    return [
        Finding.warning(
            "wall-beside-hand",
            f"Axis {axis.signals.axis}: a hand led the payload into what was touched at {', '.join(shown)}. The sensor "
            "shows the wall's force less what the hand pushes, so these are no peaks of the wall: its force may be "
            "larger by up to what the hand led with.",
            "Approach under a desired force or a command, hands off, to measure a peak.",
        )
    ]
