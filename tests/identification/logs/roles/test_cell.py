"""A cell's description is checked once and its topics can be named on top."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from identification.logs.roles.cell import (
    Cell,
    Mounting,
    PoseFields,
    PoseSource,
    WrenchFields,
    WrenchSource,
    WrenchUnits,
)
from identification.logs.roles.orientation import is_rotation, orientation_width
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
    [
        ("quaternion_xyzw", 4),
        ("quaternion_wxyz", 4),
        ("rotation_vector", 3),
        ("matrix_row_major", 9),
        ("matrix_column_major", 9),
        ("euler_ZYZ", 3),
        ("euler_xyz", 3),
    ],
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


@pytest.mark.parametrize("kind", ["matrix_row_major", "matrix_column_major"])
def test_a_pose_matrix_of_sixteen_numbers_is_position_and_rotation(kind: str) -> None:
    """The entry in row i and column j is called ij; four rows or four columns of them stand after each other."""
    order = [f"{i}{j}" if kind == "matrix_row_major" else f"{j}{i}" for i in range(4) for j in range(4)]
    fields = PoseSource(fields=PoseFields(orientation=tuple(order)), orientation_as=kind).fields
    assert fields is not None
    assert fields.position == ("03", "13", "23")
    rotation = [name for name in order if "3" not in name]
    assert list(fields.orientation) == rotation


def test_a_slice_of_a_list_is_its_entries() -> None:
    assert WrenchFields(force=("effort[1:4]",), torque=("a", "b[7:9]")).torque == ("a", "b[7]", "b[8]")
    assert WrenchFields(force=("effort[1:4]",)).force == ("effort[1]", "effort[2]", "effort[3]")
    with pytest.raises(ParameterError, match="force must be 3 paths"):
        WrenchFields(force=("effort[0:4]",))


@given(st.integers(0, 8), st.floats(0.01, 1.0))
def test_only_rotations_are_rotations(entry: int, change: float) -> None:
    turn = Rotation.from_rotvec([0.3, -2.0, 0.5]).as_matrix()
    assert is_rotation(turn.reshape(1, 9))[0]
    assert not is_rotation((turn @ np.diag([1.0, 1.0, -1.0])).reshape(1, 9))[0]
    off = turn.ravel().copy()
    off[entry] += change
    assert not is_rotation(off[None])[0]
    with pytest.raises(ParameterError, match="a rotation matrix"):
        Mounting(orientation=tuple(off.tolist()), orientation_as="matrix_row_major")
