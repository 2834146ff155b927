"""The laws of two public controllers against their own update rules, played step by step, and the traps in them."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from problems.contact.linear_controller_contact import force_per_speed, simulate_linear_contact
from problems.contact.transient import Approach, build_sampled_contact
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.hold import hold
from problems.model.plant import FREE_SPACE, Plant, build_plant_matrices
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius
from problems.model.third_party_controllers import ForwardDynamics, SpringAdmittance, alternates
from tests.problems.axes import PERIOD_S, one_pole, paper_plant
from tests.problems.update_rules import Rule, stepped


def spring_admittance(
    *, joint_damping: float = 0.0, filter_coefficient: float = 1.0, stiffness: float = 4.0
) -> SpringAdmittance:
    return SpringAdmittance(
        mass=9.0,
        damping_ratio=150.0,
        stiffness=stiffness,
        joint_damping_per_s=joint_damping,
        filter_coefficient=filter_coefficient,
    )


def played_spring_admittance(rule: SpringAdmittance, h: float) -> Rule:
    """ros2_controllers' update of one joint whose motion is the axis: reference at 0, offset and speed kept."""
    wrench = speed = offset = 0.0

    def update(force: float, measured: float) -> float:
        nonlocal wrench, speed, offset
        wrench = rule.filter_coefficient * force + (1.0 - rule.filter_coefficient) * wrench
        damping = rule.damping_ratio * 2 * math.sqrt(rule.mass * rule.stiffness)
        acceleration = (wrench - damping * speed - rule.stiffness * measured) / rule.mass
        acceleration -= rule.joint_damping_per_s * speed
        speed += acceleration * h
        offset += speed * h
        return offset

    return update


def played_forward_dynamics(rule: ForwardDynamics) -> Rule:
    """cartesian_controllers' update: positions from the sensor, the old speed into them, then the new speed."""
    speed = error = 0.0

    def update(force: float, measured: float) -> float:
        nonlocal speed, error
        pushed = rule.proportional * force + rule.derivative * (force - error) / 0.02
        error = force
        position = measured + speed * 0.02
        speed = 0.9 * (speed + pushed / 1.0 * 0.02)
        return position

    return update


RULES = {
    "spring": (spring_admittance().law(PERIOD_S), played_spring_admittance(spring_admittance(), PERIOD_S)),
    "spring, defaults": (
        spring_admittance(joint_damping=5.0, filter_coefficient=0.05).law(PERIOD_S),
        played_spring_admittance(spring_admittance(joint_damping=5.0, filter_coefficient=0.05), PERIOD_S),
    ),
    "forward dynamics": (
        ForwardDynamics(proportional=0.02, derivative=3e-4).law(PERIOD_S),
        played_forward_dynamics(ForwardDynamics(proportional=0.02, derivative=3e-4)),
    ),
}


