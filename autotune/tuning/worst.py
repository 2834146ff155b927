"""Look for the worst plant of the whole uncertainty: grid, corners, samples, then a local search from the worst few."""

from collections.abc import Callable, Container, Sequence

import numpy as np
from numpy.typing import NDArray

from problems.design.evaluation import Evaluation, ExactEvaluation, build_scenarios
from problems.design.problem import DesignProblem
from problems.design.stable_design import StableDesign
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.stability.margins import UnstableLoopError

FloatArray = NDArray[np.float64]

DENSE_STIFFNESS, DENSE_MASS = 33, 3
SAMPLES = 128
# A margin this far from its limit on every plant that was looked at does not reach it between them.
_NEAR = 0.9
_STARTS = 2
_LOOKS = 60
_FIRST_STEP, _LAST_STEP = 0.08, 0.002
_GAIN = 1e-4
_UNSTABLE = 8


class WholeSet:
    """The scenarios of a problem's whole uncertainty, prepared once, and the search between them.

    `scenarios` are the dense grid of K_e × M_p at the nominal plant and, where more is uncertain, the corners of the
    set and samples of it, and those of `also`. Deterministic for a given seed.
    """

    def __init__(self, problem: DesignProblem, seed: int = 0, also: tuple[Scenario, ...] = ()) -> None:
        self.problem = problem
        self.uncertainty = problem.uncertainty
        grid = problem.scenarios(DENSE_STIFFNESS, DENSE_MASS)
        more = (*self.uncertainty.corners(), *self.uncertainty.samples(SAMPLES, seed=seed)) if problem.uncertain else ()
        self.prepared = build_scenarios(problem, tuple(dict.fromkeys((*grid, *more, *also))))

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The scenarios that every design is held against."""
        return self.prepared.scenarios

    def evaluate(self, controller: AdmittanceController) -> ExactEvaluation:
        """Evaluate exactly over the scenarios, and at the worst plants that a local search finds from them.

        Raises UnstableLoopError when any of them is unstable.
        """
        exact = self.prepared.evaluate_exactly(controller)
        found = self._search(controller, exact)
        if not found:
            return exact
        return exact.together_with(build_scenarios(self.problem, found).evaluate_exactly(controller))

    def unstable(self, controller: AdmittanceController) -> tuple[Scenario, ...]:
        """Return the scenarios of the largest spectral radii among those that are unstable."""
        radii = self.prepared.radii(controller)
        of_plant = (*self.prepared.scenarios, *self.prepared.free_of)
        order = np.argsort(-radii, kind="stable")
        found = (of_plant[i] for i in order if not radii[i] < 1.0)
        return tuple(dict.fromkeys(found))[:_UNSTABLE]

    def worst_of(self, exact: Evaluation, names: Container[str], *depends_on: str) -> tuple[Scenario, ...]:
        """Return the worst scenario for each of these requirements that depends on the robot, or on the contact."""
        design = StableDesign(self.prepared, exact.controller, peaks=exact.peaks)
        asked = [(each, value) for each, value in self.problem.requirements.of(*depends_on) if each.name in names]
        return tuple(each.worst_scenario(value, design) for each, value in asked)

    def _search(self, controller: AdmittanceController, exact: ExactEvaluation) -> tuple[Scenario, ...]:
        if not self.uncertainty.varying:
            return ()
        found: list[Scenario] = []
        for name, value in (*exact.evaluation.requirements.items(), *exact.evaluation.soft.items()):
            values = [each.ratios.get(name) for each in exact.margins]
            if value < _NEAR or any(each is None for each in values):
                continue
            starts = _worst([m.scenario for m in exact.margins], [each or 0.0 for each in values])
            found += [self._climb(start, lambda s, n=name: self._missed(s, controller, n)) for start in starts]  # type: ignore[misc]
        peaks = exact.evaluation.peaks
        # The objective's force, and that at the contact, which may be limited whatever the objective is.
        for at_contact in {True, self.problem.objective == "contact_force"}:
            values = [p.peak_contact_force_n if at_contact else p.peak_sensor_force_n for p in peaks]
            starts = _worst([p.scenario for p in peaks], [each or 0.0 for each in values])
            found += [self._climb(start, lambda s, c=at_contact: self._peak(s, controller, c)) for start in starts]  # type: ignore[misc]
        known = set(self.scenarios)
        return tuple(s for s in dict.fromkeys(found) if s not in known)

    def _missed(self, scenario: Scenario, controller: AdmittanceController, name: str) -> float:
        """Return required/achieved of one requirement in one scenario; infinite where the loop is unstable."""
        try:
            found = build_scenarios(self.problem, [scenario])
            return max(each.ratios[name] for each in found.margins(controller))
        except UnstableLoopError:
            return np.inf

    def _peak(self, scenario: Scenario, controller: AdmittanceController, at_contact: bool) -> float:
        """Return the peak force [N] in one scenario; infinite where the loop is unstable."""
        found = build_scenarios(self.problem, [scenario])
        try:
            peak = found.stable(controller).peak(0)
        except UnstableLoopError:
            return np.inf
        return peak.peak_contact_force_n if at_contact else peak.peak_sensor_force_n

    def _climb(self, start: Scenario, value: Callable[[Scenario], float]) -> Scenario:
        """Return a scenario that is at least as bad: a pattern search in the unit cube, pulled into the set."""
        unit, best = self.uncertainty.to_unit(start), start
        worst, step, looks = value(start), _FIRST_STEP, 0
        while step >= _LAST_STEP and looks < _LOOKS and np.isfinite(worst):
            moved = False
            for direction in (*np.eye(len(unit)), *-np.eye(len(unit))):
                there = np.clip(unit + step * direction, 0.0, 1.0)
                scenario = self.uncertainty.from_unit(there)
                if np.array_equal(there, unit) or scenario == best:
                    continue
                found, looks = value(scenario), looks + 1
                if found > worst * (1.0 + _GAIN):
                    unit, best, worst, moved = there, scenario, found, True
                    break
            if not moved:
                step *= 0.25
        return best


def _worst(scenarios: Sequence[Scenario], values: Sequence[float]) -> list[Scenario]:
    """Return the scenarios of the largest values, a different one each."""
    order = sorted(range(len(values)), key=lambda i: -values[i])
    return list(dict.fromkeys(scenarios[i] for i in order[: 4 * _STARTS]))[:_STARTS]
