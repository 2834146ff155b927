"""The plants that a certificate speaks of, as numbers that the loop's equations take: in balls, with derivatives."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from problems.design.uncertainty import FURTHER_UNCERTAIN, Scenario
from problems.errors import ParameterError
from problems.frozen import freeze
from problems.model.plant import FREE_SPACE, Plant, write_plant
from problems.model.robot import bandwidth_hz, vary_robot
from problems.model.sampled import split_delay

from . import rational
from .balls import Series, as_series, ball, exponential, number, precise

FloatArray = NDArray[np.float64]
Interval = tuple[float, float]

MASS, STIFFNESS = "payload_mass_kg", "environment_stiffness_n_per_m"
LAG, LATE = "wrench_time_constant_s", "wrench_delay_s"
# What is proved over; a robot's damping ratio is not among them.
PROVABLE = (STIFFNESS, MASS, *(name for name in FURTHER_UNCERTAIN if name != "robot_damping_ratio"))


@dataclass(frozen=True, kw_only=True)
class Family:
    """A nominal plant and closed ranges of its parameters, under a hold of `sample_time_s`.

    `ranges` is keyed by the names of `problems.design.uncertainty`; what is not named is nominal. Free space is a
    nominal
    environment that is FREE_SPACE. Raises ParameterError for a name that is not provable, for a range that is none,
    for an environment with mass, for one whose stiffness reaches 0 without being free space, for a filter of the wrench
    that reaches 0, and for a delay that crosses a whole number of samples, where the loop changes its order
    (`build_families` cuts there). A delay of the wrench makes the same loop as a longer T_d: `build_families` adds
    them, and `shared_delay` then holds the ranges of both.
    """

    nominal: Plant
    ranges: Mapping[str, Interval]
    sample_time_s: float
    shared_delay: tuple[Interval, Interval] | None = None

    def __post_init__(self) -> None:
        freeze(self, "ranges")
        for name, (low, high) in self.ranges.items():
            if name not in PROVABLE:
                raise ParameterError("ranges", name, f"one of {', '.join(PROVABLE)}")
            if not 0.0 <= low <= high < math.inf:
                raise ParameterError(name, (low, high), "[lowest, highest] with 0 ≤ lowest ≤ highest")
        environment = self.nominal.environment
        if environment.mass_kg != 0.0:
            raise ParameterError("environment.mass_kg", environment.mass_kg, "0, to be proved over")
        softest = self.range_of(STIFFNESS)[0]
        touched = {STIFFNESS, "environment_damping_n_s_per_m"} & set(self.ranges)
        if softest <= 0.0 and (touched or not environment.is_free_space):
            raise ParameterError(STIFFNESS, softest, "greater than 0 in contact")
        if self.nominal.wrench_filter.delay_s > 0.0 or LATE in self.ranges:
            raise ParameterError(LATE, self.range_of(LATE), "0 (`build_families` adds it to the delay)")
        if LAG in self.ranges and not min(self.nominal.wrench_filter.time_constant_s, self.ranges[LAG][0]) > 0.0:
            raise ParameterError(LAG, self.ranges[LAG], "greater than 0, as the nominal one")
        if self.range_of(MASS)[0] <= 0.0:
            raise ParameterError(MASS, self.range_of(MASS)[0], "greater than 0")
        self.delay()

    def range_of(self, name: str) -> Interval:
        """Return the range of one parameter, from nominal to nominal where none is given."""
        plant = self.nominal
        values = {
            STIFFNESS: plant.environment.stiffness_n_per_m,
            MASS: plant.payload.mass_kg,
            "coupling_stiffness_n_per_m": plant.coupling.stiffness_n_per_m,
            "coupling_damping_n_s_per_m": plant.coupling.damping_n_s_per_m,
            "drag_n_s_per_m": plant.payload.drag_n_s_per_m,
            "environment_damping_n_s_per_m": plant.environment.damping_n_s_per_m,
            "delay_s": plant.robot.delay_s,
            "wrench_time_constant_s": plant.wrench_filter.time_constant_s,
            "wrench_delay_s": plant.wrench_filter.delay_s,
        }
        if name in self.ranges:
            return self.ranges[name]
        value = values[name] if name in values else bandwidth_hz(plant.robot)
        return value, value

    @property
    def varying(self) -> tuple[str, ...]:
        """Names of what has more than one value, in a fixed order."""
        return tuple(name for name in PROVABLE if self.range_of(name)[0] < self.range_of(name)[1])

    @property
    def is_free_space(self) -> bool:
        """Whether nothing is touched, so that the loop keeps its integrator."""
        return self.range_of(STIFFNESS)[1] == 0.0

    def delay(self) -> tuple[int, bool]:
        """Return the whole samples of delay, and whether a fraction may remain."""
        low, high = self.range_of("delay_s")
        whole, fraction = split_delay(low, self.sample_time_s)
        if low == high:
            return whole, fraction > 0.0
        last, rest = split_delay(high, self.sample_time_s)
        if last > whole and not (last == whole + 1 and rest == 0.0):
            raise ParameterError(
                "delay_s", (low, high), "within two ticks of the controller; cut it with `build_families`"
            )
        return whole, True

    def in_free_space(self) -> "Family":
        """Return the same plants with nothing to touch."""
        touching = (STIFFNESS, "environment_damping_n_s_per_m")
        kept = {name: span for name, span in self.ranges.items() if name not in touching}
        return replace(self, nominal=self.nominal.in_contact_with(FREE_SPACE), ranges=kept)

    def box(self) -> FloatArray:
        """Return the coordinates' ends (d, 2), rounded outwards; the payload's coordinate is 1/M_p."""
        spans = [self.range_of(name) for name in self.varying]
        rows = [
            (np.nextafter(1.0 / high, 0.0), np.nextafter(1.0 / low, np.inf)) if name == MASS else (low, high)
            for name, (low, high) in zip(self.varying, spans, strict=True)
        ]
        return np.array(rows, dtype=np.float64).reshape(-1, 2)

    def scenario(self, point: FloatArray) -> Scenario:
        """Return the plant at coordinates (d,) as a point of the uncertainty."""
        values = dict(zip(self.varying, np.asarray(point).tolist(), strict=True))
        if MASS in values:
            values[MASS] = 1.0 / values[MASS]
        inside = {name: min(max(value, self.ranges[name][0]), self.ranges[name][1]) for name, value in values.items()}
        if self.shared_delay is not None:
            inside |= self._shared(inside.get("delay_s", self.range_of("delay_s")[0]))
        return Scenario(**{STIFFNESS: self.range_of(STIFFNESS)[0], MASS: self.range_of(MASS)[0], **inside})

    def _shared(self, whole: float) -> dict[str, float]:
        """Return T_d and the wrench's delay whose sum is `whole`, each as far into its range as the other."""
        own, late = self.shared_delay or ((0.0, 0.0), (0.0, 0.0))
        width = own[1] - own[0] + late[1] - late[0]
        share = min(max((whole - own[0] - late[0]) / width, 0.0), 1.0) if width > 0.0 else 0.0
        return {"delay_s": own[0] + share * (own[1] - own[0]), LATE: late[0] + share * (late[1] - late[0])}

    def plant(self, point: FloatArray) -> Plant:
        """Return the plant at coordinates (d,)."""
        return self.scenario(point).plant(self.nominal)


