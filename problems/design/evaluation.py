"""Evaluate a design over a set of scenarios: stability first, then every requirement as a number that must be ≤ 1."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

import numpy as np

from ..arrays import FloatArray
from ..contact.transient import Approach, build_sampled_contact
from ..errors import AutotuneError, ParameterError
from ..model.controller import AdmittanceController
from ..model.plant import Plant
from ..model.sampled import SampledPlant, build_sampled_plant
from ..stability.margins import Margins, UnstableLoopError, prepare_margins
from .objectives import Objective
from .problem import DesignProblem
from .requirements import Requirement, Requirements
from .stable_design import Peak, PreparedPlants, StableDesign
from .uncertainty import Scenario


@dataclass(frozen=True, kw_only=True)
class ObjectiveRow:
    """What the objective costs in one row (`Objective.costs`), and the scenario that the row belongs to."""

    scenario: Scenario
    cost: float


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """A design against its problem.

    `requirements` maps each requirement to required/achieved (≤ 1 is met), worst over the scenarios; it is empty
    and `peaks` too when the loop is unstable. `peaks` and the rows of the `objective` are also empty when a margin is
    missed, unless the peaks were asked for all the same. `soft` is the same as `requirements` of those that need not be
    met, `soft_cost_n` what each of them adds to the peak in `cost`.
    """

    controller: AdmittanceController
    spectral_radius: float
    requirements: Mapping[str, float]
    peaks: tuple[Peak, ...]
    objective: tuple[ObjectiveRow, ...] = ()
    soft: Mapping[str, float] = field(default_factory=dict)
    soft_cost_n: Mapping[str, float] = field(default_factory=dict)

    @property
    def objective_cost(self) -> float:
        """The largest cost of the objective, infinite where it was not evaluated."""
        return max((row.cost for row in self.objective), default=math.inf)

    @property
    def cost(self) -> float:
        """What a search minimises: the objective's cost, and what missed soft requirements add to it."""
        return self.objective_cost + self.penalty_n

    @property
    def penalty_n(self) -> float:
        """What missed soft requirements add to the peak force."""
        return sum(self.soft_cost_n.values())

    @property
    def is_stable(self) -> bool:
        """Whether every scenario is stable in contact and in free space."""
        return not self.spectral_radius >= 1.0

    @property
    def is_feasible(self) -> bool:
        """Whether the design is stable and meets every requirement."""
        return self.is_stable and all(value <= 1.0 for value in self.requirements.values())

    @property
    def violation(self) -> float:
        """How far the worst requirement is missed: 0 when feasible."""
        if not self.is_stable:
            return math.inf
        return max((value - 1.0 for value in self.requirements.values()), default=0.0)


@dataclass(frozen=True, kw_only=True)
class PlantMargins:
    """The margins of one plant of the uncertainty: that of `scenario`, or with `free_space` before it touches.

    `ratios` is required/achieved of every requirement of a loop.
    """

    scenario: Scenario
    free_space: bool
    margins: Margins
    ratios: Mapping[str, float]

    @property
    def payload_mass_kg(self) -> float:
        """M_p."""
        return self.scenario.payload_mass_kg

    @property
    def environment_stiffness_n_per_m(self) -> float:
        """K_e, 0 in free space."""
        return 0.0 if self.free_space else self.scenario.environment_stiffness_n_per_m


@dataclass(frozen=True, kw_only=True)
class ExactEvaluation:
    """An evaluation and the margins behind it, plant by plant."""

    evaluation: Evaluation
    margins: tuple[PlantMargins, ...]

    def together_with(self, other: "ExactEvaluation") -> "ExactEvaluation":
        """Return the evaluation of the same design over the scenarios of both."""
        own, more = self.evaluation, other.evaluation
        return ExactEvaluation(
            evaluation=replace(
                own,
                spectral_radius=max(own.spectral_radius, more.spectral_radius),
                requirements=_larger(own.requirements, more.requirements),
                peaks=own.peaks + more.peaks,
                objective=own.objective + more.objective,
                soft=_larger(own.soft, more.soft),
                soft_cost_n=_larger(own.soft_cost_n, more.soft_cost_n),
            ),
            margins=self.margins + other.margins,
        )


def _larger(one: Mapping[str, float], other: Mapping[str, float]) -> dict[str, float]:
    return {name: max(one.get(name, 0.0), other.get(name, 0.0)) for name in (*one, *other)}


