"""A table of controllers over classes of payload and surface, beside the one controller that serves all of them."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TypeVar

from autotune.errors import AutotuneError, CertificateError, InfeasibleError, UsageError
from autotune.formats.canonical import dump_yaml
from autotune.formats.controller import controller_tree, parse_controller
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import Interval, ProblemSpec
from autotune.formats.schedule import COMMON_FILE, Schedule, ScheduleClass, Tuned, worst_peaks
from autotune.prediction.law import PresentGains
from autotune.processes import map_in_processes
from autotune.validation.dwell import provable_dwell_time
from identification.errors import EstimateError
from problems.design.objectives import PeakObjective, force_of
from problems.design.problem import DesignProblem
from problems.errors import ParameterError
from problems.progress import no_progress
from problems.stability.margins import UnstableLoopError

from .optimize import optimize
from .problems import build_problems, certified_mass_kg, runtime_mass_kg, within_domain
from .scenario_exchange import WholeSet
from .threshold import without_response

_BRANCHES = (InfeasibleError, CertificateError, UsageError, EstimateError)
# Two sets of samples see the same requirement differently by less than this.
_HAIR = 1e-3
_Value = TypeVar("_Value")


@dataclass(frozen=True, kw_only=True)
class _Task:
    """What one process needs to tune one class."""

    identified: IdentifiedFile
    spec: ProblemSpec
    seed: int
    problem_path: Path | None


def of_class(of: ScheduleClass, spec: ProblemSpec) -> ProblemSpec:
    """Return what an ordinary call would ask: the ranges of the class, and those of `spec` where it has none."""
    return spec.with_options(payload_mass=of.payload_mass_kg, environment_stiffness=of.environment_stiffness_n_per_m)


def build_classes(masses: Sequence[Interval], stiffnesses: Sequence[Interval]) -> tuple[ScheduleClass, ...]:
    """Return every combination of payload masses (kg) and surface stiffnesses (N/m), in their order.

    One of both may be empty, and the table then has no such axis. Overlaps and gaps are allowed. Raises UsageError for
    a class that is named twice and for no class at all.
    """
    for named in (masses, stiffnesses):
        twice = [interval for index, interval in enumerate(named) if interval in named[:index]]
        if twice:
            raise UsageError(f"The class {twice[0][0]:g} to {twice[0][1]:g} is named twice.")
    if not masses and not stiffnesses:
        raise UsageError("A schedule needs at least one class of payload mass or of surface stiffness.")
    return tuple(
        ScheduleClass(payload_mass_kg=mass, environment_stiffness_n_per_m=stiffness)
        for mass, stiffness in product(masses or (None,), stiffnesses or (None,))
    )


def hull(classes: Iterable[ScheduleClass]) -> ScheduleClass:
    """Return the smallest ranges that hold all classes, the gaps between them included."""
    classes = tuple(classes)
    return ScheduleClass(
        payload_mass_kg=_span(each.payload_mass_kg for each in classes),
        environment_stiffness_n_per_m=_span(each.environment_stiffness_n_per_m for each in classes),
    )


def tune_schedule(
    identified: IdentifiedFile,
    spec: ProblemSpec,
    classes: Sequence[ScheduleClass],
    *,
    seed: int = 0,
    problem_path: Path | None = None,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Schedule:
    """Tune a controller for every class and one for the hull of all, `processes` at a time; the result is the same.

    Each controller is what an ordinary `optimize` finds for those ranges (those of `spec` where a class has none).
    Where the common controller turns out to be gentler than a class's own, the class is searched again from it.
    `progress` gets the share of the work done since the last call.

    Raises UsageError for a class whose weight nobody could compensate and for a free compliance, InfeasibleError that
    names all classes without a controller, and what `optimize` raises with the name of the class. That the hull has
    none is no error.
    """
    report = progress or no_progress
    if spec.compliance is not None:
        raise UsageError(
            "free.environment_stiffness_n_per_m in problem.yaml chooses one compliance, and a schedule has many "
            "controllers; choose it without --schedule, then say its range with stiffness=LOW:HIGH."
        )
    objective = spec.objective
    if not isinstance(objective, PeakObjective):
        raise UsageError(
            f"A schedule compares peak forces, and objective in problem.yaml is {objective.name}; tune the classes "
            "without --schedule, or ask for contact_force or sensor_force."
        )
    whole, spec = hull(classes), within_domain(spec, identified.domain)

    def task(of: ScheduleClass) -> _Task:
        return _Task(identified=identified, spec=of_class(of, spec), seed=seed, problem_path=problem_path)

    for each in classes:
        _named(each.name, partial(_check, task(each)))
    different = list(dict.fromkeys((whole, *classes)))
    found = map_in_processes(
        _tune, [task(each) for each in different], processes, each=lambda: report(0.8 / len(different))
    )
    by_class = dict(zip(different, found, strict=True))
    common, refusal = _common(by_class[whole])
    own = _required({each.name: by_class[each] for each in classes})
    tuned = [
        Tuned(of=each, controller=controller, peaks=worst_peaks(controller, objective))
        for each, controller in zip(classes, own, strict=True)
    ]
    if common is not None:
        text = dump_yaml(controller_tree(common))
        work = partial(_beside, common=text)
        pairs = [(task(each.of), each) for each in tuned]
        beside = map_in_processes(work, pairs, processes, each=lambda: report(0.2 / len(pairs)))
        tuned = _required({each.of.name: other for each, other in zip(tuned, beside, strict=True)})
    every = [each.controller for each in tuned] + ([] if common is None else [common])
    waits, proved = provable_dwell_time(every)
    return Schedule(
        tuned=tuple(tuned),
        hull=whole,
        common=common,
        common_refusal=refusal,
        objective=objective,
        dwell_time_s=waits,
        dwell_proved_share=proved,
    )


def _check(task: _Task) -> None:
    """Refuse now what the search would refuse later: a mass that nobody can compensate, a parameter that is missing."""
    problems = _problems(task)
    asked = task.spec.payload_mass
    runtime_mass_kg(task.identified.result, certified_mass_kg(problems) or asked)


def _problems(task: _Task) -> dict[str, DesignProblem]:
    """Return what is asked of the gains of one task, whatever the structure of its law."""
    return build_problems(task.identified.result, replace(task.spec, structure=None))


def _tune(task: _Task) -> Controller | AutotuneError:
    """Return the controller of one task, or what was refused, so that the other classes are looked at as well."""
    try:
        return optimize(
            task.identified, task.spec, seed=task.seed, problem_path=task.problem_path, relax=False, replays=False
        ).controller
    except AutotuneError as error:
        return _bare(error)


def _beside(pair: tuple[_Task, Tuned], *, common: str) -> Tuned | AutotuneError:
    """Hold the common controller against one class; search the class again from it where it is gentler there."""
    task, own = pair
    read = parse_controller(common, COMMON_FILE)
    # What is held against each other are gains, and their contacts without a collision response.
    common_file = replace(read, controller=without_response(read.controller))
    try:
        peaks, missed = _judge(task, common_file.controller)
        if missed <= _HAIR and any(peak < own.peaks[axis] for axis, peak in peaks.items()):
            again = optimize(
                task.identified,
                task.spec,
                seed=task.seed,
                problem_path=task.problem_path,
                present=PresentGains.of_file(common_file),
                relax=False,
                replays=False,
            ).controller
            found = worst_peaks(again, force_of(task.spec.objective))
            if all(found[axis] <= peak for axis, peak in own.peaks.items()):
                own = replace(own, controller=again, peaks=found)
    except AutotuneError as error:
        return _bare(error)
    return replace(own, peaks_with_common=peaks)


def _judge(task: _Task, controller: Controller) -> tuple[dict[str, float], float]:
    """Return the worst peaks of a controller over a class, axis by axis, and by what share it misses what is asked."""
    peaks, missed = {}, 0.0
    for axis, problem in _problems(task).items():
        try:
            exact = WholeSet(problem, task.seed).evaluate(admittance_controller(controller, axis)).evaluation
        except UnstableLoopError as error:
            raise CertificateError(
                f"Axis {axis}: the common controller, stable wherever its own search and validation looked, is "
                f"unstable in this class (largest |z| {error.spectral_radius:.6f}); give the hull as a class to look "
                "closer."
            ) from error
        peaks[axis], missed = max(map(force_of(problem.objective).of_peak, exact.peaks)), max(missed, exact.violation)
    return peaks, missed


def _common(found: Controller | AutotuneError) -> tuple[Controller | None, str]:
    if isinstance(found, Controller):
        return found, ""
    if isinstance(found, InfeasibleError | CertificateError | UsageError):
        return None, str(found)
    raise found


def _required(found: Mapping[str, _Value | AutotuneError]) -> list[_Value]:
    """Return what was found of every class; raise what was refused, all infeasible classes in one sentence."""
    refused = {name: each for name, each in found.items() if isinstance(each, AutotuneError)}
    infeasible = {name: each for name, each in refused.items() if isinstance(each, InfeasibleError)}
    if infeasible:
        reasons = "; ".join(f"{name}: {str(each).rstrip('.')}" for name, each in infeasible.items())
        raise InfeasibleError(
            f"{len(infeasible)} of {len(found)} classes have no controller. {reasons}. "
            "Tuned by itself, such a class says what would have to be relaxed."
        )
    for name, error in refused.items():
        raise _prefixed(name, error) from error
    return [each for each in found.values() if not isinstance(each, AutotuneError)]


def _named(name: str, work: Callable[[], None]) -> None:
    try:
        work()
    except AutotuneError as error:
        raise _prefixed(name, error) from error


def _prefixed(name: str, error: AutotuneError) -> AutotuneError:
    """Return an error of the same exit code that names the class."""
    kind = type(_bare(error))
    return kind(f"Class {name}: {error}")


def _bare(error: AutotuneError) -> AutotuneError:
    """Return the error as its branch of the tree, with its text alone: not every kind passes to another process."""
    kind = next((each for each in _BRANCHES if isinstance(error, each)), AutotuneError)
    return UsageError(str(error)) if isinstance(error, ParameterError) else kind(str(error))


def _span(intervals: Iterable[Interval | None]) -> Interval | None:
    known = [interval for interval in intervals if interval is not None]
    return (min(low for low, _ in known), max(high for _, high in known)) if known else None
