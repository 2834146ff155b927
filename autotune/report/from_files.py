"""Reports from files that are already written: what each is, which belong together, and a page for all."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from autotune.errors import CertificateError, UsageError
from autotune.formats.cell import CellFile, read_cell
from autotune.formats.controller import ControllerFile, read_controller
from autotune.formats.controller_record import Controller
from autotune.formats.identified import IdentifiedFile, read_identified
from autotune.formats.kinds import unknown_file
from autotune.formats.schedule import read_schedule
from autotune.formats.schema import check_document, check_format
from autotune.formats.yaml12 import kind_of_file, load_document
from autotune.pipeline import IdentifyOptions, identify_log
from autotune.prediction.before_after import compare_before_after
from autotune.prediction.law import PresentGains, law_of_gains
from autotune.prediction.said_gains import present_gains
from autotune.processes import count_processors
from autotune.validation.report import ValidationReport
from autotune.validation.verify import verify
from autotune.windows import windows_of
from identification.errors import LogError
from identification.evidence import Evidence
from identification.logs.containers.formats import digests, sha256_of
from identification.logs.summary import LogSummary
from problems.progress import Progress, no_progress

from .identify_page import build_identify_page, summaries_of
from .optimize_page import build_front_page, build_optimize_page
from .page import Page, join_pages
from .refused_page import refused_controller_page
from .schedule_page import build_schedule_page
from .validate_page import Validated, lead, simulated_section, verdict_section

_SHOWN = ("identified", "controller", "pareto", "schedule")
_LOG = "log"


@dataclass(frozen=True, kw_only=True)
class FilesReport:
    """A page of several files; `kinds` is the kind of each by path, `reports` what was verified of the controllers.

    `refusals` are the errors of files that were altered, each of which has its part of the page.
    """

    page: Page
    kinds: Mapping[str, str]
    reports: tuple[ValidationReport, ...]
    refusals: tuple[CertificateError, ...] = ()

    def require(self) -> None:
        """Raise CertificateError where a file is altered, or a claim does not hold."""
        for refusal in self.refusals:
            raise refusal
        for report in self.reports:
            report.require()


def file_kind(path: Path) -> str:
    """Return what a file says it is (identified, controller, …), "log" for anything that is none of the tool's own.

    Raises UsageError: the file cannot be read.
    """
    return _LOG if path.is_dir() else kind_of_file(path) or _LOG


def report_files(
    paths: Sequence[Path], *, old: Path | str | None = None, samples: int = 0, progress: Progress | None = None
) -> FilesReport:
    """Build one page of the files, a part for each but the logs, which go with what was identified from them.

    A controller is verified again, with `samples` simulated contacts; `old` says what is drawn beside it: gains, those
    in the log, a controller or a cell.yaml. `progress` receives the share of the work done since the last call. An
    altered one of `paths` has its refusal as its part of the page. Raises UsageError for a file that cannot be shown,
    LogError for a log that is not the one that was identified, CertificateError for an altered `old`.
    """
    kinds = {str(path): file_kind(path) for path in paths}
    shown = [path for path in paths if kinds[str(path)] != _LOG]
    logs = [path for path in paths if kinds[str(path)] == _LOG]
    for path in shown:
        if kinds[str(path)] not in _SHOWN:
            must = f"{', '.join(_SHOWN[:-1])} and {_SHOWN[-1]} files and logs have a report"
            raise UsageError(f"{path} is of the format autotune/{kinds[str(path)]}; {must}.")
    plants = {path: read_identified(path) for path in shown if kinds[str(path)] == "identified"}
    given = _match(logs, plants)
    # Read before the loop, in which an altered file is one of `paths`.
    said = read_controller(old) if isinstance(old, Path) and kind_of_file(old) == "controller" else old
    report = progress or no_progress
    pages, reports, part = list[tuple[str, Page]](), list[ValidationReport](), 1.0 / max(len(shown), 1)
    refusals: list[CertificateError] = []
    for path in shown:
        kind = kinds[str(path)]
        try:
            if kind == "identified":
                page = _identified_page(plants[path], given[path])
            elif kind == "controller":
                read = read_controller(path)
                digest = read.controller.provenance.get("identified", {}).get("sha256")
                source = next((each for each in plants.values() if each.sha256 == digest), None)
                before = None if said is None else present_gains(said, source, tuple(read.controller.axes))
                page, verified = _controller_page(read, before, source, samples, lambda done: report(part * done))
                reports.append(verified)
            else:
                page = _table_page(path, kind)
        except CertificateError as refusal:
            page = refused_controller_page(refusal, path)
            refusals.append(refusal)
        pages.append((path.name, page))
        if kind != "controller":
            report(part)
    if not pages:
        raise unknown_file(
            paths[0],
            f"{paths[0]} is no file that autotune wrote; if it is a log, give the identified.yaml that came from it.",
        )
    return FilesReport(page=join_pages("Report", pages), kinds=kinds, reports=tuple(reports), refusals=tuple(refusals))


def _table_page(path: Path, kind: str) -> Page:
    if kind == "schedule":
        return build_schedule_page(read_schedule(path))
    document = load_document(path, error=UsageError)
    check_format(document, kind)
    check_document(document, kind)
    return build_front_page(document.tree)


def _match(logs: Sequence[Path], plants: Mapping[Path, IdentifiedFile]) -> dict[Path, tuple[Path, ...]]:
    """Return for each identified file its logs in their order; none where none was given.

    Raises LogError for a log that belongs to none, and where some of the logs of a file are given and others are not.
    """
    found = {digest: Path(path) for path, digest in digests(logs).items()} if logs else {}
    given: dict[Path, tuple[Path, ...]] = {}
    used: set[str] = set()
    for path, plant in plants.items():
        named = {str(log["sha256"]): str(log["path"]) for log in plant.provenance.get("logs", ())}
        here = [digest for digest in named if digest in found]
        if here and len(here) < len(named):
            missing = ", ".join(name for digest, name in named.items() if digest not in found)
            raise LogError(f"{path} was identified from {len(named)} logs; give {missing} too, or none of them.")
        given[path] = tuple(found[digest] for digest in here)
        used |= set(here)
    for digest, log in found.items():
        if plants and digest not in used:
            names = ", ".join(str(path) for path in plants)
            raise LogError(f"{log} is not a log that {names} was identified from: its SHA-256 is {digest[:12]}….")
    return given


def _identified_page(plant: IdentifiedFile, logs: tuple[Path, ...]) -> Page:
    evidence: tuple[Evidence, ...] = ()
    summaries: tuple[LogSummary, ...] = ()
    if logs:
        _check_urdf(plant)
        options = IdentifyOptions.from_tree(plant.provenance.get("options", {}), _cell_of(plant))
        options = replace(options, allow_partial=True)
        if not windows_of(plant.provenance):  # of which no signals are kept
            evidence = identify_log(logs, options, processes=count_processors(), with_evidence=True).evidence
        summaries = summaries_of(logs, options, evidence)
    return build_identify_page(plant.result, plant.provenance, evidence, summaries)


def _check_urdf(plant: IdentifiedFile) -> None:
    """Raise LogError where the URDF that was used is not the same any more."""
    said: Mapping[str, Any] | None = plant.provenance.get("urdf")
    if said is not None and sha256_of(Path(said["path"])) != said["sha256"]:
        raise LogError(f"{said['path']} is not the URDF that {plant.path} was identified with: it was changed.")


def _cell_of(plant: IdentifiedFile) -> CellFile | None:
    """Return the cell.yaml that was used; raises LogError where it is not the same any more."""
    said: Mapping[str, Any] | None = plant.provenance.get("cell")
    if said is None:
        return None
    found = read_cell(Path(said["path"]))
    if found.sha256 != said["sha256"]:
        raise LogError(f"{said['path']} is not the cell file that {plant.path} was identified with: it was changed.")
    return found


def _controller_page(
    file: ControllerFile, old: PresentGains | None, plant: IdentifiedFile | None, samples: int, report: Progress
) -> tuple[Page, ValidationReport]:
    """Return what `optimize` and `validate` would show, from the file alone, or with the plant that it is from."""
    part = 0.5 if samples else 1.0

    def advance(done: float) -> None:
        report(part * done)

    verified = verify(file.controller, samples=samples, progress=advance)
    checks = ValidationReport(checks=verified.checks)
    validated = Validated(report=checks, simulated=verified.simulated)
    if not checks.passed:
        # Of a loop that may be unstable there are no peaks and margins to draw.
        sections = (verdict_section(file.checksum, validated),)
        title = "A controller that does not keep what it promises"
        return Page(title=title, lead=lead(validated), tone="bad", sections=sections), checks
    present = _gains_before(file.controller) if old is None else old
    replayed = {} if plant is None else compare_before_after(plant, file.controller, present=present)
    page = build_optimize_page(file.controller, file.checksum, old=old, before_after=replayed)
    first, *others = page.sections
    shown = [each for each in others if not each.is_folded]
    folded = [each for each in others if each.is_folded]
    parts = (first, verdict_section("", validated), *shown, *simulated_section(validated), *folded)
    return replace(page, lead=f"{lead(validated)} {page.lead}", sections=parts), checks


def _gains_before(controller: Controller) -> PresentGains | None:
    """Return the gains in numbers that a controller was compared with when it was made, None where there were none."""
    said = controller.provenance.get("options", {}).get("compare") or {}
    if "gains" not in said:
        return None
    return PresentGains(laws={axis: law_of_gains(each) for axis, each in said["gains"].items()}, label=said["from"])
