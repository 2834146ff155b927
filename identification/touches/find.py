"""Touches of a log: when something pressed, how fast it was met, how hard, and whether it was a wall or a hand."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import BoolArray, FloatArray

from ..result import Blow, Touch, TouchCause
from ..signals.aligned import Span, spans_of
from ..signals.contact_rule import CONTACT
from ..signals.segments import without_pauses, without_short
from .peak import bound_peak, is_withdrawn
from .signals import AxisSignals

_APPROACH_S, _SHORTEST_APPROACH_S = 0.1, 0.02
SMALLEST_SPEED_M_S = 2e-3
STILL_M_S = 1e-3
BEFORE_S, _SKIPPED_S = 0.3, 0.015
_QUIET_S, _RISING_SAMPLES = 1.0, 2
_FEWEST_SECONDS, _QUIET_SHARE = 8, 0.2
# What pushes the flange back this far, beside how far it went in, does work on it: no surface.
_DRIVEN_M = 5e-3
_SMALLEST_TRAVEL_M = 5e-4
# An admittance without a hand moves at F^d/B_a; lag and drag of a robot leave less than this open.
_SPEED_SHARE = 0.3
# A hand turns its force round within about a tenth of a second: slower is steering, much faster is no hand.
_TURNED_S = 0.2
_SMALLEST_STEP_N = 10.0
_STEERING_N_PER_S = 100.0
_FASTEST_HAND_N_PER_S = 1500.0
_ENTERED_SHARE = 0.1
_FALLEN_SHARE = 0.5
_ACROSS_SHARE = 0.5
_AGAINST_SHARE = 0.25
_LEFT_SHARE, _HELD_SHARE = 0.1, 0.5
_FELT_SHARE, _USUAL_SHARE, _ABOVE_NOISE = 0.25, 0.75, 3.0
_BLOW_SHARE, _RETURN_SAMPLES = 0.2, 3


@dataclass(frozen=True, kw_only=True)
class FoundTouch:
    """A touch, the samples above the axis' level, those in which it is felt, and which of them is the peak."""

    touch: Touch
    span: Span
    felt: Span
    peak: int


@dataclass(frozen=True, kw_only=True)
class AxisTouches:
    """What happens on one axis: the touches, and the `led` spans in which a force moves the flange along with it.

    In `inert` and `turned` spans the force is what the payload itself makes, moved along the axis or in a tool that
    turns.
    """

    signals: AxisSignals
    touches: tuple[FoundTouch, ...]
    led: tuple[Span, ...]
    inert: tuple[Span, ...] = ()
    turned: tuple[Span, ...] = ()


def find_touches(axes: tuple[AxisSignals, ...], *, is_contact: bool = False) -> tuple[AxisTouches, ...]:
    """Find the touches of every axis; with `is_contact` the log is declared to be one contact.

    A force touches where it presses against the motion: what is met at more than 2 mm/s without any force right before
    is a wall where the approach was as fast as F^d/B_a (or its gains are not known), unless it then drives the flange
    back. A force along the motion that turns round on the way is a wall only where it turns faster than a hand can, and
    undetermined where a hand could, as is a force without motion. What moves the flange along with it is a hand that
    leads, and no touch.
    """
    free = without_force(axes)
    return _of_their_own([_on_axis(axis, free, is_contact=is_contact) for axis in axes])


def _of_their_own(found: Sequence[AxisTouches]) -> tuple[AxisTouches, ...]:
    """Leave out what is a part of something larger on another axis at that time.

    A touch beside a larger one is its share across, and a force without motion beside a hand that leads is that hand's,
    unless it comes faster than a hand steers.
    """
    kept = []
    for each in found:
        beside = [touch for other in found if other is not each for touch in other.touches]
        hands = [span for other in found for span in other.led]
        swing = round(CONTACT.longest_swing_s / each.signals.period_s)
        touches = [
            one
            for one in each.touches
            if not any(_is_share(one, other) for other in beside)
            and not (
                one.touch.is_led is None
                and any(one.span.start < hand.stop + swing and hand.start - swing < one.span.stop for hand in hands)
                and not _is_sudden(each.signals, one)
            )
        ]
        kept.append(AxisTouches(signals=each.signals, touches=tuple(touches), led=each.led))
    return tuple(kept)


def _is_share(one: FoundTouch, other: FoundTouch) -> bool:
    """Return whether a touch is what another one, of another axis, does across."""
    is_within = other.span.start - 2 <= one.peak < other.span.stop + 2
    return is_within and one.touch.peak_force < _ACROSS_SHARE * other.touch.peak_force


