import pytest

from identification.errors import listed
from identification.logs.roles.registry import Role


@pytest.mark.parametrize(
    ("count", "end"), [(0, "none"), (1, "t0"), (10, "t8, t9"), (11, "t9, … and 1 more"), (47, "t9, … and 37 more")]
)
def test_at_most_ten_are_reported_and_the_rest_counted(count: int, end: str) -> None:
    reported = listed(f"t{i}" for i in range(count))
    assert reported.endswith(end)
    assert reported.count("t") <= 10


def test_a_sentence_about_a_log_of_a_thousand_topics_stays_short() -> None:
    from identification.logs.containers.channel import Channel, ChannelInfo
    from identification.logs.roles.registry import missing_sentence

    infos = [
        ChannelInfo(
            channel=Channel(
                topic=f"/a/rather/long/topic/{i}",
                type_name=f"pkg/msg/Type{i}",
                encoding="cdr",
                schema_encoding="",
                schema=b"",
            ),
            count=1,
        )
        for i in range(1000)
    ]
    message = missing_sentence(Role.WRENCH, "run7.mcap", infos)
    assert "… and 990 more" in message
    assert len(message) < 1500
