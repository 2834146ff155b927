"""The certificate in `controller.yaml`, as values; on rx, ry, rz read N·m, rad and kg·m² for N, m and kg."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any

import numpy as np

from problems.contact.transient import Approach
from problems.design.requirements import (
    AdmittanceTarget,
    ContactAtSpeed,
    HeldByHand,
    MultiplicativeError,
    NoiseLimit,
    PassivityTarget,
)
from problems.design.uncertainty import ALWAYS_UNCERTAIN, FURTHER_UNCERTAIN, SYMBOLS, Ellipsoid, PlantSet
from problems.errors import ParameterError
from problems.frozen import AboveZero, FrozenDict, NotNegative, Rule, Text, freeze
from problems.model.plant import NO_FILTER, WrenchFilter
from problems.model.plant_parameters import PARAMETERS
from problems.model.robot import RobotModel

from .bumper_record import BumperRecord
from .coupled_record import CoupledCertificate
from .proof_records import BouncingProof, HeldProof, PeakProof, share_of
from .units import ROTATIONAL_AXES, Axis, axis_units

Interval = tuple[float, float]
FurtherName = Annotated[str, Rule(enum=FURTHER_UNCERTAIN)]
Period = Annotated[float, Rule(minimum=1e-5, maximum=0.1)]
Band = Annotated[Interval, Rule(items=Rule(minimum=0, maximum=10000))]
Polynomial = Annotated[tuple[float, ...], Rule(items=Rule(minimum=-1e40, maximum=1e40), minItems=1, maxItems=24)]
Share = Annotated[float, Rule(exclusiveMinimum=0, exclusiveMaximum=1)]

_STIFFNESS = Rule(minimum=0, maximum=1_000_000_000)
_TIME = Rule(minimum=0, maximum=1)
_DAMPING = Rule(minimum=0, maximum=10_000_000)
PARAMETER_BOUNDS: Mapping[str, Rule] = FrozenDict(
    {
        "environment_stiffness_n_per_m": _STIFFNESS,
        "payload_mass_kg": Rule(minimum=0.001, maximum=1000, turning=Rule(minimum=1e-6)),
        "coupling_stiffness_n_per_m": Rule(minimum=1, maximum=1_000_000_000, turning=Rule(minimum=0.01)),
        "coupling_damping_n_s_per_m": _DAMPING,
        "drag_n_s_per_m": Rule(minimum=0, maximum=1_000_000),
        "environment_damping_n_s_per_m": _DAMPING,
        "environment_mass_kg": Rule(minimum=0, maximum=10_000, turning=Rule(maximum=1000)),
        "delay_s": _TIME,
        "robot_bandwidth_hz": Rule(minimum=0.001, maximum=10_000),
        "robot_damping_ratio": Rule(minimum=0, maximum=100),
        "wrench_time_constant_s": _TIME,
        "wrench_delay_s": _TIME,
    }
)
"""Bounds of a number of the file that is named like a parameter of the plant."""


def check_interval(name: str, interval: Interval) -> None:
    """Raise ParameterError unless 0 ≤ lowest ≤ highest."""
    if not 0.0 <= interval[0] <= interval[1] < math.inf:
        raise ParameterError(name, interval, "[lowest, highest] with 0 ≤ lowest ≤ highest")


@dataclass(frozen=True, kw_only=True)
class ConfidenceSet:
    """An ellipsoid that cuts the ranges: the confidence `level`, its `centre` and `covariance` by parameter."""

    level: Share
    centre: Mapping[FurtherName, float]
    covariance: Mapping[FurtherName, Mapping[str, float]]

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
    robot_numerator: Polynomial
    robot_denominator: Polynomial
    delay_s: float
    approach_force_n: (
        Annotated[float, Rule(minimum=0.01, maximum=10000, turning=Rule(minimum=0.001, maximum=2000))] | None
    ) = None
    approach_speed_m_s: Annotated[float, Rule(minimum=0.0001, maximum=5, turning=Rule(maximum=25))] | None = None
    uncertain: Mapping[FurtherName, Interval] | None = None
    confidence: ConfidenceSet | None = None
    wrench_filter: (
        Annotated[
            WrenchFilter,
            Rule(
                description="what lies between the coupling's force and what the controller reads: a first-order "
                "filter, a delay, or both; none where the entry is missing",
                properties={"time_constant_s": _TIME},
                minProperties=1,
            ),
        ]
        | None
    ) = None

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

    gain_db: Annotated[float | None, Rule(minimum=0, maximum=1000)]
    phase_deg: Annotated[float | None, Rule(minimum=0, maximum=180)]
    delay_s: Annotated[float | None, Rule(minimum=0, maximum=1000)]
    modulus: Annotated[float, Rule(minimum=0, maximum=10)]
    worst: Mapping[
        Annotated[str, {"enum": ("gain_db", "phase_deg", "delay_s", "modulus")}],
        Mapping[str, Annotated[float, Rule(minimum=0, maximum=1e9)]],
    ]

    def __post_init__(self) -> None:
        for name in ("gain_db", "phase_deg", "delay_s"):
            if getattr(self, name) == math.inf:
                object.__setattr__(self, name, None)
        object.__setattr__(self, "worst", FrozenDict({key: FrozenDict(case) for key, case in self.worst.items()}))


_SI_RANGE = re.compile(r"\[([^],]+), ([^],]+)\] (N/m|s)(?![^,;])")


def _shown_range(found: re.Match[str]) -> str:
    low, high, unit = found.groups()
    scale, shown = (1e-3, "N/mm") if unit == "N/m" else (1e3, "ms")
    return f"[{scale * float(low):.5g}, {scale * float(high):.5g}] {shown}"


@dataclass(frozen=True, kw_only=True)
class Proof:
    """What is proved, by which method, over which set; `numbers` are its figures by name, if it has any."""

    claim: Text
    method: Text
    over: str | Mapping[str, Any]
    numbers: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        if self.numbers is not None:
            freeze(self, "numbers")

    def over_text(self) -> str:
        """Return the set as people read it: stiffnesses in N/mm and times in ms, where the file has SI."""
        if isinstance(self.over, str):
            return _SI_RANGE.sub(_shown_range, self.over)
        return ", ".join(f"{name} {value}" for name, value in self.over.items())


@dataclass(frozen=True, kw_only=True)
class ProvenRegion:
    """How far a modulus margin, and stability with it, is proved at all frequencies, in contact and in free space.

    `over` names what varies in its whole range, the rest is nominal. `modulus` is the swept one less the share `slack`.
    `share` of the set is proved, and all of it for K_e inside `environment_stiffness_n_per_m`; 1 is all of it.
    `cells` of plants and `arcs` of the unit circle were looked at in `run_time_s`; `budget_s` ends the attempt. Both
    are work counted at a fixed speed, not read from a clock: the same input gives the same file.
    """

    over: Annotated[
        tuple[Text, ...], Rule(description="What varies in its whole range; the rest is nominal", minItems=1)
    ]
    modulus: Annotated[Share, Rule(description="What |1 + L| is proved to exceed at both break points")]
    slack: Annotated[Share, Rule(description="Share of the swept modulus that was given away")]
    method: Text
    share: Annotated[float, Rule(description="Share of the set that is proved; 1 is all of it", minimum=0, maximum=1)]
    environment_stiffness_n_per_m: Annotated[
        Interval,
        Rule(items=_STIFFNESS, description="Where all of the set is proved"),
    ]
    cells: NotNegative
    arcs: NotNegative
    budget_s: Annotated[AboveZero, Rule(description="Run time that ends the attempt, counted like run_time_s")]
    run_time_s: Annotated[
        NotNegative, Rule(description="Run time of the proof, counted in work at 40 000 arcs a second")
    ]

    def __post_init__(self) -> None:
        check_interval("environment_stiffness_n_per_m", self.environment_stiffness_n_per_m)
        if not (0.0 < self.modulus < 1.0 and 0.0 < self.slack < 1.0 and 0.0 <= self.share <= 1.0):
            raise ParameterError("modulus", self.modulus, "modulus, slack and share between 0 and 1")
        if not (self.budget_s > 0.0 and self.run_time_s >= 0.0):
            raise ParameterError("budget_s", self.budget_s, "above 0, and no run time below 0")


_APPROACH = [{"required": ["approach_force_n"]}, {"required": ["approach_speed_m_s"]}]
_APPROACHED = "a domain that says how contact is approached: {} or both"
_ABOVE_ZERO = Rule(exclusiveMinimum=0)
_BAND = Rule(items=Rule(minimum=0, maximum=10000))
_Target = (
    Annotated[
        AdmittanceTarget,
        Rule(properties={"min_m_s_per_n": _ABOVE_ZERO, "band_hz": _BAND}, required=["min_m_s_per_n", "band_hz"]),
    ]
    | Annotated[
        NoiseLimit,
        Rule(
            properties={
                "max_speed_rms_m_s": _ABOVE_ZERO,
                "force_noise_rms_n": Rule(minimum=0),
                "position_noise_rms_m": Rule(minimum=0),
                "noise_spectrum": Rule(
                    description="How the force's noise is spread over frequency (one-sided density, any unit); white "
                    "without it",
                ),
            },
            required=["max_speed_rms_m_s", "force_noise_rms_n"],
        ),
    ]
    | Annotated[PassivityTarget, Rule(properties={"passive_below_hz": _ABOVE_ZERO})]
    | Annotated[MultiplicativeError, Rule(properties={"min_modulus": _ABOVE_ZERO})]
    | Annotated[ContactAtSpeed, Rule(properties={"max_force_n": _ABOVE_ZERO, "speed_m_s": _ABOVE_ZERO})]
    | Annotated[HeldByHand, Rule(properties={"min_modulus": _ABOVE_ZERO})]
)
Requirement = Annotated[
    float | bool | _Target,
    Rule(
        description="a number, true or false, {min_m_s_per_n, band_hz}, {max_speed_rms_m_s, force_noise_rms_n, "
        "position_noise_rms_m, noise_spectrum}, {passive_below_hz}, {min_modulus, points}, {max_force_n, speed_m_s, "
        "hand} or {min_modulus, mass_kg, damping_n_s_per_m, stiffness_n_per_m}",
        turning=Rule(
            description="a number, true or false, {min_rad_s_per_n_m, band_hz}, {max_speed_rms_rad_s, "
            "torque_noise_rms_n_m, angle_noise_rms_rad, noise_spectrum}, {passive_below_hz}, {min_modulus, points}, "
            "{max_torque_n_m, speed_rad_s, hand, hand_inertia_kg_m2} or "
            "{min_modulus, inertia_kg_m2, damping_n_m_s_per_rad, stiffness_n_m_per_rad}"
        ),
    ),
]
Asked = Mapping[str, Requirement]


@dataclass(frozen=True, kw_only=True)
class SoftRequirement:
    """What was asked at a price (N per share missed) and what was `achieved`, in the unit of what was asked.

    None where no finite limit exists.
    """

    asked: Annotated[AboveZero | _Target, Rule(description="a requirement")]
    soft_n: AboveZero
    achieved: Annotated[float | None, Rule(minimum=0)]

    def __post_init__(self) -> None:
        if self.achieved == math.inf:
            object.__setattr__(self, "achieved", None)


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """What was shown about the controller, and for which plants.

    `proved` holds for every plant that it names, `sampled` was looked for on many plants of the set and not found.
    `requirements` are those of x, y, z, `rotational_requirements` those of rx, ry, rz (rad, N·m), None without them.
    `soft` holds by axis what need not be met, and what was achieved, `continuous` what of the modulus is proved, `held`
    what of it while a hand holds the payload, `peaks` what no first contact exceeds, `bouncing` whether every
    contact comes to rest (None: earlier releases).
    `coupled` is of all axes together, None where one alone is known or asked. `bumper` is of a payload that is soft
    inside; all else is of one in one piece.
    """

    domain: Mapping[
        Axis,
        Annotated[
            AxisDomain,
            Rule(
                description=_APPROACHED.format("approach_force_n, approach_speed_m_s"),
                anyOf=_APPROACH,
                turning=Rule(description=_APPROACHED.format("approach_torque_n_m, approach_speed_rad_s")),
            ),
        ],
    ]
    sample_time_s: Period
    requirements: Mapping[str, Requirement]
    proved: tuple[Proof, ...]
    margins: Mapping[Axis, AxisMargins]
    rotational_requirements: Mapping[str, Requirement] | None = None
    sampled: tuple[Proof, ...] = ()
    soft: Mapping[Axis, Mapping[str, SoftRequirement]] | None = None
    continuous: Mapping[Axis, Annotated[tuple[ProvenRegion, ...], Rule(minItems=1)]] | None = None
    held: Mapping[Axis, HeldProof] | None = None
    peaks: Mapping[Axis, PeakProof] | None = None
    bouncing: Mapping[Axis, BouncingProof] | None = None
    coupled: CoupledCertificate | None = None
    bumper: BumperRecord | None = None

    def __post_init__(self) -> None:
        freeze(self, "domain", "requirements", "margins")
        for name in ("continuous", "held", "peaks", "bouncing", "rotational_requirements", "soft"):
            if getattr(self, name) is not None:
                freeze(self, name)

    @property
    def proved_further(self) -> tuple[Proof, ...]:
        """What `held`, `peaks` and `bouncing` say is proved, in words."""
        held = tuple(
            Proof(
                claim=f"axis {name}: stable with |1 + L| > {each.modulus:.4g} while a hand holds the payload",
                method=each.method,
                over=share_of(
                    f"{each.hand.describe(turning=name in ROTATIONAL_AXES)}, on every certified surface and off it",
                    each.share,
                ),
                numbers={"share": each.share, "cells": each.cells, "arcs": each.arcs},
            )
            for name, each in (self.held or {}).items()
            if each.share > 0.0
        )
        peaks = tuple(
            Proof(
                claim=f"axis {name}: no first contact exceeds {each.force_n:.4g} {axis_units(name).force}",
                method=each.method,
                over=share_of(
                    "every K_e and M_p of the domain and every moment of the touch, everything else nominal",
                    each.share,
                ),
                numbers={"share": each.share, "staying": each.staying, "cells": each.cells},
            )
            for name, each in (self.peaks or {}).items()
            if each.share > 0.0
        )
        bumper = () if self.bumper is None else self.bumper.proved()
        return (*held, *peaks, *self._resting, *(Proof(**each) for each in bumper))

    @property
    def sampled_further(self) -> tuple[Proof, ...]:
        """What `bumper` says was sampled, in words."""
        return () if self.bumper is None else tuple(Proof(**each) for each in self.bumper.sampled())

    @property
    def _resting(self) -> tuple[Proof, ...]:
        return tuple(
            Proof(
                claim=f"axis {name}: every contact comes to rest, whatever it begins with",
                method=each.method,
                over=share_of(
                    f"every {', '.join(SYMBOLS[key] for key in each.over)} of the domain, everything else nominal; "
                    f"every constant {axis_units(name).force_name} above 0",
                    each.share,
                ),
                numbers={"share": each.share, "cells": each.cells, "arcs": each.arcs},
            )
            for name, each in (self.bouncing or {}).items()
            if each.share > 0.0
        )

    def requirements_of(self, axis: str) -> Asked | None:
        """Return what was asked of one axis; None for a rotational one of which the file does not say it."""
        return self.rotational_requirements if axis in ROTATIONAL_AXES else self.requirements
