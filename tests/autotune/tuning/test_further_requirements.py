"""Requirements that are no field of `Requirements`: searched, certified, validated and priced like the built-in."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from autotune.formats.controller_record import Controller
from autotune.formats.identified import IdentifiedFile
from autotune.studies.objectives import PassiveBand
from autotune.tuning.optimality import near_keys, row_at
from autotune.tuning.optimize import Optimized, optimize
from autotune.tuning.search import solve_design
from autotune.validation.validate import validate_controller
from problems.design.evaluation import build_scenarios
from problems.design.requirements import Requirements
from tests.autotune.tuning.cases import FAST_REQUIREMENTS, FAST_SPEC, design_problem, identified_plant

ASKED = {"min_damping_ratio": 0.15, "passive_band": 1.0}


@cache
def optimized() -> Optimized:
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    asked = replace(FAST_REQUIREMENTS, further=ASKED, plugins=(PassiveBand(),))
    return optimize(plant, replace(FAST_SPEC, requirements=asked), seed=1)


def claiming(name: str, value: float) -> Controller:
    controller = optimized().controller
    certificate = controller.certificate
    return replace(controller, certificate=replace(certificate, requirements={**certificate.requirements, name: value}))


def test_a_plain_search_meets_them_and_its_controller_is_certified_and_validated_for_them() -> None:
    found = optimized()
    assert ASKED.items() <= dict(found.controller.certificate.requirements).items()
    assert {"min_damping_ratio", "passive_band"} <= set(found.searches["x"].evaluation.requirements)
    assert found.searches["x"].evaluation.is_feasible
    verdicts = {check.name: check.passed for check in found.report.checks}
    assert verdicts["damping ratio"]
    assert verdicts["passive band"]


@pytest.mark.parametrize(
    ("name", "value", "check"),
    [
        ("min_damping_ratio", 0.25, "damping ratio"),
        ("passive_band", 1e-3, "passive band"),
        ("of_another_machine", 1.0, "requirements"),
    ],
)
def test_a_claim_that_is_false_or_cannot_be_verified_does_not_pass(name: str, value: float, check: str) -> None:
    failed = {each.name: each.message for each in validate_controller(claiming(name, value)).checks if not each.passed}
    assert set(failed) == {check}
    assert (f"{value:g}" if check != "requirements" else "no requirement of that name") in failed[check]


def test_it_shapes_the_design_and_its_gradient_is_that_of_central_differences() -> None:
    asked = Requirements(free_space_admittance=None, further={"min_damping_ratio": 0.2})
    found = solve_design(design_problem(requirements=asked), seed=1)
    ratio = found.evaluation.requirements["min_damping_ratio"]
    # What was asked for is used up to the reserve of the search, or something else holds the peak.
    assert ratio <= 1.0
    problem = design_problem(requirements=replace(asked, further={"min_damping_ratio": 0.2 * ratio}))
    prepared = build_scenarios(problem, found.active.scenarios)
    keys = [key for key in near_keys(prepared, found.design, 0.5) if key[0] == "min_damping_ratio"]
    row = row_at(prepared, found.design, keys[0])
    assert not row.is_exact
    # Along the damping, whose logarithm is the variable; a step ten times that of the row.
    step = np.array([0.0, 1e-4 * found.design[1], 0.0, 0.0])
    ends = [row_at(prepared, found.design + sign * step, keys[0]).value for sign in (1.0, -1.0)]
    # Central differences of two steps differ by their square times a third derivative of order one.
    assert (ends[0] - ends[1]) / 2e-4 == pytest.approx(row.gradient[1], rel=1e-4, abs=1e-6)
