"""Compiled loop over the designs of a map on one plant."""

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled
from .margin_kernel import Grid, find_loop_margins
from .polynomials import CONTROLLER_POWERS, controller_polynomials

FloatArray = NDArray[np.float64]


@compiled
def margins_of_plant(
    polynomials: FloatArray,
    grid: Grid,
    designs: FloatArray,
    wanted: NDArray[np.bool_],
    sampling: tuple[float, float, bool],
    everything: bool,
    out: FloatArray,
) -> None:
    """Write the margins of the wanted, stable loops into rows of `out` (m, MARGINS), see `find_loop_margins`.

    `polynomials` and `grid` are the plant's as in `PreparedMargins`, `designs` (m, 7) controller parameters, `sampling` (h, θ, ideal).
    """
    h, theta, ideal = sampling
    controller = np.zeros((3, CONTROLLER_POWERS))
    for i in range(len(designs)):
        if wanted[i]:
            degree = controller_polynomials(designs[i], ideal, controller)
            find_loop_margins(polynomials, grid, controller, degree, (h, theta), everything, out[i])
