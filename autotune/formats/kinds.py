"""What kind of file a path names, by its first bytes: which command it is for, and what a command would replace."""

import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path

from autotune.errors import AutotuneError, UsageError
from problems.frozen import FrozenDict

LOG = "log"
PLANTS = ("identified", "plant")
HEAD_BYTES = 4096
PICTURE_MARK = "autotune map"
"""What a picture says of its maker: as `Software` of a PNG, as the creator of an SVG."""
_FORMAT = re.compile(rb"""^\s*(?:/\* |\{\s*)?["']?format["']?\s*:\s*["']?autotune/([a-z_]+)""", re.MULTILINE)
_LOG_BEGINS = (b"\x89MCAP0\r\n", b"#ROSBAG", b"SQLite format 3", b"PAR1", b"\x28\xb5\x2f\xfd")
_TABLE_ENDINGS = (".csv", ".tsv", ".parquet")
_PAGE = b'<meta name="generator" content="autotune report">'
_TABLE = b"# autotune/map version "
_PICTURES = (
    (b"\x89PNG\r\n\x1a\n", f"Software\0{PICTURE_MARK}".encode()),
    (b"<?xml ", f"<dc:title>{PICTURE_MARK}</dc:title>".encode()),
)
_NOUNS: Mapping[str, str] = FrozenDict(
    {
        "c": "C export",
        "campaign": "manifest of a campaign",
        "cell": "description of a cell",
        "identified": "identified plant",
        "map": "table of a map",
        "pareto": "Pareto front",
        "picture": "picture of a map",
        "problem": "description of a problem",
    }
)
_COMMANDS: Mapping[str, str] = FrozenDict(
    {
        LOG: "autotune identify {}",
        "identified": "autotune optimize {}",
        "plant": "autotune optimize {}",
        "controller": "autotune validate {}",
        "schedule": "autotune validate {}",
        "pareto": "autotune report {}",
        "campaign": "autotune campaign {}",
        "cell": "autotune identify LOG --cell {}",
        "problem": "autotune optimize identified.yaml --problem {}",
    }
)
_SEALED = ("controller", "schedule")


def name_of(path: Path) -> str:
    """Return the name of a file or folder; of `.` and `..` that of the folder which they are."""
    return path.name if path.name.strip(".") else path.resolve().name


def kind_of(path: Path) -> str | None:
    """Return the kind of a file of this tool, such as "controller"; None for a log or a file of another program.

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


def is_log(path: Path) -> bool:
    """Return whether a path is plainly a log: a folder, a file that begins as one, or a table by its name."""
    if path.is_dir():
        return True
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    is_table = path.suffix.lower() in _TABLE_ENDINGS and not head.startswith(_TABLE)
    return head.startswith(_LOG_BEGINS) or is_table


def check_kind(path: Path, kinds: Sequence[str]) -> None:
    """Raise UsageError, with the command that the file is for, where it is plainly of another kind than asked.

    A file that cannot be opened is left to whoever reads it.
    """
    try:
        found = LOG if is_log(path) else kind_of(path)
    except OSError:
        return
    if not found or found in kinds:
        return
    *listed, last = (f"a {kind}.yaml" if kind in ("cell", "problem") else _named(kind) for kind in kinds)
    wanted = f"{', '.join(listed)} or {last}" if listed else last
    command = _COMMANDS.get(found)
    advice = "" if command is None else f": run `{command.format(shlex.quote(str(path)))}`"
    raise UsageError(f"{path} is {_named(found)}, not {wanted}{advice}.")


def unknown_file(path: Path, message: str, *, without_format: str = "") -> UsageError:
    """Return the error of a file of no kind that is wanted; raises UsageError for a text that is no valid YAML.

    `without_format` is said too of a YAML file that does not say what it is.
    """
    from .yaml12 import load_yaml  # noqa: PLC0415 - imports a YAML library

    # A table of a log may end in .txt too.
    if not is_log(path) and path.suffix.lower() != ".txt":
        with path.open("rb") as stream:
            is_text = b"\0" not in stream.read(HEAD_BYTES)
        if is_text:
            tree = load_yaml(path, error=UsageError)
            if "format" not in tree:
                message += without_format
    return UsageError(message)


def _noun(kind: str) -> str:
    return _NOUNS.get(kind, kind)


def _named(kind: str) -> str:
    return f"{'an' if kind == 'identified' else 'a'} {_noun(kind)}"


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
    from .canonical import checksum, short  # noqa: PLC0415 - imports a YAML library, and mostly there is no file

    if kind not in _SEALED:
        return f"the {_noun(kind)} of sha256 {short(sha256(path.read_bytes()).hexdigest())}"
    from .yaml12 import load_yaml  # noqa: PLC0415 - the same

    try:
        tree = load_yaml(path)
    except AutotuneError:
        return f"a file that is no whole {kind}"
    found = checksum(tree)
    return f"the {kind} of checksum {short(found)}" if tree.get("checksum") == found else f"a {kind} that is not whole"


def check_replaced(path: Path | str, kind: str, *, option: str = "-o") -> str:
    """Return what a file of `kind` will replace, in words as `describe_existing`; "" where nothing would be lost.

    Raises UsageError as `check_replaceable`.
    """
    check_replaceable(path, kind, option=option)
    try:
        return describe_existing(path)
    except OSError as error:
        raise _unreadable(path, error) from error


def check_replaceable(
    path: Path | str, kind: str, *, option: str = "-o", is_own: Callable[[Path], bool] | None = None
) -> None:
    """Raise UsageError where another file exists: only a file of the same kind is replaced.

    `is_own` decides instead of `kind_of` for kinds that this module does not know, such as exports.
    """
    path = Path(path)
    try:
        found = kind_of(path)
        if found == "" or (found == kind if is_own is None else is_own(path)):
            return
    except OSError as error:
        raise _unreadable(path, error) from error
    noun = "file of this tool" if found is None and is_own is None else _noun(kind)
    what = f" ({_noun(found)})" if found is not None else ""
    raise UsageError(f"{path} exists and is no {noun}{what}, so it is not replaced; name another one with {option}.")


def _unreadable(path: Path | str, error: OSError) -> UsageError:
    return UsageError(f"{path} cannot be read: {error.strerror or error}.")
