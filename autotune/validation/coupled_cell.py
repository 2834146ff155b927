"""The axes of a controller file on one payload: the plants that its certificate of all axes together speaks of."""

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.coupled_record import CoupledBody, HeldAxis, Vector
from autotune.formats.units import AXES, ROTATIONAL_AXES
from problems.arrays import FloatArray
from problems.model.axis_kind import LEVER_M
from problems.model.coupled import CoupledPlant, Law, PointSurface, RigidPayload, contact_direction
from problems.model.plant import Coupling, Environment, PayloadDynamics, Plant
from problems.model.robot import RobotModel

UNCOUPLED = 0.1
"""Largest |M_ij|/√(M_ii M_jj) between two axes that are not checked together: κ² of a mode's mass, a hundredth."""
# Where the robot holds an axis its own dynamics do not matter; these are over in a sample or two.
_HELD_ROBOT = RobotModel.from_bandwidth(bandwidth_rad_per_s=1e3, delay_s=0.0)


@dataclass(frozen=True, kw_only=True)
class CoupledCell:
    """The known axes of a cell in the order x to rz, their laws (None: held), and the payload they share.

    `domains` are those of the tuned axes, `held` the others. Everything but K_e and the mass is nominal; the inertia
    goes with the mass.
    """

    domains: Mapping[str, AxisDomain]
    laws: Mapping[str, Law]
    held: Mapping[str, HeldAxis]
    payload: RigidPayload
    contact_points_m: tuple[Vector, ...]
    sample_time_s: float

    @classmethod
    def of(cls, controller: Controller, body: CoupledBody) -> "CoupledCell":
        """Return the cell of a controller whose payload is `body`."""
        domains = {name: controller.certificate.domain[name] for name in controller.axes}
        laws = {name: admittance_controller(controller, name) for name in domains}
        return cls.build(domains, laws, body, controller.sample_time_s)

    @classmethod
    def build(
        cls, domains: Mapping[str, AxisDomain], laws: Mapping[str, Law], body: CoupledBody, sample_time_s: float
    ) -> "CoupledCell":
        """Return the cell of laws, one for every domain, whose payload is `body`."""
        return cls(
            domains=domains,
            laws=laws,
            held=dict(body.held),
            payload=body.rigid(),
            contact_points_m=body.contact_points_m,
            sample_time_s=sample_time_s,
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The axes that are known."""
        return tuple(name for name in AXES if name in self.domains or name in self.held)

    @cached_property
    def masses_kg(self) -> tuple[float, ...]:
        """The ends of the payload's mass."""
        straight = [each for name, each in self.domains.items() if name not in ROTATIONAL_AXES]
        return tuple(sorted(set(straight[0].payload_mass_kg))) if straight else (self.payload.mass_kg,)

    def stiffnesses(self, name: str) -> tuple[float, ...]:
        """Return the ends of K_e of a tuned axis and their geometric mean."""
        low, high = self.domains[name].environment_stiffness_n_per_m
        return tuple(sorted({low, math.sqrt(low * high), high}))

    def mass_matrix(self, names: tuple[str, ...], mass_kg: float) -> FloatArray:
        """Return M (k, k) of some axes for a payload of this mass."""
        places = [AXES.index(name) for name in names]
        whole = self.payload.scaled(mass_kg / self.payload.mass_kg).mass_matrix
        return np.asarray(whole[np.ix_(places, places)])

    def plant(self, names: tuple[str, ...], mass_kg: float, surface: PointSurface | None = None) -> CoupledPlant:
        """Return some axes in free space or on a surface; raises ParameterError where no body has such a payload."""
        matrix = self.mass_matrix(names, mass_kg)
        plants = tuple(self._axis(name, float(matrix[i, i])) for i, name in enumerate(names))
        return CoupledPlant(plants=plants, mass_matrix=matrix, surface=surface)

    def law(self, names: tuple[str, ...]) -> tuple[Law, ...]:
        """Return the laws of some axes."""
        return tuple(self.laws.get(name) for name in names)

    def scale(self, names: tuple[str, ...]) -> FloatArray:
        """Return 1 for each axis along which, and the lever for each about which something moves."""
        return np.array([LEVER_M if name in ROTATIONAL_AXES else 1.0 for name in names])

    def surface(self, names: tuple[str, ...], name: str, stiffness: float) -> PointSurface:
        """Return what one axis touches alone, square to it and in line with the sensor's origin."""
        damping = self.domains[name].environment_damping_n_s_per_m
        direction = np.array([float(each == name) for each in names])
        return PointSurface(
            direction=direction, environment=Environment(stiffness_n_per_m=stiffness, damping_n_s_per_m=damping)
        )

    def surface_at(self, names: tuple[str, ...], name: str, point_m: Vector, stiffness: float) -> PointSurface:
        """Return the same surface where a point of the payload touches it."""
        alone = self.surface(names, name, stiffness)
        whole = contact_direction(point_m, [float(each == name) for each in AXES[:3]])
        return PointSurface(direction=whole[[AXES.index(each) for each in names]], environment=alone.environment)

    def strengths(self) -> FloatArray:
        """Return |M_ij|/√(M_ii M_jj) between the known axes, 0 on the diagonal."""
        matrix = np.abs(self.mass_matrix(self.names, self.payload.mass_kg))
        size = np.sqrt(np.diag(matrix))
        return np.asarray(matrix / np.outer(size, size) - np.eye(len(size)))

    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Return the known axes in groups that the payload does not couple by more than `UNCOUPLED`."""
        near, left, found = self.strengths() > UNCOUPLED, list(range(len(self.names))), []
        while left:
            group, edge = {left[0]}, {left[0]}
            while edge:
                edge = {j for i in edge for j in np.flatnonzero(near[i]).tolist()} - group
                group |= edge
            found.append(tuple(self.names[i] for i in sorted(group)))
            left = [i for i in left if i not in group]
        return tuple(found)

    def touched(self, name: str) -> Iterator[Vector]:
        """Yield the points of the payload that may touch a surface square to a straight axis.

        The given ones, else the middle, edges and corners of a face of the box around the centre of mass that has the
        payload's inertia, and half way to them; how far it goes along the axis makes no difference.
        """
        if self.contact_points_m:
            yield from self.contact_points_m
            return
        half, centre, along = self.half_edges_m(), self.payload.com_S_m, AXES.index(name)
        others = [i for i in range(3) if i != along]
        for shares in itertools.product((0.0, -1.0, 1.0, -0.5, 0.5), repeat=2):
            point = [float(each) for each in centre]
            point[along] += half[along]
            for i, share in zip(others, shares, strict=True):
                point[i] += share * half[i]
            yield point[0], point[1], point[2]

    def half_edges_m(self) -> tuple[float, float, float]:
        """Return half the edges of the uniform box with the payload's mass and inertia about the centre of mass.

        What is not known of the inertia is taken as the mean of what is.
        """
        x, y, z = self.payload.com_S_m**2
        own = np.diag(self.payload.inertia_S_kg_m2) - self.payload.mass_kg * np.array([y + z, x + z, x + y])
        known = np.diag(self.payload.inertia_S_kg_m2) > 0.0
        own = np.where(known, np.maximum(own, 0.0), np.mean(np.maximum(own, 0.0)[known]) if np.any(known) else 0.0)
        squares = 1.5 * (np.sum(own) - 2.0 * own) / self.payload.mass_kg
        first, second, third = np.sqrt(np.maximum(squares, 0.0)).tolist()
        return first, second, third

    def _axis(self, name: str, mass: float) -> Plant:
        domain = self.domains.get(name)
        if domain is None:
            held = self.held[name]
            return Plant(
                robot=_HELD_ROBOT,
                coupling=Coupling(
                    stiffness_n_per_m=held.coupling_stiffness_n_per_m, damping_n_s_per_m=held.coupling_damping_n_s_per_m
                ),
                payload=PayloadDynamics(mass_kg=mass, drag_n_s_per_m=held.drag_n_s_per_m),
            )
        return domain.plants.at(mass, 0.0)
