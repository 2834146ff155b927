"""The batch against one pair at a time by the other functions of this floor."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from problems.contact.transient import Approach, SampledContact, build_sampled_contact, simulate_contact
from problems.design.batch_evaluation import BatchResult, ScenarioBatch, are_stable, build_batch
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment
from problems.model.sampled import SampledPlant, build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.random_loops import radius_of, random_controller, random_plant, sampled_of

NUMBERS = ("modulus", "modulus_hz", "peak_sensor_force_n", "peak_contact_force_n", "time_of_peak_s")
PEAKS = NUMBERS[2:]
APPROACHES = [
    pytest.param(Approach(force_n=30.0), id="force"),
    pytest.param(Approach(speed_m_s=0.05), id="speed"),
    pytest.param(Approach(speed_m_s=0.05, driven_by="hand", after_impact_n=0.0), id="a hand that lets go"),
]
KINDS = [
    pytest.param("tustin", ("none", "filtered"), id="tustin"),
    pytest.param("tustin", ("ideal",), id="tustin, ideal"),
    pytest.param("forward_euler", ("none", "filtered"), id="forward Euler"),
    pytest.param("backward_euler", ("ideal",), id="backward Euler, ideal"),
]


def pair_of(delay_samples: float, stiffness: float, **changes: float) -> SampledContact:
    plant = paper_plant(stiffness=stiffness, robot=one_pole(delay_samples * PERIOD_S), **changes)
    return build_sampled_contact(sampled_of(plant))


def mixed() -> list[SampledContact]:
    """Return scenarios with whole, fractional and no delay, soft and stiff, light and heavy."""
    return [
        pair_of(3.0, 3e4),
        pair_of(0.0, 2e5, coupling_damping=200.0),
        pair_of(2.4, 1e6, mass=4.0),
        pair_of(7.0, 2e4, mass=50.0, environment_damping=100.0),
    ]


DESIGNS = [
    admittance(damping=3000.0, lead=0.02),
    admittance(damping=900.0, lead=0.0),
    admittance(mass=30.0, damping=6000.0, lead=0.0, feedback=5e-3),
    replace(admittance(damping=2500.0), compensation_mass_kg=5.0),
]


def columns_of(found: BatchResult) -> np.ndarray:
    return np.stack([found.is_stable, *(getattr(found, name) for name in NUMBERS)])


def assert_same_pairs(
    found: BatchResult,
    controllers: Sequence[AdmittanceController],
    pairs: Sequence[SampledContact],
    approach: Approach,
) -> int:
    """Compare with margins and simulation pair by pair; return how many were stable."""
    stable = 0
    for (i, controller), (j, pair) in itertools.product(enumerate(controllers), enumerate(pairs)):
        expected = max(radius_of(pair.contact, controller), radius_of(pair.free, controller)) < 1.0
        assert found.is_stable[i, j] == expected
        if not expected:
            assert all(np.isnan(getattr(found, name)[i, j]) for name in NUMBERS)
            continue
        stable += 1
        margins, run = find_margins(pair.contact, controller), simulate_contact(pair, controller, approach)
        # The same search on the same grid; 2π divides and multiplies.
        assert found.modulus[i, j] == pytest.approx(margins.modulus, rel=1e-12)
        assert found.modulus_hz[i, j] == pytest.approx(margins.modulus_hz, rel=1e-12)
        for name in PEAKS:
            assert getattr(found, name)[i, j] == pytest.approx(getattr(run, name), rel=1e-9)
    return stable


@pytest.mark.parametrize("approach", APPROACHES)
def test_mixed_scenarios_are_those_of_one_pair_at_a_time(approach: Approach) -> None:
    pairs = mixed()
    assert len({(pair.contact.whole_delay, pair.contact.fraction > 0.0) for pair in pairs}) == 4
    found = build_batch(pairs).evaluate(DESIGNS, approach)
    stable = assert_same_pairs(found, DESIGNS, pairs, approach)
    assert 4 <= stable < len(DESIGNS) * len(pairs)


@pytest.mark.parametrize(("form", "compensations"), KINDS)
@pytest.mark.parametrize("order", [1, 2, 3])
def test_random_scenarios_are_those_of_one_pair_at_a_time(
    order: int, form: str, compensations: tuple[str, ...]
) -> None:
    rng, approach, stable = np.random.default_rng(order), Approach(force_n=20.0), 0
    for _ in range(2):
        plants = [random_plant(rng, order=order, contact=True) for _ in range(3)]
        pairs = [build_sampled_contact(sampled_of(plant)) for plant in plants]
        designs = [random_controller(rng, forms=(form,), compensations=compensations) for _ in range(4)]
        stable += assert_same_pairs(build_batch(pairs).evaluate(designs, approach), designs, pairs, approach)
    assert stable >= 3


@pytest.mark.parametrize(("form", "compensations"), KINDS)
def test_stability_is_that_of_the_spectral_radius(form: str, compensations: tuple[str, ...]) -> None:
    rng = np.random.default_rng(5)
    for order in (1, 2, 3):
        plants = [sampled_of(random_plant(rng, order=order)) for _ in range(15)]
        designs = [random_controller(rng, forms=(form,), compensations=compensations) for _ in range(10)]
        expected = [[radius_of(plant, design) < 1.0 for plant in plants] for design in designs]
        found = are_stable(plants, designs)
        assert found.shape == (10, 15)
        np.testing.assert_array_equal(found, expected)
        assert {True, False} == set(found.ravel().tolist())


def test_the_result_does_not_depend_on_order_or_on_how_a_set_is_split() -> None:
    pairs, approach = mixed(), Approach(force_n=30.0)
    whole = columns_of(build_batch(pairs).evaluate(DESIGNS, approach))
    turned = columns_of(build_batch(pairs[::-1]).evaluate(DESIGNS[::-1], approach))
    np.testing.assert_array_equal(turned[:, ::-1, ::-1], whole)
    halves = [
        [columns_of(build_batch(part).evaluate(designs, approach)) for part in (pairs[:1], pairs[1:])]
        for designs in (DESIGNS[:3], DESIGNS[3:])
    ]
    np.testing.assert_array_equal(np.block([[row] for row in [np.concatenate(half, axis=2) for half in halves]]), whole)
    twice = columns_of(build_batch([*pairs, *pairs]).evaluate([*DESIGNS, *DESIGNS], approach))
    np.testing.assert_array_equal(twice, np.tile(whole, (1, 2, 2)))
    plants = [pair.contact for pair in pairs]
    one_by_one = [[are_stable([plant], [design])[0, 0] for plant in plants] for design in DESIGNS]
    np.testing.assert_array_equal(are_stable(plants, DESIGNS), one_by_one)


def test_what_is_not_asked_stays_open() -> None:
    batch, approach = build_batch(mixed()), Approach(force_n=30.0)
    both = batch.evaluate(DESIGNS, approach)
    for margins, peaks in ((True, False), (False, True), (False, False)):
        found = batch.evaluate(DESIGNS, approach, margins=margins, peaks=peaks)
        np.testing.assert_array_equal(found.is_stable, both.is_stable)
        for name in NUMBERS:
            asked = peaks if name in PEAKS else margins
            expected = getattr(both, name) if asked else np.full(both.modulus.shape, np.nan)
            np.testing.assert_array_equal(getattr(found, name), expected)


def test_an_unstable_pair_has_no_numbers_and_the_others_keep_theirs() -> None:
    """docs/method.md, erratum 4: the printed example is unstable in contact."""
    pairs, approach = [pair_of(3.0, 3e4), pair_of(3.0, 5e5)], Approach(force_n=30.0)
    designs = [admittance(mass=10.0, lead=0.0), admittance(damping=3000.0, lead=0.02)]
    found = build_batch(pairs).evaluate(designs, approach)
    assert found.is_stable.tolist() == [[True, False], [True, True]]
    for name in NUMBERS:
        np.testing.assert_array_equal(np.isnan(getattr(found, name)), ~found.is_stable)
    with pytest.raises(UnstableLoopError):
        simulate_contact(pairs[1], designs[0], approach)


def test_a_pair_that_only_free_space_makes_unstable_is_unstable() -> None:
    pair = pair_of(3.0, 1e5, drag=300.0)
    design = admittance(mass=10.0, lead=0.0)
    assert radius_of(pair.contact, design) < 1.0 < radius_of(pair.free, design)
    assert not build_batch([pair]).evaluate([design], Approach(force_n=30.0)).is_stable[0, 0]


def test_a_pair_on_the_boundary_is_decided_by_eigenvalues_with_the_same_numbers() -> None:
    """Bisect B_a to the boundary: there Routh's array cancels, and what is decided apart must fit in seamlessly."""
    pair, approach = pair_of(3.0, 2e5), Approach(force_n=30.0)
    low, high = 500.0, 5000.0
    for _ in range(45):
        middle = 0.5 * (low + high)
        radii = [radius_of(side, admittance(damping=middle, lead=0.0)) for side in (pair.free, pair.contact)]
        low, high = (low, middle) if max(radii) < 1.0 else (middle, high)
    designs = [admittance(damping=high * (1.0 + step), lead=0.0) for step in (-1e-8, 1e-8, 1e-6, 1e-5, 1e-4)]
    found = build_batch([pair]).evaluate(designs, approach, peaks=False)
    assert found.is_stable[:, 0].tolist() == [False, True, True, True, True]
    # On the boundary |1 + L| is proportional to the distance from it; a tenth less each step where all are so small.
    moduli = found.modulus[1:, 0]
    assert moduli[0] < 1e-6
    assert np.all(np.diff(moduli) > 0.0)
    assert moduli[3] / moduli[2] == pytest.approx(10.0, rel=1e-2)
    full = build_batch([pair]).evaluate(designs[2:], approach)
    assert_same_pairs(full, designs[2:], [pair], approach)