def _is_sudden(axis: AxisSignals, one: FoundTouch) -> bool:
    """Return whether a force comes faster than a hand steers, or lasts while the hand holds against it."""
    if one.touch.hold_s is not None:
        return True
    rate, step = _turned_round(axis, one.touch.sign, one.peak)
    return step >= _SMALLEST_STEP_N and rate >= _STEERING_N_PER_S


def without_force(axes: tuple[AxisSignals, ...]) -> BoolArray:
    """Return where no axis shows a force (n,)."""
    return np.asarray(np.all([np.abs(axis.force_n) <= axis.level_n for axis in axes], axis=0), dtype=np.bool_)


def _on_axis(axis: AxisSignals, free: BoolArray, *, is_contact: bool) -> AxisTouches:
    touches: list[FoundTouch] = []
    led: list[Span] = []
    speed = axis.speed_m_s()
    for sign in _deeper_side(axis) if is_contact else (-1, 1):
        pressing = -sign * axis.force_n
        longest = round(CONTACT.longest_bounce_s / axis.period_s)
        swing = max(1, round(CONTACT.longest_swing_s / axis.period_s))
        presses = list(find_presses(pressing, axis.level_n, longest, swing))
        felt = presses if is_contact else _felt(axis, pressing, presses, swing)
        for span, around in zip(presses, felt, strict=True):
            judged = _judge(axis, sign, span, free, is_contact=is_contact)
            if judged is not None:
                left = span.stop if is_contact else _left_at(axis, sign, span)
                touches.append(_described(axis, sign, Span(start=span.start, stop=left), around, judged))
                if left < span.stop:
                    led.append(Span(start=left, stop=span.stop))
                continue
            for part, is_still in _parts(span, speed, axis.period_s):
                if is_still:
                    touches.append(_described(axis, sign, part, around, (TouchCause.UNDETERMINED, None)))
                elif len(part) >= swing:
                    led.append(part)
    return AxisTouches(signals=axis, touches=tuple(sorted(touches, key=lambda each: each.span.start)), led=tuple(led))


def _left_at(axis: AxisSignals, sign: int, span: Span) -> int:
    """Return when the flange is driven back for good from where it was met: no surface goes along with it."""
    into = sign * (axis.travel_m[span.slice] - axis.travel_m[span.start])
    near = np.flatnonzero(into >= -_SMALLEST_TRAVEL_M)
    rest = Span(start=span.start + int(near[-1]) + 1, stop=span.stop) if near.size else span
    is_held = not near.size or (len(rest) > 0 and find_hold(axis, -sign * axis.force_n, rest) is not None)
    return span.stop if is_held else rest.start


def _felt(axis: AxisSignals, pressing: FloatArray, presses: Sequence[Span], swing: int) -> list[Span]:
    """Return each press from where the force leaves what is usual below the level until it is back there."""
    level, small = axis.level_n, np.abs(pressing[np.abs(pressing) <= axis.level_n])
    common = float(np.quantile(small, _USUAL_SHARE)) + _ABOVE_NOISE * axis.noise_n if small.size else 0.0
    usual = max(_FELT_SHARE * level, common)
    ends = [0, *(edge for span in presses for edge in (span.start, span.stop)), len(pressing)]
    found = []
    for i, span in enumerate(presses):
        highest = float(np.max(pressing[span.slice]))
        least = min(level, max(usual, _ENTERED_SHARE * highest))
        outside = np.flatnonzero(~without_pauses(np.asarray(pressing > least), swing))
        # What little there is before the first blow is not its beginning.
        blow = span.start + int(np.argmax(pressing[span.slice] >= _BLOW_SHARE * highest))
        before, after = outside[outside < blow], outside[outside >= span.stop]
        start = int(before[-1]) + 1 if before.size else 0
        stop = int(after[0]) if after.size else len(pressing)
        found.append(Span(start=max(start, ends[2 * i]), stop=min(stop, ends[2 * i + 3])))
    return found


def _deeper_side(axis: AxisSignals) -> tuple[int, ...]:
    """Return the side on which a trace of a contact goes farther in."""
    if not np.all(np.isfinite(axis.travel_m)):
        return ()
    return (1,) if np.max(axis.travel_m) >= -np.min(axis.travel_m) else (-1,)


