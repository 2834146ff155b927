"""Windows of motion: what one payload on one spring explains of a motion that holds a hand or a contact too."""

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np

from problems.arrays import FloatArray

from ..signals.segments import Span
from .segments import Segment

SHORTEST_S = 1.0
_WINDOW_S = 0.5
_PIECE_S = 2.0
_DRIVEN = 0.3
_CHANGE_S = 5e-3


def cut(spans: Iterable[Segment], length_s: float, period_s: float) -> list[Segment]:
    """Cut spans into pieces of this length, as nearly as they divide; shorter ones stay whole."""
    pieces = []
    for span in spans:
        count = max(1, round(len(span) * period_s / length_s))
        edges = np.linspace(span.start, span.stop, count + 1).round().astype(int).tolist()
        pieces += [Segment(start=start, stop=stop) for start, stop in pairwise(edges)]
    return pieces


def windows_of(spans: Iterable[Segment], period_s: float) -> list[Segment]:
    """Cut spans into windows of about half a second."""
    return cut(spans, _WINDOW_S, period_s)


def informative_pieces(
    spans: Iterable[Segment], position_m: FloatArray, force_n: FloatArray, period_s: float
) -> list[Segment]:
    """Return the pieces of two seconds in which nothing drives the payload, those whose force changes most first.

    A passive payload takes work and gives back what it took: ∫F dx is not most of ∫|F dx|, as where a hand leads it.
    Changes are those over 5 ms: a force that only holds, on a surface, shows nothing of the payload.
    """
    passive, lag = [], max(1, round(_CHANGE_S / period_s))
    for piece in cut(spans, _PIECE_S, period_s):
        power = force_n[piece.slice][:-1] * np.diff(position_m[piece.slice])
        if len(piece) * period_s >= SHORTEST_S and float(np.sum(power)) < _DRIVEN * float(np.sum(np.abs(power))):
            force = force_n[piece.slice]
            passive.append((float(np.sum((force[lag:] - force[:-lag]) ** 2)), piece))
    return [piece for _, piece in sorted(passive, key=lambda pair: -pair[0])]


def joined(windows: Sequence[Segment], period_s: float) -> list[Segment]:
    """Join windows, by their time, that follow each other without a gap; what is shorter than a second is left out."""
    runs: list[Segment] = []
    for window in windows:
        if runs and runs[-1].stop == window.start:
            runs[-1] = Segment(start=runs[-1].start, stop=window.stop)
        else:
            runs.append(window)
    return [run for run in runs if len(run) * period_s >= SHORTEST_S]


def outside(segment: Segment, others: Sequence[Segment | Span]) -> bool:
    """Return whether a span overlaps none of others."""
    return not any(o.start < segment.stop and segment.start < o.stop for o in others)
