"""`plan.yaml`: what to record next."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from identification.experiment_design.contacts import ContactPlan, TapPlan
from identification.experiment_design.poses import FEWEST_POSES, PosePlan
from identification.experiment_design.result import LABELS, ExperimentPlan, PeakEffect, Step, StepKind
from identification.experiment_design.sweep import Repeat, SweepPlan
from problems.frozen import AboveZero, NotNegative, Rule, Text
from problems.model.robot import RobotModel

from .atomic import write_atomic
from .canonical import dump_yaml, plain
from .records import record_tree
from .schema import VERSION, check_tree

FORMAT = "autotune/plan"

_COMMAND_POINTS = 7

Parameter = Annotated[str, Rule(enum=tuple(LABELS))]
Deviation = Annotated[float | None, Rule(minimum=0)]
UnitPart = Annotated[float, Rule(minimum=-1, maximum=1)]


@dataclass(frozen=True, kw_only=True)
class ReferenceContact:
    """The contact whose peak the deviations move."""

    peak_force_n: AboveZero
    approach_force_n: AboveZero
    mass_kg: AboveZero
    damping_n_s_per_m: AboveZero


@dataclass(frozen=True, kw_only=True)
class PredictedParameter:
    """A `Prediction` as the file names it."""

    parameter: Parameter
    value: NotNegative
    allowed_std: AboveZero
    std_now: Deviation
    std_after: Deviation
    peak_now_n: Deviation
    peak_after_n: Deviation


@dataclass(frozen=True, kw_only=True)
class PoseEntry:
    """One orientation of a `PosePlan`."""

    tilt_deg: Annotated[float, Rule(minimum=0, maximum=180)]
    azimuth_deg: Annotated[float, Rule(minimum=0, exclusiveMaximum=360)]
    quaternion_xyzw: tuple[UnitPart, UnitPart, UnitPart, UnitPart]


@dataclass(frozen=True, kw_only=True)
class PosesSettings:
    """Settings of the poses; the deviations are those of as many poses in equal steps."""

    hold_s: AboveZero
    poses: Annotated[tuple[PoseEntry, ...], Rule(minItems=FEWEST_POSES)]
    naive_mass_std_kg: Deviation
    naive_com_std_m: Deviation


@dataclass(frozen=True, kw_only=True)
class CommandPoint:
    """The command of a sweep at one frequency."""

    frequency_hz: AboveZero
    amplitude_m: AboveZero
    speed_m_s: AboveZero


@dataclass(frozen=True, kw_only=True)
class WorstForce:
    """The plausible cell on which a sweep makes the most force, and that."""

    peak_force_n: AboveZero
    frequency_hz: AboveZero
    stiffness_n_per_m: AboveZero
    mass_kg: AboveZero
    damping_ratio: NotNegative
    bandwidth_hz: AboveZero


@dataclass(frozen=True, kw_only=True)
class SweepSettings:
    """Settings of the sweep, as in `SweepPlan`."""

    low_hz: AboveZero
    high_hz: AboveZero
    duration_s: AboveZero
    flange_speed_m_s: AboveZero
    command: Annotated[tuple[CommandPoint, ...], Rule(minItems=2)]
    fade_s: AboveZero
    peak_force_n: AboveZero
    worst_case: WorstForce
    abort_force_n: AboveZero
    repeat: Repeat | None
    bound_by: Annotated[str, Rule(enum=("max-speed", "max-force", "max-stroke"))]
    robot_limit_hz: AboveZero


@dataclass(frozen=True, kw_only=True)
class StepEntry:
    """One phase to record; `settings` is null where the limits leave none."""

    record: str
    needed: bool
    why: Text
    settings: object
    predicted: Annotated[tuple[PredictedParameter, ...], Rule(minItems=1)]


@dataclass(frozen=True, kw_only=True)
class PosesStep(StepEntry):
    """Poses at rest."""

    record: Literal["poses"]
    settings: PosesSettings | None


@dataclass(frozen=True, kw_only=True)
class SweepStep(StepEntry):
    """A sweep."""

    record: Literal["sweep"]
    settings: SweepSettings


@dataclass(frozen=True, kw_only=True)
class TapsStep(StepEntry):
    """Taps."""

    record: Literal["taps"]
    settings: TapPlan


@dataclass(frozen=True, kw_only=True)
class ContactsStep(StepEntry):
    """Contacts."""

    record: Literal["contacts"]
    settings: ContactPlan | None


@dataclass(frozen=True, kw_only=True)
class LimitsEntry:
    """`ExperimentLimits` with every number written out."""

    max_tilt_deg: AboveZero
    pose_count: Annotated[int, Rule(minimum=0)]
    max_speed_m_s: AboveZero
    max_force_n: AboveZero
    max_stroke_m: AboveZero
    max_duration_s: AboveZero
    max_frequency_hz: AboveZero | None = None


@dataclass(frozen=True, kw_only=True)
class PlanTable:
    """The entries of `plan.yaml`, but for where it comes from."""

    axis: Annotated[str, Rule(enum=("x", "y", "z"))]
    binding: Parameter
    reference: Annotated[ReferenceContact | None, Rule(description="the contact whose peak the deviations move")]
    steps: Annotated[tuple[PosesStep | SweepStep | TapsStep | ContactsStep, ...], Rule(minItems=1)]
    limits: LimitsEntry
    assumed: Mapping[str, NotNegative]


_STEPS = {
    StepKind.POSES: PosesStep,
    StepKind.SWEEP: SweepStep,
    StepKind.TAPS: TapsStep,
    StepKind.CONTACTS: ContactsStep,
}


def plan_tree(plan: ExperimentPlan, provenance: Mapping[str, object]) -> dict[str, Any]:
    """Return the plain tree of `plan.yaml`; deviations are null where nothing determines the parameter.

    Raises ParameterError when a number is not finite.
    """
    table = PlanTable(
        axis=plan.axis,
        binding=plan.binding,
        reference=None if plan.effect is None else _reference(plan.effect),
        steps=tuple(_step(step, plan.values.robot) for step in plan.steps),
        limits=LimitsEntry(**vars(plan.limits)),
        assumed=plan.values.assumed,
    )
    provenance = plain(provenance, "provenance")
    tree = {"format": FORMAT, "version": VERSION, **record_tree(table), "provenance": provenance}
    check_tree(tree, "plan")
    return tree


def write_plan(path: Path | str, plan: ExperimentPlan, provenance: Mapping[str, object]) -> None:
    """Write `plan.yaml` in one step; raises as `plan_tree` and `write_atomic` do."""
    write_atomic(path, dump_yaml(plan_tree(plan, provenance)))


def _reference(effect: PeakEffect) -> ReferenceContact:
    law = effect.controller
    return ReferenceContact(
        peak_force_n=effect.peak_force_n,
        approach_force_n=effect.approach_force_n,
        mass_kg=law.mass_kg,
        damping_n_s_per_m=law.damping_n_s_per_m,
    )


def _step(step: Step, robot: RobotModel) -> Any:
    settings: object = step.settings
    if isinstance(settings, PosePlan):
        settings = _poses(settings)
    elif isinstance(settings, SweepPlan):
        settings = _sweep(settings, robot)
    named = ({"parameter" if key == "name" else key: each for key, each in vars(p).items()} for p in step.predictions)
    predicted = tuple(PredictedParameter(**each) for each in named)
    of: Any = _STEPS[step.kind]
    return of(record=step.kind.value, needed=step.is_needed, why=step.why, settings=settings, predicted=predicted)


def _poses(plan: PosePlan) -> PosesSettings:
    turns = zip(plan.tilt_deg.tolist(), plan.azimuth_deg.tolist(), plan.quaternion_xyzw.tolist(), strict=True)
    return PosesSettings(
        hold_s=plan.hold_s,
        poses=tuple(
            PoseEntry(tilt_deg=round(tilt, 3), azimuth_deg=round(azimuth, 3), quaternion_xyzw=quaternion)
            for tilt, azimuth, quaternion in turns
        ),
        naive_mass_std_kg=plan.naive_mass_std_kg if np.isfinite(plan.naive_mass_std_kg) else None,
        naive_com_std_m=plan.naive_com_std_m if np.isfinite(plan.naive_com_std_m) else None,
    )


def _sweep(plan: SweepPlan, robot: RobotModel) -> SweepSettings:
    frequency, speed = plan.sweep.frequency_hz(), plan.sweep.command_speed_m_s(robot)
    points = np.linspace(0, len(frequency) - 1, _COMMAND_POINTS).astype(int)
    worst = {name: value for name, value in vars(plan.worst).items() if name != "force_per_speed_n_s_per_m"}
    return SweepSettings(
        **vars(plan.sweep),
        command=tuple(
            CommandPoint(frequency_hz=f, amplitude_m=v / (2.0 * np.pi * f), speed_m_s=v)
            for f, v in zip(frequency[points].tolist(), speed[points].tolist(), strict=True)
        ),
        fade_s=plan.fade_s,
        peak_force_n=plan.peak_force_n,
        worst_case=WorstForce(peak_force_n=plan.worst_peak_force_n, **worst),
        abort_force_n=plan.abort_force_n,
        repeat=plan.repeat,
        bound_by=plan.bound_by,
        robot_limit_hz=plan.robot_limit_hz,
    )
