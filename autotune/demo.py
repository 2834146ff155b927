"""The whole chain on a simulated cell, beside the truth that only a simulation knows."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from autotune.errors import UsageError
from autotune.export.export import export_controller
from autotune.formats.atomic import write_atomic
from autotune.formats.canonical import dump_yaml, short
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.identified import read_identified, write_identified
from autotune.formats.problem import ProblemSpec
from autotune.formats.yaml12 import load_yaml
from autotune.pipeline import identify_log
from autotune.prediction.contact import Law
from autotune.prediction.law import PresentGains
from autotune.results import Identification
from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from autotune.simulation.write import write_mcap
from autotune.tuning.optimize import Optimized, optimize
from autotune.validation.report import ValidationReport
from autotune.validation.validate import validate_controller
from identification.result import Estimate
from problems.contact.nonlinearities import Deadband, DeadbandType
from problems.frozen import FrozenDict
from problems.progress import Progress, no_progress

LIST = "demo.yaml"
FORMAT = "autotune/demo"
_CHUNK = 2**20


class MadeHere:
    """What a demo made in `folder`, by name and sha256, kept there as `demo.yaml`; `replaced` were there before.

    Raises UsageError where one of `names` is that of a file that is not on that list, or was changed since.
    """

    def __init__(self, folder: Path, names: Sequence[str]) -> None:
        self.path = folder / LIST
        self._digests = self._former()
        existing = [folder / name for name in names if (folder / name).exists()]
        for path in existing:
            if not path.is_file() or self._digests.get(path.name) != _digest(path):
                raise UsageError(
                    f"{path} exists and is not what a demo made there, so it is not replaced; name another folder."
                )
        self.replaced = tuple(f"{path} (sha256 {short(self._digests[path.name])})" for path in existing)

    def add(self, path: Path) -> None:
        """Note a file that was just written; raises as `write_atomic`."""
        self._digests[path.name] = _digest(path)
        write_atomic(self.path, dump_yaml({"format": FORMAT, "version": 1, "made": dict(self._digests)}))

    def _former(self) -> dict[str, str]:
        if not self.path.exists():
            return {}
        tree = load_yaml(self.path, error=UsageError)
        made = tree.get("made")
        if tree.get("format") != FORMAT or not isinstance(made, dict):
            raise UsageError(
                f"{self.path} exists and is no list of a demo, so it is not replaced; name another folder."
            )
        return {str(name): str(digest) for name, digest in made.items()}


def _digest(path: Path) -> str:
    found = sha256()
    with path.open("rb") as stream:
        while part := stream.read(_CHUNK):
            found.update(part)
    return found.hexdigest()


CELLS: Mapping[str, tuple[Callable[[], SimulatedCell], ProblemSpec]] = FrozenDict(
    {
        "standard": (SimulatedCell, ProblemSpec()),
        "low-drag": (
            SimulatedCell.low_drag,
            ProblemSpec(payload_mass=(12.0, 20.0), environment_stiffness=(2e4, 5e5)),
        ),
    }
)
"""The cells of the demo by name, and what is asked of the controller of each."""
STEPS = (
    "simulating a cell",
    "writing its log",
    "identifying",
    "optimizing and proving",
    "validating the file",
    "exporting",
)
PAGE = "report.html"
"""The page of the command line, beside the files of `DemoFiles`."""
# Of the time, measured; only for the progress bar.
_SHARES = (0.02, 0.25, 0.12, 0.37, 0.24, 0.0)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """One parameter: what was identified beside what is true; both in `unit`."""

    name: str
    unit: str
    truth: float
    estimate: Estimate
    scale: float = 1.0

    @property
    def error_share(self) -> float | None:
        """(identified − truth)/truth."""
        value = self.estimate.value
        return None if value is None else value / self.truth - 1.0


@dataclass(frozen=True, kw_only=True)
class DemoFiles:
    """Where everything lies."""

    log: Path
    identified: Path
    controller: Path
    twin: Path

    @classmethod
    def inside(cls, directory: Path) -> "DemoFiles":
        """Return where everything lies in a folder."""
        return cls(
            log=directory / "cell.mcap",
            identified=directory / "identified.yaml",
            controller=directory / "controller.yaml",
            twin=directory / "controller.json",
        )


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """What the chain found, step by step; `identified` has the signals of the log, for pictures."""

    identified: Identification
    comparisons: tuple[Comparison, ...]
    optimized: Optimized
    report: ValidationReport
    checksum: str
    files: DemoFiles
    made: MadeHere


def run_demo(
    directory: Path,
    *,
    cell: str = "standard",
    seed: int = 0,
    step: Callable[[str], None] | None = None,
    progress: Progress | None = None,
) -> DemoResult:
    """Simulate a cell of `CELLS`, then identify, optimize, validate and export, through the files of a real run.

    `step` receives the name of each step as it begins, `progress` the share of the work done since the last call.
    Files of an earlier demo in the same folder are replaced. Raises UsageError where one of these names is that of
    anything else: a file of another origin, or one that was changed since (`autotune.demo`).
    """
    begin, report = step or no_progress, progress or no_progress
    directory.mkdir(parents=True, exist_ok=True)
    files = DemoFiles.inside(directory)
    made = MadeHere(directory, [each.name for each in (*vars(files).values(), directory / PAGE)])
    begin(STEPS[0])
    build, spec = CELLS[cell]
    simulated = build()
    run = simulate_cell(simulated, Program(), seed=seed)
    report(_SHARES[0])
    begin(STEPS[1])
    logged = (run.recording.wrench, run.recording.pose, run.recording.command)
    each = _SHARES[1] / sum(len(signal.stamp_ns) for signal in logged if signal is not None)
    write_mcap(run.recording, files.log, progress=lambda count: report(each * count))
    made.add(files.log)
    begin(STEPS[2])
    found = identify_log(files.log, progress=lambda share: report(_SHARES[2] * share), with_evidence=True)
    write_identified(files.identified, found.result, found.provenance)
    made.add(files.identified)
    begin(STEPS[3])
    optimized = optimize(
        read_identified(files.identified),
        spec,
        seed=seed,
        present=_present(simulated),
        progress=lambda share: report(_SHARES[3] * share),
    )
    write_controller(files.controller, optimized.controller)
    made.add(files.controller)
    begin(STEPS[4])
    read = read_controller(files.controller)
    checked = validate_controller(read.controller, lambda share: report(_SHARES[4] * share))
    checked.require()
    begin(STEPS[5])
    export_controller(files.controller, "json", files.twin)
    made.add(files.twin)
    return DemoResult(
        identified=found,
        comparisons=compare(simulated, found),
        optimized=optimized,
        report=checked,
        checksum=read.checksum,
        files=files,
        made=made,
    )


def _present(cell: SimulatedCell) -> PresentGains:
    """Return the gains with which the log of a simulated cell was recorded."""
    law = Law(controller=cell.controller, deadband=Deadband(width_n=cell.deadband_n, kind=DeadbandType.THRESHOLD))
    return PresentGains(laws={cell.approach_axis: law}, label="the gains of the simulated cell")


def compare(cell: SimulatedCell, found: Identification) -> tuple[Comparison, ...]:
    """Put the identified parameters of the approach axis beside the truth."""
    axis = found.result.axes[cell.approach_axis]
    rows = [
        Comparison(
            name="payload mass M_p", unit="kg", truth=cell.payload_mass_kg, estimate=found.result.payload.mass_kg
        ),
        Comparison(
            name="coupling stiffness K_s",
            unit="N/mm",
            truth=cell.coupling.stiffness_n_per_m,
            estimate=axis.coupling.stiffness_n_per_m,
            scale=1e-3,
        ),
        Comparison(
            name="coupling damping B_s",
            unit="N·s/m",
            truth=cell.coupling.damping_n_s_per_m,
            estimate=axis.coupling.damping_n_s_per_m,
        ),
        Comparison(name="payload drag B_p", unit="N·s/m", truth=cell.drag_n_s_per_m, estimate=axis.drag_n_s_per_m),
        Comparison(
            name="robot delay T_d",
            unit="samples",
            truth=cell.robot.delay_s,
            estimate=axis.robot.delay_s,
            scale=1.0 / cell.sample_time_s,
        ),
    ]
    rows += [
        Comparison(
            name="environment stiffness K_e",
            unit="N/mm",
            truth=cell.environment.stiffness_n_per_m,
            estimate=surface.stiffness_n_per_m,
            scale=1e-3,
        )
        for surface in axis.environments
    ]
    return tuple(rows)
