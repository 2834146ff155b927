"""The continuous plant of one axis: robot, coupling, payload and environment (docs/method.md, "The loop").

Rotational axes use the same equations: read m as rad, N as N·m and kg as kg·m² in every name below.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .._checks import non_negative, positive
from ..arrays import ComplexArray, FloatArray
from ..compiled import equation
from ..errors import ParameterError
from .robot import RobotModel


@dataclass(frozen=True, kw_only=True)
class PayloadDynamics:
    """P = 1/(M_p s + B_p): `mass_kg` M_p, and `drag_n_s_per_m` B_p, damping to ground."""

    mass_kg: float
    drag_n_s_per_m: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "mass_kg", positive("mass_kg", self.mass_kg))
        object.__setattr__(self, "drag_n_s_per_m", non_negative("drag_n_s_per_m", self.drag_n_s_per_m))


@dataclass(frozen=True, kw_only=True)
class Bumper:
    """The part of a payload that touches, behind a spring and a damper inside the payload: a bumper, a soft structure.

    `mass_kg` M_t is a part of M_p; `stiffness_n_per_m` K_t and `damping_n_s_per_m` B_t lie between it and the rest.
    """

    mass_kg: float
    stiffness_n_per_m: float
    damping_n_s_per_m: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "mass_kg", positive("bumper.mass_kg", self.mass_kg))
        object.__setattr__(self, "stiffness_n_per_m", positive("bumper.stiffness_n_per_m", self.stiffness_n_per_m))
        object.__setattr__(self, "damping_n_s_per_m", non_negative("bumper.damping_n_s_per_m", self.damping_n_s_per_m))


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
    """E = M_e s + B_e + K_e/s: stiffness, damping and moving mass of what is touched; all zero is free space."""

    stiffness_n_per_m: float
    damping_n_s_per_m: float = 0.0
    mass_kg: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "stiffness_n_per_m", non_negative("stiffness_n_per_m", self.stiffness_n_per_m))
        object.__setattr__(self, "damping_n_s_per_m", non_negative("damping_n_s_per_m", self.damping_n_s_per_m))
        object.__setattr__(self, "mass_kg", non_negative("mass_kg", self.mass_kg))

    @property
    def coefficients(self) -> tuple[float, float, float]:
        """K_e, B_e, M_e: E(s) s in ascending powers of s, which is all that the equations take of it."""
        return self.stiffness_n_per_m, self.damping_n_s_per_m, self.mass_kg

    @property
    def is_free_space(self) -> bool:
        """Whether nothing is touched."""
        return self.coefficients == (0.0, 0.0, 0.0)

    @property
    def is_anchored(self) -> bool:
        """Whether it holds a position; without stiffness the loop keeps its integrator at z = 1."""
        return self.stiffness_n_per_m > 0.0


# Of the plant without a filter of the wrench, in the order of `Plant.parameters`.
PLANT_PARAMETERS = 7
# Place of K_e among them, and of the constant term in ascending powers.
ENVIRONMENT_STIFFNESS, CONSTANT = 4, 0
# What acts at once, `direct` of `write_plant`: d_F, d_e and p_e.
OF_FORCE, OF_CONTACT, OF_PUSH = 0, 1, 2
FREE_SPACE = Environment(stiffness_n_per_m=0.0)


@dataclass(frozen=True, kw_only=True)
class WrenchFilter:
    """What lies between the coupling force F and the force F_m that the controller reads.

    τ dF_m/dt = F − F_m with `time_constant_s` τ (a first-order filter in the sensor or its driver; 0 is none), then a
    delay by `delay_s` θ: F_m(s) = e^(−sθ)/(1 + τ s) F(s).
    """

    time_constant_s: float = 0.0
    delay_s: float = 0.0

    def __post_init__(self) -> None:
        name = "wrench_filter.time_constant_s"
        object.__setattr__(self, "time_constant_s", non_negative(name, self.time_constant_s))
        object.__setattr__(self, "delay_s", non_negative("wrench_filter.delay_s", self.delay_s))

    @classmethod
    def from_corner(cls, corner_hz: float) -> "WrenchFilter":
        """Return the first-order filter with this corner, τ = 1/(2π f)."""
        return cls(time_constant_s=1.0 / (2.0 * math.pi * positive("wrench_filter.corner_hz", corner_hz)))

    @property
    def is_none(self) -> bool:
        """Whether the controller reads F itself."""
        return self.time_constant_s == 0.0 and self.delay_s == 0.0

    def response(self, frequency_rad_per_s: FloatArray) -> ComplexArray:
        """Return F_m/F at the frequencies (n,)."""
        s = 1j * np.asarray(frequency_rad_per_s, dtype=np.float64)
        return np.asarray(np.exp(-s * self.delay_s) / (1.0 + self.time_constant_s * s), dtype=np.complex128)


NO_FILTER = WrenchFilter()


@dataclass(frozen=True, kw_only=True)
class Plant:
    """Everything between the position command and the force signal on one axis.

    With a `bumper` the payload is two masses, M_p together: what the coupling carries, and what touches. The compiled
    kernels of many plants and the proofs know no bumper and refuse one. Raises ParameterError for a bumper that is not
    lighter than the payload, and for one on an environment with mass.
    """

    robot: RobotModel
    coupling: Coupling
    payload: PayloadDynamics
    environment: Environment = FREE_SPACE
    wrench_filter: WrenchFilter = field(default=NO_FILTER)
    bumper: Bumper | None = None

    def __post_init__(self) -> None:
        if self.bumper is None:
            return
        if not self.bumper.mass_kg < self.payload.mass_kg:
            must = f"below the payload's {self.payload.mass_kg:g} kg"
            raise ParameterError("bumper.mass_kg", self.bumper.mass_kg, must)
        if self.environment.mass_kg > 0.0:
            raise ParameterError("environment.mass_kg", self.environment.mass_kg, "0 beside a bumper of the payload")

    def in_contact_with(self, environment: Environment) -> "Plant":
        """Return the same plant with another environment."""
        return replace(self, environment=environment)

    @property
    def loop_delay_s(self) -> float:
        """T_d and the wrench's delay θ together: how late a command answers to what was measured for it."""
        return self.robot.delay_s + self.wrench_filter.delay_s

    @property
    def port(self) -> tuple[RobotModel, WrenchFilter]:
        """What the rendered admittance depends on besides the controller."""
        return self.robot, self.wrench_filter

    def require_one_piece(self) -> None:
        """Raise ParameterError for a payload with a bumper, which most of what is computed does not know."""
        if self.bumper is not None:
            raise ParameterError("bumper", self.bumper, "none where a payload is one mass")

    def parameters(self) -> FloatArray:
        """Return (K_s, B_s, M_p, B_p, K_e, B_e, M_e), then τ if the wrench is filtered: what the equations take.

        Raises ParameterError for a payload with a bumper.
        """
        self.require_one_piece()
        time_constant = self.wrench_filter.time_constant_s
        return np.array(
            [
                self.coupling.stiffness_n_per_m,
                self.coupling.damping_n_s_per_m,
                self.payload.mass_kg,
                self.payload.drag_n_s_per_m,
                *self.environment.coefficients,
                *([time_constant] if time_constant > 0.0 else []),
            ]
        )


