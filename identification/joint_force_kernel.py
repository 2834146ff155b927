"""The coupling's force over a span, with its slopes by any number of parameters: one compiled loop over the ticks.

Time is counted in samples, as in `joint_kernel`.
"""

import numpy as np
from numpy.typing import NDArray

from problems.compiled import compiled

from .joint_kernel import MOST_TAKEN, TINY, pressing, switch, switch_along

FloatArray = NDArray[np.float64]
# phi (2, 2, 2, …) and gamma (2, 2, m, …) of free motion and contact, swing (2, 2, …), body (7, …), the wall's place and
# the payload's position and velocity at first (3, …): `run_force`.
Law = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]
# drive (n, m) or (r, n, m), ends (n, 4) or (r, n, 4): `joint_path.Cut`
Path = tuple[FloatArray, FloatArray]


@compiled
def run_force(
    law: Law, slopes: Law, path: Path, path_slopes: Path, through: NDArray[np.intp], sign: float, walled: bool
) -> FloatArray:
    """Return the coupling's force at every tick, and below it its slope by each parameter, (1 + p, n).

    p_(k+1) = phi p_k + gamma w_k, w being the drive; all is counted in the direction `sign` from the wall on, which is
    at first not touched, and if not `walled` never. `slopes` are those of the law by p parameters, their last axis.
    Parameter `through[i]` moves the path as well, by `path_slopes` [i]. Exact: a sample is linear in its state, and
    where the payload touches or leaves, `switch_along` takes the moment's own motion along.
    """
    phi, gamma, swing, body, place = law
    drive, ends = path
    count = slopes[4].shape[1]
    out = np.empty((1 + count, len(drive)))
    state, following = np.zeros(4), np.zeros(4)
    moved, moving = np.zeros((4, count)), np.zeros((4, count))
    state[:2], moved[:2] = place[1:], slopes[4][1:]
    at, taken = np.zeros((4, 1 + count)), np.empty((MOST_TAKEN, 2))
    of = body[0], body[1], body[2], body[3], body[4], body[5], body[6]
    touching = False
    for k in range(len(drive)):
        _flange(k, ends, path_slopes[1], place, slopes[4], through, sign, at)
        _felt(k, state, moved, body, slopes[3], at, out)
        mode = 1 if touching else 0
        _follow(k, mode, phi, gamma, place, drive, sign, state, following)
        _follow_slopes(k, mode, law, slopes, drive, path_slopes[0], through, sign, state, moved, moving)
        if walled:
            _swing(touching, swing, slopes[2], state, moved, following, moving)
            now = at[0, 0], at[1, 0], at[2, 0], at[3, 0]
            if pressing(following, now, 1.0, of, touching) != touching:
                following[:] = state
                taken[:, 1] = 0.0
                before = touching
                touching, steps = switch(following, now, of, before, taken)
                _turn(state, moved, at, body, slopes[3], before, taken[:steps], moving)
        state[:] = following
        moved[:] = moving
    return out


@compiled
def _flange(
    k: int,
    ends: FloatArray,
    end_slopes: FloatArray,
    place: FloatArray,
    place_slopes: FloatArray,
    through: NDArray[np.intp],
    sign: float,
    at: FloatArray,
) -> None:
    """Write the flange's place and velocity right after tick k and before the next, from the wall on, (4, 1 + p)."""
    for j in range(4):
        wall = 1.0 if j in (0, 2) else 0.0
        at[j, 0] = sign * ends[k, j] - wall * place[0]
        for i in range(place_slopes.shape[1]):
            at[j, 1 + i] = -wall * place_slopes[0, i]
        for r in range(len(through)):
            at[j, 1 + through[r]] += sign * end_slopes[r, k, j]


@compiled
def _felt(
    k: int, state: FloatArray, moved: FloatArray, body: FloatArray, slopes: FloatArray, at: FloatArray, out: FloatArray
) -> None:
    """Write F = K_s (x_p − x) + B_s (v_p − v) right after a tick, and its slopes."""
    x, v = state[0] - at[0, 0], state[1] - at[1, 0]
    out[0, k] = body[0] * x + body[1] * v
    for i in range(moved.shape[1]):
        by_path = body[0] * (moved[0, i] - at[0, 1 + i]) + body[1] * (moved[1, i] - at[1, 1 + i])
        out[1 + i, k] = by_path + slopes[0, i] * x + slopes[1, i] * v


