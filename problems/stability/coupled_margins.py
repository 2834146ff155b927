"""Margins of axes that act on each other: smallest singular value of I + L, disk margins one loop and all at a time.

With S = (I + L)⁻¹, min σ(I + L) = 1/max σ(S) (Skogestad and Postlethwaite, Multivariable Feedback Control, 2nd ed.,
8.6 and 9.2.2); of one loop, the others closed, |1 + L_i| = 1/|S_ii|, and its balanced disk margin is 1/|S_ii − ½|; all
at a time it is 1/μ(S − ½ I), of which the scaled norm bounds μ from above (Seiler, Packard and Gahinet, An Introduction
to Disk Margins, 2020, section 5).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ..arrays import ComplexArray, FloatArray, IntArray
from ..errors import ParameterError
from ..model.controller import controller_blocks
from ..model.coupled import (
    CoupledLoop,
    CoupledSampledPlant,
    Law,
    build_coupled_loop,
    coupled_poles,
)
from ..model.difference import controller_gains
from .margins import UnstableLoopError

_POINTS, _LOWEST_HZ, _SHORT_OF_NYQUIST = 160, 0.02, 1e-9
_AROUND_A_POLE, _FASTEST_DECAY = 17, 0.3
# A minimum is cut out of its neighbours so often, by 8 points each: 4⁻⁹ of the first bracket is left.
_ROUNDS, _INSIDE = 9, 8
# Minima of the grid this far above the lowest one are not cut: between neighbours nothing falls by half.
_NEAR = 1.5
_BALANCED = 12  # rounds of Osborne's scaling
_CONVERGED, _MOST_STEPS = 1e-9, 60


@dataclass(frozen=True, kw_only=True)
class LoopMargins:
    """Of one axis with the loops of all others closed: the smaller value of both break points, see `Margins`."""

    modulus: float
    modulus_hz: float
    disk: float


@dataclass(frozen=True, kw_only=True)
class CoupledMargins:
    """The margins of axes that act on each other, in the order of the axes that have a law.

    `modulus` is the smallest singular value of I + L over both break points at `modulus_hz`, torques divided and
    angles multiplied by the lever; `disk` the disk margin of all loops at a time (a lower bound, which
    holds for changes of all loops in any combination); `loops` that of each with the others closed.
    """

    modulus: float
    modulus_hz: float
    disk: float
    loops: tuple[LoopMargins, ...]
    spectral_radius: float


@dataclass(frozen=True, kw_only=True)
class WorstMode:
    """The slowest or fastest growing mode of a loop: |z|, its frequency, and the axis (place) that moves most in it."""

    radius: float
    frequency_hz: float
    axis: int


def worst_mode(sampled: CoupledSampledPlant, loop: CoupledLoop) -> WorstMode:
    """Return the mode with the largest |z|; shares of the axes are those of the kinetic energy of the payload."""
    poles, vectors = coupled_poles(loop)
    worst = int(np.argmax(np.abs(poles)))
    speeds = vectors[[place + 1 for place in sampled.matrices.places], worst]
    energy = np.abs(speeds) ** 2 * np.diag(sampled.plant.mass_matrix)
    angle = abs(float(np.angle(poles[worst])))
    return WorstMode(
        radius=float(np.abs(poles[worst])),
        frequency_hz=angle / (2.0 * np.pi * loop.sample_time_s),
        axis=int(np.argmax(energy)),
    )


def coupled_responses(
    sampled: CoupledSampledPlant, frequency_rad_per_s: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    """Return F/x^d (n, k, k) and x/x^d (n, k), whose axes do not mix, of the plant at frequencies (n,)."""
    z = np.exp(1j * np.asarray(frequency_rad_per_s) * sampled.sample_time_s)
    m, size = sampled.matrices, len(sampled.phi)
    whole, chains = np.array(sampled.whole), np.array(sampled.chains)
    late = z[:, None] ** -whole
    inputs = sampled.gamma * late[:, None, :] + sampled.gamma_old * (z[:, None] ** -(whole + 1))[:, None, :]
    states = np.linalg.solve(z[:, None, None] * np.eye(size) - sampled.phi, inputs)
    force = m.c_force @ states
    diagonal = np.arange(len(whole))
    force[:, diagonal, diagonal] += m.d_force * z[:, None] ** -chains
    return np.asarray(force, dtype=np.complex128), np.einsum("kn,mnk->mk", m.c_position, states)


def coupled_sensitivities(
    sampled: CoupledSampledPlant, laws: Sequence[Law], scale: FloatArray, frequency_rad_per_s: FloatArray
) -> ComplexArray:
    """Return S = (I + L)⁻¹ (2, n, k, k) at the commands and at the forces, of the axes that have a law.

    `scale` (k,) is 1 along an axis and the lever [m] about one.
    """
    driven = [i for i, law in enumerate(laws) if law is not None]
    forces, positions = coupled_responses(sampled, frequency_rad_per_s)
    force, position, lever = forces[:, driven][:, :, driven], positions[:, driven], scale[driven]
    z = np.exp(1j * np.asarray(frequency_rad_per_s) * sampled.sample_time_s)
    blocks = [controller_blocks(law, sampled.sample_time_s) for law in laws if law is not None]
    gains = [controller_gains(each, z) for each in blocks]
    forward, back = (np.stack([each[kind] + 0.0 * z for each in gains], axis=1) for kind in (0, 1))
    one = np.eye(len(driven))
    command = -forward[:, :, None] * force
    moved = 1.0 + back * position
    index = np.arange(len(driven))
    command[:, index, index] += back * position
    # I − P_F (I + C_x P_x)⁻¹ C_F; P_x and the laws are diagonal.
    measured = one - force * (forward / moved)[:, None, :]
    command = one + command
    found = np.stack([command * lever[:, None] / lever, measured / lever[:, None] * lever])
    return np.asarray(np.linalg.inv(found))


def find_coupled_margins(
    sampled: CoupledSampledPlant, laws: Sequence[Law], scale: FloatArray, loop: CoupledLoop | None = None
) -> CoupledMargins:
    """Find the margins of all axes together and of each, every minimum searched on the loop itself.

    Raises UnstableLoopError if the loop is not stable, by its eigenvalues, ParameterError without any law.
    """
    poles, grid = _stable_grid(sampled, laws, loop)
    values = _values(coupled_sensitivities(sampled, laws, scale, grid))
    found = [_searched(sampled, laws, scale, grid, each, row) for row, each in enumerate(values)]
    best, places = np.array(found).T
    hz, count = places / (2.0 * np.pi), (len(values) - 2) // 2
    return CoupledMargins(
        modulus=float(best[0]),
        modulus_hz=float(hz[0]),
        disk=float(best[1]),
        loops=tuple(
            LoopMargins(modulus=float(best[2 + i]), modulus_hz=float(hz[2 + i]), disk=float(best[2 + count + i]))
            for i in range(count)
        ),
        spectral_radius=float(np.max(np.abs(poles))),
    )


def find_coupled_modulus(
    sampled: CoupledSampledPlant, laws: Sequence[Law], scale: FloatArray, loop: CoupledLoop | None = None
) -> tuple[float, float]:
    """Find `modulus` and `modulus_hz` of `find_coupled_margins` alone, in a fraction of its time; raises as it does."""
    _, grid = _stable_grid(sampled, laws, loop)
    (values,) = _values(coupled_sensitivities(sampled, laws, scale, grid), 0)
    modulus, place = _searched(sampled, laws, scale, grid, values, 0)
    return modulus, place / (2.0 * np.pi)


def _stable_grid(
    sampled: CoupledSampledPlant, laws: Sequence[Law], loop: CoupledLoop | None
) -> tuple[ComplexArray, FloatArray]:
    """Return the poles (m,) of a stable loop and the frequencies (n,) at which its margins are looked for first."""
    if not any(law is not None for law in laws):
        raise ParameterError("laws", "none", "at least one")
    closed = build_coupled_loop(sampled, laws) if loop is None else loop
    poles, _ = coupled_poles(closed)
    radius = float(np.max(np.abs(poles)))
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    return poles, _grid(poles, sampled.sample_time_s)


def _searched(
    sampled: CoupledSampledPlant,
    laws: Sequence[Law],
    scale: FloatArray,
    grid: FloatArray,
    values: FloatArray,
    row: int,
) -> tuple[float, float]:
    """Return the least value of a row and its place, from its values (n,) on the grid."""
    lowest = int(np.argmin(values))
    near = _minima(values)
    near = near[values[near] < _NEAR * values[lowest]]
    low, high = grid[np.maximum(near - 1, 0)], grid[np.minimum(near + 1, len(grid) - 1)]
    found, place = _lowest(lambda at: _values(coupled_sensitivities(sampled, laws, scale, at), row)[0], low, high)
    return (found, place) if found < values[lowest] else (float(values[lowest]), float(grid[lowest]))


def _lowest(values: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> tuple[float, float]:
    """Return the least value in the brackets (m,), and its place: each is cut down around its lowest point."""
    best, place = np.inf, 0.0
    for _ in range(_ROUNDS):
        step = (high - low) / (_INSIDE + 1)
        inside = low[:, None] + step[:, None] * np.arange(1, _INSIDE + 1)
        found = values(inside.ravel()).reshape(inside.shape)
        lowest, each = np.argmin(found, axis=1), np.arange(len(low))
        centre, least = inside[each, lowest], found[each, lowest]
        worst = int(np.argmin(least))
        if least[worst] < best:
            best, place = float(least[worst]), float(centre[worst])
        low, high = centre - step, centre + step
    return best, place


def _values(sensitivities: ComplexArray, row: int | None = None) -> FloatArray:
    """Return rows (2 + 2 k, n): modulus and disk of all loops, then modulus of each loop and disk of each; or one."""
    k = sensitivities.shape[-1]
    shifted = sensitivities - 0.5 * np.eye(k)
    gains = []
    if row in (None, 0):
        gains.append(np.max(np.linalg.norm(sensitivities, ord=2, axis=(-2, -1)), axis=0)[None])
    if row in (None, 1):
        gains.append(np.max(scaled_norm(shifted), axis=0)[None])
    if row is None or row > 1:
        each = [np.max(np.abs(np.einsum("bnii->bin", one)), axis=0) for one in (sensitivities, shifted)]
        both = np.concatenate(each)
        gains.append(both if row is None else both[row - 2 : row - 1])
    return 1.0 / np.concatenate(gains)


def scaled_norm(matrices: ComplexArray) -> FloatArray:
    """Return σ(D A D⁻¹) (…,) with the diagonal D > 0 that balances rows and columns: an upper bound of μ(A).

    Osborne's balancing; any D gives a bound.
    """
    k = matrices.shape[-1]
    square = np.abs(matrices) ** 2
    scale = np.ones(matrices.shape[:-1])
    # Of two axes one round is exact.
    for _ in range(_BALANCED if k > 2 else k - 1):
        for i in range(k):
            weighed = square * scale[..., :, None] / scale[..., None, :]
            own = weighed[..., i, i]
            row, column = np.sum(weighed[..., i, :], axis=-1) - own, np.sum(weighed[..., :, i], axis=-1) - own
            ratio = np.where((row > 0.0) & (column > 0.0), column / np.where(row > 0.0, row, 1.0), 1.0)
            scale[..., i] *= np.sqrt(ratio)
    root = np.sqrt(scale)
    return np.asarray(
        np.minimum(
            np.linalg.norm(matrices * root[..., :, None] / root[..., None, :], ord=2, axis=(-2, -1)),
            np.linalg.norm(matrices, ord=2, axis=(-2, -1)),
        )
    )


def _grid(poles: ComplexArray, sample_time_s: float) -> FloatArray:
    """Return frequencies (n,) up to just short of the Nyquist frequency, denser around the poles of the loop."""
    nyquist = (1.0 - _SHORT_OF_NYQUIST) * np.pi / sample_time_s
    slow = 2.0 * np.pi * _LOWEST_HZ
    grid = [np.geomspace(slow, nyquist, _POINTS), np.array([nyquist])]
    around = np.linspace(-4.0, 4.0, _AROUND_A_POLE)
    for pole in poles[(poles.imag > 0.0) & (np.abs(poles) > _FASTEST_DECAY)]:
        rate = np.log(pole) / sample_time_s
        grid.append(rate.imag + max(-rate.real, 1e-4 * rate.imag) * around)
    found = np.concatenate(grid)
    return np.unique(found[(found >= slow) & (found <= nyquist)])


def _minima(values: FloatArray) -> IntArray:
    """Return where values (n,) are not above their neighbours."""
    padded = np.concatenate([[np.inf], values, [np.inf]])
    return np.asarray(np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] <= padded[2:])))


def largest_gain(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> tuple[float, float]:
    """Return max over the unit circle of σ(D + C (zI − A)⁻¹ B) of a stable A, and its angle [rad/sample].

    A gain is above the largest one exactly if a Hamiltonian matrix has no imaginary eigenvalue, which decides without
    a grid of frequencies (Boyd, Balakrishnan and Kabamba 1989; Bruinsma and Steinbuch 1990), of the system in
    w = (z − 1)/(z + 1).
    """
    one = np.eye(len(a))
    inverse = np.linalg.inv(a + one)
    a_w, b_w = inverse @ (a - one), np.sqrt(2.0) * inverse @ b
    c_w, d_w = np.sqrt(2.0) * c @ inverse, d - c @ inverse @ b

    def gain(frequency: float) -> float:
        response = d_w + c_w @ np.linalg.solve(1j * frequency * one - a_w, b_w)
        return float(np.linalg.norm(response, ord=2))

    poles = np.linalg.eigvals(a_w)
    starts = [0.0, *np.abs(poles.imag).tolist()]
    place = max(starts, key=gain)
    best = max(gain(place), float(np.linalg.norm(d_w, ord=2)))
    for _ in range(_MOST_STEPS):
        level = best * (1.0 + _CONVERGED)
        crossings = _crossings(a_w, b_w, c_w, d_w, level)
        if len(crossings) < 2:
            break
        middles = (
            np.sqrt(crossings[:-1] * crossings[1:]) if crossings[0] > 0 else 0.5 * (crossings[:-1] + crossings[1:])
        )
        found = max(middles.tolist(), key=gain)
        if not gain(found) > level:
            break
        best, place = gain(found), found
    return best, 2.0 * float(np.arctan(place))


def _crossings(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray, level: float) -> FloatArray:
    """Return the frequencies at which a singular value passes the level, ascending."""
    inner = np.linalg.inv(level**2 * np.eye(d.shape[1]) - d.T @ d)
    outer = np.eye(d.shape[0]) + d @ inner @ d.T
    corner = a + b @ inner @ d.T @ c
    hamiltonian = np.block([[corner, b @ inner @ b.T], [-c.T @ outer @ c, -corner.T]])
    values = np.linalg.eigvals(hamiltonian)
    # An eigenvalue on the axis is found to the square root of rounding where two meet.
    on_axis = np.abs(values.real) < 1e-7 * np.maximum(np.abs(values), 1e-9)
    return np.unique(values.imag[on_axis & (values.imag > 0.0)])
