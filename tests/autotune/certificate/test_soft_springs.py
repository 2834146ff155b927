"""Springs of every stiffness above 0: what is proved is never what a sweep rejects, down to the softest."""

from itertools import pairwise

import numpy as np
import pytest

from autotune.certificate import certify as certify_module
from autotune.certificate.bounds import judge_at_rest
from autotune.certificate.certify import certify, prove
from autotune.certificate.family import Claim, Family, Verdict
from examples.paper.continuous import plant_blocks
from problems.design.hand import HandImpedance
from problems.design.uncertainty import MASS, STIFFNESS, PlantSet
from problems.model.controller import AdmittanceController
from problems.model.plant import Environment
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.autotune.certificate.loops import smallest_return_difference
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant

WORK = 400_000
# Angles and springs over decades, as near to the integrator as double precision shows it.
ANGLES = np.geomspace(1e-5, np.pi, 600)
SPRINGS = np.geomspace(1e-2, 1.0, 8)


def soft_family(stiffest: float, mass: tuple[float, float], drag: tuple[float, float]) -> Family:
    nominal = paper_plant(stiffness=stiffest, mass=mass[0], drag=drag[0])
    ranges = {STIFFNESS: (0.0, stiffest), MASS: mass, "drag_n_s_per_m": drag}
    return Family(nominal=nominal, ranges=ranges, sample_time_s=PERIOD_S)


def swept(of: Family, law: AdmittanceController) -> float:
    """Return the least |1 + L| over springs, the ends of the other ranges and a grid of angles; 0 where unstable."""
    least = np.inf
    for mass in of.range_of(MASS):
        for drag in of.range_of("drag_n_s_per_m"):
            for share in SPRINGS:
                plant = paper_plant(stiffness=share * of.range_of(STIFFNESS)[1], mass=mass, drag=drag)
                if spectral_radius(build_loop(build_sampled_plant(plant, PERIOD_S), law)) >= 1.0:
                    return 0.0
                least = min(least, float(np.min(smallest_return_difference(plant, law, ANGLES))))
    return least


@pytest.mark.parametrize("seed", range(5))
def test_a_modulus_is_proved_up_to_what_a_sweep_finds_and_not_beyond(seed: int) -> None:
    rng = np.random.default_rng(seed)
    light, damped = float(rng.uniform(8.0, 20.0)), float(rng.uniform(200.0, 700.0))
    of = soft_family(float(rng.uniform(1e3, 2e4)), (light, light + 5.0), (damped, damped + 50.0))
    law = admittance(
        float(rng.uniform(15.0, 40.0)), float(rng.uniform(1500.0, 4000.0)), float(rng.choice([0.0, 0.013]))
    )
    least = swept(of, law)
    if least > 0.0:
        assert certify(of, law, 0.95 * least, work=WORK).verdict is Verdict.PROVED
    beyond = certify(of, law, min(1.01 * least, 0.999) if least > 0.0 else None, work=WORK)
    assert beyond.verdict is not Verdict.PROVED


def test_a_law_that_is_unstable_on_stiff_springs_is_proved_below_them_only() -> None:
    """The printed example without lead (MODEL.md, errata 4): its loop becomes unstable between two stiffnesses."""
    law = admittance(10.0, 1000.0, 0.0)

    def radius(stiffness: float) -> float:
        return spectral_radius(build_loop(build_sampled_plant(paper_plant(stiffness=stiffness), PERIOD_S), law))

    grid = np.geomspace(1e3, 5e5, 200)
    last, first = next((a, b) for a, b in pairwise(grid) if radius(a) < 1.0 <= radius(b))
    below = soft_family(0.97 * last, (16.0, 16.0), (630.0, 630.0))
    assert certify(below, law, None, work=WORK).verdict is Verdict.PROVED
    found = certify(soft_family(1.1 * first, (16.0, 16.0), (630.0, 630.0)), law, None, work=WORK)
    assert found.verdict is Verdict.REFUTED
    assert found.plant is not None
    assert radius(found.plant.environment_stiffness_n_per_m) > 1.0


