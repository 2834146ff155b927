"""The admittance controller and its sampled form (docs/method.md, "The loop", errata 2 and 3)."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .._checks import non_negative, positive
from ..arrays import FloatArray
from ..compiled import compiled, equation
from ..errors import ParameterError
from . import difference
from .difference import (
    BIQUAD_1,
    BIQUAD_2,
    BIQUAD_POLE_1,
    BLOCK_ROWS,
    COMPENSATION,
    DERIVATIVE_GAIN,
    FEEDBACK_DAMPING,
    LAG_GAIN,
    POSITION_TO_LAG,
    ControlState,
)

Compensation = Literal["filtered", "ideal"]
Discretization = Literal["tustin", "forward_euler", "backward_euler"]

# Below this a feedback damping in seconds changes |G| by less than can be measured (0.003 dB for the printed value).
SMALLEST_FEEDBACK_DAMPING_S = 1e-4
PAPER_VELOCITY_FILTER_RAD_PER_S = 120.0
PAPER_ACCELERATION_FILTER_RAD_PER_S = 200.0

# s is replaced by (z − 1)/(h (θ z + 1 − θ)).
THETA: dict[Discretization, float] = {"tustin": 0.5, "forward_euler": 0.0, "backward_euler": 1.0}
CONTROLLER_STATES = 6


_NUMBERS: Callable[["AdmittanceController"], tuple[float, ...]] = attrgetter(
    "mass_kg",
    "damping_n_s_per_m",
    "lead_s",
    "feedback_damping_s",
    "velocity_filter_rad_per_s",
    "acceleration_filter_rad_per_s",
    "compensation_mass_kg",
)
_BIQUAD: Callable[["AdmittanceController"], tuple[float, ...]] = attrgetter(
    "biquad_zero_s", "biquad_zero_damping_ratio", "biquad_pole_s", "biquad_pole_damping_ratio"
)


@dataclass(frozen=True, kw_only=True)
class AdmittanceController:
    """x^d = A(1 + C_ff) N (F^d + F + P̂ O_a x) − C_fb x.

    A = 1/(M_a s² + B_a s), C_ff = K_l s, C_fb = B_fb ω_v s/(s + ω_v), O_a = ω_v ω_a s²/((s + ω_a)(s + ω_v)), and the
    biquad N = (1 + 2 ζ_z τ_z s + τ_z² s²)/(1 + 2 ζ_p τ_p s + τ_p² s²), which is 1 in the paper's law.

    `mass_kg` M_a, `damping_n_s_per_m` B_a, `lead_s` K_l, `feedback_damping_s` B_fb (seconds),
    `velocity_filter_rad_per_s` ω_v, `acceleration_filter_rad_per_s` ω_a, `compensation_mass_kg` P̂. With the
    compensation "ideal", O_a = s². `discretization` is the form that runs in the cell. `biquad_zero_s` τ_z,
    `biquad_zero_damping_ratio` ζ_z, `biquad_pole_s` τ_p and `biquad_pole_damping_ratio` ζ_p are the time constants 1/ω
    and damping ratios of the biquad; there is none where τ_p = 0.

    Raises ParameterError for values out of range, among them a B_fb in the paper's printed unit, and for a biquad with
    a zero alone, beside the ideal compensation, or in the form forward_euler.
    """

    mass_kg: float
    damping_n_s_per_m: float
    lead_s: float = 0.0
    feedback_damping_s: float = 0.0
    velocity_filter_rad_per_s: float = PAPER_VELOCITY_FILTER_RAD_PER_S
    acceleration_filter_rad_per_s: float = PAPER_ACCELERATION_FILTER_RAD_PER_S
    compensation_mass_kg: float = 0.0
    compensation: Compensation = "filtered"
    discretization: Discretization = "tustin"
    biquad_zero_s: float = 0.0
    biquad_zero_damping_ratio: float = 1.0
    biquad_pole_s: float = 0.0
    biquad_pole_damping_ratio: float = 1.0

    def __post_init__(self) -> None:
        for name in ("mass_kg", "damping_n_s_per_m", "velocity_filter_rad_per_s", "acceleration_filter_rad_per_s"):
            object.__setattr__(self, name, positive(name, getattr(self, name)))
        for name in ("lead_s", "compensation_mass_kg"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name)))
        object.__setattr__(self, "feedback_damping_s", check_feedback_damping(self.feedback_damping_s))
        for name, known in (("compensation", ("filtered", "ideal")), ("discretization", tuple(THETA))):
            if getattr(self, name) not in known:
                raise ParameterError(name, getattr(self, name), f"one of {', '.join(known)}")
        if self.compensates and self.compensation == "ideal" and self.theta == 0.0:
            raise ParameterError(
                "discretization", self.discretization, "tustin or backward_euler (a derivative ahead of time is none)"
            )
        self._check_biquad()

    def _check_biquad(self) -> None:
        for name in ("biquad_zero_s", "biquad_zero_damping_ratio", "biquad_pole_s"):
            object.__setattr__(self, name, non_negative(name, getattr(self, name)))
        damping = positive("biquad_pole_damping_ratio", self.biquad_pole_damping_ratio)
        object.__setattr__(self, "biquad_pole_damping_ratio", damping)
        if not self.has_biquad:
            if self.biquad_zero_s > 0.0:
                raise ParameterError("biquad_pole_s", 0.0, "above 0 where the biquad has a zero")
            return
        if self.is_ideal:
            raise ParameterError("compensation", self.compensation, "filtered beside a biquad")
        if self.theta == 0.0:
            raise ParameterError("discretization", self.discretization, "tustin or backward_euler with a biquad")

    @property
    def compensates(self) -> bool:
        """Whether the payload's acceleration is compensated."""
        return self.compensation_mass_kg > 0.0

    @property
    def has_biquad(self) -> bool:
        """Whether the force passes a biquad."""
        return self.biquad_pole_s > 0.0

    @property
    def theta(self) -> float:
        """θ of the rule s ≈ (z − 1)/(h (θ z + 1 − θ))."""
        return THETA[self.discretization]

    @property
    def is_ideal(self) -> bool:
        """Whether the compensation takes the acceleration without filters."""
        return self.compensates and self.compensation == "ideal"

    def parameters(self) -> FloatArray:
        """Return (M_a, B_a, K_l, B_fb, ω_v, ω_a, P̂), then (τ_z, ζ_z, τ_p, ζ_p) of a biquad, as the equations take."""
        return np.array(self.numbers())

    def numbers(self) -> tuple[float, ...]:
        """Return the same as a tuple, from which the parameters of many controllers make one array faster."""
        return (*_NUMBERS(self), *_BIQUAD(self)) if self.has_biquad else _NUMBERS(self)


