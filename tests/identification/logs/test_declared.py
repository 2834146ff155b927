"""Logs whose meaning is declared: every kind of channel gives the signals that went in."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from identification.errors import EstimateError, LogError
from identification.identify import identify_cell
from identification.logs.inspect import inspect_log
from identification.logs.read import read_recording
from identification.logs.roles.cell import (
    Cell,
    Clock,
    DeclaredDeadband,
    DesiredForceSource,
    Frame,
    GainsFields,
    GainsSource,
    PoseFields,
    PoseSource,
    PoseUnits,
    TwistFields,
    TwistSource,
    WrenchFields,
    WrenchSource,
    WrenchUnits,
)
from identification.logs.tables.layout import TableLayout
from identification.signals.recording import AppliedDeadband, Recording
from problems.contact.nonlinearities import DeadbandType
from tests.identification.logs.message_builder import (
    ADMITTANCE_STATE,
    DELAY_NS,
    Topic,
    Tree,
    header,
    write_log,
    xyz,
    xyzw,
)

N = 200
RNG = np.random.default_rng(7)
WRENCH = RNG.standard_normal((N, 6)) * [50, 50, 50, 5, 5, 5]
TURN = Rotation.from_rotvec(np.linspace(0.0, 2.0, N)[:, None] * [0.6, 0.0, 0.8]) * Rotation.from_rotvec([3.0, 0.2, 0.1])
POSITION = np.cumsum(RNG.standard_normal((N, 3)), axis=0) * 1e-3
QUATERNION, EULER = TURN.as_quat(canonical=True), TURN.as_euler("ZYZ")


def wrench(i: int, stamp: int) -> Tree:
    return {"header": header(stamp, "ft"), "wrench": {"force": xyz(WRENCH[i, :3]), "torque": xyz(WRENCH[i, 3:])}}


def pose(i: int, stamp: int) -> Tree:
    return {"header": header(stamp), "pose": {"position": xyz(POSITION[i]), "orientation": xyzw(QUATERNION[i])}}


def joints(i: int, stamp: int) -> Tree:
    entries = {"position": [*POSITION[i] * 1e3, *EULER[i]], "velocity": [*range(6)], "effort": [*WRENCH[i], *range(6)]}
    return {"header": header(stamp, ""), **entries}


def numbers(i: int, _: int) -> Tree:
    return {"data": [0.0, *WRENCH[i], *POSITION[i], *QUATERNION[i][[3, 0, 1, 2]]]}


def transform(i: int, stamp: int, child: str = "tool0") -> Tree:
    return {
        "header": header(stamp),
        "child_frame_id": child,
        "transform": {"translation": xyz(POSITION[i]), "rotation": xyzw(QUATERNION[i])},
    }


FT = Topic(topic="/ft", type_name="geometry_msgs/msg/WrenchStamped", message=wrench)
POSE = Topic(topic="/pose", type_name="geometry_msgs/msg/PoseStamped", message=pose)
JOINTS = Topic(topic="/state", type_name="sensor_msgs/msg/JointState", message=joints)
NUMBERS = Topic(topic="/numbers", type_name="std_msgs/msg/Float64MultiArray", message=numbers)


def paths(name: str, first: int, last: int) -> tuple[str, ...]:
    return tuple(f"{name}[{index}]" for index in range(first, last))


OF_JOINTS = Cell(
    wrench=WrenchSource(topic="/state", fields=WrenchFields(force=paths("effort", 0, 3), torque=paths("effort", 3, 6))),
    pose=PoseSource(
        topic="/state",
        fields=PoseFields(position=paths("position", 0, 3), orientation=paths("position", 3, 6)),
        units=PoseUnits(position="mm"),
        orientation_as="euler_ZYZ",
    ),
)


def assert_same_motion(recording: Recording, *, delayed: bool = False) -> None:
    """The recording holds wrench and pose as they went in, stamped by the header or (delayed) by the recorder."""
    stamps = FT.stamps + (DELAY_NS if delayed else 0)
    assert np.array_equal(recording.wrench.stamp_ns, stamps)
    assert np.array_equal(recording.pose.stamp_ns, stamps)
    assert np.array_equal(recording.wrench.force_n, WRENCH[:, :3])
    assert np.array_equal(recording.wrench.torque_n_m, WRENCH[:, 3:])
    # Millimetres and back is one rounding.
    assert np.allclose(recording.pose.position_m, POSITION, rtol=1e-14, atol=0)
    apart = Rotation.from_quat(recording.pose.quaternion_xyzw).inv() * TURN
    assert np.max(apart.magnitude()) < 1e-7  # arccos near 1
    assert np.max(np.linalg.norm(np.diff(recording.pose.quaternion_xyzw, axis=0), axis=1)) < 0.01


def codes(recording: Recording) -> list[str]:
    return [finding.code for finding in recording.findings]


def test_joint_states(tmp_path: Path) -> None:
    recording = read_recording(write_log(tmp_path / "run.mcap", [JOINTS]), OF_JOINTS)
    assert_same_motion(recording)
    assert recording.clocks == {"wrench": "header", "pose": "header"}
    assert recording.command is None


def test_the_choice_is_reported(tmp_path: Path) -> None:
    recording = read_recording(write_log(tmp_path / "run.mcap", [FT, POSE]))
    message = [finding.message for finding in recording.findings if finding.code == "channel-chosen"]
    assert message[0].startswith("The wrench is read from /ft (geometry_msgs/msg/WrenchStamped, 200 messages, ")
    assert message[0].endswith("frame ft): the only plausible geometry_msgs/msg/WrenchStamped.")
    assert len(message) == 2


def test_arrays_without_a_header_are_stamped_by_the_recorder_and_so_is_all_else(tmp_path: Path) -> None:
    cell = Cell(
        wrench=WrenchSource(fields=WrenchFields(force=paths("data", 1, 4), torque=paths("data", 4, 7))),
        pose=PoseSource(
            topic="/numbers",
            fields=PoseFields(position=paths("data", 7, 10), orientation=paths("data", 10, 14)),
            orientation_as="quaternion_wxyz",
        ),
    )
    path = write_log(tmp_path / "run.mcap", [NUMBERS, POSE])
    recording = read_recording(path, cell)
    assert_same_motion(recording, delayed=True)
    (reported,) = [finding for finding in recording.findings if finding.code == "log-clock"]
    assert reported.message.startswith("/numbers has no header stamps")
    mixed = read_recording(path, replace(cell, pose=None))
    assert mixed.clocks == {"wrench": "log", "pose": "log"}
    assert np.array_equal(mixed.pose.stamp_ns, POSE.stamps + DELAY_NS)


def test_json_is_read_by_its_paths(tmp_path: Path) -> None:
    def sample(i: int, stamp: int) -> Tree:
        stamps = {"stamp": {"sec": stamp // 10**9, "nanosec": stamp % 10**9}, "frame_id": "ft"}
        return {
            "meta": stamps,
            "f": WRENCH[i].tolist(),
            "tcp": {"p": POSITION[i].tolist(), "q": QUATERNION[i].tolist()},
        }

    cell = Cell(
        wrench=WrenchSource(
            topic="/json", header="meta", fields=WrenchFields(force=paths("f", 0, 3), torque=paths("f", 3, 6))
        ),
        pose=PoseSource(
            topic="/json",
            header="meta",
            fields=PoseFields(position=paths("tcp.p", 0, 3), orientation=paths("tcp.q", 0, 4)),
        ),
    )
    path = write_log(tmp_path / "run.mcap", [Topic(topic="/json", type_name="", message=sample)])
    assert_same_motion(read_recording(path, cell))
    summary = inspect_log(path)
    assert summary.numbers[0].paths[:4] == ("meta.stamp.sec", "meta.stamp.nanosec", "f[0]", "f[1]")


def test_a_transform_is_the_pose(tmp_path: Path) -> None:
    one = Topic(topic="/tool", type_name="geometry_msgs/msg/TransformStamped", message=transform)
    recording = read_recording(write_log(tmp_path / "one.mcap", [FT, one]))
    assert_same_motion(recording)
    assert recording.pose.frame_id == "base"
    tree = Topic(
        topic="/tf",
        type_name="tf2_msgs/msg/TFMessage",
        message=lambda i, stamp: {"transforms": [transform(N - 1 - i, stamp, "elbow"), transform(i, stamp)]},
    )
    path = write_log(tmp_path / "tree.mcap", [FT, tree])
    with pytest.raises(LogError, match=r"2 transforms, .*elbow in base, tool0 in base; say which with `pose: \{parent"):
        read_recording(path)
    recording = read_recording(path, Cell(pose=PoseSource(parent="base", child="tool0")))
    assert_same_motion(recording)
    assert inspect_log(path, Cell(pose=PoseSource(parent="base", child="tool0"))).roles[1].child == "tool0"


def test_the_admittance_state_shows_gains_and_a_wrench_in_base_axes(tmp_path: Path) -> None:
    def state(i: int, stamp: int) -> Tree:
        turned = {"force": xyz(TURN[i].apply(WRENCH[i, :3])), "torque": xyz(TURN[i].apply(WRENCH[i, 3:]))}
        return {
            "mass": {"data": [10.0 + i, 11, 12, 1, 2, 3]},
            "damping": {"data": [100, 110, 120, 4, 5, 6]},
            "wrench_base": {"header": header(stamp), "wrench": turned},
        }

    admittance = Topic(topic="/admittance/state", type_name=ADMITTANCE_STATE, message=state)
    recording = read_recording(write_log(tmp_path / "alone.mcap", [admittance, POSE]))
    assert recording.clocks == {"wrench": "log", "pose": "log", "gains": "log"}
    assert recording.wrench.gravity_compensated
    # The recorder's clock is 0.3 ms late for both: within the pose's time, and the turn is that of the sample.
    assert np.allclose(recording.wrench.force_n, WRENCH[:, :3], rtol=0, atol=1e-9)
    assert "admittance-state-wrench" in codes(recording)
    assert recording.gains is not None
    assert recording.gains.mass[5].tolist() == [15, 11, 12, 1, 2, 3]
    assert recording.gains.damping[0].tolist() == [100, 110, 120, 4, 5, 6]
    # Beside a sensor that is logged with header stamps the gains are brought to its clock.
    beside = read_recording(write_log(tmp_path / "beside.mcap", [admittance, FT, POSE]))
    assert beside.wrench.topic == "/ft"
    assert beside.clocks == {"wrench": "header", "pose": "header", "gains": "log"}
    assert beside.gains is not None
    assert np.array_equal(beside.gains.stamp_ns, admittance.stamps)


def test_twist_gains_and_desired_force_of_joint_states(tmp_path: Path) -> None:
    cell = replace(
        OF_JOINTS,
        twist=TwistSource(topic="/state", fields=TwistFields(linear=paths("velocity", 0, 3))),
        gains=GainsSource(
            topic="/state", fields=GainsFields(mass=paths("effort", 6, 12), damping=paths("velocity", 0, 6))
        ),
        desired_force=DesiredForceSource(topic="/state", fields=WrenchFields(force=paths("effort", 9, 12))),
    )
    recording = read_recording(write_log(tmp_path / "run.mcap", [JOINTS]), cell)
    assert_same_motion(recording)
    assert recording.twist is not None
    assert recording.twist.linear_m_s[3].tolist() == [0, 1, 2]
    assert recording.twist.measured_axes == ("x", "y", "z")
    assert recording.gains is not None
    assert recording.gains.mass[9].tolist() == [0, 1, 2, 3, 4, 5]
    assert recording.desired_force is not None
    assert recording.desired_force.force_n[0].tolist() == [3, 4, 5]
    assert "twist-disagrees" in codes(recording)


def test_known_gains_are_constants(tmp_path: Path) -> None:
    deadband = DeclaredDeadband(type=DeadbandType.SUBTRACTIVE, force_n=5.0)
    lead = (0.02, 0.02, 0.02, 0.0, 0.0, 0.0)
    cell = Cell(gains=GainsSource(mass=(1, 2, 3, 4, 5, 6), damping=(7, 8, 9, 10, 11, 12), lead=lead, deadband=deadband))
    recording = read_recording(write_log(tmp_path / "run.mcap", [FT, POSE]), cell)
    assert recording.gains is not None
    assert recording.gains.mass.tolist() == [[1, 2, 3, 4, 5, 6]]
    assert recording.gains.damping.tolist() == [[7, 8, 9, 10, 11, 12]]
    assert recording.gains.lead_s == lead
    assert recording.gains.deadband == AppliedDeadband(type="subtractive", force_n=5.0)


def test_a_known_desired_force_turns_with_the_tool_where_it_is_declared_in_base_axes(tmp_path: Path) -> None:
    source = DesiredForceSource(force=(0.0, 0.0, 0.03), units=WrenchUnits(force="kN"))
    log = write_log(tmp_path / "run.mcap", [FT, POSE])
    cells = Cell(desired_force=source), Cell(desired_force=replace(source, expressed_in=Frame.BASE))
    of_tool, of_base = (read_recording(log, cell) for cell in cells)
    assert of_tool.desired_force is not None
    assert of_tool.desired_force.force_n == pytest.approx(np.array([[0.0, 0.0, 30.0]]))
    assert of_base.desired_force is not None
    turned = Rotation.from_quat(of_base.pose.quaternion_xyzw).apply(np.array(of_base.desired_force.force_n))
    assert turned == pytest.approx(np.tile([0.0, 0.0, 30.0], (len(turned), 1)), abs=1e-9)


def test_clocks_are_as_declared(tmp_path: Path) -> None:
    path = write_log(tmp_path / "run.mcap", [FT, POSE])
    cell = Cell(wrench=WrenchSource(clock=Clock.LOG, clock_offset_s=-0.0003), pose=PoseSource(clock_offset_s=2.0))
    recording = read_recording(path, cell)
    assert recording.clocks == {"wrench": "log", "pose": "header"}
    assert np.array_equal(recording.wrench.stamp_ns, FT.stamps)
    assert np.array_equal(recording.pose.stamp_ns, POSE.stamps + 2 * 10**9)
    fields = WrenchFields(force=paths("data", 1, 4), torque=paths("data", 4, 7))
    headless = Cell(wrench=WrenchSource(topic="/numbers", fields=fields, clock=Clock.HEADER))
    with pytest.raises(LogError, match=r"/numbers must have header stamps, as cell.yaml declares for the wrench"):
        read_recording(write_log(tmp_path / "numbers.mcap", [NUMBERS, POSE]), headless)


def test_several_files_are_one_recording(tmp_path: Path) -> None:
    def part(topic: Topic, first: int) -> Topic:
        class Part(Topic):
            @property
            def stamps(self) -> Any:
                return topic.stamps[first : first + 100]

        return Part(topic=topic.topic, type_name=topic.type_name, message=lambda i, s: topic.message(first + i, s))

    one = write_log(tmp_path / "a.mcap", [part(FT, 0), part(POSE, 0)])
    two = write_log(tmp_path / "b.mcap", [part(FT, 100), part(POSE, 100)])
    recording = read_recording([two, one])
    assert_same_motion(recording)
    assert list(recording.sha256) == [str(two), str(one)]
    with pytest.raises(LogError, match="one is named twice"):
        read_recording([one, tmp_path / "." / "a.mcap"])
    with pytest.raises(LogError, match="At least one log"):
        read_recording([])


def test_files_that_hold_other_channels_are_one_recording(tmp_path: Path) -> None:
    files = [write_log(tmp_path / "ft.mcap", [FT]), write_log(tmp_path / "pose.mcap", [POSE])]
    assert_same_motion(read_recording(files))
    table = tmp_path / "ft.csv"
    rows = [
        ",".join(map(repr, [stamp + DELAY_NS, *map(float, row)]))
        for stamp, row in zip(FT.stamps.tolist(), WRENCH, strict=True)
    ]
    table.write_text("\n".join(["t,fx,fy,fz,tx,ty,tz", *rows, ""]), encoding="utf-8")
    cell = Cell(
        wrench=WrenchSource(fields=WrenchFields(force=("fx", "fy", "fz"), torque=("4", "5", "6"))),
        table=TableLayout(time="t", time_unit="ns"),
    )
    recording = read_recording([table, files[1]], cell)
    # Nanoseconds since 1970 are written as whole numbers, and the pose follows the table's clock.
    assert_same_motion(recording, delayed=True)


def test_a_part_that_lacks_a_channel_is_refused(tmp_path: Path) -> None:
    files = [write_log(tmp_path / "a.mcap", [FT, POSE]), write_log(tmp_path / "b.mcap", [FT])]
    with pytest.raises(LogError, match=r"/pose must hold the measured pose in each of a\.mcap, b\.mcap"):
        read_recording(files)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"wrench": WrenchSource(topic="/state", fields=WrenchFields(force=paths("effort", 10, 13)))},
            r"must have effort\[12\], which cell.yaml declares for the wrench, found position\[0\] to position\[5\], ",
        ),
        ({"wrench": WrenchSource(topic="/state", fields=WrenchFields(force=("a", "b", "c")))}, "must have a, b, c,"),
    ],
)
def test_fields_that_are_not_there_are_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = write_log(tmp_path / "run.mcap", [JOINTS])
    with pytest.raises(LogError, match=message):
        read_recording(path, replace(OF_JOINTS, **change))


def test_one_channel_may_be_stamped_for_one_role_and_not_for_the_other(tmp_path: Path) -> None:
    path = write_log(tmp_path / "run.mcap", [JOINTS])
    wrench_source, pose_source = OF_JOINTS.wrench or WrenchSource(), OF_JOINTS.pose or PoseSource()
    for change in (
        {"wrench": replace(wrench_source, header="")},
        {"pose": replace(pose_source, header="")},
    ):
        recording = read_recording(path, replace(OF_JOINTS, **change))
        assert_same_motion(recording, delayed=True)
        assert "log-clock" in codes(recording)


def test_an_axis_that_stays_in_the_deadband_is_refused_unless_one_is_declared(tmp_path: Path) -> None:
    def quiet(i: int, stamp: int) -> Tree:
        reported = {"force": xyz([*WRENCH[i, :2], 0.0]), "torque": xyz(WRENCH[i, 3:])}
        return {"header": header(stamp, "ft"), "wrench": reported}

    path = write_log(tmp_path / "run.mcap", [replace(FT, message=quiet), POSE])
    with pytest.raises(LogError, match="force z axis of topic /ft is 0 in all 200 samples"):
        read_recording(path)
    deadband = DeclaredDeadband(type=DeadbandType.SUBTRACTIVE)
    recording = read_recording(path, Cell(wrench=WrenchSource(deadband=deadband)))
    assert np.array_equal(recording.wrench.force_n[:, :2], WRENCH[:, :2])
    reported = [finding for finding in recording.findings if finding.code == "stuck-axis"]
    assert [finding.severity for finding in reported] == ["warning"]


def test_a_command_that_stands_still_is_no_broken_sensor(tmp_path: Path) -> None:
    def resting(i: int, stamp: int) -> Tree:
        at = max(i - 150, 0)
        return {"header": header(stamp), "pose": {"position": xyz(POSITION[at]), "orientation": xyzw(QUATERNION[at])}}

    command = replace(POSE, topic="/pose_command", message=resting)
    recording = read_recording(write_log(tmp_path / "run.mcap", [FT, POSE, command]))
    assert recording.command is not None
    assert not {"stuck-axis", "repeated-samples"} & set(codes(recording))
    # The same of the measured pose is a fault.
    with pytest.raises(LogError, match="stays exactly the same"):
        read_recording(write_log(tmp_path / "stuck.mcap", [FT, replace(POSE, message=resting)]))


def test_a_declared_layout_is_not_asked_for(tmp_path: Path) -> None:
    path = write_log(tmp_path / "run.mcap", [JOINTS])
    assert "layout-undeclared" in [finding.code for finding in inspect_log(path).findings]
    summary = inspect_log(path, OF_JOINTS)
    assert "layout-undeclared" not in [finding.code for finding in summary.findings]
    assert [role.reason for role in summary.roles[:2]] == ["declared with its fields"] * 2


def test_rows_without_a_time_have_no_rate(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("a,b\n1,2\n3,4\n", encoding="utf-8")
    summary = inspect_log(tmp_path / "run.csv")
    assert (summary.channels[0].count, summary.channels[0].rate_hz, summary.channels[0].max_gap_s) == (2, None, None)
    assert "time-undeclared" in [finding.code for finding in summary.findings]
    timed = inspect_log(tmp_path / "run.csv", Cell(table=TableLayout(sample_rate_hz=100.0)))
    assert timed.channels[0].rate_hz == pytest.approx(100.0)
    with pytest.raises(LogError, match="time is not declared"):
        read_recording(
            tmp_path / "run.csv",
            Cell(
                wrench=WrenchSource(fields=WrenchFields(force=("a", None, None))),
                displacement=PoseSource(fields=PoseFields(position=("b", None, None))),
            ),
        )


def test_an_orientation_that_jumps_is_reported(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.mcap", [JOINTS])
    assert "orientation-jumps" not in codes(read_recording(path, OF_JOINTS))
    leap = Topic(
        topic="/state",
        type_name="sensor_msgs/msg/JointState",
        message=lambda i, s: {**joints(i, s), "position": [*POSITION[i], *(EULER[i] + [0, i > 100, 0])]},
    )
    assert "orientation-jumps" in codes(read_recording(write_log(tmp_path / "b.mcap", [leap]), OF_JOINTS))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"wrench": WrenchSource(topic="/ft", gravity_compensated=True, expressed_in=Frame.SENSOR)},
            "Gravity is already removed from the force of topic /ft, so the payload's mass",
        ),
        ({"displacement": PoseSource(topic="/pose")}, "Topic /pose shows a displacement from an unknown pose"),
    ],
)
def test_what_mass_cannot_be_separated_from_ends_in_a_reason(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    path = write_log(tmp_path / "run.mcap", [FT, POSE])
    recording = read_recording(path, Cell(**change))
    with pytest.raises(EstimateError, match=message):
        identify_cell(recording)
    assert any("cell.yaml declares" in sentence for sentence in inspect_log(path, Cell(**change)).missing)


def test_a_pose_that_only_turns_is_no_stuck_pose(tmp_path: Path) -> None:
    """Whether the orientation is told in four numbers or in three."""

    def turning(i: int, stamp: int) -> Tree:
        return {"header": header(stamp, ""), "position": [0.4, 0.0, 0.9, *TURN[i].as_rotvec()], "effort": [1.0]}

    arm = Topic(topic="/arm", type_name="sensor_msgs/msg/JointState", message=turning)
    fields = PoseFields(position=paths("position", 0, 3), orientation=paths("position", 3, 6))
    cell = Cell(pose=PoseSource(topic="/arm", fields=fields, orientation_as="rotation_vector"))
    recording = read_recording(write_log(tmp_path / "run.mcap", [FT, arm]), cell)
    assert np.all(recording.pose.position_m == [0.4, 0.0, 0.9])
    left = (Rotation.from_quat(recording.pose.quaternion_xyzw) * TURN.inv()).magnitude()
    # The angle of a turn is known to the root of what its cosine is.
    assert np.max(left) < 1e-7
