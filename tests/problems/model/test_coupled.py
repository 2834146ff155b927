import itertools

import numpy as np
import pytest

from problems.errors import ParameterError
from problems.model.coupled import (
    CoupledPlant,
    PointSurface,
    RigidPayload,
    build_coupled_loop,
    build_coupled_matrices,
    build_coupled_sampled_plant,
    contact_direction,
    coupled_poles,
)
from problems.model.sampled import build_loop, build_sampled_plant, stability_matrix
from tests.problems.axes import PERIOD_S
from tests.problems.coupled_cases import COM_M, INERTIA_KG_M2, LAWS, axis, body, cell, single, wall


@pytest.mark.parametrize("surface", [None, wall()])
def test_without_an_offset_the_poles_are_those_of_the_axes_alone(surface: PointSurface | None) -> None:
    loop = build_coupled_loop(build_coupled_sampled_plant(cell(0.0, surface), PERIOD_S), LAWS)
    found = coupled_poles(loop)[0]
    alone = np.concatenate(
        [
            np.linalg.eigvals(stability_matrix(build_loop(build_sampled_plant(single(i, surface), PERIOD_S), law)))
            for i, law in enumerate(LAWS)
        ]
    )
    assert len(found) == len(alone)
    # Poles near 0 are those of the delay chains, which rounding spreads.
    for pole in found[np.abs(found) > 0.3]:
        assert np.min(np.abs(alone - pole)) < 1e-12


def test_the_mode_of_an_offset_mass_has_the_frequency_of_its_closed_form() -> None:
    """det(K − ω² M) = 0 of (m, m c; m c, I): (m I − m² c²) ω⁴ − (I K_x + m K_r) ω² + K_x K_r = 0."""
    k_x, k_r = 3e5, 2.3e4
    plants = (axis(k_x, 0.0, 0.0, 0.0), axis(k_r, 0.0, 0.0, 0.0))
    matrix = body().mass_matrix[np.ix_([0, 4], [0, 4])]
    assert matrix.tolist() == [[16.0, 16.0 * COM_M], [16.0 * COM_M, INERTIA_KG_M2]]
    made = build_coupled_matrices(CoupledPlant(plants=plants, mass_matrix=matrix), 1e-3)
    square = np.roots([16.0 * INERTIA_KG_M2 - (16.0 * COM_M) ** 2, -(INERTIA_KG_M2 * k_x + 16.0 * k_r), k_x * k_r])
    expected = np.sort(np.sqrt(square)) / (2.0 * np.pi)
    poles = np.linalg.eigvals(made.a) / 1e-3
    found = np.sort(poles.imag[poles.imag > 1.0]) / (2.0 * np.pi)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    # The 19 Hz at which such a payload swings: below those of x and of ry alone.
    assert 18.5 < found[0] < 20.0 < np.sqrt(k_x / 16.0) / (2.0 * np.pi)
    assert found[0] < np.sqrt(k_r / INERTIA_KG_M2) / (2.0 * np.pi)


def test_momentum_follows_from_the_points_of_the_body() -> None:
    """Of point masses M is the sum of m_i J_iᵀ J_i with the rows of each point's velocity."""
    rng = np.random.default_rng(3)
    masses, places = rng.uniform(0.5, 2.0, 5), rng.normal(scale=0.2, size=(5, 3))
    inertia = sum(m * (p @ p * np.eye(3) - np.outer(p, p)) for m, p in zip(masses, places, strict=True))
    com = masses @ places / np.sum(masses)
    found = RigidPayload(mass_kg=float(np.sum(masses)), com_S_m=com, inertia_S_kg_m2=inertia).mass_matrix
    rows = np.array([[contact_direction(p.tolist(), normal.tolist()) for normal in np.eye(3)] for p in places])
    expected = np.einsum("i,inj,ink->jk", masses, rows, rows)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize(("surface", "unheld"), [(None, 2), (wall(), 1), (wall(direction=np.array([1.0, 0.3])), 1)])
def test_what_nothing_holds_goes_on_by_itself(surface: PointSurface | None, unheld: int) -> None:
    loop = build_coupled_loop(build_coupled_sampled_plant(cell(surface=surface), PERIOD_S), LAWS)
    moves = loop.translations
    assert moves.shape == (len(loop.a), unheld)
    np.testing.assert_allclose(loop.a @ moves, moves, atol=1e-11)
    every, others = np.linalg.eigvals(loop.a), coupled_poles(loop)[0]
    assert len(others) == len(every) - unheld
    assert sum(abs(pole - 1.0) < 1e-6 for pole in every) == unheld + sum(abs(pole - 1.0) < 1e-6 for pole in others)


def test_a_held_axis_is_a_spring_to_the_flange_that_stands() -> None:
    loop = build_coupled_loop(build_coupled_sampled_plant(cell(), PERIOD_S), (LAWS[0], None))
    assert loop.translations.shape[1] == 1
    assert not np.any(loop.c_command[1])


def test_no_body_has_less_inertia_than_its_mass_at_its_centre() -> None:
    with pytest.raises(ParameterError, match="positive definite"):
        cell(0.25)
    for i, j in itertools.combinations(range(3), 2):
        skew = np.eye(3)
        skew[i, j] = 0.1
        with pytest.raises(ParameterError, match="symmetric"):
            RigidPayload(mass_kg=1.0, com_S_m=np.zeros(3), inertia_S_kg_m2=skew)
