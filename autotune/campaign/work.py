"""What is done with one run: identify, and tune; its files are a folder that appears whole."""

import json
import shutil
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotune.drift import CLOCK, bias_values, identified_values
from autotune.errors import CertificateError, InfeasibleError, UsageError
from autotune.formats.atomic import write_folder_atomic
from autotune.formats.cell import read_cell
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller import controller_tree, read_controller
from autotune.formats.identified import identified_tree, parse_identified, read_identified
from autotune.formats.kinds import kind_of
from autotune.formats.problem import ProblemSpec, read_problem
from autotune.formats.units import axis_units
from autotune.formats.yaml12 import dump_yaml
from autotune.pipeline import identify_log
from autotune.results import Identification
from autotune.text import speed_text
from autotune.version import __version__
from identification.errors import EstimateError, LogError
from identification.logs.containers.formats import sha256_of
from identification.result import Identified
from problems.errors import AutotuneError
from problems.model.axis_kind import AxisKind

from .manifest import CELLS, LoggedRun
from .options import RunOptions

if TYPE_CHECKING:
    from autotune.prediction.result import PredictedContact

_IDENTIFIED = "identified.yaml"
_WRITTEN = frozenset({_IDENTIFIED, "controller.yaml"})
_STEPS = {LogError: "log", EstimateError: "estimate", InfeasibleError: "requirements", CertificateError: "certificate"}


