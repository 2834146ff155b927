"""The force that the payload's own mass and drag make on the sensor: in no touch is there as little else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import nnls

from problems.arrays import FloatArray

from ..result import Estimate, Finding, Status, TouchCause
from ..signals.contact_rule import CONTACT
from ..signals.segments import Span
from .find import AxisTouches, FoundTouch
from .signals import AxisSignals

# Over this long a motion is taken as even acceleration: a payload on its gripper swings faster than 10 Hz.
_EVEN_S, _FEWEST = 0.04, 5
# Short beside the swings of a payload on its coupling; the second one where the pose is noisy.
_SMOOTHED_S = (8e-3, 16e-3)
# In deviations of a Gaussian: a derivative of it that is cut off at four shows an acceleration where there is none.
_REACH = 7.0
_MODES_HZ, _DAMPING_RATIOS = tuple(np.geomspace(8.0, 40.0, 24).tolist()), (0.02, 0.06, 0.12)
_LEAST_EXPLAINED, _MOST_LEFT = 0.9, 0.25
_FEWEST_ALIKE = 3
# As well is the mass known at best: a payload that swings, and drag, take part.
_MASS_KNOWN = 0.05
_METHOD = "force over acceleration where the payload is moved and nothing else presses"
_NOTE = "of pushes alone: a sweep shows it better"
_TURNING_RAD_S = 0.1
# A tenth of the touches drops out at a time.
_PARTS = 10


@dataclass(frozen=True, kw_only=True)
class PayloadForce:
    """F = −(m a + b v) of an axis, `explained` of the energy of the force in `spans` that are nothing else.

    `mode` is the frequency [Hz] and the damping ratio with which the payload swings on its coupling, None if rigid.
    `left_n` (n,) is the smoothed force less F: what presses beside it.
    """

    mass_kg: float
    drag_n_s_per_m: float
    explained: float
    spans: tuple[Span, ...]
    left_n: FloatArray
    mode: tuple[float, float] | None = None

    def explains(self, each: FoundTouch) -> bool:
        """Return whether hardly anything presses in a touch beside F; something may pull, as a wall that is left."""
        pressing = -each.touch.sign * self.left_n[each.span.slice]
        return each.touch.hold_s is None and float(np.max(pressing)) <= _MOST_LEFT * each.touch.peak_force

    @property
    def mass(self) -> Estimate:
        """The mass [kg], weak: each span leaves it open by the share of its force that is not explained."""
        std = self.mass_kg * max(float(np.sqrt((1.0 - self.explained) / len(self.spans))), _MASS_KNOWN)
        return Estimate(value=self.mass_kg, std=std, status=Status.WEAK, method=_METHOD, note=_NOTE)


@dataclass(frozen=True, kw_only=True)
class KnownMotion:
    """What fits explain of a log: all on `axes`, and on the others the `turning_s` (start, stop) of the tool.

    A payload that turns presses with its inertia about a centre of mass that a log without weight does not show.
    """

    axes: frozenset[str]
    turning_s: tuple[tuple[float, float], ...]


def without_known(
    found: Sequence[AxisTouches], known: KnownMotion | None, turn_rad_s: FloatArray | None = None
) -> tuple[tuple[AxisTouches, ...], tuple[Finding, ...], dict[str, Estimate]]:
    """Leave out what fits explain, or where they know nothing, what `without_turning` and `without_inertia` do.

    Returns what is left, what is to be said, and by axis the mass that moves.
    """
    if known is None:
        others, about_turning = without_turning(found, turn_rad_s)
        kept, about, masses = without_inertia(others)
        return kept, (*about_turning, *about), masses
    others, findings, masses = without_inertia([axis for axis in found if axis.signals.axis not in known.axes])
    kept = tuple(
        replace(axis, touches=tuple(each for each in axis.touches if not _is_turned(each, known))) for axis in others
    )
    turned = [each for axis in others for each in axis.touches if _is_turned(each, known)]
    return kept, (*findings, *([_about_turning(turned)] if turned else [])), masses


def _is_turned(each: FoundTouch, known: KnownMotion) -> bool:
    peak_s = each.touch.peak_s
    swing_s = CONTACT.longest_swing_s
    return any(start - swing_s <= peak_s <= stop + swing_s for start, stop in known.turning_s)


def _about_turning(turned: Sequence[FoundTouch]) -> Finding:
    largest = max(each.touch.peak_force for each in turned)
    times = "once" if len(turned) == 1 else f"{len(turned)} times"
    return Finding(
        code="payload-inertia",
        severity="info",
        message=f"While the tool turned, {times} a force of up to {largest:.1f} N is what the payload's inertia about "
        "its centre of mass makes, as far as this log shows it, and is not listed as a touch.",
        advice="",
    )


def without_turning(
    found: Sequence[AxisTouches], turn_rad_s: FloatArray | None
) -> tuple[tuple[AxisTouches, ...], tuple[Finding, ...]]:
    """Leave out the touches that are the payload's inertia in a tool that turns, and say so.

    `turn_rad_s` (n, 3) is ω in S. F = −m a − (α × c + ω × (ω × c)) m with one m and m c for all axes: what the touches
    agree on to three quarters, and nine tenths of the energy of their force.
    """
    if turn_rad_s is None or len(found) < 3 or not all(np.all(np.isfinite(axis.signals.travel_m)) for axis in found):
        return tuple(found), ()
    signals, count = found[0].signals, len(turn_rad_s)
    width = _even_width(signals)
    if count < width:
        return tuple(found), ()
    rate = np.asarray(scipy.signal.savgol_filter(turn_rad_s, width, 2, axis=0))
    fast = np.linalg.norm(rate, axis=1) > _TURNING_RAD_S
    spans = [
        Span(start=i * count + part.start, stop=i * count + part.stop)
        for i, axis in enumerate(found)
        for part in (*(each.span for each in axis.touches if each.touch.cause is TouchCause.UNDETERMINED), *axis.led)
        if np.any(fast[part.slice])
    ]
    columns, force = _turning_columns(found, rate, width)
    alike = _agreeing(spans, columns, force, _least_squares)
    if alike is None or alike.explained < _LEAST_EXPLAINED:
        return tuple(found), ()
    kept = []
    for i, axis in enumerate(found):
        mine = [Span(start=each.start - i * count, stop=each.stop - i * count) for each in alike.spans]
        touches = tuple(each for each in axis.touches if each.span not in mine)
        led = tuple(span for span in axis.led if span not in mine)
        turned = tuple(span for span in mine if 0 <= span.start < count)
        kept.append(replace(axis, touches=touches, led=led, turned=turned))
    pairs = zip(found, kept, strict=True)
    left_out = [each for axis, rest in pairs for each in axis.touches if each not in rest.touches]
    return tuple(kept), (_about_turning(left_out),) if left_out else ()


def _turning_columns(found: Sequence[AxisTouches], rate: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Return the columns (3 n, 4) of m and m c, and the force (3 n,): the three axes one behind the other."""
    period = found[0].signals.period_s
    speed, change = (
        np.column_stack(
            [scipy.signal.savgol_filter(a.signals.travel_m, width, 2, deriv=d, delta=period) for a in found]
        )
        for d in (1, 2)
    )
    linear = change + np.cross(rate, speed)
    turning = np.asarray(scipy.signal.savgol_filter(rate, width, 2, deriv=1, delta=period, axis=0))
    about = [np.cross(turning, arm) + np.cross(rate, np.cross(rate, arm)) for arm in np.eye(3)]
    columns = -np.stack([linear, *about], axis=-1)
    force = np.stack([scipy.signal.savgol_filter(axis.signals.force_n, width, 2) for axis in found])
    return columns.transpose(1, 0, 2).reshape(-1, 4), force.reshape(-1)


