"""Result of an experiment design: what to record, and what each uncertainty changes in the peak contact force."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from problems.contact.transient import Approach, build_sampled_contact, simulate_contact
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.robot import RobotModel
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError

from .contacts import ContactPlan, TapPlan, plant_of, stable_controller
from .poses import FEWEST_POSES, PosePlan
from .sweep import SweepLimits, SweepPlan
from .values import PlanValues

_APPROACH_FORCE_N = 30.0
_STEP = 0.01
_SMALLEST_DAMPING_RATIO = 0.05
_SHORTEST_DELAY_S = 1e-4
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


@dataclass(frozen=True, kw_only=True)
class PeakEffect:
    """The peak force of a reference contact and |d peak/d parameter| [N per SI unit], keyed as `PlanValues`.

    The contact is that of the exact sampled loop with `controller`, after a force-driven approach with
    `approach_force_n`; the peak is the larger one of sensor and surface. What does not act along a straight axis, the
    centre of mass, has no entry.
    """

    peak_force_n: float
    controller: AdmittanceController
    approach_force_n: float
    gradients: Mapping[str, float]

    def moves_n(self, name: str, std: float | None) -> float | None:
        """Return by how much a deviation moves the peak [N], None where one of both is not known."""
        gradient = self.gradients.get(name)
        return None if gradient is None or std is None else gradient * std


def peak_effect(values: PlanValues, controller: AdmittanceController | None = None) -> PeakEffect | None:
    """Differentiate the peak of a contact by every parameter, with `controller` or a usual one that is stable there.

    Central differences over 1 % of a value (of a twentieth of the critical damping at least, for a damping). None where
    the loop is not stable on the surface with any usual controller, or with the one that is given.
    """
    law = controller if controller is not None else stable_controller(values)
    if law is None:
        return None
    gradients = {}
    try:
        peak = _peak_n(values, law)
        for name, step in _steps(values).items():
            known = values.known()[name].value
            low = max(known - step, 0.0)
            high = known + step
            gradients[name] = abs(
                _peak_n(_moved(values, name, high), law) - _peak_n(_moved(values, name, low), law)
            ) / (high - low)
    except (UnstableLoopError, ParameterError):
        return None
    gradients["motion_mass_kg"] = gradients["mass_kg"]
    return PeakEffect(peak_force_n=peak, controller=law, approach_force_n=_APPROACH_FORCE_N, gradients=gradients)


def _steps(values: PlanValues) -> dict[str, float]:
    contact = 2.0 * float(np.sqrt(values.environment_stiffness_n_per_m.value * values.mass_kg.value))
    floors = {
        "mass_kg": 0.0,
        "stiffness_n_per_m": 0.0,
        "damping_n_s_per_m": _SMALLEST_DAMPING_RATIO * values.critical_damping_n_s_per_m,
        "drag_n_s_per_m": _SMALLEST_DAMPING_RATIO * values.critical_damping_n_s_per_m,
        "bandwidth_hz": 0.0,
        "delay_s": _SHORTEST_DELAY_S,
        "environment_stiffness_n_per_m": 0.0,
        "environment_damping_n_s_per_m": _SMALLEST_DAMPING_RATIO * contact,
    }
    return {name: _STEP * max(values.known()[name].value, floor) for name, floor in floors.items()}


def _moved(values: PlanValues, name: str, value: float) -> PlanValues:
    changed = {name: replace(values.known()[name], value=value)}
    robot = values.robot
    if name == "bandwidth_hz":
        robot = _scaled(robot, value / values.bandwidth_hz.value)
    elif name == "delay_s":
        robot = replace(robot, delay_s=value)
    return replace(values, robot=robot, **changed)  # type: ignore[arg-type]  # every field but the robot is of this kind


def _scaled(robot: RobotModel, factor: float) -> RobotModel:
    """Return r(s/factor)."""
    numerator, denominator = (
        np.asarray(poly) / factor ** np.arange(len(poly) - 1, -1, -1.0) for poly in (robot.numerator, robot.denominator)
    )
    return RobotModel(numerator=numerator, denominator=denominator, delay_s=robot.delay_s)


def _peak_n(values: PlanValues, controller: AdmittanceController) -> float:
    pair = build_sampled_contact(build_sampled_plant(plant_of(values), values.sample_time_s.value))
    run = simulate_contact(pair, controller, Approach(force_n=_APPROACH_FORCE_N))
    return max(run.peak_sensor_force_n, run.peak_contact_force_n)


class StepKind(StrEnum):
    """A phase of a recording."""

    POSES = "poses"
    SWEEP = "sweep"
    TAPS = "taps"
    CONTACTS = "contacts"


@dataclass(frozen=True, kw_only=True)
class ExperimentLimits:
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
    """One parameter (named as in `PlanValues`): std now and after the whole plan, None where nothing shows it.

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
    """One phase to record; `settings` is None where the limits leave none, `is_needed` shows whether anything asks."""

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
    limits: ExperimentLimits