@dataclass(frozen=True, kw_only=True)
class PreparedScenarios(PreparedPlants):
    """The scenarios of a design problem, with everything that does not depend on the design already computed."""

    problem: DesignProblem

    @property
    def approach(self) -> Approach:
        """How the contacts begin."""
        return self.problem.approach

    def evaluate(self, design: Sequence[float] | FloatArray, *, peaks_if_missed: bool = False) -> Evaluation:
        """Evaluate a design, the values of `problem.variables`, over the scenarios.

        `peaks_if_missed` asks for the peaks of a stable design that misses a requirement as well (a solver that walks
        along the boundary needs them).
        """
        controller = self.problem.controller(design)
        stable = StableDesign(self, controller)
        if not np.max(stable.radii) < 1.0:
            return Evaluation(
                controller=controller,
                # A radius that is not a number is no smaller than 1 either.
                spectral_radius=float(np.nan_to_num(np.max(stable.radii), nan=math.inf)),
                requirements={},
                peaks=(),
            )
        return self._evaluated(stable, self._margins(stable), peaks_if_missed)

    def evaluate_exactly(self, controller: AdmittanceController) -> ExactEvaluation:
        """Evaluate a stable controller with its margins plant by plant.

        Raises UnstableLoopError when any scenario is unstable.
        """
        return self.evaluate_stable(self.stable(controller))

    def evaluate_stable(self, design: StableDesign) -> ExactEvaluation:
        """Evaluate a controller whose loops are known to be stable, with its margins plant by plant."""
        margins = self._margins(design)
        return ExactEvaluation(evaluation=self._evaluated(design, margins, True), margins=margins)

    def stable(self, controller: AdmittanceController) -> StableDesign:
        """Return a controller with its stable loops; raises UnstableLoopError when any of them is not."""
        stable = StableDesign(self, controller)
        if not np.max(stable.radii) < 1.0:
            raise UnstableLoopError(float(np.max(stable.radii)))
        return stable

    def margins(self, controller: AdmittanceController) -> tuple[PlantMargins, ...]:
        """Find the margins of every plant's loop; raises UnstableLoopError when any of them is not stable."""
        return self._margins(self.stable(controller))

    def _margins(self, design: StableDesign) -> tuple[PlantMargins, ...]:
        asked = tuple(self.problem.requirements.of("loop"))
        ratios = {requirement.name: requirement.ratios(value, design) for requirement, value in asked}
        return tuple(
            PlantMargins(
                scenario=self.scenario_of(i),
                free_space=i >= len(self.scenarios),
                margins=design.loop(i).margins,
                ratios={name: float(values[i]) for name, values in ratios.items()},
            )
            for i in range(len(self.plants))
        )

    def _evaluated(self, design: StableDesign, margins: tuple[PlantMargins, ...], peaks_if_missed: bool) -> Evaluation:
        asked = self.problem.requirements
        ratios = {name: max(each.ratios[name] for each in margins) for name in margins[0].ratios}
        ratios |= {each.name: float(np.max(each.ratios(value, design))) for each, value in asked.of("robot")}
        hard, soft = asked.split(ratios)
        radius = float(np.max(design.radii))
        if not peaks_if_missed and any(value > 1.0 for value in hard.values()):
            return Evaluation(
                controller=design.controller,
                spectral_radius=radius,
                requirements=hard,
                peaks=(),
                soft=soft,
            )
        ratios |= {each.name: float(np.max(each.ratios(value, design))) for each, value in asked.of("contact")}
        hard, soft = asked.split(ratios)
        return Evaluation(
            controller=design.controller,
            spectral_radius=radius,
            requirements=hard,
            peaks=design.peaks,
            objective=self._objective(design),
            soft=soft,
            soft_cost_n={name: asked.cost_n(name, ratio) for name, ratio in soft.items()},
        )

    def _objective(self, design: StableDesign) -> tuple[ObjectiveRow, ...]:
        """Return the rows of the objective; of one of all scenarios together that of the scenario worst by itself."""
        objective, asked = self.problem.objective, self.problem.requirements
        costs = objective.costs(asked, design)
        if len(costs) == 1:
            return (ObjectiveRow(scenario=objective.worst_scenario(asked, design), cost=float(costs[0])),)
        scenarios = (objective.scenario(self, row) for row in range(len(costs)))
        return tuple(ObjectiveRow(scenario=s, cost=float(c)) for s, c in zip(scenarios, costs, strict=True))


