"""The design problem as a value: what may vary, what must hold, what is minimised; it needs no solver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .._checks import interval, positive
from ..arrays import FloatArray
from ..contact.transient import Approach
from ..errors import ParameterError
from ..frozen import FrozenDict
from ..model.controller import (
    PAPER_VELOCITY_FILTER_RAD_PER_S,
    SMALLEST_FEEDBACK_DAMPING_S,
    AdmittanceController,
    check_feedback_damping,
)
from ..model.plant import Plant
from .objectives import CONTACT_FORCE, Objective, PeakObjective
from .requirements import AdmittanceTarget, MultiplicativeError, NoiseLimit, PassivityTarget, Requirements
from .uncertainty import SYMBOLS, PlantSet, Scenario

__all__ = [
    "BIQUAD_VARIABLES",
    "CONTROLLER_VARIABLES",
    "DEFAULT_BOUNDS",
    "FURTHER_VARIABLES",
    "VARIABLES",
    "AdmittanceTarget",
    "DesignProblem",
    "MultiplicativeError",
    "NoiseLimit",
    "PassivityTarget",
    "Requirements",
]

# The variables that are always free, in the order of the design vector. The bounds hold the paper's cells (10..20 kg,
# 550..2000 N s/m, 0..0.025 s, 0..0.0075 s) and little more on the side of small mass and large lead: K_l/M_a is what
# sensor noise is multiplied by on its way to the velocity command, and the measured limit of K_l was half the modelled.
VARIABLES = ("mass", "damping", "lead_s", "feedback_damping_s")
DEFAULT_BOUNDS: Mapping[str, tuple[float, float]] = FrozenDict(
    {"mass": (5.0, 100.0), "damping": (100.0, 10000.0), "lead_s": (0.0, 0.03), "feedback_damping_s": (0.0, 0.05)}
)
FURTHER_VARIABLES = ("velocity_filter_rad_per_s", "acceleration_filter_rad_per_s", "compensation_mass_kg")
"""Variables that are free on request, in the order in which they follow: ω_v, ω_a, P̂."""
BIQUAD_VARIABLES = ("biquad_zero_s", "biquad_zero_damping_ratio", "biquad_pole_s", "biquad_pole_damping_ratio")
"""Variables of the structure with a biquad, free together: τ_z, ζ_z, τ_p, ζ_p."""
CONTROLLER_VARIABLES = (*VARIABLES, *FURTHER_VARIABLES, *BIQUAD_VARIABLES)
"""All of them, in the order of `AdmittanceController.numbers`."""
# A pole that is damped less rings; a zero that is damped more makes the payload light in one band and heavy below it.
_BIQUAD_ZERO_DAMPING, _BIQUAD_POLE_DAMPING = (0.05, 1.5), (0.25, 3.0)
_MAY_BE_ZERO = ("lead_s", "feedback_damping_s", "compensation_mass_kg")
# A nominal value that is the end of its own range may differ from it by the rounding of a unit.
_ROUNDING = 1e-9


def biquad_bounds(sample_time_s: float, slowest_rad_per_s: float) -> dict[str, tuple[float, float]]:
    """Return the usual bounds of a biquad that is stepped at h: its corners lie above the slowest one and below 1/h."""
    corners = (sample_time_s, max(1.0 / slowest_rad_per_s, 2.0 * sample_time_s))
    return dict(zip(BIQUAD_VARIABLES, (corners, _BIQUAD_ZERO_DAMPING, corners, _BIQUAD_POLE_DAMPING), strict=True))


@dataclass(frozen=True, kw_only=True)
class DesignProblem:
    """One axis: the plants that must all be safe, approach, bounds, requirements and objective.

    `bounds` of `FURTHER_VARIABLES` and of all `BIQUAD_VARIABLES` make those free too.
    """

    plants: PlantSet
    sample_time_s: float
    approach: Approach = field(default_factory=lambda: Approach(force_n=30.0))
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    requirements: Requirements = field(default_factory=Requirements)
    objective: Objective = CONTACT_FORCE
    velocity_filter_rad_per_s: float = PAPER_VELOCITY_FILTER_RAD_PER_S

    def __post_init__(self) -> None:
        self._check_bounds()
        object.__setattr__(self, "sample_time_s", positive("sample_time_s", self.sample_time_s))
        for requirement, asked in self.requirements.of("loop", "robot", "contact"):
            requirement.check_sampling(asked, self.sample_time_s)
        self._check_prices()
        self._check_plants()

    def _check_prices(self) -> None:
        """Refuse prices in newtons beside an objective that is no force."""
        prices = self.requirements.soft_n
        if prices and not isinstance(self.objective, PeakObjective):
            must = f"left out: these are newtons of peak force, and the objective is {self.objective.name}"
            raise ParameterError("soft_n", dict(prices), must)

    def _check_bounds(self) -> None:
        unknown = sorted(set(self.bounds) - {*CONTROLLER_VARIABLES})
        if unknown:
            raise ParameterError("bounds", unknown, f"given for {', '.join(CONTROLLER_VARIABLES)} only")
        given = {**DEFAULT_BOUNDS, **self.bounds}
        bounds = {name: interval(name, given[name]) for name in CONTROLLER_VARIABLES if name in given}
        for name in bounds:
            if name not in _MAY_BE_ZERO:
                positive(f"lower bound of {name}", bounds[name][0])
        missing = [name for name in BIQUAD_VARIABLES if name not in bounds]
        if 0 < len(missing) < len(BIQUAD_VARIABLES):
            raise ParameterError("bounds", ", ".join(missing), "given too: the four of a biquad are free together")
        for value in bounds["feedback_damping_s"]:
            check_feedback_damping(value)
        if "acceleration_filter_rad_per_s" in bounds and bounds.get("compensation_mass_kg", (0.0, 0.0))[1] == 0.0:
            must = "left out unless compensation_mass_kg is free too (the filter is that of the compensation)"
            raise ParameterError("bounds", "acceleration_filter_rad_per_s", must)
        object.__setattr__(self, "bounds", FrozenDict(bounds))

    @property
    def variables(self) -> tuple[str, ...]:
        """The free variables in the order of the design vector: `VARIABLES`, then those that were made free."""
        return tuple(self.bounds)

    def _check_plants(self) -> None:
        """Refuse a nominal value outside of its range, and what reads the position beside a late wrench."""
        for name, value in self.plants.nominal_values().items():
            low, high = self.plants.range_of(name)
            if not low * (1.0 - _ROUNDING) <= value <= high * (1.0 + _ROUNDING):
                raise ParameterError(f"uncertain {name}", (low, high), f"around the nominal value {value:g}")
        self._check_wrench_delay()

    def _check_wrench_delay(self) -> None:
        """Refuse variables that let the law read the position beside a wrench that comes a delay late."""
        late = self.plants.range_of("wrench_delay_s")[1]
        for name in ("feedback_damping_s", "compensation_mass_kg"):
            if late > 0.0 and self.bounds.get(name, (0.0, 0.0))[1] > 0.0:
                must = "(0, 0) where the wrench comes with a pure delay (position and wrench are of different moments)"
                raise ParameterError(f"bounds of {name}", self.bounds[name], must)

    def plant(self, scenario: Scenario) -> Plant:
        """Return the plant of one scenario, in contact."""
        return scenario.plant(self.plants.nominal)

    def scenarios(self, stiffness_count: int, mass_count: int) -> tuple[Scenario, ...]:
        """Return a grid over K_e × M_p at the nominal plant, ends included.

        Stiffness is spaced by equal ratios, mass by equal steps. A range that is one value gives one point; any other
        needs a count of 2 or more, for its ends.
        """
        if min(stiffness_count, mass_count) < 2:
            raise ParameterError(
                "scenario counts", (stiffness_count, mass_count), "at least 2, for the ends of a range"
            )
        low, high = self.plants.environment_stiffness_n_per_m
        stiffness = np.geomspace(low, high, stiffness_count if high > low else 1)
        # geomspace reproduces the ends only to rounding; the ends are what was promised.
        stiffness[0], stiffness[-1] = (low, high) if high > low else (low, low)
        mass_low, mass_high = self.plants.payload_mass_kg
        masses = np.linspace(mass_low, mass_high, mass_count if mass_high > mass_low else 1)
        return tuple(
            Scenario(environment_stiffness_n_per_m=float(k), payload_mass_kg=float(m))
            for m in masses
            for k in stiffness
        )

    def controller(self, design: Sequence[float] | FloatArray) -> AdmittanceController:
        """Return the controller of a design vector, the values of `variables`.

        Feedback damping too small to be a value in seconds is none at all (docs/method.md, erratum 2).
        """
        mass, damping, lead, feedback = (float(value) for value in design[: len(VARIABLES)])
        further: dict[str, Any] = {"velocity_filter_rad_per_s": self.velocity_filter_rad_per_s}
        further |= {name: float(design[i]) for i, name in enumerate(self.variables) if i >= len(VARIABLES)}
        return AdmittanceController(
            mass_kg=mass,
            damping_n_s_per_m=damping,
            lead_s=lead,
            feedback_damping_s=feedback if feedback >= SMALLEST_FEEDBACK_DAMPING_S else 0.0,
            **further,
        )

    def parameters(
        self, designs: FloatArray, *, first: AdmittanceController | None = None, keeps_small: bool = False
    ) -> FloatArray:
        """Return the parameters (m, 7 or 11) of the controllers of designs (m, n), as `AdmittanceController` has them.

        The first of them, which may be built already, is checked as `controller` does. A feedback damping that is too
        small to be a value in seconds is none, unless asked to keep it (`keeps_small`): then all is continuous.
        """
        first = self.controller(designs[0]) if first is None else first
        out = np.tile(first.parameters(), (len(designs), 1))
        for values, name in zip(designs.T, self.variables, strict=True):
            is_cut = name == "feedback_damping_s" and not keeps_small
            least = SMALLEST_FEEDBACK_DAMPING_S if is_cut else -np.inf
            out[:, CONTROLLER_VARIABLES.index(name)] = np.where(values < least, 0.0, values)
        return out

    def __str__(self) -> str:
        """Return the problem as a table for people: what is free, what is uncertain, what is asked."""
        asked = self.requirements
        lines = [
            (
                self.objective.direction.replace("ize", "ise"),
                f"the {self.objective.title}, worst over the whole uncertainty",
            )
        ]
        approach = self.approach
        words = f"{approach.speed_m_s:g} m/s" if approach.force_n is None else f"{approach.force_n:g} N"
        lines.append(("approach", words))
        lines += [(f"free: {name}", f"{low:g} to {high:g}") for name, (low, high) in self.bounds.items()]
        lines += [
            (f"uncertain: {SYMBOLS[name]}", f"{low:g} to {high:g}  ({name})")
            for name, (low, high) in self.plants.ranges.items()
        ]
        ellipsoid = self.plants.ellipsoid
        if ellipsoid is not None:
            names = ", ".join(SYMBOLS[name] for name in ellipsoid.names)
            lines.append(("cut by", f"the {100.0 * ellipsoid.level:g} % confidence set of {names}"))
        lines += [
            (f"nominal: {SYMBOLS[name]}", f"{value:g}")
            for name, value in self.plants.nominal_values().items()
            if name not in self.plants.ranges
        ]
        lines.append(("sample time", f"{self.sample_time_s:g} s"))
        for name, value in asked.asked().items():
            price, requirement = asked.soft_n.get(name), asked.kind(name)
            words = requirement.describe(value)
            words = words if price is None else f"{words}, or {price:g} N per share missed"
            lines.append((f"{'required' if price is None else 'soft'}: {requirement.title}", words))
        return "\n".join(f"{name:36}{value}" for name, value in lines)
