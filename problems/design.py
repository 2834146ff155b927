"""The design problem as a value: what may vary, what must hold, what is minimised; it needs no solver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ._checks import interval, non_negative, positive
from .contact import Approach
from .controller import PAPER_VELOCITY_FILTER_RAD_PER_S, AdmittanceController
from .errors import ParameterError
from .plant import Coupling, Environment, Payload, Plant
from .robot import RobotModel
from .robot_variation import bandwidth_hz, damping_ratio, has_damping_ratio
from .uncertainty import ALWAYS_UNCERTAIN, FURTHER_UNCERTAIN, SYMBOLS, Ellipsoid, Scenario, Uncertainty, check_robot

FloatArray = NDArray[np.float64]
Objective = Literal["contact_force", "sensor_force"]

# Free variables in the order of the design vector. The bounds hold the paper's cells (10..20 kg, 550..2000 N s/m,
# 0..0.025 s, 0..0.0075 s) and little more on the side of small mass and large lead: K_l/M_a is what sensor noise is
# multiplied by on its way to the velocity command, and the measured limit of K_l was half the modelled one.
VARIABLES = ("mass", "damping", "lead_s", "feedback_damping_s")
DEFAULT_BOUNDS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"mass": (5.0, 100.0), "damping": (100.0, 10000.0), "lead_s": (0.0, 0.03), "feedback_damping_s": (0.0, 0.05)}
)
# A nominal value that is the end of its own range may differ from it by the rounding of a unit.
_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class AdmittanceTarget:
    """|G(j2πf)| ≥ `min_m_s_per_n` for f in `band_hz` (MODEL.md, "Free-space admittance target")."""

    min_m_s_per_n: float = 7e-4
    band_hz: tuple[float, float] = (0.1, 2.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "min_m_s_per_n", positive("min_m_s_per_n", self.min_m_s_per_n))
        object.__setattr__(self, "band_hz", interval("band_hz", self.band_hz))
        positive("band_hz", self.band_hz[0])


@dataclass(frozen=True, kw_only=True)
class Requirements:
    """What every scenario must meet; None asks for nothing. Stability is always asked.

    `max_peak_force_n` limits the force on the environment, whatever the objective is.
    """

    modulus_margin: float | None = 0.5
    gain_margin_db: float | None = 6.0
    phase_margin_deg: float | None = 30.0
    delay_margin_s: float | None = 1e-3
    decay_rate_per_s: float | None = None
    max_peak_force_n: float | None = None
    free_space_admittance: AdmittanceTarget | None = field(default_factory=AdmittanceTarget)

    def __post_init__(self) -> None:
        for name in (
            "modulus_margin",
            "gain_margin_db",
            "phase_margin_deg",
            "delay_margin_s",
            "decay_rate_per_s",
            "max_peak_force_n",
        ):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, positive(name, value))
        if self.modulus_margin is not None and self.modulus_margin >= 1.0:
            raise ParameterError(
                "modulus_margin", self.modulus_margin, "below 1 (|1 + L| tends to 1 at high frequency)"
            )


@dataclass(frozen=True, kw_only=True)
class DesignProblem:
    """One axis: nominal plant, the set that must all be safe, approach, bounds, requirements and objective.

    `uncertain` holds ranges of further parameters by name (`problems.uncertainty.FURTHER_UNCERTAIN`), around the
    nominal values; `ellipsoid` cuts them down to a confidence set. Without them the set is K_e × M_p.
    """

    robot: RobotModel
    coupling: Coupling
    drag_n_s_per_m: float
    environment_stiffness_n_per_m: tuple[float, float]
    payload_mass_kg: tuple[float, float]
    sample_time_s: float
    environment_damping_n_s_per_m: float = 0.0
    approach: Approach = field(default_factory=lambda: Approach(force_n=30.0))
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    requirements: Requirements = field(default_factory=Requirements)
    objective: Objective = "contact_force"
    velocity_filter_rad_per_s: float = PAPER_VELOCITY_FILTER_RAD_PER_S
    uncertain: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ellipsoid: Ellipsoid | None = None
    uncertainty: Uncertainty = field(init=False)

    def __post_init__(self) -> None:
        unknown = sorted(set(self.bounds) - set(VARIABLES))
        if unknown:
            raise ParameterError("bounds", unknown, f"given for {', '.join(VARIABLES)} only")
        bounds = {name: interval(name, self.bounds.get(name, DEFAULT_BOUNDS[name])) for name in VARIABLES}
        for name in ("mass", "damping"):
            positive(f"lower bound of {name}", bounds[name][0])
        object.__setattr__(self, "bounds", MappingProxyType(bounds))
        stiffness = interval("environment_stiffness_n_per_m", self.environment_stiffness_n_per_m)
        positive("environment_stiffness_n_per_m", stiffness[0])
        object.__setattr__(self, "environment_stiffness_n_per_m", stiffness)
        mass = interval("payload_mass_kg", self.payload_mass_kg)
        positive("payload_mass_kg", mass[0])
        object.__setattr__(self, "payload_mass_kg", mass)
        object.__setattr__(self, "sample_time_s", positive("sample_time_s", self.sample_time_s))
        non_negative("drag_n_s_per_m", self.drag_n_s_per_m)
        non_negative("environment_damping_n_s_per_m", self.environment_damping_n_s_per_m)
        target = self.requirements.free_space_admittance
        if target is not None and target.band_hz[1] >= 0.5 / self.sample_time_s:
            raise ParameterError("free_space_admittance.band_hz", target.band_hz, "below half the sampling rate")
        self._check_uncertainty()

    def _check_uncertainty(self) -> None:
        for name in ALWAYS_UNCERTAIN:
            if name in self.uncertain:
                raise ParameterError("uncertain", name, "given as the problem's own range")
        check_robot(self.robot, self.uncertain)
        known = {name: getattr(self, name) for name in ALWAYS_UNCERTAIN}
        uncertainty = Uncertainty(ranges={**known, **self.uncertain}, ellipsoid=self.ellipsoid)
        for name, value in self.nominal().items():
            low, high = uncertainty.ranges.get(name, (value, value))
            if not low * (1.0 - _ROUNDING) <= value <= high * (1.0 + _ROUNDING):
                raise ParameterError(f"uncertain {name}", (low, high), f"around the nominal value {value:g}")
        object.__setattr__(self, "uncertainty", uncertainty)
        further = {name: pair for name, pair in uncertainty.ranges.items() if name in FURTHER_UNCERTAIN}
        object.__setattr__(self, "uncertain", MappingProxyType(further))

    def nominal(self) -> dict[str, float]:
        """Return the nominal values of what may be uncertain beyond K_e and M_p, as far as the robot has them."""
        values = {
            "coupling_stiffness_n_per_m": self.coupling.stiffness_n_per_m,
            "coupling_damping_n_s_per_m": self.coupling.damping_n_s_per_m,
            "drag_n_s_per_m": self.drag_n_s_per_m,
            "environment_damping_n_s_per_m": self.environment_damping_n_s_per_m,
            "delay_s": self.robot.delay_s,
            "robot_bandwidth_hz": bandwidth_hz(self.robot),
        }
        return {**values, "robot_damping_ratio": damping_ratio(self.robot)} if has_damping_ratio(self.robot) else values

    def plant(self, scenario: Scenario) -> Plant:
        """Return the plant of one scenario, in contact."""
        return scenario.plant(self.nominal_plant())

    def nominal_plant(self) -> Plant:
        """Return the nominal plant, touching the softest surface with the lightest payload."""
        return Plant(
            robot=self.robot,
            coupling=self.coupling,
            payload=Payload(mass_kg=self.payload_mass_kg[0], drag_n_s_per_m=self.drag_n_s_per_m),
            environment=Environment(
                stiffness_n_per_m=self.environment_stiffness_n_per_m[0],
                damping_n_s_per_m=self.environment_damping_n_s_per_m,
            ),
        )

    def scenarios(self, stiffness_count: int, mass_count: int) -> tuple[Scenario, ...]:
        """Return a grid over K_e × M_p at the nominal plant, ends included.

        Stiffness is spaced by equal ratios, mass by equal steps. A range that is one value gives one point; any other
        needs a count of 2 or more, for its ends.
        """
        if min(stiffness_count, mass_count) < 2:
            raise ParameterError(
                "scenario counts", (stiffness_count, mass_count), "at least 2, for the ends of a range"
            )
        low, high = self.environment_stiffness_n_per_m
        stiffness = np.geomspace(low, high, stiffness_count if high > low else 1)
        # geomspace reproduces the ends only to rounding; the ends are what was promised.
        stiffness[0], stiffness[-1] = (low, high) if high > low else (low, low)
        mass_low, mass_high = self.payload_mass_kg
        masses = np.linspace(mass_low, mass_high, mass_count if mass_high > mass_low else 1)
        return tuple(
            Scenario(environment_stiffness_n_per_m=float(k), payload_mass_kg=float(m))
            for m in masses
            for k in stiffness
        )

    def controller(self, design: Sequence[float] | FloatArray) -> AdmittanceController:
        """Return the controller of a design vector (M_a, B_a, K_l, B_fb).

        Feedback damping too small to be a value in seconds is none at all (MODEL.md, erratum 2).
        """
        feedback = float(design[3])
        return AdmittanceController(
            mass_kg=float(design[0]),
            damping_n_s_per_m=float(design[1]),
            lead_s=float(design[2]),
            feedback_damping_s=feedback if feedback >= 1e-4 else 0.0,
            velocity_filter_rad_per_s=self.velocity_filter_rad_per_s,
        )

    def __str__(self) -> str:
        """Return the problem as a table for people: what is free, what is uncertain, what is asked."""
        asked = self.requirements
        target = asked.free_space_admittance
        lines = [("minimise", f"the peak {self.objective.replace('_', ' ')}, worst over the whole uncertainty")]
        approach = self.approach
        told = f"{approach.speed_m_s:g} m/s" if approach.force_n is None else f"{approach.force_n:g} N"
        lines.append(("approach", told))
        lines += [(f"free: {name}", f"{low:g} to {high:g}") for name, (low, high) in self.bounds.items()]
        lines += [
            (f"uncertain: {SYMBOLS[name]}", f"{low:g} to {high:g}  ({name})")
            for name, (low, high) in self.uncertainty.ranges.items()
        ]
        if self.ellipsoid is not None:
            names = ", ".join(SYMBOLS[name] for name in self.ellipsoid.names)
            lines.append(("cut by", f"the {100.0 * self.ellipsoid.level:g} % confidence set of {names}"))
        lines += [
            (f"nominal: {SYMBOLS[name]}", f"{value:g}")
            for name, value in self.nominal().items()
            if name not in self.uncertain
        ]
        lines.append(("sample time", f"{self.sample_time_s:g} s"))
        numbers = {f.name: getattr(asked, f.name) for f in fields(asked) if f.name != "free_space_admittance"}
        lines += [(f"required: {name}", f"{value:g}") for name, value in numbers.items() if value is not None]
        if target is not None:
            low, high = target.band_hz
            lines.append(("required: free-space admittance", f"{target.min_m_s_per_n:g} from {low:g} to {high:g} Hz"))
        return "\n".join(f"{name:36}{value}" for name, value in lines)
