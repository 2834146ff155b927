"""Laws of the form M dv/dt = f − D v − K x as public controllers discretise them, one axis each.

Read in the sources of URScript_Examples (admittance_control.script), crisp_controllers
(cartesian_admittance_controller.cpp), cartesian_controllers_ros2 (vanilla_cartesian_admittance_rule.cpp) and
lbr_fri_ros2_stack (admittance_controller.cpp); docs/targets.md names the commits.
"""

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from .._checks import non_negative, positive
from ..arrays import FloatArray
from ..errors import ParameterError
from .linear_controllers import LinearController


class Discretization(Enum):
    """How a controller steps M dv/dt = f − D v − K x; e_k is the wrench, x_k the measured position, h the period.

    `TRAPEZOIDAL`: a_k = (e_k − D v_{k−1})/M; v_k = v_{k−1} + h/2 (a_k + a_{k−1}); x^d_k = p_k = p_{k−1} + h v_k.
    `EULER`: v_k = v_{k−1} + h (e_k − D v_{k−1})/M; x^d_k = p_k = p_{k−1} + h v_k.
    `MEASURED_MOTION`: w_k = (x_k − x_{k−1})/h; v_k = v_{k−1} + h (e_k − D w_k − K x_k)/M; x^d_k as above.
    `FROM_MEASURED`: w_k as above; u_k = w_k + h (e_k − D w_k)/M; y_k = y_{k−1} + a (u_k − y_{k−1});
    x^d_k = x_k + h y_k.
    """

    TRAPEZOIDAL = "trapezoidal"
    EULER = "euler"
    MEASURED_MOTION = "measured motion"
    FROM_MEASURED = "from the measured position"


@dataclass(frozen=True, kw_only=True)
class MassDamper:
    """One axis of a law with mass and damping; a spring where the discretisation measures the motion it damps.

    Parameters
    ----------
    discretization
        The rule by which it is stepped.
    mass
        M (kg; kg·m² about a turning axis).
    damping
        D (N·s/m; N·m·s/rad).
    stiffness
        K (N/m; N·m/rad), for `MEASURED_MOTION` alone.
    filter_time_s
        The time constant T of the low-pass of the speed, a = 1 − e^(−h/T), for `FROM_MEASURED` alone; 0 for none.

    Raises
    ------
    ParameterError
        A value out of range, or one that the discretisation has no place for.

    """

    discretization: Discretization
    mass: float
    damping: float
    stiffness: float = 0.0
    filter_time_s: float = 0.0

    def __post_init__(self) -> None:
        positive("mass", self.mass)
        for name, owner in (
            ("damping", None),
            ("stiffness", Discretization.MEASURED_MOTION),
            ("filter_time_s", Discretization.FROM_MEASURED),
        ):
            value = non_negative(name, getattr(self, name))
            if value > 0.0 and owner not in (None, self.discretization):
                raise ParameterError(name, value, f"0 with the discretisation {self.discretization.value}")

    def law(self, sample_time_s: float) -> LinearController:
        """Return the difference equation at the period h."""
        h = positive("sample_time_s", sample_time_s)
        kind = self.discretization
        if kind is Discretization.MEASURED_MOTION:
            return LinearController(
                matrix=self._measured_motion(h, self.stiffness),
                rest=np.array([0.0, 1.0, 1.0]),
                sample_time_s=h,
                holds_position=self.stiffness > 0.0,
                approach=self._measured_motion(h, 0.0),
            )
        if kind is Discretization.FROM_MEASURED:
            rest = np.array([1.0, 0.0])
            return LinearController(matrix=self._from_measured(h), rest=rest, sample_time_s=h, follows_position=True)
        if kind is Discretization.TRAPEZOIDAL:
            rest = np.array([0.0, 0.0, 1.0])
            return LinearController(matrix=self._trapezoidal(h), rest=rest, sample_time_s=h)
        return LinearController(matrix=self._euler(h), rest=np.array([0.0, 1.0]), sample_time_s=h)

    def _trapezoidal(self, h: float) -> FloatArray:
        """Return the matrix over (v, a, p; e, x)."""
        acceleration = np.array([-self.damping, 0.0, 0.0, 1.0, 0.0]) / self.mass
        speed = np.array([1.0, 0.5 * h, 0.0, 0.0, 0.0]) + 0.5 * h * acceleration
        position = np.array([0.0, 0.0, 1.0, 0.0, 0.0]) + h * speed
        return np.array([speed, acceleration, position, position])

    def _euler(self, h: float) -> FloatArray:
        """Return the matrix over (v, p; e, x)."""
        gain = h / self.mass
        speed = np.array([1.0 - gain * self.damping, 0.0, gain, 0.0])
        position = np.array([0.0, 1.0, 0.0, 0.0]) + h * speed
        return np.array([speed, position, position])

    def _measured_motion(self, h: float, stiffness: float) -> FloatArray:
        """Return the matrix over (v, p, x before; e, x)."""
        gain, drop = h / self.mass, self.damping / self.mass
        speed = np.array([1.0, 0.0, drop, gain, -drop - gain * stiffness])
        position = np.array([0.0, 1.0, 0.0, 0.0, 0.0]) + h * speed
        return np.array([speed, position, [0.0, 0.0, 0.0, 0.0, 1.0], position])

    def _from_measured(self, h: float) -> FloatArray:
        """Return the matrix over (x before, y; e, x)."""
        kept = 0.0 if self.filter_time_s == 0.0 else math.exp(-h / self.filter_time_s)
        # What is left of the measured speed once a period of damping is taken off.
        share = (1.0 - h * self.damping / self.mass) / h
        speed = np.array([-share, 0.0, h / self.mass, share])
        filtered = np.array([0.0, kept, 0.0, 0.0]) + (1.0 - kept) * speed
        measured = np.array([0.0, 0.0, 0.0, 1.0])
        return np.array([measured, filtered, measured + h * filtered])
