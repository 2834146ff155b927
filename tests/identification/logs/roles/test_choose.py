"""Which channel serves as what: taken when it is the only plausible one, asked back when it is not."""

import pytest

from identification.errors import LogError
from identification.logs.containers.channel import Channel, ChannelInfo
from identification.logs.roles.cell import (
    Cell,
    DesiredForceSource,
    GainsFields,
    GainsSource,
    PoseFields,
    PoseSource,
    TwistSource,
    WrenchFields,
    WrenchSource,
)
from identification.logs.roles.choose import choose, choose_all, open_questions, spelled_as_in
from identification.logs.roles.registry import (
    ADMITTANCE_STATE,
    FLOAT_ARRAY,
    JOINT_STATE,
    POSE_STAMPED,
    TF_MESSAGE,
    TRANSFORM_STAMPED,
    TWIST_STAMPED,
    WRENCH,
    WRENCH_STAMPED,
    Role,
    is_command_name,
    is_processed_name,
    roles_of,
)

PAIRS = {"/tf": (("base", "tool0"), ("map", "base")), "/tool": (("base", "tool0"),), "/tf_static": (("map", "base"),)}
EFFORT = WrenchFields(force=("effort[0]", "effort[1]", "effort[2]"))


def info(
    topic: str,
    type_name: str,
    *,
    count: int = 100,
    encoding: str = "cdr",
    frame: str = "f",
    columns: tuple[str, ...] = (),
) -> ChannelInfo:
    channel = Channel(topic=topic, type_name=type_name, encoding=encoding, schema_encoding="ros2msg", schema=b"")
    return ChannelInfo(channel=channel, count=count, frame=frame, has_header=True, columns=columns)


FT, POSE = info("/ft", WRENCH_STAMPED), info("/pose", POSE_STAMPED)


def frames_of(one: ChannelInfo) -> tuple[tuple[str, str], ...]:
    return PAIRS[one.channel.topic]


def chosen(infos: list[ChannelInfo], cell: Cell | None = None) -> dict[Role, str]:
    found = choose_all(infos, cell or Cell(), "run.mcap", frames_of)
    return {role: choice.info.channel.topic for role, choice in found.items()}


def refused(infos: list[ChannelInfo], cell: Cell | None = None) -> str:
    with pytest.raises(LogError) as caught:
        chosen(infos, cell)
    return str(caught.value)


@pytest.mark.parametrize(
    "topic",
    ["/robot/pose_command", "/cmd_pose", "/commanded", "/x_desired", "/targetFrame", "/ee/reference/pose", "/setpoint1",
     "/set_point", "/setPoint", "/goal", "/joint_commands", "/targets", "/setpoints", "/pose_ref", "/des_pose"],
)  # fmt: skip
def test_command_words_are_recognised(topic: str) -> None:
    assert is_command_name(topic)


@pytest.mark.parametrize(
    "topic", ["/robot/pose", "/recommended", "/goalkeeper/pose", "/offset/point_pose", "/set/of/point", "/design/pose"]
)
def test_words_are_whole(topic: str) -> None:
    assert not is_command_name(topic)


def test_names_show_a_processed_wrench() -> None:
    assert is_processed_name("/ft_sensor/compensated")
    assert is_processed_name("/wrenchFiltered")
    assert not is_processed_name("/ft/raw")


@pytest.mark.parametrize(
    ("topic", "type_name", "encoding", "roles"),
    [
        ("/ft", WRENCH_STAMPED, "cdr", (Role.WRENCH,)),
        ("/ft", WRENCH_STAMPED, "ros1", (Role.WRENCH,)),
        ("/ft", WRENCH_STAMPED, "json", ()),
        ("/ft", WRENCH, "cdr", (Role.WRENCH,)),
        ("/ft_desired", WRENCH_STAMPED, "cdr", (Role.DESIRED_FORCE,)),
        ("/pose", POSE_STAMPED, "cdr", (Role.POSE,)),
        ("/pose_cmd", POSE_STAMPED, "cdr", (Role.COMMAND,)),
        ("/tf", TF_MESSAGE, "cdr", (Role.POSE,)),
        ("/flange", TRANSFORM_STAMPED, "cdr", (Role.POSE,)),
        ("/flange_target", TRANSFORM_STAMPED, "cdr", (Role.COMMAND,)),
        ("/twist", TWIST_STAMPED, "cdr", (Role.TWIST,)),
        ("/twist_cmd", TWIST_STAMPED, "cdr", ()),
        ("/admittance/state", ADMITTANCE_STATE, "cdr", (Role.WRENCH, Role.GAINS)),
        ("/joints", JOINT_STATE, "cdr", (Role.JOINT_STATE,)),
        ("/data", FLOAT_ARRAY, "cdr", (Role.NUMBERS,)),
        ("/image", "sensor_msgs/msg/Image", "cdr", ()),
    ],
)
def test_roles_follow_type_encoding_and_name(
    topic: str, type_name: str, encoding: str, roles: tuple[Role, ...]
) -> None:
    assert roles_of(info(topic, type_name, encoding=encoding).channel) == roles


