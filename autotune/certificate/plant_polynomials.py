"""The sampled plants of a cell as polynomials in w = z − 1: in balls, with derivatives by the plant's parameters."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from problems.arrays import FloatArray
from problems.design.uncertainty import MASS, STIFFNESS
from problems.model.plant import PLANT_PARAMETERS, Bumper, write_plant
from problems.model.plant_parameters import PARAMETERS
from problems.model.robot import bandwidth_hz

from . import rational
from .balls import DualBall, as_series, ball, exponential, precise, units
from .family import LAG, PROVABLE, Family

_ENVIRONMENT_DAMPING = "environment_damping_n_s_per_m"


@precise
def plant_polynomials(family: Family, cell: FloatArray, *, with_derivatives: bool = False) -> tuple[list[Any], ...]:
    """Return d, n_F and n_x in w = z − 1 over a cell (d, 2) of coordinates, ascending, as series.

    X = n_x/(z^c d) X^d and F = n_F/(z^c d) X^d with d = det(zI − φ) and c commands in the delay chain. Asked for them,
    every number carries its derivatives along the coordinates, over the whole cell.
    """
    values = parameter_values(family, cell, units(len(cell)) if with_derivatives else [None] * len(cell))
    whole, has_fraction = family.delay()
    augmented, position, force, direct = continuous_plant(family, values)
    size = len(position)
    full = exponential(augmented)
    gamma = full[:size, size]
    if has_fraction:
        # The newer command acts during the last 1 − fraction of the period, the older one before.
        rest = (whole + 1) - values["delay_s"] / family.sample_time_s
        newer = exponential(augmented * rest)[:size, size]
        inputs = [(newer, True), (gamma - newer, False)]
    else:
        inputs = [(gamma, False)]
    whole_step, order = full[:size, :size], family.nominal.robot.order
    answer = _Filtered(family, whole_step) if _has_filter(family) else _Plain(whole_step, force, order)
    characteristic = answer.characteristic
    found_force, found_position = [direct * each for each in characteristic], [0]
    for column, is_newer in inputs:
        for_force, for_position = answer.numerators(position, column)
        found_force = rational.add(found_force, rational.times_z(for_force) if is_newer else for_force)
        found_position = rational.add(found_position, rational.times_z(for_position) if is_newer else for_position)
    return characteristic, found_force, found_position


class _Plain:
    """Numerators of F and x over one characteristic polynomial, from the change over a sample.

    The robot's states do not depend on the payload's, Δ = [[R, 0], [Q, P]], so that with d = d_R d_P the payload's
    balls stay out of the robot's polynomials: n_F = d_P f_R adj_R γ_R + f_P adj_P (Q adj_R γ_R + d_R γ_P).
    """

    def __init__(self, whole: Any, force: Any, order: int) -> None:
        size = len(whole)
        change = whole - np.array([[int(i == j) for j in range(size)] for i in range(size)], dtype=object)
        self.order, self.force, self.pushed_by = order, force[:order], change[order:, :order]
        self.robot, self.adjugate = rational.resolvent(change[:order, :order])
        self.payload, adjugate = rational.resolvent(change[order:, order:])
        self.rows = [rational.dot(force[order:], each) for each in adjugate]
        self.characteristic = rational.times(self.robot, self.payload)

    def numerators(self, position: Any, column: Any) -> tuple[list[Any], list[Any]]:
        """Return those of F and of x for one input's column."""
        n = self.order
        moved = [rational.dot(each, column[:n]) for each in self.adjugate]
        pushed = [column[n:] * each for each in self.robot]
        for i, each in enumerate(moved):
            pushed[i] = pushed[i] + rational.dot(self.pushed_by, each)
        carried = rational.times(self.rows, pushed, rational.dot)
        held = rational.times(self.payload, [rational.dot(self.force, each) for each in moved])
        along = rational.times(self.payload, [rational.dot(position[:n], each) for each in moved])
        return rational.add(held, carried), along


