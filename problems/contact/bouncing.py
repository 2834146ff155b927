"""Whether a contact comes to rest: two stable linear loops, in contact and in free space, do not make it so.

A contact that is left and made again switches between two loops. Each of them may be stable and the contact still
bounce for ever; this is decided by following the exact sampled loop from the impact on (`follow_bounces`).
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.controller import AdmittanceController
from ..model.linear_controllers import LinearController
from ..model.sampled import build_loop, spectral_radius
from ..stability.margins import UnstableLoopError
from .kernel import first_moment, walk
from .kernel_types import CONTACT_PEAK, FOUND, SWITCHES, TOUCHING, Contact, Forces, RunResults, Start, TickRange, Traces
from .linear_controller_contact import begin_linear_contact, run_linear_contact
from .transient import Approach, SampledContact, begin_contact, longest_run

# Verdicts: the contact is made for good; it is left again and again and its impacts do not get weaker; it is still
# left at the end, but its impacts do get weaker.
SETTLED, BOUNCING, DECAYING = 0, 1, 2

# Windows that two pairs of them are compared over, the first window (the impact itself) left out.
_COMPARED = 4
_UNDIMINISHED = 0.9
# An impact this far above the force at rest, as a share of it, is none.
_NO_IMPACT = 0.01
# A linear motion has settled when its slowest part has decayed to exp(-7), a thousandth.
_DECAY_EXPONENTS = 7.0
_SHORTEST_WINDOW = 64
WINDOWS = 12
"""After so many settling times a contact is given up whose impacts get weaker, but which has not come to rest."""


class Ending(Enum):
    """How a contact ended; the text says it."""

    SETTLED = "came to rest"
    BOUNCING = "bounces on, with impacts that do not get weaker"
    DECAYING = "still bounced at the end, with impacts that got weaker"


@dataclass(frozen=True, kw_only=True)
class ContactOutcome:
    """How a contact ended after `duration_s`.

    `peak_contact_force_n` is the largest contact force in that time, `leaves_per_s` how often the contact was left.
    """

    ending: Ending
    duration_s: float
    peak_contact_force_n: float
    leaves_per_s: float


def settling_window(pair: SampledContact, law: AdmittanceController | LinearController) -> int:
    """Return in how many samples the slower of the two linear motions settles, at most those of the longest transient.

    Raises UnstableLoopError if the loop in contact or in free space is not stable.
    """
    # A weak spring of the law takes seconds in free space, of which a bounce has none.
    plants = (pair.contact,) if isinstance(law, LinearController) and law.holds_position else (pair.free, pair.contact)
    radius = max(spectral_radius(build_loop(plant, law)) for plant in plants)
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    decay = math.ceil(_DECAY_EXPONENTS / -math.log(radius)) if radius > 0.0 else 0
    return min(max(_SHORTEST_WINDOW, decay), longest_run(pair.free.sample_time_s))


def follow_contact(
    pair: SampledContact, law: AdmittanceController | LinearController, approach: Approach, *, window: int | None = None
) -> ContactOutcome:
    """Follow one impact of the exact sampled loop until it has come to rest, or bounces for ever.

    It has come to rest when the contact is not left for a whole `window` of samples, by default the time in which the
    slower of the two linear motions settles. It bounces when it was left in each of four windows in a row, the first
    one not counted, and the largest force of the last two is, above the force at rest, at least nine tenths of that of
    the two before. No bounce that decays to nothing in a finite time is called so; one that decays by less than a
    tenth in two settling times is. `WINDOWS` are followed at most.

    Raises UnstableLoopError if the loop in contact or in free space is not stable.
    """
    length, h = settling_window(pair, law) if window is None else window, pair.free.sample_time_s
    peaks, switches = np.zeros(WINDOWS), np.zeros(WINDOWS, dtype=np.int64)
    if isinstance(law, LinearController):
        verdict, count = _follow_linear(pair, law, approach, length, peaks, switches)
    else:
        begun, work = begin_contact(pair, law, approach), Traces(np.empty(length), np.empty(length))
        verdict, count = follow_bounces(pair.arguments, begun.blocks, begun.start, begun.forces, work, peaks, switches)
    return ContactOutcome(
        ending={SETTLED: Ending.SETTLED, BOUNCING: Ending.BOUNCING}.get(verdict, Ending.DECAYING),
        duration_s=count * length * h,
        peak_contact_force_n=float(peaks[count - 1]),
        leaves_per_s=0.5 * int(switches[count - 1]) / (length * h),
    )


def _follow_linear(
    pair: SampledContact,
    law: LinearController,
    approach: Approach,
    window: int,
    peaks: FloatArray,
    switches: NDArray[np.int64],
) -> tuple[int, int]:
    """Follow a contact over windows, see `follow_bounces`; a contact ends on the grid of the parts."""
    loop, start, force, _ = begin_linear_contact(pair, law, approach)
    force, touching = force if approach.after_impact_n is None else approach.after_impact_n, True
    for w in range(len(peaks)):
        found = np.zeros(FOUND)
        touching, switches[w] = run_linear_contact(loop, start, force, window, touching, found)
        peaks[w] = found[CONTACT_PEAK]
        verdict = judge_window(peaks, switches, w, touching, force)
        if verdict >= 0:
            return verdict, w + 1
    return DECAYING, len(peaks)


@compiled
def follow_bounces(
    plant: Contact,
    blocks: FloatArray,
    start: Start,
    forces: Forces,
    work: Traces,
    peaks: FloatArray,
    switches: NDArray[np.int64],
) -> tuple[int, int]:
    """Follow a contact over windows and return the verdict with the number of windows.

    A window is as long as the arrays of `work`, which are written over: the time in which the slower of the two linear
    motions, in contact and in free space, settles. `peaks` (w,) gets the largest F_e of each window, `switches`
    (w,) in how many samples of it the contact began or ended; w is the most that is followed. A window without a
    switch that ends in contact is linear throughout, so the motion has settled.
    """
    now, flags = first_moment(start, plant, np.zeros(FOUND))
    found, crest, length = np.zeros(FOUND), np.full((2, len(now.state) + 3), -1.0), len(work.sensed)
    results = RunResults(work, found, crest)
    for w in range(len(peaks)):
        found[:], before = 0.0, flags[SWITCHES]
        walk(plant, blocks, now, flags, forces, TickRange(0, length, length), results)
        peaks[w], switches[w] = found[CONTACT_PEAK], flags[SWITCHES] - before
        verdict = judge_window(peaks, switches, w, flags[TOUCHING] == 1, forces.desired + forces.push)
        if verdict >= 0:
            return verdict, w + 1
    return DECAYING, len(peaks)


@compiled
def judge_window(peaks: FloatArray, switches: NDArray[np.int64], w: int, touching: bool, rest: float) -> int:
    """Return SETTLED or BOUNCING if windows 0 to w show it, else -1; `rest` is the force at rest."""
    if switches[w] == 0 and touching:
        return SETTLED
    if w >= _COMPARED:
        late, early = max(peaks[w], peaks[w - 1]) - rest, max(peaks[w - 2], peaks[w - 3]) - rest
        left = np.min(switches[w - _COMPARED + 1 : w + 1]) > 0
        if left and late > _NO_IMPACT * rest and late >= _UNDIMINISHED * early:
            return BOUNCING
    return -1
