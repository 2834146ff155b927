"""What a contact feels like: its law of force over depth, and whether a hand breaks it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import fdtri

from ..signals.segments import Span
from .payload import AxisContacts, Payload, least_touch, press_sign, span_median

FloatArray = NDArray[np.float64]

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


@dataclass(frozen=True, kw_only=True)
class ContactTimes:
    """A contact in samples: `span` from first touch to release; `bounces` when it left the surface before the hold.

    Where it never came to rest, `hold` is when it pressed and not `is_held`. `onset` and `release` are None where the
    log does not show them; `hand_suspected` is None where it cannot be told.
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
class Law:
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


def learn_law(contact: ContactTimes, of: AxisContacts, payload: Payload, period_s: float) -> Law | None:
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
    # On the way into something soft the speed falls as the depth grows: only the signs tell K_e and B_e apart.
    rows, force = rows - rows.mean(axis=0), force - force.mean()
    size = np.maximum(np.max(np.abs(rows), axis=0), 1e-300)
    solution, left = nnls(rows / size, force)
    unsigned = force - rows / size @ np.linalg.lstsq(rows / size, force, rcond=None)[0]
    energy = max(float(force @ force), 1e-300)
    return Law(
        stiffness=float(solution[0] / size[0]),
        damping=float(solution[1] / size[1]),
        left_share=float(left**2 / energy),
        unsigned_share=float(unsigned @ unsigned / energy),
    )


def _last_touch(contact: ContactTimes, of: AxisContacts, payload: Payload) -> int:
    """Return the first sample of the touch that lasts into the hold."""
    if not contact.bounces:
        return contact.span.start
    level = least_touch(of, payload, contact.hold)
    after = slice(contact.bounces[-1], contact.hold.start)
    away = np.flatnonzero(press_sign(of, contact.hold) * payload.touch_n[after] < level)
    return after.start + (int(away[-1]) + 1 if away.size else 0)


def suspect_hand(
    contact: ContactTimes, law: Law, payload: Payload, free: Sequence[Span], period_s: float
) -> bool | None:
    """Return whether the force on the surface follows something else than the payload's way into it.

    What the law leaves of F_e from the hold to the release is a hand (or a wall that moves). Its means over 50 ms are
    held against those at rest by an F-test of level `FALSE_ALARM`, widened by a tenth of what the law says changes and
    by 4 % of the hold's force. A hand that is there on the way in leaves no law (`Law.is_broken`). None where the log
    is too short.
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
    told = law.stiffness * float(np.std(payload.position_m[pressed.slice]))
    held_n = abs(span_median(payload.touch_n, contact.hold))
    return float(np.var(held, ddof=1)) > limit + (_SMALLEST_HAND_SHARE * held_n) ** 2 + (_LAW_SHARE * told) ** 2


def _batches(values: FloatArray, period_s: float) -> FloatArray:
    """Return means over 50 ms each, (m,)."""
    length = max(1, round(_BATCH_S / period_s))
    count = len(values) // length
    return np.asarray(values[: count * length].reshape(count, length).mean(axis=1))
