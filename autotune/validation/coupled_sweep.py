"""What several axes do together at the ends of K_e and M_p: margins, stability, contacts at points of the payload."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from autotune.formats.coupled_record import CoupledBody, CoupledCertificate, PointContact, TogetherMargins, Vector
from autotune.formats.units import AXES, ROTATIONAL_AXES, axis_units
from autotune.text import stiffness_text
from problems.arrays import FloatArray
from problems.contact.bouncing import Ending
from problems.contact.coupled_contact import CoupledPair, build_coupled_pair, simulate_coupled_contact
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.model.controller import AdmittanceController
from problems.model.coupled import (
    CoupledLoop,
    CoupledPlant,
    CoupledSampledPlant,
    build_coupled_loop,
    build_coupled_sampled_plant,
)
from problems.model.sampled import build_sampled_plant
from problems.stability.coupled_margins import (
    CoupledMargins,
    coupled_sensitivities,
    find_coupled_margins,
    worst_mode,
)
from problems.stability.margins import Margins, find_margins

from .coupled_cell import UNCOUPLED, CoupledCell

METHOD = "margins searched and contacts simulated on the exact sampled loop of all axes; a sweep, no proof"
# Corners, edges and the middle of a face come first.
_MOST_POINTS = 9
_POINTS = 240  # frequencies at which the axes outside of a group are held against it


@dataclass(frozen=True, kw_only=True)
class CoupledFailure:
    """A plant on which the axes together are unstable, or bounce for ever: where, which mode, which axis moves most."""

    group: tuple[str, ...]
    axis: str
    mode_hz: float
    radius: float
    where: str
    bounces: bool = False

    def message(self) -> str:
        """Return it in a sentence."""
        together = " and ".join([", ".join(self.group[:-1]), self.group[-1]] if len(self.group) > 1 else self.group)
        if self.bounces:
            return f"{together} together bounce for ever {self.where}; {self.axis} moves most, at {self.mode_hz:.3g} Hz"
        return (
            f"{together} act on each other through the payload and are unstable together {self.where}: a mode at "
            f"{self.mode_hz:.3g} Hz grows (largest |z| {self.radius:.6f}), in which {self.axis} moves most"
        )


@dataclass(frozen=True, kw_only=True)
class _Case:
    """A group of axes on one plant."""

    group: tuple[str, ...]
    where: str
    sampled: CoupledSampledPlant
    loop: CoupledLoop


@dataclass(frozen=True, kw_only=True)
class CoupledSweep:
    """What the sweep found: the certificate, or the plant at which it ends."""

    certificate: CoupledCertificate | None
    failure: CoupledFailure | None = None


def sweep_coupled(cell: CoupledCell, body: CoupledBody) -> CoupledSweep:
    """Sweep a cell. Raises ParameterError where no body has such a payload."""
    cases = _all_cases(cell)
    failure = _first_failure(cell, cases)
    points: dict[str, tuple[PointContact, ...]] = {}
    turns = any(each in ROTATIONAL_AXES for each in cell.names)
    for name in cell.domains if turns and failure is None else ():
        if name not in ROTATIONAL_AXES:
            contacts = _touch(cell, name)
            if isinstance(contacts, CoupledFailure):
                failure = contacts
                break
            points[name] = contacts
    if failure is not None:
        return CoupledSweep(certificate=None, failure=failure)
    found = [(case, _margins(cell, case)) for case in cases]
    apart = {name: _apart(cell, name) for name in cell.domains}
    single = [apart[group[0]] for group in cell.groups() if len(group) == 1 and group[0] in apart]
    every: list[Margins | CoupledMargins] = [*single, *(margins for _, margins in found)]
    worst = min(every, key=lambda each: each.modulus)
    return CoupledSweep(
        certificate=CoupledCertificate(
            axes=tuple(cell.domains),
            body=body,
            groups=cell.groups(),
            coupling=float(np.max(cell.strengths())),
            uncoupled=UNCOUPLED,
            neglected=_neglected(cell),
            modulus=worst.modulus,
            modulus_hz=worst.modulus_hz,
            modulus_apart=min(each.modulus for each in apart.values()),
            disk=min(each.disk for each in every),
            spectral_radius=max(each.spectral_radius for each in every),
            loops=_loops(found, cell),
            points=points,
            method=METHOD,
        )
    )


def coupled_plants(cell: CoupledCell) -> Iterator[tuple[tuple[str, ...], CoupledPlant]]:
    """Yield every group of more than one axis on every plant of the sweep."""
    for group, _, plant in _plants(cell):
        yield group, plant


def _plants(cell: CoupledCell) -> Iterator[tuple[tuple[str, ...], str, CoupledPlant]]:
    """Yield groups in free space and touching along each of their axes, at the ends of mass and stiffness."""
    groups = [group for group in cell.groups() if len(group) > 1 and any(name in cell.laws for name in group)]
    for group, mass in itertools.product(groups, cell.masses_kg):
        yield group, f"in free space, M_p {mass:.4g} kg", cell.plant(group, mass)
        for name in group:
            for stiffness in cell.stiffnesses(name) if name in cell.domains else ():
                where = f"touching along {name}, K_e {stiffness_text(stiffness, axis_units(name))}, M_p {mass:.4g} kg"
                yield group, where, cell.plant(group, mass, cell.surface(group, name, stiffness))


def _case(cell: CoupledCell, group: tuple[str, ...], where: str, plant: CoupledPlant) -> _Case:
    sampled = build_coupled_sampled_plant(plant, cell.sample_time_s)
    return _Case(group=group, where=where, sampled=sampled, loop=build_coupled_loop(sampled, cell.law(group)))


def _all_cases(cell: CoupledCell) -> list[_Case]:
    """Return the groups on the plants of the sweep, their loops closed."""
    return [_case(cell, *each) for each in _plants(cell)]


def _first_failure(cell: CoupledCell, cases: Sequence[_Case]) -> CoupledFailure | None:
    """Return the first unstable one of the groups' cases, then of all axes together where they are no group."""
    whole = _whole_plants(cell) if cell.groups() != (cell.names,) else ()
    for case in itertools.chain(cases, (_case(cell, cell.names, *each) for each in whole)):
        failure = find_failure(case)
        if failure is not None:
            return failure
    return None


