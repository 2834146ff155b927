import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from problems.contact.kernel_types import Wall
from problems.contact.leaps import Motion, wall_force
from problems.contact.nonlinearities import Nonlinearities
from problems.contact.transient import Approach
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant
from tests.problems.axes import PERIOD_S, PRESS, admittance, one_pole, paper_plant
from tests.problems.nonlinear_runs import COMPENSATING, FIRM, exactly, simulate, worst

NO_LEAP = np.zeros((0, 2, 3, 5))
TWO_POLES = RobotModel(numerator=np.array([900.0]), denominator=np.array([1.0, 48.0, 900.0]), delay_s=2.4e-3)


@pytest.mark.parametrize(
    ("delay", "coupling_damping", "controller", "approach"),
    [
        pytest.param(2.4e-3, 100.0, FIRM, PRESS, id="three samples"),
        pytest.param(2.4e-3, 0.0, COMPENSATING, Approach(force_n=30.0, driven_by="hand"), id="filtered, by hand"),
        pytest.param(2.0e-3, 100.0, COMPENSATING, PRESS, id="two and a half samples"),
        pytest.param(2.0e-3, 0.0, replace(COMPENSATING, compensation="ideal"), PRESS, id="ideal compensation"),
        pytest.param(2.2e-3, 0.0, replace(FIRM, discretization="backward_euler"), PRESS, id="two and three quarters"),
        pytest.param(0.0, 0.0, FIRM, Approach(speed_m_s=0.02, after_impact_n=10.0), id="no delay"),
    ],
)
def test_while_nothing_switches_the_error_falls_with_the_fourth_power_of_the_step(
    delay: float, coupling_damping: float, controller: AdmittanceController, approach: Approach
) -> None:
    plant = paper_plant(coupling_damping=coupling_damping, environment_damping=50.0, robot=one_pole(delay))
    exact = exactly(plant, controller, approach, 400)
    assert np.all(exact.contact_force_n[1:] > 0.0)
    errors = [worst(simulate(plant, controller, approach, substeps=n), exact) for n in (4, 8, 16)]
    # The next term of the error is one step further down: at 4 substeps of 0.2 rad it may shift the order by 0.1.
    np.testing.assert_allclose(np.log2(np.array(errors[:-1]) / errors[1:]), 4.0, atol=0.1)
    # Each step of a fast motion (390 rad/s) errs by (ωΔ)⁵/120 of a force of 50 N, and the motion decays within about
    # ten radians: at 8 substeps 50·10·0.039⁴/120 = 1e-5.
    assert errors[1] < 1e-5


@pytest.mark.parametrize("substeps", [10, 40])
@pytest.mark.parametrize(
    ("plant", "controller"),
    [
        pytest.param(
            paper_plant(mass=4.0, drag=50.0, coupling=3e4), admittance(damping=800.0, lead=0.01), id="undamped wall"
        ),
        pytest.param(
            paper_plant(
                mass=4.0,
                drag=20.0,
                coupling=3e4,
                coupling_damping=5.0,
                environment_damping=15.0,
                robot=one_pole(2.0e-3),
            ),
            admittance(damping=1500.0, lead=0.02, feedback=5e-3),
            id="dampers, half a sample",
        ),
    ],
)
def test_runs_that_leave_and_touch_again_agree_with_the_exact_transient(
    plant: Plant, controller: AdmittanceController, substeps: int
) -> None:
    exact, run = exactly(plant, controller, PRESS, 400), simulate(plant, controller, substeps=substeps)
    assert np.count_nonzero(np.diff(run.is_touching.astype(int)) == -1) >= 2
    # A kink inside a step Δ is missed by at most Δ, so v_p by K_e v Δ²/(2 M_p), a jump of B_e v by B_e v Δ/M_p; as a
    # force times √(K_e M_p). Two departures and returns at up to the speed of the swing, F/√(K_e M_p).
    step, stiffness, mass = PERIOD_S / substeps, plant.environment.stiffness_n_per_m, plant.payload.mass_kg
    speed = np.max(exact.contact_force_n) / math.sqrt(stiffness * mass)
    missed = stiffness * step**2 / 2.0 + plant.environment.damping_n_s_per_m * step
    assert worst(run, exact) < 4.0 * math.sqrt(stiffness * mass) * speed * missed / mass
    assert abs(run.time_of_peak_s - exact.time_of_peak_s) <= step
    # The peak is that of the substeps, half of one away at the most: cos(ωΔ/2) of the swing, ω = √(K_e/M_p).
    swing = (0.5 * step) ** 2 * stiffness / mass / 2.0 * exact.peak_contact_force_n
    assert abs(run.peak_contact_force_n - exact.peak_contact_force_n) < swing + worst(run, exact)


@pytest.mark.parametrize(
    ("position", "velocity", "force"),
    [(0.5, 0.0, 50.0), (0.5, 1.0, 57.0), (0.5, -20.0, 0.0), (0.0, 1.0, 7.0), (-1e-9, 100.0, 0.0), (-1.0, 0.0, 0.0)],
)
def test_the_wall_pushes_behind_its_surface_and_never_pulls(position: float, velocity: float, force: float) -> None:
    motion = Motion(np.zeros((3, 5)), np.zeros((3, 4)), Wall(100.0, 7.0, 0.0, 1.0), 3, 3, 0.0, (0, 1), NO_LEAP)
    assert wall_force(motion, position, velocity) == pytest.approx(force, rel=1e-15)


