"""The table of the plant's parameters: what each is called, in which unit, and where a `Plant` holds it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from .._checks import non_negative
from ..frozen import FrozenDict
from .axis_kind import QuantityKind, rotational_name
from .plant import NO_FILTER, Coupling, Environment, PayloadDynamics, Plant, WrenchFilter
from .robot import RobotModel, bandwidth_hz, damping_ratio, vary_robot

Part = Literal["environment", "payload", "coupling", "robot", "wrench_filter"]


@dataclass(frozen=True, kw_only=True)
class PlantParameter:
    """A number of the plant: `name` in files and sets, `symbol`, and the `part` of a `Plant` it is of.

    `place` is where `Plant.parameters` adds it, None of what is not in them. It may be uncertain, above 0 unless it
    `may_be_zero`; a proof covers the range of one that `is_provable`.
    """

    name: str
    symbol: str
    label: str
    kind: QuantityKind
    part: Part
    place: int | None = None
    may_be_zero: bool = False
    is_provable: bool = True

    @property
    def field(self) -> str:
        """The name under which the part holds it."""
        return self.name.removeprefix(f"{self.part.partition('_')[0]}_")

    @property
    def short_name(self) -> str:
        """Its name without a unit that depends on the kind of axis, as maps and people write it."""
        return self.name.removesuffix("_kg").removesuffix("_n_per_m").removesuffix("_n_s_per_m")

    @property
    def rotational_name(self) -> str:
        """Its name in the files of a turning axis."""
        return rotational_name(self.name)

    def value(self, plant: Plant) -> float:
        """Return its value [SI of the axis]; raises ParameterError for a damping ratio of a robot that has none."""
        if self.field == "bandwidth_hz":
            return bandwidth_hz(plant.robot)
        if self.field == "damping_ratio":
            return damping_ratio(plant.robot)
        return float(getattr(getattr(plant, self.part), self.field))


def _row(
    name: str, symbol: str, label: str, kind: QuantityKind, part: Part, place: int | None = None, **others: bool
) -> PlantParameter:
    """Return a row of the table; what may be zero, vary or be proved is said by name."""
    return PlantParameter(name=name, symbol=symbol, label=label, kind=kind, part=part, place=place, **others)


_ROWS = (
    _row("environment_stiffness_n_per_m", "K_e", "environment stiffness", "stiffness", "environment", 4),
    _row("payload_mass_kg", "M_p", "payload mass", "mass", "payload", 2),
    _row("coupling_stiffness_n_per_m", "K_s", "coupling stiffness", "stiffness", "coupling", 0),
    _row("coupling_damping_n_s_per_m", "B_s", "coupling damping", "damping", "coupling", 1, may_be_zero=True),
    _row("drag_n_s_per_m", "B_p", "drag", "damping", "payload", 3, may_be_zero=True),
    _row("environment_damping_n_s_per_m", "B_e", "environment damping", "damping", "environment", 5, may_be_zero=True),
    _row("environment_mass_kg", "M_e", "environment mass", "mass", "environment", 6, may_be_zero=True),
    _row("delay_s", "T_d", "delay", "time", "robot", may_be_zero=True),
    _row("robot_bandwidth_hz", "f_b", "robot bandwidth", "frequency", "robot"),
    _row("robot_damping_ratio", "ζ_b", "robot damping ratio", "ratio", "robot", is_provable=False),
    # A filter of the wrench is a state of the plant, which does not vanish within a set: τ_w is above 0 or absent.
    _row("wrench_time_constant_s", "τ_w", "wrench filter, time constant", "time", "wrench_filter"),
    _row("wrench_delay_s", "T_w", "wrench delay", "time", "wrench_filter", may_be_zero=True),
)
PARAMETERS: Mapping[str, PlantParameter] = FrozenDict({each.name: each for each in _ROWS})


def with_values(plant: Plant, values: Mapping[str, float]) -> Plant:
    """Return the plant with the named parameters at these values, what is not named as it is.

    Another robot bandwidth moves all frequencies of r(s). Raises KeyError for a name that is not in the table,
    ParameterError for a value that cannot be.
    """
    changed = _by_part(values)
    robot = vary_robot(plant.robot, **changed.pop("robot", {}))
    parts = {part: replace(getattr(plant, part), **fields) for part, fields in changed.items()}
    return replace(plant, robot=robot, **parts)


def build_plant(robot: RobotModel, values: Mapping[str, float], wrench_filter: WrenchFilter = NO_FILTER) -> Plant:
    """Return the plant of a robot with the named parameters of everything else; without an environment, free space."""
    of = _by_part({"environment_stiffness_n_per_m": 0.0, **values})
    return Plant(
        robot=vary_robot(robot, **of.get("robot", {})),
        coupling=Coupling(**of["coupling"]),
        payload=PayloadDynamics(**of["payload"]),
        environment=Environment(**of["environment"]),
        wrench_filter=replace(wrench_filter, **of.get("wrench_filter", {})),
    )


def _by_part(values: Mapping[str, float]) -> dict[str, dict[str, float]]:
    """Return the values by the part of the plant that holds them, and its field."""
    found: dict[str, dict[str, float]] = {}
    for name, value in values.items():
        found.setdefault(PARAMETERS[name].part, {})[PARAMETERS[name].field] = non_negative(name, value)
    return found
