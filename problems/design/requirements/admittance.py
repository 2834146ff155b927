"""The free-space admittance that a person who leads the payload feels: the least |G| over a band of frequencies."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from ..._checks import interval, positive
from ...arrays import FloatArray
from ...errors import ParameterError
from ...model.controller import AdmittanceController
from ...model.response import PlantResponse, free_space_admittance, join_wrench, plant_response, rendered_admittance
from ...model.robot import RobotModel
from ...model.sampled import SampledPlant
from ..stable_design import Gradient, PreparedPlants, StableDesign
from ..uncertainty import Scenario
from .base import Requirement

_BAND_POINTS = 40
_AROUND_A_DIP = np.linspace(-2.0, 2.0, 17)


@dataclass(frozen=True, kw_only=True)
class AdmittanceTarget:
    """|G(j2πf)| ≥ `min_m_s_per_n` for f in `band_hz` (docs/method.md, "The loop").

    `is_default` marks a target that nobody asked for: it may follow the cell (`autotune.tuning.defaults`). It is no
    part of what is asked, so it is neither compared nor written.
    """

    # Made anew, so that files say these numbers also where they are the usual ones.
    min_m_s_per_n: float = field(default_factory=lambda: 7e-4)
    band_hz: tuple[float, float] = field(default_factory=lambda: (0.1, 2.0))
    is_default: bool = field(default=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "min_m_s_per_n", positive("min_m_s_per_n", self.min_m_s_per_n))
        object.__setattr__(self, "band_hz", interval("band_hz", self.band_hz))
        positive("band_hz", self.band_hz[0])


class AdmittanceRequirement(Requirement[AdmittanceTarget]):
    """min |G| over the band, of the robot alone: the payload does not enter G."""

    name, title = "free_space_admittance", "free-space admittance"
    asked_as = AdmittanceTarget
    depends_on: ClassVar[Literal["loop", "robot", "contact"]] = "robot"
    unit, turning_unit = "m/s/N", "rad/s/(N·m)"
    lever_power = -2

    def threshold(self, asked: AdmittanceTarget) -> float:
        """Return the least |G| [m/s/N]."""
        return asked.min_m_s_per_n

    def with_threshold(self, asked: AdmittanceTarget, threshold: float) -> AdmittanceTarget:
        """Return the same band with another |G|."""
        return replace(asked, min_m_s_per_n=threshold)

    def read(self, entry: Mapping[str, Any]) -> AdmittanceTarget:
        """Return the target of plain data."""
        return AdmittanceTarget(**{**entry, "band_hz": tuple(map(float, entry["band_hz"]))})

    def check_sampling(self, asked: AdmittanceTarget, sample_time_s: float) -> None:
        """Raise ParameterError for a band that reaches the Nyquist frequency."""
        if asked.band_hz[1] >= 0.5 / sample_time_s:
            raise ParameterError("free_space_admittance.band_hz", asked.band_hz, "below half the sampling rate")

    def describe(self, asked: AdmittanceTarget, *, turning: bool = False) -> str:
        """Return target and band in words."""
        low, high = asked.band_hz
        return f"{asked.min_m_s_per_n:.4g} {self.unit_on(turning=turning)}, {low:g} to {high:g} Hz"

    def count(self, prepared: PreparedPlants) -> int:
        """Return 1: all robots together."""
        del prepared
        return 1

    def achieved(self, asked: AdmittanceTarget, design: StableDesign, row: int) -> float:
        """Return the least |G| of all robots [m/s/N]."""
        del row
        response = target_response(design.prepared, asked)
        gain = np.abs(rendered_admittance(response, design.controller, design.prepared.sample_time_s))
        return float(np.min(gain))

    def gradient(self, asked: AdmittanceTarget, design: StableDesign, row: int) -> Gradient | None:
        """Differentiate |G| at the frequency where it is least, of the robot where that is."""
        from ..gradients import admittance_gradient  # noqa: PLC0415 - CasADi takes a second to import

        del row
        robots = design.prepared.robots.values()
        found = [admittance_gradient(plant, design.controller, asked.band_hz) for plant, _ in robots]
        return min(found, key=lambda each: each.value)

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return any scenario; `worst_scenario` knows better."""
        del row
        return prepared.scenarios[0]

    def worst_scenario(self, asked: AdmittanceTarget, design: StableDesign) -> Scenario:
        """Return a scenario of the robot of the least |G|."""
        robots = design.prepared.robots.values()
        return min(robots, key=lambda each: smallest_admittance(each[0], design.controller, asked.band_hz))[1]


def target_response(prepared: PreparedPlants, target: AdmittanceTarget) -> PlantResponse:
    """Return the responses of all different robots over the band, one after the other."""
    return prepared.once(("free_space_admittance", target.band_hz), lambda: _target_response(prepared, target.band_hz))


def _target_response(prepared: PreparedPlants, band_hz: tuple[float, float]) -> PlantResponse:
    robots = prepared.robots.items()
    found = [plant_response(plant, band_frequencies(robot, band_hz)) for (robot, _), (plant, _) in robots]
    if len(found) == 1:
        return found[0]
    return PlantResponse(
        frequency_rad_per_s=np.concatenate([each.frequency_rad_per_s for each in found]),
        z=np.concatenate([each.z for each in found]),
        force=np.concatenate([each.force for each in found]),
        position=np.concatenate([each.position for each in found]),
        wrench=join_wrench(found),
    )


def smallest_admittance(sampled: SampledPlant, controller: AdmittanceController, band_hz: tuple[float, float]) -> float:
    """Return min |G| [m/s/N] over the band (ends included)."""
    omega = band_frequencies(sampled.plant.robot, band_hz)
    return float(np.min(np.abs(free_space_admittance(sampled, controller, omega))))


def band_frequencies(robot: RobotModel, band_hz: tuple[float, float]) -> FloatArray:
    """Return the frequencies [rad/s] at which a band is evaluated: evenly, ends included, and around dips of r(s)."""
    low, high = 2.0 * np.pi * band_hz[0], 2.0 * np.pi * band_hz[1]
    # |G| is smooth but for lightly damped zeros of the robot.
    zeros = [zero for zero in np.roots(robot.numerator) if low <= zero.imag <= high]
    dips = [zero.imag + max(abs(zero.real), 1e-4 * zero.imag) * _AROUND_A_DIP for zero in zeros]
    omega = np.concatenate([np.geomspace(low, high, _BAND_POINTS), *dips])
    return np.unique(np.clip(omega, low, high))
