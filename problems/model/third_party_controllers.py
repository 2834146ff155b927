"""The admittance laws that two public controllers run, one axis each, as difference equations.

Read in the sources of ros2_controllers (admittance_rule_impl.hpp, 2.x to 6.x) and of cartesian_controllers
(cartesian_force_controller.cpp, PDController.cpp, IKSolver.cpp and ForwardDynamicsSolver.cpp, branch ros2). The joints'
kinematics is taken as exact, so that an axis of the control frame is one such equation by itself.
"""

import math
from dataclasses import dataclass

import numpy as np

from .._checks import non_negative, positive
from ..errors import ParameterError
from .linear_controllers import LinearController

_ROUNDING = 1e-9
VIRTUAL_STEP_S = 0.02
"""The time that forward dynamics advances in every cycle, whatever the cycle's length."""
VIRTUAL_MASS = 1.0
"""The mass (kg) and the inertia (kg·m²) of the last link of the virtual robot."""
VELOCITY_KEPT = 0.9
"""What is kept of the virtual velocity in every cycle."""


@dataclass(frozen=True, kw_only=True)
class SpringAdmittance:
    """M dv/dt = f − D v − K x − J M v, f a first-order low-pass of F^d + F, by the semi-implicit Euler rule.

    f_k = a e_k + (1 − a) f_{k−1}; v_{k+1} = v_k + h ((f_k − D v_k − K x_k)/M − J v_k); p_{k+1} = p_k + h v_{k+1};
    x^d_k = p_{k+1}. The spring pulls on the measured position x. D = 2 ζ √(M K), so K = 0 leaves no damping but J's.

    `mass` M (kg), `damping_ratio` ζ, `stiffness` K (N/m), `joint_damping_per_s` J (1/s), `filter_coefficient` a in
    (0, 1], where 1 does not filter. Raises ParameterError for values out of range.
    """

    mass: float
    damping_ratio: float
    stiffness: float
    joint_damping_per_s: float
    filter_coefficient: float

    def __post_init__(self) -> None:
        positive("mass", self.mass)
        for name in ("damping_ratio", "stiffness", "joint_damping_per_s"):
            non_negative(name, getattr(self, name))
        if not 0.0 < self.filter_coefficient <= 1.0:
            raise ParameterError("filter_coefficient", self.filter_coefficient, "above 0 and at most 1 (no filter)")

    @property
    def damping(self) -> float:
        """D, what the damping ratio makes (N·s/m)."""
        return 2.0 * self.damping_ratio * math.sqrt(self.mass * self.stiffness)

    @property
    def total_damping(self) -> float:
        """D + J M, what a steady speed costs (N·s/m)."""
        return self.damping + self.joint_damping_per_s * self.mass

    def own_pole(self, sample_time_s: float) -> float:
        """Return 1 − h (D/M + J), by which the commanded speed goes on without force or spring.

        The continuous law dies out without a change of sign. Below 0 the speed changes sign in every cycle, which
        force noise excites at half the update rate, and below −1 it grows.
        """
        return 1.0 - positive("sample_time_s", sample_time_s) * self.total_damping / self.mass

    def law(self, sample_time_s: float) -> LinearController:
        """Return the difference equation at h; states f_{k−1}, v_k, p_k."""
        h = positive("sample_time_s", sample_time_s)
        spring = self._matrix(h, self.stiffness)
        return LinearController(
            matrix=spring,
            rest=np.array([0.0, 0.0, 1.0]),
            sample_time_s=h,
            holds_position=self.stiffness > 0.0,
            approach=self._matrix(h, 0.0),
        )

    def _matrix(self, h: float, stiffness: float) -> np.ndarray:
        a, gain = self.filter_coefficient, h / self.mass
        force = np.array([1.0 - a, 0.0, 0.0, a, 0.0])
        speed = gain * force + np.array([0.0, self.own_pole(h), 0.0, 0.0, -gain * stiffness])
        position = h * speed + np.array([0.0, 0.0, 1.0, 0.0, 0.0])
        return np.array([force, speed, position, position])


@dataclass(frozen=True, kw_only=True)
class ForwardDynamics:
    """A virtual mass of 1 that is pushed by a PD rule on F^d + F and moves the command ahead of the measured position.

    g_k = P e_k + D (e_k − e_{k−1})/T; x^d_k = x_k + T v_k; v_{k+1} = 0.9 (v_k + T g_k/1) with T = 0.02 s in every
    cycle. The mass of the admittance is not free, and neither speed nor damping know the cycle's length. Its own poles
    are 0.9 and, of the derivative, 0: they never change sign.

    `proportional` P (what a newton pushes with, in newtons), `derivative` D (the same, times s). Raises ParameterError
    for values out of range.
    """

    proportional: float
    derivative: float

    def __post_init__(self) -> None:
        positive("proportional", self.proportional)
        non_negative("derivative", self.derivative)

    def law(self, sample_time_s: float) -> LinearController:
        """Return the difference equation at h; states v_k, e_{k−1}."""
        step, share = VIRTUAL_STEP_S, VELOCITY_KEPT * VIRTUAL_STEP_S / VIRTUAL_MASS
        slope = self.derivative / step
        return LinearController(
            matrix=np.array(
                [
                    [VELOCITY_KEPT, -share * slope, share * (self.proportional + slope), 0.0],
                    [0.0, 0.0, 1.0, 0.0],
                    [step, 0.0, 0.0, 1.0],
                ]
            ),
            rest=np.zeros(2),
            sample_time_s=positive("sample_time_s", sample_time_s),
            follows_position=True,
        )


def alternates(law: LinearController) -> bool:
    """Return whether a pole that the law has by itself, nothing fed back, lies left of the imaginary axis of z.

    Such a part of the command changes sign from cycle to cycle, whatever the plant damps of it.
    """
    r = law.state_count
    return bool(np.any(np.linalg.eigvals(law.matrix[:r, :r]).real < -_ROUNDING)) if r else False
