"""Designs that nothing refutes: what a proof, an impact or validation shows to be wrong joins the search."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeVar

from autotune.errors import CertificateError, InfeasibleError
from autotune.validation.axis_proof import AxisProof, ProofOptions, Prover, prove_axis
from autotune.validation.bouncing import RefutedError
from autotune.validation.bouncing_proof import prove_bouncing
from autotune.validation.held import prove_held
from autotune.validation.peak_proof import prove_peaks
from problems.progress import no_progress

from .coupled_search import CoupledSearch
from .optimality_report import OptimalityReport, report_optimality
from .record import build_domain, certified_hand
from .scenario_exchange import NOTHING, Counterexamples, ImpactTest
from .search import SearchResult, solve_design
from .soft_payload import SoftPayload

Result = TypeVar("Result")

ROUNDS = 6
# A reference that lies lower by more than this is worth another search, from its design.
_LARGEST_GAP = 1e-3
_BETTER = 1e-6


@dataclass(frozen=True, kw_only=True)
class Settled:
    """A search's result that nothing refutes, what is proved of it, its optimality, and the counterexamples met."""

    search: SearchResult
    proved: AxisProof
    optimality: OptimalityReport
    counterexamples: Counterexamples


def settle_all(
    searches: Mapping[str, SearchResult],
    asked: ProofOptions,
    seed: int,
    report: Callable[[float], None],
    beside: CoupledSearch,
    soft: SoftPayload,
    certified: Callable[[Mapping[str, Settled]], Result],
) -> tuple[dict[str, Settled], Result]:
    """Return what nothing refutes of every axis, and what `certified` makes of it.

    Neither of each by itself (`settle`), nor of all axes on their payload, nor with a bumper, nor the validation that
    `certified` ends with: the plant that its RefutedError names joins the search of that axis. `report` gets the share
    of the work done since the last call.
    """
    met: dict[str, Counterexamples] = {}
    for round_index in range(ROUNDS + 1):
        settled = _settle_together(searches, asked, seed, no_progress if met else report, beside, soft, met)
        try:
            return settled, certified(settled)
        except RefutedError as error:
            refuted, known = error, settled[error.axis]
            joined = known.counterexamples.joined(error)
            if joined == known.counterexamples or round_index == ROUNDS:
                raise
        met[refuted.axis] = joined
        again = _searched_again(known.search, joined, refuted, seed)
        searches = {name: each.search for name, each in settled.items()} | {refuted.axis: again}
    raise AssertionError  # the last round returns or raises


def _settle_together(
    searches: Mapping[str, SearchResult],
    asked: ProofOptions,
    seed: int,
    report: Callable[[float], None],
    beside: CoupledSearch,
    soft: SoftPayload,
    met: Mapping[str, Counterexamples],
) -> dict[str, Settled]:
    """Return what nothing but validation may refute; `met` are the counterexamples that are known, by axis."""
    settled: dict[str, Settled] = {}

    def settle_each(found: Mapping[str, SearchResult]) -> dict[str, SearchResult]:
        portion = 1.0 / len(found) if not settled else 0.0
        now = dict(found)
        for name, search in found.items():
            passing = soft.searched(name, search)
            for _ in range(ROUNDS):
                others = beside.beside(name, now).beside
                asks = soft.with_test(name, replace(met.get(name, NOTHING), beside=others))
                settled[name] = settle(name, passing, asked, seed=seed, counterexamples=asks)
                now[name] = settled[name].search
                passing = soft.searched(name, now[name])
                if passing is now[name]:
                    break
            report(portion)
        return now

    beside.agreed(searches, settle_each)
    return settled


def settle(
    name: str, found: SearchResult, asked: ProofOptions, *, seed: int, counterexamples: Counterexamples = NOTHING
) -> Settled:
    """Search again until nothing refutes the result, then from the reference's design where that is better.

    The plant at which a proof fails joins the scenarios; an impact that bounces for ever must come to rest, which adds
    to the `counterexamples`. Raises CertificateError where that does not help within a few rounds, InfeasibleError
    where no controller is left.
    """
    first = _unrefuted(name, found, asked, counterexamples, seed)
    search, start = first.search, first.optimality.reference.design
    if not first.optimality.gap > _LARGEST_GAP or not ImpactTest(search.problem, first.counterexamples).passes(start):
        return first
    try:
        other = solve_design(search.problem, seed=seed, start=start, counterexamples=first.counterexamples)
        if other.evaluation.cost > (1.0 - _BETTER) * search.evaluation.cost:
            return first
        second = _unrefuted(name, other, asked, first.counterexamples, seed)
    except (InfeasibleError, CertificateError):
        # The first result is kept.
        return first
    lower = second.search.evaluation.cost < search.evaluation.cost
    return second if lower else first


def _unrefuted(
    name: str, search: SearchResult, asked: ProofOptions, counterexamples: Counterexamples, seed: int
) -> Settled:
    """Return a result that nothing refutes, and what was taken in."""
    for round_index in range(ROUNDS + 1):
        try:
            proved = prove_search(name, search, asked)
        except RefutedError as error:
            joined = counterexamples.joined(error)
            if joined == counterexamples or round_index == ROUNDS:
                raise
            refuted, counterexamples = error, joined
        else:
            break
        search = _searched_again(search, counterexamples, refuted, seed)
    return Settled(search=search, proved=proved, optimality=report_optimality(search), counterexamples=counterexamples)


def _searched_again(
    search: SearchResult, counterexamples: Counterexamples, refuted: RefutedError, seed: int
) -> SearchResult:
    """Return what a search from a refuted design finds; raises InfeasibleError, with what refuted it, where nothing."""
    try:
        return solve_design(search.problem, seed=seed, start=search.design, counterexamples=counterexamples)
    except InfeasibleError as error:
        raise InfeasibleError(f"{refuted} Searched again with that: {error}", missed=error.missed) from error


def prove_search(
    name: str, search: SearchResult, asked: ProofOptions, report: Callable[[float], None] | None = None
) -> AxisProof:
    """Prove of one axis stability, and of the modulus that the search found over its dense grid what can be.

    Raises RefutedError with the plant where a proof fails, and with the impact where a contact bounces for ever.
    """
    problem, law = search.problem, search.problem.controller(search.design)
    swept = min(each.margins.modulus for each in search.margins)
    proved = prove_axis(problem.plants, law, problem.sample_time_s, name, swept, asked, report)
    prover, hand = Prover(), certified_hand(name, problem)
    bouncing = prove_bouncing(prover, build_domain(problem), law, problem.sample_time_s, name, asked)
    proved = replace(proved, bouncing=bouncing, answers=(*proved.answers, *prover.answers))
    if asked.further_s == 0.0:
        return proved
    prover = Prover()
    bounded = replace(asked, budget_s=asked.further_s)
    held = prove_held(prover, problem.plants, law, problem.sample_time_s, hand, bounded)
    largest = max(each.peak_contact_force_n for each in search.evaluation.peaks)
    approach = build_domain(problem).approach
    peak = prove_peaks(prover, problem.plants, law, problem.sample_time_s, name, approach, largest, bounded)
    return replace(proved, held=held, peak=peak, answers=(*proved.answers, *prover.answers))
