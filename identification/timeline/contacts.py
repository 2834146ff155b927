"""Contacts of a time line: onset, peak, hold, release, bounces, and whether a hand pushed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls
from scipy.special import fdtri

from problems.arrays import BoolArray, FloatArray

from ..signals.aligned import spans_of
from ..signals.contact_rule import CONTACT
from ..signals.segments import MotionSpans, Span, low_pass, without_pauses, without_short
from .moves import is_hand_led
from .payload import AxisContacts, PayloadMotion, least_touch, press_sign, span_median

_ONSET_SKIP_S = 0.012
_LEARNT_S = 0.3
_RELEASE_SKIP_S = 0.05
_SHORTEST_LEARNT_S = 0.06
_BATCH_S = 0.05
_FEWEST_BATCHES = 5
_SECOND_DIFFERENCES = 18.0 / 35.0  # of their number are independent, for white noise
FALSE_ALARM = 1e-3
"""How often a hold without a hand is taken for one with a hand by the sensor's noise alone."""
_SMALLEST_HAND_SHARE = 0.04
_LAW_SHARE = 0.1
_POOR_LAW = 0.5
_BROKEN_LAW = 0.2
_DRIVING_SHARE = 0.1
_CLEAR_LAW = 0.2
_SLOW_HZ = 8.0
_BESIDE_HOLE_S = 0.1


@dataclass(frozen=True, kw_only=True)
class ContactTimes:
    """A contact in samples: `span` from first touch to release; `bounces` when it left the surface before the hold.

    Where it never came to rest, `hold` is when it pressed and not `is_held`. `onset` and `release` are None where the
    log does not show them; `hand_suspected` is None where it cannot be determined.
    """

    span: Span
    onset: int | None
    peak: int
    peak_force_n: float
    hold: Span
    is_held: bool
    release: int | None
    bounces: tuple[int, ...]
    hand_suspected: bool | None


@dataclass(frozen=True, kw_only=True)
class ForceLaw:
    """F_e = K_e (x_p − x_w) + B_e v_p with K_e, B_e ≥ 0, and the share of the variance of F_e that it leaves.

    `unsigned_share` is what it would leave with any signs: a hand that drives the payload is a damping below zero.
    """

    stiffness: float
    damping: float
    left_share: float
    unsigned_share: float

    @property
    def is_clear(self) -> bool:
        """Whether half of the force or more goes with depth and speed."""
        return self.unsigned_share < _POOR_LAW

    @property
    def is_driving(self) -> bool:
        """Whether it takes a damping or a stiffness below zero: what is touched does work, as no surface can."""
        return self.left_share - self.unsigned_share > _DRIVING_SHARE

    @property
    def is_broken(self) -> bool:
        """Whether it leaves more than what yields ever harder, F_e ∝ depth³, would leave (0.16)."""
        return self.left_share > _BROKEN_LAW


def learn_law(contact: ContactTimes, of: AxisContacts, payload: PayloadMotion, period_s: float) -> ForceLaw | None:
    """Learn the law of what is touched on the way in, from the last touch into the hold, or else on the way out.

    None where the log shows neither, or has a hole there.
    """
    learnt, skip = round(_LEARNT_S / period_s), round(_ONSET_SKIP_S / period_s)
    hold = contact.hold
    if contact.onset is not None:
        used = slice(_last_touch(contact, of, payload) + skip, min(hold.start + learnt, hold.stop))
    elif contact.release is not None:
        used = slice(max(hold.start, hold.stop - learnt), contact.release - skip)
    else:
        return None
    if (used.stop - used.start) * period_s < _SHORTEST_LEARNT_S:
        return None
    force, position = payload.touch_n[used], payload.position_m[used]
    rows = np.column_stack([position, payload.velocity_m_s[used]])
    if not np.all(np.isfinite(rows)):
        return None
    # On the way into something soft the speed falls as the depth grows: only the signs distinguish K_e and B_e.
    rows, force = rows - rows.mean(axis=0), force - force.mean()
    size = np.maximum(np.max(np.abs(rows), axis=0), 1e-300)
    solution, left = nnls(rows / size, force)
    unsigned = force - rows / size @ np.linalg.lstsq(rows / size, force, rcond=None)[0]
    energy = max(float(force @ force), 1e-300)
    return ForceLaw(
        stiffness=float(solution[0] / size[0]),
        damping=float(solution[1] / size[1]),
        left_share=float(left**2 / energy),
        unsigned_share=float(unsigned @ unsigned / energy),
    )


