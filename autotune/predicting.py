"""From a plant, gains and a contact as a person says them to a prediction, alone or beside the contacts of a log."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from autotune.design import Design
from autotune.errors import UsageError
from autotune.formats.identified import IdentifiedFile
from autotune.formats.plant import NO_DELAY_GIVEN, Plant
from autotune.formats.quantity import Uncertain
from autotune.formats.stiffness_units import check_bumper_unit, check_surface_unit, doubtful_surface
from autotune.formats.units import ROTATIONAL_AXES
from autotune.prediction.against_touches import Running, TouchComparison, compare_touches, other_surface
from autotune.prediction.as_run_by import running_law
from autotune.prediction.certified import outside_domain
from autotune.prediction.contact import TargetLaw, check_approach, with_bumper
from autotune.prediction.law import law_notes, law_of_gains
from autotune.prediction.plants import Surface, build_plants, find_axis
from autotune.prediction.result import PredictedContact, predict_contact
from autotune.prediction.said_gains import parse_number, parse_pairs
from autotune.quantities import parse_quantity
from autotune.results import Identification
from identification.result import Identified
from problems.contact.transient import Approach
from problems.errors import ParameterError
from problems.model.plant import Bumper

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller

Gains = Mapping[str, float] | Mapping[str, float | str] | Design | str | Path | None
# As for a design: what is no contact experiment of a robot.
_MOST = {"payload_mass": 1e3, "sample_time": 0.1}


@dataclass(frozen=True, kw_only=True)
class ContactRequest:
    """What contact is asked for, None where the plant or the gains say it; units as of `autotune.predict`.

    With `has_unit` the unit of the stiffness was typed, so that it is meant, however soft.
    """

    surface: str = ""
    stiffness: float | Uncertain | None = None
    payload_mass: float | None = None
    speed: float | None = None
    force: float | None = None
    axis: str | None = None
    sample_time: float | None = None
    has_unit: bool = False
    bumper: Bumper | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.bumper, Bumper | None):
            raise ParameterError("bumper", self.bumper, "at.Bumper(mass_kg=…, stiffness_n_per_m=…)")
        if self.bumper is not None:
            check_bumper_unit(self.bumper.stiffness_n_per_m)
        for name, most in _MOST.items():
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and 0.0 < value <= most):
                raise ParameterError(name, value, f"a number greater than 0 and at most {most:g}")
        for name in ("speed", "force"):
            value = getattr(self, name)
            if value is not None and not (_is_number(value) and value > 0.0):
                raise ParameterError(f"approach_{name}", value, "a number greater than 0")
        if self.stiffness is not None and self.surface:
            raise UsageError("Say the name of a surface or a stiffness, not both.")

    def touched(self) -> Surface:
        """Return the surface that is meant."""
        if self.stiffness is None:
            return Surface(name=self.surface)
        value, std = (
            (self.stiffness.value, self.stiffness.std)
            if isinstance(self.stiffness, Uncertain)
            else (self.stiffness, 0.0)
        )
        if not (_is_number(value) and 0.0 < value < math.inf):
            raise ParameterError("environment_stiffness", value, "a number greater than 0")
        return Surface(stiffness=float(value), std=std)

    def approach(self) -> Approach | None:
        """Return how the contact begins, None where nothing is said of it."""
        if self.speed is None and self.force is None:
            return None
        found = (
            Approach(force_n=self.force)
            if self.speed is None
            else Approach(speed_m_s=self.speed, after_impact_n=self.force)
        )
        check_approach(found)
        return found


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def predict_any(source: object, gains: Gains, asked: ContactRequest) -> PredictedContact:
    """Predict one contact of a design, a plant or what was identified; see `autotune.predict`."""
    if isinstance(source, Design):
        _check_of_design(gains, asked)
        return source.predict(
            environment_stiffness=asked.touched().stiffness,
            payload_mass=asked.payload_mass,
            approach_speed=asked.speed,
            approach_force=asked.force,
            axis=asked.axis,
            bumper=asked.bumper,
        )
    file = plant_file(source)
    approach = asked.approach()
    if approach is None:
        raise UsageError("Say how the contact begins: approach_force or approach_speed.")
    surface = asked.touched()
    axis = find_axis(file.result, asked.axis, surface)
    notes = []
    if surface.stiffness is not None and axis not in ROTATIONAL_AXES:
        around = surface.stiffness, surface.stiffness
        if not asked.has_unit:
            check_surface_unit(around, surface.stiffness)
            notes += list(doubtful_surface(around))
    notes += [each.message for each in file.result.findings if each.message == NO_DELAY_GIVEN]
    plants = build_plants(file, surface, axis=axis, payload_mass=asked.payload_mass, sample_time_s=asked.sample_time)
    plants = with_bumper(plants, asked.bumper)
    controller = _controller(gains)
    law = running_law(controller, axis) if controller is not None else law_of_gains(_mapping(gains))
    found = predict_contact(plants, law, approach)
    outside = () if controller is None else outside_domain(controller.certificate.domain[axis], found)
    said = () if isinstance(law, TargetLaw) else tuple(law_notes(law, axis, controller))
    return replace(found, outside=outside, law_notes=said, neglected=(*notes, *found.neglected))


def _check_of_design(gains: Gains, asked: ContactRequest) -> None:
    """Refuse what a design brings itself."""
    given = {"gains": gains, "surface": asked.surface or None, "sample_time": asked.sample_time}
    for name, value in given.items():
        if value is not None:
            raise UsageError(
                f"{name}= does not go with a Design, which brings its own gains, period and certified plants: leave it "
                "out, or predict on a Plant, an Identification or the path of one."
            )
    if isinstance(asked.stiffness, Uncertain):
        raise UsageError("The stiffness of a surface must be one number for a design, without a deviation.")


def _controller(gains: Gains) -> "Controller | None":
    """Return the controller that the gains are of, None for gains in numbers."""
    if isinstance(gains, Design):
        return gains.controller
    if isinstance(gains, str | Path):
        from autotune.formats.controller import read_controller  # noqa: PLC0415 - a file only

        return read_controller(gains).controller
    return None


def plant_file(source: object) -> IdentifiedFile:
    """Return the parameters behind a plant or an identification; raises UsageError for anything else."""
    if isinstance(source, Identification | Plant):
        return source.file()
    if isinstance(source, IdentifiedFile):
        return source
    raise UsageError(
        f"A prediction needs what identify, optimize or load returns, a Plant or a path, found {type(source).__name__}."
    )


def _mapping(gains: Gains) -> Mapping[str, float | str]:
    if isinstance(gains, Mapping):
        return gains
    raise UsageError(
        "A contact of a plant needs gains: a mapping with mass and damping, a design, or the path of a controller."
    )


def parse_approach(text: str, axis: str | None) -> dict[str, float]:
    """Return force and speed of the form force=30 or speed=28mm/s,force=15; raises UsageError."""
    turns = axis in ROTATIONAL_AXES
    kinds = {"force": "torque" if turns else "force", "speed": "rotational speed" if turns else "speed"}
    return {
        name: parse_number(value, kinds[name], "--approach")
        for name, value in parse_pairs(text, "--approach", tuple(kinds))
    }


def parse_surface(text: str, result: Identified | None) -> tuple[str, float | Uncertain | None]:
    """Return the name of a surface of a plant, or a stiffness such as 20N/mm or 20±2N/mm; raises UsageError.

    Without a plant there are no names.
    """
    axes = {} if result is None else result.axes
    names = [each.name for axis in axes.values() for each in axis.environments]
    if text in names:
        return text, None
    value, sign, std = text.replace("+-", "±").partition("±")
    unit = (std if sign else value).lstrip("0123456789.eE+- ")
    kind = "rotational stiffness" if "rad" in unit or "deg" in unit else "stiffness"
    try:
        stiffness = parse_quantity(value if not sign else f"{value}{unit}", kind).value
        deviation = parse_quantity(std, kind).value if sign else 0.0
    except ValueError:
        held = f"the plant holds {', '.join(names)}" if names else "the plant holds none"
        raise UsageError(
            f"--surface {text} must be the name of a surface ({held}) or a stiffness such as 20N/mm."
        ) from None
    return "", Uncertain(stiffness, deviation) if sign else stiffness


def compare_with_touches(
    file: IdentifiedFile,
    logs: Sequence[tuple[str, Identified]],
    gains: Mapping[str, float | str],
    controller: "Controller | None",
    asked: ContactRequest,
    progress: Callable[[float], None] | None = None,
) -> TouchComparison:
    """Predict every touch of what logs show; gains and desired force are the logs' unless they are said."""
    touches = [
        (line.log or (name if len(logs) > 1 else ""), touch)
        for name, result in logs
        for line in result.timelines
        for touch in line.touches
        if asked.axis is None or touch.axis == asked.axis
    ]

    def running(axis: str) -> Running:
        if controller is not None:
            law = running_law(controller, axis)
            if isinstance(law, TargetLaw):
                return Running(law=law, desired_force=asked.force)
            return Running(
                law=law,
                mass=law.controller.mass_kg,
                damping=law.controller.damping_n_s_per_m,
                lead_s=law.controller.lead_s,
                desired_force=asked.force,
            )
        law = law_of_gains({"mass": 1.0, "damping": 1.0, **gains})
        names = {"mass": "mass", "damping": "damping", "lead": "lead_s"}
        said = {field: float(gains[name]) for name, field in names.items() if name in gains}
        return Running(law=law, desired_force=asked.force, **said)

    surface = asked.touched()
    found = compare_touches(
        file,
        touches,
        running,
        surface=None if surface == Surface() else surface,
        sample_time_s=asked.sample_time,
        progress=progress,
    )
    shown = {
        (each.log, axis, of.name): of.secant_stiffness_n_per_m
        for each in found.contacts
        for name, result in logs
        if each.log in ("", name)
        for axis, estimates in result.axes.items()
        for of in estimates.environments
    }
    places = ((each, (each.log, each.touch.axis, each.touch.surface or "")) for each in found.contacts)
    said = (other_surface(each, shown.get(place)) for each, place in places)
    return replace(found, other_surfaces=tuple(dict.fromkeys(text for text in said if text)))
