"""The margins of random loops against definitions, dense grids fitted to the loop's poles, and eigenvalues."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import control
import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

from problems.arrays import ComplexArray, FloatArray
from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.response import loop_response
from problems.model.robot import RobotModel
from problems.model.sampled import SampledPlant, build_cut_loop, build_sampled_plant
from problems.stability.margin_kernel import PolynomialLoop, _refined_response
from problems.stability.margins import Margins, find_margins, prepare_margins
from problems.stability.polynomials import CONTROLLER_POWERS, controller_polynomials
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.random_loops import even, radius_of, random_controller, random_plant, sampled_of, stable_loops

BREAK_POINTS = ("at_force", "at_command")
# Distances from a pole in units of its own distance to the circle: steps of 5 %.
_STEPS = np.geomspace(0.05, 1e4, 250)
AROUND = np.concatenate([-_STEPS[::-1], [-0.025, 0.0, 0.025], _STEPS])


@dataclass(frozen=True, kw_only=True)
class OpenLoop:
    """y = C (z − A)⁻¹ B u + D u with L = −y/u: the loop cut at one break point and closed at the other."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: float

    def closed(self, factor: complex) -> ComplexArray:
        """Return the poles with u = factor · y."""
        return np.asarray(np.linalg.eigvals(self.a + np.outer(self.b, self.c) * factor / (1.0 - factor * self.d)))

    def closed_late(self, samples: int) -> ComplexArray:
        """Return the poles with u_k = y_{k − samples}."""
        if samples == 0:
            return self.closed(1.0)
        n = len(self.a)
        a = np.zeros((n + samples, n + samples))
        a[:n, :n], a[:n, -1] = self.a, self.b
        a[n, :n], a[n, -1] = self.c, self.d
        a[n + 1 :, n : n + samples - 1] = np.eye(samples - 1)
        return np.asarray(np.linalg.eigvals(a))


def opened(sampled: SampledPlant, controller: AdmittanceController) -> tuple[OpenLoop, OpenLoop]:
    """Cut the loop at the force signal, and at the command."""
    cut = build_cut_loop(sampled, controller)
    n, out = cut.state_count, []
    for here, other in ((cut.force, cut.command), (cut.command, cut.force)):
        m = cut.closed_at(other)
        out.append(OpenLoop(a=m[:n, :n], b=m[:n, here], c=m[here, :n], d=float(m[here, here])))
    return out[0], out[1]


def distance_of(poles: ComplexArray, *, anchored: bool) -> float:
    """Return how far the nearest pole is from the unit circle; the integrator at z = 1 does not count."""
    kept = poles if anchored else np.delete(poles, np.argmin(np.abs(poles - 1.0)))
    return float(np.min(np.abs(np.abs(kept) - 1.0)))


def largest_of(poles: ComplexArray, *, anchored: bool) -> float:
    kept = poles if anchored else np.delete(poles, np.argmin(np.abs(poles - 1.0)))
    return float(np.max(np.abs(kept)))


def fitted_grid(sampled: SampledPlant, controller: AdmittanceController) -> FloatArray:
    """Return frequencies that no pole can hide between: L and 1 + L change only as fast as their nearest pole is."""
    h = sampled.sample_time_s
    nyquist = (1.0 - 1e-9) * math.pi / h
    parts = [np.geomspace(0.1, nyquist, 1500), np.linspace(0.1, nyquist, 1500)]
    cut = build_cut_loop(sampled, controller)
    for signals in ((), (cut.command,), (cut.command, cut.force)):
        poles = np.linalg.eigvals(cut.closed_at(*signals)[: cut.state_count, : cut.state_count])
        seen = poles[(np.abs(poles) > 0.2) & (poles.imag >= 0.0)]
        parts.extend((np.angle(z) + max(abs(1.0 - abs(z)), 1e-9) * AROUND) / h for z in seen)
    grid = np.concatenate(parts)
    return np.unique(grid[(grid >= 0.1) & (grid <= nyquist)])


