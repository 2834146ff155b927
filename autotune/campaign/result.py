"""A campaign from Python: many logs of many cells, by this machine's processes or any executor, and what came of it."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from warnings import warn

from autotune.arguments import count, errors_in_arguments, file_path, truth
from autotune.drift import Change, change_text
from autotune.errors import UsageError
from autotune.processes import count_processors
from autotune.shown import Progress, ResultTable, Shown, data_frame, plain_tree, reporting
from problems.errors import shown
from problems.progress import no_progress

from .dask_pool import dask_executor
from .fleet import Unusual, changes, unusual
from .manifest import read_manifest
from .options import RunOptions
from .run import work_on_runs
from .tables import campaign_rows, check_tables, write_tables
from .text import outcome_text, unusual_text
from .work import RunOutcome

_CHECKSUMS = 0.02  # their share of the work


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Campaign(Shown):
    """What came of every run of a campaign.

    Attributes
    ----------
    folder
        Where each run's files and the tables are.
    outcomes
        The runs in their order: `cell`, `run`, `values` (value and deviation in SI by name), `peaks_n`, `refused` and
        `reason`, `outside`.

    """

    folder: Path
    outcomes: tuple[RunOutcome, ...]

    @property
    def changes(self) -> tuple[Change, ...]:
        """What changed in a cell from one run to the next."""
        return changes(self.outcomes)

    @property
    def unusual(self) -> tuple[Unusual, ...]:
        """What is unlike the other cells."""
        return unusual(self.outcomes)

    def _headline(self) -> str:
        return f"Campaign in {self.folder}: {outcome_text(self.outcomes)}"

    def _tables(self) -> Iterator[ResultTable]:
        rows = tuple((each.cell, each.run, each.refused or "good", each.reason) for each in self.outcomes)
        yield ResultTable(title="runs", columns=("cell", "run", "outcome", "why"), rows=rows)

    def _notes(self) -> Sequence[str]:
        return [*map(change_text, self.changes), *map(unusual_text, self.unusual)]

    def to_dict(self) -> dict[str, Any]:
        """Return folder, runs, changes and what is unusual as plain data."""
        tree = {"folder": self.folder, "runs": self.outcomes, "changes": self.changes, "unusual": self.unusual}
        return {name: plain_tree(each) for name, each in tree.items()}

    def to_pandas(self) -> Any:
        """Return `campaign.csv` as a pandas.DataFrame; raises UsageError where pandas is not installed."""
        columns, rows = campaign_rows(self.outcomes)
        return data_frame({name: [row[i] for row in rows] for i, name in enumerate(columns)})


@errors_in_arguments()
def run_campaign(
    manifest: str | Path,
    folder: str | Path,
    *,
    optimize: bool = True,
    seed: int = 0,
    allow_partial: bool = False,
    salvage: bool = False,
    jobs: int | None = None,
    executor: Executor | None = None,
    scheduler: str | None = None,
    storage: str | None = None,
    progress: Progress = None,
) -> Campaign:
    """Identify many logs of many cells, search their controllers, and compare the cells; what is there is not redone.

    Parameters
    ----------
    manifest
        A folder (a folder for each cell, its logs the runs), or a CSV or YAML file, as of `autotune campaign`. Of logs
        in deeper folders it is warned.
    folder
        Where the results are, and go on.
    optimize
        Search a controller for every run.
    seed
        Of the searches.
    allow_partial, salvage
        As of `identify`, for every run.
    jobs
        How many processes, or tasks at a time; the processors of this machine unless it is said. A script guards its
        own start (`if __name__ == "__main__"`).
    executor
        Any executor of `concurrent.futures` whose workers see the same files.
    scheduler
        "dask" for a cluster on this machine, or the address of one, as in tcp://head:8786 (extra `dask`).
    storage
        URL of the database that keeps the state, by which several hosts share the runs, as in
        postgresql+psycopg://autotune@db/plant (extra `postgresql`); `campaign.sqlite` in the folder unless it is said.
    progress
        True for a bar, or a callable that takes the share of the work done since its last call.

    Returns
    -------
    Campaign
        Outcomes, changes from run to run, and cells unlike the others.

    Raises
    ------
    UsageError
        An argument is none, the manifest names what cannot be read, a result cannot be written or would replace what
        no campaign has written, or the state cannot be kept.

    """
    path, target, seed = file_path("manifest", manifest), file_path("folder", folder), count("seed", seed)
    jobs = count_processors() if jobs is None else count("jobs", jobs, least=1)
    options = RunOptions(
        optimize=truth("optimize", optimize),
        seed=seed,
        allow_partial=truth("allow_partial", allow_partial),
        salvage=truth("salvage", salvage),
    )
    if not isinstance(executor, Executor | None):
        raise UsageError(f"executor must be one of concurrent.futures, found {shown(executor)}.")
    runs = read_manifest(path, note=partial(warn, stacklevel=4))
    check_tables(target)
    with ExitStack() as stack:
        if scheduler is not None:
            executor, _ = stack.enter_context(dask_executor(scheduler, jobs))
        report = stack.enter_context(reporting(progress, "campaign")) or no_progress
        weights = {"checksums": _CHECKSUMS, "campaign": 1.0 - _CHECKSUMS}
        outcomes = work_on_runs(
            runs,
            target,
            options,
            jobs=jobs,
            executor=executor,
            storage=storage,
            progress=lambda what, total: nullcontext(lambda *_: report(weights[what] / total)),
        )
    write_tables(target, outcomes)
    return Campaign(folder=target, outcomes=outcomes)
