"""Recognise the file that a command would replace: one of the same kind, or another, which is kept."""

import re
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path

from autotune.errors import AutotuneError, UsageError
from problems.frozen import FrozenDict

from .canonical import checksum, short

HEAD_BYTES = 4096
_FORMAT = re.compile(rb'^\s*(?:/\* |\{\s*)?"?format"?: "?autotune/([a-z_]+)', re.MULTILINE)
_PAGE = b'<meta name="generator" content="autotune report">'
_TABLE = b"# autotune/map version "
PICTURE_MARK = "autotune map"
"""What a picture says of its maker: as `Software` of a PNG, as the creator of an SVG."""
_PICTURES = (
    (b"\x89PNG\r\n\x1a\n", f"Software\0{PICTURE_MARK}".encode()),
    (b"<?xml ", f"<dc:title>{PICTURE_MARK}</dc:title>".encode()),
)
_NOUNS: Mapping[str, str] = FrozenDict(
    {
        "c": "C export",
        "controller": "controller",
        "identified": "identified plant",
        "map": "table of a map",
        "pareto": "front",
        "picture": "picture of a map",
        "plan": "plan",
        "plant": "plant",
        "report": "report",
        "schedule": "schedule",
    }
)
_SEALED = ("controller", "schedule")


def kind_of(path: Path) -> str | None:
    """Return the kind of a file of this tool, such as "controller"; None for a file of another program.

    "" where nothing is lost: no file, an empty one or a device.
    """
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    if not head:
        return ""
    if _PAGE in head:
        return "report"
    if head.startswith(_TABLE):
        return "map"
    if any(head.startswith(begin) and mark in head for begin, mark in _PICTURES):
        return "picture"
    found = _FORMAT.search(head)
    return None if found is None else found[1].decode()


def describe_existing(path: Path | str) -> str:
    """Return in a few words which file exists there, with its checksum; "" where nothing would be lost.

    A controller or schedule has a checksum of its own, others that of their bytes (sha256).
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "":
        return ""
    if kind is None:
        return "a file of another program"
    noun = _NOUNS.get(kind, kind)
    if kind not in _SEALED:
        return f"the {noun} of sha256 {short(sha256(path.read_bytes()).hexdigest())}"
    from .yaml12 import load_yaml  # noqa: PLC0415 - slow to import, and mostly there is no file

    try:
        tree = load_yaml(path)
    except AutotuneError:
        return f"a file that is no whole {noun}"
    found = checksum(tree)
    return f"the {noun} of checksum {short(found)}" if tree.get("checksum") == found else f"a {noun} that is not whole"


def check_kind(path: Path | str, kind: str, *, option: str = "-o", is_own: Callable[[Path], bool] | None = None) -> str:
    """Return what a file of `kind` will replace, in words as `describe_existing`; "" where nothing would be lost.

    `is_own` decides instead of `kind_of` for kinds that this module does not know, such as exports. Raises UsageError
    where another file exists: only a file of the same kind is replaced.
    """
    path = Path(path)
    try:
        found = kind_of(path)
        if found == "" or (found == kind if is_own is None else is_own(path)):
            return describe_existing(path)
    except OSError as error:
        raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
    noun = "file of this tool" if found is None and is_own is None else _NOUNS.get(kind, kind)
    what = f" ({_NOUNS.get(found, found)})" if found is not None else ""
    raise UsageError(f"{path} exists and is no {noun}{what}, so it is not replaced; name another one with {option}.")
