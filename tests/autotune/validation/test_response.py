"""The collision response of a file is replayed: thresholds, peaks and contacts that are not its own are found out."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from autotune.errors import UsageError
from autotune.formats.controller_record import (
    AxisPrediction,
    CollisionSettings,
    Controller,
    ScenarioPrediction,
    admittance_controller,
)
from autotune.formats.limits import CollisionResponse
from autotune.validation.against_log import compare_with_log
from autotune.validation.contacts import verify_response
from autotune.validation.disturbances import Disturbances, axis_effects
from autotune.validation.monte_carlo import run_monte_carlo
from autotune.validation.monte_carlo_checks import monte_carlo_checks, monte_carlo_tree
from problems.contact.nonlinearities import Collision
from tests.autotune.tuning.responding import responding


@cache
def two_contacts() -> Controller:
    """The file with its softest and its worst contact only, which is quick to replay."""
    controller = responding().controller
    predicted = controller.predicted["x"]
    ends = replace(
        predicted,
        scenarios=(predicted.scenarios[0], predicted.scenarios[-1]),
        with_collision_response=(predicted.with_collision_response[0], predicted.with_collision_response[-1]),
    )
    return replace(controller, predicted={"x": ends})


def verified(controller: Controller) -> tuple[str, list[str]]:
    return verify_response(controller, "x", controller.certificate.domain["x"], admittance_controller(controller, "x"))


def threshold(value: float) -> Callable[[Controller], Controller]:
    return lambda c: replace(c, collision=replace(c.collision, threshold_n=value))


def predicted(change: Callable[[AxisPrediction], AxisPrediction]) -> Callable[[Controller], Controller]:
    return lambda c: replace(c, predicted={"x": change(c.predicted["x"])})


def last(**values: Any) -> Callable[[Controller], Controller]:
    def changed(before: AxisPrediction) -> AxisPrediction:
        first, worst = before.with_collision_response
        return replace(before, with_collision_response=(first, replace(worst, **values)))

    return predicted(changed)


def scaled(share: float) -> Callable[[ScenarioPrediction], ScenarioPrediction]:
    return lambda each: replace(
        each,
        peak_contact_force_n=share * each.peak_contact_force_n,
        peak_sensor_force_n=share * each.peak_sensor_force_n,
    )


NONE = CollisionSettings(response=CollisionResponse.NONE, threshold_n=None)
FALSE_CLAIMS: dict[str, tuple[Callable[[Controller], Controller], str]] = {
    "a threshold that is passed in free motion": (threshold(8.0), "free motion passes the threshold of 8 N before"),
    "a threshold that detects later": (
        threshold(20.0),
        r"with it the peak sensor force is predicted as 39\.",
    ),
    "lower peaks": (
        predicted(lambda p: replace(p, with_collision_response=tuple(map(scaled(0.95), p.with_collision_response)))),
        "with it the peak contact force is predicted as",
    ),
    "higher peaks than without": (
        predicted(lambda p: replace(p, scenarios=tuple(map(scaled(0.8), p.scenarios)))),
        r"the worst peak contact force is 41\.\d\d N with the response, 37\.\d\d N without",
    ),
    "a contact left out": (
        predicted(lambda p: replace(p, with_collision_response=p.with_collision_response[1:])),
        "no contact with the collision response is predicted",
    ),
    "no contact at all": (predicted(lambda p: replace(p, with_collision_response=())), "predicts no contact with it"),
    "another plant": (last(further={"drag_n_s_per_m": 400.0}), "lies outside of the certified domain"),
    "a stiffer wall": (last(environment_stiffness_n_per_m=1e5), "lies outside of the certified domain"),
    "no response": (lambda c: replace(c, collision=NONE), "the file has none on this axis"),
}


def test_the_contacts_of_a_good_file_are_confirmed_and_none_is_detected_early() -> None:
    reported, wrong = verified(two_contacts())
    assert wrong == []
    assert "2 contacts replayed, it begins in 2 and never before the touch" in reported


@pytest.mark.parametrize("name", list(FALSE_CLAIMS))
def test_a_false_claim_is_found_out(name: str) -> None:
    change, reported = FALSE_CLAIMS[name]
    _, wrong = verified(change(two_contacts()))
    with pytest.raises(AssertionError, match=reported):
        raise AssertionError("; ".join(wrong))


def test_a_file_without_response_has_nothing_to_confirm() -> None:
    plain = predicted(lambda p: replace(p, with_collision_response=()))(two_contacts())
    assert verified(replace(plain, collision=NONE)) == ("", [])


def test_the_certified_set_is_simulated_with_the_response_too() -> None:
    controller = two_contacts()
    chosen = controller.collision.threshold_n
    assert chosen is not None
    assert axis_effects(controller, "x", Disturbances(), 0.03).collision == Collision(threshold_n=chosen)
    stopped = replace(controller, collision=replace(controller.collision, response=CollisionResponse.STOP))
    assert axis_effects(stopped, "x", Disturbances(), 0.03).collision == Collision(response="stop", threshold_n=chosen)
    found = run_monte_carlo(controller, count=8)
    plain = run_monte_carlo(replace(controller, collision=NONE), count=8)
    assert found[0].sensor is not None
    assert plain[0].sensor is not None
    assert found[0].sensor.linear == plain[0].sensor.linear
    assert found[0].sensor.observed.largest < 0.95 * plain[0].sensor.observed.largest
    checks = monte_carlo_checks(found)
    assert all(check.passed for check in checks)
    assert f"the collision response at {chosen:g} N" in checks[-1].message
    tree: Any = monte_carlo_tree(found)
    assert tree["x"]["effects"]["collision_threshold"] == chosen


def test_a_log_is_not_compared_with_a_response_that_the_comparison_does_not_know() -> None:
    nothing: Any = None
    with pytest.raises(UsageError, match="knows neither collision response nor variable damping"):
        compare_with_log(two_contacts(), nothing)
