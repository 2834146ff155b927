"""`autotune demo`: the whole chain on the log of a simulated cell."""

import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from autotune.shown import COMPILING
from problems.errors import MissingExtraError, require_extra

from ._common import Output, output_options
from ._limits import how_far_lines, limit_blocks, limit_tree, limits_of
from ._options import GroupedCommand
from ._terminal import detect_terminal, print_message, print_table

if TYPE_CHECKING:
    from autotune.demo import Comparison, DemoResult
    from autotune.limit.limit import LimitResult
    from autotune.report.page import Page

    from ._common import Advance

_EPILOG = """\b
Examples:
  autotune demo
  autotune demo first-try --seed 7
  autotune demo --cell low-drag
  autotune demo --json --quiet
"""


# Of a cold start: the kernels that are compiled here, and the share of the time that they take.
_KERNELS, _COLD_SHARE = 300, 0.75
# Any plant will do for what its design compiles.
_PLANT = """format: autotune/plant
version: 1
mass: 16.2
coupling_stiffness: 3.1e5
coupling_damping: 150
drag: {value: 330, std: 1}
robot: {bandwidth: 3.2, delay: 2.4e-3}
environment_stiffness: [9.6e4, 1.45e5]
sample_time: 8e-4
"""


@click.command("demo", cls=GroupedCommand, epilog=_EPILOG)
@click.argument("directory", metavar="[DIR]", type=click.Path(path_type=Path, file_okay=False), default="autotune-demo")
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True, help="Seed of noise and search.")
@click.option(
    "--cell",
    type=click.Choice(("standard", "low-drag")),
    default="standard",
    show_default=True,
    help="The simulated cell: the standard one, or a payload with little damping to ground.",
)
@output_options
def command(output: Output, directory: Path, seed: int, cell: str) -> None:
    """Write the log of a simulated cell to DIR and run all steps on it.

    DIR (default autotune-demo) then holds the log (MCAP), identified.yaml, controller.yaml and its JSON twin, and
    report.html. The summary compares the identified parameters with those of the simulation. The low-drag cell is tuned
    for 12 to 20 kg on surfaces of 20 to 500 N/mm; the usual free-space admittance cannot be had there.
    """
    from autotune.demo import PAGE, run_demo

    from ._report import write_report

    has_page = True
    try:
        require_extra("The page of the demo", "bokeh", "reports")
    except MissingExtraError as error:
        output.note(f"{error} The demo goes on without it.")
        has_page = False
    with output.progress("demo", 1.0) as advance, _compiling_beside(output), _counting_kernels(advance) as work:
        found = run_demo(directory, cell=cell, seed=seed, step=lambda name: output.note(f"{name} ..."), progress=work)
    page = found.files.log.parent / PAGE if has_page else None
    limits = limits_of(output, found.optimized) if find_spec("cvxpy") else {}
    written = write_report(output, page, lambda: _page(found, limits))
    if page is not None:
        found.made.add(page)
    for path in found.made.replaced:
        output.note(f"replaced {path}, of an earlier demo")
    output.result({**_tree(found), **limit_tree(limits), **written}, lambda: _print(found, page, limits))
    output.next_command("explore", found.files.controller)


@contextlib.contextmanager
def _counting_kernels(advance: "Advance") -> Iterator[Callable[[float], None]]:
    """Yield what takes shares of the work, while the bar also moves with every kernel that is compiled.

    A cold start spends most of its time on them; then they have most of the bar, else the work has all of it.
    """
    from problems.compiling import each_compilation

    compiled = 0

    def count() -> None:
        nonlocal compiled
        compiled += 1
        if compiled <= _KERNELS:
            advance(_COLD_SHARE / _KERNELS)

    with each_compilation(count):
        yield lambda share: advance((1.0 - _COLD_SHARE if compiled else 1.0) * share)


@contextlib.contextmanager
def _compiling_beside(output: Output) -> Iterator[None]:
    """Compile what a design needs in a process of its own while the block runs, where kernels have to be compiled.

    What that has not compiled at the end of the block is given up.
    """
    from autotune.processes import count_processors
    from problems.compiling import on_compilation

    running: list[subprocess.Popen[bytes]] = []
    with tempfile.TemporaryDirectory(prefix="autotune-demo-") as folder:

        def start() -> None:
            if detect_terminal(sys.stderr).is_terminal:
                output.note(COMPILING)
            if count_processors() == 1:
                return
            plant = Path(folder) / "plant.yaml"
            plant.write_text(_PLANT, encoding="utf-8")
            command = [sys.executable, "-m", "autotune", "optimize", str(plant), "-o", f"{folder}/controller.yaml"]
            command += ["--compare", "mass=10,damping=1500", "--quiet"]
            nothing = subprocess.DEVNULL
            running.append(subprocess.Popen(command, stdin=nothing, stdout=nothing, stderr=nothing))

        on_compilation(start)
        try:
            yield
        finally:
            on_compilation(_nothing)
            for process in running:
                process.terminate()
                process.wait()


