"""Values that stay exactly the same: dead and stuck axes, saturation, repeats, coarse steps, deadbands."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from problems.arrays import BoolArray, FloatArray, IntArray

from .aligned import edges_of
from .sweeps import repeats

_BLOCK = 100
_NOISY_RATIO = 0.5
_NOISY_REPEATS = 0.6
_SHORTEST_STUCK = 25
_SHORTEST_STUCK_S = 0.1
_RARE_LENGTHS = 4.0
_FLAT = 3
_FLAT_RUNS = 2
_ENTRY_STEPS = 2.5
_ENTRY_SHARE = 0.3
_RESTING_SHARE = 0.3
_RANGE_SHARE = 0.999
_LEVELS = 20_000
_ROUNDING = 1e-9
_SHARE = 0.01
_FEWEST = 50
_GAP_SPACINGS = 20.0
_NEAREST = 200
_SLOPE_SAMPLES = 4
_CROSSINGS = 5
_COARSE_REPEATS = 0.3
_LEVEL_FACTOR = 3.0


@dataclass(frozen=True, kw_only=True)
class Runs:
    """Stretches of one value: samples `starts` up to, not including, `stops` (m,) each."""

    starts: IntArray
    stops: IntArray

    @property
    def lengths(self) -> IntArray:
        """Count the samples of each."""
        return np.asarray(self.stops - self.starts)

    def chosen(self, keep: BoolArray) -> "Runs":
        """Return some of the runs."""
        return Runs(starts=self.starts[keep], stops=self.stops[keep])


def find_runs(mask: BoolArray) -> Runs:
    """Return the stretches in which `mask` (n,) holds."""
    starts, stops = edges_of(mask)
    return Runs(starts=starts, stops=stops)


def equal_runs(values: FloatArray) -> Runs:
    """Return the stretches of two or more samples in which `values` (n,) does not change at all."""
    runs = find_runs(values[1:] == values[:-1])
    return Runs(starts=runs.starts, stops=runs.stops + 1)


def stuck_runs(values: FloatArray, period_s: float) -> Runs:
    """Return where a sensor with noise says exactly the same for too long to be chance, (n,) values.

    The noise has to show elsewhere: a signal without noise, or one of coarse steps, may well stay the same. How often
    two samples are equal where anything changes shows how long a run by chance can get.
    """
    runs = equal_runs(values)
    repeats = _natural_repeats(values)
    if repeats is None:
        return runs.chosen(np.zeros(len(runs.starts), dtype=bool))
    by_chance = np.log(len(values)) / -np.log(max(repeats, 1e-6))
    shortest = max(_SHORTEST_STUCK, _SHORTEST_STUCK_S / period_s, _RARE_LENGTHS * by_chance)
    return runs.chosen(runs.lengths >= shortest)


def _natural_repeats(values: FloatArray) -> float | None:
    """Return how often a sample equals the one before where the axis lives; None where that shows no noise."""
    count = len(values) // _BLOCK
    if count < 2:
        return None
    blocks = values[: count * _BLOCK].reshape(count, _BLOCK)
    first = np.diff(blocks, axis=1)
    share = np.mean(first == 0.0, axis=1)
    alive = share < 1.0
    if not np.any(alive):
        return None
    first = first[alive]
    second = np.diff(first, axis=1)
    # White noise: second differences are √3 times the first ones; of a smooth signal they are far smaller.
    ratio = np.sqrt(np.mean(second**2, axis=1) / np.mean(first**2, axis=1))
    repeats = float(np.quantile(share[alive], 0.9))
    noisy = float(np.median(ratio)) > _NOISY_RATIO and repeats < _NOISY_REPEATS
    return repeats if noisy else None


def _clipped(values: FloatArray, runs: Runs) -> BoolArray:
    """Return which runs were entered in the middle of a movement, as a limit is and a rest is not."""
    before = values[np.maximum(runs.starts - 1, 0)]
    after = values[np.minimum(runs.stops, len(values) - 1)]
    here = values[runs.starts]
    entry = np.maximum(np.abs(here - before), np.abs(here - after))
    steps = np.abs(np.diff(values[: min(len(values), _LEVELS)]))
    moved = steps[steps > 0.0]
    usual = float(np.median(moved)) if moved.size else 0.0
    return np.asarray(entry > max(_ENTRY_SHARE * usual, _ENTRY_STEPS * quantum(values)))


def saturated_samples(values: FloatArray, limit: float | None, resting: BoolArray) -> BoolArray:
    """Return which samples of (n,) are at the end of the range: the declared one, or one that shows.

    Undeclared, a limit shows as an extreme value held for several samples, repeatedly, and left and entered abruptly
    while something else moves: `resting` (n,) shows where no axis of the sensor changes.
    """
    if limit is not None:
        return np.asarray(np.abs(values) >= _RANGE_SHARE * limit)
    found = np.zeros(len(values), dtype=bool)
    low, high = float(np.min(values)), float(np.max(values))
    if low == high:
        return found
    for extreme in (low, high):
        if extreme == 0.0:
            continue  # a deadband ends there, a range does not
        at = values == extreme
        runs = find_runs(at)
        flat = runs.chosen(runs.lengths >= _FLAT)
        if not len(flat.starts):
            continue
        rests = np.array([float(np.mean(resting[a + 1 : b])) for a, b in zip(flat.starts, flat.stops, strict=True)])
        flat = flat.chosen(_clipped(values, flat) & (rests < _RESTING_SHARE))
        if len(flat.starts) >= _FLAT_RUNS:
            found |= at
    return found


def quantum(values: FloatArray) -> float:
    """Return the step between the levels of (n,) values, 0 for a continuum (to rounding)."""
    part = values[: min(len(values), _LEVELS)]
    levels = np.unique(part)
    if len(levels) < 2 or len(levels) > 0.5 * len(part):
        return 0.0
    steps = np.diff(levels)
    smallest = float(np.min(steps))
    if smallest < _ROUNDING * float(np.max(np.abs(levels))):
        return 0.0
    counts = steps / smallest
    # Rounding of decimal levels leaves some bits; a continuum leaves anything.
    return smallest if bool(np.all(np.abs(counts - np.round(counts)) < 1e-3 * counts)) else 0.0


def repeated_share(values: FloatArray) -> float:
    """Return how often a sample of (n, k) equals the one before in all axes, where anything moves.

    Zero where all axes come in coarse steps, which repeat by themselves.
    """
    if all(quantum(column) > 0.0 or bool(np.all(column == column[0])) for column in values.T):
        return 0.0
    same = repeats(values)
    count = len(same) // _BLOCK
    if not count:
        return 0.0
    share = np.mean(same[: count * _BLOCK].reshape(count, _BLOCK), axis=1)
    alive = share < 0.995
    return float(np.median(share[alive])) if np.any(alive) else 0.0


@dataclass(frozen=True, kw_only=True)
class FoundDeadband:
    """`zero_share` of the samples are exactly 0; `width` in the unit of the axis, None where unknown."""

    kind: Literal["threshold", "subtractive"]
    width: float | None
    zero_share: float


def find_deadband(values: FloatArray) -> FoundDeadband | None:
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
        return FoundDeadband(kind="threshold", width=float(near[0]), zero_share=share)
    if _is_a_level(values[~zero], count, spacing):
        return None
    return FoundDeadband(kind="subtractive", width=_crossing_width(values), zero_share=share)


def _is_a_level(others: FloatArray, zeros: int, spacing: float) -> bool:
    """Return whether 0 is one of the levels of a sensor: a coarse one repeats others too, a fine one has neighbours."""
    if len(others) > 1 and float(np.mean(others[1:] == others[:-1])) > _COARSE_REPEATS:
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
