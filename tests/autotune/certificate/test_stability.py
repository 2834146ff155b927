"""Proofs of stability alone, for any linear law, against eigenvalues and Lyapunov functions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.certificate import certify as certify_module
from autotune.certificate.certify import CELL_WORK, certify, prove
from autotune.certificate.family import Claim, CombinedCertificate, Family, ProofOutcome, Verdict, build_families
from problems.arrays import FloatArray
from problems.design.uncertainty import MASS, STIFFNESS, PlantSet
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.plant import WrenchFilter
from problems.model.robot import RobotModel
from problems.model.sampled import Controller
from problems.model.third_party_controllers import ForwardDynamics, SpringAdmittance
from tests.autotune.certificate.lyapunov import lyapunov_stability
from tests.autotune.certificate.plants import radii, radius_at, random_points, uncertain, uncertain_plants
from tests.problems.axes import PERIOD_S, admittance, between, controllers, linear_controller, one_pole, or_zero

TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.0e-3)
# Heavily damped enough for both robots over the whole set.
CALM = admittance(20.0, 3500.0, 0.013)
SPRUNG = SpringAdmittance(
    mass=8.0, damping_ratio=200.0, stiffness=40.0, joint_damping_per_s=5.0, filter_coefficient=0.3
).law(PERIOD_S)
FOLLOWING = ForwardDynamics(proportional=0.01, derivative=2e-4).law(PERIOD_S)
WORK = 400_000
KINDS = {
    "whole delay": one_pole(),
    "no delay": one_pole(0.0),
    "fraction": one_pole(2.7 * PERIOD_S),
    "fraction below one sample": one_pole(0.4 * PERIOD_S),
    "two poles": TWO_POLES,
}
EVERY_KIND = pytest.mark.parametrize("robot", list(KINDS.values()), ids=list(KINDS))
EVERY_LAW = pytest.mark.parametrize("law", [CALM, linear_controller(CALM, PERIOD_S), SPRUNG, FOLLOWING])
FEW = settings(deadline=None, max_examples=30)


def proved(plants: PlantSet, law: Controller, *, work: int = WORK) -> CombinedCertificate:
    return prove(Claim(plants=plants, law=law, sample_time_s=PERIOD_S, modulus=None, work=work))


def check_not_contradicted(plants: PlantSet, law: Controller) -> CombinedCertificate:
    """What is proved no plant contradicts, and a plant that is named as unstable is."""
    found = proved(plants, law)
    points = random_points(plants, 100)
    if found.holds:
        assert np.max(radii(plants, law, points)) < 1.0
        assert np.max(radii(plants, law, [(mass, 0.0) for mass, _ in points])) < 1.0
    else:
        failed = found.failed
        assert failed is not None
        assert failed.plant is not None
        mass, (low, high) = failed.plant.payload_mass_kg, plants.payload_mass_kg
        assert low * (1.0 - 1e-12) <= mass <= high * (1.0 + 1e-12)
        if failed.verdict is Verdict.REFUTED:
            # To the rounding of eigenvalues next to the circle.
            radius = radius_at(plants, law, mass, failed.plant.environment_stiffness_n_per_m)
            assert radius >= 1.0 - 1e-9
    return found


def gentle_controllers() -> st.SearchStrategy[AdmittanceController]:
    return st.builds(
        admittance,
        mass=between(8.0, 40.0),
        damping=between(1200.0, 8000.0),
        lead=or_zero(between(5e-3, 0.03)),
        feedback=or_zero(between(1e-3, 0.015)),
    )


def third_party_laws() -> st.SearchStrategy[LinearController]:
    spring = st.builds(
        SpringAdmittance,
        mass=between(5.0, 40.0),
        damping_ratio=between(50.0, 500.0),
        stiffness=or_zero(between(1.0, 300.0)),
        joint_damping_per_s=or_zero(between(50.0, 200.0)),
        filter_coefficient=st.sampled_from((1.0, 0.3, 0.05)),
    )
    forward = st.builds(ForwardDynamics, proportional=between(1e-3, 0.05), derivative=or_zero(between(1e-5, 1e-3)))
    return st.one_of(spring, forward).map(lambda each: each.law(PERIOD_S))


@FEW
@given(plants=uncertain_plants(), law=st.one_of(gentle_controllers(), controllers(), third_party_laws()))
def test_a_proof_is_never_contradicted_by_eigenvalues(plants: PlantSet, law: Controller) -> None:
    check_not_contradicted(plants, law)


def test_the_law_above_is_not_empty() -> None:
    """Of random gentle designs a good part is stable and proved, so the law speaks of something."""
    rng = np.random.default_rng(5)
    verdicts: list[tuple[bool, bool]] = []
    for _ in range(20):
        plants = uncertain(
            robot=one_pole(float(rng.uniform(0.0, 4.0)) * PERIOD_S),
            drag=float(rng.uniform(200.0, 800.0)),
            mass=(15.5, 16.5),
            stiffness=(1.5e5, 2e5),
        )
        law = admittance(float(rng.uniform(8.0, 40.0)), float(rng.uniform(300.0, 3000.0)), float(rng.uniform(0, 0.02)))
        points = random_points(plants, 30)
        stable = np.max(radii(plants, law, [*points, *((mass, 0.0) for mass, _ in points)])) < 1.0
        verdicts.append((bool(stable), check_not_contradicted(plants, law).holds))
    assert sum(holds for _, holds in verdicts) >= 8
    assert sum(not holds for _, holds in verdicts) >= 3
    # What is stable with room to spare is proved: no stable one of these is left unproved.
    assert [pair for pair in verdicts if pair[0] != pair[1]] == []


@EVERY_KIND
@EVERY_LAW
def test_every_kind_of_loop_is_proved_over_a_domain_by_two_methods(robot: RobotModel, law: Controller) -> None:
    """The oracle needs more cells: it is asked about a part of the set, and not about a spring in free space."""
    plants = uncertain(
        robot=robot, coupling_damping=150.0, environment_damping=40.0, mass=(15.6, 16.4), stiffness=(1.4e5, 1.6e5)
    )
    assert radius_at(plants, law, 16.0, 1.5e5) < 1.0
    assert check_not_contradicted(plants, law).holds
    ranges = {MASS: (15.98, 16.02), STIFFNESS: (1.49e5, 1.51e5)}
    part = Family(nominal=plants.nominal, ranges=ranges, sample_time_s=PERIOD_S)
    assert lyapunov_stability(part, law, PERIOD_S).holds
    if law is not SPRUNG:
        assert lyapunov_stability(part.in_free_space(), law, PERIOD_S).holds


@pytest.mark.parametrize("modulus", [None, 0.3])
def test_a_controller_and_its_difference_equation_have_the_same_proof(modulus: float | None) -> None:
    law = admittance(20.0, 3500.0, 0.013, 0.01)
    ranges = {STIFFNESS: (5e4, 3e5), MASS: (14.0, 18.0)}
    for family in build_families(uncertain().nominal, ranges, PERIOD_S):
        for each in (family, family.in_free_space()):
            first, second = (certify(each, one, modulus, work=WORK) for one in (law, linear_controller(law, PERIOD_S)))
            assert first.holds
            assert (first.cells, first.arcs, first.work) == (second.cells, second.arcs, second.work)


@pytest.mark.parametrize("law", [SPRUNG, FOLLOWING], ids=["spring", "follows"])
def test_a_law_that_is_unstable_somewhere_is_refuted(law: LinearController) -> None:
    """Far more of it than is stable: 30 times the force, in the command."""
    matrix = law.matrix.copy()
    matrix[:, law.state_count] *= 30.0
    found = check_not_contradicted(uncertain(), replace(law, matrix=matrix))
    assert found.false is not None


def test_one_plant_is_one_cell() -> None:
    found = proved(uncertain(mass=(16.0, 16.0), stiffness=(1.5e5, 1.5e5)), CALM)
    assert (found.holds, found.cells, [part.share for part in found.parts]) == (True, 2, [1.0, 1.0])


@pytest.mark.parametrize("modulus", [None, 0.3])
def test_the_cells_that_are_proved_are_counted(modulus: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells are cut in two: of n that are looked at (n + 1)/2 are proved, the others cut; corners are no cells."""
    looked_at: list[FloatArray] = []
    plain = certify_module._Search._coefficients

    def counted(self: certify_module._Search, cell: FloatArray) -> object:
        looked_at.append(cell)
        return plain(self, cell)

    monkeypatch.setattr(certify_module._Search, "_coefficients", counted)
    (family,) = build_families(uncertain().nominal, {STIFFNESS: (2e4, 5e5), MASS: (12.0, 20.0)}, PERIOD_S)
    found = certify(family, admittance(12.0, 2500.0, 0.02, 0.01), modulus, work=WORK)
    assert found.holds
    wide = [cell for cell in looked_at if np.all(cell[:, 0] < cell[:, 1])]
    assert len(looked_at) - len(wide) == (0 if modulus is None else 4)
    assert len(wide) > 20
    assert found.cells == (len(wide) + 1) // 2
    # Every cell that is proved has arcs, and all of them are work.
    assert found.cells < found.arcs <= found.work - CELL_WORK * len(looked_at)


