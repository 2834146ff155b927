"""Points of a front: a controller in one of the structures, judged exactly over the dense grid of the uncertainty."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from autotune.errors import AutotuneError, UsageError
from autotune.tuning.scenario_exchange import WholeSet
from problems.arrays import FloatArray
from problems.design.objectives import Objective
from problems.design.problem import DesignProblem
from problems.design.stable_design import StableDesign
from problems.errors import ParameterError
from problems.frozen import Count, FrozenDict, Text
from problems.model.controller import AdmittanceController, Discretization

from .plugins import Demand, ObjectiveLimit

Sampler = Literal["tpe", "nsga2"]


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """A stable controller against its problem: `values` of the objectives, `requirements` as required/achieved."""

    controller: AdmittanceController
    values: Mapping[str, float]
    requirements: Mapping[str, float]

    @property
    def is_feasible(self) -> bool:
        """Whether every requirement is met."""
        return all(value <= 1.0 for value in self.requirements.values())


@dataclass(frozen=True, kw_only=True)
class StudyRecord:
    """What an Optuna study behind a front did: its name, sampler, finished trials, and how many were feasible."""

    name: Text
    sampler: Sampler
    trials: Count
    feasible: Count


@dataclass(frozen=True, kw_only=True)
class Front:
    """The points of one axis that no other one beats, from the gentlest in the first objective on.

    `chosen` is the index of the controller that `optimize` chose, None where another point beats it or it misses a
    demand of the study.
    """

    problem: DesignProblem
    objectives: tuple[Objective, ...]
    points: tuple[Judgement, ...]
    scenario_count: int
    chosen: int | None
    study: StudyRecord | None = None


class Judge:
    """Judges controllers over the dense grid, corners and samples of a problem's uncertainty, margins exactly."""

    def __init__(
        self, problem: DesignProblem, objectives: tuple[Objective, ...], demands: tuple[Demand, ...] = ()
    ) -> None:
        self.problem, self.demands = problem, demands
        self.objectives = tuple(each.beside(problem.objective) for each in objectives)
        self._prepared = WholeSet(problem).prepared

    @property
    def scenario_count(self) -> int:
        """How many scenarios a controller is judged in."""
        return len(self._prepared.scenarios)

    def judge(self, controller: AdmittanceController) -> Judgement:
        """Judge one controller; raises UnstableLoopError where no number of it means anything."""
        design = self._prepared.stable(controller)
        evaluation = self._prepared.evaluate_stable(design).evaluation
        values = {each.name: _finite(each.name, self._ask(each, design)) for each in self.objectives}
        asked = {each.name: _required(each.name, self._ask(each, design)) for each in self.demands}
        return Judgement(
            controller=controller,
            values=FrozenDict(values),
            requirements=FrozenDict({**evaluation.requirements, **asked}),
        )

    def _ask(self, plugin: Objective | Demand, design: StableDesign) -> float:
        # Other people's code may raise anything.
        try:
            if isinstance(plugin, ObjectiveLimit):
                return plugin.ratio(self.problem, design)
            if isinstance(plugin, Objective):
                return plugin.worst(self.problem.requirements, design)
            return plugin.achieved(1.0, design, 0)
        except AutotuneError:
            raise
        except Exception as error:
            raise UsageError(f"{plugin.name} failed on {design.controller}: {error!r}.") from error


def undominated(points: Sequence[Judgement], objectives: tuple[Objective, ...]) -> tuple[Judgement, ...]:
    """Return the feasible points that no other one beats, sorted by the objectives; of equal ones the first.

    One beats another that is no better in any objective and worse in at least one.
    """
    feasible = [point for point in points if point.is_feasible]
    costs = [_costs(point, objectives) for point in feasible]
    kept: dict[tuple[float, ...], Judgement] = {}
    for point, cost in zip(feasible, costs, strict=True):
        if cost not in kept and not any(_beats(other, cost) for other in costs):
            kept[cost] = point
    return tuple(kept[cost] for cost in sorted(kept))


