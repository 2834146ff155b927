"""The filter or delay of the wrench out of the joint fits of all axes: one sensor, one driver."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..result import Estimate, Finding, Status, WrenchFilterEstimate
from ..verdicts import judged, weak_at_best
from .filter import DECIDED, is_late, taken_for_filter
from .latency import Lag

_METHOD = "maximum likelihood of pose and force, beside everything else"
_IDENTIFIED_SHARE, _WEAK_SHARE = 0.1, 0.5
_IDENTIFIED_SAMPLES = 0.2
_APART_STDS, _APART_SHARE = 5.0, 0.2


def find_wrench_filter(
    lags: Mapping[str, Lag], shifted_s: float, period_s: float
) -> tuple[WrenchFilterEstimate | None, tuple[Finding, ...]]:
    """Return the low-pass or the delay that the axes show, None where the wrench is not late by what matters.

    `lags` are those of the fits by axis, after `shifted_s` was taken off the wrench's stamps. Where axes show different
    kinds, the one with more evidence counts; where they show different sizes, the latest one. What a wrench is early
    by is a clock's, not a filter's, and left out.
    """
    clock = taken_for_filter(shifted_s)
    whole = {n: lag if lag.is_filter else replace(lag, seconds=lag.seconds + clock) for n, lag in lags.items()}
    late = {name: lag for name, lag in whole.items() if is_late(lag.seconds, lag.std_s, period_s)}
    if not late:
        return None, ()
    evidence = sum(lag.evidence or 0.0 for lag in late.values())
    is_filter = evidence > 0.0 or all(lag.is_filter for lag in late.values())
    alike = {name: lag for name, lag in late.items() if lag.is_filter == is_filter} or late
    seconds, std, why = _together(alike)
    if abs(evidence) < DECIDED:
        why = f"a {'delay' if is_filter else 'low-pass'} explains it nearly as well"
    if is_filter:
        corner = 1.0 / (2.0 * np.pi * seconds)
        estimate = judged(
            corner, corner * std / seconds, method=_METHOD, identified=_IDENTIFIED_SHARE, weak=_WEAK_SHARE
        )
        found = WrenchFilterEstimate(corner_hz=weak_at_best(estimate, why) if why else estimate)
        told = f"passes a first-order low-pass of {corner:.3g} ± {corner * std / seconds:.2g} Hz"
    else:
        is_sharp = std < _IDENTIFIED_SAMPLES * period_s
        status = Status.IDENTIFIED if is_sharp and not why else Status.WEAK
        found = WrenchFilterEstimate(delay_s=Estimate(value=seconds, std=std, status=status, method=_METHOD, note=why))
        told = f"comes {1e3 * seconds:.3f} ± {1e3 * std:.2g} ms late"
    return found, (_told(told, tuple(alike), why),)


def _together(alike: Mapping[str, Lag]) -> tuple[float, float, str]:
    """Return mean and deviation of what the axes show, the largest where they disagree, and why it is weak then."""
    values, stds = np.array([lag.seconds for lag in alike.values()]), np.array([lag.std_s for lag in alike.values()])
    weights = stds**-2.0
    mean = float(weights @ values / np.sum(weights))
    apart = float(np.max(values) - np.min(values))
    if apart > max(_APART_STDS * float(np.max(stds)), _APART_SHARE * mean):
        return float(np.max(values)), apart, "the axes disagree; the latest counts"
    squares = float(np.sum(weights * (values - mean) ** 2)) / max(len(values) - 1, 1)
    return mean, float(np.min(stds)) * max(1.0, float(np.sqrt(squares))), ""


def _told(told: str, axes: tuple[str, ...], why: str) -> Finding:
    return Finding(
        code="wrench-filter",
        severity="warning" if why else "info",
        message=f"The wrench {told} (axis {', '.join(axes)}){f': {why}' if why else ''}. It is in the loop, and in "
        "`sensor.wrench_filter`.",
        advice="",
    )
