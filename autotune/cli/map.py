"""`autotune map`: two parameters against stability, a margin or the peak, as a picture with its data."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.formats.kinds import PLANTS

from ._common import Output, output_options
from ._options import SETTINGS, FilePath, GroupedCommand, output_option
from ._terminal import print_message

if TYPE_CHECKING:
    from problems.maps.loops import Where

_EPILOG = """\b
Examples:
  autotune map controller.yaml -o map.svg
  autotune map controller.yaml --show modulus --x environment_stiffness=1e4:1e6:log --y lead_s=0:0.05
  autotune map identified.yaml --set mass=13 --show peak-contact --x damping=300:3000 --y lead_s=0:0.03:60
  autotune map controller.yaml --show stable-damping --where contact
  autotune map controller.yaml --show stable-lead --where free_space --y drag=100:900:3

\b
NAME is one of
  of the controller: mass M_a, damping B_a, lead_s K_l, feedback_damping_s B_fb, velocity_filter_rad_per_s ω_v,
    acceleration_filter_rad_per_s ω_a, compensation_mass P̂
  of the plant: payload_mass M_p, drag B_p, payload_frequency_rad_per_s ω = sqrt(K_s/M_p), payload_damping_ratio
    ζ = B_p/(2 sqrt(M_p K_s)), coupling_stiffness K_s, coupling_damping B_s, environment_stiffness K_e,
    environment_damping B_e, environment_mass M_e, delay_s T_d, robot_bandwidth_rad_per_s ω_b
