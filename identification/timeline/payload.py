"""Motion of the payload behind the coupling, and the force on what it touches."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from problems.arrays import BoolArray, FloatArray

from ..axes.straight import AxisMotion
from ..signals.contact_rule import CONTACT
from ..signals.segments import Span, low_pass, rate_of

_HIGHEST_HZ = 60.0
_LOWEST_HZ = 20.0
_RESONANCES = 1.5
_SLOW_HZ = 8.0
_MARGIN_S = 0.2
_FEWEST_FILTERED = 30
_PUSHED_S = 0.3


@dataclass(frozen=True, kw_only=True)
class AxisContacts:
    """An axis with its rests under force, and K_s, B_s, B_p, M_p (4,) as far as they are known.

    `smallest_n` is the least contact force and `softest_n_per_m` the least stiffness of a surface, see
    `ContactRule`; on a rotational axis both are those of torque and angle.
    """

    axis: AxisMotion
    holds: tuple[Span, ...]
    coupling: FloatArray
    smallest_n: float = CONTACT.smallest_n
    softest_n_per_m: float = CONTACT.softest_n_per_m


@dataclass(frozen=True, kw_only=True)
class PayloadMotion:
    """The payload behind the coupling, (n,) each: position, velocity, and the force on what it touches or holds it."""

    position_m: FloatArray
    velocity_m_s: FloatArray
    touch_n: FloatArray


def observe_payload(of: AxisContacts, period_s: float) -> PayloadMotion:
    """See the payload through the coupling, x_p = x + (F − B_s/K_s dF/dt)/K_s, and F_e = −F − B_p v_p − M_p a_p.

    Below 60 Hz or 1.5 resonances (docs/method.md, "The loop"); positive forces press towards +axis.
    """
    stiffness, damping, drag, mass = of.coupling
    resonance = float(np.sqrt(stiffness / mass)) / (2.0 * np.pi)
    band = min(_HIGHEST_HZ, max(_LOWEST_HZ, _RESONANCES * resonance))
    force = low_pass(of.axis.force_n, period_s, band)
    position = low_pass(of.axis.position_m, period_s, band)
    position = position + (force - damping / stiffness * rate_of(force, period_s)) / stiffness
    velocity = rate_of(position, period_s)
    touch = -force - drag * velocity - mass * rate_of(velocity, period_s)
    return PayloadMotion(position_m=position, velocity_m_s=velocity, touch_n=np.asarray(touch))


def unexplained_share(of: AxisContacts, payload: PayloadMotion, span: Span, period_s: float) -> float:
    """Return the share of the force's energy over a span, below 8 Hz, that the payload's own motion does not explain.

    0 where what is left is no more than the least contact force.
    """
    margin = round(_MARGIN_S / period_s)
    around = slice(max(0, span.start - margin), span.stop + margin)
    inside = slice(span.start - around.start, span.stop - around.start)
    if len(of.axis.force_n[around]) < _FEWEST_FILTERED:
        return 0.0
    force, left = (low_pass(each[around], period_s, _SLOW_HZ)[inside] for each in (of.axis.force_n, payload.touch_n))
    if not float(np.sqrt(np.mean(left**2))) > of.smallest_n:
        return 0.0
    return float(np.sum(left**2) / np.sum(force**2))


def pushed(of: AxisContacts, payload: PayloadMotion, span: Span, period_s: float) -> BoolArray:
    """Return where in a span (n,) the payload's own motion explains less than half of the force, over 0.3 s below 8 Hz.

    Not where what is left is no more than the least contact force.
    """
    margin, width = round(_MARGIN_S / period_s), max(1, round(_PUSHED_S / period_s))
    around = slice(max(0, span.start - margin), span.stop + margin)
    inside = slice(span.start - around.start, span.stop - around.start)
    if len(of.axis.force_n[around]) < _FEWEST_FILTERED:
        return np.zeros(len(span), dtype=np.bool_)
    force, left = (
        uniform_filter1d(np.nan_to_num(low_pass(each[around], period_s, _SLOW_HZ)) ** 2, width)[inside]
        for each in (of.axis.force_n, payload.touch_n)
    )
    return np.asarray((left > of.smallest_n**2) & (left > 0.5 * force))


def press_sign(of: AxisContacts, hold: Span) -> float:
    """Return +1 when pressing towards +axis: the force on the flange is then negative."""
    return -1.0 if span_median(of.axis.force_n, hold) > 0.0 else 1.0


def least_touch(of: AxisContacts, payload: PayloadMotion, hold: Span) -> float:
    """Return the force above which the payload touches what a hold presses on: a tenth of the hold's, or the least."""
    return CONTACT.touch_threshold_n(press_sign(of, hold) * span_median(payload.touch_n, hold))


def span_median(values: FloatArray, span: Span) -> float:
    """Return the median of values (n,) over a span."""
    return float(np.median(values[span.slice]))
