"""Inside a sample: exact integration, and the moments at which the contact begins and ends."""

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled, inlined
from .kernel_types import APART, IN_CONTACT, PLACE, PRESSED, SPEED, Crossing, HeldInputs, Inputs, Wall

# Substeps between the ticks per radian of the fastest oscillation of a contact.
SUBSTEPS_PER_RADIAN = 2.0
MOST_SUBSTEPS = 64

_TAYLOR_TERMS = 14
_BISECTIONS = 44
_SWITCHES_PER_SAMPLE = 8
_SERIES_TERMS = 18
# Shares of the force below which a term, or what a crest may still hide, is rounding.
_NEGLIGIBLE, _FLAT = 1e-18, 1e-16
_SLOPE_STEPS = 7
# The first two coefficients of a power series.
_VALUE, _SLOPE = 0, 1
# Below this (ωτ)² the power series of cosine and sine are exact to rounding in four terms.
_NEARLY_CRITICAL = 1e-3


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


@inlined
def spring_force(wall: Wall, position: float, velocity: float) -> float:
    """Return K_e x_p + B_e v_p of a massless environment, whose damper acts only behind its surface (x_p ≥ 0).

    Above 0 it is F_e, and the payload is in contact; otherwise F_e is 0 (MODEL.md, "The contact transient").
    """
    return wall.stiffness * position + (wall.damping * velocity if position >= 0.0 else 0.0)


