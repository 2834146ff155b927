"""A Franka robot's own state messages, in bags written by rosbags: poses, commands and wrenches with the right sign."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from identification.errors import LogError
from identification.logs.inspect import inspect_log
from identification.logs.read import read_recording
from identification.logs.roles.cell import Cell, ExertedBy, PoseFields, PoseSource, WrenchSource
from identification.logs.roles.orientation import COLUMN_MAJOR, ROW_MAJOR
from identification.logs.roles.registry import Role
from identification.signals.recording import Recording

Array = NDArray[np.float64]

N, PERIOD_NS, START_NS = 120, 5_000_000, 1_700_000_000_000_000_000
RNG = np.random.default_rng(18)
TURN = Rotation.from_rotvec(np.linspace(0.0, 1.2, N)[:, None] * [0.5, 0.7, -0.4]) * Rotation.from_rotvec(
    [np.pi, 0, 0.2]
)
POSITION = np.cumsum(RNG.standard_normal((N, 3)), axis=0) * 1e-3 + [0.4, 0.1, 0.5]
AHEAD = POSITION + np.array([0.0, 0.0, -0.002])
ON_SURROUNDINGS_N = RNG.standard_normal((N, 6)) * [20, 20, 20, 2, 2, 2]
"""The robot's force on its surroundings in base axes, as the robot's makers define it."""

# The names and types of the public definitions; what is not read is left out except where it tests the skipping.
STATE_1 = """\
std_msgs/Header header
float64[7] q
float64[6] K_F_ext_hat_K
float64[6] O_F_ext_hat_K
float64[16] O_T_EE
float64[16] O_T_EE_d
float64 time
uint8 ROBOT_MODE_MOVE=2
uint8 robot_mode
franka_msgs/Errors current_errors
"""
STATE_2 = re.sub(r"\b[KO]_[A-Za-z_]+", lambda name: name[0].lower(), STATE_1)
"""ROS 2 allows no capitals in names of fields."""
ROBOT_STATE_2 = """\
std_msgs/Header header
sensor_msgs/JointState measured_joint_state
geometry_msgs/WrenchStamped k_f_ext_hat_k
geometry_msgs/WrenchStamped o_f_ext_hat_k
geometry_msgs/PoseStamped o_t_ee
geometry_msgs/PoseStamped o_t_ee_d
float64 time
uint8 robot_mode
"""
ERRORS = "bool joint_reflex\nbool self_collision\n"
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg(ERRORS, "franka_msgs/msg/Errors"))
ROS1.register(get_types_from_msg(STATE_1, "franka_msgs/msg/FrankaState"))
ROS2.register(get_types_from_msg(ERRORS, "franka_msgs/msg/Errors"))
ROS2.register(get_types_from_msg(STATE_2, "franka_msgs/msg/FrankaState"))
ROS2.register(get_types_from_msg(ROBOT_STATE_2, "franka_msgs/msg/FrankaRobotState"))


def columns(position: Array, turn: Rotation) -> Array:
    """The 16 entries of the pose, column after column."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn.as_matrix(), position
    return matrix.ravel(order="F")


def head(store: Any, index: int, name: str = "") -> Any:
    stamp_ns = START_NS + index * PERIOD_NS
    time = store.types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    sequence = {"seq": index} if store is ROS1 else {}
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id=name, **sequence)


def state(store: Any, index: int, desired: Array) -> Any:
    upper = store is ROS1
    names = {name: name if upper else name.lower() for name in ("K_F_ext_hat_K", "O_F_ext_hat_K", "O_T_EE", "O_T_EE_d")}
    return store.types["franka_msgs/msg/FrankaState"](
        header=head(store, index),
        q=np.zeros(7),
        **{
            names["K_F_ext_hat_K"]: np.full(6, 99.0),
            names["O_F_ext_hat_K"]: ON_SURROUNDINGS_N[index],
            names["O_T_EE"]: columns(POSITION[index], TURN[index]),
            names["O_T_EE_d"]: columns(desired[index], TURN[index]),
        },
        time=0.0,
        robot_mode=2,
        current_errors=store.types["franka_msgs/msg/Errors"](joint_reflex=False, self_collision=False),
    )


