"""Contacts of a payload's points while all axes act on each other: peaks, and whether they come to rest."""

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autotune.formats.coupled_record import PointContact, Vector
from problems.arrays import FloatArray
from problems.contact.bouncing import Ending
from problems.contact.coupled_contact import CoupledContact, CoupledPair, build_coupled_pair, simulate_coupled_contact
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.coupled import CoupledLoop, CoupledSampledPlant, build_coupled_loop, build_coupled_sampled_plant
from problems.model.sampled import build_sampled_plant
from problems.stability.coupled_margins import find_coupled_margins

from .coupled_cell import CoupledCell
from .coupled_failure import CoupledCase, CoupledFailure, TouchedPoint, find_failure, slowest_mode

# Corners, edges and the middle of a face come first.
_MOST_POINTS = 9


def law_of(cell: CoupledCell, name: str) -> AdmittanceController:
    """Return the law of a tuned axis."""
    law = cell.laws[name]
    if law is None:
        raise KeyError(name)
    return law


@dataclass(frozen=True, kw_only=True)
class Touching:
    """One axis that touches with points of the payload: the plants, its peak alone on each, and the free cell."""

    cell: CoupledCell
    name: str

    @cached_property
    def plants(self) -> tuple[tuple[float, float], ...]:
        """The ends of mass and stiffness."""
        return tuple(itertools.product(self.cell.masses_kg, self.cell.stiffnesses(self.name)))

    @cached_property
    def alone_n(self) -> dict[tuple[float, float], float]:
        """The peak of the axis alone."""
        domain, h = self.cell.domains[self.name], self.cell.sample_time_s
        pairs = {
            (mass, stiffness): build_sampled_contact(build_sampled_plant(domain.plants.at(mass, stiffness), h))
            for mass, stiffness in self.plants
        }
        law = law_of(self.cell, self.name)
        return {
            plant: simulate_contact(pair, law, domain.approach).peak_contact_force_n for plant, pair in pairs.items()
        }

    @cached_property
    def free(self) -> dict[float, tuple[CoupledSampledPlant, CoupledLoop]]:
        """The cell in free space, by mass."""
        found = {}
        for mass in self.cell.masses_kg:
            sampled = build_coupled_sampled_plant(self.cell.plant(self.cell.names, mass), self.cell.sample_time_s)
            found[mass] = sampled, build_coupled_loop(sampled, self.cell.law(self.cell.names))
        return found

    def pair(self, point: Vector, mass: float, stiffness: float) -> CoupledPair:
        """Return the cell on the surface."""
        cell, names = self.cell, self.cell.names
        plant = cell.plant(names, mass, cell.surface_at(names, self.name, point, stiffness))
        normal = np.array([float(each == self.name) for each in names])
        return build_coupled_pair(plant, cell.law(names), cell.sample_time_s, free=self.free[mass], normal=normal)

    def points(self) -> tuple[Vector, ...]:
        """Return the points that differ: what is beside the known axes makes no difference. The first of too many."""
        names = self.cell.names
        found: dict[tuple[float, ...], Vector] = {}
        for point in self.cell.touched(self.name):
            direction = self.cell.surface_at(names, self.name, point, 1.0).direction
            found.setdefault(tuple(np.round(direction, 9).tolist()), point)
        points = tuple(found.values())
        return points if self.cell.contact_points_m else points[:_MOST_POINTS]

    def force(self) -> tuple[FloatArray, float | None]:
        """Return F^d (k,) along the axis, and the speed where the approach says one."""
        approach = self.cell.domains[self.name].approach
        along = np.array([float(each == self.name) for each in self.cell.names])
        return along * (approach.force_n or 1.0), approach.speed_m_s

    def end(self, at: TouchedPoint) -> CoupledContact | CoupledFailure:
        """Return the contact with a point on one plant, or what of it is unstable or does not come to rest."""
        pair = self.pair(at.point_m, at.mass_kg, at.stiffness_n_per_m)
        names, where = self.cell.names, at.where()
        cases = [
            CoupledCase(group=names, where=where, sampled=pair.contact, loop=pair.contact_loop),
            CoupledCase(group=names, where=where, sampled=pair.free, loop=pair.free_loop),
        ]
        failure = next((each for case in cases if (each := find_failure(case)) is not None), None)
        if failure is None:
            found = simulate_coupled_contact(pair, *self.force())
            if found.ending is not Ending.BOUNCING:
                return found
            failure = slowest_mode(cases[0], bounces=True)
        return replace(failure, touched=at)

    def contacts(self) -> Iterator[CoupledFailure | PointContact]:
        """Yield the worst contact with each point of the payload, or the first one that fails."""
        for point in self.points():
            ratio, leaves, worst = 0.0, 0, None
            for mass, stiffness in self.plants:
                at = TouchedPoint(name=self.name, point_m=point, mass_kg=mass, stiffness_n_per_m=stiffness)
                seen = self.end(at)
                if isinstance(seen, CoupledFailure):
                    yield seen
                    return
                found = seen.peak_contact_force_n, seen.time_of_peak_s, stiffness, mass
                worst = found if worst is None else max(worst, found)
                leaves = max(leaves, seen.leaves)
                ratio = max(ratio, seen.peak_contact_force_n / self.alone_n[mass, stiffness])
            if worst is not None:
                peak, when, stiffness, mass = worst
                yield PointContact(
                    point_m=point,
                    environment_stiffness_n_per_m=stiffness,
                    payload_mass_kg=mass,
                    peak_contact_force_n=peak,
                    time_of_peak_s=when,
                    largest_ratio=ratio,
                    leaves=float(leaves),
                )


def first_bounce(cell: CoupledCell, touched: Iterable[TouchedPoint]) -> CoupledFailure | None:
    """Return what fails of these contacts, None where all come to rest."""
    ends = (Touching(cell=cell, name=at.name).end(at) for at in touched)
    return next((each for each in ends if isinstance(each, CoupledFailure)), None)


def swept_at_points(cell: CoupledCell, points: Mapping[str, Sequence[Vector]]) -> float:
    """Return the least σ_min(I + L) at forces and commands of all axes, over points, K_e (ends and middle) and M_p."""
    names, found = cell.names, []
    for name, mass in itertools.product(points, cell.masses_kg):
        for point, stiffness in itertools.product(points[name], cell.stiffnesses(name)):
            plant = cell.plant(names, mass, cell.surface_at(names, name, point, stiffness))
            sampled = build_coupled_sampled_plant(plant, cell.sample_time_s)
            found.append(find_coupled_margins(sampled, cell.law(names), cell.scale(names)).modulus)
    return min(found)


def touch(cell: CoupledCell, name: str) -> tuple[PointContact, ...] | CoupledFailure:
    """Return the worst contact of one axis with each point of the payload, or the one that does not come to rest."""
    found: list[PointContact] = []
    for each in Touching(cell=cell, name=name).contacts():
        if isinstance(each, CoupledFailure):
            return each
        found.append(each)
    return tuple(found)
