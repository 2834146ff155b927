"""The payload behind the coupling on a known flange path, with and without something to touch: compiled loops.

Time is counted in samples: velocities are m per sample, B/h and M/h² stand for B and M.
"""

import numpy as np
from numpy.typing import NDArray

from problems.compiled import compiled

FloatArray = NDArray[np.float64]
# (K_s, B_s/h, B_p/h, M_p/h², K_e, B_e/h, M_e/h²)
Body = tuple[float, float, float, float, float, float, float]

_BISECTIONS = 40
_RADIANS_PER_STEP = 0.15
_MOST_STEPS = 400
_MOST_SWITCHES = 8
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
def _driven(gamma: FloatArray, drive: FloatArray, sign: float, wall: float) -> tuple[float, float]:
    """Return gamma w (2,) of one sample; w is the drive seen in the direction of pressing, from the wall on."""
    first = second = 0.0
    place = len(drive) - 4
    for j in range(len(drive)):
        w = sign * drive[j] - (wall if j == place else 0.0)
        first += gamma[0, j] * w
        second += gamma[1, j] * w
    return first, second


@compiled
def _felt(state: tuple[float, float], path: FloatArray, body: Body, sign: float, wall: float) -> float:
    """Return F = K_s (x_p − x) + B_s (v_p − v) right after a tick."""
    return float(body[0] * (state[0] - (sign * path[0] - wall)) + body[1] * (state[1] - sign * path[1]))


@compiled
def run_free(
    phi: FloatArray,
    gamma: FloatArray,
    drive: FloatArray,
    path: FloatArray,
    body: Body,
    place: tuple[float, float],
    start: tuple[float, float],
) -> FloatArray:
    """Return the coupling's force at every tick (n,), the payload moving freely: p_(k+1) = phi p_k + gamma w_k.

    `drive` (n, m) holds w, `path` (n, 4) the flange's position and velocity after tick k and before tick k + 1;
    `place` is the direction, +1 or -1, in which all is counted, and where it is counted from; `start` is p_0.
    """
    out = np.empty(len(drive))
    sign, wall = place
    x, v = start
    for k in range(len(drive)):
        out[k] = _felt((x, v), path[k], body, sign, wall)
        first, second = _driven(gamma, drive[k], sign, wall)
        x, v = phi[0, 0] * x + phi[0, 1] * v + first, phi[1, 0] * x + phi[1, 1] * v + second
    return out


@compiled
def run_contact(
    phi: FloatArray,
    gamma: FloatArray,
    swing: FloatArray,
    drive: FloatArray,
    path: FloatArray,
    body: Body,
    place: tuple[float, float],
    start: tuple[float, float],
) -> FloatArray:
    """Return what `run_free` does with a wall at `place[1]`, at first not touched.

    `phi` (2, 2, 2) and `gamma` (2, 2, m) hold free motion and contact; `swing` (2, 2) moves a freed environment.
    """
    out = np.empty(len(drive))
    sign, wall = place
    # Payload, then environment.
    state = np.array([start[0], start[1], 0.0, 0.0])
    following = state.copy()
    touching = False
    for k in range(len(drive)):
        out[k] = _felt((state[0], state[1]), path[k], body, sign, wall)
        mode = 1 if touching else 0
        driven = _driven(gamma[mode], drive[k], sign, wall)
        for i in range(2):
            following[i] = phi[mode, i, 0] * state[0] + phi[mode, i, 1] * state[1] + driven[i]
            following[2 + i] = swing[i, 0] * state[2] + swing[i, 1] * state[3]
        if touching:
            following[2], following[3] = following[0], following[1]
        ends = sign * path[k, 0] - wall, sign * path[k, 1], sign * path[k, 2] - wall, sign * path[k, 3]
        if pressing(following, ends, 1.0, body, touching) == touching:
            state[:] = following
        else:
            touching = switch(state, ends, body, touching)
    return out


