"""The page of a schedule: a controller per class of payload and surface, and the cost of one for all."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from autotune.charts.chart import Chart, Panel, Points, Role, Scale
from autotune.formats.canonical import short
from autotune.formats.records import rename_axis_keys
from autotune.formats.schedule import ScheduleFile
from autotune.formats.units import axis_units

from .controller_tables import checksum_fact
from .page import Facts, Note, Page, Section, Table, build_table

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
    blocks = (Facts(facts=(checksum_fact(file.checksum),)), *_charts(tree), _table(tree), *notes)
    return Page(
        title="A controller for every class",
        lead=f"{len(tree['classes'])} classes, each with a validated controller of its own.",
        sections=(Section(key="classes", title="Classes", blocks=blocks),),
        tone="good",
        footer=str(tree["provenance"].get("tool", "")),
    )


def _charts(tree: Mapping[str, Any]) -> Iterator[Chart]:
    """Yield per axis the peak of every class with its own controller, and with one for all where there is one."""
    classes, names = tree["classes"], list(dict.fromkeys(axis for each in tree["classes"] for axis in each["axes"]))
    for axis in names:
        units = axis_units(axis)
        seen = [
            (number, each["name"], rename_axis_keys(axis, each["axes"][axis], reading=True))
            for number, each in enumerate(classes, 1)
            if axis in each["axes"]
        ]
        points = [
            _peaks("with its own controller", "after", "dot", [(i, n, found["peak_force_n"]) for i, n, found in seen])
        ]
        common = [
            (i, n, found["peak_with_common_n"]) for i, n, found in seen if found.get("peak_with_common_n") is not None
        ]
        points += [_peaks("with one for all", "before", "diamond", common)] if common else []
        lowest, highest = (pick(found["peak_force_n"] for _, _, found in seen) for pick in (min, max))
        yield Chart(
            key=f"{axis}-classes",
            title=f"Peak {units.force_name} of every class, axis {axis}",
            alternative=f"The largest predicted peak in each of {len(seen)} classes, with its own controller from "
            f"{lowest:.4g} to {highest:.4g} {units.force}, and with one controller for all where there is one.",
            caption="; ".join(f"{number}: {name}" for number, name, _ in seen),
            panels=(
                Panel(
                    x=Scale(label="class, in the order of the table", limits=(0.5, len(classes) + 0.5), counts=True),
                    y=Scale(label=f"peak [{units.force}]"),
                    elements=tuple(points),
                ),
            ),
        )


def _peaks(label: str, role: Role, marker: Literal["dot", "diamond"], seen: Sequence[tuple[int, str, float]]) -> Points:
    numbers, names, peaks = zip(*seen, strict=True)
    return Points(
        x=np.array(numbers, dtype=np.float64), y=np.array(peaks), label=label, role=role, names=names, marker=marker
    )


def _table(tree: Mapping[str, Any]) -> Table:
    ranges = [name for name in _RANGES if any(entry.get(name) is not None for entry in tree["classes"])]
    rows = []
    for entry in tree["classes"]:
        for axis, of_axis in entry["axes"].items():
            found, force = rename_axis_keys(axis, of_axis, reading=True), axis_units(axis).force
            texts = [_span(entry.get(name), _RANGES[name][1]) for name in ranges]
            texts += [f"{found['peak_force_n']:.4g} {force}"]
            common, cost = found.get("peak_with_common_n"), found.get("cost_n")
            texts += ["" if common is None else f"{common:.4g} {force}", "" if cost is None else f"{cost:+.3g} {force}"]
            rows.append((entry["name"], axis, *texts, short(entry["checksum"])))
    columns = ("class", "axis", *(_RANGES[name][0] for name in ranges), "peak", "with one for all", "costs", "checksum")
    caption = "The classes, and what one controller for all would cost in each"
    return build_table(caption, columns, rows, numbers=range(2, len(columns) - 1))


def _span(interval: Sequence[float] | None, scale: float) -> str:
    if interval is None:
        return ""
    low, high = (scale * end for end in interval)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
