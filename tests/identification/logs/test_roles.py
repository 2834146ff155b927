"""Which topic names say that they carry a command."""

import pytest

from identification.logs.channel import Channel
from identification.logs.definitions import JOINT_STATE, POSE, WRENCH
from identification.logs.roles import Role, is_command_name, roles_of


@pytest.mark.parametrize(
    "topic",
    ["/robot/pose_command", "/cmd_pose", "/commanded", "/x_desired", "/targetFrame", "/ee/reference/pose", "/setpoint1",
     "/set_point", "/setPoint", "/goal"],
)  # fmt: skip
def test_command_words_are_recognised(topic: str) -> None:
    assert is_command_name(topic)


@pytest.mark.parametrize(
    "topic", ["/robot/pose", "/recommended", "/goalkeeper/pose", "/offset/point_pose", "/set/of/point"]
)
def test_words_are_whole(topic: str) -> None:
    assert not is_command_name(topic)


@pytest.mark.parametrize(
    ("topic", "type_name", "encoding", "roles"),
    [
        ("/ft", WRENCH, "cdr", (Role.WRENCH,)),
        ("/ft", WRENCH, "ros1", (Role.WRENCH,)),
        ("/ft", WRENCH, "json", ()),
        ("/pose", POSE, "cdr", (Role.POSE,)),
        ("/pose_cmd", POSE, "cdr", (Role.COMMAND,)),
        ("/joints", JOINT_STATE, "cdr", (Role.JOINT_STATE,)),
        ("/ft", "geometry_msgs/msg/Wrench", "cdr", ()),
    ],
)
def test_roles_follow_type_encoding_and_name(
    topic: str, type_name: str, encoding: str, roles: tuple[Role, ...]
) -> None:
    assert roles_of(Channel(topic=topic, type_name=type_name, encoding=encoding, definition="")) == roles
