"""The modulus that is left where the plant's response is wrong by a share that was measured."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ..._checks import non_negative, positive
from ...errors import ParameterError
from ...model.response import LoopResponse, PlantResponse, loop_at, plant_response
from ...model.sampled import SampledPlant
from ..stable_design import StableDesign, StableLoop
from .base import LoopRequirement

_TANGENT_SHARE = 0.25


@dataclass(frozen=True, kw_only=True)
class MultiplicativeError:
    """|1 + L| − |L| δ ≥ `min_modulus` of free space, for L the loop cut at the force and δ its relative error.

    `points` are rows of frequency [Hz], ascending, and δ. A plant F (1 + Δ) with |Δ| ≤ δ then keeps |1 + L| ≥
    `min_modulus` there (Skogestad and Postlethwaite, *Multivariable Feedback Control*, section 7.5, robust stability
    with multiplicative uncertainty, where `min_modulus` is 0). Nothing is said between the points.
    """

    min_modulus: float
    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "min_modulus", positive("min_modulus", self.min_modulus))
        if self.min_modulus >= 1.0:
            raise ParameterError("min_modulus", self.min_modulus, "below 1 (|1 + L| tends to 1 at high frequency)")
        rows = [_row(point) for point in self.points]
        if any(after[0] <= before[0] for before, after in pairwise(rows)):
            raise ParameterError("points", [f for f, _ in rows], "rows of ascending frequencies")
        object.__setattr__(self, "points", tuple(rows))


def _row(point: Sequence[float]) -> tuple[float, float]:
    if len(point) != 2:
        raise ParameterError("points", point, "rows of frequency [Hz] and relative error")
    return positive("points", point[0]), non_negative("points", point[1])


class ErrorRequirement(LoopRequirement[MultiplicativeError]):
    """min over the points of |1 + L| − |L| δ, of every plant in free space; a loop in contact has no limit from it."""

    name, title = "multiplicative_error", "modulus beside the measured error"
    asked_as = MultiplicativeError
    must_be_below = (1.0, "|1 + L| tends to 1 at high frequency")

    def threshold(self, asked: MultiplicativeError) -> float:
        """Return the least modulus."""
        return asked.min_modulus

    def with_threshold(self, asked: MultiplicativeError, threshold: float) -> MultiplicativeError:
        """Return the same error with another modulus."""
        return replace(asked, min_modulus=threshold)

    def read(self, entry: Mapping[str, Any]) -> MultiplicativeError:
        """Return what plain data asks."""
        return MultiplicativeError(**{**entry, "points": tuple(tuple(point) for point in entry["points"])})

    def check_sampling(self, asked: MultiplicativeError, sample_time_s: float) -> None:
        """Raise ParameterError for points at or beyond the Nyquist frequency."""
        if asked.points and asked.points[-1][0] >= 0.5 / sample_time_s:
            must = "below half the sampling rate"
            raise ParameterError("multiplicative_error.points", asked.points[-1][0], must)

    def describe(self, asked: MultiplicativeError, *, turning: bool = False) -> str:
        """Return modulus, largest error and band in words."""
        del turning
        if not asked.points:
            return "nothing"
        share, low, high = max(d for _, d in asked.points), asked.points[0][0], asked.points[-1][0]
        return f"{asked.min_modulus:g}, with up to {100.0 * share:.3g} % of error from {low:g} to {high:g} Hz"

    def of_loop(self, asked: MultiplicativeError, loop: StableLoop) -> float:
        """Return the least |1 + L| − |L| δ; infinite in contact."""
        if not _is_free(loop.sampled) or not asked.points:
            return np.inf
        return _least(asked, loop_at(_response(loop.sampled, asked), loop.controller, loop.sample_time_s))

    def achieved(self, asked: MultiplicativeError, design: StableDesign, row: int) -> float:
        """Return the least |1 + L| − |L| δ of one plant, whose response is found once for all controllers."""
        sampled = design.prepared.plants[row].sampled
        if not _is_free(sampled) or not asked.points:
            return np.inf
        key = (self.name, row, tuple(f for f, _ in asked.points))
        response = design.prepared.once(key, lambda: _response(sampled, asked))
        return _least(asked, loop_at(response, design.controller, sampled.sample_time_s))

    def ratio(self, asked: MultiplicativeError, achieved: float) -> float:
        """Return required/achieved, below a quarter of what is required its tangent there: it may be below 0."""
        least = _TANGENT_SHARE * asked.min_modulus
        if achieved >= least:
            return asked.min_modulus / achieved
        return (2.0 - achieved / least) / _TANGENT_SHARE

    def achieved_at(self, asked: MultiplicativeError, ratio: float) -> float:
        """Return the inverse of `ratio`."""
        if ratio * _TANGENT_SHARE <= 1.0:
            return super().achieved_at(asked, ratio)
        return _TANGENT_SHARE * asked.min_modulus * (2.0 - ratio * _TANGENT_SHARE)


def _is_free(sampled: SampledPlant) -> bool:
    return sampled.plant.environment.is_free_space


def _response(sampled: SampledPlant, asked: MultiplicativeError) -> PlantResponse:
    return plant_response(sampled, 2.0 * np.pi * np.array([f for f, _ in asked.points]))


def _least(asked: MultiplicativeError, loop: LoopResponse) -> float:
    error = np.array([share for _, share in asked.points])
    return float(np.min(np.abs(1.0 + loop.at_force) - np.abs(loop.at_force) * error))
