"""`pareto.yaml`: the controllers of a front, none of which another one beats."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from autotune.formats.atomic import write_atomic
from autotune.formats.canonical import dump_yaml, plain
from autotune.formats.records import record_tree, rename_axis_keys
from autotune.formats.schema import VERSION, check_tree
from autotune.formats.units import ROTATIONAL_AXES, Axis
from problems.frozen import AboveZero, Count, NotNegative, Rule, Text
from problems.model.controller import Discretization

from .points import Front, Judgement, StudyRecord

FORMAT = "autotune/pareto"


@dataclass(frozen=True, kw_only=True)
class ObjectiveEntry:
    """How the file names an objective."""

    name: Text
    unit: str
    direction: Literal["minimize", "maximize"]


@dataclass(frozen=True, kw_only=True)
class PointEntry:
    """One controller of a front, with the objectives' values and required/achieved of each requirement."""

    mass: AboveZero
    damping: AboveZero
    lead_s: NotNegative
    feedback_damping_s: NotNegative
    discretization: Discretization
    compensation_mass: NotNegative
    values: Annotated[Mapping[str, float], Rule(minProperties=1)]
    requirements: Mapping[str, Annotated[float, Rule(minimum=0, maximum=1)]]


@dataclass(frozen=True, kw_only=True)
class FrontEntry:
    """The front of one axis; `chosen` is the index of the point that `optimize` chose."""

    objectives: Annotated[tuple[ObjectiveEntry, ...], Rule(minItems=1)]
    scenarios: Count
    chosen: Annotated[int | None, Rule(minimum=0)]
    study: Annotated[
        StudyRecord | None, Rule(description="null, or name, sampler, trials and feasible trials of a study")
    ]
    points: Annotated[tuple[PointEntry, ...], Rule(minItems=1)]


@dataclass(frozen=True, kw_only=True)
class ParetoTable:
    """The entries of `pareto.yaml`, but for where it comes from."""

    axes: Annotated[Mapping[Axis, FrontEntry], Rule(minProperties=1)]


def pareto_tree(fronts: Mapping[str, Front], provenance: Mapping[str, object]) -> dict[str, Any]:
    """Return the plain tree of `pareto.yaml`; raises ParameterError when a number is not finite."""
    table = record_tree(ParetoTable(axes={axis: _front(axis, front) for axis, front in fronts.items()}))
    table["axes"] = {axis: rename_axis_keys(axis, tree, reading=False) for axis, tree in table["axes"].items()}
    tree = {"format": FORMAT, "version": VERSION, **table, "provenance": plain(provenance, "provenance")}
    check_tree(tree, "pareto")
    return tree


def write_pareto(path: Path | str, tree: Mapping[str, Any]) -> None:
    """Write the tree of `pareto_tree` in one step; raises as `write_atomic` does."""
    write_atomic(path, dump_yaml(tree))


def _front(axis: str, front: Front) -> FrontEntry:
    named = (each.tree(turning=axis in ROTATIONAL_AXES) for each in front.objectives)
    return FrontEntry(
        objectives=tuple(ObjectiveEntry(**each) for each in named),  # type: ignore[arg-type]
        scenarios=front.scenario_count,
        chosen=front.chosen,
        study=front.study,
        points=tuple(map(_point, front.points)),
    )


def _point(point: Judgement) -> PointEntry:
    law = point.controller
    return PointEntry(
        mass=law.mass_kg,
        damping=law.damping_n_s_per_m,
        lead_s=law.lead_s,
        feedback_damping_s=law.feedback_damping_s,
        discretization=law.discretization,
        compensation_mass=law.compensation_mass_kg,
        values=point.values,
        requirements=point.requirements,
    )
