"""What a map can vary and show: one table of names, symbols and units, and how a value enters plant or controller."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Literal

from ..errors import ParameterError
from ..frozen import FrozenDict
from ..model.controller import SMALLEST_FEEDBACK_DAMPING_S, AdmittanceController
from ..model.plant import Coupling, Environment, PayloadDynamics, Plant
from ..model.robot import RobotModel

Part = Literal["controller", "plant"]


@dataclass(frozen=True, kw_only=True)
class MapParameter:
    """A number of the loop: `symbol` as in MODEL.md, `unit` on a translational axis and on a rotational one."""

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


_MASS, _DAMPING, _STIFFNESS = ("kg", "kg·m²"), ("N·s/m", "N·m·s/rad"), ("N/m", "N·m/rad")
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
_OF_PLANT = (
    ("payload_mass", "M_p", "payload mass", _MASS, False),
    ("drag", "B_p", "payload damping to ground", _DAMPING, True),
    ("payload_frequency_rad_per_s", "ω", "payload frequency", _CORNER, False),
    ("payload_damping_ratio", "ζ", "payload damping ratio", _NONE, True),
    ("coupling_stiffness", "K_s", "coupling stiffness", _STIFFNESS, False),
    ("coupling_damping", "B_s", "coupling damping", _DAMPING, True),
    ("environment_stiffness", "K_e", "environment stiffness", _STIFFNESS, True),
    ("environment_damping", "B_e", "environment damping", _DAMPING, True),
    ("environment_mass", "M_e", "environment mass", _MASS, True),
    ("delay_s", "T_d", "delay", _SECONDS, True),
    ("robot_bandwidth_rad_per_s", "ω_b", "robot bandwidth", _CORNER, False),
)


def _table(part: Part, rows: tuple[tuple[str, str, str, tuple[str, str], bool], ...]) -> dict[str, MapParameter]:
    return {
        name: MapParameter(
            name=name,
            symbol=symbol,
            label=label,
            unit=units[0],
            rotational_unit=units[1],
            part=part,
            may_be_zero=zero,
        )
        for name, symbol, label, units, zero in rows
    }


MAP_PARAMETERS: Mapping[str, MapParameter] = FrozenDict(
    _table("controller", _OF_CONTROLLER) | _table("plant", _OF_PLANT)
)
"""Every parameter by its name. The payload frequency is ω = sqrt(K_s/M_p) and stands for M_p; its damping ratio
ζ = B_p/(2 sqrt(M_p K_s)) stands for B_p; the bandwidth is that of a robot with one pole."""

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
    """Return the parameter of that name or symbol (M_a, B_a, K_l …); raises ParameterError with those known."""
    if name in MAP_PARAMETERS:
        return MAP_PARAMETERS[name]
    for parameter in MAP_PARAMETERS.values():
        if parameter.symbol == name:
            return parameter
    raise ParameterError("parameter", name, f"one of {', '.join(MAP_PARAMETERS)}")


def check_together(names: Collection[str]) -> None:
    """Raise ParameterError if two of the names say the same thing twice (ω and M_p, ζ and B_p)."""
    for derived, direct in STANDS_FOR.items():
        if derived in names and direct in names:
            raise ParameterError(derived, sorted(names), f"given without {direct}, which it determines")


def controller_at(controller: AdmittanceController, values: Mapping[str, float]) -> AdmittanceController:
    """Return the controller with the parameters of `values` that belong to it.

    A feedback damping too small to be a value in seconds is none at all (MODEL.md, erratum 2), so that a range may
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
    coupling, environment = plant.coupling, plant.environment
    stiffness = values.get("coupling_stiffness", coupling.stiffness_n_per_m)
    mass = values.get("payload_mass", plant.payload.mass_kg)
    if "payload_frequency_rad_per_s" in values:
        mass = stiffness / values["payload_frequency_rad_per_s"] ** 2
    drag = values.get("drag", plant.payload.drag_n_s_per_m)
    if "payload_damping_ratio" in values:
        drag = 2.0 * values["payload_damping_ratio"] * math.sqrt(mass * stiffness)
    return Plant(
        robot=_robot_at(plant.robot, values),
        coupling=Coupling(
            stiffness_n_per_m=stiffness,
            damping_n_s_per_m=values.get("coupling_damping", coupling.damping_n_s_per_m),
        ),
        payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=drag),
        environment=Environment(
            stiffness_n_per_m=values.get("environment_stiffness", environment.stiffness_n_per_m),
            damping_n_s_per_m=values.get("environment_damping", environment.damping_n_s_per_m),
            mass_kg=values.get("environment_mass", environment.mass_kg),
        ),
        wrench_filter=plant.wrench_filter,
    )


def _robot_at(robot: RobotModel, values: Mapping[str, float]) -> RobotModel:
    delay = values.get("delay_s", robot.delay_s)
    if "robot_bandwidth_rad_per_s" in values:
        if not has_bandwidth(robot):
            must = f"asked of a robot with one pole (this one has {robot.order})"
            raise ParameterError("robot_bandwidth_rad_per_s", values["robot_bandwidth_rad_per_s"], must)
        return RobotModel.from_bandwidth(bandwidth_rad_per_s=values["robot_bandwidth_rad_per_s"], delay_s=delay)
    if delay == robot.delay_s:
        return robot
    return RobotModel(numerator=robot.numerator, denominator=robot.denominator, delay_s=delay)


def has_bandwidth(robot: RobotModel) -> bool:
    """Whether the robot is one pole, so that one number tells its bandwidth."""
    return robot.order == 1


def value_of(name: str, plant: Plant, controller: AdmittanceController) -> float:
    """Return what a parameter is on a plant and controller; NaN for the bandwidth of a robot with more poles."""
    if name in CONTROLLER_FIELDS:
        return float(getattr(controller, CONTROLLER_FIELDS[name]))
    stiffness, mass, drag = plant.coupling.stiffness_n_per_m, plant.payload.mass_kg, plant.payload.drag_n_s_per_m
    robot = plant.robot
    return {
        "payload_mass": mass,
        "drag": drag,
        "payload_frequency_rad_per_s": math.sqrt(stiffness / mass),
        "payload_damping_ratio": drag / (2.0 * math.sqrt(mass * stiffness)),
        "coupling_stiffness": stiffness,
        "coupling_damping": plant.coupling.damping_n_s_per_m,
        "environment_stiffness": plant.environment.stiffness_n_per_m,
        "environment_damping": plant.environment.damping_n_s_per_m,
        "environment_mass": plant.environment.mass_kg,
        "delay_s": robot.delay_s,
        "robot_bandwidth_rad_per_s": float(robot.denominator[-1]) if has_bandwidth(robot) else math.nan,
    }[name]