def find_failure(case: _Case, *, bounces: bool = False) -> CoupledFailure | None:
    """Return the mode that grows, or with `bounces` the slowest one; None where all decay."""
    mode = worst_mode(case.sampled, case.loop)
    if mode.radius < 1.0 and not bounces:
        return None
    return CoupledFailure(
        group=case.group,
        axis=case.group[mode.axis],
        mode_hz=mode.frequency_hz,
        radius=mode.radius,
        where=case.where,
        bounces=bounces,
    )


def first_failure(cell: CoupledCell) -> CoupledFailure | None:
    """Return the first plant of the sweep on which the axes together are unstable, without margins and contacts."""
    return _first_failure(cell, _all_cases(cell))


def damped_by(cell: CoupledCell, factor: float) -> CoupledCell:
    """Return the cell with `factor` times M_a and B_a on every axis."""
    laws = {
        name: law and replace(law, mass_kg=factor * law.mass_kg, damping_n_s_per_m=factor * law.damping_n_s_per_m)
        for name, law in cell.laws.items()
    }
    return replace(cell, laws=laws)


def _margins(cell: CoupledCell, case: _Case) -> CoupledMargins:
    return find_coupled_margins(case.sampled, cell.law(case.group), cell.scale(case.group), case.loop)


def _loops(found: Sequence[tuple[_Case, CoupledMargins]], cell: CoupledCell) -> dict[str, TogetherMargins]:
    """Return the least margins of each axis with the loops of the others closed."""
    loops: dict[str, TogetherMargins] = {}
    for case, margins in found:
        driven = [name for name in case.group if name in cell.laws]
        for name, each in zip(driven, margins.loops, strict=True):
            before = loops.get(name, TogetherMargins(modulus=math.inf, disk=math.inf))
            loops[name] = TogetherMargins(modulus=min(before.modulus, each.modulus), disk=min(before.disk, each.disk))
    return loops


def _law(cell: CoupledCell, name: str) -> AdmittanceController:
    law = cell.laws[name]
    if law is None:
        raise KeyError(name)
    return law


def _apart(cell: CoupledCell, name: str) -> Margins:
    """Return the margins of one axis alone at that of the same plants which has the least modulus."""
    domain = cell.domains[name]
    masses = cell.masses_kg if name not in ROTATIONAL_AXES else _inertias(cell, name)
    plants = [domain.plants.at(mass, stiffness) for mass in masses for stiffness in (0.0, *cell.stiffnesses(name))]
    law = _law(cell, name)
    found = [find_margins(build_sampled_plant(plant, cell.sample_time_s), law) for plant in plants]
    return min(found, key=lambda each: each.modulus)


