"""Designs for a payload that touches with a bumper."""

from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.controller_record import admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.tuning.optimize import optimize
from autotune.tuning.problems import build_problems
from autotune.tuning.search import solve_design
from autotune.tuning.soft_payload import SoftPayload
from autotune.validation.validate import validate_controller
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.problem import NoiseLimit, Requirements
from problems.model.controller import AdmittanceController
from problems.model.plant import Bumper, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from problems.stability.noise import command_speed_gain
from tests.autotune.tuning.cases import FAST_SPEC, ROOM, design_problem, fast_optimized, identified_plant

BUMPER = Bumper(mass_kg=0.5, stiffness_n_per_m=1e5, damping_n_s_per_m=50.0)
# One that takes some of the modulus of a design for one mass.
HEAVY = Bumper(mass_kg=6.0, stiffness_n_per_m=1e4, damping_n_s_per_m=24.0)


def soft_plants(bumper: Bumper) -> list[Plant]:
    plants = design_problem().plants
    soft = replace(plants, nominal=replace(plants.nominal, bumper=bumper))
    return [soft.at(mass, wall) for mass in (15.5, 16.0, 16.5) for wall in (0.0, 8e4, 1e5, 1.6e5)]


def largest_gain(law: AdmittanceController) -> float:
    return max(command_speed_gain(build_sampled_plant(each, 8e-4), law) for each in soft_plants(HEAVY))


def test_a_design_that_misses_something_with_the_bumper_is_searched_again() -> None:
    """The command is allowed a hair less noise than the bumper makes of the design for one mass."""
    problem = design_problem()
    first = solve_design(problem)
    noise = NoiseLimit(max_speed_rms_m_s=0.998 * largest_gain(problem.controller(first.design)), force_noise_rms_n=1.0)
    limited = replace(problem, requirements=replace(problem.requirements, command_noise=noise))
    soft, before = SoftPayload(HEAVY, {"x": limited}, seed=0), replace(first, problem=limited)
    found = soft.searched("x", before)
    assert found is not before
    better = limited.controller(found.design)
    assert largest_gain(better) <= noise.max_speed_rms_m_s * (1.0 + 1e-6)
    for each in soft_plants(HEAVY):
        sampled = build_sampled_plant(each, 8e-4)
        assert find_margins(sampled, better).modulus >= 0.5 * (1.0 - 1e-3)
        if each.environment.stiffness_n_per_m > 0.0:
            assert simulate_contact(build_sampled_contact(sampled), better, problem.approach).is_settled
    (note,) = soft.notes({"x": found})
    assert "with a bumper of 6 kg on 10 N/mm and 24 N·s/m it misses command_noise" in note
    assert soft.searched("x", found) is found


def test_the_file_states_what_holds_with_the_bumper_and_validation_repeats_it() -> None:
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    found = optimize(plant, replace(FAST_SPEC, bumper=BUMPER), seed=1)
    record = found.controller.certificate.bumper
    assert record is not None
    assert record.bumper == BUMPER
    law = admittance_controller(found.controller, "x")
    domain = found.controller.certificate.domain["x"]
    plants = [replace(each.plant(domain.plants.nominal), bumper=BUMPER) for each in domain.plants.corners()]
    moduli = [find_margins(build_sampled_plant(each, 8e-4), law).modulus for each in plants]
    assert record.axes["x"].modulus <= min(moduli)
    assert record.axes["x"].share == 1.0
    checks = [each for each in validate_controller(found.controller).checks if each.name == "bumper"]
    assert len(checks) == 2
    assert all(each.passed for each in checks)
    assert fast_optimized().controller.axes == found.controller.axes


@pytest.mark.parametrize(
    ("bumper", "said"),
    [
        (Bumper(mass_kg=15.5, stiffness_n_per_m=1e5), r"below the 15\.5 kg of the lightest"),
        (Bumper(mass_kg=1e-6, stiffness_n_per_m=1e9), "cannot be followed on the surfaces of axis x"),
    ],
)
def test_one_that_is_no_part_of_the_payload_is_refused(bumper: Bumper, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        SoftPayload(bumper, {"x": design_problem()}, seed=0)


def test_axes_that_turn_have_none_and_other_commands_refuse_it() -> None:
    with pytest.raises(UsageError, match="only axes that turn are tuned"):
        SoftPayload(BUMPER, {"rx": design_problem()}, seed=0)
    with pytest.raises(UsageError, match="validate --bumper"):
        build_problems(identified_plant(), replace(FAST_SPEC, bumper=BUMPER))


def test_one_that_swings_for_ever_is_refused_soon() -> None:
    problem = design_problem(bounds={**ROOM, "mass": (6.0, 6.0)}, requirements=Requirements())
    soft = SoftPayload(Bumper(mass_kg=3.0, stiffness_n_per_m=2e4), {"x": problem}, seed=0)
    with pytest.raises(InfeasibleError, match=r"with a bumper of 3 kg on 20 N/mm .* does not come to rest"):
        soft.searched("x", solve_design(problem))
