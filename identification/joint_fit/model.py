"""The parameters of one axis, and its equations of motion over one sample (docs/method.md, "The loop").

The steps take complex parameters, too: a tiny imaginary part h of one makes the imaginary part of every entry h times
its derivative, exact to rounding, since nothing is subtracted (Al-Mohy and Higham 2010 on the matrix exponential).
The exponential is scipy's: that of `problems.model.sampled`, made for compiled code, takes three times as long here.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.model.robot import RobotModel
from problems.model.sampled import split_delay

from .kernel import Body

# Of floats, or of complex numbers where a parameter is one.
Array = NDArray[Any]
Rows = tuple[tuple[complex, ...], ...]

COUPLING_NAMES = ("stiffness_n_per_m", "damping_n_s_per_m", "drag_n_s_per_m", "mass_kg")
SURFACE_NAMES = ("stiffness_n_per_m", "damping_n_s_per_m", "mass_kg")
ROBOT_NAMES = (
    ("robot_frequency_rad_per_s", "delay_s"),
    ("robot_frequency_rad_per_s", "robot_damping_ratio", "delay_s"),
)


@dataclass(frozen=True, kw_only=True)
class ParameterLayout:
    """Where each parameter is in the vector: coupling, robot (order 0 is none), then the surfaces."""

    robot_order: int
    surfaces: int

    @property
    def names(self) -> tuple[str, ...]:
        """Name every parameter: K_s, B_s, B_p, M_p; ω, (ζ,) T_d; then K_e, B_e, M_e of each surface."""
        robot = ROBOT_NAMES[self.robot_order - 1] if self.robot_order else ()
        walls = tuple(f"environment{i + 1}_{name}" for i in range(self.surfaces) for name in SURFACE_NAMES)
        return COUPLING_NAMES + robot + walls

    @property
    def robot(self) -> slice:
        """Return where ω, (ζ,) T_d are."""
        return slice(4, 4 + (self.robot_order + 1 if self.robot_order else 0))

    def surface(self, index: int) -> slice:
        """Return where K_e, B_e, M_e of a surface are."""
        first = self.robot.stop + 3 * index
        return slice(first, first + 3)

    def __len__(self) -> int:
        return len(self.names)


def robot_model(values: FloatArray) -> RobotModel:
    """Return r(s) of one pole (ω, T_d) or two (ω, ζ, T_d)."""
    omega, delay = float(values[0]), float(values[-1])
    if len(values) == 2:
        return RobotModel.from_bandwidth(bandwidth_rad_per_s=omega, delay_s=delay)
    denominator = np.array([1.0, 2.0 * float(values[1]) * omega, omega**2])
    return RobotModel(numerator=np.array([omega**2]), denominator=denominator, delay_s=delay)


@dataclass(frozen=True, kw_only=True)
class Hold:
    """What acts on the robot in one sample: the command `older` samples ago for `fraction` of it, then the next."""

    older: int
    fraction: complex


def held(delay_s: complex, period_s: float) -> Hold:
    """Split a delay into whole samples and the part of a sample in which the older command still acts.

    At a delay of whole samples the derivative is that of a longer one.
    """
    whole, fraction = split_delay(delay_s.real, period_s)
    return Hold(older=whole + 1, fraction=fraction + 1j * delay_s.imag / period_s if delay_s.imag else fraction)


def robot_rate(values: Sequence[complex] | FloatArray, period_s: float) -> Array:
    """Return rows of d(robot state)/dτ over (state, command), τ in samples: x, or x and its rate."""
    omega = values[0] * period_s
    if len(values) == 2:
        return np.array([[-omega, omega]])
    zeta = values[1]
    return np.array([[0.0, 1.0, 0.0], [-(omega**2), -2.0 * zeta * omega, omega**2]])


def held_step(values: Sequence[complex] | FloatArray, period_s: float) -> tuple[Array, int]:
    """Return what moves the robot's state over one sample, (order, order + 2), and how old the older command is.

    It acts on state, older and newer command (`run_robot`).
    """
    hold, rate = held(complex(values[-1]), period_s), robot_rate(values, period_s)
    order = len(rate)
    generator = np.zeros((order + 1, order + 1), dtype=rate.dtype)
    generator[:order] = rate
    first, second = expm(generator * hold.fraction), expm(generator * (1.0 - hold.fraction))
    step = np.zeros((order, order + 2), dtype=np.result_type(first, second))
    step[:, :order] = second[:order, :order] @ first[:order, :order]
    step[:, order] = second[:order, :order] @ first[:order, order]
    step[:, order + 1] = second[:order, order]
    return step, hold.older


def body(coupling: Sequence[complex] | FloatArray, surface: Sequence[complex] | FloatArray, period_s: float) -> Body:
    """Return the parameters with time counted in samples."""
    k_s, b_s, b_p, m_p = (_number(v) for v in coupling)
    k_e, b_e, m_e = (_number(v) for v in surface)
    h = period_s
    return Body(k_s, b_s / h, b_p / h, m_p / h**2, k_e, b_e / h, m_e / h**2)


def _number(value: complex) -> complex:
    """Return a plain number, complex only if it has to be: what does not depend on it stays real."""
    return complex(value) if value.imag != 0.0 else float(value.real)


def payload_step(of: Body, robot: Array | None, fraction: complex, *, touching: bool) -> tuple[Array, Array]:
    """Return (2, 2) and (2, m) matrices, read-only: p' = phi p + gamma w over one sample, exactly.

    w is (robot state, older and newer command, if there is a robot; then four Taylor coefficients of the rest of the
    flange's path). M_p dv_p/dt = −F − B_p v_p − F_e, F = K_s (x_p − x) + B_s (v_p − v).
    """
    rows = None if robot is None else tuple(map(tuple, robot.tolist()))
    loaded = (of[3] + of[6], of[0] + of[4], of[1] + of[2] + of[5]) if touching else (of[3], of[0], of[1] + of[2])
    return _payload_step(*loaded, of[0], of[1], rows, fraction)


# Every span asks for the same few steps. A complex number with no imaginary part is equal to a float, and is not one.
@lru_cache(maxsize=256, typed=True)
def _payload_step(
    mass: complex,
    stiffness: complex,
    damping: complex,
    k_s: complex,
    b_s: complex,
    robot: Rows | None,
    fraction: complex,
) -> tuple[Array, Array]:
    order = 0 if robot is None else len(robot)
    # p, robot state, command, rest of the path and three derivatives.
    size = 2 + order + (1 if order else 0) + 4
    parts = [mass, stiffness, damping, k_s, b_s, *(robot[-1] if robot is not None else ())]
    a = np.zeros((size, size), dtype=np.result_type(*parts))
    a[0, 1] = 1.0
    a[1, :2] = -stiffness / mass, -damping / mass
    rest = size - 4
    a[1, rest], a[1, rest + 1] = k_s / mass, b_s / mass
    for i in range(3):
        a[rest + i, rest + i + 1] = 1.0
    factorials = np.array([1.0, 1.0, 2.0, 6.0])
    if robot is None:
        whole = expm(a)[:2]
        return _read_only(whole[:, :2], whole[:, 2:] * factorials)
    a[2 : 2 + order, 2 : 3 + order] = robot
    a[1, 2] += k_s / mass
    a[1, 2 : 3 + order] += b_s / mass * np.array(robot[0])
    first, second = expm(np.stack([a * fraction, a * (1.0 - fraction)]))
    held_column = 2 + order
    newer = second[:2, held_column].copy()
    carry = second[:2].copy()
    carry[:, held_column] = 0.0
    whole = carry @ first
    gamma = np.column_stack([whole[:, 2 : 2 + order], whole[:, held_column], newer, whole[:, rest:] * factorials])
    return _read_only(whole[:, :2], gamma)


def _read_only(phi: Array, gamma: Array) -> tuple[Array, Array]:
    kept = np.array(phi, order="C"), np.array(gamma, order="C")
    kept[0].setflags(write=False)
    kept[1].setflags(write=False)
    return kept


def swing_step(of: Body, *, back_at_once: bool) -> Array:
    """Return the (2, 2) step, read-only, of a freed environment, M_e x'' + B_e x' + K_e x = 0."""
    return _swing_step(0.0, 0.0, 0.0) if back_at_once else _swing_step(*of[4:])


@lru_cache(maxsize=64, typed=True)
def _swing_step(k_e: complex, b_e: complex, m_e: complex) -> Array:
    step = np.zeros((2, 2), dtype=np.result_type(k_e, b_e, m_e))
    if m_e.real > 0.0:
        step[:] = expm(np.array([[0.0, 1.0], [-k_e / m_e, -b_e / m_e]]))
    step.setflags(write=False)
    return step