def robot_state(index: int) -> Any:
    t = ROS2.types
    xyz, quaternion = t["geometry_msgs/msg/Vector3"], t["geometry_msgs/msg/Quaternion"]

    def wrench(values: Array) -> Any:
        inner = t["geometry_msgs/msg/Wrench"](force=xyz(*values[:3]), torque=xyz(*values[3:]))
        return t["geometry_msgs/msg/WrenchStamped"](header=head(ROS2, index, "base"), wrench=inner)

    def pose(position: Array) -> Any:
        point = t["geometry_msgs/msg/Point"](*position)
        inner = t["geometry_msgs/msg/Pose"](position=point, orientation=quaternion(*TURN[index].as_quat()))
        return t["geometry_msgs/msg/PoseStamped"](header=head(ROS2, index, "base"), pose=inner)

    joints = t["sensor_msgs/msg/JointState"](
        header=head(ROS2, index), name=["fr3_joint1"], position=np.zeros(1), velocity=np.zeros(1), effort=np.zeros(1)
    )
    return t["franka_msgs/msg/FrankaRobotState"](
        header=head(ROS2, index, "base"),
        measured_joint_state=joints,
        k_f_ext_hat_k=wrench(np.full(6, 99.0)),
        o_f_ext_hat_k=wrench(ON_SURROUNDINGS_N[index]),
        o_t_ee=pose(POSITION[index]),
        o_t_ee_d=pose(AHEAD[index]),
        time=0.0,
        robot_mode=2,
    )


def old_bag(path: Path, desired: Array = AHEAD, *, rests: bool = False) -> Path:
    with BagWriter(path) as bag:
        topic = bag.add_connection("/franka_states", "franka_msgs/msg/FrankaState", typestore=ROS1)
        for index in range(N):
            message = state(ROS1, index, desired)
            if rests:
                message.O_T_EE_d = columns(AHEAD[0], TURN[0])
            bag.write(topic, START_NS + index * PERIOD_NS, ROS1.serialize_ros1(message, message.__msgtype__))
    return path


def folder(path: Path, name: str, message: Callable[[int], Any]) -> Path:
    with FolderWriter(path, version=9) as bag:
        topic = bag.add_connection("/robot_state", name, typestore=ROS2)
        for index in range(N):
            bag.write(topic, START_NS + index * PERIOD_NS, ROS2.serialize_cdr(message(index), name))
    return path


LOGS: dict[str, Callable[[Path], Path]] = {
    "ROS 1 FrankaState": lambda path: old_bag(path / "run.bag"),
    "ROS 2 FrankaState": lambda path: folder(
        path / "run", "franka_msgs/msg/FrankaState", lambda index: state(ROS2, index, AHEAD)
    ),
    "ROS 2 FrankaRobotState": lambda path: folder(path / "run", "franka_msgs/msg/FrankaRobotState", robot_state),
}


def same_turn(recording: Recording) -> bool:
    apart = (Rotation.from_quat(recording.pose.quaternion_xyzw).inv() * TURN).magnitude()
    return bool(np.max(apart) < 1e-7)  # arccos near 1


@pytest.mark.parametrize("written", LOGS.values(), ids=list(LOGS))
def test_a_state_holds_pose_command_and_wrench(written: Callable[[Path], Path], tmp_path: Path) -> None:
    recording = read_recording(written(tmp_path))
    assert np.array_equal(recording.pose.position_m, POSITION)
    assert same_turn(recording)
    assert recording.command is not None
    assert np.array_equal(recording.command.position_m, AHEAD)
    # What the surroundings do to the robot is the opposite, seen from the end effector.
    expected = [-TURN.inv().apply(ON_SURROUNDINGS_N[:, part]) for part in (slice(0, 3), slice(3, 6))]
    assert np.allclose(recording.wrench.force_n, expected[0], atol=1e-12)
    assert np.allclose(recording.wrench.torque_n_m, expected[1], atol=1e-12)
    assert recording.wrench.gravity_compensated
    assert "franka-wrench" in [finding.code for finding in recording.findings]


def test_a_state_pressed_down_pushes_the_robot_up(tmp_path: Path) -> None:
    """Pressing along −z of the base the robot's force on the table is −z; the payload's on the sensor then lifts it."""
    recording = read_recording(old_bag(tmp_path / "run.bag"))
    down = ON_SURROUNDINGS_N[:, 2] < 0.0
    in_base = TURN.apply(recording.wrench.force_n.copy())
    assert np.all(in_base[down, 2] > 0.0)


def test_the_cell_has_the_last_word(tmp_path: Path) -> None:
    """A simulated robot tells the force with the other sign, which the cell may say."""
    cell = Cell(wrench=WrenchSource(exerted_by=ExertedBy.PAYLOAD))
    bag = old_bag(tmp_path / "run.bag")
    assert np.array_equal(read_recording(bag, cell).wrench.force_n, -read_recording(bag).wrench.force_n)


