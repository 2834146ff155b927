"""What the joint refinement minimises: the signals of one axis, its spans, the noise, and the parameters' units."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .model import Layout
from .noise import Smoother, Whitener
from .path import MOST_CUTS, FlangePath, commanded_path, measured_path
from .segments import Segment
from .sensor import Lateness

FloatArray = NDArray[np.float64]

_KEPT = 2


class Paths:
    """The flange's paths that were asked for last: most questions of a descent leave the robot as it is."""

    def __init__(self) -> None:
        self._kept: dict[bytes, FlangePath] = {}

    def of(self, robot: FloatArray, signals: "Signals") -> FlangePath:
        """Return the path for robot parameters (ω, (ζ,) T_d), or that of the pose alone where there are none."""
        key = robot.tobytes()
        found = self._kept.pop(key, None)
        if found is None:
            found = signals.path_of(robot)
            for oldest in list(self._kept)[: 1 - _KEPT]:
                del self._kept[oldest]
        self._kept[key] = found
        return found


@dataclass(frozen=True, kw_only=True)
class Signals:
    """One axis on one clock: flange position, force without weight and bias, command; (n,) each, the last or None.

    `command_m[k]` is the command issued at or after tick k and before the next; `smoother` belongs to the pose. The
    force is shown with a `lateness`, whose time constant, or without one delay, may be off by `lag_std_s`; the pose was
    measured at tick `measured[0]` and every `measured[1]` ticks.
    """

    period_s: float
    position_m: FloatArray
    force_n: FloatArray
    command_m: FloatArray | None
    smoother: Smoother
    lag_std_s: float = 0.0
    lateness: Lateness = field(default_factory=Lateness)
    measured: tuple[int, int] = (0, 1)
    paths: Paths = field(default_factory=Paths, init=False, repr=False, compare=False)

    def at_poses(self, span: slice) -> slice:
        """Return the ticks of a span at which the pose was measured."""
        first, every = self.measured
        return slice(span.start + (first - span.start) % every, span.stop, every)

    def path(self, values: FloatArray, layout: Layout) -> FlangePath:
        """Return the flange's path for robot parameters, which is kept for a while."""
        return self.paths.of(values[layout.robot], self)

    def path_of(self, robot: FloatArray, keeps: int = MOST_CUTS) -> FlangePath:
        """Return the flange's path for robot parameters (ω, (ζ,) T_d), that of the pose alone without them."""
        if self.command_m is None or robot.size == 0:
            return measured_path(self.position_m, self.smoother)
        return commanded_path(robot, self.command_m, self.position_m, self.smoother, self.period_s, keeps)


@dataclass(frozen=True, kw_only=True)
class Point:
    """A value of everything: shared parameters, and each segment's own."""

    values: FloatArray
    nuisances: tuple[FloatArray, ...]


@dataclass(frozen=True, kw_only=True)
class Summary:
    """A quadratic form |root · u|² of all shared parameters about `values`, u counted as the steps are."""

    root: FloatArray
    values: FloatArray


@dataclass(frozen=True, kw_only=True)
class Problem:
    """What is fitted: force over `segments`, pose over `pose_spans`, with one whitener per kind of span.

    `priors` are (index, value, standard deviation); `fixed` are indices that stay as they are, and with the robot's
    among them `known_path` is the flange's path; `summary` stands for other spans. No payload is lighter than
    `lightest_kg`: next to nothing, its own motion could not be told from rounding. None is heavier than `heaviest_kg`.
    """

    signals: Signals
    layout: Layout
    segments: tuple[Segment, ...]
    pose_spans: tuple[slice, ...]
    free_noise: Whitener
    contact_noise: Whitener
    pose_noise: Whitener
    priors: tuple[tuple[int, float, float], ...] = ()
    fixed: tuple[int, ...] = ()
    known_path: FlangePath | None = None
    summary: Summary | None = None
    lightest_kg: float = 0.01
    heaviest_kg: float = np.inf

    def path(self, values: FloatArray) -> FlangePath:
        """Return the flange's path at these parameters."""
        return self.signals.path(values, self.layout) if self.known_path is None else self.known_path

    def noise(self, segment: Segment) -> Whitener:
        """Return the whitener of a segment's force."""
        return self.contact_noise if segment.is_contact else self.free_noise


def stiffest_seen_n_per_m(mass_kg: float, period_s: float) -> float:
    """Return the K_s at which a payload of this mass swings at half the sampling rate.

    Above it a sample shows the swinging of a softer spring as well (aliasing), so no K_s can be told there.
    """
    return float(mass_kg * (np.pi / period_s) ** 2)


def sizes_of(values: FloatArray, layout: Layout, period_s: float) -> FloatArray:
    """Return a unit for every parameter: itself where it cannot vanish, else a tenth of what would be critical."""
    out = np.array(values, dtype=np.float64)
    mass = float(values[3])
    out[1] = out[2] = 0.2 * np.sqrt(float(values[0]) * mass)
    if layout.robot_order:
        out[layout.robot.stop - 1] = period_s
    for i in range(layout.surfaces):
        first = layout.surface(i).start
        out[first + 1] = 0.2 * np.sqrt(float(values[first]) * mass)
        out[first + 2] = 0.1 * mass
    return out


def logarithmic(layout: Layout) -> NDArray[np.bool_]:
    """Return which parameters are stepped in their logarithm: K_s, M_p, ω, ζ and K_e."""
    out = np.zeros(len(layout), dtype=bool)
    out[[0, 3]] = True
    out[layout.robot.start : layout.robot.stop - 1] = layout.robot_order > 0
    for i in range(layout.surfaces):
        out[layout.surface(i).start] = True
    return out
