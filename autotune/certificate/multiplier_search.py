"""Find a multiplier for the contact spring of a set of plants: a linear program over frequencies and plants.

A multiplier is a certificate: however it was found, `bouncing.prove_rest` shows whether it does.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog

from problems.arrays import ComplexArray, FloatArray
from problems.contact.multiplier import Multiplier
from problems.design.uncertainty import MASS, STIFFNESS
from problems.model.plant import FREE_SPACE, Plant
from problems.model.response import controller_response, plant_response
from problems.model.sampled import Controller, build_sampled_plant

from .bouncing import DAMPING, check_covered
from .family import Family

_SHIFTS = tuple(float(each) for each in np.round(np.geomspace(2e-4, 0.1, 28), 6))
_RATES = (0.3, 3.0, 30.0, 100.0, 300.0)
_DAMPERS = tuple(float(f"{each:.3g}") for each in np.geomspace(1e-6, 1.0, 49))
_FREQUENCIES, _LOWEST, _EVEN = 250, 0.02, 250
_MOST_VARYING, _MASSES = 3, 3
# The multiplier is looked at as a share of its size at this frequency [rad/s] and above.
_CORNER = 60.0
# What the fading part has at least, which holds what lies above π/h.
_LEAST_FADING = 0.1
_SMALL, _DIGITS = 1e-4, 4
# Of the rows of the program each so many-th is taken at first; so many join it at a time, that miss by more than this.
_EACH, _JOINING, _SAME_ROOM = 16, 40, 1e-9


def spring_response(
    plant: Plant, law: Controller, sample_time_s: float, frequency_rad_per_s: FloatArray
) -> ComplexArray:
    """Return G(jω) [m/N], −x_p per contact force at the same frequency, of the sampled loop in free space.

    It is P + A D W/h, see `bouncing`.
    """
    omega = np.asarray(frequency_rad_per_s, dtype=np.float64)
    sampled = build_sampled_plant(plant.in_contact_with(FREE_SPACE), sample_time_s)
    held = plant_response(sampled, omega)
    forward, feedback = controller_response(law, held.z, sample_time_s)
    closed = forward / (1.0 + feedback * held.position - forward * held.force)
    s, coupling, payload, robot = 1j * omega, plant.coupling, plant.payload, plant.robot
    stiff = coupling.stiffness_n_per_m + coupling.damping_n_s_per_m * s
    given = 1.0 / (payload.mass_kg * s * s + payload.drag_n_s_per_m * s + stiff)
    moved = np.polyval(robot.numerator, s) / np.polyval(robot.denominator, s) * np.exp(-s * plant.loop_delay_s)
    hold = (1.0 - 1.0 / held.z) / s
    sensed = 1.0 / (1.0 + s * plant.wrench_filter.time_constant_s)
    return np.asarray(given + (given * stiff) ** 2 * moved * hold * closed * sensed / sample_time_s)


def find_multiplier(families: Sequence[Family], law: Controller) -> Multiplier | None:
    """Return the multiplier with the most room on corners and middles of all these sets; None where there is no room.

    Raises ParameterError for what `bouncing.prove_rest` does not cover.
    """
    for each in families:
        check_covered(each, law)
    h, stiffness = families[0].sample_time_s, families[0].range_of(STIFFNESS)[1]
    highest = math.pi / h
    omega = np.unique(
        np.concatenate([np.geomspace(_LOWEST, highest, _FREQUENCIES), np.linspace(0.0, highest, _EVEN + 1)[1:]])
    )
    basis = [_CORNER**-1 * 1j * omega, *(-np.expm1(-1j * omega * shift) for shift in _SHIFTS)]
    basis += [1j * omega / (1j * omega + rate) for rate in _RATES]
    columns, scale = np.stack(basis, axis=1), np.abs(1j * omega / (1j * omega + _CORNER))
    answers = [spring_response(plant, law, h, omega) for family in families for plant in _plants(family)]
    rows = []
    for answer in answers:
        sprung = answer + 1.0 / stiffness
        rows.append(np.real(columns * (sprung / np.abs(sprung) / scale)[:, None]))
    found = most_room(np.concatenate(rows))
    if found is None:
        return None
    kept = [float(f"{each:.{_DIGITS}g}") if each > _SMALL else 0.0 for each in found]
    shifts = [(place, weight) for place, weight in zip(_SHIFTS, kept[1:], strict=False) if weight > 0.0]
    fading = [(place, weight) for place, weight in zip(_RATES, kept[1 + len(_SHIFTS) :], strict=True) if weight > 0.0]
    multiplier = Multiplier(
        rate_s=float(f"{kept[0] / _CORNER:.{_DIGITS}g}"),
        shifts_s=tuple(place for place, _ in shifts),
        shift_weights=tuple(weight for _, weight in shifts),
        fading_per_s=tuple(place for place, _ in fading),
        fading_weights=tuple(weight for _, weight in fading),
        damper_s=0.0,
    )
    damping = families[0].range_of(DAMPING)[1]
    if damping == 0.0:
        return multiplier
    return _with_damper(multiplier, omega, answers, stiffness, damping)


def _with_damper(
    multiplier: Multiplier, omega: FloatArray, answers: list[ComplexArray], stiffness: float, damping: float
) -> Multiplier | None:
    """Return the multiplier with the weight κ of the damper that leaves the most room; None where there is none.

    Spring and damper together are lossy if 4 Re(M (G + 1/K_e)) κ (Re sG + 1/B_e) > |M G + κ conj(sG)|².
    """
    response, answer = multiplier.response(omega)[None, :], np.array(answers)
    spring, moved = np.real(response * (answer + 1.0 / stiffness)), 1j * omega[None, :] * answer
    lossy = np.real(moved) + 1.0 / damping
    room = [
        float(np.min(4.0 * spring * each * lossy / np.abs(response * answer + each * np.conj(moved)) ** 2))
        for each in _DAMPERS
    ]
    best = int(np.argmax(room))
    return replace(multiplier, damper_s=_DAMPERS[best]) if room[best] > 1.0 else None


def _plants(family: Family) -> list[Plant]:
    """Return the middle of the set, masses in between, and its corners as far as few parameters vary."""
    free = family.in_free_space()
    box = free.box()
    middle = np.mean(box, axis=1)
    points = [middle]
    if len(box) <= _MOST_VARYING:
        points += [box[np.arange(len(box)), list(ends)] for ends in itertools.product((0, 1), repeat=len(box))]
    if MASS in free.varying:
        place = free.varying.index(MASS)
        for share in np.linspace(0.0, 1.0, _MASSES + 2):
            point = middle.copy()
            point[place] = box[place, 0] + share * (box[place, 1] - box[place, 0])
            points.append(point)
    return [free.plant(point) for point in points]


def most_room(rows: FloatArray) -> FloatArray | None:
    """Return weights ≥ 0 of sum 1 that make the least of rows·weights the largest; None where it is not above 0.

    Few of the rows bind: a program of some is solved, and those that its weights miss most join it, until none is left.
    """
    taken = np.zeros(len(rows), dtype=bool)
    taken[::_EACH] = True
    while (found := _most_room_of(rows[taken])) is not None:
        weights, least = found[:-1], found[-1]
        room = np.where(taken, np.inf, rows @ weights)
        missed = np.argsort(room, kind="stable")[:_JOINING]
        missed = missed[room[missed] < (1.0 - _SAME_ROOM) * least]
        if not len(missed):
            return weights
        taken[missed] = True
    return None


def _most_room_of(rows: FloatArray) -> FloatArray | None:
    """Solve the linear program of these rows; return the weights with the least of rows·weights behind them."""
    count = rows.shape[1]
    bounded = np.concatenate([-rows, np.ones((len(rows), 1))], axis=1)
    fading = np.zeros(count + 1)
    fading[count - len(_RATES) : count] = -1.0
    found = linprog(
        np.concatenate([np.zeros(count), [-1.0]]),
        A_ub=np.concatenate([bounded, fading[None, :]]),
        b_ub=np.concatenate([np.zeros(len(rows)), [-_LEAST_FADING]]),
        A_eq=np.concatenate([np.ones(count), [0.0]])[None, :],
        b_eq=[1.0],
        bounds=[(0.0, None)] * count + [(None, None)],
    )
    if not found.success or not found.x[-1] > 0.0:
        return None
    return np.asarray(found.x)