@dataclass(frozen=True, kw_only=True)
class RunOutcome:
    """What came of a run.

    `values` are value and standard deviation in SI of what is identified, by name; `recorded_s` is the stamp of the
    first sample. `peaks_n` are, by axis, the worst predicted peak with the gains of the log (None where they are not
    known) and with the new controller. `refused` says which kind of refusal ended it, "" for none, `reason` why.
    `outside` is what of the plant lies outside of what the controller in the manifest is certified for; None without.
    `damage` says what of the logs is damaged and was left out. `log_peaks_n` are, by axis, the largest peak that a log
    shows on its hardest surface, and the one predicted with the new controller at the same speed, at the sensor.
    `peaks_at` and `log_peaks_at` say on which surfaces, and with which approach or speed, those are.
    `files` are the names of what was written in the run's folder, with the SHA-256 of each. `own_key` is the key of all
    but `outside`: without the controller in the manifest. `identified_key` is that of what was identified alone.
    """

    cell: str
    run: str
    key: str
    recorded_s: float | None = None
    values: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    peaks_n: Mapping[str, tuple[float | None, float]] = field(default_factory=dict)
    refused: str = ""
    reason: str = ""
    outside: tuple[str, ...] | None = None
    damage: str = ""
    log_peaks_n: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    own_key: str = ""
    identified_key: str = ""
    peaks_at: Mapping[str, str] = field(default_factory=dict)
    log_peaks_at: Mapping[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Cell and run, as in messages and as the folder of the results."""
        return f"{self.cell}/{self.run}"

    def text(self) -> str:
        """Return the outcome as JSON."""
        return json.dumps(asdict(self), allow_nan=False)

    def has_files(self, folder: Path, *names: str) -> bool:
        """Return whether the folder of the run holds what was written there, or these files of it, to the byte."""
        try:
            return all(sha256_of(folder / name) == self.files.get(name) for name in names or self.files)
        except LogError:
            return False

    def has_identified(self, task: "RunTask") -> bool:
        """Return whether what it has identified is what the task would, and still in the folder."""
        return self.identified_key == task.identified_key and self.has_files(task.folder, _IDENTIFIED)


@dataclass(frozen=True, kw_only=True)
class RunTask:
    """A run, where its results belong, and the key of all that they follow from.

    `own_key` is the key without the controller in the manifest, `identified_key` that of what is identified: without
    problem, seed and whether to optimize too. `known` is a result with one of these keys, which lacks no more than the
    rest.
    """

    run: LoggedRun
    folder: Path
    key: str
    own_key: str
    identified_key: str
    options: RunOptions
    known: RunOutcome | None = None

    def refused(self, kind: str, reason: str) -> RunOutcome:
        """Return the outcome of a run of which nothing else is known."""
        return RunOutcome(cell=self.run.cell, run=self.run.run, key=self.key, refused=kind, reason=reason)


def parse_outcome(text: str | None) -> RunOutcome | None:
    """Return what `RunOutcome.text` wrote; None for anything that this release does not know."""
    try:
        tree = json.loads(text or "")
        values = {name: (float(value), float(std)) for name, (value, std) in tree.pop("values").items()}
        peaks = {name: (before, float(after)) for name, (before, after) in tree.pop("peaks_n").items()}
        outside = tree.pop("outside")
        in_log = {name: (float(before), float(after)) for name, (before, after) in tree.pop("log_peaks_n", {}).items()}
        return RunOutcome(
            **tree,
            values=values,
            peaks_n=peaks,
            log_peaks_n=in_log,
            outside=None if outside is None else tuple(outside),
        )
    except (ValueError, TypeError, KeyError, AttributeError):
        return None


def digest_of(path: Path, of_file: Callable[[Path], str] = sha256_of) -> str:
    """Return the SHA-256 of a file, or of the names and digests of all that is in a folder."""
    if not path.is_dir():
        return of_file(path)
    parts = sorted(each for each in path.rglob("*") if each.is_file())
    lines = "".join(f"{each.relative_to(path)} {of_file(each)}\n" for each in parts)
    return sha256(lines.encode()).hexdigest()


def build_task(run: LoggedRun, folder: Path, options: RunOptions, of_log: Callable[[Path], str] = digest_of) -> RunTask:
    """Return the task of a run; its key is the SHA-256 of version, options and the bytes of every file.

    What the manifest says of the run's options goes before those of the campaign. `of_log` returns the SHA-256 of a
    log, which may be known already. Paths of the task are absolute: who works on it may have another current folder.

    Raises UsageError where a file cannot be read.
    """
    files = {"cell_file": run.cell_file, "problem": run.problem}
    options = replace(options, **run.options)
    if options.urdf is not None:
        options = replace(options, urdf=options.urdf.absolute())
        files["urdf"] = options.urdf
    try:
        digests = {key: None if path is None else digest_of(path) for key, path in files.items()}
        controller = None if run.controller is None else digest_of(run.controller)
        logs = [of_log(log) for log in run.logs]
    except OSError as error:
        raise UsageError(f"{error.filename} cannot be read: {error.strerror or error}.") from error
    said = {"version": __version__, "options": options.tree(), "logs": logs, **digests}
    read = {**said, "options": replace(options, optimize=True, seed=0).tree(), "problem": None}
    identified_key, own_key, key = (_key_of(each) for each in (read, said, {**said, "controller": controller}))
    return RunTask(
        run=run.in_any_folder(),
        folder=folder.absolute() / CELLS / run.cell / run.run,
        key=key,
        own_key=own_key,
        identified_key=identified_key,
        options=options,
    )


def _key_of(said: Mapping[str, Any]) -> str:
    return sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def work_on(task: RunTask) -> RunOutcome:
    """Identify a run, search its controller, and write all that is known as one folder; a refusal is a result too.

    What was not foreseen, or a file that cannot be read, ends the run and not the campaign; nothing is written of it,
    so that it is tried again.
    """
    others = [path.name for path in task.folder.glob("*") if path.name not in _WRITTEN or path.is_dir()]
    _check_others(task.folder, others)
    files: dict[str, str] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if task.known is not None and task.known.own_key == task.own_key:
                return _check_again(task, task.known)
            outcome = _identify_and_tune(task, files)
        except Exception as error:  # noqa: BLE001 - one log must not end the work on all others
            if _is_unreadable(error, task):
                return task.refused("unreadable", f"{error} It is tried again by the next campaign.")
            return task.refused("unforeseen", f"Unforeseen {type(error).__name__}: {error}")
    try:
        if files:
            task.folder.parent.mkdir(parents=True, exist_ok=True)
            write_folder_atomic(task.folder, files)
        elif task.folder.exists():
            shutil.rmtree(task.folder)  # of another log, or other options
    except OSError as error:
        raise UsageError(f"{task.folder} cannot be written: {error.strerror or error}.") from error
    digests = {name: sha256(text.encode()).hexdigest() for name, text in files.items()}
    return replace(outcome, files=digests, own_key=task.own_key, identified_key=task.identified_key)


def written_before(folder: Path) -> tuple[str, ...]:
    """Return which files the folder of a run has from an older campaign, where the state knows nothing of the run.

    Raises UsageError where a file has the name of one and is another.
    """
    try:
        kinds = {name: kind_of(folder / name) for name in sorted(_WRITTEN)}
    except OSError as error:
        raise UsageError(f"{error.filename} cannot be read: {error.strerror or error}.") from error
    found = [name for name, kind in kinds.items() if name == f"{kind}.yaml"]
    _check_others(folder, [name for name, kind in kinds.items() if kind != "" and name not in found])
    return tuple(found)


def _check_others(folder: Path, others: Sequence[str]) -> None:
    """Raise UsageError where there are files that no campaign has written."""
    if others:
        raise UsageError(
            f"{folder} holds {', '.join(sorted(others))}, which no campaign has written and this one would delete; "
            "move that to another folder, and the same command goes on."
        )


def _check_again(task: RunTask, known: RunOutcome) -> RunOutcome:
    """Return a result that is known with the controller that the manifest names now; what was written stays."""
    if _IDENTIFIED in known.files:
        outside = _outside(task, read_identified(task.folder / _IDENTIFIED).result)
    else:
        outside = _broken(task)
    return replace(known, key=task.key, outside=outside)


def _identify_and_tune(task: RunTask, files: dict[str, str]) -> RunOutcome:
    """Return what came of a run, and put the files that it makes into `files`, by name."""
    run = task.run
    outcome = RunOutcome(cell=run.cell, run=run.run, key=task.key)
    try:
        if task.known is None:
            cell = None if run.cell_file is None else read_cell(run.cell_file)
            found = identify_log(run.logs, task.options.of_identify(cell))
            result, recorded = found.result, float(found.provenance["time_span_s"][0])
            files[_IDENTIFIED] = dump_yaml(identified_tree(result, found.provenance))
            outcome = replace(outcome, recorded_s=recorded, values=_values(found), damage=_damage(result))
        else:
            path, known = task.folder / _IDENTIFIED, task.known
            files[_IDENTIFIED] = path.read_text(encoding="utf-8")
            result = parse_identified(files[_IDENTIFIED], path).result
            outcome = replace(outcome, recorded_s=known.recorded_s, values=known.values, damage=known.damage)
        outcome = replace(outcome, outside=_outside(task, result))
        if task.options.optimize:
            outcome = _tune(task, files, outcome)
    except AutotuneError as error:
        if _is_unreadable(error, task):
            raise
        kind = next((name for of, name in _STEPS.items() if isinstance(error, of)), "usage")
        outside = _broken(task) if outcome.outside is None else outcome.outside
        return replace(outcome, refused=kind, reason=str(error), outside=outside)
    return outcome


def _is_unreadable(error: Exception, task: RunTask) -> bool:
    """Return whether an error is that a file cannot be read or is gone, which the bytes of the key do not imply.

    What is only wrong in a file may be an OSError of a library too, which has no number then.
    """
    reason: BaseException | None = error if isinstance(error, AutotuneError) else None
    while reason is not None:
        if isinstance(reason, OSError) and reason.errno is not None:
            return True
        reason = reason.__cause__
    run = task.run
    files = (*run.logs, run.cell_file, run.problem, run.controller, task.options.urdf)
    return isinstance(error, AutotuneError) and not all(path is None or path.exists() for path in files)


def _broken(task: RunTask) -> tuple[str, ...] | None:
    """Return why a controller's file certifies nothing, None where it may hold: without a log nobody knows more."""
    try:
        if task.run.controller is not None:
            read_controller(task.run.controller)
    except AutotuneError as error:
        if _is_unreadable(error, task):
            raise
        return (str(error).rstrip("."),)
    return None


def _values(found: Identification) -> dict[str, tuple[float, float]]:
    """Return what is followed from run to run: what was identified, the sensor's bias, the clocks' offset."""
    offset = found.provenance.get("wrench_offset_s")
    clock = {} if offset is None else {CLOCK: (float(offset[0]), float(offset[1]))}
    return identified_values(found.result) | bias_values(found.result) | clock


def _damage(result: Identified) -> str:
    """Return what of the logs of a run is damaged and left out."""
    return " ".join(finding.message for finding in result.findings if finding.code == "salvaged")


def _outside(task: RunTask, result: Identified) -> tuple[str, ...] | None:
    """Return what of a plant lies outside of what a controller is certified for, or why its file certifies nothing."""
    from autotune.validation.domain import check_domain  # noqa: PLC0415 - compiles

    if task.run.controller is None:
        return None
    try:
        checks = check_domain(read_controller(task.run.controller).controller, result)
    except AutotuneError as error:
        if _is_unreadable(error, task):
            raise
        return (str(error).rstrip("."),)
    return tuple(f"axis {each.axis}, {each.name}: {each.message}" for each in checks if not each.passed)


def _tune(task: RunTask, files: dict[str, str], outcome: RunOutcome) -> RunOutcome:
    """Search the controller and write it; return the outcome with its peaks."""
    from autotune.prediction.said_gains import present_gains  # noqa: PLC0415 - compiles
    from autotune.tuning.optimize import optimize  # noqa: PLC0415 - compiles

    problem = task.run.problem
    spec = ProblemSpec() if problem is None else read_problem(problem)
    source = parse_identified(files[_IDENTIFIED], task.folder / _IDENTIFIED)
    present = present_gains(None, source, spec.axes)
    found = optimize(source, spec, seed=task.options.seed, problem_path=problem, present=present)
    files["controller.yaml"] = dump_yaml(controller_tree(found.controller))
    predicted, certified = found.controller.predicted, found.controller.certificate.domain
    hardest = {name: each.surfaces[0] for name, each in found.before_after.items() if each.surfaces}
    return replace(
        outcome,
        peaks_n={
            name: (_before(found.before_after, name), max(each.peak_contact_force_n for each in one.scenarios))
            for name, one in predicted.items()
        },
        peaks_at={name: _certified_text(certified[name], axis_units(name)) for name in predicted},
        log_peaks_n={
            name: (each.measured[1], each.after.predicted.peak_sensor_force) for name, each in hardest.items()
        },
        log_peaks_at={name: _contact_text(each.after.predicted) for name, each in hardest.items()},
    )


def _certified_text(domain: AxisDomain, units: AxisKind) -> str:
    """Say on which surfaces and at which approach the predicted peaks of an axis are."""
    scale, unit = units.shown_stiffness
    ends = dict.fromkeys(f"{scale * each:.4g}" for each in domain.environment_stiffness_n_per_m)
    return f"K_e {' to '.join(ends)} {unit}, approach with {domain.approach.text(units)}"


def _contact_text(contact: "PredictedContact") -> str:
    """Say on which surface and at which speed a contact of the log is."""
    return f"{contact.surface}, {speed_text(contact.contact.contact_speed_m_s, axis_units(contact.axis).force)}"


def _before(before_after: Mapping[str, Any], name: str) -> float | None:
    """Return the worst peak with the gains of the log; None where it is not known, or where the loop is unstable."""
    before = before_after[name].worst[0] if name in before_after else None
    return None if before is None or before == float("inf") else float(before)
