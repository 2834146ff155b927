"""Small files for tests, and all that a container hands on of a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from identification.logs.containers.channel import Batch, Channel, Survey, salvaged
from identification.logs.containers.mcap_file import McapContainer
from identification.logs.containers.mcap_salvage import SalvagedMcap
from identification.result import Finding
from tests.identification.logs.containers.mcap_writer import Sent, Style, Writer, channel, schema

START_NS = 1_700_000_000_000_000_000
SCHEMAS = {1: schema(1, "pkg/msg/A", "ros2msg", b"uint8 a"), 2: schema(2, "pkg.B", "protobuf", b"\x01\x02")}
CHANNELS = {
    1: channel(1, 1, "/a", "cdr", {"qos": "x"}),
    2: channel(2, 2, "/b", "protobuf"),
    3: channel(3, 0, "/c", "json"),
}

Message = tuple[int, bytes]


@dataclass(frozen=True, kw_only=True)
class Contents:
    """What a container tells: its survey, the messages of each topic, and what it had to leave out."""

    survey: Survey
    messages: dict[str, list[Message]]
    findings: tuple[Finding, ...]


def messages_of(batch: Batch) -> list[Message]:
    return [
        (int(log_ns), batch.data[start : start + size].tobytes())
        for log_ns, start, size in zip(batch.log_ns, batch.starts, batch.sizes, strict=True)
    ]


def read_all(path: Path, *, salvage: bool = False, topics: Sequence[str] | None = None) -> Contents:
    """Read every channel, or those of some topics."""
    with (SalvagedMcap if salvage else McapContainer)(path) as container:
        survey = container.survey()
        wanted = [held.channel for held in survey.held if topics is None or held.channel.topic in topics]
        messages: dict[str, list[Message]] = {channel.topic: [] for channel in wanted}
        for channel_, found in container.read(wanted, messages_of):
            messages[channel_.topic] += found
        findings = salvaged(path.name, container.lost(), salvage=salvage)
        return Contents(survey=survey, messages=messages, findings=findings)


def channels_of(path: Path) -> list[Channel]:
    with McapContainer(path) as container:
        return [held.channel for held in container.survey().held]


def some_messages(count: int = 60, seed: int = 0) -> list[Sent]:
    """Messages on three channels, now and then out of order, of 0 to 39 random bytes."""
    random = np.random.default_rng(seed)
    return [
        Sent(
            channel_id=int(random.choice([1, 1, 1, 2, 3])),
            log_ns=START_NS + 1000 * index - int(random.integers(0, 2500)),
            data=random.bytes(int(random.integers(0, 40))),
            sequence=index,
        )
        for index in range(count)
    ]


def expected(messages: Sequence[Sent]) -> dict[str, list[Message]]:
    topics = {1: "/a", 2: "/b", 3: "/c"}
    return {
        topic: [(sent.log_ns, sent.data) for sent in messages if sent.channel_id == number]
        for number, topic in topics.items()
    }


def write_style(path: Path, messages: Sequence[Sent], style: Style) -> Writer:
    writer = Writer(style, SCHEMAS, CHANNELS)
    path.write_bytes(writer.write(messages))
    return writer
