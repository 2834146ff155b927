"""The certificate in `controller.yaml`, as values; on rx, ry, rz read N·m, rad and kg·m² for N, m and kg."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from problems.contact.transient import Approach
from problems.design.requirements import AdmittanceTarget, NoiseLimit, PassivityTarget
from problems.design.uncertainty import ALWAYS_UNCERTAIN, Ellipsoid, PlantSet
from problems.errors import ParameterError
from problems.frozen import FrozenDict, freeze
from problems.model.plant import NO_FILTER, WrenchFilter
from problems.model.plant_parameters import PARAMETERS
from problems.model.robot import RobotModel

from .units import ROTATIONAL_AXES

Interval = tuple[float, float]


def check_interval(name: str, interval: Interval) -> None:
    """Raise ParameterError unless 0 ≤ lowest ≤ highest."""
    if not 0.0 <= interval[0] <= interval[1] < math.inf:
        raise ParameterError(name, interval, "[lowest, highest] with 0 ≤ lowest ≤ highest")


@dataclass(frozen=True, kw_only=True)
class ConfidenceSet:
    """An ellipsoid that cuts the ranges: the confidence `level`, its `centre` and `covariance` by parameter."""

    level: float
    centre: Mapping[str, float]
    covariance: Mapping[str, Mapping[str, float]]

    def __post_init__(self) -> None:
        freeze(self, "centre", "covariance")
        for name, row in self.covariance.items():
            if set(row) != set(self.centre):
                raise ParameterError(f"covariance.{name}", sorted(row), f"given for {', '.join(self.centre)}")
        if set(self.covariance) != set(self.centre):
            raise ParameterError("covariance", sorted(self.covariance), f"given for {', '.join(self.centre)}")

    @classmethod
    def of(cls, ellipsoid: Ellipsoid) -> "ConfidenceSet":
        """Return the record of an ellipsoid."""
        names = ellipsoid.names
        rows = zip(names, ellipsoid.covariance, strict=True)
        return cls(
            level=ellipsoid.level,
            centre=dict(zip(names, ellipsoid.centre, strict=True)),
            covariance={name: dict(zip(names, row, strict=True)) for name, row in rows},
        )

    def ellipsoid(self) -> Ellipsoid:
        """Return the same as a set to compute with."""
        names = tuple(self.centre)
        return Ellipsoid(
            names=names,
            centre=tuple(self.centre.values()),
            covariance=tuple(tuple(self.covariance[a][b] for b in names) for a in names),
            level=self.level,
        )


@dataclass(frozen=True, kw_only=True)
class AxisDomain:
    """The plants of one axis for which the certificate holds; r(s) in descending powers of s, r(0) = 1.

    `uncertain` holds ranges of what is not at its nominal value beyond K_e and M_p, `confidence` what cuts them.
    `wrench_filter` lies between the coupling's force and what the controller reads, None if nothing does.
    """

    environment_stiffness_n_per_m: Interval
    payload_mass_kg: Interval
    environment_damping_n_s_per_m: float
    environment_mass_kg: float
    coupling_stiffness_n_per_m: float
    coupling_damping_n_s_per_m: float
    drag_n_s_per_m: float
    robot_numerator: tuple[float, ...]
    robot_denominator: tuple[float, ...]
    delay_s: float
    approach_force_n: float | None = None
    approach_speed_m_s: float | None = None
    uncertain: Mapping[str, Interval] | None = None
    confidence: ConfidenceSet | None = None
    wrench_filter: WrenchFilter | None = None

    def __post_init__(self) -> None:
        check_interval("environment_stiffness_n_per_m", self.environment_stiffness_n_per_m)
        check_interval("payload_mass_kg", self.payload_mass_kg)
        if self.uncertain is not None:
            freeze(self, "uncertain")
            _ = self.plants
        elif self.confidence is not None:
            raise ParameterError("confidence", self.confidence.level, "given together with the ranges that it cuts")

    @classmethod
    def of(cls, plants: PlantSet, approach: Approach) -> "AxisDomain":
        """Return the domain that says this set, and how its contacts begin."""
        robot, wrench, cut = plants.nominal.robot, plants.nominal.wrench_filter, plants.ellipsoid
        return cls(
            **{name: PARAMETERS[name].value(plants.nominal) for name in _NOMINAL},
            environment_stiffness_n_per_m=plants.environment_stiffness_n_per_m,
            payload_mass_kg=plants.payload_mass_kg,
            robot_numerator=tuple(float(c) for c in robot.numerator),
            robot_denominator=tuple(float(c) for c in robot.denominator),
            approach_force_n=approach.force_n,
            approach_speed_m_s=approach.speed_m_s,
            uncertain=plants.further or None,
            confidence=None if cut is None else ConfidenceSet.of(cut),
            wrench_filter=None if wrench.is_none else wrench,
        )

    @cached_property
    def plants(self) -> PlantSet:
        """The set that the file says; raises ParameterError if there is no such set."""
        numerator, denominator = np.array(self.robot_numerator), np.array(self.robot_denominator)
        robot = RobotModel(numerator=numerator, denominator=denominator, delay_s=self.delay_s)
        return PlantSet.of(
            robot,
            environment_stiffness_n_per_m=self.environment_stiffness_n_per_m,
            payload_mass_kg=self.payload_mass_kg,
            wrench_filter=self.wrench_filter or NO_FILTER,
            further=self.uncertain,
            ellipsoid=None if self.confidence is None else self.confidence.ellipsoid(),
            **{name: getattr(self, name) for name in _NOMINAL},
        )

    @property
    def approach(self) -> Approach:
        """How the contacts begin: by the speed where one is said, else by the force; ParameterError without both."""
        speed = self.approach_speed_m_s
        return Approach(force_n=self.approach_force_n if speed is None else None, speed_m_s=speed)


_NOMINAL = tuple(
    each.name for each in fields(AxisDomain) if each.name in PARAMETERS and each.name not in ALWAYS_UNCERTAIN
)


@dataclass(frozen=True, kw_only=True)
class AxisMargins:
    """The smallest margins over the domain; None where no finite limit exists (infinity is stored as None).

    `worst` names for each margin the plant at which it was found.
    """

    gain_db: float | None
    phase_deg: float | None
    delay_s: float | None
    modulus: float
    worst: Mapping[str, Mapping[str, float | str]]

    def __post_init__(self) -> None:
        for name in ("gain_db", "phase_deg", "delay_s"):
            if getattr(self, name) == math.inf:
                object.__setattr__(self, name, None)
        object.__setattr__(self, "worst", FrozenDict({key: FrozenDict(case) for key, case in self.worst.items()}))


@dataclass(frozen=True, kw_only=True)
class Proof:
    """What is proved, by which method, over which set; `numbers` are its figures by name, if it has any."""

    claim: str
    method: str
    over: str | Mapping[str, Any]
    numbers: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        if self.numbers is not None:
            freeze(self, "numbers")

    def over_text(self) -> str:
        """Return the set as text."""
        if isinstance(self.over, str):
            return self.over
        return ", ".join(f"{name} {value}" for name, value in self.over.items())


@dataclass(frozen=True, kw_only=True)
class ProvenRegion:
    """How far a modulus margin, and stability with it, is proved at all frequencies, in contact and in free space.

    `over` names what varies in its whole range, the rest is nominal. `modulus` is the swept one less the share `slack`.
    `share` of the set is proved, and all of it for K_e inside `environment_stiffness_n_per_m`; 1 is all of it.
    `cells` of plants and `arcs` of the unit circle were looked at in `run_time_s`; `budget_s` ends the attempt. Both
    are work counted at a fixed speed, not read from a clock: the same input gives the same file.
    """

    over: tuple[str, ...]
    modulus: float
    slack: float
    method: str
    share: float
    environment_stiffness_n_per_m: Interval
    cells: float
    arcs: float
    budget_s: float
    run_time_s: float

    def __post_init__(self) -> None:
        check_interval("environment_stiffness_n_per_m", self.environment_stiffness_n_per_m)
        if not (0.0 < self.modulus < 1.0 and 0.0 < self.slack < 1.0 and 0.0 <= self.share <= 1.0):
            raise ParameterError("modulus", self.modulus, "modulus, slack and share between 0 and 1")
        if not (self.budget_s > 0.0 and self.run_time_s >= 0.0):
            raise ParameterError("budget_s", self.budget_s, "above 0, and no run time below 0")


Requirement = float | bool | AdmittanceTarget | NoiseLimit | PassivityTarget
Asked = Mapping[str, Requirement]


@dataclass(frozen=True, kw_only=True)
class SoftRequirement:
    """What was asked at a price (N per share missed) and what was `achieved`, in the unit of what was asked.

    None where no finite limit exists.
    """

    asked: float | AdmittanceTarget | NoiseLimit | PassivityTarget
    soft_n: float
    achieved: float | None

    def __post_init__(self) -> None:
        if self.achieved == math.inf:
            object.__setattr__(self, "achieved", None)


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What was shown about the controller, and for which plants.

    `proved` holds for every plant that it names, `sampled` was looked for on many plants of the set and not found.
    `requirements` are those of x, y, z, `rotational_requirements` those of rx, ry, rz (rad, N·m), None without them.
    `soft` holds by axis what need not be met, and what was achieved, `continuous` what of the modulus is proved.
    """

    domain: Mapping[str, AxisDomain]
    sample_time_s: float
    requirements: Mapping[str, Requirement]
    proved: tuple[Proof, ...]
    margins: Mapping[str, AxisMargins]
    rotational_requirements: Mapping[str, Requirement] | None = None
    sampled: tuple[Proof, ...] = ()
    soft: Mapping[str, Mapping[str, SoftRequirement]] | None = None
    continuous: Mapping[str, tuple[ProvenRegion, ...]] | None = None

    def __post_init__(self) -> None:
        freeze(self, "domain", "requirements", "margins")
        if self.continuous is not None:
            freeze(self, "continuous")
        if self.rotational_requirements is not None:
            freeze(self, "rotational_requirements")
        if self.soft is not None:
            freeze(self, "soft")

    def requirements_of(self, axis: str) -> Asked | None:
        """Return what was asked of one axis; None for a rotational one of which the file does not say it."""
        return self.rotational_requirements if axis in ROTATIONAL_AXES else self.requirements