def test_a_hand_adds_its_impedance_to_that_of_payload_and_surface() -> None:
    """Ē = C_s (1 + P E)/(1 + P E + P C_s) with 1/P + E + M_h s + B_h + K_h/s in the place of 1/P + E."""
    hand = HandImpedance(mass_kg=2.0, damping_n_s_per_m=30.0, stiffness_n_per_m=900.0)
    omega = np.geomspace(0.1, 1e3, 50)
    for plant in (paper_plant(environment_damping=40.0), paper_plant(stiffness=0.0)):
        alone, held = plant_blocks(plant, omega), plant_blocks(hand.holding(plant), omega)
        s = 1j * omega
        load = 1.0 / alone.payload + alone.environment + 2.0 * s + 30.0 + 900.0 / s
        np.testing.assert_allclose(held.felt_impedance, 1.0 / (1.0 / alone.coupling + 1.0 / load), rtol=1e-12)


def test_a_claim_with_a_hand_is_one_about_every_hand() -> None:
    """Each of the three parts is refuted by a modulus above its own least, and named where it is."""
    plants = PlantSet.of(
        one_pole(),
        environment_stiffness_n_per_m=(5e4, 2e5),
        payload_mass_kg=(15.0, 17.0),
        coupling_stiffness_n_per_m=3e5,
        coupling_damping_n_s_per_m=0.0,
        drag_n_s_per_m=400.0,
    )
    law = admittance(20.0, 3500.0, 0.013)
    hand = HandImpedance()
    moduli = [
        float(np.min(smallest_return_difference(each.holding(plants.at(mass, stiffness)), law, ANGLES)))
        for each in (hand, HandImpedance(mass_kg=0.0, damping_n_s_per_m=0.0, stiffness_n_per_m=1.0), hand)
        for mass in (15.0, 17.0)
        for stiffness in (0.0, 5e4, 2e5)
    ]
    claim = Claim(plants=plants, law=law, sample_time_s=PERIOD_S, modulus=0.95 * min(moduli), work=WORK, hand=hand)
    found = prove(claim)
    assert found.holds
    assert (len(found.free_space), len(found.held), len(found.contact)) == (1, 1, 1)
    beyond = prove(Claim(**{**vars(claim), "modulus": 1.01 * min(moduli)}))
    assert beyond.false is not None
    alone = prove(Claim(**{**vars(claim), "hand": None}))
    assert alone.held == ()
    assert alone.holds


def test_springs_from_zero_are_those_above_zero() -> None:
    """Without a spring the loop keeps its integrator; the range says that it is not of the set."""
    of = soft_family(3000.0, (16.0, 21.0), (300.0, 350.0))
    assert of.is_soft
    assert not of.is_free_space
    assert not of.in_free_space().is_soft
    springs = of.in_free_space().on_springs_up_to(500.0)
    assert springs.range_of(STIFFNESS) == (0.0, 500.0)
    assert springs.nominal.environment == Environment(stiffness_n_per_m=500.0)


def test_what_is_judged_at_rest_holds_for_the_plants_inside() -> None:
    """Arcs from 0 and cells from K = 0, where χ and R vanish together: drawn plants keep what is judged of them."""
    rng = np.random.default_rng(5)
    of, law = soft_family(3000.0, (16.0, 17.0), (300.0, 320.0)), admittance(20.0, 3000.0, 0.013)
    search = certify_module._Search(of, law, 0.5)
    assert search.at_rest is not None
    cell = of.box()
    plants = search._cell_at_rest(cell, search._coefficients(cell))
    ends = np.array([[0.0, 1e-4], [0.0, 1e-3], [1e-3, 4e-3], [0.0, 0.01]])
    held = 0
    for modulus in (0.5, 0.8, 0.9, 0.95, 0.99):
        holds = judge_at_rest(search.at_rest.on(ends), plants, modulus).holds
        held += int(np.sum(holds))
        for _ in range(12):
            share = rng.random(3) * [10.0 ** rng.uniform(-3.0, 0.0), 1.0, 1.0]
            plant = of.plant(cell[:, 0] + share * (cell[:, 1] - cell[:, 0]))
            inside = ends[:, 0] + rng.random(len(ends)) * (ends[:, 1] - ends[:, 0])
            there = smallest_return_difference(plant, law, inside)
            # At the lowest frequencies determinants lose their digits.
            assert np.all(there[holds & (inside > 1e-5)] > modulus * (1.0 - 1e-4))
    assert 0 < held < 20
