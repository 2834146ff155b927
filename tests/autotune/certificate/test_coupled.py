"""Proofs of axes together: the enclosed loop is the sampled one, what is true is proved, what is false never is."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.certificate.coupled import prove_coupled
from autotune.certificate.coupled_system import AffineLoop, CoupledFamily, coupled_system
from problems.errors import ParameterError
from problems.model.coupled import CoupledPlant, PointSurface, build_coupled_loop, build_coupled_sampled_plant
from problems.model.plant import WrenchFilter
from problems.stability.coupled_margins import (
    coupled_sensitivities,
    find_coupled_margins,
    largest_gain,
)
from tests.problems.axes import PERIOD_S
from tests.problems.coupled_cases import LAWS, SCALE, cell, largest_sensitivity, wall

SOFT, STIFF = 1e5, 1.1e5


def family(
    plant: CoupledPlant, stiffness: tuple[float, float] = (0.0, 0.0), factors: tuple[float, float] = (1.0, 1.0)
) -> CoupledFamily:
    return CoupledFamily(
        plant=plant,
        laws=LAWS,
        scale=SCALE,
        sample_time_s=PERIOD_S,
        stiffness_n_per_m=stiffness,
        mass_factors=factors,
    )


def gain_of(plant: CoupledPlant) -> float:
    return largest_sensitivity(build_coupled_loop(build_coupled_sampled_plant(plant, PERIOD_S), LAWS), (0, 1), SCALE)[0]


def command_gain(plant: CoupledPlant) -> float:
    """Return max σ(S) at the commands from frequency responses, another road than the enclosed matrices."""
    found = find_coupled_margins(build_coupled_sampled_plant(plant, PERIOD_S), LAWS, SCALE)
    at_command = [
        coupled_sensitivities(build_coupled_sampled_plant(plant, PERIOD_S), LAWS, SCALE, grid)[0]
        for grid in np.split(np.geomspace(0.1, 0.999999 * np.pi / PERIOD_S, 80_000), 20)
    ]
    assert found.spectral_radius < 1.0
    return max(float(np.max(np.linalg.norm(each, ord=2, axis=(1, 2)))) for each in at_command)


def middle_gain(system: AffineLoop) -> float:
    n, m = system.states, system.middle
    return largest_gain(m[:n, :n], m[:n, n:], m[n:, :n], m[n:, n:])[0]


def filtered(plant: CoupledPlant) -> CoupledPlant:
    wrench = WrenchFilter.from_corner(100.0)
    return replace(plant, plants=tuple(replace(each, wrench_filter=wrench) for each in plant.plants))


@pytest.mark.parametrize("surface", [None, wall(), wall(direction=np.array([1.0, 0.3]))])
@pytest.mark.parametrize("has_filter", [False, True])
def test_the_enclosed_loop_is_the_sampled_one(surface: PointSurface | None, has_filter: bool) -> None:
    plant = filtered(cell(surface=surface)) if has_filter else cell(surface=surface)
    stiffness = 0.0 if surface is None else surface.environment.stiffness_n_per_m
    system = coupled_system(family(plant, (stiffness, stiffness)), family(plant, (stiffness, stiffness)).box())
    assert middle_gain(system) == pytest.approx(gain_of(plant), rel=1e-8)  # both to 1e-9
    # Forces in N per displacement in m make entries of 3e5, which doubles hold to 1e-10.
    assert float(np.max(system.rest)) < 1e-8


@pytest.mark.parametrize("surface", [None, wall(), wall(direction=np.array([1.0, 0.3]))])
def test_the_loop_that_is_cut_at_the_commands_is_the_sampled_one(surface: PointSurface | None) -> None:
    """The change of the command by the change of what is added: S to the grid's 1e-4, larger between its points."""
    plant = cell(surface=surface)
    stiffness = 0.0 if surface is None else surface.environment.stiffness_n_per_m
    of = replace(family(plant, (stiffness, stiffness)), at="command")
    gain, grid = middle_gain(coupled_system(of, of.box())), command_gain(plant)
    assert grid <= gain * (1.0 + 1e-9)
    assert gain == pytest.approx(grid, rel=1e-4)
    # The two cuts are different loops.
    assert gain != pytest.approx(gain_of(plant), rel=1e-2)
    true, false = (prove_coupled(of, share / gain, work=200_000) for share in (0.97, 1.001))
    assert (true.share, true.refuted) == (1.0, None)
    assert false.refuted == (stiffness, 1.0)


@pytest.mark.parametrize("widths", [(0.15, 0.02), (0.0, 0.03), (0.2, 0.0)])
def test_every_plant_of_a_cell_lies_in_its_box(widths: tuple[float, float]) -> None:
    """Loops of drawn plants, each enclosed as a point: first and second order, and what is left beyond them."""
    of = family(cell(surface=wall(STIFF, damping=0.0)), (SOFT, STIFF), (0.9, 1.1))
    middle = np.array([1.05 * SOFT, 1.0])
    half = middle * np.array(widths)
    whole, rng = coupled_system(of, np.stack([middle - half, middle + half], axis=1)), np.random.default_rng(2)
    vary, scales = [i for i in range(2) if widths[i] > 0.0], np.outer(1.0 / whole.balance, whole.balance)
    for _ in range(10):
        shares = rng.uniform(-1.0, 1.0, 2)
        point = middle + shares * half
        drawn = coupled_system(of, np.stack([point, point], axis=1))
        # Each system is balanced on its own.
        found = drawn.middle * np.outer(1.0 / drawn.balance, drawn.balance)
        flat = whole.middle + sum(shares[i] * each for i, each in zip(vary, whole.derivatives, strict=True))
        products = [2.0 * shares[i] ** 2 - 1.0 for i in vary] + ([float(np.prod(shares))] if len(vary) == 2 else [])
        model = flat + sum(each * curve for each, curve in zip(products, whole.curves, strict=True))
        off = np.abs(found - model * scales)
        assert np.all(off <= whole.rest * scales + 1e-11 * np.abs(found))
    # The rest is of third order: less than what of second order is in the box, in the rows that the plant moves.
    n = whole.states
    assert np.max(whole.rest[:n, :n]) < 0.5 * max(float(np.max(np.abs(each[:n, :n]))) for each in whole.curves)


