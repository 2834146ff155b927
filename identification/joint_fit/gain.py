"""A sensor whose scale is not what it should be: everything mechanical is off by the same share."""

from dataclasses import replace

import numpy as np

from .result import JointFit

_MECHANICAL = ("stiffness_n_per_m", "damping_n_s_per_m", "drag_n_s_per_m", "mass_kg")


def with_gain_error(fit: JointFit, share: float) -> JointFit:
    """Return the fit with a deviation of `share` common to all stiffnesses, dampings and masses, secants included.

    F = Z(s) X: a force that is wrong by a share makes every coefficient of Z wrong by it, and no residual shows it.
    """
    if share == 0.0:
        return fit
    common = np.where([name.endswith(_MECHANICAL) for name in fit.names], share * fit.values, 0.0)
    surfaces = tuple(
        replace(surface, secant_std_n_per_m=float(np.hypot(surface.secant_std_n_per_m, share * surface.secant_n_per_m)))
        for surface in fit.surfaces
    )
    return replace(fit, covariance=fit.covariance + np.outer(common, common), surfaces=surfaces)
