"""Frequency response of the exact sampled loop at its two break points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..compiled import equation
from . import difference
from .controller import AdmittanceController, controller_blocks
from .linear_controllers import LinearController
from .plant import Plant, WrenchFilter
from .sampled import Controller, SampledPlant, build_loop, check_wrench_delay

# Written once in plain arithmetic, and compiled into whatever kernel calls it.
controller_gains = equation(difference.controller_gains)


@dataclass(frozen=True, kw_only=True)
class PlantResponse:
    """From the command x^d to the sampled force and position, delay and hold included, at z = exp(jωh).

    `wrench` is 1/(1 + jωτ) of the wrench's filter, None where there is none; `force` is F_m. A delay of the wrench is
    part of what lies between the command and both, see `SampledPlant`.
    """

    frequency_rad_per_s: FloatArray
    z: ComplexArray
    force: ComplexArray
    position: ComplexArray
    wrench: ComplexArray | None = None


def plant_response(sampled: SampledPlant, frequency_rad_per_s: FloatArray) -> PlantResponse:
    """Evaluate F/x^d and X/x^d of the sampled plant; frequencies (n,) in rad/s up to π/h."""
    omega = np.asarray(frequency_rad_per_s, dtype=np.float64)
    z = np.exp(1j * omega * sampled.sample_time_s)
    n = sampled.state_count
    late, time_constant = z ** (-sampled.whole_delay), sampled.plant.wrench_filter.time_constant_s
    drive = (sampled.gamma[None, :] + sampled.gamma_old[None, :] / z[:, None])[..., None]
    states = np.linalg.solve(z[:, None, None] * np.eye(n) - sampled.phi, drive)[..., 0]
    # With a fraction, the hold still shows the older command at the tick.
    held = 1.0 / z if sampled.fraction > 0.0 else np.ones_like(z)
    return PlantResponse(
        frequency_rad_per_s=omega,
        z=z,
        force=late * (states @ sampled.c_force + sampled.d_force * held),
        position=late * (states @ sampled.c_position),
        wrench=None if time_constant == 0.0 else WrenchFilter(time_constant_s=time_constant).response(omega),
    )


def join_wrench(responses: Sequence[PlantResponse]) -> ComplexArray | None:
    """Return `wrench` of responses one after the other, None where none of them is filtered."""
    if all(each.wrench is None for each in responses):
        return None
    return np.concatenate([np.ones_like(each.z) if each.wrench is None else each.wrench for each in responses])


def controller_response(controller: Controller, z: ComplexArray, h: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the sampled forms of A(1 + C_ff) and of C_fb − A(1 + C_ff) P̂ O_a at the points `z`."""
    if isinstance(controller, LinearController):
        return controller.gains(z)
    forward, feedback = controller_gains(controller_blocks(controller, h), z)
    return np.asarray(forward, dtype=np.complex128), np.asarray(feedback, dtype=np.complex128)


@dataclass(frozen=True, kw_only=True)
class LoopResponse:
    """Open-loop responses with negative feedback: 1 + L is what must stay away from zero."""

    frequency_rad_per_s: FloatArray
    at_force: ComplexArray
    at_command: ComplexArray


def loop_response(sampled: SampledPlant, controller: Controller, frequency_rad_per_s: FloatArray) -> LoopResponse:
    """Break the sampled loop at the force signal, L, and at the position command, L_x (docs/method.md, "The loop").

    1 + L_x = (1 + (C_fb − A(1 + C_ff) P̂ O_a) X/X^d)(1 + L), as in the continuous form.
    """
    check_wrench_delay(sampled.plant, controller)
    return loop_at(plant_response(sampled, frequency_rad_per_s), controller, sampled.sample_time_s)


def loop_at(plant: PlantResponse, controller: Controller, sample_time_s: float) -> LoopResponse:
    """Return the same from the response of a plant, which one controller after another may ask.

    A law that follows the position is cut behind what it adds to it (`LinearController.follows_position`).
    """
    forward, feedback = controller_response(controller, plant.z, sample_time_s)
    damped = feedback * plant.position
    command = damped - plant.force * forward
    if isinstance(controller, LinearController) and controller.follows_position:
        command = (command + plant.position) / (1.0 - plant.position)
    return LoopResponse(
        frequency_rad_per_s=plant.frequency_rad_per_s,
        at_force=-plant.force * forward / (1.0 + damped),
        at_command=command,
    )


def rendered_admittance(plant: PlantResponse, controller: Controller, sample_time_s: float) -> ComplexArray:
    """Return G = V/F [m/s/N] of the sampled controller and robot (docs/method.md, "The loop").

    The robot ignores F, so the payload does not enter G; V is the derivative of the position below the Nyquist rate.
    F is the coupling's force: what filters the wrench is part of G.
    """
    forward, feedback = controller_response(controller, plant.z, sample_time_s)
    velocity = 1j * plant.frequency_rad_per_s * plant.position
    if plant.wrench is not None:
        velocity = velocity * plant.wrench
    return np.asarray(forward * velocity / (1.0 + feedback * plant.position), dtype=np.complex128)


def free_space_admittance(
    sampled: SampledPlant, controller: Controller, frequency_rad_per_s: FloatArray
) -> ComplexArray:
    """Return the rendered admittance G [m/s/N] of a sampled plant, see `rendered_admittance`."""
    check_wrench_delay(sampled.plant, controller)
    return rendered_admittance(plant_response(sampled, frequency_rad_per_s), controller, sampled.sample_time_s)


def hand_admittance(sampled: SampledPlant, controller: Controller, frequency_rad_per_s: FloatArray) -> ComplexArray:
    """Return V_p/F_h [m/s/N]: the payload's velocity per force of a hand on it, in the closed sampled loop.

    The hand's force is held from tick to tick, which adds half a sample of lag. Below the loop's bandwidth in free
    space it is 1/(B_a + B_p), see `hand_force_per_speed`.
    """
    loop, omega = build_loop(sampled, controller), np.asarray(frequency_rad_per_s, dtype=np.float64)
    z = np.exp(1j * omega * sampled.sample_time_s)
    states = np.linalg.solve(z[:, None, None] * np.eye(len(loop.a)) - loop.a, loop.b_push[:, None])[..., 0]
    return np.asarray(1j * omega * states[:, sampled.state_count - 2], dtype=np.complex128)


def hand_force_per_speed(plant: Plant, controller: AdmittanceController) -> float:
    """Return the steady hand force [N·s/m] that leads the payload in free space at 1 m/s: B_a + B_p."""
    return controller.damping_n_s_per_m + plant.payload.drag_n_s_per_m
