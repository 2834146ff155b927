"""Logs of joint positions: the pose is the tip's, whatever the order of the joints, and is compared with others."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from autotune.formats.cell import read_cell
from identification.errors import LogError
from identification.logs.inspect import inspect_log
from identification.logs.joints import read_chain
from identification.logs.read import read_recording
from identification.logs.roles.cell import Cell, WrenchFields, WrenchSource
from identification.signals.recording import PoseSignal, Recording
from problems.errors import MissingExtraError, ParameterError
from tests.identification.logs.message_builder import DELAY_NS, Topic, Tree, header, write_log, xyz, xyzw
from tests.identification.logs.robots import ARM, JOINTS

pytest.importorskip("pytransform3d", reason="the extra urdf is not installed")

Array = NDArray[np.float64]
N = 200
SWING = np.sin(np.linspace(0.0, 6.0, N))[:, None] * np.linspace(0.1, 0.5, 7) + np.linspace(-1.0, 1.0, 7)
NAMES = ("gripper", *(JOINTS[i] for i in (4, 0, 6, 2, 1, 5, 3)))
"""As a broadcaster sorts them: in another order than along the arm, with a gripper among them."""


def states(positions: Array, names: Callable[[int], tuple[str, ...]] = lambda _: NAMES) -> Callable[[int, int], Tree]:
    at = dict(zip(JOINTS, positions.T, strict=True))

    def message(i: int, stamp: int) -> Tree:
        values = [at[name][i] if name in at else 7.0 for name in names(i)]
        return {"header": header(stamp, ""), "name": list(names(i)), "position": values}

    return message


def wrench(i: int, stamp: int) -> Tree:
    return {
        "header": header(stamp, "ft"),
        "wrench": {"force": xyz(SWING[i, :3] + i % 3), "torque": xyz(SWING[i, 3:6] - i % 5)},
    }


FT = Topic(topic="/ft", type_name="geometry_msgs/msg/WrenchStamped", message=wrench)
JOINT_STATES = Topic(topic="/joint_states", type_name="sensor_msgs/msg/JointState", message=states(SWING))
DESIRED = Topic(topic="/desired_joint_states", type_name="sensor_msgs/msg/JointState", message=states(SWING + 0.01))


@pytest.fixture
def arm(tmp_path: Path) -> Path:
    path = tmp_path / "arm.urdf"
    path.write_text(ARM)
    return path


def poses(arm: Path, positions: Array = SWING) -> Array:
    return read_chain(arm, "tool0").poses(positions)


def same(pose: PoseSignal, expected: Array) -> bool:
    turn = Rotation.from_quat(pose.quaternion_xyzw).inv() * Rotation.from_quat(expected[:, 3:])
    return bool(np.array_equal(pose.position_m, expected[:, :3]) and np.max(turn.magnitude()) < 1e-7)  # arccos near 1


def test_joint_states_are_poses_of_the_tip(arm: Path, tmp_path: Path) -> None:
    log = write_log(tmp_path / "run.mcap", [FT, JOINT_STATES, DESIRED])
    recording = read_recording(log, Cell().with_urdf(arm, "tool0"))
    assert same(recording.pose, poses(arm))
    assert recording.command is not None
    assert same(recording.command, poses(arm, SWING + 0.01))
    assert recording.pose.topic == "/joint_states"
    assert recording.clocks == {"wrench": "header", "pose": "header", "command": "header"}
    reported = [finding.message for finding in recording.findings if finding.code == "channel-chosen"]
    assert reported[1].endswith("joint positions through arm.urdf up to tool0.")


@pytest.mark.parametrize("is_arm", [lambda i: i % 2 == 0, lambda i: i % 5 > 0, lambda i: i >= 150])
def test_a_gripper_that_publishes_on_the_same_topic_is_passed_over(
    is_arm: Callable[[int], bool], arm: Path, tmp_path: Path
) -> None:
    topic = replace(JOINT_STATES, message=states(SWING, lambda i: NAMES if is_arm(i) else ("finger",)))
    log = write_log(tmp_path / "run.mcap", [FT, topic])
    recording = read_recording(log, Cell().with_urdf(arm, "tool0"))
    assert not [each for each in inspect_log(log, Cell().with_urdf(arm, "tool0")).findings if each.severity == "error"]
    rows = [i for i in range(len(FT.stamps)) if is_arm(i)]
    assert np.array_equal(recording.pose.stamp_ns, FT.stamps[rows])
    assert same(recording.pose, poses(arm)[rows])


def test_inspect_says_what_the_joints_serve_as(arm: Path, tmp_path: Path) -> None:
    log = write_log(tmp_path / "run.mcap", [FT, JOINT_STATES, DESIRED])
    summary = inspect_log(log, Cell().with_urdf(arm, "tool0"))
    assert not summary.missing
    assert {role.entry: role.topic for role in summary.roles if role.topic} == {
        "wrench": "/ft",
        "pose": "/joint_states",
        "command": "/desired_joint_states",
    }
    assert not [finding for finding in summary.findings if finding.severity == "error"]


def test_ros_1_holds_the_same(arm: Path, tmp_path: Path) -> None:
    store, path = get_typestore(Stores.ROS1_NOETIC), tmp_path / "run.bag"
    t = store.types
    with BagWriter(path) as bag:
        topics = [bag.add_connection(each.topic, each.type_name, typestore=store) for each in (FT, JOINT_STATES)]
        for i, stamp in enumerate(FT.stamps.tolist()):
            time = t["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
            head = t["std_msgs/msg/Header"](seq=i, stamp=time, frame_id="")
            vector = t["geometry_msgs/msg/Vector3"](*map(float, SWING[i, :3] + i % 3))
            force = t[FT.type_name](header=head, wrench=t["geometry_msgs/msg/Wrench"](force=vector, torque=vector))
            tree = states(SWING)(i, stamp)
            joints = t[JOINT_STATES.type_name](
                header=head,
                name=tree["name"],
                position=np.array(tree["position"]),
                velocity=np.zeros(0),
                effort=np.zeros(0),
            )
            bag.write(topics[0], stamp, store.serialize_ros1(force, FT.type_name))
            bag.write(topics[1], stamp, store.serialize_ros1(joints, JOINT_STATES.type_name))
    assert same(read_recording(path, Cell().with_urdf(arm, "tool0")).pose, poses(arm))


def read_both(arm: Path, tmp_path: Path, pose: Array, count: int | None = None) -> Recording:
    """Read a log that also has a pose topic, with the joints of its first `count` samples."""

    def stamped(i: int, stamp: int) -> Tree:
        return {"header": header(stamp), "pose": {"position": xyz(pose[i, :3]), "orientation": xyzw(pose[i, 3:])}}

    topic = Topic(topic="/tcp_pose", type_name="geometry_msgs/msg/PoseStamped", message=stamped)
    joints = JOINT_STATES if count is None else replace(JOINT_STATES, count=count)
    return read_recording(write_log(tmp_path / "run.mcap", [FT, joints, topic]), Cell().with_urdf(arm, "tool0"))


def read_beside(arm: Path, tmp_path: Path, pose: Array) -> tuple[Recording, str, str]:
    """Read a log that also has a pose topic, and return how it compares."""
    recording = read_both(arm, tmp_path, pose)
    [found] = [finding for finding in recording.findings if finding.code.startswith("joints-")]
    return recording, found.code, found.message


def test_a_pose_topic_goes_before_and_is_compared(arm: Path, tmp_path: Path) -> None:
    recording, code, _ = read_beside(arm, tmp_path, poses(arm))
    assert recording.pose.topic == "/tcp_pose"
    assert code == "joints-agree"


@pytest.mark.parametrize(("count", "is_compared"), [(9, False), (10, True)])
def test_few_samples_of_the_joints_are_compared_with_nothing(
    arm: Path, tmp_path: Path, count: int, is_compared: bool
) -> None:
    found = read_both(arm, tmp_path, poses(arm), count).findings
    assert any(each.code == "joints-agree" for each in found) == is_compared


def test_a_pose_of_another_tip_is_reported_with_its_offset(arm: Path, tmp_path: Path) -> None:
    pose = poses(arm)
    pose[:, :3] += Rotation.from_quat(pose[:, 3:]).apply([0.0, 0.01, -0.12])
    _, code, message = read_beside(arm, tmp_path, pose)
    assert code == "joints-disagree"
    assert "is 120.42 mm and 0.00° (rms) away" in message  # the length of the offset
    assert "a constant offset of (0.0, 10.0, -120.0) mm in the axes of the tip leaves 0.00 mm." in message


def test_a_pose_that_is_turned_is_reported(arm: Path, tmp_path: Path) -> None:
    pose = poses(arm)
    pose[:, 3:] = (Rotation.from_quat(pose[:, 3:]) * Rotation.from_rotvec([0.0, 0.0, np.radians(5)])).as_quat()
    _, code, message = read_beside(arm, tmp_path, pose)
    assert code == "joints-disagree"
    assert "is 0.00 mm and 5.00° (rms) away" in message


def test_columns_of_a_table_in_degrees(arm: Path, tmp_path: Path) -> None:
    """A `cell.yaml` beside the URDF names it by its own folder; the slide is a length, whatever the angles are in."""
    unit = np.array([1.0 if name == "slide" else 180.0 / np.pi for name in JOINTS])
    rows = np.column_stack([FT.stamps / 1e9, SWING * unit, SWING[:, :3]])
    names = ["t", *(f"q{i}" for i in range(7)), "fx", "fy", "fz"]
    text = "".join(",".join(map(repr, row)) + "\n" for row in rows.tolist())
    (tmp_path / "run.csv").write_text(f"{','.join(names)}\n{text}")
    (tmp_path / "cell.yaml").write_text(
        "format: autotune/cell\nversion: 1\ntable: {time: t}\nwrench: {fields: {force: [fx, fy, fz]}}\n"
        "joints: {urdf: arm.urdf, tip: tool0, angle: deg, positions: [q0, q1, q2, q3, q4, q5, q6]}\n"
    )
    recording = read_recording(tmp_path / "run.csv", read_cell(tmp_path / "cell.yaml").cell)
    assert np.allclose(recording.pose.position_m, poses(arm)[:, :3], atol=1e-12)


def test_a_message_of_another_type_names_its_joints_in_order(arm: Path, tmp_path: Path) -> None:
    def numbers(i: int, _: int) -> Tree:
        return {"data": [*SWING[i], *SWING[i, :6]]}

    topic = Topic(topic="/numbers", type_name="std_msgs/msg/Float64MultiArray", message=numbers)
    log = write_log(tmp_path / "run.mcap", [topic])
    cell = Cell(wrench=WrenchSource(fields=WrenchFields(force=("data[7:10]",), torque=("data[10:13]",))))
    cell = cell.with_urdf(arm, "tool0")
    assert cell.joints is not None
    joints = replace(cell.joints, topic="/numbers", positions=("data[0:7]",))
    recording = read_recording(log, replace(cell, joints=joints))
    assert same(recording.pose, poses(arm))
    assert recording.pose.stamp_ns[0] == FT.stamps[0] + DELAY_NS
    with pytest.raises(LogError, match=r"must name 7 numbers of topic /numbers, those of shoulder, lift, .* found 6"):
        read_recording(log, replace(cell, joints=replace(joints, positions=("data[0:6]",))))
    with pytest.raises(LogError, match="is no JointState, so its joints have no names"):
        read_recording(log, replace(cell, joints=replace(joints, positions=())))


@pytest.mark.parametrize(
    ("topics", "output"),
    [
        ([FT], "must have one channel of measured joint positions, found 0"),
        ([FT, JOINT_STATES, replace(JOINT_STATES, topic="/b")], "found 2; name it with `joints: {topic: …}`"),
        (
            [FT, replace(JOINT_STATES, message=states(SWING, lambda _: NAMES[:-1]))],
            "found no elbow; it has gripper, wrist_1, shoulder",
        ),
        (
            [FT, replace(JOINT_STATES, message=states(SWING, lambda i: NAMES[::-1] if i % 2 else NAMES))],
            "in one order, found 2: several robots publish on it; record each on a topic of its own.",
        ),
    ],
)
def test_joints_that_do_not_fit_are_refused(topics: list[Topic], output: str, arm: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError) as caught:
        read_recording(write_log(tmp_path / "run.mcap", topics), Cell().with_urdf(arm, "tool0"))
    assert output in str(caught.value)


def test_urdf_and_tip_go_together(arm: Path) -> None:
    with pytest.raises(ParameterError, match="tip must be named too"):
        Cell().with_urdf(arm, None)
    with pytest.raises(ParameterError, match="urdf must be named too"):
        Cell().with_urdf(None, "tool0")


def test_without_the_extra_one_sentence_says_so(arm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = write_log(tmp_path / "run.mcap", [FT, JOINT_STATES])
    monkeypatch.setattr("problems.errors.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"A URDF needs pytransform3d, .*pip install 'robot-autotune\[urdf\]'"):
        read_recording(log, Cell().with_urdf(arm, "tool0"))
