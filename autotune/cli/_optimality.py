"""What `optimize` and `demo` tell of a result beside its numbers: what it rests on, and how near the best it is."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from autotune.formats.units import AxisUnits
    from autotune.tuning.explain import Active
    from autotune.tuning.multistart import Reference
    from autotune.tuning.optimality_report import Standing
    from autotune.tuning.optimize import Optimized
    from problems.design.problem import DesignProblem

# How many decimals of a price are told: what is none in them is told as nothing.
_DECIMALS = {"N": 2, "N·m": 4}


def active_tree(found: "Optimized") -> dict[str, Any]:
    """Return, per axis, the active requirements and bounds with the price of one percent in N, or in N·m."""
    from autotune.formats.records import ROTATIONAL_AXES

    return {
        name: [
            {
                "name": a.name,
                "price_n_m_per_percent" if name in ROTATIONAL_AXES else "price_n_per_percent": a.price_n,
                **({"soft": True} if a.soft else {}),
            }
            for a in standing.active
        ]
        for name, standing in found.standings.items()
    }


def active_lines(found: "Optimized", name: str) -> list[str]:
    """Say in words what holds the peak of one axis up, and how far the result is shown to be the best."""
    from autotune.formats.units import axis_units

    standing, units = found.standings[name], axis_units(name)
    lines = [_active_line(entry, found.searches[name].problem, units) for entry in standing.active]
    if not standing.active:
        lines.append(f"no requirement is active: the peak is the approach {units.force_name} itself")
    return [*lines, *_standing_lines(standing, units, bool(found.searches[name].problem.requirements.soft_n))]


def _active_line(entry: "Active", problem: "DesignProblem", units: "AxisUnits") -> str:
    decimals = _DECIMALS[units.force]
    saved, is_nothing = f"{entry.price_n:.{decimals}f} {units.force}", entry.price_n < 0.5 * 10.0**-decimals
    side, _, variable = entry.name.partition(" bound of ")
    if variable:
        limit = problem.bounds[variable][0 if side == "lower" else 1]
        if is_nothing:
            return f"the {entry.name}, {limit:g}, is active, and widening it saves nothing"
        return f"the {entry.name}, {limit:g}, is active: 1 % wider saves {saved}; widen it, or accept"
    if is_nothing:
        return f"{entry.name} is active, easing it alone saves nothing"
    if entry.soft:
        return f"{entry.name} is wished, not required: wishing 1 % less saves {saved} of peak and price"
    return f"{entry.name} holds the peak up: easing it by 1 % saves {saved}, asking 1 % more costs as much"


def _standing_lines(standing: "Standing", units: "AxisUnits", has_wishes: bool) -> Iterator[str]:
    """Yield whether the design is feasible, an optimum of its surroundings, and the best that anyone found.

    With wishes, what was minimised is the peak and the prices of what is missed.
    """
    what = f"{units.force} of peak and price" if has_wishes else units.force
    near = ""
    if standing.nearest is not None:
        near = f"; nearest to its limit is {standing.nearest}, {100.0 * standing.ratio:.4f} % of it used up"
    met = "every requirement is met" if standing.is_feasible else "a requirement is missed"
    yield f"{met} over {standing.scenario_count} contacts{near}"
    optimality, slack = standing.optimality, standing.optimality.slack * standing.objective_n
    yield (
        f"conditions of an optimum: {optimality.relative_residual:.1e} of the gradient is left over (KKT residual), "
        f"unused slack is worth {slack:.3f} {units.force}"
    )
    yield (
        f"gap {100.0 * standing.gap:.3f} % to a reference: {standing.reference.least_n:.2f} {what} is the least "
        f"that was found {_where_it_was_looked(standing.reference)}"
    )


def _where_it_was_looked(reference: "Reference") -> str:
    told = (
        f"over the {reference.scenarios} hardest contacts alone with nothing kept in reserve, from here and by "
        f"{reference.descents} descents from the best of {reference.designs} other designs"
    )
    if not math.isfinite(reference.elsewhere_n):
        return f"{told}, none of which met the requirements"
    return f"{told}, {reference.arrived} of which end there"
