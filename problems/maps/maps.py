"""Maps: any two parameters of the loop against stability, a margin or the peak of a contact."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from .._checks import finite, positive
from ..arrays import BoolArray, FloatArray
from ..contact.transient import Approach
from ..errors import ParameterError
from ..frozen import freeze
from ..model.controller import AdmittanceController, check_feedback_damping
from ..model.plant import Plant
from ..progress import Progress
from .loops import Designs, Where, build_chunk, check_delay, designs_around, peaks_of
from .parameters import MapParameter, MapQuantity, Part, check_together, controller_at, find_parameter, plant_at

_Kind = TypeVar("_Kind", np.bool_, np.float64)
Spacing = Literal["linear", "log"]

MOST_VALUES = 2000
MOST_POINTS = 1_000_000
PLANTS_PER_CHUNK = 64
_CONTROLLERS_PER_BLOCK = 4096


@dataclass(frozen=True, kw_only=True)
class MapAxis:
    """`count` values of a parameter from `low` to `high`, by equal steps or equal ratios ("log").

    Raises ParameterError for an unknown parameter, a range that is empty, reversed or not possible, or a count that is
    not between 2 and 2000.
    """

    name: str
    low: float
    high: float
    count: int
    spacing: Spacing = "linear"

    def __post_init__(self) -> None:
        parameter = find_parameter(self.name)
        object.__setattr__(self, "name", parameter.name)
        for end in ("low", "high"):
            object.__setattr__(self, end, finite(f"{end} end of {self.name}", getattr(self, end)))
        found = (self.low, self.high)
        if not self.low < self.high:
            raise ParameterError(f"range of {self.name}", found, "LOW:HIGH with LOW below HIGH")
        if self.spacing not in {"linear", "log"}:
            raise ParameterError(f"spacing of {self.name}", self.spacing, "linear or log")
        if self.low < 0.0 or (self.low == 0.0 and not parameter.may_be_zero):
            least = "0 or above" if parameter.may_be_zero else "above 0"
            raise ParameterError(f"range of {self.name}", found, least)
        if self.low == 0.0 and self.spacing == "log":
            raise ParameterError(f"range of {self.name}", found, "above 0 for logarithmic spacing")
        if self.name == "feedback_damping_s":
            check_feedback_damping(self.high)
        if not 2 <= self.count <= MOST_VALUES:
            raise ParameterError(f"number of values of {self.name}", self.count, f"between 2 and {MOST_VALUES}")

    @property
    def parameter(self) -> MapParameter:
        """What is varied."""
        return find_parameter(self.name)

    def values(self) -> FloatArray:
        """Return the values (count,), both ends included exactly."""
        space = np.geomspace if self.spacing == "log" else np.linspace
        values = np.asarray(space(self.low, self.high, self.count), dtype=np.float64)
        values[0], values[-1] = self.low, self.high
        return values


@dataclass(frozen=True, kw_only=True)
class MapRequest:
    """What is asked: `quantity` over `x` and `y` around a plant (in contact, where contact is asked) and a controller.

    `fixed` holds parameters that stay at their value at every point; it differs from a changed plant for the payload
    frequency and damping ratio, which then determine M_p and B_p everywhere. `where` says for which loop stability is
    asked and the smallest margin taken; a peak needs both. `approach` matters for peaks only.

    Raises ParameterError for a request that one of its corners cannot meet.
    """

    plant: Plant
    controller: AdmittanceController
    sample_time_s: float
    x: MapAxis
    y: MapAxis
    quantity: MapQuantity = MapQuantity.STABILITY
    where: Where = "both"
    approach: Approach = field(default_factory=lambda: Approach(force_n=30.0))
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "sample_time_s", positive("sample_time_s", self.sample_time_s))
        object.__setattr__(self, "quantity", MapQuantity(self.quantity))
        freeze(self, "fixed")
        if self.where not in {"contact", "free_space", "both"}:
            raise ParameterError("where", self.where, "contact, free_space or both")
        if self.quantity.is_peak and self.where != "both":
            raise ParameterError("where", self.where, "both for a peak (a contact begins in free space)")
        check_varied((self.x, self.y), self.fixed)
        if self.x.count * self.y.count > MOST_POINTS:
            raise ParameterError("points of the map", self.x.count * self.y.count, f"at most {MOST_POINTS}")
        for x in (self.x.low, self.x.high):
            for y in (self.y.low, self.y.high):
                plant, _ = self.point(x, y)
                check_delay(plant, self.sample_time_s)
                if self.quantity.is_peak and plant.environment.is_free_space:
                    raise ParameterError("environment_stiffness", 0.0, "above 0 for a peak: a surface to touch")

    def point(self, x: float, y: float) -> tuple[Plant, AdmittanceController]:
        """Return plant and controller at one point of the map."""
        values = {**self.fixed, self.x.name: x, self.y.name: y}
        return plant_at(self.plant, values), controller_at(self.controller, values)


@dataclass(frozen=True, kw_only=True)
class MapResult:
    """`is_stable` and `values`, rows over y and columns over x.

    A value of an unstable loop is NaN; a margin that nothing limits is infinite. `values` is all NaN when only
    stability was asked. Units are those of the quantity.
    """

    request: MapRequest
    is_stable: BoolArray
    values: FloatArray


@dataclass(frozen=True, kw_only=True)
class MapPoint:
    """One point of a map; `value` is NaN when the loop is unstable or only stability was asked."""

    x: float
    y: float
    is_stable: bool
    value: float


def check_varied(axes: Sequence[MapAxis], fixed: Mapping[str, float]) -> None:
    """Raise ParameterError if axes and fixed values say anything twice."""
    names = [find_parameter(name).name for name in fixed] + [axis.name for axis in axes]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ParameterError(twice[0], f"{names.count(twice[0])} times", "given once, as an axis or as a fixed value")
    check_together(names)


def compute_map(
    request: MapRequest, *, plants_per_chunk: int = PLANTS_PER_CHUNK, progress: Progress | None = None
) -> MapResult:
    """Compute every point of a map: the memory is that of the result and of one chunk of plants.

    Every distinct plant is sampled once. `progress` receives the share of the work done since the last call.
    """
    plants, controllers = _Varied(request, "plant"), _Varied(request, "controller")
    base = controller_at(request.controller, request.fixed)
    shape = (controllers.count, plants.count)
    stable, values = np.zeros(shape, dtype=np.bool_), np.full(shape, np.nan)
    for start in range(0, plants.count, plants_per_chunk):
        part = slice(start, min(start + plants_per_chunk, plants.count))
        columns = plants.columns(part.start, part.stop)
        here = [
            plant_at(request.plant, {**request.fixed, **{name: float(values[i]) for name, values in columns.items()}})
            for i in range(part.stop - part.start)
        ]
        for first in range(0, controllers.count, _CONTROLLERS_PER_BLOCK):
            block = slice(first, min(first + _CONTROLLERS_PER_BLOCK, controllers.count))
            those = designs_around(base, controllers.columns(block.start, block.stop))
            stable[block, part], values[block, part] = _evaluate(request, here, those)
            if progress is not None:
                progress(len(here) * those.count / stable.size)
    return MapResult(request=request, is_stable=_on_grid(request, stable), values=_on_grid(request, values))


def evaluate_point(request: MapRequest, x: float, y: float) -> MapPoint:
    """Return what the map of `request` shows at one point, which need not be one of its grid."""
    plant, controller = request.point(x, y)
    stable, values = _evaluate(request, [plant], designs_around(controller, {}))
    return MapPoint(x=x, y=y, is_stable=bool(stable[0, 0]), value=float(values[0, 0]))


def distance_at_boundary(result: MapResult) -> FloatArray:
    """Return the largest |z| − 1 of the loops beside every change of verdict, NaN elsewhere, as rows over y.

    It is below 0 on the stable side and above on the other; where it passes 0 between two neighbours is the boundary.
    """
    stable, request = result.is_stable, result.request
    beside = np.zeros(stable.shape, dtype=np.bool_)
    down, across = stable[1:] != stable[:-1], stable[:, 1:] != stable[:, :-1]
    beside[1:] |= down
    beside[:-1] |= down
    beside[:, 1:] |= across
    beside[:, :-1] |= across
    x, y = request.x.values(), request.y.values()
    out = np.full(stable.shape, np.nan)
    last, chunk = None, None
    # Rows or columns in which the plant stays the same come one after the other.
    order = np.argwhere(beside.T)[:, ::-1] if request.x.parameter.part == "plant" else np.argwhere(beside)
    for i, j in order:
        plant, controller = request.point(float(x[j]), float(y[i]))
        if chunk is None or plant != last:
            last, chunk = plant, build_chunk([plant], request.sample_time_s, request.where)
        distance = abs(chunk.largest_radius(controller) - 1.0)
        out[i, j] = -distance if stable[i, j] else distance
    return out


class _Varied:
    """The combinations of those axes that belong to plant or controller, y outside, x inside; one if there are none."""

    def __init__(self, request: MapRequest, part: Part) -> None:
        self.axes = [(axis.name, axis.values()) for axis in (request.y, request.x) if axis.parameter.part == part]
        self.shape = tuple(len(values) for _, values in self.axes)
        self.count = math.prod(self.shape)

    def columns(self, start: int, stop: int) -> dict[str, FloatArray]:
        """Return the values (stop − start,) of each axis for some of the combinations."""
        places = np.unravel_index(np.arange(start, stop), self.shape) if self.axes else ()
        return {name: values[place] for (name, values), place in zip(self.axes, places, strict=True)}


def _on_grid(request: MapRequest, found: NDArray[_Kind]) -> NDArray[_Kind]:
    """Return controllers × plants as rows over y and columns over x."""
    parts = request.x.parameter.part, request.y.parameter.part
    if parts == ("controller", "plant"):
        found = found.T
    return np.ascontiguousarray(found.reshape(request.y.count, request.x.count))


def _evaluate(request: MapRequest, plants: Sequence[Plant], designs: Designs) -> tuple[BoolArray, FloatArray]:
    """Return verdicts and values (m, p) of controllers on plants."""
    h = request.sample_time_s
    if request.quantity.is_peak:
        return peaks_of(plants, h, designs, request.approach, request.quantity)
    chunk = build_chunk(plants, h, request.where)
    stable = chunk.stable(designs)
    if request.quantity is MapQuantity.STABILITY:
        return stable, np.full(stable.shape, np.nan)
    return stable, chunk.margins(designs, stable, request.quantity)
