"""Discrete choices of a controller beside its four numbers: how it is discretised, and which parts it has."""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from autotune.errors import UsageError
from problems.design.problem import DesignProblem
from problems.model.controller import AdmittanceController, Discretization

FloatArray = NDArray[np.float64]

STRUCTURES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "discretization": ("tustin", "backward_euler", "forward_euler"),
        "compensation": ("off", "filtered"),
        "lead": ("on", "off"),
        "feedback": ("on", "off"),
    }
)
"""What may be left to a study, the form that `optimize` writes first: it is taken for everything that is not."""

_FORMS: Mapping[str, Discretization] = {
    "tustin": "tustin",
    "backward_euler": "backward_euler",
    "forward_euler": "forward_euler",
}


def check_choices(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names; raises UsageError for one that is not in `STRUCTURES` or stands twice."""
    unknown = [name for name in names if name not in STRUCTURES]
    if unknown:
        raise UsageError(f"{unknown[0]!r} cannot be left to a study; there are: {', '.join(STRUCTURES)}.")
    if len(set(names)) != len(names):
        raise UsageError(f"Each choice may be named once; found {', '.join(names)}.")
    return names


def design_of(problem: DesignProblem, controller: AdmittanceController) -> FloatArray:
    """Return the values of `problem.variables` (n,) that `problem.controller` makes this controller of."""
    values = {
        "mass": controller.mass_kg,
        "damping": controller.damping_n_s_per_m,
        "lead_s": controller.lead_s,
        "feedback_damping_s": controller.feedback_damping_s,
        "velocity_filter_rad_per_s": controller.velocity_filter_rad_per_s,
        "acceleration_filter_rad_per_s": controller.acceleration_filter_rad_per_s,
        "compensation_mass_kg": controller.compensation_mass_kg,
    }
    return np.array([values[name] for name in problem.variables])


def build_controller(problem: DesignProblem, design: FloatArray, chosen: Mapping[str, str]) -> AdmittanceController:
    """Return the controller of a design, the values of `problem.variables`, in the chosen structure.

    `chosen` maps names of `STRUCTURES` to one of their values. With the compensation, P̂ is the middle of the payload's
    range unless it is a variable; a part that is off has the gain 0, whatever the design says.
    """
    low, high = problem.payload_mass_kg
    base = problem.controller(design)
    compensation = base.compensation_mass_kg
    if "compensation" in chosen:
        compensation = (compensation or 0.5 * (low + high)) if chosen["compensation"] == "filtered" else 0.0
    return replace(
        base,
        discretization=_FORMS[chosen.get("discretization", "tustin")],
        compensation_mass_kg=compensation,
        lead_s=0.0 if chosen.get("lead") == "off" else base.lead_s,
        feedback_damping_s=0.0 if chosen.get("feedback") == "off" else base.feedback_damping_s,
    )