@dataclass(frozen=True, kw_only=True)
class PlantMatrices:
    """ds/dτ = A s + B x^d + p f in the dimensionless time τ = t/`time_scale_s`; rows below act on s, x^d and f.

    The state is (robot chain, x_p, `time_scale_s`·v_p): one size for every entry, so that exponentials are exact to
    rounding; before x_p comes F_m in metres of the coupling where the wrench is filtered (x_p is always the last but
    one). Of a payload with a bumper x_p is what touches; place and speed of the rest come before it. f is an outside
    force on the payload (a hand), positive towards +x. x = c_x s; the force that is measured, F (or F_m), = c_F s +
    d_F x^d; F_e = c_e s + d_e x^d + p_e f while the payload stays on the environment.
    """

    a: FloatArray
    b: FloatArray
    push: FloatArray
    c_position: FloatArray
    c_force: FloatArray
    d_force: float
    c_contact: FloatArray
    d_contact: float
    push_contact: float
    time_scale_s: float


@equation
def _write_contact(a: Any, b: Any, c_contact: Any, direct: Any, k_e: Any, b_e: Any, m_e: Any) -> None:
    """Write F_e = M_e dv_p/dt + B_e v_p + K_e x_p over the state and the command; x_p and v_p are last."""
    n = a.shape[0]
    for i in range(n):
        c_contact[i] = m_e * a[n - 1, i]
    c_contact[n - 2] = c_contact[n - 2] + k_e
    c_contact[n - 1] = c_contact[n - 1] + b_e
    direct[OF_CONTACT] = m_e * b[n - 1]


@equation
def _write_filter(a: Any, b: Any, c_force: Any, direct: Any, n: int, rate: Any, answer: Any) -> None:
    """Put F_m in the place of F: the state `n` is F_m over `answer`, the stiffness of the coupling within t."""
    for i in range(a.shape[0]):
        a[n, i] = rate * c_force[i] / answer
        c_force[i] = 0.0
    a[n, n] = -rate
    b[n] = rate * direct[OF_FORCE] / answer
    c_force[n] = answer
    direct[OF_FORCE] = 0.0