class _Filtered:
    """The same of a plant whose last state is that of the wrench's filter, which nothing else depends on.

    With that block taken apart, det = d (w − δ) and F_m = ρ adj γ + d γ_f: the filter's ball stays out of d and adj.
    """

    def __init__(self, family: Family, whole: Any) -> None:
        n = len(whole) - 1
        self.plant = _Plain(whole[:n, :n], whole[n, :n], family.nominal.robot.order)
        self.unit, self.decay = _filter_unit(family), whole[n, n] - 1
        self.characteristic = self._slowed(self.plant.characteristic)

    def numerators(self, position: Any, column: Any) -> tuple[list[Any], list[Any]]:
        """Return those of F_m and of x for one input's column."""
        n = len(column) - 1
        through, moved = self.plant.numerators(position[:n], column[:n])
        measured = rational.add(through, [column[n] * each for each in self.plant.characteristic])
        return [self.unit * each for each in measured], self._slowed(moved)

    def _slowed(self, polynomial: list[Any]) -> list[Any]:
        """Return (w − δ) times a polynomial in w."""
        return rational.add([0, *polynomial], [-1 * self.decay * each for each in polynomial])


def _has_filter(family: Family) -> bool:
    return family.nominal.wrench_filter.time_constant_s > 0.0


def _filter_unit(family: Family) -> float:
    """Return the stiffness [N/m] in which the filter's state is written: a number that does not vary."""
    coupling = family.nominal.coupling
    return coupling.stiffness_n_per_m + coupling.damping_n_s_per_m / family.sample_time_s


def parameter_values(family: Family, cell: FloatArray, derivatives: Sequence[Any]) -> dict[str, Any]:
    """Return every parameter as a series, the coordinates with these derivatives or None.

    The payload's is 1/M_p, with a bumper that of the rest, 1/(M_p − M_t).
    """
    found = {name: as_series(family.range_of(name)[0]) for name in PROVABLE}
    bumper = family.nominal.bumper
    found[MASS] = 1 / (found[MASS] if bumper is None else found[MASS] - as_series(bumper.mass_kg))
    for name, (low, high), derivative in zip(family.varying, cell, derivatives, strict=True):
        found[name] = DualBall(ball(float(low), float(high)), derivative)
    return found


def continuous_plant(family: Family, values: Mapping[str, Any]) -> tuple[Any, Any, Any, Any]:
    """Return the augmented continuous plant by sample, square, the rows of x and F, and F's direct part.

    The equations are those of `write_plant`; the payload's position is relative to the flange, e = x_p − x, as
    otherwise the force of a free payload is a small difference of large balls.
    """
    n = family.nominal.robot.order
    h: Any = as_series(family.sample_time_s)
    a, push = _objects(n + 2, n + 2), _objects(n + 2)
    b, position, force, contact, direct = (
        _objects(n + 2),
        _objects(n + 2),
        _objects(n + 2),
        _objects(n + 2),
        _objects(3),
    )
    parameters = _objects(PLANT_PARAMETERS)
    bumper, touched = family.nominal.bumper, values
    if bumper is not None:
        # What bears the bumper touches nothing.
        values = {**values, STIFFNESS: as_series(0), _ENVIRONMENT_DAMPING: as_series(0)}
    # Dampings act on speeds, and the rest on e or, divided by the mass, below.
    for each in PARAMETERS.values():
        if each.kind == "damping":
            # Two dampings at one place act together.
            parameters[each.place] = parameters[each.place] + values[each.name]
    parameters[PARAMETERS[MASS].place] = as_series(1)
    top, bottom = _robot(family, values)
    write_plant(a, b, push, position, force, contact, direct, top, bottom, parameters, h)
    k_s, k_e, inverse = values["coupling_stiffness_n_per_m"], values[STIFFNESS], values[MASS]
    scale, flange = push[n + 1], rational.dot(position[:n], a[:n, :n])
    for i in range(n):
        a[n, i] = -flange[i]
        a[n + 1, i] = inverse * (a[n + 1, i] - scale * k_e * position[i])
    b[n] = -rational.dot(position[:n], b[:n])
    a[n + 1, n] = -inverse * scale * (k_s + k_e)
    a[n + 1, n + 1] = inverse * a[n + 1, n + 1]
    b[n + 1] = inverse * b[n + 1]
    force[n] = k_s
    plant = a, b, position, force, direct[0]
    if bumper is not None:
        plant = _with_bumper(bumper, touched, (inverse * scale, h), plant)
    if _has_filter(family):
        return _filtered(family, h / values[LAG], plant)
    return _augmented(plant[0], plant[1]), *plant[2:]


