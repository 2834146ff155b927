"""The page of a campaign: its cells, what changed in them, which are unlike the others, and why runs were refused."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime

import numpy as np

from autotune.campaign.fleet import Unusual, by_cell, changes, unusual
from autotune.campaign.text import outcome_text, runs_by_text
from autotune.campaign.work import RunOutcome
from autotune.charts.chart import Band, Chart, Panel, Points, Scale
from autotune.drift import MASS, Change, parameter_name, parameter_text
from autotune.formats.units import AXES, axis_units
from autotune.text import with_deviation

from .page import Note, Page, Section, Table, TableCell, build_table

_MOST_CHARTS = 12
# Names of so many letters stay in one line.
_LONGEST_WHOLE = 24
_SENSOR = "Sensor"


def build_campaign_page(outcomes: Sequence[RunOutcome], footer: str) -> Page:
    """Build the report of what came of every run."""
    refused = [each for each in outcomes if each.refused]
    broken, damaged = [each for each in outcomes if each.outside], [each for each in outcomes if each.damage]
    changed, odd = changes(outcomes), unusual(outcomes)
    sections = [
        Section(key="certificates", title="Certificates that no longer hold", blocks=tuple(_broken_notes(broken))),
        Section(key="refused", title="Refused", blocks=(_refused_table(refused),)),
        Section(key="damaged", title="Damaged logs", blocks=tuple(_damage_notes(damaged))),
        Section(
            key="changes",
            title="What changed from run to run",
            blocks=(_change_table(changed), *_drift_charts(outcomes, changed)),
        ),
        Section(key="unusual", title="Cells unlike the others", blocks=(_unusual_table(odd),)),
        Section(key="peaks", title="Peaks", blocks=tuple(_peak_charts(outcomes))),
        Section(key="runs", title="All runs", blocks=tuple(_run_tables(outcomes))),
    ]
    filled = {
        "certificates": broken,
        "refused": refused,
        "damaged": damaged,
        "changes": changed,
        "unusual": odd,
        "peaks": [each for each in outcomes if each.peaks_n],
        "runs": outcomes,
    }
    return Page(
        title="Campaign",
        lead=outcome_text(outcomes),
        sections=tuple(section for section in sections if filled[section.key]),
        tone="bad" if broken else "warn" if refused or damaged or changed or odd else "good",
        footer=footer,
    )


def _broken_notes(broken: Sequence[RunOutcome]) -> Iterator[Note]:
    said = ((each.name, what) for each in broken for what in each.outside or ())
    for what, names in runs_by_text(said).items():
        yield Note(text=f"{names}: {what}.", kind="certificate", tone="bad")


def _damage_notes(damaged: Sequence[RunOutcome]) -> Iterator[Note]:
    for each in damaged:
        yield Note(text=f"{each.name}: {each.damage}", kind="damage", tone="warn")


def _refused_table(refused: Sequence[RunOutcome]) -> Table:
    counts = Counter(each.refused for each in refused)
    rows = [
        (kind if not k else "", str(counts[kind]) if not k else "", *_named(each), each.reason)
        for kind, _ in counts.most_common()
        for k, each in enumerate(each for each in refused if each.refused == kind)
    ]
    return build_table("By reason", ("refused for", "runs", "cell", "run", "why"), rows, numbers=(1,))


def _change_table(changed: Sequence[Change]) -> Table:
    rows: list[tuple[str | TableCell, ...]] = []
    for each in changed:
        label, unit, old, new = parameter_text(each.name, each.old, each.new)
        share = f"{100.0 * (each.new / each.old - 1.0):+.2g} %" if each.old else ""
        runs = map(_name, (each.cell, each.before, each.after))
        rows.append((*runs, label, old, new, unit, share, f"{each.stds:.1f}"))
    columns = ("cell", "from run", "to run", "parameter", "was", "is", "unit", "change", "deviations")
    return build_table("Beyond three standard deviations and 0.2 %", columns, rows, numbers=(4, 5, 7, 8))


def _drift_charts(outcomes: Sequence[RunOutcome], changed: Sequence[Change]) -> Iterator[Chart]:
    """Yield what changed over the runs of its cell, with its deviations."""
    runs = by_cell(outcomes)
    for cell, name in list(dict.fromkeys((each.cell, each.name) for each in changed))[:_MOST_CHARTS]:
        held = [run for run in runs[cell] if name in run.values]
        label, scale, unit = parameter_name(name)
        value, std = scale * np.array([run.values[name] for run in held]).T
        at = np.arange(1.0, len(held) + 1.0)
        yield Chart(
            key=f"{cell}-{name}",
            title=f"{cell}: {label}",
            alternative=f"{label} of {cell} in {len(held)} runs, from {value[0]:.4g} to {value[-1]:.4g} {unit}.",
            caption="; ".join(f"{number}: {run.run}" for number, run in enumerate(held, 1)),
            panels=(
                Panel(
                    x=Scale(label="run, in the order of recording", limits=(0.5, len(held) + 0.5), counts=True),
                    y=Scale(label=f"{label.rpartition(': ')[2]} [{unit}]"),
                    elements=(
                        Band(x=at, low=value - 2.0 * std, high=value + 2.0 * std, label="two standard deviations"),
                        Points(x=at, y=value, label="identified"),
                    ),
                ),
            ),
        )


def _unusual_table(odd: Sequence[Unusual]) -> Table:
    rows: list[tuple[str | TableCell, ...]] = []
    for each in odd:
        if each.name:
            label, unit, value, median = parameter_text(each.name, each.value, each.median)
        else:
            label, unit, value, median = "all together", "squared distance", f"{each.value:.3g}", f"{each.median:.3g}"
        rows.append((_name(each.cell), label, value, median, unit, f"{each.score:.1f}"))
    columns = ("cell", "parameter", "value", "median of the cells", "unit", "robust deviations")
    return build_table("The newest run of each cell; all together beside its limit", columns, rows, numbers=(2, 3, 5))


def _peak_charts(outcomes: Sequence[RunOutcome]) -> Iterator[Chart]:
    newest = {cell: runs[-1] for cell, runs in by_cell(outcomes).items() if runs[-1].peaks_n}
    for axis in dict.fromkeys(axis for run in newest.values() for axis in run.peaks_n):
        in_log = {cell: run.log_peaks_n[axis] for cell, run in newest.items() if axis in run.log_peaks_n}
        if in_log:
            title = f"Hardest contact of the log of every cell, at the sensor, axis {axis}"
            where = {cell: run.log_peaks_at.get(axis, "") for cell, run in newest.items()}
            labels = ("in the log", "with the new controller at the same speed")
            yield _peak_chart(axis, "log", title, in_log, where, labels)
        worst = {cell: run.peaks_n[axis] for cell, run in newest.items() if axis in run.peaks_n}
        title = f"Worst predicted peak of every cell, at the contact, axis {axis}"
        where = {cell: run.peaks_at.get(axis, "") for cell, run in newest.items()}
        yield _peak_chart(axis, "cells", title, worst, where, ("with the gains of the log", "with the new controller"))


def _peak_chart(
    axis: str,
    key: str,
    title: str,
    peaks: Mapping[str, tuple[float | None, float]],
    where: Mapping[str, str],
    labels: tuple[str, str],
) -> Chart:
    """Draw the peaks of every cell before, where they are known, and after; the caption says where each is."""
    unit = axis_units(axis).force
    after = np.array([peak for _, peak in peaks.values()])
    known = [(i, before) for i, (before, _) in enumerate(peaks.values(), 1) if before is not None]
    points = [Points(x=np.arange(1.0, len(peaks) + 1.0), y=after, label=labels[1], role="after", marker="dot")]
    if known:
        at, before = np.array(known, dtype=float).T
        points.append(Points(x=at, y=before, label=labels[0], role="before", marker="diamond"))
    highest = max(float(np.max(each.y)) for each in points)
    return Chart(
        key=f"{axis}-{key}",
        title=title,
        alternative=f"Peaks of {len(peaks)} cells {labels[1]}, from {after.min():.4g} to {after.max():.4g} {unit}, "
        f"and {labels[0]} where they are known.",
        caption="; ".join(
            f"{i}: {cell}{f' ({where[cell]})' if where[cell] else ''}" for i, cell in enumerate(peaks, 1)
        ),
        panels=(
            Panel(
                x=Scale(label="cell, in the order of the list", limits=(0.5, len(peaks) + 0.5), counts=True),
                y=Scale(label=f"peak [{unit}]", limits=(0.0, 1.1 * highest)),
                elements=tuple(points),
            ),
        ),
    )


def _run_tables(outcomes: Sequence[RunOutcome]) -> Iterator[Table]:
    """Yield what came of every run, then tables for each axis: all of them side by side are wider than a page."""
    groups: dict[str, list[str]] = {"": []}
    for name in dict.fromkeys(name for each in outcomes for name in each.values):
        groups.setdefault(_group(name), []).append(name)
    rows = [(*_named(each), _recorded(each), _verdict(each), *_values(each, groups[""])) for each in outcomes]
    yield _value_table("Value ± standard deviation", ("recorded", "outcome"), groups.pop(""), rows)
    order = (*AXES, _SENSOR)
    for group in sorted(groups, key=lambda group: order.index(group.partition(",")[0])):
        names = groups[group]
        rows = [(*_named(each), *_values(each, names)) for each in outcomes if each.values.keys() & set(names)]
        caption = group if group == _SENSOR else f"Axis {group}"
        yield _value_table(f"{caption}: value ± standard deviation", (), names, rows)


def _group(name: str) -> str:
    """Return which table holds a parameter: of an axis, of its surfaces, of the sensor, or "" for the payload's."""
    axis, *others = name.split(".")
    if axis not in AXES:
        return "" if name == MASS else _SENSOR
    return axis if len(others) == 1 else f"{axis}, surfaces"