def build_scenarios(problem: DesignProblem, scenarios: Sequence[Scenario]) -> PreparedScenarios:
    """Sample every scenario's plant, and every different one in free space, once."""
    h = problem.sample_time_s
    nominal = problem.plants.nominal
    pairs = tuple(build_sampled_contact(build_sampled_plant(s.plant(nominal), h)) for s in scenarios)
    # Every different plant in free space is evaluated once, with its first scenario.
    different: dict[Plant, tuple[SampledPlant, Scenario]] = {}
    for scenario, pair in zip(scenarios, pairs, strict=True):
        different.setdefault(pair.free.plant, (pair.free, scenario))
    free = sorted(different.values(), key=lambda each: each[1].payload_mass_kg)
    plants = tuple(prepare_margins(plant) for plant in (*(pair.contact for pair in pairs), *(f for f, _ in free)))
    return PreparedScenarios(
        problem=problem,
        scenarios=tuple(scenarios),
        pairs=pairs,
        plants=plants,
        free_of=tuple(scenario for _, scenario in free),
    )


class EvaluationFunction(ABC):
    """A number as one function of a whole evaluation, all scenarios together."""

    @abstractmethod
    def __call__(self, controller: AdmittanceController, problem: DesignProblem, evaluation: Evaluation) -> float:
        """Return the number, worst over the scenarios of `evaluation.peaks`; the loop is stable in all of them.

        The same arguments must give the same number, to the last bit: trials of different processes are compared.
        """

    def count(self, prepared: PreparedPlants) -> int:
        """Return 1: all scenarios together."""
        del prepared
        return 1

    def achieved(self, asked: Any, design: StableDesign, row: int) -> float:
        """Return the number, worst over all scenarios."""
        del asked, row
        return self._of(design, design.peaks)

    def _of(self, design: StableDesign, peaks: tuple[Peak, ...]) -> float:
        prepared = design.prepared
        if not isinstance(prepared, PreparedScenarios):
            raise TypeError("a function of an evaluation is computed for a design problem's scenarios only")
        evaluation = Evaluation(
            controller=design.controller,
            spectral_radius=float(np.max(design.radii)),
            requirements={},
            peaks=peaks,
        )
        try:
            return float(self(design.controller, prepared.problem, evaluation))
        except AutotuneError:
            raise
        except Exception as error:
            # Other people's code may raise anything.
            raise ParameterError(self._described(), error, "a number for every stable loop") from error

    @abstractmethod
    def _described(self) -> str:
        """Return what it is, with its name."""

    def scenario(self, prepared: PreparedPlants, row: int) -> Scenario:
        """Return any scenario; `worst_scenario` knows better."""
        del row
        return prepared.scenarios[0]

    def _worst_alone(self, design: StableDesign, *, is_large: bool) -> Scenario:
        """Return the scenario whose number by itself is the largest, or the least."""
        sign = 1.0 if is_large else -1.0
        return max(design.peaks, key=lambda peak: sign * self._of(design, (peak,))).scenario


class CustomRequirement(EvaluationFunction, Requirement[float]):
    """A requirement as one function of a whole evaluation: required/achieved, 0 or above, ≤ 1 is met.

    Its threshold is the largest such number, 1 unless it is relaxed.
    """

    depends_on: ClassVar[Literal["loop", "robot", "contact"]] = "contact"
    is_upper_limit = True

    def _described(self) -> str:
        return f"requirement {self.name}"

    def achieved(self, asked: Any, design: StableDesign, row: int) -> float:
        """Return required/achieved, worst over all scenarios; raises ParameterError for NaN or less than 0."""
        ratio = super().achieved(asked, design, row)
        if not ratio >= 0.0:
            raise ParameterError(self._described(), ratio, "required/achieved, 0 or above, for a stable loop")
        return ratio

    def worst_scenario(self, asked: float, design: StableDesign) -> Scenario:
        """Return the scenario that is worst by itself."""
        del asked
        return self._worst_alone(design, is_large=True)


class CustomObjective(EvaluationFunction, Objective):
    """An objective as one function of a whole evaluation."""

    def _described(self) -> str:
        return f"objective {self.name}"

    def worst_scenario(self, asked: Requirements, design: StableDesign) -> Scenario:
        """Return the scenario that is worst by itself."""
        del asked
        return self._worst_alone(design, is_large=self.direction == "minimize")
