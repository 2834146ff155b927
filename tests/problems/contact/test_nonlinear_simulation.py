import math
from dataclasses import replace

import numpy as np
import pytest

from problems.contact.nonlinear_simulation import Operator, simulate_nonlinear, simulate_operator
from problems.contact.nonlinearities import (
    NO_NONLINEARITIES,
    Collision,
    CommandLimits,
    Deadband,
    Nonlinearities,
    VariableDamping,
)
from problems.contact.transient import Approach
from problems.errors import ParameterError
from problems.model.plant import Plant
from problems.model.robot import RobotModel
from problems.stability.margins import UnstableLoopError
from tests.problems.axes import PERIOD_S, PRESS, admittance, one_pole, paper_plant
from tests.problems.nonlinear_runs import FIRM, PRINTED, SUBTRACTIVE, THRESHOLD, light_plant, simulate

TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 42.0, 900.0]), delay_s=2.3e-3)
LIMITED = Nonlinearities(limits=CommandLimits(speed_m_s=0.02, acceleration_m_s2=2.0))
HAND = Approach(force_n=4.0, driven_by="hand")
FAST = Approach(speed_m_s=0.1)


def test_an_approach_from_rest_arrives_as_the_steady_approach_begins() -> None:
    plant = paper_plant(stiffness=3e4)
    far, near = simulate(plant, distance=0.02, duration=3.6), simulate(plant, duration=0.6)
    assert far.impact_time_s is not None
    # The slowest motion in free space is M_a/B_a and the robot's 0.05 s; the way takes 2.4 s.
    assert far.impact_speed_m_s == pytest.approx(30.0 / (3000.0 + 630.0), rel=1e-3)
    assert near.impact_speed_m_s == pytest.approx(30.0 / (3000.0 + 630.0), rel=1e-3)
    # Where in a sample it meets the wall is another, which is one sample of 8e-4 s in a rise of 0.05 s and more.
    assert far.peak_contact_force_n == pytest.approx(near.peak_contact_force_n, rel=0.01)
    assert far.time_of_peak_s - far.impact_time_s == pytest.approx(near.time_of_peak_s, abs=4 * PERIOD_S)
    assert far.flange_position_m[0] == far.payload_position_m[0] == -0.02
    assert far.payload_velocity_m_s[0] == far.sensor_force_n[0] == 0.0


def test_a_hand_that_lets_go_at_the_impact_pushes_until_then() -> None:
    plant = paper_plant(stiffness=3e4)
    hand = Approach(force_n=30.0, driven_by="hand", after_impact_n=0.0)
    run = simulate(plant, approach=hand, distance=0.005, duration=3.0)
    assert run.impact_time_s is not None
    before = run.time_s < run.impact_time_s
    # The hand's force reaches the sensor, less the drag; nobody holds the payload against the wall afterwards.
    assert np.max(run.seen_force_n[before][100:]) < 0.0
    assert abs(run.sensor_force_n[-1]) < 0.01 * run.peak_sensor_force_n


@pytest.mark.parametrize(
    ("approach", "deadband", "speed"),
    [
        # F^d + D(−630 v) = 1000 v
        pytest.param(PRESS, None, 30.0 / 1630.0, id="none"),
        pytest.param(PRESS, Deadband(width_n=5.0), 30.0 / 1630.0, id="drag above the threshold"),
        pytest.param(PRESS, Deadband(width_n=20.0), 30.0 / 1000.0, id="drag below the threshold"),
        pytest.param(PRESS, SUBTRACTIVE, 35.0 / 1630.0, id="subtractive"),
        # D(f − 630 v) = 1000 v
        pytest.param(Approach(force_n=30.0, driven_by="hand"), SUBTRACTIVE, 25.0 / 1630.0, id="a hand, subtractive"),
        pytest.param(Approach(force_n=30.0, driven_by="hand"), THRESHOLD, 30.0 / 1630.0, id="a hand, threshold"),
    ],
)
def test_the_steady_approach_balances_with_the_deadband(
    approach: Approach, deadband: Deadband | None, speed: float
) -> None:
    plant, controller, effects = paper_plant(stiffness=3e4), admittance(), Nonlinearities(deadband=deadband)
    # Before the impact the sensor shows the hold's ripple beside the drag: ωh/2 = 0.8 % of the drag.
    steady = simulate(plant, controller, approach, effects=effects)
    assert steady.impact_speed_m_s == pytest.approx(speed, rel=1e-3)
    arrived = simulate(plant, controller, approach, effects=effects, distance=0.03, duration=2.5)
    assert arrived.impact_speed_m_s == pytest.approx(speed, rel=1e-3)


