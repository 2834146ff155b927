"""The plain admittance 1/(M_a s² + B_a s): force to displacement, period by period."""

import math
from typing import Any

from problems.errors import ParameterError
from problems.model.difference import controller_step, write_blocks


class PlainAdmittance:
    """The admittance 1/(M_a s² + B_a s), without lead or compensation, in its Tustin form.

    Equation (1) of Haninger et al. with K_l = 0; force to displacement, from rest. With a payload of little drag it can
    be unstable at any M_a and B_a that a person would guess, so that `FirstLog` does without.

    Parameters
    ----------
    mass_kg, damping_n_s_per_m
        M_a and B_a. More damping is safer in contact: the approach is F^d/B_a.
    period_s
        How often it is stepped.

    Raises
    ------
    ParameterError
        A number that is not above 0.

    """

    def __init__(self, *, mass_kg: float = 20.0, damping_n_s_per_m: float = 2000.0, period_s: float) -> None:
        for name, value in (("mass_kg", mass_kg), ("damping_n_s_per_m", damping_n_s_per_m), ("period_s", period_s)):
            if not (math.isfinite(value) and value > 0.0):
                raise ParameterError(name, value, "a finite number above 0")
        self._blocks: dict[Any, float] = {}
        # The filters have no gain here; their corners only have to be some.
        write_blocks(self._blocks, (mass_kg, damping_n_s_per_m, 0.0, 0.0, 1.0, 1.0, 0.0), period_s, 0.5, ideal=False)
        self._state = (0.0,) * 6

    def step(self, force_n: float) -> float:
        """Return the displacement [m] that is commanded in this period for F^d + F [N]."""
        command, self._state = controller_step(self._blocks, self._state, force_n, 0.0)
        return float(command)
