"""The force that the payload's own mass and drag make on the sensor: in no touch is there as little else."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls
from scipy.signal import savgol_filter

from problems.arrays import FloatArray

from ..result import Finding, TouchCause
from ..signals.segments import Span
from .find import LONGEST_SWING_S, AxisTouches, FoundTouch
from .signals import AxisSignals

# Over this long a motion is taken as even acceleration: a payload on its gripper swings faster than 10 Hz.
_EVEN_S, _FEWEST = 0.04, 5
_LEAST_EXPLAINED, _MOST_LEFT = 0.9, 0.25
_FEWEST_ALIKE = 3
_TURNING_RAD_S = 0.1
# A tenth of the touches drops out at a time.
_PARTS = 10


@dataclass(frozen=True, kw_only=True)
class PayloadForce:
    """F = −(m a + b v) of an axis, `explained` of the energy of the force in `spans` that are nothing else."""

    mass_kg: float
    drag_n_s_per_m: float
    explained: float
    spans: tuple[Span, ...]


@dataclass(frozen=True, kw_only=True)
class KnownMotion:
    """What fits explain of a log: all on `axes`, and on the others the `turning_s` (start, stop) of the tool.

    A payload that turns presses with its inertia about a centre of mass that a log without weight does not show.
    """

    axes: frozenset[str]
    turning_s: tuple[tuple[float, float], ...]


def without_known(
    found: Sequence[AxisTouches], known: KnownMotion | None, turn_rad_s: FloatArray | None = None
) -> tuple[tuple[AxisTouches, ...], tuple[Finding, ...]]:
    """Leave out what fits explain, or where they know nothing, what `without_turning` and `without_inertia` do."""
    if known is None:
        others, about_turning = without_turning(found, turn_rad_s)
        kept, about = without_inertia(others)
        return kept, (*about_turning, *about)
    others, findings = without_inertia([axis for axis in found if axis.signals.axis not in known.axes])
    kept = tuple(
        replace(axis, touches=tuple(each for each in axis.touches if not _is_turned(each, known))) for axis in others
    )
    turned = [each for axis in others for each in axis.touches if _is_turned(each, known)]
    return kept, (*findings, *([_about_turning(turned)] if turned else []))


def _is_turned(each: FoundTouch, known: KnownMotion) -> bool:
    peak_s = each.touch.peak_s
    return any(start - LONGEST_SWING_S <= peak_s <= stop + LONGEST_SWING_S for start, stop in known.turning_s)


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
    rate = np.asarray(savgol_filter(turn_rad_s, width, 2, axis=0))
    fast = np.linalg.norm(rate, axis=1) > _TURNING_RAD_S
    spans = [
        Span(start=i * count + part.start, stop=i * count + part.stop)
        for i, axis in enumerate(found)
        for part in (*(each.span for each in axis.touches if each.touch.cause is TouchCause.UNDETERMINED), *axis.led)
        if np.any(fast[part.slice])
    ]
    columns, force = _turning_columns(found, rate, width)
    alike = _agreeing(spans, columns, force, force, _least_squares)
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
        np.column_stack([savgol_filter(a.signals.travel_m, width, 2, deriv=d, delta=period) for a in found])
        for d in (1, 2)
    )
    linear = change + np.cross(rate, speed)
    turning = np.asarray(savgol_filter(rate, width, 2, deriv=1, delta=period, axis=0))
    about = [np.cross(turning, arm) + np.cross(rate, np.cross(rate, arm)) for arm in np.eye(3)]
    columns = -np.stack([linear, *about], axis=-1)
    force = np.stack([savgol_filter(axis.signals.force_n, width, 2) for axis in found])
    return columns.transpose(1, 0, 2).reshape(-1, 4), force.reshape(-1)


def without_inertia(found: Sequence[AxisTouches]) -> tuple[tuple[AxisTouches, ...], tuple[Finding, ...]]:
    """Leave out the touches and the leading hands that are the payload's own motion, and say so.

    A payload that is shaken presses against the motion without anything being there. Hands move an admittance along its
    acceleration, and walls slow the flange down by what presses: both have the other sign of inertia.
    """
    kept, findings = [], []
    for axis in found:
        payload = payload_force(axis)
        spans = () if payload is None else payload.spans
        own = [each for each in axis.touches if each.span in spans]
        led = tuple(span for span in axis.led if span not in spans)
        touches = tuple(each for each in axis.touches if each not in own)
        kept.append(replace(axis, touches=touches, led=led, inert=tuple(spans)))
        if payload is not None and own:
            findings.append(_about(axis.signals.axis, own, payload))
    return tuple(kept), tuple(findings)


def payload_force(axis: AxisTouches) -> PayloadForce | None:
    """Fit one mass and one drag, above and at least 0, to all touches without a hold and to all that a force leads.

    Those of which a quarter of the peak is left drop out until the others agree. None where fewer than three do, or
    less than nine tenths of the energy of their force is explained.
    """
    signals = axis.signals
    width = _even_width(signals)
    unheld = [each for each in axis.touches if each.touch.hold_s is None and each.touch.cause is not TouchCause.HAND]
    if not np.all(np.isfinite(signals.travel_m)) or len(signals.travel_m) < width:
        return None
    speed, acceleration = (
        savgol_filter(signals.travel_m, width, 2, deriv=order, delta=signals.period_s) for order in (1, 2)
    )
    force = savgol_filter(signals.force_n, width, 2)
    # What a deadband takes off is as large in every touch.
    is_cut = float(np.mean(signals.force_n == 0.0)) > 0.0
    columns = np.column_stack([-acceleration, -speed, -np.sign(force) * is_cut])
    spans = [*(each.span for each in unheld), *axis.led]
    alike = _agreeing(spans, columns, force, signals.force_n, _not_negative)
    if alike is None or alike.values[0] <= 0.0 or alike.explained < _LEAST_EXPLAINED:
        return None
    mass, drag, _ = alike.values
    return PayloadForce(mass_kg=mass, drag_n_s_per_m=drag, explained=alike.explained, spans=alike.spans)


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
    raw: FloatArray,
    solve: Callable[[FloatArray, FloatArray], FloatArray],
) -> _Alike | None:
    """Fit columns (n, k) to a force (n,) in spans; those of which a quarter of the `raw` peak is left drop out.

    Each span weighs as much as any other, however long and hard it is. None where fewer than three agree.
    """
    alike = list(spans)
    weight = np.zeros(len(force))
    for span in spans:
        weight[span.slice] = 1.0 / (float(np.max(np.abs(raw[span.slice]))) * np.sqrt(len(span)))
    while len(alike) >= _FEWEST_ALIKE:
        rows = np.concatenate([np.arange(span.start, span.stop) for span in alike])
        values = solve(weight[rows, None] * columns[rows], weight[rows] * force[rows])
        left = np.abs(force - columns @ values)
        over = [float(np.max(left[span.slice]) / np.max(np.abs(raw[span.slice]))) for span in alike]
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
