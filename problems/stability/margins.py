"""Margins of the exact sampled loop at both break points; stability is decided apart, by eigenvalues."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import BoolArray, ComplexArray, FloatArray
from ..compiled import compiled
from ..errors import AutotuneError, ParameterError
from ..model.controller import AdmittanceController
from ..model.sampled import KEPT_PLANTS, SampledPlant, build_loop, check_wrench_delay, spectral_radius
from .margin_kernel import (
    DELAY_S,
    DISK,
    EVERY_MARGIN,
    GAIN_DB,
    MARGINS,
    MODULUS,
    MODULUS_ALONE,
    MODULUS_RAD_PER_S,
    PHASE_RAD,
    Grid,
    PolynomialLoop,
    find_loop_margins,
    plant_at,
)
from .polynomials import CONTROLLER_POWERS, controller_polynomials, plant_polynomials

_LOWEST_HZ = 0.02
_SLOW_HZ = 1.0
_SLOW_SHARE = 8
_BASE_POINTS = 64
# Real parts of poles that are rounding: B_s = B_p = 0.
_UNDAMPED = 1e-10
# Around a resonance, in its half-widths, and between those.
_AROUND = np.linspace(-6.0, 6.0, 25)
_BETWEEN = 0.5 * (_AROUND[1:] + _AROUND[:-1])
_SHORT_OF_NYQUIST = 1e-9
# The cosine beyond which neighbours are on opposite sides.
_OPPOSITE = 0.5
# Where the loop gain is next to nothing (below 1e-3), a crossover limits nothing.
LARGEST_GAIN_DB = 60.0


class UnstableLoopError(AutotuneError):
    """Margins and peaks of an unstable loop are not numbers, so none is given."""

    def __init__(self, spectral_radius: float) -> None:
        super().__init__(
            f"The loop is unstable (largest |z| = {spectral_radius:.6f}); margins and peak forces exist only for a "
            "stable loop. Raise the admittance damping or change the lead gain."
        )
        self.spectral_radius = spectral_radius


@dataclass(frozen=True, kw_only=True)
class Margins:
    """The smaller margin of the two break points, each with the frequency where it is reached.

    `modulus` is min |1 + L|, at `modulus_hz`; `disk` the balanced disk margin α = min 2|1 + L|/|1 − L|, which tolerates
    gain and phase together (a gain of (2 + α)/(2 − α), a phase of 2 atan(α/2)); `gain_db` the smallest change of gain,
    up or down, that reaches the stability limit; `phase_deg` the smallest rotation either way; `delay_s` the smallest
    extra delay, 0 if the loop gain is still above 1 at the Nyquist frequency. A margin that no crossover limits is
    infinite, and so is a gain margin above 60 dB.
    """

    modulus: float
    modulus_hz: float
    disk: float
    gain_db: float
    phase_deg: float
    delay_s: float
    spectral_radius: float


class RawMargins(NamedTuple):
    """Margins of many loops at once, shape of the leading axes of the response."""

    modulus: FloatArray
    gain_db: FloatArray
    phase_deg: FloatArray
    delay_s: FloatArray


def margins_on_grid(frequency_rad_per_s: FloatArray, loop: ComplexArray) -> RawMargins:
    """Read the margins of `loop` (..., n) given on an increasing grid (n,) that ends at the Nyquist frequency.

    Crossovers are interpolated linearly in log gain and phase between neighbours. Raises ParameterError for values
    that are not finite: they would pass for an infinite margin.
    """
    if not np.all(np.isfinite(loop)):
        raise ParameterError("loop", "values that are not finite", "finite at every frequency")
    shape, loop = loop.shape[:-1], loop.reshape(-1, loop.shape[-1])
    modulus, last = np.min(np.abs(1.0 + loop), axis=-1), loop[:, -1].real
    # The Tustin form has a zero at z = −1, so the last point may be exactly 0.
    with np.errstate(divide="ignore", invalid="ignore"):
        gain_db = np.where(last < 0.0, np.abs(20.0 * np.log10(np.abs(last))), np.inf)
        phase, delay_s = np.full(len(loop), np.inf), np.full(len(loop), np.inf)
        # Phase crossovers: the segment passes the negative real axis.
        imag = loop.imag
        row, _, start, stop = _segments(loop, (imag[:, :-1] * imag[:, 1:] <= 0.0) & (imag[:, :-1] != imag[:, 1:]))
        real = _crossing(start, stop)
        # Past an undamped pole L turns round through infinity, not through zero: its inverse goes the short way.
        far = (start * stop.conj()).real < -np.abs(start * stop) * _OPPOSITE
        far &= np.abs(start * stop) > 1.0
        real[far] = 1.0 / _crossing(1.0 / start[far], 1.0 / stop[far])
        np.minimum.at(gain_db, row, np.where(real < 0.0, np.abs(20.0 * np.log10(np.abs(real))), np.inf))
        # Gain crossovers: |L| passes 1.
        gain = np.log(np.abs(loop))
        row, at, start, stop = _segments(loop, (gain[:, :-1] * gain[:, 1:] <= 0.0) & (gain[:, :-1] != gain[:, 1:]))
        first, second = np.log(np.abs(start)), np.log(np.abs(stop))
        share = first / (first - second)
        angle = np.angle(-start) + share * np.angle(stop / start)  # of −L: zero on the critical point
        omega = frequency_rad_per_s[at] + share * (frequency_rad_per_s[at + 1] - frequency_rad_per_s[at])
        wrapped = np.angle(np.exp(1j * angle))
        np.minimum.at(phase, row, np.abs(wrapped))
        np.minimum.at(delay_s, row, np.where(wrapped > 0.0, wrapped, wrapped + 2.0 * np.pi) / omega)
    return RawMargins(*(each.reshape(shape) for each in (modulus, gain_db, np.degrees(phase), delay_s)))


def _crossing(start: ComplexArray, stop: ComplexArray) -> FloatArray:
    """Return where the straight line between two points crosses the real axis."""
    return np.asarray(start.real + start.imag / (start.imag - stop.imag) * (stop.real - start.real))


def _segments(
    loop: ComplexArray, crossing: BoolArray
) -> tuple[NDArray[np.intp], NDArray[np.intp], ComplexArray, ComplexArray]:
    """Return row and index of the segments between neighbours that cross, and both ends of each."""
    row, at = np.nonzero(crossing)
    return row, at, loop[row, at], loop[row, at + 1]


def frequency_grid(sampled: SampledPlant, points: int = _BASE_POINTS) -> FloatArray:
    """Return frequencies (n,) [rad/s] to just short of the Nyquist frequency, denser around the plant's resonances."""
    nyquist = (1.0 - _SHORT_OF_NYQUIST) * np.pi / sampled.sample_time_s
    base, extra = _base_grid(nyquist, points), []
    for pole in np.linalg.eigvals(sampled.rate) / sampled.sample_time_s:
        if pole.imag > 0.0:
            width = max(-pole.real, 1e-4 * abs(pole))
            # The response of an undamped plant is infinite at the pole itself, where no margin is least.
            undamped = abs(pole.real) <= _UNDAMPED * abs(pole)
            extra.append(pole.imag + width * (_BETWEEN if undamped else _AROUND))
    grid = np.concatenate([base, *extra])
    grid = np.sort(grid[(grid >= base[0]) & (grid < nyquist)])
    # A grid is made for every plant: `np.unique` alone would take as long as all of this.
    return np.append(grid[np.append(grid[1:] != grid[:-1], True)], nyquist)


