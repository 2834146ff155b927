"""A stiffness of a surface in N/m that is only possible, or usual, in N/mm or kN/m."""

from collections.abc import Iterator

from problems.errors import ParameterError

from .quantity import Interval

# A stiffness in N/mm or kN/m that is written as N/m is a thousandth of what it should be: a usual press goes deep.
_USUAL_PRESS_N, _IMPOSSIBLE_DEPTH_M = 30.0, 1.0
# A spring inside of a payload gives way by a hand's breadth at most.
_DEEPEST_BUMPER_M = 0.1
DOUBTFUL_N_PER_M = 2e3
"""A stiffness below this is possible in N/m and usual in N/mm or kN/m."""


def check_surface_unit(surface: Interval, given: object) -> None:
    """Raise ParameterError for a surface [N/m] that can only be meant in another unit; `given` is what was written."""
    if surface[0] < _USUAL_PRESS_N / _IMPOSSIBLE_DEPTH_M:
        depth = _USUAL_PRESS_N / surface[0]
        must = f"in N/m: into this one {_USUAL_PRESS_N:g} N press {depth:.2g} m deep"
        raise ParameterError("environment_stiffness", given, f"{must} (did you mean {interval_text(surface, 1e3)}?)")


def check_bumper_unit(stiffness: float) -> None:
    """Raise ParameterError for a bumper's spring [N/m] that can only be meant in another unit."""
    depth = _USUAL_PRESS_N / stiffness
    if depth > _DEEPEST_BUMPER_M:
        must = f"in N/m: {_USUAL_PRESS_N:g} N press this one {depth:.2g} m deep (did you mean {1e3 * stiffness:g}?)"
        raise ParameterError("bumper.stiffness_n_per_m", stiffness, must)


def doubtful_surface(surface: Interval) -> Iterator[str]:
    """Yield a sentence for a surface [N/m] that is possible in N/m, and usual in N/mm or kN/m."""
    if surface[1] < DOUBTFUL_N_PER_M:
        least, most = (1e3 * _USUAL_PRESS_N / each for each in reversed(surface))
        depth = f"{least:.3g}" if least == most else f"{least:.3g} to {most:.3g}"
        yield (
            f"An environment_stiffness of {interval_text(surface)} N/m is very soft: {_USUAL_PRESS_N:g} N press "
            f"{depth} mm into it. If it was meant in N/mm or kN/m, write {interval_text(surface, 1e3)}."
        )


def interval_text(interval: Interval, factor: float = 1.0) -> str:
    """Return a range, or the one number that it holds, times a factor."""
    low, high = (f"{factor * each:g}" for each in interval)
    return low if low == high else f"{low} to {high}"