@pytest.mark.parametrize("rests", [True, False])
def test_a_desired_pose_that_moves_nothing_is_no_command(rests: bool, tmp_path: Path) -> None:
    recording = read_recording(old_bag(tmp_path / "run.bag", POSITION, rests=rests))
    assert recording.command is None
    [finding] = [finding for finding in recording.findings if finding.code == "idle-command"]
    assert ("stays the same" if rests else "repeats the measured pose") in finding.message


@pytest.mark.parametrize("part", [slice(3, 6), slice(0, 3)], ids=["torques", "forces"])
def test_torques_that_a_state_never_fills_are_left_out_and_forces_are_refused(
    part: slice, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unfilled = ON_SURROUNDINGS_N.copy()
    unfilled[:, part] = 0.0
    monkeypatch.setattr(f"{__name__}.ON_SURROUNDINGS_N", unfilled)
    bag = old_bag(tmp_path / "run.bag")
    seen = [(finding.code, finding.severity) for finding in inspect_log(bag).findings]
    if part == slice(0, 3):
        with pytest.raises(LogError, match="force x, force y, force z axes of topic /franka_states are 0"):
            read_recording(bag)
        assert ("stuck-axis", "error") in seen
        return
    recording = read_recording(bag)
    assert recording.wrench.measured_axes == ("x", "y", "z")
    assert [each.severity for each in recording.findings if each.code == "zero-torques"] == ["warning"]
    assert ("zero-torques", "warning") in seen
    assert not [code for code, severity in seen if severity == "error"]


def test_inspect_names_what_a_state_can_serve_as(tmp_path: Path) -> None:
    summary = inspect_log(old_bag(tmp_path / "run.bag"))
    assert summary.channels[0].roles == (Role.WRENCH, Role.POSE, Role.COMMAND)
    [missing] = summary.missing
    assert missing.startswith("The type of /franka_states says that gravity is removed from the wrench")
    assert not [finding for finding in summary.findings if finding.severity == "error"]


def test_a_pose_of_sixteen_numbers_is_declared_by_one_path(tmp_path: Path) -> None:
    bag = old_bag(tmp_path / "run.bag")
    fields = PoseFields(orientation=("O_T_EE[0:16]",))
    cell = Cell(pose=PoseSource(topic="franka_states", fields=fields, orientation_as=COLUMN_MAJOR))
    recording = read_recording(bag, cell)
    assert np.array_equal(recording.pose.position_m, POSITION)
    assert same_turn(recording)
    wrong = Cell(pose=PoseSource(topic="/franka_states", fields=fields, orientation_as=ROW_MAJOR))
    with pytest.raises(LogError, match=f"last row of a matrix is. Declare the other of {ROW_MAJOR}"):
        read_recording(bag, wrong)


def test_numbers_that_are_no_rotation_are_refused(tmp_path: Path) -> None:
    bag = old_bag(tmp_path / "run.bag")
    fields = PoseFields(position=("O_T_EE[12:15]",), orientation=("O_T_EE[0:9]",))
    with pytest.raises(LogError, match="120 matrices of topic /franka_states are no rotations"):
        read_recording(bag, Cell(pose=PoseSource(topic="/franka_states", fields=fields, orientation_as=ROW_MAJOR)))


def test_the_robots_own_wrench_topic_gives_way_to_its_state(tmp_path: Path) -> None:
    """`F_ext` holds the same estimate with the same sign, which its type does not say."""
    path = tmp_path / "run.bag"
    stamped = "geometry_msgs/msg/WrenchStamped"
    with BagWriter(path) as bag:
        states = bag.add_connection("/franka_states", "franka_msgs/msg/FrankaState", typestore=ROS1)
        forces = bag.add_connection("/F_ext", stamped, typestore=ROS1)
        zero = ROS1.types["geometry_msgs/msg/Vector3"](x=1.0, y=2.0, z=3.0)
        for index in range(N):
            now = START_NS + index * PERIOD_NS
            bag.write(states, now, ROS1.serialize_ros1(state(ROS1, index, AHEAD), "franka_msgs/msg/FrankaState"))
            inner = ROS1.types["geometry_msgs/msg/Wrench"](force=zero, torque=zero)
            message = ROS1.types[stamped](header=head(ROS1, index), wrench=inner)
            bag.write(forces, now, ROS1.serialize_ros1(message, stamped))
    assert read_recording(path).wrench.topic == "/franka_states"