@pytest.mark.parametrize("driven_by", ["desired_force", "hand"])
def test_work_is_stored_or_dissipated(driven_by: str) -> None:
    """Balance of payload, coupling and wall, whose flange is moved by a robot of two poles: no power jumps."""
    plant = paper_plant(stiffness=3e4, coupling_damping=80.0, environment_damping=60.0, robot=TWO_POLES)
    approach = Approach(speed_m_s=0.05, driven_by=driven_by, after_impact_n=20.0)  # type: ignore[arg-type]
    k_s, b_s, m_p, b_p, k_e, b_e, _ = plant.parameters()
    gaps = []
    for h in (2e-4, 1e-4):
        run = simulate(plant, approach=approach, h=h, duration=0.3)
        assert np.all(run.is_touching)
        x, v, x_p, v_p = (
            run.flange_position_m,
            run.flange_velocity_m_s,
            run.payload_position_m,
            run.payload_velocity_m_s,
        )
        stored = 0.5 * (m_p * v_p**2 + k_s * (x_p - x) ** 2 + k_e * x_p**2)
        work = run.sensor_force_n * v + (20.0 if driven_by == "hand" else 0.0) * v_p
        lost = b_p * v_p**2 + b_s * (v_p - v) ** 2 + b_e * v_p**2
        gap = np.trapezoid(work - lost, run.time_s) - (stored[-1] - stored[0])
        gaps.append(abs(gap) / np.trapezoid(np.abs(work), run.time_s))
    # The trapezoidal rule on powers that swing at twice 440 rad/s errs by (880 h)²/12 of the part that swings.
    assert gaps[1] < 6.5e-4
    assert gaps[0] / gaps[1] == pytest.approx(4.0, rel=0.05)


def test_small_noise_passes_through_the_linear_loop() -> None:
    plant = paper_plant(stiffness=1e5)
    clean, noisy = (simulate(plant, effects=Nonlinearities(force_noise_rms_n=rms), seed=3) for rms in (0.0, 0.14))
    assert np.all(noisy.is_touching[1:])
    loop = build_loop(build_sampled_plant(plant, PERIOD_S), FIRM)
    state, forces, commands = np.zeros(len(loop.a)), [], []
    for noise in -(noisy.seen_force_n - noisy.sensor_force_n):
        forces.append(float(loop.c_force @ state) + loop.d_force * noise)
        commands.append(float(loop.c_command @ state) + loop.d_command * noise)
        state = loop.a @ state + loop.b * noise
    # Fourth order at 10 substeps: 1e-8 of the forces (0.1 N).
    np.testing.assert_allclose(clean.sensor_force_n - noisy.sensor_force_n, forces, atol=1e-7)
    np.testing.assert_allclose(noisy.command_m - clean.command_m, commands, atol=1e-12)


def test_the_variance_of_force_and_command_is_that_of_the_linear_loop() -> None:
    plant, rms = paper_plant(stiffness=1e5), 0.14
    run = simulate(plant, effects=Nonlinearities(force_noise_rms_n=rms), seed=4, duration=240.0)
    loop = build_loop(build_sampled_plant(plant, PERIOD_S), FIRM)
    covariance = solve_discrete_lyapunov(loop.a, rms**2 * np.outer(loop.b, loop.b))
    settled = slice(5000, None)
    slowest = -1.0 / np.log(np.max(np.abs(np.linalg.eigvals(loop.a))))
    # So many independent pieces of twice the slowest time constant know a deviation to 1/√(2 n): four of these.
    share = 4.0 / math.sqrt(2.0 * (len(run.time_s) - 5000) / (2.0 * slowest))
    assert share < 0.25
    force = math.sqrt(loop.c_force @ covariance @ loop.c_force + (loop.d_force * rms) ** 2)
    command = math.sqrt(loop.c_command @ covariance @ loop.c_command + (loop.d_command * rms) ** 2)
    assert np.std(run.sensor_force_n[settled]) == pytest.approx(force, rel=share)
    assert np.std(run.command_m[settled]) == pytest.approx(command, rel=share)


@pytest.mark.parametrize("delay_samples", [0.0, 3.0, 2.4])
def test_a_command_that_does_not_arrive_leaves_the_robot_with_the_one_before(delay_samples: float) -> None:
    """The flange follows, by the closed form of a lag, what arrives: where that is late, the command before."""
    rate, share, h = 20.0, 0.3, PERIOD_S
    robot = RobotModel(numerator=np.array([rate]), denominator=np.array([1.0, rate]), delay_s=delay_samples * h)
    effects = Nonlinearities(late_share=share)
    run = simulate(paper_plant(stiffness=1e5, robot=robot), effects=effects, seed=5, duration=0.2, distance=1e-3)
    count = len(run.time_s)
    late = np.random.default_rng(5).random(count) < share
    whole = math.floor(delay_samples + 1e-9)
    fraction = delay_samples - whole
    place = acting = -1e-3
    for k in range(count - 1):
        assert run.flange_position_m[k] == pytest.approx(place, abs=1e-12)
        sent = run.command_m[k - whole] if k >= whole else -1e-3
        newer = acting if late[k] else sent
        for held, part in ((acting if fraction > 1e-9 else newer, fraction), (newer, 1.0 - fraction)):
            place = held + (place - held) * math.exp(-rate * part * h)
        acting = newer


def test_late_commands_cost_as_much_as_a_longer_delay() -> None:
    """With half of them late a command is held for one sample more on average: the peak lies between the two delays."""
    plant = paper_plant(stiffness=1e5)
    later = replace(plant, robot=replace(plant.robot, delay_s=plant.robot.delay_s + 2.0 * PERIOD_S))
    clean, shaken, delayed = (
        simulate(of, effects=Nonlinearities(late_share=share), seed=1).peak_contact_force_n
        for of, share in ((plant, 0.0), (plant, 0.5), (later, 0.0))
    )
    assert clean < shaken < delayed
