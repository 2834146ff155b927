"""The targets that hold the controller itself: canonical YAML, its JSON twin, and C99."""

import json
import re
import shlex
from pathlib import Path

from autotune.errors import CertificateError, UsageError

from .target import ExportRequest, ExportTarget, Rendered, begins_with

_ZERO = (0.0, 0.0, 0.0)
_C_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")
CELL_MARK = "# Written by autotune export --target cell.\n"
"""The first line of a `cell` file, which is otherwise like the controller.yaml that `optimize` writes."""


def render_cell(request: ExportRequest) -> Rendered:
    """Return the canonical `controller.yaml`, which the cell reads, checksum included, below a line that names it."""
    from autotune.formats.controller import controller_tree  # noqa: PLC0415
    from autotune.formats.yaml12 import dump_yaml  # noqa: PLC0415

    return _read_back(request, CELL_MARK + dump_yaml(controller_tree(request.source.controller)))


def render_json(request: ExportRequest) -> Rendered:
    """Return the JSON twin of `controller.yaml`: the same tree and checksum, by the schema `controller.schema.json`."""
    from autotune.formats.canonical import dump_json  # noqa: PLC0415
    from autotune.formats.controller import controller_tree  # noqa: PLC0415

    return _read_back(request, dump_json(controller_tree(request.source.controller)))


def _read_back(request: ExportRequest, text: str) -> Rendered:
    """Return the text; raises CertificateError unless it reads back as the same controller with the same checksum."""
    from autotune.formats.canonical import short  # noqa: PLC0415
    from autotune.formats.controller import parse_controller  # noqa: PLC0415

    source, twin = request.source, parse_controller(text, request.out)
    if twin.checksum != source.checksum or twin.controller != source.controller:
        raise CertificateError(
            f"{source.path}: the export does not read back as the same controller ({short(twin.checksum)} instead of "
            f"{short(source.checksum)})."
        )
    return Rendered(texts=(text,))


def _is_json_controller(path: Path) -> bool:
    """Return whether a file is a controller as JSON, which no other command writes."""
    try:
        tree = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        return False
    return isinstance(tree, dict) and tree.get("format") == "autotune/controller"


def _c_files(out: Path) -> tuple[Path, Path]:
    """Return header and source; raises UsageError for a name that is none of a C source."""
    if out.suffix != ".c" or not _C_NAME.fullmatch(out.stem):
        raise UsageError(f"{out} must be a name for C functions followed by .c, such as cell.c; name another file.")
    return out.with_suffix(".h"), out


def _render_c(request: ExportRequest) -> Rendered:
    from autotune.runtime.law import Payload  # noqa: PLC0415
    from autotune.runtime.load import read_law  # noqa: PLC0415

    from .c_source import render_c  # noqa: PLC0415

    source = request.source
    # No mass is certified to be 0: `NAME_check` refuses this payload until the cell gives its own.
    nothing = Payload(mass_kg=0.0, com_S_m=_ZERO, force_bias_S_n=_ZERO, torque_bias_S_n_m=_ZERO)
    text = render_c(read_law(source.path, nothing), request.out.stem, source.controller.provenance, request.signed_by)
    name = request.out.stem
    set_in_cell = f"note: {name}_file_payload is empty; {name}_check takes a {name}_payload of your own only."
    lines = (set_in_cell,) if source.controller.payload.set_in_cell else ()
    return Rendered(texts=(text.header, text.source), lines=lines)


def _validate(request: ExportRequest) -> str:
    return shlex.join(["autotune", "validate", str(request.out)])


def _compile(request: ExportRequest) -> str:
    flags = ("-std=c99", "-O2", "-Wall", "-Wextra", "-ffp-contract=off")
    return shlex.join(["cc", *flags, "-c", str(request.out), "-o", str(request.out.with_suffix(".o"))])


CELL = ExportTarget(
    name="cell",
    summary="the YAML that the cell reads.",
    render=render_cell,
    is_own=begins_with(CELL_MARK.encode().replace(b".", rb"\.")),
    following=_validate,
)
JSON = ExportTarget(
    name="json",
    summary="the same content as JSON, with a JSON Schema.",
    render=render_json,
    is_own=_is_json_controller,
    following=_validate,
)
C = ExportTarget(
    name="c",
    summary="the controller's step as one C99 source NAME.c, and the header NAME.h beside it.",
    render=_render_c,
    is_own=begins_with(rb"/\* format: autotune/c, version 1: "),
    files=_c_files,
    suffix=".c",
    following=_compile,
)
