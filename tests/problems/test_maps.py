"""Maps and stable intervals, against the exact loop's eigenvalues and the functions that answer single points."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from problems import map_plants, maps
from problems.contact import Approach, build_sampled_contact, simulate_contact
from problems.controller import AdmittanceController
from problems.errors import ParameterError
from problems.map_designs import designs_around
from problems.map_parameters import MAP_PARAMETERS, MapQuantity, controller_at, find_parameter, plant_at, value_of
from problems.map_plants import PlantChunk, Where
from problems.map_search import (
    IntervalCase,
    IntervalRequest,
    StableInterval,
    find_stable_intervals,
)
from problems.maps import MapAxis, MapRequest, compute_map, distance_at_boundary, evaluate_point
from problems.margins import find_margins
from problems.plant import FREE_SPACE, Plant
from problems.robot import RobotModel
from problems.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import LAW, PERIOD_S, admittance, between, controllers, one_pole, paper_plant, plants

FloatArray = NDArray[np.float64]

LEAD = MapAxis(name="lead_s", low=0.0, high=0.06, count=13)
DAMPING = MapAxis(name="damping", low=200.0, high=5000.0, count=11, spacing="log")
STIFFNESS = MapAxis(name="environment_stiffness", low=1e4, high=1e6, count=9, spacing="log")
MASS = MapAxis(name="payload_mass", low=4.0, high=60.0, count=7)
WIDE_LEAD = MapAxis(name="lead_s", low=0.0, high=0.1, count=201)
WIDE_DAMPING = MapAxis(name="damping", low=10.0, high=1e5, count=201, spacing="log")
WHERES: tuple[Where, ...] = ("contact", "free_space", "both")


def request(**changes: Any) -> MapRequest:
    given_values: dict[str, Any] = {
        "plant": paper_plant(stiffness=1e5),
        "controller": admittance(),
        "sample_time_s": PERIOD_S,
        "x": STIFFNESS,
        "y": LEAD,
    }
    return MapRequest(**{**given_values, **changes})


def largest_radius(plant: Plant, controller: AdmittanceController, where: Where) -> float:
    """Return the largest |z| wherever stability is asked, by the eigenvalues."""
    plants_of = {"contact": [plant], "free_space": [plant.in_contact_with(FREE_SPACE)]}
    plants_of["both"] = plants_of["contact"] + plants_of["free_space"]
    return max(
        spectral_radius(build_loop(build_sampled_plant(each, PERIOD_S), controller)) for each in plants_of[where]
    )


def intervals_of(
    plant: Plant, controller: AdmittanceController, searched: MapAxis, where: Where, **changes: Any
) -> tuple[StableInterval, ...]:
    """Return the stable intervals on one plant: the first of two values that change nothing."""
    along = MapAxis(name="drag", low=plant.payload.drag_n_s_per_m, high=plant.payload.drag_n_s_per_m + 1.0, count=2)
    cases = {"": IntervalCase(controller=controller)}
    asked = IntervalRequest(
        plant=plant, sample_time_s=PERIOD_S, cases=cases, along=along, searched=searched, where=where, **changes
    )
    return find_stable_intervals(asked).intervals[""][0]


# --- stable intervals ---------------------------------------------------------------------------------------------

# Two intervals of B_a: a slow robot behind a long delay, with lead.
ISLAND = (
    paper_plant(
        stiffness=7.3e4,
        mass=36.7,
        drag=958.0,
        coupling=8.96e5,
        coupling_damping=300.0,
        robot=one_pole(0.01185, 27.2),
    ),
    admittance(mass=37.9, lead=0.00926),
)


@pytest.mark.parametrize(
    ("plant", "controller", "searched", "where", "count"),
    [
        (paper_plant(stiffness=0.0, drag=300.0), admittance(10.0, 1000.0), WIDE_LEAD, "free_space", 1),
        (paper_plant(stiffness=5e5), admittance(10.0, 1000.0), WIDE_LEAD, "contact", 1),
        (paper_plant(stiffness=5e5, drag=200.0), admittance(10.0, 1000.0, feedback=7.5e-3), WIDE_LEAD, "both", 1),
        (*ISLAND, WIDE_DAMPING, "contact", 2),
        (paper_plant(stiffness=0.0, drag=100.0), admittance(10.0, 1000.0), WIDE_LEAD, "free_space", 0),
    ],
)
def test_the_intervals_are_those_of_a_dense_sweep_of_eigenvalues(
    plant: Plant, controller: AdmittanceController, searched: MapAxis, where: Where, count: int
) -> None:
    found = intervals_of(plant, controller, searched, where)
    assert len(found) == count
    # Three values in every step of the scan, none of them a value of it.
    dense = replace(searched, count=3 * (searched.count - 1) + 2).values()[1:-1]
    for value in dense:
        radius = largest_radius(plant, controller_at(controller, {searched.name: float(value)}), where)
        assert (radius < 1.0) == any(each.lower <= value <= each.upper for each in found)


def test_the_limits_of_the_lead_in_free_space_hang_on_the_payloads_damping() -> None:
    """MODEL.md, erratum 7, whose figures have one or two digits: half a unit of the last one."""
    design = admittance(10.0, 1000.0)
    (well_damped,) = intervals_of(paper_plant(stiffness=0.0, drag=630.0), design, WIDE_LEAD, "free_space")
    assert well_damped.lower_is_bound
    assert well_damped.upper == pytest.approx(0.047, abs=1e-3)
    (lightly_damped,) = intervals_of(paper_plant(stiffness=0.0, drag=300.0), design, WIDE_LEAD, "free_space")
    assert not lightly_damped.lower_is_bound
    assert lightly_damped.lower == pytest.approx(0.006, abs=1e-3)
    assert lightly_damped.upper == pytest.approx(0.033, abs=1e-3)
    assert intervals_of(paper_plant(stiffness=0.0, drag=100.0), design, WIDE_LEAD, "free_space") == ()


@LAW
@given(plants(contact=True), controllers(), st.sampled_from([WIDE_LEAD, WIDE_DAMPING]), st.sampled_from(WHERES))
def test_an_interval_is_stable_at_its_ends_and_not_a_tolerance_beyond(
    plant: Plant, controller: AdmittanceController, searched: MapAxis, where: Where
) -> None:
    tolerance = 1e-4
    scale, back = (np.log, np.exp) if searched.spacing == "log" else (np.asarray, float)
    step = tolerance * (scale(searched.high) - scale(searched.low))

    def radius(value: float) -> float:
        return largest_radius(plant, controller_at(controller, {searched.name: value}), where)

    for each in intervals_of(plant, controller, searched, where, tolerance=tolerance):
        assert max(radius(each.lower), radius(each.upper)) < 1.0
        assert each.lower_is_bound == (each.lower == searched.low)
        assert each.upper_is_bound == (each.upper == searched.high)
        # The change is bracketed to `tolerance`; the unstable side of the bracket is at most that far away.
        if not each.lower_is_bound:
            assert radius(float(back(scale(each.lower) - 1.01 * step))) >= 1.0
        if not each.upper_is_bound:
            assert radius(float(back(scale(each.upper) + 1.01 * step))) >= 1.0


def test_intervals_along_a_controller_parameter_are_those_of_each_controller() -> None:
    along = MapAxis(name="mass", low=5.0, high=40.0, count=4)
    plant, design = paper_plant(stiffness=2e5), admittance()
    cases = {"": IntervalCase(controller=design)}
    found = find_stable_intervals(
        IntervalRequest(plant=plant, sample_time_s=PERIOD_S, cases=cases, along=along, searched=WIDE_DAMPING)
    )
    for mass, column in zip(along.values(), found.intervals[""], strict=True):
        assert column == intervals_of(plant, replace(design, mass_kg=float(mass)), WIDE_DAMPING, "both")


def test_every_case_has_its_own_fixed_values_and_chunks_change_nothing() -> None:
    along = MapAxis(name="payload_frequency_rad_per_s", low=40.0, high=400.0, count=11, spacing="log")
    ratios = (0.05, 0.2)
    cases = {str(z): IntervalCase(controller=admittance(), fixed={"payload_damping_ratio": z}) for z in ratios}
    plant = paper_plant(stiffness=5e5)
    asked = IntervalRequest(plant=plant, sample_time_s=PERIOD_S, cases=cases, along=along, searched=WIDE_LEAD)
    shares: list[float] = []
    found = find_stable_intervals(asked, plants_per_chunk=3, progress=shares.append)
    assert found == find_stable_intervals(asked)
    assert sum(shares) == pytest.approx(1.0)
    for z in ratios:
        for omega, column in zip(along.values(), found.intervals[str(z)], strict=True):
            mass = 3e5 / omega**2
            same = paper_plant(stiffness=5e5, mass=mass, drag=2.0 * z * math.sqrt(mass * 3e5))
            direct = intervals_of(same, admittance(), WIDE_LEAD, "both")
            assert len(column) == len(direct)
            for one, other in zip(column, direct, strict=True):
                # The same plant but for rounding: a bisection may end one step of it apart.
                assert (one.lower, one.upper) == pytest.approx((other.lower, other.upper), abs=2e-6)


def test_the_smallest_stable_damping_rises_with_the_stiffness_and_falls_with_lead() -> None:
    """The trend of the paper's figure for stiff walls: the lead needs less damping than standard admittance."""
    along = MapAxis(name="environment_stiffness", low=1e5, high=1e6, count=8, spacing="log")
    leads = {"standard": 0.0, "lead": 0.02}
    cases = {name: IntervalCase(controller=admittance(lead=lead)) for name, lead in leads.items()}
    found = find_stable_intervals(
        IntervalRequest(
            plant=paper_plant(),
            sample_time_s=PERIOD_S,
            cases=cases,
            along=along,
            searched=WIDE_DAMPING,
            where="contact",
        )
    )
    standard, lead = found.smallest("standard"), found.smallest("lead")
    assert np.all(np.diff(standard) > 0.0)
    assert np.all(lead < standard)
    assert np.all(found.largest("standard") == WIDE_DAMPING.high)


