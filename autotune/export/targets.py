"""The formats that a controller can be exported to; each turns a verified file into the whole text of another."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from autotune.errors import CertificateError, UsageError
from problems.frozen import FrozenDict

if TYPE_CHECKING:
    from autotune.formats.controller import Controller

    from .trust import Trust

# The files are read and written by functions that import what they need, so that the list of targets costs nothing.


def render_cell(controller: "Controller") -> str:
    """Return the canonical `controller.yaml`, which the cell reads, checksum included, below a line that names it."""
    from autotune.formats.controller import controller_tree  # noqa: PLC0415
    from autotune.formats.yaml12 import dump_yaml  # noqa: PLC0415

    from .replace import CELL_MARK  # noqa: PLC0415

    return CELL_MARK + dump_yaml(controller_tree(controller))


def render_json(controller: "Controller") -> str:
    """Return the JSON twin of `controller.yaml`: the same tree and checksum, as `controller.schema.json` tells it."""
    from autotune.formats.controller import controller_tree  # noqa: PLC0415
    from autotune.formats.dump import dump_json  # noqa: PLC0415

    return dump_json(controller_tree(controller))


TARGETS: Mapping[str, Callable[["Controller"], str]] = FrozenDict({"cell": render_cell, "json": render_json})
EVERY_TARGET = (*TARGETS, "c")
"""Also those that are no text from which the controller could be read back."""
PEER_TARGETS = ("ros2_control", "fzi_cartesian")
"""Controllers of others, which run another law: `autotune.export.peers` certifies it before it writes anything."""


def export_controller(
    path: Path | str,
    target: str,
    out: Path | str,
    trust: "Trust | None" = None,
    progress: Callable[[float], None] | None = None,
) -> str:
    """Verify the controller file `path`, write it to `out` in the format `target` and return its checksum.

    The text is read back and must tell the same controller before `out` is touched; for C see `c_source.export_c`.
    `trust` says what more is asked of the file than a law that is stable over its domain with the margins stated.

    Raises UsageError for an unknown target, a file that cannot be opened or written, or an `out` that is not of the
    same export; CertificateError for a file that is altered, not validated, not as asked, false, or not
    read back the same.
    """
    from autotune.formats.atomic import write_atomic  # noqa: PLC0415
    from autotune.formats.controller import parse_controller, read_controller, short  # noqa: PLC0415

    from .replace import check_replaceable  # noqa: PLC0415
    from .trust import Trust, check_law  # noqa: PLC0415

    trust = Trust() if trust is None else trust
    if target == "c":
        from .c_source import export_c  # noqa: PLC0415

        return export_c(path, out, trust, progress)
    if target not in TARGETS:
        raise UsageError(f"There is no export target {target}; targets: {', '.join(EVERY_TARGET)}.")
    source = read_controller(path)
    check_replaceable(out, target, path)
    trust.verify(source)
    check_law(source, progress)
    text = TARGETS[target](source.controller)
    twin = parse_controller(text, out)
    if twin.checksum != source.checksum or twin.controller != source.controller:
        told = f"{short(twin.checksum)} instead of {short(source.checksum)}"
        raise CertificateError(f"{path}: the {target} form does not read back as the same controller ({told}).")
    write_atomic(out, text)
    return source.checksum
