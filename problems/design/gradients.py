"""Exact derivatives of what a design is judged by: peak forces, margins, admittance and decay by the controller.

The symbolic loop (`problems.design.symbolic`) is differentiated; where a number is an extremum over time or
frequency the
derivative is that at the extremum, and where it is read at a crossover the crossover's own motion is taken along. A
gradient is ∂/∂(M_a, B_a, K_l, B_fb, ω_v, ω_a, P̂), shape (7,), the order of `AdmittanceController.parameters`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar

from ..arrays import ComplexArray, FloatArray
from ..contact.transient import Approach, transient_from
from ..model.controller import AdmittanceController
from ..model.response import free_space_admittance, loop_response
from ..model.sampled import SampledPlant
from ..stability.margins import frequency_grid
from .stable_design import Gradient, StableDesign
from .symbolic import Structure, arguments_of, build_contact_forces, build_symbolic_form

ForcePlace = Literal["contact", "sensor"]

_GRID_POINTS = 2000
_BAND_POINTS = 60
_LENGTHS = 128
_LATEST_TICK = 600
_AGREES = 2e-3
_BREAKS = ("at_force", "at_command")


@dataclass(frozen=True, kw_only=True)
class _Response:
    """A complex response with its derivatives by the controller (7,) and by ω."""

    value: complex
    by_controller: ComplexArray
    by_frequency: complex


def peak_gradient(
    sampled: SampledPlant, controller: AdmittanceController, approach: Approach, time_s: float, place: ForcePlace
) -> Gradient:
    """Differentiate the force [N] at `time_s` after the impact, F_e or at the sensor −F; the payload stays until then.

    Between the ticks by the parabola through the three next to it. Whether the payload left is the caller's to know:
    compare the value with the simulation's.
    """
    moment = time_s / sampled.sample_time_s
    first = max(round(moment) - 1, 0)
    length = -(-(first + 3) // _LENGTHS) * _LENGTHS
    forces = _forces(Structure.like(sampled, controller), approach, length, place)
    value, gradients = forces(*arguments_of(sampled, controller))
    # Lagrange's weights of the three ticks.
    u = moment - first
    weights = np.array([(u - 1.0) * (u - 2.0) / 2.0, u * (2.0 - u), u * (u - 1.0) / 2.0])
    ticks = slice(first, first + 3)
    return Gradient(
        value=float(weights @ np.asarray(value).ravel()[ticks]), by_controller=weights @ np.asarray(gradients)[ticks]
    )


def contact_peak_gradient(design: StableDesign, scenario: int, place: ForcePlace) -> Gradient | None:
    """Differentiate the peak force [N] of one scenario's contact.

    None where it comes too late to be unrolled to, or where the payload has left before.
    """
    pair, approach = design.prepared.pairs[scenario], design.prepared.approach
    run = transient_from(pair, design.controller, approach)
    moment, value = (
        (run.time_of_sensor_peak_s, run.peak_sensor_force_n)
        if place == "sensor"
        else (run.time_of_peak_s, run.peak_contact_force_n)
    )
    # A force that has crept so long is nearly at rest; unrolled that far, its derivative costs a hundred simulations.
    if moment > _LATEST_TICK * design.prepared.sample_time_s:
        return None
    found = peak_gradient(pair.contact, design.controller, approach, moment, place)
    return replace(found, value=value) if abs(found.value - value) <= _AGREES * value else None


def modulus_gradient(
    sampled: SampledPlant, controller: AdmittanceController, at_rad_per_s: float | None = None
) -> Gradient:
    """Differentiate min |1 + L| over frequency and both break points; the loop must be stable.

    `at_rad_per_s` is where the minimum lies, if that is known (`Margins.modulus_hz`).
    """

    def distance(loop: ComplexArray) -> FloatArray:
        return np.abs(1.0 + loop)

    found = []
    for point in _BREAKS:
        omega = _lowest(sampled, controller, point, distance) if at_rad_per_s is None else at_rad_per_s
        found.append(_length_gradient(sampled, controller, point, omega, lambda response: 1.0 + response.value))
    return min(found, key=lambda gradient: gradient.value)


def gain_gradient(sampled: SampledPlant, controller: AdmittanceController) -> Gradient | None:
    """Differentiate the gain margin [dB], the smallest |20 log10 |L|| where L passes the negative real axis."""
    found = []
    for point, omega in _crossings(sampled, controller, lambda loop: loop.imag, lambda loop: loop.real < 0.0):
        response = _response(sampled, controller, point, omega)
        # The crossing moves so that Im L stays 0.
        moves = -response.by_controller.imag / response.by_frequency.imag
        real = response.value.real
        along = response.by_controller.real + response.by_frequency.real * moves
        if not real < 0.0:
            continue  # on the axis itself by a rounding error: the loop passes 0 there, and no gain moves it to −1
        decibel = 20.0 * np.log10(-real)
        found.append(
            Gradient(value=abs(float(decibel)), by_controller=np.sign(decibel) * 20.0 / np.log(10.0) * along / real)
        )
    return min(found, key=lambda gradient: gradient.value, default=None)


def phase_gradient(sampled: SampledPlant, controller: AdmittanceController) -> Gradient | None:
    """Differentiate the phase margin [deg], the smallest turn that brings L to −1 where |L| = 1."""
    found = []
    for _, angle, gradient, _ in _gain_crossovers(sampled, controller):
        found.append(Gradient(value=float(np.degrees(abs(angle))), by_controller=np.degrees(np.sign(angle) * gradient)))
    return min(found, key=lambda each: each.value, default=None)


def delay_gradient(sampled: SampledPlant, controller: AdmittanceController) -> Gradient | None:
    """Differentiate the delay margin [s], the smallest lag that brings L to −1 where |L| = 1."""
    found = []
    for omega, angle, gradient, moves in _gain_crossovers(sampled, controller):
        lag = angle if angle > 0.0 else angle + 2.0 * np.pi
        found.append(Gradient(value=lag / omega, by_controller=gradient / omega - lag / omega**2 * moves))
    return min(found, key=lambda each: each.value, default=None)


def decay_gradient(sampled: SampledPlant, controller: AdmittanceController) -> Gradient:
    """Differentiate the decay rate −ln ρ/h [1/s] of the loop's slowest eigenvalue."""
    structure = Structure.like(sampled, controller)
    matrix, gradients = _loop(structure)(*arguments_of(sampled, controller))
    a = np.asarray(matrix)
    values, vectors = np.linalg.eig(a)
    size = np.abs(values)
    if not sampled.plant.environment.is_anchored:
        # Free space does not know where it is: that eigenvalue stays at 1.
        size[np.argmin(np.abs(values - 1.0))] = 0.0
    slowest = int(np.argmax(size))
    right, left = vectors[:, slowest], np.linalg.inv(vectors)[slowest]
    # CasADi stacks columns.
    moved = np.asarray(gradients).reshape((*a.shape, -1), order="F")
    shift = np.einsum("i,ijk,j->k", left, moved, right)
    radius = abs(values[slowest])
    by_radius = (np.conj(values[slowest]) * shift).real / radius
    h = sampled.sample_time_s
    return Gradient(value=float(-np.log(radius) / h), by_controller=-by_radius / (radius * h))


