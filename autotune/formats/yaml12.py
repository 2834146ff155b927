"""Read and write plain data as YAML 1.2, of which JSON is a part, and refuse everything that can surprise."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal
from hashlib import sha256
from math import isfinite
from pathlib import Path
from typing import Any, NoReturn

from ruamel.yaml import YAML
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import (
    AliasEvent,
    CollectionStartEvent,
    DocumentEndEvent,
    DocumentStartEvent,
    Event,
    MappingEndEvent,
    MappingStartEvent,
    NodeEvent,
    ScalarEvent,
    SequenceEndEvent,
    SequenceStartEvent,
    StreamEndEvent,
    StreamStartEvent,
)

from autotune.errors import AutotuneError, CertificateError, UsageError

from .canonical import DEEPEST, LARGEST_INTEGER, Place, dump_yaml

LARGEST_FILE_BYTES = 2**20
_FORMAT = re.compile(rb"""["']?format["']?\s*:\s*["']?autotune/(\w+)""")
_LONGEST_REASON = 600

_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|(0|[1-9][0-9]*)(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_FINITE = re.compile(r"[-+]?\.?(nan|inf|infinity)", re.IGNORECASE)
_WORDS: dict[str, object] = {"": None, "~": None} | {
    form: value
    for word, value in (("null", None), ("true", True), ("false", False))
    for form in (word, word.capitalize(), word.upper())
}
_WHOLE_NUMBERS = ("signs",)
"""Lists in which no number has decimals, so that a comma between two of them can mean one thing only."""
_COUNTS = {"mass": 6, "damping": 6, "lead": 6, "force": 3, "torque": 3, "gravity_direction": 3}
"""Lists of so many numbers: without any space a list of that count cannot be one of decimals with commas."""
_COMMA_LEFT, _COMMA_RIGHT = re.compile(r"[-+]?[0-9]+"), re.compile(r"[0-9]+([eE][-+]?[0-9]+)?")


@dataclass(frozen=True, kw_only=True)
class Document:
    """A file that was read: its plain tree, the line of each entry, and the sha256 of its bytes."""

    path: Path
    tree: dict[str, Any]
    lines: dict[Place, int]
    sha256: str
    error: type[AutotuneError]

    def refuse(self, place: Place, reason: str) -> NoReturn:
        """Raise this document's error, with the line of the entry."""
        raise refusal(self.error, self.path, self.line(place), reason)

    def line(self, place: Place) -> int:
        """Return the line of an entry, or of the nearest entry around it."""
        while place not in self.lines:
            place = place[:-1]
        return self.lines[place]


def refusal(error: type[AutotuneError], path: Path, line: int | None, reason: str) -> AutotuneError:
    """Return the error that names file, line and reason; a reason that quotes a monstrous file is cut."""
    where = f"{path}" if line is None else f"{path}, line {line}"
    return error(f"{where}: {reason if len(reason) <= _LONGEST_REASON else reason[:_LONGEST_REASON] + ' …'}")


def kind_of_file(path: Path) -> str:
    """Return what a file says that it is, `identified`, `controller` …; empty where it does not."""
    try:
        with path.open("rb") as stream:
            found = _FORMAT.search(stream.read(LARGEST_FILE_BYTES))
    except OSError as reason:
        raise UsageError(f"{path} cannot be read: {reason.strerror or reason}.") from reason
    return found[1].decode() if found else ""


def load_yaml(path: Path | str, *, error: type[AutotuneError] = CertificateError) -> dict[str, Any]:
    """Read a file as one mapping of plain data; see `load_document`."""
    return load_document(path, error=error).tree


def load_document(path: Path | str, *, error: type[AutotuneError] = CertificateError, exact: bool = False) -> Document:
    """Read a file as one mapping of plain data and remember the line of each entry.

    `exact` also refuses numbers with more digits than their double holds, and a last line without its end: for files
    that a program wrote, where either means that something changed them.

    Raises UsageError: the file cannot be opened. error: anything else; the text names file, line and reason.
    """
    path = Path(path)
    try:
        with path.open("rb") as stream:
            data = stream.read(LARGEST_FILE_BYTES + 1)
    except OSError as reason:
        raise UsageError(f"{path} cannot be read: {reason.strerror or reason}.") from reason
    return parse_document(data, path, error=error, exact=exact)