def test_nothing_stable_is_nan() -> None:
    along = MapAxis(name="drag", low=50.0, high=100.0, count=2)
    cases = {"": IntervalCase(controller=admittance(10.0, 1000.0))}
    found = find_stable_intervals(
        IntervalRequest(
            plant=paper_plant(stiffness=0.0), sample_time_s=PERIOD_S, cases=cases, along=along, searched=WIDE_LEAD
        )
    )
    assert np.all(np.isnan(found.smallest("")))
    assert np.all(np.isnan(found.largest("")))


# --- maps ---------------------------------------------------------------------------------------------------------


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
    build = map_plants.build_chunk

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


def test_the_boundary_lies_where_the_bisection_finds_it() -> None:
    """Interpolating the distance between two neighbours and bisecting the verdict are two roads to one limit."""
    lead = MapAxis(name="lead_s", low=0.0, high=0.06, count=61)
    asked = request(x=lead, y=MapAxis(name="drag", low=250.0, high=630.0, count=5), where="free_space")
    result = compute_map(asked)
    distance = distance_at_boundary(result)
    seen = 0
    for i, drag in enumerate(asked.y.values()):
        plant = paper_plant(stiffness=1e5, drag=float(drag))
        ends = [
            end
            for each in intervals_of(plant, admittance(), lead, "free_space")
            for end, is_bound in ((each.lower, each.lower_is_bound), (each.upper, each.upper_is_bound))
            if not is_bound
        ]
        changes = np.flatnonzero(result.is_stable[i, 1:] != result.is_stable[i, :-1])
        assert len(ends) == len(changes)
        for end, k in zip(ends, changes, strict=True):
            left, right = distance[i, k], distance[i, k + 1]
            assert left * right < 0.0
            crossing = lead.values()[k] + 1e-3 * left / (left - right)
            # The distance is smooth: over a step of 1 ms a straight line misses its zero by a hundredth of the step.
            assert crossing == pytest.approx(end, abs=2e-5)
            seen += 1
    assert seen >= 5
    assert np.all(np.isnan(distance) | (np.sign(distance) == np.where(result.is_stable, -1.0, 1.0)))


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


