"""Protobuf messages, by the descriptors that the log carries."""

from collections.abc import Callable

from google.protobuf import (  # type: ignore[import-untyped]  # the package carries no annotations
    any_pb2,
    descriptor_pb2,
    descriptor_pool,
    duration_pb2,
    empty_pb2,
    field_mask_pb2,
    message,
    message_factory,
    struct_pb2,
    timestamp_pb2,
    wrappers_pb2,
)

from ...errors import LogError
from ..containers.channel import Channel

_FOREIGN = (message.DecodeError, TypeError, KeyError, ValueError, RecursionError, UnicodeError, MemoryError)

_OWN = {
    module.DESCRIPTOR.name: module.DESCRIPTOR.serialized_pb
    for module in (
        any_pb2, descriptor_pb2, duration_pb2, empty_pb2, field_mask_pb2, struct_pb2, timestamp_pb2, wrappers_pb2
    )
}  # fmt: skip


def build_parser(channel: Channel) -> Callable[[bytes], object]:
    """Build the parser of a channel's messages; what it returns has the fields as attributes.

    A field that is not set reads as its default (0, empty), as in Protobuf itself. Raises LogError where the channel
    carries no usable descriptors (a serialized FileDescriptorSet) of its type; the parser raises it for a message that
    is damaged, lacks a required field or holds fields that its descriptors do not know.
    """
    try:
        files = descriptor_pb2.FileDescriptorSet.FromString(channel.schema)
        build = message_factory.GetMessageClass(_pool_of(files).FindMessageTypeByName(channel.type_name))
    except _FOREIGN as error:
        raise LogError(
            f"The Protobuf descriptors of topic {channel.topic} do not define {channel.type_name or 'a type'} "
            f"({_first_line(error)}); record with a writer that stores a complete FileDescriptorSet."
        ) from error

    def parse(data: bytes) -> object:
        parsed: message.Message = build()
        try:
            parsed.ParseFromString(data)
        except _FOREIGN as error:
            raise _refusal(channel, f"is damaged ({_first_line(error)})") from error
        if not parsed.IsInitialized():
            raise _refusal(channel, "lacks a required field")
        size = parsed.ByteSize()
        parsed.DiscardUnknownFields()
        if parsed.ByteSize() != size:
            raise _refusal(channel, "holds fields that its descriptors do not define")
        return parsed

    return parse


def _pool_of(files: descriptor_pb2.FileDescriptorSet) -> descriptor_pool.DescriptorPool:
    """Add the files to a pool of their own, each behind those that it imports."""
    pool = descriptor_pool.DescriptorPool()
    waiting = {file.name: file for file in files.file}
    known: set[str] = set()
    stack = list(waiting)
    entered: set[str] = set()
    while stack:
        name = stack[-1]
        needed = [each for each in _file(waiting, name).dependency if each not in known]
        if name in known or not needed:
            if name not in known:
                pool.AddSerializedFile(_file(waiting, name).SerializeToString())
                known.add(name)
            stack.pop()
        elif name in entered:
            raise ValueError(f"{name} imports itself")
        else:
            entered.add(name)
            stack.extend(needed)
    return pool


def _file(files: dict[str, descriptor_pb2.FileDescriptorProto], name: str) -> descriptor_pb2.FileDescriptorProto:
    """Return a file of the set, or one of Protobuf's own that writers leave out."""
    if name not in files:
        files[name] = descriptor_pb2.FileDescriptorProto.FromString(_OWN[name])
    return files[name]


def _refusal(channel: Channel, what: str) -> LogError:
    return LogError(
        f"A message of topic {channel.topic} is no {channel.type_name}: it {what}; "
        "the log is damaged or its writer stored another schema."
    )


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
