"""The loop around which a map varies: from what a file knows and what the user sets."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

from autotune.errors import UsageError
from identification.errors import EstimateError
from problems.frozen import freeze
from problems.maps.parameters import CONTROLLER_FIELDS, STANDS_FOR, controller_at, plant_at, value_of
from problems.model.controller import AdmittanceController
from problems.model.plant import Coupling, Environment, Payload, Plant

from .source import MapSource

# What a controller must be given; the rest of it is off, or as in the paper, until somebody says otherwise.
_NEEDED = ("mass", "damping")
_OF_PLANT = ("payload_mass", "drag", "coupling_stiffness", "coupling_damping", "environment_stiffness")
# Stands for a value that every point of the map replaces.
_REPLACED = 1.0


@dataclass(frozen=True, kw_only=True)
class Base:
    """Plant and controller at the values that are fixed; `derived` are the settings that determine others everywhere.

    What is varied, or determined by what is varied, has some value in `plant` and `controller` that nobody sees.
    """

    plant: Plant
    controller: AdmittanceController
    derived: Mapping[str, float]

    def __post_init__(self) -> None:
        freeze(self, "derived")

    def value(self, name: str) -> float:
        """Return the value of a parameter that does not vary."""
        return value_of(name, plant_at(self.plant, self.derived), self.controller)

    def fixed(self, varied: Collection[str]) -> dict[str, float]:
        """Return the parameters that do not vary, and say the payload as the varied and the derived ones do."""
        spoken = {*varied, *self.derived}
        unsaid = {direct if derived in spoken else derived for derived, direct in STANDS_FOR.items()}
        found = {
            name: self.value(name) for name in (*CONTROLLER_FIELDS, *_PLANT_NAMES) if name not in {*varied, *unsaid}
        }
        return {name: value for name, value in found.items() if not math.isnan(value)}


_PLANT_NAMES = (
    *("payload_mass", "drag", "payload_frequency_rad_per_s", "payload_damping_ratio"),
    *("coupling_stiffness", "coupling_damping", "environment_stiffness", "environment_damping", "environment_mass"),
    *("delay_s", "robot_bandwidth_rad_per_s"),
)


def known_values(source: MapSource, settings: Mapping[str, float]) -> dict[str, float]:
    """Return every parameter that the source or a setting gives, or that follows from those."""
    known = dict(source.known) | {"delay_s": source.robot.delay_s}
    if source.robot.order == 1:
        known["robot_bandwidth_rad_per_s"] = float(source.robot.denominator[-1])
    if source.controller is not None:
        known |= {name: float(getattr(source.controller, field)) for name, field in CONTROLLER_FIELDS.items()}
    known |= settings
    if "payload_frequency_rad_per_s" in settings and "coupling_stiffness" in known:
        known["payload_mass"] = known["coupling_stiffness"] / settings["payload_frequency_rad_per_s"] ** 2
    stiffness, mass = known.get("coupling_stiffness", 0.0), known.get("payload_mass", 0.0)
    if stiffness > 0.0 and mass > 0.0:
        known.setdefault("payload_frequency_rad_per_s", math.sqrt(stiffness / mass))
        if "drag" in known:
            known.setdefault("payload_damping_ratio", known["drag"] / (2.0 * math.sqrt(stiffness * mass)))
    return known


def build_base(source: MapSource, settings: Mapping[str, float], varied: Collection[str], *, touches: bool) -> Base:
    """Build plant and controller from what is known; `touches` tells whether the environment matters.

    Raises UsageError for a controller value that is neither known nor varied, EstimateError for such a plant
    parameter, ParameterError for values out of range.
    """
    known = known_values(source, settings)
    determined = {direct for derived, direct in STANDS_FOR.items() if derived in varied or derived in settings}
    for name in _NEEDED:
        if name not in known and name not in varied:
            raise UsageError(f"{name} is not known; say --set {name}=VALUE, or --controller FILE.")
    for name in _OF_PLANT:
        if name in known or name in varied or name in determined:
            continue
        if name == "environment_stiffness" and not touches:
            continue
        reason = source.missing.get(name, "the file does not tell it")
        raise EstimateError(
            f"{source.path}: {name} of axis {source.axis} is not identified ({reason}); say --set {name}=VALUE."
        )
    values = {name: known.get(name, _REPLACED) for name in (*_NEEDED, *_OF_PLANT)}
    if not touches:
        values["environment_stiffness"] = known.get("environment_stiffness", 0.0)
    kind = source.controller or AdmittanceController(mass_kg=_REPLACED, damping_n_s_per_m=_REPLACED)
    direct = {name: value for name, value in settings.items() if name not in STANDS_FOR}
    plant = Plant(
        robot=source.robot,
        coupling=Coupling(stiffness_n_per_m=values["coupling_stiffness"], damping_n_s_per_m=values["coupling_damping"]),
        payload=Payload(mass_kg=values["payload_mass"], drag_n_s_per_m=values["drag"]),
        environment=Environment(
            stiffness_n_per_m=values["environment_stiffness"],
            damping_n_s_per_m=known.get("environment_damping", 0.0),
            mass_kg=known.get("environment_mass", 0.0),
        ),
        wrench_filter=source.wrench_filter,
    )
    return Base(
        plant=plant_at(plant, direct),
        controller=controller_at(kind, {name: values[name] for name in _NEEDED} | direct),
        derived={name: value for name, value in settings.items() if name in STANDS_FOR and name not in varied},
    )