# --- parameters ---------------------------------------------------------------------------------------------------


@LAW
@given(plants(), controllers(), st.sampled_from(list(MAP_PARAMETERS)), between(0.5, 2.0))
def test_a_parameter_that_is_set_has_that_value_and_no_other_changes(
    plant: Plant, controller: AdmittanceController, name: str, factor: float
) -> None:
    before = {each: value_of(each, plant, controller) for each in MAP_PARAMETERS}
    if math.isnan(before[name]):
        with pytest.raises(ParameterError, match="one pole"):
            plant_at(plant, {name: 20.0})
        return
    value = factor * before[name] if before[name] > 0.0 else 0.01 * factor
    changed = plant_at(plant, {name: value}), controller_at(controller, {name: value})
    after = {each: value_of(each, *changed) for each in MAP_PARAMETERS}
    # sqrt and square of a double differ by a few units of its last place.
    assert after[name] == pytest.approx(value, rel=1e-14)
    payload = {"payload_mass", "drag", "payload_frequency_rad_per_s", "payload_damping_ratio"}
    moved = payload if name in payload | {"coupling_stiffness"} else set()
    for each in set(MAP_PARAMETERS) - moved - {name}:
        assert after[each] == before[each] or math.isnan(before[each])


@LAW
@given(plants(), between(20.0, 500.0), between(0.01, 1.0), between(5e4, 1e6))
def test_frequency_and_damping_ratio_hold_whatever_else_is_set(
    plant: Plant, omega: float, zeta: float, stiffness: float
) -> None:
    values = {"payload_frequency_rad_per_s": omega, "payload_damping_ratio": zeta, "coupling_stiffness": stiffness}
    changed = plant_at(plant, values)
    assert changed.coupling.stiffness_n_per_m == stiffness
    assert math.sqrt(stiffness / changed.payload.mass_kg) == pytest.approx(omega, rel=1e-14)
    critical = 2.0 * math.sqrt(changed.payload.mass_kg * stiffness)
    assert changed.payload.drag_n_s_per_m / critical == pytest.approx(zeta, rel=1e-14)