def find_presses(pressing: FloatArray, level: float, longest: int, swing: int) -> Iterator[Span]:
    """Yield the presses; a force the other way in between parts them where it is no short swing after a blow."""
    touched = np.asarray(pressing > level)
    joined = without_pauses(touched, longest)
    against = without_short(np.asarray(pressing < -level), swing)
    smallest = max(CONTACT.smallest_trace_peak_n, CONTACT.peak_levels * level)
    for span in spans_of(np.asarray(joined & ~against)):
        inside = np.flatnonzero(touched[span.slice])
        if inside.size and float(np.max(pressing[span.slice])) > smallest:
            yield Span(start=span.start + int(inside[0]), stop=span.start + int(inside[-1]) + 1)


def _parts(span: Span, speed: FloatArray, period_s: float) -> Iterator[tuple[Span, bool]]:
    """Yield a span in parts that move and parts that rest."""
    still = without_short(
        np.asarray(np.abs(speed[span.slice]) < STILL_M_S), max(1, round(CONTACT.shortest_rest_s / period_s))
    )
    for mask, is_still in ((still, True), (~still, False)):
        for part in spans_of(np.asarray(mask)):
            yield Span(start=span.start + part.start, stop=span.start + part.stop), is_still


def approach_speed(axis: AxisSignals, onset: int, sign: int, over_s: float = _APPROACH_S) -> float | None:
    """Return how fast the flange goes towards what it touches, by least squares over `over_s` before the onset [m/s].

    A trace that begins with the contact shows it in its first 20 ms; None where the log shows neither.
    """
    start = int(np.searchsorted(axis.time_s, axis.time_s[onset] - over_s))
    window = slice(start, onset + 1)
    if axis.time_s[onset] - axis.time_s[start] < _SHORTEST_APPROACH_S:
        window = slice(start, max(start + 4, int(np.searchsorted(axis.time_s, axis.time_s[start] + 0.02)) + 1))
    time, travel = axis.time_s[window], axis.travel_m[window]
    if len(time) < 3 or not np.all(np.isfinite(travel)):
        return None
    return sign * float(np.polyfit(time - time[0], travel - travel[0], 1)[0])


def _judge(
    axis: AxisSignals, sign: int, span: Span, free: BoolArray, *, is_contact: bool
) -> tuple[TouchCause, bool | None] | None:
    """Return the cause of a press and whether a hand led into it, None where the force moves the flange along."""
    if is_contact:
        return TouchCause.WALL, None
    speed = approach_speed(axis, span.start, sign)
    if speed is None:
        return TouchCause.UNDETERMINED, None
    into = sign * (axis.travel_m[span.slice] - axis.travel_m[span.start])
    if speed < SMALLEST_SPEED_M_S:
        return None if float(np.min(into)) < -_SMALLEST_TRAVEL_M else (TouchCause.UNDETERMINED, None)
    window = _just_before(axis, span.start)
    if window.stop > window.start and bool(np.all(free[window])):
        return _met_free(axis, span, sign, into), False
    cause = _met_led(axis, sign, span)
    return None if cause is None else (cause, True)


def _met_free(axis: AxisSignals, span: Span, sign: int, into: FloatArray) -> TouchCause:
    """Return the cause of a press before which there is drag at most; `into` (n,) is how far the flange goes.

    A hand presses all the way back; a payload that swings while the flange is taken off a wall presses to and fro.
    """
    deepest = int(np.argmax(into))
    beyond = deepest + np.flatnonzero(into[deepest:] < 0.0)
    pressing = -sign * axis.force_n[span.slice]
    if float(np.min(into[deepest:])) < -_DRIVEN_M and float(np.median(pressing[beyond])) > axis.level_n:
        return TouchCause.HAND
    return TouchCause.WALL if is_driven_by_desired(axis, span.start, sign) else TouchCause.UNDETERMINED


def _met_led(axis: AxisSignals, sign: int, span: Span) -> TouchCause | None:
    """Return the cause of a press after a force along the motion, None where a hand steers."""
    pressing = -sign * axis.force_n
    stop = max(span.start + 1, int(np.searchsorted(axis.time_s, axis.time_s[span.start] + _TURNED_S)))
    high = span.start + int(np.argmax(pressing[span.start : stop]))
    rate, step = _turned_round(axis, sign, high)
    if pressing[high] < _AGAINST_SHARE * step or step < _SMALLEST_STEP_N or rate < _STEERING_N_PER_S:
        return None
    return TouchCause.WALL if rate > _FASTEST_HAND_N_PER_S else TouchCause.UNDETERMINED


def desired_speed(axis: AxisSignals, onset: int) -> float | None:
    """Return F^d/B_a [m/s], None where one of them is not known or F^d is zero."""
    damping, desired = float(axis.damping_n_s_per_m[onset]), float(axis.desired_n[onset])
    is_known = bool(np.isfinite(damping) and np.isfinite(desired) and damping > 0.0 and desired != 0.0)
    return desired / damping if is_known else None


