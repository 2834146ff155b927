"""The compiled way from plants to polynomials, held to the one that every other module takes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.errors import ParameterError
from problems.maps.loops import Designs, build_plant_loops, designs_around, peaks_of
from problems.maps.parameters import MapQuantity
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import loop_polynomials
from tests.problems.axes import LAW, PERIOD_S, admittance, controllers, one_pole, paper_plant, plants
from tests.problems.random_loops import radius_of, random_controller, random_plant


@LAW
@given(plants())
def test_the_polynomials_are_those_of_the_sampled_plant(plant: Plant) -> None:
    # A second plant with a longer delay makes room behind the first one's powers.
    other = replace(plant, robot=replace(plant.robot, delay_s=plant.robot.delay_s + 2.5 * PERIOD_S))
    found, sizes, first = build_plant_loops([plant, other], PERIOD_S).loops
    for k, each in enumerate((plant, other)):
        expected = loop_polynomials(build_sampled_plant(each, PERIOD_S))
        assert sizes[k] == expected.shape[1]
        assert first[k] == (0 if each.environment.is_anchored else 1)
        # Two forms of the same steps: 1e-10 of the largest coefficient of each polynomial.
        scale = np.max(np.abs(expected), axis=1, keepdims=True)
        assert np.all(np.abs(found[k, :, : sizes[k]] - expected) <= 1e-10 * scale)
        assert np.all(found[k, :, sizes[k] :] == 0.0)


@LAW
@given(plants(), st.lists(controllers(), min_size=1, max_size=4))
def test_verdicts_are_those_of_the_eigenvalues(some: Plant, laws: list[AdmittanceController]) -> None:
    more = [replace(some, payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=200.0)) for mass in (3.0, 30.0)]
    loops = build_plant_loops([some, *more], PERIOD_S)
    for law in laws:
        expected = [radius_of(build_sampled_plant(each, PERIOD_S), law) < 1.0 for each in (some, *more)]
        assert loops.stable(designs_around(law, {}))[0].tolist() == expected
        assert [loops.only(j).stable(designs_around(law, {}))[0, 0] for j in range(3)] == expected


def test_a_plant_whose_motion_overflows_is_refused() -> None:
    with pytest.raises(ParameterError, match="finite"):
        build_plant_loops([paper_plant(coupling=1e300)], PERIOD_S)


def test_a_plant_can_be_had_sampled() -> None:
    plant = paper_plant(robot=one_pole(1.7e-3))
    sampled = build_plant_loops([paper_plant(), plant], PERIOD_S).sampled(1)
    assert (sampled.plant, sampled.whole_delay) == (plant, math.floor(1.7e-3 / PERIOD_S))
    assert build_plant_loops([plant], PERIOD_S).stable(designs_around(admittance(), {})).shape == (1, 1)


APPROACHES = [
    pytest.param(Approach(force_n=30.0), id="force"),
    pytest.param(Approach(speed_m_s=0.05), id="speed"),
    pytest.param(Approach(speed_m_s=0.05, driven_by="hand", after_impact_n=0.0), id="a hand that lets go"),
]
CALM = admittance(damping=3000.0, lead=0.02)


def pair_of(delay_samples: float, stiffness: float, **changes: float) -> Plant:
    return paper_plant(stiffness=stiffness, robot=one_pole(delay_samples * PERIOD_S), **changes)


def mixed() -> list[Plant]:
    """Return plants with whole, fractional and no delay, soft and stiff, light and heavy."""
    return [
        pair_of(3.0, 3e4),
        pair_of(0.0, 2e5, coupling_damping=200.0),
        pair_of(2.4, 1e6, mass=4.0),
        pair_of(7.0, 2e4, mass=50.0, environment_damping=100.0),
    ]


def assert_same_peaks(some: list[Plant], designs: Designs, approach: Approach) -> int:
    """Compare with the simulation pair by pair; return how many were stable."""
    pairs = [build_sampled_contact(build_sampled_plant(each, PERIOD_S)) for each in some]
    stable, sensor = peaks_of(some, PERIOD_S, designs, approach, MapQuantity.PEAK_SENSOR)
    _, contact = peaks_of(some, PERIOD_S, designs, approach, MapQuantity.PEAK_CONTACT)
    for (i, j), is_stable in np.ndenumerate(stable):
        law, pair = designs.controller(i), pairs[j]
        assert is_stable == (max(radius_of(pair.contact, law), radius_of(pair.free, law)) < 1.0)
        if not is_stable:
            assert np.isnan(sensor[i, j])
            assert np.isnan(contact[i, j])
            continue
        run = simulate_contact(pair, law, approach)
        assert sensor[i, j] == pytest.approx(run.peak_sensor_force_n, rel=1e-9)
        assert contact[i, j] == pytest.approx(run.peak_contact_force_n, rel=1e-9)
    return int(np.count_nonzero(stable))


@pytest.mark.parametrize("approach", APPROACHES)
def test_peaks_are_those_of_one_pair_at_a_time(approach: Approach) -> None:
    varied = {
        "damping": np.array([3000.0, 900.0, 2500.0]),
        "lead_s": np.array([0.02, 0.0, 0.02]),
        "compensation_mass": np.array([0.0, 0.0, 5.0]),
    }
    assert 4 <= assert_same_peaks(mixed(), designs_around(CALM, varied), approach) < 12


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(
    ("form", "kind"),
    [("tustin", "none"), ("tustin", "ideal"), ("forward_euler", "filtered"), ("backward_euler", "ideal")],
)
def test_random_peaks_are_those_of_one_pair_at_a_time(order: int, form: str, kind: str) -> None:
    rng = np.random.default_rng(order)
    stable = 0
    for _ in range(4):
        some = [random_plant(rng, order=order, contact=True) for _ in range(3)]
        law = random_controller(rng, forms=(form,), compensations=(kind,))
        stable += assert_same_peaks(some, designs_around(law, {}), Approach(force_n=20.0))
    assert stable >= 1


def test_a_pair_that_only_free_space_makes_unstable_is_unstable() -> None:
    plant, law = pair_of(3.0, 1e5, drag=300.0), admittance(mass=10.0, lead=0.0)
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    assert radius_of(pair.contact, law) < 1.0 < radius_of(pair.free, law)
    stable, peaks = peaks_of(
        [plant], PERIOD_S, designs_around(law, {}), Approach(force_n=30.0), MapQuantity.PEAK_CONTACT
    )
    assert not stable[0, 0]
    assert np.isnan(peaks[0, 0])


def test_a_pair_on_the_boundary_is_decided_by_eigenvalues() -> None:
    """Bisect B_a to the boundary, where Routh's array cancels."""
    plant = pair_of(3.0, 2e5)
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    low, high = 500.0, 5000.0
    for _ in range(45):
        middle = 0.5 * (low + high)
        radii = [radius_of(side, admittance(damping=middle, lead=0.0)) for side in (pair.free, pair.contact)]
        low, high = (low, middle) if max(radii) < 1.0 else (middle, high)
    dampings = high * (1.0 + np.array([-1e-8, 1e-8, 1e-6, 1e-5, 1e-4]))
    designs = designs_around(admittance(damping=high, lead=0.0), {"damping": dampings})
    stable, _ = peaks_of([plant], PERIOD_S, designs, Approach(force_n=30.0), MapQuantity.PEAK_CONTACT)
    assert stable[:, 0].tolist() == [False, True, True, True, True]


@pytest.mark.parametrize("samples", [90.0, 200.0])
def test_a_delay_of_hundreds_of_samples_fits(samples: float) -> None:
    designs = designs_around(admittance(lead=0.0), {"damping": np.array([20_000.0, 900.0])})
    assert assert_same_peaks([pair_of(samples, 2e4), pair_of(3.0, 2e4)], designs, Approach(force_n=10.0)) >= 2


def test_a_surface_with_mass_and_a_damped_coupling_fits() -> None:
    plant = replace(
        paper_plant(stiffness=3e4),
        coupling=Coupling(stiffness_n_per_m=2e5, damping_n_s_per_m=300.0),
        environment=Environment(stiffness_n_per_m=3e4, damping_n_s_per_m=50.0, mass_kg=2.0),
    )
    assert assert_same_peaks([plant], designs_around(CALM, {}), Approach(speed_m_s=0.02)) == 1
