"""`autotune limit`: how far a design is from what any linear controller could reach."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.formats.kinds import PLANTS

from ._common import Output, output_options
from ._options import SETTINGS, FilePath, FiniteRange, GroupedCommand
from ._terminal import print_message, print_table

if TYPE_CHECKING:
    from autotune.formats.controller_record import Controller
    from autotune.limit.limit import LimitResult
    from problems.design.problem import DesignProblem
    from problems.design.uncertainty import Scenario

_EPILOG = """\b
Examples:
  autotune limit controller.yaml
  autotune limit identified.yaml --problem problem.yaml --plot limit.svg
  autotune limit controller.yaml --plants 3 --noise 3 --json
"""


@click.command("limit", cls=GroupedCommand, epilog=_EPILOG)
@click.argument("source", type=FilePath(*SETTINGS, kinds=(*PLANTS, "controller")))
@click.option(
    "--controller",
    type=FilePath(*SETTINGS, kinds=("controller",)),
    help="Controller of SOURCE's plant to look at, under its own requirements unless --problem says others (default: "
    "one that is searched).",
)
@click.option("--problem", type=FilePath(*SETTINGS, kinds=("problem",)), help="Requirements and ranges: problem.yaml.")
@click.option("--axis", metavar="NAME", help="x, y, z, rx, ry or rz (default: all).")
@click.option(
    "--plants",
    type=click.IntRange(1, 4),
    default=1,
    show_default=True,
    help="How many of the hardest contacts one controller is to soften at once.",
)
@click.option(
    "--noise",
    type=FiniteRange(min=1.0, max=100.0),
    default=1.0,
    show_default=True,
    metavar="FACTOR",
    help="How often the command noise that the problem allows, or the design makes, the others may have.",
)
@click.option(
    "--plot", type=click.Path(path_type=Path, dir_okay=False), metavar="F.svg", help="Also draw it, .svg or .png."
)
@output_options
def command(
    output: Output,
    source: Path,
    controller: Path | None,
    problem: Path | None,
    axis: str | None,
    plants: int,
    noise: float,
    plot: Path | None,
) -> None:
    """Say how far the design is from what any linear controller could reach under the same requirements.

    SOURCE is controller.yaml, or a plant, for which a design is searched. Looked at are the hardest contacts of the
    certified set. All controllers approach at the speed of the design, keep the modulus and the free-space admittance
    that are asked, and make no more noise of the command. From above: a controller of high order that reaches less, as
    the exact loop shows. From below: a force that no linear controller gets below. Needs the extra `limit`. Exit code
    5: no design meets the requirements.
    """
    from autotune.formats.atomic import check_target
    from autotune.formats.units import axis_units
    from problems.errors import require_extra

    require_extra("autotune limit", "cvxpy", "limit")
    if plot is not None:
        if plot.suffix.lower() not in {".svg", ".png"}:
            raise click.UsageError(f"--plot {plot} must end in .svg or .png.")
        check_target(plot, [source], kind="picture", option="--plot")
    found = _found(output, source, controller, problem, axis, plants, noise)
    tree: dict[str, Any] = {"axes": {name: each.to_dict() for name, each in found.items()}}
    if plot is not None:
        _write_plot(output, plot, found)
        tree["plot"] = str(plot)

    def text() -> None:
        for name, each in found.items():
            print_message(f"axis {name}: {each.summary(axis_units(name).force)}")
            _print_limit(each, name)
        if plot is not None:
            print_message(f"written: {plot}")

    output.result(tree, text)
    output.next_command("explore", controller or source)


def _found(
    output: Output,
    source: Path,
    controller: Path | None,
    problem: Path | None,
    axis: str | None,
    plants: int,
    noise: float,
) -> "dict[str, LimitResult]":
    from dataclasses import replace

    from autotune.errors import InfeasibleError, UsageError
    from autotune.explore.source import read_exploration
    from autotune.formats.controller import read_controller
    from autotune.formats.controller_record import admittance_controller
    from autotune.formats.units import axis_units
    from autotune.formats.yaml12 import kind_of_file
    from autotune.limit.limit import find_limit, hardest
    from problems.progress import ProgressSlice

    with output.progress("looking for the limit", 1.0) as advance:
        share = 0.0 if controller is not None else 0.2
        exploration = read_exploration(source, problem, lambda done: advance(share * done))
        is_plant = kind_of_file(source) != "controller"
        names = list(exploration.axes) if axis is None else [axis]
        if axis is not None and axis not in exploration.axes:
            raise UsageError(f"Axis {axis} is not in {source}; it holds {', '.join(exploration.axes)}.")
        given = None if controller is None else read_controller(controller).controller
        file = given if is_plant else read_controller(source).controller
        found = {}
        for name in names:
            start = exploration.axes[name]
            if start.note and given is None and is_plant:
                raise InfeasibleError(
                    f"Axis {name}: {start.note} What would be enough, and whether another structure has a design, says "
                    "`autotune optimize`; its controller.yaml can be looked at."
                )
            if given is not None and name not in given.axes:
                raise UsageError(f"Axis {name} is not in {controller}; it holds {', '.join(given.axes)}.")
            law = start.problem.controller(start.design) if given is None else admittance_controller(given, name)
            if given is not None and problem is None:
                # What the controller was made for is what it is held against.
                start = replace(start, problem=_asked_as_of(start.problem, given, name))
            portion = ProgressSlice(advance, (1.0 - share) / len(names))
            seen = start.scenarios
            if file is not None:
                seen = (*seen, *_predicted_in(file, name, start.problem))
            worst = hardest(start.problem, law, seen, plants, units=axis_units(name))
            if given is not None:
                _note_uncertified(output, given, name, worst)
            found[name] = find_limit(
                start.problem, law, worst, noise_factor=noise, spectrum=start.noise_spectrum, progress=portion
            )
            portion.finish()
    return found


def _predicted_in(controller: "Controller", name: str, problem: "DesignProblem") -> "Iterator[Scenario]":
    """Yield the contacts that a controller file predicts, its hardest among them, that are in the problem's set."""
    from problems.design.uncertainty import MASS, STIFFNESS

    for each in controller.predicted[name].scenarios:
        scenario = each.scenario()
        values = {MASS: each.payload_mass_kg, STIFFNESS: each.environment_stiffness_n_per_m}
        inside = all(low <= values[key] <= high for key in values for low, high in [problem.plants.range_of(key)])
        if inside and set(scenario.further()) <= set(problem.plants.further):
            yield scenario


