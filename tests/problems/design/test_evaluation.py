import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.design.evaluation import (
    Evaluation,
    PlantMargins,
    PreparedScenarios,
    build_scenarios,
)
from problems.design.objectives import BUILT_IN
from problems.design.problem import AdmittanceTarget, DesignProblem, NoiseLimit, PassivityTarget, Requirements
from problems.design.requirements import LoopRequirement, smallest_admittance
from problems.design.stable_design import StableDesign, StableLoop
from problems.errors import ParameterError
from problems.model.response import free_space_admittance
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.stability.margins import Margins, UnstableLoopError, find_margins
from problems.stability.noise import command_speed_gain
from problems.stability.passivity import prepare_port
from tests.problems.axes import PERIOD_S, paper_problem

GOOD = (15.0, 3000.0, 0.02, 0.0)
UNSTABLE = (10.0, 300.0, 0.0, 0.0)
EASY = Requirements(
    modulus_margin=0.4,
    gain_margin_db=4.0,
    phase_margin_deg=25.0,
    delay_margin_s=1e-3,
    decay_rate_per_s=0.1,
    free_space_admittance=AdmittanceTarget(min_m_s_per_n=1e-4, band_hz=(0.1, 2.0)),
)


def problem(**changes: Any) -> DesignProblem:
    return paper_problem(**{"approach": Approach(force_n=30.0), "requirements": EASY, **changes})


def prepared(**changes: Any) -> PreparedScenarios:
    asked = problem(**changes)
    return build_scenarios(asked, asked.scenarios(3, 2))


def margins(**changes: float) -> Margins:
    values = {
        "modulus": 0.5,
        "modulus_hz": 20.0,
        "disk": 0.6,
        "gain_db": 8.0,
        "phase_deg": 50.0,
        "delay_s": 4e-3,
        "spectral_radius": math.exp(-5.0 * PERIOD_S),
    }
    return Margins(**(values | changes))


def ratios_of(asked: Requirements, found: Margins) -> dict[str, float]:
    """Required/achieved of everything that is asked of a loop with these margins."""
    made = SimpleNamespace(margins=found, spectral_radius=found.spectral_radius, sample_time_s=PERIOD_S)
    loop = cast("StableLoop", made)
    return {
        requirement.name: requirement.ratio(value, requirement.of_loop(value, loop))
        for requirement, value in asked.of("loop")
        if isinstance(requirement, LoopRequirement)
    }


def margins_of(ready: PreparedScenarios, design: tuple[float, ...]) -> tuple[PlantMargins, ...]:
    return ready.evaluate_exactly(ready.problem.controller(design)).margins


def test_a_requirement_is_required_over_achieved() -> None:
    asked = Requirements(
        modulus_margin=0.4, gain_margin_db=6.0, phase_margin_deg=30.0, delay_margin_s=1e-3, decay_rate_per_s=10.0
    )
    # One quotient each; the decay rate also goes through a logarithm of nearly one, which costs three digits.
    assert ratios_of(asked, margins()) == pytest.approx(
        {
            "modulus_margin": 0.8,
            "gain_margin_db": 0.75,
            "phase_margin_deg": 0.6,
            "delay_margin_s": 0.25,
            "decay_rate_per_s": 2.0,
        },
        rel=1e-12,
    )


def test_a_margin_that_nothing_limits_is_met_and_one_of_zero_is_missed_altogether() -> None:
    asked = Requirements(modulus_margin=0.5, gain_margin_db=6.0, phase_margin_deg=30.0, delay_margin_s=None)
    found = ratios_of(asked, margins(gain_db=math.inf, phase_deg=0.0))
    assert found == {"modulus_margin": 1.0, "gain_margin_db": 0.0, "phase_margin_deg": math.inf}


def test_what_is_not_asked_is_not_reported() -> None:
    nothing = Requirements(
        modulus_margin=None,
        gain_margin_db=None,
        phase_margin_deg=None,
        delay_margin_s=None,
        free_space_admittance=None,
    )
    assert ratios_of(nothing, margins()) == {}
    ready = prepared(requirements=nothing)
    found = ready.evaluate(GOOD)
    assert found.requirements == {}
    assert found.is_feasible
    assert found.violation == 0.0


def test_the_admittance_requirement_is_the_smallest_over_the_band() -> None:
    ready = prepared()
    controller, band = ready.problem.controller(GOOD), (0.1, 2.0)
    omega = 2.0 * np.pi * np.geomspace(*band, 5000)
    dense = float(np.min(np.abs(free_space_admittance(ready.free[0], controller, omega))))
    found = smallest_admittance(ready.free[0], controller, band)
    # |G| is smooth below the first corner, and its minimum lies on an end of the band, which the grid holds.
    assert found == pytest.approx(dense, rel=1e-9)
    requirement = ready.evaluate(GOOD, peaks_if_missed=True).requirements["free_space_admittance"]
    assert requirement == pytest.approx(1e-4 / dense, rel=1e-9)