def without_inertia(
    found: Sequence[AxisTouches],
) -> tuple[tuple[AxisTouches, ...], tuple[Finding, ...], dict[str, Estimate]]:
    """Leave out the touches and the leading hands that are the payload's own motion, and say so.

    A payload that is shaken presses against the motion without anything being there. Hands move an admittance along its
    acceleration, and walls slow the flange down by what presses: both have the other sign of inertia.
    """
    kept, findings, masses = [], [], {}
    for axis in found:
        payload = payload_force(axis)
        # A deadband takes more of small forces than this can tell.
        if payload is not None and not _is_cut(axis.signals):
            masses[axis.signals.axis] = payload.mass
        spans = () if payload is None else payload.spans
        own = [
            each
            for each in axis.touches
            if each.span in spans
            or (payload is not None and each.touch.cause is TouchCause.UNDETERMINED and payload.explains(each))
        ]
        led = tuple(span for span in axis.led if span not in spans)
        touches = tuple(each for each in axis.touches if each not in own)
        kept.append(replace(axis, touches=touches, led=led, inert=tuple(spans)))
        if payload is not None and own:
            findings.append(_about(axis.signals.axis, own, payload))
    return tuple(kept), tuple(findings), masses


def payload_force(axis: AxisTouches) -> PayloadForce | None:
    """Fit one mass and one drag, above and at least 0, to all touches without a hold and to all that a force leads.

    The payload is rigid on the flange, or else swings on its coupling: the flange's motion goes through a mode of
    second order, the one of `_MODES_HZ` and `_DAMPING_RATIOS` that explains most. Touches of which a quarter of the
    peak is left drop out until the others agree. None where fewer than three do, or less than nine tenths of the energy
    of their force is explained.
    """
    signals = axis.signals
    width = _even_width(signals)
    unheld = [each for each in axis.touches if each.touch.hold_s is None and each.touch.cause is not TouchCause.HAND]
    if not np.all(np.isfinite(signals.travel_m)) or len(signals.travel_m) < width:
        return None
    spans = [*(each.span for each in unheld), *axis.led]
    if len(spans) < _FEWEST_ALIKE:
        return None
    found = None
    for smoothed_s in _SMOOTHED_S:
        found = found or _own_force(signals, spans, max(smoothed_s / signals.period_s, 1.0))
    return found


