"""The search looks over the whole uncertainty, and what it returns holds where nobody looked."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.tuning.scenario_exchange import WholeSet
from autotune.tuning.search import solve_design
from problems.design.evaluation import ExactEvaluation, build_scenarios
from problems.design.problem import DesignProblem, Requirements
from problems.design.uncertainty import Ellipsoid, PlantSet, Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant import WrenchFilter
from problems.model.robot import RobotModel
from tests.autotune.tuning.cases import FURTHER, fast_optimized, uncertain_optimized

# Requirements are held on many plants; between them a margin dips by less than this.
BETWEEN = 1e-3


def test_the_nominal_design_misses_somewhere_and_the_robust_one_nowhere() -> None:
    """Uniform draws of the whole box, which are none of the search's scenarios."""
    robust = uncertain_optimized().searches["x"]
    problem, rng = robust.problem, np.random.default_rng(17)
    nominal = solve_design(replace(problem, plants=problem.plants.only()))
    ranges = problem.plants.ranges
    draws = [Scenario(**{name: float(rng.uniform(*pair)) for name, pair in ranges.items()}) for _ in range(300)]
    prepared = build_scenarios(problem, draws)
    seen = prepared.evaluate_exactly(problem.controller(robust.design)).evaluation
    assert {name: value for name, value in seen.requirements.items() if value > 1.0 + BETWEEN} == {}
    assert seen.cost <= robust.evaluation.cost * (1.0 + 2e-3)
    flattered = prepared.evaluate_exactly(problem.controller(nominal.design)).evaluation
    assert max(flattered.requirements.values()) > 1.0 + 10.0 * BETWEEN
    # Safety costs: the same plants, more to hold.
    assert robust.evaluation.cost > nominal.evaluation.cost


def test_the_local_search_finds_what_lies_between_the_scenarios() -> None:
    """The largest miss that it returns is at least that of 300 random plants."""
    search = uncertain_optimized().searches["x"]
    problem, law = search.problem, search.problem.controller(search.design)
    found = WholeSet(problem).evaluate(law).evaluation
    others = build_scenarios(problem, problem.plants.samples(256, seed=99)).evaluate_exactly(law).evaluation
    for name in ("modulus_margin", "free_space_admittance"):
        assert found.requirements[name] >= others.requirements[name] * (1.0 - 1e-3)
    assert found.cost >= others.cost * (1.0 - 1e-3)


def _confidence_set(**known: tuple[float, float]) -> Ellipsoid:
    """Return the set of independent values with their deviations."""
    covariance = np.diag([std**2 for _, std in known.values()])
    centre = tuple(value for value, _ in known.values())
    return Ellipsoid(names=tuple(known), centre=centre, covariance=tuple(map(tuple, covariance.tolist())))


def lightly_damped() -> DesignProblem:
    """A cell of little drag, whose plants are those of a confidence set: none of them is a corner of its box."""
    return DesignProblem(
        plants=PlantSet.of(
            RobotModel(numerator=np.array([959.8]), denominator=np.array([1.0, 51.89, 959.8]), delay_s=4.66e-3),
            coupling_stiffness_n_per_m=4.354e5,
            coupling_damping_n_s_per_m=93.0,
            drag_n_s_per_m=38.5,
            environment_stiffness_n_per_m=(7.4e4, 1.16e5),
            payload_mass_kg=(10.9, 11.4),
            wrench_filter=WrenchFilter(time_constant_s=1e-3),
            further={
                "coupling_stiffness_n_per_m": (3.65e5, 5.06e5),
                "coupling_damping_n_s_per_m": (30.7, 157.0),
                "drag_n_s_per_m": (30.4, 46.7),
                "delay_s": (4.54e-3, 4.77e-3),
                "wrench_time_constant_s": (6.6e-4, 1.34e-3),
            },
            ellipsoid=_confidence_set(
                coupling_stiffness_n_per_m=(4.354e5, 2.2e4),
                coupling_damping_n_s_per_m=(93.0, 20.0),
                drag_n_s_per_m=(38.5, 2.6),
                delay_s=(4.66e-3, 3.8e-5),
            ),
        ),
        sample_time_s=2e-3,
        requirements=Requirements(
            modulus_margin=0.45, gain_margin_db=6.0, phase_margin_deg=30.0, free_space_admittance=None
        ),
    )


def test_a_margin_in_free_space_is_sought_between_the_samples_and_every_one_where_that_is_asked() -> None:
    problem, law = lightly_damped(), AdmittanceController(mass_kg=72.0, damping_n_s_per_m=6000.0, lead_s=0.03)
    whole = WholeSet(problem)
    drawn = build_scenarios(problem, problem.plants.samples(1024, seed=7)).evaluate_exactly(law)
    for every_margin in (False, True):
        found = whole.evaluate(law, climbs_objective=False, every_margin=every_margin)
        assert _least_free(found) <= 1.002 * _least_free(drawn)
    # Without a climb the samples are what is known, and they flatter.
    assert _least_free(whole.prepared.evaluate_exactly(law)) > 1.01 * _least_free(found)
    gains = [min(each.margins.gain_db for each in seen.margins) for seen in (found, drawn)]
    assert gains[0] <= gains[1] * 1.002


