import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from problems.arrays import ComplexArray, FloatArray
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.response import loop_response
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_loop, build_sampled_plant, spectral_radius
from problems.stability.margins import UnstableLoopError, find_margins, frequency_grid, margins_on_grid, prepare_margins
from tests.problems.axes import (
    DELAY_S,
    LAW,
    PERIOD_S,
    WHOLE_DELAYS,
    admittance,
    controllers,
    one_pole,
    paper_plant,
    plants,
)
from tests.problems.reference import closed_loop

NYQUIST = math.pi / PERIOD_S
BRUTE_FORCE_POINTS = 200_000

# Named designs, each stable: lead, feedback damping, high damping on a stiff wall, light payload, free space.
NAMED = [
    (paper_plant(stiffness=3e4), admittance(feedback=7.5e-3)),
    (paper_plant(stiffness=5e5), admittance(damping=3000.0, lead=0.02)),
    (paper_plant(stiffness=2e5, mass=3.0, robot=one_pole(1.9e-3)), admittance(damping=2500.0, lead=0.01)),
    (paper_plant(stiffness=0.0), admittance(lead=0.02)),
]


def sampled_of(plant: Plant) -> SampledPlant:
    return build_sampled_plant(plant, PERIOD_S)


def radius_of(sampled: SampledPlant, controller: AdmittanceController) -> float:
    return spectral_radius(build_loop(sampled, controller))


def brute_force(grid: FloatArray, loop: ComplexArray) -> tuple[float, float, float, float]:
    """Read modulus, gain, phase and delay margin off neighbouring points without interpolating."""
    flips = np.flatnonzero((np.abs(loop[1:]) > 1.0) != (np.abs(loop[:-1]) > 1.0))
    angles = np.angle(-loop[flips])
    real = np.flatnonzero((np.sign(loop.imag[1:]) != np.sign(loop.imag[:-1])) & (loop.real[1:] < 0.0))
    decibels = np.append(np.abs(20.0 * np.log10(np.abs(loop[real]))), np.inf)
    return (
        float(np.min(np.abs(1.0 + loop))),
        float(np.min(decibels)),
        float(np.degrees(np.min(np.append(np.abs(angles), np.inf)))),
        float(np.min(np.append(np.mod(angles, 2.0 * np.pi) / grid[flips], np.inf))),
    )


@pytest.mark.parametrize(("plant", "controller"), NAMED)
def test_margins_are_those_of_200000_frequencies(plant: Plant, controller: AdmittanceController) -> None:
    sampled = sampled_of(plant)
    grid = np.geomspace(0.2, NYQUIST * (1.0 - 1e-9), BRUTE_FORCE_POINTS)
    response = loop_response(sampled, controller, grid)
    found = find_margins(sampled, controller)
    at = [brute_force(grid, loop) for loop in (response.at_force, response.at_command)]
    modulus, gain_db, phase_deg, delay_s = (min(values) for values in zip(*at, strict=True))
    # A minimum is flat, so a grid misses it by the square of its step of 4e-5 in ln ω; it never finds a lower one.
    assert found.modulus <= modulus * (1.0 + 1e-9)
    assert found.modulus == pytest.approx(modulus, rel=1e-6)
    # Crossovers are read one step off, and L turns and shrinks at most 30 times as fast as ln ω: 30 · 4e-5.
    assert found.gain_db == pytest.approx(gain_db, abs=20.0 * math.log10(1.0 + 1.2e-3))
    assert found.phase_deg == pytest.approx(phase_deg, abs=math.degrees(1.2e-3))
    assert found.delay_s == pytest.approx(delay_s, rel=5e-3)
    worst = loop_response(sampled, controller, np.array([2.0 * np.pi * found.modulus_hz]))
    assert min(abs(1.0 + worst.at_force[0]), abs(1.0 + worst.at_command[0])) == pytest.approx(found.modulus, rel=1e-9)
    assert found.spectral_radius == radius_of(sampled, controller)


def louder(sampled: SampledPlant, factor: float, *, at_force: bool) -> SampledPlant:
    """Multiply the loop's gain by `factor` at one break point."""
    if at_force:
        return replace(sampled, c_force=factor * sampled.c_force, d_force=factor * sampled.d_force)
    return replace(
        sampled,
        gamma=factor * sampled.gamma,
        gamma_old=factor * sampled.gamma_old,
        d_force=factor * sampled.d_force,
    )


