"""The proof of one cell in plain steps, by other libraries: the oracle of `autotune.validation.proof_cells`."""

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgWarning, expm_frechet, solve_discrete_lyapunov

from autotune.validation.proof import UncertainPlant
from problems.model.controller import AdmittanceController
from problems.model.plant import build_plant_matrices
from problems.model.sampled import SampledPlant, build_loop, build_sampled_plant, stability_matrix

FloatArray = NDArray[np.float64]

_ROUNDING_UNITS = 100.0 * np.finfo(np.float64).eps
_LARGEST_EXPONENT = 600.0


@dataclass(frozen=True, kw_only=True)
class Cell:
    """A rectangle of the unit square that the two varying numbers, 1/M_p and K_e/M_p, are mapped to."""

    low: tuple[float, float]
    high: tuple[float, float]

    @property
    def centre(self) -> tuple[float, float]:
        return 0.5 * (self.low[0] + self.high[0]), 0.5 * (self.low[1] + self.high[1])


class StraightLoop:
    """The closed loop as a function of 1/M_p and K_e/M_p, with its derivatives."""

    def __init__(self, plants: UncertainPlant, controller: AdmittanceController, sample_time_s: float) -> None:
        self.plants, self.controller, self.h = plants, controller, sample_time_s
        self.free = plants.environment_stiffness_n_per_m == (0.0, 0.0)
        mass_low, mass_high = plants.payload_mass_kg
        self.inverse = (1.0 / mass_high, 1.0 / mass_low)
        # The rectangle (1/M, K/M) would hold stiffness that nobody asked for; K itself is the second coordinate, and
        # a cell's rectangle in (1/M, K/M) is built around its corners.
        self.stiffness = plants.environment_stiffness_n_per_m
        reference = plants.at(1.0, 0.0)
        whole = build_plant_matrices(reference, sample_time_s)
        size = len(whole.b)
        self.size = size
        # Only the last row (payload acceleration) depends on the mass: it is 1/M times the row for 1 kg.
        self.per_mass = np.zeros((size + 1, size + 1))
        self.per_mass[size - 1, :size], self.per_mass[size - 1, size] = whole.a[-1], whole.b[-1]
        self.per_ratio = np.zeros((size + 1, size + 1))
        self.per_ratio[size - 1, size - 2] = -(sample_time_s**2)

    def plant_numbers(self, point: tuple[float, float]) -> tuple[float, float]:
        """Return (M_p, K_e) of a point of the unit square."""
        inverse = self.inverse[0] + point[0] * (self.inverse[1] - self.inverse[0])
        return 1.0 / inverse, self.stiffness[0] + point[1] * (self.stiffness[1] - self.stiffness[0])

    def slack(self, cell: Cell) -> float:
        """Return 1 − (bound on ‖L A L⁻¹‖ over the cell); −inf if the loop at the centre is unstable."""
        mass, stiffness = self.plant_numbers(cell.centre)
        sampled = build_sampled_plant(self.plants.at(mass, stiffness), self.h)
        centre = self._reduced(sampled)
        if not np.max(np.abs(np.linalg.eigvals(centre))) < 1.0:
            return -math.inf
        half = self._half_ranges(cell, mass, stiffness)
        first = [self._derivative(sampled, centre, direction) for direction in (self.per_mass, self.per_ratio)]
        remainder = self._remainder(sampled, half)
        best = -1.0
        for root in lyapunov_roots(centre):
            inverse = np.asarray(np.linalg.inv(root), dtype=np.float64)
            corners = [
                float(np.linalg.norm(root @ (centre + s1 * half[0] * first[0] + s2 * half[1] * first[1]) @ inverse, 2))
                for s1 in (-1.0, 1.0)
                for s2 in (-1.0, 1.0)
            ]
            rest = self._reach(root, inverse, sampled) * remainder
            rounding = _ROUNDING_UNITS * float(np.linalg.norm(np.abs(root) @ np.abs(centre) @ np.abs(inverse)))
            best = max(best, 1.0 - max(corners) - rest - rounding)
        return best

    def _half_ranges(self, cell: Cell, mass: float, stiffness: float) -> tuple[float, float]:
        """Return how far 1/M and K/M get from the centre's in this cell."""
        corners = [self.plant_numbers((a, b)) for a in (cell.low[0], cell.high[0]) for b in (cell.low[1], cell.high[1])]
        return (
            max(abs(1.0 / m - 1.0 / mass) for m, _ in corners),
            max(abs(k / m - stiffness / mass) for m, k in corners),
        )

    def _reduced(self, sampled: SampledPlant) -> FloatArray:
        return stability_matrix(build_loop(sampled, self.controller))

    def _derivative(self, sampled: SampledPlant, centre: FloatArray, direction: FloatArray) -> FloatArray:
        """Return the derivative of the loop matrix: the loop is affine in phi, gamma and gamma_old."""
        augmented = self._augmented(sampled)
        size, fraction = self.size, sampled.fraction
        whole = expm_frechet(augmented, direction, compute_expm=False)
        newer = expm_frechet(augmented * (1.0 - fraction), direction * (1.0 - fraction), compute_expm=False)
        gamma = newer[:size, size] if fraction > 0.0 else whole[:size, size]
        older = whole[:size, size] - gamma if fraction > 0.0 else np.zeros(size)
        moved = replace(
            sampled,
            phi=np.ascontiguousarray(sampled.phi + whole[:size, :size]),
            gamma=sampled.gamma + gamma,
            gamma_old=sampled.gamma_old + older,
        )
        return self._reduced(moved) - centre

    def _augmented(self, sampled: SampledPlant) -> FloatArray:
        out = np.zeros((self.size + 1, self.size + 1))
        out[: self.size, : self.size], out[: self.size, self.size] = sampled.rate, sampled.drive
        return out

    def _remainder(self, sampled: SampledPlant, half: tuple[float, float]) -> float:
        """Bound the second-order remainder of the loop matrix over the cell in the 2-norm.

        ‖exp(M + E) − exp(M) − D exp(M)E‖ ≤ ½‖E‖² e^(‖M‖+‖E‖). It enters phi and gamma once each, gamma_old through two
        exponentials; gamma is multiplied by the command row, and deflation by at most 1 + the translation's size.
        """
        change = half[0] * float(np.linalg.norm(self.per_mass, 2)) + half[1] * float(np.linalg.norm(self.per_ratio, 2))
        size = float(np.linalg.norm(self._augmented(sampled), 2))
        exponential = 0.5 * change**2 * math.exp(min(size + change, _LARGEST_EXPONENT))
        return 2.0 * exponential * self._command_size(sampled)

    def _reach(self, root: FloatArray, inverse: FloatArray, sampled: SampledPlant) -> float:
        """Bound ‖L R L⁻¹‖/‖R‖: in contact R has plant rows only, and acts on plant and past commands only."""
        rows = columns = slice(None)
        if not self.free:
            rows = slice(0, self.size)
            if sampled.whole_delay > 0:
                columns = slice(0, self.size + sampled.chain_length)
        return float(np.linalg.norm(root[:, rows], 2) * np.linalg.norm(inverse[columns], 2))

    def _command_size(self, sampled: SampledPlant) -> float:
        """Return how much larger a change of (phi, gamma, gamma_old) can be in the loop matrix than in the plant."""
        loop = build_loop(sampled, self.controller)
        n = self.size
        command = 0.0 if sampled.whole_delay > 0 else float(np.linalg.norm(loop.a[n])) if sampled.chain_length else 0.0
        if sampled.chain_length == 0:
            # Without delay the command row is spread over the plant rows: gamma·command is those rows less phi.
            spread = loop.a[:n].copy()
            spread[:, :n] -= sampled.phi
            command = float(np.linalg.norm(spread)) / max(float(np.linalg.norm(sampled.gamma)), 1e-300)
        deflation = 1.0
        if self.free:
            shift = loop.translation / np.max(np.abs(loop.translation))
            deflation = 1.0 + float(np.linalg.norm(shift))
        return (2.0 + command) * deflation


def lyapunov_roots(a: FloatArray) -> list[FloatArray]:
    """Return candidates L with V = |L s|²: one from the modes, one from a Lyapunov equation."""
    roots = []
    radius = float(np.max(np.abs(np.linalg.eigvals(a))))
    # A^T P A − σ² P = −W with σ between the radius and 1 keeps the decrease even in every direction.
    for share in (0.5, 0.1):
        sigma = radius + share * (1.0 - radius)
        scaled = a / sigma
        weight = np.eye(len(a))
        for _ in range(2):
            with warnings.catch_warnings():
                # What an ill-conditioned equation gives is a candidate like any other: the proof decides.
                warnings.simplefilter("ignore", LinAlgWarning)
                p = solve_discrete_lyapunov(scaled.T, weight)
            p = 0.5 * (p + p.T)
            diagonal = np.diag(np.diag(p))
            weight = diagonal / float(np.max(diagonal)) + 1e-9 * np.eye(len(a))
            try:
                roots.append(np.linalg.cholesky(p).T)
            except np.linalg.LinAlgError:
                break
    return roots
