import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from problems.model.response import free_space_admittance, loop_response
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_cut_loop
from problems.stability.passivity import prepare_port
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.random_loops import even, radius_of, random_controller, random_environment, random_plant, sampled_of
from tests.problems.reference import rendered_impedance


def real_part(sampled: SampledPlant, controller: AdmittanceController, omega: FloatArray | float) -> FloatArray:
    return np.asarray(free_space_admittance(sampled, controller, np.atleast_1d(omega)).real)


def port_radius(plant: SampledPlant, controller: AdmittanceController) -> float:
    """Return the spectral radius of robot and controller alone, its integrator left out, by another road.

    On a payload that hardly feels its coupling and is held by the ground, the loop through the force is open.
    """
    held = replace(
        plant.plant.in_contact_with(paper_plant(stiffness=1.0).environment),
        payload=replace(plant.plant.payload, mass_kg=1.0, drag_n_s_per_m=1e4),
        coupling=replace(plant.plant.coupling, stiffness_n_per_m=1e-6, damping_n_s_per_m=0.0),
    )
    # What is left of the integrator is 1 − K_s h/B_a, far closer to 1 than any pole that a port would have.
    cut = build_cut_loop(sampled_of(held), controller)
    poles = np.linalg.eigvals(cut.closed_at(cut.command)[: cut.state_count, : cut.state_count])
    slow = np.abs(poles - 1.0) < 1e-6
    return float(np.max(np.abs(poles[~slow])))


def random_ports(seed: int, count: int) -> list[tuple[SampledPlant, AdmittanceController]]:
    """Draw stable ports of every kind."""
    rng = np.random.default_rng(seed)
    out: list[tuple[SampledPlant, AdmittanceController]] = []
    while len(out) < count:
        sampled, controller = sampled_of(random_plant(rng, contact=False)), random_controller(rng)
        if port_radius(sampled, controller) < 0.9999:
            out.append((sampled, controller))
    return out


def test_a_delayed_robot_is_not_passive_and_the_frequency_is_where_the_phase_passes_90_degrees() -> None:
    sampled = sampled_of(paper_plant(stiffness=0.0))
    found = prepare_port(sampled).fails_above_hz(admittance(mass=10.0, damping=1000.0, lead=0.0))
    assert found is not None
    # Continuous closed form: phase of 1/(M_a s + B_a) · 20/(s + 20) · delay of T_d and half a sample.
    omega = 2.0 * np.pi * found
    phase = np.arctan(0.01 * omega) + np.arctan(omega / 20.0) + omega * (2.4e-3 + 0.5 * PERIOD_S)
    assert phase == pytest.approx(np.pi / 2.0, rel=2e-3)  # Tustin warps by (ωh)²/12, far below; the hold is 1e-3 here


def test_a_port_fails_just_above_its_frequency_and_nowhere_below_it() -> None:
    rng, failing = np.random.default_rng(51), 0
    for sampled, controller in random_ports(52, 60):
        found = prepare_port(sampled).fails_above_hz(controller)
        if found is None:
            continue
        failing += 1
        edge = 2.0 * math.pi * found
        # The edge is a sign change, bisected to rounding; Re G leaves zero in proportion to the distance from it.
        assert real_part(sampled, controller, edge * (1.0 + 1e-7))[0] < 0.0
        below = np.append(np.exp(rng.uniform(math.log(0.06), math.log(edge), 300)), edge * (1.0 - 1e-7))
        assert np.all(real_part(sampled, controller, np.minimum(below, edge * (1.0 - 1e-7))) >= 0.0)
    assert failing >= 50


def test_a_narrow_loss_of_passivity_is_found() -> None:
    """A pole with a damping ratio of 1e-4 just below its zero: the phase dips by 180° over a thousandth of 3 Hz."""
    pole, zero, light = 2.0 * math.pi * 3.0, 2.0 * math.pi * 3.003, 1e-4
    robot = RobotModel(
        numerator=np.array([1.0 / zero**2, 2.0 * light / zero, 1.0]),
        denominator=np.convolve([1.0 / pole**2, 2.0 * light / pole, 1.0], [1.0 / 60.0, 1.0]),
        delay_s=0.0,
    )
    sampled, controller = sampled_of(paper_plant(stiffness=0.0, robot=robot)), admittance(lead=0.0, mass=5.0)
    plain = np.geomspace(0.1, 2.0 * math.pi * 5.0, 800)
    assert np.all(real_part(sampled, controller, plain) > 0.0)
    found = prepare_port(sampled).fails_above_hz(controller)
    assert found is not None
    # In between the robot answers backwards.
    assert 3.0 * (1.0 - 3.0 * light) < found < 3.003