def _value_table(
    caption: str, others: tuple[str, ...], names: Sequence[str], rows: Sequence[tuple[TableCell, ...]]
) -> Table:
    """Return a table of cell, run, `others` and the values of names, whose axis is in the caption."""
    heads = [f"{label.partition(': ')[2] or label} [{unit}]" for label, _, unit in map(parameter_name, names)]
    columns = ("cell", "run", *others, *heads)
    return build_table(caption, columns, rows, numbers=range(len(columns) - len(heads), len(columns)))


def _named(outcome: RunOutcome) -> tuple[TableCell, TableCell]:
    return _name(outcome.cell), _name(outcome.run)


def _name(text: str) -> TableCell:
    return TableCell(text=text, is_whole=len(text) <= _LONGEST_WHOLE)


def _recorded(outcome: RunOutcome) -> TableCell:
    at = None if outcome.recorded_s is None else datetime.fromtimestamp(outcome.recorded_s, UTC)
    return TableCell(text="" if at is None else at.strftime("%Y-%m-%d %H:%M"), is_whole=True)


def _verdict(outcome: RunOutcome) -> TableCell:
    if outcome.refused or outcome.outside:
        return TableCell(text=outcome.refused or "certificate no longer holds", tone="bad")
    return TableCell(text="damaged log", tone="warn") if outcome.damage else TableCell(text="good", tone="good")


def _values(outcome: RunOutcome, names: Sequence[str]) -> list[TableCell]:
    shown = (
        with_deviation(*outcome.values[name], parameter_name(name)[1]) if name in outcome.values else ()
        for name in names
    )
    return [TableCell(text=" ± ".join(each)) for each in shown]