@lru_cache(maxsize=16)
def _base_grid(nyquist: float, points: int) -> FloatArray:
    """Return the part of the grid that all plants of a sample time share."""
    # Below the robot's bandwidth nothing happens quickly.
    slow = points // _SLOW_SHARE
    low, middle = 2.0 * np.pi * _LOWEST_HZ, min(2.0 * np.pi * _SLOW_HZ, 0.5 * nyquist)
    return np.concatenate([np.geomspace(low, middle, slow), np.geomspace(middle, nyquist, points - slow)])


@dataclass(frozen=True, kw_only=True)
class PreparedMargins:
    """What the margins of one plant need and no controller changes, computed when they are first asked for.

    Of many plants only radii and contacts are looked at. See `find_loop_margins`.
    """

    sampled: SampledPlant

    @cached_property
    def polynomials(self) -> FloatArray:
        """The plant's polynomials without the whole samples of delay, and how many those are."""
        return response_polynomials(self.sampled)

    @cached_property
    def grid(self) -> Grid:
        """Frequencies, and the plant's responses there."""
        return margin_grid(self.sampled, self.polynomials)

    def find(self, controller: AdmittanceController, spectral_radius: float) -> Margins:
        """Find the margins of a loop that is known to be stable, with this spectral radius.

        Raises ParameterError when the loop's response is not finite.
        """
        found = self._found(controller, EVERY_MARGIN)
        return Margins(
            modulus=float(found[MODULUS]),
            modulus_hz=float(found[MODULUS_RAD_PER_S] / (2.0 * math.pi)),
            disk=float(found[DISK]),
            gain_db=float(found[GAIN_DB]) if found[GAIN_DB] < LARGEST_GAIN_DB else math.inf,
            phase_deg=math.degrees(found[PHASE_RAD]),
            delay_s=float(found[DELAY_S]),
            spectral_radius=spectral_radius,
        )

    def find_modulus(self, controller: AdmittanceController) -> float:
        """Find the modulus margin alone of a loop that is known to be stable, see `find`."""
        return float(self._found(controller, MODULUS_ALONE)[MODULUS])

    def _found(self, controller: AdmittanceController, depth: int) -> FloatArray:
        """Return what `find_loop_margins` finds; raises ParameterError when the loop's response is not finite."""
        check_wrench_delay(self.sampled.plant, controller)
        factors, found = np.zeros((3, CONTROLLER_POWERS)), np.empty(MARGINS)
        degree = controller_polynomials(controller.parameters(), controller.is_ideal, factors)
        loop = PolynomialLoop(self.polynomials, factors, degree, self.sampled.sample_time_s, controller.theta)
        find_loop_margins(loop, self.grid, depth, found)
        if np.isnan(found[MODULUS]):
            raise ParameterError("loop", self.sampled.plant, "one with a finite response at every frequency")
        return found


