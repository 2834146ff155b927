"""A deadband that was applied before recording: its kind and width."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .constant_runs import find_runs
from .recording import FloatArray

_SHARE = 0.01
_FEWEST = 50
_GAP_SPACINGS = 20.0
_NEAREST = 200
_SLOPE_SAMPLES = 4
_CROSSINGS = 5
_COARSE_REPEATS = 0.3
_LEVEL_FACTOR = 3.0


@dataclass(frozen=True, kw_only=True)
class Deadband:
    """`zero_share` of the samples are exactly 0; `width` in the unit of the axis, None where it cannot be told."""

    kind: Literal["threshold", "subtractive"]
    width: float | None
    zero_share: float


def find_deadband(values: FloatArray) -> Deadband | None:
    """Look for a deadband in one axis (n,).

    A threshold leaves no value between 0 and its width; a subtractive one continues at 0. Its width shows in the time
    that a force needs to cross from one side to the other: slope times time is twice the width. None without exact
    zeros beyond what levels of a coarse sensor would leave.
    """
    zero = values == 0.0
    count = int(np.count_nonzero(zero))
    if count < max(_FEWEST, _SHARE * len(values)) or count == len(values):
        return None
    size = np.sort(np.abs(values[~zero]))
    near = size[:_NEAREST]
    steps = np.diff(np.unique(near))
    spacing = float(np.median(steps)) if steps.size else float(near[0])
    share = count / len(values)
    if near[0] > _GAP_SPACINGS * spacing and near[0] > 0.0:
        return Deadband(kind="threshold", width=float(near[0]), zero_share=share)
    if _is_a_level(values[~zero], count, spacing):
        return None
    return Deadband(kind="subtractive", width=_crossing_width(values), zero_share=share)


def _is_a_level(others: FloatArray, zeros: int, spacing: float) -> bool:
    """Return whether 0 is one of the levels of a sensor: a coarse one repeats others too, a fine one has neighbours."""
    if float(np.mean(others[1:] == others[:-1])) > _COARSE_REPEATS:
        return True
    beside = max(int(np.count_nonzero(np.abs(others - k * spacing) < 0.1 * spacing)) for k in (-2, -1, 1, 2))
    return spacing > 0.0 and zeros < _LEVEL_FACTOR * beside


def _crossing_width(values: FloatArray) -> float | None:
    """Return half of slope times time over the zero runs that go from one sign to the other, if they agree."""
    runs = find_runs(values == 0.0)
    k = _SLOPE_SAMPLES
    inside = (runs.starts > k) & (runs.stops < len(values) - k)
    starts, stops = runs.starts[inside], runs.stops[inside]
    before, after = values[starts - 1], values[stops]
    crossing = before * after < 0.0
    starts, stops = starts[crossing], stops[crossing]
    if len(starts) < _CROSSINGS:
        return None
    slope = 0.5 * (values[starts - 1] - values[starts - k] + values[stops + k - 1] - values[stops]) / (k - 1)
    # From the last value on one side to the first on the other the force itself moved by slope times that time.
    moved = np.abs(slope) * (stops - starts + 1) - np.abs(values[stops] - values[starts - 1])
    low, width, high = (0.5 * float(quantile) for quantile in np.quantile(moved, (0.25, 0.5, 0.75)))
    return width if width > 0.0 and high - low < width else None