def parse_document(data: bytes, path: Path, *, error: type[AutotuneError], exact: bool) -> Document:
    """Do the work of `load_document` on bytes; `path` is for messages only."""
    text = _text(data, path, error)
    if not text.strip():
        raise error(f"{path}, line 1: the file is empty.")
    if exact and not text.endswith("\n"):
        raise error(f"{path}, line {text.count(chr(10)) + 1}: the last line has no end; the file is truncated.")
    reader = _Reader(path, error, exact)
    try:
        tree = reader.read(YAML(typ="safe", pure=True).parse(text))
    except MarkedYAMLError as cause:
        mark = cause.problem_mark or cause.context_mark
        reason = f"not readable as YAML: {cause.problem or cause.context}."
        raise refusal(error, path, None if mark is None else mark.line + 1, reason) from cause
    except (YAMLError, ValueError, OverflowError) as cause:
        raise refusal(error, path, None, f"not readable as YAML: {' '.join(str(cause).split())}.") from cause
    return Document(path=path, tree=tree, lines=reader.lines, sha256=sha256(data).hexdigest(), error=error)


def _text(data: bytes, path: Path, error: type[AutotuneError]) -> str:
    if len(data) > LARGEST_FILE_BYTES:
        raise error(f"{path}: larger than {LARGEST_FILE_BYTES} bytes; this is not such a file.")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as reason:
        line = data.count(b"\n", 0, reason.start) + 1
        raise error(f"{path}, line {line}: not UTF-8 text; save the file as UTF-8.") from reason
    for mark, reason_text in (
        ("\ufeff", "a byte order mark; save the file as UTF-8 without one."),
        ("\t", "a tab; use spaces."),
        ("\0", "a zero byte; the file is damaged."),
    ):
        if (at := text.find(mark)) >= 0:
            raise error(f"{path}, line {text.count(chr(10), 0, at) + 1}: {reason_text}")
    return text


