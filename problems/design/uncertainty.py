"""The set of plants that must be safe: a box of parameters, cut down to a confidence ellipsoid where there is one.

Names and units are those of the files. On rotational axes read rad, N·m and kg·m² for m, N and kg.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.special import chdtri

from .._checks import interval, positive
from ..arrays import FloatArray
from ..errors import ParameterError
from ..frozen import FrozenDict
from ..model.plant import FREE_SPACE, NO_FILTER, Plant, WrenchFilter
from ..model.plant_parameters import PARAMETERS, build_plant, with_values
from ..model.robot import RobotModel, has_damping_ratio
from ..sobol import sobol_points

Interval = tuple[float, float]

UNCERTAIN = tuple(PARAMETERS)
ALWAYS_UNCERTAIN, FURTHER_UNCERTAIN = UNCERTAIN[:2], UNCERTAIN[2:]
ENVIRONMENT_MASS = "environment_mass_kg"
STIFFNESS, MASS = ALWAYS_UNCERTAIN
SYMBOLS: Mapping[str, str] = FrozenDict({name: PARAMETERS[name].symbol for name in UNCERTAIN})
# More corners than these are left to the samples: eleven parameters have 2048.
MOST_CORNERS = 128
_ON_THE_EDGE = 1e-9
# What is left of a deviation once the others are known; below this rounding decides what lies inside.
_FLATTEST = 1e-6


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """One point of the uncertainty; None where a parameter keeps its nominal value."""

    environment_stiffness_n_per_m: float
    payload_mass_kg: float
    coupling_stiffness_n_per_m: float | None = None
    coupling_damping_n_s_per_m: float | None = None
    drag_n_s_per_m: float | None = None
    environment_damping_n_s_per_m: float | None = None
    environment_mass_kg: float | None = None
    delay_s: float | None = None
    robot_bandwidth_hz: float | None = None
    robot_damping_ratio: float | None = None
    wrench_time_constant_s: float | None = None
    wrench_delay_s: float | None = None

    def further(self) -> dict[str, float]:
        """Return what is said beyond K_e and M_p."""
        values = ((name, getattr(self, name)) for name in FURTHER_UNCERTAIN)
        return {name: value for name, value in values if value is not None}

    def plant(self, nominal: Plant) -> Plant:
        """Return the nominal plant with the values of this point, in contact."""
        always = {STIFFNESS: self.environment_stiffness_n_per_m, MASS: self.payload_mass_kg}
        return with_values(nominal, {**always, **self.further()})


@dataclass(frozen=True, kw_only=True)
class Ellipsoid:
    """The confidence set {p : (p − c)ᵀ Σ⁻¹ (p − c) ≤ χ²}, with the quantile of χ² for as many degrees as names.

    `centre` (k,) and `covariance` (k, k) in SI in the order of `names`; `level` is the confidence. Raises
    ParameterError for a covariance that is not positive definite.
    """

    names: tuple[str, ...]
    centre: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    level: float = 0.95

    def __post_init__(self) -> None:
        for name in self.names:
            if name not in UNCERTAIN or self.names.count(name) > 1:
                raise ParameterError("ellipsoid.names", name, f"different ones of {', '.join(UNCERTAIN)}")
        count = len(self.names)
        if count == 0 or len(self.centre) != count or [len(row) for row in self.covariance] != [count] * count:
            raise ParameterError("ellipsoid", count, "names, as many numbers, and a square matrix of them")
        if not 0.0 < self.level < 1.0:
            raise ParameterError("ellipsoid.level", self.level, "between 0 and 1")
        object.__setattr__(self, "centre", tuple(float(value) for value in self.centre))
        object.__setattr__(self, "covariance", tuple(tuple(float(v) for v in row) for row in self.covariance))
        matrix = np.array(self.covariance)
        deviations = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        must = "finite, symmetric and positive definite"
        if not (np.all(np.isfinite(matrix)) and np.all(deviations > 0.0) and np.array_equal(matrix, matrix.T)):
            raise ParameterError("ellipsoid.covariance", self.covariance, must)
        try:
            flattest = float(np.min(np.diag(self._root)))
        except np.linalg.LinAlgError:
            flattest = 0.0
        if flattest < _FLATTEST:
            raise ParameterError("ellipsoid.covariance", "errors that are no further apart than rounding", must)

    @cached_property
    def _root(self) -> FloatArray:
        """Return the Cholesky factor of the correlations: stiffness and seconds lie nine decades apart."""
        deviations = self._deviations
        correlations = np.array(self.covariance) / np.outer(deviations, deviations)
        return np.asarray(np.linalg.cholesky(correlations), dtype=np.float64)

    @cached_property
    def _deviations(self) -> FloatArray:
        return np.sqrt(np.diag(np.array(self.covariance)))

    @cached_property
    def _middle(self) -> FloatArray:
        return np.array(self.centre)

    @cached_property
    def _reach(self) -> float:
        return math.sqrt(self.quantile)

    @property
    def quantile(self) -> float:
        """Return the χ² that bounds the quadratic form."""
        return float(chdtri(len(self.names), 1.0 - self.level))

    def size(self, point: FloatArray) -> float:
        """Return how far out a point (k,) lies; 1 is the surface."""
        return float(self.sizes(np.asarray(point)))

    def sizes(self, points: FloatArray) -> FloatArray:
        """Return how far out each of several points (..., k) lies; 1 is the surface."""
        scaled = np.linalg.solve(self._root, ((points - self._middle) / self._deviations).T)
        return np.asarray(np.linalg.norm(scaled, axis=0) / self._reach)

    def box(self) -> dict[str, Interval]:
        """Return the smallest box around the ellipsoid, without its negative part."""
        half = math.sqrt(self.quantile) * self._deviations
        return {
            name: (max(0.0, middle - extent), middle + extent)
            for name, middle, extent in zip(self.names, self.centre, half.tolist(), strict=True)
        }


@dataclass(frozen=True, kw_only=True)
class PlantSet:
    """All plants that must be safe: `ranges` for K_e, M_p and any of the others, and an ellipsoid that cuts them.

    What has no range is as in the `nominal` plant, which touches the softest surface with the lightest payload. Raises
    ParameterError for unknown names, ranges that cannot be, and an ellipsoid whose centre lies outside of the ranges or
    that speaks of what does not vary.
    """

    nominal: Plant
    ranges: Mapping[str, Interval]
    ellipsoid: Ellipsoid | None = None
    varying: tuple[str, ...] = field(init=False)

    def __post_init__(self) -> None:
        for name in self.ranges:
            if name not in UNCERTAIN:
                raise ParameterError("uncertain", name, f"one of {', '.join(UNCERTAIN)}")
        for name in ALWAYS_UNCERTAIN:
            if name not in self.ranges:
                raise ParameterError(name, None, "given as a range")
        if "robot_damping_ratio" in self.ranges and not has_damping_ratio(self.nominal.robot):
            must = f"given for a robot with two poles and no zero only (this one has {self.nominal.robot.order} poles)"
            raise ParameterError("robot_damping_ratio", self.ranges["robot_damping_ratio"], must)
        checked = {name: _checked(name, self.ranges[name]) for name in UNCERTAIN if name in self.ranges}
        object.__setattr__(self, "ranges", FrozenDict(checked))
        object.__setattr__(self, "varying", tuple(n for n, (low, high) in checked.items() if high > low))
        soft_and_light = {name: checked[name][0] for name in ALWAYS_UNCERTAIN}
        object.__setattr__(self, "nominal", with_values(self.nominal, soft_and_light))
        if self.ellipsoid is None:
            return
        for name, middle in zip(self.ellipsoid.names, self.ellipsoid.centre, strict=True):
            if name not in self.varying:
                raise ParameterError("ellipsoid.names", name, "one of the parameters that vary")
            low, high = checked[name]
            if not low <= middle <= high:
                raise ParameterError(f"ellipsoid.centre of {name}", middle, f"inside the range {low:g} to {high:g}")

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        *,
        environment_stiffness_n_per_m: Interval,
        payload_mass_kg: Interval,
        wrench_filter: WrenchFilter = NO_FILTER,
        further: Mapping[str, Interval] | None = None,
        ellipsoid: Ellipsoid | None = None,
        **nominal: float,
    ) -> "PlantSet":
        """Return the set around a robot and the `nominal` values of the other parameters, by their names."""
        always = {STIFFNESS: environment_stiffness_n_per_m, MASS: payload_mass_kg}
        for name in always.keys() & (further or {}).keys():
            raise ParameterError("uncertain", name, "given as the problem's own range")
        lowest = {name: _checked(name, span)[0] for name, span in always.items()}
        plant = build_plant(robot, {**lowest, **nominal}, wrench_filter)
        return cls(nominal=plant, ranges={**always, **(further or {})}, ellipsoid=ellipsoid)

    @property
    def environment_stiffness_n_per_m(self) -> Interval:
        """The range of K_e."""
        return self.ranges[STIFFNESS]

    @property
    def payload_mass_kg(self) -> Interval:
        """The range of M_p."""
        return self.ranges[MASS]

    @property
    def further(self) -> dict[str, Interval]:
        """The ranges beyond K_e and M_p."""
        return {name: span for name, span in self.ranges.items() if name not in ALWAYS_UNCERTAIN}

    def range_of(self, name: str) -> Interval:
        """Return the range of one parameter, from nominal to nominal where none is given."""
        if name in self.ranges:
            return self.ranges[name]
        value = PARAMETERS[name].value(self.nominal)
        return value, value

    def nominal_values(self) -> dict[str, float]:
        """Return the nominal values of what may be uncertain beyond K_e and M_p, as far as the plant has it."""
        robot = self.nominal.robot
        values = {
            name: PARAMETERS[name].value(self.nominal)
            for name in FURTHER_UNCERTAIN
            if name != "robot_damping_ratio" or has_damping_ratio(robot)
        }
        absent = {name for name in values if PARAMETERS[name].part == "wrench_filter" or name == ENVIRONMENT_MASS}
        return {name: value for name, value in values.items() if name not in absent or value or name in self.ranges}

    def at(self, mass_kg: float, stiffness_n_per_m: float) -> Plant:
        """Return the nominal plant with another payload and surface; without stiffness it is in free space."""
        plant = self.nominal if stiffness_n_per_m > 0.0 else self.nominal.in_contact_with(FREE_SPACE)
        return with_values(plant, {MASS: mass_kg, STIFFNESS: stiffness_n_per_m})

    def with_ranges(self, ranges: Mapping[str, Interval]) -> "PlantSet":
        """Return the same with further or other ranges."""
        return replace(self, ranges={**self.ranges, **ranges})

    def only(self, names: Iterable[str] = ALWAYS_UNCERTAIN) -> "PlantSet":
        """Return the box over these parameters, everything else nominal: the lowest K_e and M_p, and no ellipsoid."""
        kept = {name: self.ranges[name] for name in names}
        lowest = {name: (self.ranges[name][0],) * 2 for name in ALWAYS_UNCERTAIN}
        return PlantSet(nominal=self.nominal, ranges={**lowest, **kept})

    def from_unit(self, unit: Sequence[float] | FloatArray) -> Scenario:
        """Return the scenario of a point of the unit cube (d,), one side per entry of `varying`, pulled into the set.

        K_e goes by equal ratios, the others by equal steps.
        """
        values = {name: low for name, (low, high) in self.ranges.items() if low == high}
        for name, share in zip(self.varying, np.clip(unit, 0.0, 1.0).tolist(), strict=True):
            low, high = self.ranges[name]
            value = _along(name, low, high, share)
            # The ends are what was promised, not what rounding makes of them.
            values[name] = low if share == 0.0 else high if share == 1.0 else min(max(value, low), high)
        return self._inside(values)

    def from_units(self, units: FloatArray) -> dict[str, FloatArray]:
        """Return the values (m,) by name of points (m, d) inside of the unit cube, as `from_unit` makes each."""
        shares = dict(zip(self.varying, units.T, strict=True))
        values = {name: np.full(len(units), low) for name, (low, _) in self.ranges.items()}
        for name, share in shares.items():
            low, high = self.ranges[name]
            values[name] = np.clip(_along(name, low, high, share), low, high)
        if self.ellipsoid is not None:
            names, centre = self.ellipsoid.names, np.array(self.ellipsoid.centre)
            points = np.stack([values[name] for name in names], axis=1)
            pulled = centre + (points - centre) / np.maximum(self.ellipsoid.sizes(points), 1.0)[:, None]
            values |= dict(zip(names, pulled.T, strict=True))
        return values

    def to_unit(self, scenario: Scenario) -> FloatArray:
        """Return the point of the unit cube (d,) of a scenario; one that keeps a nominal value lies in the middle."""
        unit = np.full(len(self.varying), 0.5)
        for i, name in enumerate(self.varying):
            (low, high), value = self.ranges[name], getattr(scenario, name)
            if value is not None:
                ratio = name == STIFFNESS
                unit[i] = math.log(value / low) / math.log(high / low) if ratio else (value - low) / (high - low)
        return np.asarray(np.clip(unit, 0.0, 1.0))

    def contains(self, scenario: Scenario) -> bool:
        """Whether a scenario lies in the set; what keeps its nominal value does."""
        for name, (low, high) in self.ranges.items():
            value = getattr(scenario, name)
            if value is not None and not low <= value <= high:
                return False
        if any(name not in self.ranges for name in scenario.further()):
            return False
        if self.ellipsoid is None:
            return True
        always = {name: float(getattr(scenario, name)) for name in ALWAYS_UNCERTAIN}
        centre = dict(zip(self.ellipsoid.names, self.ellipsoid.centre, strict=True))
        values = {**centre, **always, **scenario.further()}
        point = np.array([values[name] for name in self.ellipsoid.names])
        return self.ellipsoid.size(point) <= 1.0 + _ON_THE_EDGE

    def _inside(self, values: dict[str, float]) -> Scenario:
        """Return the scenario of values in the box, moved towards the ellipsoid's centre as far as it takes."""
        if self.ellipsoid is not None:
            point = np.array([values[name] for name in self.ellipsoid.names])
            size = self.ellipsoid.size(point)
            if size > 1.0:
                centre = np.array(self.ellipsoid.centre)
                moved = centre + (point - centre) / size
                values = {**values, **dict(zip(self.ellipsoid.names, moved.tolist(), strict=True))}
        return Scenario(**values)

    def corners(self) -> tuple[Scenario, ...]:
        """Return the corners of the box, pulled into the set; of many parameters the first ones alone vary together.

        With more than `MOST_CORNERS` corners the later parameters all go one way, then all the other.
        """
        count = len(self.varying)
        free = min(count, int(math.log2(MOST_CORNERS)) - 1 if 2**count > MOST_CORNERS else count)
        rest = ((0.0,) * (count - free), (1.0,) * (count - free)) if count > free else ((),)
        units = [(*ends, *same) for same in rest for ends in itertools.product((0.0, 1.0), repeat=free)]
        return tuple(dict.fromkeys(self.from_unit(unit) for unit in units))

    def samples(self, count: int, *, seed: int = 0) -> tuple[Scenario, ...]:
        """Return scenarios of a scrambled Sobol' sequence, `count` rounded up to a power of two, pulled into the set.

        What lies outside of the ellipsoid ends up on its surface, where the worst plants mostly are.
        """
        if not self.varying:
            return (self.from_unit(()),)
        units = sobol_points(len(self.varying), 2 ** max(0, math.ceil(math.log2(count))), seed=seed)
        return tuple(dict.fromkeys(self.from_unit(unit) for unit in units))


def _along(name: str, low: float, high: float, share: Any) -> Any:
    """Return what lies at a share, or at an array of them, of a range: K_e by equal ratios, others by equal steps."""
    return low * (high / low) ** share if name == STIFFNESS else low + share * (high - low)


def _checked(name: str, span: Interval) -> Interval:
    """Return a range that can be; raises ParameterError."""
    low, high = interval(name, span)
    return (low if PARAMETERS[name].may_be_zero else positive(name, low)), high
