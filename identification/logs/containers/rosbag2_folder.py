"""Folders of rosbag2: several files in order as one log, held against what their `metadata.yaml` says."""

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeVar, cast

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from ...errors import LogError
from ...result import Finding
from .channel import Batch, Channel, Container, Held, Survey
from .zstd import unpack_message, unpack_messages

T = TypeVar("T")
NAME = "metadata.yaml"
_LIMIT_BYTES = 2**20
_DEEPEST = 50
_OPENING, _CLOSING = tuple(b"[{"), tuple(b"]}")
_ROOT = "rosbag2_bagfile_information"
_STORAGES = ("mcap", "sqlite3")
_MODES = ("none", "file", "message", "storage")
_Tree = Mapping[str, object]
_PACKED = (".zstd", ".zst")
_DIGITS = re.compile(r"(\d+)")
_LISTED = 5


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


class Rosbag2FolderContainer(Container):
    """A folder of parts, each opened only while it is being read."""

    def __init__(
        self, path: Path, open_part: Callable[..., Container], endings: Collection[str], *, salvage: bool = False
    ) -> None:
        self._path, self._open_part, self._endings, self._salvage = path, open_part, tuple(endings), salvage
        self._name = path.name or str(path)
        self._lost: list[str] = []
        self._remarks: list[Finding] = []
        self._surveys: dict[Path, Survey] = {}
        self._survey: Survey | None = None
        self._lost_of_parts: dict[str, None] = {}
        self._check_links()
        self._metadata = self._read_metadata()
        self._parts = self._find_parts(self._metadata) if self._metadata else self._guess_parts()

    def survey(self) -> Survey:
        """Return what the parts hold together; raise LogError where one is damaged or the counts do not agree."""
        if self._survey is None:
            for part in self._parts:
                self._survey_part(part)
            if self._metadata:
                self._check_counts(self._metadata)
            self._survey = self._merged()
        return self._survey

    def read(self, wanted: Collection[Channel], handle: Callable[[Batch], T]) -> Iterator[tuple[Channel, T]]:
        """Read the wanted channels part by part; see `Container.read`."""
        self.survey()
        chosen = set(wanted)
        for part, survey in self._surveys.items():
            here = {held.channel for held in survey.held if held.channel in chosen}
            if not here or not self.may_want(survey.start_ns, survey.end_ns):
                continue
            with self._opened(part) as container:
                container.recorded_ns = self.recorded_ns
                yield from container.read(here, self._handler(part, handle))
                self._note(part, container)

    def lost(self) -> tuple[str, ...]:
        """Name the files and the damaged places of files that were left out so far."""
        return (*self._lost_of_parts, *self._lost)

    def _note(self, part: Path, container: Container) -> None:
        self._lost_of_parts.update(dict.fromkeys(f"of {part.name} {place}" for place in container.lost()))

    def _check_links(self) -> None:
        """Refuse a link that leads out of the folder: what it leads to was not recorded here, and is not shown."""
        whole = self._path.resolve()
        for path in self._entries():
            if path.is_symlink() and not path.resolve().is_relative_to(whole):
                raise LogError(
                    f"{self._name}/{path.name} is a symbolic link that leads out of the folder, so nothing is read "
                    "from it; copy the recorded file itself into the folder, or name it on its own."
                )

    def _entries(self) -> list[Path]:
        try:
            return sorted(self._path.iterdir())
        except OSError as error:
            raise LogError(f"{self._name} cannot be read: {error.strerror or error}; check its permissions.") from error

    def _read_metadata(self) -> Metadata | None:
        path = self._path / NAME
        if not path.exists():
            return None
        try:
            return read_metadata(path)
        except LogError as error:
            if not self._salvage:
                raise
            self._lost.append(str(error).rstrip("."))
            return None

    def _find_parts(self, metadata: Metadata) -> list[Path]:
        """Return the files that the metadata list, packed or not."""
        listed = {name: _first_existing(self._path, name) for name in metadata.files}
        missing = [name for name, path in listed.items() if path is None]
        if missing and not self._salvage:
            raise LogError(
                f"{self._name} lacks {_names(missing)}, which its {NAME} lists; copy the folder again, "
                "or read the files that are there with --salvage."
            )
        self._lost.extend(f"{name} is missing" for name in missing)
        parts = [path for path in listed.values() if path is not None]
        others = [path.name for path in self._log_files() if path not in parts]
        if others:
            self._remarks.append(
                Finding.warning(
                    "unlisted-files",
                    f"{self._name} holds {_names(others)}, not listed in its {NAME}, which is left out.",
                    "Run `ros2 bag reindex` if the file belongs to the recording, or name it on its own.",
                )
            )
        return parts

    def _guess_parts(self) -> list[Path]:
        """Return the files of a folder without metadata, which must be of one kind and number through."""
        files = sorted(self._log_files(), key=lambda path: _natural(path.name))
        if not files:
            raise LogError(
                f"{self._name} is a folder without a log: it holds neither {NAME} nor files named "
                f"{', '.join('*' + ending for ending in self._endings)}; name a log file or the folder of a recording."
            )
        if len({_stem(path.name, self._endings) for path in files}) > 1:
            raise LogError(
                f"{self._name} is a folder without {NAME} that holds several logs "
                f"({_names([path.name for path in files])}); name one of them."
            )
        self._remarks.append(
            Finding(
                code="metadata-absent",
                severity="info" if len(files) == 1 else "warning",
                message=f"{self._name} has no usable {NAME}: it is read as {_names([path.name for path in files])}, "
                "in this order.",
                advice="Run `ros2 bag reindex` on the folder, or name the file that is meant.",
            )
        )
        return files

    def _log_files(self) -> list[Path]:
        return [path for path in self._entries() if _stem(path.name, self._endings) and path.is_file()]

    def _opened(self, part: Path) -> closing[Container]:
        return closing(self._open_part(part, salvage=self._salvage))

    def _survey_part(self, part: Path) -> None:
        try:
            with self._opened(part) as container:
                self._surveys[part] = container.survey()
                self._note(part, container)
        except LogError as error:
            if not self._salvage:
                raise
            self._lost.append(str(error).rstrip("."))

    def _check_counts(self, metadata: Metadata) -> None:
        """Raise LogError, or note it with `salvage`, where the files hold other messages than the metadata count."""
        held: Counter[str] = Counter()
        for survey in self._surveys.values():
            for each in survey.held:
                held[each.channel.topic] += each.count
        wrong = [
            f"{held[topic]} of {metadata.topic_counts.get(topic, 0)} messages of {topic}"
            for topic in sorted(held.keys() | metadata.topic_counts.keys())
            if held[topic] != metadata.topic_counts.get(topic, 0)
        ]
        for part, survey in self._surveys.items():
            count = sum(each.count for each in survey.held)
            expected = metadata.file_counts.get(part.name, metadata.file_counts.get(part.stem, count))
            if count != expected:
                wrong.append(f"{count} of {expected} messages in {part.name}")
        if held.total() != metadata.message_count:
            wrong.append(f"{held.total()} of {metadata.message_count} messages in all")
        if wrong and not self._salvage:
            raise LogError(
                f"{self._name} does not hold what its {NAME} counts: {_names(wrong)}; "
                "messages are lost or the file is of another recording: read what is there with --salvage."
            )
        self._lost.extend(wrong)

    def _merged(self) -> Survey:
        counts: Counter[Channel] = Counter()
        first: dict[Channel, bytes] = {}
        for part, survey in self._surveys.items():
            for held in survey.held:
                counts[held.channel] += held.count
                if held.count and held.channel not in first:
                    first[held.channel] = self._plain(part, held)
        filled = [survey for survey in self._surveys.values() if any(held.count for held in survey.held)]
        kinds = sorted({survey.container.removeprefix("rosbag2 ") for survey in self._surveys.values()})
        return Survey(
            container=f"rosbag2 folder ({', '.join(kinds)})",
            held=tuple(
                Held(channel=channel, count=counts[channel], first_message=first.get(channel, b""))
                for channel in sorted(counts, key=lambda each: (each.topic, each.type_name, each.schema))
            ),
            start_ns=min((survey.start_ns for survey in filled), default=0),
            end_ns=max((survey.end_ns for survey in filled), default=0),
            findings=(
                *self._remarks,
                *_joined([survey.findings for survey in self._surveys.values()]),
            ),
        )

    def _is_packed(self, part: Path) -> bool:
        """Return whether the container returns messages that are still compressed: SQLite's unpacks them itself."""
        mode = self._metadata.compression_mode if self._metadata else ""
        return mode == "message" and ".mcap" in part.suffixes

    def _plain(self, part: Path, held: Held) -> bytes:
        if not self._is_packed(part):
            return held.first_message
        try:
            return unpack_message(held.first_message, held.channel.topic)
        except LogError:
            if not self._salvage:
                raise
            return b""

    def _handler(self, part: Path, handle: Callable[[Batch], T]) -> Callable[[Batch], T]:
        if not self._is_packed(part):
            return handle
        lost = self._lost if self._salvage else None
        return lambda batch: handle(unpack_messages(batch, lost))


