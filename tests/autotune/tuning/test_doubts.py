"""Ranges of problem.yaml that leave out what was identified."""

from dataclasses import replace

import pytest

from autotune.tuning.doubts import doubtful_ranges
from problems.design import DesignProblem
from tests.autotune.tuning.cases import design_problem, identified_axis, known


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
