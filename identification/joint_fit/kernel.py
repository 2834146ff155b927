"""The robot's steps, and the payload's inside a sample in which it touches or leaves: compiled loops.

Time is counted in samples: velocities are m per sample, B/h and M/h² stand for B and M. What takes complex numbers
answers with a slope as well: its imaginary part is the slope times that of what came in, if that is tiny.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from problems.arrays import ComplexArray, FloatArray
from problems.compiled import compiled

# Of floats, or of complex numbers.
Array = NDArray[Any]
# (K_s, B_s/h, B_p/h, M_p/h², K_e, B_e/h, M_e/h²)
Body = tuple[complex, complex, complex, complex, complex, complex, complex]
# The flange's position and velocity at both ends of a sample.
Ends = tuple[complex, complex, complex, complex]

# So small that its square is nothing beside 1, and so is what rounding leaves of it.
TINY = 1e-30

_BISECTIONS = 40
_RADIANS_PER_STEP = 0.15
_MOST_STEPS = 400
_MOST_SWITCHES = 8
# 2^-38: the bisection has found nothing but the end.
_AN_INSTANT = 4e-12
_AT_ZERO, _AT_ONCE = 1.0, 2.0
MOST_TAKEN = _MOST_STEPS + 3 * _MOST_SWITCHES
# A freed environment that swings faster than this [rad/sample] is back before the payload is.
_BACK_AT_ONCE = 20.0


@compiled
def run_robot(
    step: FloatArray, command: FloatArray, older: int, state: FloatArray, first: int, stop: int
) -> FloatArray:
    """Return the robot's state at the ticks `first` to `stop` (stop - first, order), `state` being that at `first`.

    `step` acts on (state, older, newer command): in sample k the commands older, older − 1 samples ago act one after
    the other (MODEL.md, "What runs in the cell").
    """
    order = len(state)
    out = np.empty((stop - first, order))
    now, following = state.copy(), state.copy()
    for k in range(first, stop):
        for i in range(order):
            out[k - first, i] = now[i]
        _follow(step, command, older, k, now, following)
    return out


@compiled
def mark_robot(
    step: FloatArray, command: FloatArray, older: int, state: FloatArray, position: FloatArray, every: int
) -> tuple[FloatArray, float]:
    """Return the robot's state at every so manieth tick (⌈n/every⌉, order), and the mean of position − robot."""
    order, total = len(state), 0.0
    marks = np.empty(((len(command) + every - 1) // every, order))
    now, following = state.copy(), state.copy()
    for k in range(len(command)):
        if k % every == 0:
            marks[k // every] = now
        total += position[k] - now[0]
        _follow(step, command, older, k, now, following)
    return marks, total / len(command)


@compiled
def _follow(step: FloatArray, command: FloatArray, older: int, k: int, now: FloatArray, following: FloatArray) -> None:
    """Move the robot's state `now` from tick k to the next; `following` is room to work."""
    order = len(now)
    first, second = command[max(k - older, 0)], command[max(k - older + 1, 0)]
    for i in range(order):
        total = step[i, order] * first + step[i, order + 1] * second
        for j in range(order):
            total += step[i, j] * now[j]
        following[i] = total
    now[:] = following


@compiled
def flange(ends: Ends, at: complex) -> tuple[complex, complex]:
    """Return the flange's position and velocity inside a sample, by the cubic through both ends."""
    x0, v0, x1, v1 = ends
    c2 = 3.0 * (x1 - x0) - 2.0 * v0 - v1
    c3 = 2.0 * (x0 - x1) + v0 + v1
    return x0 + at * (v0 + at * (c2 + at * c3)), v0 + at * (2.0 * c2 + 3.0 * at * c3)


@compiled
def accelerations(state: Array, ends: Ends, at: complex, body: Body, touching: bool) -> tuple[complex, complex]:
    """Return the accelerations of payload and environment in m per sample²."""
    k_s, b_s, b_p, m_p, k_e, b_e, m_e = body
    x, v = flange(ends, at)
    pull = k_s * (x - state[0]) + b_s * (v - state[1]) - b_p * state[1]
    if touching:
        shared = (pull - k_e * state[0] - b_e * state[1]) / (m_p + m_e)
        return shared, shared
    if returns_at_once(body):
        return pull / m_p, 0.0 * pull
    return pull / m_p, -(k_e * state[2] + b_e * state[3]) / m_e


@compiled
def returns_at_once(body: Body) -> bool:
    """Whether a freed environment is at its rest position before the payload can meet it again."""
    return bool(body[6].real * _BACK_AT_ONCE**2 <= body[4].real)


@compiled
def pressure(state: Array, ends: Ends, at: complex, body: Body, touching: bool) -> complex:
    """Return what is positive while the payload is on the environment.

    If it was on it, the force [N]; if it was off it, how far it is behind the environment's face [m], or, where that
    is back at once, the smaller one of the spring's force and the whole force [N].
    """
    if touching:
        force: complex = body[4] * state[0] + body[5] * state[1]
        # Without a mass the slope by it counts as well.
        if body[6] != 0.0:
            force += body[6] * accelerations(state, ends, at, body, touching)[0]
        return force
    if returns_at_once(body):
        spring: complex = body[4] * state[0]
        return spring + body[5] * state[1] if state[1].real < 0.0 else spring
    behind: complex = state[0] - state[2]
    return behind


@compiled
def pressing(state: FloatArray, ends: Ends, at: float, body: Body, touching: bool) -> bool:
    """Tell whether the payload is on the environment, given whether it was."""
    return bool(pressure(state, ends, at, body, touching).real > 0.0)


@compiled
def advance(state: Array, ends: Ends, at: complex, dt: complex, body: Body, touching: bool) -> Array:
    """Return the state after `dt` samples, by the classical fourth-order rule."""
    slope, total, probe = np.empty_like(state), np.zeros_like(state), state.copy()
    for stage in range(4):
        share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
        payload, environment = accelerations(probe, ends, at + share * dt, body, touching)
        slope[0], slope[1], slope[2], slope[3] = probe[1], payload, probe[3], environment
        weight = 1.0 if stage in (0, 3) else 2.0
        total += weight * slope
        following = 1.0 if stage == 2 else 0.5
        probe = state + following * dt * slope
    end = state + dt / 6.0 * total
    if returns_at_once(body) and not touching:
        end[2], end[3] = 0.0, 0.0
    return end


@compiled
def meet(state: Array, body: Body, touching: bool) -> None:
    """Change the state where the payload touches, taking the environment's mass along without rebound, or leaves."""
    if touching:
        state[1] = (body[3] * state[1] + body[6] * state[3]) / (body[3] + body[6])
    elif returns_at_once(body):
        state[2], state[3] = 0.0, 0.0
    else:
        state[2], state[3] = state[0], state[1]


@compiled
def switch(state: FloatArray, ends: Ends, body: Body, touching: bool, taken: FloatArray) -> tuple[bool, int]:
    """Move `state` through a sample in which the payload touches or leaves; return whether it touches at the end.

    `taken` (MOST_TAKEN, 2) is given the steps, whose number is returned, too: how long each is, and whether it ends at
    a touch or a release, which it does where `pressure` passes 0, or at once: who meets a wall that is pulled back by
    its spring is rid of it again.
    """
    k_s, b_s, b_p, m_p, k_e, b_e, m_e = body
    rate = np.sqrt((k_s + k_e) / m_p) + (b_s + b_p + b_e) / m_p
    if not returns_at_once(body):
        rate = max(rate, np.sqrt(k_e / m_e) + b_e / m_e)
    steps = int(min(max(np.ceil(rate / _RADIANS_PER_STEP), 8.0), _MOST_STEPS))
    size, at, switches, count = 1.0 / steps, 0.0, 0, 0
    while at < 1.0 - 1e-12:
        dt = min(size, 1.0 - at)
        end = advance(state, ends, at, dt, body, touching)
        # What chatters more often than this within a sample is taken to stay as it is until the next tick.
        if switches >= _MOST_SWITCHES or pressing(end, ends, at + dt, body, touching) == touching:
            state[:] = end
        else:
            dt = _until(state, ends, at, dt, body, touching)
            state[:] = advance(state, ends, at, dt, body, touching)
            switches += 1
            touching = not touching
            meet(state, body, touching)
            taken[count, 1] = _AT_ONCE if dt < size * _AN_INSTANT else _AT_ZERO
        taken[count, 0] = dt
        at += dt
        count += 1
    if touching:
        state[2], state[3] = state[0], state[1]
    return touching, count


@compiled
def _until(state: FloatArray, ends: Ends, at: float, longest: float, body: Body, touching: bool) -> float:
    """Return after how many samples, `longest` at most, the payload touches or leaves."""
    low, high = 0.0, longest
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        probe = advance(state, ends, at, middle, body, touching)
        if pressing(probe, ends, at + middle, body, touching) == touching:
            low = middle
        else:
            high = middle
    return high


@compiled
def switch_along(along: ComplexArray, touching: bool, taken: FloatArray) -> None:
    """Move the states in `along` (p, 15) through the steps (n, 2) that `switch` took.

    Its rows are state, flange at both ends, and body; all have the same real parts, and the imaginary ones are TINY
    times slopes. Where `pressure` is 0 at a touch or release, that moves so that it stays 0; the last step ends at the
    tick.
    """
    passed = np.zeros(len(along), dtype=np.complex128)
    for step in range(len(taken)):
        dt, turns = taken[step, 0], taken[step, 1] > 0.0
        at_zero = taken[step, 1] == _AT_ZERO
        growing = _growth(along[0].real, passed[0].real, dt, touching) if at_zero else 1.0
        for i in range(len(along)):
            state, ends, body = _parts(along[i])
            length = dt + 0j
            if at_zero:
                end = advance(state, ends, passed[i], length, body, touching)
                off = pressure(end, ends, passed[i] + length, body, touching).imag
                length -= 1j * (off / growing)
            elif step == len(taken) - 1 and not turns:
                length = 1.0 - passed[i]
            state[:] = advance(state, ends, passed[i], length, body, touching)
            passed[i] += length
            if turns:
                meet(state, body, not touching)
        touching ^= turns
    if touching:
        along[:, 2:4] = along[:, :2]


@compiled
def _growth(of: FloatArray, at: float, dt: float, touching: bool) -> float:
    """Return how fast `pressure` changes with time, `dt` samples after a state."""
    state, ends, body = _parts(of + 0j)
    later = dt + TINY * 1j
    end = advance(state, ends, at + 0j, later, body, touching)
    found = pressure(end, ends, at + later, body, touching).imag / TINY
    # What only grazes does not move.
    return found if found != 0.0 else np.inf


@compiled
def _parts(of: Array) -> tuple[Array, Ends, Body]:
    return of[:4], (of[4], of[5], of[6], of[7]), (of[8], of[9], of[10], of[11], of[12], of[13], of[14])
