"""Axes that act on each other: one rigid payload on the couplings of several axes, touched at a point (docs/method.md).

Of every axis robot, coupling, drag and wrench filter are those of its own `Plant`; what they share is the payload's
mass matrix about the sensor's origin and the surface. For a diagonal mass matrix and a surface square to one axis the
equations are those of `write_plant`, axis by axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .._checks import frozen_vector
from ..arrays import ComplexArray, FloatArray, IntArray
from ..errors import ParameterError
from .controller import AdmittanceController, controller_blocks, needed_states
from .hold import hold
from .plant import FREE_SPACE, Environment, Plant, build_plant_matrices
from .sampled import close_loop, controller_matrix, controller_rest, split_delay

AXIS_NAMES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, kw_only=True, eq=False)
class RigidPayload:
    """Mass [kg], centre of mass c (3,) [m] and inertia (3, 3) [kg·m²] about the sensor's origin, in its frame S."""

    mass_kg: float
    com_S_m: FloatArray
    inertia_S_kg_m2: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "com_S_m", frozen_vector("com_S_m", self.com_S_m))
        inertia = np.array(self.inertia_S_kg_m2, dtype=np.float64)
        if inertia.shape != (3, 3) or not np.array_equal(inertia, inertia.T):
            raise ParameterError("inertia_S_kg_m2", inertia.tolist(), "symmetric, three by three")
        inertia.flags.writeable = False
        object.__setattr__(self, "inertia_S_kg_m2", inertia)

    def scaled(self, factor: float) -> "RigidPayload":
        """Return the payload of the same shape with `factor` times the mass, and so the inertia."""
        return RigidPayload(
            mass_kg=factor * self.mass_kg, com_S_m=self.com_S_m, inertia_S_kg_m2=factor * self.inertia_S_kg_m2
        )

    @cached_property
    def mass_matrix(self) -> FloatArray:
        """M (6, 6) = (m I, −m [c]×; m [c]×, I_O): momentum and angular momentum about O by the speeds there."""
        x, y, z = self.com_S_m
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.block(
            [[self.mass_kg * np.eye(3), -self.mass_kg * cross], [self.mass_kg * cross, self.inertia_S_kg_m2]]
        )


def contact_direction(point_S_m: Sequence[float], normal_S: Sequence[float]) -> FloatArray:
    """Return J (6,): how far a point of the payload goes along a unit normal by the six displacements at S."""
    point, normal = np.asarray(point_S_m, dtype=np.float64), np.asarray(normal_S, dtype=np.float64)
    return np.concatenate([normal, np.cross(point, normal)])


@dataclass(frozen=True, kw_only=True, eq=False)
class PointSurface:
    """What is touched: d = J q of its `direction` J (k,) presses with F_e = K_e d + B_e ḋ, and acts back with Jᵀ."""

    direction: FloatArray
    environment: Environment

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", frozen_vector("direction", self.direction))
        if self.environment.mass_kg != 0.0:
            raise ParameterError("environment.mass_kg", self.environment.mass_kg, "0 where axes act on each other")


@dataclass(frozen=True, kw_only=True, eq=False)
class CoupledPlant:
    """The plants of k axes in free space, which share a payload with the mass matrix M (k, k), and what it touches.

    The masses of `plants` are not used. Displacements about an axis are in rad, forces about one in N·m.
    Raises ParameterError for a mass matrix that is not positive definite, and for an axis that touches something.
    """

    plants: tuple[Plant, ...]
    mass_matrix: FloatArray
    surface: PointSurface | None = None

    def __post_init__(self) -> None:
        matrix = np.array(self.mass_matrix, dtype=np.float64)
        k = len(self.plants)
        if matrix.shape != (k, k) or not np.array_equal(matrix, matrix.T) or np.min(np.linalg.eigvalsh(matrix)) <= 0.0:
            must = (
                f"symmetric and positive definite, {k} by {k} (an inertia about S of at least that of the mass there)"
            )
            raise ParameterError("mass_matrix", matrix.tolist(), must)
        if self.surface is not None and len(self.surface.direction) != k:
            raise ParameterError("surface.direction", len(self.surface.direction), f"{k} numbers")
        for plant in self.plants:
            plant.require_one_piece()
        if any(not plant.environment.is_free_space for plant in self.plants):
            raise ParameterError("plants", "an axis in contact", "in free space; the surface is the payload's")
        matrix.flags.writeable = False
        object.__setattr__(self, "mass_matrix", matrix)

    def touching(self, surface: PointSurface | None) -> "CoupledPlant":
        """Return the same cell with another surface, None for free space."""
        return CoupledPlant(plants=self.plants, mass_matrix=self.mass_matrix, surface=surface)


