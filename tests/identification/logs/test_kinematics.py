"""The pose of a tip: closed forms, and the library's own way through the same robot, one joint at a time."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from identification.errors import LogError
from identification.logs.joints import read_chain
from tests.identification.logs.robots import ARM, JOINTS, PLANAR

urdf = pytest.importorskip("pytransform3d.urdf", reason="the extra urdf is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("robots")
    (path / "arm.urdf").write_text(ARM)
    (path / "planar.urdf").write_text(PLANAR)
    return path


def test_two_links_in_a_plane(folder: Path) -> None:
    """x = 2 cos a + cos(a + b), y = 2 sin a + sin(a + b), turned by a + b."""
    angles = np.random.default_rng(1).uniform(-3, 3, (50, 2))
    pose = read_chain(folder / "planar.urdf", "tip").poses(angles)
    a, both = angles[:, 0], angles.sum(axis=1)
    assert np.allclose(pose[:, 0], 2 * np.cos(a) + np.cos(both), atol=1e-14)
    assert np.allclose(pose[:, 1], 2 * np.sin(a) + np.sin(both), atol=1e-14)
    half = np.column_stack([np.zeros((50, 2)), np.sin(both / 2), np.cos(both / 2)])
    assert np.allclose(pose[:, 3:] * np.sign(pose[:, 6:]), half * np.sign(half[:, 3:]), atol=1e-14)


def test_degrees_are_radians_after_their_factor(folder: Path) -> None:
    chain = read_chain(folder / "planar.urdf", "tip")
    assert np.allclose(
        chain.poses(np.array([[90.0, 45.0]]), np.pi / 180), chain.poses(np.array([[np.pi / 2, np.pi / 4]]))
    )


@given(st.lists(st.floats(-3.0, 3.0), min_size=7, max_size=7), st.sampled_from([None, "base", "l2"]))
def test_the_library_goes_the_same_way(folder: Path, positions: list[float], base: str | None) -> None:
    chain = read_chain(folder / "arm.urdf", "tool0", base)
    names = chain.moving
    assert names == JOINTS[-len(names) :]
    manager = urdf.UrdfTransformManager()
    manager.load_urdf(ARM.replace("0 2 0", "0 1 0"))
    values = positions[-len(names) :]
    for name, value in zip(names, values, strict=True):
        manager.set_joint(name, value)
    expected = manager.get_transform("tool0", base or "world")
    [found] = chain.poses(np.array([values]))
    x, y, z, w = found[3:]
    # The rotation matrix of a quaternion, written out.
    turn = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    assert np.allclose(found[:3], expected[:3, 3], atol=1e-12)
    assert np.allclose(turn, expected[:3, :3], atol=1e-12)


def test_a_row_without_a_number_has_no_pose(folder: Path) -> None:
    pose = read_chain(folder / "planar.urdf", "tip").poses(np.array([[0.0, 0.0], [np.nan, 0.0], [0.0, np.inf]]))
    assert np.isfinite(pose[0]).all()
    assert np.isnan(pose[1:]).all()


@pytest.mark.parametrize(
    ("text", "tip", "base", "message"),
    [
        (ARM, "tool1", None, "has no link 'tool1' to be the tip; its links are: world, base, l1"),
        (ARM, "tool0", "floor", "has no link 'floor' to be the base"),
        (ARM, "tool0", "apart", "No chain of joints leads from apart to tool0"),
        (ARM, "base", None, "No joint moves base against world"),
        (ARM, "finger", None, "The joint finger of arm.urdf follows another .mimic."),
        (ARM[:900], "tool0", None, "arm.urdf must be a URDF, found"),
        (ARM.replace("0 2 0", "0 0 0"), "tool0", None, "The joint lift of arm.urdf has no axis"),
        ("<robot name='a'><link name='b'/><xacro:macro/></robot>", "b", None, "xacro robot.xacro > robot.urdf"),
        ("", "tool0", None, "arm.urdf must be a URDF"),
    ],
)
def test_what_is_no_chain_is_refused(text: str, tip: str, base: str | None, message: str, tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(text)
    with pytest.raises(LogError, match=message):
        read_chain(path, tip, base)


def test_a_urdf_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read: No such file"):
        read_chain(tmp_path / "none.urdf", "tool0")
