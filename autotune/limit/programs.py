"""The convex programs over Q: steps to a controller that gets nearer to the limit, and what none gets below.

Peak and modulus of the first plant, in contact, are convex in Q. The loops of the other plants and of free space are
1 + N_i C = f_i/(1 − N Q) with f_i = 1 − (N − N_i) Q: their modulus |f_i| ≥ m |1 − N Q| holds where the real part of
f_i, turned to what it was, does (a second-order cone, and no encirclement is lost on the way: Karimi and Kammer 2017).
Forces and noise of the other plants are taken as they change to first order, within a trust region.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import null_space, toeplitz

from problems.arrays import ComplexArray, FloatArray
from problems.errors import AutotuneError
from problems.model.response import plant_response
from problems.stability.noise_spectrum import RelativeSpectrum

from .signals import ContactSignals
from .youla import YoulaBasis

# Held in reserve inside, for what lies between the frequencies and for the solver's digits.
_RESERVE = 1.003
_FREQUENCIES, _BETWEEN, _LOWEST_RAD_PER_S = 200, 10, 0.5
_NOISE_POINTS = 2048
_TRUST = 0.3
# The lower bound: inputs of the modulus that join at a time, rounds of them, how many ticks of them there may be in all
# (each costs a row), what counts as violated, and what the solver leaves open, which is taken off.
_INPUTS_A_ROUND, _ROUNDS, _MOST_ROWS, _VIOLATED, _GAP = 8, 12, 12_000, 1.002, 1e-5
_SCALE_M_PER_N = 1e-6
# Gaps are a tenth of what is taken off the bound, and the reserve is larger by far. Clarabel's own choice of a
# factorization on several threads takes twice the processor time for programs of this size.
_SOLVER = {"tol_gap_rel": 1e-6, "tol_gap_abs": 1e-6, "tol_feas": 1e-7, "direct_solve_method": "qdldl"}


class NoSolutionError(AutotuneError):
    """The solver found no point that meets everything."""


@dataclass(frozen=True, kw_only=True)
class EqualDemands:
    """What the controllers that are compared have in common.

    The `modulus` of every loop; |G| ≥ `min_m_s_per_n` over `band_rad_per_s` (k,), None
    where nothing is asked; the RMS of the commanded speed per RMS of force noise at most `noise_m_s_per_n`, white
    noise unless it has a `spectrum`; F^d `driving_force_n`.
    """

    modulus: float
    min_m_s_per_n: float | None
    band_rad_per_s: FloatArray
    noise_m_s_per_n: float
    driving_force_n: float
    at_contact: bool
    spectrum: RelativeSpectrum | None = None


class ConvexStep:
    """The convex program around the coefficients of one design; what stays the same is worked out once."""

    def __init__(self, basis: YoulaBasis, plants: tuple[ContactSignals, ...], asked: EqualDemands) -> None:
        """Take the plants, the first of which the basis belongs to."""
        self.basis, self.plants, self.asked = basis, plants, asked
        self.h = plants[0].pair.contact.sample_time_s
        self.hold_at(frequencies(plants, self.h, _FREQUENCIES))
        self.ticks = len(plants[0].wall_force)
        self.pulses = basis.pulses(self.ticks)
        band = asked.band_rad_per_s
        self.band = (
            basis.response(np.exp(1j * band * self.h)),
            plants[0].response(band),
            robot_velocity(plants[0], band),
        )
        # The force must end at F^d: two equations, which leave these directions of the coefficients.
        self.rows, self.values = at_rest(basis, plants[0], asked.driving_force_n)
        self.directions = null_space(self.rows / np.linalg.norm(self.rows, axis=1)[:, None])

    def hold_at(self, omega: FloatArray) -> None:
        """Hold the loops at these frequencies (k,) [rad/s]."""
        self.omega, self.q = omega, self.basis.response(np.exp(1j * omega * self.h))
        self.first, self.loops = self.plants[0].response(omega), self._loops_at(omega)

    def _loops_at(self, omega: FloatArray) -> list[ComplexArray]:
        """Return −F/x^d of every loop, in contact, then free."""
        return [each.response(omega, free=free) for free in (False, True) for each in self.plants]

    def met(self, theta: FloatArray) -> float:
        """Return the least |1 + L| over what is asked of it, between the frequencies too; it is held where missed."""
        omega = frequencies(self.plants, self.h, _BETWEEN * _FREQUENCIES)
        q = self.basis.response(np.exp(1j * omega * self.h)) @ theta
        first = self.plants[0].response(omega)
        s, least, missed = np.abs(1.0 - first * q), math.inf, [self.omega]
        for n in self._loops_at(omega):
            share = np.abs(1.0 - (first - n) * q) / s / self.asked.modulus
            least = min(least, float(np.min(share)))
            missed.append(omega[share < 1.0])
        if least < 1.0:
            self.hold_at(np.unique(np.concatenate(missed)))
        return least

    def start(self, theta: FloatArray) -> FloatArray:
        """Return the nearest coefficients with which the force ends at F^d."""
        return np.asarray(theta - np.linalg.pinv(self.rows) @ (self.rows @ theta - self.values), dtype=np.float64)

    def solve(self, theta: FloatArray, trust: float = _TRUST) -> FloatArray:
        """Return the coefficients of the next design; raises NoSolutionError where there is none."""
        y, peak = cp.Variable(self.directions.shape[1]), cp.Variable()
        constraints = [*self._loops(y, theta), *self._noise(y, theta)]
        for i in range(len(self.plants)):
            constraints += self._forces(y, peak, theta, i)
            if i > 0:
                constraints.append(self._near(y, theta, i, trust))
        if self.asked.min_m_s_per_n is not None:
            constraints.append(self._band(y, theta, self.asked.min_m_s_per_n))
        solve_quietly(cp.Problem(cp.Minimize(peak), constraints))
        return self.start(theta + self.directions @ np.asarray(y.value, dtype=np.float64))

    def _loops(self, y: cp.Variable, theta: FloatArray) -> list[Any]:
        """Return |1 − N Q| ≤ 1/m in contact, and the turned |f_i| ≥ m |1 − N Q| of all other loops."""
        n, q, moves = self.first, self.q @ theta, self.q @ self.directions
        s = 1.0 - n * q
        scale = 1.0 / np.abs(s)
        distance = cp.Variable(len(s))
        moved = _modulus(y, s * scale, -(n * scale)[:, None] * moves)
        constraints = [moved <= distance, distance <= scale / (self.asked.modulus * _RESERVE)]
        for other in self.loops[1:]:
            f = 1.0 - (n - other) * q
            turn = scale * np.conj(f) / np.abs(f)
            turned = (-((n - other) * turn)[:, None] * moves).real
            constraints.append(self.asked.modulus * _RESERVE * distance <= scale * np.abs(f) + turned @ y)
        return constraints

    def _band(self, y: cp.Variable, theta: FloatArray, least: float) -> Any:
        """Return |G| ≥ Y over the band, G = C·R with R from the command to the robot's velocity as F reaches it."""
        q, n, robot = self.band
        gain = robot * (q @ theta)
        s = 1.0 - n * (q @ theta)
        scale = 1.0 / np.abs(s)
        both = _modulus(y, s * scale, -(n * scale)[:, None] * (q @ self.directions))
        turn = scale * np.conj(gain) / np.abs(gain)
        turned = ((robot * turn)[:, None] * (q @ self.directions)).real
        return least * _RESERVE * both <= scale * np.abs(gain) + turned @ y

    def _forces(self, y: cp.Variable, peak: cp.Variable, theta: FloatArray, i: int) -> list[Any]:
        """Return that no force of this plant's first contact is above `peak`, and that the payload stays on."""
        at, moves = (self.pulses @ theta, self.pulses) if i == 0 else self._other_pulses(theta, i)
        (pressed, sensed), (pressed_moves, sensed_moves) = _forces_of(self.plants[i], at, moves @ self.directions)
        contact = pressed + pressed_moves @ y
        # The first tick's force is nothing, whatever the law.
        return [(contact if self.asked.at_contact else sensed + sensed_moves @ y) <= peak, contact[1:] >= 0.0]

    def _other_pulses(self, theta: FloatArray, i: int) -> tuple[FloatArray, FloatArray]:
        """Return Q_i = Q/f_i in time at `theta` (ticks,), and how it changes, dQ_i = dQ/f_i² (ticks, count)."""
        count = 4 * _NOISE_POINTS
        while count < 4 * self.ticks:
            count *= 2
        # At rest N is real; a frequency far below all others stands for zero.
        omega = 2.0 * np.pi * np.maximum(np.arange(count // 2 + 1), 1e-6) / (count * self.h)
        q = self.basis.response(np.exp(1j * omega * self.h))
        f = 1.0 - (self.plants[0].response(omega) - self.plants[i].response(omega)) * (q @ theta)
        spectrum = np.column_stack([(q @ theta) / f, q / (f**2)[:, None]])
        found = np.fft.irfft(spectrum, count, axis=0)[: self.ticks]
        return found[:, 0], found[:, 1:]

    def _near(self, y: cp.Variable, theta: FloatArray, i: int, trust: float) -> Any:
        """Return that the change of f_i stays small beside it, as its square and the forces need it."""
        away = self.first - self.plants[i].response(self.omega)
        f = 1.0 - away * (self.q @ theta)
        rows = (away / np.abs(f))[:, None] * (self.q @ self.directions)
        return _modulus(y, np.zeros(len(f), dtype=np.complex128), rows) <= trust

    def _noise(self, y: cp.Variable, theta: FloatArray) -> list[Any]:
        """Return that the RMS of the commanded speed is within its limit in every loop, that of the first exactly."""
        limit, constraints = self.asked.noise_m_s_per_n / _RESERVE, []
        for j in range(2 * len(self.plants)):
            rows, offset = noise_rows(self.basis, self.plants, theta, j, self.h, self.asked.spectrum)
            # A norm of many rows is that of their triangle.
            both = np.column_stack([rows @ self.directions, offset + rows @ theta])
            triangle = np.asarray(np.linalg.qr(both, mode="r"), dtype=np.float64) / limit
            constraints.append(cp.norm(triangle[:, :-1] @ y + triangle[:, -1]) <= 1.0)
        return constraints


def _modulus(y: cp.Variable, at: ComplexArray, moves: ComplexArray) -> Any:
    """Return |at + moves y| (k,)."""
    return cp.norm(cp.vstack([at.real + moves.real @ y, at.imag + moves.imag @ y]), axis=0)


def noise_rows(
    basis: YoulaBasis,
    plants: tuple[ContactSignals, ...],
    theta: FloatArray,
    j: int,
    h: float,
    spectrum: RelativeSpectrum | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return rows and offset whose norm at x is the RMS of the commanded speed per newton in loop `j`.

    Loops are those of the plants in contact, then in free space. The loop's Q_j is Q/f_j, to first order around
    `theta`; the mean over frequencies in the middle of equal steps leaves the integrator of free space out.
    """
    omega = np.pi * (np.arange(_NOISE_POINTS) + 0.5) / _NOISE_POINTS / h
    z = np.exp(1j * omega * h)
    q, first = basis.response(z), plants[0].response(omega)
    other = plants[j % len(plants)].response(omega, free=j >= len(plants))
    f = 1.0 - (first - other) * (q @ theta)
    speed = (1.0 - 1.0 / z) / h / np.sqrt(_NOISE_POINTS)
    if spectrum is not None:
        speed = speed * np.sqrt(spectrum.beside_white(omega / (2.0 * np.pi), h))
    slope = (speed / f**2)[:, None] * q
    offset = speed * (q @ theta) / f - slope @ theta
    return np.vstack([slope.real, slope.imag]), np.concatenate([offset.real, offset.imag])


def frequencies(plants: tuple[ContactSignals, ...], h: float, count: int) -> FloatArray:
    """Return frequencies [rad/s], `count` by equal ratios, and closer where the payload swings."""
    nyquist = np.pi / h
    swings = [abs(pole) / h for each in plants for pole in np.linalg.eigvals(each.pair.contact.rate) if pole.imag > 0.0]
    around = [np.linspace(0.5, 1.5, 21) * swing for swing in swings if swing < nyquist]
    grid = np.concatenate([np.geomspace(_LOWEST_RAD_PER_S, 0.9999 * nyquist, count), *around])
    return np.unique(grid[grid < nyquist])


def robot_velocity(plant: ContactSignals, omega: FloatArray) -> ComplexArray:
    """Return V/X^d of the robot as the rendered admittance has it: with the wrench's filter."""
    found = plant_response(plant.pair.free, omega)
    velocity = 1j * omega * found.position
    return velocity if found.wrench is None else velocity * found.wrench


def at_rest(basis: YoulaBasis, plant: ContactSignals, driving_force_n: float) -> tuple[FloatArray, FloatArray]:
    """Return rows (2, count) and values (2,): N Q = 1 at z = 1, and the force that the ramp ends at is F^d."""
    value, slope = basis.at_rest()
    opened = plant.open
    away = np.eye(len(opened.a)) - opened.a
    once = np.linalg.solve(away, opened.b)
    gain = -float(opened.c @ once + opened.d)
    change = float(opened.c @ np.linalg.solve(away, once))
    ends_at = -driving_force_n - plant.steady_force_n
    rows = np.array([gain * value, change * value + gain * slope])
    return rows, np.array([1.0, -ends_at / plant.ramp_force_n])


def _forces_of(
    plant: ContactSignals, at: FloatArray, moves: FloatArray
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Return F_e and −F at the pulse response `at` (ticks,), and what `moves` (ticks, k) of it change in them."""
    n = len(plant.wall_force)
    answers = [np.convolve(each, plant.wall_force)[:n] for each in (plant.contact_pulse, plant.force_pulse)]
    rest = plant.wall_contact, -plant.steady_force_n - plant.wall_force
    forces = [alone + np.convolve(answer, at)[:n] for alone, answer in zip(rest, answers, strict=True)]
    changes = [toeplitz(answer, np.zeros(n)) @ moves for answer in answers]
    return (forces[0], forces[1]), (changes[0], changes[1])


def solve_quietly(problem: "cp.Problem") -> None:
    """Solve with Clarabel; raises NoSolutionError where it finds nothing."""
    with warnings.catch_warnings():
        # What is nearly optimal is a design all the same, and is looked at by other code.
        warnings.simplefilter("ignore")
        try:
            problem.solve(solver=cp.CLARABEL, **_SOLVER)
        except cp.SolverError as error:
            raise NoSolutionError(f"The convex program was not solved: {error}") from error
    if problem.status not in {cp.OPTIMAL, cp.OPTIMAL_INACCURATE}:
        raise NoSolutionError(f"The convex program has no solution: {problem.status}.")


@dataclass(frozen=True, kw_only=True)
class LowerBound:
    """No controller's peak is below `force_n`, by the first `ticks` ticks and `inputs` inputs of the modulus.

    Where it `is_at_rest` it is F^d, which the force ends at, and nothing was solved.
    """

    force_n: float
    ticks: int
    inputs: int
    is_at_rest: bool = False


def lower_bound(plant: ContactSignals, asked: EqualDemands, ticks: int) -> LowerBound:
    """Return a force below which no linear controller of one plant gets, whatever its order.

    The forces up to a tick depend on the commands up to that tick alone, so that with one free coefficient per tick
    nothing is left out: the least peak over them is below that of every controller. The noise of the command counts up
    to the same tick only, and the modulus as far as inputs of that length show it: ‖S w‖ ≤ ‖w‖/m for every w, of which
    those that the solution violates most are added until none is left or there are many. Each of these asks for less
    than the whole does. Raises NoSolutionError where there is none.
    """
    h, zero = plant.pair.contact.sample_time_s, np.zeros(ticks)
    wall = plant.wall_force[:ticks]
    pulse = plant.contact_pulse[:ticks] if asked.at_contact else plant.force_pulse[:ticks]
    rest = plant.wall_contact[:ticks] if asked.at_contact else -plant.steady_force_n - wall
    forces = _SCALE_M_PER_N * toeplitz(np.convolve(pulse, wall)[:ticks], zero)
    loop = _SCALE_M_PER_N * toeplitz(plant.force_pulse[:ticks], zero)
    speed = _SCALE_M_PER_N / h / asked.noise_m_s_per_n * (np.eye(ticks) - np.eye(ticks, k=-1))
    if asked.spectrum is not None:
        # Noise of a spectrum is white noise behind a causal filter: of its first ticks the first of both make it.
        speed = toeplitz(asked.spectrum.pulse(h, ticks), zero) @ speed
    x, peak, inputs = cp.Variable(ticks), cp.Variable(), list[FloatArray]()
    best = 0.0
    for _ in range(_ROUNDS):
        constraints = [rest + forces @ x <= peak, cp.norm(speed @ x) <= 1.0]
        constraints += [cp.norm(w - (toeplitz(w, zero) @ loop) @ x) <= 1.0 / asked.modulus for w in inputs]
        problem = cp.Problem(cp.Minimize(peak), constraints)
        solve_quietly(problem)
        best = max(best, float(problem.value) * (1.0 - _GAP))
        _, gains, vectors = np.linalg.svd(np.eye(ticks) - toeplitz(loop @ x.value, zero))
        worst = [
            v for gain, v in zip(gains[:_INPUTS_A_ROUND], vectors, strict=False) if gain * asked.modulus > _VIOLATED
        ]
        if not worst or ticks * (len(inputs) + len(worst)) > _MOST_ROWS:
            break
        inputs += worst
    return LowerBound(force_n=best, ticks=ticks, inputs=len(inputs))