def searched(sampled: SampledPlant, controller: AdmittanceController) -> dict[str, float]:
    """Find the margins by their definitions on the fitted grid, minima and crossovers polished by scipy."""
    grid = fitted_grid(sampled, controller)
    response = loop_response(sampled, controller, grid)
    out = dict.fromkeys(("modulus", "disk", "gain_db", "phase_deg", "delay_s"), math.inf)
    for name in BREAK_POINTS:
        loop = getattr(response, name)

        def at(omega: float, name: str = name) -> complex:
            return complex(getattr(loop_response(sampled, controller, np.array([omega])), name)[0])

        for key, measure in (("modulus", modulus_of), ("disk", disk_of)):
            out[key] = min(out[key], polished(grid, measure(loop), lambda w, f=measure: float(f(at(w)))))  # type: ignore[misc]
        for omega in crossings(grid, loop.imag, lambda w: at(w).imag):
            if at(omega).real < 0.0:
                out["gain_db"] = min(out["gain_db"], abs(20.0 * math.log10(-at(omega).real)))
        if loop[-1].real < 0.0 and abs(loop[-1].imag) < 1e-3 * abs(loop[-1].real):
            out["gain_db"] = min(out["gain_db"], abs(20.0 * math.log10(-loop[-1].real)))
        for omega in crossings(grid, np.abs(loop) - 1.0, lambda w: abs(at(w)) - 1.0):
            angle = float(np.angle(-at(omega)))
            out["phase_deg"] = min(out["phase_deg"], math.degrees(abs(angle)))
            out["delay_s"] = min(out["delay_s"], (angle % (2.0 * math.pi)) / omega)
        if abs(loop[-1]) > 1.0:
            out["delay_s"] = 0.0
    return out


def modulus_of(loop: ComplexArray | complex) -> FloatArray:
    return np.asarray(np.abs(1.0 + loop))


def disk_of(loop: ComplexArray | complex) -> FloatArray:
    return np.asarray(2.0 * np.abs(1.0 + loop) / np.abs(1.0 - loop))


def polished(grid: FloatArray, values: FloatArray, function: Callable[[float], float]) -> float:
    """Return the smallest of the three deepest minima, each searched between its neighbours."""
    inner = np.flatnonzero((values[1:-1] <= values[:-2]) & (values[1:-1] <= values[2:])) + 1
    best = float(np.min(values))
    for k in inner[np.argsort(values[inner])][:3]:
        found = minimize_scalar(
            function, bounds=(grid[k - 1], grid[k + 1]), method="bounded", options={"xatol": 1e-10 * grid[k]}
        )
        best = min(best, float(found.fun))
    return best


def crossings(grid: FloatArray, values: FloatArray, function: Callable[[float], float]) -> list[float]:
    changes = np.flatnonzero((values[1:] > 0.0) != (values[:-1] > 0.0))
    return [float(brentq(function, grid[k], grid[k + 1], xtol=1e-12 * grid[k], rtol=1e-13)) for k in changes]


def assert_found(found: Margins, expected: dict[str, float]) -> None:
    # A minimum is searched until its parabola is met to some 1e-5; crossovers to rounding of L over its slope.
    assert found.modulus == pytest.approx(expected["modulus"], rel=5e-5)
    assert found.disk == pytest.approx(expected["disk"], rel=5e-5)
    assert found.phase_deg == pytest.approx(expected["phase_deg"], rel=1e-6)
    assert found.delay_s == pytest.approx(expected["delay_s"], rel=1e-6)
    # Where the loop gain is below a millionth, no change of gain is looked for.
    limited = expected["gain_db"] if expected["gain_db"] < 120.0 else math.inf
    assert found.gain_db == pytest.approx(limited, rel=1e-6)


def test_random_margins_are_those_of_a_grid_that_is_fitted_to_every_pole() -> None:
    forms, kinds = set(), set()
    for sampled, controller in stable_loops(np.random.default_rng(21), 30):
        assert_found(find_margins(sampled, controller), searched(sampled, controller))
        forms.add(controller.discretization)
        kinds.add(controller.compensation if controller.compensates else "none")
    assert len(forms) == len(kinds) == 3


