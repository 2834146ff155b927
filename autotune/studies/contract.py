"""What every objective and requirement must keep, as checks that the author of a plugin can run in a test."""

import math
import pickle
from collections.abc import Sequence
from importlib.metadata import EntryPoint

import numpy as np

from autotune.errors import AutotuneError
from problems.contact.transient import Approach
from problems.design.evaluation import build_scenarios
from problems.design.objectives import BUILT_IN, Objective
from problems.design.problem import DesignProblem
from problems.design.stable_design import StableDesign
from problems.design.uncertainty import PlantSet
from problems.model.robot import RobotModel

from .plugins import OBJECTIVES, REQUIREMENTS, Requirement, registered

_DESIGNS = ((6.0, 1300.0, 0.02, 0.005), (6.0, 1300.0, 0.01, 0.005), (10.0, 1600.0, 0.02, 0.0))


class ContractError(AutotuneError):
    """A plugin does not keep what is asked of it."""


def sample_problem() -> DesignProblem:
    """Return a small problem, after the paper's cell, on which plugins are tried."""
    return DesignProblem(
        plants=PlantSet.of(
            RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3),
            coupling_stiffness_n_per_m=3e5,
            coupling_damping_n_s_per_m=150.0,
            drag_n_s_per_m=330.0,
            environment_stiffness_n_per_m=(8e4, 1.6e5),
            payload_mass_kg=(15.5, 16.5),
        ),
        sample_time_s=8e-4,
        approach=Approach(force_n=30.0),
    )


def sample_designs(problem: DesignProblem) -> tuple[StableDesign, ...]:
    """Return controllers that are stable in every scenario of a small grid."""
    prepared = build_scenarios(problem, problem.scenarios(3, 2))
    return tuple(prepared.stable(problem.controller(np.array(design))) for design in _DESIGNS)


def check_objective(kind: type[Objective]) -> None:
    """Raise ContractError unless `kind` is an objective that a study can use.

    It is registered under its own name, says unit and direction, is made without arguments, gives a number above 0
    for stable controllers of any structure, and the same number from another instance and in another order.
    """
    _check_registered(kind, OBJECTIVES, kind.name)
    _must(isinstance(kind.unit, str), kind, "unit must be text")
    _must(kind.direction in ("minimize", "maximize"), kind, f"direction must be minimize or maximize: {kind.direction}")
    for value in _repeatable(kind, kind(), kind()):
        _must(0.0 < value < math.inf, kind, f"must be above 0 and finite for a stable loop, found {value}")


def check_requirement(kind: type[Requirement]) -> None:
    """Raise ContractError unless `kind` is a requirement that a study can use.

    As `check_objective`, but the number is required/achieved: 0 or above, and infinite where nothing is achieved.
    """
    _check_registered(kind, REQUIREMENTS, kind.name)
    for value in _repeatable(kind, kind(), kind()):
        _must(value >= 0.0, kind, f"must be required/achieved, 0 or above, found {value}")


def _check_registered(kind: type, group: str, name: str) -> None:
    _must(name.isidentifier(), kind, f"name must be a plain word, found {name!r}")
    if name in BUILT_IN and type(BUILT_IN[name]) is kind:
        return
    entry: EntryPoint | None = registered(group).get(name)
    _must(entry is not None and entry.load() is kind, kind, f"must be the entry point {name} of {group}")


def _repeatable(kind: type, one: Objective | Requirement, other: Objective | Requirement) -> Sequence[float]:
    problem = sample_problem()
    samples = sample_designs(problem)
    before = pickle.dumps([vars(each.controller) for each in samples])

    def number(plugin: Objective | Requirement, design: StableDesign) -> float:
        if isinstance(plugin, Objective):
            return plugin.worst(problem.requirements, design)
        return plugin.achieved(1.0, design, 0)

    forth = [number(one, each) for each in samples]
    back = [number(other, each) for each in reversed(samples)]
    _must(all(isinstance(value, float) for value in forth), kind, f"must return floats, found {forth}")
    _must(forth == back[::-1], kind, f"must repeat itself to the last bit, found {forth} and then {back[::-1]}")
    _must(
        pickle.dumps([vars(each.controller) for each in samples]) == before,
        kind,
        "must leave its arguments as they are",
    )
    return forth


def _must(holds: bool, kind: type, what: str) -> None:
    if not holds:
        raise ContractError(f"{kind.__module__}:{kind.__qualname__} {what}.")
