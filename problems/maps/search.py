"""The stable set of a controller parameter, all its intervals, along another (docs/method.md, errata 5 and 7)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .._checks import positive
from ..arrays import BoolArray, FloatArray
from ..errors import ParameterError
from ..frozen import FrozenDict, freeze
from ..model.controller import AdmittanceController
from ..model.plant import Plant
from ..progress import Progress
from .loops import Designs, PlantChunk, Where, build_chunk, check_delay, designs_around
from .maps import PLANTS_PER_CHUNK, MapAxis, check_varied
from .parameters import controller_at, plant_at

DEFAULT_TOLERANCE = 1e-5


@dataclass(frozen=True, kw_only=True)
class StableInterval:
    """The loop is stable from `lower` to `upper`, both included.

    `lower_is_bound` and `upper_is_bound` say that the search ended there, not stability.
    """

    lower: float
    upper: float
    lower_is_bound: bool
    upper_is_bound: bool


@dataclass(frozen=True, kw_only=True)
class IntervalCase:
    """One curve of a request: a controller, and parameters that stay at their value."""

    controller: AdmittanceController
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "fixed")


@dataclass(frozen=True, kw_only=True)
class IntervalRequest:
    """Which values of the controller parameter `searched` are stable, for every case at every value of `along`.

    The range of `searched` is looked at in its `count` values, then every change of verdict is bisected until it is
    known within `tolerance`, a share of the range (of its logarithm for "log"). What is narrower than the step of the
    range may be missed. `where` says which loops must be stable.
    """

    plant: Plant
    sample_time_s: float
    cases: Mapping[str, IntervalCase]
    along: MapAxis
    searched: MapAxis
    where: Where = "both"
    tolerance: float = DEFAULT_TOLERANCE

    def __post_init__(self) -> None:
        object.__setattr__(self, "sample_time_s", positive("sample_time_s", self.sample_time_s))
        freeze(self, "cases")
        positive("tolerance", self.tolerance)
        if not self.cases:
            raise ParameterError("cases", "none", "at least one")
        if self.where not in {"contact", "free_space", "both"}:
            raise ParameterError("where", self.where, "contact, free_space or both")
        if self.searched.parameter.part != "controller":
            raise ParameterError("searched parameter", self.searched.name, "one of the controller")
        for case in self.cases.values():
            check_varied((self.along, self.searched), case.fixed)
            for value in (self.along.low, self.along.high):
                check_delay(self.plant_at(case, value), self.sample_time_s)
                for end in (self.searched.low, self.searched.high):
                    controller_at(case.controller, {**self.values_at(case, value), self.searched.name: end})

    def values_at(self, case: IntervalCase, along: float) -> dict[str, float]:
        """Return the values that are set at one value of `along`."""
        return {**case.fixed, self.along.name: along}

    def plant_at(self, case: IntervalCase, along: float) -> Plant:
        """Return the plant of a case at one value of `along`."""
        return plant_at(self.plant, self.values_at(case, along))


@dataclass(frozen=True, kw_only=True)
class IntervalResult:
    """For each case the stable intervals, from low to high, at each value of `along`; an empty tuple is none."""

    request: IntervalRequest
    intervals: Mapping[str, tuple[tuple[StableInterval, ...], ...]]

    def smallest(self, case: str) -> FloatArray:
        """Return the smallest stable value at each value of `along`, NaN where there is none."""
        return np.array([each[0].lower if each else np.nan for each in self.intervals[case]])

    def largest(self, case: str) -> FloatArray:
        """Return the largest stable value at each value of `along`, NaN where there is none."""
        return np.array([each[-1].upper if each else np.nan for each in self.intervals[case]])


def find_stable_intervals(
    request: IntervalRequest, *, plants_per_chunk: int = PLANTS_PER_CHUNK, progress: Progress | None = None
) -> IntervalResult:
    """Scan and bisect: the memory is that of the result and of one chunk of plants.

    `progress` receives the share of the work done since the last call.
    """
    found: dict[str, list[tuple[StableInterval, ...]]] = {name: [] for name in request.cases}
    along = request.along.values()
    for name, case in request.cases.items():
        for start in range(0, len(along), plants_per_chunk):
            values = along[start : start + plants_per_chunk]
            if request.along.parameter.part == "plant":
                found[name] += _on_plants(request, case, values)
            else:
                found[name] += _on_controllers(request, case, values)
            if progress is not None:
                progress(len(values) / (len(along) * len(request.cases)))
    return IntervalResult(request=request, intervals=FrozenDict({name: tuple(each) for name, each in found.items()}))


def _on_plants(request: IntervalRequest, case: IntervalCase, along: FloatArray) -> list[tuple[StableInterval, ...]]:
    """Search for one controller on a chunk of plants."""
    plants = [request.plant_at(case, float(value)) for value in along]
    chunk = build_chunk(plants, request.sample_time_s, request.where)
    controller = controller_at(case.controller, case.fixed)
    stable = chunk.stable(_designs(request, controller, request.searched.values()))
    return [_intervals(request, chunk.one(j), controller, stable[:, j]) for j in range(len(plants))]


def _on_controllers(
    request: IntervalRequest, case: IntervalCase, along: FloatArray
) -> list[tuple[StableInterval, ...]]:
    """Search for several controllers on one plant."""
    chunk = build_chunk([plant_at(request.plant, case.fixed)], request.sample_time_s, request.where)
    out = []
    for value in along:
        controller = controller_at(case.controller, request.values_at(case, float(value)))
        stable = chunk.stable(_designs(request, controller, request.searched.values()))[:, 0]
        out.append(_intervals(request, chunk, controller, stable))
    return out


def _designs(request: IntervalRequest, controller: AdmittanceController, values: FloatArray) -> Designs:
    return designs_around(controller, {request.searched.name: values})


def _intervals(
    request: IntervalRequest, chunk: PlantChunk, controller: AdmittanceController, stable: BoolArray
) -> tuple[StableInterval, ...]:
    """Return the stable intervals on one plant, given the verdicts at the values that are looked at."""
    values = request.searched.values()
    changes = np.flatnonzero(stable[1:] != stable[:-1])
    ends = _bisect(request, chunk, controller, stable, changes)
    starts = [float(values[0])] if stable[0] else []
    starts += [end for end, k in zip(ends, changes, strict=True) if stable[k + 1]]
    stops = [end for end, k in zip(ends, changes, strict=True) if stable[k]]
    stops += [float(values[-1])] if stable[-1] else []
    return tuple(
        StableInterval(
            lower=lower,
            upper=upper,
            lower_is_bound=bool(stable[0]) and i == 0,
            upper_is_bound=bool(stable[-1]) and i == len(starts) - 1,
        )
        for i, (lower, upper) in enumerate(zip(starts, stops, strict=True))
    )


def _bisect(
    request: IntervalRequest,
    chunk: PlantChunk,
    controller: AdmittanceController,
    stable: BoolArray,
    changes: NDArray[np.int64],
) -> Sequence[float]:
    """Return where the verdict changes between the values `changes` and the next ones: the side that is stable."""
    if not len(changes):
        return []
    values, is_log = request.searched.values(), request.searched.spacing == "log"
    scale = np.log(values) if is_log else values
    inside = np.where(stable[changes], scale[changes], scale[changes + 1])
    outside = np.where(stable[changes], scale[changes + 1], scale[changes])
    kept = np.where(stable[changes], values[changes], values[changes + 1])
    while np.max(np.abs(outside - inside)) > request.tolerance * (scale[-1] - scale[0]):
        middle = 0.5 * (inside + outside)
        tried = np.exp(middle) if is_log else middle
        holds = chunk.stable(_designs(request, controller, tried))[:, 0]
        inside, outside = np.where(holds, middle, inside), np.where(holds, outside, middle)
        kept = np.where(holds, tried, kept)
    return [float(value) for value in kept]