def test_a_dip_between_two_points_of_the_grid_is_found() -> None:
    """A payload with next to no damping: 1 + L turns within a ten-thousandth of the frequency, and dips there."""
    rng, narrow = np.random.default_rng(22), 0
    for _ in range(25):
        sampled, controller = lightly_damped(rng)
        found, expected = find_margins(sampled, controller), searched(sampled, controller)
        assert_found(found, expected)
        plain = np.geomspace(0.5, (1.0 - 1e-9) * math.pi / PERIOD_S, 1000)
        seen = loop_response(sampled, controller, plain)
        narrow += min(np.min(np.abs(1.0 + getattr(seen, name))) for name in BREAK_POINTS) > 1.02 * found.modulus
    # The case is not empty: a thousand points do not see such dips.
    assert narrow >= 3


def lightly_damped(rng: np.random.Generator) -> tuple[SampledPlant, AdmittanceController]:
    """Draw a stable loop whose plant has a resonance with a damping ratio of 1e-5 to 1e-2."""
    while True:
        plant = random_plant(rng)
        plant = replace(
            plant,
            payload=replace(plant.payload, drag_n_s_per_m=even(rng, 1e-2, 30.0)),
            coupling=replace(plant.coupling, damping_n_s_per_m=0.0),
            environment=replace(plant.environment, damping_n_s_per_m=0.0),
        )
        sampled, controller = sampled_of(plant), random_controller(rng)
        if radius_of(sampled, controller) < 1.0:
            return sampled, controller


@pytest.mark.parametrize("samples", [20, 60, 150])
def test_margins_under_a_long_delay(samples: int) -> None:
    rng = np.random.default_rng(samples)
    for sampled, controller in stable_loops(rng, 4, delay_s=samples * PERIOD_S):
        assert_found(find_margins(sampled, controller), searched(sampled, controller))


def test_the_gain_margin_brings_a_pole_onto_the_circle_and_nothing_smaller_does() -> None:
    for sampled, controller in stable_loops(np.random.default_rng(23), 60):
        anchored, margin = sampled.plant.environment.is_anchored, find_margins(sampled, controller).gain_db
        loops = opened(sampled, controller)
        if math.isfinite(margin):
            factors = [10.0 ** (sign * margin / 20.0) for sign in (1.0, -1.0)]
            nearest = min(distance_of(loop.closed(f), anchored=anchored) for loop in loops for f in factors)
            # Eigenvalues of a loop of order ten.
            assert nearest < 1e-8
        for share in (0.2, 0.5, 0.8, 0.99):
            change = 10.0 ** (share * min(margin, 40.0) / 20.0)
            for loop, factor in itertools.product(loops, (change, 1.0 / change)):
                assert largest_of(loop.closed(factor), anchored=anchored) < 1.0


def test_the_phase_margin_brings_a_pole_onto_the_circle_and_nothing_smaller_does() -> None:
    limited = 0
    for sampled, controller in stable_loops(np.random.default_rng(24), 60):
        anchored, margin = sampled.plant.environment.is_anchored, find_margins(sampled, controller).phase_deg
        loops = opened(sampled, controller)
        if math.isfinite(margin):
            limited += 1
            # A rotation of the conjugate half is the conjugate's: turning one way is enough to see the other.
            rotation = np.exp(1j * math.radians(margin))
            assert min(distance_of(loop.closed(rotation), anchored=anchored) for loop in loops) < 1e-8
        for share in (0.25, 0.5, 0.75, 0.99):
            turned = np.exp(1j * math.radians(share * min(margin, 180.0)))
            for loop in loops:
                assert largest_of(loop.closed(turned), anchored=anchored) < 1.0
    assert limited >= 30