def test_nothing_is_proved_when_a_corner_is_unstable() -> None:
    """docs/method.md, erratum 4: the printed design is unstable at 5e5 N/m; here it is only the stiff end that is."""
    law = admittance(10.0, 1000.0, 0.0)
    plants = uncertain(mass=(16.0, 16.0), stiffness=(1e3, 5e5))
    assert radius_at(plants, law, 16.0, 1e3) < 1.0 <= radius_at(plants, law, 16.0, 5e5)
    assert check_not_contradicted(plants, law).false is not None


def gap(drag: float) -> tuple[PlantSet, AdmittanceController]:
    """Light damping: stable against soft and against stiff walls, and not in between (docs/method.md, erratum 5)."""
    plants = uncertain(
        robot=one_pole(bandwidth_rad_per_s=24.0), coupling=2.1e5, drag=drag, mass=(16.0, 16.0), stiffness=(1e5, 3e6)
    )
    return plants, admittance(9.3, 1340.0, 0.019)


def scanned(plants: PlantSet, law: Controller, count: int = 200) -> tuple[FloatArray, FloatArray]:
    low, high = plants.environment_stiffness_n_per_m
    stiffness = np.geomspace(low, high, count)
    return stiffness, radii(plants, law, [(16.0, float(k)) for k in stiffness])


