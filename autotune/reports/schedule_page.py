"""The report of a schedule: a controller per class of payload and surface, and what one for all would cost."""

from collections.abc import Mapping, Sequence
from typing import Any

from autotune.files.canonical import short
from autotune.files.records import rename_axis_keys
from autotune.files.schedule import ScheduleFile
from autotune.files.units import axis_units

from .controller_tables import checksum_fact
from .page import Cell, Facts, Note, Page, Section, Table

_RANGES = {"payload_mass_kg": ("payload [kg]", 1.0), "environment_stiffness_n_per_m": ("K_e [N/mm]", 1e-3)}


def build_schedule_page(file: ScheduleFile) -> Page:
    """Build the report of a `schedule.yaml` whose controllers were found whole."""
    tree = file.tree
    common = tree["common"]
    notes = (
        (Note(text=f"No controller serves all classes: {common['refusal']}", kind="common", tone="warn"),)
        if common["file"] is None
        else ()
    )
    blocks = (Facts(facts=(checksum_fact(file.checksum),)), _table(tree), *notes)
    return Page(
        title="A controller for every class",
        lead=f"{len(tree['classes'])} classes, each with a validated controller of its own.",
        sections=(Section(key="classes", title="Classes", blocks=blocks),),
        tone="good",
        footer=str(tree["provenance"].get("tool", "")),
    )


def _table(tree: Mapping[str, Any]) -> Table:
    ranges = [name for name in _RANGES if any(entry.get(name) is not None for entry in tree["classes"])]
    rows = []
    for entry in tree["classes"]:
        for axis, of_axis in entry["axes"].items():
            told, force = rename_axis_keys(axis, of_axis, reading=True), axis_units(axis).force
            texts = [_span(entry.get(name), _RANGES[name][1]) for name in ranges]
            texts += [f"{told['peak_force_n']:.4g} {force}"]
            common, cost = told.get("peak_with_common_n"), told.get("cost_n")
            texts += ["" if common is None else f"{common:.4g} {force}", "" if cost is None else f"{cost:+.3g} {force}"]
            cells = (Cell(text=text, is_number=True) for text in texts)
            rows.append((Cell(text=entry["name"]), Cell(text=axis), *cells, Cell(text=short(entry["checksum"]))))
    heads = (_RANGES[name][0] for name in ranges)
    return Table(
        caption="The classes, and what one controller for all would cost in each",
        columns=("class", "axis", *heads, "peak", "with one for all", "costs", "checksum"),
        rows=tuple(rows),
    )


def _span(interval: Sequence[float] | None, scale: float) -> str:
    if interval is None:
        return ""
    low, high = (scale * end for end in interval)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