@compiled
def is_in_contact(
    state: FloatArray, surface_state: FloatArray, wall: Wall, outputs: FloatArray, inputs: HeldInputs, touching: bool
) -> bool:
    """Tell whether the payload is on the environment, given whether it was: the one rule of every contact.

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
def _moved(
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
def _switch_moment(
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
        trial, swung = _moved(flow, state, surface_state, wall, held, touching, middle)
        if is_in_contact(trial, swung, wall, outputs, held, touching) == touching:
            low = middle
        else:
            high = middle
    return high


@compiled
def switch_within(
    flow: FloatArray,
    state: FloatArray,
    surface_state: FloatArray,
    wall: Wall,
    outputs: FloatArray,
    inputs: Inputs,
    fraction: float,
    touching: bool,
    substeps: int,
) -> Crossing:
    """Advance `state` over one sample in which the contact begins or ends, locating each event by bisection.

    The sample is crossed in `substeps`, so that a contact that ends and begins again within it is seen;
    `surface_state` is advanced as well.
    """
    impulse, best, moment, switches = 0.0, 0.0, 0.0, 0
    for part in range(2):
        at, stop = (0.0, fraction) if part == 0 else (fraction, 1.0)
        held = HeldInputs(inputs.older if part == 0 else inputs.newer, inputs.push)
        while at < stop:
            torn = touching and wall.mass > 0.0 and contact_force(state, outputs, held) < 0.0
            if torn and switches < _SWITCHES_PER_SAMPLE:
                apply_impact(state, surface_state, wall, touching)
                touching, switches = False, switches + 1
            piece = min(stop - at, 1.0 / substeps)
            end, swung = _moved(flow, state, surface_state, wall, held, touching, piece)
            # Whatever the limit, nothing passes through the environment.
            switched = is_in_contact(end, swung, wall, outputs, held, touching) != touching
            if switched and touching and switches >= _SWITCHES_PER_SAMPLE:
                switched = False
            if switched:
                piece = _switch_moment(flow, state, surface_state, wall, outputs, held, touching, piece)
                end, swung = _moved(flow, state, surface_state, wall, held, touching, piece)
            if touching:
                value, where = largest_force(flow[IN_CONTACT], outputs, held, state, piece)
                if value > best:
                    best, moment = value, at + where
            state[:], surface_state[:] = end, swung
            at += piece
            if switched:
                impulse = max(impulse, apply_impact(state, surface_state, wall, touching))
                touching = not touching
                switches += 1
    return Crossing(touching, impulse, best, moment)


@compiled
def largest_in_sample(
    flow: FloatArray,
    outputs: FloatArray,
    inputs: Inputs,
    state: FloatArray,
    fraction: float,
) -> tuple[float, float]:
    """Return the largest F_e with its moment over a sample without switch."""
    n = len(state)
    if fraction == 0.0:
        return largest_force(flow, outputs, HeldInputs(inputs.newer, inputs.push), state, 1.0)
    best, moment = largest_force(flow, outputs, HeldInputs(inputs.older, inputs.push), state, fraction)
    drive = flow[:, n] * inputs.older + flow[:, n + 1] * inputs.push
    middle = advance(flow[:, :n].copy(), drive, state, fraction)
    value, where = largest_force(flow, outputs, HeldInputs(inputs.newer, inputs.push), middle, 1.0 - fraction)
    return (value, fraction + where) if value > best else (best, moment)


@compiled
def contact_force_rate(flow: FloatArray, outputs: FloatArray, inputs: HeldInputs, state: FloatArray) -> float:
    """Return dF_e/dτ of a payload that stays on the environment."""
    n, total = len(state), 0.0
    for i in range(n):
        rate = flow[i, n] * inputs.command + flow[i, n + 1] * inputs.push
        for j in range(n):
            rate += flow[i, j] * state[j]
        total += outputs[PRESSED, i] * rate
    return total


@compiled
def largest_force(
    flow: FloatArray,
    outputs: FloatArray,
    inputs: HeldInputs,
    state: FloatArray,
    duration: float,
) -> tuple[float, float]:
    """Return the largest F_e over [0, duration] with its moment: a power series in pieces, maximised in each."""
    n, size = len(state), 0.0
    for i in range(n):
        size = max(size, np.sum(np.abs(flow[i, :n])))
    pieces = max(1, int(np.ceil(size * duration)))
    step = duration / pieces
    best, moment, weight = contact_force(state, outputs, inputs), 0.0, np.sum(np.abs(outputs[PRESSED, :n]))
    current, term, next_term, series = state.copy(), np.empty(n), np.empty(n), np.empty(_SERIES_TERMS)
    for piece in range(pieces):
        count = 1
        series[_VALUE] = contact_force(current, outputs, inputs)
        for i in range(n):
            total = flow[i, n] * inputs.command + flow[i, n + 1] * inputs.push
            for j in range(n):
                total += flow[i, j] * current[j]
            term[i] = total * step
        for order in range(1, _SERIES_TERMS):
            series[order], longest = 0.0, 0.0
            for i in range(n):
                current[i] += term[i]
                series[order] += outputs[PRESSED, i] * term[i]
                longest = max(longest, abs(term[i]))
            count = order + 1
            # The terms shrink from here on: each is at most `step` · `size` / order of the one before.
            if longest * weight < _NEGLIGIBLE * abs(series[_VALUE]):
                break
            for i in range(n):
                total = 0.0
                for j in range(n):
                    total += flow[i, j] * term[j]
                next_term[i] = total * (step / (order + 1.0))
            for i in range(n):
                term[i] = next_term[i]
        value, where = _largest_of_series(series[:count])
        if value > best:
            best, moment = value, (piece + where) * step
    return best, moment


@compiled
def _largest_of_series(series: FloatArray) -> tuple[float, float]:
    """Return the largest value of a smooth power series on [0, 1]: where its slope turns from up to down, else an end.

    A piece is short against the fastest oscillation (its argument is below one), so the slope turns once at most.
    """
    start, stop = series[_VALUE], _sum_series(series, 1.0)
    best, where = (start, 0.0) if start >= stop else (stop, 1.0)
    low, high = 0.0, 1.0
    if series[_SLOPE] > 0.0 and _slope_of_series(series, 1.0) < 0.0:
        left, right = series[_SLOPE], _slope_of_series(series, 1.0)
        for _ in range(_SLOPE_STEPS):
            middle = low + (high - low) * min(0.95, max(0.05, left / (left - right)))
            slope = _slope_of_series(series, middle)
            if slope > 0.0:
                low, left = middle, slope
            else:
                high, right = middle, slope
            # The value at the crest is off by less than slope times width.
            if abs(slope) * (high - low) < _FLAT * abs(best):
                low = high = middle
                break
        middle = 0.5 * (low + high)
        value = _sum_series(series, middle)
        if value > best:
            best, where = value, middle
    return best, where


@compiled
def _sum_series(series: FloatArray, at: float) -> float:
    total = 0.0
    for j in range(len(series) - 1, -1, -1):
        total = total * at + series[j]
    return total


@compiled
def _slope_of_series(series: FloatArray, at: float) -> float:
    total = 0.0
    for j in range(len(series) - 1, 0, -1):
        total = total * at + j * series[j]
    return total
