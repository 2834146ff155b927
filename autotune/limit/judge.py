"""What a controller does on the exact loops of the plants that controllers are compared over."""

import math
from dataclasses import dataclass, fields

import numpy as np

from problems.arrays import FloatArray
from problems.contact.linear_controller_contact import trace_linear_contact
from problems.contact.transient import Approach, ContactTransient, SampledContact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.response import free_space_admittance, loop_response
from problems.model.sampled import Controller, SampledPlant, build_loop, spectral_radius
from problems.stability.margins import RawMargins, UnstableLoopError, frequency_grid, margins_on_grid
from problems.stability.noise import command_speed_gain
from problems.stability.noise_spectrum import RelativeSpectrum

_GRID, _FINE, _POINTS_A_STATE = 600, 10, 60


@dataclass(frozen=True, kw_only=True)
class ReachedPeak:
    """What one controller does over the plants: worst peak [N], margins, noise [m/s/N] and least |G| [m/s/N].

    `trace` is its contact with the plant of the worst peak.
    """

    peak_force_n: float
    modulus: float
    gain_db: float
    phase_deg: float
    delay_s: float
    noise_m_s_per_n: float
    min_m_s_per_n: float
    trace: ContactTransient

    def to_dict(self) -> dict[str, float | None]:
        """Return the numbers; None is a margin without limit."""
        names = [each.name for each in fields(self) if each.name != "trace"]
        numbers = {name: float(getattr(self, name)) for name in names}
        return {name: number if math.isfinite(number) else None for name, number in numbers.items()}


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopJudge:
    """Looks at a controller on the exact loops of all plants, with none of the convex program's numbers.

    The noise of the force is white unless it has a `spectrum`.
    """

    pairs: tuple[SampledContact, ...]
    approach: Approach
    band_rad_per_s: FloatArray
    at_contact: bool
    spectrum: RelativeSpectrum | None = None

    def __call__(self, law: Controller) -> ReachedPeak:
        """Return what it reaches; raises UnstableLoopError where a loop is unstable."""
        traces = [self._trace(pair, law) for pair in self.pairs]
        worst = max(traces, key=self.peak)
        plants = [plant for pair in self.pairs for plant in (pair.contact, pair.free)]
        margins = np.min([_margins(plant, law) for plant in plants], axis=0)
        return ReachedPeak(
            peak_force_n=self.peak(worst),
            modulus=float(margins[0]),
            gain_db=float(margins[1]),
            phase_deg=float(margins[2]),
            delay_s=float(margins[3]),
            noise_m_s_per_n=max(command_speed_gain(plant, law, self.spectrum) for plant in plants),
            min_m_s_per_n=min(
                float(np.min(np.abs(free_space_admittance(pair.free, law, self.band_rad_per_s)))) for pair in self.pairs
            ),
            trace=worst,
        )

    def peak(self, trace: ContactTransient) -> float:
        """Return the peak [N] where it is asked."""
        return trace.peak_contact_force_n if self.at_contact else trace.peak_sensor_force_n

    def _trace(self, pair: SampledContact, law: Controller) -> ContactTransient:
        if isinstance(law, AdmittanceController):
            return simulate_contact(pair, law, self.approach)
        radius = spectral_radius(build_loop(pair.free, law))
        if not radius < 1.0:
            raise UnstableLoopError(radius)
        return trace_linear_contact(pair, law, self.approach)


def _margins(plant: SampledPlant, law: Controller) -> RawMargins:
    omega = frequency_grid(plant, _GRID)
    if isinstance(law, LinearController):
        # A law of many ticks winds through as many turns, and dips where the plant alone is smooth.
        even = np.linspace(omega[0], omega[-1], _POINTS_A_STATE * len(law.rest))
        omega = np.unique(np.concatenate([frequency_grid(plant, _FINE * _GRID), even]))
    response = loop_response(plant, law, omega)
    found = [margins_on_grid(omega, each) for each in (response.at_force, response.at_command)]
    return RawMargins(*np.min(found, axis=0))
