"""The schemas and channels that an MCAP file defines, each perhaps many times."""

from collections.abc import Iterable

from mcap import records
from rosbags.typesys.msg import normalize_msgtype

from .channel import Channel
from .mcap_records import Damage, Kind, parse_channel, parse_schema

Definition = tuple[int, bytes, int]
"""Kind, content and offset of a record that defines a schema or a channel."""


class Definitions:
    """Gather definitions; one that is repeated must say the same."""

    def __init__(self) -> None:
        self._seen: set[tuple[int, bytes]] = set()
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, tuple[records.Channel, int]] = {}
        self._built: dict[int, Channel] = {}

    def is_new(self, kind: int, body: bytes) -> bool:
        """Tell whether a definition has to be added."""
        return (kind, body) not in self._seen

    def add(self, kind: int, body: bytes, offset: int) -> None:
        """Add a definition; raise Damage when it contradicts an earlier one."""
        if (kind, body) in self._seen:
            return
        if kind == Kind.SCHEMA:
            schema = parse_schema(body, offset)
            if schema.id == 0:
                raise Damage(offset, "a schema has the id 0, which stands for none")
            if self._schemas.setdefault(schema.id, schema) != schema:
                raise Damage(offset, f"schema {schema.id} is defined twice, differently")
        else:
            channel = parse_channel(body, offset)
            if self._channels.setdefault(channel.id, (channel, offset))[0] != channel:
                raise Damage(offset, f"channel {channel.id} is defined twice, differently")
        self._seen.add((kind, body))

    @property
    def ids(self) -> frozenset[int]:
        """Return the ids of all channels."""
        return frozenset(self._channels)

    @property
    def usable(self) -> frozenset[int]:
        """Return the ids of the channels whose schemas are defined."""
        return frozenset(channel_id for channel_id in self._channels if self.has_all((channel_id,)))

    def has_all(self, channel_ids: Iterable[int]) -> bool:
        """Tell whether these channels and their schemas are defined."""
        return all(
            channel_id in self._channels and self._channels[channel_id][0].schema_id in {0, *self._schemas}
            for channel_id in channel_ids
        )

    def channel(self, channel_id: int) -> Channel:
        """Return what a channel id stands for; raise Damage when its schema is nowhere defined."""
        found = self._built.get(channel_id)
        if found is None:
            found = self._built[channel_id] = self._build(*self._channels[channel_id])
        return found

    def _build(self, record: records.Channel, offset: int) -> Channel:
        if record.schema_id == 0:
            return Channel(
                topic=record.topic, type_name="", encoding=record.message_encoding, schema_encoding="", schema=b""
            )
        schema = self._schemas.get(record.schema_id)
        if schema is None:
            raise Damage(offset, f"channel {record.topic} names schema {record.schema_id}, which is not defined")
        is_ros = schema.encoding in ("ros2msg", "ros1msg", "ros2idl")
        return Channel(
            topic=record.topic,
            type_name=normalize_msgtype(schema.name) if is_ros else schema.name,
            encoding=record.message_encoding,
            schema_encoding=schema.encoding,
            schema=bytes(schema.data),
        )
