"""The page of a campaign: its cells, what changed in them, which are unlike the others, and why runs were refused."""

from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import numpy as np

from autotune.campaign.fleet import Unusual, by_cell, changes, unusual
from autotune.campaign.text import outcome_text
from autotune.campaign.work import RunOutcome
from autotune.charts.chart import Chart, Panel, Points, Scale
from autotune.drift import Change, parameter_name, parameter_text
from autotune.formats.units import axis_units
from autotune.text import with_deviation

from .page import Note, Page, Section, Table, TableCell, build_table


def build_campaign_page(outcomes: Sequence[RunOutcome], footer: str) -> Page:
    """Build the report of what came of every run."""
    refused = [each for each in outcomes if each.refused]
    broken = [each for each in outcomes if each.outside]
    changed, odd = changes(outcomes), unusual(outcomes)
    sections = [
        Section(key="certificates", title="Certificates that no longer hold", blocks=tuple(_broken_notes(broken))),
        Section(key="refused", title="Refused", blocks=(_refused_table(refused),)),
        Section(key="changes", title="What changed from run to run", blocks=(_change_table(changed),)),
        Section(key="unusual", title="Cells unlike the others", blocks=(_unusual_table(odd),)),
        Section(key="peaks", title="Peaks", blocks=tuple(_peak_charts(outcomes))),
        Section(key="runs", title="All runs", blocks=(_run_table(outcomes),)),
    ]
    filled = {
        "certificates": broken,
        "refused": refused,
        "changes": changed,
        "unusual": odd,
        "peaks": [each for each in outcomes if each.peaks_n],
        "runs": outcomes,
    }
    return Page(
        title="Campaign",
        lead=outcome_text(outcomes),
        sections=tuple(section for section in sections if filled[section.key]),
        tone="bad" if broken else "warn" if refused or changed or odd else "good",
        footer=footer,
    )


def _broken_notes(broken: Sequence[RunOutcome]) -> Iterator[Note]:
    for each in broken:
        yield Note(text=f"{each.cell}, {each.run}: {'; '.join(each.outside or ())}.", kind="certificate", tone="bad")


def _refused_table(refused: Sequence[RunOutcome]) -> Table:
    counts = Counter(each.refused for each in refused)
    rows = [
        (kind, str(counts[kind]), each.cell, each.run, each.reason)
        for kind, _ in counts.most_common()
        for each in refused
        if each.refused == kind
    ]
    return build_table("By reason", ("refused for", "runs", "cell", "run", "why"), rows, numbers=(1,))


def _change_table(changed: Sequence[Change]) -> Table:
    rows = []
    for each in changed:
        label, unit, old, new = parameter_text(each.name, each.old, each.new)
        share = f"{100.0 * (each.new / each.old - 1.0):+.2g} %" if each.old else ""
        runs = (each.cell, each.before, each.after, label)
        rows.append((*runs, old, new, unit, share, f"{each.stds:.1f}"))
    columns = ("cell", "from run", "to run", "parameter", "was", "is", "unit", "change", "deviations")
    return build_table("Beyond three standard deviations and 0.2 %", columns, rows, numbers=(4, 5, 7, 8))


def _unusual_table(odd: Sequence[Unusual]) -> Table:
    rows = []
    for each in odd:
        if each.name:
            label, unit, value, median = parameter_text(each.name, each.value, each.median)
        else:
            label, unit, value, median = "all together", "squared distance", f"{each.value:.3g}", f"{each.median:.3g}"
        rows.append((each.cell, label, value, median, unit, f"{each.score:.1f}"))
    columns = ("cell", "parameter", "value", "median of the cells", "unit", "robust deviations")
    return build_table("The newest run of each cell; all together beside its limit", columns, rows, numbers=(2, 3, 5))


def _peak_charts(outcomes: Sequence[RunOutcome]) -> Iterator[Chart]:
    newest = {cell: runs[-1] for cell, runs in by_cell(outcomes).items() if runs[-1].peaks_n}
    for axis in dict.fromkeys(axis for run in newest.values() for axis in run.peaks_n):
        shown = [(cell, run.peaks_n[axis]) for cell, run in newest.items() if axis in run.peaks_n]
        unit = axis_units(axis).force
        after = np.array([peak for _, (_, peak) in shown])
        known = [(i, before) for i, (_, (before, _)) in enumerate(shown, 1) if before is not None]
        at = np.arange(1.0, len(shown) + 1.0)
        points = [Points(x=at, y=after, label="with the new controller", role="after", marker="dot")]
        if known:
            at, before = np.array(known, dtype=float).T
            points.append(Points(x=at, y=before, label="with the gains of the log", role="before", marker="diamond"))
        yield Chart(
            key=f"{axis}-cells",
            title=f"Worst predicted peak of every cell, axis {axis}",
            alternative=f"The worst predicted peak of {len(shown)} cells with the new controller, from "
            f"{after.min():.4g} to {after.max():.4g} {unit}, and with the gains of the log where they are known.",
            caption="; ".join(f"{number}: {cell}" for number, (cell, _) in enumerate(shown, 1)),
            panels=(
                Panel(
                    x=Scale(label="cell, in the order of the list", limits=(0.5, len(shown) + 0.5), counts=True),
                    y=Scale(label=f"peak [{unit}]"),
                    elements=tuple(points),
                ),
            ),
        )


def _run_table(outcomes: Sequence[RunOutcome]) -> Table:
    names = list(dict.fromkeys(name for each in outcomes for name in each.values))
    heads = [f"{label} [{unit}]" for label, unit in (parameter_text(name)[:2] for name in names)]
    rows: list[tuple[str | TableCell, ...]] = []
    for each in outcomes:
        values = [_value(each, name) for name in names]
        verdict = TableCell(text=each.refused or "good", tone="bad" if each.refused else "good")
        when = (
            "" if each.recorded_s is None else datetime.fromtimestamp(each.recorded_s, UTC).strftime("%Y-%m-%d %H:%M")
        )
        rows.append((each.cell, each.run, when, verdict, *values))
    numbers = tuple(range(4, 4 + len(names)))
    return build_table(
        "Value ± standard deviation", ("cell", "run", "recorded", "outcome", *heads), rows, numbers=numbers
    )


def _value(outcome: RunOutcome, name: str) -> str:
    if name not in outcome.values:
        return ""
    return " ± ".join(with_deviation(*outcome.values[name], parameter_name(name)[1]))
