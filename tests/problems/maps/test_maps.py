"""Maps against the exact loop's eigenvalues and the functions that answer single points."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.errors import ParameterError
from problems.maps import loops, maps
from problems.maps.loops import PlantChunk, Where
from problems.maps.maps import MapAxis, compute_map, evaluate_point
from problems.maps.parameters import MapQuantity
from problems.model.plant import FREE_SPACE
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.map_cases import DAMPING, LEAD, MASS, STIFFNESS, WHERES, largest_radius, request


@pytest.mark.parametrize("where", WHERES)
@pytest.mark.parametrize(("x", "y"), [(STIFFNESS, LEAD), (LEAD, STIFFNESS), (DAMPING, LEAD), (STIFFNESS, MASS)])
def test_verdicts_are_those_of_the_eigenvalues(x: MapAxis, y: MapAxis, where: Where) -> None:
    asked = request(x=x, y=y, where=where)
    found = compute_map(asked)
    assert found.is_stable.shape == (y.count, x.count)
    for i, upwards in enumerate(y.values()):
        for j, to_the_right in enumerate(x.values()):
            plant, controller = asked.point(float(to_the_right), float(upwards))
            assert found.is_stable[i, j] == (largest_radius(plant, controller, where) < 1.0)
    assert np.all(np.isnan(found.values))


MARGIN_OF = {
    MapQuantity.MODULUS: "modulus",
    MapQuantity.GAIN: "gain_db",
    MapQuantity.PHASE: "phase_deg",
    MapQuantity.DELAY: "delay_s",
    MapQuantity.DISK: "disk",
}


@pytest.mark.parametrize("quantity", MARGIN_OF)
@pytest.mark.parametrize("where", WHERES)
def test_margins_are_those_of_single_points_and_nan_where_unstable(quantity: MapQuantity, where: Where) -> None:
    x, y = replace(STIFFNESS, count=4), replace(LEAD, count=5)
    # Feedback damping makes the two break points differ.
    asked = request(x=x, y=y, quantity=quantity, where=where, controller=admittance(feedback=5e-3))
    found = compute_map(asked)
    assert np.any(found.is_stable)
    for i, upwards in enumerate(y.values()):
        for j, to_the_right in enumerate(x.values()):
            plant, controller = asked.point(float(to_the_right), float(upwards))
            if largest_radius(plant, controller, where) >= 1.0:
                assert math.isnan(found.values[i, j])
                continue
            sampled = [plant] if where != "free_space" else []
            sampled += [plant.in_contact_with(FREE_SPACE)] if where != "contact" else []
            margins = [find_margins(build_sampled_plant(each, PERIOD_S), controller) for each in sampled]
            # The same kernel on the same numbers.
            assert found.values[i, j] == min(getattr(each, MARGIN_OF[quantity]) for each in margins)


def test_a_margin_that_nothing_limits_is_infinite() -> None:
    """In free space L begins at B_p/B_a = 630/8000, and without lead it never comes up to 1: no crossover."""
    damping = replace(DAMPING, low=4e3, high=8e3)
    asked = request(x=MASS, y=damping, controller=admittance(lead=0.0), where="free_space")
    for quantity in (MapQuantity.DELAY, MapQuantity.PHASE):
        found = compute_map(replace(asked, quantity=quantity))
        assert np.all(found.is_stable)
        assert found.values[-1, 0] == math.inf


@pytest.mark.parametrize("approach", [Approach(force_n=30.0), Approach(speed_m_s=0.05, driven_by="hand")])
@pytest.mark.parametrize("quantity", [MapQuantity.PEAK_CONTACT, MapQuantity.PEAK_SENSOR])
def test_peaks_are_those_of_single_contacts_and_nan_where_unstable(quantity: MapQuantity, approach: Approach) -> None:
    x, y = replace(STIFFNESS, count=3), replace(LEAD, count=4)
    asked = request(x=x, y=y, quantity=quantity, approach=approach, controller=admittance(damping=700.0))
    found = compute_map(asked)
    assert np.any(found.is_stable)
    assert not np.all(found.is_stable)
    for i, upwards in enumerate(y.values()):
        for j, to_the_right in enumerate(x.values()):
            plant, controller = asked.point(float(to_the_right), float(upwards))
            if largest_radius(plant, controller, "both") >= 1.0:
                assert math.isnan(found.values[i, j])
                continue
            pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
            run = simulate_contact(pair, controller, approach)
            at_contact = quantity is MapQuantity.PEAK_CONTACT
            assert found.values[i, j] == (run.peak_contact_force_n if at_contact else run.peak_sensor_force_n)


def test_10800_points_are_the_same_however_they_are_chunked(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = request(x=replace(STIFFNESS, count=120), y=replace(LEAD, count=90), quantity=MapQuantity.MODULUS)
    most: list[int] = []
    build = loops.build_chunk

    def watched(plants_here: Any, *rest: Any) -> PlantChunk:
        most.append(len(plants_here))
        return build(plants_here, *rest)

    monkeypatch.setattr(maps, "build_chunk", watched)
    whole = compute_map(asked, plants_per_chunk=10_800)
    assert most == [120]
    most.clear()
    shares: list[float] = []
    parts = compute_map(asked, plants_per_chunk=7, progress=shares.append)
    assert whole.values.size == 10_800
    assert np.array_equal(whole.is_stable, parts.is_stable)
    assert np.array_equal(whole.values, parts.values, equal_nan=True)
    # Never more plants at once than the chunk says, and each of them once.
    assert max(most) == 7
    assert sum(most) == 120
    assert sum(shares) == pytest.approx(1.0)


def test_blocks_of_controllers_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = request(x=DAMPING, y=LEAD, quantity=MapQuantity.PHASE)
    whole = compute_map(asked)
    monkeypatch.setattr(maps, "_CONTROLLERS_PER_BLOCK", 5)
    parts = compute_map(asked)
    assert np.array_equal(whole.is_stable, parts.is_stable)
    assert np.array_equal(whole.values, parts.values, equal_nan=True)


@pytest.mark.parametrize(("x", "y"), [(STIFFNESS, LEAD), (DAMPING, LEAD), (STIFFNESS, MASS)])
def test_exchanging_the_axes_transposes_the_map(x: MapAxis, y: MapAxis) -> None:
    one = compute_map(request(x=x, y=y, quantity=MapQuantity.DISK))
    other = compute_map(request(x=y, y=x, quantity=MapQuantity.DISK))
    assert np.array_equal(one.is_stable, other.is_stable.T)
    assert np.array_equal(one.values, other.values.T, equal_nan=True)


def test_asking_for_both_takes_the_worse_of_contact_and_free_space() -> None:
    drag = MapAxis(name="drag", low=50.0, high=700.0, count=8)
    found = {w: compute_map(request(x=drag, quantity=MapQuantity.MODULUS, where=w)) for w in WHERES}
    contact, free, both = (found[w] for w in WHERES)
    assert np.array_equal(both.is_stable, contact.is_stable & free.is_stable)
    assert not np.array_equal(both.is_stable, contact.is_stable)
    smaller = np.where(both.is_stable, np.minimum(contact.values, free.values), np.nan)
    assert np.array_equal(both.values, smaller, equal_nan=True)


def test_peaks_grow_with_the_force_of_the_approach() -> None:
    """The transient is linear in the force but for its contact, whose condition knows no size either."""
    small, large = (
        compute_map(request(y=MASS, quantity=MapQuantity.PEAK_CONTACT, approach=Approach(force_n=force)))
        for force in (10.0, 70.0)
    )
    assert np.any(small.is_stable)
    # Events inside a sample are located to 1e-9 of it or better.
    np.testing.assert_allclose(large.values, 7.0 * small.values, rtol=1e-7)


def test_a_compensation_from_nothing_on_may_be_ideal() -> None:
    mass = MapAxis(name="compensation_mass", low=0.0, high=16.0, count=5)
    design = replace(admittance(), compensation="ideal")
    asked = request(x=mass, controller=design, quantity=MapQuantity.MODULUS, where="contact")
    found = compute_map(asked)
    for i, j in np.ndindex(found.values.shape):
        plant, controller = asked.point(float(mass.values()[j]), float(LEAD.values()[i]))
        assert found.is_stable[i, j] == (largest_radius(plant, controller, "contact") < 1.0)
        if found.is_stable[i, j]:
            assert found.values[i, j] == find_margins(build_sampled_plant(plant, PERIOD_S), controller).modulus


def test_a_point_of_a_map_is_what_the_map_holds_there() -> None:
    asked = request(quantity=MapQuantity.GAIN)
    found = compute_map(asked)
    i, j = np.argwhere(found.is_stable)[0]
    point = evaluate_point(asked, float(asked.x.values()[j]), float(asked.y.values()[i]))
    assert (point.is_stable, point.value) == (True, found.values[i, j])


def test_a_feedback_damping_too_small_to_be_measured_is_none() -> None:
    axis = MapAxis(name="feedback_damping_s", low=0.0, high=5e-4, count=21)
    found = compute_map(request(x=axis, quantity=MapQuantity.MODULUS))
    # The values below 1e-4 s are the first four.
    assert np.array_equal(found.values[:, :4], np.repeat(found.values[:, :1], 4, axis=1), equal_nan=True)
    assert not np.array_equal(found.values[:, 4], found.values[:, 0], equal_nan=True)


# --- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "K_x"}, "one of mass, damping"),
        ({"low": 0.06}, "LOW below HIGH"),
        ({"low": 0.07}, "LOW below HIGH"),
        ({"low": -0.01}, "0 or above"),
        ({"name": "mass", "low": 0.0}, "above 0"),
        ({"low": math.nan}, "finite"),
        ({"high": math.inf}, "finite"),
        ({"spacing": "log"}, "above 0 for logarithmic spacing"),
        ({"spacing": "cubic"}, "linear or log"),
        ({"count": 1}, "between 2 and 2000"),
        ({"count": 2001}, "between 2 and 2000"),
        ({"name": "feedback_damping_s", "high": 2e-5}, "prints B_fb in another unit"),
    ],
)
def test_an_impossible_range_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        replace(LEAD, **changes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"y": STIFFNESS}, "given once"),
        ({"fixed": {"K_l": 0.01}}, "given once"),
        ({"x": MASS, "fixed": {"payload_frequency_rad_per_s": 100.0}}, "given without payload_mass"),
        ({"where": "nowhere"}, "contact, free_space or both"),
        ({"sample_time_s": 0.0}, "above 0"),
        ({"quantity": MapQuantity.PEAK_SENSOR, "where": "contact"}, "both for a peak"),
        ({"quantity": MapQuantity.PEAK_SENSOR, "plant": paper_plant(stiffness=0.0), "x": MASS}, "a surface to touch"),
        ({"x": replace(STIFFNESS, count=1001), "y": replace(LEAD, count=1000)}, "at most 1000000"),
        ({"x": MapAxis(name="delay_s", low=0.0, high=0.3, count=3)}, "at most 250 samples"),
    ],
)
def test_an_impossible_map_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        request(**changes)


def test_the_bandwidth_of_a_robot_with_two_poles_is_refused() -> None:
    robot = RobotModel(numerator=np.array([400.0]), denominator=np.array([1.0, 30.0, 400.0]), delay_s=2.4e-3)
    with pytest.raises(ParameterError, match="one pole"):
        request(plant=paper_plant(robot=robot), x=MapAxis(name="ω_b", low=5.0, high=50.0, count=3))


def test_a_long_delay_that_is_allowed_is_judged_as_the_eigenvalues_do() -> None:
    """The polynomials are of degree 110 there, which doubles cannot hold."""
    plant = paper_plant(stiffness=2e4, robot=one_pole(100.5 * PERIOD_S))
    asked = request(plant=plant, x=replace(DAMPING, high=50_000.0), y=replace(MASS, name="mass"), where="contact")
    found = compute_map(asked)
    assert len(np.unique(found.is_stable)) == 2
    for i, j in np.ndindex(found.is_stable.shape):
        point = asked.point(float(asked.x.values()[j]), float(asked.y.values()[i]))
        assert found.is_stable[i, j] == (largest_radius(*point, "contact") < 1.0)