def test_a_fixed_damping_ratio_goes_along_with_the_mass() -> None:
    asked = request(x=MASS, fixed={"payload_damping_ratio": 0.1})
    for mass in (4.0, 60.0):
        plant, _ = asked.point(mass, 0.01)
        assert plant.payload.drag_n_s_per_m == pytest.approx(0.2 * math.sqrt(mass * 3e5))


@LAW
@given(controllers(), st.lists(between(200.0, 5000.0), min_size=1, max_size=3))
def test_rows_of_numbers_are_the_controllers_they_stand_for(
    controller: AdmittanceController, dampings: list[float]
) -> None:
    designs = designs_around(controller, {"damping": np.array(dampings)})
    assert designs.count == len(dampings)
    for i, damping in enumerate(dampings):
        assert designs.controller(i) == replace(controller, damping_n_s_per_m=damping)
    assert designs_around(controller, {}).controller(0) == controller


def test_parameters_are_found_by_name_and_symbol() -> None:
    for name, parameter in MAP_PARAMETERS.items():
        assert find_parameter(name) is parameter
        assert find_parameter(parameter.symbol) is parameter
    assert find_parameter("damping").unit_of(rotational=True) == "N·m·s/rad"
    assert MapAxis(name="K_l", low=0.0, high=1.0, count=2).name == "lead_s"


@pytest.mark.parametrize("axis", [LEAD, DAMPING, MapAxis(name="K_e", low=0.1, high=0.3, count=7, spacing="log")])
def test_the_ends_of_a_range_are_values_of_it(axis: MapAxis) -> None:
    values = axis.values()
    assert (len(values), values[0], values[-1]) == (axis.count, axis.low, axis.high)
    steps = np.diff(np.log(values) if axis.spacing == "log" else values)
    np.testing.assert_allclose(steps, steps[0], rtol=1e-9)


# --- refusals -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "told"),
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
def test_an_impossible_range_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(ParameterError, match=told):
        replace(LEAD, **changes)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"y": STIFFNESS}, "given once"),
        ({"fixed": {"K_l": 0.01}}, "given once"),
        ({"x": MASS, "fixed": {"payload_frequency_rad_per_s": 100.0}}, "given without payload_mass"),
        ({"where": "nowhere"}, "contact, free_space or both"),
        ({"sample_time_s": 0.0}, "above 0"),
        ({"quantity": MapQuantity.PEAK_SENSOR, "where": "contact"}, "both for a peak"),
        ({"quantity": MapQuantity.PEAK_SENSOR, "plant": paper_plant(stiffness=0.0), "x": MASS}, "a surface to touch"),
        ({"x": replace(STIFFNESS, count=1001), "y": replace(LEAD, count=1000)}, "at most 1000000"),
        ({"x": MapAxis(name="delay_s", low=0.0, high=0.08, count=3)}, "at most 77 samples"),
    ],
)
def test_an_impossible_map_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(ParameterError, match=told):
        request(**changes)


def test_the_bandwidth_of_a_robot_with_two_poles_is_refused() -> None:
    robot = RobotModel(numerator=np.array([400.0]), denominator=np.array([1.0, 30.0, 400.0]), delay_s=2.4e-3)
    with pytest.raises(ParameterError, match="one pole"):
        request(plant=paper_plant(robot=robot), x=MapAxis(name="ω_b", low=5.0, high=50.0, count=3))


def test_a_long_delay_that_is_allowed_is_judged_as_the_eigenvalues_do() -> None:
    """77 samples are the most; the polynomials are of degree 84 there."""
    plant = paper_plant(stiffness=2e4, robot=one_pole(76.5 * PERIOD_S))
    asked = request(plant=plant, x=replace(DAMPING, high=50_000.0), y=replace(MASS, name="mass"), where="contact")
    found = compute_map(asked)
    assert len(np.unique(found.is_stable)) == 2
    for i, j in np.ndindex(found.is_stable.shape):
        point = asked.point(float(asked.x.values()[j]), float(asked.y.values()[i]))
        assert found.is_stable[i, j] == (largest_radius(*point, "contact") < 1.0)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"cases": {}}, "at least one"),
        ({"searched": MASS}, "one of the controller"),
        ({"along": replace(WIDE_LEAD, count=3)}, "given once"),
        ({"tolerance": 0.0}, "above 0"),
        ({"where": "nowhere"}, "contact, free_space or both"),
    ],
)
def test_an_impossible_search_is_refused(changes: dict[str, Any], told: str) -> None:
    asked = IntervalRequest(
        plant=paper_plant(),
        sample_time_s=PERIOD_S,
        cases={"": IntervalCase(controller=admittance())},
        along=STIFFNESS,
        searched=WIDE_LEAD,
    )
    with pytest.raises(ParameterError, match=told):
        replace(asked, **changes)