def test_an_unstable_gap_between_two_stable_ends_is_found() -> None:
    plants, law = gap(30.0)
    stiffness, found = scanned(plants, law)
    unstable = stiffness[found >= 1.0]
    assert found[0] < 1.0
    assert found[-1] < 1.0
    assert unstable.size > 10
    false = check_not_contradicted(plants, law).false
    assert false is not None
    assert false.plant is not None
    assert unstable[0] <= false.plant.environment_stiffness_n_per_m <= unstable[-1]


def test_a_gap_a_percent_wide_is_found_as_well() -> None:
    """The drag is raised until the gap has all but closed: it is seen from one of 100 stiffnesses 3 % apart."""
    low, high = 40.0, 60.0
    for _ in range(16):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if np.max(scanned(*gap(middle), 100)[1]) > 1.0 else (low, middle)
    plants, law = gap(low)
    _, found = scanned(plants, law, 100)
    assert np.count_nonzero(found >= 1.0) == 1
    assert check_not_contradicted(plants, law).false is not None


def test_just_beyond_the_gap_the_whole_interval_is_proved() -> None:
    plants, law = gap(80.0)
    assert np.max(scanned(plants, law)[1]) < 0.9995
    assert check_not_contradicted(plants, law).holds


def test_a_proof_that_runs_out_names_a_plant_of_the_set_and_refutes_nothing() -> None:
    plants = uncertain(mass=(10.0, 20.0), stiffness=(2e4, 5e5))
    found = proved(plants, CALM, work=3 * CELL_WORK)
    assert (found.holds, found.false) == (False, None)
    assert isinstance(found.failed, ProofOutcome)
    assert found.failed.verdict is Verdict.RAN_OUT
    assert 0.0 <= found.share < 1.0
    assert found.failed.plant is not None
    assert 10.0 <= found.failed.plant.payload_mass_kg <= 20.0


def test_a_law_that_neither_integrates_nor_follows_is_refused() -> None:
    """x^d = x as a law that says nothing of following: cut at x^d its free space has |1 + L| = 0 at rest."""
    law = replace(FOLLOWING, follows_position=False)
    with pytest.raises(ParameterError, match="one that integrates, or follows or holds the position"):
        proved(uncertain(), law)


def test_a_law_of_another_period_is_refused() -> None:
    with pytest.raises(ParameterError, match="that of the plant"):
        proved(uncertain(), replace(FOLLOWING, sample_time_s=1e-3))


@pytest.mark.parametrize("law", [admittance(20.0, 3500.0, 0.013, 0.01), SPRUNG, FOLLOWING])
def test_a_law_that_reads_the_position_is_not_proved_behind_a_late_wrench(law: Controller) -> None:
    late = uncertain(wrench_filter=WrenchFilter(delay_s=1e-3))
    with pytest.raises(ParameterError, match=r"wrench_delay_s must be 0 for a law that reads the position"):
        proved(late, law)
    assert check_not_contradicted(late, CALM).holds
