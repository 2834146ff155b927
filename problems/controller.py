"""The sampled admittance controller: Tustin forms of A(1+C_ff) and C_fb (MODEL.md, "Continuous blocks")."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._checks import non_negative, positive
from .compiled import compiled
from .errors import ParameterError

FloatArray = NDArray[np.float64]

# MODEL.md, erratum 2: the paper prints 2e-5 and 7.5e-6, which cannot be seconds.
SMALLEST_FEEDBACK_DAMPING_S = 1e-4
PAPER_VELOCITY_FILTER_RAD_PER_S = 120.0


@dataclass(frozen=True, kw_only=True)
class AdmittanceController:
    """x^d = A(1 + C_ff)(F^d + F) − C_fb x with A = 1/(M_a s² + B_a s), C_ff = K_l s, C_fb = B_fb ω_v s/(s + ω_v).

    `mass_kg` M_a, `damping_n_s_per_m` B_a, `lead_s` K_l, `feedback_damping_s` B_fb (seconds),
    `velocity_filter_rad_per_s` ω_v.

    Raises ParameterError for values out of range, among them a B_fb in the paper's printed unit.
    """

    mass_kg: float
    damping_n_s_per_m: float
    lead_s: float = 0.0
    feedback_damping_s: float = 0.0
    velocity_filter_rad_per_s: float = PAPER_VELOCITY_FILTER_RAD_PER_S

    def __post_init__(self) -> None:
        object.__setattr__(self, "mass_kg", positive("mass_kg", self.mass_kg))
        object.__setattr__(self, "damping_n_s_per_m", positive("damping_n_s_per_m", self.damping_n_s_per_m))
        object.__setattr__(self, "lead_s", non_negative("lead_s", self.lead_s))
        object.__setattr__(self, "feedback_damping_s", check_feedback_damping(self.feedback_damping_s))
        object.__setattr__(
            self,
            "velocity_filter_rad_per_s",
            positive("velocity_filter_rad_per_s", self.velocity_filter_rad_per_s),
        )

    def parameters(self) -> FloatArray:
        """Return (M_a, B_a, K_l, B_fb, ω_v), the order that the kernels take."""
        return np.array(
            [
                self.mass_kg,
                self.damping_n_s_per_m,
                self.lead_s,
                self.feedback_damping_s,
                self.velocity_filter_rad_per_s,
            ]
        )


def check_feedback_damping(feedback_damping_s: float) -> float:
    """Return B_fb [s], refusing values that can only be the paper's printed unit (MODEL.md, erratum 2)."""
    value = non_negative("feedback_damping_s", feedback_damping_s)
    if 0.0 < value < SMALLEST_FEEDBACK_DAMPING_S:
        raise ParameterError(
            "feedback_damping_s",
            value,
            f"0 or at least {SMALLEST_FEEDBACK_DAMPING_S:g} s (smaller values change nothing that can be measured; the "
            "paper prints B_fb in another unit, see `feedback_damping_from_paper_mm`)",
        )
    return value


def feedback_damping_from_paper_mm(printed: float) -> float:
    """Convert a B_fb as the paper prints it to seconds, reading it as s·m/mm: times 1000 (MODEL.md, erratum 2)."""
    return check_feedback_damping(1000.0 * printed)


@compiled
def first_order_tustin(n1: float, n0: float, d1: float, d0: float, h: float) -> tuple[float, float, float]:
    """Return (direct, pole, gain) of (n1 s + n0)/(d1 s + d0) under s = (2/h)(z − 1)/(z + 1).

    y_k = direct·e_k + s_k, s_{k+1} = pole·s_k + gain·e_k.
    """
    w = 2.0 / h
    lead = d1 * w + d0
    direct, second = (n1 * w + n0) / lead, (n0 - n1 * w) / lead
    pole = (d1 * w - d0) / lead
    return direct, pole, second + pole * direct


@compiled
def controller_blocks(parameters: FloatArray, h: float) -> FloatArray:
    """Return the three first-order Tustin blocks, rows (direct, pole, gain): integrator, lag, feedback.

    The first two add up to A(1 + C_ff) = (1/B_a)/s + (K_l − M_a/B_a)/(M_a s + B_a), driven by F^d + F; the third is
    C_fb, driven by x and subtracted. The Tustin form of a sum is the sum of the Tustin forms, so this is the paper's
    difference equation in the smallest number of states.
    """
    mass, damping, lead, feedback, corner = parameters
    blocks = np.empty((3, 3))
    blocks[0, :] = first_order_tustin(0.0, 1.0 / damping, 1.0, 0.0, h)
    blocks[1, :] = first_order_tustin(0.0, lead - mass / damping, mass, damping, h)
    blocks[2, :] = first_order_tustin(feedback * corner, 0.0, 1.0, corner, h)
    return blocks