def _last_touch(contact: ContactTimes, of: AxisContacts, payload: PayloadMotion) -> int:
    """Return the first sample of the touch that lasts into the hold."""
    if not contact.bounces:
        return contact.span.start
    level = least_touch(of, payload, contact.hold)
    after = slice(contact.bounces[-1], contact.hold.start)
    away = np.flatnonzero(press_sign(of, contact.hold) * payload.touch_n[after] < level)
    return after.start + (int(away[-1]) + 1 if away.size else 0)


def suspect_hand(
    contact: ContactTimes, law: ForceLaw, payload: PayloadMotion, free: Sequence[Span], period_s: float
) -> bool | None:
    """Return whether the force on the surface follows something else than the payload's way into it.

    What the law leaves of F_e from the hold to the release is a hand (or a wall that moves). Its means over 50 ms are
    held against those at rest by an F-test of level `FALSE_ALARM`, widened by a tenth of what the law says changes and
    by 4 % of the hold's force. A hand that is there on the way in leaves no law (`ForceLaw.is_broken`). None where the
    log is too short.
    """
    if law.is_broken:
        return True

    def left(span: Span) -> FloatArray:
        position, velocity = payload.position_m[span.slice], payload.velocity_m_s[span.slice]
        return _batches(payload.touch_n[span.slice] - law.stiffness * position - law.damping * velocity, period_s)

    skip = round(_RELEASE_SKIP_S / period_s)
    pressed = Span(start=contact.hold.start, stop=max(contact.hold.stop, contact.span.stop - skip))
    held = left(pressed)
    bends = [np.diff(values, n=2) for values in map(left, free) if len(values) >= _FEWEST_BATCHES]
    if len(held) < _FEWEST_BATCHES or not bends:
        return None
    # Second differences: at rest the robot may creep, and only what it touches would feel that.
    noise = float(np.median([np.mean(bend**2) for bend in bends])) / 6.0
    freedom = _SECOND_DIFFERENCES * sum(len(bend) for bend in bends)
    limit = noise * float(fdtri(len(held) - 1, freedom, 1.0 - FALSE_ALARM))
    expected = law.stiffness * float(np.std(payload.position_m[pressed.slice]))
    held_n = abs(span_median(payload.touch_n, contact.hold))
    return float(np.var(held, ddof=1)) > limit + (_SMALLEST_HAND_SHARE * held_n) ** 2 + (_LAW_SHARE * expected) ** 2


def _batches(values: FloatArray, period_s: float) -> FloatArray:
    """Return means over 50 ms each, (m,)."""
    length = max(1, round(_BATCH_S / period_s))
    count = len(values) // length
    return np.asarray(values[: count * length].reshape(count, length).mean(axis=1))


@dataclass(frozen=True, kw_only=True)
class Pressed:
    """Rests under force: `contacts` with a surface, those that are `unclear`, and those `by_hand`.

    Unclear is what the way in or out does not show, or shows as no law of force over depth; by hand is what rests on
    something that is softer than any surface or drives the payload. `restless` pressed in motion, without a clear law.
    """

    contacts: tuple[ContactTimes, ...]
    unclear: tuple[ContactTimes, ...]
    by_hand: tuple[ContactTimes, ...]
    restless: tuple[ContactTimes, ...] = ()


