"""Verify what a file says of all axes together by another method: dense step matrices from scipy, no grid, small steps.

Robot and controller come from `scipy.signal`, the payload from its equations of motion, steps from scipy's matrix
exponential; margins from the eigenvalues of a Hamiltonian matrix, contacts from small steps of fixed size.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy
from scipy.linalg import expm, schur

from autotune.formats.controller_record import Controller
from autotune.formats.coupled_record import CoupledCertificate, PointContact
from problems.arrays import FloatArray
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.coupled import CoupledPlant, Law
from problems.stability.coupled_margins import largest_gain
from problems.text import significant

from .coupled_cell import CoupledCell
from .coupled_sweep import coupled_plants
from .report import Check

_SAME_MODULUS = 1e-3
# Steps of a sixteenth of a period miss the moment of a touch, and so the peak, by less.
_STEPS, _SAME_PEAK, _TAIL_S = 16, 0.02, 0.02
_ON_UNIT = 1e-6
_STABLE = 1.0 - 1e-12


def check_coupled(controller: Controller) -> Iterator[Check]:
    """Yield what comes of the certificate of all axes together; nothing where the file has none."""
    stated = controller.certificate.coupled
    if stated is None:
        return
    check = partial(Check, axis=next(iter(controller.axes)), name="axes together")
    if set(stated.axes) != set(controller.axes):
        yield check(passed=False, message=f"stated of {', '.join(stated.axes)}, tuned are {', '.join(controller.axes)}")
        return
    try:
        cell = CoupledCell.of(controller, stated.body)
        radius, modulus, count = _margins(cell)
        peaks = [_peak_error(cell, name, points) for name, points in stated.points.items() if points]
    except ParameterError as refusal:
        yield check(passed=False, message=str(refusal))
        return
    wrong = _wrong(stated, radius, modulus, peaks)
    if wrong:
        yield check(passed=False, message=wrong)
        return
    yield check(passed=True, message=_message(stated, modulus, count, peaks))


def _wrong(stated: CoupledCertificate, radius: float, modulus: float, peaks: Sequence[float]) -> str:
    if not radius < _STABLE:
        return f"unstable together: largest |z| {radius:.6f}, by the eigenvalues of the step matrix"
    if any(len(group) > 1 for group in stated.groups) and modulus < (1.0 - _SAME_MODULUS) * stated.modulus:
        return f"smallest singular value of I + L {modulus:.4g} by a second method, stated {stated.modulus:.4g}"
    asked = stated.min_modulus
    if asked is not None and modulus < (1.0 - _SAME_MODULUS) * asked:
        return f"smallest singular value of I + L {modulus:.4g} by a second method, {asked:g} is asked"
    worst = max(peaks, default=0.0)
    if worst > _SAME_PEAK:
        return f"a contact at a point is {significant(100.0 * worst)} % harder by a second method than stated"
    return ""


def _message(stated: CoupledCertificate, modulus: float, count: int, peaks: Sequence[float]) -> str:
    if count == 0:
        return f"coupling {significant(stated.coupling)}: no axes to be checked together"
    contacts = f"; contacts at points within {significant(100.0 * max(map(abs, peaks)))} %" if peaks else ""
    return (
        f"stable on {count} plants by the eigenvalues of the whole step matrix, smallest singular value of I + L "
        f"{modulus:.4g} without a grid of frequencies (stated {stated.modulus:.4g}){contacts}; swept, not proved"
    )


def _margins(cell: CoupledCell) -> tuple[float, float, int]:
    """Return the largest |z|, the least σ_min(I + L) and the number of the plants that the sweep looked at."""
    radius, modulus, count = 0.0, np.inf, 0
    for group, plant in coupled_plants(cell):
        loop = build_dense_loop(plant, cell.law(group), cell.sample_time_s)
        own = loop.radius()
        radius, count = max(radius, own), count + 1
        if own < _STABLE:
            driven = [i for i, law in enumerate(cell.law(group)) if law is not None]
            modulus = min(modulus, loop.modulus(driven, cell.scale(group)))
    return radius, modulus, count


@dataclass(frozen=True, kw_only=True, eq=False)
class DenseLoop:
    """s⁺ = a s + b_force e + b_command w; F = c_force s + d_force e and x^d = c_command s + d_command w, (k, …)."""

    a: FloatArray
    b_force: FloatArray
    b_command: FloatArray
    c_force: FloatArray
    d_force: FloatArray
    c_command: FloatArray
    d_command: FloatArray
    unheld: int

    def radius(self) -> float:
        """Return the largest |z| but for the motions that nothing holds."""
        poles = np.linalg.eigvals(self.a)
        far = np.argsort(np.abs(poles - 1.0))[self.unheld :]
        return float(np.max(np.abs(poles[far])))

    def modulus(self, driven: Sequence[int], scale: FloatArray) -> float:
        """Return 1/max σ(S) over both break points."""
        place, lever = list(driven), scale[list(driven)]
        one = np.eye(len(place))
        # Motions that nothing holds are not seen in the forces, and not moved by what is added to the commands.
        kept = _basis(self.a, unit_first=True)[:, self.unheld :]
        gains = [
            largest_gain(
                kept.T @ self.a @ kept,
                kept.T @ self.b_force[:, place] * lever,
                self.c_force[place] @ kept / lever[:, None],
                one + self.d_force[np.ix_(place, place)] / lever[:, None] * lever,
            ),
        ]
        kept = _basis(self.a, unit_first=False)[:, : len(self.a) - self.unheld]
        gains.append(
            largest_gain(
                kept.T @ self.a @ kept,
                kept.T @ self.b_command[:, place] / lever,
                self.c_command[place] @ kept * lever[:, None],
                one + self.d_command[np.ix_(place, place)] * lever[:, None] / lever,
            )
        )
        return 1.0 / max(gain for gain, _ in gains)


def _basis(a: FloatArray, *, unit_first: bool) -> FloatArray:
    """Return the orthogonal basis of the Schur form with the eigenvalues at 1 first, or last."""

    def chosen(real: float, imaginary: float) -> bool:
        return (abs(complex(real, imaginary) - 1.0) < _ON_UNIT) == unit_first

    _, basis, _ = schur(a, output="real", sort=chosen)
    return np.asarray(basis)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Continuous:
    """dξ/dt = a ξ + b u with x, F (rows of ξ) and F's direct part (k,); q is ξ[place], v follows k later."""

    a: FloatArray
    b: FloatArray
    position: FloatArray
    force: FloatArray
    direct: FloatArray
    place: int


