"""Ranges and second opinions that the tests of maps share."""

from typing import Any

from problems.maps.loops import Where
from problems.maps.maps import MapAxis, MapRequest
from problems.maps.search import IntervalCase, IntervalRequest, StableInterval, find_stable_intervals
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Plant
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from tests.problems.axes import PERIOD_S, admittance, paper_plant

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
