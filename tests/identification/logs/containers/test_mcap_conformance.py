"""The MCAP project's conformance suite: each file is built from its list of records, and its messages are expected.

The suite beside this checkout holds the lists only. A list names the CRCs of its file, so that the file that is built
here is known to be theirs byte by byte.
"""

import json
import struct
from pathlib import Path
from typing import Any

import pytest

from identification.logs.containers.channel import Channel
from tests.identification.logs.containers.mcap_reading import read_all
from tests.identification.logs.containers.mcap_writer import DATA_END, FOOTER, Sent, Style, Writer, channel, schema

PADDING = b"\x01\xff\xff"
ROOT = Path(__file__).resolve().parents[4].parent / "shared" / "data" / "mcap_conformance"
LISTS = sorted(ROOT.glob("*/*.json"))


def records_of(path: Path, kind: str) -> list[dict[str, Any]]:
    return [dict(record["fields"]) for record in json.loads(path.read_text())["records"] if record["type"] == kind]


def raw(values: list[str]) -> bytes:
    return bytes(map(int, values))


def build(path: Path) -> bytes:
    features = set(json.loads(path.read_text())["meta"]["variant"]["features"])
    style = Style(
        chunked="ch" in features,
        message_index="mx" in features,
        statistics="st" in features,
        repeat_schemas="rsh" in features,
        repeat_channels="rch" in features,
        chunk_index="chx" in features,
        summary_offsets="sum" in features,
        padding=PADDING if "pad" in features else b"",
        data_crc=True,
    )
    schemas, channels = records_of(path, "Schema"), records_of(path, "Channel")
    writer = Writer(
        style,
        {int(s["id"]): schema(int(s["id"]), s["name"], s["encoding"], raw(s["data"])) for s in schemas},
        {
            int(c["id"]): channel(int(c["id"]), int(c["schema_id"]), c["topic"], c["message_encoding"], c["metadata"])
            for c in channels
        },
    )
    return writer.write(
        [
            Sent(
                channel_id=int(m["channel_id"]),
                log_ns=int(m["log_time"]),
                data=raw(m["data"]),
                sequence=int(m["sequence"]),
            )
            for m in records_of(path, "Message")
        ]
    )


def test_the_suite_is_whole() -> None:
    if not LISTS:
        pytest.skip("needs the conformance suite in ../shared/data")
    assert len(LISTS) == 154


@pytest.mark.parametrize("path", LISTS, ids=lambda path: path.stem)
def test_a_conformance_file_holds_the_messages_of_its_list(path: Path, tmp_path: Path) -> None:
    data = build(path)
    footer, end = records_of(path, "Footer")[0], records_of(path, "DataEnd")[0]
    footer_start = data.rfind(struct.pack("<BQ", FOOTER, 20))
    assert struct.unpack_from("<QQI", data, footer_start + 9) == tuple(
        int(footer[name]) for name in ("summary_start", "summary_offset_start", "summary_crc")
    )
    data_crc = struct.pack("<I", int(end["data_section_crc"]))
    assert any(data.find(struct.pack("<BQ", DATA_END, length) + data_crc) > 0 for length in (4, 4 + len(PADDING)))
    file = tmp_path / "conformance.mcap"
    file.write_bytes(data)

    messages = [(int(m["log_time"]), raw(m["data"])) for m in records_of(path, "Message")]
    channels = {
        Channel(topic=c["topic"], type_name=s["name"], encoding=c["message_encoding"],
                schema_encoding=s["encoding"], schema=raw(s["data"]))
        for c in records_of(path, "Channel") for s in records_of(path, "Schema") if s["id"] == c["schema_id"]
    }  # fmt: skip
    for salvage in (False, True):
        contents = read_all(file, salvage=salvage)
        assert {held.channel for held in contents.survey.held} == channels
        assert contents.messages == ({"example": messages} if channels else {})
        assert [held.count for held in contents.survey.held] == [len(messages)] * len(channels)
        assert all(held.first_message == (messages[0][1] if messages else b"") for held in contents.survey.held)
        assert contents.findings == ()
        if messages:
            times = [log_ns for log_ns, _ in messages]
            assert (contents.survey.start_ns, contents.survey.end_ns) == (min(times), max(times))
