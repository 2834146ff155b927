"""The damping ratio of the slowest oscillation of every plant's loop."""

import math

import numpy as np
from numpy.typing import ArrayLike

from ...model.sampled import Controller, SampledPlant, build_cut_loop, stability_matrix
from ..stable_design import StableLoop
from .base import LoopRequirement

# An imaginary part below this share of |z| is rounding of a double real pole.
_REAL = 1e-7


class DampingRatio(LoopRequirement[float]):
    """ζ = −Re s/|s| of the slowest oscillating mode, s = ln(z)/h of an eigenvalue z of the sampled loop.

    The slowest mode is that of the largest |z|. Asked of every loop, in contact and in free space; infinite where
    nothing oscillates. Its gradient is that of central differences.
    """

    name, title = "min_damping_ratio", "damping ratio"
    must_be_below = (1.0, "a mode whose damping ratio is 1 does not oscillate")

    def of_loop(self, asked: float, loop: StableLoop) -> float:
        """Return the damping ratio from the eigenvalues of the closed loop."""
        del asked
        return slowest_damping_ratio(np.linalg.eigvals(stability_matrix(loop.matrices)))

    def verified(self, asked: float, sampled: SampledPlant, controller: Controller) -> float:
        """Return the damping ratio from the loop that was cut and closed again at the command and at the force."""
        del asked
        cut = build_cut_loop(sampled, controller)
        closed = cut.closed_at(cut.command, cut.force)
        return slowest_damping_ratio(np.linalg.eigvals(closed[:-2, :-3]))


def slowest_damping_ratio(eigenvalues: ArrayLike) -> float:
    """Return the damping ratio of the oscillating eigenvalue of the largest |z|; infinite without any.

    A negative real z alternates from tick to tick: it oscillates at the Nyquist frequency.
    """
    z = np.asarray(eigenvalues, dtype=np.complex128)
    oscillating = z[(np.abs(z.imag) > _REAL * np.abs(z)) | (z.real < 0.0)]
    if not oscillating.size:
        return math.inf
    s = np.log(oscillating[np.argmax(np.abs(oscillating))])
    return float(-s.real / np.abs(s))