def admittance_gradient(
    sampled: SampledPlant, controller: AdmittanceController, band_hz: tuple[float, float]
) -> Gradient:
    """Differentiate min |G| [m/s/N] over a band, its ends included; the plant's surroundings do not matter."""
    low, high = 2.0 * np.pi * band_hz[0], 2.0 * np.pi * band_hz[1]
    grid = np.geomspace(low, high, _BAND_POINTS) if high > low else np.array([low])

    def gain(omega: FloatArray) -> FloatArray:
        return np.abs(free_space_admittance(sampled, controller, omega))

    lowest = _refined(grid, gain)
    return _length_gradient(sampled, controller, "admittance", lowest, lambda response: response.value)


def passivity_gradient(sampled: SampledPlant, controller: AdmittanceController, fails_hz: float) -> Gradient:
    """Differentiate the frequency [Hz] at which Re G turns negative, which is known: it moves so that Re G stays 0."""
    response = _response(sampled, controller, "admittance", 2.0 * np.pi * fails_hz)
    moves = -response.by_controller.real / response.by_frequency.real
    return Gradient(value=fails_hz, by_controller=moves / (2.0 * np.pi))


def _length_gradient(
    sampled: SampledPlant,
    controller: AdmittanceController,
    name: str,
    omega: float,
    vector: Callable[[_Response], complex],
) -> Gradient:
    """Return the length of a vector in the plane and its derivative at a fixed frequency."""
    response = _response(sampled, controller, name, omega)
    point = vector(response)
    return Gradient(value=abs(point), by_controller=(np.conj(point) * response.by_controller).real / abs(point))