@pytest.mark.parametrize("hertz", [0.3, 1.03, 1.77])
def test_a_robot_that_hardly_moves_at_one_frequency_is_seen_to(hertz: float) -> None:
    """A zero with a damping ratio of 1 %: |G| dips over a hundredth of the frequency, between any even points."""
    zero = 2.0 * math.pi * hertz
    pair = np.array([1.0 / zero**2, 0.02 / zero, 1.0])
    robot = RobotModel(
        numerator=pair,
        denominator=np.convolve([1.0 / zero**2, 1.4 / zero, 1.0], [1.0 / 20.0, 1.0]),
        delay_s=2.4e-3,
    )
    ready, band = prepared(robot=robot), (0.1, 2.0)
    controller = ready.problem.controller(GOOD)
    omega = 2.0 * np.pi * np.linspace(*band, 40_001)
    dense = float(np.min(np.abs(free_space_admittance(ready.free[0], controller, omega))))
    # The deepest point is up to the damping ratio squared beside the zero, where the dip is as wide as the ratio.
    assert smallest_admittance(ready.free[0], controller, band) == pytest.approx(dense, rel=1e-3)
    ((requirement, target),) = ready.problem.requirements.of("robot")
    found = float(requirement.ratios(target, StableDesign(ready, controller))[0])
    assert found == pytest.approx(1e-4 / dense, rel=1e-3)


def test_every_scenario_is_evaluated_in_contact_and_in_free_space() -> None:
    ready = prepared()
    assert len(ready.scenarios) == len(ready.pairs) == 6
    assert [plant.plant.payload.mass_kg for plant in ready.free] == [8.0, 16.0]
    controller = ready.problem.controller(GOOD)
    sides = [*(pair.contact for pair in ready.pairs), *ready.free]
    found = ready.evaluate(GOOD)
    # The same matrices, their eigenvalues taken one by one or in a batch.
    assert found.spectral_radius == pytest.approx(
        max(spectral_radius(build_loop(side, controller)) for side in sides), abs=1e-12
    )
    exact, one_by_one = ready.evaluate_exactly(controller), [find_margins(side, controller) for side in sides]
    assert [each.margins for each in exact.margins] == one_by_one
    assert [(each.payload_mass_kg, each.environment_stiffness_n_per_m) for each in exact.margins] == [
        (side.plant.payload.mass_kg, side.plant.environment.stiffness_n_per_m) for side in sides
    ]
    worst = min(each.modulus for each in one_by_one)
    assert exact.evaluation.requirements["modulus_margin"] == pytest.approx(0.4 / worst, rel=1e-14)


@pytest.mark.parametrize("design", [GOOD, (13.0, 1500.0, 0.02, 7.5e-3)])
def test_an_evaluation_has_the_requirements_of_the_margins_plant_by_plant(
    design: tuple[float, float, float, float],
) -> None:
    ready = prepared(requirements=replace(EASY, modulus_margin=0.2, gain_margin_db=2.0, phase_margin_deg=15.0))
    fast, exact = ready.evaluate(design), ready.evaluate_exactly(ready.problem.controller(design)).evaluation
    assert (
        set(fast.requirements)
        == set(exact.requirements)
        == {
            "modulus_margin",
            "gain_margin_db",
            "phase_margin_deg",
            "delay_margin_s",
            "decay_rate_per_s",
            "free_space_admittance",
        }
    )
    assert dict(fast.requirements) == dict(exact.requirements)
    worst = {
        name: max(ratios_of(ready.problem.requirements, each.margins)[name] for each in margins_of(ready, design))
        for name in exact.requirements
        if name != "free_space_admittance"
    }
    assert {name: exact.requirements[name] for name in worst} == worst
    assert [peak.scenario for peak in fast.peaks] == list(ready.scenarios)
    assert fast.peaks == exact.peaks
    assert fast.cost == exact.cost
    assert fast.is_feasible
    assert exact.is_feasible


def test_the_peaks_are_those_of_a_single_simulation() -> None:
    ready = prepared()
    found = ready.evaluate(GOOD)
    for scenario, peak in zip(ready.scenarios, found.peaks, strict=True):
        pair = build_sampled_contact(build_sampled_plant(ready.problem.plant(scenario), PERIOD_S))
        run = simulate_contact(pair, ready.problem.controller(GOOD), ready.problem.approach)
        assert peak.peak_contact_force_n == run.peak_contact_force_n
        assert peak.peak_sensor_force_n == run.peak_sensor_force_n
        assert peak.time_of_peak_s == run.time_of_peak_s