def build_families(nominal: Plant, ranges: Mapping[str, Interval], sample_time_s: float) -> tuple[Family, ...]:
    """Return all plants as families, cut where the delay passes a tick of the controller."""
    late = ranges.get(LATE, (nominal.wrench_filter.delay_s,) * 2)
    shared: tuple[Interval, Interval] | None = None
    if late[1] > 0.0:
        own = ranges.get("delay_s", (nominal.robot.delay_s, nominal.robot.delay_s))
        shared = own, (late[0], late[1])
        ranges = {name: span for name, span in ranges.items() if name not in {LATE, "delay_s"}}
        if own[0] < own[1] or late[0] < late[1]:
            # Rounded outwards: the range must hold every sum.
            ranges["delay_s"] = float(np.nextafter(own[0] + late[0], 0.0)), float(np.nextafter(own[1] + late[1], 1.0))
        robot = vary_robot(nominal.robot, delay_s=nominal.loop_delay_s)
        nominal = replace(nominal, robot=robot, wrench_filter=replace(nominal.wrench_filter, delay_s=0.0))
    low, high = ranges.get("delay_s", (nominal.robot.delay_s, nominal.robot.delay_s))
    first, last = math.floor(low / sample_time_s) + 1, math.ceil(high / sample_time_s)
    ends = [low, *(each for k in range(first, last) if low < (each := k * sample_time_s) < high), high]
    spans = [dict(ranges) if "delay_s" not in ranges else {**ranges, "delay_s": span} for span in pairwise(ends)]
    return tuple(
        Family(nominal=nominal, ranges=each, sample_time_s=sample_time_s, shared_delay=shared) for each in spans
    )


