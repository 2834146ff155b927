"""The free-space admittance that is asked where nobody says one: up to where the robot follows, and what can be had."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from autotune.formats.units import axis_units
from problems.arrays import FloatArray
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.evaluation import build_scenarios
from problems.design.problem import AdmittanceTarget, DesignProblem, Requirements
from problems.model.robot import RobotModel, bandwidth_hz
from problems.progress import no_progress
from problems.text import rounded_down

from .bounds import Box
from .descent import descend
from .relax import ADMITTANCE, attainable
from .search import SearchResult

# Up to a third of its bandwidth a robot of one or two poles follows to 5 %: there the target asks for an admittance,
# above it for the robot's roll-off to be made up for at lower frequencies.
_SHARE_OF_BANDWIDTH = 1.0 / 3.0
_BAND_DIGITS = 2
# Of the most that can be had: the very most leaves one design and no choice of a gentle one.
_SHARE_OF_ATTAINABLE = 0.8
_HAIR = 1e-3
# A slow hand, at which the force is said that it needs [m/s or rad/s].
_HAND_SPEED = 0.1


@dataclass(frozen=True, kw_only=True)
class DefaultAdmittance:
    """What was asked of one axis by default, and what it costs.

    `attainable` is the most that was found [m/s/N], where the usual target cannot be had; `usual` is that target.
    `objective` is the value of the objective at the design, `objective_with_usual` that of a design with the usual
    target over the hardest contacts, None where none was found or looked for.
    """

    target: AdmittanceTarget
    usual: AdmittanceTarget
    robot_bandwidth_hz: float
    attainable: float | None
    objective: float
    objective_with_usual: float | None

    @property
    def is_lowered(self) -> bool:
        """Whether less is asked than usual, since the usual target cannot be had."""
        return self.attainable is not None

    def tree(self) -> dict[str, Any]:
        """Return plain data, for the provenance of a controller."""
        targets = {"used": self.target, "usual": self.usual}
        return {
            "free_space_admittance": {
                **{key: {"min_m_s_per_n": t.min_m_s_per_n, "band_hz": list(t.band_hz)} for key, t in targets.items()},
                "robot_bandwidth_hz": self.robot_bandwidth_hz,
                "attainable": None if self.attainable is None else {"min_m_s_per_n": self.attainable},
                "objective": {"used": self.objective, "usual": self.objective_with_usual},
            }
        }


def follow_robot(asked: Requirements, robot: RobotModel) -> Requirements:
    """Return the requirements with the band of a default admittance ending where the robot still follows.

    That is a third of its bandwidth, at most the usual end. A target that somebody asked for stays as it is.
    """
    target = asked.free_space_admittance
    if target is None or not target.is_default:
        return asked
    low, high = target.band_hz
    end = rounded_down(_SHARE_OF_BANDWIDTH * bandwidth_hz(robot), _BAND_DIGITS)
    return replace(asked, free_space_admittance=replace(target, band_hz=(min(low, end), min(high, end))))


def lower_default(
    problem: DesignProblem, *, seed: int, progress: Callable[[float], None] = no_progress
) -> DesignProblem | None:
    """Return the problem with four fifths of the admittance that can be had, where a default asks for more.

    None where somebody asked for it, where it can be had, or where no admittance makes the rest feasible.
    """
    target = problem.requirements.free_space_admittance
    if target is None or not target.is_default or ADMITTANCE in problem.requirements.soft_n:
        return None
    most = attainable(problem, seed=seed, progress=progress)
    if most is None or most >= target.min_m_s_per_n:
        return None
    lowered = replace(target, min_m_s_per_n=rounded_down(_SHARE_OF_ATTAINABLE * most, _BAND_DIGITS))
    return _with_target(problem, lowered)


def beside_margins(problem: DesignProblem, *, seed: int) -> DesignProblem:
    """Return the problem with the default admittance that can be had where no peak is limited.

    What is said of a limit that no controller meets is then about that limit, and not about what nobody asked for. A
    problem without such limits, or whose usual admittance can be had, stays as it is.
    """
    asked = problem.requirements
    without = asked
    for kind, _ in asked.of("contact"):
        without = without.with_asked(kind.name, None)
    lowered = None if without == asked else lower_default(replace(problem, requirements=without), seed=seed)
    target = None if lowered is None else lowered.requirements.free_space_admittance
    return problem if target is None else _with_target(problem, target)


def default_admittance(asked: DesignProblem, found: SearchResult) -> DefaultAdmittance | None:
    """Return what was asked by default of the axis of a search; None where nothing of it followed the cell.

    `asked` is the problem before `lower_default`.
    """
    before, target = asked.requirements.free_space_admittance, found.problem.requirements.free_space_admittance
    if before is None or target is None or not target.is_default:
        return None
    # A threshold does not depend on the robot, so it is the usual one in the units of the axis.
    usual = AdmittanceTarget(min_m_s_per_n=before.min_m_s_per_n)
    if target == usual:
        return None
    is_lowered = target.min_m_s_per_n < before.min_m_s_per_n
    objective = found.problem.objective
    cost = None if is_lowered else _cost_of(_with_target(found.problem, usual), found)
    return DefaultAdmittance(
        target=target,
        usual=usual,
        robot_bandwidth_hz=bandwidth_hz(found.problem.plants.nominal.robot),
        attainable=target.min_m_s_per_n / _SHARE_OF_ATTAINABLE if is_lowered else None,
        objective=float(objective.value(found.evaluation.cost)),
        objective_with_usual=None if cost is None else float(objective.value(cost)),
    )


def default_message(name: str, default: DefaultAdmittance, problem: DesignProblem) -> str:
    """Return sentences on what was asked of an axis by default, why, and what the usual target would cost."""
    units, target, usual = axis_units(name), default.target, default.usual
    objective, turning = problem.objective, axis_units(name).force != "N"
    unit = objective.unit_on(turning=turning)
    said = (
        f"Axis {name}: nobody asked for a free-space admittance, so {target.min_m_s_per_n:g} {units.admittance} are "
        f"asked from {target.band_hz[0]:g} to {target.band_hz[1]:g} Hz"
    )
    if target.band_hz[1] < usual.band_hz[1]:
        said += f", a third of the robot's bandwidth of {default.robot_bandwidth_hz:.3g} Hz"
    if default.attainable is not None:
        return (
            f"{said}; the usual {usual.min_m_s_per_n:g} cannot be had in this cell beside the other requirements, only "
            f"about {default.attainable:.3g}. To move it at {_HAND_SPEED:g} {units.speed} a hand needs up to "
            f"{_HAND_SPEED / target.min_m_s_per_n:.3g} {units.force}, with the usual one "
            f"{_HAND_SPEED / usual.min_m_s_per_n:.3g}. Write free_space_admittance into problem.yaml, and optimize "
            "says what of the plant is in the way of it."
        )
    here = f"{objective.title} is {default.objective:.4g} {unit}".rstrip()
    if default.objective_with_usual is None:
        return f"{said}; up to the usual {usual.band_hz[1]:g} Hz no controller was found. The {here}."
    there = f"{default.objective_with_usual:.4g} {unit}".rstrip()
    return f"{said}; the {here}, and with the usual band to {usual.band_hz[1]:g} Hz it would be {there}."


def _with_target(problem: DesignProblem, target: AdmittanceTarget) -> DesignProblem:
    return replace(problem, requirements=replace(problem.requirements, free_space_admittance=target))


def _cost_of(problem: DesignProblem, found: SearchResult) -> float | None:
    """Return the least cost of a problem over the scenarios of a search, by descents from its design.

    The second start has that admittance already; None where neither meets the requirements.
    """
    screen, box = build_batch_evaluator(build_scenarios(problem, found.active.scenarios)), Box(problem)
    faster: FloatArray = found.design.copy()
    faster[:2] /= max(1.0, float(screen.evaluate(faster[None], peaks_if_missed=True).requirements[ADMITTANCE][0]))
    costs = []
    for start in (found.design, faster):
        unit = descend(screen, box, box.unit(start)).unit
        ended = screen.evaluate(box.design(unit)[None], peaks_if_missed=True)
        if ended.violation[0] <= _HAIR:
            costs.append(float(ended.cost[0]))
    return min(costs, default=None)
