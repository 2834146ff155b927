"""Say why no controller meets the requirements: what of the plant is in the way, what to ask instead, and check it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from autotune.errors import InfeasibleError
from autotune.formats.canonical import flow_text
from autotune.formats.records import record_tree, rename_axis_keys
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from problems.design.batch_evaluation import EVERY_REQUIREMENT
from problems.design.problem import DesignProblem
from problems.model.plant_parameters import with_values
from problems.model.robot import bandwidth_hz
from problems.progress import no_progress
from problems.text import significant

from .relax import ADMITTANCE, Relaxation, asked_of, can_meet, find_relaxations, is_feasible, relaxation_message
from .search import SearchResult, solve_design

# What is suggested is easier by these shares than what was reached: a search from nowhere must find it again.
_EASIER = (0.03, 0.1)
# How far a parameter of the plant is eased, and how often the way there is halved.
_EASIEST, _FASTER, _LITTLE_DRAG, _HALVINGS = 27.0, 4.0, 1.0, 3
_FARTHEST = 200.0


@dataclass(frozen=True, kw_only=True)
class Cause:
    """A number of the plant that is in the way, and the one at which the requirements would be met, about.

    `name` is that of the parameter, `environment_stiffness_n_per_m` for the upper end of its range.
    """

    name: str
    value: float
    enough: float


@dataclass(frozen=True, kw_only=True)
class Explanation:
    """Why a problem is infeasible: single relaxations, causes in the plant, and requirements that were checked.

    `suggestion` is a part of `problem.yaml` with which the search finds `found`; empty where none was found.
    """

    relaxations: tuple[Relaxation, ...]
    causes: tuple[Cause, ...] = ()
    suggestion: dict[str, Any] = field(default_factory=dict)
    found: SearchResult | None = None
    is_known_too_little: bool = False


def explain(
    name: str, problem: DesignProblem, *, seed: int, progress: Callable[[float], None] | None = None
) -> Explanation:
    """Return why no controller of the axis `name` meets the requirements, and what would be enough.

    `progress` gets the share of the work done since the last call.
    """
    report = progress or no_progress
    relaxations = find_relaxations(problem, seed=seed, progress=lambda share: report(0.6 * share))
    if not relaxations:
        return Explanation(relaxations=())
    causes = find_causes(problem, seed=seed)
    report(0.2)
    suggestion, found = _checked(name, problem, relaxations, seed)
    report(0.2)
    return Explanation(
        relaxations=relaxations,
        causes=causes,
        suggestion=suggestion,
        found=found,
        is_known_too_little=_is_known_too_little(problem, seed),
    )


def _is_known_too_little(problem: DesignProblem, seed: int) -> bool:
    """Return whether the requirements can be met with all but K_e and M_p at its value; a short look comes first."""
    nominal = _nominal(problem)
    return bool(problem.plants.further) and can_meet(nominal, seed=seed) and is_feasible(nominal, seed=seed)


def find_causes(problem: DesignProblem, *, seed: int) -> tuple[Cause, ...]:
    """Return how much drag, how soft a hardest surface and how fast a robot would each be about enough by itself.

    Of the nominal plant over the corners and the middle of K_e and M_p, by bisection: a short global search looks
    whether every requirement can be met there. Such a number is enough; that less is not, nobody proves.
    """
    nominal, easiest = _nominal(problem), _easiest(problem)
    found = {name: _enough(nominal, name, value, end, seed) for name, (value, end) in easiest.items() if value != end}
    return tuple(
        Cause(name=name, value=easiest[name][0], enough=each) for name, each in found.items() if each is not None
    )


def explanation_message(name: str, problem: DesignProblem, why: Explanation) -> str:
    """Return sentences on what would be enough, what is in the way, and the lines for `problem.yaml`."""
    said = [relaxation_message(problem, why.relaxations)]
    said.append(_causes_message(name, problem, why.causes))
    if why.found is not None:
        objective, turning = problem.objective, name in ROTATIONAL_AXES
        unit = objective.unit_on(turning=turning)
        best = f"{objective.value(why.found.evaluation.cost):.4g} {unit}".rstrip()
        said.append(
            f"Checked: with these lines in problem.yaml the search finds a controller, {objective.title} {best}: "
            f"{flow_text(why.suggestion)}"
        )
    if why.is_known_too_little:
        said.append(
            "With everything but K_e and M_p at its nominal value there is one: the obstacle is how little is known of "
            f"{', '.join(problem.plants.further)}. Record more, or say in problem.yaml what is sure."
        )
    return " ".join(said)


def _causes_message(name: str, problem: DesignProblem, causes: tuple[Cause, ...]) -> str:
    units, found = axis_units(name), {each.name: each for each in causes}
    scale, unit = units.shown_stiffness
    if not found:
        ends = {key: end for key, (_, end) in _easiest(problem).items()}
        return (
            f"No single number of the plant is in the way: {ends['drag_n_s_per_m']:.3g} {units.damping} of damping to "
            f"ground (B_p) would not be enough, nor surfaces up to {scale * ends['environment_stiffness_n_per_m']:.3g} "
            f"{unit}, nor a robot that follows to {significant(ends['robot_bandwidth_hz'])} Hz."
        )
    said = []
    drag = found.get("drag_n_s_per_m")
    if drag is not None:
        said.append(
            f"this payload has {drag.value:.3g} {units.damping} of damping to ground (B_p), and about "
            f"{significant(drag.enough)} would be enough"
        )
    hardest = found.get("environment_stiffness_n_per_m")
    if hardest is not None:
        said.append(
            f"the surfaces are up to {scale * hardest.value:.3g} {unit} hard (K_e), and up to about "
            f"{significant(scale * hardest.enough)} a controller could meet what is asked"
        )
    robot = found.get("robot_bandwidth_hz")
    if robot is not None:
        said.append(
            f"the robot follows to {robot.value:.3g} Hz, and one of the same kind to about {robot.enough:.2g} Hz would "
            "be enough"
        )
    return f"What is in the way: {'; '.join(said)}."


def _nominal(problem: DesignProblem) -> DesignProblem:
    return replace(problem, plants=problem.plants.only())


def _easiest(problem: DesignProblem) -> dict[str, tuple[float, float]]:
    """Return for each parameter that is looked at its value, and the easiest one that is tried."""
    plant = problem.plants.nominal
    drag, bandwidth = plant.payload.drag_n_s_per_m, bandwidth_hz(plant.robot)
    low, high = problem.plants.environment_stiffness_n_per_m
    return {
        "drag_n_s_per_m": (drag, _EASIEST * max(drag, _LITTLE_DRAG)),
        "environment_stiffness_n_per_m": (high, max(low, high / _EASIEST)),
        "robot_bandwidth_hz": (bandwidth, _FASTER * bandwidth),
    }


def _enough(problem: DesignProblem, name: str, value: float, easiest: float, seed: int) -> float | None:
    """Return a value of one parameter at which nothing is missed, None if not at the easiest one either."""
    if not can_meet(_eased(problem, name, easiest), seed=seed):
        return None
    last, good = max(value, easiest / _FARTHEST) if value < easiest else value, easiest
    for _ in range(_HALVINGS):
        middle = math.sqrt(last * good)
        last, good = (last, middle) if can_meet(_eased(problem, name, middle), seed=seed) else (middle, good)
    return good


def _eased(problem: DesignProblem, name: str, value: float) -> DesignProblem:
    plants = problem.plants
    if name in plants.ranges:
        low, _ = plants.ranges[name]
        return replace(problem, plants=plants.with_ranges({name: (low, value)}))
    return replace(problem, plants=replace(plants, nominal=with_values(plants.nominal, {name: value})))


def _checked(
    name: str, problem: DesignProblem, relaxations: tuple[Relaxation, ...], seed: int
) -> tuple[dict[str, Any], SearchResult | None]:
    """Return a relaxation with which a search from nowhere finds a controller, as a part of `problem.yaml`.

    What a hand feels is given up before a margin.
    """
    for relaxation in sorted(relaxations, key=lambda each: each.name != ADMITTANCE)[:2]:
        for share in _EASIER:
            eased = relaxation.within(problem.requirements, share)
            try:
                found = solve_design(replace(problem, requirements=eased), seed=seed)
            except InfeasibleError:
                continue
            names = asked_of(problem.requirements) if relaxation.name == EVERY_REQUIREMENT else (relaxation.name,)
            asked = {each: record_tree(eased.asked()[each], each) for each in names}
            tree = rename_axis_keys(name, {"requirements": asked}, reading=False)
            return ({"rotational": tree} if name in ROTATIONAL_AXES else tree), found
    return {}, None