def _first_existing(folder: Path, name: str) -> Path | None:
    """Return the file, or the same one packed or unpacked since, or None."""
    names = [name, *(name + ending for ending in _PACKED), *(name.removesuffix(ending) for ending in _PACKED)]
    return next((folder / each for each in names if (folder / each).is_file()), None)


def _stem(name: str, endings: tuple[str, ...]) -> str:
    """Return a log's name without its last number, the same for all parts of a recording; empty for other files."""
    for packed in _PACKED:
        name = name.removesuffix(packed)
    ending = next((ending for ending in endings if name.endswith(ending)), None)
    if ending is None or name.startswith("."):
        return ""
    pieces = _DIGITS.split(name.removesuffix(ending))
    return "".join([*pieces[:-2], "#", *pieces[-1:]] if len(pieces) > 1 else pieces) + ending


def _natural(name: str) -> list[tuple[int, str]]:
    return [(int(piece), "") if piece.isdigit() else (0, piece) for piece in _DIGITS.split(name)]


def _names(names: Collection[str]) -> str:
    ordered = sorted(names, key=_natural)
    more = f" and {len(ordered) - _LISTED} more" if len(ordered) > _LISTED else ""
    return ", ".join(ordered[:_LISTED]) + more


def _joined(findings: list[tuple[Finding, ...]]) -> Iterator[Finding]:
    """Yield what the parts found, each kind of remark once and everything graver as often as it occurs."""
    seen: set[str] = set()
    for finding in (each for part in findings for each in part):
        if finding.severity != "info" or finding.code not in seen:
            seen.add(finding.code)
            yield finding
