"""Passivity of the port F → V: up to which frequency the controlled robot takes energy only."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from ..._checks import positive
from ...errors import ParameterError
from ...stability.passivity import PreparedPort, prepare_port
from ..stable_design import Gradient, PreparedPlants, StableDesign
from ..uncertainty import Scenario
from .base import Requirement

# Nearer to the Nyquist frequency the answer is that frequency, and does not move.
_NEARLY_NYQUIST = 0.499
_PASSIVE_NOWHERE = 1e-3


@dataclass(frozen=True, kw_only=True)
class PassivityTarget:
    """Re G(j2πf) ≥ 0, the port F → V passive, for every f up to `passive_below_hz` (`problems.stability.passivity`)."""

    passive_below_hz: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "passive_below_hz", positive("passive_below_hz", self.passive_below_hz))


class PassivityRequirement(Requirement[PassivityTarget]):
    """The frequency [Hz] at which Re G turns negative, of every different robot."""

    name, title = "passivity", "passivity"
    asked_as = PassivityTarget
    depends_on: ClassVar[Literal["loop", "robot", "contact"]] = "robot"
    unit = "Hz"

    def threshold(self, asked: PassivityTarget) -> float:
        """Return the end of the band [Hz]."""
        return asked.passive_below_hz

    def with_threshold(self, asked: PassivityTarget, threshold: float) -> PassivityTarget:
        """Return the target with another end."""
        return replace(asked, passive_below_hz=threshold)

    def read(self, entry: Mapping[str, Any]) -> PassivityTarget:
        """Return what plain data asks."""
        return PassivityTarget(**entry)

    def check_sampling(self, asked: PassivityTarget, sample_time_s: float) -> None:
        """Raise ParameterError for a band that reaches the Nyquist frequency."""
        if asked.passive_below_hz >= 0.5 / sample_time_s:
            must = "below half the sampling rate"
            raise ParameterError("passivity.passive_below_hz", asked.passive_below_hz, must)

    def describe(self, asked: PassivityTarget, *, turning: bool = False) -> str:
        """Return the band in words."""
        del turning
        return f"up to {asked.passive_below_hz:g} Hz"

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of different robots."""
        return len(prepared.robots)

    def achieved(self, asked: PassivityTarget, design: StableDesign, row: int) -> float:
        """Return the frequency up to which the port of one robot is passive [Hz]."""
        del asked
        return _ports(design.prepared)[row].passive_below_hz(design.controller)

    def gradient(self, asked: PassivityTarget, design: StableDesign, row: int) -> Gradient | None:
        """Differentiate the frequency at which Re G turns negative; None where it does not, or nowhere else."""
        from ..gradients import passivity_gradient  # noqa: PLC0415 - CasADi takes a second to import

        fails_hz, h = self.achieved(asked, design, row), design.prepared.sample_time_s
        if not _PASSIVE_NOWHERE * asked.passive_below_hz < fails_hz < _NEARLY_NYQUIST / h:
            return None
        return passivity_gradient(_ports(design.prepared)[row].sampled, design.controller, fails_hz)

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return a scenario of the robot."""
        return [scenario for _, scenario in prepared.robots.values()][row]


def _ports(prepared: PreparedPlants) -> tuple[PreparedPort, ...]:
    """Return the port of every different robot and wrench filter."""
    robots = prepared.robots.values()
    return prepared.once("passivity", lambda: tuple(prepare_port(plant) for plant, _ in robots))
