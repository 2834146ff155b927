"""A design problem as plain mappings, lists, numbers and text, and back to the last bit."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

from ..contact.transient import Approach
from ..errors import ParameterError
from ..model.plant import Coupling, WrenchFilter
from ..model.robot import RobotModel
from .problem import DesignProblem
from .requirements import REQUIREMENTS, AdmittanceTarget, NoiseLimit, PassivityTarget, Requirements
from .uncertainty import Ellipsoid

_PLAIN = (
    "drag_n_s_per_m",
    "environment_damping_n_s_per_m",
    "sample_time_s",
    "objective",
    "velocity_filter_rad_per_s",
)
_INTERVALS = ("environment_stiffness_n_per_m", "payload_mass_kg")
_MAPPINGS = ("bounds", "uncertain")


def problem_to_dict(problem: DesignProblem) -> dict[str, Any]:
    """Return the tree of a problem; names and units are those of its fields."""
    robot, ellipsoid = problem.robot, problem.ellipsoid
    return {
        "robot": {
            "numerator": robot.numerator.tolist(),
            "denominator": robot.denominator.tolist(),
            "delay_s": robot.delay_s,
        },
        "coupling": asdict(problem.coupling),
        "wrench_filter": asdict(problem.wrench_filter),
        **{name: getattr(problem, name) for name in _PLAIN},
        **{name: list(getattr(problem, name)) for name in _INTERVALS},
        **{name: {key: list(pair) for key, pair in getattr(problem, name).items()} for name in _MAPPINGS},
        "approach": asdict(problem.approach),
        "requirements": _requirements_tree(problem.requirements),
        "ellipsoid": None
        if ellipsoid is None
        else {
            "names": list(ellipsoid.names),
            "centre": list(ellipsoid.centre),
            "covariance": [list(row) for row in ellipsoid.covariance],
            "level": ellipsoid.level,
        },
    }


def problem_from_dict(tree: Mapping[str, Any]) -> DesignProblem:
    """Return the problem of a tree; raises ParameterError for an entry that is missing, unknown or out of range."""
    try:
        return _problem(tree)
    except (KeyError, TypeError) as error:
        raise ParameterError("design problem", str(error).strip("'"), "the tree of a design problem") from error


def _problem(tree: Mapping[str, Any]) -> DesignProblem:
    ellipsoid = tree["ellipsoid"]
    known = {
        "robot",
        "coupling",
        "wrench_filter",
        "approach",
        "requirements",
        "ellipsoid",
        *_PLAIN,
        *_INTERVALS,
        *_MAPPINGS,
    }
    unknown = sorted(set(tree) - known)
    if unknown:
        raise ParameterError("design problem", unknown[0], f"made of {', '.join(sorted(known))}")
    entries: dict[str, Any] = {name: tree[name] for name in _PLAIN}
    entries |= {name: tuple(tree[name]) for name in _INTERVALS}
    entries |= {name: {key: tuple(pair) for key, pair in tree[name].items()} for name in _MAPPINGS}
    return DesignProblem(
        robot=RobotModel(**tree["robot"]),
        coupling=Coupling(**tree["coupling"]),
        wrench_filter=WrenchFilter(**tree.get("wrench_filter", {})),
        **entries,
        approach=Approach(**tree["approach"]),
        requirements=_requirements(tree["requirements"]),
        ellipsoid=None
        if ellipsoid is None
        else Ellipsoid(
            names=tuple(ellipsoid["names"]),
            centre=tuple(ellipsoid["centre"]),
            covariance=tuple(tuple(row) for row in ellipsoid["covariance"]),
            level=ellipsoid["level"],
        ),
    )


def _requirements_tree(requirements: Requirements) -> dict[str, Any]:
    found = {name: _plain(getattr(requirements, name)) for name in REQUIREMENTS}
    if found["free_space_admittance"] is not None:
        found["free_space_admittance"]["band_hz"] = list(found["free_space_admittance"]["band_hz"])
    return {**found, "soft_n": dict(requirements.soft_n)}


def _plain(asked: Any) -> Any:
    return asdict(asked) if isinstance(asked, AdmittanceTarget | NoiseLimit | PassivityTarget) else asked


def _requirements(tree: Mapping[str, Any]) -> Requirements:
    asked = dict(tree)
    if asked.get("free_space_admittance") is not None:
        target = asked["free_space_admittance"]
        asked["free_space_admittance"] = AdmittanceTarget(**{**target, "band_hz": tuple(target["band_hz"])})
    kinds: dict[str, Callable[..., Any]] = {"command_noise": NoiseLimit, "passivity": PassivityTarget}
    for name, kind in kinds.items():
        if asked.get(name) is not None:
            asked[name] = kind(**asked[name])
    return Requirements(**asked)