def refusal(plants: Sequence[SampledPlant], controllers: Sequence[AdmittanceController]) -> str:
    with pytest.raises(ParameterError) as found:
        are_stable(plants, controllers)
    return str(found.value)


def test_what_does_not_fit_together_is_refused_in_one_sentence() -> None:
    rng, design = np.random.default_rng(0), admittance()
    plant = sampled_of(paper_plant())
    third = sampled_of(random_plant(rng, order=3, contact=True))
    slower = build_sampled_plant(paper_plant(), 2.0 * PERIOD_S)
    backward = replace(design, discretization="backward_euler")
    ideal = replace(design, compensation="ideal", compensation_mass_kg=5.0)
    cases: list[tuple[list[SampledPlant], list[AdmittanceController], str]] = [
        ([plant, third], [design], "one robot order and sample time"),
        ([plant, slower], [design], "one robot order and sample time"),
        ([plant], [design, backward], "one discretisation and kind of compensation"),
        ([plant], [design, ideal], "one discretisation and kind of compensation"),
        ([], [design], "plants must be at least one"),
        ([plant], [], "controllers must be at least one"),
    ]
    for plants, designs, sentence in cases:
        said = refusal(plants, designs)
        assert sentence in said
        assert "\n" not in said
        assert ". " not in said
        assert said.endswith(".")