@compiled
def _follow(
    k: int,
    mode: int,
    phi: FloatArray,
    gamma: FloatArray,
    place: FloatArray,
    drive: FloatArray,
    sign: float,
    state: FloatArray,
    following: FloatArray,
) -> None:
    """Move the payload by one sample."""
    wall = drive.shape[1] - 4
    for row in range(2):
        total = 0.0
        for j in range(drive.shape[1]):
            total += gamma[mode, row, j] * (sign * drive[k, j] - (place[0] if j == wall else 0.0))
        following[row] = phi[mode, row, 0] * state[0] + phi[mode, row, 1] * state[1] + total


@compiled
def _follow_slopes(
    k: int,
    mode: int,
    law: Law,
    slopes: Law,
    drive: FloatArray,
    drive_slopes: FloatArray,
    through: NDArray[np.intp],
    sign: float,
    state: FloatArray,
    moved: FloatArray,
    moving: FloatArray,
) -> None:
    """Move the payload's slopes by one sample: those of phi and gamma act on the state and drive, phi on themselves."""
    phi, gamma, wall = law[0], law[1], drive.shape[1] - 4
    count = moved.shape[1]
    for row in range(2):
        for i in range(count):
            moving[row, i] = (
                phi[mode, row, 0] * moved[0, i]
                + phi[mode, row, 1] * moved[1, i]
                + slopes[0][mode, row, 0, i] * state[0]
                + slopes[0][mode, row, 1, i] * state[1]
                - gamma[mode, row, wall] * slopes[4][0, i]
            )
        for j in range(drive.shape[1]):
            w = sign * drive[k, j] - (law[4][0] if j == wall else 0.0)
            for i in range(count):
                moving[row, i] += slopes[1][mode, row, j, i] * w
        for r in range(len(through)):
            total = 0.0
            for j in range(drive.shape[1]):
                total += gamma[mode, row, j] * drive_slopes[r, k, j]
            moving[row, through[r]] += sign * total


@compiled
def _swing(
    touching: bool,
    swing: FloatArray,
    slopes: FloatArray,
    state: FloatArray,
    moved: FloatArray,
    following: FloatArray,
    moving: FloatArray,
) -> None:
    """Move the environment by one sample, and its slopes: with the payload, or freed."""
    for row in range(2):
        if touching:
            following[2 + row] = following[row]
        else:
            following[2 + row] = swing[row, 0] * state[2] + swing[row, 1] * state[3]
        for i in range(moved.shape[1]):
            if touching:
                moving[2 + row, i] = moving[row, i]
            else:
                own = swing[row, 0] * moved[2, i] + swing[row, 1] * moved[3, i]
                moving[2 + row, i] = own + slopes[row, 0, i] * state[2] + slopes[row, 1, i] * state[3]


@compiled
def _turn(
    state: FloatArray,
    moved: FloatArray,
    at: FloatArray,
    body: FloatArray,
    slopes: FloatArray,
    touching: bool,
    taken: FloatArray,
    moving: FloatArray,
) -> None:
    """Write the slopes after a sample in which the payload touches or leaves, from those before it."""
    count = moved.shape[1]
    if count == 0:
        return
    states, ends = np.empty((count, 4), dtype=np.complex128), np.empty((count, 4), dtype=np.complex128)
    bodies = np.empty((count, 7), dtype=np.complex128)
    for i in range(count):
        for j in range(4):
            states[i, j] = state[j] + TINY * 1j * moved[j, i]
            ends[i, j] = at[j, 0] + TINY * 1j * at[j, 1 + i]
        for j in range(7):
            bodies[i, j] = body[j] + TINY * 1j * slopes[j, i]
    switch_along(states, ends, bodies, touching, taken)
    for i in range(count):
        for j in range(4):
            moving[j, i] = states[i, j].imag / TINY