def _modes(signals: AxisSignals) -> list[tuple[float, float]]:
    """Return frequencies [Hz] and damping ratios of payloads on their couplings, as far as the log resolves them."""
    return [(hz, ratio) for hz in _MODES_HZ for ratio in _DAMPING_RATIOS if 4.0 * hz < signals.rate_hz]


def _motion_columns(signals: AxisSignals, sigma: float) -> tuple[FloatArray, FloatArray]:
    """Return −acceleration, −speed and what a deadband took (n, 3), and the force (n,), smoothed by `sigma` samples."""
    # One filter for all of them, so that what holds of the signals holds of what is left of them.
    force, speed, acceleration = (
        gaussian_filter1d(values, sigma, order=order, mode="nearest", truncate=_REACH) / signals.period_s**order
        for values, order in ((signals.force_n, 0), (signals.travel_m, 1), (signals.travel_m, 2))
    )
    # What a deadband takes off is as large in every touch.
    return np.column_stack([-acceleration, -speed, -np.sign(force) * _is_cut(signals)]), force


def _is_cut(signals: AxisSignals) -> bool:
    return bool(np.any(signals.force_n == 0.0))


def _felt(columns: FloatArray, mode: tuple[float, float] | None, period_s: float) -> FloatArray:
    """Return the columns of a payload that swings with a mode on its coupling, as they are of a rigid one."""
    if mode is None:
        return columns
    return np.column_stack(
        [_swung(columns[:, 0], *mode, period_s), _swung(columns[:, 1], *mode, period_s), columns[:, 2]]
    )


