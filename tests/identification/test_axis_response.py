"""Where the measured response differs from the model is a finding; where it does not, there is none."""

import re
from dataclasses import replace

import numpy as np
import pytest

from identification.axis_response import response_findings
from identification.measured_response import FrequencyResponse
from problems.arrays import FloatArray
from problems.model.robot import RobotModel
from tests.identification.robot.test_frequency_response import Cell, measured

H = 2e-3
ROBOT = RobotModel.from_bandwidth(bandwidth_rad_per_s=38.0, delay_s=3 * H)


def coupling(cell: Cell) -> FloatArray:
    return np.array([cell.stiffness, cell.damping, cell.drag, cell.mass])


@pytest.mark.parametrize("seed", range(8))
def test_the_true_model_is_no_finding(seed: int) -> None:
    assert list(response_findings("x", coupling(Cell()), ROBOT, measured(Cell(), seed), H)) == []


def test_another_robot_and_another_spring_are_reported_with_frequency_and_size() -> None:
    cell = Cell()
    found = measured(cell, 1)
    slow = RobotModel.from_bandwidth(bandwidth_rad_per_s=30.0, delay_s=3 * H)
    (about_robot,) = response_findings("x", coupling(cell), slow, found, H)
    assert about_robot.code == "response-differs"
    assert "from command to pose" in about_robot.message
    # At high frequencies the poles' ratio is left: 38/30 is 27 % more.
    assert re.search(r"by 2[67]\.\d %", about_robot.message)
    (about_spring,) = response_findings("x", coupling(replace(cell, stiffness=2.6e5)), ROBOT, found, H)
    assert "from pose to force" in about_spring.message


def test_dry_friction_is_a_finding() -> None:
    (about,) = response_findings("x", coupling(Cell()), ROBOT, measured(Cell(friction_n=5.0), 1), H)
    assert "from pose to force" in about.message


def test_without_a_robot_the_pose_is_smooth() -> None:
    felt = FrequencyResponse(pose_to_force=measured(Cell(), 1).pose_to_force)
    assert list(response_findings("x", coupling(Cell()), None, felt, H)) == []
    assert list(response_findings("x", coupling(Cell(stiffness=2e5)), None, felt, H)) != []


def test_about_an_axis_nothing_is_said() -> None:
    assert list(response_findings("rx", coupling(Cell(stiffness=1e5)), ROBOT, measured(Cell(), 1), H)) == []
