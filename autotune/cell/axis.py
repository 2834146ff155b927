"""The approach axis of the simulated cell, stepped with the ground floor's exact sampled plant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from problems.compiled import compiled
from problems.contact_kernel import switch_within, wall_force
from problems.controller import controller_blocks
from problems.plant import FREE_SPACE
from problems.sampled import SampledPlant, build_sampled_plant, hold, translation_state

from .phases import Script
from .truth import Cell

FloatArray = NDArray[np.float64]
# phi, gamma, gamma_old, held hand force, rate: what `SampledPlant` calls so, and the hand's column.
Mode = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, kw_only=True)
class AxisRun:
    """Signals at the ticks of the controller, (n,) each, relative to the start; the wall is at `wall_distance_m`."""

    flange_m: FloatArray
    command_m: FloatArray
    payload_m: FloatArray
    payload_velocity_m_s: FloatArray
    force_n: FloatArray
    contact_force_n: FloatArray
    hand_force_n: FloatArray


def run_axis(cell: Cell, script: Script, measured_noise_n: FloatArray) -> AxisRun:
    """Step controller, robot, payload and wall through the script; the controller sees the noisy force."""
    h = cell.sample_time_s
    contact = build_sampled_plant(cell.contact_plant(), h)
    free = build_sampled_plant(cell.contact_plant().in_contact_with(FREE_SPACE), h)
    blocks = controller_blocks(cell.controller.parameters(), h)
    n = free.state_count
    hand = np.zeros(n)
    hand[n - 1] = h * h / cell.payload_mass_kg
    rest = translation_state(free, blocks)
    signals = _step_axis(
        _mode(contact, hand),
        _mode(free, hand),
        (free.drive, hand),
        (free.c_position, free.c_force, free.d_force),
        (free.whole_delay, free.chain_length, free.fraction),
        (cell.environment.stiffness_n_per_m, cell.environment.damping_n_s_per_m / h),
        blocks,
        rest,
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


def _mode(sampled: SampledPlant, hand: FloatArray) -> Mode:
    _, held_hand = hold(sampled.rate, hand, 1.0)
    return sampled.phi, sampled.gamma, sampled.gamma_old, held_hand, sampled.rate


@compiled
def _admittance_step(blocks: FloatArray, control: FloatArray, force: float, position: float) -> float:
    """Return the command for F^d + F (deadband applied) and the measured position; advance the controller's states."""
    direct = blocks[0, 0] + blocks[1, 0]
    command = control[0] + control[1] + direct * force - (blocks[2, 0] * position + control[2])
    control[0] = blocks[0, 1] * control[0] + blocks[0, 2] * force
    control[1] = blocks[1, 1] * control[1] + blocks[1, 2] * force
    control[2] = blocks[2, 1] * control[2] + blocks[2, 2] * position
    return float(command)


@compiled
def _step_axis(
    contact: Mode,
    free: Mode,
    inputs: tuple[FloatArray, FloatArray],
    outputs: tuple[FloatArray, FloatArray, float],
    delay: tuple[int, int, float],
    wall: tuple[float, float],
    blocks: FloatArray,
    rest: FloatArray,
    limits: tuple[float, float],
    script: tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray, FloatArray],
    noise: FloatArray,
) -> FloatArray:
    """Return rows flange, command, payload, payload velocity·h, F, F_e, hand force over the ticks; the wall is at 0."""
    c_position, c_force, d_force = outputs
    whole, chain, fraction = delay
    admittance, script_command, desired, hand_force, homing = script
    drive, hand = inputs
    n, samples = len(drive), len(admittance)
    state = -limits[0] * rest[:n]
    past = np.full(max(chain, 1), -limits[0])
    control = np.zeros(3)
    out = np.empty((7, samples))
    base, was_running, touching = -limits[0], False, False
    for k in range(samples):
        position = float(c_position @ state)
        sensed = float(c_force @ state + d_force * past[chain - 1])
        seen = sensed + noise[k]
        drive_force = float(desired[k] + (seen if abs(seen) > limits[1] else 0.0))
        if admittance[k]:
            if not was_running:
                control[:] = rest[n + chain :] * past[0]
            command = _admittance_step(blocks, control, drive_force, position)
        else:
            if was_running or k == 0:
                base = past[0] - script_command[k]
            command = base + script_command[k]
        was_running = admittance[k]
        pushed = hand_force[k] - homing[k] * (state[n - 2] + limits[0])
        out[0, k], out[1, k], out[2, k], out[3, k] = position, command, state[n - 2], state[n - 1]
        out[4, k], out[6, k] = sensed, pushed
        out[5, k] = max(0.0, wall_force(state, n, wall[0], wall[1])) if touching else 0.0
        newer = command if whole == 0 else past[whole - 1]
        older = past[chain - 1] if chain > whole else newer
        mode = contact if touching else free
        following = mode[0] @ state + mode[1] * newer + mode[2] * older + mode[3] * pushed
        if (wall_force(following, n, wall[0], wall[1]) <= 0.0) == touching:
            pushes = (drive * older + hand * pushed, drive * newer + hand * pushed)
            following, touching = switch_within((contact[4], free[4]), pushes, state, fraction, touching, wall)
        state = following
        for i in range(chain - 1, 0, -1):
            past[i] = past[i - 1]
        past[0] = command
    return out
