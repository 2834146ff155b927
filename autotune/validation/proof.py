"""Prove stability of the exact sampled loop over continuous ranges of K_e and M_p, cell by cell.

In every cell a quadratic Lyapunov function is found for the loop at its centre and shown to decrease for the whole
cell: with V(s) = |L s|², it decreases where ‖L A L⁻¹‖ < 1. Two of the plant's numbers vary, 1/M_p and K_e/M_p; the
continuous plant is affine in them. Over a cell, A = A_c + δ₁ A₁ + δ₂ A₂ + R with the derivatives of the matrix
exponential and a bound on the second-order remainder R. The norm is convex in (δ₁, δ₂), so the corners decide.
The arithmetic is double precision; a bound on its rounding, scaled by the matrices at hand, is taken off.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from problems.model.plant import NO_FILTER, Coupling, Environment, Payload, Plant, WrenchFilter, build_plant_matrices
from problems.model.robot import RobotModel
from problems.model.sampled import Controller, SampledPlant, build_loop, build_sampled_plant, stability_matrix

from .proof_cells import CellLoop

FloatArray = NDArray[np.float64]

_SMALLEST_SHARE = 1e-7
_MOST_CELLS = 20000
_AT_ONCE = 512


@dataclass(frozen=True, kw_only=True)
class UncertainPlant:
    """A plant whose payload mass and environment stiffness lie anywhere in intervals; (0, 0) is free space."""

    robot: RobotModel
    coupling: Coupling
    drag_n_s_per_m: float
    environment_damping_n_s_per_m: float
    payload_mass_kg: tuple[float, float]
    environment_stiffness_n_per_m: tuple[float, float]
    wrench_filter: WrenchFilter = NO_FILTER

    def at(self, mass_kg: float, stiffness_n_per_m: float) -> Plant:
        """Return one plant of the set."""
        return Plant(
            robot=self.robot,
            coupling=self.coupling,
            payload=Payload(mass_kg=mass_kg, drag_n_s_per_m=self.drag_n_s_per_m),
            environment=Environment(
                stiffness_n_per_m=stiffness_n_per_m, damping_n_s_per_m=self.environment_damping_n_s_per_m
            ),
            wrench_filter=self.wrench_filter,
        )

    @property
    def port(self) -> tuple[RobotModel, WrenchFilter]:
        """What the rendered admittance depends on besides the controller."""
        return self.robot, self.wrench_filter

    def in_free_space(self) -> "UncertainPlant":
        """Return the same plants with nothing to touch."""
        return replace(self, environment_stiffness_n_per_m=(0.0, 0.0), environment_damping_n_s_per_m=0.0)


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


@lru_cache(maxsize=16)
def prove_stability(plants: UncertainPlant, controller: Controller, sample_time_s: float) -> StabilityProof:
    """Prove that the sampled loop is stable for every plant of the set, or name a plant for which it is not shown.

    The set is split until every cell is proved; a cell whose centre is unstable, or one that would have to be split
    too finely, ends the attempt.
    """
    loop = build_cell_loop(plants, controller, sample_time_s)
    waiting, cells, slack = np.array([[0.0, 0.0, 1.0, 1.0]]), 0, math.inf
    while len(waiting):
        now, waiting = waiting[:_AT_ONCE], waiting[_AT_ONCE:]
        found = loop.slack(now)
        proved = found > 0.0
        cells, slack = cells + int(np.sum(proved)), min([slack, *found[proved].tolist()])
        failed, width = now[~proved], now[~proved, 2:] - now[~proved, :2]
        hopeless = (found[~proved] == -math.inf) | (np.max(width, axis=1, initial=0.0) < _SMALLEST_SHARE)
        if np.any(hopeless) or (len(failed) and cells + len(waiting) + len(failed) > _MOST_CELLS):
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


def build_cell_loop(plants: UncertainPlant, controller: Controller, sample_time_s: float) -> CellLoop:
    """Find how the loop matrix depends on 1/M_p and K_e/M_p.

    A point of the unit square is 1/M_p and K_e: a rectangle of (1/M, K/M) would hold stiffness that nobody asked for.
    """
    mass_low, mass_high = plants.payload_mass_kg
    whole = build_plant_matrices(plants.at(1.0, 0.0), sample_time_s)
    n = len(whole.b)
    # Only the last row (payload acceleration) depends on the mass: it is 1/M times the row for 1 kg.
    steady, per_mass, per_ratio = np.zeros((3, n + 1, n + 1))
    steady[: n - 1, :n], steady[: n - 1, n] = whole.a[:-1], whole.b[:-1]
    per_mass[n - 1, :n], per_mass[n - 1, n] = whole.a[-1], whole.b[-1]
    per_ratio[n - 1, n - 2] = -(sample_time_s**2)
    sampled = build_sampled_plant(plants.at(mass_high, plants.environment_stiffness_n_per_m[0]), sample_time_s)
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
        stiffness=plants.environment_stiffness_n_per_m,
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