@equation
def write_plant(
    a: Any,
    b: Any,
    push: Any,
    c_position: Any,
    c_force: Any,
    c_contact: Any,
    direct: Any,
    numerator: Any,
    denominator: Any,
    parameters: Any,
    t: float,
) -> None:
    """Fill zeroed arrays with the equations of motion of one axis, delay left out; `direct` gets (d_F, d_e, p_e).

    x = r(s) x^d; F = K_s (x_p − x) + B_s (v_p − v); F_e = M_e dv_p/dt + B_e v_p + K_e x_p, the wall at x_p = 0;
    M_p dv_p/dt = −F − B_p v_p − F_e + f (docs/method.md, "The loop", with its signs). With an eighth parameter τ the
    measured force is that behind the filter, τ dF_m/dt = F − F_m, one state more. `numerator` (n,) and `denominator`
    (n + 1,) hold ascending powers of s, the latter monic; `parameters` as in `Plant.parameters`.
    """
    n, filtered = denominator.shape[0] - 1, parameters.shape[0] > PLANT_PARAMETERS
    p = n + 1 if filtered else n
    k_s, coupling_damping, m_p, drag = parameters[0], parameters[1], parameters[2], parameters[3]
    k_e, damping, mass = parameters[4], parameters[5], parameters[6]
    b_s, b_p, b_e, m_e = coupling_damping / t, drag / t, damping / t, mass / (t * t)
    # Controllable form of r(s) in p = s t: state i is t^i times the i-th derivative of one position-like signal.
    for i in range(n - 1):
        a[i, i + 1] = 1.0
    for i in range(n):
        a[n - 1, i] = -denominator[i] * t ** (n - i)
        c_position[i] = numerator[i] / denominator[CONSTANT] / t**i
    b[n - 1] = denominator[CONSTANT] * t**n

    # Velocity of the flange, times t, is c_position shifted along the chain.
    last = c_position[n - 1]
    for i in range(n):
        velocity = last * a[n - 1, i]
        if i > 0:
            velocity = velocity + c_position[i - 1]
        c_force[i] = -k_s * c_position[i] - b_s * velocity
    c_force[p] = k_s
    c_force[p + 1] = b_s
    direct[OF_FORCE] = -b_s * last * b[n - 1]

    scale = t * t / (m_p + mass)
    a[p, p + 1] = 1.0
    for i in range(p + 2):
        a[p + 1, i] = -scale * c_force[i]
    a[p + 1, p] = a[p + 1, p] - scale * k_e
    a[p + 1, p + 1] = a[p + 1, p + 1] - scale * (b_p + b_e)
    b[p + 1] = -scale * direct[OF_FORCE]
    push[p + 1] = scale

    _write_contact(a, b, c_contact, direct, k_e, b_e, m_e)
    direct[OF_PUSH] = m_e * scale
    if filtered:
        _write_filter(a, b, c_force, direct, n, t / parameters[PLANT_PARAMETERS], k_s + b_s)


def build_plant_matrices(plant: Plant, time_scale_s: float) -> PlantMatrices:
    """Build the equations of motion of one axis as first-order equations, see `write_plant`."""
    if plant.bumper is not None:
        return _with_bumper(plant, plant.bumper, time_scale_s)
    t, parameters = positive("time_scale_s", time_scale_s), plant.parameters()
    n = plant.robot.order + 2 + len(parameters) - PLANT_PARAMETERS
    numerator, denominator = plant.robot.ascending()
    a = np.zeros((n, n))
    b, push, c_position, c_force, c_contact = (np.zeros(n) for _ in range(5))
    direct = np.zeros(3)
    write_plant(a, b, push, c_position, c_force, c_contact, direct, numerator, denominator, parameters, t)
    return PlantMatrices(
        a=a,
        b=b,
        push=push,
        c_position=c_position,
        c_force=c_force,
        d_force=float(direct[OF_FORCE]),
        c_contact=c_contact,
        d_contact=float(direct[OF_CONTACT]),
        push_contact=float(direct[OF_PUSH]),
        time_scale_s=t,
    )


def _with_bumper(plant: Plant, bumper: Bumper, time_scale_s: float) -> PlantMatrices:
    """Build the equations of a payload in two parts: (M_p − M_t) dv/dt = −F − B_p v − N + f, M_t dv_p/dt = N − F_e.

    N = K_t (x − x_p) + B_t (v − v_p) is what the rest of the payload, at x, puts on the bumper.
    """
    t, environment = positive("time_scale_s", time_scale_s), plant.environment
    rest = replace(plant.payload, mass_kg=plant.payload.mass_kg - bumper.mass_kg)
    of = build_plant_matrices(replace(plant, payload=rest, environment=FREE_SPACE, bumper=None), t)
    n = len(of.b)
    place, speed = n, n + 1
    pushed = np.zeros(n + 2)
    pushed[[n - 2, place]] = bumper.stiffness_n_per_m, -bumper.stiffness_n_per_m
    pushed[[n - 1, speed]] = bumper.damping_n_s_per_m / t, -bumper.damping_n_s_per_m / t
    pressed = np.zeros(n + 2)
    pressed[[place, speed]] = environment.stiffness_n_per_m, environment.damping_n_s_per_m / t
    a = np.pad(of.a, (0, 2))
    a[n - 1] -= t * t / rest.mass_kg * pushed
    a[place, speed] = 1.0
    a[speed] = t * t / bumper.mass_kg * (pushed - pressed)
    return replace(
        of,
        a=a,
        b=np.pad(of.b, (0, 2)),
        push=np.pad(of.push, (0, 2)),
        c_position=np.pad(of.c_position, (0, 2)),
        c_force=np.pad(of.c_force, (0, 2)),
        c_contact=pressed,
    )
