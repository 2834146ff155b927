"""What several axes do together that refuses them: unstable, bouncing for ever, or a modulus below the one asked."""

from dataclasses import dataclass, replace

from autotune.formats.coupled_record import Vector
from autotune.formats.units import axis_units
from autotune.text import stiffness_text
from problems.model.coupled import CoupledLoop, CoupledSampledPlant
from problems.stability.coupled_margins import worst_mode


@dataclass(frozen=True, kw_only=True)
class TouchedPoint:
    """A contact of one axis with a point of the payload, on one plant."""

    name: str
    point_m: Vector
    mass_kg: float
    stiffness_n_per_m: float

    def where(self) -> str:
        """Return it in words."""
        at = "(" + ", ".join(f"{each:.3g}" for each in self.point_m) + ") m"
        stiffness = stiffness_text(self.stiffness_n_per_m, axis_units(self.name))
        return f"touching along {self.name} at {at}, K_e {stiffness}, M_p {self.mass_kg:.4g} kg"


@dataclass(frozen=True, kw_only=True)
class CoupledFailure:
    """A plant on which the axes together are unstable, or bounce for ever: where, which mode, which axis moves most.

    `touched` is the contact with a point at which that was seen; `modulus` the smallest singular value of I + L that
    was found and the one that was asked, where that alone is missed.
    """

    group: tuple[str, ...]
    axis: str
    mode_hz: float
    radius: float
    where: str
    bounces: bool = False
    touched: TouchedPoint | None = None
    modulus: tuple[float, float] | None = None

    def message(self) -> str:
        """Return it in a sentence."""
        together = " and ".join([", ".join(self.group[:-1]), self.group[-1]] if len(self.group) > 1 else self.group)
        if self.modulus is not None:
            found, asked = self.modulus
            return (
                f"{together} together have a smallest singular value of I + L of {found:.3g} {self.where}, at "
                f"{self.mode_hz:.3g} Hz, and {asked:g} is asked (axes_together.min_modulus)"
            )
        if self.bounces:
            return f"{together} together bounce for ever {self.where}; {self.axis} moves most, at {self.mode_hz:.3g} Hz"
        return (
            f"{together} act on each other through the payload and are unstable together {self.where}: a mode at "
            f"{self.mode_hz:.3g} Hz grows (largest |z| {self.radius:.6f}), in which {self.axis} moves most"
        )


@dataclass(frozen=True, kw_only=True)
class CoupledCase:
    """A group of axes on one plant."""

    group: tuple[str, ...]
    where: str
    sampled: CoupledSampledPlant
    loop: CoupledLoop


def find_failure(case: CoupledCase) -> CoupledFailure | None:
    """Return the mode that grows; None where all decay."""
    found = slowest_mode(case)
    return None if found.radius < 1.0 else found


def slowest_mode(case: CoupledCase, *, bounces: bool = False) -> CoupledFailure:
    """Return the mode that decays most slowly, or grows, as what fails."""
    mode = worst_mode(case.sampled, case.loop)
    return CoupledFailure(
        group=case.group,
        axis=case.group[mode.axis],
        mode_hz=mode.frequency_hz,
        radius=mode.radius,
        where=case.where,
        bounces=bounces,
    )


def weak_modulus(case: CoupledCase, found: tuple[float, float], asked: float) -> CoupledFailure:
    """Return what misses the modulus: what was `found`, and at how many Hz."""
    modulus, hz = found
    return replace(slowest_mode(case), mode_hz=hz, modulus=(modulus, asked))
