"""Whether the declared signs of the force and of F^d agree with what the touches of a log show."""

from collections.abc import Iterator, Sequence

import numpy as np

from problems.arrays import BoolArray, FloatArray

from ..errors import EstimateError
from ..signals.aligned import Span
from ..signals.contact_rule import CONTACT
from .find import (
    BEFORE_S,
    SMALLEST_SPEED_M_S,
    STILL_M_S,
    AxisTouches,
    approach_speed,
    desired_speed,
    find_hold,
    find_presses,
    is_driven_by_desired,
    without_force,
)
from .signals import AxisSignals

_SMALLEST_HELD_N, _MOST_LISTED = 10.0, 8


def check_force_sign(axes: tuple[AxisSignals, ...]) -> None:
    """Refuse a wrench that points along the approach wherever the tool was stopped and held a force of 10 N or more.

    What stops a tool pushes against its free approach; a hand leads it along the force, but under that force it does
    not stand still. Hands hold against less, as within an admittance's deadband.

    Parameters
    ----------
    axes
        Force [N] and travel [m] of each axis, by the declared sign.

    Raises
    ------
    EstimateError
        Force and approach agree at every such hold.

    """
    free = without_force(axes)
    held = [hold for axis in axes for hold in _holds(axis, free)]
    if not held or any(speed > 0.0 for _, speed, _ in held):
        return
    listed = ", ".join(f"{at:.2f} s ({force:.1f} N)" for at, _, force in held[:_MOST_LISTED])
    raise EstimateError(
        "What stops the tool must push against its approach, found a force that pushes where the tool goes and then "
        f"stands still, at {listed}: try `exerted_by: sensor` of the wrench (`payload` where it is `sensor` now) in "
        "cell.yaml. `payload` is the force of payload and surroundings on the sensor, `sensor` that of the robot on "
        "them. If a hand held the tool there, leave that part out with --from and --to."
    )


def check_desired_force(found: Sequence[AxisTouches]) -> None:
    """Refuse an F^d that points away from all that is met as fast as it would drive, turned round.

    Parameters
    ----------
    found
        The touches of every axis, with F^d [N] and B_a [N·s/m] as the log or cell.yaml says them.

    Raises
    ------
    EstimateError
        On one axis some touches are met at −F^d/B_a and none at F^d/B_a.

    """
    for axis in found:
        met = [
            (each, speed)
            for each in axis.touches
            if not each.touch.is_led and (speed := each.touch.approach_speed) is not None and speed > 0.0
        ]
        turned = [
            (each.touch, speed)
            for each, speed in met
            if _is_driven_at(axis.signals, each.span.start, each.touch.sign, -1.0)
        ]
        if not turned or any(_is_driven_at(axis.signals, each.span.start, each.touch.sign, 1.0) for each, _ in met):
            continue
        touch, speed = turned[0]
        name, toward = axis.signals.axis, "+" if touch.sign > 0 else "-"
        raise EstimateError(
            f"F^d must drive the tool towards what it touches, found {touch.desired_force or 0.0:.4g} N along {name} "
            f"where the tool met something in {toward}{name} at {1e3 * speed:.3g} mm/s, as fast as F^d/B_a and the "
            f"other way ({touch.peak_s:.2f} s): turn the sign of `desired_force` along {name} in cell.yaml (its "
            "number, or `signs` of its topic)."
        )


def _holds(axis: AxisSignals, free: BoolArray) -> Iterator[tuple[float, float, float]]:
    """Yield when the tool was held after a free approach [s], its speed against the force [m/s] and the force [N]."""
    longest = round(CONTACT.longest_bounce_s / axis.period_s)
    swing = max(1, round(CONTACT.longest_swing_s / axis.period_s))
    for sign in (-1, 1):
        pressing = -sign * axis.force_n
        for span in find_presses(pressing, axis.level_n, longest, swing):
            before = slice(int(np.searchsorted(axis.time_s, axis.time_s[span.start] - BEFORE_S)), span.start)
            hold = find_hold(axis, pressing, span) or _swinging_hold(axis, pressing, span)
            speed = approach_speed(axis, span.start, sign)
            if hold is None or speed is None or before.stop == before.start or not np.all(free[before]):
                continue
            force = float(np.median(pressing[hold.slice]))
            if abs(speed) >= SMALLEST_SPEED_M_S and force >= _SMALLEST_HELD_N:
                yield float(axis.time_s[hold.start]), speed, force


def _swinging_hold(axis: AxisSignals, pressing: FloatArray, span: Span) -> Span | None:
    """Return the first 0.4 s under force at whose end the tool is where it was, as on a wall on which it swings."""
    count = max(1, round(CONTACT.shortest_rest_s / axis.period_s))
    travel = axis.travel_m[span.slice]
    back = np.abs(travel[count:] - travel[:-count]) < STILL_M_S * CONTACT.shortest_rest_s
    pressed = np.asarray(pressing[span.slice] > axis.level_n)
    for start in np.flatnonzero(back).tolist():
        if bool(np.all(pressed[start : start + count])):
            return Span(start=span.start + start, stop=span.start + start + count)
    return None


def _is_driven_at(axis: AxisSignals, onset: int, sign: int, turned: float) -> bool:
    """Return whether the approach is at `turned` F^d/B_a; false where one of them is not known or F^d is zero."""
    return desired_speed(axis, onset) is not None and is_driven_by_desired(axis, onset, sign, turned=turned)
