"""Stability over continuous ranges of K_e and M_p by Lyapunov functions: the oracle of `autotune.certificate`.

In every cell a quadratic Lyapunov function is found for the loop at its centre and shown to decrease for the whole
cell: with V(s) = |L s|², it decreases where ‖L A L⁻¹‖ < 1. Two of the plant's numbers vary, 1/M_p and K_e/M_p; the
continuous plant is affine in them, and what the controller makes of the sampled plant is a constant and a basis. Over
a cell, A = A_c + δ₁ A₁ + δ₂ A₂ + R with the derivatives of the matrix exponential and a bound on the second-order
remainder R. The norm is convex in (δ₁, δ₂), so the corners decide. The arithmetic is double precision; a bound on its
rounding, scaled by the matrices at hand, is taken off. It shares neither functions nor arithmetic with the certificate.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from autotune.certificate.family import Family
from problems.arrays import FloatArray
from problems.design.uncertainty import MASS, STIFFNESS
from problems.model.plant import build_plant_matrices
from problems.model.plant_parameters import with_values
from problems.model.sampled import Controller, SampledPlant, build_loop, build_sampled_plant, stability_matrix

_SMALLEST_SHARE = 1e-7
_MOST_CELLS = 800
_AT_ONCE = 512
_TAYLOR_TERMS = 18
_DOUBLINGS = 60
_NOTHING = 1e-20
_SHARES = (0.5, 0.1)
_WEIGHTS = 2
# Products of three matrices of order n lose at most about 3n ε times the product of their norms; this is well above.
_ROUNDING_UNITS = 100.0 * np.finfo(np.float64).eps
_LARGEST_EXPONENT = 600.0  # a bound this large proves nothing, and does not overflow


@dataclass(frozen=True, kw_only=True)
class CellLoop:
    """A loop whose plant varies.

    The augmented continuous plant by sample, (n + 1, n + 1), is `steady` + `per_mass`/M + `per_ratio` K/M; the delay
    ends `fraction` of a sample late. The loop matrix is `constant` (N, N) plus `basis` (n² + 2n, N, N) times the
    numbers of the sampled plant. `inverse` is the range of 1/M_p, `stiffness` that of K_e. A change of the plant is at
    most `gain` times as large in the loop matrix, in its first `rows`, acting on its first `columns`.
    """

    steady: FloatArray
    per_mass: FloatArray
    per_ratio: FloatArray
    fraction: float
    constant: FloatArray
    basis: FloatArray
    inverse: tuple[float, float]
    stiffness: tuple[float, float]
    gain: float
    rows: int
    columns: int

    def plant_numbers(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return 1/M_p and K_e (m,) at points (m, 2) of the unit square."""
        low, high = np.array([self.inverse[0], self.stiffness[0]]), np.array([self.inverse[1], self.stiffness[1]])
        found = low + points * (high - low)
        return found[:, 0], found[:, 1]

    def slack(self, cells: FloatArray) -> FloatArray:
        """Return 1 − (bound on ‖L A L⁻¹‖) over cells (m, 4), low corner first; −inf where the centre is unstable."""
        inverse, stiffness = self.plant_numbers(0.5 * (cells[:, :2] + cells[:, 2:]))
        augmented = self.augmented(inverse, stiffness)
        centre = self.loop(self.sampled(augmented))
        radius = np.max(np.abs(np.linalg.eigvals(centre)), axis=1)
        out = np.where(radius < 1.0, -1.0, -np.inf)
        inside = np.flatnonzero(radius < 1.0)
        half = self._half_ranges(cells, inverse, stiffness)
        first, second = (
            half[k][:, None, None] * self.derivative(augmented, direction)
            for k, direction in enumerate((self.per_mass, self.per_ratio))
        )
        rest = self.remainder(augmented, half)
        for share in _SHARES:
            # AᵀPA − σ²P = −W with σ between the radius and 1 keeps the decrease even in every direction.
            weight = np.broadcast_to(np.eye(centre.shape[1]), centre.shape)[inside]
            for _ in range(_WEIGHTS):
                todo = np.flatnonzero(out[inside] <= 0.0)
                inside, weight = inside[todo], weight[todo]
                if not inside.size:
                    return out
                scaled = centre[inside] / (radius[inside] + share * (1.0 - radius[inside]))[:, None, None]
                p = lyapunov(scaled, weight)
                found = self._bounded(p, centre[inside], first[inside], second[inside], rest[inside])
                out[inside] = np.maximum(out[inside], found)
                diagonal = np.diagonal(p, axis1=1, axis2=2)
                weight = (diagonal / np.max(diagonal, axis=1)[:, None] + 1e-9)[:, :, None] * np.eye(p.shape[1])
        return out

    def _bounded(
        self, p: FloatArray, centre: FloatArray, first: FloatArray, second: FloatArray, rest: FloatArray
    ) -> FloatArray:
        """Return the slack that V(s) = sᵀPs = |L s|² gives; the norm is convex, so the corners decide."""
        values, vectors = np.linalg.eigh(p)
        # P that is not positive definite in these digits bounds nothing: its slack is hugely negative.
        size = np.sqrt(np.maximum(values, 1e-300))
        root, back = size[:, :, None] * np.swapaxes(vectors, 1, 2), vectors / size[:, None, :]
        signs = ((-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0))
        corners = [spectral_norm(root @ (centre + one * first + two * second) @ back) for one, two in signs]
        reach = spectral_norm(root[:, :, : self.rows]) * spectral_norm(back[:, : self.columns, :])
        rounding = _ROUNDING_UNITS * np.linalg.norm(np.abs(root) @ np.abs(centre) @ np.abs(back), axis=(1, 2))
        return np.asarray(1.0 - np.max(corners, axis=0) - reach * rest - rounding)

    def augmented(self, inverse: FloatArray, stiffness: FloatArray) -> FloatArray:
        """Return the augmented continuous plants (m, n + 1, n + 1)."""
        ratio = (inverse * stiffness)[:, None, None]
        return np.asarray(self.steady + inverse[:, None, None] * self.per_mass + ratio * self.per_ratio)

    def sampled(self, augmented: FloatArray) -> FloatArray:
        """Return phi, gamma and gamma_old (m, n² + 2n)."""
        return self._numbers(exponential(augmented), exponential(augmented * (1.0 - self.fraction)))

    def derivative(self, augmented: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the derivative of the loop matrix along a direction of the augmented plant, (m, N, N)."""
        later = 1.0 - self.fraction
        moved = self._numbers(
            moved_exponential(augmented, direction), moved_exponential(augmented * later, direction * later)
        )
        return np.asarray(np.einsum("mk,kij->mij", moved, self.basis))

    def loop(self, numbers: FloatArray) -> FloatArray:
        """Return the loop matrices (m, N, N) that sampled plants make."""
        return np.asarray(self.constant + np.einsum("mk,kij->mij", numbers, self.basis))

    def remainder(self, augmented: FloatArray, half: tuple[FloatArray, FloatArray]) -> FloatArray:
        """Bound the second-order remainder of the loop matrix over cells in the 2-norm, (m,).

        ‖exp(M + E) − exp(M) − D exp(M)E‖ ≤ ½‖E‖² e^(‖M‖+‖E‖), once in phi and once in gamma.
        """
        change = half[0] * np.linalg.norm(self.per_mass, 2) + half[1] * np.linalg.norm(self.per_ratio, 2)
        exponent = np.minimum(spectral_norm(augmented) + change, _LARGEST_EXPONENT)
        return np.asarray(2.0 * 0.5 * change**2 * np.exp(exponent) * self.gain)

    def _half_ranges(
        self, cells: FloatArray, inverse: FloatArray, stiffness: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return how far 1/M and K/M get from the centre's, (m,) each."""
        far, wide = np.zeros(len(cells)), np.zeros(len(cells))
        for i, j in ((0, 1), (0, 3), (2, 1), (2, 3)):
            corner, stiff = self.plant_numbers(cells[:, [i, j]])
            far = np.maximum(far, np.abs(corner - inverse))
            wide = np.maximum(wide, np.abs(corner * stiff - inverse * stiffness))
        return far, wide

    def _numbers(self, whole: FloatArray, later: FloatArray) -> FloatArray:
        n, count = whole.shape[1] - 1, len(whole)
        gamma = later[:, :n, n] if self.fraction > 0.0 else whole[:, :n, n]
        return np.hstack([whole[:, :n, :n].reshape(count, n * n), gamma, whole[:, :n, n] - gamma])


def spectral_norm(matrices: FloatArray) -> FloatArray:
    """Return the 2-norm of each matrix (m, i, j)."""
    return np.asarray(np.linalg.svd(matrices, compute_uv=False)[:, 0])


def exponential(matrices: FloatArray) -> FloatArray:
    """Return exp of each matrix (m, k, k) by its Taylor series at a norm of at most 1/2, squared back."""
    largest = float(np.max(np.sum(np.abs(matrices), axis=2)))
    squarings = max(0, int(np.ceil(np.log2(max(2.0 * largest, 1e-300)))))
    small = matrices / 2.0**squarings
    out, term = np.eye(matrices.shape[1]) + small, small
    for k in range(2, _TAYLOR_TERMS + 1):
        term = term @ small / k
        out = out + term
    for _ in range(squarings):
        out = out @ out
    return np.asarray(out)


def moved_exponential(matrices: FloatArray, direction: FloatArray) -> FloatArray:
    """Return the derivative of the exponential along a direction: the upper right block of that of [[M, E], [0, M]]."""
    count, n = matrices.shape[:2]
    block = np.zeros((count, 2 * n, 2 * n))
    block[:, :n, :n], block[:, :n, n:], block[:, n:, n:] = matrices, direction, matrices
    return exponential(block)[:, :n, n:]


def lyapunov(a: FloatArray, weight: FloatArray) -> FloatArray:
    """Return Σ (Aᵀ)ᵏ W Aᵏ over k ≥ 0 of each matrix (m, N, N), twice as many terms each time."""
    total, power = weight, a
    for _ in range(_DOUBLINGS):
        total = total + np.swapaxes(power, 1, 2) @ total @ power
        power = power @ power
        if np.max(np.abs(power)) < _NOTHING:
            break
    return np.asarray(0.5 * (total + np.swapaxes(total, 1, 2)))


@dataclass(frozen=True, kw_only=True)
class StabilityProof:
    """The outcome: `holds` with the number of `cells`, or the plant at which it failed.

    `slack` is the smallest 1 − ‖L A L⁻¹‖ (bound included) over all cells.
    """

    holds: bool
    cells: int
    slack: float
    failed_mass_kg: float | None = None
    failed_stiffness_n_per_m: float | None = None


def lyapunov_stability(
    family: Family, controller: Controller, sample_time_s: float, *, most_cells: int = _MOST_CELLS
) -> StabilityProof:
    """Prove that the sampled loop is stable for every plant of the set, or name a plant for which it is not shown.

    The set is split until every cell is proved; a cell whose centre is unstable, or one that would have to be split
    too finely, ends the attempt.
    """
    loop = build_cell_loop(family, controller, sample_time_s)
    waiting, cells, slack = np.array([[0.0, 0.0, 1.0, 1.0]]), 0, math.inf
    while len(waiting):
        now, waiting = waiting[:_AT_ONCE], waiting[_AT_ONCE:]
        found = loop.slack(now)
        proved = found > 0.0
        cells, slack = cells + int(np.sum(proved)), min([slack, *found[proved].tolist()])
        failed, width = now[~proved], now[~proved, 2:] - now[~proved, :2]
        hopeless = (found[~proved] == -math.inf) | (np.max(width, axis=1, initial=0.0) < _SMALLEST_SHARE)
        if np.any(hopeless) or (len(failed) and cells + len(waiting) + len(failed) > most_cells):
            worst = int(np.argmax(hopeless))
            inverse, stiffness = loop.plant_numbers(0.5 * (failed[[worst], :2] + failed[[worst], 2:]))
            return StabilityProof(
                holds=False,
                cells=cells,
                slack=float(found[~proved][worst]),
                failed_mass_kg=float(1.0 / inverse[0]),
                failed_stiffness_n_per_m=float(stiffness[0]),
            )
        waiting = np.vstack([_split(loop, failed), waiting])
    return StabilityProof(holds=True, cells=cells, slack=slack)


def _split(loop: CellLoop, cells: FloatArray) -> FloatArray:
    """Halve cells (m, 4) along the side that moves the plant more."""
    width = cells[:, 2:] - cells[:, :2]
    moves = width * [
        (loop.inverse[1] - loop.inverse[0]) * np.linalg.norm(loop.per_mass),
        (loop.stiffness[1] - loop.stiffness[0]) * loop.inverse[1] * np.linalg.norm(loop.per_ratio),
    ]
    rows, side = np.arange(len(cells)), np.argmax(moves, axis=1)
    middle = 0.5 * (cells[rows, side] + cells[rows, side + 2])
    lower, upper = cells.copy(), cells.copy()
    lower[rows, side + 2], upper[rows, side] = middle, middle
    return np.vstack([lower, upper])


def build_cell_loop(family: Family, controller: Controller, sample_time_s: float) -> CellLoop:
    """Find how the loop matrix depends on 1/M_p and K_e/M_p.

    A point of the unit square is 1/M_p and K_e: a rectangle of (1/M, K/M) would hold stiffness that nobody asked for.
    """
    (mass_low, mass_high), stiffness = family.range_of(MASS), family.range_of(STIFFNESS)
    whole = build_plant_matrices(with_values(family.nominal, {MASS: 1.0, STIFFNESS: 0.0}), sample_time_s)
    n = len(whole.b)
    # Only the last row (payload acceleration) depends on the mass: it is 1/M times the row for 1 kg.
    steady, per_mass, per_ratio = np.zeros((3, n + 1, n + 1))
    steady[: n - 1, :n], steady[: n - 1, n] = whole.a[:-1], whole.b[:-1]
    per_mass[n - 1, :n], per_mass[n - 1, n] = whole.a[-1], whole.b[-1]
    per_ratio[n - 1, n - 2] = -(sample_time_s**2)
    heaviest = with_values(family.nominal, {MASS: mass_high, STIFFNESS: stiffness[0]})
    sampled = build_sampled_plant(heaviest, sample_time_s)
    constant, basis = _affine(sampled, controller)
    gain, rows, columns = _bounds(sampled, controller)
    return CellLoop(
        steady=steady,
        per_mass=per_mass,
        per_ratio=per_ratio,
        fraction=sampled.fraction,
        constant=constant,
        basis=basis,
        inverse=(1.0 / mass_high, 1.0 / mass_low),
        stiffness=stiffness,
        gain=gain,
        rows=rows,
        columns=columns,
    )


def _affine(sampled: SampledPlant, controller: Controller) -> tuple[FloatArray, FloatArray]:
    """Return the loop matrix without the plant, and what each number of phi, gamma and gamma_old adds to it."""
    n = sampled.state_count

    def reduced(numbers: FloatArray) -> FloatArray:
        phi, gamma, gamma_old = np.split(numbers, [n * n, n * n + n])
        moved = replace(sampled, phi=phi.reshape(n, n), gamma=gamma, gamma_old=gamma_old)
        return stability_matrix(build_loop(moved, controller))

    constant = reduced(np.zeros(n * n + 2 * n))
    return constant, np.array([reduced(unit) - constant for unit in np.eye(n * n + 2 * n)])


def _bounds(sampled: SampledPlant, controller: Controller) -> tuple[float, int, int]:
    """Return by how much a change of (phi, gamma, gamma_old) can be larger in the loop matrix, its rows and columns.

    gamma_old takes part through two exponentials; gamma is multiplied by the command row, and deflation by at most 1 +
    the translation's size. In contact a change is in plant rows only, and acts on plant and past commands only.
    """
    loop, n = build_loop(sampled, controller), sampled.state_count
    command = 0.0 if sampled.whole_delay > 0 else float(np.linalg.norm(loop.a[n])) if sampled.chain_length else 0.0
    if sampled.chain_length == 0:
        # Without delay the command row is spread over the plant rows: gamma·command is those rows less phi.
        spread = loop.a[:n].copy()
        spread[:, :n] -= sampled.phi
        command = float(np.linalg.norm(spread)) / max(float(np.linalg.norm(sampled.gamma)), 1e-300)
    order = len(stability_matrix(loop))
    if not loop.is_anchored:
        shift = loop.translation / np.max(np.abs(loop.translation))
        return (2.0 + command) * (1.0 + float(np.linalg.norm(shift))), order, order
    return 2.0 + command, n, n + sampled.chain_length if sampled.whole_delay > 0 else order
