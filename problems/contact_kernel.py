"""Compiled stepping of one contact: straight loops over the equations of `problems.sampled`."""

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled

FloatArray = NDArray[np.float64]
Mode = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

_TAYLOR_TERMS = 14
_BISECTIONS = 44
_SWITCHES_PER_SAMPLE = 8


@compiled
def advance(rate: FloatArray, push: FloatArray, state: FloatArray, duration: float) -> FloatArray:
    """Integrate ds/dτ = rate·s + push (constant) over `duration` (≤ 1) to rounding: Taylor series in short pieces."""
    size = 0.0
    for i in range(len(state)):
        size = max(size, np.sum(np.abs(rate[i])))
    pieces = max(1, int(np.ceil(2.0 * size * duration)))
    step = duration / pieces
    out = state.copy()
    for _ in range(pieces):
        # s(τ) = s + Σ τ^j/j! rate^(j−1)(rate·s + push)
        term = (rate @ out + push) * step
        total = out + term
        for j in range(2, _TAYLOR_TERMS + 1):
            term = (rate @ term) * (step / j)
            total = total + term
        out = total
    return out


@compiled
def wall_force(state: FloatArray, n: int, stiffness: float, damping: float) -> float:
    """Return K_e x_p + B_e v_p for a payload behind the wall, the penetration's sign in front of it."""
    if state[n - 2] < 0.0:
        return float(stiffness * state[n - 2])
    return float(stiffness * state[n - 2] + damping * state[n - 1])


@compiled
def switch_within(
    rates: tuple[FloatArray, FloatArray],
    pushes: tuple[FloatArray, FloatArray],
    state: FloatArray,
    fraction: float,
    touching: bool,
    wall: tuple[float, float],
) -> tuple[FloatArray, bool]:
    """Cross one sample in which the contact begins or ends, locating each event by bisection."""
    n = len(state)
    current = state.copy()
    switches = 0
    for part in range(2):
        remaining = fraction if part == 0 else 1.0 - fraction
        push = pushes[part]
        while remaining > 0.0:
            rate = rates[0] if touching else rates[1]
            end = advance(rate, push, current, remaining)
            outside = wall_force(end, n, wall[0], wall[1]) <= 0.0
            if outside != touching or switches >= _SWITCHES_PER_SAMPLE:
                current = end
                break
            low, high = 0.0, remaining
            for _ in range(_BISECTIONS):
                middle = 0.5 * (low + high)
                trial = advance(rate, push, current, middle)
                if (wall_force(trial, n, wall[0], wall[1]) <= 0.0) == touching:
                    high = middle
                else:
                    low = middle
            current = advance(rate, push, current, high)
            remaining -= high
            touching = not touching
            switches += 1
    return current, touching


@compiled
def run_contact(
    contact: Mode,
    free: Mode,
    drive: FloatArray,
    outputs: tuple[FloatArray, FloatArray, float],
    delay: tuple[int, int, float],
    wall: tuple[float, float],
    blocks: FloatArray,
    start: FloatArray,
    desired_force: float,
    samples: int,
) -> tuple[FloatArray, FloatArray]:
    """Return F and F_e at every tick, from the impact on; the state is laid out as in `assemble_loop`."""
    c_position, c_force, d_force = outputs
    whole, chain, fraction = delay
    n = len(drive)
    state, past, control = start[:n].copy(), start[n : n + chain].copy(), start[n + chain :].copy()
    direct = blocks[0, 0] + blocks[1, 0]
    force, contact_force = np.empty(samples), np.empty(samples)
    touching = True
    for k in range(samples):
        position = c_position @ state
        sensed = c_force @ state
        rest = control[0] + control[1] - control[2] - blocks[2, 0] * position
        if chain > 0:
            sensed += d_force * past[chain - 1]
            command = rest + direct * (desired_force + sensed)
        else:
            command = (rest + direct * (desired_force + sensed)) / (1.0 - direct * d_force)
            sensed += d_force * command
        force[k] = sensed
        contact_force[k] = max(0.0, wall_force(state, n, wall[0], wall[1])) if touching else 0.0
        drive_force = desired_force + sensed
        control[0] = blocks[0, 1] * control[0] + blocks[0, 2] * drive_force
        control[1] = blocks[1, 1] * control[1] + blocks[1, 2] * drive_force
        control[2] = blocks[2, 1] * control[2] + blocks[2, 2] * position
        newer = command if whole == 0 else past[whole - 1]
        older = past[chain - 1] if chain > whole else newer
        phi, gamma, gamma_old = (contact[0], contact[1], contact[2]) if touching else (free[0], free[1], free[2])
        following = phi @ state + gamma * newer + gamma_old * older
        if (wall_force(following, n, wall[0], wall[1]) <= 0.0) == touching:
            following, touching = switch_within(
                (contact[3], free[3]), (drive * older, drive * newer), state, fraction, touching, wall
            )
        state = following
        for i in range(chain - 1, 0, -1):
            past[i] = past[i - 1]
        if chain > 0:
            past[0] = command
    return force, contact_force
