"""The robot's steps, and the payload's inside a sample in which it touches or leaves: compiled loops.

Time is counted in samples: velocities are m per sample, B/h and M/h² replace B and M. What takes complex numbers
answers with a slope as well: its imaginary part is the slope times that of what came in, if that is tiny.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from problems.arrays import ComplexArray, FloatArray
from problems.compiled import compiled

# Of floats, or of complex numbers.
Array = NDArray[Any]
# The flange's position and velocity at both ends of a sample.
Ends = tuple[complex, complex, complex, complex]
# The state: payload and the environment's face, each with its speed; then columns of `taken`.
PAYLOAD, SPEED, FACE, FACE_SPEED = 0, 1, 2, 3
LENGTH, EVENT = 0, 1


class Body(NamedTuple):
    """Payload, coupling and environment in units of one sample: K_s, B_s/h, B_p/h, M_p/h², K_e, B_e/h, M_e/h²."""

    k_s: complex
    b_s: complex
    b_p: complex
    m_p: complex
    k_e: complex
    b_e: complex
    m_e: complex


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
    the other (docs/method.md, "The loop").
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
        total += position[k] - now[PAYLOAD]
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
    # By one loop: an assignment of slices takes three times as long as everything else here.
    for i in range(order):
        now[i] = following[i]


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
    pull = k_s * (x - state[PAYLOAD]) + b_s * (v - state[SPEED]) - b_p * state[SPEED]
    if touching:
        shared = (pull - k_e * state[PAYLOAD] - b_e * state[SPEED]) / (m_p + m_e)
        return shared, shared
    if returns_at_once(body):
        return pull / m_p, 0.0 * pull
    return pull / m_p, -(k_e * state[FACE] + b_e * state[FACE_SPEED]) / m_e


@compiled
def returns_at_once(body: Body) -> bool:
    """Whether a freed environment is at its rest position before the payload can meet it again."""
    return bool(body.m_e.real * _BACK_AT_ONCE**2 <= body.k_e.real)


@compiled
def pressure(state: Array, ends: Ends, at: complex, body: Body, touching: bool) -> complex:
    """Return what is positive while the payload is on the environment.

    If it was on it, the force [N]; if it was off it, how far it is behind the environment's face [m], or, where that
    is back at once, the smaller one of the spring's force and the whole force [N].
    """
    if touching:
        force: complex = body.k_e * state[PAYLOAD] + body.b_e * state[SPEED]
        # Without a mass the slope by it counts as well.
        if body.m_e != 0.0:
            shared, _ = accelerations(state, ends, at, body, touching)
            force += body.m_e * shared
        return force
    if returns_at_once(body):
        spring: complex = body.k_e * state[PAYLOAD]
        return spring + body.b_e * state[SPEED] if state[SPEED].real < 0.0 else spring
    behind: complex = state[PAYLOAD] - state[FACE]
    return behind


@compiled
def pressing(state: FloatArray, ends: Ends, at: float, body: Body, touching: bool) -> bool:
    """Return whether the payload is on the environment, given whether it was."""
    return bool(pressure(state, ends, at, body, touching).real > 0.0)


@compiled
def advance(state: Array, ends: Ends, at: complex, dt: complex, body: Body, touching: bool) -> Array:
    """Return the state after `dt` samples, by the classical fourth-order rule."""
    slope, total, probe = np.empty_like(state), np.zeros_like(state), state.copy()
    for stage in range(4):
        share = 0.0 if stage == 0 else (1.0 if stage == 3 else 0.5)
        payload, environment = accelerations(probe, ends, at + share * dt, body, touching)
        slope[0], slope[1], slope[2], slope[3] = probe[SPEED], payload, probe[FACE_SPEED], environment
        weight = 1.0 if stage in (0, 3) else 2.0
        total += weight * slope
        following = 1.0 if stage == 2 else 0.5
        probe = state + following * dt * slope
    end = state + dt / 6.0 * total
    if returns_at_once(body) and not touching:
        end[FACE], end[FACE_SPEED] = 0.0, 0.0
    return end


@compiled
def meet(state: Array, body: Body, touching: bool) -> None:
    """Change the state where the payload touches, taking the environment's mass along without rebound, or leaves."""
    if touching:
        state[SPEED] = (body.m_p * state[SPEED] + body.m_e * state[FACE_SPEED]) / (body.m_p + body.m_e)
    elif returns_at_once(body):
        state[FACE], state[FACE_SPEED] = 0.0, 0.0
    else:
        state[FACE], state[FACE_SPEED] = state[PAYLOAD], state[SPEED]


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
            taken[count, EVENT] = _AT_ONCE if dt < size * _AN_INSTANT else _AT_ZERO
        taken[count, LENGTH] = dt
        at += dt
        count += 1
    if touching:
        state[FACE], state[FACE_SPEED] = state[PAYLOAD], state[SPEED]
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
    times derivatives. Where `pressure` is 0 at a touch or release, that moves so that it stays 0; the last step ends
    at the tick.
    """
    # All rows have the same real parts.
    first, passed = 0, np.zeros(len(along), dtype=np.complex128)
    for step in range(len(taken)):
        dt, turns = taken[step, LENGTH], taken[step, EVENT] > 0.0
        at_zero = taken[step, EVENT] == _AT_ZERO
        growing = _growth(along[first].real, passed[first].real, dt, touching) if at_zero else 1.0
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
    body = Body(of[8], of[9], of[10], of[11], of[12], of[13], of[14])
    return of[:4], (of[4], of[5], of[6], of[7]), body
