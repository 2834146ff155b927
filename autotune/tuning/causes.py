"""Say why no controller meets the requirements: what of the plant is in the way, what to ask instead, and check it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np

from autotune.errors import InfeasibleError
from autotune.formats.canonical import lines_to_paste, place_to_paste
from autotune.formats.records import record_tree, rename_axis_keys
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from problems.arrays import FloatArray
from problems.design.batch_result import EVERY_REQUIREMENT
from problems.design.problem import DesignProblem
from problems.model.plant_parameters import with_values
from problems.model.robot import bandwidth_hz
from problems.progress import no_progress
from problems.text import significant

from .relax import ADMITTANCE, Relaxation, asked_of, find_met, find_relaxations, is_feasible, relaxation_message
from .search import SearchResult, solve_design

# What is suggested is easier by these shares than what was reached: a search from nowhere must find it again.
_EASIER = (0.03, 0.1)
# Who gives up more of a margin has none left: that is no way out to paste.
_MOST_EASED = 0.75
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

    `pairs` are causes that are enough two together, looked for where none is by itself;
    `suggestion` is a part of `problem.yaml` with which the search finds `found`; empty where none was found.
    """

    relaxations: tuple[Relaxation, ...]
    causes: tuple[Cause, ...] = ()
    pairs: tuple[tuple[Cause, ...], ...] = ()
    suggestion: dict[str, Any] = field(default_factory=dict)
    found: SearchResult | None = None
    is_known_too_little: bool = False

    @property
    def met_by(self) -> FloatArray | None:
        """A design (n,) that meets the requirements although the search found none; None without one."""
        met = self.relaxations[0].met_by if self.relaxations else ()
        return np.array(met) if met else None


def explain(
    name: str, problem: DesignProblem, *, seed: int, progress: Callable[[float], None] | None = None
) -> Explanation:
    """Return why no controller of the axis `name` meets the requirements, and what would be enough.

    Where a design turns up that meets them, nothing else is looked for (`Explanation.met_by`).

    `progress` gets the share of the work done since the last call.
    """
    report = progress or no_progress
    relaxations = find_relaxations(problem, seed=seed, progress=lambda share: report(0.6 * share))
    if not relaxations or relaxations[0].met_by:
        return Explanation(relaxations=relaxations)
    causes = find_causes(problem, seed=seed)
    pairs = () if causes else find_causes(problem, seed=seed, together=2)
    report(0.2)
    suggestion, found = _checked(name, problem, relaxations, seed)
    report(0.2)
    return Explanation(
        relaxations=relaxations,
        causes=tuple(cause for (cause,) in causes),
        pairs=pairs,
        suggestion=suggestion,
        found=found,
        is_known_too_little=_is_known_too_little(problem, seed),
    )


def _is_known_too_little(problem: DesignProblem, seed: int) -> bool:
    """Return whether the requirements can be met with all but K_e and M_p at its value; a short look comes first."""
    nominal = _nominal(problem)
    return bool(problem.plants.further) and find_met(nominal, seed=seed) is not None and is_feasible(nominal, seed=seed)


def find_causes(problem: DesignProblem, *, seed: int, together: int = 1) -> tuple[tuple[Cause, ...], ...]:
    """Return how much drag, how soft a hardest surface and how fast a robot would each be about enough.

    Each by itself, or as many `together`, every one eased by the same share of its way. Of the nominal plant over the
    corners and the middle of K_e and M_p, by bisection: a short global search looks whether every requirement can be
    met there. Such numbers are enough; that less is not, nobody proves.
    """
    nominal, found = _nominal(problem), []
    for ways in combinations(_easiest(problem), together):
        share = _enough(nominal, ways, seed) if all(way.value != way.easiest for way in ways) else None
        if share is not None:
            found.append(tuple(Cause(name=way.name, value=way.value, enough=way.at(share)) for way in ways))
    return tuple(found)


def explanation_message(name: str, problem: DesignProblem, why: Explanation) -> str:
    """Return sentences on what would be enough, what is in the way, and the lines for `problem.yaml`."""
    turning = name in ROTATIONAL_AXES
    said = [relaxation_message(problem, why.relaxations, turning=turning)]
    said.append(_causes_message(name, problem, why))
    if why.found is not None:
        objective = problem.objective
        unit = objective.unit_on(turning=turning)
        best = f"{objective.value(why.found.evaluation.cost):.4g} {unit}".rstrip()
        lines = "; ".join(lines_to_paste(why.suggestion))
        said.append(
            f"Checked: with these lines in problem.yaml {place_to_paste(why.suggestion)}, a little easier than just "
            f"enough, the search finds a controller, {objective.title} {best}: {lines}"
        )
    if why.is_known_too_little:
        said.append(
            "With everything but K_e and M_p at its nominal value there is one: the obstacle is how little is known of "
            f"{', '.join(problem.plants.further)}. Record more, or say in problem.yaml what is sure."
        )
    return " ".join(said)