@pytest.mark.parametrize("name", RULES)
def test_the_law_is_the_update_rule(name: str) -> None:
    law, played = RULES[name]
    ours, rng = stepped(law), np.random.default_rng(5)
    for force, measured in zip(rng.normal(0.0, 20.0, 300), rng.normal(0.0, 1e-3, 300), strict=True):
        assert ours(force, measured) == pytest.approx(played(force, measured), rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("name", ["spring", "forward dynamics"])
def test_the_contact_is_that_of_the_rule_played_against_the_wall(name: str) -> None:
    """From rest through the approach into the wall, in twentieths of a sample, with nothing of the matrices' code."""
    plant = paper_plant(stiffness=6e4, drag=330.0, coupling_damping=150.0)
    slow = ForwardDynamics(proportional=0.004, derivative=8e-5)
    law, played = {
        "spring": (RULES["spring"][0], played_spring_admittance(spring_admittance(), PERIOD_S)),
        "forward dynamics": (slow.law(PERIOD_S), played_forward_dynamics(slow)),
    }[name]
    pair = build_sampled_contact(build_sampled_plant(plant, PERIOD_S))
    predicted = simulate_linear_contact(pair, law, Approach(force_n=20.0))
    # A second of approach is enough for a steady speed.
    sensor, contact = _replayed(plant, played, 20.0, -predicted.contact_speed_m_s * 1.0)
    # The spring's pull over the approach (0.04 N) and the moment of touching inside a sample differ.
    assert contact == pytest.approx(predicted.peak_contact_force_n, rel=0.01)
    assert sensor == pytest.approx(predicted.peak_sensor_force_n, rel=0.01)


def _replayed(plant: Plant, played: Rule, force: float, start: float) -> tuple[float, float]:
    """Return the peaks of F and F_e after a start from rest, the wall's force as a push on a payload in free space."""
    free = build_plant_matrices(plant.in_contact_with(FREE_SPACE), PERIOD_S)
    phi, gamma = hold(free.a, np.stack([free.b, free.push], axis=1), 1.0 / 20.0)
    state, commands = np.zeros(3), [0.0] * 4
    sensor = contact = 0.0
    touched = False
    for _ in range(2200):
        touched = touched or state[1] + start > 0.0
        felt = float(free.c_force @ state) + free.d_force * commands[-3]
        sensor = max(sensor, -felt) if touched else sensor
        commands = [*commands[-3:], played(force + felt, float(free.c_position @ state))]
        for _ in range(20):
            pressed = plant.environment.stiffness_n_per_m * max(float(state[1]) + start, 0.0)
            contact = max(contact, pressed)
            state = phi @ state + gamma @ np.array([commands[-4], -pressed])
    return sensor, contact


def test_without_stiffness_there_is_no_damping_and_the_joints_default_adds_five_masses() -> None:
    loose = SpringAdmittance(
        mass=9.0, damping_ratio=150.0, stiffness=0.0, joint_damping_per_s=0.0, filter_coefficient=1.0
    )
    assert loose.damping == loose.total_damping == 0.0
    pair = build_sampled_contact(build_sampled_plant(paper_plant(stiffness=6e4), PERIOD_S))
    plain, damped = (spring_admittance(joint_damping=j).law(PERIOD_S) for j in (0.0, 5.0))
    assert force_per_speed(pair, damped) - force_per_speed(pair, plain) == pytest.approx(5.0 * 9.0, rel=1e-9)


def test_the_default_filter_is_a_low_pass_at_four_hertz_and_38_ms_late_at_500_hz() -> None:
    h = 2e-3
    filtered, plain = (spring_admittance(filter_coefficient=a).law(h) for a in (0.05, 1.0))

    def of_the_filter(frequency_hz: float) -> complex:
        z = np.exp(2j * np.pi * np.array([frequency_hz]) * h)
        return complex((filtered.gains(z)[0] / plain.gains(z)[0])[0])

    assert abs(of_the_filter(4.1)) == pytest.approx(math.sqrt(0.5), rel=0.01)
    slow_hz = 0.05
    late = -np.angle(of_the_filter(slow_hz)) / (2.0 * np.pi * slow_hz)
    assert late == pytest.approx(0.038, rel=1e-3)


def test_the_virtual_mass_is_not_free_and_its_damping_goes_with_the_update_rate() -> None:
    """On a robot that is where it is told to be, the rendered damping is h e/(0.02 v) = 0.1 h/(0.9 0.02² P)."""
    for h in (8e-4, 2e-3):
        for gain in (0.01, 0.05):
            law = ForwardDynamics(proportional=gain, derivative=0.0).law(h)
            played, position, speeds = stepped(law), 0.0, []
            for _ in range(400):
                following = played(1.0, position)
                speeds.append((following - position) / h)
                position = following
            assert 1.0 / speeds[-1] == pytest.approx(0.1 * h / (0.9 * 0.02**2 * gain), rel=1e-6)
            # What is left of the last speed falls by 0.9 in a cycle, whatever the gain.
            left = 1.0 - np.array(speeds) / speeds[-1]
            np.testing.assert_allclose(left[2:40] / left[1:39], 0.9, rtol=1e-6)


def test_the_euler_rule_has_another_smallest_damping_than_the_trapezoidal_one() -> None:
    sampled = build_sampled_plant(
        paper_plant(stiffness=5e4, coupling_damping=150.0, robot=one_pole(bandwidth_rad_per_s=60.0)), PERIOD_S
    )

    def smallest(stable: Callable[[float], bool]) -> float:
        low, high = 10.0, 20000.0
        while high / low > 1.0 + 1e-4:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if stable(middle) else (middle, high)
        return high

    def tustin(damping: float) -> bool:
        law = AdmittanceController(mass_kg=10.0, damping_n_s_per_m=damping)
        return spectral_radius(build_loop(sampled, law)) < 1.0

    def euler(damping: float) -> bool:
        rule = SpringAdmittance(
            mass=10.0,
            damping_ratio=damping / (2.0 * math.sqrt(10.0 * 1e-6)),
            stiffness=1e-6,
            joint_damping_per_s=0.0,
            filter_coefficient=1.0,
        )
        return spectral_radius(build_loop(sampled, rule.law(PERIOD_S))) < 1.0

    assert abs(smallest(euler) / smallest(tustin) - 1.0) > 0.01


@pytest.mark.parametrize("values", [{"mass": 0.0}, {"stiffness": -1.0}, {"filter_coefficient": 0.0}])
def test_numbers_out_of_range_are_refused(values: dict[str, float]) -> None:
    good = {"mass": 9.0, "damping_ratio": 1.0, "stiffness": 1.0, "joint_damping_per_s": 0.0, "filter_coefficient": 1.0}
    with pytest.raises(ParameterError):
        SpringAdmittance(**{**good, **values})


@pytest.mark.parametrize("gains", [(0.0, 0.0), (0.01, -1.0)])
def test_gains_out_of_range_are_refused(gains: tuple[float, float]) -> None:
    with pytest.raises(ParameterError):
        ForwardDynamics(proportional=gains[0], derivative=gains[1])


@pytest.mark.parametrize("coefficient", [1.0, 0.05])
@pytest.mark.parametrize(("joint_damping", "damping_ratio"), [(0.0, 936.0), (0.0, 939.0), (30.0, 914.0), (30.0, 917.0)])
def test_a_negative_own_pole_is_a_speed_that_changes_sign_in_every_cycle(
    coefficient: float, joint_damping: float, damping_ratio: float
) -> None:
    """After a push that ends, played by the peer's own update; h (D/M + J) = 1 lies between each two ratios."""
    rule = SpringAdmittance(
        mass=9.0,
        damping_ratio=damping_ratio,
        stiffness=4.0,
        joint_damping_per_s=joint_damping,
        filter_coefficient=1.0,
    )
    update = played_spring_admittance(rule, PERIOD_S)
    offsets = [update(force, 0.0) for force in (0.0, 50.0, 0.0, 0.0)]
    pushed, after = np.diff(offsets)[:2]
    assert after == pytest.approx(rule.own_pole(PERIOD_S) * pushed, rel=1e-9)
    filtered = replace(rule, filter_coefficient=coefficient).law(PERIOD_S)
    assert alternates(filtered) == (after < 0.0) == (damping_ratio in (939.0, 917.0))


def test_forward_dynamics_has_no_pole_that_changes_sign() -> None:
    assert not alternates(ForwardDynamics(proportional=0.02, derivative=0.003).law(PERIOD_S))