@pytest.mark.parametrize("name", ["contact", "sensor"])
def test_the_objective_is_the_worst_peak_of_the_force_that_was_asked(name: str) -> None:
    found = prepared(objective=BUILT_IN[f"{name}_force"]).evaluate(GOOD)
    assert found.cost == max(getattr(peak, f"peak_{name}_force_n") for peak in found.peaks)


def test_an_unstable_design_has_neither_peaks_nor_requirements() -> None:
    ready = prepared()
    found = ready.evaluate(UNSTABLE)
    assert found.spectral_radius > 1.0
    assert (dict(found.requirements), found.peaks, found.cost) == ({}, (), math.inf)
    assert (found.is_stable, found.is_feasible, found.violation) == (False, False, math.inf)
    with pytest.raises(UnstableLoopError):
        ready.evaluate_exactly(ready.problem.controller(UNSTABLE))


def test_one_unstable_scenario_makes_the_design_unstable() -> None:
    """Stable on the soft wall, unstable on the stiff one (docs/method.md, erratum 4)."""
    design = (10.0, 1000.0, 0.0, 0.0)
    soft = prepared(environment_stiffness_n_per_m=(2e4, 2e4), payload_mass_kg=(16.0, 16.0))
    both = prepared(environment_stiffness_n_per_m=(2e4, 5e5), payload_mass_kg=(16.0, 16.0))
    assert soft.evaluate(design).is_stable
    assert not both.evaluate(design).is_stable


def test_free_space_alone_can_make_a_design_unstable() -> None:
    ready = prepared(drag_n_s_per_m=300.0, environment_stiffness_n_per_m=(1e5, 1e5), payload_mass_kg=(16.0, 16.0))
    design = (10.0, 1000.0, 0.0, 0.0)
    radii = [
        spectral_radius(build_loop(side, ready.problem.controller(design)))
        for side in (ready.pairs[0].contact, ready.free[0])
    ]
    assert radii[0] < 1.0 < radii[1]
    assert ready.evaluate(design).spectral_radius == pytest.approx(radii[1], abs=1e-12)


def test_free_space_alone_can_hold_the_margin_down() -> None:
    ready = prepared(drag_n_s_per_m=300.0, environment_stiffness_n_per_m=(1e5, 1e5), payload_mass_kg=(16.0, 16.0))
    design = (10.0, 2000.0, 0.0, 0.0)
    controller = ready.problem.controller(design)
    contact, free = (find_margins(side, controller).modulus for side in (ready.pairs[0].contact, ready.free[0]))
    assert free < 0.5 * contact
    # One quotient, and back.
    assert 0.4 / ready.evaluate(design).requirements["modulus_margin"] == pytest.approx(free, rel=1e-14)


def test_a_missed_margin_gives_no_peak_unless_it_is_asked_for() -> None:
    ready = prepared(requirements=Requirements(phase_margin_deg=89.0, free_space_admittance=None))
    found = ready.evaluate(GOOD)
    assert found.is_stable
    assert not found.is_feasible
    assert found.violation == max(found.requirements.values()) - 1.0 > 0.0
    assert (found.peaks, found.cost) == ((), math.inf)
    asked = ready.evaluate(GOOD, peaks_if_missed=True)
    assert asked.requirements == found.requirements
    assert not asked.is_feasible
    # The peaks do not depend on what is required.
    assert asked.cost == prepared().evaluate(GOOD).cost
    assert ready.evaluate(UNSTABLE, peaks_if_missed=True).peaks == ()


@pytest.mark.parametrize(("limit", "feasible"), [(1.001, True), (0.999, False)])
def test_a_limit_on_the_peak_is_a_requirement(limit: float, feasible: bool) -> None:
    unlimited = prepared().evaluate(GOOD)
    asked = Requirements(
        modulus_margin=0.4,
        gain_margin_db=4.0,
        phase_margin_deg=25.0,
        max_peak_force_n=limit * unlimited.cost,
        free_space_admittance=None,
    )
    found = prepared(requirements=asked).evaluate(GOOD)
    # One product and one quotient.
    assert found.requirements["max_peak_force_n"] == pytest.approx(1.0 / limit, rel=1e-14)
    assert found.is_feasible is feasible
    assert found.cost == unlimited.cost


