"""`autotune warm`: compile every kernel into the cache, so that no later command has to."""

import contextlib
import importlib.util
import io
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import click

from problems.errors import AutotuneError

from ._common import Advance, Output, output_options
from ._options import GroupedCommand

_EPILOG = """\b
Examples:
  autotune warm
  autotune warm --json --quiet
"""
_ROWS = 2000


@click.command("warm", cls=GroupedCommand, epilog=_EPILOG)
@output_options
def command(output: Output) -> None:
    """Compile every kernel into the cache, so that no later command compiles anything.

    Runs the commands on the log of a simulated cell in a temporary folder, which is removed at the end. Takes about
    3 minutes on one core, once for each version and machine; less than one where everything is compiled already.
    NUMBA_CACHE_DIR says where the cache is.
    """
    from problems.compiled import compilations

    before = compilations.count
    with output.progress("compiling", 1.0) as advance, tempfile.TemporaryDirectory(prefix="autotune-warm-") as folder:
        _warm(Path(folder), advance)
    count = compilations.count - before
    text = f"{count} kernels compiled." if count else "Everything was compiled already."
    output.result({"compiled": count}, lambda: click.echo(text))
    output.next_command("demo")


def _warm(folder: Path, advance: Advance) -> None:
    """Run the commands in `folder`; the shares are those of the time of a cold start."""
    log, bag, rosbag2, table = folder / "cell.mcap", folder / "cell.bag", folder / "cell", folder / "cell.csv"
    identified, controller = str(folder / "identified.yaml"), str(folder / "controller.yaml")
    axes = ("--x", "environment_stiffness=2e4:5e5:4:log", "--y", "lead_s=0:0.03:4")
    steps: list[tuple[str, float, Callable[[], None]]] = [
        ("demo", 0.58, lambda: _run("demo", str(folder))),
        ("log formats", 0.02, lambda: _write_logs(bag, rosbag2, table)),
        *(
            (f"inspect {path.name}", 0.03, lambda path=path: _run("inspect", str(path)))
            for path in (log, bag, rosbag2, table)
        ),
        ("plan", 0.05, lambda: _run("plan", identified, "-o", str(folder / "plan.yaml"))),
        ("validate", 0.05, lambda: _run("validate", controller, "--identified", identified, "--log", str(log))),
        ("predict", 0.02, lambda: _predict(identified, controller)),
        ("map", 0.06, lambda: _map(controller, folder, axes)),
        ("noise that is not white", 0.01, lambda: _coloured_noise(Path(identified))),
        ("explore", 0.09, lambda: _explore(Path(identified), Path(controller))),
    ]
    for name, share, step in steps:
        advance(0.0, f"compiling: {name}")
        step()
        advance(share)


def _run(*arguments: str) -> None:
    """Run a command in silence; it is for what it compiles, so that its verdict is of no interest."""
    from .main import COMMANDS, LazyGroup

    group = LazyGroup(entries=COMMANDS, name="autotune")
    with _silence(), contextlib.suppress(AutotuneError):
        group.main([*arguments, "--quiet"], standalone_mode=False)


def _write_logs(bag: Path, rosbag2: Path, table: Path) -> None:
    from autotune.simulation.phases import Program
    from autotune.simulation.simulate import simulate_cell
    from autotune.simulation.truth import SimulatedCell
    from autotune.simulation.write_bags import write_csv, write_ros1_bag, write_rosbag2

    program = Program(pose_count=1, sweep_s=0.0, jogging_s=0.0, contact_count=1)
    recording = simulate_cell(SimulatedCell(), program, seed=0).recording
    for path, write in ((bag, write_ros1_bag), (rosbag2, write_rosbag2), (table, write_csv)):
        write(recording, path, rows=_ROWS)


def _coloured_noise(identified: Path) -> None:
    """Evaluate a design under noise that is not white, as that of the demo's sensor is."""
    import numpy as np

    from autotune.formats.identified import read_identified
    from autotune.formats.problem import ProblemSpec
    from autotune.tuning.problems import build_problems
    from problems.design.batch_evaluation import build_batch_evaluator
    from problems.design.evaluation import build_scenarios
    from problems.design.problem import NoiseLimit, Requirements
    from problems.stability.noise_spectrum import RelativeSpectrum

    spectrum = RelativeSpectrum(frequency_hz=(1.0, 100.0), relative_density=(2.0, 1.0))
    limit = NoiseLimit(max_speed_rms_m_s=1.0, force_noise_rms_n=1.0, noise_spectrum=spectrum)
    spec = ProblemSpec(requirements=Requirements(command_noise=limit))
    for problem in build_problems(read_identified(identified).result, spec).values():
        low, high = np.array([problem.bounds[name] for name in problem.variables]).T
        scenarios = build_scenarios(problem, problem.scenarios(2, 2))
        build_batch_evaluator(scenarios).evaluate(low + 0.2 * (high - low)[None], margins_if_missed=True)


def _predict(identified: str, controller: str) -> None:
    """Predict a contact with a deadband and one without."""
    for gains in (("--controller", controller), ("--gains", "mass=13,damping=1000")):
        _run("predict", identified, *gains, "--surface", "40N/mm", "--approach", "force=30")


def _map(controller: str, folder: Path, axes: tuple[str, ...]) -> None:
    """Draw one map of each kind: stability, a margin, a peak, and stable gains."""
    for show in ("stability", "modulus", "phase", "peak-contact"):
        _run("map", controller, *axes, "--show", show, "-o", str(folder / f"{show}.svg"))
    _run("map", controller, "--show", "stable-damping", "-o", str(folder / "stable.svg"))


def _explore(identified: Path, controller: Path) -> None:
    """Build the page from both kinds of file, as it is when it is opened."""
    if importlib.util.find_spec("bokeh") is None:
        return  # without the extra "reports" there is no page, and nothing to compile for it
    from bokeh.document import Document

    from autotune.explore.page import build_page
    from autotune.explore.saving import Target
    from autotune.explore.source import read_exploration

    with _silence(), contextlib.suppress(AutotuneError):
        for source in (identified, controller):
            build_page(read_exploration(source), Target(source.with_name("tried.yaml")), Document())


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        yield
