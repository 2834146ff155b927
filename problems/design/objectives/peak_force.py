"""The peak force of the hardest contact, at the contact itself or at the sensor."""

from abc import abstractmethod
from typing import ClassVar, Literal, Protocol

from ..requirements import Requirements
from ..stable_design import Gradient, PreparedPlants, StableDesign
from ..uncertainty import Scenario
from .base import BatchColumn, Direction, Objective

Place = Literal["contact", "sensor"]
PLACES: tuple[Place, Place] = ("contact", "sensor")


class PeakForces(Protocol):
    """The peak forces [N] of one contact, simulated or predicted."""

    @property
    def peak_contact_force_n(self) -> float:
        """The force at the contact, max F_e."""

    @property
    def peak_sensor_force_n(self) -> float:
        """The force at the sensor, max −F."""


class PeakObjective(Objective):
    """The peak force of every scenario's contact [N]; `place` says where the force is."""

    unit: ClassVar[str] = "N"
    rotational_unit: ClassVar[str | None] = "N·m"
    direction: ClassVar[Direction] = "minimize"
    place: ClassVar[Place]

    @abstractmethod
    def of_peak(self, peak: PeakForces) -> float:
        """Return the force [N] of a contact."""

    def count(self, prepared: PreparedPlants) -> int:
        """Return the number of scenarios."""
        return len(prepared.scenarios)

    def achieved(self, asked: Requirements, design: StableDesign, row: int) -> float:
        """Return the peak of one scenario [N]."""
        del asked
        return self.of_peak(design.peak(row))

    def gradient(self, asked: Requirements, design: StableDesign, row: int) -> Gradient | None:
        """Differentiate the force at the time of the peak."""
        from ..gradients import contact_peak_gradient  # noqa: PLC0415 - CasADi takes a second to import

        del asked
        return contact_peak_gradient(design, row, self.place)

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return the scenario."""
        return prepared.scenarios[row]


class ContactForce(PeakObjective):
    """max F_e, the force on the environment."""

    name: ClassVar[str] = "contact_force"
    title: ClassVar[str] = "peak contact force"
    place: ClassVar[Place] = "contact"
    batch_column: ClassVar[BatchColumn | None] = "contact_peak"

    def of_peak(self, peak: PeakForces) -> float:
        """Return max F_e [N] of a contact."""
        return peak.peak_contact_force_n


class SensorForce(PeakObjective):
    """max −F, the force at the sensor."""

    name: ClassVar[str] = "sensor_force"
    title: ClassVar[str] = "peak sensor force"
    place: ClassVar[Place] = "sensor"
    batch_column: ClassVar[BatchColumn | None] = "sensor_peak"

    def of_peak(self, peak: PeakForces) -> float:
        """Return max −F [N] of a contact."""
        return peak.peak_sensor_force_n


CONTACT_FORCE = ContactForce()


class PeakForce(ContactForce):
    """The peak force that the problem minimises, on fronts: at the sensor if it says so, else at the contact."""

    name: ClassVar[str] = "peak_force"

    def beside(self, minimised: Objective) -> Objective:
        """Return the peak at the sensor where that is minimised."""
        return _PeakForceAtSensor() if isinstance(minimised, SensorForce) else self


class _PeakForceAtSensor(SensorForce):
    """The peak force of a problem that minimises the one at the sensor."""

    name: ClassVar[str] = PeakForce.name


def force_of(objective: Objective) -> PeakObjective:
    """Return the objective if it is a peak force, else the peak force at the contact."""
    return objective if isinstance(objective, PeakObjective) else CONTACT_FORCE
