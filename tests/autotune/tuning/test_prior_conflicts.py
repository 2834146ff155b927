"""Ranges of problem.yaml that leave out what was identified."""

from dataclasses import replace

import pytest

from autotune.tuning.prior_conflicts import doubtful_ranges, left_out_contacts
from identification.result import CONTACT_UNEXPLAINED, Finding
from problems.design.problem import DesignProblem
from tests.autotune.tuning.cases import design_problem, identified_axis, identified_plant, known, with_axis


def delayed(low: float, high: float) -> DesignProblem:
    """As `optimize` builds it: the nominal value moves into the range that was said."""
    problem = design_problem()
    nominal = replace(problem.robot, delay_s=min(max(problem.robot.delay_s, low), high))
    return replace(problem, robot=nominal, uncertain={"delay_s": (low, high)})


@pytest.mark.parametrize(
    ("interval", "told"),
    [
        ((0.0, 0.0), "delay_s in problem.yaml, 0, lies 1200 deviations off what was identified, 0.0024 ± 2e-06;"),
        ((2.5e-3, 3e-3), "delay_s in problem.yaml, 0.0025 to 0.003, lies 50 deviations off"),
        ((2.409e-3, 3e-3), ""),
        ((2.0e-3, 3e-3), ""),
    ],
)
def test_a_range_far_from_what_was_identified_is_told(interval: tuple[float, float], told: str) -> None:
    axis = identified_axis()
    axis = replace(axis, robot=replace(axis.robot, delay_s=known(2.4e-3, 2e-6)))
    found = list(doubtful_ranges(delayed(*interval), axis, "x"))
    assert [line.startswith(f"axis x: {told}") for line in found] == ([True] if told else [])


def test_what_is_known_without_deviation_or_not_at_all_is_no_doubt() -> None:
    problem = delayed(0.0, 0.0)
    for delay in (known(2.4e-3, 0.0), replace(known(2.4e-3), value=None, std=None)):
        axis = replace(identified_axis(), robot=replace(identified_axis().robot, delay_s=delay))
        assert list(doubtful_ranges(problem, axis, "x")) == []


def test_a_contact_that_a_said_range_leaves_out_is_stated() -> None:
    axis = identified_axis()
    stiff = replace(axis.environments[0], name="x2", stiffness_n_per_m=known(2e5, 1e4), peak_force_n=(75.7,))
    plant = with_axis(replace(axis, environments=(stiff,)))
    narrow = replace(design_problem(), environment_stiffness_n_per_m=(2e4, 5e4))
    (line,) = left_out_contacts(narrow, plant, "x")
    assert line.startswith("axis x: surface x2, touched with up to 75.7 N in the log, has K_e = 2e+05 N/m")
    wide = replace(narrow, environment_stiffness_n_per_m=(2e4, 5e5))
    assert list(left_out_contacts(wide, plant, "x")) == []


def test_a_contact_of_unknown_stiffness_is_stated_beside_any_range() -> None:
    message = "Axis x: what was touched at 52.7 s (75.7 N) is none of the surfaces."
    finding = Finding(code=CONTACT_UNEXPLAINED, severity="error", message=message, advice="", axis="x")
    plant = replace(identified_plant(), findings=(finding,))
    wide = replace(design_problem(), environment_stiffness_n_per_m=(2e4, 5e5))
    (line,) = left_out_contacts(wide, plant, "x")
    assert line.startswith(message)
    assert "20000 to 500000 N/m" in line
