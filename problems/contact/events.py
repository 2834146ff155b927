"""Inside a sample: exact integration, and the moments at which the contact begins and ends."""

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled, inlined
from .kernel_types import APART, IN_CONTACT, PLACE, PRESSED, SPEED, HeldInputs, Wall

# Substeps between the ticks per radian of the fastest oscillation of a contact.
SUBSTEPS_PER_RADIAN = 2.0
MOST_SUBSTEPS = 64

_TAYLOR_TERMS = 14
_BISECTIONS = 44
# Below this (ωτ)² the power series of cosine and sine are exact to rounding in four terms.
_NEARLY_CRITICAL = 1e-3


@compiled
def rate_bound(rate: FloatArray) -> float:
    """Return a bound on how fast ds/dτ = rate·s turns or decays: the smaller of ‖A‖ and √‖A²‖ of its matrix A (n, n).

    Positions and velocities are of unlike size, and so are the rows of A: ω² where what swings does so with ω.
    """
    largest, squared, n = 0.0, 0.0, len(rate)
    for i in range(n):
        once, twice = 0.0, 0.0
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += rate[i, k] * rate[k, j]
            once, twice = once + abs(rate[i, j]), twice + abs(total)
        largest, squared = max(largest, once), max(squared, twice)
    return float(min(largest, np.sqrt(squared)))


@compiled
def advance(rate: FloatArray, push: FloatArray, state: FloatArray, duration: float) -> FloatArray:
    """Integrate ds/dτ = rate·s + push (constant) over `duration` (≤ 1) to rounding: Taylor series in short pieces."""
    n, pieces = len(state), max(1, int(np.ceil(2.0 * rate_bound(rate) * duration)))
    step = duration / pieces
    out, term, following = state.copy(), np.empty(n), np.empty(n)
    for _ in range(pieces):
        # s(τ) = s + Σ τ^j/j! rate^(j−1)(rate·s + push), row by row: products of matrices would each make an array.
        for i in range(n):
            total = push[i]
            for k in range(n):
                total += rate[i, k] * out[k]
            term[i] = total * step
        for i in range(n):
            out[i] += term[i]
        for j in range(2, _TAYLOR_TERMS + 1):
            for i in range(n):
                total = 0.0
                for k in range(n):
                    total += rate[i, k] * term[k]
                following[i] = total * (step / j)
            for i in range(n):
                out[i] += following[i]
            term, following = following, term
    return out


@inlined
def spring_force(wall: Wall, position: float, velocity: float) -> float:
    """Return K_e x_p + B_e v_p of a massless environment, whose damper acts only behind its surface (x_p ≥ 0).

    Above 0 it is F_e, and the payload is in contact; otherwise F_e is 0 (docs/method.md, "Contact").
    """
    return wall.stiffness * position + (wall.damping * velocity if position >= 0.0 else 0.0)


@compiled
def is_in_contact(
    state: FloatArray, surface_state: FloatArray, wall: Wall, outputs: FloatArray, inputs: HeldInputs, touching: bool
) -> bool:
    """Return whether the payload is on the environment, given whether it was: the one rule of every contact.

    A massless environment follows at once, so that it is the sign of its force. One with mass is met where it is,
    and left when F_e = M_e dv_p/dt + B_e v_p + K_e x_p is not above 0.
    """
    n = len(state)
    if wall.mass == 0.0:
        return bool(spring_force(wall, state[n - 2], state[n - 1]) > 0.0)
    if not touching:
        return bool(state[n - 2] > surface_state[PLACE])
    return contact_force(state, outputs, inputs) > 0.0


@compiled
def contact_force(state: FloatArray, outputs: FloatArray, inputs: HeldInputs) -> float:
    """Return F_e of a payload that stays on the environment."""
    n = len(state)
    force = outputs[PRESSED, n] * inputs.command + outputs[PRESSED, n + 1] * inputs.push
    for i in range(n):
        force += outputs[PRESSED, i] * state[i]
    return float(force)