@pytest.mark.parametrize(("plant", "controller"), NAMED[:3])
def test_the_gain_margin_is_where_a_louder_or_softer_loop_begins_to_grow(
    plant: Plant, controller: AdmittanceController
) -> None:
    sampled = sampled_of(plant)
    margin_db = find_margins(sampled, controller).gain_db

    def radii(decibels: float) -> list[float]:
        factors = [10.0 ** (sign * decibels / 20.0) for sign in (1.0, -1.0)]
        return [radius_of(louder(sampled, f, at_force=a), controller) for f in factors for a in (True, False)]

    # A part in 10⁴ is far outside the precision of the search and inside any use.
    assert all(max(radii(share * margin_db)) < 1.0 for share in (0.25, 0.5, 0.75, 0.9999))
    assert max(radii(1.0001 * margin_db)) > 1.0


def later(plant: Plant, extra_s: float) -> SampledPlant:
    robot = plant.robot
    slower = RobotModel(numerator=robot.numerator, denominator=robot.denominator, delay_s=robot.delay_s + extra_s)
    return sampled_of(
        Plant(robot=slower, coupling=plant.coupling, payload=plant.payload, environment=plant.environment)
    )


def delay_margin_at(sampled: SampledPlant, controller: AdmittanceController, *, at_force: bool) -> float:
    grid = np.linspace(0.5, NYQUIST, BRUTE_FORCE_POINTS)
    response = loop_response(sampled, controller, grid)
    return float(margins_on_grid(grid, response.at_force if at_force else response.at_command).delay_s)


@pytest.mark.parametrize(("plant", "controller"), NAMED[:3])
def test_the_delay_margin_at_the_command_is_the_delay_that_the_robot_may_gain(
    plant: Plant, controller: AdmittanceController
) -> None:
    lost = next(s for s in range(100) if radius_of(later(plant, s * PERIOD_S), controller) >= 1.0)
    low, high = (lost - 1) * PERIOD_S, lost * PERIOD_S
    margin = delay_margin_at(sampled_of(plant), controller, at_force=False)
    # Whole samples of delay are e^{-jωτ} exactly, so the margin lies in the sample in which the loop is lost.
    assert low < margin < high
    for _ in range(12):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if radius_of(later(plant, middle), controller) < 1.0 else (low, middle)
    # Inside a sample the held command is smoother than e^{-jωτ}, by (ωh)²/8: under 1 % of a sample up to 100 Hz.
    assert low == pytest.approx(margin, abs=0.01 * PERIOD_S)
    assert find_margins(sampled_of(plant), controller).delay_s <= margin * (1.0 + 1e-6)


@pytest.mark.parametrize(("plant", "controller"), NAMED[:2])
def test_the_delay_margin_at_the_force_is_how_late_the_sensor_may_be(
    plant: Plant, controller: AdmittanceController
) -> None:
    margin = delay_margin_at(sampled_of(plant), controller, at_force=True)
    whole = round(plant.robot.delay_s / PERIOD_S)
    radii = [
        np.max(np.abs(closed_loop(plant, controller, PERIOD_S, whole, force_delay=samples).poles()))
        for samples in (math.floor(margin / PERIOD_S), math.ceil(margin / PERIOD_S))
    ]
    assert radii[0] < 1.0 < radii[1]
    assert find_margins(sampled_of(plant), controller).delay_s <= margin * (1.0 + 1e-6)


@LAW
@given(plants(WHOLE_DELAYS, contact=True), controllers(), st.integers(1, 3))
def test_a_sample_of_delay_costs_a_sample_of_delay_margin(
    plant: Plant, controller: AdmittanceController, samples: int
) -> None:
    """|L_x| stays and its phase falls by ω h: exact, whatever the loop, as long as it stays stable."""
    assume(radius_of(sampled_of(plant), controller) < 0.9999)
    extra = samples * PERIOD_S
    assume(radius_of(later(plant, extra), controller) < 0.9999)
    grid = frequency_grid(sampled_of(plant))
    loop = loop_response(sampled_of(plant), controller, grid).at_command
    delayed = loop_response(later(plant, extra), controller, grid).at_command
    np.testing.assert_allclose(delayed, loop * np.exp(-1j * grid * extra), rtol=1e-9)
    before, after = float(margins_on_grid(grid, loop).delay_s), float(margins_on_grid(grid, delayed).delay_s)
    # The same crossovers are interpolated in both: rounding. A design may have none: then both are infinite.
    assert after == pytest.approx(before - extra, abs=1e-9)


@pytest.mark.parametrize(("plant", "controller"), NAMED[:2])
def test_all_margins_fall_when_the_robot_becomes_later(plant: Plant, controller: AdmittanceController) -> None:
    rows = [find_margins(later(plant, s * PERIOD_S), controller) for s in (0.0, 0.5, 1.0, 1.5, 2.0)]
    for name in ("modulus", "gain_db", "phase_deg", "delay_s"):
        values = [getattr(row, name) for row in rows]
        assert all(second < first for first, second in itertools.pairwise(values)), (name, values)