def _with_bumper(
    bumper: Bumper, values: Mapping[str, Any], carried: tuple[Any, Any], plant: tuple[Any, Any, Any, Any, Any]
) -> tuple[Any, Any, Any, Any, Any]:
    """Put a bumper between the surface and the rest of a payload that `plant` has (`problems.model.plant`).

    Behind its states come g = x_p − x_b, the way of what touches against what bears it, and the speed of what touches.
    `carried` are h²/(M_p − M_t) and the period h.
    """
    (by_force, h), (a, b, position, force, direct) = carried, plant
    n = len(b)
    bearing, place, speed = n - 1, n, n + 1
    k_e, b_e = values[STIFFNESS], values[_ENVIRONMENT_DAMPING] / h
    k_t, b_t = as_series(bumper.stiffness_n_per_m), as_series(bumper.damping_n_s_per_m) / h
    light = h * h / as_series(bumper.mass_kg)
    wider, driven, shown, measured = _objects(n + 2, n + 2), _objects(n + 2), _objects(n + 2), _objects(n + 2)
    wider[:n, :n], driven[:n], shown[:n], measured[:n] = a, b, position, force
    wider[bearing, bearing] = wider[bearing, bearing] - by_force * b_t
    wider[bearing, place], wider[bearing, speed] = by_force * k_t, by_force * b_t
    wider[place, bearing], wider[place, speed] = as_series(-1), as_series(1)
    # x_p = x + e + g lies on the surface.
    for i in range(n - 2):
        wider[speed, i] = -light * k_e * position[i]
    wider[speed, n - 2], wider[speed, place] = -light * k_e, -light * (k_t + k_e)
    wider[speed, bearing], wider[speed, speed] = light * b_t, -light * (b_t + b_e)
    return wider, driven, shown, measured, direct


def _filtered(family: Family, rate: Any, plant: tuple[Any, Any, Any, Any, Any]) -> tuple[Any, Any, Any, Any]:
    """Add the state of the wrench's filter, F_m in units of a nominal stiffness, behind the others."""
    a, b, position, force, direct = plant
    n, unit = len(b), _filter_unit(family)
    wider, driven, shown, measured = _objects(n + 1, n + 1), _objects(n + 1), _objects(n + 1), _objects(n + 1)
    wider[:n, :n], driven[:n], shown[:n] = a, b, position
    for i in range(n):
        wider[n, i] = rate * force[i] / unit
    wider[n, n] = -rate
    driven[n] = rate * direct / unit
    measured[n] = as_series(unit)
    return _augmented(wider, driven), shown, measured, 0


def _augmented(a: Any, b: Any) -> Any:
    n = len(b)
    out = _objects(n + 1, n + 1)
    out[:n, :n], out[:n, n] = a, b
    return out


def _robot(family: Family, values: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return numerator and monic denominator, ascending, with all frequencies of r(s) moved to the bandwidth."""
    numerator, denominator = family.nominal.robot.ascending()
    n = len(numerator)
    top, bottom = _objects(n), _objects(n + 1)
    moves = "robot_bandwidth_hz" in family.ranges
    ratio = values["robot_bandwidth_hz"] / bandwidth_hz(family.nominal.robot) if moves else 1
    for i in range(n + 1):
        power = ratio ** (n - i) if moves and i < n else 1
        bottom[i] = as_series(float(denominator[i])) * power
        if i < n:
            top[i] = as_series(float(numerator[i])) * power
    return top, bottom


def _objects(*shape: int) -> Any:
    out = np.empty(shape, dtype=object)
    out.fill(0)
    return out
