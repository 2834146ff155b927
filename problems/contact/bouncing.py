"""Whether a contact comes to rest: two stable linear loops, in contact and in free space, do not make it so.

A contact that is left and made again switches between two loops. Each of them may be stable and the contact still
bounce for ever; this is decided by following the exact sampled loop from the impact on (`bouncing_kernel`).
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from ..model.controller import AdmittanceController
from ..model.linear_controllers import LinearLaw
from ..model.sampled import build_loop, spectral_radius
from ..stability.margins import UnstableLoopError
from .bouncing_kernel import BOUNCING, SETTLED, follow_bounces
from .linear_controller_contact import follow_law_bounces
from .transient import Approach, SampledContact, begin_contact, longest_run

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
class Followed:
    """How a contact ended after `duration_s`, and its last settling time (`window_s`).

    `peak_contact_force_n` is the largest contact force in that time, `leaves_per_s` how often the contact was left.
    """

    ending: Ending
    duration_s: float
    window_s: float
    peak_contact_force_n: float
    leaves_per_s: float


def settling_window(pair: SampledContact, law: AdmittanceController | LinearLaw) -> int:
    """Return in how many samples the slower of the two linear motions settles, at most those of the longest transient.

    Raises UnstableLoopError if the loop in contact or in free space is not stable.
    """
    # A weak spring of the law takes seconds in free space, of which a bounce has none.
    plants = (pair.contact,) if isinstance(law, LinearLaw) and law.holds_position else (pair.free, pair.contact)
    radius = max(spectral_radius(build_loop(plant, law)) for plant in plants)
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    decay = math.ceil(_DECAY_EXPONENTS / -math.log(radius)) if radius > 0.0 else 0
    return min(max(_SHORTEST_WINDOW, decay), longest_run(pair.free.sample_time_s))


def follow_contact(
    pair: SampledContact, law: AdmittanceController | LinearLaw, approach: Approach, *, window: int | None = None
) -> Followed:
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
    if isinstance(law, LinearLaw):
        verdict, count = follow_law_bounces(pair, law, approach, length, peaks, switches)
    else:
        begun, room = begin_contact(pair, law, approach), (np.empty(length), np.empty(length))
        verdict, count = follow_bounces(pair.arguments, begun.blocks, begun.start, begun.forces, room, peaks, switches)
    return Followed(
        ending={SETTLED: Ending.SETTLED, BOUNCING: Ending.BOUNCING}.get(verdict, Ending.DECAYING),
        duration_s=count * length * h,
        window_s=length * h,
        peak_contact_force_n=float(peaks[count - 1]),
        leaves_per_s=0.5 * int(switches[count - 1]) / (length * h),
    )
