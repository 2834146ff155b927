"""A force that no B_a and K_l of a box get below, by branch and bound: all other numbers of law and plant are fixed.

A cell of B_a × K_l is dropped where all of its laws miss a requirement at one frequency, or make more noise in the
ticks that the robot's delay leaves to the law alone; of the others the largest force of the first ticks is bounded
from below by the walk of `certificate.peaks`, with the law's numbers in the place of the plant's. The cell with the
least bound is cut in two until that bound is near the force which is reached (Land and Doig, Econometrica 28(3),
1960). Over 1 + L stands (1 + B_fb V P_x)(M_a s + B_a) − (1 + K_l s) P_F/s, linear in B_a and in K_l, so that no law of
a cell is further from the origin than its corners.
"""

import heapq
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, find_margins, frequency_grid
from problems.stability.noise_spectrum import RelativeSpectrum

from .balls import Balls, DualBall, as_series, at, ball, derivative_of, enclose_complex, number, on_circle, precise
from .contact_loop import contact_loop
from .family import Family
from .law import LawCell
from .peak_kernel import CellLoop, least_largest
from .peaks import prepare_cell
from .plant_polynomials import plant_polynomials

# The places of B_a and K_l in `AdmittanceController.numbers`.
_DAMPING, _LEAD = 1, 2
# Cells wider than this, by the logarithm of B_a and by the shares of its bounds of K_l, are cut before they are walked.
_WALKED = 0.35
_NARROWEST = 1e-5
_TICKS = 120
# More than rounding changes a number here.
_OUT = 1.0 + 1e-9
# Every so many of the frequencies at which margins are looked for.
_STRIDE = 4

Cell = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Asked:
    """What cells are dropped for: modulus, least |G| [m/s/N] at frequencies, and noise of the command [m/s per N].

    The noise of the force is white unless it has a spectrum.
    """

    modulus: float | None = None
    min_m_s_per_n: float | None = None
    band_rad_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    noise_m_s_per_n: float | None = None
    noise_spectrum: RelativeSpectrum | None = None


@dataclass(frozen=True, kw_only=True)
class LeastPeak:
    """`force_n` is proved to be exceeded by every law of the box that meets what is asked; `cells` were looked at."""

    force_n: float
    cells: int


@dataclass(frozen=True)
class _Place:
    """At frequencies (n,): s of the law, 1 + B_fb V P_x and −P_F/s with their radii, and |P_x s| where it is free."""

    s: NDArray[np.complex128]
    beside: Balls
    through: Balls
    follows: FloatArray | None


def find_least_peak(
    plants: Sequence[Plant],
    law: AdmittanceController,
    approach: Approach,
    sample_time_s: float,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    asked: Asked,
    *,
    reached_n: float,
    tolerance: float = 0.01,
    most_cells: int = 4000,
    progress: Callable[[float], None] | None = None,
) -> LeastPeak:
    """Bound the peak of the contact force from below over all B_a and K_l.

    Parameters
    ----------
    plants
        In contact. The requirements are looked at on all of them and in free space, the peak on the first, whose
        contact begins at a tick.
    law
        What the other numbers of the law are.
    approach
        A force or a speed, under F^d that goes on.
    sample_time_s
        The period h.
    bounds
        Those of B_a [N·s/m] and of K_l [s].
    asked
        What the laws must meet; nothing else is looked at, so that the bound holds whatever is asked beside it.
    reached_n, tolerance
        The search ends where the bound lies within this share below a force that is reached [N].
    most_cells
        It ends after so many cells, too.
    progress
        Is passed the share of the work done since the last call.

    Returns
    -------
    LeastPeak
        The bound; `reached_n` at most.

    Raises
    ------
    ParameterError
        For a law with a biquad, a compensation or another rule than Tustin's, a plant whose wrench is filtered or late
        or whose surface has a mass, and an approach that is not under F^d.
    """
    if law.has_biquad or law.compensation_mass_kg != 0.0 or law.theta != 0.5:
        raise ParameterError("law", law, "four gains by Tustin's rule, without compensation and biquad")
    search = _Search(plants, law, approach, sample_time_s, asked)
    (low, high), (short, long) = bounds
    waiting: list[tuple[float, int, Cell]] = [(0.0, 0, (low, high, short, long))]
    cells, enough = 0, (1.0 - tolerance) * reached_n
    while waiting and cells < most_cells and waiting[0][0] < enough:
        least, _, cell = heapq.heappop(waiting)
        halves = _halves(cell, long - short)
        if halves is None:
            heapq.heappush(waiting, (least, cells, cell))
            break
        for half in halves:
            cells += 1
            if search.is_dropped(half):
                continue
            wide = _width(half, long - short)
            bound = search.least_peak(half) if max(wide) < _WALKED else 0.0
            if bound < enough and max(wide) < _WALKED and search.is_dropped_where_its_middle_is_worst(half):
                continue
            heapq.heappush(waiting, (max(least, bound), cells, half))
        if progress is not None:
            progress(2.0 / most_cells)
    return LeastPeak(force_n=float(min(waiting[0][0] if waiting else reached_n, reached_n)), cells=cells)


