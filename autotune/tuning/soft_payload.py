"""A payload that touches with a bumper: designs that meet what is asked with it too, and what the file says of that.

The search is that of the payload in one piece. A design that misses something with the bumper (`problems.model.plant`)
is searched again for more of what it misses, then for the best that the loops and contacts of both masses let pass.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

from autotune.certificate.certify import METHOD
from autotune.errors import InfeasibleError, UsageError
from autotune.formats.bumper_record import BumperContacts, BumperRecord, describe_bumper
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.units import ROTATIONAL_AXES
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.bumper import SAMPLED, prove_with_bumper
from problems.arrays import FloatArray
from problems.contact.transient import simulate_contact
from problems.design.evaluation import PreparedScenarios, build_scenarios
from problems.design.problem import DesignProblem
from problems.design.requirements import Requirements
from problems.design.uncertainty import ENVIRONMENT_MASS, MASS, STIFFNESS, Scenario
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Bumper
from problems.stability.margins import UnstableLoopError

from .scenario_exchange import NOTHING, Counterexamples, WholeSet, scenarios_of
from .search import SearchResult, solve_design

_ROUNDS = 5
# Of what is asked for more of: beyond what was missed, and of the modulus where a contact does not end.
_MORE, _LOUDER = 1.002, 1.1
_RESTS = "modulus_margin"
# So many designs in a row that do not pass end a search; a contact that does not end takes as long as so many.
_PATIENCE, _DEAR = 400, 20


@dataclass(frozen=True, kw_only=True)
class _Found:
    """What a law does with the bumper: required/achieved by name, what else is wrong, and the plants to blame."""

    missed: Mapping[str, float] = field(default_factory=dict)
    wrong: str = ""
    worst: tuple[Scenario, ...] = ()
    contacts: BumperContacts | None = None

    @property
    def passes(self) -> bool:
        return not self.missed and not self.wrong

    def words(self) -> str:
        """Say what is missed."""
        shares = [
            f"{name} (only {min(100.0 / value, 99.9):.3g} % of what is asked)" for name, value in self.missed.items()
        ]
        return self.wrong or f"it misses {', '.join(shares)}"


class _Axis:
    """One axis of the payload in two parts: its whole set, and the plants that a search asks.

    Raises ParameterError for contacts that swing too fast to be followed.
    """

    def __init__(self, problem: DesignProblem, bumper: Bumper, seed: int) -> None:
        self.of, plants = problem, problem.plants
        self._known: tuple[AdmittanceController, _Found] | None = None
        self._patience = _PATIENCE
        soft = replace(plants, nominal=replace(plants.nominal, bumper=bumper))
        self.problem = replace(problem, plants=soft)
        self.whole = WholeSet(self.problem, seed)
        self.asked: PreparedScenarios = build_scenarios(self.problem, self.problem.scenarios(3, 2))
        # The ends of K_e are among them: what swings too fast to be followed is refused before any search.
        for pair in self.asked.pairs:
            _ = pair.arguments

    def goes(self, law: AdmittanceController) -> bool:
        """Return whether a law passes on the plants that are asked; raises InfeasibleError where none did for long."""
        try:
            passes, cost = self.asked.evaluate_exactly(law).evaluation.is_feasible, 1
        except UnstableLoopError:
            passes, cost = False, 1
        if passes and self._restless(self.asked, law) is not None:
            passes, cost = False, _DEAR
        self._patience = _PATIENCE if passes else self._patience - cost
        if self._patience <= 0:
            raise InfeasibleError("none of the controllers that were tried passed")
        return passes

    def look(self, law: AdmittanceController) -> _Found:
        """Return what a law does over the whole set, and at the worst plants between; of the last one at once."""
        if self._known is None or self._known[0] != law:
            self._known = law, self._look(law)
        return self._known[1]

    def _look(self, law: AdmittanceController) -> _Found:
        try:
            exact = self.whole.evaluate(law, every_margin=True)
        except UnstableLoopError as refusal:
            return _Found(wrong=str(refusal).rstrip("."), worst=self.whole.unstable(law))
        left = self._restless(self.whole.prepared, law)
        if left is not None:
            return _Found(wrong="a contact does not come to rest", worst=(left,))
        missed = {name: value for name, value in exact.evaluation.requirements.items() if value > 1.0}
        if missed:
            return _Found(missed=missed, worst=scenarios_of(self.whole, exact.evaluation, exact.margins, list(missed)))
        weakest = min(exact.margins, key=lambda each: each.margins.modulus)
        hardest = max(exact.evaluation.peaks, key=lambda each: each.peak_contact_force_n)
        return _Found(
            contacts=BumperContacts(
                modulus=weakest.margins.modulus,
                peak_contact_force_n=hardest.peak_contact_force_n,
                peak_sensor_force_n=max(each.peak_sensor_force_n for each in exact.evaluation.peaks),
                hardest={
                    STIFFNESS: hardest.scenario.environment_stiffness_n_per_m,
                    MASS: hardest.scenario.payload_mass_kg,
                    **hardest.scenario.further(),
                },
                plants=float(len(exact.margins)),
            )
        )

    def join(self, worst: tuple[Scenario, ...]) -> None:
        """Add plants to those that a search asks."""
        joined = tuple(dict.fromkeys((*self.asked.scenarios, *worst)))
        if len(joined) > len(self.asked.scenarios):
            self.asked = build_scenarios(self.problem, joined)

    def _restless(self, prepared: PreparedScenarios, law: AdmittanceController) -> Scenario | None:
        """Return the first plant on which a contact does not come to rest."""
        for scenario, pair in zip(prepared.scenarios, prepared.pairs, strict=True):
            if not simulate_contact(pair, law, self.problem.approach).is_settled:
                return scenario
        return None


class SoftPayload:
    """What the designs of the straight axes must pass with the bumper of a problem; nothing without one.

    Raises UsageError for a bumper that is no part of the payload of these problems.
    """

    def __init__(self, bumper: Bumper | None, problems: Mapping[str, DesignProblem], seed: int) -> None:
        self._bumper, self._seed = bumper, seed
        self._axes: dict[str, _Axis] = {}
        self._before: dict[str, tuple[float, str]] = {}
        self._straight: frozenset[str] = frozenset()
        if bumper is None:
            return
        self._straight = frozenset(problems) - ROTATIONAL_AXES
        if not self._straight:
            raise UsageError("payload.bumper is of straight axes, and only axes that turn are tuned; leave it out.")
        for name in sorted(self._straight):
            _check_bumper(name, problems[name], bumper)
            try:
                self._axes[name] = _Axis(problems[name], bumper, seed)
            except ParameterError as refusal:
                raise UsageError(
                    f"payload.bumper cannot be followed on the surfaces of axis {name}: {refusal}"
                ) from None

    def with_test(self, name: str, counterexamples: Counterexamples) -> Counterexamples:
        """Return what a search of one axis must pass, with the bumper too."""
        axis = self._axes.get(name)
        return counterexamples if axis is None else replace(counterexamples, soft=axis.goes)

    def searched(self, name: str, search: SearchResult) -> SearchResult:
        """Return a design of an axis, searched again where it misses something with the bumper, else as it is.

        Raises InfeasibleError where no design was found that meets what is asked with it.
        """
        if self._bumper is None or name not in self._straight:
            return search
        problem, axis = search.problem, self._axes.get(name)
        if axis is None or axis.of != problem:
            axis = self._axes[name] = _Axis(problem, self._bumper, self._seed)
        found, tight = axis.look(problem.controller(search.design)), problem.requirements
        for _ in range(_ROUNDS):
            if found.passes:
                return search
            self._before.setdefault(name, (search.evaluation.cost, found.words()))
            axis.join(found.worst)
            tight = _tightened(tight, found)
            start = self._start(replace(problem, requirements=tight), search.design)
            asked = self.with_test(name, NOTHING)
            try:
                search = solve_design(problem, seed=self._seed, start=start, counterexamples=asked)
            except InfeasibleError as error:
                raise InfeasibleError(self._refusal(name, found), missed=error.missed) from error
            found = axis.look(problem.controller(search.design))
        if not found.passes:
            raise InfeasibleError(self._refusal(name, found))
        return search

    def _start(self, problem: DesignProblem, start: FloatArray) -> FloatArray:
        """Return a design that has more of what was missed, where there is one."""
        try:
            return solve_design(problem, seed=self._seed, start=start).design
        except InfeasibleError:
            return start

    def _refusal(self, name: str, found: _Found) -> str:
        return (
            f"Axis {name}: no controller was found that meets what is asked with {self._described} on the payload "
            f"(payload.bumper): {found.words()}. Ask for less, narrow the ranges, or damp the bumper."
        )

    @property
    def _described(self) -> str:
        return "" if self._bumper is None else describe_bumper(self._bumper)

    def notes(self, searches: Mapping[str, SearchResult]) -> Iterator[str]:
        """Yield what was searched again, and what it costs."""
        for name, (cost, words) in self._before.items():
            objective = searches[name].problem.objective
            old, new = (objective.value(each) for each in (cost, searches[name].evaluation.cost))
            yield (
                f"Axis {name} had another design for a payload in one piece, but with {self._described} {words}. It "
                f"was searched again; {objective.title} {old:.4g} before, {new:.4g} now, both in one piece."
            )

    def stated(self, controller: Controller, prover: Prover, asked: ProofOptions) -> Controller:
        """Return the controller with what is sampled, and proved, with the bumper; raises InfeasibleError."""
        if self._bumper is None:
            return controller
        axes = {}
        for name, axis in self._axes.items():
            law, plants = admittance_controller(controller, name), controller.certificate.domain[name].plants
            found = axis.look(law)
            if found.contacts is None:
                raise InfeasibleError(self._refusal(name, found))
            h = controller.sample_time_s
            axes[name] = prove_with_bumper(prover, plants, law, h, self._bumper, found.contacts, asked)
        record = BumperRecord(bumper=self._bumper, axes=axes, method=SAMPLED, proof_method=METHOD)
        return replace(controller, certificate=replace(controller.certificate, bumper=record))


def _check_bumper(name: str, problem: DesignProblem, bumper: Bumper) -> None:
    """Refuse a bumper that is no part of the payload, and one on a surface with a mass."""
    lightest = problem.plants.payload_mass_kg[0]
    if bumper.mass_kg >= lightest:
        raise UsageError(
            f"payload.bumper has {bumper.mass_kg:g} kg and is a part of the payload, so it must be below the "
            f"{lightest:g} kg of the lightest (axis {name})."
        )
    if problem.plants.range_of(ENVIRONMENT_MASS)[1] > 0.0:
        raise UsageError("payload.bumper is not known beside environment_mass_kg; leave one of them out.")


def _tightened(requirements: Requirements, found: _Found) -> Requirements:
    """Return the requirements with more asked of what was missed, of the modulus where a loop or contact fails."""
    asked = requirements.asked()
    missed = found.missed or ({_RESTS: _LOUDER} if _RESTS in asked else {})
    for name, ratio in missed.items():
        kind, factor = requirements.kind(name), _MORE * ratio
        level = requirements.threshold(name)
        try:
            moved = kind.with_threshold(asked[name], level / factor if kind.is_upper_limit else level * factor)
            requirements = requirements.with_asked(name, moved)
        except ParameterError:
            # More than can be asked of anything.
            continue
    return requirements
