"""Proofs over plants whose wrench is filtered or late: what is proved no sweep rejects, what is false is refuted."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.certificate import certify as certify_module
from autotune.certificate.base_plant import fails_at
from autotune.certificate.bounds import judge
from autotune.certificate.certify import certify
from autotune.certificate.family import LAG, LATE, Family, ProofOutcome, Verdict, build_families
from autotune.validation.margins import SweptMargins, sweep_margins
from problems.design.uncertainty import MASS, STIFFNESS, PlantSet
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant, WrenchFilter
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.autotune.certificate.loops import family, smallest_return_difference
from tests.autotune.certificate.lyapunov import lyapunov_stability
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant

WORK = 100_000
FILTER = WrenchFilter.from_corner(50.0)
CALM = admittance(20.0, 3500.0, 0.013, 0.01)
LEAD = admittance(20.0, 3500.0, 0.013)


def filtered(delay_s: float = 2.7 * PERIOD_S, wrench: WrenchFilter = FILTER) -> Plant:
    plant = paper_plant(
        stiffness=1e5,
        mass=15.0,
        drag=400.0,
        coupling_damping=120.0,
        environment_damping=30.0,
        robot=one_pole(delay_s),
    )
    return replace(plant, wrench_filter=wrench)


def of_lags(delay_s: float = 2.7 * PERIOD_S) -> Family:
    ranges = {"coupling_damping_n_s_per_m": (100.0, 140.0), LAG: (2.9e-3, 3.4e-3)}
    return family((1e5, 1.3e5), (15.0, 17.0), nominal=filtered(delay_s), **ranges)


def swept(of: Family, law: AdmittanceController) -> SweptMargins:
    plants = PlantSet(nominal=of.nominal, ranges={name: of.range_of(name) for name in (STIFFNESS, MASS)})
    others = [
        replace(plants.at(mass, stiffness), wrench_filter=WrenchFilter(time_constant_s=lag))
        for lag in of.range_of(LAG)
        for mass in of.range_of(MASS)
        for stiffness in np.geomspace(*of.range_of(STIFFNESS), 5)
    ]
    return sweep_margins(plants, law, PERIOD_S, stiffness=5, mass=2, others=others)


@pytest.mark.parametrize("law", [CALM, LEAD], ids=["feedback", "lead"])
@pytest.mark.parametrize("delay_s", [0.0, 2.4e-3, 2.7 * PERIOD_S], ids=["none", "whole", "fraction"])
def test_the_balls_return_difference_is_that_of_the_filtered_loop(delay_s: float, law: AdmittanceController) -> None:
    """A claim a millionth above or below |1 + L| by determinants is certainly false, or not."""
    for of in (of_lags(delay_s), of_lags(delay_s).in_free_space()):
        point = np.mean(of.box(), axis=1)
        for angle in (0.003, 0.02, 0.15, 1.0, 3.0):
            there = float(smallest_return_difference(of.plant(point), law, np.array([angle]))[0])
            assert fails_at(of, law, point, angle, there * (1.0 + 1e-6))
            assert not fails_at(of, law, point, angle, there * (1.0 - 1e-6))


def test_cells_and_arcs_hold_their_filtered_plants() -> None:
    """|χ| > m |R| is claimed on no arc on which a plant of the cell has |1 + L| ≤ m."""
    rng = np.random.default_rng(6)
    for of in (of_lags(), of_lags().in_free_space()):
        search = certify_module._Search(of, CALM, 0.5)
        box, arcs = of.box(), np.arange(search.circle.count_of_first)
        for _ in range(3):
            arcs = search.circle.halves(arcs)
        angles, cell = search.circle.angles(arcs), search._plant_cell(box)
        for modulus in (0.3, 0.6, 0.9):
            holds = judge(search.circle.at(arcs), cell, modulus).holds
            for share in rng.random((6, len(box))):
                plant = of.plant(box[:, 0] + share * (box[:, 1] - box[:, 0]))
                inside = angles[:, 0] + rng.random(len(angles)) * (angles[:, 1] - angles[:, 0])
                there = smallest_return_difference(plant, CALM, np.minimum(inside, np.pi))
                # At the lowest frequencies determinants of free space lose their digits.
                assert np.all(there[holds & (inside > 1e-3)] > modulus * (1.0 - 1e-6))
        assert np.any(judge(search.circle.at(arcs), cell, 0.1).holds)


def check_refuted(found: ProofOutcome, of: Family, law: AdmittanceController) -> None:
    """Look at the plant and the frequency by determinants and eigenvalues."""
    assert found.plant is not None
    assert found.frequency_rad_per_s is not None
    plant = found.plant.plant(of.nominal)
    assert of.range_of(LAG)[0] <= plant.wrench_filter.time_constant_s <= of.range_of(LAG)[1]
    there = smallest_return_difference(plant, law, np.array([found.frequency_rad_per_s * PERIOD_S]))[0]
    assert there < found.modulus or spectral_radius(build_loop(build_sampled_plant(plant, PERIOD_S), law)) > 1.0


def test_random_designs_pass_with_slack_and_no_false_claim_is_proved() -> None:
    stable = 0
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        lag = float(np.exp(rng.uniform(np.log(0.8e-3), np.log(3.2e-3))))
        plant = filtered(float(rng.uniform(0.0, 4.0)) * PERIOD_S, WrenchFilter(time_constant_s=lag))
        soft = float(rng.uniform(3e4, 3e5))
        of = family((soft, 1.3 * soft), (15.0, 15.6), nominal=plant, **{LAG: (lag, 1.08 * lag)})
        law = admittance(
            float(rng.uniform(8.0, 40.0)),
            float(rng.uniform(150.0, 3000.0)),
            float(rng.choice([0.0, 0.015])),
            float(rng.choice([0.0, 0.01])),
        )
        margins = swept(of, law)
        modulus = min(margins.values["modulus"], 0.999)
        places = (of, of.in_free_space())
        found = [certify(each, law, 0.85 * modulus, work=WORK) for each in places]
        stable += margins.largest_radius < 1.0
        # 15 % of slack are enough wherever a modulus is left, and whatever is refuted is false there.
        proved, holds = all(each.holds for each in found), margins.largest_radius < 1.0
        assert proved == holds or (holds and modulus < 0.05), (seed, found)
        false = [certify(each, law, min(1.02 * modulus, 0.9999), work=WORK // 4) for each in places]
        assert not all(each.holds for each in false) or modulus > 0.97, seed
        for each, where in zip([*found, *false], [*places, *places], strict=True):
            if each.verdict is Verdict.REFUTED:
                check_refuted(each, where, law)
    assert 3 <= stable <= 10


def test_what_holds_without_the_filter_is_refuted_with_it() -> None:
    law = admittance(5.0, 1162.3, 0.019, 0.0096)
    plant = paper_plant(
        stiffness=1e5, mass=16.2, drag=330.0, coupling=3.1e5, coupling_damping=150.0, environment_damping=0.0
    )
    ranges = {STIFFNESS: (1e5, 1.4e5), MASS: (16.0, 16.4)}
    plain = Family(nominal=plant, ranges=ranges, sample_time_s=PERIOD_S)
    assert certify(plain, law, 0.45, work=WORK).holds
    behind = replace(plain, nominal=replace(plant, wrench_filter=FILTER))
    found = certify(behind, law, 0.45, work=WORK)
    assert found.verdict is Verdict.REFUTED
    check_refuted(found, behind, law)


def test_two_proofs_of_stability_agree_behind_a_filter() -> None:
    of = family((1.0e5, 1.1e5), (15.0, 15.5), nominal=filtered())
    for law in (CALM, admittance(8.0, 400.0, 0.0)):
        for each in (of, of.in_free_space()):
            expected = law is CALM
            assert certify(each, law, 0.05, work=WORK).holds == expected
            assert lyapunov_stability(each, law, PERIOD_S).holds == expected


def test_a_late_wrench_is_proved_as_a_longer_delay_and_reported_as_both() -> None:
    """T_d from 2.6 to 2.8 samples and 0 to 0.6 of the wrench: 2.6 to 3.4, cut at the tick in between."""
    plant = filtered(2.7 * PERIOD_S, replace(FILTER, delay_s=0.3 * PERIOD_S))
    own, late = (2.6 * PERIOD_S, 2.8 * PERIOD_S), (0.0, 0.6 * PERIOD_S)
    ranges = {STIFFNESS: (1e5, 1.1e5), MASS: (15.0, 15.3), "delay_s": own, LATE: late}
    families = build_families(plant, ranges, PERIOD_S)
    assert [each.delay() for each in families] == [(2, True), (3, True)]
    for each in families:
        box = each.box()
        for share in (0.0, 0.4, 1.0):
            found = each.scenario(box[:, 0] + share * (box[:, 1] - box[:, 0]))
            there = found.plant(plant)
            assert own[0] * (1.0 - 1e-12) <= there.robot.delay_s <= own[1] * (1.0 + 1e-12)
            assert late[0] <= there.wrench_filter.delay_s <= late[1] * (1.0 + 1e-12)
            total = box[each.varying.index("delay_s")] @ [1.0 - share, share]
            assert there.loop_delay_s == pytest.approx(total, rel=1e-12)
        assert certify(each, LEAD, 0.3, work=WORK).holds
    (alone,) = build_families(plant, {STIFFNESS: (1e5, 1.1e5)}, PERIOD_S)
    assert alone.nominal.robot.delay_s == pytest.approx(3.0 * PERIOD_S, rel=1e-12)
    assert alone.varying == (STIFFNESS,)


@pytest.mark.parametrize(
    ("nominal", "ranges", "message"),
    [
        (filtered(), {LAG: (0.0, 1e-3)}, "wrench_time_constant_s must be greater than 0"),
        (filtered(wrench=WrenchFilter()), {LAG: (1e-3, 2e-3)}, "wrench_time_constant_s must be greater than 0"),
        (filtered(wrench=WrenchFilter(delay_s=1e-3)), {}, "wrench_delay_s must be 0"),
        (filtered(), {LATE: (0.0, 1e-3)}, "wrench_delay_s must be 0"),
    ],
)
def test_a_family_that_is_none_is_refused(nominal: Plant, ranges: dict[str, tuple[float, float]], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Family(nominal=nominal, ranges=ranges, sample_time_s=PERIOD_S)
