"""One stable controller on many sampled plants: its loops, their margins and the peaks of their contacts, on demand."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

from ..arrays import FloatArray
from ..contact.transient import Approach, SampledContact, transient_from
from ..model.controller import AdmittanceController
from ..model.plant import WrenchFilter
from ..model.radii import spectral_radii
from ..model.robot import RobotModel
from ..model.sampled import Controller, SampledLoop, SampledPlant, build_loop, spectral_radius
from ..stability.margins import Margins, PreparedMargins
from .uncertainty import Scenario

Made = TypeVar("Made")


@dataclass(frozen=True, kw_only=True)
class Gradient:
    """A number and its derivative by the controller's parameters (7,), in the order of `Controller.parameters`."""

    value: float
    by_controller: FloatArray


@dataclass(frozen=True, kw_only=True)
class Peak:
    """The contact forces of one scenario."""

    scenario: Scenario
    peak_sensor_force_n: float
    peak_contact_force_n: float
    time_of_peak_s: float


@dataclass(frozen=True, kw_only=True)
class StableLoop:
    """One sampled plant with a controller that it is stable with; `prepared` is what its margins are found with.

    `known_radius` is its spectral radius, where that was found together with others.
    """

    sampled: SampledPlant
    controller: Controller
    prepared: PreparedMargins | None = None
    known_radius: float | None = None

    @property
    def sample_time_s(self) -> float:
        """The period h."""
        return self.sampled.sample_time_s

    @cached_property
    def matrices(self) -> SampledLoop:
        """The closed loop's state space."""
        return build_loop(self.sampled, self.controller)

    @cached_property
    def spectral_radius(self) -> float:
        """The largest |z| of the loop."""
        return spectral_radius(self.matrices) if self.known_radius is None else self.known_radius

    @cached_property
    def margins(self) -> Margins:
        """The margins over both break points; raises TypeError without what they are found with."""
        if self.prepared is None or not isinstance(self.controller, AdmittanceController):
            raise TypeError("margins are found of a prepared plant with an AdmittanceController only")
        return self.prepared.find(self.controller, self.spectral_radius)


@dataclass(frozen=True, kw_only=True)
class PreparedPlants(ABC):
    """Contact scenarios with everything that does not depend on the controller already computed.

    `plants` are those of the scenarios in contact, then every different one in free space, the lightest first;
    `free_of` are scenarios that those belong to.
    """

    scenarios: tuple[Scenario, ...]
    pairs: tuple[SampledContact, ...]
    plants: tuple[PreparedMargins, ...]
    free_of: tuple[Scenario, ...]
    _kept: dict[Hashable, Any] = field(default_factory=dict, repr=False, compare=False)

    @property
    @abstractmethod
    def approach(self) -> Approach:
        """How the contacts begin."""

    def once(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """Return what `make` returned when it was called first for this key."""
        if key not in self._kept:
            self._kept[key] = make()
        made: Made = self._kept[key]
        return made

    @property
    def sample_time_s(self) -> float:
        """The period h."""
        return self.plants[0].sampled.sample_time_s

    @property
    def free(self) -> tuple[SampledPlant, ...]:
        """The different plants in free space, the lightest first."""
        return tuple(plant.sampled for plant in self.plants[len(self.pairs) :])

    @cached_property
    def robots(self) -> dict[tuple[RobotModel, WrenchFilter], tuple[SampledPlant, Scenario]]:
        """A plant in free space and its scenario for every different robot and wrench filter.

        What the robot renders in free space does not depend on the payload.
        """
        return {plant.plant.port: (plant, of) for plant, of in zip(self.free, self.free_of, strict=True)}

    def scenario_of(self, plant: int) -> Scenario:
        """Return the scenario that a plant belongs to."""
        count = len(self.scenarios)
        return self.scenarios[plant] if plant < count else self.free_of[plant - count]

    def radii(self, controller: AdmittanceController) -> FloatArray:
        """Return the spectral radius of every plant's loop."""
        return StableDesign(self, controller).radii

    def peaks(self, controller: AdmittanceController) -> tuple[Peak, ...]:
        """Simulate the contact of every scenario; the loops must be stable."""
        return StableDesign(self, controller).peaks


class StableDesign:
    """A controller that is stable on all prepared plants; loops, margins and peaks are computed once, on demand."""

    def __init__(
        self,
        prepared: PreparedPlants,
        controller: AdmittanceController,
        peaks: Sequence[Peak] | None = None,
    ) -> None:
        self.prepared, self.controller = prepared, controller
        self._loops: dict[int, StableLoop] = {}
        self._given = None if peaks is None else tuple(peaks)
        self._peaks: dict[int, Peak] = {}

    @cached_property
    def radii(self) -> FloatArray:
        """The spectral radius of every plant's loop (p,)."""
        plants, law = self.prepared.plants, self.controller
        found = spectral_radii([build_loop(plant.sampled, law) for plant in plants])
        self._loops = {
            i: StableLoop(sampled=plant.sampled, controller=law, prepared=plant, known_radius=radius)
            for i, (plant, radius) in enumerate(zip(plants, found.tolist(), strict=True))
        }
        return found

    def loop(self, plant: int) -> StableLoop:
        """Return the loop of one plant."""
        if plant not in self._loops:
            prepared = self.prepared.plants[plant]
            self._loops[plant] = StableLoop(sampled=prepared.sampled, controller=self.controller, prepared=prepared)
        return self._loops[plant]

    def peak(self, scenario: int) -> Peak:
        """Return the contact of one scenario: the one that was given, else the simulated one."""
        if self._given is not None:
            return self._given[scenario]
        if scenario not in self._peaks:
            run = transient_from(self.prepared.pairs[scenario], self.controller, self.prepared.approach)
            self._peaks[scenario] = Peak(
                scenario=self.prepared.scenarios[scenario],
                peak_sensor_force_n=run.peak_sensor_force_n,
                peak_contact_force_n=run.peak_contact_force_n,
                time_of_peak_s=run.time_of_peak_s,
            )
        return self._peaks[scenario]

    @property
    def peaks(self) -> tuple[Peak, ...]:
        """The contacts that were given, else the simulated ones of all scenarios."""
        if self._given is not None:
            return self._given
        return tuple(self.peak(i) for i in range(len(self.prepared.scenarios)))
