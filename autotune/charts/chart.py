"""Charts as values: axes with units, lines, bands, markers and maps, described once and drawn by each renderer."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from problems.arrays import RealArray

Role = Literal[
    "measured", "model", "before", "after", "target", "residual", "quiet", "bad", "good", "other", "stable", "edge"
]
Spacing = Literal["linear", "log"]


MOST_POINTS = 2800
"""Of a curve, as many as any drawing of it holds."""
_MARGIN_SHARE = 0.06


def _column(values: ArrayLike) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64).reshape(-1)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, kw_only=True)
class Line:
    """A curve through (x, y), each (n,); NaN breaks it. `label` names it in the legend, empty for none.

    A `wide` one is seen on both sides of a curve that lies on it, as what was before always is.
    """

    x: RealArray
    y: RealArray
    label: str = ""
    role: Role = "measured"
    dashed: bool = False
    steps: bool = False
    wide: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", _column(self.x))
        object.__setattr__(self, "y", _column(self.y))
        if len(self.x) != len(self.y):
            raise ValueError(f"a curve needs as many y as x, found {len(self.y)} and {len(self.x)}")

    def thinned(self, most: int) -> tuple[RealArray, RealArray]:
        """Return at most `most` points (x, y) of the curve, its peaks among them."""
        return decimate(self.x, self.y, most)

    @property
    def is_wide(self) -> bool:
        """Whether another curve may lie on it and must not hide it."""
        return self.wide or self.role == "before"


@dataclass(frozen=True, kw_only=True)
class Band:
    """What lies between two curves over x, each (n,)."""

    x: RealArray
    low: RealArray
    high: RealArray
    label: str = ""
    role: Role = "model"

    def __post_init__(self) -> None:
        for name in ("x", "low", "high"):
            object.__setattr__(self, name, _column(getattr(self, name)))
        if not len(self.x) == len(self.low) == len(self.high):
            raise ValueError("a band needs as many low and high as x")


@dataclass(frozen=True, kw_only=True)
class Points:
    """Single points (n,), with `names` (n,) that are shown under the pointer, or none."""

    x: RealArray
    y: RealArray
    label: str = ""
    role: Role = "measured"
    names: tuple[str, ...] = ()
    marker: Literal["dot", "star", "diamond"] = "dot"

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", _column(self.x))
        object.__setattr__(self, "y", _column(self.y))
        if len(self.x) != len(self.y) or (self.names and len(self.names) != len(self.x)):
            raise ValueError("points need as many y, and names if any, as x")


@dataclass(frozen=True, kw_only=True)
class Bars:
    """Bars between `edges` (n + 1,) of height `heights` (n,)."""

    edges: RealArray
    heights: RealArray
    label: str = ""
    role: Role = "quiet"

    def __post_init__(self) -> None:
        object.__setattr__(self, "edges", _column(self.edges))
        object.__setattr__(self, "heights", _column(self.heights))
        if len(self.edges) != len(self.heights) + 1:
            raise ValueError("bars need one edge more than heights")


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A stretch of the x axis that is shaded over the whole height: a phase of a log, a band of frequencies."""

    low: float
    high: float
    label: str = ""
    role: Role = "quiet"


@dataclass(frozen=True, kw_only=True)
class Limit:
    """A straight line across the panel at `value` of an axis: a bound, a target, the design's own value."""

    value: float
    along: Literal["x", "y"] = "y"
    label: str = ""
    role: Role = "target"


@dataclass(frozen=True, kw_only=True)
class Heat:
    """Numbers on a grid as colours: `values` (rows, columns) over `x` (columns,) and `y` (rows,), NaN left open.

    `x` and `y` are the middles of the cells, evenly spaced on the panel's scales. With `limits` the colours span them,
    symmetric limits get a scale with a neutral middle. `names` (x, y) replaces the ticks of a table of names.
    `spacing` is that of the colours, turned round where values are `descending`; with `smooth` they run on between the
    cells, and lines of equal value are drawn. `hole` says what it means where there is no number.
    """

    x: RealArray
    y: RealArray
    values: RealArray
    label: str
    limits: tuple[float, float] | None = None
    names: tuple[tuple[str, ...], tuple[str, ...]] | None = None
    written: bool = False
    spacing: Spacing = "linear"
    smooth: bool = False
    descending: bool = False
    hole: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "x", _column(self.x))
        object.__setattr__(self, "y", _column(self.y))
        values = np.array(self.values, dtype=np.float64)
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        if values.shape != (len(self.y), len(self.x)):
            raise ValueError(f"a grid of {len(self.y)} rows and {len(self.x)} columns cannot hold {values.shape}")

    @property
    def is_two_sided(self) -> bool:
        """Whether colours show the sign, around a neutral middle."""
        return self.limits is not None and self.limits[0] == -self.limits[1]

    def span(self) -> tuple[float, float]:
        """Return the numbers at the two ends of the colours."""
        return self.limits or (float(np.nanmin(self.values)), float(np.nanmax(self.values)))

    def writings(self) -> Iterator[tuple[float, float, str, bool]]:
        """Yield x, y, number and whether its colour is dark, for each cell that has its number written in it."""
        if not self.written:
            return
        most = max(abs(end) for end in self.span())
        for y, row in zip(self.y, self.values, strict=True):
            for x, value in zip(self.x, row, strict=True):
                if np.isfinite(value):
                    rounded = f"{abs(value):.2f}".removeprefix("0")
                    sign = "−" if value < 0.0 and float(rounded) != 0.0 else ""
                    yield float(x), float(y), "0" if float(rounded) == 0.0 else sign + rounded, abs(value) > 0.6 * most


