"""Noise on its way from the force sensor to the command: closed forms, seeded simulations, laws."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from problems.model.controller import AdmittanceController
from problems.model.plant import Environment, PayloadDynamics, Plant
from problems.model.response import controller_response, loop_response
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_loop
from problems.stability.noise import command_speed_gain
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.random_loops import sampled_of, stable_loops


def open_plant(delay_samples: float = 3.0) -> SampledPlant:
    """Return a payload on a coupling so soft that no force comes back: the admittance alone."""
    return sampled_of(paper_plant(stiffness=0.0, coupling=1e-3, robot=one_pole(delay_samples * PERIOD_S)))


def impulse_sum(first: float, second: float, third: float, pole: float) -> float:
    """Return the sum of the squared impulse response of (b_0 + b_1/z + b_2/z²)/(1 − p/z)."""
    one = second + pole * first
    rest = third + pole * one
    return first**2 + one**2 + rest**2 / (1.0 - pole**2)


@pytest.mark.parametrize("delay_samples", [0.0, 2.4, 3.0])
@pytest.mark.parametrize("lead", [0.0, 0.005, 0.013, 0.03])
def test_the_admittance_alone_has_its_closed_form(lead: float, delay_samples: float) -> None:
    """The speed from tick to tick is (1 + z⁻¹)/2 times the Tustin form of (1 + K_l s)/(M_a s + B_a)."""
    mass, damping, h, noise = 13.0, 1000.0, PERIOD_S, 0.7
    found = noise * command_speed_gain(open_plant(delay_samples), admittance(mass, damping, lead))
    scale = 2.0 * mass + damping * h
    pole, b0, b1 = (2.0 * mass - damping * h) / scale, (h + 2.0 * lead) / scale, (h - 2.0 * lead) / scale
    speed = impulse_sum(0.5 * b0, 0.5 * (b0 + b1), 0.5 * b1, pole)
    # What comes back through the coupling is K_s/(B_a ...) = 1e-6 of the noise at the slowest; the rest is rounding.
    assert found == pytest.approx(noise * math.sqrt(speed), rel=1e-6)


def test_a_lead_of_the_time_constant_passes_noise_through_the_damping_alone() -> None:
    """K_l = M_a/B_a: the speed is the mean of two samples over B_a."""
    found = command_speed_gain(open_plant(), admittance(13.0, 1000.0, 0.013))
    assert found == pytest.approx(1.0 / (1000.0 * math.sqrt(2.0)), rel=1e-6)


def test_a_rigid_contact_has_the_closed_form_of_a_first_order_loop() -> None:
    """x^d_k: x_{k+1} = x^d_k at once, F = −K x, Tustin integrator: poles of 2 B_a z (z − 1) + K h (z + 1)."""
    robot = one_pole(0.0, 40.0 / PERIOD_S)  # settles to e^−40 within a sample
    plant = replace(
        paper_plant(stiffness=2e4, coupling=1e6, robot=robot), payload=PayloadDynamics(mass_kg=1e-6, drag_n_s_per_m=1.0)
    )
    damping, noise = 200.0, 1.5
    found = noise * command_speed_gain(sampled_of(plant), admittance(0.01 * damping, damping, 0.01))
    # X^d/n = g (1 + z⁻¹)/(1 − (1 − κ) z⁻¹ + κ z⁻²) with g = h/(2 B_a), κ = g K: covariances of a second-order filter.
    g = PERIOD_S / (2.0 * damping)
    kappa = g / (1.0 / 2e4 + 1.0 / 1e6)
    c1 = (1.0 - kappa) / (1.0 + kappa)  # r(1)/r(0) of 1/(1 − (1 − κ)/z + κ/z²)
    c2 = (1.0 - kappa) * c1 - kappa
    variance = (1.0 + kappa) / ((1.0 - kappa) * ((1.0 + kappa) ** 2 - (1.0 - kappa) ** 2))
    # (1 − z⁻²): 2 r(0) − 2 r(2).
    assert found == pytest.approx(noise * g * math.sqrt(2.0 * variance * (1.0 - c2)) / PERIOD_S, rel=1e-5)


CASES = [
    pytest.param(paper_plant(stiffness=3e4), admittance(feedback=7.5e-3), id="contact, feedback damping"),
    pytest.param(paper_plant(stiffness=0.0), admittance(lead=0.02), id="free space, lead"),
    pytest.param(
        paper_plant(stiffness=0.0, robot=one_pole(1.3 * PERIOD_S)),
        AdmittanceController(mass_kg=20.0, damping_n_s_per_m=1500.0, lead_s=0.01, compensation_mass_kg=8.0),
        id="free space, fraction, compensation",
    ),
    pytest.param(
        paper_plant(stiffness=2e5, coupling_damping=300.0, robot=one_pole(0.0)),
        replace(admittance(damping=4000.0), discretization="backward_euler"),
        id="no delay, damped coupling, backward Euler",
    ),
]


@pytest.mark.parametrize(("plant", "controller"), CASES)
def test_a_long_simulation_has_the_predicted_rms(plant: Plant, controller: AdmittanceController) -> None:
    """Two million ticks at most, from rest, as averages over independent runs."""
    loop, rng, noise = build_loop(sampled_of(plant), controller), np.random.default_rng(71), 0.8
    runs, ticks = 1000, 2000
    state = np.zeros((len(loop.a), runs))
    command = np.empty((ticks, runs))
    for k in range(ticks):
        n = noise * rng.standard_normal(runs)
        command[k] = loop.c_command @ state + loop.d_command * n
        state = loop.a @ state + np.outer(loop.b, n)
    late = command[ticks // 2 :]
    speed = np.diff(late, axis=0) / PERIOD_S
    found = noise * command_speed_gain(sampled_of(plant), controller)
    # A thousand runs are independent: even if the ticks of a run were one, the RMS would have 1/√2000 = 2.2 %; three
    # times that. With 0.8 s before it, what is left of the start is below e^−3 of loops that settle in 0.25 s.
    assert np.sqrt(np.mean(speed**2)) == pytest.approx(found, rel=0.06)


def test_random_loops_have_the_integral_of_their_response() -> None:
    """σ² = (1/π) ∫ |H(e^{jθ})|² dθ over [0, π], H = (1 − z⁻¹) A(1 + C_ff)/(1 + C_fb X) S: by Parseval."""
    for sampled, controller in stable_loops(np.random.default_rng(72), 4, below=0.998):

        def density(angle: float, sampled: SampledPlant = sampled, c: AdmittanceController = controller) -> float:
            z = np.exp(1j * np.array([angle]))
            forward, _ = controller_response(c, z, PERIOD_S)
            response = loop_response(sampled, c, np.array([angle / PERIOD_S]))
            # x^d per noise is the forward path over 1 + L_x.
            return float(np.abs((1.0 - 1.0 / z) * forward / (1.0 + response.at_command))[0] ** 2)

        # Poles stand 2e-3 off the circle at least: decades of the angle, each smooth at that scale.
        ends = [1e-7, 1e-3, 3e-3, 1e-2, *np.geomspace(0.02, math.pi, 30)]
        parts = [quad(density, a, b, limit=200, epsrel=1e-7)[0] for a, b in itertools.pairwise(ends)]
        found = command_speed_gain(sampled, controller)
        assert found * PERIOD_S == pytest.approx(math.sqrt(sum(parts) / math.pi), rel=1e-5)


@pytest.mark.parametrize(
    "environment",
    [Environment(stiffness_n_per_m=0.0), Environment(stiffness_n_per_m=0.0, damping_n_s_per_m=500.0)],
    ids=["nothing", "a dashpot"],
)
def test_without_an_anchor_the_speed_is_that_on_the_softest_spring(environment: Environment) -> None:
    """A spring of 0.1 N/m holds the command back over minutes, which the difference of two ticks does not see."""
    found, held = (
        command_speed_gain(sampled_of(paper_plant(stiffness=0.0).in_contact_with(each)), admittance())
        for each in (environment, replace(environment, stiffness_n_per_m=0.1))
    )
    assert 0.0 < found < 1.0
    assert held == pytest.approx(found, rel=1e-4)


def test_more_lead_means_more_noise() -> None:
    """ANCHORS and design bounds: K_l/M_a is what noise is multiplied by at high frequency."""
    found = [command_speed_gain(open_plant(), admittance(lead=lead)) for lead in (0.013, 0.02, 0.03, 0.04)]
    assert all(b > a for a, b in itertools.pairwise(found))


def test_a_robot_of_higher_order_changes_what_comes_back_only() -> None:
    robot = RobotModel(
        numerator=np.array([4e4]), denominator=np.convolve([1.0, 20.0], [1.0, 60.0, 2e3]), delay_s=1.9e-3
    )
    sampled = sampled_of(paper_plant(stiffness=0.0, coupling=1e-3, robot=robot))
    alone, other = (command_speed_gain(plant, admittance()) for plant in (open_plant(), sampled))
    # As above: 1e-6 of the noise comes back.
    assert other == pytest.approx(alone, rel=1e-6)
