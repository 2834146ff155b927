"""`pareto.yaml`: the controllers of a front, none of which another one beats."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from autotune.formats.atomic import write_atomic
from autotune.formats.canonical import dump_yaml, plain
from autotune.formats.records import record_tree, rename_axis_keys
from autotune.formats.schema import VERSION, check_tree
from autotune.formats.units import ROTATIONAL_AXES

from .points import Front, Judgement

FORMAT = "autotune/pareto"


def pareto_tree(fronts: Mapping[str, Front], provenance: Mapping[str, object]) -> dict[str, Any]:
    """Return the plain tree of `pareto.yaml`; raises ParameterError when a number is not finite."""
    tree = {
        "format": FORMAT,
        "version": VERSION,
        "axes": {axis: rename_axis_keys(axis, _front(axis, front), reading=False) for axis, front in fronts.items()},
        "provenance": plain(provenance, "provenance"),
    }
    check_tree(tree, "pareto")
    return tree


def write_pareto(path: Path | str, tree: Mapping[str, Any]) -> None:
    """Write the tree of `pareto_tree` in one step; raises as `write_atomic` does."""
    write_atomic(path, dump_yaml(tree))


def _front(axis: str, front: Front) -> dict[str, Any]:
    return {
        "objectives": [each.tree(turning=axis in ROTATIONAL_AXES) for each in front.objectives],
        "scenarios": front.scenario_count,
        "chosen": front.chosen,
        "study": None if front.study is None else record_tree(front.study),
        "points": [_point(point) for point in front.points],
    }


def _point(point: Judgement) -> dict[str, Any]:
    law = point.controller
    return {
        "mass": law.mass_kg,
        "damping": law.damping_n_s_per_m,
        "lead_s": law.lead_s,
        "feedback_damping_s": law.feedback_damping_s,
        "discretization": law.discretization,
        "compensation_mass": law.compensation_mass_kg,
        "values": plain(point.values, "values"),
        "requirements": plain(point.requirements, "requirements"),
    }
