"""Findings on touches that leave something open: a narrow peak, what may be a hand, what was left too early."""

from collections.abc import Sequence

from ..result import Finding, Touch, TouchCause
from .find import AxisTouches

NOT_A_SPRING = 0.1
"""The share of a force that something else than one spring explains."""

_MOST_LISTED = 8


def between_samples(axis: AxisTouches) -> list[Finding]:
    """Return the finding on peaks that are so narrow that they may lie between the samples."""
    narrow = []
    for each in axis.touches:
        touch = each.touch
        if touch.cause is TouchCause.HAND or touch.peak_interval is None or touch.rise_samples is None:
            continue
        low, high = touch.peak_interval
        samples = "1 sample" if touch.rise_samples <= 1 else f"{touch.rise_samples} samples"
        if high is None:
            narrow.append(f"at {touch.peak_s:.2f} s the peak is at least {low:.1f} N (rise in {samples})")
        elif high > (1.0 + NOT_A_SPRING) * low and touch.rise_samples <= 3:
            narrow.append(f"at {touch.peak_s:.2f} s the peak may be {low:.1f} to {high:.1f} N (rise in {samples})")
    if not narrow:
        return []
    more = f" and {len(narrow) - _MOST_LISTED} more" if len(narrow) > _MOST_LISTED else ""
    return [
        Finding.warning(
            "peak-between-samples",
            f"Axis {axis.signals.axis}, sampled at {axis.signals.rate_hz:.0f} Hz, force on the sensor: "
            f"{', '.join(narrow[:_MOST_LISTED])}{more}.",
            "Record the wrench faster, at 500 Hz or more.",
        )
    ]


def _listed(touches: Sequence[Touch]) -> str:
    shown = ", ".join(
        f"{touch.peak_s:.2f} s ({touch.axis}, {touch.peak_force:.1f} N"
        f"{', led' if touch.is_led and touch.cause is not TouchCause.WALL else ''})"
        for touch in touches[:_MOST_LISTED]
    )
    return shown + (f" and {len(touches) - _MOST_LISTED} more" if len(touches) > _MOST_LISTED else "")


def undetermined(touches: Sequence[Touch]) -> list[Finding]:
    """Return the finding on touches that may be a hand's."""
    left = [touch for touch in touches if touch.cause is not TouchCause.WALL]
    message = (
        f"What was touched at {_listed(left)} cannot be distinguished from a hand: a hand led the payload or the force "
        "came without motion."
    )
    advice = "Approach under a desired force or a command, hands off."
    return [Finding.warning("touch-undetermined", message, advice)] if left else []


def withdrawn(touches: Sequence[Touch]) -> list[Finding]:
    """Return the finding on touches that were withdrawn before their peak."""
    left = [touch for touch in touches if touch.is_withdrawn]
    message = (
        f"F^d turned away before the peak of the touch at {_listed(left)}: no whole blow, so no surface is identified "
        "from it."
    )
    return [Finding.warning("touch-withdrawn", message, "Keep pressing for a second after the touch.")] if left else []
