"""What an experiment plan hands on: phases, why, and what each parameter would gain."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from problems.errors import ParameterError

from .contacts import ContactPlan
from .effect import PeakEffect
from .poses import FEWEST_POSES, PosePlan
from .sweep import SweepLimits, SweepPlan
from .taps import TapPlan
from .values import PlanValues

LABELS = {
    "mass_kg": "payload mass",
    "com_m": "centre of mass",
    "stiffness_n_per_m": "coupling K_s",
    "damping_n_s_per_m": "coupling B_s",
    "drag_n_s_per_m": "drag B_p",
    "motion_mass_kg": "M_p from motion",
    "bandwidth_hz": "robot bandwidth",
    "delay_s": "delay T_d",
    "environment_stiffness_n_per_m": "environment K_e",
    "environment_damping_n_s_per_m": "environment B_e",
}
"""What people call the parameters of a plan."""
UNITS = {
    "mass_kg": ("kg", 1.0),
    "com_m": ("mm", 1e3),
    "stiffness_n_per_m": ("N/mm", 1e-3),
    "damping_n_s_per_m": ("N·s/m", 1.0),
    "drag_n_s_per_m": ("N·s/m", 1.0),
    "motion_mass_kg": ("kg", 1.0),
    "bandwidth_hz": ("Hz", 1.0),
    "delay_s": ("ms", 1e3),
    "environment_stiffness_n_per_m": ("N/mm", 1e-3),
    "environment_damping_n_s_per_m": ("N·s/m", 1.0),
}
"""Their units on the screen, and how many of them an SI unit is."""


class StepKind(StrEnum):
    """A phase of a recording."""

    POSES = "poses"
    SWEEP = "sweep"
    TAPS = "taps"
    CONTACTS = "contacts"


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What the cell allows; `pose_count` 0 leaves the poses out. Raises ParameterError where that leaves nothing."""

    max_tilt_deg: float = 60.0
    pose_count: int = 9
    max_speed_m_s: float = SweepLimits.max_speed_m_s
    max_force_n: float = SweepLimits.max_force_n
    max_stroke_m: float = SweepLimits.max_stroke_m
    max_duration_s: float = SweepLimits.max_duration_s
    max_frequency_hz: float | None = None

    def __post_init__(self) -> None:
        if self.pose_count != 0 and self.pose_count < FEWEST_POSES:
            raise ParameterError("pose_count", self.pose_count, f"0 or at least {FEWEST_POSES}")
        if not 0.0 < self.max_tilt_deg <= 180.0:
            raise ParameterError("max_tilt_deg", self.max_tilt_deg, "above 0 and at most 180")
        for name in ("max_speed_m_s", "max_force_n", "max_stroke_m", "max_duration_s", "max_frequency_hz"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise ParameterError(name, value, "finite and above 0")


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """One parameter (named as in `PlanValues`): std now and after the whole plan, None where nothing tells it.

    `peak_now_n`, `peak_after_n` are by how much those deviations move the peak of the reference contact; None for what
    does not act on it, and where nothing is known.
    """

    name: str
    value: float
    allowed_std: float
    std_now: float | None
    std_after: float | None
    peak_now_n: float | None = None
    peak_after_n: float | None = None

    @property
    def urgency(self) -> float:
        """How many times what is allowed the deviation is now."""
        return np.inf if self.std_now is None else self.std_now / self.allowed_std


@dataclass(frozen=True, kw_only=True)
class Step:
    """One phase to record; `settings` is None where the limits leave none, `is_needed` tells whether anything asks."""

    kind: StepKind
    is_needed: bool
    why: str
    predictions: tuple[Prediction, ...]
    settings: PosePlan | SweepPlan | TapPlan | ContactPlan | None


@dataclass(frozen=True, kw_only=True)
class ExperimentPlan:
    """What to record, most urgent first; `binding` names the parameter whose deviation moves the peak most now.

    What is not known at all comes before that. `effect` is the reference contact, None where no usual controller is
    stable on the surface: there the largest std over allowed std binds.
    """

    axis: str
    binding: str
    effect: PeakEffect | None
    steps: tuple[Step, ...]
    values: PlanValues
    limits: Limits