def test_a_drag_at_the_threshold_switches_back_and_forth_around_it() -> None:
    """13 N of drag: seen, the speed falls towards 30/1630 m/s, unseen, it rises towards 30/1000 m/s."""
    effects, speed = Nonlinearities(deadband=Deadband(width_n=13.0)), 13.0 / 630.0
    steady = simulate(paper_plant(stiffness=3e4), admittance(), effects=effects)
    assert steady.impact_speed_m_s == pytest.approx(speed, rel=1e-3)
    run = simulate(paper_plant(stiffness=3e4), admittance(), effects=effects, distance=0.03, duration=1.4)
    late = run.time_s > 0.6
    assert run.impact_time_s is None
    assert (
        30.0 / 1630.0 < np.min(run.payload_velocity_m_s[late]) < speed < np.max(run.payload_velocity_m_s[late]) < 0.03
    )
    assert np.any(run.is_dead[late])
    assert not np.all(run.is_dead[late])


@pytest.mark.parametrize("driven_by", ["desired_force", "hand"])
@pytest.mark.parametrize("deadband", [Deadband(width_n=40.0), THRESHOLD, SUBTRACTIVE])
def test_a_speed_driven_approach_finds_the_force_that_sustains_it(driven_by: str, deadband: Deadband) -> None:
    approach = Approach(speed_m_s=0.02, driven_by=driven_by)  # type: ignore[arg-type]
    run = simulate(paper_plant(stiffness=3e4), admittance(), approach, effects=Nonlinearities(deadband=deadband))
    drag, needed = 630.0 * 0.02, 1000.0 * 0.02
    seen_drag = {"threshold": drag if drag > deadband.width_n else 0.0, "subtractive": drag - 5.0}[deadband.kind]
    by_hand = drag + {"threshold": max(needed, deadband.width_n), "subtractive": needed + 5.0}[deadband.kind]
    # The hold's ripple, 0.8 % of the drag.
    assert run.driving_force_n == pytest.approx(by_hand if driven_by == "hand" else needed + seen_drag, abs=8e-3 * drag)
    assert run.impact_speed_m_s == pytest.approx(0.02, rel=1e-12)


def test_an_approach_at_the_speed_limit_is_steady_and_nothing_winds_up() -> None:
    plant, effects = paper_plant(stiffness=3e4), Nonlinearities(limits=CommandLimits(speed_m_s=0.01))
    near = simulate(plant, admittance(damping=1500.0, lead=0.02), effects=effects, duration=2.0)
    far = simulate(plant, admittance(damping=1500.0, lead=0.02), effects=effects, distance=0.005, duration=3.0)
    assert near.impact_speed_m_s == pytest.approx(0.01, rel=1e-12)
    # The robot follows after 0.05 s, a tenth of the way.
    assert far.impact_speed_m_s == pytest.approx(0.01, rel=1e-3)
    assert far.impact_time_s is not None
    after = far.time_s > far.impact_time_s
    released = far.time_s[after & ~far.is_limited][0]
    # The force that the admittance wants less of grows by K_e v per second; it has left the limit before F reaches the
    # 30 − 1500·0.01 = 15 N at which its own steady speed is the limit, whatever it wanted before.
    assert far.sensor_force_n[np.searchsorted(far.time_s, released)] < 15.0
    assert far.peak_contact_force_n == pytest.approx(near.peak_contact_force_n, rel=0.01)


def test_a_steady_approach_with_variable_damping_has_the_damping_of_its_speed() -> None:
    effects, speed = Nonlinearities(variable_damping=VariableDamping()), 0.03
    run = simulate(light_plant(3.2e4), PRINTED, Approach(speed_m_s=speed), effects=effects)
    damping = 800.0 * math.exp(-8.0 * speed)
    # One bisection and one exponential; the ripple of the hold is 0.8 % of the drag.
    assert run.damping_n_s_per_m[0] == pytest.approx(damping, rel=1e-12)
    assert run.driving_force_n == pytest.approx((damping + 150.0) * speed, rel=2e-3)
    again = simulate(light_plant(3.2e4), PRINTED, Approach(force_n=run.driving_force_n), effects=effects)
    assert again.impact_speed_m_s == pytest.approx(speed, rel=1e-12)