@compiled
def substeps_apart(wall: Wall) -> int:
    """Return in how many substeps a sample is crossed while the environment's mass swings on its own."""
    if wall.mass == 0.0:
        return 1
    return max(1, min(MOST_SUBSTEPS, int(np.ceil(SUBSTEPS_PER_RADIAN * np.sqrt(wall.stiffness / wall.mass)))))


@compiled
def advance_surface(surface_state: FloatArray, wall: Wall, duration: float) -> None:
    """Let the environment's mass swing back on its own spring and damper, M x'' + B x' + K x = 0 in closed form."""
    if wall.mass == 0.0:
        return
    position, speed = surface_state[PLACE], surface_state[SPEED]
    stiffness, decay = wall.stiffness / wall.mass, 0.5 * wall.damping / wall.mass
    square = stiffness - decay * decay
    turn = square * duration * duration
    # (cosine, sine over frequency) times exp(−decay·τ).
    if abs(turn) < _NEARLY_CRITICAL:
        shrink = np.exp(-decay * duration)
        cosine = shrink * (1.0 - turn / 2.0 * (1.0 - turn / 12.0 * (1.0 - turn / 30.0)))
        sine = shrink * duration * (1.0 - turn / 6.0 * (1.0 - turn / 20.0 * (1.0 - turn / 42.0)))
    elif turn > 0.0:
        shrink, frequency = np.exp(-decay * duration), np.sqrt(square)
        cosine, sine = shrink * np.cos(frequency * duration), shrink * np.sin(frequency * duration) / frequency
    else:
        fast = decay + np.sqrt(-square)
        slowly, quickly = np.exp(-stiffness / fast * duration), np.exp(-fast * duration)
        cosine, sine = 0.5 * (slowly + quickly), 0.5 * (slowly - quickly) / (fast - decay)
    surface_state[PLACE] = position * cosine + (speed + decay * position) * sine
    surface_state[SPEED] = speed * cosine - (decay * speed + stiffness * position) * sine


@compiled
def apply_impact(state: FloatArray, surface_state: FloatArray, wall: Wall, touching: bool) -> float:
    """Let the payload leave, or meet the environment's mass without rebound; return the impulse on it times 1/h."""
    n = len(state)
    if wall.mass == 0.0:
        return 0.0
    if touching:
        surface_state[PLACE], surface_state[SPEED] = state[n - 2], state[n - 1]
        return 0.0
    common = wall.share * state[n - 1] + (1.0 - wall.share) * surface_state[SPEED]
    impulse = wall.mass * (common - surface_state[SPEED])
    state[n - 1] = common
    return float(impulse)


@compiled
def moved_within(
    flow: FloatArray,
    state: FloatArray,
    surface_state: FloatArray,
    wall: Wall,
    held: HeldInputs,
    touching: bool,
    duration: float,
) -> tuple[FloatArray, FloatArray]:
    """Return payload and environment after `duration`, in contact or apart."""
    n, mode = len(state), IN_CONTACT if touching else APART
    drive = flow[mode, :, n] * held.command + flow[mode, :, n + 1] * held.push
    end, swung = advance(flow[mode, :, :n].copy(), drive, state, duration), surface_state.copy()
    if not touching:
        advance_surface(swung, wall, duration)
    return end, swung


@compiled
def switch_moment(
    flow: FloatArray,
    state: FloatArray,
    surface_state: FloatArray,
    wall: Wall,
    outputs: FloatArray,
    held: HeldInputs,
    touching: bool,
    duration: float,
) -> float:
    """Return when, within `duration`, the contact begins or ends."""
    low, high = 0.0, duration
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        trial, swung = moved_within(flow, state, surface_state, wall, held, touching, middle)
        if is_in_contact(trial, swung, wall, outputs, held, touching) == touching:
            low = middle
        else:
            high = middle
    return high
