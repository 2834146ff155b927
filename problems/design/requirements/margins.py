"""Margins of every plant's loop: modulus, gain, phase and delay margin, and the decay rate of its slowest mode."""

import math
from typing import ClassVar

from ..stable_design import Gradient, StableDesign, StableLoop
from .base import LoopRequirement


class Margin(LoopRequirement[float]):
    """One of the `Margins` of a loop over both break points: the field `margin`."""

    margin: ClassVar[str]

    @property
    def heading(self) -> str:
        """Title and unit, as over a column."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def of_loop(self, asked: float, loop: StableLoop) -> float:
        """Return the margin, in the unit of its field."""
        del asked
        return float(getattr(loop.margins, self.margin))

    def gradient(self, asked: float, design: StableDesign, row: int) -> Gradient | None:
        """Differentiate the margin at the frequency where it is read, which moves with the controller."""
        from .. import gradients  # noqa: PLC0415 - CasADi takes a second to import

        del asked
        loop = design.loop(row)
        if self.margin == "modulus":
            at_rad_per_s = 2.0 * math.pi * loop.margins.modulus_hz
            return gradients.modulus_gradient(loop.sampled, design.controller, at_rad_per_s)
        of = {
            "gain_db": gradients.gain_gradient,
            "phase_deg": gradients.phase_gradient,
            "delay_s": gradients.delay_gradient,
        }
        return of[self.margin](loop.sampled, design.controller)


class ModulusMargin(Margin):
    """min |1 + L| over frequency and both break points."""

    name, title, margin = "modulus_margin", "modulus margin", "modulus"
    must_be_below = (1.0, "|1 + L| tends to 1 at high frequency")


class GainMargin(Margin):
    """The least change of the gain, up or down, that makes the loop unstable [dB]."""

    name, title, margin = "gain_margin_db", "gain margin", "gain_db"
    unit = "dB"


class PhaseMargin(Margin):
    """The least turn of the phase, to either side, that makes the loop unstable [deg]."""

    name, title, margin = "phase_margin_deg", "phase margin", "phase_deg"
    unit = "°"


class DelayMargin(Margin):
    """The least delay beyond its own that makes the loop unstable [s]."""

    name, title, margin = "delay_margin_s", "delay margin", "delay_s"
    unit, shown_scale = "ms", 1e3


class DecayRate(LoopRequirement[float]):
    """−ln ρ/h of the loop's slowest mode [1/s], a translation in free space left out."""

    name, title = "decay_rate_per_s", "decay rate"
    unit = "1/s"

    def of_loop(self, asked: float, loop: StableLoop) -> float:
        """Return the decay rate [1/s], infinite for a deadbeat loop."""
        del asked
        radius = loop.spectral_radius
        return -math.log(radius) / loop.sample_time_s if radius != 0.0 else math.inf

    def gradient(self, asked: float, design: StableDesign, row: int) -> Gradient | None:
        """Differentiate the largest eigenvalue."""
        from ..gradients import decay_gradient  # noqa: PLC0415 - CasADi takes a second to import

        del asked
        return decay_gradient(design.loop(row).sampled, design.controller)
