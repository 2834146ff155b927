"""What of a force turns the payload on its coupling, out of torque, centre of mass and inertia.

About the centre of mass c, F = −m (a + α × c) and τ − c × F = −I_C α, a being the acceleration of the sensor's origin.
"""

import numpy as np

from problems.arrays import FloatArray

from ..result import Status
from ..signals.aligned import AlignedLog
from .gravity import GravityFit
from .inertia import InertiaFit, inertia_matrix

_PART = 2**16


def turning_force(
    force_S_n: FloatArray, torque_S_n_m: FloatArray, mass_kg: float, com_S_m: FloatArray, inertia_kg_m2: FloatArray
) -> FloatArray:
    """Return −m α × c (n, 3) [N] of a payload that only the sensor holds, from its force and torque (n, 3).

    Weight and bias are taken off; `inertia_kg_m2` (3, 3) is about the sensor's origin.
    """
    about_com = inertia_kg_m2 - _of_point(mass_kg, com_S_m)
    turned = np.linalg.solve(about_com, (torque_S_n_m - np.cross(com_S_m, force_S_n)).T).T
    return np.asarray(mass_kg * np.cross(turned, com_S_m))


def turning_of_payload(
    log: AlignedLog, force_S_n: FloatArray, gravity: GravityFit, inertia: InertiaFit
) -> FloatArray | None:
    """Return `turning_force` of a log (n, 3), NaN along axes for which the inertia is not known; None for all three.

    Along an axis the turns about the two others count, whose moments must be identified. What else is not known of the
    tensor is that of a body alike in all directions about its centre of mass.
    """
    mass, com = gravity.mass_kg, gravity.com_S_m
    known = [each.status is Status.IDENTIFIED for each in inertia.components[:3]]
    useful = [all(known[i] for i in range(3) if i != axis) for axis in range(3)]
    if not gravity.has_torque or not any(useful):
        return None
    of_point = _of_point(mass, com)
    tensor = inertia_matrix(np.array([np.nan if each.value is None else each.value for each in inertia.components]))
    usual = np.nanmean(np.where(known, np.diag(tensor - of_point), np.nan))
    fill = of_point + usual * np.eye(3)
    tensor = np.where(np.isnan(tensor), fill, tensor)
    for i in range(3):
        tensor[i, i] = tensor[i, i] if known[i] else fill[i, i]
    if not np.all(np.linalg.eigvalsh(tensor - of_point) > 0.0):
        return None
    torque = gravity.compensated_torque_S_n_m(log)
    found = np.empty_like(torque)
    for part in (slice(first, first + _PART) for first in range(0, len(torque), _PART)):
        found[part] = turning_force(force_S_n[part], torque[part], mass, com, tensor)
    found[:, ~np.array(useful)] = np.nan
    return found


def _of_point(mass_kg: float, at_m: FloatArray) -> FloatArray:
    """Return the inertia (3, 3) of a point mass about the origin."""
    return np.asarray(mass_kg * (at_m @ at_m * np.eye(3) - np.outer(at_m, at_m)))
