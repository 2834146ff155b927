"""The oracle of Lyapunov functions, inside: derivative, remainder, and cell by cell."""

from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from autotune.certificate.family import Family
from problems.arrays import FloatArray
from problems.design.uncertainty import MASS, STIFFNESS
from problems.model.plant_parameters import with_values
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, stability_matrix
from tests.autotune.certificate.lyapunov import build_cell_loop, lyapunov
from tests.autotune.certificate.plants import random_points, uncertain
from tests.autotune.certificate.test_stability import CALM, EVERY_KIND
from tests.problems.axes import PERIOD_S


def numbers_of(inverse: float, stiffness: float) -> tuple[FloatArray, FloatArray]:
    return np.array([inverse]), np.array([stiffness])


def reduced(family: Family, mass: float, stiffness: float) -> FloatArray:
    """Return the matrix whose eigenvalues decide, of one plant."""
    plant = with_values(family.nominal, {MASS: mass, STIFFNESS: stiffness})
    return stability_matrix(build_loop(build_sampled_plant(plant, PERIOD_S), CALM))


def set_of(robot: RobotModel, free: bool, **ranges: Any) -> Family:
    plants = uncertain(robot=robot, coupling_damping=150.0, environment_damping=0.0 if free else 40.0, **ranges)
    family = Family(nominal=plants.nominal, ranges=plants.ranges, sample_time_s=PERIOD_S)
    return family.in_free_space() if free else family


@EVERY_KIND
@pytest.mark.parametrize("free", [False, True], ids=["contact", "free space"])
def test_the_loop_is_that_of_the_plant(robot: RobotModel, free: bool) -> None:
    plants = set_of(robot, free)
    loop, stiffness = build_cell_loop(plants, CALM, PERIOD_S), 0.0 if free else 1.5e5
    found = loop.loop(loop.sampled(loop.augmented(*numbers_of(1.0 / 14.0, stiffness))))[0]
    np.testing.assert_allclose(found, reduced(plants, 14.0, stiffness), rtol=0.0, atol=1e-12 * np.max(np.abs(found)))


@EVERY_KIND
@pytest.mark.parametrize("free", [False, True], ids=["contact", "free space"])
def test_the_derivative_is_that_of_finite_differences(robot: RobotModel, free: bool) -> None:
    plants = set_of(robot, free)
    loop = build_cell_loop(plants, CALM, PERIOD_S)
    inverse, ratio = 1.0 / 16.0, 0.0 if free else 1.5e5 / 16.0
    augmented = loop.augmented(*numbers_of(inverse, ratio / inverse))
    steps = [(loop.per_mass, 1e-4 * inverse, 0.0)]
    # In free space the stiffness stays 0: with any stiffness it would not be free space.
    steps += [] if free else [(loop.per_ratio, 0.0, 1e-4 * ratio)]
    for direction, d_inverse, d_ratio in steps:
        above, below = (
            reduced(plants, 1.0 / (inverse + s * d_inverse), (ratio + s * d_ratio) / (inverse + s * d_inverse))
            for s in (1.0, -1.0)
        )
        slope = (above - below) / (2.0 * (d_inverse + d_ratio))
        # Central differences: relative error 1e-8 of truncation, 1e-12 of rounding, both well below.
        derivative = loop.derivative(augmented, direction)[0]
        np.testing.assert_allclose(derivative, slope, rtol=0.0, atol=1e-6 * float(np.max(np.abs(slope))))


@EVERY_KIND
@pytest.mark.parametrize("free", [False, True], ids=["contact", "free space"])
@pytest.mark.parametrize("width", [1.0, 0.1])
def test_the_remainder_stays_below_its_bound(robot: RobotModel, free: bool, width: float) -> None:
    """True second-order remainder at random points and at the corners of a cell against the bound used in the proof."""
    plants = set_of(robot, free, mass=(10.0, 20.0), stiffness=(2e4, 5e5))
    loop = build_cell_loop(plants, CALM, PERIOD_S)
    cell = np.array([0.3 * (1.0 - width), 0.2 * (1.0 - width), 0.3 + 0.7 * width, 0.2 + 0.8 * width])
    inverse, stiffness = loop.plant_numbers(0.5 * (cell[None, :2] + cell[None, 2:]))
    augmented = loop.augmented(inverse, stiffness)
    half = loop._half_ranges(cell[None], inverse, stiffness)
    at = loop.loop(loop.sampled(augmented))[0]
    slopes = [loop.derivative(augmented, direction)[0] for direction in (loop.per_mass, loop.per_ratio)]
    bound = float(loop.remainder(augmented, half)[0])
    rng = np.random.default_rng(3)
    largest = 0.0
    for share in [*np.ndindex(2, 2), *rng.random((20, 2))]:
        point = cell[:2] + np.array(share) * (cell[2:] - cell[:2])
        there, k = loop.plant_numbers(point[None])
        moves = (there[0] - inverse[0], k[0] * there[0] - stiffness[0] * inverse[0])
        # No point of the cell is outside of the rectangle that the corners of the norm are taken from.
        assert all(abs(move) <= h[0] * (1.0 + 1e-9) for move, h in zip(moves, half, strict=True))
        linear = at + moves[0] * slopes[0] + moves[1] * slopes[1]
        largest = max(largest, float(np.linalg.norm(reduced(plants, 1.0 / there[0], k[0]) - linear, 2)))
    assert 0.0 < largest < bound


@EVERY_KIND
def test_the_norm_over_a_cell_is_below_what_the_slack_promises(robot: RobotModel) -> None:
    """A cell with slack has one Lyapunov function for all its plants: each contracts by at least the slack."""
    masses, stiffnesses = (15.9, 16.1), (1.45e5, 1.5e5)
    plants = set_of(robot, False, mass=masses, stiffness=stiffnesses)
    loop, cell = build_cell_loop(plants, CALM, PERIOD_S), np.array([[0.0, 0.0, 1.0, 1.0]])
    slack = float(loop.slack(cell)[0])
    assert slack > 0.0
    inverse, stiffness = loop.plant_numbers(np.array([[0.5, 0.5]]))
    centre = reduced(plants, float(1.0 / inverse[0]), float(stiffness[0]))
    matrices = [reduced(plants, m, k) for m, k in random_points(uncertain(mass=masses, stiffness=stiffnesses), 30)]
    radius, weight, contraction = float(np.max(np.abs(np.linalg.eigvals(centre)))), np.eye(len(centre)), []
    for _ in range(2):
        # The functions that the oracle tries first, by scipy's solver.
        p = solve_discrete_lyapunov((centre / (0.5 + 0.5 * radius)).T, weight)
        root = np.linalg.cholesky(0.5 * (p + p.T)).T
        contraction.append(max(float(np.linalg.norm(root @ a @ np.linalg.inv(root), 2)) for a in matrices))
        weight = np.diag(np.diag(p)) / float(np.max(np.diag(p))) + 1e-9 * np.eye(len(centre))
    assert min(contraction) <= 1.0 - slack


def test_the_sum_solves_the_lyapunov_equation() -> None:
    rng = np.random.default_rng(1)
    a = rng.normal(size=(3, 6, 6))
    a *= 0.999 / np.max(np.abs(np.linalg.eigvals(a)), axis=1)[:, None, None]
    weight = np.broadcast_to(np.eye(6), a.shape)
    p = lyapunov(a, weight)
    np.testing.assert_allclose(np.swapaxes(a, 1, 2) @ p @ a - p, -weight, atol=1e-9 * np.max(p))
