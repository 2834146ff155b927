"""What several axes do together at the ends of K_e and M_p: margins, stability, contacts at points of the payload."""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.formats.coupled_record import CoupledBody, CoupledCertificate, PointContact, TogetherMargins
from autotune.formats.units import AXES, ROTATIONAL_AXES, axis_units
from autotune.text import stiffness_text
from problems.model.coupled import CoupledPlant, Law, build_coupled_loop, build_coupled_sampled_plant
from problems.model.sampled import build_sampled_plant
from problems.stability.coupled_margins import (
    CoupledMargins,
    coupled_sensitivities,
    find_coupled_margins,
    find_coupled_modulus,
)
from problems.stability.margins import Margins, find_margins

from .coupled_cell import UNCOUPLED, CoupledCell
from .coupled_failure import CoupledCase, CoupledFailure, TouchedPoint, find_failure, weak_modulus
from .coupled_points import first_bounce, law_of, touch

METHOD = "margins searched and contacts simulated on the exact sampled loop of all axes; a sweep, no proof"
_POINTS = 240  # frequencies at which the axes outside of a group are held against it


@dataclass(frozen=True, kw_only=True)
class CoupledSweep:
    """What the sweep found: the certificate, or the plant at which it ends."""

    certificate: CoupledCertificate | None
    failure: CoupledFailure | None = None


def sweep_coupled(cell: CoupledCell, body: CoupledBody, least_modulus: float | None = None) -> CoupledSweep:
    """Sweep a cell; below the `least_modulus` it fails. Raises ParameterError where no body has such a payload."""
    cases = _all_cases(cell)
    failure = _first_failure(cell, cases)
    points: dict[str, tuple[PointContact, ...]] = {}
    turns = any(each in ROTATIONAL_AXES for each in cell.names)
    for name in cell.domains if turns and failure is None else ():
        if name not in ROTATIONAL_AXES:
            contacts = touch(cell, name)
            if isinstance(contacts, CoupledFailure):
                failure = contacts
                break
            points[name] = contacts
    if failure is not None:
        return CoupledSweep(certificate=None, failure=failure)
    found = [(case, _margins(cell, case)) for case in cases]
    if least_modulus is not None:
        weak = min(found, key=lambda each: each[1].modulus, default=None)
        if weak is not None and weak[1].modulus < least_modulus:
            case, margins = weak
            missed = weak_modulus(case, (margins.modulus, margins.modulus_hz), least_modulus)
            return CoupledSweep(certificate=None, failure=missed)
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
            min_modulus=least_modulus,
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


def _case(cell: CoupledCell, group: tuple[str, ...], where: str, plant: CoupledPlant) -> CoupledCase:
    sampled = build_coupled_sampled_plant(plant, cell.sample_time_s)
    return CoupledCase(group=group, where=where, sampled=sampled, loop=build_coupled_loop(sampled, cell.law(group)))


def _all_cases(cell: CoupledCell) -> list[CoupledCase]:
    """Return the groups on the plants of the sweep, their loops closed."""
    return [_case(cell, *each) for each in _plants(cell)]


def _first_failure(cell: CoupledCell, cases: Sequence[CoupledCase]) -> CoupledFailure | None:
    """Return the first unstable one of the groups' cases, then of all axes together where they are no group."""
    whole = _whole_plants(cell) if cell.groups() != (cell.names,) else ()
    for case in itertools.chain(cases, (_case(cell, cell.names, *each) for each in whole)):
        failure = find_failure(case)
        if failure is not None:
            return failure
    return None


class CoupledPlants:
    """The plants of a sweep, sampled once, for many laws on them: stability, and `least_modulus` where one is asked.

    Of the contacts with points of the payload only those `touched` are asked, which must come to rest.
    """

    def __init__(
        self, cell: CoupledCell, touched: Sequence[TouchedPoint] = (), least_modulus: float | None = None
    ) -> None:
        self.cell, self.least_modulus = cell, least_modulus
        self.touched = tuple(touched)
        whole = _whole_plants(cell) if cell.groups() != (cell.names,) else ()
        every = (*_plants(cell), *((cell.names, *each) for each in whole))
        self._groups = {group for group in cell.groups() if len(group) > 1}
        self._sampled = [
            (group, where, build_coupled_sampled_plant(plant, cell.sample_time_s)) for group, where, plant in every
        ]

    def failure(self, laws: Mapping[str, Law], among: tuple[str, ...] = ()) -> CoupledFailure | None:
        """Return what fails first with these laws, None where nothing does; `among` one group of axes alone."""
        cell = replace(self.cell, laws=laws)
        for place, (group, where, sampled) in enumerate(self._sampled):
            if among and among not in (group, cell.names):
                continue
            loop = build_coupled_loop(sampled, cell.law(group))
            case = CoupledCase(group=group, where=where, sampled=sampled, loop=loop)
            failure = find_failure(case)
            if failure is None and self.least_modulus is not None and group in self._groups:
                modulus, hz = find_coupled_modulus(sampled, cell.law(group), cell.scale(group), loop)
                if modulus < self.least_modulus:
                    failure = weak_modulus(case, (modulus, hz), self.least_modulus)
            if failure is not None:
                # The next laws are much like these, and fail at the same plant.
                self._sampled.insert(0, self._sampled.pop(place))
                return failure
        return first_bounce(cell, self.touched) if among in ((), cell.names) else None


def damped_by(cell: CoupledCell, factor: float) -> CoupledCell:
    """Return the cell with `factor` times M_a and B_a on every axis."""
    laws = {
        name: law and replace(law, mass_kg=factor * law.mass_kg, damping_n_s_per_m=factor * law.damping_n_s_per_m)
        for name, law in cell.laws.items()
    }
    return replace(cell, laws=laws)


def _margins(cell: CoupledCell, case: CoupledCase) -> CoupledMargins:
    return find_coupled_margins(case.sampled, cell.law(case.group), cell.scale(case.group), case.loop)


def _loops(found: Sequence[tuple[CoupledCase, CoupledMargins]], cell: CoupledCell) -> dict[str, TogetherMargins]:
    """Return the least margins of each axis with the loops of the others closed."""
    loops: dict[str, TogetherMargins] = {}
    for case, margins in found:
        driven = [name for name in case.group if name in cell.laws]
        for name, each in zip(driven, margins.loops, strict=True):
            before = loops.get(name, TogetherMargins(modulus=math.inf, disk=math.inf))
            loops[name] = TogetherMargins(modulus=min(before.modulus, each.modulus), disk=min(before.disk, each.disk))
    return loops


def _apart(cell: CoupledCell, name: str) -> Margins:
    """Return the margins of one axis alone at that of the same plants which has the least modulus."""
    domain = cell.domains[name]
    masses = cell.masses_kg if name not in ROTATIONAL_AXES else _inertias(cell, name)
    plants = [domain.plants.at(mass, stiffness) for mass in masses for stiffness in (0.0, *cell.stiffnesses(name))]
    law = law_of(cell, name)
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