@precise
def plant_polynomials(family: Family, cell: FloatArray, along: int | None = None) -> tuple[list[Any], ...]:
    """Return d, n_F and n_x in w = z − 1 over a cell (d, 2) of coordinates, ascending, as series.

    X = n_x/(z^c d) X^d and F = n_F/(z^c d) X^d with d = det(zI − φ) and c commands in the delay chain. The slope of
    every number is its derivative along coordinate `along`, over the whole cell.
    """
    values = _values(family, cell, along)
    whole, has_fraction = family.delay()
    augmented, position, force, direct = _continuous(family, values)
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
    answer = _Filtered(family, full[:size, :size]) if _has_filter(family) else _Plain(full[:size, :size], force)
    characteristic = answer.characteristic
    found_force, found_position = [direct * each for each in characteristic], [0]
    for column, is_newer in inputs:
        for_force, for_position = answer.numerators(position, column)
        found_force = rational.add(found_force, rational.times_z(for_force) if is_newer else for_force)
        found_position = rational.add(found_position, rational.times_z(for_position) if is_newer else for_position)
    return characteristic, found_force, found_position


class _Plain:
    """Numerators of F and x over one characteristic polynomial, from the change over a sample."""

    def __init__(self, whole: Any, force: Any) -> None:
        size = len(whole)
        change = whole - np.array([[int(i == j) for j in range(size)] for i in range(size)], dtype=object)
        self.force = force
        self.characteristic, self.adjugate = rational.resolvent(change)

    def numerators(self, position: Any, column: Any) -> tuple[list[Any], list[Any]]:
        """Return those of F and of x for one input's column."""
        return rational.numerator(self.force, self.adjugate, column), rational.numerator(
            position, self.adjugate, column
        )


class _Filtered:
    """The same of a plant whose last state is that of the wrench's filter, which nothing else depends on.

    With that block taken apart, det = d (w − δ) and F_m = ρ adj γ + d γ_f: the filter's ball stays out of d and adj.
    """

    def __init__(self, family: Family, whole: Any) -> None:
        n = len(whole) - 1
        self.plant = _Plain(whole[:n, :n], whole[n, :n])
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
    """Return the stiffness [N/m] in which the filter's state is told: a number that does not vary."""
    coupling = family.nominal.coupling
    return coupling.stiffness_n_per_m + coupling.damping_n_s_per_m / family.sample_time_s


def _values(family: Family, cell: FloatArray, along: int | None) -> dict[str, Any]:
    """Return every parameter as a series; the payload's is 1/M_p."""
    found = {name: as_series(family.range_of(name)[0]) for name in PROVABLE}
    found[MASS] = 1 / found[MASS]
    for i, name in enumerate(family.varying):
        found[name] = Series(ball(float(cell[i, 0]), float(cell[i, 1])), number(1) if i == along else None)
    return found


def _continuous(family: Family, values: Mapping[str, Any]) -> tuple[Any, Any, Any, Any]:
    """Return the augmented continuous plant by sample, square, the rows of x and F, and F's direct part.

    The equations are those of `write_plant`; the payload's position is told relative to the flange, e = x_p − x, as
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
    parameters = _objects(7)
    named = ("coupling_damping_n_s_per_m", "drag_n_s_per_m", "environment_damping_n_s_per_m")
    for place, name in zip((1, 3, 5), named, strict=True):
        parameters[place] = values[name]
    parameters[2] = as_series(1)
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
    if _has_filter(family):
        return _filtered(family, h / values[LAG], (a, b, position, force, direct[0]))
    return _augmented(a, b), position, force, direct[0]


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
