"""What is proved is never what a sweep rejects; what is refuted is false at the plant and frequency named."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from autotune.certificate.base_plant import is_stable
from autotune.certificate.certify import CELL_WORK, certify
from autotune.certificate.family import Family, ProofOutcome, Verdict, build_families
from autotune.validation.margins import sweep_margins
from problems.design.uncertainty import MASS, STIFFNESS, PlantSet
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.autotune.certificate.loops import family, smallest_return_difference
from tests.autotune.certificate.lyapunov import lyapunov_stability
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant

WORK = 100_000
CALM = admittance(20.0, 3500.0, 0.013, 0.01)


def uncertain(of: Family) -> PlantSet:
    return PlantSet(nominal=of.nominal, ranges={name: of.range_of(name) for name in (STIFFNESS, MASS)})


def check_refuted(found: ProofOutcome, of: Family, law: AdmittanceController) -> None:
    """Look at the plant and the frequency by determinants and eigenvalues."""
    assert found.verdict is Verdict.REFUTED
    assert found.plant is not None
    assert found.frequency_rad_per_s is not None
    plant = found.plant.plant(of.nominal)
    for name, value in ((STIFFNESS, found.plant.environment_stiffness_n_per_m), (MASS, found.plant.payload_mass_kg)):
        assert of.range_of(name)[0] <= value <= of.range_of(name)[1]
    there = smallest_return_difference(plant, law, np.array([found.frequency_rad_per_s * PERIOD_S]))[0]
    radius = spectral_radius(build_loop(build_sampled_plant(plant, PERIOD_S), law))
    assert there < found.modulus or radius > 1.0


def drawn(seed: int) -> tuple[Family, AdmittanceController]:
    rng = np.random.default_rng(seed)
    robot = one_pole(float(rng.uniform(0.0, 4.0)) * PERIOD_S, float(rng.uniform(15.0, 30.0)))
    if seed % 4 == 0:
        robot = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2e-3)
    soft, light = float(rng.uniform(3e4, 3e5)), float(rng.uniform(8.0, 30.0))
    plant = paper_plant(
        stiffness=soft,
        mass=light,
        drag=float(rng.uniform(150.0, 800.0)),
        coupling_damping=float(rng.choice([0.0, 150.0])),
        environment_damping=float(rng.choice([0.0, 60.0])),
        robot=robot,
    )
    law = admittance(
        float(rng.uniform(8.0, 40.0)),
        float(rng.uniform(400.0, 5000.0)),
        float(rng.choice([0.0, 0.015, 0.02])),
        float(rng.choice([0.0, 0.01])),
    )
    if seed % 5 == 0:
        law = replace(law, compensation_mass_kg=0.4 * light)
    return family((soft, soft * float(rng.choice([1.2, 2.0]))), (light, light * 1.05), nominal=plant), law


def test_random_designs_pass_with_slack_and_never_against_a_sweep() -> None:
    outcomes: list[tuple[bool, Verdict]] = []
    for seed in range(16):
        of, law = drawn(seed)
        swept = sweep_margins(uncertain(of), law, PERIOD_S, stiffness=7, mass=2)
        stable, modulus = swept.largest_radius < 1.0, min(swept.values["modulus"], 0.999)
        found = [certify(each, law, 0.9 * modulus, work=WORK) for each in (of, of.in_free_space())]
        worst = next((each for each in found if not each.holds), found[0])
        outcomes.append((stable, worst.verdict))
        # 10 % of slack are enough wherever the sweep finds nothing, and whatever is refuted is false there.
        assert worst.holds == stable, (seed, worst)
        if not stable:
            check_refuted(worst, of if worst is found[0] else of.in_free_space(), law)
            continue
        higher = [certify(each, law, min(1.02 * modulus, 0.9999), work=WORK // 4) for each in (of, of.in_free_space())]
        assert not all(each.holds for each in higher) or modulus > 0.97, seed
        for each, there in zip(higher, (of, of.in_free_space()), strict=True):
            if each.verdict is Verdict.REFUTED:
                check_refuted(each, there, law)
    assert 5 <= sum(stable for stable, _ in outcomes) <= 13


def gap(drag: float) -> tuple[Family, AdmittanceController]:
    """Light damping: stable against soft and against stiff walls, and not in between (docs/method.md, erratum 5)."""
    plant = replace(
        paper_plant(stiffness=1e5, drag=drag, robot=one_pole(bandwidth_rad_per_s=24.0)),
        coupling=Coupling(stiffness_n_per_m=2.1e5, damping_n_s_per_m=0.0),
    )
    return family((1e5, 3e6), (16.0, 16.0), nominal=plant), admittance(9.3, 1340.0, 0.019)


def test_an_unstable_gap_between_two_stable_ends_is_found() -> None:
    of, law = gap(30.0)
    ends = [is_stable(of, law, np.array([k])) for k in (1e5, 3e6)]
    assert ends == [True, True]
    found = certify(of, law, 0.01, work=WORK)
    check_refuted(found, of, law)
    assert found.plant is not None
    assert 2e5 < found.plant.environment_stiffness_n_per_m < 2.9e6


def test_what_is_proved_is_proved_by_lyapunov_cells_too() -> None:
    """Two proofs of stability that share neither functions nor arithmetic."""
    for of in (family((1.4e5, 1.6e5), (15.5, 16.5)), gap(200.0)[0]):
        law = CALM if of.range_of(MASS)[0] < 16.0 else gap(200.0)[1]
        where = of if law is CALM else family((1.0e5, 1.1e5), (16.0, 16.0), nominal=of.nominal)
        for each in (where, where.in_free_space()):
            assert certify(each, law, 0.05, work=WORK).holds
            assert lyapunov_stability(each, law, PERIOD_S).holds


def test_a_budget_that_runs_out_says_how_far_it_got() -> None:
    of = family((2e4, 5e5), (14.0, 20.0))
    law = admittance(10.0, 1600.0, 0.02, 0.01)
    found = certify(of, law, 0.35, work=150 * CELL_WORK)
    assert found.verdict is Verdict.RAN_OUT
    assert 0.0 < found.share < 1.0
    assert found.work < 170 * CELL_WORK
    assert found.plant is not None
    up_to = found.stiffness_up_to_n_per_m
    assert up_to is not None
    assert 2e4 < up_to < 5e5
    # What it says is proved is proved by itself, and with more work all of it is.
    assert certify(family((2e4, up_to), (14.0, 20.0)), law, 0.35, work=20 * WORK).holds
    whole = certify(of, law, 0.35, work=20 * WORK)
    assert (whole.holds, whole.share) == (True, 1.0)


def test_a_claim_without_any_slack_is_not_proved_however_long() -> None:
    of = family((1e5, 1e5), (16.0, 16.0))
    angles = np.linspace(1e-3, np.pi, 200_001)[:40_000]
    exact = float(np.min(smallest_return_difference(of.nominal, CALM, angles)))
    assert certify(of, CALM, 0.99999 * exact, work=WORK).holds
    assert not certify(of, CALM, 1.00001 * exact, work=WORK).holds


def test_free_space_is_stable_but_for_its_integrator() -> None:
    of = family().in_free_space()
    assert is_stable(of, CALM, np.array([1.0 / 16.0])) is True
    assert certify(of, CALM, 0.5, work=WORK).holds
    lively = admittance(10.0, 300.0, 0.0)
    found = certify(of, lively, 0.05, work=WORK)
    check_refuted(found, of, lively)
    assert found.plant is not None
    assert found.plant.environment_stiffness_n_per_m == 0.0


FURTHER: dict[str, tuple[float, float]] = {
    STIFFNESS: (1e5, 1.2e5),
    MASS: (15.8, 16.2),
    "coupling_stiffness_n_per_m": (2.95e5, 3.05e5),
    "coupling_damping_n_s_per_m": (90.0, 110.0),
    "drag_n_s_per_m": (390.0, 410.0),
    "environment_damping_n_s_per_m": (0.0, 20.0),
    "delay_s": (2.38e-3, 2.42e-3),
    "robot_bandwidth_hz": (3.15, 3.22),
}


def test_every_parameter_may_vary_and_a_delay_may_pass_a_tick() -> None:
    nominal = paper_plant(stiffness=1e5, coupling_damping=100.0, drag=400.0)
    families = build_families(nominal, FURTHER, PERIOD_S)
    assert [each.delay() for each in families] == [(2, True), (3, True)]
    angles = np.linspace(1e-3, 1.0, 4000)
    smallest = np.inf
    rng = np.random.default_rng(4)
    for each in families:
        for share in rng.random((10, len(each.varying))):
            box = each.box()
            plant = each.plant(box[:, 0] + share * (box[:, 1] - box[:, 0]))
            smallest = min(smallest, float(np.min(smallest_return_difference(plant, CALM, angles))))
        assert certify(each, CALM, 0.85 * smallest, work=2 * WORK).holds
        check = certify(each, CALM, 1.08 * smallest, work=WORK)
        assert not check.holds


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot_damping_ratio": (0.5, 0.6)}, "ranges must be one of"),
        ({"drag_n_s_per_m": (5.0, 1.0)}, "lowest, highest"),
        ({"delay_s": (2.3e-3, 2.5e-3)}, "within two ticks"),
        ({"environment_damping_n_s_per_m": (0.0, 5.0), STIFFNESS: (0.0, 0.0)}, "greater than 0 in contact"),
    ],
)
def test_a_set_that_cannot_be_proved_over_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Family(nominal=paper_plant(stiffness=1e5), ranges=change, sample_time_s=PERIOD_S)


@pytest.mark.parametrize("modulus", [0.0, 1.0, -0.1, float("nan")])
def test_a_modulus_is_a_number_between_nothing_and_all(modulus: float) -> None:
    with pytest.raises(ValueError, match="between 0 and 1"):
        certify(family(), CALM, modulus, work=1)
