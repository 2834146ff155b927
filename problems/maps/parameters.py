"""What a map can vary and show: one table of names, symbols and units, and how a value enters plant or controller."""

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Literal

from ..errors import ParameterError
from ..frozen import FrozenDict
from ..model.axis_kind import STRAIGHT, TURNING
from ..model.controller import SMALLEST_FEEDBACK_DAMPING_S, AdmittanceController
from ..model.plant import Plant
from ..model.plant_parameters import PARAMETERS, with_values
from ..model.robot import RobotModel

Part = Literal["controller", "plant"]


@dataclass(frozen=True, kw_only=True)
class MapParameter:
    """A number of the loop: `symbol` as in docs/method.md, `unit` on a translational axis and on a rotational one."""

    name: str
    symbol: str
    label: str
    unit: str
    rotational_unit: str
    part: Part
    may_be_zero: bool

    def unit_of(self, *, rotational: bool) -> str:
        """Return the unit on one kind of axis."""
        return self.rotational_unit if rotational else self.unit


_MASS, _DAMPING = ("kg", "kg·m²"), ("N·s/m", "N·m·s/rad")
_SECONDS, _CORNER, _NONE = ("s", "s"), ("rad/s", "rad/s"), ("", "")
_OF_CONTROLLER = (
    ("mass", "M_a", "admittance mass", _MASS, False),
    ("damping", "B_a", "admittance damping", _DAMPING, False),
    ("lead_s", "K_l", "lead gain", _SECONDS, True),
    ("feedback_damping_s", "B_fb", "feedback damping", _SECONDS, True),
    ("velocity_filter_rad_per_s", "ω_v", "velocity filter", _CORNER, False),
    ("acceleration_filter_rad_per_s", "ω_a", "acceleration filter", _CORNER, False),
    ("compensation_mass", "P̂", "compensated mass", _MASS, True),
)
_DERIVED = {
    "payload": (
        ("payload_frequency_rad_per_s", "ω", "payload frequency", _CORNER, False),
        ("payload_damping_ratio", "ζ", "payload damping ratio", _NONE, True),
    ),
    "robot": (("robot_bandwidth_rad_per_s", "ω_b", "robot bandwidth", _CORNER, False),),
}
_LABELS = {"drag": "payload damping to ground"}


def _row(part: Part, row: tuple[str, str, str, tuple[str, str], bool]) -> MapParameter:
    name, symbol, label, (unit, rotational_unit), may_be_zero = row
    return MapParameter(
        name=name,
        symbol=symbol,
        label=label,
        unit=unit,
        rotational_unit=rotational_unit,
        part=part,
        may_be_zero=may_be_zero,
    )


PLANT_NAMES: Mapping[str, str] = FrozenDict(
    {
        each.short_name: name
        for part in ("payload", "coupling", "environment", "robot")
        for name, each in PARAMETERS.items()
        if each.part == part and each.kind in {"stiffness", "damping", "mass", "time"}
    }
)
"""The plant's parameters that a map may show, and their names in `problems.model.plant_parameters`."""


def _of_plant() -> Iterator[MapParameter]:
    """Yield the parameters of each part of the plant, those that are derived from a part's behind them."""
    for part in ("payload", "coupling", "environment", "robot"):
        for name, of in ((name, PARAMETERS[each]) for name, each in PLANT_NAMES.items()):
            if of.part == part:
                units = STRAIGHT.unit(of.kind), TURNING.unit(of.kind)
                # A map may go to free space.
                may_be_zero = of.may_be_zero or part == "environment"
                yield _row("plant", (name, of.symbol, _LABELS.get(name, of.label), units, may_be_zero))
        yield from (_row("plant", row) for row in _DERIVED.get(part, ()))


MAP_PARAMETERS: Mapping[str, MapParameter] = FrozenDict(
    {each.name: each for each in (*(_row("controller", row) for row in _OF_CONTROLLER), *_of_plant())}
)
"""Every parameter by its name. The payload frequency is ω = sqrt(K_s/M_p) and sets M_p; its damping ratio
ζ = B_p/(2 sqrt(M_p K_s)) sets B_p; the bandwidth is that of a robot with one pole."""

STANDS_FOR: Mapping[str, str] = FrozenDict(
    {"payload_frequency_rad_per_s": "payload_mass", "payload_damping_ratio": "drag"}
)
"""Parameters that determine another one: ω the mass M_p, ζ the damping B_p."""


class MapQuantity(StrEnum):
    """What is shown over the parameters."""

    STABILITY = "stability"
    MODULUS = "modulus"
    GAIN = "gain"
    PHASE = "phase"
    DELAY = "delay"
    DISK = "disk"
    PEAK_CONTACT = "peak-contact"
    PEAK_SENSOR = "peak-sensor"

    @property
    def is_peak(self) -> bool:
        """Whether it is a force of the contact transient."""
        return self in {MapQuantity.PEAK_CONTACT, MapQuantity.PEAK_SENSOR}

    @property
    def label(self) -> str:
        """Its name for people."""
        return _QUANTITIES[self][0]

    def unit_of(self, *, rotational: bool) -> str:
        """Return its unit on one kind of axis."""
        return _QUANTITIES[self][2 if rotational else 1]


