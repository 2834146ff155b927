"""Passivity of the port F → V: whether the controlled robot ever feeds energy into what it touches."""

from dataclasses import dataclass, replace

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..model.linear_controllers import LinearController
from ..model.response import PlantResponse, free_space_admittance, plant_response, rendered_admittance
from ..model.sampled import (
    Controller,
    SampledLoop,
    SampledPlant,
    build_cut_loop,
    build_loop,
    spectral_radius,
    stability_matrix,
)

_LOWEST_HZ = 0.01
_POINTS = 2000
# Many points at a time cost little more than one.
_SECTIONS, _NARROWINGS = 64, 9
_AROUND_A_ROOT = np.linspace(-4.0, 4.0, 33)


@dataclass(frozen=True, kw_only=True)
class PreparedPort:
    """A plant with its response on the frequencies that do not depend on the controller, see `prepare_port`."""

    sampled: SampledPlant
    grid: PlantResponse

    def fails_above_hz(self, controller: Controller) -> float | None:
        """Return where the real part of the rendered admittance G = V/F turns negative, None up to Nyquist.

        Delay and hold are in it. A port that is unstable by itself is passive nowhere. The first sign change of a grid
        that is fine around every pole and zero of G is narrowed down to rounding.
        """
        port = _port(self.sampled, controller)
        if not spectral_radius(port) < 1.0:
            return 0.0
        h = self.sampled.sample_time_s
        further = plant_response(self.sampled, _around_poles(port))
        omega = np.concatenate([self.grid.frequency_rad_per_s, further.frequency_rad_per_s])
        order = np.argsort(omega, kind="stable")
        real = np.concatenate([rendered_admittance(each, controller, h).real for each in (self.grid, further)])
        omega, real = omega[order], real[order]
        negative = np.flatnonzero(real < 0.0)
        if not negative.size:
            return None
        first = int(negative[0])
        edge = 0.0 if first == 0 else _root(self.sampled, controller, float(omega[first - 1]), float(omega[first]))
        return edge / (2.0 * np.pi)

    def passive_below_hz(self, controller: Controller) -> float:
        """Return the frequency up to which the port is passive, at most the Nyquist frequency."""
        fails = self.fails_above_hz(controller)
        return 0.5 / self.sampled.sample_time_s if fails is None else fails


def prepare_port(sampled: SampledPlant) -> PreparedPort:
    """Compute once what many controllers on one plant share."""
    return PreparedPort(sampled=sampled, grid=plant_response(sampled, _frequencies(sampled)))


def passive_below_hz(sampled: SampledPlant, controller: Controller) -> float:
    """Return the frequency up to which the port is passive, at most the Nyquist frequency."""
    return prepare_port(sampled).passive_below_hz(controller)


def _port(sampled: SampledPlant, controller: Controller) -> SampledLoop:
    """Return robot and controller with the force left to the outside; the robot does not feel the payload."""
    loop, cut = build_loop(sampled, controller), build_cut_loop(sampled, controller)
    payload = (sampled.state_count - 2, sampled.state_count - 1)
    kept = np.delete(np.arange(cut.state_count), payload)
    a = cut.closed_at(cut.command)[np.ix_(kept, kept)]
    held = isinstance(controller, LinearController) and controller.holds_position
    return replace(loop, a=a, translation=loop.translation[kept], is_anchored=held)


def _frequencies(sampled: SampledPlant) -> FloatArray:
    """Return frequencies (n,) [rad/s] to the Nyquist frequency, dense around the robot's zeros."""
    low, nyquist = 2.0 * np.pi * _LOWEST_HZ, np.pi / sampled.sample_time_s
    around = _around(np.roots(sampled.plant.robot.numerator).astype(np.complex128), nyquist)
    return np.unique(np.clip(np.concatenate([np.geomspace(low, nyquist, _POINTS), around]), low, nyquist))


def _around_poles(port: SampledLoop) -> FloatArray:
    """Return frequencies (n,) [rad/s] where a lightly damped pole of the port turns the phase."""
    poles = np.linalg.eigvals(stability_matrix(port))
    return _around(np.log(poles[poles.imag > 0.0]) / port.sample_time_s, np.pi / port.sample_time_s)


def _around(roots: ComplexArray, nyquist: float) -> FloatArray:
    low = 2.0 * np.pi * _LOWEST_HZ
    near = [root.imag + max(abs(root.real), 1e-4 * root.imag) * _AROUND_A_ROOT for root in roots if root.imag > low]
    return np.unique(np.clip(np.concatenate([np.zeros(0), *near]), low, nyquist)) if near else np.zeros(0)


def _root(sampled: SampledPlant, controller: Controller, low: float, high: float) -> float:
    for _ in range(_NARROWINGS):
        omega = np.linspace(low, high, _SECTIONS + 1)
        outside = np.flatnonzero(free_space_admittance(sampled, controller, omega[1:-1]).real < 0.0)
        first = int(outside[0]) + 1 if outside.size else _SECTIONS
        low, high = float(omega[first - 1]), float(omega[first])
    return high
