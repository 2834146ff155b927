"""Requirements as values: what is soft, what it costs, what was achieved, and asking for less."""

import copy
import math
import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from problems.design.evaluation import build_scenarios
from problems.design.requirements import (
    BUILT_IN,
    FIELDS,
    LARGEST_SHARE,
    AdmittanceTarget,
    MultiplicativeError,
    NoiseLimit,
    PassivityTarget,
    Requirements,
    RequirementValue,
)
from problems.errors import ParameterError
from tests.autotune.tuning.cases import design_problem
from tests.problems.axes import LAW

EVERYTHING = Requirements(
    decay_rate_per_s=2.0,
    max_peak_force_n=80.0,
    command_noise=NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=0.2),
    passivity=PassivityTarget(passive_below_hz=12.0),
    multiplicative_error=MultiplicativeError(min_modulus=0.4, points=((5.0, 0.2),)),
)
GOOD = np.array([6.0, 1500.0, 0.02, 0.005])
UPPER = ("max_peak_force_n", "command_noise")


def test_what_is_asked_is_reported_by_name() -> None:
    assert tuple(EVERYTHING.asked()) == FIELDS
    assert "passivity" not in Requirements().asked()


@pytest.mark.parametrize(
    ("soft", "must"),
    [
        ({"stability": 1.0}, "given for modulus_margin"),
        ({"modulus": 1.0}, "found 'modulus'; modulus_margin may be meant"),
        ({"passivity": 1.0}, "together with what is asked"),
        ({"modulus_margin": 0.0}, "above 0"),
        ({"modulus_margin": math.inf}, "above 0"),
        ({"modulus_margin": 1e7}, "at most 1e\\+06 N"),
    ],
)
def test_a_price_that_means_nothing_is_refused(soft: dict[str, float], must: str) -> None:
    with pytest.raises(ParameterError, match=must):
        Requirements(soft_n=soft)


@pytest.mark.parametrize(
    "make",
    [
        lambda: NoiseLimit(max_speed_rms_m_s=0.0),
        lambda: NoiseLimit(max_speed_rms_m_s=1e-3, force_noise_rms_n=-1.0),
        lambda: PassivityTarget(passive_below_hz=0.0),
    ],
)
def test_limits_are_numbers_above_zero(make: Any) -> None:
    with pytest.raises(ParameterError):
        make()


def test_missing_by_a_share_costs_that_share_of_the_price() -> None:
    asked = Requirements(soft_n={"modulus_margin": 20.0})
    assert asked.cost_n("modulus_margin", 0.9) == 0.0
    assert asked.cost_n("modulus_margin", 1.25) == pytest.approx(5.0, rel=1e-15)
    # However far away, a cost stays a number, so that the search can order what misses it.
    assert asked.cost_n("modulus_margin", math.inf) == asked.cost_n("modulus_margin", math.nan) == 20.0 * LARGEST_SHARE


def test_hard_and_soft_are_distinguished() -> None:
    asked = Requirements(soft_n={"modulus_margin": 20.0})
    assert asked.split({"modulus_margin": 1.2, "gain_margin_db": 0.9}) == (
        {"gain_margin_db": 0.9},
        {"modulus_margin": 1.2},
    )


def ratio_at(name: str, asked: RequirementValue, reached: float) -> float:
    """Required/achieved by its definition: above 1 is missed."""
    threshold = BUILT_IN[name].threshold(asked)
    return reached / threshold if name in UPPER else threshold / reached


@LAW
@given(name=st.sampled_from(FIELDS), ratio=st.floats(1e-3, 1e3))
def test_what_is_achieved_has_that_ratio(name: str, ratio: float) -> None:
    # What is left beside an error may be below 0: beyond 4 its ratio is another one (test_multiplicative_error).
    assume(name != "multiplicative_error" or ratio <= 4.0)
    asked = EVERYTHING.asked()[name]
    assert ratio_at(name, asked, BUILT_IN[name].achieved_at(asked, ratio)) == pytest.approx(ratio, rel=1e-12)


def test_a_margin_without_limit_is_infinite_and_no_noise_is_none() -> None:
    assert BUILT_IN["gain_margin_db"].achieved_at(6.0, 0.0) == math.inf
    assert BUILT_IN["command_noise"].achieved_at(EVERYTHING.command_noise, 0.0) == 0.0