@dataclass(frozen=True, kw_only=True, eq=False)
class CoupledMatrices:
    """ds/dτ = A s + B x^d + P f in τ = t/`time_scale_s`, inputs (n, k); states axis by axis as in `PlantMatrices`.

    x = `c_position` s and F = `c_force` s + d_F x^d, (k, n) and d_F (k,) diagonal; q = s[`places`], its speed times t
    is next to it. `pressed` (n,) is F_e by the state.
    """

    a: FloatArray
    b: FloatArray
    push: FloatArray
    c_position: FloatArray
    c_force: FloatArray
    d_force: FloatArray
    pressed: FloatArray
    places: tuple[int, ...]
    time_scale_s: float


def build_coupled_matrices(plant: CoupledPlant, time_scale_s: float) -> CoupledMatrices:
    """Return the equations of motion: those of each axis, accelerations through the mass matrix, and the surface.

    M q'' = D a with the diagonal D of M and the accelerations a that each axis would have alone; then Jᵀ F_e off.
    """
    t, k, masses = time_scale_s, len(plant.plants), np.diag(plant.mass_matrix)
    single = [
        build_plant_matrices(_with_mass(each, float(mass)), t) for each, mass in zip(plant.plants, masses, strict=True)
    ]
    ends = np.cumsum([len(each.b) for each in single])
    n, places = int(ends[-1]), tuple(int(end) - 2 for end in ends)
    a, b, push, position, force = (np.zeros(shape) for shape in ((n, n), (n, k), (n, k), (k, n), (k, n)))
    for i, (each, end) in enumerate(zip(single, ends, strict=True)):
        of_axis = slice(int(end) - len(each.b), int(end))
        a[of_axis, of_axis], b[of_axis, i], push[of_axis, i] = each.a, each.b, each.push
        position[i, of_axis], force[i, of_axis] = each.c_position, each.c_force
    speeds = [place + 1 for place in places]
    mixed = np.linalg.solve(plant.mass_matrix, np.diag(masses))
    for matrix in (a, b, push):
        matrix[speeds] = mixed @ matrix[speeds]
    pressed = np.zeros(n)
    if plant.surface is not None:
        direction, environment = plant.surface.direction, plant.surface.environment
        pressed[list(places)] = environment.stiffness_n_per_m * direction
        pressed[speeds] = environment.damping_n_s_per_m / t * direction
        a[speeds] -= np.outer(t * t * np.linalg.solve(plant.mass_matrix, direction), pressed)
    d_force = np.array([each.d_force for each in single])
    return CoupledMatrices(
        a=a,
        b=b,
        push=push,
        c_position=position,
        c_force=force,
        d_force=d_force,
        pressed=pressed,
        places=places,
        time_scale_s=t,
    )