@pytest.mark.parametrize("samples", [0, 1, 3])
@pytest.mark.parametrize("gain", [0.02, 0.1])
def test_a_light_payload_a_fast_robot_and_an_integrator_have_closed_forms(samples: int, gain: float) -> None:
    """L = g (z + 1)/(z − 1) z^−(n+1), g = K h/(2 B_a): |L| = g cot(ωh/2), phase −90° − (n + 1) ω h."""
    robot = one_pole(samples * PERIOD_S, 40.0 / PERIOD_S)  # settles to e^−40 within a sample
    # The payload settles to e^−400 within a sample, and its inertia over one is 1e-6 of the spring's force.
    plant = paper_plant(stiffness=2e4, mass=1e-6, drag=1.0, coupling=1e6, robot=robot)
    damping = PERIOD_S / (2.0 * gain * (1.0 / 2e4 + 1.0 / 1e6))
    found = find_margins(sampled_of(plant), admittance(mass=0.01 * damping, damping=damping, lead=0.01))
    crossover = 2.0 * math.atan(gain) / PERIOD_S
    phase = 0.5 * math.pi - (samples + 1) * crossover * PERIOD_S
    # Crossovers are searched on the loop itself.
    assert found.phase_deg == pytest.approx(math.degrees(phase), rel=1e-9)
    assert found.delay_s == pytest.approx(phase / crossover, rel=1e-9)
    lost = gain / math.tan(math.pi / (4.0 * (samples + 1)))
    assert found.gain_db == pytest.approx(-20.0 * math.log10(lost), rel=1e-9)


def test_a_synthetic_loop_has_its_textbook_margins() -> None:
    """L = e^{−s}/s: |L| = 1 at ω = 1 with the phase −90° − 1 rad; −180° at ω = π/2."""
    grid = np.geomspace(0.01, 2.5, 20_001)
    found = margins_on_grid(grid, 1.0 / (1j * grid) * np.exp(-1j * grid))
    # Interpolated over a step of 3e-4 in ln ω, to second order: 1e-7.
    assert found.phase_deg == pytest.approx(math.degrees(0.5 * math.pi - 1.0), rel=1e-6)
    assert found.delay_s == pytest.approx(0.5 * math.pi - 1.0, rel=1e-6)
    assert found.gain_db == pytest.approx(20.0 * math.log10(0.5 * math.pi), rel=1e-6)


def test_a_loop_past_the_critical_point_needs_nearly_a_turn_of_delay_and_a_softer_gain() -> None:
    """L = e^{−j200°}/ω, then a line through −2: the nearest way is back, which delay cannot go."""
    grid = np.linspace(0.5, 2.0, 1001)
    found = margins_on_grid(grid, np.asarray(np.exp(-1j * math.radians(200.0)) / grid, dtype=np.complex128))
    # 1/ω against a straight line in ln ω over a step of 1e-3.
    assert found.phase_deg == pytest.approx(20.0, rel=1e-9)
    assert found.delay_s == pytest.approx(math.radians(340.0), rel=1e-5)
    found = margins_on_grid(grid, np.asarray(-2.0 + 1j * (grid - 1.3), dtype=np.complex128))
    assert found.gain_db == pytest.approx(20.0 * math.log10(2.0), rel=1e-12)


def test_a_loop_that_ends_on_the_negative_axis_from_one_side_has_its_gain_margin_there() -> None:
    """At Nyquist every loop is real, up to a rounding that need not change its sign."""
    grid = np.linspace(0.1, 1.0, 100)
    found = margins_on_grid(grid, np.asarray(-0.25 + 1j * np.linspace(1.0, 1e-17, 100)))
    assert found.gain_db == pytest.approx(20.0 * math.log10(4.0), rel=1e-12)


def test_what_no_crossover_limits_is_infinite() -> None:
    grid = np.linspace(0.1, 1.0, 100)
    found = margins_on_grid(grid, np.asarray(0.5 / (1.0 + 1j * grid), dtype=np.complex128))
    assert all(np.isposinf(margin) for margin in (found.gain_db, found.phase_deg, found.delay_s))
    assert found.modulus > 1.0


def test_a_loop_that_vanishes_at_the_last_frequency_is_read_without_warning() -> None:
    grid = np.linspace(0.1, 1.0, 100)
    loop = 2.0 * np.exp(-0.5j * grid) * (1.0 - (grid - 0.1) / 0.9)
    loop[-1] = 0.0
    found = margins_on_grid(grid, loop)
    # |L| = 1 half way, at ω = 0.55, where the phase is −0.275: linear in gain over a hundredth of the range.
    assert found.phase_deg == pytest.approx(math.degrees(math.pi - 0.275), rel=1e-3)