def _continuous(plant: CoupledPlant, *, touching: bool) -> _Continuous:
    """Write Newton's equations: M q'' = −F − B q' − Jᵀ (K_e J q + B_e J q'), F = K (q − x) + B (q' − x')."""
    k = len(plant.plants)
    robots = [scipy.signal.tf2ss(each.robot.numerator, each.robot.denominator) for each in plant.plants]
    filters = [each.wrench_filter.time_constant_s for each in plant.plants]
    orders = [len(robot[0]) for robot in robots]
    first = np.concatenate([[0], np.cumsum(orders)]).astype(int)
    late = int(first[-1]) + np.cumsum([0, *(int(each > 0.0) for each in filters)])
    place = int(late[-1])
    n = place + 2 * k
    a, b, force, position = np.zeros((n, n)), np.zeros((n, k)), np.zeros((k, n)), np.zeros((k, n))
    direct, stiffness = np.zeros(k), np.array([each.coupling.stiffness_n_per_m for each in plant.plants])
    damping = np.array([each.coupling.damping_n_s_per_m for each in plant.plants])
    for i, (states, inputs, output, _) in enumerate(robots):
        own = slice(int(first[i]), int(first[i + 1]))
        a[own, own], b[own, i], position[i, own] = states, inputs[:, 0], output[0]
        force[i, own] = -stiffness[i] * output[0] - damping[i] * (output @ states)[0]
        direct[i] = -damping[i] * (output @ inputs)[0, 0]
        force[i, place + i], force[i, place + k + i] = stiffness[i], damping[i]
    pull, thrust = -force.copy(), -np.diag(direct)
    speeds, places = slice(place + k, n), slice(place, place + k)
    pull[:, speeds] -= np.diag([each.payload.drag_n_s_per_m for each in plant.plants])
    if touching and plant.surface is not None:
        back, of = np.outer(plant.surface.direction, plant.surface.direction), plant.surface.environment
        pull[:, places] -= of.stiffness_n_per_m * back
        pull[:, speeds] -= of.damping_n_s_per_m * back
    inverse = np.linalg.inv(plant.mass_matrix)
    a[places, speeds], a[speeds], b[speeds] = np.eye(k), inverse @ pull, inverse @ thrust
    for i, time_constant in enumerate(filters):
        if time_constant > 0.0:
            row = int(late[i])
            a[row], b[row, i] = force[i] / time_constant, direct[i] / time_constant
            a[row, row] -= 1.0 / time_constant
            force[i], direct[i] = 0.0, 0.0
            force[i, row] = 1.0
    return _Continuous(a=a, b=b, position=position, force=force, direct=direct, place=place)