or one of the symbols M_a, B_a, K_l …; values are in SI units of the axis.
"""

_SHOWS = [
    *("stability", "modulus", "gain", "phase", "delay", "disk", "peak-contact", "peak-sensor"),
    *("stable-damping", "stable-lead"),
]
_GROUPS = {
    "Axes and quantity": ("x", "y", "show", "where", "search"),
    "Plant and controller": ("axis", "settings", "controller", "approach_force"),
    "Files": ("out", "data"),
}
_RANGE = "NAME=LO:HI[:N][:log|lin]"


@click.command("map", cls=GroupedCommand, groups=_GROUPS, epilog=_EPILOG)
@click.argument("source", type=FilePath(*SETTINGS, kinds=(*PLANTS, "controller")))
@click.option("--x", metavar=_RANGE, help="Parameter of the x axis, N values (120); logarithmic from a factor of 10.")
@click.option("--y", metavar=_RANGE, help="Parameter of the y axis (90 values), or of the compared curves.")
@click.option(
    "--show",
    type=click.Choice(_SHOWS),
    default="stability",
    show_default=True,
    metavar="WHAT",
    help=f"Quantity: {', '.join(_SHOWS)}.",
)
@click.option(
    "--where",
    type=click.Choice(["contact", "free_space", "both"]),
    default="both",
    show_default=True,
    help="The loop that must be stable and gives the margin.",
)
@click.option("--axis", metavar="NAME", help="x, y, z, rx, ry or rz; needed when SOURCE holds several.")
@click.option(
    "--set",
    "settings",
    metavar="NAME=VALUE",
    multiple=True,
    help="Set a parameter; may be repeated. Of one on an axis: where the design is marked.",
)
@click.option(
    "--controller",
    type=FilePath(*SETTINGS, kinds=("controller",)),
    help="Controller file with the gains (default: those of SOURCE).",
)
@click.option("--search", metavar="LO:HI[:N][:log|lin]", help="Search range of stable-damping or stable-lead.")
@click.option("--approach-force", type=float, metavar="N", help="Approach force, for peaks.")
@output_option("map.svg", "Picture to write, .svg or .png.")
@click.option(
    "--data",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Data file to write, .csv or .json (default: .csv beside the picture).",
)
@output_options
def command(
    output: Output,
    source: Path,
    x: str | None,
    y: str | None,
    show: str,
    where: "Where",
    axis: str | None,
    settings: tuple[str, ...],
    controller: Path | None,
    search: str | None,
    approach_force: float | None,
    out: Path,
    data: Path | None,
) -> None:
    """Draw stability, a margin or the peak force over two parameters of the loop, and save the numbers.

    SOURCE is identified.yaml or plant.yaml (give the gains with --set or --controller) or controller.yaml (its plant is
    that of the certificate). Without --x and --y the axes are damping and lead gain, around the design, which is
    marked.

    stable-damping draws the smallest stable damping over the environment stiffness for each part of the controller,
    stable-lead all stable lead gains over the payload frequency; --y then names the parameter of which a few values
    are compared.
    """
    from autotune.maps.make import make_map, summary_tree
    from autotune.maps.options import MapOptions

    options = MapOptions(
        source=source,
        picture=out,
        data=data,
        axis=axis,
        controller=controller,
        show=show,
        where=where,
        x=x,
        y=y,
        search=search,
        settings=settings,
        approach_force=approach_force,
    )
    with output.progress("mapping", 1.0) as advance:
        made = make_map(options, advance)
    for line in (*made.replaced, *made.setup.source.notes):
        output.note(line)
    tree = summary_tree(made)
    output.result(tree, lambda: print_summary(tree))
    output.next_command("explore", source)


def print_summary(tree: dict[str, Any]) -> None:
    """Print what was found in a few lines, and where the files are."""
    for line in summary_lines(tree):
        print_message(line)


def summary_lines(tree: dict[str, Any]) -> list[str]:
    """Return the summary for people."""
    from autotune.formats.canonical import short

    lines = _interval_lines(tree) if "cases" in tree else _map_lines(tree)
    lines += [f"{path}: checksum {short(checksum)}" for path, checksum in tree["checksums"].items()]
    return [*lines, f"written: {tree['picture']}, {tree['data']}"]


def _map_lines(tree: dict[str, Any]) -> list[str]:
    from autotune.maps.text import WHERE

    lines = [f"{tree['points']} points, {tree['stable_share']:.1%} stable {WHERE[tree['where']]}"]
    lines += [f"{key} {tree['show']}: {_point(tree, tree[key])}" for key in ("smallest", "largest") if key in tree]
    return [*lines, f"design: {_point(tree, tree['design'])}"] if "design" in tree else lines


def _interval_lines(tree: dict[str, Any]) -> list[str]:
    from autotune.maps.text import WHERE, number, with_unit
    from problems.model.axis_kind import for_people

    def span(ends: list[float]) -> str:
        factor, unit = for_people(searched["unit"])
        return with_unit(" to ".join(number(factor * end) for end in dict.fromkeys(ends)), unit)

    searched = tree["searched"]
    lines = [f"{_symbol(searched)} searched in {span([searched['low'], searched['high']])}, {WHERE[tree['where']]}"]
    for name, case in tree["cases"].items():
        line = f"  {name}: " if len(tree["cases"]) > 1 else "  "
        if case["smallest"] is None:
            lines.append(f"{line}nothing is stable")
            continue
        line += f"smallest stable value {span(case['smallest'])}, largest {span(case['largest'])}"
        if case["most_intervals"] > 1:
            line += f", in up to {case['most_intervals']} intervals"
        if case["stable_share"] < 1.0:
            line += f", none at {1.0 - case['stable_share']:.0%} of the values of {_symbol(tree['x'])}"
        lines.append(line)
    return lines


def _point(tree: dict[str, Any], point: dict[str, Any]) -> str:
    from autotune.maps.text import shown

    places = [f"{_symbol(tree[axis])} {shown(point[tree[axis]['name']], tree[axis]['unit'])}" for axis in ("x", "y")]
    if not point["is_stable"]:
        value = "unstable"
    elif point["value"] is None:
        value = "stable" if tree["show"] == "stability" else "no limit"
    else:
        value = shown(point["value"], tree["unit"])
    return f"{value} at {', '.join(places)}"


def _symbol(axis: dict[str, Any]) -> str:
    """Return what people call a parameter whose numbers are not in the unit of its name."""
    from problems.maps.parameters import find_parameter

    return find_parameter(axis["name"]).symbol
