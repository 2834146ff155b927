"""The same return differences on another road: determinants of the loop's matrices in double precision."""

import numpy as np
from numpy.typing import NDArray

from autotune.certificate.family import Family
from problems.arrays import FloatArray
from problems.design.uncertainty import MASS, STIFFNESS
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.sampled import build_cut_loop, build_sampled_plant
from tests.problems.axes import PERIOD_S, paper_plant


def smallest_return_difference(plant: Plant, law: AdmittanceController, angles: FloatArray) -> FloatArray:
    """Return the smaller |1 + L| of both break points at angles [rad/sample], as ratios of determinants."""
    cut = build_cut_loop(build_sampled_plant(plant, PERIOD_S), law)
    z = np.exp(1j * np.asarray(angles))[:, None, None]
    n = cut.state_count

    def characteristic(matrix: FloatArray) -> NDArray[np.complex128]:
        return np.asarray(np.linalg.det(z * np.eye(n) - matrix[:n, :n]), dtype=np.complex128)

    closed = cut.closed_at(cut.command, cut.force)
    found = []
    for signal, other in ((cut.force, cut.command), (cut.command, cut.force)):
        opened = cut.closed_at(other)
        direct = 1.0 - opened[signal, signal]
        found.append(np.abs(direct * characteristic(closed) / characteristic(opened)))
    return np.asarray(np.min(found, axis=0))


def family(
    stiffness: tuple[float, float] = (5e4, 2e5),
    mass: tuple[float, float] = (15.0, 17.0),
    *,
    nominal: Plant | None = None,
    **further: tuple[float, float],
) -> Family:
    plant = nominal if nominal is not None else paper_plant(stiffness=stiffness[0], mass=mass[0], drag=400.0)
    return Family(nominal=plant, ranges={STIFFNESS: stiffness, MASS: mass, **further}, sample_time_s=PERIOD_S)
