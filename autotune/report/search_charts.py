"""The figures of a search: how it converged, and the front of what can be traded."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.charts.chart import Chart, Element, Line, Panel, Points, Scale
from autotune.formats.units import AxisUnits

if TYPE_CHECKING:
    from autotune.tuning.search import SearchStep


def convergence_chart(name: str, units: AxisUnits, steps: Sequence["SearchStep"]) -> Chart | None:
    """Draw the best value over the designs evaluated; None where nothing was recorded."""
    if not steps:
        return None
    rounds = [step for step in steps if step.whole_n is not None]
    count = np.array([step.evaluations for step in steps], dtype=np.float64)
    best = np.array([step.best_n for step in steps])
    elements: list[Element] = [Line(x=count, y=best, label="over the working scenarios", role="after", steps=True)]
    whole = [step for step in rounds if step.whole_n is not None and np.isfinite(step.whole_n)]
    if whole:
        elements.append(
            Points(
                x=np.array([step.evaluations for step in whole], dtype=np.float64),
                y=np.array([step.whole_n for step in whole], dtype=np.float64),
                label="over the whole set, at the end of a round",
                role="model",
                marker="diamond",
                names=tuple(f"round {i}: {step.scenarios} scenarios" for i, step in enumerate(rounds, 1))[
                    -len(whole) :
                ],
            )
        )
    told = f"{len(rounds)} round{'' if len(rounds) == 1 else 's'} of adding the worst scenarios"
    return Chart(
        key=f"{name}-convergence",
        title="How the search converged",
        alternative=f"The best peak over {int(count[-1])} evaluated designs, from {best[0]:.4g} to {best[-1]:.4g} "
        f"{units.force}, with {told}.",
        caption=f"{int(count[-1])} designs evaluated; {told}, the last with {steps[-1].scenarios} scenarios.",
        panels=(
            Panel(
                x=Scale(label="designs evaluated"),
                y=Scale(label=f"peak {units.force_name} [{units.force}]"),
                elements=tuple(elements),
            ),
        ),
    )


def front_chart(axis: str, tree: Mapping[str, Any]) -> Chart:
    """Draw the first two objectives of a front of `pareto.yaml` against each other, the chosen controller marked."""
    objectives, points, chosen = tree["objectives"], tree["points"], tree["chosen"]
    y, x = objectives[0], objectives[min(1, len(objectives) - 1)]
    values = {each["name"]: np.array([point["values"][each["name"]] for point in points]) for each in (x, y)}
    names = tuple(
        f"M_a {point['mass']:.4g}, B_a {point['damping']:.4g}, K_l {point['lead_s']:.4g} s, "
        f"B_fb {point['feedback_damping_s']:.4g} s"
        for point in points
    )
    order = np.argsort(values[x["name"]], kind="stable")
    at, of = values[x["name"]], values[y["name"]]
    elements: list[Element] = [
        Line(x=at[order], y=of[order], role="quiet"),
        Points(x=at, y=of, label="controllers", role="after", names=names),
    ]
    if chosen is not None:
        one = slice(chosen, chosen + 1)
        elements.append(Points(x=at[one], y=of[one], label="chosen", role="bad", marker="star", names=names[one]))
    return Chart(
        key=f"{axis}-front",
        title=f"What can be traded: {_title(y)} against {_title(x)}",
        alternative=f"{len(points)} controllers of axis {axis} of which none is beaten by another: {_title(y)} from "
        f"{np.min(of):.4g} to {np.max(of):.4g} {y['unit']}, {_title(x)} from {np.min(at):.4g} to {np.max(at):.4g} "
        f"{x['unit']}.",
        caption=f"Every point holds in {tree['scenarios']} scenarios."
        + (" Further objectives are in the table." if len(objectives) > 2 else ""),
        panels=(Panel(x=_scale(x), y=_scale(y), elements=tuple(elements), height=1.4),),
    )


def _title(objective: Mapping[str, Any]) -> str:
    return str(objective["name"]).replace("_", " ")


def _scale(objective: Mapping[str, Any]) -> Scale:
    unit = f" [{objective['unit']}]" if objective["unit"] else ""
    return Scale(label=f"{_title(objective)}{unit}")
