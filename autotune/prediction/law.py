"""The admittance law of a controller file or of gains that a person says."""

from collections.abc import Mapping

from autotune.errors import UsageError
from autotune.formats.controller_record import Controller, admittance_controller, file_deadband
from problems.contact.nonlinearities import Deadband, DeadbandType
from problems.model.controller import AdmittanceController

from .contact import Law

GAINS: Mapping[str, str] = {
    "mass": "mass_kg",
    "damping": "damping_n_s_per_m",
    "lead": "lead_s",
    "feedback_damping": "feedback_damping_s",
}
_DEADBAND = ("deadband", "deadband_type")


def law_of(controller: Controller, axis: str) -> Law:
    """Return law and deadband of an axis of a controller file; raises UsageError for an axis that it does not hold."""
    gains = controller.axes.get(axis)
    if gains is None:
        raise UsageError(f"The controller holds the axes {', '.join(controller.axes)}, not {axis}.")
    return Law(controller=admittance_controller(controller, axis), deadband=file_deadband(gains))


def law_of_gains(gains: Mapping[str, float | str]) -> Law:
    """Return the law of gains by name: mass, damping, lead, feedback_damping [SI], deadband and deadband_type.

    Raises UsageError for other names, and where mass or damping is missing.
    """
    known = (*GAINS, *_DEADBAND)
    unknown = [name for name in gains if name not in known]
    if unknown:
        raise UsageError(f"Gains are {', '.join(known)}; found {unknown[0]}.")
    lacking = [name for name in ("mass", "damping") if name not in gains]
    if lacking:
        raise UsageError(f"Gains need mass and damping, found no {lacking[0]}.")
    numbers = {field: _number(name, gains[name]) for name, field in GAINS.items() if name in gains}
    width = _number("deadband", gains.get("deadband", 0.0))
    kind = str(gains.get("deadband_type", DeadbandType.SUBTRACTIVE))
    return Law(controller=AdmittanceController(**numbers), deadband=Deadband(width_n=width, kind=DeadbandType(kind)))  # type: ignore[arg-type]


def _number(name: str, value: float | str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"The gain {name} must be a number in SI, found {value!r}.")
    return float(value)