def test_more_scenarios_are_never_better() -> None:
    asked = problem()
    few, many = (build_scenarios(asked, asked.scenarios(n, n)).evaluate(GOOD) for n in (2, 3))
    # The ends and the middle of the finer grid contain the coarser one.
    assert many.cost >= few.cost
    assert all(many.requirements[name] >= value * (1.0 - 1e-12) for name, value in few.requirements.items())


def test_violation_is_the_excess_of_the_worst_requirement() -> None:
    base = prepared().evaluate(GOOD)
    missed = Evaluation(controller=base.controller, spectral_radius=0.9, requirements={"a": 0.5, "b": 1.25}, peaks=())
    assert missed.violation == 0.25


# --- the command's noise, passivity, and what need not be met -----------------------------------------------------

COMMANDED = replace(
    EASY,
    command_noise=NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.2),
    passivity=PassivityTarget(passive_below_hz=5.0),
)


def test_the_command_noise_is_that_of_the_noisiest_plant() -> None:
    ready = prepared(requirements=COMMANDED)
    law = ready.problem.controller(GOOD)
    worst = max(0.2 * command_speed_gain(plant.sampled, law) for plant in ready.plants)
    assert ready.evaluate(GOOD).requirements["command_noise"] == pytest.approx(worst / 1e-3, rel=1e-12)


def test_passivity_is_asked_of_the_port() -> None:
    ready = prepared(requirements=COMMANDED)
    fails = prepare_port(ready.free[0]).fails_above_hz(ready.problem.controller(GOOD))
    assert fails is not None
    assert ready.evaluate(GOOD).requirements["passivity"] == pytest.approx(5.0 / fails, rel=1e-12)
    assert len(ready.robots) == 1


def test_noise_without_a_number_and_a_band_beyond_the_sampling_are_refused() -> None:
    with pytest.raises(ParameterError, match="force_noise_rms_n"):
        problem(requirements=replace(EASY, command_noise=NoiseLimit(max_speed_rms_m_s=1e-3)))
    with pytest.raises(ParameterError, match="below half the sampling rate"):
        problem(requirements=replace(EASY, passivity=PassivityTarget(passive_below_hz=0.5 / PERIOD_S)))


def test_a_soft_requirement_decides_nothing_and_costs_its_share() -> None:
    asked = replace(EASY, modulus_margin=0.9)
    hard, soft = prepared(requirements=asked), prepared(requirements=replace(asked, soft_n={"modulus_margin": 20.0}))
    missed = hard.evaluate(GOOD, peaks_if_missed=True)
    found = soft.evaluate(GOOD)
    assert not missed.is_feasible
    assert found.is_feasible
    assert found.soft == {"modulus_margin": missed.requirements["modulus_margin"]}
    assert found.objective_cost == pytest.approx(missed.cost, rel=1e-14)
    assert found.penalty_n == pytest.approx(20.0 * (missed.requirements["modulus_margin"] - 1.0), rel=1e-14)
    assert found.cost == pytest.approx(found.objective_cost + found.penalty_n, rel=1e-14)


def test_a_soft_requirement_that_is_met_costs_nothing() -> None:
    ready = prepared(requirements=replace(EASY, soft_n=dict.fromkeys(EASY.asked(), 20.0)))
    found = ready.evaluate(GOOD)
    assert found.requirements == {}
    assert set(found.soft) == set(EASY.asked())
    assert (found.penalty_n, found.cost) == (0.0, found.objective_cost)


def test_stability_is_never_soft() -> None:
    ready = prepared(requirements=replace(EASY, soft_n=dict.fromkeys(EASY.asked(), 1.0)))
    assert not ready.evaluate(UNSTABLE).is_feasible
    assert ready.evaluate(UNSTABLE).cost == math.inf


def test_two_halves_of_a_set_cost_what_the_whole_does() -> None:
    """The peak is the larger one and a price is paid once, for the worst scenario of both."""
    asked = problem(
        requirements=replace(
            EASY, modulus_margin=0.9, max_peak_force_n=20.0, soft_n={"modulus_margin": 20.0, "max_peak_force_n": 3.0}
        )
    )
    scenarios = asked.scenarios(3, 2)
    law = asked.controller(GOOD)
    parts = [build_scenarios(asked, part).evaluate_exactly(law) for part in (scenarios[:3], scenarios[3:])]
    whole = build_scenarios(asked, scenarios).evaluate_exactly(law).evaluation
    both = parts[0].together_with(parts[1]).evaluation
    assert both.cost == pytest.approx(whole.cost, rel=1e-12)
    assert dict(both.soft) == pytest.approx(dict(whole.soft), rel=1e-12)
    assert both.penalty_n == pytest.approx(whole.penalty_n, rel=1e-12)
