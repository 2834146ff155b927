"""Search axes again that do not go together on their payload: each beside the laws of the others, until all do."""

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from autotune.errors import InfeasibleError
from autotune.formats.controller_record import RuntimePayload
from autotune.formats.units import axis_units
from autotune.validation.coupled_cell import CoupledCell
from autotune.validation.coupled_failure import CoupledFailure, TouchedPoint
from autotune.validation.coupled_sweep import CoupledPlants, damped_by
from problems.model.controller import AdmittanceController
from problems.model.coupled import Law

from .coupled import OnPayload, TogetherCheck, heavier_factor, refusal_text
from .record import build_domain
from .scenario_exchange import NOTHING, Counterexamples
from .search import SearchResult, solve_design

_ROUNDS = 4
# Of the modulus that is asked of one axis, what is asked of several that have failed: a search for stability alone ends
# at its edge. Where nothing is asked of one axis, the modulus itself.
_SHARE, _LEAST_MODULUS = 0.8, 0.1
Searches = Mapping[str, SearchResult]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Beside:
    """Whether a law of one axis goes with those of the others, of one group of them or of all."""

    plants: CoupledPlants
    laws: Mapping[str, Law]
    name: str
    group: tuple[str, ...] = ()

    def __call__(self, law: AdmittanceController) -> bool:
        return self.plants.failure({**self.laws, self.name: law}, self.group) is None


