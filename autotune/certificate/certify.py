"""Prove what is claimed of a loop, for every plant of its families at every frequency, or say where that ends."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from problems.arrays import FloatArray, IntArray
from problems.errors import ParameterError
from problems.model.sampled import Controller, build_loop, build_sampled_plant, stability_matrix

from . import rational
from .balls import Balls, as_series, derivatives_of, enclose
from .base_plant import fails_at, is_stable
from .bounds import PlantCell, Verdicts, judge, judge_at_rest
from .circle import Circle
from .family import LATE, Claim, CombinedCertificate, Family, ProofOutcome, Verdict, families_of
from .law import law_polynomials
from .plant_cells import Groups, Raw, coefficients, loop_groups, with_derivatives
from .plant_polynomials import plant_polynomials

# Work is counted in arcs judged, so that the same claim ends the same way on every machine; a cell of plants costs as
# much as this many.
CELL_WORK = 300
_NARROWEST_ARC = 1e-9
_AT_ONCE = 4096
# Arcs below this angle [rad/sample] are judged with the factor of the integrator taken out, if a spring is soft.
_NEAR_REST = 0.02
_MOST_CORNERS = 4  # of more coordinates the corners are left to the cells

METHOD = "zero exclusion on the unit circle in ball arithmetic"


@dataclass(frozen=True, kw_only=True)
class _Part:
    """A cell of plants (d, 2), the arcs on which it is not proved yet, and its share of the whole set."""

    cell: FloatArray
    arcs: IntArray
    share: float


def prove(claim: Claim, progress: Callable[[float], None] | None = None) -> CombinedCertificate:
    """Prove a claim, or find out where that ends.

    Parameters
    ----------
    claim
        What is to be proved; its work is shared by all parts.
    progress
        Is passed the share of the work done since the last call.

    Returns
    -------
    CombinedCertificate
        The parts in free space and in contact; the first that is refuted is the last.

    Raises
    ------
    ParameterError
        For parameters that cannot be proved over.
    """
    places = families_of(claim)
    every = [family for of_place in zip(*places.values(), strict=True) for family in of_place]

    def part_done(done: float) -> None:
        if progress is not None:
            progress(done / len(every))

    parts: list[ProofOutcome] = []
    for family in every:
        left = max(claim.work - sum(part.work for part in parts), 0)
        parts.append(certify(family, claim.law, claim.modulus, work=left, progress=part_done))
        if parts[-1].verdict is Verdict.REFUTED:
            break
    return CombinedCertificate(**{name: tuple(parts[i :: len(places)]) for i, name in enumerate(places)})


def certify(
    family: Family,
    law: Controller,
    modulus: float | None,
    *,
    work: int,
    progress: Callable[[float], None] | None = None,
) -> ProofOutcome:
    """Prove that the exact sampled loop is stable with |1 + L| > `modulus` at both break points, for all plants.

    No cell of plants × arc of the unit circle holds a zero of the closed loop; as poles depend continuously on the
    plant and one plant is stable, all are.

    Parameters
    ----------
    family
        The plants.
    law
        Any linear law under the hold of the family.
    modulus
        Between 0 and 1; None claims stability alone.
    work
        Bound of the effort: arcs judged, and `CELL_WORK` for each cell of plants.
    progress
        Is passed the share of the set proved since the last call.

    Returns
    -------
    ProofOutcome
        Proved, refuted with plant and frequency, or how far the proof got.

    Raises
    ------
    ValueError
        For a modulus that is not between 0 and 1.
    ParameterError
        For a law of another sample time, or one that reads the position beside a wrench that is late.
    """
    if modulus is not None and not 0.0 < modulus < 1.0:
        raise ValueError(f"modulus must be between 0 and 1, found {modulus!r}")
    search = _Search(family, law, modulus or 0.0)
    unstable = search.unstable_base()
    if unstable is not None:
        return unstable
    while search.waiting and not search.is_stuck and search.work < work:
        before = search.share
        refuted = search.step()
        if refuted is not None:
            return refuted
        if progress is not None and search.share > before:
            progress(search.share - before)
    return search.outcome()


# Several claims are about one law, and its factors on an arc are the same for all plants.
_polynomials_of = lru_cache(maxsize=16)(law_polynomials)
_circle_of = lru_cache(maxsize=16)(Circle)


class _Search:
    """The cells still to be proved, the softest on top, and what was counted so far."""

    def __init__(self, family: Family, law: Controller, modulus: float) -> None:
        self.family, self.controller, self.modulus = family, law, modulus
        self.law = _polynomials_of(law, family.sample_time_s)
        if family.shared_delay is not None and (self.law.position or self.law.follows):
            must = "0 for a law that reads the position too, which is not late"
            raise ParameterError(LATE, family.shared_delay[1], must)
        self.is_deflated = family.is_free_space and not self.law.holds_position
        self.box = family.box()
        whole, has_fraction = family.delay()
        chain = whole + int(has_fraction)
        whole_box = plant_polynomials(family, self.box)
        sizes = tuple(len(part) for part in self._groups(whole_box))
        self.circle = _circle_of(self.law, chain, sizes, is_deflated=self.is_deflated)
        self.at_rest: Circle | None = None
        if family.is_soft and not self.law.holds_position:
            sizes = tuple(len(part) for part in self._groups_at_rest(whole_box))
            self.at_rest = _circle_of(self.law, chain, (*sizes, 1), is_deflated=True, pull=True)
        first = np.arange(self.circle.count_of_first)
        # What is false is mostly false at a corner of the set, and one plant is judged at once.
        points = [_Part(cell=np.stack([end, end], axis=1), arcs=first, share=0.0) for end in self._corners()]
        self.waiting = [_Part(cell=self.box, arcs=first, share=1.0), *(points if modulus > 0.0 else [])]
        self.work, self.cells, self.arcs, self.share, self.is_stuck = 0, 0, 0, 0.0, False

    def _corners(self) -> list[FloatArray]:
        """Return the corners of the box; none where there are too many, or where one plant is all of it."""
        if not 0 < len(self.box) <= _MOST_CORNERS:
            return []
        corners = itertools.product((0, 1), repeat=len(self.box))
        found = [self.box[np.arange(len(self.box)), list(corner)] for corner in corners]
        # A stiffness of 0 bounds the set and is not of it.
        return [each for each in found if not self._reaches_zero(each[:, None])]

    def _reaches_zero(self, cell: FloatArray) -> bool:
        """Return whether plants of a cell (d, 2) come as near as one likes to those that nothing holds."""
        return self.at_rest is not None and self.family.is_held_by_nothing(cell)

    def unstable_base(self) -> ProofOutcome | None:
        """Return the refutation, or the lack of proof, by the plant in the middle; None if it is stable.

        A zero on the circle says little where stability alone is claimed, so the corners are looked at too.
        """
        middle = np.mean(self.box, axis=1)
        stable = is_stable(self.family, self.controller, middle)
        if not stable:
            verdict = Verdict.RAN_OUT if stable is None else Verdict.REFUTED
            return self._ended(verdict, middle, self._worst_pole(middle)[1])
        corners = [] if self.modulus > 0.0 else self._corners()
        return next((found for each in corners if (found := self._refuted_by_poles(each)) is not None), None)

    def _worst_pole(self, point: FloatArray) -> tuple[float, float]:
        """Return radius and angle [rad/sample] of the largest pole of one plant, by eigenvalues."""
        sampled = build_sampled_plant(self.family.plant(point), self.family.sample_time_s)
        poles = np.linalg.eigvals(stability_matrix(build_loop(sampled, self.controller)))
        worst = complex(poles[int(np.argmax(np.abs(poles)))])
        return abs(worst), abs(math.atan2(worst.imag, worst.real))

    def step(self) -> ProofOutcome | None:
        """Judge a cell, cut it where its plants are to blame; return the point where the claim is false.

        Of stability alone the widest cells come first: their middles find what is unstable.
        """
        part = self.waiting.pop(-1 if self.modulus > 0.0 else 0)
        raw = self._coefficients(part.cell)
        cell = with_derivatives(part.cell, *map(self._groups, raw))
        soft = None if self.at_rest is None else self._cell_at_rest(part.cell, raw)
        self.work += CELL_WORK
        arcs, left, blame = part.arcs, [np.zeros(0, dtype=np.int64)], np.zeros(len(self.box))
        while len(arcs):
            now, arcs = arcs[:_AT_ONCE], arcs[_AT_ONCE:]
            found = judge(self.circle.at(now), cell, self.modulus)
            if soft is not None:
                found = self._judged_at_rest(now, soft, found)
            self.work += len(now)
            self.arcs += int(np.sum(found.holds))
            failed = ~found.holds
            refuted = self._refuted_on(part, now, np.where(failed, found.middle, np.inf))
            if refuted is not None:
                return refuted
            wide = np.ptp(self.circle.angles(now), axis=1) > _NARROWEST_ARC
            by_plant = failed & (np.argmax(found.blame, axis=1) > 0)
            by_plant |= failed & ~wide
            left.append(now[by_plant])
            blame += np.sum(found.blame[by_plant, 1:], axis=0)
            arcs = np.concatenate([self.circle.halves(now[failed & ~by_plant]), arcs])
        rest = np.concatenate(left)
        if len(rest):
            self._cut(part, rest, blame)
            return None if self.modulus > 0.0 else self._refuted_by_poles(np.mean(part.cell, axis=1))
        self.cells, self.share = self.cells + int(part.share > 0.0), self.share + part.share
        return None

    def _judged_at_rest(self, arcs: IntArray, cell: PlantCell, found: Verdicts) -> Verdicts:
        """Return the verdicts with those of arcs near 0 that do not hold made anew."""
        ends = self.circle.angles(arcs)
        open_arcs = ~found.holds & (ends[:, 1] < _NEAR_REST)
        if self.at_rest is None or not np.any(open_arcs):
            return found
        anew = judge_at_rest(self.at_rest.on(ends[open_arcs]), cell, self.modulus)
        for old, new in ((found.holds, anew.holds), (found.middle, anew.middle), (found.blame, anew.blame)):
            old[open_arcs] = new
        return found

    def _cut(self, part: _Part, arcs: IntArray, blame: FloatArray) -> None:
        if np.all(part.cell[:, 0] == part.cell[:, 1]):
            # One plant and an arc that cannot be cut further: nothing is left to try.
            self.waiting.append(part)
            self.is_stuck = True
            return
        side = int(np.argmax(blame))
        low, high = part.cell[side]
        middle = 0.5 * (low + high)
        upper, lower = part.cell.copy(), part.cell.copy()
        upper[side], lower[side] = (middle, high), (low, middle)
        self.waiting += [_Part(cell=each, arcs=arcs, share=0.5 * part.share) for each in (upper, lower)]

    def _refuted_on(self, part: _Part, arcs: IntArray, middles: FloatArray) -> ProofOutcome | None:
        """Return the refutation of a modulus by the plant in the middle of a cell, on the worst of these arcs."""
        worst = int(np.argmin(middles))
        if middles[worst] >= 0.0 or self.modulus == 0.0:
            return None
        point, angle = np.mean(part.cell, axis=1), float(np.mean(self.circle.angles(arcs[worst : worst + 1])))
        if not fails_at(self.family, self.controller, point, angle, self.modulus):
            return None
        return self._ended(Verdict.REFUTED, point, angle)

    def _refuted_by_poles(self, point: FloatArray) -> ProofOutcome | None:
        """Return the refutation by a plant that is unstable: eigenvalues find it, exact arithmetic decides."""
        radius, angle = self._worst_pole(point)
        if radius < 1.0 or is_stable(self.family, self.controller, point) is not False:
            return None
        return self._ended(Verdict.REFUTED, point, angle)

    def _coefficients(self, cell: FloatArray) -> tuple[Raw, Raw]:
        return coefficients(self.family, cell)

    def _plant_cell(self, cell: FloatArray) -> PlantCell:
        """Return the coefficients over a cell."""
        return with_derivatives(cell, *map(self._groups, self._coefficients(cell)))

    def _groups(self, found: Raw) -> Groups:
        return loop_groups(self.family, self.law, found, is_deflated=self.is_deflated)

    def _groups_at_rest(self, found: Raw) -> Groups:
        """Return the groups with the factor w taken out, without the force at rest."""
        d, force, position = found
        groups = [d, force[1:]]
        if self.law.follows:
            groups.append(rational.add(d, [-1 * each for each in position])[1:])
        if self.law.position:
            groups.append(position)
        return tuple([as_series(each) for each in part] for part in groups)

    def _cell_at_rest(self, cell: FloatArray, found: tuple[Raw, Raw]) -> PlantCell:
        """Return the coefficients for `judge_at_rest`: the last is ½ K₂ n_F'(K) at z = 1, where n_F is 0 for K = 0."""
        _, (_, force, _) = found
        along, stiffest = self.family.springs_of(cell)
        slope = enclose(derivatives_of(force[:1], len(cell))[along])
        slope = slope.times(0.5 * stiffest * (1.0 + 1e-12))
        padding = ((0, 0), (0, len(cell)))
        pull = Balls(mid=np.pad(slope.mid[:, None], padding), rad=np.pad(slope.rad[:, None], padding))
        rest = with_derivatives(cell, *map(self._groups_at_rest, found))
        return PlantCell(groups=(*rest.groups, pull))

    def _ended(self, verdict: Verdict, point: FloatArray, angle: float | None) -> ProofOutcome:
        return ProofOutcome(
            verdict=verdict,
            modulus=self.modulus,
            cells=self.cells,
            arcs=self.arcs,
            work=self.work,
            share=self.share,
            plant=self.family.scenario(point),
            frequency_rad_per_s=None if angle is None else angle / self.family.sample_time_s,
        )

    def outcome(self) -> ProofOutcome:
        """Return what is proved now that nothing waits or the work is spent."""
        if self.waiting:
            middle = np.mean(self.waiting[-1].cell, axis=1)
            up_to = self.family.softest_of([part.cell for part in self.waiting])
            return replace(self._ended(Verdict.RAN_OUT, middle, None), stiffness_up_to_n_per_m=up_to)
        return ProofOutcome(
            verdict=Verdict.PROVED, modulus=self.modulus, cells=self.cells, arcs=self.arcs, work=self.work, share=1.0
        )
