"""What `optimize` tells of a compliance that it chose: the table of stiffness against peak, and what it leaves open."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from ._table import print_table
from ._terminal import tell

if TYPE_CHECKING:
    from autotune.tuning.compliance import Compliance, CompliancePoint
    from problems.design.problem import DesignProblem


def print_compliance(name: str, compliance: "Compliance", problem: "DesignProblem") -> None:
    """Print what is to be built, every stiffness that was tried with its least worst peak, and what bounds the choice.

    `problem` is the one that the controller was found for.
    """
    low, high = problem.environment_stiffness_n_per_m
    tolerance = 100.0 * compliance.asked.tolerance
    tell(
        f"axis {name}: build K_e {compliance.chosen.stiffness_n_per_m:g} N/m to ± {tolerance:g} %, certified from "
        f"{low:g} to {high:g} N/m"
    )
    place = "contact" if problem.objective == "contact_force" else "sensor"
    # Where there are wishes, it is the peak and their price that is least.
    prices = ("and price [N]",) if problem.requirements.soft_n else ()
    heads = ("K_e [N/mm]", f"least worst peak at {place} [N]", *prices, "")
    rows = [(*_numbers(point, len(prices)), _remark(compliance, point)) for point in compliance.points]
    last = len(heads) - 1
    print_table([heads, *rows], left=(last,), point=range(last), indent="  ")
    for line in _lines(compliance, problem):
        tell(f"  {line}")


def _numbers(point: "CompliancePoint", prices: int) -> tuple[str, ...]:
    evaluation = None if point.found is None else point.found.evaluation
    values = () if evaluation is None else (evaluation.peak_n, evaluation.objective_n)
    told = [f"{value:.2f}" for value in values] or ["-", "-"]
    return f"{point.stiffness_n_per_m * 1e-3:.6g}", *told[: 1 + prices]


def _remark(compliance: "Compliance", point: "CompliancePoint") -> str:
    """Return what is said of one row."""
    if point.found is None:
        return "no controller meets the requirements"
    if point.missed > 0.0:
        return "above max_peak_force_n"
    told = []
    if point is compliance.chosen:
        told.append("chosen")
    elif point is compliance.nearly_as_good:
        told.append("the stiffest within 1 % of that")
    if point is compliance.stiffest and point is not compliance.points[-1]:
        told.append("the stiffest that meets everything")
    return ", ".join(told)


def _lines(compliance: "Compliance", problem: "DesignProblem") -> Iterator[str]:
    from autotune.tuning.compliance import RESOLUTION

    low, high = compliance.asked.bounds
    if compliance.active_bound is not None:
        bound = low if compliance.active_bound == "lower" else high
        yield f"the {compliance.active_bound} bound of K_e, {bound:g} N/m, is active: widen it, or accept"
    if low < high:
        yield (
            f"between two rows nothing was tried; above each that is named the next one is at most "
            f"{100.0 * RESOLUTION:g} % stiffer. To take another one, give it as "
            "free.environment_stiffness_n_per_m: [K, K]"
        )
    damping = problem.uncertain.get("environment_damping_n_s_per_m", (problem.environment_damping_n_s_per_m,) * 2)
    told = f"{damping[0]:g}" if damping[0] == damping[1] else f"{damping[0]:g} to {damping[1]:g}"
    yield (
        f"assumed of the compliance: damping B_e {told} N·s/m, and no mass that moves with it; once it is built, "
        "identify it and ask validate --identified"
    )
