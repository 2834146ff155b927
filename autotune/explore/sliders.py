"""Ranges of the sliders: the gains within their bounds, and the plant around the identified one."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.tuning.bounds import bounds_of, linear_variables
from problems.design.evaluation import CustomRequirement
from problems.design.problem import DesignProblem
from problems.design.requirements import Requirements
from problems.design.uncertainty import ALWAYS_UNCERTAIN, MASS, STIFFNESS, SYMBOLS, Scenario
from problems.model.plant_parameters import PARAMETERS

STEPS = 1000
ASKED = "asked-"
"""What the name of a requirement's slider begins with."""
_SURFACES, _PAYLOADS, _FACTOR, _SPEEDS = 4.0, 2.0, 3.0, 2.0
# The least range of a damping, as a share of that of the payload on the coupling.
_DAMPING_SHARE = 0.2
_LEAST_DELAY_SAMPLES = 6.0
_SAME = 1e-9
# How much more or less of a requirement can be asked for, and how near its limit.
_ASKED_FACTOR, _BELOW_LIMIT = 5.0, 0.98
_GAINS = {
    "mass": ("M_a", "admittance mass"),
    "damping": ("B_a", "admittance damping"),
    "lead_s": ("K_l", "lead gain"),
    "feedback_damping_s": ("B_fb", "feedback damping"),
    "velocity_filter_rad_per_s": ("ω_v", "velocity filter"),
    "acceleration_filter_rad_per_s": ("ω_a", "acceleration filter"),
    "compensation_mass_kg": ("P̂", "compensated mass"),
    "biquad_zero_s": ("τ_z", "biquad zero"),
    "biquad_zero_damping_ratio": ("ζ_z", "damping of the zero"),
    "biquad_pole_s": ("τ_p", "biquad pole"),
    "biquad_pole_damping_ratio": ("ζ_p", "damping of the pole"),
}
# As on the terminal and in reports, in ms.
_TIMES = ("lead_s", "feedback_damping_s", "biquad_zero_s", "biquad_pole_s")
_LABELS = {STIFFNESS: "surface stiffness", MASS: "payload"}
_PLANT = (
    *(STIFFNESS, MASS, "coupling_stiffness_n_per_m", "coupling_damping_n_s_per_m", "drag_n_s_per_m"),
    *("delay_s", "robot_bandwidth_hz"),
)


@dataclass(frozen=True, kw_only=True)
class SliderRange:
    """A number from `low` to `high` in SI, moved by equal ratios where `logarithmic`, shown times `scale` in `unit`."""

    name: str
    symbol: str
    label: str
    unit: str
    low: float
    high: float
    logarithmic: bool
    scale: float = 1.0

    @property
    def title(self) -> str:
        """The text above its slider."""
        return f"{self.symbol} {self.label}" + (f" [{self.unit}]" if self.unit else "")

    @property
    def ends(self) -> tuple[float, float]:
        """The positions of its ends."""
        return self.position(self.low), self.position(self.high)

    def position(self, value: float) -> float:
        """Return where on its way a value lies."""
        return math.log10(self.scale * value) if self.logarithmic else self.scale * value

    def value(self, position: float) -> float:
        """Return the value of a position, inside the range and with the six digits that a file is given."""
        found = float(f"{(10.0**position if self.logarithmic else position) / self.scale:.6g}")
        return min(max(found, self.low), self.high)


def build_gain_sliders(problem: DesignProblem, axis: str) -> tuple[SliderRange, ...]:
    """Return a range for each variable of the problem, in their order; one whose bounds coincide cannot be moved."""
    units = axis_units(axis)
    of_axis = {"mass": units.mass, "damping": units.damping, "compensation_mass_kg": units.mass}
    return tuple(
        SliderRange(
            name=name,
            symbol=_GAINS[name][0],
            label=_GAINS[name][1],
            unit=of_axis.get(name, "ms" if name in _TIMES else "" if name.endswith("_ratio") else "rad/s"),
            low=low,
            high=high,
            logarithmic=not linear,
            scale=1e3 if name in _TIMES else 1.0,
        )
        for name, (low, high), linear in zip(
            problem.variables, bounds_of(problem).tolist(), linear_variables(problem).tolist(), strict=True
        )
    )


