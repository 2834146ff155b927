"""How far a design is from any linear controller, in the commands that make one: the option, the search, a line."""

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import click

from ._common import Output

if TYPE_CHECKING:
    from autotune.limit.limit import LimitResult
    from autotune.limit.noise_trade import NoisePoint
    from autotune.report.page import Block
    from autotune.tuning.optimize import Optimized


def limit_option(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add `--limit` to a command with a `target`, handed on as `limit`: whether it is asked.

    Refused at once is what could not be computed later: without the extra, or of a law that is not ours.
    """

    @click.option(
        "--limit",
        is_flag=True,
        help="Also say what any linear controller could reach, and these gains with more noise (about 15 s an axis).",
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


def limits_of(output: Output, found: "Optimized", *, with_trade: bool = False) -> "dict[str, LimitResult]":
    """Return the limit of every axis over the hardest of its predicted contacts, on request with the trade of noise.

    An axis of which the convex programs find nothing is left out, and said so.
    """
    from autotune.formats.controller_record import admittance_controller
    from autotune.formats.units import axis_units
    from autotune.limit.limit import find_limit, hardest
    from autotune.limit.noise_trade import trade_noise
    from autotune.limit.programs import NoSolutionError

    limits = {}
    with output.progress("looking for the limit", len(found.searches) * (2.0 if with_trade else 1.0)) as advance:
        for name, search in found.searches.items():
            problem, law = search.problem, admittance_controller(found.controller, name)
            choice = found.structures.get(name)
            spectrum = None if choice is None else choice.measured.spectrum
            scenarios = [each.scenario() for each in found.controller.predicted[name].scenarios]
            try:
                worst = hardest(problem, law, scenarios, 1, units=axis_units(name))
                limit = find_limit(problem, law, worst, spectrum=spectrum, progress=advance)
            except NoSolutionError as error:
                output.note(f"The limit of axis {name} was not found: {error}")
                continue
            # The trade is that of four gains, whatever the structure of the design.
            bounds = problem.bounds if choice is None else choice.bounds
            trade = trade_noise(search, bounds, spectrum=spectrum, progress=advance) if with_trade else ()
            limits[name] = replace(limit, trade=trade)
    return limits


def limit_tree(limits: "Mapping[str, LimitResult]") -> dict[str, Any]:
    """Return the entry of `--json`, nothing where none was looked for."""
    return {"limit": {name: each.to_dict() for name, each in limits.items()}} if limits else {}


def limit_blocks(limits: "Mapping[str, LimitResult]") -> "dict[str, tuple[Block, ...]]":
    """Return what the report says of every axis: the sentence, its picture, and the trade of noise."""
    from autotune.formats.units import axis_units
    from autotune.report.page import Note, build_table

    blocks = dict[str, tuple["Block", ...]]()
    for name, limit in limits.items():
        units = axis_units(name)
        note = Note(text=f"Axis {name}: {limit.summary(units.force)}.", kind="limit")
        blocks[name] = note, limit.chart(f"axis {name}", units.force)
        if limit.trade:
            head = (
                f"noise [m{units.speed} per {units.force}]",
                f"peak [{units.force}]",
                "M_a",
                "B_a",
                "K_l [ms]",
                "B_fb [ms]",
            )
            caption = f"Axis {name}: peak against noise, four gains, M_a and K_l hardly bounded"
            rows = [_trade_row(each) for each in limit.trade]
            blocks[name] += (build_table(caption, ("times the noise", *head), rows, numbers=range(1, 7)),)
    return blocks


def _trade_row(point: "NoisePoint") -> tuple[str, ...]:
    law, head = point.law, (f"{point.factor:g}", f"{1e3 * point.noise_m_s_per_n:.3g}")
    if law is None or point.peak_force_n is None:
        return (*head, "no design", "", "", "", "")
    gains = law.mass_kg, law.damping_n_s_per_m, 1e3 * law.lead_s, 1e3 * law.feedback_damping_s
    return (*head, f"{point.peak_force_n:.4g}", *(f"{each:.4g}" for each in gains))


def how_far_lines(limits: "Mapping[str, LimitResult]", name: str) -> list[str]:
    """Return the sentences of one axis, none where nothing was looked for."""
    from autotune.formats.units import axis_units

    if name not in limits:
        return []
    from autotune.limit.noise_trade import trade_text

    limit, unit = limits[name], axis_units(name).force
    return [limit.summary(unit), *([trade_text(limit.trade, unit)] if limit.trade else [])]