def _lowest(
    sampled: SampledPlant, controller: AdmittanceController, point: str, distance: Callable[[ComplexArray], FloatArray]
) -> float:
    """Return where the distance of the loop, broken at `point`, is least [rad/s]."""
    return _refined(
        frequency_grid(sampled, _GRID_POINTS),
        lambda omega: distance(getattr(loop_response(sampled, controller, omega), point)),
    )


def _refined(grid: FloatArray, values: Callable[[FloatArray], FloatArray]) -> float:
    """Return where a function of frequency is least: on a grid first, then between the neighbours."""
    best = int(np.argmin(values(grid)))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    if not low < high:
        return float(low)
    found = minimize_scalar(
        lambda omega: float(values(np.array([omega]))[0]),
        bounds=(float(low), float(high)),
        method="bounded",
        options={"xatol": 1e-9 * float(high)},
    )
    ends = [float(grid[best]), float(found.x)]
    return min(ends, key=lambda omega: float(values(np.array([omega]))[0]))


def _gain_crossovers(
    sampled: SampledPlant, controller: AdmittanceController
) -> list[tuple[float, float, FloatArray, FloatArray]]:
    """Return ω, the angle of −L in (−π, π], its gradient and that of ω, wherever |L| = 1 at either break point."""
    found = []
    for point, omega in _crossings(
        sampled, controller, lambda loop: np.log(np.abs(loop)), lambda loop: loop.real < 2.0
    ):
        response = _response(sampled, controller, point, omega)
        by_controller, by_frequency = response.by_controller / response.value, response.by_frequency / response.value
        # d log L: the real part is gain, the imaginary one phase; the crossover moves so that the gain stays 1.
        moves = -by_controller.real / by_frequency.real
        gradient = by_controller.imag + by_frequency.imag * moves
        found.append((omega, float(np.angle(-response.value)), gradient, moves))
    return found


def _crossings(
    sampled: SampledPlant,
    controller: AdmittanceController,
    level: Callable[[ComplexArray], FloatArray],
    counts: Callable[[ComplexArray], NDArray[np.bool_]],
) -> list[tuple[str, float]]:
    """Return break point and frequency [rad/s] of every sign change of `level` where the loop `counts`."""
    grid = frequency_grid(sampled, _GRID_POINTS)
    whole = loop_response(sampled, controller, grid)
    found = []
    for point in _BREAKS:

        def value(omega: float, point: str = point) -> float:
            return float(level(getattr(loop_response(sampled, controller, np.array([omega])), point))[0])

        loop = getattr(whole, point)
        with np.errstate(divide="ignore"):
            signs = level(loop)
        found += [
            (point, float(brentq(value, grid[i], grid[i + 1], xtol=1e-12 * grid[i + 1], rtol=1e-14)))
            for i in np.flatnonzero((signs[:-1] * signs[1:] < 0.0) & counts(loop[:-1]))
        ]
    return found


def _response(sampled: SampledPlant, controller: AdmittanceController, name: str, omega: float) -> _Response:
    structure = Structure.like(sampled, controller)
    value, by_controller, by_frequency = _responses(structure, name)(*arguments_of(sampled, controller), omega)
    (re, im), d_controller = np.asarray(value).ravel(), np.asarray(by_controller)
    d_frequency = np.asarray(by_frequency).ravel()
    return _Response(
        value=complex(re, im),
        by_controller=d_controller[0] + 1j * d_controller[1],
        by_frequency=complex(d_frequency[0], d_frequency[1]),
    )


@lru_cache(maxsize=8)
def _form(structure: Structure) -> Any:
    return build_symbolic_form(structure)


@lru_cache(maxsize=24)
def _responses(structure: Structure, name: str) -> Any:
    whole = _form(structure).response
    outputs = [name, f"jac:{name}:controller", f"jac:{name}:frequency_rad_per_s"]
    return whole.factory(f"gradients_{name}", whole.name_in(), outputs)


@lru_cache(maxsize=8)
def _loop(structure: Structure) -> Any:
    whole = _form(structure).loop
    return whole.factory("gradients_loop", whole.name_in(), ["a", "jac:a:controller"])


@lru_cache(maxsize=8)
def _forces(structure: Structure, approach: Approach, samples: int, place: ForcePlace) -> Any:
    whole = build_contact_forces(structure, approach, samples)
    name = f"{place}_force"
    return whole.factory("gradients_forces", whole.name_in(), [name, f"jac:{name}:controller"])
