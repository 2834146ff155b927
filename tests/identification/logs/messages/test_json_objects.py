"""JSON messages: what the `json` and `mcap` libraries write, and everything that is not JSON refused."""

import json
import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from identification.errors import LogError
from identification.logs.containers.channel import Batch
from identification.logs.containers.mcap_file import McapContainer
from identification.logs.messages import objects
from identification.logs.messages.objects import parse_json

TREES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@settings(max_examples=200, deadline=None)
@given(tree=TREES)
def test_what_was_written_is_read(tree: object) -> None:
    for ascii_only in (False, True):
        try:
            data = json.dumps(tree, ensure_ascii=ascii_only).encode()
        except UnicodeEncodeError:
            continue
        assert parse_json(data) == tree


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=60) | st.text(alphabet='{}[]":,.-+eE0123456789naINfty \\u', max_size=40).map(str.encode))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    try:
        parse_json(data)
    except LogError as error:
        assert "\n" not in str(error)  # noqa: PT017 - most inputs are refused, some are not


def test_numbers_that_are_not_finite_are_read_as_such() -> None:
    found = parse_json(b'{"fx": NaN, "fy": -Infinity, "fz": 1e999}')
    assert isinstance(found, dict)
    assert math.isnan(found["fx"])
    assert (found["fy"], found["fz"]) == (-math.inf, math.inf)


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"", "expecting value at character 0"),
        (b'{"fx": 1', "at character 8"),
        (b'{"fx": 1,5 "b": 2}', "at character"),
        (b'{"fx": 1} x', "extra data at character 10"),
        (b"{'fx': 1}", "at character 1"),
        (b'{"fx": 1, "fx": 2}', "the key 'fx' occurs twice"),
        (b'{"a": [{"b": {"c": 1, "d": 2, "c": 3}}]}', "the key 'c' occurs twice"),
        (b'{"fx": "\xff"}', "not UTF-8 text at byte 8"),
        (b"\xef\xbb\xbf{}", "at character 0"),
        (b"[" * 100_000 + b"]" * 100_000, "nested too deeply"),
        (b'{"a":' * 100_000 + b"1" + b"}" * 100_000, "nested too deeply"),
        (b"1" * 5000, "too many digits"),
        (b'"\x01"', "invalid control character"),
    ],
)
def test_what_is_not_json_is_refused_with_its_place(data: bytes, complaint: str) -> None:
    with pytest.raises(LogError, match=complaint):
        parse_json(data)


def test_a_message_beyond_the_limit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "_LIMIT_BYTES", 10)
    assert parse_json(b"[1, 2, 3 ]") == [1, 2, 3]
    with pytest.raises(LogError, match="11 bytes is larger than the 10 that are allowed"):
        parse_json(b"[1, 2, 3  ]")


def test_messages_of_an_mcap_file_are_read(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    sent = [{"force": {"x": 0.1 * index}, "list": [index, None, "ü"]} for index in range(50)]
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Wrench", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/ft", "json", schema)
        for index, tree in enumerate(sent):
            writer.add_message(channel, log_time=index, publish_time=index, data=json.dumps(tree).encode())
        writer.finish()

    def parsed(batch: Batch) -> list[object]:
        ends = (batch.starts + batch.sizes).tolist()
        return [parse_json(batch.data[a:b].tobytes()) for a, b in zip(batch.starts.tolist(), ends, strict=True)]

    container = McapContainer(path)
    (held,) = container.survey().held
    assert (held.channel.encoding, held.channel.schema_encoding) == ("json", "jsonschema")
    assert [tree for _, trees in container.read([held.channel], parsed) for tree in trees] == sent
    container.close()