@pytest.mark.parametrize(
    ("plant", "controller"),
    [
        pytest.param(paper_plant(), admittance(mass=10.0, lead=0.0), id="the printed example"),
        pytest.param(paper_plant(stiffness=0.0), admittance(mass=10.0, lead=0.05), id="free space, much lead"),
        pytest.param(paper_plant(stiffness=6.24e5), admittance(56.6, 371.0, 7.3e-4, 5e-3), id="modulus 0.9, |z| 1.01"),
        pytest.param(paper_plant(stiffness=3.6e4), admittance(2.64, 156.7, 0.06), id="modulus 0.89, |z| 1.08"),
    ],
)
def test_an_unstable_loop_has_no_margins(plant: Plant, controller: AdmittanceController) -> None:
    sampled = sampled_of(plant)
    with pytest.raises(UnstableLoopError, match="unstable") as refusal:
        find_margins(sampled, controller)
    assert refusal.value.spectral_radius == radius_of(sampled, controller) > 1.0


def test_a_large_distance_from_the_critical_point_does_not_mean_stable() -> None:
    """Why stability is decided apart: an unstable loop with min |1 + L| of 0.88 at both break points."""
    sampled, controller = sampled_of(paper_plant(stiffness=3.6e4)), admittance(2.64, 156.7, 0.06)
    grid = frequency_grid(sampled, 20_000)
    response = loop_response(sampled, controller, grid)
    assert min(np.min(np.abs(1.0 + response.at_force)), np.min(np.abs(1.0 + response.at_command))) > 0.5
    assert radius_of(sampled, controller) > 1.05


def test_the_grid_ends_at_nyquist_but_for_a_hair_and_is_dense_at_the_resonance() -> None:
    sampled = sampled_of(paper_plant(drag=5.0))
    grid = frequency_grid(sampled)
    # Just short of it: w = tan(ωh/2) is infinite there.
    assert 0.0 < 1.0 - grid[-1] / NYQUIST < 1e-8
    assert np.all(np.diff(grid) > 0.0)
    resonance, width = math.sqrt((3e5 + 5e5) / 16.0), 5.0 / (2.0 * 16.0)
    assert np.sum(np.abs(grid - resonance) < 3.0 * width) >= 12
    assert one_pole().delay_s == DELAY_S


@pytest.mark.parametrize("beyond", [1.005, 1.02, 1.1, 1.3])
def test_a_loop_that_passes_an_undamped_pole_does_not_cross_the_negative_axis_there(beyond: float) -> None:
    """L = 2 e^((1 − x/2)j)/(1 − x²) turns round through infinity at x = 1, and crosses that axis at x = 2 alone."""
    x = np.concatenate([np.geomspace(0.01, 0.99, 200), np.geomspace(beyond, 8.0, 400)])
    found = margins_on_grid(x, 2.0 * np.exp(1j * (1.0 - 0.5 * x)) / (1.0 - x**2))
    assert found.gain_db == pytest.approx(20.0 * math.log10(1.5), rel=1e-3)
    # |L| = 1 at x² = 3, where −L has the angle 1 − x/2.
    assert found.phase_deg == pytest.approx(math.degrees(1.0 - 0.5 * math.sqrt(3.0)), rel=1e-3)


@pytest.mark.parametrize("mass", [50.25, 60.125, 65.75, 79.5])
def test_a_point_that_is_added_at_an_undamped_pole_itself_is_put_beside_it(mass: float) -> None:
    """Points lie evenly around such a pole, so that the middle of two of them may be the pole, where L is infinite."""
    plant = Plant(
        robot=RobotModel(numerator=np.array([104.0]), denominator=np.array([1.0, 104.0]), delay_s=0.0),
        coupling=Coupling(stiffness_n_per_m=9e5, damping_n_s_per_m=0.0),
        payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=0.0),
        environment=Environment(stiffness_n_per_m=2e6),
    )
    law = AdmittanceController(
        mass_kg=183.051,
        damping_n_s_per_m=500.0,
        lead_s=0.117386,
        feedback_damping_s=0.0202758,
        biquad_zero_s=0.00415124,
        biquad_zero_damping_ratio=0.412439,
        biquad_pole_s=0.00401157,
        biquad_pole_damping_ratio=0.496392,
    )
    period_s, swing = 0.004, math.sqrt(2.9e6 / mass)
    sampled = build_sampled_plant(plant, period_s)
    nyquist = 0.999 * math.pi / period_s
    grid = np.concatenate([np.geomspace(1.0, 0.999 * swing, 100_000), np.geomspace(1.001 * swing, nyquist, 100_000)])
    response = loop_response(sampled, law, grid)
    least = min(float(np.min(np.abs(1.0 + each))) for each in (response.at_force, response.at_command))
    assert prepare_margins(sampled).find_modulus(law) == pytest.approx(least, rel=1e-4)
