"""Where the payload swings freely after something let go of it: a hand's tap, a surface."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from ..signals.segments import Span
from .straight import AxisMotion

FloatArray = NDArray[np.float64]

_LET_GO_S = 0.025
_SHORTEST_S, _LONGEST_S = 0.25, 1.5
_BETWEEN_TAPS_S = 0.3
_TAP_SHARE = 0.3
_NOISES = 8.0
_BEHIND_S = 0.2
_MOST = 12
_LARGEST_TRAVEL_M = 2e-3


def find_rings(
    axis: AxisMotion,
    moving: Sequence[Span],
    free: Sequence[Span],
    holds: Sequence[Span],
    noise_rms_n: float,
    period_s: float,
) -> tuple[Span, ...]:
    """Return spans in which nothing may touch the payload any more, at most the 12 with most force.

    `moving` are all spans that are not at rest (a tap is one, the flange need not travel), `free` those known to be
    without a hand, `holds` the rests under force. After a tap, from 25 ms behind the highest force; after a hold, from
    where the force changes its sign: pressed, the payload pushes the flange back, drawn away it is dragged along. Where
    the flange travels 2 mm or more without a hold before, somebody leads it.
    Whether a hand was still there is for the fit to tell.
    """
    known = {(s.start, s.stop) for s in free}
    held = {hold.stop: hold for hold in holds}
    found: list[Span] = []
    for span in moving:
        if (span.start, span.stop) in known:
            continue
        hold = held.get(span.start)
        if hold is not None:
            found += _release(axis, span, hold, period_s)
        elif float(np.ptp(axis.position_m[span.slice])) < _LARGEST_TRAVEL_M:
            found += _taps(axis, span, noise_rms_n, period_s)
    found.sort(key=lambda s: -float(np.sum(axis.force_n[s.slice] ** 2)))
    return tuple(sorted(found[:_MOST], key=lambda s: s.start))


def _taps(axis: AxisMotion, span: Span, noise_rms_n: float, period_s: float) -> list[Span]:
    force = np.abs(axis.force_n[span.slice] - np.median(axis.force_n[span.slice]))
    lowest = max(_NOISES * noise_rms_n, _TAP_SHARE * float(np.max(force)))
    peaks = find_peaks(np.pad(force, 1), height=lowest, distance=max(1, round(_BETWEEN_TAPS_S / period_s)))[0] - 1
    last = min(span.stop + round(_BEHIND_S / period_s), len(axis.force_n))
    let_go = round(_LET_GO_S / period_s)
    edges = [*(span.start + int(peak) - let_go for peak in peaks), last]
    return [s for i, stop in enumerate(edges[1:]) for s in _span(edges[i] + 2 * let_go, stop, period_s)]


def _release(axis: AxisMotion, span: Span, hold: Span, period_s: float) -> list[Span]:
    force = axis.force_n[span.slice]
    pulled = np.flatnonzero(force * np.sign(np.median(axis.force_n[hold.slice])) < 0.0)
    if not pulled.size:
        return []
    return _span(span.start + int(pulled[0]) + round(_LET_GO_S / period_s), span.stop, period_s)


def _span(start: int, stop: int, period_s: float) -> list[Span]:
    stop = min(stop, start + round(_LONGEST_S / period_s))
    return [Span(start=start, stop=stop)] if stop - start >= _SHORTEST_S / period_s else []
