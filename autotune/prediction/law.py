"""The admittance law of a controller file or of gains that a person says."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from autotune.errors import UsageError
from autotune.formats.canonical import short
from autotune.formats.controller import ControllerFile
from autotune.formats.controller_record import Controller, admittance_controller, file_deadband
from autotune.formats.units import AXES, axis_units
from identification.result import Identified
from problems.contact.nonlinearities import Deadband, DeadbandType
from problems.errors import ParameterError, shown
from problems.model.controller import AdmittanceController

from .contact import Law

if TYPE_CHECKING:
    from autotune.formats.cell import CellFile

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
    try:
        controller = AdmittanceController(**numbers)  # type: ignore[arg-type]
        deadband = Deadband(width_n=width, kind=DeadbandType(kind))
    except ParameterError as error:
        named = {field: name for name, field in GAINS.items()} | {"width_n": "deadband"}
        raise ParameterError(f"The gain {named.get(error.name, error.name)}", error.value, error.must) from error
    return Law(controller=controller, deadband=deadband)


_ACTS = {
    DeadbandType.THRESHOLD: "threshold: a force beyond it acts whole",
    DeadbandType.SUBTRACTIVE: "subtractive: only what exceeds it acts",
}


def deadband_text(deadband: Deadband, axis: str) -> str:
    """Return a deadband in words, as `deadband of 5 N (threshold: a force beyond it acts whole)`."""
    return f"deadband of {deadband.width_n:g} {axis_units(axis).force} ({_ACTS[deadband.kind]})"


def law_notes(law: Law, axis: str, controller: Controller | None = None) -> Iterator[str]:
    """Yield what a prediction simulates: gains and deadband; and what of a controller file it leaves out."""
    units, of = axis_units(axis), law.controller
    text = f"simulated with M_a {of.mass_kg:.6g} {units.mass}, B_a {of.damping_n_s_per_m:.6g} {units.damping}"
    text += f", K_l {1e3 * of.lead_s:.6g} ms, B_fb {1e3 * of.feedback_damping_s:.6g} ms"
    text += ", a biquad in the path of the force" if of.has_biquad else ""
    if controller is None:
        said = f"a {deadband_text(law.deadband, axis)}, as the gains say"
        none = "no deadband, as the gains name none (they may: deadband=5,deadband_type=threshold)"
        yield f"{text} and {said if law.deadband.width_n else none}"
        return
    own = file_deadband(controller.axes[axis])
    if not own.width_n:
        yield f"{text} and no deadband, as the controller file has none"
    elif law.deadband == own:
        yield f"{text} and the {deadband_text(own, axis)} of the controller file"
    else:
        yield f"{text} and without the {deadband_text(own, axis)} of the controller file, as its certified peaks are"
    left_out = []
    if controller.collision.threshold_n is not None:
        left_out.append(f"the {controller.collision.response} on a collision of {controller.collision.threshold_n:g} N")
    if axis in (controller.variable_damping or {}):
        left_out.append("variable damping")
    if left_out:
        yield f"not simulated: {' and '.join(left_out)} of the controller file (`autotune validate` does)"


def _number(name: str, value: float | str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise UsageError(f"The gain {name} must be a number in SI, found {shown(value)}.")
    return float(value)


@dataclass(frozen=True, kw_only=True)
class PresentGains:
    """What runs in a cell today, or ran in its log: `laws` by axis; `label` says in words where they are from.

    `file` is the controller file that they were read from, None for gains that a person or a log says.
    """

    laws: Mapping[str, Law]
    label: str
    file: ControllerFile | None = None

    @property
    def name(self) -> str:
        """What they are called in a table: the name of the file, or where they are from."""
        return self.label if self.file is None else self.file.path.name

    def tree(self) -> dict[str, Any]:
        """Return where they are from, as a provenance keeps it: path and checksum of a file, else the numbers."""
        if self.file is not None:
            return {"path": str(self.file.path), "checksum": self.file.checksum}
        gains = {
            name: {key: getattr(law.controller, field) for key, field in GAINS.items()}
            for name, law in self.laws.items()
        }
        return {"from": self.label, "gains": gains}

    @classmethod
    def of_file(cls, file: ControllerFile) -> "PresentGains":
        """Return those of a controller file; raises UsageError for one that was designed for an export target."""
        target = file.controller.provenance.get("as_run_by", {}).get("target")
        if target:
            raise UsageError(
                f"{file.path} was designed for {target}, which runs another law than the gains of the file; compare "
                "with gains that ran as M_a and B_a, as in mass=10,damping=1500."
            )
        laws = {name: law_of(file.controller, name) for name in file.controller.axes}
        return cls(laws=laws, label=f"{file.path}, checksum {short(file.checksum)}", file=file)

    @classmethod
    def of_cell(cls, cell: "CellFile", axes: Sequence[str]) -> "PresentGains":
        """Return the constant gains of a `cell.yaml` on some axes; raises UsageError where it holds none."""
        gains = cell.cell.gains
        if gains is None or gains.mass is None or gains.damping is None:
            raise UsageError(f"{cell.path} says no gains in numbers; add gains with mass and damping, or say them.")
        laws = {}
        for name in axes:
            place = AXES.index(name)
            lead = 0.0 if gains.lead is None else gains.lead[place]
            said = {"mass": gains.mass[place], "damping": gains.damping[place], "lead": lead}
            laws[name] = law_of_gains(said)
        return cls(laws=laws, label=f"the gains in {cell.path}")

    @classmethod
    def of_log(cls, result: Identified, axes: Sequence[str]) -> "PresentGains":
        """Return those with which the contacts of a log were recorded, on the axes that have one set of them.

        Raises UsageError where no axis has: the log does not say gains, or several.
        """
        laws, several = {}, []
        for name in axes:
            touches = (touch for line in result.timelines for touch in line.touches if touch.axis == name)
            found = {(touch.mass, touch.damping, touch.lead_s or 0.0) for touch in touches}
            if len(found) > 1:
                several.append(name)
            for mass, damping, lead in found if len(found) == 1 else ():
                if mass is not None and damping is not None:
                    laws[name] = law_of_gains({"mass": mass, "damping": damping, "lead": lead})
        if laws:
            return cls(laws=laws, label="the gains in the log")
        why = f"several gains on axis {', '.join(several)}" if several else "no gains"
        raise UsageError(
            f"The contacts of the log hold {why}, so there are none to compare with; say those that run now, as in "
            "--compare mass=10,damping=1500."
        )