def _own_force(signals: AxisSignals, spans: Sequence[Span], sigma: float) -> PayloadForce | None:
    """Return the fit of the payload's force by signals that are smoothed with a deviation of `sigma` samples."""
    columns, force = _motion_columns(signals, sigma)
    best: PayloadForce | None = None
    for mode in (None, *_modes(signals)):
        alike = _agreeing(spans, _felt(columns, mode, signals.period_s), force, _not_negative)
        if alike is None or alike.values[0] <= 0.0 or alike.explained < _LEAST_EXPLAINED:
            continue
        (mass, drag, _), felt = alike.values, _felt(columns, mode, signals.period_s)
        found = PayloadForce(
            mass_kg=mass,
            drag_n_s_per_m=drag,
            explained=alike.explained,
            spans=alike.spans,
            left_n=force - felt @ np.array(alike.values),
            mode=mode,
        )
        if mode is None:
            return found
        if best is None or (len(found.spans), found.explained) > (len(best.spans), best.explained):
            best = found
    return best


def _swung(motion: FloatArray, hz: float, ratio: float, period_s: float) -> FloatArray:
    """Return the motion (n,) of a payload on its coupling, (1 + 2 ζ s/ω)/(1 + 2 ζ s/ω + s²/ω²) of the flange's."""
    omega = 2.0 * np.pi * hz
    rate = 0.5 * omega / np.tan(0.5 * omega * period_s)  # Tustin's form with the mode where it is
    damped = 2.0 * ratio / omega
    numerator, denominator = scipy.signal.bilinear([damped, 1.0], [omega**-2.0, damped, 1.0], rate)
    return np.asarray(scipy.signal.lfilter(numerator, denominator, motion))


def _even_width(signals: AxisSignals) -> int:
    return max(_FEWEST, 2 * round(0.5 * _EVEN_S / signals.period_s) + 1)


@dataclass(frozen=True, kw_only=True)
class _Alike:
    """The spans that agree on the `values` of columns, and the share of their force's energy that these explain."""

    values: tuple[float, ...]
    spans: tuple[Span, ...]
    explained: float


def _least_squares(columns: FloatArray, force: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.lstsq(columns, force, rcond=None)[0], dtype=np.float64)


def _not_negative(columns: FloatArray, force: FloatArray) -> FloatArray:
    return np.asarray(nnls(columns, force)[0], dtype=np.float64)


def _agreeing(
    spans: Sequence[Span],
    columns: FloatArray,
    force: FloatArray,
    solve: Callable[[FloatArray, FloatArray], FloatArray],
) -> _Alike | None:
    """Fit columns (n, k) to a force (n,) in spans; those of which a quarter of the peak is left drop out.

    Each span weighs as much as any other, however long and hard it is. None where fewer than three agree.
    """
    alike = list(spans)
    weight = np.zeros(len(force))
    for span in spans:
        weight[span.slice] = 1.0 / (float(np.max(np.abs(force[span.slice]))) * np.sqrt(len(span)))
    while len(alike) >= _FEWEST_ALIKE:
        rows = np.concatenate([np.arange(span.start, span.stop) for span in alike])
        values = solve(weight[rows, None] * columns[rows], weight[rows] * force[rows])
        left = np.abs(force - columns @ values)
        over = [float(np.max(left[span.slice]) / np.max(np.abs(force[span.slice]))) for span in alike]
        if max(over) <= _MOST_LEFT:
            explained = 1.0 - float(left[rows] @ left[rows]) / float(force[rows] @ force[rows])
            return _Alike(values=tuple(map(float, values)), spans=tuple(alike), explained=explained)
        worst = max(sorted(over)[-max(1, len(over) // _PARTS)], _MOST_LEFT)
        alike = [span for span, share in zip(alike, over, strict=True) if share < worst]
    return None


def _about(axis: str, own: Sequence[FoundTouch], payload: PayloadForce) -> Finding:
    largest = max(each.touch.peak_force for each in own)
    times = "once" if len(own) == 1 else f"{len(own)} times"
    return Finding(
        code="payload-inertia",
        severity="info",
        message=f"Axis {axis}: {times} a force against the motion, up to {largest:.1f} N, is what "
        f"the payload itself makes when it is moved ({payload.mass_kg:.3g} kg and {payload.drag_n_s_per_m:.3g} N·s/m "
        f"explain {100.0 * payload.explained:.1f} % of that force), and no touch.",
        advice="",
    )
