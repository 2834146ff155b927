"""The approach axis of the simulated cell, stepped with the ground floor's exact sampled plant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.compiled import compiled
from problems.contact.events import advance_surface, contact_force, is_in_contact
from problems.contact.kernel import switch_within
from problems.contact.kernel_types import APART, IN_CONTACT, NEWEST, POSITION, SENSED, Contact, HeldInputs, Inputs
from problems.contact.transient import build_sampled_contact
from problems.model.controller import controller_blocks, controller_step
from problems.model.sampled import build_sampled_plant, controller_rest

from .phases import Script
from .truth import SimulatedCell

# Rows of the signals, and the first state of the robot's chain.
FLANGE, COMMAND, PAYLOAD, VELOCITY, FORCE, CONTACT, HAND, SIGNALS = 0, 1, 2, 3, 4, 5, 6, 7
CHAIN = 0


@dataclass(frozen=True, kw_only=True)
class AxisRun:
    """Signals at the ticks of the controller, (n,) each, relative to the start; the wall is at `wall_distance_m`.

    On a rotational axis angles [rad] and torques [N·m].
    """

    flange_m: FloatArray
    command_m: FloatArray
    payload_m: FloatArray
    payload_velocity_m_s: FloatArray
    force_n: FloatArray
    contact_force_n: FloatArray
    hand_force_n: FloatArray


def run_axis(cell: SimulatedCell, script: Script, measured_noise_n: FloatArray) -> AxisRun:
    """Step controller, robot, payload and wall through the script; the controller sees the noisy force."""
    h = cell.sample_time_s
    pair = build_sampled_contact(build_sampled_plant(cell.contact_plant(), h))
    blocks = controller_blocks(cell.controller, h)
    signals = _step_axis(
        pair.arguments,
        blocks,
        controller_rest(blocks),
        (cell.wall_distance_m, cell.deadband_n),
        (script.admittance, script.command_m, script.desired_force_n, script.hand_force_n, script.homing_n_per_m),
        measured_noise_n,
    )
    flange, command, payload, velocity, force, contact_force, hand_force = signals
    return AxisRun(
        flange_m=flange + cell.wall_distance_m,
        command_m=command + cell.wall_distance_m,
        payload_m=payload + cell.wall_distance_m,
        payload_velocity_m_s=velocity / h,
        force_n=force,
        contact_force_n=contact_force,
        hand_force_n=hand_force,
    )


@compiled
def _advance(
    plant: Contact,
    state: FloatArray,
    surface_state: FloatArray,
    inputs: Inputs,
    touching: bool,
) -> bool:
    """Step payload and environment over one sample and return whether they touch."""
    step, flow, rows, _, delay, wall = plant
    (older, newer, push), n, mode = inputs, step.shape[1], IN_CONTACT if touching else APART
    phi = step[mode, :, :n].copy()
    following = phi @ state + step[mode, :, n] * newer + step[mode, :, n + 1] * older + step[mode, :, n + 2] * push
    swung = surface_state.copy()
    if not touching:
        # An environment with mass swings back on its own.
        advance_surface(swung, wall, 1.0)
    if is_in_contact(following, swung, wall, rows, HeldInputs(newer, push), touching) != touching:
        return switch_within(flow, state, surface_state, wall, rows, inputs, delay.fraction, touching, 1).touching
    state[:], surface_state[:] = following, swung
    return touching


@compiled
def _step_axis(
    plant: Contact,
    blocks: FloatArray,
    rest: FloatArray,
    limits: tuple[float, float],
    script: tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray, FloatArray],
    noise: FloatArray,
) -> FloatArray:
    """Return rows flange, command, payload, payload velocity·h, F, F_e, hand force over the ticks; the wall is at 0."""
    (whole, chain, _), rows, (distance, deadband) = plant.delay, plant.rows, limits
    admittance, script_command, desired, hand_force, homing = script
    n, samples = plant.step.shape[1], len(admittance)
    state, past, control, surface_state = np.zeros(n), np.full(max(chain, 1), -distance), rest.copy(), np.zeros(2)
    # The robot chain's first state has unit gain at rest; then x_p.
    state[CHAIN] = state[n - 2] = -distance
    out = np.empty((SIGNALS, samples))
    base, was_running, touching = -distance, False, False
    for k in range(samples):
        held = past[chain - 1]
        position = float(np.sum(rows[POSITION, :n] * state))
        sensed = float(np.sum(rows[SENSED, :n] * state) + rows[SENSED, n] * held)
        seen = sensed + noise[k]
        drive_force = float(desired[k] + (seen if abs(seen) > deadband else 0.0))
        if admittance[k]:
            if not was_running:
                control = rest * past[NEWEST]
            law = (control[0], control[1], control[2], control[3])
            command, law = controller_step(blocks, law, drive_force, position)
            control[0], control[1], control[2], control[3] = law
        else:
            if was_running or k == 0:
                base = past[NEWEST] - script_command[k]
            command = base + script_command[k]
        was_running = admittance[k]
        push = hand_force[k] - homing[k] * (state[n - 2] + distance)
        out[FLANGE, k], out[COMMAND, k] = position, command
        out[PAYLOAD, k], out[VELOCITY, k] = state[n - 2], state[n - 1]
        out[FORCE, k], out[HAND, k] = sensed, push
        out[CONTACT, k] = max(0.0, contact_force(state, rows, HeldInputs(held, push))) if touching else 0.0
        newer = command if whole == 0 else past[whole - 1]
        older = held if chain > whole else newer
        touching = _advance(plant, state, surface_state, Inputs(older, newer, push), touching)
        for i in range(chain - 1, 0, -1):
            past[i] = past[i - 1]
        past[NEWEST] = command
    return out