def test_the_delay_margin_is_where_whole_samples_of_delay_begin_to_be_too_many() -> None:
    rng, tried = np.random.default_rng(25), 0
    for sampled, controller in stable_loops(rng, 80, below=0.99999):
        anchored, margin = sampled.plant.environment.is_anchored, find_margins(sampled, controller).delay_s
        whole = margin / PERIOD_S
        if not whole < 40.0:
            continue
        tried += 1
        loops = opened(sampled, controller)
        for samples in range(math.floor(whole) + 1):
            radii = [largest_of(loop.closed_late(samples), anchored=anchored) for loop in loops]
            assert max(radii) < 1.0, (samples, whole)
        if whole - math.floor(whole) > 1e-3:
            radii = [largest_of(loop.closed_late(math.ceil(whole)), anchored=anchored) for loop in loops]
            assert max(radii) > 1.0, whole
    assert tried >= 20


def test_a_loop_gain_above_1_at_the_nyquist_frequency_tolerates_no_delay() -> None:
    """The Tustin derivative of an ideal compensation, with lead: half a sample more and the loop is lost."""
    rng, tried = np.random.default_rng(31), 0
    while tried < 8:
        plant = random_plant(rng, delay_s=PERIOD_S * int(rng.integers(0, 4)))
        controller = random_controller(rng, forms=("tustin",), compensations=("ideal",))
        controller = replace(controller, lead_s=even(rng, 1e-3, 0.05))
        if not radius_of(sampled_of(plant), controller) < 0.999:
            continue
        tried += 1
        late = replace(plant, robot=replace(plant.robot, delay_s=plant.robot.delay_s + 0.6 * PERIOD_S))
        assert radius_of(sampled_of(late), controller) > 1.0
        assert find_margins(sampled_of(plant), controller).delay_s == 0.0


def test_a_sample_of_delay_costs_exactly_a_sample_of_delay_margin() -> None:
    """Every crossover of L_x keeps its frequency and loses ω h of phase; with one loop at both cuts it is the margin.

    As long as the delay is smaller than the margin the loop stays stable: that follows, and is checked too.
    """
    rng, checked = np.random.default_rng(26), 0
    for _ in range(400):
        plant = random_plant(rng, delay_s=PERIOD_S * int(rng.integers(0, 4)))
        controller = replace(random_controller(rng, compensations=("none",)), feedback_damping_s=0.0)
        if not radius_of(sampled_of(plant), controller) < 0.9999:
            continue
        before = find_margins(sampled_of(plant), controller).delay_s
        for samples in (1, 2, 5):
            if not before > samples * PERIOD_S * 1.0001:
                break
            late = replace(plant.robot, delay_s=plant.robot.delay_s + samples * PERIOD_S)
            after = find_margins(sampled_of(replace(plant, robot=late)), controller).delay_s
            # Two searches for the same crossover.
            assert after == pytest.approx(before - samples * PERIOD_S, abs=1e-9 * before)
            checked += math.isfinite(before)
    assert checked >= 60


def test_the_margins_obey_the_inequalities_between_them() -> None:
    """|1 + L| ≥ m gives a gain of 1 + m or 1/(1 − m), a phase of 2 asin(m/2), and bounds on α both ways."""
    for sampled, controller in stable_loops(np.random.default_rng(27), 300):
        found = find_margins(sampled, controller)
        m, alpha = found.modulus, found.disk
        # The margins are found to 5e-5 each, as above.
        room = 1.0 - 1e-4
        assert found.gain_db >= room * 20.0 * math.log10(1.0 + m)
        assert found.phase_deg >= room * math.degrees(2.0 * math.asin(0.5 * m))
        assert 0.0 < m <= 1.0 + 1e-9  # Bode: ln |1 + L| has a mean of zero at most
        assert room * 2.0 * m / (2.0 + m) <= alpha <= 2.0 * m / (2.0 - m) / room
        if alpha < 2.0:
            assert found.gain_db >= room * 20.0 * math.log10((2.0 + alpha) / (2.0 - alpha))
        assert found.phase_deg >= room * math.degrees(2.0 * math.atan(0.5 * alpha))
        # A rotation is reached by a delay at the highest frequency at the earliest.
        if math.isfinite(found.phase_deg) and found.delay_s > 0.0:
            assert found.delay_s >= math.radians(found.phase_deg) / (math.pi / PERIOD_S)