def _step(a: FloatArray, b: FloatArray, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return the step of a held input over a duration."""
    n, k = b.shape
    whole = expm(duration * np.block([[a, b], [np.zeros((k, n + k))]]))
    return whole[:n, :n], whole[:n, n:]


def _delays(plant: CoupledPlant, sample_time_s: float) -> tuple[list[int], list[float]]:
    """Return whole samples and the fraction left of each axis's delay."""
    samples = [round(each.loop_delay_s / sample_time_s, 9) for each in plant.plants]
    return [int(each) for each in samples], [each - int(each) for each in samples]


def _law_parts(law: AdmittanceController, sample_time_s: float) -> list[tuple[FloatArray, ...]]:
    """Return A(1 + C_ff) N, C_fb and P̂ O_a in their Tustin form, as state-space systems by scipy."""
    v, a = law.velocity_filter_rad_per_s, law.acceleration_filter_rad_per_s
    zero, pole = law.biquad_zero_s, law.biquad_pole_s
    above = np.trim_zeros(np.array([zero**2, 2.0 * law.biquad_zero_damping_ratio * zero, 1.0]), "f")
    below = np.trim_zeros(np.array([pole**2, 2.0 * law.biquad_pole_damping_ratio * pole, 1.0]), "f")
    continuous = (
        (np.convolve(above, [law.lead_s, 1.0]), np.convolve(below, [law.mass_kg, law.damping_n_s_per_m, 0.0])),
        ([law.feedback_damping_s * v, 0.0], [1.0, v]),
        ([law.compensation_mass_kg * v * a, 0.0, 0.0], [1.0, v + a, v * a]),
    )
    found: list[tuple[FloatArray, ...]] = []
    for top, bottom in continuous:
        if not any(top):
            found.append((np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1))))
            continue
        system = scipy.signal.tf2ss(np.trim_zeros(top, "f"), bottom)
        parts = scipy.signal.cont2discrete(system, sample_time_s, method="bilinear")[:4]
        found.append(tuple(np.atleast_2d(np.asarray(each, dtype=np.float64)) for each in parts))
    return found


def build_dense_loop(plant: CoupledPlant, laws: Sequence[Law], sample_time_s: float) -> DenseLoop:
    """Return the closed loop of a cell, assembled from scipy's parts."""
    cell = _continuous(plant, touching=plant.surface is not None)
    wholes, fractions = _delays(plant, sample_time_s)
    n, k = len(cell.a), len(laws)
    chains = [whole + int(part > 0.0) for whole, part in zip(wholes, fractions, strict=True)]
    parts = [[] if law is None else _law_parts(law, sample_time_s) for law in laws]
    chain_at = n + np.concatenate([[0], np.cumsum(chains)]).astype(int)
    sizes = [sum(len(part[0]) for part in each) for each in parts]
    law_at = int(chain_at[-1]) + np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    size = int(law_at[-1])
    a, of_command, of_force = np.zeros((size, size)), np.zeros((size, k)), np.zeros((size, k))
    force, direct = np.zeros((k, size)), np.zeros((k, k))
    answer, per_force = np.zeros((k, size)), np.zeros((k, k))
    phi, gamma = _step(cell.a, cell.b, sample_time_s)
    a[:n, :n], force[:, :n] = phi, cell.force
    position = np.zeros((k, size))
    position[:, :n] = cell.position
    for i in range(k):
        past = [None, *range(int(chain_at[i]), int(chain_at[i + 1]))]
        _, newer = _step(cell.a, cell.b[:, [i]], (1.0 - fractions[i]) * sample_time_s)
        acting = [(wholes[i], newer[:, 0])]
        if fractions[i] > 0.0:
            acting.append((wholes[i] + 1, gamma[:, i] - newer[:, 0]))
        for age, column in acting:
            place = past[age]
            if place is None:
                of_command[:n, i] += column
            else:
                a[:n, place] += column
        last = past[chains[i]]
        if last is None:
            direct[i, i] += cell.direct[i]
        else:
            force[i, last] += cell.direct[i]
        for j, place in enumerate(past[1:]):
            before = past[j]
            if before is None:
                of_command[place, i] = 1.0
            else:
                a[place, before] = 1.0
        if parts[i]:
            _add_law(parts[i], int(law_at[i]), position[i], i, (a, of_force, answer, per_force))
    return _closed(a, of_command, of_force, force, direct, answer, per_force, _unheld(plant, laws))