def test_an_unstable_port_is_passive_nowhere() -> None:
    """More compensation than M_a, filters and delay: Re G of such a port may well be positive, and means nothing."""
    sampled, unstable = sampled_of(paper_plant(stiffness=0.0, robot=one_pole(2.4e-3, 60.0))), 0
    for compensation in ("filtered", "ideal"):
        for mass in (2.0, 5.0, 9.0, 12.0, 20.0, 40.0):
            controller = AdmittanceController(
                mass_kg=10.0,
                damping_n_s_per_m=300.0,
                compensation_mass_kg=mass,
                compensation=compensation,
            )
            stable = port_radius(sampled, controller) < 1.0
            if not stable:
                unstable += 1
                assert prepare_port(sampled).fails_above_hz(controller) == 0.0
    assert 3 <= unstable <= 9


def energy_given(sampled: SampledPlant, controller: AdmittanceController, force: FloatArray, settled: int) -> float:
    """Push with `force` at the flange and return the work that goes into the port after `settled` ticks.

    The trapezoid of F over each step of x: for a sine it is Re G by the factor sin(ωh)/(ωh).
    """
    cut = build_cut_loop(sampled, controller)
    n, position = cut.state_count, np.zeros(len(force))
    m = cut.closed_at(cut.command)
    state = np.zeros(n)
    for k, pushed in enumerate(force):
        position[k] = sampled.c_position @ state[: sampled.state_count]
        state = m[:n, :n] @ state + m[:n, cut.force] * pushed
    late = slice(settled, None)
    mean = 0.5 * (force[late][1:] + force[late][:-1])
    return float(np.sum(mean * np.diff(position[late])))


@pytest.mark.parametrize(
    "controller",
    [
        admittance(mass=10.0, lead=0.0),
        admittance(),
        admittance(feedback=7.5e-3),
        AdmittanceController(mass_kg=20.0, damping_n_s_per_m=1500.0, compensation_mass_kg=5.0),
    ],
)
def test_below_the_frequency_a_force_only_loses_energy_and_above_it_gains(controller: AdmittanceController) -> None:
    """Ten seconds of a force that repeats itself; what goes in over a whole period is the port's to keep or to give."""
    sampled, rng = sampled_of(paper_plant(stiffness=0.0)), np.random.default_rng(55)
    edge = prepare_port(sampled).fails_above_hz(controller)
    assert edge is not None
    period = 2500  # two seconds: lines 0.5 Hz apart
    hertz = np.arange(period // 2 + 1) / (period * PERIOD_S)

    def force_of(chosen: NDArray[np.bool_]) -> FloatArray:
        lines = rng.uniform(0.5, 20.0, len(hertz)) * np.exp(2j * math.pi * rng.random(len(hertz)))
        once = np.fft.irfft(lines * chosen * (hertz > 0.0) * period, period)
        return np.append(np.tile(once, 3), once[0])

    for _ in range(3):
        assert energy_given(sampled, controller, force_of(hertz < 0.99 * edge), 2 * period) > 0.0
    # Just above the edge the sign is the other one.
    above = force_of((hertz > 1.02 * edge) & (hertz < 1.02 * edge + 1.0))
    assert energy_given(sampled, controller, above, 2 * period) < 0.0


def test_where_the_port_is_passive_no_passive_surface_turns_the_loop_to_the_critical_side() -> None:
    """Re G ≥ 0 and Re Ē ≥ 0 hold the phase of G Ē within ±180°: no crossing of the negative axis below the edge."""
    rng, seen = np.random.default_rng(56), 0
    for sampled, controller in random_ports(57, 60):
        edge = prepare_port(sampled).fails_above_hz(controller)
        if edge is None or edge < 0.5:
            continue
        omega = 2.0 * math.pi * np.geomspace(0.05, edge * 0.97, 400)
        touching = sampled.plant.in_contact_with(random_environment(rng))
        loop = loop_response(sampled_of(touching), controller, omega).at_force
        # The sampled force is G Ē but for the hold's share of a sample, 3 % of frequency below the edge.
        assert np.all(rendered_impedance(touching, np.asarray(1j * omega)).real >= 0.0)
        crossed = (np.sign(loop.imag[1:]) != np.sign(loop.imag[:-1])) & (loop.real[1:] < 0.0)
        assert not np.any(crossed)
        seen += 1
    assert seen >= 30


def test_a_passive_port_on_a_passive_surface_is_stable_when_the_rest_is_weak() -> None:
    """The theorem's other half: with |L| < 1 above the edge, a loop of a passive port below it cannot be unstable."""
    rng, seen = np.random.default_rng(58), 0
    for sampled, controller in random_ports(59, 60):
        edge = prepare_port(sampled).fails_above_hz(controller)
        assert edge is not None
        touching = sampled_of(
            sampled.plant.in_contact_with(
                paper_plant(stiffness=even(rng, 1e2, 1e5), environment_damping=50.0).environment
            )
        )
        above = np.geomspace(2.0 * math.pi * edge * 0.97, math.pi / PERIOD_S * (1.0 - 1e-9), 3000)
        if np.max(np.abs(loop_response(touching, controller, above).at_force)) < 0.98:
            seen += 1
            assert radius_of(touching, controller) < 1.0
    assert seen >= 5
