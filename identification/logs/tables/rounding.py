"""Times that were rounded when a table was written, put back on the even clock that explains all of them."""

from dataclasses import dataclass

import numpy as np

from ...signals.recording import StampArray

_FEWEST = 20
_FINEST_NS = 1000
_COARSE_SHARE = 0.02
_SLACK = 1.05


@dataclass(frozen=True, kw_only=True)
class RoundedTimes:
    """Stamps (n,) on the even clock that the rounded ones come from, its rate, and what they were rounded to."""

    even_ns: StampArray
    rate_hz: float
    quantum_ns: int


def find_rounding(stamp_ns: StampArray) -> RoundedTimes | None:
    """Return the even clock of which stamps (n,) are the rounded readings; None where there is none, or no need of it.

    All steps are multiples of one quantum that is no small share of the period, and no stamp is off a straight line by
    more than rounding or cutting digits off explains. A lost row, or a clock that is not even, departs from the line.
    """
    if len(stamp_ns) < _FEWEST:
        return None
    steps = np.diff(stamp_ns)
    quantum = int(np.gcd.reduce(steps))
    if int(steps.min()) < 0 or int(steps.min()) == int(steps.max()) or quantum < _FINEST_NS:
        return None
    since = (stamp_ns - stamp_ns[0]).astype(np.float64)
    rows = np.arange(len(stamp_ns)) - 0.5 * (len(stamp_ns) - 1)
    period = float(rows @ since) / float(rows @ rows)
    line = since.mean() + period * rows
    if quantum < _COARSE_SHARE * period or float(np.ptp(since - line)) > _SLACK * quantum:
        return None
    even: StampArray = stamp_ns[0] + np.rint(line).astype(np.int64)
    return RoundedTimes(even_ns=even, rate_hz=1e9 / period, quantum_ns=quantum)
