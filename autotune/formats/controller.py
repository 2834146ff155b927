"""`controller.yaml`: a tuned controller and its certificate on disk, sealed by a checksum."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from autotune.errors import CertificateError

from .atomic import write_atomic
from .canonical import checksum, short
from .controller_record import (
    Controller,
    ControllerStatus,
)
from .records import EntryError, read_record, record_tree, rename_axis_keys
from .schema import VERSION, check_document, check_format, check_tree
from .yaml12 import Document, dump_yaml, load_document, parse_document

FORMAT = "autotune/controller"


@dataclass(frozen=True, kw_only=True)
class ControllerFile:
    """A controller file that was read and found whole and unaltered; `sha256` is that of its bytes."""

    controller: Controller
    checksum: str
    path: Path
    sha256: str


def controller_tree(controller: Controller) -> dict[str, Any]:
    """Return the plain tree of `controller.yaml`, its checksum last.

    On rx, ry, rz the keys of `predicted`, of what the certificate holds by axis, and of its `rotational_requirements`
    name the rotational unit (`autotune.formats.records.ROTATIONAL_KEYS`).

    Raises ParameterError: a number is not finite, or an entry is out of its range.
    """
    tree: dict[str, Any] = {"format": FORMAT, "version": VERSION, **_renamed(record_tree(controller), reading=False)}
    tree["checksum"] = checksum(tree)
    check_tree(tree, "controller")
    return tree


def write_controller(path: Path | str, controller: Controller) -> str:
    """Write `controller.yaml` in one step and return its checksum.

    Raises ParameterError: as `controller_tree`. UsageError: the file cannot be written.
    """
    tree = controller_tree(controller)
    write_atomic(path, dump_yaml(tree))
    return str(tree["checksum"])


def read_controller(path: Path | str, *, allow_unvalidated: bool = False) -> ControllerFile:
    """Read a controller file, YAML or its JSON twin, and refuse it unless it is whole, unaltered and validated.

    Raises UsageError: the file cannot be opened. CertificateError: anything else; the text names file, line and
    reason.
    """
    return _verified(load_document(path, error=CertificateError, exact=True), allow_unvalidated)


def parse_controller(text: str, path: Path | str, *, allow_unvalidated: bool = False) -> ControllerFile:
    """Do what `read_controller` does on the text of a file; `path` is for messages only."""
    document = parse_document(text.encode(), Path(path), error=CertificateError, exact=True)
    return _verified(document, allow_unvalidated)


def _verified(document: Document, allow_unvalidated: bool) -> ControllerFile:
    check_format(document, "controller")
    check_document(document, "controller")
    stated, found = document.tree["checksum"], checksum(document.tree)
    if stated != found:
        reason = f"the checksum says {short(stated)}, but the content has {short(found)}; the file is altered."
        document.refuse(("checksum",), reason)
    body = {key: value for key, value in document.tree.items() if key not in ("format", "version", "checksum")}
    try:
        controller = read_record(Controller, _renamed(body, reading=True))
    except EntryError as error:
        raise CertificateError(f"{document.path}, line {document.line(error.place)}: {error}") from error
    if controller.status != ControllerStatus.VALIDATED and not allow_unvalidated:
        document.refuse(("status",), "the controller is not validated; run optimize until its certificate holds.")
    return ControllerFile(controller=controller, checksum=stated, path=document.path, sha256=document.sha256)


def _renamed(body: dict[str, Any], *, reading: bool) -> dict[str, Any]:
    def axes(trees: dict[str, Any]) -> dict[str, Any]:
        return {axis: rename_axis_keys(axis, tree, reading=reading) for axis, tree in trees.items()}

    certificate = body["certificate"]
    renamed = {"domain": axes(certificate["domain"]), "margins": axes(certificate["margins"])}
    if "rotational_requirements" in certificate:
        rotational = rename_axis_keys("rx", certificate["rotational_requirements"], reading=reading)
        renamed["rotational_requirements"] = rotational
    for part in ("soft", "continuous", "held", "peaks"):
        if part in certificate:
            renamed[part] = axes(certificate[part])
    if "coupled" in certificate:
        coupled = certificate["coupled"]
        renamed["coupled"] = coupled | {"body": coupled["body"] | {"held": axes(coupled["body"]["held"])}}
    return body | {"predicted": axes(body["predicted"]), "certificate": certificate | renamed}