def test_every_role_is_found_by_type_and_name() -> None:
    infos = [
        FT,
        POSE,
        info("/pose_cmd", POSE_STAMPED),
        info("/twist", TWIST_STAMPED),
        info("/admittance", ADMITTANCE_STATE),
        info("/force_goal", WRENCH_STAMPED),
        info("/tf", TF_MESSAGE),
    ]
    assert chosen(infos) == {
        Role.WRENCH: "/ft",
        Role.POSE: "/pose",
        Role.COMMAND: "/pose_cmd",
        Role.TWIST: "/twist",
        Role.GAINS: "/admittance",
        Role.DESIRED_FORCE: "/force_goal",
    }


def test_a_processed_wrench_gives_way_to_the_raw_one_and_serves_alone() -> None:
    processed = info("/ft/compensated", WRENCH_STAMPED)
    assert chosen([FT, processed, POSE])[Role.WRENCH] == "/ft"
    assert chosen([processed, POSE])[Role.WRENCH] == "/ft/compensated"
    assert "2 channels" in refused([FT, info("/other", WRENCH), POSE])


def test_the_controllers_wrench_serves_where_no_sensor_is_logged() -> None:
    assert chosen([info("/admittance", ADMITTANCE_STATE), POSE])[Role.WRENCH] == "/admittance"


def test_one_message_is_no_rival_to_a_stream() -> None:
    assert chosen([FT, POSE, info("/start", POSE_STAMPED, count=1)])[Role.POSE] == "/pose"
    assert chosen([FT, info("/start", POSE_STAMPED, count=1)])[Role.POSE] == "/start"


def test_a_frame_chooses_among_channels() -> None:
    other = info("/ft2", WRENCH_STAMPED, frame="other")
    cell = Cell(wrench=WrenchSource(frame="other"))
    assert "frame other" in refused([FT, other, POSE])
    assert chosen([FT, other, POSE], cell)[Role.WRENCH] == "/ft2"


def test_candidates_are_listed_with_what_chooses() -> None:
    message = refused([FT, info("/ft2", WRENCH, count=7, frame=""), POSE])
    assert "/ft (geometry_msgs/msg/WrenchStamped, 100 messages, frame f)" in message
    assert "/ft2 (geometry_msgs/msg/Wrench, 7 messages)" in message
    assert "--wrench-topic or `wrench: {topic: …}` in cell.yaml" in message


def test_an_ambiguous_role_that_is_not_needed_is_left_open_and_reported() -> None:
    infos = [FT, POSE, info("/twist_a", TWIST_STAMPED), info("/twist_b", TWIST_STAMPED)]
    assert Role.TWIST not in chosen(infos)
    reported = open_questions(infos, Cell(), "run.mcap")
    assert [finding.code for finding in reported] == ["role-open"]
    assert "`twist: {topic: …}`" in reported[0].message
    named = Cell(twist=TwistSource(topic="/twist_b"))
    assert chosen(infos, named)[Role.TWIST] == "/twist_b"
    assert open_questions(infos, named, "run.mcap") == ()


def test_a_transform_is_chosen_by_its_frames_or_asked_for() -> None:
    tree, one = info("/tf", TF_MESSAGE), info("/tool", TRANSFORM_STAMPED)
    assert "tool0 in base, base in map" in refused([FT, tree])
    found = choose(Role.POSE, [FT, one], Cell(), "run.mcap", frames_of)
    assert found is not None
    assert found.frames == ("base", "tool0")
    declared = Cell(pose=PoseSource(parent="base", child="tool0"))
    assert chosen([FT, tree, info("/tf_static", TF_MESSAGE)], declared)[Role.POSE] == "/tf"
    assert "2 channels" in refused([FT, tree, one], declared)
    unknown = Cell(pose=PoseSource(parent="base", child="cup"))
    assert "No transform of cup in base is in run.mcap, which holds: base in map, tool0 in base" in refused(
        [FT, tree], unknown
    )


def test_declared_fields_choose_the_only_channel_of_numbers() -> None:
    cell = Cell(wrench=WrenchSource(fields=EFFORT))
    assert chosen([info("/state", JOINT_STATE), POSE], cell)[Role.WRENCH] == "/state"
    assert "2 channels" in refused([info("/state", JOINT_STATE), info("/more", FLOAT_ARRAY), POSE], cell)
    named = Cell(wrench=WrenchSource(topic="/state", fields=EFFORT))
    assert chosen([info("/state", JOINT_STATE), info("/more", FLOAT_ARRAY), POSE], named)[Role.WRENCH] == "/state"
    assert "Topic `/state` is not in run.mcap or holds no message; topics with messages: /pose" in refused(
        [POSE], named
    )