@pytest.mark.parametrize(
    ("plant", "controller"),
    [
        (paper_plant(stiffness=3e4), admittance(feedback=7.5e-3)),
        (paper_plant(stiffness=5e5), admittance(damping=3000.0, lead=0.02)),
        (paper_plant(stiffness=0.0), admittance(lead=0.02)),
    ],
)
def test_the_disk_margin_is_python_controls(plant: Plant, controller: AdmittanceController) -> None:
    """Balanced (skew 0), at the smaller of both break points, on a grid of its own."""
    sampled = sampled_of(plant)
    grid, disks = np.geomspace(1.0, 0.999 * math.pi / PERIOD_S, 8000), []
    for loop in opened(sampled, controller):
        n = len(loop.a)
        # y = −L u.
        system = control.ss(loop.a, loop.b.reshape(n, 1), -loop.c.reshape(1, n), [[-loop.d]], PERIOD_S)
        disks.append(control.disk_margins(system, grid)[0])
    # Half a step of 0.1 % beside dips that are 5 % wide or more: (0.0005/0.05)²/2.
    assert find_margins(sampled, controller).disk == pytest.approx(min(disks), rel=1e-4)


def scaled(
    plant: Plant, controller: AdmittanceController, force: float, time: float
) -> tuple[Plant, AdmittanceController]:
    """Express an axis in other units: forces times `force`, times times `time` (a stiffness is force per length)."""
    per_speed, per_acceleration = force * time, force * time**2
    n = plant.robot.order
    powers = float(time) ** np.arange(n, -1, -1)
    other = Plant(
        robot=RobotModel(
            numerator=plant.robot.numerator * powers[n + 1 - len(plant.robot.numerator) :],
            denominator=plant.robot.denominator * powers,
            delay_s=plant.robot.delay_s * time,
        ),
        coupling=Coupling(
            stiffness_n_per_m=plant.coupling.stiffness_n_per_m * force,
            damping_n_s_per_m=plant.coupling.damping_n_s_per_m * per_speed,
        ),
        payload=PayloadDynamics(
            mass_kg=plant.payload.mass_kg * per_acceleration, drag_n_s_per_m=plant.payload.drag_n_s_per_m * per_speed
        ),
        environment=Environment(
            stiffness_n_per_m=plant.environment.stiffness_n_per_m * force,
            damping_n_s_per_m=plant.environment.damping_n_s_per_m * per_speed,
            mass_kg=plant.environment.mass_kg * per_acceleration,
        ),
    )
    return other, replace(
        controller,
        mass_kg=controller.mass_kg * per_acceleration,
        damping_n_s_per_m=controller.damping_n_s_per_m * per_speed,
        lead_s=controller.lead_s * time,
        feedback_damping_s=controller.feedback_damping_s * time,
        velocity_filter_rad_per_s=controller.velocity_filter_rad_per_s / time,
        acceleration_filter_rad_per_s=controller.acceleration_filter_rad_per_s / time,
        compensation_mass_kg=controller.compensation_mass_kg * per_acceleration,
    )


@pytest.mark.parametrize(("force", "time"), [(1e-3, 1.0), (0.05, 1.0), (1.0, 2.5), (40.0, 0.4)])
def test_units_change_no_margin(force: float, time: float) -> None:
    """Newton per millimetre, a rotational axis of 50 mm radius, slower and faster machines."""
    for sampled, controller in stable_loops(np.random.default_rng(28), 15, below=0.99999):
        plant, other = scaled(sampled.plant, controller, force, time)
        found = find_margins(sampled, controller)
        again = find_margins(build_sampled_plant(plant, PERIOD_S * time), other)
        # Grids begin at 0.02 Hz of either clock, so a minimum may be searched from other points: to 5e-5, as above.
        assert again.modulus == pytest.approx(found.modulus, rel=1e-4)
        assert again.disk == pytest.approx(found.disk, rel=1e-4)
        assert again.gain_db == pytest.approx(found.gain_db, rel=1e-6)
        assert again.phase_deg == pytest.approx(found.phase_deg, rel=1e-6)
        assert again.delay_s == pytest.approx(found.delay_s * time, rel=1e-6)
        assert again.spectral_radius == pytest.approx(found.spectral_radius, abs=1e-9)