def _width(cell: Cell, span: float) -> tuple[float, float]:
    low, high, short, long = cell
    return math.log(high / low), (long - short) / span if span > 0.0 else 0.0


def _halves(cell: Cell, span: float) -> tuple[Cell, Cell] | None:
    low, high, short, long = cell
    of_damping, of_lead = _width(cell, span)
    if max(of_damping, of_lead) < _NARROWEST:
        return None
    if of_damping >= of_lead:
        middle = math.sqrt(low * high)
        return (low, middle, short, long), (middle, high, short, long)
    middle = 0.5 * (short + long)
    return (low, high, short, middle), (low, high, middle, long)


class _Search:
    """What the plants say of cells of laws."""

    def __init__(
        self,
        plants: Sequence[Plant],
        law: AdmittanceController,
        approach: Approach,
        sample_time_s: float,
        asked: Asked,
    ) -> None:
        self.law, self.approach, self.h, self.asked = law, approach, sample_time_s, asked
        loops = list(dict.fromkeys((*plants, *(each.in_contact_with(FREE_SPACE) for each in plants))))
        self.families = [Family(nominal=each, ranges={}, sample_time_s=sample_time_s) for each in loops]
        self.sampled = [build_sampled_plant(each, sample_time_s) for each in loops]
        self.places: list[_Place] = []
        if asked.modulus is not None:
            for family, sampled in zip(self.families, self.sampled, strict=True):
                self.places.append(self._place(family, frequency_grid(sampled)[::_STRIDE]))
        # The admittance is that at the flange, whatever it carries (`free_space_admittance`).
        has_band = asked.min_m_s_per_n is not None and len(asked.band_rad_per_s) > 0
        self.band = self._place(self.families[-1], asked.band_rad_per_s) if has_band else None

    @precise
    def _place(self, family: Family, frequency_rad_per_s: FloatArray) -> _Place:
        """Return what is fixed at these frequencies."""
        law, h = self.law, self.h
        down, force, position = (
            [as_series(each).value for each in polynomial] for polynomial in plant_polynomials(family, family.box())
        )
        whole, has_fraction = family.delay()
        chain = whole + int(has_fraction)
        rows: list[list[Any]] = [[], [], [], []]
        for omega in frequency_rad_per_s.tolist():
            z = on_circle(omega * h)
            w, late = z - 1, z**chain
            s = 2 * w / (h * (z + 1))
            below = late * at(down, w)
            moved, felt = at(position, w) / below, at(force, w) / below
            filtered = law.velocity_filter_rad_per_s * s / (s + law.velocity_filter_rad_per_s)
            for row, value in zip(
                rows, (s, 1 + law.feedback_damping_s * filtered * moved, -felt / s, moved * w / h), strict=True
            ):
                row.append(value)
        s, beside, through, follows = (enclose_complex(each) for each in rows)
        return _Place(s.mid, beside, through, follows.magnitude() if family.is_free_space else None)

    def is_dropped(self, cell: Cell) -> bool:
        """Return whether all laws of a cell miss something that is asked."""
        return self._is_slow(cell) or self._is_noisy(cell) or any(self._is_near(cell, each) for each in self.places)

    def is_dropped_where_its_middle_is_worst(self, cell: Cell) -> bool:
        """Return whether all laws of a cell have too small a modulus at the frequency where that of its middle is."""
        if self.asked.modulus is None:
            return False
        for family, sampled in zip(self.families, self.sampled, strict=True):
            try:
                worst = find_margins(sampled, self._middle(cell))
            except UnstableLoopError:
                continue
            if worst.modulus < self.asked.modulus:
                place = self._place(family, np.array([2.0 * math.pi * worst.modulus_hz]))
                if self._is_near(cell, place):
                    self.places.append(place)
                    return True
        return False

    def least_peak(self, cell: Cell) -> float:
        """Return a force that the peak of every law of a cell exceeds."""
        ends = np.array(cell).reshape(2, 2)
        middle = np.mean(ends, axis=1)
        half = 0.5 * (ends[:, 1] - ends[:, 0]) * (1.0 + 1e-12) + 2.0 * np.spacing(middle)
        family, none = self.families[0], self.families[0].box()
        law = self._middle(cell)
        loop = contact_loop(family, LawCell(middle=law, values={}), self.approach, none)
        slopes = [
            contact_loop(family, LawCell(middle=law, values=_values(ends, along)), self.approach, none)
            for along in range(2)
        ]
        prepared = prepare_cell(loop, slopes, half, (1.0, 1.0), is_endless=False)
        if not isinstance(prepared, CellLoop):
            return 0.0
        # F^d of a given speed hangs on the law.
        unsure = sum(h * float(derivative_of(each.force_n).abs_upper()) for h, each in zip(half, slopes, strict=True))
        found = least_largest(prepared, _TICKS) - unsure * _OUT
        return found if math.isfinite(found) else 0.0

    def _middle(self, cell: Cell) -> AdmittanceController:
        low, high, short, long = cell
        return replace(self.law, damping_n_s_per_m=0.5 * (low + high), lead_s=0.5 * (short + long))

    def _is_near(self, cell: Cell, place: _Place) -> bool:
        """Return whether |1 + L| is below the modulus at some frequency for all laws, at the force or the command."""
        low, high, short, long = cell
        s, mass = place.s, self.law.mass_kg
        largest = np.zeros(len(s))
        for damping in (low, high):
            carried = mass * s + damping
            for lead in (short, long):
                driven = 1.0 + lead * s
                value = np.abs(place.beside.mid * carried + place.through.mid * driven)
                error = place.beside.rad * np.abs(carried) + place.through.rad * np.abs(driven)
                size = np.abs(place.beside.mid * carried) + np.abs(place.through.mid * driven)
                largest = np.maximum(largest, value + error + 1e-12 * size)
        # At the force the loop is divided by the one of the command alone.
        over = np.abs(mass * s + low) * np.maximum(1.0, np.abs(place.beside.mid) - place.beside.rad)
        assert self.asked.modulus is not None
        return bool(np.any(largest * _OUT < self.asked.modulus * over))

    def _is_slow(self, cell: Cell) -> bool:
        """Return whether the free-space admittance is too small at some frequency of the band for all laws."""
        if self.band is None or self.band.follows is None or self.asked.min_m_s_per_n is None:
            return False
        low, _, _, long = cell
        s, beside = self.band.s, np.abs(self.band.beside.mid) - self.band.beside.rad
        most = self.band.follows * np.abs(1.0 + long * s) / (np.abs(self.law.mass_kg * s + low) * np.abs(s) * beside)
        return bool(np.any((beside > 0.0) & (most * _OUT < self.asked.min_m_s_per_n)))

    def _is_noisy(self, cell: Cell) -> bool:
        """Return whether all laws make too much noise in the ticks before the robot answers.

        The command's speed answers a unit of force by (1 + q)/2 times (K_l s + 1)/(M_a s + B_a), q = 1/z. Noise of a
        spectrum is white noise behind a causal filter.
        """
        if self.asked.noise_m_s_per_n is None:
            return False
        low, high, short, long = cell
        heavy = 2.0 * self.law.mass_kg / self.h
        over = heavy + low, heavy + high
        before = (2.0 * short / self.h + 1.0) / over[1], (2.0 * long / self.h + 1.0) / over[0]
        power, answers = (1.0, 1.0), [(0.5 * before[0], 0.5 * before[1])]
        kept = self.law.mass_kg - long * high, self.law.mass_kg - short * low
        poles = (heavy - high) / over[1], (heavy - low) / over[0]
        if poles[0] < 0.0:
            return False
        for _ in range(self.sampled[0].chain_length):
            ends = [4.0 / self.h * k / o**2 * p for k in kept for o in over for p in power]
            now = min(ends), max(ends)
            answers.append((0.5 * (before[0] + now[0]), 0.5 * (before[1] + now[1])))
            before, power = now, (power[0] * poles[0], power[1] * poles[1])
        if self.asked.noise_spectrum is not None:
            answers = _filtered(answers, self.asked.noise_spectrum.pulse(self.h, len(answers)))
        total = sum(max(least, -most, 0.0) ** 2 for least, most in answers)
        return math.sqrt(total) > self.asked.noise_m_s_per_n * _OUT


def _filtered(answers: Sequence[tuple[float, float]], pulse: FloatArray) -> list[tuple[float, float]]:
    """Return between what answers (n, 2), tick by tick, lie behind a filter with this pulse (n,)."""
    between = np.array(answers)
    ends = np.array(
        [
            np.convolve(gain, each)[: len(pulse)]
            for gain in (np.maximum(pulse, 0.0), np.minimum(pulse, 0.0))
            for each in between.T
        ]
    )
    return list(zip(ends[0] + ends[3], ends[1] + ends[2], strict=True))


def _values(ends: FloatArray, along: int) -> dict[int, DualBall]:
    return {
        place: DualBall(ball(float(row[0]), float(row[1])), number(1) if i == along else None)
        for i, (place, row) in enumerate(zip((_DAMPING, _LEAD), ends, strict=True))
    }