def _costs(point: Judgement, objectives: tuple[Objective, ...]) -> tuple[float, ...]:
    """Return the objectives as numbers that should all be small."""
    return tuple(point.values[o.name] * (1.0 if o.direction == "minimize" else -1.0) for o in objectives)


def _beats(one: tuple[float, ...], other: tuple[float, ...]) -> bool:
    return one != other and all(a <= b for a, b in zip(one, other, strict=True))


def index_of(controller: AdmittanceController, points: Sequence[Judgement]) -> int | None:
    """Return the index of a controller among the points."""
    return next((i for i, point in enumerate(points) if point.controller == controller), None)


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise ParameterError(f"objective {name}", value, "a finite number for a stable loop")
    return float(value)


def _required(name: str, value: float) -> float:
    if not value >= 0.0:
        raise ParameterError(f"requirement {name}", value, "required/achieved, 0 or above")
    return float(value)


def thinned(
    points: tuple[Judgement, ...], objectives: tuple[Objective, ...], count: int | None, keep: int | None
) -> tuple[Judgement, ...]:
    """Return at most `count` of the points: the best in each objective, the one to `keep`, then the most distant ones.

    Distance is that of the objectives, each scaled to its range over the points. None returns all of them.
    """
    if count is None or len(points) <= count:
        return points
    costs = np.array([_costs(point, objectives) for point in points])
    span = np.ptp(costs, axis=0)
    scaled = (costs - costs.min(axis=0)) / np.where(span > 0.0, span, 1.0)
    kept = list(dict.fromkeys([*([] if keep is None else [keep]), *(int(i) for i in np.argmin(scaled, axis=0))]))[
        :count
    ]
    while len(kept) < count:
        distance = np.min(np.linalg.norm(scaled[:, None] - scaled[kept][None], axis=2), axis=1)
        kept.append(int(np.argmax(distance)))
    return tuple(points[i] for i in sorted(kept))


STRUCTURES: Mapping[str, tuple[str, ...]] = FrozenDict(
    {
        "discretization": ("tustin", "backward_euler", "forward_euler"),
        "compensation": ("off", "filtered"),
        "lead": ("on", "off"),
        "feedback": ("on", "off"),
    }
)
"""Discrete choices that may be left to a study, beside the numbers; the first of each is what `optimize` writes."""

_FORMS: Mapping[str, Discretization] = {
    "tustin": "tustin",
    "backward_euler": "backward_euler",
    "forward_euler": "forward_euler",
}


def check_choices(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names; raises UsageError for one that is not in `STRUCTURES` or occurs twice."""
    unknown = [name for name in names if name not in STRUCTURES]
    if unknown:
        raise UsageError(f"{unknown[0]!r} cannot be left to a study; there are: {', '.join(STRUCTURES)}.")
    if len(set(names)) != len(names):
        raise UsageError(f"Each choice may be named once; found {', '.join(names)}.")
    return names


def design_of(problem: DesignProblem, controller: AdmittanceController) -> FloatArray:
    """Return the values of `problem.variables` (n,) that `problem.controller` makes this controller of."""
    fields = {"mass": "mass_kg", "damping": "damping_n_s_per_m"}
    return np.array([getattr(controller, fields.get(name, name)) for name in problem.variables])


def build_controller(problem: DesignProblem, design: FloatArray, chosen: Mapping[str, str]) -> AdmittanceController:
    """Return the controller of a design, the values of `problem.variables`, in the chosen structure.

    `chosen` maps names of `STRUCTURES` to one of their values. With the compensation, P̂ is the middle of the payload's
    range unless it is a variable; a part that is off has the gain 0, whatever the design says.
    """
    low, high = problem.plants.payload_mass_kg
    base = problem.controller(design)
    compensation = base.compensation_mass_kg
    if "compensation" in chosen:
        compensation = (compensation or 0.5 * (low + high)) if chosen["compensation"] == "filtered" else 0.0
    return replace(
        base,
        discretization=_FORMS[chosen.get("discretization", "tustin")],
        compensation_mass_kg=compensation,
        lead_s=0.0 if chosen.get("lead") == "off" else base.lead_s,
        feedback_damping_s=0.0 if chosen.get("feedback") == "off" else base.feedback_damping_s,
    )
