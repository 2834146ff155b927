"""The continuous form of the loop as frequency responses: for Bode pictures, insight and starting points.

The delay is exact, e^(−sT); neither the hold nor the controller's sampling is in it. Stability, margins and peaks that
are reported come from the exact sampled loop (`problems.model.sampled`, `problems.stability.margins`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval

from problems._checks import positive
from problems.arrays import ComplexArray, FloatArray
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.difference import filters_in_s, forward_in_s
from problems.model.plant import Plant


@dataclass(frozen=True, kw_only=True, eq=False)
class PlantBlocks:
    """R, C_s, P, E and Ē of docs/method.md, "The loop", and the wrench's filter, shapes as `frequency_rad_per_s`.

    `wrench` F_m/F [-] lies between the coupling force and the controller, `robot` R [1/s] from command to velocity,
    `coupling` C_s [N·s/m], `payload` P [m/(N·s)], `environment` E [N·s/m] (0 in free space), `felt_impedance` Ē
    [N·s/m], with which the flange feels F = −Ē V.
    """

    frequency_rad_per_s: FloatArray
    robot: ComplexArray
    coupling: ComplexArray
    payload: ComplexArray
    environment: ComplexArray
    felt_impedance: ComplexArray
    wrench: ComplexArray


@dataclass(frozen=True, kw_only=True, eq=False)
class ControllerBlocks:
    """A(1 + C_ff), C_fb and O_a of docs/method.md, "The loop", shapes as `frequency_rad_per_s`.

    `forward` A(1 + C_ff) [m/N], `feedback` C_fb [-], `acceleration` O_a [1/s²], whether P̂ uses it or not.
    """

    frequency_rad_per_s: FloatArray
    forward: ComplexArray
    feedback: ComplexArray
    acceleration: ComplexArray


@dataclass(frozen=True, kw_only=True, eq=False)
class ContinuousLoop:
    """The blocks and what they make together; 1 + L and 1 + L_x are what must stay away from zero.

    `rendered_admittance` G = V/F [m/(N·s)] in free space, `at_force` L = G Ē, `at_command` L_x, `closed_loop`
    F_m/F^d = −L/(1 + L), `sensitivity` S = 1/(1 + L).
    """

    plant: PlantBlocks
    controller: ControllerBlocks
    rendered_admittance: ComplexArray
    at_force: ComplexArray
    at_command: ComplexArray
    closed_loop: ComplexArray
    sensitivity: ComplexArray


def plant_blocks(
    plant: Plant, frequency_rad_per_s: FloatArray, *, half_sample_of_s: float | None = None
) -> PlantBlocks:
    """Evaluate the plant's blocks at s = jω; `half_sample_of_s` is a period h, half of which is added to T_d.

    Raises ParameterError for frequencies that are not finite and above 0 (most blocks have a pole at 0).
    """
    omega, s = _laplace(frequency_rad_per_s)
    hold_s = 0.0 if half_sample_of_s is None else 0.5 * positive("half_sample_of_s", half_sample_of_s)
    robot = s * plant.robot.position_response(omega) * np.exp(-s * hold_s)
    coupling = plant.coupling.stiffness_n_per_m / s + plant.coupling.damping_n_s_per_m
    payload = 1.0 / (plant.payload.mass_kg * s + plant.payload.drag_n_s_per_m)
    stiffness, damping, mass = plant.environment.coefficients
    environment = mass * s + damping + stiffness / s
    touched = 1.0 + payload * environment
    return PlantBlocks(
        frequency_rad_per_s=omega,
        robot=robot,
        coupling=coupling,
        payload=payload,
        environment=environment,
        felt_impedance=coupling * touched / (touched + payload * coupling),
        wrench=plant.wrench_filter.response(omega),
    )


def controller_blocks(controller: AdmittanceController, frequency_rad_per_s: FloatArray) -> ControllerBlocks:
    """Evaluate the controller's blocks at s = jω, see `plant_blocks`."""
    omega, s = _laplace(frequency_rad_per_s)
    feedback, acceleration = filters_in_s(controller.numbers(), controller.compensation == "ideal")
    return ControllerBlocks(
        frequency_rad_per_s=omega,
        forward=_value(forward_in_s(controller.numbers()), s),
        feedback=_value(feedback, s),
        acceleration=_value(acceleration, s),
    )


def continuous_loop(
    plant: Plant,
    controller: AdmittanceController,
    frequency_rad_per_s: FloatArray,
    *,
    half_sample_of_s: float | None = None,
) -> ContinuousLoop:
    """Evaluate the loop at both break points (docs/method.md, "The loop").

    G = A(1 + C_ff)R/D with D = 1 − A(1 + C_ff)R·P̂·O_a/s + R·C_fb/s, and 1 + L_x = D (1 + L).
    """
    blocks = plant_blocks(plant, frequency_rad_per_s, half_sample_of_s=half_sample_of_s)
    law = controller_blocks(controller, frequency_rad_per_s)
    _, s = _laplace(frequency_rad_per_s)
    forward = law.forward * blocks.robot
    damped = blocks.robot * law.feedback / s - forward * controller.compensation_mass_kg * law.acceleration / s
    # With a filter of the wrench only what comes from the force passes it; without one this is 1.
    forward = forward * blocks.wrench
    admittance = forward / (1.0 + damped)
    at_force = admittance * blocks.felt_impedance
    sensitivity = 1.0 / (1.0 + at_force)
    return ContinuousLoop(
        plant=blocks,
        controller=law,
        rendered_admittance=admittance,
        at_force=at_force,
        at_command=damped + forward * blocks.felt_impedance,
        closed_loop=-at_force * sensitivity,
        sensitivity=sensitivity,
    )


def _value(fraction: tuple[tuple[float, ...], tuple[float, ...]], s: ComplexArray) -> ComplexArray:
    """Return numerator over denominator, in ascending powers of s."""
    numerator, denominator = (polyval(s, each) for each in fraction)
    return np.asarray(numerator / denominator, dtype=np.complex128)


def _laplace(frequency_rad_per_s: FloatArray) -> tuple[FloatArray, ComplexArray]:
    omega = np.array(frequency_rad_per_s, dtype=np.float64)
    if not (np.all(np.isfinite(omega)) and np.all(omega > 0.0)):
        raise ParameterError("frequency_rad_per_s", frequency_rad_per_s, "finite and above 0")
    return omega, np.asarray(1j * omega, dtype=np.complex128)