def find_contacts(of: AxisContacts, payload: PayloadMotion, motion: MotionSpans, period_s: float) -> Pressed:
    """Find how each rest under force began and ended; rests that the payload did not leave in between are one contact.

    The payload touches where F_e is above a tenth of the hold's, the least contact force and six deviations of the
    noise at rest. What it touches is a surface if F_e grows with the way into it, by more than an arm would push back.
    Where it touches a surface for 0.1 s or more without coming to rest, that is a contact without a hold.
    """
    free = tuple(s for s in motion.still if s not in of.holds)
    barriers = (*free, *_holes(payload.touch_n, period_s))
    noise = _scatter(payload.touch_n, free)
    found: list[ContactTimes] = []
    for hold in of.holds:
        if found and hold.start < found[-1].span.stop:
            last = found[-1]
            found[-1] = replace(
                last,
                hold=Span(start=last.hold.start, stop=hold.stop),
                span=Span(start=last.span.start, stop=max(last.span.stop, hold.stop)),
            )
            continue
        sign = press_sign(of, hold)
        window = _window(hold, barriers, len(payload.touch_n), period_s, found)
        level = max(least_touch(of, payload, hold), CONTACT.touched_noises * noise)
        touches = np.asarray(sign * payload.touch_n[window.slice] > level)
        found.append(_contact(of, sign, hold, window, touches, period_s))
    laws = [learn_law(contact, of, payload, period_s) for contact in found]
    pairs = list(zip(found, laws, strict=True))
    contacts = [
        replace(contact, hand_suspected=suspect_hand(contact, law, payload, free, period_s))
        for contact, law in pairs
        if law is not None and law.is_clear and not _is_hand(law, of)
    ]
    restless, unclear = _restless(of, payload, motion, contacts, noise, period_s)
    return Pressed(
        contacts=tuple(sorted((*contacts, *restless), key=lambda each: each.span.start)),
        unclear=tuple(contact for contact, law in pairs if law is None or not law.is_clear),
        by_hand=tuple(contact for contact, law in pairs if law is not None and law.is_clear and _is_hand(law, of)),
        restless=tuple(unclear),
    )


def _is_hand(law: ForceLaw, of: AxisContacts) -> bool:
    """Return whether what is touched is softer than any surface, or drives the payload."""
    return law.stiffness < of.softest_n_per_m or law.is_driving


def _restless(
    of: AxisContacts,
    payload: PayloadMotion,
    motion: MotionSpans,
    contacts: Sequence[ContactTimes],
    noise: float,
    period_s: float,
) -> tuple[list[ContactTimes], list[ContactTimes]]:
    """Return contacts in motion, without a hold (vibration on the surface, a bump), and those without a clear law."""
    slow = low_pass(payload.touch_n, period_s, _SLOW_HZ)
    level = max(CONTACT.restless_factor * of.smallest_n, CONTACT.touched_noises * noise)
    taken = np.ones(len(slow), dtype=np.bool_)
    for span in of.axis.spans:
        shown = of.axis.position_m[span.slice], of.axis.force_n[span.slice]
        # A hand that leads the payload along pushes as hard as a surface.
        taken[span.slice] = is_hand_led(*shown, period_s, float(of.coupling[3]), of.smallest_n)
    for contact in contacts:
        taken[contact.span.slice] = True
    barriers = (*motion.still, *_holes(slow, period_s))
    found: list[ContactTimes] = []
    unclear: list[ContactTimes] = []
    for sign in (-1.0, 1.0):
        joined = without_pauses(np.asarray((sign * slow > level) & ~taken), round(CONTACT.longest_bounce_s / period_s))
        for core in spans_of(without_short(np.asarray(joined & ~taken), round(CONTACT.shortest_restless_s / period_s))):
            window = _window(core, barriers, len(slow), period_s, [*contacts, *found])
            touches = np.asarray(sign * payload.touch_n[window.slice] > level)
            contact = _peaked(_contact(of, sign, core, window, touches, period_s), of, sign)
            law = learn_law(contact, of, payload, period_s)
            is_clear = law is not None and law.left_share < _CLEAR_LAW and law.stiffness >= of.softest_n_per_m
            pressing = sign * payload.touch_n[contact.span.slice]
            # Before and behind a hard press a filter swings to the other side.
            if np.any(taken[contact.span.slice]) or float(np.max(-pressing)) > float(np.max(pressing)):
                continue
            if is_clear:
                found.append(contact)
                taken[contact.span.slice] = True
            else:
                unclear.append(contact)
    return found, unclear