def _asked_as_of(problem: "DesignProblem", controller: "Controller", name: str) -> "DesignProblem":
    """Return a problem with the requirements and the approach of a controller's certificate."""
    from dataclasses import replace

    from autotune.validation.certified_requirements import certified_problem_requirements

    return replace(
        problem,
        requirements=certified_problem_requirements(controller, name),
        approach=controller.certificate.domain[name].approach,
    )


def _note_uncertified(output: Output, given: "Controller", name: str, scenarios: "Sequence[Scenario]") -> None:
    """Say which contacts a controller is looked at over lie outside of what it is certified for."""
    from autotune.formats.units import axis_units
    from autotune.text import scenario_text

    domain = given.certificate.domain[name]
    (lightest, heaviest), (softest, stiffest) = domain.payload_mass_kg, domain.environment_stiffness_n_per_m
    for each in scenarios:
        mass, stiffness = each.payload_mass_kg, each.environment_stiffness_n_per_m
        if not (lightest <= mass <= heaviest and softest <= stiffness <= stiffest):
            contact = scenario_text(each, axis_units(name))
            output.note(f"Axis {name}: the controller is not certified for the contact looked at, {contact}.")


def _print_limit(found: "LimitResult", axis: str) -> None:
    """Print the controllers side by side, over which plants, and what is neglected."""
    from autotune.formats.units import axis_units
    from autotune.limit.limit import NEGLECTED_ABOVE
    from autotune.text import scenario_text

    units = axis_units(axis)
    columns = [("the design", found.design)] + ([] if found.attained is None else [("any order", found.attained)])
    rows = [("", *(head for head, _ in columns))]
    lines: Mapping[str, tuple[str, float]] = {
        f"peak at the {found.place} [{units.force}]": ("peak_force_n", 1.0),
        "modulus margin": ("modulus", 1.0),
        f"command noise [m{units.speed} per {units.force}]": ("noise_m_s_per_n", 1e3),
        f"least admittance [{units.admittance}]": ("min_m_s_per_n", 1.0),
        "gain margin [dB]": ("gain_db", 1.0),
        "phase margin [°]": ("phase_deg", 1.0),
        "delay margin [ms]": ("delay_s", 1e3),
    }
    for label, (name, scale) in lines.items():
        rows.append((label, *(f"{getattr(each, name) * scale:.4g}" for _, each in columns)))
    print_table(rows, point=(1, 2), indent="  ")
    print_message(
        f"  over {'; '.join(scenario_text(each, units) for each in found.scenarios)}; approached at "
        f"{1e3 * found.approach_speed_m_s:.4g} m{units.speed}"
    )
    print_message(f"  neglected by the force that none gets below: {found.neglected_below}")
    print_message(f"  neglected by the controller of any order: {NEGLECTED_ABOVE}")


def _write_plot(output: Output, path: Path, found: "Mapping[str, LimitResult]") -> None:
    from dataclasses import replace

    from autotune.charts.matplotlib_renderer import render
    from autotune.formats.atomic import write_atomic
    from autotune.formats.kinds import PICTURE_MARK
    from autotune.formats.units import axis_units

    charts = [each.chart(f"axis {name}", axis_units(name).force) for name, each in found.items()]
    whole = replace(charts[0], panels=tuple(panel for chart in charts for panel in chart.panels))
    with output.replacing(path, "picture"):
        write_atomic(path, render(whole, path.suffix, mark=PICTURE_MARK))
