"""What an export may replace: a file that the same export made, and nothing else."""

import json
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

from autotune.errors import UsageError
from autotune.formats.atomic import check_target
from problems.frozen import FrozenDict

CELL_MARK = "# Written by autotune export --target cell.\n"
"""The first line of a `cell` file, which is otherwise like the controller.yaml that `optimize` writes."""
_HEAD_BYTES = 4096


def _begins(pattern: bytes) -> Callable[[Path], bool]:
    """Return a test of a file's first bytes."""
    mark = re.compile(pattern)

    def test(path: Path) -> bool:
        with path.open("rb") as stream:
            return mark.match(stream.read(_HEAD_BYTES)) is not None

    return test


def _is_json_controller(path: Path) -> bool:
    """Return whether a file is a controller as JSON, which no other command writes."""
    try:
        tree = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    return isinstance(tree, dict) and tree.get("format") == "autotune/controller"


_MADE_BY: Mapping[str, Callable[[Path], bool]] = FrozenDict(
    {
        "cell": _begins(re.escape(CELL_MARK.encode())),
        "json": _is_json_controller,
        "c": _begins(rb"/\* format: autotune/c, version 1: "),
        "ros2_control": _begins(rb"# Written by autotune \S+ for ros2_controllers "),
        "fzi_cartesian": _begins(rb"# Written by autotune \S+ for cartesian_controllers "),
    }
)


def files_of(out: Path | str, target: str) -> tuple[Path, ...]:
    """Return the files that an export to `out` writes: of C also the header."""
    path = Path(out)
    return (path.with_suffix(".h"), path) if target == "c" else (path,)


def standing(out: Path | str, target: str) -> tuple[Path, ...]:
    """Return those of the files to write that exist and hold something."""
    return tuple(path for path in files_of(out, target) if path.is_file() and path.stat().st_size > 0)


def check_replaceable(out: Path | str, target: str, source: Path | str) -> None:
    """Raise UsageError where the export cannot write, or would replace what the same export did not make.

    `source` is the controller file that is read. An empty file and a device hold nothing that could be lost.
    """
    for path in files_of(out, target):
        check_target(path)
        if os.path.realpath(path) == os.path.realpath(source):
            raise UsageError(f"{path} is what is read, and would be replaced by the export; name another file with -o.")
    for path in standing(out, target):
        try:
            is_own = _MADE_BY[target](path)
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror or error}.") from error
        if not is_own:
            raise UsageError(
                f"{path} exists and was not made by export --target {target}, so it is not replaced; "
                "name another file with -o."
            )