def test_noise_is_drawn_from_the_callers_generator() -> None:
    plant, effects = paper_plant(), Nonlinearities(force_noise_rms_n=0.14)
    one, same, other = (simulate(plant, effects=effects, seed=seed, duration=4.0) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.sensor_force_n, same.sensor_force_n)
    assert np.max(np.abs(one.sensor_force_n - other.sensor_force_n)) > 1e-3
    noise = one.seen_force_n - one.sensor_force_n
    # 5000 draws know their deviation to 1 %, their mean to 1.4 %, their correlation to 0.014: four of each.
    assert np.std(noise) == pytest.approx(0.14, rel=0.04)
    assert abs(np.mean(noise)) < 0.04 * 0.14 * math.sqrt(2.0)
    assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.057


def test_an_unstable_loop_is_refused_or_runs_without_a_peak() -> None:
    plant, controller = paper_plant(), admittance(mass=10.0, lead=0.0)
    with pytest.raises(UnstableLoopError):
        simulate(plant, controller)
    # At 800 the loop is stable, at the floor of the variable damping it is not.
    light = light_plant(1e5)
    simulate(light, admittance(damping=2000.0))
    with pytest.raises(UnstableLoopError):
        simulate(
            light,
            admittance(damping=2000.0),
            effects=Nonlinearities(variable_damping=VariableDamping(floor_n_s_per_m=20.0)),
        )
    run = simulate_nonlinear(plant, controller, PRESS, sample_time_s=PERIOD_S, duration_s=1.0, even_if_unstable=True)
    assert math.isnan(run.peak_sensor_force_n)
    assert math.isnan(run.peak_contact_force_n)
    # Bounded only by leaving the wall again and again.
    assert np.ptp(run.contact_force_n[-200:]) > 50.0


def test_the_run_is_a_value() -> None:
    run = simulate(paper_plant())
    with pytest.raises(ValueError, match="read-only"):
        run.sensor_force_n[0] = 0.0
    assert len(run.time_s) == 400
    assert run.impact_time_s == 0.0
    assert run.collision_time_s is None
    missed = simulate(paper_plant(), distance=1.0)
    assert missed.impact_time_s is missed.impact_speed_m_s is None
    assert missed.peak_contact_force_n == 0.0


@pytest.mark.parametrize(
    ("plant", "approach", "effects", "options", "text"),
    [
        (paper_plant(stiffness=0.0), PRESS, {}, {}, "a surface to touch"),
        (paper_plant(coupling_damping=5.0, robot=one_pole(0.0)), PRESS, {}, {}, "delay_s"),
        (paper_plant(), HAND, {"deadband": THRESHOLD}, {}, "deadband of 5 N"),
        (paper_plant(), FAST, {"limits": CommandLimits(speed_m_s=0.05)}, {}, "0.05 m/s"),
        (paper_plant(), replace(FAST, driven_by="hand"), {"force_limit_n": 20.0}, {}, "clipped"),
        (paper_plant(), PRESS, {"force_noise_rms_n": 0.1}, {}, "Generator"),
        (paper_plant(), PRESS, {"late_share": 0.1}, {}, "Generator"),
        (paper_plant(), PRESS, {"collision": Collision(threshold_n=2.0)}, {}, "above the drag"),
        (paper_plant(), PRESS, {"variable_damping": VariableDamping(update_period_s=1e-4)}, {}, "at least h"),
        (paper_plant(), PRESS, {}, {"substeps": 0}, "substeps"),
        (paper_plant(stiffness=3e9), PRESS, {}, {}, "substeps must be at least"),
        (paper_plant(), PRESS, {}, {"distance": -0.1}, "start_distance_m"),
        (paper_plant(), PRESS, {}, {"duration": 0.0}, "duration_s"),
    ],
)
def test_what_the_simulation_cannot_do_is_refused(
    plant: Plant, approach: Approach, effects: dict[str, object], options: dict[str, float], text: str
) -> None:
    with pytest.raises(ParameterError, match=text):
        simulate_nonlinear(
            plant,
            FIRM,
            approach,
            sample_time_s=PERIOD_S,
            duration_s=options.get("duration", 0.1),
            effects=Nonlinearities(**effects),  # type: ignore[arg-type]
            start_distance_m=options.get("distance"),
            substeps=int(options.get("substeps", 10)),
            even_if_unstable=True,
        )


