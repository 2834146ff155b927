"""Compiled loops of maps: over plants, and over the designs on one plant."""

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray, IntArray
from ..compiled import compiled
from ..contact.kernel_types import POSITION, SENSED
from ..model.plant import ENVIRONMENT_STIFFNESS, OF_FORCE, PLANT_PARAMETERS, write_plant
from ..model.sampled import hold_columns
from ..stability.margin_kernel import EVERY_MARGIN, MODULUS_ALONE, Grid, find_loop_margins
from ..stability.polynomials import CONTROLLER_POWERS, controller_polynomials, plant_polynomials


@compiled
def polynomials_of_plants(
    robots: tuple[FloatArray, FloatArray],
    parameters: FloatArray,
    delays: tuple[IntArray, FloatArray],
    h: float,
    out: FloatArray,
) -> None:
    """Write the polynomials of many plants into `out` (p, 3, L), see `plant_polynomials`.

    `robots` are numerators (p, n) and denominators (p, n + 1) as `RobotModel.ascending` gives them, `parameters`
    (p, 7), or (p, 8) of a filtered wrench, as `Plant.parameters`, `delays` whole samples (p,) and fractions (p,). The
    same steps as in `build_sampled_plant`, without what stability does not need. NaN where the motion overflows.
    """
    (numerators, denominators), (wholes, fractions) = robots, delays
    n = denominators.shape[1] + 1 + parameters.shape[1] - PLANT_PARAMETERS
    for k in range(len(parameters)):
        whole, fraction = wholes[k], fractions[k]
        a, b, outputs = np.zeros((n, n)), np.zeros(n), np.zeros((2, n + 2))
        push, c_contact, direct = np.zeros(n), np.zeros(n), np.zeros(3)
        c_position, c_force = outputs[POSITION, :n], outputs[SENSED, :n]
        write_plant(
            a, b, push, c_position, c_force, c_contact, direct, numerators[k], denominators[k], parameters[k], h
        )
        outputs[SENSED, n] = direct[OF_FORCE]
        whole_step = hold_columns(a, b.reshape(n, 1), 1.0)
        phi, gamma = np.ascontiguousarray(whole_step[:n, :n]), np.ascontiguousarray(whole_step[:n, n])
        if not np.all(np.isfinite(phi)):
            out[k, :, :] = np.nan
            continue
        gamma_old = np.zeros(n)
        if fraction > 0.0:
            newer = np.ascontiguousarray(hold_columns(a, b.reshape(n, 1), 1.0 - fraction)[:n, n])
            gamma_old[:] = gamma - newer
            gamma = newer
        chain = whole + (1 if fraction > 0.0 else 0)
        delay, free = (whole, chain, fraction), parameters[k, ENVIRONMENT_STIFFNESS] == 0.0
        found = plant_polynomials(phi, gamma, gamma_old, outputs, delay, free)
        out[k, :, : found.shape[1]] = found


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

    `polynomials` and `grid` are the plant's as in `PreparedMargins`, `designs` (m, 7) controller parameters, `sampling`
    (h, θ, ideal).
    """
    h, theta, ideal = sampling
    controller = np.zeros((3, CONTROLLER_POWERS))
    for i in range(len(designs)):
        if wanted[i]:
            degree = controller_polynomials(designs[i], ideal, controller)
            find_loop_margins(
                polynomials, grid, controller, degree, (h, theta), EVERY_MARGIN if everything else MODULUS_ALONE, out[i]
            )