def _with_mass(plant: Plant, mass: float) -> Plant:
    payload = type(plant.payload)(mass_kg=mass, drag_n_s_per_m=plant.payload.drag_n_s_per_m)
    return Plant(
        robot=plant.robot,
        coupling=plant.coupling,
        payload=payload,
        environment=FREE_SPACE,
        wrench_filter=plant.wrench_filter,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class CoupledSampledPlant:
    """The plant between two ticks, as `SampledPlant` holds it; every axis with its own `whole` samples and fraction."""

    plant: CoupledPlant
    matrices: CoupledMatrices
    phi: FloatArray
    gamma: FloatArray
    gamma_old: FloatArray
    gamma_push: FloatArray
    whole: tuple[int, ...]
    fractions: tuple[float, ...]

    @property
    def sample_time_s(self) -> float:
        """The controller's period h."""
        return self.matrices.time_scale_s

    @property
    def chains(self) -> tuple[int, ...]:
        """Past commands that each axis still has to see."""
        return tuple(whole + int(part > 0.0) for whole, part in zip(self.whole, self.fractions, strict=True))


def build_coupled_sampled_plant(plant: CoupledPlant, sample_time_s: float) -> CoupledSampledPlant:
    """Discretise the cell under a zero-order hold, exactly, each axis with its delay."""
    m = build_coupled_matrices(plant, sample_time_s)
    k = len(plant.plants)
    phi, held = hold(m.a, np.hstack([m.b, m.push]), 1.0)
    gamma, gamma_old = held[:, :k].copy(), np.zeros_like(held[:, :k])
    delays = [split_delay(each.loop_delay_s, sample_time_s) for each in plant.plants]
    for i, (_, fraction) in enumerate(delays):
        if fraction > 0.0:
            _, newer = hold(m.a, np.ascontiguousarray(m.b[:, i]), 1.0 - fraction)
            gamma_old[:, i], gamma[:, i] = gamma[:, i] - newer, newer
    return CoupledSampledPlant(
        plant=plant,
        matrices=m,
        phi=phi,
        gamma=gamma,
        gamma_old=gamma_old,
        gamma_push=held[:, k:].copy(),
        whole=tuple(whole for whole, _ in delays),
        fractions=tuple(fraction for _, fraction in delays),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class CoupledLoop:
    """s⁺ = `a` s + `b` e + `b_command` w + `b_push` f with everything closed, inputs (N, k).

    e is added to the measured forces (F^d is), w to the commands; F = `c_force` s + `d_force` e, x^d = `c_command` s +
    `d_command` w. States: plant, past commands axis by axis, controllers. The columns of `translations` (N, r) are the
    motions that nothing holds, each an eigenvector of the eigenvalue 1.
    """

    a: FloatArray
    b: FloatArray
    b_command: FloatArray
    b_push: FloatArray
    c_force: FloatArray
    d_force: FloatArray
    c_command: FloatArray
    d_command: FloatArray
    translations: FloatArray
    sample_time_s: float
    state_count: int


Law = AdmittanceController | None
"""The law of an axis; None is a robot that holds the axis where it is."""


def build_coupled_loop(sampled: CoupledSampledPlant, laws: Sequence[Law]) -> CoupledLoop:
    """Close the loops of all axes that have a law, without approximation."""
    h, n, k = sampled.sample_time_s, len(sampled.phi), len(sampled.whole)
    matrices = [None if law is None else controller_matrix(law, h) for law in laws]
    sizes = [0 if each is None else len(each) - 1 for each in matrices]
    starts = n + np.concatenate([[0], np.cumsum(sampled.chains)]).astype(int)
    after = int(starts[-1]) + np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    size = int(after[-1])
    m = np.zeros((size + 2 * k, size + 3 * k))
    p = sampled.matrices
    m[:n, :n], m[:n, size + 2 * k :] = sampled.phi, sampled.gamma_push
    m[size : size + k, :n] = p.c_force
    for i, chain in enumerate(sampled.chains):
        command, first = size + k + i, int(starts[i])
        past = [command, *range(first, first + chain)]
        m[:n, past[sampled.whole[i]]] += sampled.gamma[:, i]
        m[:n, past[chain]] += sampled.gamma_old[:, i] if chain > sampled.whole[i] else 0.0
        m[size + i, past[chain]] += p.d_force[i]
        for row, column in zip(past[1:], past[:-1], strict=True):
            m[row, column] = 1.0
        law = matrices[i]
        if law is not None:
            rows = [*range(int(after[i]), int(after[i + 1])), size + k + i]
            m[np.ix_(rows, rows[:-1])] = law[:, : sizes[i]]
            m[rows, size + i] = law[:, sizes[i]]
            m[np.ix_(rows, range(n))] += np.outer(law[:, sizes[i] + 1], p.c_position[i])
    closed = [i for i, law in enumerate(laws) if law is not None]
    for signal in (*(size + k + i for i in closed), *(size + i for i in closed)):
        close_loop(m, signal, signal, *m.shape)
    return CoupledLoop(
        a=np.ascontiguousarray(m[:size, :size]),
        b=m[:size, size : size + k].copy(),
        b_command=m[:size, size + k : size + 2 * k].copy(),
        b_push=m[:size, size + 2 * k :].copy(),
        c_force=m[size : size + k, :size].copy(),
        d_force=m[size : size + k, size : size + k].copy(),
        c_command=m[size + k :, :size].copy(),
        d_command=m[size + k :, size + k : size + 2 * k].copy(),
        translations=_translations(sampled, laws, starts, after, size),
        sample_time_s=h,
        state_count=n,
    )


def _translations(
    sampled: CoupledSampledPlant, laws: Sequence[Law], starts: IntArray, after: IntArray, size: int
) -> FloatArray:
    """Return the states in which axes rest one unit further on, in those directions that no surface holds."""
    places, free, begin = sampled.matrices.places, [], 0
    for i, law in enumerate(laws):
        state = np.zeros(size)
        # The robot's first state has unit gain at rest.
        state[begin] = state[places[i]] = 1.0
        begin = places[i] + 2
        if law is not None:
            blocks = controller_blocks(law, sampled.sample_time_s)
            state[int(starts[i]) : int(starts[i + 1])] = 1.0
            state[int(after[i]) : int(after[i + 1])] = controller_rest(blocks)[needed_states(blocks)]
            free.append((i, state))
    surface = sampled.plant.surface
    held = np.zeros(len(free)) if surface is None else np.array([surface.direction[i] for i, _ in free])
    if surface is not None and surface.environment.stiffness_n_per_m > 0.0 and np.any(held):
        # Pairs of which one undoes what the other does at the surface, exactly.
        pivot = int(np.argmax(np.abs(held)))
        rows = [
            (held[pivot] * state - held[j] * free[pivot][1]) / held[pivot]
            for j, (_, state) in enumerate(free)
            if j != pivot
        ]
    else:
        rows = [state for _, state in free]
    return np.array(rows).reshape(-1, size).T


def reduced_loop(loop: CoupledLoop) -> tuple[FloatArray, IntArray]:
    """Return (reduction, kept): s − translations·s[pivots] on the kept states, without the motions that nothing holds.

    With R the reduction (N − r, N), R a R⁺ on the kept states has all eigenvalues of `a` but r of the eigenvalue 1.
    """
    size, count = loop.translations.shape
    pivots: list[int] = []
    moved = loop.translations.copy()
    for j in range(count):
        pivot = int(np.argmax(np.abs(moved[:, j])))
        moved[:, j] /= moved[pivot, j]
        for other in range(count):
            if other != j:
                moved[:, other] -= moved[:, j] * moved[pivot, other]
        pivots.append(pivot)
    kept = np.array([i for i in range(size) if i not in pivots], dtype=np.int64)
    reduction = np.eye(size)
    for j, pivot in enumerate(pivots):
        reduction[:, pivot] -= moved[:, j]
    return np.ascontiguousarray(reduction[kept]), kept


def coupled_poles(loop: CoupledLoop) -> tuple[ComplexArray, ComplexArray]:
    """Return the poles (m,) and eigenvectors (N, m) of a loop without the motions that nothing holds."""
    reduction, kept = reduced_loop(loop)
    poles, vectors = np.linalg.eig(reduction @ loop.a[:, kept])
    whole = np.zeros((len(loop.a), len(poles)), dtype=np.complex128)
    whole[kept] = vectors
    return poles, whole
