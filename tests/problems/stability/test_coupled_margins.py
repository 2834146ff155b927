import numpy as np
import pytest

from problems.model.coupled import PointSurface, build_coupled_loop, build_coupled_sampled_plant
from problems.model.sampled import build_sampled_plant
from problems.stability.coupled_margins import (
    coupled_sensitivities,
    find_coupled_margins,
    find_coupled_modulus,
    scaled_norm,
    worst_mode,
)
from problems.stability.margins import UnstableLoopError, find_margins
from tests.problems.axes import PERIOD_S
from tests.problems.coupled_cases import LAWS, SCALE, cell, largest_sensitivity, single, wall


@pytest.mark.parametrize("surface", [None, wall()])
def test_without_an_offset_the_margins_are_those_of_the_axes_alone(surface: PointSurface | None) -> None:
    found = find_coupled_margins(build_coupled_sampled_plant(cell(0.0, surface), PERIOD_S), LAWS, SCALE)
    alone = [find_margins(build_sampled_plant(single(i, surface), PERIOD_S), law) for i, law in enumerate(LAWS)]
    # Both search minima to nine digits or more.
    for each, own in zip(found.loops, alone, strict=True):
        assert (each.modulus, each.disk) == pytest.approx((own.modulus, own.disk), rel=1e-8)
    assert found.modulus == pytest.approx(min(own.modulus for own in alone), rel=1e-8)
    assert found.disk == pytest.approx(min(own.disk for own in alone), rel=1e-8)


@pytest.mark.parametrize("surface", [None, wall(), wall(5e5, np.array([1.0, 0.4]))])
def test_the_smallest_singular_value_is_the_one_that_needs_no_grid(surface: PointSurface | None) -> None:
    sampled = build_coupled_sampled_plant(cell(surface=surface), PERIOD_S)
    loop = build_coupled_loop(sampled, LAWS)
    found = find_coupled_margins(sampled, LAWS, SCALE, loop)
    assert find_coupled_modulus(sampled, LAWS, SCALE) == find_coupled_modulus(sampled, LAWS, SCALE, loop)
    assert find_coupled_modulus(sampled, LAWS, SCALE) == (found.modulus, found.modulus_hz)
    gain, hz = largest_sensitivity(loop, (0, 1), SCALE)
    # Of the forces alone: the commands may have less.
    assert found.modulus <= 1.0 / gain * (1.0 + 1e-9)
    dense = np.append(np.linspace(1.0, np.pi / PERIOD_S, 4000), 2.0 * np.pi * hz)
    seen = np.linalg.svd(coupled_sensitivities(sampled, LAWS, SCALE, dense), compute_uv=False)[..., 0]
    assert np.all(1.0 / np.max(seen, axis=1) >= found.modulus * (1.0 - 1e-9))
    assert float(np.max(seen[1])) == pytest.approx(gain, rel=1e-6)  # found to 1e-9, where it is flat


def test_an_offset_takes_from_the_margins_of_both_axes() -> None:
    alone, together = (
        find_coupled_margins(build_coupled_sampled_plant(cell(offset), PERIOD_S), LAWS, SCALE) for offset in (0.0, 0.15)
    )
    assert together.modulus < 0.5 * alone.modulus
    # At the mode of both: on a flange that stands it has 15.4 Hz (the closed form), on one that yields more.
    assert 15.4 < together.modulus_hz < 25.0
    assert all(a.modulus < b.modulus for a, b in zip(together.loops, alone.loops, strict=True))
    # All loops at a time tolerate less than each alone.
    assert together.disk <= min(each.disk for each in together.loops)


def test_an_unstable_loop_has_no_margins_and_names_its_mode() -> None:
    softer = tuple(type(law)(mass_kg=0.3 * law.mass_kg, damping_n_s_per_m=0.3 * law.damping_n_s_per_m) for law in LAWS)
    sampled = build_coupled_sampled_plant(cell(), PERIOD_S)
    with pytest.raises(UnstableLoopError):
        find_coupled_margins(sampled, softer, SCALE)
    with pytest.raises(UnstableLoopError):
        find_coupled_modulus(sampled, softer, SCALE)
    mode = worst_mode(sampled, build_coupled_loop(sampled, softer))
    assert mode.radius > 1.0
    assert 10.0 < mode.frequency_hz < 25.0


def test_scaling_bounds_the_structured_gain() -> None:
    """Of (0, a; b, 0) the structured singular value is √(a b), and balancing finds it."""
    found = scaled_norm(np.array([[[0.0, 8.0], [0.5, 0.0]], [[1.0, 0.0], [0.0, 3.0]]], dtype=np.complex128))
    np.testing.assert_allclose(found, [2.0, 3.0], rtol=1e-12)
    rng = np.random.default_rng(1)
    drawn = rng.normal(size=(5, 4, 4)) + 1j * rng.normal(size=(5, 4, 4))
    assert np.all(scaled_norm(drawn) <= np.linalg.norm(drawn, ord=2, axis=(-2, -1)))
    assert np.all(scaled_norm(drawn) >= np.max(np.abs(np.linalg.eigvals(drawn)), axis=-1) * (1.0 - 1e-12))
