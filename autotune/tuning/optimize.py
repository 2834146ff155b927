"""From identified parameters to a validated controller: search, prove, write down, verify."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from autotune.errors import CertificateError, InfeasibleError
from autotune.formats.canonical import lines_to_paste
from autotune.formats.controller_record import Controller, RuntimePayload
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import ComplianceSpec, ProblemSpec
from autotune.prediction.before_after import BeforeAndAfter, compare_before_after
from autotune.prediction.law import PresentGains
from autotune.validation.axis_proof import AxisProof, ProofOptions, Prover
from autotune.validation.report import ValidationReport
from autotune.validation.requirements import MARGINS_CHECK
from autotune.validation.validate import validate_controller
from identification.result import Identified
from problems.arrays import FloatArray
from problems.design.problem import CONTROLLER_VARIABLES, DesignProblem
from problems.progress import ProgressSlice, no_progress

from .causes import explain, explanation_message
from .compare import SideBySide, check_comparable, compare, start_design
from .compliance import Compliance, build_compliance_problems, choose_compliance, named_compliance, settle_compliance
from .coupled import TogetherAsked, TogetherCheck
from .coupled_search import CoupledSearch
from .defaults import DefaultAdmittance, beside_margins, default_admittance, default_message, lower_default
from .limits import LimitsSettings, limits_settings, with_limits
from .optimality_report import OptimalityReport
from .problems import build_problems, certified_mass_kg, runtime_mass_kg, within_domain
from .provenance import design_notes, make_provenance, result_trees, with_notes
from .record import build_controller, runtime_payload
from .scenario_exchange import WholeSet
from .search import SearchResult, solve_design
from .settle import Settled, prove_search, settle_all
from .soft_payload import SoftPayload
from .strategies import StrategySettings, choose_strategies, strategy_settings
from .structure import StructureSearch
from .structure_choice import StructureChoice

# Of the time of a usual run, measured, for the progress bar alone. The second is a share of what comes
# after the search.
_SEARCH_SHARE, _PROOF_SHARE = 0.4, 0.1
_COMPLIANCE_SHARE = 0.6
_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class Optimized:
    """A controller that passed validation, the searches behind it, their optimality, and the checks it passed.

    `compared` puts it beside the present gains, axis by axis, if they are known, and `before_after` beside the contacts
    of the log; `compliance` holds the stiffness that was chosen for the axis, where the problem left it open;
    `defaults` what was asked by default and followed the cell. What the user should know is in the provenance, as
    `notes`. `unchecked_together` says why the axes were not checked on their common payload, `structures` what further
    structures of the law do, `noise_limitable` names the axes of which a limit of the command's noise could take the
    place of bounds.
    """

    controller: Controller
    searches: Mapping[str, SearchResult]
    optimality_reports: Mapping[str, OptimalityReport]
    report: ValidationReport
    compared: Mapping[str, SideBySide] = field(default_factory=dict)
    compliance: Mapping[str, Compliance] = field(default_factory=dict)
    defaults: Mapping[str, DefaultAdmittance] = field(default_factory=dict)
    before_after: Mapping[str, BeforeAndAfter] = field(default_factory=dict)
    unchecked_together: str = ""
    structures: Mapping[str, StructureChoice] = field(default_factory=dict)
    noise_limitable: frozenset[str] = frozenset()


def optimize(
    identified: IdentifiedFile,
    spec: ProblemSpec,
    *,
    seed: int = 0,
    problem_path: Path | None = None,
    present: PresentGains | None = None,
    relax: bool = True,
    replays: bool = True,
    proof: ProofOptions | None = None,
    step: Callable[[str], None] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Optimized:
    """Tune every axis, on the compliance to build if that is open, and return a controller that validation has passed.

    An admittance that nobody asked for follows the cell (`defaults`), with `relax` down to what can be had. `proof`
    says how closely the modulus is proved. `present` are the gains of today to compare with; they join the search where
    they lie inside the bounds. With `replays` the contacts of the log are replayed. `step` is called with the
    compliance that is worked on, `progress` with the share of the work done since the last call.

    Raises InfeasibleError when nothing meets the requirements (with `relax`, after searching for what would have to be
    relaxed: several times the work of a search), CertificateError when a claim cannot be proved or verified,
    EstimateError for a missing parameter, UsageError for a problem or present gains that do not fit.
    """
    report = progress or no_progress
    asked = proof if proof is not None else ProofOptions()
    spec = within_domain(spec, identified.domain)
    build = build_problems if spec.compliance is None else build_compliance_problems
    problems = build(identified.result, replace(spec, structure=None, bumper=None))
    soft = SoftPayload(spec.bumper, problems, seed)
    if present is not None:
        check_comparable(present, problems)
    # Asked before the search, because it may refuse.
    payload = carried_payload(identified.result, problems, spec)
    chosen = _choose(problems, spec.compliance, seed, step or no_progress, ProgressSlice(report, _COMPLIANCE_SHARE))
    if chosen:
        report = ProgressSlice(report, 1.0 - _COMPLIANCE_SHARE)
        problems = {name: compliance.on_chosen(problems[name]) for name, compliance in chosen.items()}
    structures = StructureSearch(spec, identified.result, seed)
    searches = structures.searched(_search_all(problems, present, chosen, seed, relax, structures, report))
    chosen = {name: settle_compliance(problems[name], each, searches[name], seed) for name, each in chosen.items()}
    together = TogetherCheck(TogetherAsked.of(identified.result, spec), asked)
    beside = CoupledSearch(together, payload, seed)

    def certified(settled: Mapping[str, Settled]) -> tuple[Controller, ValidationReport, dict[str, DefaultAdmittance]]:
        found = {name: each.search for name, each in settled.items()}
        defaults = {name: said for name, each in found.items() if (said := default_admittance(problems[name], each))}
        provenance = make_provenance(identified, problems, spec, seed, problem_path, present, asked)
        provenance |= result_trees(settled, identified.result, defaults, chosen)
        passed = certify(
            found, payload, provenance, asked, lambda done: report((1.0 - _SEARCH_SHARE) * done),
            strategies=strategy_settings(identified.result, spec), limits=limits_settings(identified.result, spec),
            proved={name: each.proved for name, each in settled.items()}, together=together, soft=soft,
        )  # fmt: skip
        return *passed, defaults

    portion = ProgressSlice(report, (1.0 - _SEARCH_SHARE) * _PROOF_SHARE)
    settled, (controller, checked, defaults) = settle_all(searches, asked, seed, portion, beside, soft, certified)
    searches = {name: each.search for name, each in settled.items()}
    problems = {name: each.problem for name, each in searches.items()}
    compared = {} if present is None else compare(present, searches)
    before_after = replay_log(identified, controller, present, compared) if replays else {}
    lowered = [default_message(name, each, problems[name]) for name, each in defaults.items() if each.is_lowered]
    notes = [*lowered, *beside.notes(searches), *soft.notes(searches), *structures.notes(searches)]
    notes += design_notes(identified, controller, problems, spec, has_compliance=bool(chosen))
    return Optimized(
        controller=with_notes(controller, notes, before_after), searches=searches, report=checked, compared=compared,
        optimality_reports={name: each.optimality for name, each in settled.items()},
        compliance=chosen, defaults=defaults, before_after=before_after, unchecked_together=together.unchecked,
        structures=structures.choices, noise_limitable=structures.noise_limitable(problems),
    )  # fmt: skip


def replay_log(
    identified: IdentifiedFile,
    controller: Controller,
    present: PresentGains | None,
    compared: Mapping[str, SideBySide],
) -> dict[str, BeforeAndAfter]:
    """Return what a controller changes on the contacts of the log, axis by axis.

    The largest peak of present gains that are unstable somewhere is infinite.
    """
    did = {name: both.old.performance for name, both in compared.items()}
    worst = {name: math.inf if each is None else each.peak_contact_force_n for name, each in did.items()}
    return compare_before_after(identified, controller, present=present, worst_before=worst)


def carried_payload(identified: Identified, problems: Mapping[str, DesignProblem], spec: ProblemSpec) -> RuntimePayload:
    """Return the payload that the runtime compensates; raises UsageError where ranges leave the identified one out."""
    certified = certified_mass_kg(problems) or spec.payload_mass
    is_chosen = certified is not None and certified[0] == certified[1]
    return runtime_payload(identified, runtime_mass_kg(identified, certified), is_chosen=is_chosen)


def certify(
    searches: Mapping[str, SearchResult],
    payload: RuntimePayload,
    provenance: Mapping[str, Any],
    proof: ProofOptions,
    progress: Callable[[float], None],
    *,
    proved: Mapping[str, AxisProof] | None = None,
    strategies: StrategySettings | None = None,
    limits: LimitsSettings | None = None,
    together: Callable[[Controller, Prover], Controller] | None = None,
    soft: SoftPayload | None = None,
) -> tuple[Controller, ValidationReport]:
    """Prove what can be proved of the designs, write them down, and return the controller once validation passed it.

    `proved` is what has been proved already, `strategies` asks for what is chosen for these designs beside gains,
    `limits` says what is known of the cell for those of the runtime; `together` adds what is certified of all axes on
    their payload, `soft` what is with a bumper; `progress` gets the share of the work done since the last call. Where
    validation finds smaller margins than the search did, they are sought everywhere, and stated anew. Raises
    CertificateError when a claim cannot be proved or verified, RefutedError among them (`prove_search`), and what
    `choose_strategies` and `together` raise.
    """
    for name, search in searches.items():
        check_within_bounds(search, name)
    found = _prove(searches, proof, progress) if proved is None else proved
    if strategies is not None:
        # Peaks are proved of the gains alone.
        found = {name: replace(each, peak=None) for name, each in found.items()}

    def stated(results: Mapping[str, SearchResult]) -> tuple[Controller, ValidationReport]:
        controller = build_controller(results, payload, found, provenance)
        prover = Prover(tuple(answer for each in found.values() for answer in each.answers))
        if strategies is not None:
            controller = choose_strategies(controller, results, strategies, prover)
        controller = with_limits(controller, limits or LimitsSettings())
        if together is not None:
            controller = together(controller, prover)
        if soft is not None:
            controller = soft.stated(controller, prover, proof)
        share = 1.0 - _PROOF_SHARE
        return controller, validate_controller(controller, lambda done: progress(share * done), proved=prover.answers)

    controller, checked = stated(searches)
    doubted = {each.axis for each in checked.checks if each.name == MARGINS_CHECK and not each.passed}
    if doubted:
        every = {name: _with_every_margin(each) if name in doubted else each for name, each in searches.items()}
        controller, checked = stated(every)
    checked.require()
    return controller, checked


def _with_every_margin(found: SearchResult) -> SearchResult:
    """Return a result with margins that were sought everywhere in the set, also those far from their limits."""
    law = found.problem.controller(found.design)
    exact = WholeSet(found.problem).evaluate(law, climbs_objective=False, every_margin=True)
    return replace(found, margins=(*found.margins, *exact.margins))


def check_within_bounds(search: SearchResult, name: str) -> None:
    """Raise CertificateError if the controller that a design makes lies outside of the bounds that were asked."""
    problem = search.problem
    values = dict(zip(CONTROLLER_VARIABLES, problem.controller(search.design).numbers(), strict=False))
    for variable, (low, high) in problem.bounds.items():
        if not low * (1.0 - _ROUNDING) <= values[variable] <= high * (1.0 + _ROUNDING):
            raise CertificateError(
                f"Axis {name}: the design found has {variable} {values[variable]:g}, outside of its bounds {low:g} to "
                f"{high:g}, so nothing is written."
            )


def _prove(
    searches: Mapping[str, SearchResult], asked: ProofOptions, report: Callable[[float], None]
) -> dict[str, AxisProof]:
    """Return what is proved of every axis, see `prove_search`."""
    proved = {}
    for name, search in searches.items():
        portion = ProgressSlice(report, _PROOF_SHARE / len(searches))
        proved[name] = prove_search(name, search, asked, portion)
        portion.finish()
    return proved


def _choose(
    problems: Mapping[str, DesignProblem],
    asked: ComplianceSpec | None,
    seed: int,
    step: Callable[[str], None],
    portion: ProgressSlice,
) -> dict[str, Compliance]:
    """Choose the compliance of the axis, none unless it is asked; `step` gets each stiffness as it is worked on."""
    found = {
        name: choose_compliance(
            problem, asked, seed=seed, step=lambda stiffness: step(f"K_e {1e-3 * stiffness:g} N/mm"), progress=portion
        )
        for name, problem in problems.items()
        if asked is not None
    }
    if found:
        portion.finish()
        step("")
    return found


def _search_all(
    problems: Mapping[str, DesignProblem],
    present: PresentGains | None,
    chosen: Mapping[str, Compliance],
    seed: int,
    relax: bool,
    structures: StructureSearch,
    report: Callable[[float], None],
) -> dict[str, SearchResult]:
    """Search the design of every axis, from what is known of one."""
    searches = {}
    for name, problem in problems.items():
        portion = ProgressSlice(report, _SEARCH_SHARE / len(problems))
        start = _start(name, problem, present, chosen.get(name))
        with named_compliance(name, chosen.get(name)):
            searches[name] = _search(name, problem, seed, start, relax, structures, report, portion)
    return searches


def _start(
    name: str, problem: DesignProblem, present: PresentGains | None, compliance: Compliance | None
) -> FloatArray | None:
    """Return the design that joins the search: the present gains, else that of the chosen compliance."""
    today = None if present is None else present.laws.get(name)
    start = None if today is None else start_design(today.controller, problem)
    if start is None and compliance is not None and compliance.chosen.found is not None:
        return compliance.chosen.found.design
    return start


def _search(
    name: str,
    problem: DesignProblem,
    seed: int,
    start: FloatArray | None,
    relax: bool,
    structures: StructureSearch,
    report: Callable[[float], None],
    portion: ProgressSlice,
) -> SearchResult:
    try:
        found = solve_design(problem, seed=seed, start=start, progress=portion)
    except InfeasibleError as error:
        freer = structures.beyond_gains(name, problem)
        if freer is not None:
            portion.finish()
            return freer
        # Less is asked of what nobody asked for where no law of the structure that is asked has it.
        lowered = lower_default(problem, seed=seed) if relax else None
        if lowered is not None:
            return _search(name, lowered, seed, start, relax, structures, report, portion)
        if not relax:
            raise InfeasibleError(f"Axis {name}: {error}") from error
        # In the place of what a controller would still have to pass.
        problem = beside_margins(problem, seed=seed)
        why = explain(name, problem, seed=seed, progress=ProgressSlice(report, 1.0 - _SEARCH_SHARE))
        if why.met_by is not None:
            return _search(name, problem, seed, why.met_by, False, structures, report, portion)
        said = structures.suggestion_message(name)
        if not why.relaxations and not said:
            raise InfeasibleError(f"Axis {name}: {error}") from error
        eased = explanation_message(name, problem, why) if why.relaxations else ""
        raise InfeasibleError(
            " ".join(filter(None, (f"Axis {name}: {error.bare}.", eased, said))),
            tuple((each.name, each.asked, each.possible) for each in why.relaxations),
            suggestion=structures.suggestion(name) or why.suggestion,
            to_paste=lines_to_paste(why.suggestion) if said else (),
        ) from error
    portion.finish()
    return found
