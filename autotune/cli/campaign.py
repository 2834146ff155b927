"""`autotune campaign`: many logs of many cells."""

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._common import Output, output_options
from ._options import SETTINGS, FilePath, GroupedCommand, salvage_option
from ._report import check_report, print_report_path, report_option, write_report
from ._terminal import print_message

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from concurrent.futures import Executor

    from autotune.campaign.manifest import LoggedRun
    from autotune.campaign.options import RunOptions
    from autotune.campaign.work import RunOutcome

_LONGEST_WAIT_S = 7.0 * 86400.0
_EPILOG = """\b
Examples:
  autotune campaign logs/ -o fleet --report fleet.html
  autotune campaign manifest.csv -o fleet --jobs 8
  autotune campaign manifest.yaml -o fleet --scheduler tcp://head:8786 --jobs 40
  autotune campaign logs/ -o fleet --storage postgresql+psycopg://autotune@db/plant
"""


def _finite(ctx: click.Context, param: click.Parameter, value: float | None) -> float | None:
    """Refuse NaN, infinity, and what no clock waits for."""
    if value is not None and not 1.0 <= value <= _LONGEST_WAIT_S:
        raise click.BadParameter(f"{value:g} must be 1 to {_LONGEST_WAIT_S:g} seconds.", ctx, param)
    return value


@click.command("campaign", cls=GroupedCommand, epilog=_EPILOG)
@click.argument("manifest", type=FilePath(*SETTINGS, ".csv", dir_okay=True))
@click.option(
    "-o",
    "--out",
    "out",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("autotune-campaign"),
    show_default=True,
    metavar="DIR",
    help="Folder of the results.",
)
@click.option("--jobs", type=click.IntRange(1), help="Runs at a time.  [default: the processors of this machine]")
@click.option(
    "--scheduler",
    metavar="dask|tcp://...",
    help="Work on a Dask cluster: one of this machine, or a running one that sees the same files.",
)
@click.option(
    "--storage",
    metavar="URL",
    help="Where the state of the runs is, by which several hosts share them: sqlite:///FILE or "
    "postgresql+psycopg://...  [default: campaign.sqlite in DIR]",
)
@click.option("--optimize/--no-optimize", default=True, show_default=True, help="Search a controller for each run.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Seed of the searches.")
@click.option(
    "--allow-partial", is_flag=True, help="Keep runs of which a parameter is unidentifiable, or logs disagree."
)
@salvage_option
@click.option(
    "--watch",
    type=click.FloatRange(min=1.0),
    callback=_finite,
    metavar="S",
    help="Look for new runs every S seconds until interrupted; a log that has changed meanwhile waits.",
)
@report_option
@output_options
def command(
    output: Output,
    manifest: Path,
    out: Path,
    jobs: int | None,
    scheduler: str | None,
    storage: str | None,
    optimize: bool,
    seed: int,
    allow_partial: bool,
    salvage: bool,
    watch: float | None,
    report: Path | None,
) -> None:
    """Identify every run that MANIFEST names, search its controller, and compare the cells.

    MANIFEST is a folder (a folder for each cell, its logs the runs), a CSV with the columns cell and log, or a YAML
    file. What is done already is not done again: a run is known by the SHA-256 of its files, the options and the
    version. DIR then holds each run's files, campaign.csv and, with pyarrow, campaign.parquet. A run that is refused
    is a result with its reason. The same command on several hosts, with one --storage, shares the runs. Exit code 4:
    no run was identified. 6: a controller that the manifest names is no longer certified for what its cell's newest
    run shows.
    """
    from autotune.campaign.options import RunOptions
    from autotune.campaign.text import outcome_text
    from autotune.processes import count_processors

    check_report(report, [manifest] if manifest.is_file() else [])
    options = RunOptions(optimize=optimize, seed=seed, allow_partial=allow_partial, salvage=salvage)
    count = jobs or count_processors()
    with ExitStack() as stack:
        executor = None
        if scheduler is not None:
            from autotune.campaign.dask_pool import dask_executor

            executor, dashboard = stack.enter_context(dask_executor(scheduler, count))
            output.note(f"dashboard: {dashboard}")
        outcomes: tuple[RunOutcome, ...] = ()
        for look, runs in enumerate(_looks(output, manifest, watch)):
            before = outcomes
            outcomes = _once(output, runs, out, options, count, executor, storage, is_another_look=look > 0)
            tree = _tree(output, out, outcomes, report)
            if watch is not None and (outcomes != before or not look):
                _note_new(output, outcomes, before)
                output.note(f"{outcome_text(outcomes)} Looking again every {watch:g} s (Ctrl-C ends it).")
    output.result(tree, lambda: _print(out, outcomes, report))
    _require(outcomes)
    if report is None:
        said = [] if optimize else ["--no-optimize"]
        said += ["--seed", str(seed)] if seed else []
        said += ["--allow-partial"] if allow_partial else []
        said += ["--salvage"] if salvage else []
        said += ["--storage", storage] if storage is not None else []
        output.next_command("campaign", manifest, "-o", out, *said, "--report", "campaign.html")