def build_plant_sliders(problem: DesignProblem, axis: str) -> tuple[SliderRange, ...]:
    """Return ranges for the plant that is looked at: beyond the ranges of the problem too, to see what lies there."""
    units = axis_units(axis)
    return tuple(
        SliderRange(
            name=name,
            symbol=SYMBOLS[name],
            label=_LABELS.get(name, PARAMETERS[name].label),
            unit=units.shown(PARAMETERS[name].kind)[1],
            low=low,
            high=high,
            logarithmic=low > 0.0,
            scale=units.shown(PARAMETERS[name].kind)[0],
        )
        for name in _PLANT
        for low, high in [_plant_range(problem, name)]
    )


def _plant_range(problem: DesignProblem, name: str) -> tuple[float, float]:
    if name in ALWAYS_UNCERTAIN:
        low, high = problem.plants.ranges[name]
        factor = _PAYLOADS if name == MASS else _SURFACES
        return low / factor, high * factor
    low, high = problem.plants.range_of(name)
    if name == "coupling_stiffness_n_per_m":
        return low / _FACTOR, high * _FACTOR
    if name == "robot_bandwidth_hz":
        return low / _SPEEDS, high * _SPEEDS
    if name == "delay_s":
        return 0.0, max(_FACTOR * high, _LEAST_DELAY_SAMPLES * problem.sample_time_s)
    critical = math.sqrt(problem.plants.nominal.coupling.stiffness_n_per_m * problem.plants.payload_mass_kg[1])
    return 0.0, max(_FACTOR * high, _DAMPING_SHARE * critical)


def nominal_values(problem: DesignProblem) -> dict[str, float]:
    """Return the plant that is looked at first: the middle of the ranges of K_e and M_p, the rest nominal."""
    soft, stiff = problem.plants.environment_stiffness_n_per_m
    middle = {STIFFNESS: math.sqrt(soft * stiff), MASS: 0.5 * sum(problem.plants.payload_mass_kg)}
    return {name: middle[name] if name in middle else problem.plants.nominal_values()[name] for name in _PLANT}


def scenario_at(problem: DesignProblem, values: Mapping[str, float]) -> Scenario:
    """Return the plant of these values as a scenario, in which what is nominal stays unsaid."""
    nominal = problem.plants.nominal_values()
    further = {
        name: value
        for name, value in values.items()
        if name not in ALWAYS_UNCERTAIN and abs(value - nominal[name]) > 1e-5 * abs(nominal[name]) + _SAME
    }
    return Scenario(
        environment_stiffness_n_per_m=values["environment_stiffness_n_per_m"],
        payload_mass_kg=values["payload_mass_kg"],
        **further,
    )


def build_requirement_sliders(asked: Requirements, axis: str) -> tuple[SliderRange, ...]:
    """Return a range around the threshold of each requirement that is asked, in the unit in which it is shown.

    One that another package computes as a ratio has no threshold of its own, and gets none.
    """
    turning = axis in ROTATIONAL_AXES
    return tuple(
        SliderRange(
            name=f"{ASKED}{name}",
            symbol=kind.title[:1].upper() + kind.title[1:],
            label="at most" if kind.is_upper_limit else "at least",
            unit=kind.unit_on(turning=turning),
            low=shown / _ASKED_FACTOR,
            high=min(shown * _ASKED_FACTOR, max(limit, shown)),
            logarithmic=True,
        )
        for name in asked.asked()
        for kind in [asked.kind(name)]
        if not isinstance(kind, CustomRequirement)
        for shown in [float(f"{kind.shown_scale * asked.threshold(name):.6g}")]
        for limit in [math.inf if kind.must_be_below is None else _BELOW_LIMIT * kind.must_be_below[0]]
    )


def shown_thresholds(asked: Requirements) -> dict[str, float]:
    """Return the threshold of each requirement as its slider shows it, by the slider's name."""
    return {
        f"{ASKED}{name}": float(f"{asked.kind(name).shown_scale * asked.threshold(name):.6g}") for name in asked.asked()
    }


def requirements_at(asked: Requirements, shown: Mapping[str, float]) -> Requirements:
    """Return the requirements with the thresholds `shown` of the sliders; one that was not moved stays as it is."""
    before = shown_thresholds(asked)
    for name, value in asked.asked().items():
        key, kind = f"{ASKED}{name}", asked.kind(name)
        if key in shown and shown[key] != before[key]:
            threshold = float(f"{shown[key] / kind.shown_scale:.9g}")
            asked = asked.with_asked(name, kind.with_threshold(value, threshold))
    return asked
