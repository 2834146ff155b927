"""The loop in contact from tick to tick and its state at the touch, in balls, with derivatives by the plant.

The state is that of the plant (robot, payload relative to the flange, its speed), the commands on their way, newest
first, and the law's states. z is what it differs by from rest on the wall under F^d.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.design.uncertainty import MASS, STIFFNESS
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.difference import rest_states, steady_states

from .balls import as_series, exponential, number, precise, solved
from .family import Family
from .law import LawCell, blocks_in_balls, controller_rows, states_needed
from .plant_polynomials import continuous_plant, parameter_values

Objects = Any  # arrays of flint numbers and series
DAMPING = "environment_damping_n_s_per_m"


@dataclass(frozen=True, kw_only=True)
class ContactLoop:
    """z⁺ = `change` z, F_e = F^d + `pressed` z, and `start`, z at the last tick before the touch.

    `rest` is the state at rest one metre on, `held` the command that acts at the tick by z, and `stepped` its step
    within the sample. `curvature` is F_e'' by z, `jump` F_e' and F_e'' by that step; `flow` and `free_flow` are the
    continuous plant with its command as last state (n + 1, n + 1), `moves` F_e by them, `before` their state at
    `start`, from the flange on. `way` [m] is that of the approach in a sample, `force_n` F^d. `newtons` are K_e, B_e/h,
    K_s, (B_s + B_p)/h and h²/M_p. Time in samples.
    """

    change: Objects
    start: Objects
    rest: Objects
    held: Objects
    stepped: Objects
    pressed: Objects
    curvature: Objects
    jump: tuple[Any, Any]
    flow: Objects
    free_flow: Objects
    moves: Objects
    before: Objects
    way: Any
    force_n: Any
    newtons: tuple[Any, ...]


@precise
def contact_loop(
    family: Family,
    law: AdmittanceController | LawCell,
    approach: Approach,
    cell: FloatArray,
    along: int | None = None,
) -> ContactLoop:
    """Return the loop over a cell (d, 2) of coordinates; numbers carry their derivative along coordinate `along`.

    Of a cell of laws they carry what its values carry.
    Raises ParameterError for a filter of the wrench, and for a force that ends at the impact.
    """
    if family.nominal.wrench_filter.time_constant_s > 0.0:
        raise ParameterError("wrench_filter.time_constant_s", family.nominal.wrench_filter.time_constant_s, "0")
    if family.shared_delay is not None:
        raise ParameterError("wrench_filter.delay_s", family.shared_delay[1], "0")
    if approach.driven_by != "desired_force" or approach.after_impact_n is not None:
        raise ParameterError("approach", approach, "one under F^d, which goes on")
    values = parameter_values(family, cell, [number(1) if i == along else None for i in range(len(cell))])
    h, blocks, rows = (
        family.sample_time_s,
        blocks_in_balls(law, family.sample_time_s),
        controller_rows(law, family.sample_time_s),
    )
    kept = states_needed(law, h)
    augmented, position, force, direct = continuous_plant(family, values)
    n = len(position)
    whole, has_fraction = family.delay()
    chain = whole + int(has_fraction)
    change = _closed(family, values, (augmented, position, force, direct), rows)
    rest = _rest(position, chain, [rest_states(blocks)[i] for i in kept])
    stiffness, coupling = values[STIFFNESS], values["coupling_stiffness_n_per_m"]
    force_rows = _force_rows(family, values, augmented, position, len(rest))
    free = continuous_plant(family, {**values, STIFFNESS: as_series(0), DAMPING: as_series(0)})
    begun, before, way, force_n = _approach(family, values, free, law, approach, (blocks, kept, rest))
    for i in range(len(rest)):
        begun[i] = begun[i] - force_n * (1 / stiffness + 1 / coupling) * rest[i]
    begun[n - 2] = begun[n - 2] + force_n / coupling
    stepped = _objects(len(rest))
    if has_fraction:
        stepped = stepped + (_unit(len(rest), n + whole - 1) if whole else change[n])
        stepped[n + whole] = stepped[n + whole] - 1
    dampings = values["coupling_damping_n_s_per_m"] + values["drag_n_s_per_m"]
    return ContactLoop(
        change=change,
        start=begun,
        rest=rest,
        held=_unit(len(rest), n + chain - 1) if chain else change[n],
        stepped=stepped,
        flow=augmented,
        free_flow=free[0],
        **force_rows,
        before=before,
        way=way,
        force_n=force_n,
        newtons=(stiffness, values[DAMPING] / h, coupling, dampings / h, values[MASS] * (h * h)),
    )


def _force_rows(family: Family, values: Any, augmented: Objects, position: Objects, size: int) -> dict[str, Any]:
    """Return `pressed`, `curvature`, `jump` and `moves` of a `ContactLoop` with states of this size."""
    n = len(position)
    whole, has_fraction = family.delay()
    chain = whole + int(has_fraction)
    pressed, moves, curvature = _objects(size), _objects(n + 1), _objects(size)
    for i in range(n):
        pressed[i] = values[STIFFNESS] * position[i]
    pressed[n - 2] = pressed[n - 2] + values[STIFFNESS]
    pressed[n - 1] = pressed[n - 1] + values[DAMPING] / family.sample_time_s
    moves[:n] = pressed[:n]
    turned = np.dot(moves, augmented)
    curved = np.dot(turned, augmented)
    curvature[:n] = curved[:n]
    if chain:
        curvature[n + chain - 1] = curved[n]
    return {"pressed": pressed, "curvature": curvature, "jump": (turned[n], curved[n]), "moves": moves}


def _closed(family: Family, values: Any, plant: tuple[Objects, ...], rows: Objects) -> Objects:
    """Return the change of the state over a sample, without what comes from outside."""
    augmented, position, force, direct = plant
    n, r = len(position), len(rows) - 1
    whole, has_fraction = family.delay()
    chain = whole + int(has_fraction)
    size = n + chain + r
    full = exponential(augmented)
    measured, place, out = _objects(size), _objects(size), _objects(size, size)
    measured[:n], place[:n] = force, position
    if chain:
        measured[n + chain - 1] = direct
    elif as_series(direct).value != 0:
        raise ParameterError("robot.delay_s", 0.0, "above 0 with damping in the coupling")
    answers = _objects(r + 1, size)
    for i in range(r + 1):
        answers[i] = measured * rows[i, r] + place * rows[i, r + 1]
        answers[i, n + chain :] = rows[i, :r]
    command = answers[r]
    acting = [command, *(_unit(size, n + j) for j in range(chain))]
    for i in range(n):
        out[i, :n] = full[i, :n]
    columns = _inputs(family, values, augmented, full)
    for column, acts in zip(columns, acting[whole:], strict=False):
        for i in range(n):
            out[i] = out[i] + acts * column[i]
    if chain:
        out[n] = command
    for j in range(1, chain):
        out[n + j, n + j - 1] = 1
    out[n + chain :] = answers[:r]
    return out


def _inputs(family: Family, values: Any, augmented: Objects, full: Objects) -> list[Objects]:
    """Return what the newer command, and with a fraction of a sample the older one, does to the plant in a sample."""
    n = len(full) - 1
    whole, has_fraction = family.delay()
    gamma = full[:n, n]
    if not has_fraction:
        return [gamma]
    newer = exponential(augmented * ((whole + 1) - values["delay_s"] / family.sample_time_s))[:n, n]
    return [newer, gamma - newer]


def _rest(position: Objects, chain: int, of_law: list[Any]) -> Objects:
    """Return the state at rest with flange, payload and command at one metre."""
    out = _objects(len(position) + chain + len(of_law))
    # All of the robot's chain but its first state are derivatives.
    out[0] = 1 / position[0]
    for j in range(chain):
        out[len(position) + j] = 1
    out[len(position) + chain :] = of_law
    return out


def _approach(
    family: Family,
    values: Any,
    free: tuple[Objects, ...],
    law: AdmittanceController | LawCell,
    approach: Approach,
    known: tuple[Objects, list[int], Objects],
) -> tuple[Objects, Objects, Any, Any]:
    """Return the state of the steady approach with x_p = 0, that of the plant from the flange on, the way and F^d.

    The plant repeats itself one step further on.
    """
    blocks, kept, rest = known
    augmented, position, force, direct = free
    n, h = len(position), family.sample_time_s
    whole, has_fraction = family.delay()
    chain = whole + int(has_fraction)
    full = exponential(augmented)
    columns = _inputs(family, values, augmented, full)
    system, right = _objects(n + 1, n + 1), _objects(n + 1)
    system[:n, :n] = full[:n, :n]
    for i in range(n):
        system[i, i] = system[i, i] - 1
        for j, column in enumerate(columns):
            system[i, n] = system[i, n] + column[i]
            right[i] = right[i] + column[i] * (whole + j)
        right[i] = right[i] + rest[i]
    system[n, :n] = position
    system[n, n - 2] = 1
    steady = solved(system, right)
    command = steady[n]
    ramp = np.dot(force, steady[:n]) + direct * (command - chain)
    resistance = law.damping_n_s_per_m - ramp * h
    if approach.speed_m_s is None:
        force_n: Any = as_series(number(approach.force_n))
        way = force_n / resistance * h
    else:
        way = as_series(number(approach.speed_m_s)) * h
        force_n = way / h * resistance
    states = steady_states(
        blocks, command * way, np.dot(position, steady[:n]) * way, way / h, number(h), way / h * law.damping_n_s_per_m
    )
    out = _objects(len(rest))
    for i in range(n):
        out[i] = steady[i] * way
    for j in range(chain):
        out[n + j] = (command - (j + 1)) * way
    out[n + chain :] = [states[i] for i in kept]
    place = np.dot(position, out[:n])
    before = _objects(n + 1)
    for i in range(n):
        before[i] = out[i] - place * rest[i]
    before[n] = (command - chain) * way - place
    return out, before, way, force_n


def _unit(size: int, place: int) -> Any:
    return np.array([int(i == place) for i in range(size)], dtype=object)


def _objects(*shape: int) -> Any:
    out = np.empty(shape, dtype=object)
    out.fill(0)
    return out