_QUANTITIES: Mapping[MapQuantity, tuple[str, str, str]] = {
    MapQuantity.STABILITY: ("stability", "", ""),
    MapQuantity.MODULUS: ("modulus margin", "", ""),
    MapQuantity.GAIN: ("gain margin", "dB", "dB"),
    MapQuantity.PHASE: ("phase margin", "°", "°"),
    MapQuantity.DELAY: ("delay margin", "s", "s"),
    MapQuantity.DISK: ("disk margin", "", ""),
    MapQuantity.PEAK_CONTACT: ("peak contact force", "N", "N·m"),
    MapQuantity.PEAK_SENSOR: ("peak sensor force", "N", "N·m"),
}

CONTROLLER_FIELDS = {
    "mass": "mass_kg",
    "damping": "damping_n_s_per_m",
    "lead_s": "lead_s",
    "feedback_damping_s": "feedback_damping_s",
    "velocity_filter_rad_per_s": "velocity_filter_rad_per_s",
    "acceleration_filter_rad_per_s": "acceleration_filter_rad_per_s",
    "compensation_mass": "compensation_mass_kg",
}
"""The field of `AdmittanceController` of each of its parameters, in the order of `AdmittanceController.parameters`."""


def find_parameter(name: str) -> MapParameter:
    """Return the parameter of that name or symbol (M_a, B_a, K_l …); raises ParameterError with those known.

    A name may leave its unit out, as `lead` for `lead_s`.
    """
    if name in MAP_PARAMETERS:
        return MAP_PARAMETERS[name]
    for parameter in MAP_PARAMETERS.values():
        if name in (parameter.symbol, parameter.name.removesuffix("_s")):
            return parameter
    raise ParameterError("parameter", name, f"one of {', '.join(MAP_PARAMETERS)}")


def check_together(names: Collection[str]) -> None:
    """Raise ParameterError if two of the names say the same thing twice (ω and M_p, ζ and B_p)."""
    for derived, direct in STANDS_FOR.items():
        if derived in names and direct in names:
            raise ParameterError(derived, sorted(names), f"given without {direct}, which it determines")


def controller_at(controller: AdmittanceController, values: Mapping[str, float]) -> AdmittanceController:
    """Return the controller with the parameters of `values` that belong to it.

    A feedback damping too small to be a value in seconds is none at all (docs/method.md, erratum 2), so a range may
    begin at 0.
    """
    changed: dict[str, Any] = {field: values[name] for name, field in CONTROLLER_FIELDS.items() if name in values}
    if 0.0 < changed.get("feedback_damping_s", 0.0) < SMALLEST_FEEDBACK_DAMPING_S:
        changed["feedback_damping_s"] = 0.0
    return replace(controller, **changed) if changed else controller


def plant_at(plant: Plant, values: Mapping[str, float]) -> Plant:
    """Return the plant with the parameters of `values` that belong to it.

    A payload frequency sets M_p = K_s/ω², a damping ratio then B_p = 2 ζ sqrt(M_p K_s), whatever else `values` sets.
    """
    plant = with_values(plant, {PLANT_NAMES[name]: value for name, value in values.items() if name in PLANT_NAMES})
    stiffness, payload, robot = plant.coupling.stiffness_n_per_m, plant.payload, plant.robot
    if "payload_frequency_rad_per_s" in values:
        payload = replace(payload, mass_kg=stiffness / values["payload_frequency_rad_per_s"] ** 2)
    if "payload_damping_ratio" in values:
        drag = 2.0 * values["payload_damping_ratio"] * math.sqrt(payload.mass_kg * stiffness)
        payload = replace(payload, drag_n_s_per_m=drag)
    if "robot_bandwidth_rad_per_s" in values:
        bandwidth = values["robot_bandwidth_rad_per_s"]
        if not has_bandwidth(robot):
            must = f"asked of a robot with one pole (this one has {robot.order})"
            raise ParameterError("robot_bandwidth_rad_per_s", bandwidth, must)
        robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=bandwidth, delay_s=robot.delay_s)
    return replace(plant, payload=payload, robot=robot)


def has_bandwidth(robot: RobotModel) -> bool:
    """Whether the robot is one pole, so that one number gives its bandwidth."""
    return robot.order == 1


def value_of(name: str, plant: Plant, controller: AdmittanceController) -> float:
    """Return what a parameter is on a plant and controller; NaN for the bandwidth of a robot with more poles."""
    if name in CONTROLLER_FIELDS:
        return float(getattr(controller, CONTROLLER_FIELDS[name]))
    if name in PLANT_NAMES:
        return PARAMETERS[PLANT_NAMES[name]].value(plant)
    stiffness, mass, drag = plant.coupling.stiffness_n_per_m, plant.payload.mass_kg, plant.payload.drag_n_s_per_m
    robot = plant.robot
    return {
        "payload_frequency_rad_per_s": math.sqrt(stiffness / mass),
        "payload_damping_ratio": drag / (2.0 * math.sqrt(mass * stiffness)),
        "robot_bandwidth_rad_per_s": float(robot.denominator[-1]) if has_bandwidth(robot) else math.nan,
    }[name]
