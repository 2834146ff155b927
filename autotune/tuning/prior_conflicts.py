"""Name the ranges of problem.yaml that contradict the identified plant; they are obeyed all the same."""

from collections.abc import Iterator, Mapping

from autotune.formats.units import axis_units
from identification.result import AxisEstimate, Identified
from problems.design.problem import DesignProblem

from .problems import unexplained_contacts
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
            given = f"{low:g}" if low == high else f"{low:g} to {high:g}"
            yield (
                f"axis {name}: {key} in problem.yaml, {given}, lies {off:.0f} deviations off what was identified, "
                f"{estimate.value:.4g} ± {estimate.std:.2g}; the controller is certified for what problem.yaml says."
            )


def left_out_contacts(problem: DesignProblem, identified: Identified, name: str) -> Iterator[str]:
    """Yield a sentence for each contact in the log that the certified range of K_e may leave out."""
    units = axis_units(name)
    low, high = problem.environment_stiffness_n_per_m
    for surface in identified.axes[name].environments:
        value = surface.stiffness_n_per_m.value
        if value is None or low <= value <= high:
            continue
        yield (
            f"axis {name}: surface {surface.name}, touched with up to {max(surface.peak_force_n, default=0.0):.1f} "
            f"{units.force} in the log, has K_e = {value:.4g} {units.stiffness}, and the controller is certified for "
            f"{low:g} to {high:g} {units.stiffness} only: keep it off that surface."
        )
    for finding in unexplained_contacts(identified, name):
        yield (
            f"{finding.message} Whether {low:g} to {high:g} {units.stiffness}, the range that was said, holds it "
            "is not known from the log."
        )


def left_out_tree(problems: Mapping[str, DesignProblem], identified: Identified) -> dict[str, list[str]]:
    """Return `left_out_contacts` of all axes as a plain tree, for the provenance of a controller; empty without any."""
    lines = [line for name, problem in problems.items() for line in left_out_contacts(problem, identified, name)]
    return {"left_out_contacts": lines} if lines else {}
