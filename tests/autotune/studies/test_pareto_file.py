from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats.yaml12 import load_document
from autotune.studies.pareto_file import pareto_tree, write_pareto
from autotune.studies.points import Front, Judge, StudyRecord
from problems.design.objectives import Admittance, CommandNoise, PeakForce
from problems.errors import ParameterError
from tests.autotune.studies.small import START, small_problem


@pytest.fixture(scope="module")
def front() -> Front:
    objectives = (PeakForce(), Admittance(), CommandNoise())
    judge = Judge(small_problem(), objectives)
    law = replace(small_problem().controller(START), discretization="backward_euler")
    return Front(
        problem=small_problem(),
        objectives=objectives,
        points=(judge.judge(law),),
        scenario_count=judge.scenario_count,
        chosen=None,
        study=StudyRecord(name="s.x", sampler="tpe", trials=9, feasible=2),
    )


def test_it_is_written_and_read_back(front: Front, tmp_path: Path) -> None:
    tree = pareto_tree({"x": front}, {"tool": "x"})
    write_pareto(tmp_path / "pareto.yaml", tree)
    assert load_document(tmp_path / "pareto.yaml", error=UsageError).tree == tree
    (point,) = tree["axes"]["x"]["points"]
    assert (point["damping"], point["discretization"], point["compensation_mass"]) == (1290.0, "backward_euler", 0.0)
    assert point["values"] == dict(front.points[0].values)
    assert tree["axes"]["x"]["study"] == {"name": "s.x", "sampler": "tpe", "trials": 9, "feasible": 2}


def test_a_rotational_axis_has_its_units(front: Front) -> None:
    reported = pareto_tree({"rz": front}, {})["axes"]["rz"]["objectives"]
    assert [each["unit"] for each in reported] == ["N·m", "rad/s/(N·m)", "rad/s per N·m"]


def test_a_point_that_misses_a_requirement_is_no_point_of_a_front(front: Front) -> None:
    missed = replace(front.points[0], requirements={"modulus_margin": 1.01})
    with pytest.raises(ParameterError, match="modulus_margin"):
        pareto_tree({"x": replace(front, points=(missed,))}, {})
