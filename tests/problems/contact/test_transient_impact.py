"""Impacts beside an ODE solver that looks for meetings and departures (`tests.problems.collision`)."""

from dataclasses import replace

import numpy as np
import pytest

from problems.contact.transient import Approach, ContactTransient, build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.plant import Environment, Plant
from problems.model.sampled import build_loop, build_sampled_plant
from tests.problems.axes import (
    BOUNCING,
    DAMPED,
    PERIOD_S,
    PRESS,
    QUIET,
    STRUCTURES,
    admittance,
    heavy_wall,
    one_pole,
    paper_plant,
)
from tests.problems.collision import Collision, collide
from tests.problems.reference import steady_approach

SLOWER_CLOCK_S = 8e-3


def both(
    plant: Plant, controller: AdmittanceController, approach: Approach, samples: int, period_s: float = PERIOD_S
) -> tuple[ContactTransient, Collision, float]:
    """Run an impact by the product and by the ODE solver; return both and the force on the wall at rest."""
    pair, by_hand = build_sampled_contact(build_sampled_plant(plant, period_s)), approach.driven_by == "hand"
    free = build_loop(pair.free, controller)
    start = steady_approach(pair.free, free, force=approach.force_n, speed=approach.speed_m_s, hand=by_hand)
    after = start.force_n if approach.after_impact_n is None else approach.after_impact_n
    run = simulate_contact(pair, controller, approach, samples=samples)
    forces = (0.0, after) if by_hand else (after, 0.0)
    return run, collide(plant, controller, period_s, start, forces, samples), after


def hard(stiffness: float, mass: float = 16.0, drag: float = 630.0, coupling: float = 3e5) -> Plant:
    return paper_plant(stiffness=stiffness, mass=mass, drag=drag, coupling=coupling)


@pytest.mark.parametrize(
    ("plant", "controller", "approach", "departures"),
    [
        pytest.param(BOUNCING, admittance(damping=800.0, lead=0.01), PRESS, 2, id="undamped wall, whole delay"),
        pytest.param(
            DAMPED, admittance(damping=1500.0, lead=0.02, feedback=5e-3), PRESS, 2, id="dampers, half a sample"
        ),
        pytest.param(hard(1e7), QUIET, PRESS, 5, id="1e7 N/m"),
        pytest.param(hard(1e8), QUIET, PRESS, 10, id="1e8 N/m"),
        pytest.param(hard(1e7, 2.0, 50.0, 3e4), QUIET, PRESS, 10, id="1e7 N/m, light"),
        pytest.param(hard(1e8, 2.0, 50.0, 3e4), QUIET, PRESS, 10, id="1e8 N/m, light: leaves within a sample"),
        pytest.param(heavy_wall(0.01), QUIET, PRESS, 2, id="hardly any mass"),
        pytest.param(heavy_wall(0.5, 50.0), QUIET, PRESS, 1, id="mass and damper"),
        pytest.param(heavy_wall(50.0), QUIET, PRESS, 0, id="a wall heavier than the payload"),
        pytest.param(
            replace(heavy_wall(1.0), robot=one_pole(0.0)), QUIET, Approach(speed_m_s=0.1), 1, id="mass, no delay"
        ),
        pytest.param(paper_plant(robot=one_pole(2e-3)), QUIET, Approach(force_n=30.0, driven_by="hand"), 0, id="hand"),
        pytest.param(
            paper_plant(robot=one_pole(2e-3)),
            QUIET,
            Approach(speed_m_s=0.1, driven_by="hand", after_impact_n=-5.0),
            1,
            id="hand that pulls back",
        ),
        pytest.param(
            paper_plant(robot=one_pole(2e-3)), QUIET, Approach(speed_m_s=0.1, after_impact_n=0.0), 0, id="let go"
        ),
        pytest.param(
            replace(BOUNCING, robot=one_pole(0.0)),
            replace(STRUCTURES["filtered, forward Euler"], damping_n_s_per_m=4000.0),
            PRESS,
            1,
            id="filtered compensation, forward Euler, no delay",
        ),
        pytest.param(
            DAMPED,
            replace(STRUCTURES["ideal, backward Euler"], damping_n_s_per_m=4000.0),
            Approach(speed_m_s=0.05),
            1,
            id="ideal compensation, backward Euler",
        ),
        pytest.param(
            BOUNCING, replace(STRUCTURES["ideal"], damping_n_s_per_m=5000.0), PRESS, 1, id="ideal compensation"
        ),
    ],
)
def test_an_impact_is_what_an_ode_solver_finds(
    plant: Plant, controller: AdmittanceController, approach: Approach, departures: int
) -> None:
    """Forces at the ticks, leaving and meeting again, impulse, and the peak between the ticks with its time."""
    found, expected, rest = both(plant, controller, approach, 120)
    assert expected.departures >= departures
    # The solver keeps 1e-11 per step; a late event of a collision multiplies it by some orders of magnitude.
    scale = expected.peak
    np.testing.assert_allclose(-found.sensor_force_n, expected.sensed, atol=1e-6 * scale)
    np.testing.assert_allclose(found.contact_force_n, expected.pressed, atol=1e-6 * scale)
    assert found.impulse_n_s == pytest.approx(max(expected.impulses, default=0.0), rel=1e-6, abs=1e-12)
    if expected.peak > rest and expected.time_of_peak < 119 * PERIOD_S:
        assert found.peak_contact_force_n == pytest.approx(expected.peak, rel=1e-8)
        # A crest is flat: its moment is known to the root of what its value is, relative to a fast oscillation.
        assert found.time_of_peak_s == pytest.approx(expected.time_of_peak, abs=1e-7)
    else:
        # It was still rising, and the force at rest counts.
        assert found.peak_contact_force_n == pytest.approx(max(rest, expected.peak), rel=1e-2)


