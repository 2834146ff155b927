"""The coupling's force over a span and its slopes by any number of parameters: compiled loops over the ticks.

Time is counted in samples, as in `joint_kernel`. All is seen in the direction of pressing, and from the wall on.
"""

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.compiled import compiled

from .kernel import MOST_TAKEN, TINY, pressing, switch, switch_along

ModeArray = NDArray[np.int8]
# K_s, B_s/h, B_p/h, M_p/h², K_e, B_e/h, M_e/h²
RealBody = tuple[float, float, float, float, float, float, float]

# What a sample begins with, and TURNS more where the payload touches or leaves in it.
OFF, ON, TURNS = 0, 1, 2


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
def _felt(state: tuple[float, float], path: FloatArray, body: RealBody, sign: float, wall: float) -> float:
    """Return F = K_s (x_p − x) + B_s (v_p − v) right after a tick."""
    return float(body[0] * (state[0] - (sign * path[0] - wall)) + body[1] * (state[1] - sign * path[1]))


@compiled
def run_free(
    phi: FloatArray,
    gamma: FloatArray,
    drive: FloatArray,
    path: FloatArray,
    body: RealBody,
    place: tuple[float, float],
    start: tuple[float, float],
    states: FloatArray,
) -> FloatArray:
    """Return the coupling's force at every tick (n,), the payload moving freely: p_(k+1) = phi p_k + gamma w_k.

    `drive` (n, m) holds w, `path` (n, 4) the flange's position and velocity after tick k and before tick k + 1;
    `place` is the direction, +1 or -1, in which all is counted, and where it is counted from; `start` is p_0.
    `states` (n, 2) is given p.
    """
    out = np.empty(len(drive))
    sign, wall = place
    x, v = start
    for k in range(len(drive)):
        states[k, 0], states[k, 1] = x, v
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
    body: RealBody,
    place: tuple[float, float],
    start: tuple[float, float],
    states: FloatArray,
    modes: ModeArray,
) -> FloatArray:
    """Return what `run_free` does with a wall at `place[1]`, at first not touched.

    `phi` (2, 2, 2) and `gamma` (2, 2, m) hold free motion and contact; `swing` (2, 2) moves a freed environment.
    `states` (n, 4) is given payload and environment, `modes` (n,) OFF or ON, and TURNS.
    """
    out = np.empty(len(drive))
    sign, wall = place
    # Payload, then environment.
    state = np.array([start[0], start[1], 0.0, 0.0])
    following, taken = state.copy(), np.empty((MOST_TAKEN, 2))
    touching = bool(OFF)  # a literal False would be compiled once more
    for k in range(len(drive)):
        states[k] = state
        out[k] = _felt((state[0], state[1]), path[k], body, sign, wall)
        mode = ON if touching else OFF
        modes[k] = mode
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
            modes[k] += TURNS
            touching, _ = switch(state, ends, body, touching, taken)
    return out


@compiled
def carry_free(phi: FloatArray, pushed: FloatArray, start: FloatArray, stiffness: float, damping: float) -> FloatArray:
    """Return K_s x' + B_s v' (n, p) of slopes that follow x'_(k+1) = phi x'_k + `pushed`_k, from `start` (2, p) on.

    `pushed` (n, 2, p) is what a sample adds to the slopes.
    """
    count = start.shape[1]
    out, moved = np.empty((len(pushed), count)), start.copy()
    p00, p01, p10, p11 = phi[0, 0], phi[0, 1], phi[1, 0], phi[1, 1]
    for k in range(len(pushed)):
        for i in range(count):
            x, v = moved[0, i], moved[1, i]
            out[k, i] = stiffness * x + damping * v
            moved[0, i] = p00 * x + p01 * v + pushed[k, 0, i]
            moved[1, i] = p10 * x + p11 * v + pushed[k, 1, i]
    return out


@compiled
def carry_contact(
    phi: FloatArray,
    swing: tuple[FloatArray, FloatArray],
    pushed: FloatArray,
    start: FloatArray,
    body: tuple[FloatArray, FloatArray],
    ends: tuple[FloatArray, FloatArray],
    states: FloatArray,
    modes: ModeArray,
) -> FloatArray:
    """Return what `carry_free` does along a run with contact, whose `states` and `modes` are those of `run_contact`.

    `swing`, `body` (7,) and `ends`, the flange from the wall on in the samples that turn, in order, (turns, 4), come
    with their slopes, parameters last. There the moment's own motion is taken along (`switch_along`).
    """
    count, turns = start.shape[1], 0
    out = np.empty((len(pushed), count))
    moved, moving = np.zeros((4, count)), np.zeros((4, count))
    moved[:2] = start
    for k in range(len(pushed)):
        mode = modes[k] % TURNS
        for i in range(count):
            out[k, i] = body[0][0] * moved[0, i] + body[0][1] * moved[1, i]
        if modes[k] >= TURNS:
            _turn(states[k], moved, ends[0][turns], ends[1][turns], body, mode == ON)
            turns += 1
            continue
        for row in range(2):
            for i in range(count):
                moving[row, i] = phi[mode, row, 0] * moved[0, i] + phi[mode, row, 1] * moved[1, i] + pushed[k, row, i]
                if mode == ON:
                    moving[2 + row, i] = moving[row, i]
                else:
                    swung = swing[1][row, 0, i] * states[k, 2] + swing[1][row, 1, i] * states[k, 3]
                    moving[2 + row, i] = swing[0][row, 0] * moved[2, i] + swing[0][row, 1] * moved[3, i] + swung
        moved[:] = moving
    return out


@compiled
def _turn(
    state: FloatArray,
    moved: FloatArray,
    ends: FloatArray,
    end_slopes: FloatArray,
    body: tuple[FloatArray, FloatArray],
    touching: bool,
) -> None:
    """Change the slopes `moved` (4, p) through a sample in which the payload touches or leaves."""
    count, taken = moved.shape[1], np.zeros((MOST_TAKEN, 2))
    of = body[0]
    real = of[0], of[1], of[2], of[3], of[4], of[5], of[6]
    _, steps = switch(state.copy(), (ends[0], ends[1], ends[2], ends[3]), real, touching, taken)
    along = np.empty((count, 15), dtype=np.complex128)
    for i in range(count):
        for j in range(4):
            along[i, j] = state[j] + TINY * 1j * moved[j, i]
            along[i, 4 + j] = ends[j] + TINY * 1j * end_slopes[j, i]
        for j in range(7):
            along[i, 8 + j] = of[j] + TINY * 1j * body[1][j, i]
    switch_along(along, touching, taken[:steps])
    for i in range(count):
        for j in range(4):
            moved[j, i] = along[i, j].imag / TINY