def test_the_batch_refuses_what_stability_refuses() -> None:
    slower = build_sampled_contact(build_sampled_plant(paper_plant(), 2.0 * PERIOD_S))
    with pytest.raises(ParameterError, match="one robot order and sample time"):
        build_batch([pair_of(3.0, 3e4), slower])
    with pytest.raises(ParameterError, match="at least one"):
        build_batch([])
    batch: ScenarioBatch = build_batch([pair_of(3.0, 3e4)])
    with pytest.raises(ParameterError, match="at least one"):
        batch.evaluate([], Approach(force_n=30.0))
    with pytest.raises(ParameterError, match="one discretisation"):
        batch.evaluate([admittance(), replace(admittance(), discretization="forward_euler")], Approach(force_n=30.0))


def test_compensated_and_plain_controllers_may_share_a_batch() -> None:
    """Filters that are not in use add no pole: P̂ = 0 and B_fb = 0 are the plain controller."""
    pairs, approach = mixed()[:2], Approach(force_n=30.0)
    plain = admittance(damping=3000.0, lead=0.02)
    others = [replace(plain, compensation_mass_kg=2.0), plain, replace(plain, feedback_damping_s=2e-3)]
    alone = columns_of(build_batch(pairs).evaluate([plain], approach))
    np.testing.assert_array_equal(columns_of(build_batch(pairs).evaluate(others, approach))[:, 1:2], alone)


@pytest.mark.parametrize("samples", [90.0, 200.0, 300.0])
def test_a_delay_of_hundreds_of_samples_fits(samples: float) -> None:
    pairs, approach = [pair_of(samples, 2e4), pair_of(3.0, 2e4)], Approach(force_n=10.0)
    designs = [admittance(damping=20_000.0, lead=0.0), admittance(damping=900.0, lead=0.0)]
    found = build_batch(pairs).evaluate(designs, approach)
    assert assert_same_pairs(found, designs, pairs, approach) >= 2


def test_a_surface_with_mass_and_a_damped_coupling_fits() -> None:
    plant = paper_plant(stiffness=3e4)
    plant = replace(
        plant,
        coupling=Coupling(stiffness_n_per_m=2e5, damping_n_s_per_m=300.0),
        environment=Environment(stiffness_n_per_m=3e4, damping_n_s_per_m=50.0, mass_kg=2.0),
    )
    pair, approach = build_sampled_contact(sampled_of(plant)), Approach(speed_m_s=0.02)
    assert assert_same_pairs(build_batch([pair]).evaluate(DESIGNS, approach), DESIGNS, [pair], approach) >= 2
