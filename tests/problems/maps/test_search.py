"""Stable intervals against the exact loop's eigenvalues."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from problems.errors import ParameterError
from problems.maps.loops import Where
from problems.maps.maps import MapAxis, compute_map, distance_at_boundary
from problems.maps.parameters import controller_at
from problems.maps.search import IntervalCase, IntervalRequest, find_stable_intervals
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from tests.problems.axes import LAW, PERIOD_S, admittance, controllers, one_pole, paper_plant, plants
from tests.problems.map_cases import (
    MASS,
    STIFFNESS,
    WHERES,
    WIDE_DAMPING,
    WIDE_LEAD,
    intervals_of,
    largest_radius,
    request,
)

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
        # Stable up to the end of the search.
        (paper_plant(stiffness=5e5), admittance(10.0, 1000.0, 0.015), WIDE_DAMPING, "contact", 1),
        (paper_plant(stiffness=0.0, drag=100.0), admittance(10.0, 1000.0), WIDE_LEAD, "free_space", 0),
    ],
)
def test_the_intervals_are_those_of_a_dense_sweep_of_eigenvalues(
    plant: Plant, controller: AdmittanceController, searched: MapAxis, where: Where, count: int
) -> None:
    found = intervals_of(plant, controller, searched, where)
    assert len(found) == count
    # Only the first can begin where the search does, and only the last can end there.
    assert [each.lower_is_bound for each in found] == [each.lower == searched.low for each in found]
    assert [each.upper_is_bound for each in found] == [each.upper == searched.high for each in found]
    # Three values in every step of the scan, none of them a value of it.
    dense = replace(searched, count=3 * (searched.count - 1) + 2).values()[1:-1]
    for value in dense:
        radius = largest_radius(plant, controller_at(controller, {searched.name: float(value)}), where)
        assert (radius < 1.0) == any(each.lower <= value <= each.upper for each in found)


def test_the_limits_of_the_lead_in_free_space_hang_on_the_payloads_damping() -> None:
    """docs/method.md, erratum 7, whose figures have one or two digits: half a unit of the last one."""
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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cases": {}}, "at least one"),
        ({"searched": MASS}, "one of the controller"),
        ({"along": replace(WIDE_LEAD, count=3)}, "given once"),
        ({"tolerance": 0.0}, "above 0"),
        ({"where": "nowhere"}, "contact, free_space or both"),
    ],
)
def test_an_impossible_search_is_refused(changes: dict[str, Any], message: str) -> None:
    asked = IntervalRequest(
        plant=paper_plant(),
        sample_time_s=PERIOD_S,
        cases={"": IntervalCase(controller=admittance())},
        along=STIFFNESS,
        searched=WIDE_LEAD,
    )
    with pytest.raises(ParameterError, match=message):
        replace(asked, **changes)


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
