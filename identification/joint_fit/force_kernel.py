"""The coupling's force over a span and its derivatives by any number of parameters: compiled loops over the ticks.

Time is counted in samples, as in `joint_kernel`. All is seen in the direction of pressing, and from the wall on.
"""

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.compiled import compiled

from .kernel import FACE, FACE_SPEED, MOST_TAKEN, PAYLOAD, SPEED, TINY, Body, pressing, switch, switch_along

ModeArray = NDArray[np.int8]
# Columns of the flange's path after a tick and before the next, and rows of what a step moves: position and speed.
X, V, X_END, V_END = 0, 1, 2, 3
# Entries of a body as an array.
K_S, B_S = 0, 1

# What a sample begins with, and TURNS more where the payload touches or leaves in it.
OFF, ON, TURNS = 0, 1, 2


@compiled
def _driven(gamma: FloatArray, drive: FloatArray, sign: float, wall: float) -> tuple[float, float]:
    """Return gamma w (2,) of one sample; w is the drive seen in the direction of pressing, from the wall on."""
    first = second = 0.0
    place = len(drive) - 4
    for j in range(len(drive)):
        w = sign * drive[j] - (wall if j == place else 0.0)
        first += gamma[X, j] * w
        second += gamma[V, j] * w
    return first, second


@compiled
def _felt(state: tuple[float, float], path: FloatArray, body: Body, sign: float, wall: float) -> float:
    """Return F = K_s (x_p − x) + B_s (v_p − v) right after a tick."""
    x, v = state
    felt = body.k_s * (x - (sign * path[X] - wall)) + body.b_s * (v - sign * path[V])
    return float(felt.real)


@compiled
def run_free(
    phi: FloatArray,
    gamma: FloatArray,
    drive: FloatArray,
    path: FloatArray,
    body: Body,
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
        x, v = phi[X, X] * x + phi[X, V] * v + first, phi[V, X] * x + phi[V, V] * v + second
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
    x, v = start
    state = np.array([x, v, 0.0, 0.0])
    following, taken = state.copy(), np.empty((MOST_TAKEN, 2))
    touching = bool(OFF)  # a literal False would be compiled once more
    for k in range(len(drive)):
        states[k] = state
        out[k] = _felt((state[PAYLOAD], state[SPEED]), path[k], body, sign, wall)
        mode = ON if touching else OFF
        modes[k] = mode
        driven = _driven(gamma[mode], drive[k], sign, wall)
        for i in range(2):
            following[i] = phi[mode, i, X] * state[PAYLOAD] + phi[mode, i, V] * state[SPEED] + driven[i]
            following[FACE + i] = swing[i, X] * state[FACE] + swing[i, V] * state[FACE_SPEED]
        if touching:
            following[FACE], following[FACE_SPEED] = following[PAYLOAD], following[SPEED]
        ends = sign * path[k, X] - wall, sign * path[k, V], sign * path[k, X_END] - wall, sign * path[k, V_END]
        if pressing(following, ends, 1.0, body, touching) == touching:
            state[:] = following
        else:
            modes[k] += TURNS
            touching, _ = switch(state, ends, body, touching, taken)
    return out


@compiled
def carry_free(phi: FloatArray, pushed: FloatArray, start: FloatArray, stiffness: float, damping: float) -> FloatArray:
    """Return K_s x' + B_s v' (n, p) of derivatives x'_(k+1) = phi x'_k + `pushed`_k, from `start` (2, p) on.

    `pushed` (n, 2, p) is what a sample adds to the derivatives.
    """
    count = start.shape[1]
    out, moved = np.empty((len(pushed), count)), start.copy()
    x_x, x_v, v_x, v_v = phi[X, X], phi[X, V], phi[V, X], phi[V, V]
    for k in range(len(pushed)):
        for i in range(count):
            x, v = moved[0, i], moved[1, i]
            out[k, i] = stiffness * x + damping * v
            moved[X, i] = x_x * x + x_v * v + pushed[k, X, i]
            moved[V, i] = v_x * x + v_v * v + pushed[k, V, i]
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
    with their derivatives, parameters last. There the moment's own motion is taken along (`switch_along`).
    """
    count, turns, (of, of_derivatives), (crossed, crossed_derivatives) = start.shape[1], 0, body, ends
    (swung, swung_derivatives), out = swing, np.empty((len(pushed), count))
    moved, moving = np.zeros((4, count)), np.zeros((4, count))
    moved[:2] = start
    for k in range(len(pushed)):
        mode = modes[k] % TURNS
        for i in range(count):
            out[k, i] = of[K_S] * moved[PAYLOAD, i] + of[B_S] * moved[SPEED, i]
        if modes[k] >= TURNS:
            _turn(states[k], moved, (crossed[turns], crossed_derivatives[turns]), (of, of_derivatives), mode == ON)
            turns += 1
            continue
        for row in range(2):
            for i in range(count):
                moving[row, i] = phi[mode, row, X] * moved[PAYLOAD, i] + phi[mode, row, V] * moved[SPEED, i]
                moving[row, i] += pushed[k, row, i]
                if mode == ON:
                    moving[FACE + row, i] = moving[row, i]
                else:
                    own = (
                        swung_derivatives[row, X, i] * states[k, FACE]
                        + swung_derivatives[row, V, i] * states[k, FACE_SPEED]
                    )
                    carried = swung[row, X] * moved[FACE, i] + swung[row, V] * moved[FACE_SPEED, i]
                    moving[FACE + row, i] = carried + own
        moved[:] = moving
    return out


@compiled
def _turn(
    state: FloatArray,
    moved: FloatArray,
    ends: tuple[FloatArray, FloatArray],
    body: tuple[FloatArray, FloatArray],
    touching: bool,
) -> None:
    """Change the derivatives `moved` (4, p) through a sample in which the payload touches or leaves."""
    (at, at_derivatives), (of, of_derivatives) = ends, body
    count, taken = moved.shape[1], np.zeros((MOST_TAKEN, 2))
    real = Body(of[0], of[1], of[2], of[3], of[4], of[5], of[6])
    _, steps = switch(state.copy(), (at[0], at[1], at[2], at[3]), real, touching, taken)
    along = np.empty((count, 15), dtype=np.complex128)
    for i in range(count):
        for j in range(4):
            along[i, j] = state[j] + TINY * 1j * moved[j, i]
            along[i, 4 + j] = at[j] + TINY * 1j * at_derivatives[j, i]
        for j in range(7):
            along[i, 8 + j] = of[j] + TINY * 1j * of_derivatives[j, i]
    switch_along(along, touching, taken[:steps])
    for i in range(count):
        for j in range(4):
            moved[j, i] = along[i, j].imag / TINY
