"""What is kept of many points: nothing that is beaten, and the ends when there are too many."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autotune.studies.plugins import Objective
from autotune.studies.points import Judge, Judgement, design_of, thinned, undominated
from problems.design.objectives import Admittance, PeakForce
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.stability.margins import UnstableLoopError
from tests.autotune.studies.small import START, small_problem

OBJECTIVES = (PeakForce(), Admittance())
NUMBERS = st.integers(0, 6).map(float)


@st.composite
def judgements(draw: st.DrawFn) -> list[Judgement]:
    reported = draw(st.lists(st.tuples(NUMBERS, NUMBERS, st.sampled_from([0.5, 1.0, 1.5])), max_size=25))
    return [
        Judgement(
            controller=AdmittanceController(mass_kg=10.0 + i, damping_n_s_per_m=1000.0),
            values={"peak_force": peak, "admittance": free},
            requirements={"any": missed},
        )
        for i, (peak, free, missed) in enumerate(reported)
    ]


def beats(one: Judgement, other: Judgement) -> bool:
    better = (
        one.values["peak_force"] - other.values["peak_force"],
        other.values["admittance"] - one.values["admittance"],
    )
    return max(better) <= 0.0 and min(better) < 0.0


@given(judgements())
def test_what_is_kept_is_feasible_and_unbeaten_and_what_is_not_is_one_of_three(points: list[Judgement]) -> None:
    kept = undominated(points, OBJECTIVES)
    for point in points:
        beaten = any(other.is_feasible and beats(other, point) for other in points)
        same = any(other is not point and other.values == point.values for other in kept)
        stays = any(point is other for other in kept)
        assert stays or beaten or same or not point.is_feasible
        assert not (stays and (beaten or same or not point.is_feasible))
    assert [p.values["peak_force"] for p in kept] == sorted(p.values["peak_force"] for p in kept)


@given(judgements(), st.integers(2, 8))
def test_a_thinned_front_keeps_its_ends_and_its_order(points: list[Judgement], count: int) -> None:
    kept = undominated(points, OBJECTIVES)
    fewer = thinned(kept, OBJECTIVES, count, None)
    assert len(fewer) == min(count, len(kept))
    assert [p for p in kept if p in fewer] == list(fewer)
    if kept:
        assert (fewer[0], fewer[-1]) == (kept[0], kept[-1])
        assert kept[len(kept) // 2] in thinned(kept, OBJECTIVES, 3, len(kept) // 2)


class Broken(Objective):
    name, unit, direction = "broken", "1", "minimize"

    def __init__(self, outcome: Any) -> None:
        self.outcome = outcome

    def __call__(self, *_: Any) -> float:
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return float(self.outcome)


def test_an_objective_that_fails_or_is_no_number_is_named() -> None:
    law = small_problem().controller(START)
    with pytest.raises(ParameterError, match=r"objective broken .*ZeroDivisionError"):
        Judge(small_problem(), (Broken(ZeroDivisionError("x")),)).judge(law)
    with pytest.raises(ParameterError, match="objective broken"):
        Judge(small_problem(), (Broken(float("nan")),)).judge(law)


def test_an_unstable_controller_is_not_judged() -> None:
    with pytest.raises(UnstableLoopError):
        Judge(small_problem(), OBJECTIVES).judge(AdmittanceController(mass_kg=6.0, damping_n_s_per_m=300.0))


def test_a_design_is_found_again_in_its_controller() -> None:
    problem = small_problem()
    np.testing.assert_array_equal(design_of(problem, problem.controller(START)), START)
