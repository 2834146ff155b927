"""How the force on what is touched grows with depth, seen through the coupling: K_e between two ends."""

from dataclasses import dataclass

import numpy as np

from ..result import Estimate
from .law import ContactTimes
from .payload import AxisContacts, Payload, press_sign

_TOUCHED_SHARE = 0.1
_FEWEST_SAMPLES = 12
_CLEAR_SHARE = 0.9
# What a slope leaves out: dry friction, a payload seen up to two of its resonances, a surface that is no spring.
_LEFT_OUT_SHARE = 0.07
_MOST_SHARE = 0.5
_STDS = 3.0


@dataclass(frozen=True, kw_only=True)
class Slope:
    """K_e of what is touched lies between `low_n_per_m` and `high_n_per_m`; `sign` is that of the direction."""

    sign: int
    low_n_per_m: float
    high_n_per_m: float

    @property
    def stiffness_n_per_m(self) -> float:
        """Return the middle of both ends."""
        return 0.5 * (self.low_n_per_m + self.high_n_per_m)


def learn_slope(of: AxisContacts, payload: Payload, contact: ContactTimes, coupling: Estimate) -> Slope | None:
    """Return the slope of F_e = K_e (x_p − x_w) over the samples in which a contact touches, None if it is not clear.

    The lower end is the slope of force over way, the upper end the inverse of that of way over force (errors in either
    of them), both wider by three deviations of what K_s, `coupling` [N/m], and the model leave open, with
    dK_e = K_e² d(1/K_s). Clear: nine tenths of the variance, no softer than a surface may be, and open by half at most.
    """
    sign = int(press_sign(of, contact.hold))
    force, way = sign * payload.touch_n[contact.span.slice], sign * payload.position_m[contact.span.slice]
    known = np.isfinite(force) & np.isfinite(way)
    highest = float(np.max(force, initial=0.0, where=known))
    touches = known & (force > max(of.smallest_n, _TOUCHED_SHARE * highest))
    if np.count_nonzero(touches) < _FEWEST_SAMPLES or coupling.value is None or coupling.std is None:
        return None
    spread = np.cov(way[touches], force[touches])
    if not (spread[0, 0] > 0.0 and spread[0, 1] > 0.0):
        return None
    low, high = float(spread[0, 1] / spread[0, 0]), float(spread[1, 1] / spread[0, 1])
    left_open = _STDS * float(np.hypot(_LEFT_OUT_SHARE, high * coupling.std / coupling.value**2))
    if low < _CLEAR_SHARE * high or low < of.softest_n_per_m or left_open > _MOST_SHARE:
        return None
    return Slope(sign=sign, low_n_per_m=low * (1.0 - left_open), high_n_per_m=high * (1.0 + left_open))