@LAW
@given(name=st.sampled_from(FIELDS), share=st.floats(1e-6, 0.5))
def test_easing_asks_for_less_of_one_and_leaves_the_others(name: str, share: float) -> None:
    less = EVERYTHING.relaxed(name, share)
    before, after = EVERYTHING.asked(), less.asked()
    # At what the first asked for, the eased one is met with something left.
    assert ratio_at(name, after[name], EVERYTHING.threshold(name)) < 1.0
    assert {key: value for key, value in after.items() if key != name} == {
        key: value for key, value in before.items() if key != name
    }


def test_noise_is_counted_by_the_speed_that_it_makes() -> None:
    limit = NoiseLimit(max_speed_rms_m_s=2e-3, force_noise_rms_n=0.5)
    assert limit.speed_rms_m_s(4e-3) == pytest.approx(2e-3, rel=1e-15)


@LAW
@given(name=st.sampled_from(FIELDS), factor=st.floats(1e-3, 0.99))
def test_a_threshold_can_be_taken_out_and_put_back(name: str, factor: float) -> None:
    requirement, asked = BUILT_IN[name], EVERYTHING.asked()[name]
    changed = requirement.with_threshold(asked, factor * requirement.threshold(asked))
    assert requirement.threshold(changed) == factor * requirement.threshold(asked)
    assert requirement.with_threshold(changed, requirement.threshold(asked)) == asked
    # What is achieved at the threshold meets it exactly.
    assert requirement.ratio(asked, requirement.threshold(asked)) == 1.0


def test_every_registered_requirement_is_an_argument_by_its_name() -> None:
    for name in ("free_space_admittance", "command_noise", "passivity"):
        with pytest.raises(ParameterError, match=f"{name} must be of the type"):
            Requirements(**{name: 3})  # type: ignore[arg-type]
    asked = Requirements(modulus_margin=0.6, min_damping_ratio=0.2)
    assert asked == Requirements(modulus_margin=0.6, further={"min_damping_ratio": 0.2})
    assert asked.asked()["min_damping_ratio"] == 0.2
    assert eval(repr(asked), {"Requirements": Requirements}) == asked
    assert pickle.loads(pickle.dumps(asked)) == copy.deepcopy(asked) == asked
    assert replace(asked, min_damping_ratio=0.3).further == {"min_damping_ratio": 0.3}  # type: ignore[call-arg]
    assert replace(asked, modulus_margin=0.7).further == asked.further
    assert not Requirements(min_damping_ratio=None).further
    with pytest.raises(ParameterError, match=r"must be one of modulus_margin, .*; min_damping_ratio may be meant\."):
        Requirements(min_dampin=0.2)


@pytest.mark.parametrize("name", FIELDS)
def test_the_worst_scenario_alone_is_as_bad_as_all(name: str) -> None:
    requirement, asked, problem = BUILT_IN[name], getattr(EVERYTHING, name), design_problem()
    design = build_scenarios(problem, problem.scenarios(2, 2)).stable(problem.controller(GOOD))
    worst = requirement.worst_scenario(asked, design)
    alone = build_scenarios(problem, [worst]).stable(design.controller)
    found = np.max(requirement.ratios(asked, design))
    assert np.max(requirement.ratios(asked, alone)) == pytest.approx(found, rel=1e-9)


@pytest.mark.parametrize("slowest_first", [True, False])
def test_the_worst_scenario_of_an_admittance_is_of_the_robot_that_yields_least(slowest_first: bool) -> None:
    asked, problem = AdmittanceTarget(min_m_s_per_n=1e-4, band_hz=(0.5, 6.0)), design_problem()
    some = problem.scenarios(2, 2)[0]
    bandwidths = (1.5, 4.0, 9.0) if slowest_first else (9.0, 4.0, 1.5)
    design = build_scenarios(problem, [replace(some, robot_bandwidth_hz=each) for each in bandwidths]).stable(
        problem.controller(GOOD)
    )
    requirement = BUILT_IN["free_space_admittance"]
    worst = requirement.worst_scenario(asked, design)
    assert worst.robot_bandwidth_hz == 1.5
    alone = build_scenarios(problem, [worst]).stable(design.controller)
    least = requirement.achieved(asked, alone, 0)
    assert requirement.achieved(asked, design, 0) == least
    gradient = requirement.gradient(asked, design, 0)
    assert gradient is not None
    assert gradient.value == pytest.approx(least, rel=1e-3)
