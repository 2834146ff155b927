"""Compiled: follow one contact until it has come to rest, or has been bouncing for too long to come to rest."""

import numpy as np
from numpy.typing import NDArray

from ..compiled import compiled
from .kernel import Contact, Start, first_moment, walk

FloatArray = NDArray[np.float64]

# Verdicts: the contact is made for good; it is left again and again and its impacts do not get weaker; it is still
# left at the end, but its impacts do get weaker.
SETTLED, BOUNCING, DECAYING = 0, 1, 2

# Windows that two pairs of them are compared over, the first window (the impact itself) left out.
_COMPARED = 4
_UNDIMINISHED = 0.9
# An impact this far above the force at rest, as a share of it, is none.
_NO_IMPACT = 0.01


@compiled
def follow_bounces(
    plant: Contact,
    blocks: FloatArray,
    start: Start,
    forces: tuple[float, float],
    room: tuple[FloatArray, FloatArray],
    peaks: FloatArray,
    switches: NDArray[np.int64],
) -> tuple[int, int]:
    """Follow a contact over windows and return the verdict with the number of windows.

    A window is as long as `room`, two arrays that are written over; it must be the time in which the slower of the two
    linear motions, in contact and in free space, settles. `peaks` (w,) gets the largest F_e of each window, `switches`
    (w,) in how many samples of it the contact began or ended; w is the most that is followed. A window without a
    switch that ends in contact is linear throughout, so the motion has settled.
    """
    now, flags = first_moment(start, plant[3], np.zeros(5))
    found, crest, length = np.zeros(5), np.full((2, len(now[0]) + 3), -1.0), len(room[0])
    for w in range(len(peaks)):
        found[:], before = 0.0, flags[2]
        walk(plant, blocks, now, flags, forces, (0, length, length), room, found, crest)
        peaks[w], switches[w] = found[2], flags[2] - before
        verdict = judge_window(peaks, switches, w, flags[1] == 1, forces[0] + forces[1])
        if verdict >= 0:
            return verdict, w + 1
    return DECAYING, len(peaks)


@compiled
def judge_window(peaks: FloatArray, switches: NDArray[np.int64], w: int, touching: bool, rest: float) -> int:
    """Return SETTLED or BOUNCING if windows 0 to w tell so, else -1; `rest` is the force at rest."""
    if switches[w] == 0 and touching:
        return SETTLED
    if w >= _COMPARED:
        late, early = max(peaks[w], peaks[w - 1]) - rest, max(peaks[w - 2], peaks[w - 3]) - rest
        left = np.min(switches[w - _COMPARED + 1 : w + 1]) > 0
        if left and late > _NO_IMPACT * rest and late >= _UNDIMINISHED * early:
            return BOUNCING
    return -1
