"""What the `metadata.yaml` of a rosbag2 folder says of it."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import cast

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from ...errors import LogError

NAME = "metadata.yaml"
_LIMIT_BYTES = 2**20
_DEEPEST = 50
_OPENING, _CLOSING = tuple(b"[{"), tuple(b"]}")
_ROOT = "rosbag2_bagfile_information"
_STORAGES = ("mcap", "sqlite3")
_MODES = ("none", "file", "message", "storage")
_Tree = Mapping[str, object]


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """The parts of a folder in order, how they are compressed, and how many messages they hold.

    `topic_counts` is keyed by topic, `file_counts` by file name (empty in older versions).
    """

    storage: str
    compression_mode: str
    files: tuple[str, ...]
    message_count: int
    topic_counts: Mapping[str, int]
    file_counts: Mapping[str, int]


def read_metadata(path: Path) -> Metadata:
    """Read a `metadata.yaml`; raise LogError where it is damaged or says what cannot be."""
    where = f"{path.parent.name}/{path.name}"
    try:
        with path.open("rb") as file:
            data = file.read(_LIMIT_BYTES + 1)
        if len(data) > _LIMIT_BYTES:
            raise LogError(f"{where} is larger than {_LIMIT_BYTES} bytes, which no recorder writes.")
        if b"<<" in data:
            raise LogError(f"{where} holds a merge key (<<), which no recorder writes; restore the recorded file.")
        if _deepest(data) > _DEEPEST:
            raise LogError(f"{where} is nested more than {_DEEPEST} levels deep, which no recorder writes.")
        tree = YAML(typ="safe", pure=True).load(data.decode("utf-8-sig"))
        return _build(where, tree)
    except OSError as error:
        raise LogError(f"{where} cannot be read: {error.strerror or error}; copy the folder again.") from error
    except (YAMLError, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise LogError(
            f"{where} is damaged: {_reason(error)}; restore it (`ros2 bag reindex`) or read the folder with --salvage."
        ) from error


def _deepest(data: bytes) -> int:
    """Return how deep brackets are nested: the parser takes far longer with each level."""
    codes = np.frombuffer(data, dtype=np.uint8)
    steps = np.isin(codes, _OPENING).astype(np.int64) - np.isin(codes, _CLOSING)
    return int(np.cumsum(steps).max(initial=0))


def _reason(error: Exception) -> str:
    if isinstance(error, MarkedYAMLError) and error.problem_mark is not None:
        return f"line {error.problem_mark.line + 1}: {error.problem or error.context}"
    return " ".join(str(error).split())[:300] or type(error).__name__


def _build(where: str, tree: object) -> Metadata:
    root = _mapping(_mapping(tree, "the document").get(_ROOT), _ROOT)
    storage = _text(root, "storage_identifier")
    if storage not in _STORAGES:
        raise LogError(f"{where} names the storage {storage!r}; {' and '.join(_STORAGES)} can be read: convert it.")
    mode = (_text(root, "compression_mode", "") or "none").lower()
    packer = _text(root, "compression_format", "")
    if mode not in _MODES or (mode in ("file", "message") and packer != "zstd"):
        raise LogError(
            f"{where} names the compression {packer!r} in mode {mode!r}; zstd of files or messages can be read: "
            "convert the log with `ros2 bag convert`."
        )
    version = _count(root, "version")
    files = tuple(_file_name(where, name, version) for name in _list(root, "relative_file_paths"))
    if not files:
        raise ValueError("it lists no file")
    if len(set(files)) < len(files):
        raise ValueError("it lists a file twice")
    topics: Counter[str] = Counter()
    for entry in _list(root, "topics_with_message_count"):
        topic = _mapping(entry, "an entry of topics_with_message_count")
        topics[_text(_mapping(topic.get("topic_metadata"), "topic_metadata"), "name")] += _count(topic, "message_count")
    parts = [_mapping(entry, "an entry of files") for entry in _list(root, "files", [])]
    return Metadata(
        storage=storage,
        compression_mode=mode,
        files=files,
        message_count=_count(root, "message_count"),
        topic_counts=dict(topics),
        file_counts={_file_name(where, part["path"], version): _count(part, "message_count") for part in parts},
    )


def _file_name(where: str, value: object, version: int) -> str:
    """Return the name of a part; up to version 3 the name of the folder precedes it."""
    path = PurePosixPath(value if isinstance(value, str) else "")
    parts = path.parts[1:] if version <= 3 and len(path.parts) == 2 else path.parts
    if len(parts) != 1 or parts[0] in ("..", "/") or "\0" in parts[0]:
        raise LogError(f"{where} lists {value!r}, which is no file in this folder; restore the recorded file.")
    return parts[0]


def _mapping(value: object, name: str) -> _Tree:
    if not isinstance(value, Mapping):
        raise ValueError(f"{name} must be a mapping")
    return cast(_Tree, value)


def _list(tree: _Tree, name: str, default: list[object] | None = None) -> list[object]:
    value = tree.get(name, default)
    if not isinstance(value, list):
        raise ValueError(f"{name} must be a list")
    return value


def _text(tree: _Tree, name: str, default: str | None = None) -> str:
    value = tree.get(name, default)
    if not isinstance(value, str):
        raise ValueError(f"{name} must be text")
    return value


def _count(tree: _Tree, name: str) -> int:
    value = tree.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"{name} must be a whole number of zero or more")
    return value