@compiled
def flange(ends: tuple[float, float, float, float], at: float) -> tuple[float, float]:
    """Return the flange's position and velocity inside a sample, by the cubic through both ends."""
    x0, v0, x1, v1 = ends
    c2 = 3.0 * (x1 - x0) - 2.0 * v0 - v1
    c3 = 2.0 * (x0 - x1) + v0 + v1
    return x0 + at * (v0 + at * (c2 + at * c3)), v0 + at * (2.0 * c2 + 3.0 * at * c3)


@compiled
def accelerations(
    state: FloatArray, ends: tuple[float, float, float, float], at: float, body: Body, touching: bool
) -> tuple[float, float]:
    """Return the accelerations of payload and environment in m per sample²."""
    k_s, b_s, b_p, m_p, k_e, b_e, m_e = body
    x, v = flange(ends, at)
    pull = k_s * (x - state[0]) + b_s * (v - state[1]) - b_p * state[1]
    if touching:
        shared = (pull - k_e * state[0] - b_e * state[1]) / (m_p + m_e)
        return shared, shared
    if returns_at_once(body):
        return pull / m_p, 0.0
    return pull / m_p, -(k_e * state[2] + b_e * state[3]) / m_e


@compiled
def returns_at_once(body: Body) -> bool:
    """Whether a freed environment is at its rest position before the payload can meet it again."""
    return bool(body[6] * _BACK_AT_ONCE**2 <= body[4])


@compiled
def pressing(state: FloatArray, ends: tuple[float, float, float, float], at: float, body: Body, touching: bool) -> bool:
    """Tell whether the payload is on the environment, given whether it was: force when on it, gap when off it."""
    if touching:
        force = body[4] * state[0] + body[5] * state[1]
        if body[6] > 0.0:
            force += body[6] * accelerations(state, ends, at, body, True)[0]
        return bool(force > 0.0)
    if returns_at_once(body):
        return bool(state[0] > 0.0 and body[4] * state[0] + body[5] * state[1] > 0.0)
    return bool(state[0] > state[2])


@compiled
def _advance(
    state: FloatArray, ends: tuple[float, float, float, float], at: float, dt: float, body: Body, touching: bool
) -> FloatArray:
    """Return the state after `dt` samples, by the classical fourth-order rule."""
    slope, total, probe = np.empty(4), np.zeros(4), state.copy()
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
def switch(state: FloatArray, ends: tuple[float, float, float, float], body: Body, touching: bool) -> bool:
    """Move `state` through a sample in which the payload touches or leaves; return whether it touches at the end."""
    k_s, b_s, b_p, m_p, k_e, b_e, m_e = body
    rate = np.sqrt((k_s + k_e) / m_p) + (b_s + b_p + b_e) / m_p
    if not returns_at_once(body):
        rate = max(rate, np.sqrt(k_e / m_e) + b_e / m_e)
    steps = int(min(max(np.ceil(rate / _RADIANS_PER_STEP), 8.0), _MOST_STEPS))
    size, at, switches = 1.0 / steps, 0.0, 0
    while at < 1.0 - 1e-12:
        dt = min(size, 1.0 - at)
        end = _advance(state, ends, at, dt, body, touching)
        # What chatters more often than this within a sample is taken to stay as it is until the next tick.
        if switches >= _MOST_SWITCHES or pressing(end, ends, at + dt, body, touching) == touching:
            state[:] = end
            at += dt
            continue
        low, high = 0.0, dt
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            probe = _advance(state, ends, at, middle, body, touching)
            if pressing(probe, ends, at + middle, body, touching) == touching:
                low = middle
            else:
                high = middle
        state[:] = _advance(state, ends, at, high, body, touching)
        at += high
        switches += 1
        touching = not touching
        if touching:
            # The payload takes the environment's mass along without rebound.
            state[1] = (m_p * state[1] + m_e * state[3]) / (m_p + m_e)
        elif returns_at_once(body):
            state[2], state[3] = 0.0, 0.0
        else:
            state[2], state[3] = state[0], state[1]
    if touching:
        state[2], state[3] = state[0], state[1]
    return touching