def is_driven_by_desired(axis: AxisSignals, onset: int, sign: int, *, turned: float = 1.0) -> bool:
    """Return whether the approach is as fast as (F^d + F)/B_a, true where one of them is not known or F^d is zero."""
    asked, speed = desired_speed(axis, onset), approach_speed(axis, onset, sign)
    if asked is None or speed is None:
        return True
    before = axis.force_n[_just_before(axis, onset)]
    drag = float(np.median(before)) if before.size else 0.0
    driven = sign * (turned * asked + drag / float(axis.damping_n_s_per_m[onset]))
    return abs(speed - driven) <= _SPEED_SHARE * abs(driven)


def _just_before(axis: AxisSignals, onset: int) -> slice:
    """Return the samples from 0.3 s to 15 ms before the onset."""
    return slice(
        int(np.searchsorted(axis.time_s, axis.time_s[onset] - BEFORE_S)),
        max(1, int(np.searchsorted(axis.time_s, axis.time_s[onset] - _SKIPPED_S))),
    )


def _turned_round(axis: AxisSignals, sign: int, high: int) -> tuple[float, float]:
    """Return how fast [N/s] and by how much [N] the force turns towards pressing until the sample `high`."""
    pressing = -sign * axis.force_n
    begin = int(np.searchsorted(axis.time_s, axis.time_s[high] - _TURNED_S))
    low = begin + int(np.argmin(pressing[begin : high + 1]))
    step = float(pressing[high] - pressing[low])
    # The last instant at which the force was still as it had been before is where it began to turn.
    last = low + int(np.flatnonzero(pressing[low : high + 1] <= pressing[low] + _ENTERED_SHARE * step)[-1])
    return step / max(float(axis.time_s[high] - axis.time_s[last]), axis.period_s), step


def _described(
    axis: AxisSignals, sign: int, span: Span, around: Span, judged: tuple[TouchCause, bool | None]
) -> FoundTouch:
    """Return a press, from and until when it is felt: `around` a still part of it, that part alone."""
    cause, is_led = judged
    hold = find_hold(axis, -sign * axis.force_n, span)
    found = describe_touch(axis, sign, span, hold=hold, cause=cause, is_led=is_led)
    presses = np.flatnonzero(-sign * axis.force_n[around.start : around.stop] > axis.level_n) + around.start
    felt = Span(
        start=around.start if span.start <= presses[0] else span.start,
        stop=around.stop if span.stop > presses[-1] else span.stop,
    )
    ends = felt.stop >= len(axis.time_s) - 1
    touch = replace(
        found.touch,
        onset_s=float(axis.time_s[felt.start]),
        release_s=None if ends else float(axis.time_s[felt.stop]),
    )
    return replace(found, touch=touch, felt=felt)


def describe_touch(
    axis: AxisSignals, sign: int, span: Span, *, hold: Span | None, cause: TouchCause, is_led: bool | None
) -> FoundTouch:
    """Return what the samples of a span show of the touch that it is."""
    pressing = -sign * axis.force_n
    inside = pressing[span.slice]
    peak = span.start + int(np.argmax(inside))
    low, high, rise = touch_peak(axis, pressing, span.start, peak)
    held = None if hold is None else float(np.median(pressing[hold.slice]))
    left = max(
        axis.level_n,
        min(
            _LEFT_SHARE * (float(pressing[peak]) if high is None else high),
            np.inf if held is None else _HELD_SHARE * held,
        ),
    )
    apart = without_short(np.asarray(inside <= left), max(1, round(CONTACT.shortest_bounce_s / axis.period_s)))
    last = span.stop >= len(axis.time_s) - 1

    def at(values: FloatArray) -> float | None:
        value = float(values[span.start])
        return value if np.isfinite(value) else None

    touch = Touch(
        axis=axis.axis,
        sign=sign,
        cause=cause,
        peak_s=float(axis.time_s[peak]),
        peak_force=float(pressing[peak]),
        onset_s=float(axis.time_s[span.start]),
        release_s=None if last else float(axis.time_s[span.stop]),
        hold_s=None if hold is None else (float(axis.time_s[hold.start]), float(axis.time_s[hold.stop - 1])),
        bounces_s=tuple(float(axis.time_s[span.start + gap.start]) for gap in spans_of(apart)),
        later_blows=tuple(_later_blows(axis, sign, span, [gap.stop for gap in spans_of(apart)], peak))
        if cause is TouchCause.WALL
        else (),
        peak_interval=(low, high),
        rise_samples=rise,
        approach_speed=_stated_speed(approach_speed(axis, span.start, sign), cause),
        impulse=_impulse(axis, pressing, span),
        held_force=held,
        is_led=is_led,
        is_withdrawn=hold is None and not is_led and is_withdrawn(axis, sign, span.start, peak, span.stop),
        mass=at(axis.mass_kg),
        damping=at(axis.damping_n_s_per_m),
        lead_s=axis.lead_s,
        desired_force=at(axis.desired_n),
        sample_period_s=axis.period_s,
    )
    return FoundTouch(touch=touch, span=span, felt=span, peak=peak)


