"""What was said of the plant and does not fit what was identified; it is obeyed, and it is told."""

from collections.abc import Iterator

from identification.result import AxisEstimate
from problems.design import DesignProblem

from .uncertain import plant_estimates

# Three happen by chance in some of many parameters, five in none.
_MOST_STDS = 5.0


def doubtful_ranges(problem: DesignProblem, axis: AxisEstimate, name: str) -> Iterator[str]:
    """Yield a sentence for each range of problem.yaml that leaves out what was identified by many deviations."""
    of_confidence = () if problem.ellipsoid is None else problem.ellipsoid.names
    for key, estimate in plant_estimates(axis).items():
        if key not in problem.uncertain or key in of_confidence or estimate.value is None or not estimate.std:
            continue
        low, high = problem.uncertain[key]
        off = max(low - estimate.value, estimate.value - high) / estimate.std
        if off > _MOST_STDS:
            told = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            yield (
                f"axis {name}: {key} in problem.yaml, {told}, lies {off:.0f} deviations off what was identified, "
                f"{estimate.value:.4g} ± {estimate.std:.2g}; the controller is certified for what problem.yaml says."
            )