class CoupledSearch:
    """What the designs of several axes must pass together, and the search for designs that do.

    `beside` is NOTHING until they have failed once. `notes` says in words what was searched again.
    """

    def __init__(self, check: TogetherCheck, payload: RuntimePayload, seed: int) -> None:
        self._check, self._payload, self._seed = check, payload, seed
        self._plants: CoupledPlants | None = None
        self._first: tuple[CoupledFailure, Searches] | None = None

    def beside(self, name: str, searches: Searches) -> Counterexamples:
        """Return what one axis must pass beside the designs of the others."""
        if self._plants is None:
            return NOTHING
        return Counterexamples(beside=_Beside(plants=self._plants, laws=_laws(searches), name=name))

    def agreed(self, searches: Searches, settle: Callable[[Searches], Searches]) -> Searches:
        """Return designs that `settle` keeps and that pass together, those that were given where they do.

        Raises InfeasibleError where no search finds such designs.
        """
        if not self._check.is_asked:
            return settle(searches)
        for done in itertools.count():
            # Unstable together: nothing of it is worth a proof.
            failure = self._quick_failure(searches)
            if failure is None:
                searches = settle(searches)
                found = self._sweep(searches)
                failure = None if found.sweep is None else found.sweep.failure
            if failure is None:
                break
            if done == _ROUNDS:
                raise InfeasibleError(refusal_text(self._cell(searches), failure, f"{_ROUNDS} times, in vain"))
            searches = self._searched_again(searches, failure)
        return searches

    def notes(self, searches: Searches) -> Iterator[str]:
        """Yield what was searched again, and what it costs."""
        if self._first is None:
            return
        failure, before = self._first
        changed = []
        for name, each in searches.items():
            objective, unit = each.problem.objective, axis_units(name)
            old, new = (objective.value(found.evaluation.cost) for found in (before[name], each))
            if old != new:
                changed.append(f"{name}: {objective.title} {old:.4g} before, {new:.4g} now ({unit.force})")
        message = failure.message()
        yield (
            f"Each axis by itself had another design, but {message}. They were searched again beside each other, for "
            f"a smallest singular value of I + L of {self._check.asked.least_modulus:.3g}; {'; '.join(changed)}."
        )

    def _cell(self, searches: Searches) -> CoupledCell:
        found = self._place(searches)
        if found.cell is None:
            raise InfeasibleError(found.unchecked)
        return found.cell

    def _place(self, searches: Searches) -> OnPayload:
        domains = {name: build_domain(each.problem) for name, each in searches.items()}
        h = next(iter(searches.values())).problem.sample_time_s
        return self._check.asked.place(domains, _laws(searches), self._payload, h)[0]

    def _sweep(self, searches: Searches) -> OnPayload:
        domains = {name: build_domain(each.problem) for name, each in searches.items()}
        h = next(iter(searches.values())).problem.sample_time_s
        return self._check.sweep(domains, _laws(searches), self._payload, h)

    def _quick_failure(self, searches: Searches) -> CoupledFailure | None:
        placed = self._place(searches)
        if placed.cell is None:
            return None
        plants = CoupledPlants(placed.cell) if self._plants is None else self._plants
        return plants.failure(placed.cell.laws)

    def _searched_again(self, searches: Searches, failure: CoupledFailure) -> Searches:
        """Return other designs that pass what failed: of those that are found, the ones that cost least."""
        cell = self._cell(searches)
        self._first = self._first or (failure, searches)
        touched: tuple[TouchedPoint, ...] = () if self._plants is None else self._plants.touched
        touched += () if failure.touched is None else (failure.touched,)
        least = self._check.asked.least_modulus or _least_modulus(searches)
        self._check.asked = replace(self._check.asked, least_modulus=least)
        self._plants = CoupledPlants(cell, touched, least)
        found, reasons = [], []
        for order, laws in self._ways(cell, self._plants, failure.group):
            first = _Beside(plants=self._plants, laws=laws, name=order[0], group=failure.group)
            try:
                found.append(self._one_after_the_other(searches, order, first))
            except InfeasibleError as error:
                reasons.append(str(error))
        if not found:
            raise InfeasibleError(refusal_text(cell, failure, " ".join(dict.fromkeys(reasons))))
        return min(found, key=lambda each: _dearer(each, searches))

    def _ways(
        self, cell: CoupledCell, plants: CoupledPlants, group: tuple[str, ...]
    ) -> Iterator[tuple[tuple[str, ...], Mapping[str, Law]]]:
        """Yield which axes of a group are searched, one after the other, and the laws that they begin beside.

        One axis alone beside the others as they are; or all of them, beside others that are heavy enough.
        """
        tuned = tuple(name for name in group if name in cell.laws)
        for name in tuned:
            yield (name,), cell.laws
        factor = heavier_factor(cell, group, plants) if len(tuned) > 1 else None
        if factor is not None:
            # A second time each, as the first ones stood beside laws that were still heavier.
            yield 2 * tuned, {**cell.laws, **{name: damped_by(cell, factor).laws[name] for name in tuned}}

    def _one_after_the_other(self, searches: Searches, order: tuple[str, ...], first: _Beside) -> Searches:
        """Return the searches with those of `order` made again, each beside the laws of all others at that time."""
        laws, found = dict(first.laws), dict(searches)
        for name in order:
            problem, asked = searches[name].problem, Counterexamples(beside=replace(first, laws=dict(laws), name=name))
            try:
                found[name] = solve_design(problem, seed=self._seed, start=found[name].design, counterexamples=asked)
            except InfeasibleError as error:
                raise InfeasibleError(f"Axis {name}: {error.bare}.") from error
            laws[name] = problem.controller(found[name].design)
        return found


def _least_modulus(searches: Searches) -> float:
    asked = [each.problem.requirements.modulus_margin for each in searches.values()]
    return min((_SHARE * each for each in asked if each is not None), default=_LEAST_MODULUS)


def _laws(searches: Searches) -> dict[str, Law]:
    return {name: each.problem.controller(each.design) for name, each in searches.items()}


def _dearer(found: Searches, before: Searches) -> float:
    """Return by what share of what it was an objective is worse, the sum over the axes."""
    costs = ((found[name].evaluation.cost, before[name].evaluation.cost) for name in found)
    return sum((new - old) / abs(old) if old else new - old for new, old in costs)