def _stated_speed(speed: float | None, cause: TouchCause) -> float | None:
    """Return the speed of an approach, None where the flange does not go towards what presses."""
    least = 0.0 if cause is TouchCause.WALL else SMALLEST_SPEED_M_S
    return speed if speed is not None and speed > least else None


def _later_blows(axis: AxisSignals, sign: int, span: Span, returns: Sequence[int], peak: int) -> Iterator[Blow]:
    """Yield the blows with which a payload comes back at `returns`, samples of the span: those as large as to count."""
    pressing = -sign * axis.force_n
    over_s, least = max(_SHORTEST_APPROACH_S, _RETURN_SAMPLES * axis.period_s), _BLOW_SHARE * float(pressing[peak])
    for begin, end in zip(returns, [*returns[1:], len(span)][: len(returns)], strict=True):
        onset, stop = span.start + begin, span.start + end
        # What little there is before the first blow makes that no later one.
        if onset >= stop or onset <= peak < stop or float(np.max(pressing[span.start : onset], initial=0.0)) < least:
            continue
        top = onset + int(np.argmax(pressing[onset:stop]))
        speed = approach_speed(axis, onset, sign, over_s)
        if speed is None or speed < SMALLEST_SPEED_M_S or pressing[top] < least:
            continue
        low, high, _ = touch_peak(axis, pressing, onset, top)
        yield Blow(
            onset_s=float(axis.time_s[onset]),
            peak_s=float(axis.time_s[top]),
            peak_force=float(pressing[top]),
            approach_speed=speed,
            peak_interval=(low, high),
        )


def touch_peak(axis: AxisSignals, pressing: FloatArray, onset: int, peak: int) -> tuple[float, float | None, int]:
    """Return `bound_peak` of a touch, its noise from a quiet second of the log, or from what is before the onset.

    What the payload's motion adds is force on the sensor: no noise, and the largest of it right before a contact.
    """
    length = round(_QUIET_S / axis.period_s)
    seconds = pressing[: len(pressing) // length * length].reshape(-1, length)
    spread = np.std(seconds, axis=1)
    order = np.argsort(spread)[int(np.count_nonzero(spread <= 0.0)) :]
    if len(order) >= _FEWEST_SECONDS:
        quiet = seconds[order[int(_QUIET_SHARE * len(order))]]
    else:
        begin = int(np.searchsorted(axis.time_s, axis.time_s[onset] - _QUIET_S))
        quiet = pressing[begin : max(begin, onset - _RISING_SAMPLES)]
    return bound_peak(pressing, onset, peak, quiet=quiet, noise=axis.noise_n)


def find_hold(axis: AxisSignals, pressing: FloatArray, span: Span) -> Span | None:
    """Return the longest rest under force."""
    still = np.asarray((np.abs(axis.speed_m_s()[span.slice]) < STILL_M_S) & (pressing[span.slice] > axis.level_n))
    found = spans_of(without_short(still, max(1, round(CONTACT.shortest_rest_s / axis.period_s))))
    if not found:
        return None
    longest = max(found, key=len)
    return Span(start=span.start + longest.start, stop=span.start + longest.stop)


def _impulse(axis: AxisSignals, pressing: FloatArray, span: Span) -> float | None:
    """Return ∫F dt of the first blow [N·s], None where what presses does not let off."""
    fallen = first_fall(pressing[span.slice], axis.level_n)
    if fallen is None:
        return None
    blow = slice(max(0, span.start - 1), span.start + fallen + 1)
    return float(np.trapezoid(np.maximum(pressing[blow], 0.0), axis.time_s[blow]))


def first_fall(pressing: FloatArray, level: float) -> int | None:
    """Return the first sample at which a force (n,) has fallen to half of what it had reached, None where it does not.

    What it reaches must be twice `level`: less is noise at the beginning.
    """
    highest = np.maximum.accumulate(pressing)
    fallen = np.flatnonzero((pressing < _FALLEN_SHARE * highest) & (highest > 2.0 * level))
    return int(fallen[0]) if fallen.size else None