@pytest.mark.parametrize(("force", "time"), [(1e-3, 1.0), (1.0, 2.5), (40.0, 0.4)])
def test_units_scale_the_peaks(force: float, time: float) -> None:
    plant, controller = paper_plant(stiffness=5e4, robot=one_pole(2.1e-3)), admittance(damping=2000.0, feedback=5e-3)
    other_plant, other = scaled(plant, controller, force, time)
    run = simulate_contact(build_sampled_contact(sampled_of(plant)), controller, Approach(force_n=30.0))
    pair = build_sampled_contact(build_sampled_plant(other_plant, PERIOD_S * time))
    again = simulate_contact(pair, other, Approach(force_n=30.0 * force))
    assert again.contact_speed_m_s == pytest.approx(run.contact_speed_m_s / time, rel=1e-12)
    # The same motion of a few hundred samples, rounded elsewhere.
    assert again.peak_contact_force_n == pytest.approx(run.peak_contact_force_n * force, rel=1e-8)
    assert again.peak_sensor_force_n == pytest.approx(run.peak_sensor_force_n * force, rel=1e-8)


def test_a_wall_that_gives_way_at_once_is_free_space() -> None:
    rng, compared = np.random.default_rng(29), 0
    while compared < 15:
        free, controller = random_plant(rng, contact=False), random_controller(rng)
        if not radius_of(sampled_of(free), controller) < 0.9999:
            continue
        compared += 1
        alone = find_margins(sampled_of(free), controller)
        soft = sampled_of(free.in_contact_with(Environment(stiffness_n_per_m=1e-3)))
        touching = find_margins(soft, controller)
        # K_e/(ω B_p) at the lowest frequency of the grid, 0.13 rad/s, and B_p ≥ 50: 2e-4, there and not at the minimum.
        assert touching.modulus == pytest.approx(alone.modulus, rel=1e-4)
        assert touching.gain_db == pytest.approx(alone.gain_db, rel=1e-4)
        if math.isfinite(alone.phase_deg):
            assert touching.phase_deg == pytest.approx(alone.phase_deg, rel=1e-4)
            assert touching.delay_s == pytest.approx(alone.delay_s, rel=1e-4)


@pytest.mark.parametrize("name", ["long delay", "light damping"])
def test_neighbours_of_the_refined_response_are_within_35_degrees(name: str) -> None:
    """Seen from the critical point, and L itself where it is not small: the line between them is 0.954 as near as they.

    Only where a segment is narrower than 1e-8 of its frequency is nothing refined any more.
    """
    plants = {
        "long delay": paper_plant(stiffness=1e5, robot=one_pole(100.5 * PERIOD_S)),
        "light damping": paper_plant(stiffness=3e5, drag=1.0, robot=one_pole(2.2e-3)),
    }
    sampled = build_sampled_plant(plants[name], PERIOD_S)
    law = admittance(damping=9000.0, lead=0.02, feedback=0.01)
    prepared, factors = prepare_margins(sampled), np.zeros((3, CONTROLLER_POWERS))
    degree = controller_polynomials(law.parameters(), law.is_ideal, factors)
    polynomials = PolynomialLoop(prepared.polynomials, factors, degree, PERIOD_S, law.theta)
    omega, points = _refined_response(polynomials, prepared.grid)
    assert len(points) == 2
    assert len(omega) > len(prepared.grid[0])
    wide = np.diff(omega) > 2e-8 * omega[1:]
    for difference in points:
        loop = difference - 1.0
        large = np.maximum(np.abs(loop[1:]), np.abs(loop[:-1])) > 0.03
        # A grid of any fineness has such neighbours, unless points are added where the curve turns.
        for turns, counted in ((difference[1:] / difference[:-1], wide), (loop[1:] / loop[:-1], wide & large)):
            assert np.max(np.abs(np.degrees(np.angle(turns[counted])))) <= 35.0