def _nothing() -> None:
    """Hear of compilations after the block, whose folder is gone."""


def _page(found: "DemoResult", limits: "Mapping[str, LimitResult]") -> "Page":
    """Return the page of what was tuned, which begins with what it changes, and of what was identified."""
    from autotune.pipeline import IdentifyOptions
    from autotune.report.identify_page import build_identify_page, summaries_of
    from autotune.report.optimize_page import build_optimize_page
    from autotune.report.page import join_pages

    identified, files = found.identified, found.files
    summaries = summaries_of([files.log], IdentifyOptions(), identified.evidence)
    steps = {name: search.steps for name, search in found.optimized.searches.items()}
    parts = (
        (
            files.controller,
            build_optimize_page(
                found.optimized.controller,
                found.checksum,
                steps=steps,
                before_after=found.optimized.before_after,
                limits=limit_blocks(limits),
            ),
        ),
        (files.log, build_identify_page(identified.result, identified.provenance, identified.evidence, summaries)),
    )
    return join_pages("The demo: from a log to a controller", [(path.name, page) for path, page in parts])


def _tree(found: "DemoResult") -> dict[str, Any]:
    from autotune.formats.controller import controller_tree

    from ._optimized import active_tree
    from .validate import checks_tree

    return {
        "identified": [
            {
                "name": c.name,
                "unit": c.unit,
                "truth": c.truth * c.scale,
                "value": None if c.estimate.value is None else c.estimate.value * c.scale,
                "std": None if c.estimate.std is None else c.estimate.std * c.scale,
                "status": c.estimate.status.value,
            }
            for c in found.comparisons
        ],
        "controller": controller_tree(found.optimized.controller),
        "active": active_tree(found.optimized),
        "before_after": {name: each.to_dict() for name, each in found.optimized.before_after.items()},
        "checks": checks_tree(found.report),
        "checksum": found.checksum,
        "files": {name: str(getattr(found.files, name)) for name in ("log", "identified", "controller", "twin")},
    }


def _print(found: "DemoResult", page: Path | None, limits: "Mapping[str, LimitResult]") -> None:
    from autotune.formats.canonical import short
    from autotune.formats.units import axis_units
    from autotune.text import scenario_text

    from ._optimized import active_lines, default_lines, print_before_after

    print_message(
        "A cell was simulated and its log written; everything below was found from that log alone. The truth is shown "
        "beside it."
    )
    print_message()
    print_before_after(found.optimized.before_after)
    _heading("Identified from the log, beside the truth of the simulation")
    rows: list[tuple[str, ...]] = [("parameter", "identified", "± std", "truth", "error", "unit", "verdict")]
    rows += map(_comparison, found.comparisons)
    print_table(rows, left=(0, 5, 6), point=(1, 2, 3), verdict=6, indent="  ")
    controller = found.optimized.controller
    for name, gains in controller.axes.items():
        _heading(f"Controller chosen for axis {name}")
        print_message(
            f"  admittance mass M_a {gains.mass:g} kg, damping B_a {gains.damping:g} N·s/m, "
            f"lead K_l {1e3 * gains.lead_s:g} ms, feedback damping B_fb {1e3 * gains.feedback_damping_s:g} ms"
        )
        worst = max(controller.predicted[name].scenarios, key=lambda s: s.peak_contact_force_n)
        print_message(
            f"  worst predicted peak {worst.peak_contact_force_n:.1f} N at the contact, "
            f"{worst.peak_sensor_force_n:.1f} N at the sensor ({scenario_text(worst.scenario(), axis_units(name))})"
        )
        lines = (*default_lines(found.optimized, name), *active_lines(found.optimized, name))
        for line in (*lines, *how_far_lines(limits, name)):
            print_message(f"  {line}")
    for note in controller.provenance.get("notes", ()):
        print_message(f"  {note}")
    _heading("Proved and verified, from the written file alone")
    for check in found.report.checks:
        print_message(f"{check.name}: {check.message}", indent="  ", verdict=f"{check.verdict:6} ")
    _heading(f"Files (checksum of the controller: {short(found.checksum)})")
    for name, path in (
        ("log", found.files.log),
        ("identified plant", found.files.identified),
        ("controller for the cell", found.files.controller),
        ("its JSON twin", found.files.twin),
        ("report, to open first", page),
    ):
        if path is not None:
            print_message(f"  {name:24}{path}")


def _heading(text: str) -> None:
    print_message()
    print_message(text)


def _comparison(c: "Comparison") -> tuple[str, ...]:
    from autotune.text import rounded_to, with_deviation

    value, std, error = c.estimate.value, c.estimate.std, c.error_share
    return (
        c.name,
        *with_deviation(value, std, c.scale),
        rounded_to((std or 0.0) * c.scale, c.truth * c.scale),
        "-" if error is None else f"{100.0 * error:+.2f} %",
        c.unit,
        c.estimate.status.value,
    )
