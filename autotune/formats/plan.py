"""`plan.yaml`: what to record next."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from identification.experiment_design.contacts import ContactPlan, TapPlan
from identification.experiment_design.poses import PosePlan
from identification.experiment_design.result import ExperimentPlan, PeakEffect, Prediction, Step
from identification.experiment_design.sweep import SweepPlan
from problems.model.robot import RobotModel

from .atomic import write_atomic
from .canonical import dump_yaml, plain
from .records import record_tree
from .schema import VERSION, check_tree

FORMAT = "autotune/plan"

_COMMAND_POINTS = 7


def plan_tree(plan: ExperimentPlan, provenance: Mapping[str, object]) -> dict[str, Any]:
    """Return the plain tree of `plan.yaml`; deviations are null where nothing determines the parameter.

    Raises ParameterError when a number is not finite.
    """
    tree = {
        "format": FORMAT,
        "version": VERSION,
        "axis": plan.axis,
        "binding": plan.binding,
        "reference": None if plan.effect is None else _reference(plan.effect),
        "steps": [_step(step, plan.values.robot) for step in plan.steps],
        "limits": {name: value for name, value in vars(plan.limits).items() if value is not None},
        "assumed": plain(plan.values.assumed, "assumed"),
        "provenance": plain(provenance, "provenance"),
    }

    check_tree(tree, "plan")
    return tree


def write_plan(path: Path | str, plan: ExperimentPlan, provenance: Mapping[str, object]) -> None:
    """Write `plan.yaml` in one step; raises as `plan_tree` and `write_atomic` do."""
    write_atomic(path, dump_yaml(plan_tree(plan, provenance)))


def _reference(effect: PeakEffect) -> dict[str, float]:
    return {
        "peak_force_n": effect.peak_force_n,
        "approach_force_n": effect.approach_force_n,
        "mass_kg": effect.controller.mass_kg,
        "damping_n_s_per_m": effect.controller.damping_n_s_per_m,
    }


def _step(step: Step, robot: RobotModel) -> dict[str, Any]:
    return {
        "record": step.kind.value,
        "needed": step.is_needed,
        "why": step.why,
        "settings": _settings(step, robot),
        "predicted": [_prediction(entry) for entry in step.predictions],
    }


def _prediction(entry: Prediction) -> dict[str, Any]:
    return {
        "parameter": entry.name,
        "value": entry.value,
        "allowed_std": entry.allowed_std,
        "std_now": entry.std_now,
        "std_after": entry.std_after,
        "peak_now_n": entry.peak_now_n,
        "peak_after_n": entry.peak_after_n,
    }


def _settings(step: Step, robot: RobotModel) -> dict[str, Any] | None:
    settings = step.settings
    if isinstance(settings, PosePlan):
        return _poses(settings)
    if isinstance(settings, SweepPlan):
        return _sweep(settings, robot)
    if isinstance(settings, TapPlan | ContactPlan):
        tree = record_tree(settings)
        tree.pop("std")
        return dict(tree)
    return None


def _poses(plan: PosePlan) -> dict[str, Any]:
    turns = zip(plan.tilt_deg, plan.azimuth_deg, plan.quaternion_xyzw, strict=True)
    return {
        "hold_s": plan.hold_s,
        "poses": [
            {
                "tilt_deg": round(float(tilt), 3),
                "azimuth_deg": round(float(azimuth), 3),
                "quaternion_xyzw": [float(part) for part in quaternion],
            }
            for tilt, azimuth, quaternion in turns
        ],
        "naive_mass_std_kg": plan.naive_mass_std_kg if np.isfinite(plan.naive_mass_std_kg) else None,
        "naive_com_std_m": plan.naive_com_std_m if np.isfinite(plan.naive_com_std_m) else None,
    }


def _sweep(plan: SweepPlan, robot: RobotModel) -> dict[str, Any]:
    sweep = plan.sweep
    frequency, speed = sweep.frequency_hz(), sweep.command_speed_m_s(robot)
    points = np.linspace(0, len(frequency) - 1, _COMMAND_POINTS).astype(int)
    return {
        "low_hz": sweep.low_hz,
        "high_hz": sweep.high_hz,
        "duration_s": sweep.duration_s,
        "flange_speed_m_s": sweep.flange_speed_m_s,
        "command": [
            {
                "frequency_hz": float(frequency[i]),
                "amplitude_m": float(speed[i] / (2.0 * np.pi * frequency[i])),
                "speed_m_s": float(speed[i]),
            }
            for i in points
        ],
        "fade_s": plan.fade_s,
        "peak_force_n": plan.peak_force_n,
        "worst_case": {
            "peak_force_n": plan.worst_peak_force_n,
            "frequency_hz": plan.worst.frequency_hz,
            "stiffness_n_per_m": plan.worst.stiffness_n_per_m,
            "mass_kg": plan.worst.mass_kg,
            "damping_ratio": plan.worst.damping_ratio,
            "bandwidth_hz": plan.worst.bandwidth_hz,
        },
        "abort_force_n": plan.abort_force_n,
        "repeat": None if plan.repeat is None else record_tree(plan.repeat),
        "bound_by": plan.bound_by,
        "robot_limit_hz": plan.robot_limit_hz,
    }