def check_feedback_damping(feedback_damping_s: float) -> float:
    """Return B_fb [s], refusing values that can only be the paper's printed unit (docs/method.md, erratum 2)."""
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
    """Convert a B_fb as printed to seconds, reading it as s·m/mm: times 1000 (docs/method.md, erratum 2)."""
    return check_feedback_damping(1000.0 * _printed(printed))


def feedback_damping_from_paper_per_sample(printed: float, sample_time_s: float) -> float:
    """Convert a B_fb as printed to seconds, reading it as s times h: times 1/h (docs/method.md, erratum 2)."""
    return check_feedback_damping(_printed(printed) / positive("sample_time_s", sample_time_s))


def _printed(feedback_damping: float) -> float:
    """Return a B_fb in the paper's unit, refusing values that are seconds already: it prints 7.5e-6 and 2e-5."""
    if non_negative("printed", feedback_damping) >= SMALLEST_FEEDBACK_DAMPING_S:
        raise ParameterError(
            "printed", feedback_damping, f"below {SMALLEST_FEEDBACK_DAMPING_S:g}, as the paper prints it (not seconds)"
        )
    return feedback_damping


# Written once in plain arithmetic, and compiled into whatever kernel calls them.
write_first_order = equation(difference.write_first_order)
forward_in_s = equation(difference.forward_in_s)
biquad_in_s = equation(difference.biquad_in_s)
write_biquad = equation(difference.write_biquad)
write_blocks = equation(difference.write_blocks)
controller_step = equation(difference.controller_step)
steady_states = equation(difference.steady_states)


def controller_blocks(controller: AdmittanceController, sample_time_s: float) -> FloatArray:
    """Return the blocks (BLOCK_ROWS, 3) of a controller at h, see `write_blocks`."""
    h = positive("sample_time_s", sample_time_s)
    return blocks_of(controller.parameters(), h, controller.theta, controller.is_ideal)


@compiled
def control_tuple(control: FloatArray) -> ControlState:
    """Return the states (CONTROLLER_STATES,) as `controller_step` takes them."""
    return control[0], control[1], control[2], control[3], control[4], control[5]


@compiled
def keep_control(control: FloatArray, state: ControlState) -> None:
    """Write the states into an array (CONTROLLER_STATES,)."""
    control[0], control[1], control[2], control[3], control[4], control[5] = state


@compiled
def blocks_of(parameters: FloatArray, h: float, theta: float, ideal: bool) -> FloatArray:
    """Return the blocks (BLOCK_ROWS, 3) of a parameter vector, see `write_blocks`."""
    blocks = np.zeros((BLOCK_ROWS, 3))
    write_blocks(blocks, parameters, h, theta, ideal)
    return blocks


def needed_states(blocks: FloatArray) -> NDArray[np.int64]:
    """Return which of the states the command can see; the others would only add poles that nobody excites."""
    filtered = blocks[COMPENSATION] != 0.0
    kept = [0]
    if blocks[LAG_GAIN] != 0.0 or blocks[POSITION_TO_LAG] != 0.0:
        kept.append(1)
    if blocks[FEEDBACK_DAMPING] != 0.0 or filtered:
        kept.append(2)
    if filtered or blocks[DERIVATIVE_GAIN] != 0.0:
        kept.append(3)
    if blocks[BIQUAD_1] != 0.0 or blocks[BIQUAD_2] != 0.0 or blocks[BIQUAD_POLE_1] != 0.0:
        kept.append(4)
        kept.append(5)
    return np.array(kept, dtype=np.int64)
