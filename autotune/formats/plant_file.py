"""`plant.yaml` as a file: reading what a person wrote, or what was identified where either will do."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from autotune.errors import UsageError
from problems.errors import ParameterError

from .identified import IdentifiedFile, read_identified
from .plant import FORMAT, Plant
from .quantity import Uncertain
from .robot import Robot
from .schema import check_document, check_format, head_of
from .yaml12 import Document, kind_of_file, load_document


def read_plant(path: Path | str) -> IdentifiedFile:
    """Read `identified.yaml`, or a `plant.yaml` that a person wrote.

    Raises UsageError: the file cannot be read, is neither, or an entry is missing, unknown or out of range; the text
    names file, line and key.
    """
    kind = kind_of_file(Path(path))
    if kind == "identified":
        return read_identified(path)
    document = load_document(path, error=UsageError)
    if kind != "plant":
        found = f"autotune/{kind}" if kind else f"no such key; a plant.yaml begins with {head_of('plant')}"
        document.refuse(("format",), f"format must be autotune/identified or {FORMAT}, found {found}.")
    return parse_plant(document).file(document.path, document.sha256)


def parse_plant(document: Document) -> Plant:
    """Return the plant of a file that was loaded; raises UsageError as `read_plant`."""
    check_format(document, "plant")
    check_document(document, "plant")
    tree = {key: value for key, value in document.tree.items() if key not in ("format", "version")}
    within: tuple[str, ...] = ("robot",)
    try:
        robot = Robot(
            **{name: _quantity(value, (*within, name), document) for name, value in tree.pop("robot").items()}
        )
        within = ()
        return Plant(robot=robot, **{name: _quantity(value, (name,), document) for name, value in tree.items()})
    except ParameterError as error:
        place = (*within, *error.name.split("."))
        document.refuse(place if place in document.lines else within, str(error))


def _quantity(value: Any, place: tuple[str, ...], document: Document) -> Any:
    if isinstance(value, Mapping):
        try:
            return Uncertain(value["value"], value["std"])
        except ParameterError as error:
            document.refuse((*place, error.name), str(error))
    return value
