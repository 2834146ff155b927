"""The continuous plant of one axis: robot, coupling, payload and environment (MODEL.md, "Continuous blocks").

Rotational axes use the same equations with rad, N·m and kg·m².
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._checks import non_negative, positive
from .robot import RobotModel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Payload:
    """P = 1/(M_p s + B_p): `mass_kg` M_p, and `drag_n_s_per_m` B_p, damping to ground."""

    mass_kg: float
    drag_n_s_per_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mass_kg", positive("mass_kg", self.mass_kg))
        object.__setattr__(self, "drag_n_s_per_m", non_negative("drag_n_s_per_m", self.drag_n_s_per_m))


@dataclass(frozen=True, kw_only=True)
class Coupling:
    """C_s = K_s/s + B_s between flange and payload: sensor and gripper."""

    stiffness_n_per_m: float
    damping_n_s_per_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "stiffness_n_per_m", positive("stiffness_n_per_m", self.stiffness_n_per_m))
        object.__setattr__(self, "damping_n_s_per_m", non_negative("damping_n_s_per_m", self.damping_n_s_per_m))


@dataclass(frozen=True, kw_only=True)
class Environment:
    """E = B_e + K_e/s, massless; both zero is free space."""

    stiffness_n_per_m: float
    damping_n_s_per_m: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "stiffness_n_per_m", non_negative("stiffness_n_per_m", self.stiffness_n_per_m))
        object.__setattr__(self, "damping_n_s_per_m", non_negative("damping_n_s_per_m", self.damping_n_s_per_m))

    @property
    def is_free_space(self) -> bool:
        """Whether nothing is touched."""
        return self.stiffness_n_per_m == 0.0 and self.damping_n_s_per_m == 0.0


FREE_SPACE = Environment(stiffness_n_per_m=0.0)


@dataclass(frozen=True, kw_only=True)
class Plant:
    """Everything between the position command and the force signal on one axis."""

    robot: RobotModel
    coupling: Coupling
    payload: Payload
    environment: Environment = FREE_SPACE

    def in_contact_with(self, environment: Environment) -> "Plant":
        """Return the same plant with another environment."""
        return Plant(robot=self.robot, coupling=self.coupling, payload=self.payload, environment=environment)


@dataclass(frozen=True, kw_only=True)
class PlantMatrices:
    """ds/dτ = A s + B x^d in the dimensionless time τ = t/`time_scale_s`; rows below act on s and x^d.

    The state is (robot chain, x_p, `time_scale_s`·v_p): one size for every entry, so that exponentials are exact to
    rounding. x = c_x s; F = c_F s + d_F x^d.
    """

    a: FloatArray
    b: FloatArray
    c_position: FloatArray
    c_force: FloatArray
    d_force: float
    time_scale_s: float


def build_plant_matrices(plant: Plant, time_scale_s: float) -> PlantMatrices:
    """Write the equations of motion of one axis as first-order equations (delay left out).

    x = r(s) x^d; F = K_s (x_p − x) + B_s (v_p − v); M_p dv_p/dt = −F − B_p v_p − (K_e x_p + B_e v_p),
    with the wall at x_p = 0 (MODEL.md, "Continuous blocks", with its signs).
    """
    t, n = positive("time_scale_s", time_scale_s), plant.robot.order
    coupling, payload, environment = plant.coupling, plant.payload, plant.environment
    # Controllable form of r(s) in p = s t: state i is t^i times the i-th derivative of one position-like signal.
    denominator = plant.robot.denominator / t ** np.arange(n, -1, -1.0)
    numerator = plant.robot.numerator / t ** np.arange(len(plant.robot.numerator) - 1, -1, -1.0)
    lead = denominator[0]
    a = np.zeros((n + 2, n + 2))
    a[: n - 1, 1:n] = np.eye(n - 1)
    a[n - 1, :n] = -denominator[:0:-1] / lead
    b = np.zeros(n + 2)
    b[n - 1] = denominator[-1] / lead
    c_position = np.zeros(n + 2)
    c_position[: len(numerator)] = numerator[::-1] / denominator[-1]
    # Velocity of the flange times t, from the rows above.
    c_velocity, d_velocity = c_position @ a, float(c_position @ b)

    stiffness, damping = coupling.stiffness_n_per_m, coupling.damping_n_s_per_m / t
    c_force = -stiffness * c_position - damping * c_velocity
    c_force[n] += stiffness
    c_force[n + 1] += damping
    d_force = -damping * d_velocity

    scale = t * t / payload.mass_kg
    a[n, n + 1] = 1.0
    a[n + 1] = -scale * c_force
    a[n + 1, n] -= scale * environment.stiffness_n_per_m
    a[n + 1, n + 1] -= scale * (payload.drag_n_s_per_m + environment.damping_n_s_per_m) / t
    b[n + 1] = -scale * d_force
    return PlantMatrices(a=a, b=b, c_position=c_position, c_force=c_force, d_force=d_force, time_scale_s=t)
