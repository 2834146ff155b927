"""The laws with mass and damping against their programs' update rules, step by step, and their continuous limit."""

import math

import numpy as np
import pytest

from problems.contact.linear_controller_contact import force_per_speed
from problems.contact.transient import build_sampled_contact
from problems.errors import ParameterError
from problems.model.mass_damper_controllers import Discretization, MassDamper
from problems.model.sampled import build_sampled_plant
from tests.problems.axes import PERIOD_S, paper_plant
from tests.problems.update_rules import Rule, stepped

MASS, DAMPING, STIFFNESS = 12.0, 900.0, 40.0


def rule(kind: Discretization) -> MassDamper:
    return MassDamper(
        discretization=kind,
        mass=MASS,
        damping=DAMPING,
        stiffness=STIFFNESS if kind is Discretization.MEASURED_MOTION else 0.0,
        filter_time_s=0.4 if kind is Discretization.FROM_MEASURED else 0.0,
    )


def played_script(h: float) -> Rule:
    """Universal Robots' loop: the new acceleration sees the old speed, speed and way are means of old and new."""
    acceleration = speed = way = 0.0

    def update(force: float, _: float) -> float:
        nonlocal acceleration, speed, way
        before = acceleration
        acceleration = (force - 0.0 * way - DAMPING * speed) / MASS
        speed = h * 0.5 * (acceleration + before) + speed
        way += speed * h  # what a speed that is held for a step makes of the position
        return way

    return update


def played_crisp(h: float) -> Rule:
    """crisp_controllers' inner loop: a body of its own, moved by its new speed."""
    speed = way = 0.0

    def update(force: float, _: float) -> float:
        nonlocal speed, way
        speed += (force - DAMPING * speed) / MASS * h
        way += speed * h
        return way

    return update


def played_vic(h: float) -> Rule:
    """cartesian_vic_controller's rule: damping and spring act on the measured motion, the speed is added up."""
    speed = way = before = 0.0

    def update(force: float, measured: float) -> float:
        nonlocal speed, way, before
        seen, before = (measured - before) / h, measured
        speed += (STIFFNESS * (0.0 - measured) + DAMPING * (0.0 - seen) + force) / MASS * h
        way += speed * h
        return way

    return update


def played_lbr(h: float) -> Rule:
    """lbr_fri_ros2's update: the measured speed and what a period adds, smoothed, on top of the measured position."""
    smoothed = before = 0.0
    alpha = 1.0 - math.exp(-h / 0.4)

    def update(force: float, measured: float) -> float:
        nonlocal smoothed, before
        speed, before = (measured - before) / h, measured
        speed += (force - DAMPING * speed) / MASS * h
        smoothed = alpha * speed + (1.0 - alpha) * smoothed
        return measured + smoothed * h

    return update


PLAYED = {
    Discretization.TRAPEZOIDAL: played_script,
    Discretization.EULER: played_crisp,
    Discretization.MEASURED_MOTION: played_vic,
    Discretization.FROM_MEASURED: played_lbr,
}


@pytest.mark.parametrize("kind", Discretization)
@pytest.mark.parametrize("h", [PERIOD_S, 2e-3])
def test_the_law_is_the_update_rule(kind: Discretization, h: float) -> None:
    ours, played, rng = stepped(rule(kind).law(h)), PLAYED[kind](h), np.random.default_rng(7)
    for force, measured in zip(rng.normal(0.0, 20.0, 400), rng.normal(0.0, 1e-3, 400), strict=True):
        assert ours(force, measured) == pytest.approx(played(force, measured), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("kind", [Discretization.TRAPEZOIDAL, Discretization.EULER])
def test_a_short_period_makes_the_continuous_law(kind: Discretization) -> None:
    """1/(M s² + D s) of the force, at frequencies far below 1/h."""
    h, omega = 1e-5, np.array([1.0, 10.0, 100.0])
    forward, feedback = rule(kind).law(h).gains(np.exp(1j * omega * h))
    s = 1j * omega
    # A command is held for half a period on average; 100 rad/s · 10 µs.
    np.testing.assert_allclose(forward, 1.0 / (MASS * s**2 + DAMPING * s), rtol=2e-3)
    assert np.all(feedback == 0.0)


def test_a_steady_push_meets_the_damping() -> None:
    plant = paper_plant(stiffness=6e4, drag=330.0, coupling_damping=150.0)
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    for kind in (Discretization.TRAPEZOIDAL, Discretization.EULER, Discretization.MEASURED_MOTION):
        more, less = (
            force_per_speed(pair, MassDamper(discretization=kind, mass=MASS, damping=each).law(PERIOD_S))
            for each in (DAMPING, DAMPING - 500.0)
        )
        assert more - less == pytest.approx(500.0, rel=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"mass": 0.0}, "mass must be finite and above 0"),
        ({"damping": -1.0}, "damping must be"),
        ({"stiffness": 1.0}, "stiffness must be 0 with the discretisation euler"),
        ({"filter_time_s": 0.4}, "filter_time_s must be 0 with the discretisation euler"),
    ],
)
def test_what_a_discretisation_has_no_place_for_is_refused(given: dict[str, float], message: str) -> None:
    numbers = {"mass": MASS, "damping": DAMPING} | given
    with pytest.raises(ParameterError, match=message):
        MassDamper(discretization=Discretization.EULER, **numbers)
