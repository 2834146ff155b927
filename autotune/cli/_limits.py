"""How far a design is from any linear controller, in the commands that make one: the option, the search, a line."""

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import click

from ._common import Output

if TYPE_CHECKING:
    from autotune.charts.chart import Chart
    from autotune.limit.limit import LimitResult
    from autotune.tuning.optimize import Optimized


def limit_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--limit` to a command with a `target`, handed on as `limit`: whether it is asked.

    Refused at once is what could not be computed later: without the extra, or of a law that is not ours.
    """

    @click.option(
        "--limit",
        is_flag=True,
        help="Also say how far the design is from what any linear controller could reach (about 10 s an axis).",
    )
    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        if kwargs["limit"]:
            from problems.errors import require_extra

            if target := kwargs["target"]:
                raise click.UsageError(
                    f"--limit looks at our own law, which {target} does not run; leave out --limit or --for."
                )
            require_extra("--limit", "cvxpy", "limit")
        return function(*args, **kwargs)

    return command


def limits_of(output: Output, found: "Optimized") -> "dict[str, LimitResult]":
    """Return the limit of every axis over the hardest of its predicted contacts.

    An axis of which the convex programs find nothing is left out, and said so.
    """
    from autotune.formats.controller_record import admittance_controller
    from autotune.limit.limit import find_limit, hardest
    from autotune.limit.programs import NoSolutionError

    limits = {}
    with output.progress("looking for the limit", float(len(found.searches))) as advance:
        for name, search in found.searches.items():
            law = admittance_controller(found.controller, name)
            scenarios = [each.scenario() for each in found.controller.predicted[name].scenarios]
            worst = hardest(search.problem, law, scenarios, 1)
            try:
                limits[name] = find_limit(search.problem, law, worst, progress=advance)
            except NoSolutionError as error:
                output.note(f"The limit of axis {name} was not found: {error}")
    return limits


def limit_tree(limits: "Mapping[str, LimitResult]") -> dict[str, Any]:
    """Return the entry of `--json`, nothing where none was looked for."""
    return {"limit": {name: each.to_dict() for name, each in limits.items()}} if limits else {}


def limit_charts(limits: "Mapping[str, LimitResult]") -> "dict[str, Chart]":
    """Return the picture of every axis for the report."""
    from autotune.formats.units import axis_units

    return {name: each.chart(f"axis {name}", axis_units(name).force) for name, each in limits.items()}


def how_far_lines(limits: "Mapping[str, LimitResult]", name: str) -> list[str]:
    """Return the sentence of one axis, none where none was looked for."""
    from autotune.formats.units import axis_units

    return [limits[name].summary(axis_units(name).force)] if name in limits else []
