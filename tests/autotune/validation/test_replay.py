"""Replayed contacts against the exact transient of the ground floor."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from autotune.formats.limits import VariableDampingSettings
from autotune.validation.replay import Strategy, equation_gains, replay_contact, robot_alone
from autotune.validation.replay_kernel import difference_step, follow_forces, over_sample, replay_ticks, rest_at
from problems.contact.transient import Approach, ContactTransient, build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant, WrenchFilter
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from tests.problems import reference
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant

# What validation allows between prediction and replay.
STATED = 0.02
LIGHT = paper_plant(stiffness=8e4, coupling_damping=150.0)
TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.0e-3)


def exact(plant: Plant, law: AdmittanceController, force: float) -> ContactTransient:
    return simulate_contact(build_sampled_contact(build_sampled_plant(plant, PERIOD_S)), law, Approach(force_n=force))


@pytest.mark.parametrize(
    ("plant", "law"),
    [
        (paper_plant(stiffness=2e4), admittance(13.0, 1200.0, 0.013)),
        (paper_plant(stiffness=1.5e5), admittance(20.0, 3500.0, 0.013)),
        (paper_plant(stiffness=1.5e5, environment_damping=60.0, coupling_damping=150.0), admittance(20.0, 3500.0)),
        (paper_plant(stiffness=4e4, robot=one_pole(0.0), coupling_damping=150.0), admittance(13.0, 2500.0, 0.013)),
        (paper_plant(stiffness=8e4, robot=one_pole(2.7 * PERIOD_S)), admittance(13.0, 1800.0, 0.013, 0.006)),
        (paper_plant(stiffness=8e4, robot=one_pole(0.4 * PERIOD_S)), admittance(13.0, 1800.0, 0.013)),
        (paper_plant(stiffness=1e5, robot=TWO_POLES), admittance(20.0, 4000.0, 0.02)),
        (replace(LIGHT, wrench_filter=WrenchFilter.from_corner(50.0)), admittance(13.0, 2500.0, 0.013, 0.006)),
        (replace(LIGHT, wrench_filter=WrenchFilter(time_constant_s=1e-3, delay_s=1.3e-3)), admittance(13.0, 2500.0)),
    ],
    ids=[
        *("soft", "stiff", "damped", "no delay", "fraction, feedback", "fraction below one sample", "two poles"),
        *("filtered wrench", "filtered and late wrench"),
    ],
)
def test_the_peaks_are_those_of_the_exact_transient(plant: Plant, law: AdmittanceController) -> None:
    force = 30.0
    predicted = exact(plant, law, force)
    replayed = replay_contact(plant, law, PERIOD_S, force)
    assert predicted.peak_contact_force_n > 1.02 * force  # there is a peak to speak of
    assert replayed.peak_contact_force_n == pytest.approx(predicted.peak_contact_force_n, rel=STATED)
    assert replayed.peak_sensor_force_n == pytest.approx(predicted.peak_sensor_force_n, rel=STATED)


@pytest.mark.parametrize(
    ("plant", "law"),
    [
        (paper_plant(stiffness=1.35e6, drag=95.0, coupling=3.7e4, mass=33.5), admittance(18.7, 2623.0, 0.0219)),
        (paper_plant(stiffness=1.8e6, drag=84.0, coupling=1.36e5, mass=34.0), admittance(16.8, 1338.0, 0.0263)),
        (paper_plant(stiffness=3.05e5, drag=114.0, coupling=5.55e4, mass=20.8), admittance(17.0, 1307.0, 0.00156)),
    ],
    ids=["sensor peak while away", "many bounces", "slow approach"],
)
def test_a_payload_that_bounces_off_is_followed(plant: Plant, law: AdmittanceController) -> None:
    """The sensor may show its peak while the payload is away from the wall, and a late bounce may be the hardest."""
    predicted = exact(plant, law, 30.0)
    away = np.flatnonzero(predicted.contact_force_n[1:] == 0.0) + 1
    assert np.any(np.diff(away) > 1)  # it left at least twice
    replayed = replay_contact(plant, law, PERIOD_S, 30.0)
    assert replayed.peak_contact_force_n == pytest.approx(predicted.peak_contact_force_n, rel=STATED)
    assert replayed.peak_sensor_force_n == pytest.approx(predicted.peak_sensor_force_n, rel=STATED)


def test_a_lead_that_leaps_at_the_start_has_settled_before_the_touch() -> None:
    """K_l B_a/M_a is 930: F^d makes the command leap by F^d K_l/B_a, 12 mm, and the contact is of the steady speed.

    One that comes during the leap is far harder; of a law without lead none is harder than the steady one.
    """
    law = AdmittanceController(
        mass_kg=0.986,
        damping_n_s_per_m=1526.0,
        lead_s=0.6,
        biquad_zero_s=5.51e-3,
        biquad_zero_damping_ratio=0.384,
        biquad_pole_s=0.018,
        biquad_pole_damping_ratio=1.04,
    )
    robot = RobotModel(numerator=np.array([20.0]), denominator=np.array([1.0, 20.0]), delay_s=2.4e-3)
    plant = paper_plant(stiffness=1.45e5, drag=330.0, coupling=3.1e5, coupling_damping=150.0, robot=robot, mass=16.6)
    predicted, replayed = exact(plant, law, 30.0), replay_contact(plant, law, PERIOD_S, 30.0)
    assert replayed.largest_speed_m_s > 20.0 * predicted.contact_speed_m_s
    assert replayed.peak_contact_force_n == pytest.approx(predicted.peak_contact_force_n, rel=2e-3)
    plain = admittance(13.0, 2500.0)
    for moment in (0.05, 0.1):
        early, slow = (replay_contact(plant, each, PERIOD_S, 30.0, touch_after_s=moment) for each in (law, plain))
        assert early.peak_contact_force_n > 2.0 * replayed.peak_contact_force_n
        assert slow.peak_contact_force_n <= replay_contact(plant, plain, PERIOD_S, 30.0).peak_contact_force_n
    # When the leap has died away it is the same again.
    late = replay_contact(plant, law, PERIOD_S, 30.0, touch_after_s=3.0)
    assert late.peak_contact_force_n == pytest.approx(replayed.peak_contact_force_n, rel=1e-3)


def test_a_surface_so_soft_that_it_takes_seconds_is_followed_to_the_end() -> None:
    plant, law = paper_plant(stiffness=2e3), admittance(13.0, 1500.0, 0.013)
    predicted = exact(plant, law, 30.0)
    assert predicted.time_of_peak_s > 3.0
    replayed = replay_contact(plant, law, PERIOD_S, 30.0)
    assert replayed.peak_contact_force_n == pytest.approx(predicted.peak_contact_force_n, rel=STATED)


def test_without_a_deadband_peaks_grow_with_the_force() -> None:
    """The wall is at 0 and everything else is linear: twice the force, twice the peak."""
    plant, law = paper_plant(stiffness=1e5), admittance(20.0, 3500.0, 0.013)
    once, twice = (replay_contact(plant, law, PERIOD_S, force) for force in (20.0, 40.0))
    assert twice.peak_contact_force_n == pytest.approx(2.0 * once.peak_contact_force_n, rel=1e-3)


def test_a_deadband_hides_what_is_below_it() -> None:
    plant, law = paper_plant(stiffness=1e5), admittance(20.0, 3500.0, 0.013)
    without, with_it = (replay_contact(plant, law, PERIOD_S, 30.0, deadband_n=d) for d in (0.0, 8.0))
    # The controller learns of the contact later, so it presses harder.
    assert with_it.peak_contact_force_n > without.peak_contact_force_n


def test_the_difference_equation_is_the_one_of_the_paper() -> None:
    law = admittance(13.0, 1000.0, 0.013, 0.008)
    gains, past, printed = equation_gains(law, PERIOD_S), rest_at(0.0), reference.DifferenceEquation(law, PERIOD_S)
    rng = np.random.default_rng(2)
    forces, positions = rng.normal(size=300) * 20.0, np.cumsum(rng.normal(size=300)) * 1e-5
    mine, theirs = np.empty(300), np.empty(300)
    for tick, (force, position) in enumerate(zip(forces, positions, strict=True)):
        past = difference_step(gains, past, force, position, reset=False)
        mine[tick], theirs[tick] = past.sent, printed.step(force, position)
    np.testing.assert_allclose(mine, theirs, rtol=0.0, atol=1e-10 * float(np.max(np.abs(theirs))))


@pytest.mark.parametrize("robot", [one_pole(), one_pole(0.0), one_pole(1.3 * PERIOD_S), TWO_POLES])
def test_the_robot_alone_steps_like_the_whole_sampled_plant(robot: RobotModel) -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=0.0, robot=robot), PERIOD_S)
    alone, state, past = robot_alone(robot, PERIOD_S), np.zeros(sampled.state_count), np.zeros(12)
    of_robot = np.zeros(robot.order)
    commands = np.random.default_rng(4).normal(size=200)
    for command in commands:
        past = np.concatenate([[command], past[:-1]])
        newer, older = past[sampled.whole_delay], past[sampled.whole_delay + 1]
        state = sampled.phi @ state + sampled.gamma * newer + sampled.gamma_old * older
        of_robot = over_sample(alone.sample, of_robot, past[alone.whole + 1], past[alone.whole])
        assert alone.output @ of_robot == pytest.approx(float(sampled.c_position @ state), abs=1e-10)


@pytest.mark.parametrize("robot", [one_pole(0.0), one_pole(1.3 * PERIOD_S), TWO_POLES])
def test_compiled_and_straight_python_follow_the_same_force(robot: RobotModel) -> None:
    alone, gains = robot_alone(robot, PERIOD_S), equation_gains(admittance(13.0, 1000.0, 0.013, 0.008), PERIOD_S)
    force = np.random.default_rng(5).normal(size=400)
    straight = follow_forces.py_func(alone, gains, force)  # type: ignore[attr-defined]
    # The same operations, in sums of at most three terms.
    np.testing.assert_allclose(follow_forces(alone, gains, force), straight, rtol=1e-12, atol=1e-18)


VARIED = VariableDampingSettings(
    highest=3000.0, lowest=2000.0, decay_s_per_m=30.0, update_periods=12, largest_change=100.0
)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"deadband_n": 4.0},
        {"strategy": Strategy(threshold_n=12.0)},
        {"strategy": Strategy(threshold_n=12.0, stops=True, variable=VARIED)},
    ],
)
def test_compiled_and_straight_python_replay_the_same_contact(
    options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = paper_plant(stiffness=1.35e6, drag=95.0, coupling=3.7e4, mass=33.5, robot=one_pole(0.4 * PERIOD_S))
    law = admittance(18.7, 2623.0, 0.0219)
    compiled = vars(replay_contact(plant, law, PERIOD_S, 30.0, **options))
    monkeypatch.setattr("autotune.validation.replay.replay_ticks", replay_ticks.py_func)  # type: ignore[attr-defined]
    straight = vars(replay_contact(plant, law, PERIOD_S, 30.0, **options))
    assert (straight["detected_after_s"] is None) == ("strategy" not in options)
    # Rounding, as it grows over several bounces.
    assert list(compiled.values()) == [each and pytest.approx(each, rel=1e-9) for each in straight.values()]


@pytest.mark.parametrize("delay", [0.4 * PERIOD_S, 2.7 * PERIOD_S, 3.0 * PERIOD_S])
def test_far_from_the_surface_a_sample_may_be_two_steps(delay: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the payload bounces several times and the delay ends inside a sample."""
    plant = paper_plant(stiffness=1.35e6, drag=95.0, coupling=3.7e4, mass=33.5, robot=one_pole(delay))
    law = admittance(18.7, 2623.0, 0.0219)
    quick = replay_contact(plant, law, PERIOD_S, 30.0)
    monkeypatch.setattr("autotune.validation.replay._FAR_SAMPLES", np.inf)
    slow = replay_contact(plant, law, PERIOD_S, 30.0)
    assert quick.peak_contact_force_n == pytest.approx(slow.peak_contact_force_n, rel=1e-9)
    assert quick.peak_sensor_force_n == pytest.approx(slow.peak_sensor_force_n, rel=1e-9)


def test_of_a_surface_on_which_the_force_creeps_the_value_at_rest_counts() -> None:
    """B_a/K_e is 8 s, so that after 10 s of contact the force is a quarter short of F^d."""
    plant, law = paper_plant(stiffness=250.0), admittance(13.0, 2000.0, 0.013)
    predicted = exact(plant, law, 30.0)
    assert not predicted.is_settled
    assert predicted.contact_force_n[-1] < 0.8 * 30.0
    replayed = replay_contact(plant, law, PERIOD_S, 30.0)
    # e = F^d + F vanishes at rest, and one real pole is left.
    assert replayed.peak_contact_force_n == replayed.peak_sensor_force_n == 30.0
    assert predicted.peak_contact_force_n == 30.0
