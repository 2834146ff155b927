"""Limits of the runtime: what the schema takes at its ends the records take too, and what is beyond they refuse."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any, cast, get_args, get_origin, get_type_hints

import pytest

from autotune.formats.limits import AxisLimits, Biquad, VariableDampingSettings
from problems.errors import ParameterError
from problems.frozen import Rule
from tests.autotune.formats.samples import make_limits

SCHEDULE = VariableDampingSettings(highest=1e6, lowest=1.0, decay_s_per_m=8.0, update_periods=10, largest_change=20.0)
FILTER = Biquad(zero_s=0.01, zero_damping_ratio=0.5, pole_s=0.02, pole_damping_ratio=0.7)
AXIS = AxisLimits(speed=0.25, acceleration=10.0, followed_speed=0.2, followed_lag_s=0.05)
LIMITS = make_limits(("x",))
RECORDS = (SCHEDULE, FILTER, AXIS, LIMITS)


def rules(record: Any) -> Iterator[tuple[str, Rule]]:
    """Yield the rule of every number, optional ones included."""
    for name, hint in get_type_hints(type(record), include_extras=True).items():
        for each in (hint, *get_args(hint)):
            if get_origin(each) is Annotated and get_args(each)[0] in (int, float):
                yield name, next(rule for rule in get_args(each)[1:] if isinstance(rule, Rule))


NUMBERS = [
    pytest.param(record, name, rule, id=f"{type(record).__name__}.{name}")
    for record in RECORDS
    for name, rule in rules(record)
]


@pytest.mark.parametrize(("record", "name", "rule"), NUMBERS)
def test_what_the_schema_takes_at_its_ends_the_record_takes(record: Any, name: str, rule: Rule) -> None:
    least = rule["minimum"] if "minimum" in rule else math.nextafter(rule["exclusiveMinimum"], math.inf)
    for value in (least, rule["maximum"]):
        assert getattr(replace(record, **{name: value}), name) == value


@pytest.mark.parametrize(("record", "name", "rule"), NUMBERS)
@pytest.mark.parametrize("value", [-1e-9, math.nan, math.inf])
def test_what_is_negative_or_not_finite_the_record_refuses(record: Any, name: str, rule: Rule, value: float) -> None:
    del rule
    with pytest.raises(ParameterError, match=name):
        replace(record, **{name: value})


@pytest.mark.parametrize(
    ("record", "name"),
    [
        *((SCHEDULE, name) for name in ("highest", "lowest", "update_periods", "largest_change")),
        *((FILTER, name) for name in ("pole_s", "pole_damping_ratio")),
        *((AXIS, name) for name, _ in rules(AXIS)),
        *((LIMITS, name) for name, _ in rules(LIMITS)),
    ],
)
def test_nothing_is_no_limit(record: Any, name: str) -> None:
    with pytest.raises(ParameterError, match=name):
        replace(record, **{name: 0})


def test_a_schedule_has_no_lowest_damping_above_the_highest() -> None:
    with pytest.raises(ParameterError, match=r"lowest must be at most the highest, 100"):
        replace(SCHEDULE, highest=100.0, lowest=math.nextafter(100.0, math.inf))
    assert replace(SCHEDULE, highest=100.0, lowest=100.0).lowest == 100.0


@pytest.mark.parametrize("name", ["followed_speed", "followed_lag_s"])
def test_the_robot_s_lag_and_its_speed_go_together(name: str) -> None:
    with pytest.raises(ParameterError, match="followed_lag_s"):
        replace(AXIS, **cast(Any, {name: None}))


def test_a_lag_fades_by_its_time_constant() -> None:
    step_s, missing = 1e-3, 1.0
    for _ in range(50):
        missing *= 1.0 - AXIS.followed_weight(step_s)
    assert missing == pytest.approx(math.exp(-1.0), rel=1e-12)
    assert replace(AXIS, followed_speed=None, followed_lag_s=None).followed_weight(step_s) == 1.0


def test_a_filter_is_described_by_its_corners() -> None:
    assert FILTER.describe() == "zero at 15.92 Hz (ζ 0.5), pole at 7.958 Hz (ζ 0.7)"
    assert replace(FILTER, zero_s=0.0).describe() == "pole at 7.958 Hz (ζ 0.7)"
