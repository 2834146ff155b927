"""Logs of raw messages, written by other libraries, and what a container hands on of them."""

from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_typestore

from identification.logs.containers.channel import Batch, Channel, Container

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
START_NS = 1_700_000_000_000_000_000
TYPES = {
    "/ft": "geometry_msgs/msg/WrenchStamped",
    "/pose": "geometry_msgs/msg/PoseStamped",
    "/rare": "std_msgs/msg/String",
}
Told = dict[str, list[tuple[int, bytes]]]


@dataclass(frozen=True, kw_only=True)
class Stored:
    """One message; its content is any bytes, as no container looks into it."""

    topic: str
    log_ns: int
    data: bytes


def several(count: int = 300, seed: int = 1) -> list[Stored]:
    """Messages of three topics among each other, one of them rare, with sizes from nothing to some hundred bytes."""
    random = np.random.default_rng(seed)
    topics = random.choice(["/ft", "/pose", "/rare"], size=count, p=[0.5, 0.48, 0.02])
    return [
        # The first byte of a CDR message is 0.
        Stored(
            topic=str(topic), log_ns=START_NS + 800_000 * index, data=b"\0" + random.bytes(int(random.integers(0, 300)))
        )
        for index, topic in enumerate(topics)
    ]


def reported(messages: Iterable[Stored]) -> Told:
    """The same messages per topic."""
    found: Told = {}
    for message in messages:
        found.setdefault(message.topic, []).append((message.log_ns, message.data))
    return found


def write_bag(
    path: Path,
    messages: Sequence[Stored],
    compression: BagWriter.CompressionFormat | None = None,
    chunk_bytes: int = 4000,
) -> Path:
    """Write a ROS 1 bag."""
    bag = BagWriter(path)
    bag.chunk_threshold = chunk_bytes
    if compression is not None:
        bag.set_compression(compression)
    with bag:
        connections = {
            topic: bag.add_connection(topic, TYPES[topic], typestore=ROS1)
            for topic in dict.fromkeys(message.topic for message in messages)
        }
        for message in messages:
            bag.write(connections[message.topic], message.log_ns, message.data)
    return path


def write_folder(
    path: Path,
    messages: Sequence[Stored],
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    mode: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write a folder of rosbag2."""
    bag = FolderWriter(path, version=9, storage_plugin=storage)
    if mode != CompressionMode.NONE:
        bag.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        connections = {
            topic: bag.add_connection(topic, TYPES[topic], typestore=ROS2)
            for topic in dict.fromkeys(message.topic for message in messages)
        }
        for message in messages:
            bag.write(connections[message.topic], message.log_ns, message.data)
    return path


def messages_of(batch: Batch) -> list[tuple[int, bytes]]:
    """Time and bytes of each message of a batch."""
    return [
        (int(log_ns), batch.data[start : start + size].tobytes())
        for log_ns, start, size in zip(batch.log_ns, batch.starts, batch.sizes, strict=True)
    ]


def channels_of(container: Container) -> dict[str, Channel]:
    """The channels by topic."""
    return {held.channel.topic: held.channel for held in container.survey().held}


def read_all(container: Container, *topics: str) -> Told:
    """Read topics (or all), close the container and return the messages per topic in order."""
    with closing(container):
        channels = channels_of(container)
        found: Told = {}
        for channel, messages in container.read([channels[topic] for topic in topics or channels], messages_of):
            found.setdefault(channel.topic, []).extend(messages)
        return found


def codes(container: Container) -> list[str]:
    """The codes of what the survey found."""
    return [finding.code for finding in container.survey().findings]