def _peaked(contact: ContactTimes, of: AxisContacts, sign: float) -> ContactTimes:
    """Return a contact without a hold with the peak of all of it."""
    pressing = -sign * of.axis.force_n[contact.span.slice]
    peak = int(np.argmax(np.nan_to_num(pressing, nan=-np.inf)))
    return replace(contact, peak=contact.span.start + peak, peak_force_n=float(pressing[peak]), is_held=False)


def _scatter(values: FloatArray, spans: Sequence[Span]) -> float:
    """Return the deviation of values (n,) in a usual span: who pushes at one rest must not hide a contact."""
    return float(np.median([np.std(values[s.slice]) for s in spans])) if spans else 0.0


def _holes(values: FloatArray, period_s: float) -> Iterator[Span]:
    """Yield the holes of values (n,), each with and without what lies beside it.

    There a filter does not know how what it filters goes on, and two derivatives make a touch of that.
    """
    beside = round(_BESIDE_HOLE_S / period_s)
    for hole in spans_of(~np.isfinite(values)):
        yield hole
        yield Span(start=max(0, hole.start - beside), stop=hole.stop + beside)


def _window(hold: Span, free: Sequence[Span], count: int, period_s: float, found: Sequence[ContactTimes]) -> Span:
    """Return where the touches of a hold are looked for: to the rests without force, other contacts, or 3 s away."""
    furthest = round(CONTACT.furthest_s / period_s)
    others = [*free, *(contact.span for contact in found)]
    before = [s.stop for s in others if s.stop <= hold.start]
    after = [s.start for s in others if s.start >= hold.stop]
    return Span(start=max([0, hold.start - furthest, *before]), stop=min([count, hold.stop + furthest, *after]))


def lead_samples(period_s: float) -> int:
    """Return how far from the ends of what is searched a touch begins or ends that the log shows, in samples."""
    return max(1, round(CONTACT.smallest_lead_s / period_s))


def _contact(
    of: AxisContacts, sign: float, hold: Span, window: Span, touches: BoolArray, period_s: float
) -> ContactTimes:
    """Put the instants together; `touches` shows over the window where the payload touches."""
    held = slice(hold.start - window.start, hold.stop - window.start)
    touches[held] = True
    joined = without_pauses(touches, round(CONTACT.longest_bounce_s / period_s))
    run = next(s for s in spans_of(joined) if s.start <= held.start < s.stop)
    lead = lead_samples(period_s)
    is_entered, is_left = run.start > lead, run.stop < len(touches) - lead
    span = Span(start=window.start + run.start, stop=window.start + run.stop)
    onset = span.start if is_entered else None
    shortest = round(CONTACT.shortest_bounce_s / period_s)
    before = ~touches[run.start : held.start]
    apart = [s for s in spans_of(before) if len(s) >= shortest] if is_entered else []
    pressing = -sign * of.axis.force_n[span.start : hold.stop]
    peak = int(np.argmax(np.nan_to_num(pressing, nan=-np.inf)))
    return ContactTimes(
        span=span,
        onset=onset,
        peak=span.start + peak,
        peak_force_n=float(pressing[peak]),
        hold=hold,
        is_held=True,
        release=span.stop if is_left else None,
        bounces=tuple(span.start + s.start for s in apart),
        hand_suspected=None,
    )
