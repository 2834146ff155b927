"""A force that is proved for all first contacts is exceeded by none that another method simulates."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from autotune.certificate import peaks
from autotune.certificate.balls import as_series
from autotune.certificate.contact_loop import contact_loop
from autotune.certificate.family import Family, build_families
from autotune.certificate.peak_kernel import CellLoop, ForceBounds, walk
from autotune.certificate.peaks import prepare_cell, prove_peak
from problems.arrays import FloatArray
from problems.contact.nonlinear_simulation import needed_substeps, simulate_nonlinear
from problems.contact.transient import Approach, transient_from
from problems.design.uncertainty import MASS, STIFFNESS
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant, WrenchFilter
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import PERIOD_S, PRESS, admittance, one_pole, pair_of, paper_plant

WORK = 400_000
TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.3e-3)


def family(plant: Plant, stiffness: tuple[float, float], mass: tuple[float, float]) -> Family:
    (found,) = build_families(plant, {STIFFNESS: stiffness, MASS: mass}, PERIOD_S)
    return found


def numbers(entries: Any) -> FloatArray:
    return np.array([float(as_series(each).value.mid()) for each in np.ravel(entries)]).reshape(np.shape(entries))


@pytest.mark.parametrize("approach", [PRESS, Approach(speed_m_s=0.02)])
@pytest.mark.parametrize(
    ("plant", "law"),
    [
        (paper_plant(stiffness=2e5, coupling_damping=100.0, environment_damping=20.0), admittance(10.0, 1600.0, 0.02)),
        (paper_plant(stiffness=1e5, robot=one_pole(2.7e-3)), admittance(10.0, 1600.0, 0.02, 0.01)),
        (paper_plant(stiffness=5e4, robot=TWO_POLES), replace(admittance(20.0, 2500.0), compensation_mass_kg=4.0)),
        (paper_plant(stiffness=5e4, robot=one_pole(5e-4)), admittance(15.0, 2000.0, 0.0, 0.01)),
        (paper_plant(stiffness=5e4, robot=one_pole(0.0)), admittance(15.0, 2000.0, 0.01)),
    ],
)
def test_its_loop_is_that_of_the_exact_transient(plant: Plant, law: AdmittanceController, approach: Approach) -> None:
    """Two forms of one equation: z from tick to tick in balls, and the kernel that the search simulates with."""
    stiffness, mass = plant.environment.stiffness_n_per_m, plant.payload.mass_kg
    of = family(plant, (stiffness, stiffness), (mass, mass))
    loop = contact_loop(of, law, approach, np.zeros((0, 2)))
    run = transient_from(pair_of(plant), law, approach, samples=300)
    change, z, row = numbers(loop.change), numbers(loop.start), numbers(loop.pressed)
    force = []
    for _ in range(300):
        force.append(float(as_series(loop.force_n).value.mid()) + float(row @ z))
        z = change @ z
    assert float(np.min(run.contact_force_n[1:])) > 0.0
    np.testing.assert_allclose(force, run.contact_force_n, rtol=0.0, atol=1e-9)
    assert numbers(loop.way)[()] / PERIOD_S == pytest.approx(run.contact_speed_m_s, rel=1e-12)


def drawn(seed: int) -> tuple[Plant, AdmittanceController, tuple[float, float], tuple[float, float]]:
    """Draw a cell and a law that is stable on the ends of its ranges."""
    rng = np.random.default_rng(seed)
    while True:
        soft, light = float(rng.uniform(2e4, 2e5)), float(rng.uniform(8.0, 20.0))
        plant = paper_plant(
            stiffness=soft,
            mass=light,
            drag=float(rng.uniform(200.0, 800.0)),
            coupling_damping=float(rng.choice([0.0, 150.0])),
            environment_damping=float(rng.choice([0.0, 30.0])),
            robot=one_pole(float(rng.uniform(1.0, 4.0)) * PERIOD_S, float(rng.uniform(15.0, 30.0))),
        )
        law = admittance(float(rng.uniform(8.0, 25.0)), float(rng.uniform(1200.0, 3500.0)), 0.015, 0.01)
        spans = (soft, soft * float(rng.uniform(1.1, 1.8))), (light, light * 1.1)
        ends = [build_sampled_plant(at(plant, k, m), PERIOD_S) for k in (0.0, *spans[0]) for m in spans[1]]
        if max(spectral_radius(build_loop(each, law)) for each in ends) < 0.999:
            return plant, law, *spans


def at(plant: Plant, stiffness: float, mass: float) -> Plant:
    return replace(
        plant,
        payload=replace(plant.payload, mass_kg=mass),
        environment=replace(
            plant.environment,
            stiffness_n_per_m=stiffness,
            damping_n_s_per_m=plant.environment.damping_n_s_per_m if stiffness else 0.0,
        ),
    )


def worst(plant: Plant, law: AdmittanceController, stiffness: tuple[float, float], mass: tuple[float, float]) -> float:
    """Return the largest peak at the ends and between, of contacts that begin on a tick."""
    grid = [at(plant, float(k), float(m)) for k in np.linspace(*stiffness, 5) for m in np.linspace(*mass, 3)]
    return max(transient_from(pair_of(each), law, PRESS).peak_contact_force_n for each in grid)


@pytest.mark.parametrize("seed", range(3))
def test_no_contact_that_is_simulated_otherwise_exceeds_what_is_proved(seed: int) -> None:
    """Runge-Kutta steps from rest at a distance, so that the touch falls anywhere between two ticks."""
    plant, law, stiffness, mass = drawn(seed)
    limit = 1.03 * worst(plant, law, stiffness, mass)
    found = prove_peak(family(plant, stiffness, mass), law, PRESS, limit, work=WORK)
    assert found.holds
    assert 0.0 <= found.staying <= 1.0
    rng = np.random.default_rng(100 + seed)
    for _ in range(6):
        one = at(plant, float(rng.uniform(*stiffness)), float(rng.uniform(*mass)))
        run = simulate_nonlinear(
            one,
            law,
            PRESS,
            sample_time_s=PERIOD_S,
            duration_s=1.2,
            start_distance_m=float(rng.uniform(0.006, 0.0061)),
            substeps=needed_substeps(one, PERIOD_S),
        )
        assert run.impact_time_s is not None
        assert run.peak_contact_force_n <= limit


@pytest.mark.parametrize("seed", range(12))
def test_a_force_just_below_the_largest_is_never_proved(seed: int) -> None:
    plant, law, stiffness, mass = drawn(seed)
    below = 0.995 * worst(plant, law, stiffness, mass)
    found = prove_peak(family(plant, stiffness, mass), law, PRESS, below, work=60_000)
    assert not found.holds
    if found.refuted_by is not None:
        touched = at(plant, found.refuted_by.environment_stiffness_n_per_m, found.refuted_by.payload_mass_kg)
        assert transient_from(pair_of(touched), law, PRESS).peak_contact_force_n > 0.99 * below


def test_a_bound_that_is_no_number_proves_nothing() -> None:
    plant = paper_plant(stiffness=1e5)
    of, law = family(plant, (1e5, 1.01e5), (16.0, 16.0)), admittance(10.0, 1600.0, 0.02, 0.01)
    box = of.box()
    middle = np.mean(box, axis=1)
    loop = contact_loop(of, law, PRESS, np.stack([middle, middle], axis=1))
    slopes = [contact_loop(of, law, PRESS, box, 0)]
    cell = prepare_cell(loop, slopes, 0.5 * np.ptp(box, axis=1), (0.5, 1.0))
    assert isinstance(cell, CellLoop)
    assert walk(cell, 100.0, 6000, 50).is_bounded
    for spoiled in (
        cell._replace(place=cell.place * np.nan),
        cell._replace(unknown=cell.unknown + np.inf),
        cell._replace(touching=np.nan),
        cell._replace(row_spread=cell.row_spread * np.nan),
    ):
        assert not walk(spoiled, 100.0, 6000, 50).is_bounded


def test_a_part_that_cannot_be_cut_further_is_left_and_never_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, law, stiffness, mass = drawn(0)
    largest, narrow = worst(plant, law, stiffness, mass), (stiffness[0], 1.005 * stiffness[0])
    monkeypatch.setattr(peaks, "_halves", lambda *_: None)
    left = prove_peak(family(plant, stiffness, mass), law, PRESS, 1.0005 * largest, work=WORK)
    assert (left.holds, left.share, left.cells, left.refuted_by) == (False, 0.0, 0, None)
    small = family(plant, narrow, (mass[0], mass[0]))
    assert prove_peak(small, law, PRESS, 2.0 * largest, work=WORK).holds
    plain = peaks._walk_cell

    def without_last(*of: Any) -> ForceBounds:
        found: ForceBounds = plain(*of)
        return found._replace(is_bounded=False) if of[4][0] == 0.0 else found

    monkeypatch.setattr(peaks, "_walk_cell", without_last)
    last_left = prove_peak(small, law, PRESS, 2.0 * largest, work=WORK)
    assert (last_left.holds, last_left.share, last_left.cells) == (False, 0.75, 3)


def test_an_unstable_loop_has_no_bound() -> None:
    """The printed example without lead (MODEL.md, errata 4)."""
    of = family(paper_plant(), (5e5, 5e5), (16.0, 16.0))
    found = prove_peak(of, admittance(10.0, 1000.0, 0.0), PRESS, 1e6, work=60_000)
    assert not found.holds


def test_what_is_not_covered_is_refused() -> None:
    plant = paper_plant(stiffness=1e5)
    of, law = family(plant, (1e5, 1.1e5), (16.0, 16.0)), admittance(10.0, 1600.0, 0.02)
    lets_go = Approach(speed_m_s=0.02, driven_by="hand", after_impact_n=0.0)
    with pytest.raises(ParameterError, match="under F\\^d, which goes on"):
        prove_peak(of, law, lets_go, 100.0, work=WORK)
    for lag in (WrenchFilter(time_constant_s=2e-3), WrenchFilter(delay_s=1e-3)):
        late = family(replace(plant, wrench_filter=lag), (1e5, 1.1e5), (16.0, 16.0))
        with pytest.raises(ParameterError, match="wrench_filter"):
            prove_peak(late, law, PRESS, 100.0, work=WORK)
