"""`identified.yaml`: plant parameters on disk."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from autotune.errors import UsageError
from identification.result import Identified, Status
from problems.frozen import freeze

from .atomic import write_atomic
from .canonical import plain
from .records import EntryError, read_record, record_tree, rename_axis_keys
from .schema import VERSION, check_document, check_format, check_tree
from .yaml12 import Document, dump_yaml, load_document, parse_document

FORMAT = "autotune/identified"
IN_MEMORY = Path("(in memory)")
"""The path of what was never read from a file."""


@dataclass(frozen=True, kw_only=True)
class IdentifiedFile:
    """Plant parameters of a file, with the sha256 of its bytes; of `IN_MEMORY` that of those it would have.

    `domain` is the set that a controller must be safe for where a person said it, by the names of `problem.yaml`;
    empty where it follows from the estimates.
    """

    result: Identified
    provenance: Mapping[str, Any]
    path: Path
    sha256: str
    domain: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "provenance", "domain")


def identified_tree(result: Identified, provenance: Mapping[str, object]) -> dict[str, Any]:
    """Return the plain tree of `identified.yaml`.

    On rx, ry, rz the keys have the rotational unit: `stiffness_n_m_per_rad`, `secant_stiffness_n_m_per_rad`,
    `damping_n_m_s_per_rad`, `drag_n_m_s_per_rad`, `inertia_kg_m2`, `peak_torque_n_m`.

    Raises ParameterError: a number is not finite, or an entry contradicts the format (an unidentifiable parameter
    that has a value, an identified one that has none, a stiffness that is not positive).
    """
    body = record_tree(result)
    body["axes"] = {axis: rename_axis_keys(axis, tree, reading=False) for axis, tree in body["axes"].items()}
    tree = {"format": FORMAT, "version": VERSION, **body, "provenance": plain(provenance, "provenance")}
    check_tree(tree, "identified")
    return tree


def write_identified(path: Path | str, result: Identified, provenance: Mapping[str, object]) -> str:
    """Write `identified.yaml` in one step, return its sha256; raises as `identified_tree` and `write_atomic` do."""
    text = dump_yaml(identified_tree(result, provenance))
    write_atomic(path, text)
    return sha256(text.encode()).hexdigest()


def read_identified(path: Path | str) -> IdentifiedFile:
    """Read `identified.yaml` (or its JSON twin), every number to the last bit.

    Raises UsageError: the file cannot be read, is not of this format and version, or an entry is missing, unknown or
    out of range; the text names file, line and reason.
    """
    return _checked(load_document(path, error=UsageError))


def parse_identified(text: str, path: Path) -> IdentifiedFile:
    """Do what `read_identified` does on the text of a file that is, or will be, at `path`."""
    return _checked(parse_document(text.encode(), path, error=UsageError, exact=False))


def _checked(document: Document) -> IdentifiedFile:
    check_format(document, "identified")
    check_document(document, "identified")
    body = {key: value for key, value in document.tree.items() if key not in ("format", "version", "provenance")}
    body["axes"] = {axis: rename_axis_keys(axis, tree, reading=True) for axis, tree in body["axes"].items()}
    try:
        result = read_record(Identified, body)
    except EntryError as refused:
        document.refuse(refused.place, str(refused))
    _check_values(document, result)
    return IdentifiedFile(
        result=result,
        provenance=document.tree["provenance"],
        path=document.path,
        sha256=document.sha256,
    )


_ROUNDING = 1e-6


def _check_values(document: Document, result: Identified) -> None:
    """Refuse a value that was changed by hand and still calls itself identified: its covariance says another."""
    for name, axis in result.axes.items():
        if axis.covariance is None:
            continue
        fitted = dict(zip(axis.covariance.names, axis.covariance.values, strict=True))
        keys = rename_axis_keys(
            name,
            {key: key for key in ("stiffness_n_per_m", "damping_n_s_per_m", "drag_n_s_per_m", "mass_kg")},
            reading=False,
        )
        place = {old: new for new, old in keys.items()}
        for symbol, estimate, where in (
            ("K_s", axis.coupling.stiffness_n_per_m, ("coupling", place["stiffness_n_per_m"])),
            ("B_s", axis.coupling.damping_n_s_per_m, ("coupling", place["damping_n_s_per_m"])),
            ("B_p", axis.drag_n_s_per_m, (place["drag_n_s_per_m"],)),
            ("M_p", axis.mass_kg, (place["mass_kg"],)),
            ("T_d", axis.robot.delay_s, ("robot", "delay_s")),
        ):
            if estimate is None or estimate.value is None or estimate.status is Status.GIVEN or symbol not in fitted:
                continue
            if abs(estimate.value - fitted[symbol]) > _ROUNDING * abs(fitted[symbol]) + 1e-2 * (estimate.std or 0.0):
                document.refuse(
                    ("axes", name, *where, "value"),
                    f"{estimate.value:g} is not what the covariance of axis {name} holds for {symbol}, "
                    f"{fitted[symbol]:g}; a value that was corrected by hand has the status given, and its std.",
                )
