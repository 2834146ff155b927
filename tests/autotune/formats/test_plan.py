from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autotune.errors import UsageError
from autotune.formats.plan import plan_tree, write_plan
from autotune.formats.schema import violations
from autotune.formats.yaml12 import load_document
from identification.experiment_design.experiment import plan_experiment
from identification.experiment_design.result import ExperimentLimits, ExperimentPlan
from identification.experiment_design.values import Known, usual_values
from problems.errors import ParameterError
from problems.model.robot import RobotModel


@pytest.fixture(scope="module")
def slow() -> ExperimentPlan:
    """A plan that holds every kind of step: the robot is too slow for the payload's swing."""
    robot = RobotModel.from_bandwidth(bandwidth_rad_per_s=1.0, delay_s=2.4e-3)
    values = replace(usual_values(), robot=robot, misfit_share=Known(value=0.05))
    return plan_experiment("y", values, ExperimentLimits())


def test_every_kind_of_step_is_written_and_read_back(slow: ExperimentPlan, tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    write_plan(path, slow, {"tool": "x"})
    tree = load_document(path, error=UsageError).tree
    assert tree == plan_tree(slow, {"tool": "x"})
    assert list(tree)[:5] == ["format", "version", "axis", "binding", "reference"]
    assert list(tree)[5:] == ["steps", "limits", "assumed", "provenance"]
    assert slow.effect is not None
    assert tree["reference"]["peak_force_n"] == slow.effect.peak_force_n
    assert (tree["format"], tree["version"], tree["axis"]) == ("autotune/plan", 1, "y")
    assert [step["record"] for step in tree["steps"]] == ["poses", "sweep", "taps", "contacts"]
    assert tree["assumed"]["mass_kg"] == 16.0
    assert tree["limits"]["max_tilt_deg"] == 60.0


def test_what_a_robot_would_be_fed_belongs_together(slow: ExperimentPlan) -> None:
    poses, sweep, _, _ = (step["settings"] for step in plan_tree(slow, {})["steps"])
    for pose in poses["poses"]:
        axis = np.radians(pose["azimuth_deg"])
        turn = Rotation.from_rotvec(np.radians(pose["tilt_deg"]) * np.array([np.cos(axis), np.sin(axis), 0.0]))
        assert (turn.inv() * Rotation.from_quat(pose["quaternion_xyzw"])).magnitude() < 1e-4  # table: thousandths
    for point in sweep["command"]:
        assert point["speed_m_s"] == pytest.approx(2.0 * np.pi * point["frequency_hz"] * point["amplitude_m"])
    assert sweep["command"][0]["frequency_hz"] == pytest.approx(sweep["low_hz"])
    assert sweep["command"][-1]["frequency_hz"] == pytest.approx(sweep["high_hz"])


def test_a_step_whose_settings_belong_to_another_is_no_plan(slow: ExperimentPlan) -> None:
    tree = plan_tree(slow, {})
    assert list(violations(tree, "plan")) == []
    tree["steps"][0]["settings"] = tree["steps"][1]["settings"]
    assert [violation.place[:2] for violation in violations(tree, "plan")] == [("steps", 0)]
    with pytest.raises(ParameterError):
        plan_tree(replace(slow, axis="rx"), {})


def test_what_nothing_shows_is_null(slow: ExperimentPlan) -> None:
    entries = [entry for step in plan_tree(slow, {})["steps"] for entry in step["predicted"]]
    assert all(entry["std_now"] is None for entry in entries)
    assert all(entry["std_after"] is None or entry["std_after"] > 0.0 for entry in entries)