def _add_law(
    parts: Sequence[tuple[FloatArray, ...]], at: int, position: FloatArray, i: int, into: tuple[FloatArray, ...]
) -> None:
    """Write one law: drive = e + P̂ O_a x, x^d = A(1 + C_ff) drive − C_fb x; rows act on the states and on e."""
    a, of_force, answer, per_force = into
    (a_1, b_1, c_1, d_1), (a_2, b_2, c_2, d_2), (a_3, b_3, c_3, d_3) = parts
    ends = at + np.cumsum([0, len(a_1), len(a_2), len(a_3)])
    forward, back, observer = (slice(int(x), int(y)) for x, y in itertools.pairwise(ends))
    a[forward, forward], a[back, back], a[observer, observer] = a_1, a_2, a_3
    a[back] += np.outer(b_2[:, 0], position)
    a[observer] += np.outer(b_3[:, 0], position)
    drive = d_3[0, 0] * position
    drive = drive + np.eye(len(position))[observer].T @ c_3[0]
    a[forward] += np.outer(b_1[:, 0], drive)
    of_force[forward, i] = b_1[:, 0]
    answer[i, forward] = c_1[0]
    answer[i] += d_1[0, 0] * drive - d_2[0, 0] * position
    answer[i, back] -= c_2[0]
    per_force[i, i] = d_1[0, 0]


def _closed(
    a: FloatArray,
    of_command: FloatArray,
    of_force: FloatArray,
    force: FloatArray,
    direct: FloatArray,
    answer: FloatArray,
    per_force: FloatArray,
    unheld: int,
) -> DenseLoop:
    """Close forces and commands: F = H s + D u, u = C s + K (F + e) + w; what acts is u."""
    k = len(force)
    inverse = np.linalg.inv(np.eye(k) - per_force @ direct)
    by_state, by_force, by_command = inverse @ (answer + per_force @ force), inverse @ per_force, inverse
    seen, seen_force, seen_command = (
        force + direct @ by_state,
        direct @ by_force,
        direct @ by_command,
    )
    return DenseLoop(
        a=a + of_command @ by_state + of_force @ seen,
        b_force=of_command @ by_force + of_force @ (seen_force + np.eye(k)),
        b_command=of_command @ by_command + of_force @ seen_command,
        c_force=seen,
        d_force=seen_force,
        c_command=by_state,
        d_command=by_command - np.eye(k),
        unheld=unheld,
    )


def _unheld(plant: CoupledPlant, laws: Sequence[Law]) -> int:
    """Return how many motions nothing holds: one per law, one less where a surface is in the way of any."""
    driven = [i for i, law in enumerate(laws) if law is not None]
    surface = plant.surface
    has_surface = (
        surface is not None and surface.environment.stiffness_n_per_m > 0.0 and np.any(surface.direction[driven])
    )
    return len(driven) - int(bool(has_surface))