def test_an_operator_leads_the_payload_to_his_way_and_into_balance_with_the_wall() -> None:
    """At rest the admittance feels nothing, so that the hand's spring holds what the wall pushes back."""
    plant, law = paper_plant(stiffness=3e4, drag=100.0, coupling_damping=300.0), admittance(13.0, 1000.0, 0.013)
    ticks = np.arange(14_000)
    for end in (-0.05, 0.04):
        path = np.where(ticks < 500, -0.1, end)
        hand = Operator(mass_kg=2.0, damping_n_s_per_m=30.0, stiffness_n_per_m=900.0, path_m=path)
        run = simulate_operator(plant, law, hand, sample_time_s=PERIOD_S)
        there = end if end < 0.0 else 900.0 * end / (900.0 + 3e4)
        np.testing.assert_allclose(run.payload_position_m[:499], -0.1, rtol=0.0, atol=1e-12)
        assert run.payload_position_m[-1] == pytest.approx(there, rel=1e-3)
        assert run.contact_force_n[-1] == pytest.approx(max(0.0, 3e4 * there), rel=1e-3)
        assert run.sensor_force_n[-1] == pytest.approx(0.0, abs=0.1)
        assert (run.impact_time_s is None) == (end < 0.0)


@pytest.mark.parametrize(
    "effects", [NO_NONLINEARITIES, Nonlinearities(deadband=SUBTRACTIVE), LIMITED], ids=["none", "deadband", "limits"]
)
def test_leaps_over_samples_in_which_nothing_switches_change_nothing(effects: Nonlinearities) -> None:
    for plant in (paper_plant(stiffness=3e4), paper_plant(stiffness=1e5, environment_damping=60.0, robot=TWO_POLES)):
        law = admittance(20.0, 3500.0, 0.013, 0.01)
        runs = [
            simulate_nonlinear(
                plant,
                law,
                Approach(force_n=30.0),
                sample_time_s=PERIOD_S,
                duration_s=0.6,
                effects=effects,
                substeps=40,
                leaps=leaps,
            )
            for leaps in (False, True)
        ]
        np.testing.assert_allclose(runs[1].contact_force_n, runs[0].contact_force_n, rtol=0.0, atol=2e-5)
        assert runs[1].peak_contact_force_n == pytest.approx(runs[0].peak_contact_force_n, rel=1e-7)
        assert runs[1].impact_speed_m_s == runs[0].impact_speed_m_s


def test_a_hand_that_moves_pulls_with_its_mean_over_a_leap() -> None:
    path = -0.02 + 0.05 * PERIOD_S * np.minimum(np.arange(2500), 1400)
    hand = Operator(mass_kg=2.0, damping_n_s_per_m=30.0, stiffness_n_per_m=2000.0, path_m=path)
    plant, law = paper_plant(stiffness=5e4, drag=100.0, coupling_damping=300.0), admittance(20.0, 3500.0, 0.013)
    runs = [
        simulate_operator(plant, law, hand, sample_time_s=PERIOD_S, substeps=40, leaps=leaps) for leaps in (False, True)
    ]
    assert runs[0].peak_contact_force_n > 30.0
    assert runs[1].peak_contact_force_n == pytest.approx(runs[0].peak_contact_force_n, rel=1e-5)
    np.testing.assert_allclose(runs[1].payload_position_m, runs[0].payload_position_m, rtol=0.0, atol=5e-8)


def test_a_plant_that_turns_too_fast_is_crossed_in_steps() -> None:
    run = {}
    for leaps in (False, True):
        plant = paper_plant(stiffness=2e6, mass=3.0)
        run[leaps] = simulate_nonlinear(
            plant,
            admittance(20.0, 3500.0, 0.013),
            Approach(force_n=30.0),
            sample_time_s=PERIOD_S,
            duration_s=0.1,
            leaps=leaps,
            even_if_unstable=True,
        )
    np.testing.assert_array_equal(run[True].contact_force_n, run[False].contact_force_n)


def test_a_hand_of_no_impedance_leaves_the_payload_where_it_is() -> None:
    nothing = Operator(mass_kg=0.0, damping_n_s_per_m=0.0, stiffness_n_per_m=0.0, path_m=np.linspace(-0.1, 0.1, 500))
    run = simulate_operator(paper_plant(), admittance(13.0, 1600.0, 0.02), nothing, sample_time_s=PERIOD_S)
    np.testing.assert_allclose(run.payload_position_m, -0.1, rtol=0.0, atol=1e-12)