def test_a_range_of_mass_and_stiffness_takes_a_sixth_of_the_work() -> None:
    """763 cells while what is of second order was left to the rest, and twice as much of it."""
    stiffness, factors = (8e4, 1.2e5), (0.97, 1.03)
    gains = [
        gain_of(replace(plant, mass_matrix=float(factor) * plant.mass_matrix))
        for plant in (cell(surface=wall(each, damping=0.0)) for each in stiffness)
        for factor in np.linspace(*factors, 3)
    ]
    of = family(cell(surface=wall(stiffness[1], damping=0.0)), stiffness, factors)
    found = prove_coupled(of, 0.95 / max(gains), work=500_000)
    assert (found.share, found.refuted) == (1.0, None)
    assert prove_coupled(of, 1.005 / max(gains), work=500_000).share < 1.0


def test_a_range_is_proved_down_to_the_slack() -> None:
    plant = cell(surface=wall(STIFF, damping=0.0))
    least = 1.0 / max(gain_of(cell(surface=wall(each, damping=0.0))) for each in np.linspace(SOFT, STIFF, 5))
    found = prove_coupled(family(plant, (SOFT, STIFF), (0.9995, 1.0005)), 0.95 * least, work=2_000_000)
    assert (found.share, found.refuted) == (1.0, None)
    assert found.cells > 1


@pytest.mark.parametrize("surface", [None, wall(SOFT, damping=0.0)])
def test_a_range_of_mass_alone_is_cut_along_the_mass(surface: PointSurface | None) -> None:
    """In free space and on one surface nothing but the mass varies; it was K_e that was halved, for ever."""
    plant, stiffness = cell(surface=surface), 0.0 if surface is None else SOFT
    masses = np.linspace(0.85, 1.15, 13).tolist()
    scaled = [replace(plant, mass_matrix=each * plant.mass_matrix) for each in masses]
    least = 1.0 / max(gain_of(each) for each in scaled)
    of = family(plant, (stiffness, stiffness), (masses[0], masses[-1]))
    found = prove_coupled(of, 0.95 * least, work=2_000_000)
    assert (found.share, found.refuted) == (1.0, None)
    assert found.cells > 1
    assert prove_coupled(of, 1.005 * least, work=300_000).share < 1.0


@pytest.mark.parametrize("surface", [None, wall(SOFT, damping=0.0)])
def test_what_is_false_is_refuted_and_never_proved(surface: PointSurface | None) -> None:
    plant, stiffness = cell(surface=surface), 0.0 if surface is None else SOFT
    false = prove_coupled(family(plant, (stiffness, stiffness)), 1.001 / gain_of(plant), work=100_000)
    assert false.refuted == (stiffness, 1.0)
    true = prove_coupled(family(plant, (stiffness, stiffness)), 0.97 / gain_of(plant), work=100_000)
    assert (true.share, true.cells) == (1.0, 1)


def test_half_a_per_cent_above_the_least_is_never_proved_of_a_range() -> None:
    least = 1.0 / max(gain_of(cell(surface=wall(each, damping=0.0))) for each in (SOFT, STIFF))
    plant = cell(surface=wall(STIFF, damping=0.0))
    found = prove_coupled(family(plant, (SOFT, STIFF)), 1.005 * least, work=300_000)
    assert found.share < 1.0


def test_an_unstable_plant_refutes() -> None:
    plant = cell(surface=wall(SOFT, damping=0.0))
    softer = tuple(replace(law, damping_n_s_per_m=0.3 * law.damping_n_s_per_m) for law in LAWS)
    unstable = replace(family(plant, (SOFT, STIFF)), laws=softer)
    assert prove_coupled(unstable, 0.01, work=100_000).refuted is not None


def test_a_spent_budget_says_how_far_it_got() -> None:
    found = prove_coupled(family(cell(surface=wall(5e5, damping=0.0)), (2e4, 5e5)), 0.05, work=5_000)
    assert 0.0 <= found.share < 1.0
    assert found.refuted is None


def test_a_command_that_acts_at_once_is_refused() -> None:
    plants = tuple(replace(each, robot=replace(each.robot, delay_s=0.0)) for each in cell().plants)
    plant = replace(cell(), plants=plants)
    with pytest.raises(ParameterError, match="damping in the coupling"):
        coupled_system(family(plant), family(plant).box())
    undamped = tuple(replace(each, coupling=replace(each.coupling, damping_n_s_per_m=0.0)) for each in plants)
    at_once = replace(family(replace(cell(), plants=undamped)), at="command")
    with pytest.raises(ParameterError, match="a sample or more"):
        coupled_system(at_once, at_once.box())