@dataclass(frozen=True, kw_only=True)
class Region:
    """The part of the panel in which `values` (rows, columns) over `x` (columns,) and `y` (rows,) are above 0.

    It is hatched; its edge has a line and, with `edge_label`, a name of its own.
    """

    x: RealArray
    y: RealArray
    values: RealArray
    label: str
    edge_label: str = ""

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            object.__setattr__(self, name, _column(getattr(self, name)))
        values = np.array(self.values, dtype=np.float64)
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        if values.shape != (len(self.y), len(self.x)):
            raise ValueError(f"a region of {len(self.y)} rows and {len(self.x)} columns cannot hold {values.shape}")


@dataclass(frozen=True, kw_only=True)
class Area:
    """Filled polygons, each (n, 2)."""

    polygons: tuple[RealArray, ...]
    label: str = ""
    role: Role = "quiet"


Element = Line | Band | Points | Bars | Stretch | Limit | Heat | Region | Area


@dataclass(frozen=True, kw_only=True)
class Scale:
    """One side of a panel: what it shows with its unit, its spacing, and its ends where they are not the data's.

    One that `counts` has ticks at whole numbers alone.
    """

    label: str
    spacing: Spacing = "linear"
    limits: tuple[float, float] | None = None
    counts: bool = False


@dataclass(frozen=True, kw_only=True)
class Panel:
    """A pair of axes and what is drawn in it: stretches, then the others in this order; `equal` keeps circles round.

    The `ground` of a map of stability is that of stable or unstable loops; `note` is written in the middle.
    """

    x: Scale
    y: Scale
    elements: tuple[Element, ...]
    title: str = ""
    height: float = 1.0
    equal: bool = False
    ground: Literal["plain", "stable", "unstable"] = "plain"
    note: str = ""

    def in_units(self, x: float, y: float) -> "Panel":
        """Return the same panel with all numbers multiplied by `x` across and by `y` upwards: lines, points, maps."""
        sides = [
            replace(side, limits=None if side.limits is None else (by * side.limits[0], by * side.limits[1]))
            for side, by in ((self.x, x), (self.y, y))
        ]
        return replace(self, x=sides[0], y=sides[1], elements=tuple(_in_units(each, x, y) for each in self.elements))

    def stretches(self) -> dict[Role, list[Stretch]]:
        """Return the stretches by role: a log has dozens, which are drawn in a few strokes."""
        found: dict[Role, list[Stretch]] = {}
        for each in self.elements:
            if isinstance(each, Stretch):
                found.setdefault(each.role, []).append(each)
        return found


@dataclass(frozen=True, kw_only=True)
class Chart:
    """A figure: panels below each other, or beside each other with `beside`.

    `key` is its name within the page; `alternative` says in words what there is to see, for whoever cannot see it.
    With `linked`, the panels' x axes move together.
    """

    key: str
    title: str
    alternative: str
    panels: tuple[Panel, ...]
    caption: str = ""
    beside: bool = False
    linked: bool = False
    live: bool = True


def level_panels(panels: Sequence[Panel]) -> tuple[Panel, ...]:
    """Return panels beside each other with one scale for y, which holds what any of them shows."""
    values = np.concatenate([each for panel in panels for each in _heights(panel)])
    values = values[np.isfinite(values)]
    low, high = float(np.min(values, initial=0.0)), float(np.max(values, initial=0.0))
    room = _MARGIN_SHARE * (high - low) or 1.0
    ends = (low - room if low < 0.0 else 0.0, high + room if high > 0.0 else 0.0)
    return tuple(replace(panel, y=replace(panel.y, limits=ends)) for panel in panels)


def _heights(panel: Panel) -> Iterator[np.ndarray]:
    for element in panel.elements:
        if isinstance(element, Line | Points):
            yield element.y
        elif isinstance(element, Band):
            yield element.low
            yield element.high
        elif isinstance(element, Limit) and element.along == "y":
            yield np.array([element.value])


def decimate(x: RealArray, y: RealArray, most: int) -> tuple[RealArray, RealArray]:
    """Return at most `most` points of a curve over rising x (n,), with the smallest and largest y of every stretch.

    Of each of most/2 stretches of as many points, the point where y is smallest and the one where it is largest are
    kept in their order; where a stretch has a NaN, the curve stays broken there. The first and the last x are kept.
    """
    if len(x) <= most or most < 4:
        return x, y
    count = (most - 2) // 2
    edges = np.linspace(1, len(x) - 1, count + 1).astype(np.int64)
    kept = np.empty(2 * count + 2, dtype=np.int64)
    kept[0], kept[-1] = 0, len(x) - 1
    for i, (low, high) in enumerate(pairwise(edges.tolist())):
        part = y[low:high]
        broken = np.isnan(part)
        if broken.any():
            # One number that is none, and the largest of the others, so that a gap neither closes nor hides a peak.
            best = int(np.nanargmax(np.abs(part))) if not broken.all() else 0
            pair = (int(np.argmax(broken)), best)
        else:
            pair = (int(np.argmin(part)), int(np.argmax(part)))
        kept[2 * i + 1], kept[2 * i + 2] = low + min(pair), low + max(pair)
    kept = np.unique(kept)
    return x[kept], y[kept]


def _in_units(element: Element, x: float, y: float) -> Element:
    if isinstance(element, Area):
        return replace(element, polygons=tuple(polygon * (x, y) for polygon in element.polygons))
    if isinstance(element, Line | Points | Heat | Region):
        return replace(element, x=element.x * x, y=element.y * y)
    raise TypeError(f"a {type(element).__name__} cannot be multiplied")