def stiffly_coupled() -> DesignProblem:
    """A cell of little drag: a law's modulus is small on the softest surface and on one in the middle of the range."""
    known = {
        "coupling_stiffness_n_per_m": (281602.7, 428.4),
        "coupling_damping_n_s_per_m": (104.03, 4.374),
        "drag_n_s_per_m": (22.034, 1.866),
        "delay_s": (2.03096e-3, 1.902e-5),
        "robot_bandwidth_hz": (4.59922, 0.035),
        "robot_damping_ratio": (0.948113, 5.43e-3),
    }
    return DesignProblem(
        plants=PlantSet.of(
            RobotModel(
                numerator=np.array([1734.555]), denominator=np.array([1.0, 78.974, 1734.555]), delay_s=2.03096e-3
            ),
            environment_stiffness_n_per_m=(6.84e4, 1.08e5),
            payload_mass_kg=(19.6, 20.5),
            further={
                "coupling_stiffness_n_per_m": (280080.0, 283130.0),
                "coupling_damping_n_s_per_m": (88.509, 119.56),
                "drag_n_s_per_m": (15.413, 28.655),
                "delay_s": (1.9634e-3, 2.0985e-3),
                "robot_bandwidth_hz": (4.475, 4.7235),
                "robot_damping_ratio": (0.92885, 0.96738),
            },
            ellipsoid=_confidence_set(**known),
            coupling_stiffness_n_per_m=known["coupling_stiffness_n_per_m"][0],
            coupling_damping_n_s_per_m=known["coupling_damping_n_s_per_m"][0],
            drag_n_s_per_m=known["drag_n_s_per_m"][0],
        ),
        sample_time_s=2e-3,
        requirements=Requirements(modulus_margin=0.5, free_space_admittance=None),
    )


def test_a_margin_in_contact_is_sought_on_the_softest_surface_too() -> None:
    """A margin has minima over K_e: no climb from the one on a stiffer surface comes to the other."""
    problem = stiffly_coupled()
    law = AdmittanceController(mass_kg=5.0, damping_n_s_per_m=1e4, lead_s=0.016, feedback_damping_s=0.03)
    found = WholeSet(problem).evaluate(law, climbs_objective=False)
    drawn = build_scenarios(problem, _on_the_surface(problem.plants, 512)).evaluate_exactly(law)
    least = [min(each.margins.modulus for each in seen.margins if not each.free_space) for seen in (found, drawn)]
    assert least[0] <= 1.0005 * least[1]


def _on_the_surface(plants: PlantSet, count: int) -> list[Scenario]:
    """Return points drawn on the surface of a confidence set, of the heaviest payload on the softest surface."""
    ellipsoid = plants.ellipsoid
    assert ellipsoid is not None
    directions = np.random.default_rng(3).normal(size=(count, len(ellipsoid.names)))
    directions *= np.sqrt(ellipsoid.quantile / np.sum(directions**2, axis=1, keepdims=True))
    points = np.array(ellipsoid.centre) + directions * np.sqrt(np.diag(np.array(ellipsoid.covariance)))
    soft, heavy = plants.environment_stiffness_n_per_m[0], plants.payload_mass_kg[1]
    return [
        Scenario(
            environment_stiffness_n_per_m=soft,
            payload_mass_kg=heavy,
            **dict(zip(ellipsoid.names, point.tolist(), strict=True)),
        )
        for point in points
    ]


def _least_free(exact: ExactEvaluation) -> float:
    return min(each.margins.modulus for each in exact.margins if each.free_space)


def test_the_whole_set_is_the_grid_alone_where_nothing_else_is_uncertain() -> None:
    problem = fast_optimized().searches["x"].problem
    assert WholeSet(problem).scenarios == problem.scenarios(33, 3)
    whole = WholeSet(uncertain_optimized().searches["x"].problem)
    assert all(whole.plants.contains(s) for s in whole.scenarios)
    assert {name for s in whole.scenarios for name in s.further()} == set(FURTHER)


def test_the_slowest_robot_is_the_one_that_moves_least_freely() -> None:
    whole = WholeSet(uncertain_optimized().searches["x"].problem)
    search = uncertain_optimized().searches["x"]
    (slowest,) = whole.worst_of(search.evaluation, ["free_space_admittance"], "robot")
    slow = build_scenarios(whole.problem, [slowest]).evaluate(search.design).requirements
    everything = whole.prepared.evaluate(search.design).requirements
    # The bands' points are the same for every robot without zeros.
    assert slow["free_space_admittance"] == pytest.approx(everything["free_space_admittance"], rel=1e-12)
