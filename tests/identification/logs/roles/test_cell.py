"""A cell's description is checked once and its topics can be named on top."""

import pytest

from identification.logs.roles.cell import (
    FORCE_N,
    TORQUE_N_M,
    Cell,
    Mounting,
    PoseFields,
    PoseSource,
    WrenchSource,
    WrenchUnits,
    orientation_width,
)
from problems.errors import ParameterError


def test_topics_named_by_the_user_go_first_and_leave_the_rest() -> None:
    cell = Cell(wrench=WrenchSource(topic="/a", units=WrenchUnits(force="kN")), pose=PoseSource(topic="/p"))
    named = cell.with_topics(wrench="/b", pose=None, command="/c")
    assert named.wrench is not None
    assert (named.wrench.topic, named.wrench.units.force) == ("/b", "kN")
    assert named.pose == cell.pose
    assert named.command == PoseSource(topic="/c")
    assert cell.with_topics(wrench=None, pose=None, command=None) == cell


def test_a_pose_topic_names_the_displacement_where_one_is_declared() -> None:
    named = Cell(displacement=PoseSource(topic="/a")).with_topics(wrench=None, pose="/b", command=None)
    assert named.displacement == PoseSource(topic="/b")
    assert named.pose is None


@pytest.mark.parametrize(
    ("kind", "width"),
    [("quaternion_xyzw", 4), ("quaternion_wxyz", 4), ("rotation_vector", 3), ("euler_ZYZ", 3), ("euler_xyz", 3)],
)
def test_orientations_have_their_width(kind: str, width: int) -> None:
    assert orientation_width(kind) == width


@pytest.mark.parametrize("kind", ["euler_ZZY", "euler_zYx", "euler", "euler_xyzw", "quaternion", "", "euler_XYZ\n"])
def test_other_orientations_are_refused(kind: str) -> None:
    with pytest.raises(ParameterError, match="orientation_as must be"):
        orientation_width(kind)


def test_contradictions_are_refused() -> None:
    with pytest.raises(ParameterError, match="displacement"):
        Cell(pose=PoseSource(), displacement=PoseSource())
    with pytest.raises(ParameterError, match="of 3 numbers"):
        PoseSource(fields=PoseFields(position=("a", "b", "c"), orientation=("d", "e", "f")))
    with pytest.raises(ParameterError, match="child"):
        PoseSource(parent="base")
    with pytest.raises(ParameterError, match="4 numbers"):
        Mounting(orientation=(1.0, 0.0, 0.0))
    with pytest.raises(ParameterError, match="one of N, kN, lbf, kgf"):
        WrenchUnits(force="daN")


def test_units_are_those_of_the_books() -> None:
    # A pound-force is 0.45359237 kg times standard gravity, an inch 25.4 mm: exact by definition,
    # up to one rounding.
    assert FORCE_N["lbf"] == pytest.approx(0.45359237 * 9.80665, rel=1e-15)
    assert TORQUE_N_M["lbf·ft"] == pytest.approx(12 * TORQUE_N_M["lbf·in"], rel=1e-15)
    assert TORQUE_N_M["lbf·in"] == pytest.approx(0.112984829, rel=1e-8)
    assert TORQUE_N_M["Nm"] == TORQUE_N_M["N·m"] == 1.0