@pytest.mark.parametrize(("stiffness", "mass"), [(2e6, 2.0), (5e6, 2.0), (5e7, 16.0)])
def test_a_slow_clock_does_not_hide_the_bounces_between_its_ticks(stiffness: float, mass: float) -> None:
    """At 8 ms these walls swing by 8 to 14 rad per sample: the payload is back and gone again between two ticks."""
    plant = paper_plant(stiffness=stiffness, mass=mass, drag=300.0, coupling=3e4, robot=one_pole(0.01))
    controller = admittance(mass=20.0, damping=6000.0, lead=0.02)
    found, expected, _ = both(plant, controller, Approach(speed_m_s=0.05, after_impact_n=2.0), 60, SLOWER_CLOCK_S)
    assert expected.departures > 0
    np.testing.assert_allclose(found.contact_force_n, expected.pressed, atol=1e-6 * expected.peak)
    assert found.peak_contact_force_n == pytest.approx(expected.peak, rel=1e-8)
    assert found.time_of_peak_s == pytest.approx(expected.time_of_peak, abs=1e-7)


def test_a_light_mass_comes_and_goes_between_the_ticks() -> None:
    """Apart, a mass of 1.4 kg on 1.3e7 N/m swings by 6 rad per sample of 2 ms and meets the payload on its way."""
    plant = replace(hard(1.3e7, 2.6, 290.0, 5.4e4), robot=one_pole(2e-3, 124.0))
    plant = plant.in_contact_with(Environment(stiffness_n_per_m=1.3e7, mass_kg=1.4))
    controller = admittance(mass=7.0, damping=1600.0, lead=0.042)
    found, expected, _ = both(plant, controller, Approach(speed_m_s=0.1, after_impact_n=20.0), 60, 2e-3)
    assert len(expected.impulses) > 1
    np.testing.assert_allclose(found.contact_force_n, expected.pressed, atol=1e-6 * expected.peak)
    np.testing.assert_allclose(-found.sensor_force_n, expected.sensed, atol=1e-6 * expected.peak)
    assert found.impulse_n_s == pytest.approx(max(expected.impulses), rel=1e-6)


def test_a_step_of_the_force_tears_the_payload_off_a_mass_at_the_tick() -> None:
    """A hand that lets go at the impact, a damped coupling: at the tick nothing presses the two together any more."""
    plant = paper_plant(
        stiffness=6.8e5,
        environment_mass=0.8,
        mass=7.3,
        drag=370.0,
        coupling=5.2e4,
        coupling_damping=950.0,
        robot=one_pole(0.9e-3, 50.0),
    )
    controller = admittance(mass=39.0, damping=1200.0, lead=0.011)
    gone = Approach(speed_m_s=0.1, driven_by="hand", after_impact_n=0.0)
    found, expected, _ = both(plant, controller, gone, 60, 2e-3)
    np.testing.assert_allclose(found.contact_force_n, expected.pressed, atol=1e-6 * expected.peak)
    np.testing.assert_allclose(-found.sensor_force_n, expected.sensed, atol=1e-6 * expected.peak)
    assert found.peak_contact_force_n == pytest.approx(expected.peak, rel=1e-7)
