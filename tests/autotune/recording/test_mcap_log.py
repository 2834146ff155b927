"""Messages of text, decoded by a library that has not written them."""

import pytest
from rosbags.typesys import Stores, get_typestore

from autotune.recording.mcap_log import TextChannel, TextKind

STAMPS_NS = (1_700_000_003_000_000_250, 1_700_000_003_999_999_999)


@pytest.mark.parametrize("text", ["", "a", "peak 12.5 N", "Größe"])
def test_a_line_of_a_log_has_its_stamp_and_its_text(text: str) -> None:
    channel = TextChannel(topic="/said", kind=TextKind.LOG, stamps_ns=STAMPS_NS, texts=(text, text))
    encode, store = channel.messages(), get_typestore(Stores.ROS2_HUMBLE)
    for i, stamp_ns in enumerate(STAMPS_NS):
        line = store.deserialize_cdr(encode(i), "rcl_interfaces/msg/Log")
        assert 10**9 * line.stamp.sec + line.stamp.nanosec == stamp_ns  # type: ignore[attr-defined]
        assert line.stamp.nanosec < 10**9  # type: ignore[attr-defined]
        assert (line.name, line.msg) == ("autotune", text)  # type: ignore[attr-defined]