def _looks(output: Output, manifest: Path, watch: float | None) -> "Iterator[tuple[LoggedRun, ...]]":
    """Yield the runs of a manifest, with `watch` again after so many seconds, and then of logs that rest only.

    A mistake in a file then ends no look.
    """
    from autotune.campaign.manifest import LogWatch, read_manifest
    from autotune.campaign.text import runs_by_text
    from autotune.errors import UsageError

    noted: set[str] = set()

    def note(text: str) -> None:
        if text not in noted:
            noted.add(text)
            output.note(f"warning: {text}")

    runs = read_manifest(manifest, may_be_empty=watch is not None, note=note)
    if watch is None:
        yield runs
        return
    looks, mistake = LogWatch(watch), ""

    def rested() -> "tuple[LoggedRun, ...]":
        found, waiting = looks.look(runs)
        why = f"a log that has changed within {looks.rest_s:g} s may still grow"
        for names in runs_by_text((name, why) for name in waiting).values():
            output.note(f"Waits for {names}: {why}.")
        return found

    yield rested()
    while True:
        time.sleep(watch)
        try:
            runs = read_manifest(manifest, may_be_empty=True, note=note)
        except UsageError as error:
            if str(error) != mistake:
                mistake = str(error)
                output.note(f"{mistake} Nothing is done until it is mended.")
        else:
            if mistake:
                output.note("Mended: the campaign goes on.")
            mistake = ""
            yield rested()


def _once(
    output: Output,
    runs: "Sequence[LoggedRun]",
    out: Path,
    options: "RunOptions",
    jobs: int,
    executor: "Executor | None",
    storage: str | None,
    *,
    is_another_look: bool,
) -> "tuple[RunOutcome, ...]":
    """Work on what is missing, and write the tables of all."""
    from autotune.campaign.run import work_on_runs
    from autotune.campaign.tables import check_tables, write_tables

    check_tables(out)
    outcomes = work_on_runs(
        runs,
        out,
        options,
        jobs=jobs,
        executor=executor,
        storage=storage,
        progress=output.progress,
        note=output.note,
        is_another_look=is_another_look,
    )
    write_tables(out, outcomes)
    return outcomes


def _tree(output: Output, out: Path, outcomes: "Sequence[RunOutcome]", report: Path | None) -> dict[str, Any]:
    """Return the object of `--json`, after the page is written."""
    from autotune.campaign.fleet import changes, unusual
    from autotune.report.campaign_page import build_campaign_page
    from autotune.shown import plain_tree
    from autotune.version import __version__

    page = write_report(output, report, lambda: build_campaign_page(outcomes, f"autotune {__version__}"))
    tree = {"folder": out, "runs": outcomes, "changes": changes(outcomes), "unusual": unusual(outcomes)}
    return {**{key: plain_tree(value) for key, value in tree.items()}, **page}


def _note_new(output: Output, outcomes: "Sequence[RunOutcome]", before: "Sequence[RunOutcome]") -> None:
    """Say what is wrong with the runs that were not there, or other, when it was looked before."""
    for verdict, what in _faults([each for each in outcomes if each not in before]):
        output.note(f"{verdict}{what}")


def _faults(found: "Iterable[RunOutcome]") -> "Iterator[tuple[str, str]]":
    """Yield what is wrong with runs, as verdict and sentence; what is wrong with several alike once."""
    from autotune.campaign.text import runs_by_text

    said = ((each.name, fault) for each in found for fault in _faults_of(each))
    for (verdict, what), names in runs_by_text(said).items():
        yield verdict, f"{names}: {what}"


def _faults_of(found: "RunOutcome") -> "Iterator[tuple[str, str]]":
    if found.refused:
        yield f"refused ({found.refused}): ", found.reason
    if found.damage:
        yield "warning: ", found.damage
    for what in found.outside or ():
        yield "error: ", f"the certificate does not hold: {what}."


def _print(out: Path, outcomes: "Sequence[RunOutcome]", report: Path | None) -> None:
    from autotune.campaign.fleet import changes, unusual
    from autotune.campaign.text import outcome_text, unusual_text
    from autotune.drift import change_text

    print_message(outcome_text(outcomes))
    for verdict, what in _faults(outcomes):
        print_message(what, verdict=verdict)
    for line in (*map(change_text, changes(outcomes)), *map(unusual_text, unusual(outcomes))):
        print_message(line, verdict="note: ")
    print_message(f"written: {out / 'campaign.csv'} and a folder for each run that was identified in {out / 'cells'}")
    print_report_path(report)


def _require(outcomes: "Sequence[RunOutcome]") -> None:
    """Raise what decides the exit code: a certificate of a newest run that does not hold, or nothing identified."""
    from autotune.campaign.fleet import by_cell
    from autotune.errors import CertificateError
    from identification.errors import EstimateError

    cells = by_cell(outcomes)
    broken = [cell for cell, runs in cells.items() if runs[-1].outside]
    # Of a refused run it is the file of the controller that certifies nothing.
    broken = [*dict.fromkeys((*broken, *(each.cell for each in outcomes if each.refused and each.outside)))]
    if broken:
        raise CertificateError(
            f"The controllers of {', '.join(broken)} are not certified for what the newest run of their cell shows, "
            "for the reasons above; optimize them again (a campaign that optimizes has done so: controller.yaml in "
            "the run's folder)."
        )
    if not cells:
        raise EstimateError(f"None of {len(outcomes)} runs was identified; the reasons are above.")