def _inertias(cell: CoupledCell, name: str) -> tuple[float, ...]:
    i = AXES.index(name) - 3
    nominal = float(cell.payload.inertia_S_kg_m2[i, i])
    return tuple(nominal * mass / cell.payload.mass_kg for mass in cell.masses_kg)


def _neglected(cell: CoupledCell) -> float:
    """Return the largest share of its modulus that a group loses to the axes outside of it, whose loops are closed.

    With S₀ of the groups apart and S of the whole, S_gg = S₀_g X and σ_min of the group is at least that of S₀_g over
    ‖X‖, frequency by frequency.
    """
    names = cell.names
    groups = {name: place for place, group in enumerate(cell.groups()) for name in group}
    own = np.array([[groups[a] == groups[b] for b in names] for a in names])
    if np.all(own) or np.max(cell.strengths()[~own]) == 0.0:
        return 0.0
    driven, worst = [name for name in names if name in cell.laws], 1.0
    grid = np.geomspace(2.0 * np.pi * 0.02, 0.999 * np.pi / cell.sample_time_s, _POINTS)
    for _, plant in _whole_plants(cell):
        apart = replace(plant, mass_matrix=np.where(own, plant.mass_matrix, 0.0))
        whole, alone = (
            coupled_sensitivities(
                build_coupled_sampled_plant(each, cell.sample_time_s), cell.law(names), cell.scale(names), grid
            )
            for each in (plant, apart)
        )
        for group in cell.groups():
            places = [driven.index(name) for name in group if name in driven]
            block = np.ix_(range(2), range(len(grid)), places, places)
            if places:
                change = np.linalg.solve(alone[block], whole[block])
                worst = max(worst, float(np.max(np.linalg.norm(change, ord=2, axis=(-2, -1)))))
    return 1.0 - 1.0 / worst


def _whole_plants(cell: CoupledCell) -> Iterator[tuple[str, CoupledPlant]]:
    """Yield all axes in free space and touching along each of them, at the ends of mass and stiffness."""
    for mass in cell.masses_kg:
        yield f"in free space, M_p {mass:.4g} kg", cell.plant(cell.names, mass)
        for name in cell.domains:
            for stiffness in cell.domains[name].environment_stiffness_n_per_m:
                where = f"touching along {name}, K_e {stiffness_text(stiffness, axis_units(name))}, M_p {mass:.4g} kg"
                yield where, cell.plant(cell.names, mass, cell.surface(cell.names, name, stiffness))


@dataclass(frozen=True, kw_only=True)
class _Touching:
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
        law = _law(self.cell, self.name)
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


def _touch(cell: CoupledCell, name: str) -> tuple[PointContact, ...] | CoupledFailure:
    """Return the worst contact of one axis with each point of the payload, or the one that does not come to rest."""
    touching, found = _Touching(cell=cell, name=name), []
    force, speed = touching.force()
    for point in touching.points():
        ratio, leaves, found_here = 0.0, 0, []
        for mass, stiffness in touching.plants:
            pair = touching.pair(point, mass, stiffness)
            at = "(" + ", ".join(f"{each:.3g}" for each in point) + ") m"
            where = (
                f"touching along {name} at {at}, K_e {stiffness_text(stiffness, axis_units(name))}, M_p {mass:.4g} kg"
            )
            cases = [
                _Case(group=cell.names, where=where, sampled=pair.contact, loop=pair.contact_loop),
                _Case(group=cell.names, where=where, sampled=pair.free, loop=pair.free_loop),
            ]
            failure = next((each for case in cases if (each := find_failure(case)) is not None), None)
            if failure is not None:
                return failure
            seen = simulate_coupled_contact(pair, force, speed)
            if seen.ending is Ending.BOUNCING:
                return find_failure(cases[0], bounces=True)  # type: ignore[return-value]  # never None then
            found_here.append((seen.peak_contact_force_n, seen.time_of_peak_s, stiffness, mass))
            leaves = max(leaves, seen.leaves)
            ratio = max(ratio, seen.peak_contact_force_n / touching.alone_n[mass, stiffness])
        peak, when, stiffness, mass = max(found_here)
        found.append(
            PointContact(
                point_m=point,
                environment_stiffness_n_per_m=stiffness,
                payload_mass_kg=mass,
                peak_contact_force_n=peak,
                time_of_peak_s=when,
                largest_ratio=ratio,
                leaves=float(leaves),
            )
        )
    return tuple(found)
