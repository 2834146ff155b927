"""`autotune identify`: plant parameters from a log."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ._common import Output, output_options
from ._table import printable, table_lines

if TYPE_CHECKING:
    from identification.result import AxisEstimate, Estimate, Identified, VectorEstimate
    from identification.timeline_phases import Timeline

_EPILOG = """\b
Examples:
  autotune identify run7.mcap -o identified.yaml
  autotune identify run7.mcap --wrench-topic /ft/raw --command-topic /servo/target
  autotune identify part1.bag part2.bag --cell cell.yaml
  autotune identify monday.mcap friday.mcap --given mass_kg=16.2±0.1
"""


@click.command("identify", epilog=_EPILOG)
@click.argument("logs", metavar="LOG...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--output",
    "out",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("identified.yaml"),
    show_default=True,
    help="The file to write.",
)
@click.option(
    "--cell", "cell_path", type=click.Path(path_type=Path, dir_okay=False), help="What the log cannot say: cell.yaml."
)
@click.option("--wrench-topic", help="The wrench, if the log has several.")
@click.option("--pose-topic", help="The measured flange pose, if the log has several.")
@click.option("--command-topic", help="The commanded flange pose.")
@click.option(
    "--allow-partial",
    is_flag=True,
    help="Write the file even if a parameter is missing (it is marked unidentifiable) or logs disagree.",
)
@click.option("--salvage", is_flag=True, help="Read what a damaged log still holds, and tell what is lost.")
@click.option(
    "--given",
    metavar="NAME=VALUE±STD",
    multiple=True,
    help="What is known from elsewhere, e.g. mass_kg=16.2±0.1 or x.delay_s=2.4e-3+-1e-4; without ± it is exact.",
)
@output_options
def command(
    output: Output,
    logs: tuple[Path, ...],
    out: Path,
    cell_path: Path | None,
    wrench_topic: str | None,
    pose_topic: str | None,
    command_topic: str | None,
    allow_partial: bool,
    salvage: bool,
    given: tuple[str, ...],
) -> None:
    """Estimate payload, sensor, robot, coupling and environment from LOG, each with its uncertainty and a verdict.

    LOGs that follow each other within a second are one recording; others are identified apart and combined, and a
    parameter on which they disagree is named. A recording needs a wrench, the measured flange pose and the commanded
    one; in it: 6 to 12 tilted poses at rest, a commanded sweep in free space, and contacts. Exit code 3: a log cannot
    be used. 4: they do not tell enough, or disagree; nothing is written then, unless with --allow-partial.
    """
    from autotune.files.atomic import check_target
    from autotune.files.cell import read_cell
    from autotune.files.identified import identified_tree, write_identified
    from autotune.given import parse_given
    from autotune.identifying import Topics, identify_log
    from autotune.processes import count_processors

    check_target(out, [*logs, *([] if cell_path is None else [cell_path])])
    topics = Topics(wrench=wrench_topic, pose=pose_topic, command=command_topic)
    cell = None if cell_path is None else read_cell(cell_path)
    with output.progress(f"identifying {', '.join(log.name for log in logs)}", None):
        found = identify_log(
            logs,
            topics,
            cell=cell,
            salvage=salvage,
            allow_partial=allow_partial,
            given=parse_given(given),
            processes=count_processors(),
        )
    write_identified(out, found.result, found.provenance)
    output.result(identified_tree(found.result, found.provenance), lambda: print_identified(found.result, out))


def print_identified(result: "Identified", out: Path) -> None:
    """Print the parameters as a table, the findings below."""
    rows = [("parameter", "value", "± std", "unit", "verdict"), *_rows(result)]
    for line in table_lines(rows, left=(0, 3, 4)):
        click.echo(line)
    for timeline in result.timelines:
        click.echo(printable(_timeline_line(timeline)))
    for finding in result.findings:
        click.echo(printable(f"{finding.severity}: {finding.message} {finding.advice}".rstrip()))
    click.echo(f"written: {out}")


def _timeline_line(timeline: "Timeline") -> str:
    """Return what happened in a log and for how long, in the order of its first time."""
    spent: dict[str, tuple[int, float]] = {}
    for phase in timeline.phases:
        count, seconds = spent.get(phase.kind.value, (0, 0.0))
        spent[phase.kind.value] = count + 1, seconds + phase.stop_s - phase.start_s
    told = ", ".join(f"{count} x {kind} {seconds:.1f} s" for kind, (count, seconds) in spent.items())
    return f"time line{f' of {timeline.log}' if timeline.log else ''}: {told}"


def _rows(result: "Identified") -> Iterator[tuple[str, ...]]:
    yield _row("payload mass", result.payload.mass_kg, "kg")
    yield from _vector_rows("centre of mass", result.payload.com_m, "mm", 1e3)
    if result.payload.inertia_kg_m2 is not None:
        for name, component in vars(result.payload.inertia_kg_m2).items():
            yield _row(f"inertia {name} about sensor", component, "kg·m²")
    yield from _vector_rows("force bias", result.sensor.force_bias_n, "N", 1.0)
    yield _row("force noise", result.sensor.force_noise_rms_n, "N rms")
    yield _row("gravity residual", result.sensor.gravity_residual_rms_n, "N rms")
    if result.sensor.mounting_rad is not None:
        yield from _vector_rows("sensor turned about", result.sensor.mounting_rad, "deg", 180.0 / math.pi)
    if result.sensor.base_tilt_rad is not None:
        yield from _vector_rows("base tilted about", result.sensor.base_tilt_rad, "deg", 180.0 / math.pi)
    yield _row("control period", result.sample_time_s, "ms", 1e3)
    for name, axis in result.axes.items():
        yield from _axis_rows(name, axis)


def _axis_rows(name: str, axis: "AxisEstimate") -> Iterator[tuple[str, ...]]:
    from autotune.files.units import axis_units

    units = axis_units(name)
    # Stiffnesses of translations are told in N/mm, as on data sheets.
    stiffness, scale = ("N/mm", 1e-3) if units.stiffness == "N/m" else (units.stiffness, 1.0)
    damping, mass = units.damping, units.mass
    yield _row(f"{name}: coupling K_s", axis.coupling.stiffness_n_per_m, stiffness, scale)
    yield _row(f"{name}: coupling B_s", axis.coupling.damping_n_s_per_m, damping)
    yield _row(f"{name}: drag B_p", axis.drag_n_s_per_m, damping)
    if axis.mass_kg is not None:
        yield _row(f"{name}: {units.mass_name} from motion", axis.mass_kg, mass)
    yield _row(f"{name}: robot bandwidth", axis.robot.bandwidth_hz, "Hz")
    yield _row(f"{name}: delay T_d", axis.robot.delay_s, "ms", 1e3)
    for surface in axis.environments:
        count = f"{surface.contacts} contact{'' if surface.contacts == 1 else 's'}"
        told = f"{name}: {surface.name}, {count}"
        yield _row(f"{told}: K_e", surface.stiffness_n_per_m, stiffness, scale)
        yield _row(f"{told}: secant", surface.secant_stiffness_n_per_m, stiffness, scale)
        yield _row(f"{told}: B_e", surface.damping_n_s_per_m, damping)
        yield _row(f"{told}: M_e", surface.mass_kg, mass)
        lowest, highest = min(surface.peak_force_n, default=None), max(surface.peak_force_n, default=None)
        if lowest is not None and highest is not None:
            peaks = f"{highest:.1f}" if lowest == highest else f"{lowest:.1f} to {highest:.1f}"
            yield f"{told}: peak", peaks, "", units.force, ""


def _row(name: str, estimate: "Estimate", unit: str, scale: float = 1.0) -> tuple[str, ...]:
    if estimate.value is None and estimate.ci95 is not None:
        low, high = estimate.ci95
        return name, f"{low * scale:.4g} to {high * scale:.4g}", "-", unit, estimate.status.value
    return (name, *_numbers(estimate.value, estimate.std, scale), unit, estimate.status.value)


def _vector_rows(name: str, estimate: "VectorEstimate", unit: str, scale: float) -> Iterator[tuple[str, ...]]:
    for i, axis in enumerate("xyz" if estimate.value is None else "xyz"[: len(estimate.value)]):
        value = None if estimate.value is None else estimate.value[i]
        std = None if estimate.std is None else estimate.std[i]
        yield (f"{name} {axis}", *_numbers(value, std, scale), unit, estimate.status.value)


def _numbers(value: float | None, std: float | None, scale: float) -> tuple[str, str]:
    if value is None:
        return "-", "-"
    return f"{value * scale:.4f}", "-" if std is None else f"{std * scale:.2g}"
