"""Prove a search's result and look for bouncing before it is written, and search again with what refutes it."""

from collections.abc import Callable
from dataclasses import dataclass

from autotune.errors import CertificateError, InfeasibleError
from autotune.formats.units import axis_units
from autotune.validation.axis_proof import AxisProof, ProofOptions, prove_axis
from autotune.validation.bouncing import RefutedError, search_bouncing

from .optimality_report import OptimalityReport, report_optimality
from .record import build_domain
from .scenario_exchange import NOTHING, Counterexamples, ImpactTest
from .search import SearchResult, solve_design

_ROUNDS = 6
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


def settle(name: str, found: SearchResult, asked: ProofOptions, *, seed: int) -> Settled:
    """Search again until nothing refutes the result, then from the reference's design where that is better.

    The plant at which a proof fails joins the scenarios; an impact that bounces for ever must come to rest. Raises
    CertificateError where that does not help within a few rounds, InfeasibleError where no controller is left.
    """
    first = _unrefuted(name, found, asked, NOTHING, seed)
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
    for round_index in range(_ROUNDS + 1):
        try:
            proved = prove_search(name, search, asked)
        except RefutedError as error:
            joined = counterexamples.joined(error)
            if joined == counterexamples or round_index == _ROUNDS:
                raise
            refuted, counterexamples = error, joined
        else:
            break
        try:
            search = solve_design(search.problem, seed=seed, start=search.design, counterexamples=counterexamples)
        except InfeasibleError as error:
            raise InfeasibleError(f"{refuted} Searched again with that: {error}", missed=error.missed) from error
    return Settled(search=search, proved=proved, optimality=report_optimality(search), counterexamples=counterexamples)


def prove_search(
    name: str, search: SearchResult, asked: ProofOptions, report: Callable[[float], None] | None = None
) -> AxisProof:
    """Prove of one axis stability, and of the modulus that the search found over its dense grid what can be.

    Raises RefutedError with the plant where a proof fails, and with the impact where a contact bounces for ever.
    """
    problem, law = search.problem, search.problem.controller(search.design)
    swept = min(each.margins.modulus for each in search.margins)
    proved = prove_axis(problem.plants, law, problem.sample_time_s, name, swept, asked, report)
    bouncing = search_bouncing(name, build_domain(problem), law, problem.sample_time_s)
    if bouncing.found is not None:
        raise RefutedError(
            f"Axis {name}: {bouncing.message()}. Stability in contact and in free space does not exclude that, so the "
            f"{axis_units(name).force_name} never comes to rest.",
            axis=name,
            scenario=bouncing.found.scenario,
            impact=bouncing.found,
        )
    return proved