def test_columns_choose_the_table() -> None:
    one = info("a.csv", "csv", encoding="table", columns=("t", "fx", "fy", "fz"))
    other = info("b.csv", "csv", encoding="table", columns=("t", "x", "y", "z"))
    cell = Cell(
        wrench=WrenchSource(fields=WrenchFields(force=("fx", "fy", "fz"))),
        displacement=PoseSource(fields=PoseFields(position=("x", None, "3"))),
    )
    assert chosen([one, other], cell) == {Role.WRENCH: "a.csv", Role.POSE: "b.csv"}


def test_a_refusal_names_the_entries_to_correct_or_to_delete() -> None:
    gains = GainsSource(topic="/gains", fields=GainsFields(mass=("m[0:6]",), damping=("b[0:6]",)))
    force = DesiredForceSource(topic="/gains", fields=EFFORT)
    told = refused([FT, POSE], Cell(gains=gains, desired_force=force))
    assert "Topic `/gains` is not in run.mcap" in told
    assert "Correct the `topic` of `gains`, `desired_force` in cell.yaml, or delete `gains`, `desired_force`" in told
    both = Cell(wrench=WrenchSource(topic="/state", fields=EFFORT), twist=TwistSource(topic="/state"))
    told = refused([FT, POSE], both)
    assert "Correct the `topic` of `wrench`, `twist` in cell.yaml, or delete `twist` with" in told


def test_declared_columns_that_no_table_has_are_named() -> None:
    table = info("a.csv", "csv", encoding="table", columns=("fx", "fy", "fz", "x", "y", "z"))
    cell = Cell(
        wrench=WrenchSource(fields=WrenchFields(force=("fx", "fy", "fz"))),
        displacement=PoseSource(fields=PoseFields(position=("x", "y", "5"))),
        desired_force=DesiredForceSource(fields=WrenchFields(force=("fdx", "fy", "5"))),
    )
    told = refused([table], cell)
    assert "a.csv must have the columns fdx, which cell.yaml declares for the desired force, found fx, fy, fz" in told
    assert "correct `desired_force: {fields: …}`, or delete `desired_force`" in told


def test_a_named_channel_of_numbers_needs_its_layout() -> None:
    message = refused([info("/state", JOINT_STATE), POSE], Cell(wrench=WrenchSource(topic="/state")))
    assert "`wrench: {topic: /state, fields: …}` in cell.yaml" in message
    assert "/state may carry it" in refused([info("/state", JOINT_STATE), POSE])


def test_declared_gains_need_no_channel() -> None:
    known = Cell(gains=GainsSource(mass=(1.0,) * 6, damping=(1.0,) * 6))
    assert Role.GAINS not in chosen([FT, POSE, info("/admittance", ADMITTANCE_STATE)], known)


def test_one_topic_cannot_be_measured_and_commanded() -> None:
    cell = Cell(pose=PoseSource(topic="/pose"), command=PoseSource(topic="/pose"))
    assert "at once" in refused([FT, POSE], cell)


@pytest.mark.parametrize(("in_log", "declared"), [("ft", "/ft"), ("/ft", "ft")])
def test_a_slash_in_front_of_a_topic_makes_no_difference(in_log: str, declared: str) -> None:
    infos = [info(in_log, WRENCH_STAMPED), info("/other", WRENCH_STAMPED), POSE]
    cell = spelled_as_in(Cell(wrench=WrenchSource(topic=declared)), infos)
    assert chosen(infos, cell)[Role.WRENCH] == in_log


def test_a_topic_that_is_there_as_named_is_taken_though_another_differs_by_its_slash() -> None:
    infos = [info("ft", WRENCH_STAMPED), info("/ft", WRENCH_STAMPED), POSE]
    for topic in ("ft", "/ft"):
        assert chosen(infos, spelled_as_in(Cell(wrench=WrenchSource(topic=topic)), infos))[Role.WRENCH] == topic


def test_an_axis_that_is_left_out_has_no_path() -> None:
    found = choose(Role.WRENCH, [FT, POSE], Cell(wrench=WrenchSource(left_out=("z", "rx"))), "run.mcap", frames_of)
    assert found is not None
    assert [path is None for path in found.fields] == [False, False, True, True, False, False]


def test_a_cell_that_was_written_for_one_table_serves_another() -> None:
    table = info("monday.csv", "csv", encoding="table", columns=("fx", "fy", "fz"))
    declared = Cell(wrench=WrenchSource(topic="friday.csv"))
    assert spelled_as_in(declared, [table]).wrench == WrenchSource(topic="monday.csv")
    for infos, cell in (
        ([table, info("pose.csv", "csv", encoding="table")], declared),
        ([table], Cell(wrench=WrenchSource(topic="/ft"))),
        ([FT], declared),
    ):
        assert spelled_as_in(cell, infos) == cell