@lru_cache(maxsize=KEPT_PLANTS)
def prepare_margins(sampled: SampledPlant) -> PreparedMargins:
    """Return what the margins of a sampled plant need, once for all controllers; raises where it is not finite."""
    check_finite(sampled)
    return PreparedMargins(sampled=sampled)


def find_margins(sampled: SampledPlant, controller: AdmittanceController) -> Margins:
    """Find the margins of one exact sampled loop: every minimum and crossover is searched on the loop itself.

    Raises UnstableLoopError if the loop is not stable, by its eigenvalues.
    """
    check_finite(sampled)
    radius = spectral_radius(build_loop(sampled, controller))
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    return prepare_margins(sampled).find(controller, radius)


@compiled
def _are_finite(matrix: FloatArray, vectors: tuple[FloatArray, FloatArray, FloatArray, FloatArray]) -> bool:
    """Return whether every number of a matrix (n, n) and of vectors (n,) is finite."""
    total = 0.0
    for i in range(len(matrix)):
        for j in range(len(matrix)):
            total += 0.0 * matrix[i, j]
        for vector in vectors:
            total += 0.0 * vector[i]
    return total == 0.0


def check_finite(sampled: SampledPlant) -> None:
    """Refuse a plant whose matrices overflow: what is not a number would pass for a margin without limit."""
    vectors = (sampled.gamma, sampled.gamma_old, sampled.c_position, sampled.c_force)
    if not (math.isfinite(sampled.d_force) and _are_finite(sampled.phi, vectors)):
        raise ParameterError("plant", sampled.plant, "one whose motion over one sample is finite")


def loop_polynomials(sampled: SampledPlant) -> FloatArray:
    """Return denominator and numerators of F/x^d and x/x^d of a sampled plant, see `plant_polynomials`."""
    return _polynomials(sampled, sampled.whole_delay)


def response_polynomials(sampled: SampledPlant) -> FloatArray:
    """Return what `plant_at` takes: the polynomials without the whole samples of delay, and how many those are."""
    polynomials = _polynomials(sampled, 0)
    delay = np.zeros((1, polynomials.shape[1]))
    delay[0, 0] = sampled.whole_delay
    return np.concatenate([polynomials, delay])


def _polynomials(sampled: SampledPlant, whole: int) -> FloatArray:
    outputs = np.array([[*sampled.c_position, 0.0, 0.0], [*sampled.c_force, sampled.d_force, 0.0]])
    delay = (whole, whole + sampled.chain_length - sampled.whole_delay, sampled.fraction)
    rests = not sampled.plant.environment.is_anchored
    return plant_polynomials(sampled.phi, sampled.gamma, sampled.gamma_old, outputs, delay, rests)


def margin_grid(sampled: SampledPlant, polynomials: FloatArray | None = None) -> Grid:
    """Return what `find_loop_margins` needs of a plant besides its polynomials, which may be known already."""
    omega = frequency_grid(sampled)
    tangent = np.tan(0.5 * omega * sampled.sample_time_s)
    return omega, tangent, *_responses(response_polynomials(sampled) if polynomials is None else polynomials, tangent)


@compiled
def _responses(plant: FloatArray, tangent: FloatArray) -> tuple[ComplexArray, ComplexArray]:
    """Return F/x^d and x/x^d at w = j tan(ωh/2) (n,), see `plant_at`."""
    force, position = np.empty(len(tangent), dtype=np.complex128), np.empty(len(tangent), dtype=np.complex128)
    for k in range(len(tangent)):
        force[k], position[k] = plant_at(plant, complex(0.0, tangent[k]))
    return force, position