def _causes_message(name: str, problem: DesignProblem, why: Explanation) -> str:
    units = axis_units(name)
    scale, unit = units.shown_stiffness
    if not why.causes:
        drag, hardest, robot = (way.easiest for way in _easiest(problem))
        said = (
            f"No single number of the plant is in the way: {drag:.3g} {units.damping} of damping to ground (B_p) would "
            f"not be enough, nor surfaces up to {scale * hardest:.3g} {unit}, nor a robot that follows to "
            f"{significant(robot)} Hz."
        )
        pairs = "; or ".join(" and ".join(_enough_text(name, each) for each in pair) for pair in why.pairs)
        return f"{said} Two together would be enough: {pairs}." if pairs else said
    return f"What is in the way: {'; '.join(_cause_text(name, each) for each in why.causes)}."


def _cause_text(name: str, cause: Cause) -> str:
    """Return a clause on a number of the plant and on what would be enough by itself."""
    units = axis_units(name)
    scale, unit = units.shown_stiffness
    if cause.name == "drag_n_s_per_m":
        has = f"this payload has {cause.value:.3g} {units.damping} of damping to ground (B_p)"
        return f"{has}, and about {significant(cause.enough)} would be enough"
    if cause.name == "robot_bandwidth_hz":
        of_kind = f"one of the same kind to about {cause.enough:.2g} Hz would be enough"
        return f"the robot follows to {cause.value:.3g} Hz, and {of_kind}"
    return (
        f"the surfaces are up to {scale * cause.value:.3g} {unit} hard (K_e), and up to about "
        f"{significant(scale * cause.enough)} a controller could meet what is asked"
    )


def _enough_text(name: str, cause: Cause) -> str:
    """Return what would be enough of one number of the plant, beside another."""
    units = axis_units(name)
    scale, unit = units.shown_stiffness
    if cause.name == "drag_n_s_per_m":
        return f"about {significant(cause.enough)} {units.damping} of damping to ground"
    if cause.name == "robot_bandwidth_hz":
        return f"a robot to about {cause.enough:.2g} Hz"
    return f"surfaces up to about {significant(scale * cause.enough)} {unit}"


def _nominal(problem: DesignProblem) -> DesignProblem:
    return replace(problem, plants=problem.plants.only())


@dataclass(frozen=True, kw_only=True)
class _Way:
    """A parameter of the plant from its value to the easiest one that is tried."""

    name: str
    value: float
    easiest: float

    def at(self, share: float) -> float:
        """Return the value at a share of the way, on a logarithmic scale."""
        start = max(self.value, self.easiest / _FARTHEST) if self.value < self.easiest else self.value
        return float(start * (self.easiest / start) ** share)


def _easiest(problem: DesignProblem) -> tuple[_Way, _Way, _Way]:
    """Return the ways of drag, of the hardest surface and of the robot's bandwidth."""
    plant = problem.plants.nominal
    drag, bandwidth = plant.payload.drag_n_s_per_m, bandwidth_hz(plant.robot)
    low, high = problem.plants.environment_stiffness_n_per_m
    return (
        _Way(name="drag_n_s_per_m", value=drag, easiest=_EASIEST * max(drag, _LITTLE_DRAG)),
        _Way(name="environment_stiffness_n_per_m", value=high, easiest=max(low, high / _EASIEST)),
        _Way(name="robot_bandwidth_hz", value=bandwidth, easiest=_FASTER * bandwidth),
    )


def _enough(problem: DesignProblem, ways: Sequence[_Way], seed: int) -> float | None:
    """Return a share of these ways at which nothing is missed, None if not at their end either."""
    known = find_met(_eased(problem, ways, 1.0), seed=seed)
    if known is None:
        return None
    last, good = 0.0, 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (last + good)
        nearer = find_met(_eased(problem, ways, middle), seed=seed, start=known)
        last, good, known = (middle, good, known) if nearer is None else (last, middle, nearer)
    return good


def _eased(problem: DesignProblem, ways: Sequence[_Way], share: float) -> DesignProblem:
    for way in ways:
        plants, value = problem.plants, way.at(share)
        if way.name in plants.ranges:
            low, _ = plants.ranges[way.name]
            problem = replace(problem, plants=plants.with_ranges({way.name: (low, value)}))
        else:
            problem = replace(problem, plants=replace(plants, nominal=with_values(plants.nominal, {way.name: value})))
    return problem


def _is_upper(problem: DesignProblem, relaxation: Relaxation) -> bool:
    """Return whether what is asked is a most, such as a peak, and not a least."""
    if relaxation.name == EVERY_REQUIREMENT:
        return False
    return problem.requirements.kind(relaxation.name).is_upper_limit


def _checked(
    name: str, problem: DesignProblem, relaxations: tuple[Relaxation, ...], seed: int
) -> tuple[dict[str, Any], SearchResult | None]:
    """Return a relaxation with which a search from nowhere finds a controller, as a part of `problem.yaml`.

    What a hand feels is given up before a margin.
    """
    for relaxation in sorted(relaxations, key=lambda each: each.name != ADMITTANCE)[:2]:
        if relaxation.name != ADMITTANCE and relaxation.share > _MOST_EASED and not _is_upper(problem, relaxation):
            continue
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
