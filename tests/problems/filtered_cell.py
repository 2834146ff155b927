"""A cell with a filtered or late wrench, simulated in SI from the physics alone: `problems` computes nothing here."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from tests.problems.reference import SampledLaw

SUBSTEPS = 100


@dataclass(frozen=True, kw_only=True)
class Seen:
    """Peaks as pressing forces, and the force that the controller read at every tick since the touch, (n,)."""

    peak_sensor_force_n: float
    peak_contact_force_n: float
    read_n: FloatArray


def equations(plant: Plant, wall_m: float | None) -> FloatArray:
    """Return d/dt of (x, x_p, v_p, F_m, x^d, 1), square: a robot of one pole, the wall at `wall_m` or nowhere."""
    pole = float(plant.robot.denominator[-1])
    k, b = plant.coupling.stiffness_n_per_m, plant.coupling.damping_n_s_per_m
    mass, drag, wall = plant.payload.mass_kg, plant.payload.drag_n_s_per_m, plant.environment
    velocity = np.array([-pole, 0.0, 0.0, 0.0, pole, 0.0])
    force = np.array([-k, k, b, 0.0, 0.0, 0.0]) - b * velocity
    a = np.zeros((6, 6))
    a[0] = velocity
    a[1, 2] = 1.0
    a[2] = -force / mass
    a[2, 2] -= drag / mass
    if wall_m is not None:
        a[2, 1] -= wall.stiffness_n_per_m / mass
        a[2, 2] -= wall.damping_n_s_per_m / mass
        a[2, 5] += wall.stiffness_n_per_m * wall_m / mass
    a[3] = force / plant.wrench_filter.time_constant_s
    a[3, 3] -= 1.0 / plant.wrench_filter.time_constant_s
    return a


def press(
    plant: Plant, law: AdmittanceController, h: float, force_n: float, *, before: int, after: int, holds: bool = False
) -> Seen:
    """Approach from rest under F^d for `before` ticks, touch at the moment whose wrench the next tick reads, go on.

    The delays are whole hundredths of a period. With `holds` the payload cannot leave the wall again.
    """
    late = round(plant.robot.delay_s / h * SUBSTEPS)
    old = round(plant.wrench_filter.delay_s / h * SUBSTEPS)
    assert late + old > 0
    free = expm(equations(plant, None) * h / SUBSTEPS)
    equation, state = SampledLaw(law, h), np.zeros(6)
    state[5] = 1.0
    commands, history = [0.0] * (late // SUBSTEPS + 2), [0.0] * (old + 1)
    touch, wall, pressing = before * SUBSTEPS - old, 0.0, free
    sensor = contact = 0.0
    read = []
    for k in range(before + after):
        for j in range(SUBSTEPS):
            moment = k * SUBSTEPS + j
            if moment == touch:
                wall = float(state[1])
                pressing = expm(equations(plant, wall) * h / SUBSTEPS)
            if j == 0:
                seen = history[-1 - old]
                commands.append(equation.step(force_n + seen, float(state[0])))
                if k >= before:
                    read.append(seen)
                    sensor = max(sensor, -seen)
            # The command that acts `late` substeps after its tick.
            state[4] = commands[-1 - (late - j + SUBSTEPS - 1) // SUBSTEPS]
            deep = plant.environment.stiffness_n_per_m * (state[1] - wall)
            deep += plant.environment.damping_n_s_per_m * state[2]
            touches = moment >= touch and (holds or moment == touch or (deep > 0.0 and state[1] > wall))
            contact = max(contact, float(deep)) if touches else contact
            state = (pressing if touches else free) @ state
            history.append(float(state[3]))
        history, commands = history[-old - 1 :], commands[-late // SUBSTEPS - 3 :]
    return Seen(peak_sensor_force_n=sensor, peak_contact_force_n=contact, read_n=np.array(read))