class _Reader:
    """Builds the tree from parsing events, so that tags, anchors and duplicates never get a meaning."""

    def __init__(self, path: Path, error: type[AutotuneError], exact: bool) -> None:
        self.path, self.error, self.exact = path, error, exact
        self.lines: dict[Place, int] = {}
        self.is_json = False

    def read(self, events: Iterator[Event]) -> dict[str, Any]:
        tree: Any = None
        documents = 0
        for event in events:
            if isinstance(event, StreamStartEvent | StreamEndEvent | DocumentEndEvent):
                continue
            if isinstance(event, DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self.refuse(event, "a second document begins; a file holds one.")
                if event.version or event.tags:
                    self.refuse(event, "a % directive; remove it, the file is read as YAML 1.2.")
            else:
                self.is_json = isinstance(event, MappingStartEvent) and bool(event.flow_style)
                tree = self.value(event, events, ())
        if not isinstance(tree, dict):
            raise self.error(f"{self.path}, line 1: must hold a mapping (key: value), found {describe(tree)}.")
        return tree

    def refuse(self, event: Event, reason: str) -> NoReturn:
        raise refusal(self.error, self.path, event.start_mark.line + 1, reason)

    def value(self, event: Event, events: Iterator[Event], place: Place) -> Any:
        if isinstance(event, AliasEvent) or (isinstance(event, NodeEvent) and event.anchor is not None):
            self.refuse(
                event, f"anchors and aliases (&{event.anchor}, *{event.anchor}) are not used here; write it out."
            )
        if not isinstance(event, ScalarEvent | CollectionStartEvent):
            self.refuse(event, "a value must be here.")
        if event.tag is not None:
            self.refuse(event, f"tags ({event.tag}) are not used here; remove it.")
        if len(place) > DEEPEST:
            self.refuse(event, f"nested more than {DEEPEST} levels deep.")
        self.lines.setdefault(place, event.start_mark.line + 1)
        if isinstance(event, MappingStartEvent):
            return self.mapping(events, place)
        if isinstance(event, SequenceStartEvent):
            return self.sequence(events, place, is_flow=bool(event.flow_style) and not self.is_json)
        if not isinstance(event, ScalarEvent):
            self.refuse(event, "a value must be here.")
        return self.scalar(event)

    def mapping(self, events: Iterator[Event], place: Place) -> dict[str, Any]:
        tree: dict[str, Any] = {}
        for event in events:
            if isinstance(event, MappingEndEvent):
                break
            if not isinstance(event, ScalarEvent):
                self.refuse(event, "a key must be text.")
            key = self.value(event, events, (*place, event.value))
            if not isinstance(key, str):
                self.refuse(event, f"a key must be text, found {describe(key)}.")
            if key in tree:
                self.refuse(event, f"the key {key} occurs twice, first in line {self.lines[*place, key]}.")
            tree[key] = self.value(next(events), events, (*place, key))
        return tree

    def sequence(self, events: Iterator[Event], place: Place, *, is_flow: bool) -> list[Any]:
        items: list[Any] = []
        before: ScalarEvent | None = None
        doubtful: list[tuple[ScalarEvent, ScalarEvent]] = []
        tight = 0
        for event in events:
            if isinstance(event, SequenceEndEvent):
                break
            scalar = event if isinstance(event, ScalarEvent) else None
            if is_flow and before is not None and scalar is not None and _is_tight(before, scalar):
                tight += 1
                doubtful += [(before, scalar)] if _is_decimal_comma(before, scalar) else []
            items.append(self.value(event, events, (*place, len(items))))
            before = scalar
        is_counted = tight == len(items) - 1 and len(items) == _COUNTS.get(str(place[-1]) if place else "")
        if doubtful and place[-1:] != _WHOLE_NUMBERS and not is_counted:
            self.refuse_comma(*doubtful[0])
        return items

    def refuse_comma(self, before: ScalarEvent, event: ScalarEvent) -> NoReturn:
        one, two = before.value, event.value
        self.refuse(
            event,
            f"{one},{two} may be a decimal comma; write {one}.{two} for one number, {one}, {two} for two.",
        )

    def scalar(self, event: ScalarEvent) -> Any:
        text: str = event.value
        if event.style is not None:
            # JSON writes characters beyond the basic plane as two escapes.
            return text.encode("utf-16", "surrogatepass").decode("utf-16", "surrogatepass") if _has_pair(text) else text
        if text in _WORDS:
            return _WORDS[text]
        if _NOT_FINITE.fullmatch(text):
            self.refuse(event, f"{text} is not a finite number.")
        if _FLOAT.fullmatch(text):
            return self.number(event, text)
        return text

    def number(self, event: Event, text: str) -> int | float:
        if len(text) > 60:
            self.refuse(event, f"a number of {len(text)} characters.")
        if _INTEGER.fullmatch(text):
            if abs(int(text)) > LARGEST_INTEGER:
                self.refuse(event, f"{text} is beyond 2^53; write it with an exponent.")
            return int(text)
        number = float(text)
        if not isfinite(number):
            self.refuse(event, f"{text} is too large for a number.")
        if self.exact and Decimal(text) != Decimal(repr(number)):
            self.refuse(event, f"{text} was written as {number!r}; the file is altered.")
        return number


def _is_tight(before: ScalarEvent, event: ScalarEvent) -> bool:
    return bool(event.start_mark.index - before.end_mark.index == 1)


def _is_decimal_comma(before: ScalarEvent, event: ScalarEvent) -> bool:
    return (
        before.style is event.style is None
        and _COMMA_LEFT.fullmatch(before.value) is not None
        and _COMMA_RIGHT.fullmatch(event.value) is not None
    )


def _has_pair(text: str) -> bool:
    return re.search("[\ud800-\udbff][\udc00-\udfff]", text) is not None


def describe(value: object) -> str:
    """Name a plain value for a message."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f"the text {value[:60]!r}"
    if isinstance(value, dict | list):
        return "a mapping" if isinstance(value, dict) else f"a list of {len(value)}"
    return repr(value)


__all__ = ["Document", "describe", "dump_yaml", "load_document", "load_yaml", "parse_document"]