def _peak_error(cell: CoupledCell, name: str, points: Sequence[PointContact]) -> float:
    """Return the share by which the hardest contact of one axis at a point is harder in small steps than stated."""
    stated = max(points, key=lambda each: each.peak_contact_force_n)
    names, h, laws = cell.names, cell.sample_time_s, cell.law(cell.names)
    surface = cell.surface_at(names, name, stated.point_m, stated.environment_stiffness_n_per_m)
    plant = cell.plant(names, stated.payload_mass_kg, surface)
    loop = build_dense_loop(plant.touching(None), laws, h)
    domain = cell.domains[name]
    along = np.array([float(each == name) for each in names])
    # The state that repeats itself one step further on, of all such states the smallest.
    unmoved = loop.a - np.eye(len(loop.a))
    _, _, rows = np.linalg.svd(unmoved)
    still = rows[len(rows) - loop.unheld :].T
    found = np.linalg.lstsq(np.hstack([unmoved, -still]), -loop.b_force @ along, rcond=None)[0]
    state, way = found[: len(unmoved)], still @ found[len(unmoved) :]
    place = _continuous(plant, touching=False).place
    speed = float(surface.direction @ way[place : place + len(names)]) / h
    wanted = domain.approach.speed_m_s
    factor = (domain.approach.force_n or 0.0) if wanted is None else wanted / speed
    peak = _largest_force(plant, laws, h, factor * state, factor * along, 1.2 * stated.time_of_peak_s + _TAIL_S)
    return peak / stated.peak_contact_force_n - 1.0


def _largest_force(
    plant: CoupledPlant, laws: Sequence[Law], h: float, start: FloatArray, desired: FloatArray, duration_s: float
) -> float:
    """Return the largest F_e over a time from the touch on, in steps of fixed size that end where they end."""
    wholes, fractions = _delays(plant, h)
    modes = [_continuous(plant, touching=each) for each in (False, True)]
    n, k, place = len(modes[0].a), len(laws), modes[0].place
    surface = plant.surface
    if surface is None:
        raise ParameterError("surface", None, "there")
    direction, of = surface.direction, surface.environment
    state, offset = start[:n].copy(), float(direction @ start[place : place + k])
    push = np.zeros((n, 1))
    push[place + k :, 0] = np.linalg.inv(plant.mass_matrix) @ direction * of.stiffness_n_per_m * offset
    inputs = [np.hstack([mode.b, each * push]) for mode, each in zip(modes, (0.0, 1.0), strict=True)]
    steps = [_step(mode.a, each, h / _STEPS) for mode, each in zip(modes, inputs, strict=True)]
    chains = [whole + int(part > 0.0) for whole, part in zip(wholes, fractions, strict=True)]
    at, past, parts, memory = n, [], [], []
    for chain in chains:
        past.append([0.0, *start[at : at + chain]])
        at += chain
    for law in laws:
        own = [] if law is None else _law_parts(law, h)
        parts.append(own)
        memory.append([start[(at := at + len(part[0])) - len(part[0]) : at].copy() for part in own])
    older = [[wholes[i] + int((j + 0.5) / _STEPS < fractions[i]) for i in range(k)] for j in range(_STEPS)]
    touching, peak = True, 0.0
    for _ in range(round(duration_s / h)):
        for i in range(k):
            late = past[i][chains[i]] if chains[i] else 0.0
            force = float(modes[0].force[i] @ state + modes[0].direct[i] * late) + desired[i]
            if parts[i]:
                past[i][0] = _answer(parts[i], memory[i], force, float(modes[0].position[i] @ state))
        for j in range(_STEPS):
            held = np.array([*(past[i][older[j][i]] for i in range(k)), 1.0])
            phi, gamma = steps[int(touching)]
            state = phi @ state + gamma @ held
            depth = float(direction @ state[place : place + k]) - offset
            speed = float(direction @ state[place + k :]) if depth >= 0.0 else 0.0
            force = of.stiffness_n_per_m * depth + of.damping_n_s_per_m * speed
            touching = force > 0.0
            peak = max(peak, force)
        for i in range(k):
            past[i] = [0.0, *past[i][: chains[i]]]
    return peak


def _answer(parts: Sequence[tuple[FloatArray, ...]], memory: list[FloatArray], force: float, position: float) -> float:
    """Return x^d of one law, whose states go on."""
    (a_1, b_1, c_1, d_1), (a_2, b_2, c_2, d_2), (a_3, b_3, c_3, d_3) = parts
    drive = force + float(c_3[0] @ memory[2]) + d_3[0, 0] * position
    command = c_1[0] @ memory[0] + d_1[0, 0] * drive - c_2[0] @ memory[1] - d_2[0, 0] * position
    memory[0] = a_1 @ memory[0] + b_1[:, 0] * drive
    memory[1] = a_2 @ memory[1] + b_2[:, 0] * position
    memory[2] = a_3 @ memory[2] + b_3[:, 0] * position
    return float(command)
