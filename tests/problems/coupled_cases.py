"""x and ry of a payload of 16 kg whose centre of mass lies 0.15 m off the sensor, and laws for both."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.coupled import CoupledLoop, CoupledPlant, PointSurface, RigidPayload, reduced_loop
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.stability.coupled_margins import largest_gain
from tests.problems.axes import one_pole

COM_M, INERTIA_KG_M2 = 0.15, 0.7
SCALE = np.array([1.0, 0.2])
LAWS = (
    AdmittanceController(mass_kg=16.0, damping_n_s_per_m=1200.0, lead_s=0.01, feedback_damping_s=0.005),
    AdmittanceController(mass_kg=0.64, damping_n_s_per_m=48.0, lead_s=0.01),
)


def axis(stiffness: float, damping: float, drag: float, delay_s: float) -> Plant:
    return Plant(
        robot=one_pole(delay_s),
        coupling=Coupling(stiffness_n_per_m=stiffness, damping_n_s_per_m=damping),
        payload=PayloadDynamics(mass_kg=1.0, drag_n_s_per_m=drag),
    )


# A whole delay, and one with a fraction.
PLANTS = (axis(3e5, 150.0, 300.0, 2.4e-3), axis(1e4, 3.0, 12.0, 2.63e-3))


def body(com_m: float = COM_M) -> RigidPayload:
    inertia = np.diag([INERTIA_KG_M2, INERTIA_KG_M2, 0.2])
    return RigidPayload(mass_kg=16.0, com_S_m=np.array([0.0, 0.0, com_m]), inertia_S_kg_m2=inertia)


def cell(com_m: float = COM_M, surface: PointSurface | None = None) -> CoupledPlant:
    return CoupledPlant(plants=PLANTS, mass_matrix=body(com_m).mass_matrix[np.ix_([0, 4], [0, 4])], surface=surface)


def wall(stiffness: float = 1e5, direction: FloatArray | None = None, damping: float = 20.0) -> PointSurface:
    return PointSurface(
        direction=np.array([1.0, 0.0]) if direction is None else direction,
        environment=Environment(stiffness_n_per_m=stiffness, damping_n_s_per_m=damping),
    )


def single(i: int, touches: PointSurface | None = None) -> Plant:
    """Return one axis of the cell alone."""
    masses = (16.0, INERTIA_KG_M2)
    found = replace(
        PLANTS[i], payload=PayloadDynamics(mass_kg=masses[i], drag_n_s_per_m=PLANTS[i].payload.drag_n_s_per_m)
    )
    return found if touches is None or i else found.in_contact_with(touches.environment)


def largest_sensitivity(loop: CoupledLoop, driven: Sequence[int], scale: FloatArray) -> tuple[float, float]:
    """Return max σ(S) at the forces, of the axes `driven`, and its frequency [Hz], see `largest_gain`."""
    reduction, kept = reduced_loop(loop)
    place = np.array(driven, dtype=np.int64)
    lever = scale[place]
    a, b = reduction @ loop.a[:, kept], reduction @ loop.b[:, place] * lever
    c = loop.c_force[np.ix_(place, kept)] / lever[:, None]
    d = np.eye(len(place)) + loop.d_force[np.ix_(place, place)] / lever[:, None] * lever
    gain, angle = largest_gain(a, b, c, d)
    return gain, angle / (2.0 * np.pi * loop.sample_time_s)
