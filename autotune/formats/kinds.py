"""What kind of file a path names, seen in its first bytes, and which command it is for."""

import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

from autotune.errors import UsageError
from problems.frozen import FrozenDict

LOG = "log"
PLANTS = ("identified", "plant")
_HEAD_BYTES = 4096
_FILES: Mapping[str, str] = FrozenDict(
    {
        "cell": "a description of a cell",
        "problem": "a description of a problem",
        "plan": "a plan of a recording",
        "pareto": "a Pareto front",
    }
)
_LOG_BEGINS = (b"\x89MCAP0\r\n", b"#ROSBAG", b"SQLite format 3", b"PAR1", b"\x28\xb5\x2f\xfd")
_FORMAT = re.compile(rb"""^\s*[{]?\s*["']?format["']?\s*:\s*["']?autotune/([a-z_]+)""", re.MULTILINE)
_COMMANDS: Mapping[str, str] = FrozenDict(
    {
        LOG: "autotune identify {}",
        "identified": "autotune optimize {}",
        "plant": "autotune optimize {}",
        "controller": "autotune validate {}",
        "schedule": "autotune validate {}",
        "pareto": "autotune report {}",
        "cell": "autotune identify LOG --cell {}",
        "problem": "autotune optimize identified.yaml --problem {}",
    }
)


def kind_of_path(path: Path) -> str:
    """Return `log`, or what a file says that it is, such as `identified`; "" for what neither is plain."""
    if path.is_dir():
        return LOG
    with path.open("rb") as stream:
        head = stream.read(_HEAD_BYTES)
    if head.startswith(_LOG_BEGINS):
        return LOG
    found = _FORMAT.search(head)
    return "" if found is None else found[1].decode()


def check_kind(path: Path, kinds: Sequence[str]) -> None:
    """Raise UsageError, with the command that the file is for, where it is plainly of another kind than asked.

    A file that cannot be opened is left to whoever reads it.
    """
    try:
        found = kind_of_path(path)
    except OSError:
        return
    if not found or found in kinds:
        return
    wanted = " or ".join(_name(kind) for kind in kinds)
    command = _COMMANDS.get(found)
    advice = "" if command is None else f": run `{command.format(shlex.quote(str(path)))}`"
    raise UsageError(f"{path} is {_FILES.get(found) or _name(found)}, not {wanted}{advice}.")


def _name(kind: str) -> str:
    if kind == "identified":
        return "an identified plant"
    return f"a {kind}.yaml" if kind in _FILES else f"a {kind}"
