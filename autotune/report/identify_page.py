"""The page of an identification: parameters, health of the log, and how well the model explains it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from autotune.charts.chart import Chart
from autotune.formats.units import axis_units
from autotune.text import ParameterRow, held_out_lines, parameter_rows, touch_columns, touch_note, touch_rows
from autotune.windows import windows_of
from identification.errors import LogError
from identification.evidence import AxisEvidence, Evidence
from identification.fit_quality import FitQuality
from identification.logs.inspect import inspect_log
from identification.logs.read import LogSpan
from identification.logs.summary import LogSummary
from identification.result import AxisEstimate, Finding, Identified

from .identify_charts import (
    contact_charts,
    contact_table,
    contacts_seen,
    correlation_chart,
    residual_charts,
    response_charts,
)
from .page import Block, Fact, Facts, Note, Page, Section, Table, TableCell, Tone, build_table
from .sensor_charts import noise_chart, wrench_charts
from .window_blocks import window_section

if TYPE_CHECKING:
    from autotune.pipeline import IdentifyOptions


_TONES: Mapping[str, Tone] = {
    "identified": "good",
    "given": "good",
    "weak": "warn",
    "unidentifiable": "bad",
    "error": "bad",
    "warning": "warn",
    "info": "quiet",
}
_ORDER = ("error", "warning", "info")
# Findings that say what to record for a parameter that is weak or missing.
_LACKING = frozenset({"unidentifiable", "bounded", "weak", "inertia-not-excited"})


def build_identify_page(
    result: Identified,
    provenance: Mapping[str, Any],
    evidence: Sequence[Evidence] = (),
    summaries: Sequence[LogSummary] = (),
) -> Page:
    """Build the report of what `identify` found.

    `evidence` has the signals of every log, in the order of `result.timelines`; without it (a report from the file
    alone) the figures are those of the parameters. `summaries` are those of `inspect`.
    """
    rows = list(parameter_rows(result))
    log = _log_section(result, evidence, summaries) if evidence or summaries or result.timelines else None
    axes = [_axis_section(result, name, axis, evidence) for name, axis in result.axes.items()]
    picture, rest = _taken_out([*axes, *([] if log is None else [log])])
    below = rest if log is None else [rest[-1], *rest[:-1]]
    parameters = Section(key="parameters", title="Parameters", blocks=(_parameter_table(rows),))
    windows = window_section(windows_of(provenance))
    sections = (_summary_section(result, rows, picture), windows, parameters, *below, _sensor_section(result))
    return Page(
        title="The identified cell",
        lead=_lead(result, rows),
        tone=_worst_tone(result, rows),
        sections=tuple(section for section in sections if section.blocks),
        footer=_footer(provenance),
    )


def _taken_out(sections: Sequence[Section]) -> tuple[Chart | None, list[Section]]:
    """Return the main figure of the page, and the sections without it.

    It is one of contacts, measured and modelled; where there is none, the first of the first section that has one.
    """
    charts = [block for section in sections for block in section.blocks if isinstance(block, Chart)]
    contacts = [chart for chart in charts if chart.key.endswith("-contacts")]
    picture = next(iter([*contacts, *charts]), None)
    kept = [replace(each, blocks=tuple(b for b in each.blocks if b is not picture)) for each in sections]
    return picture, kept


def _lead(result: Identified, rows: Sequence[ParameterRow]) -> str:
    verdicts = ("identified", "given", "weak", "unidentifiable")
    named = {word: [row.name for row in rows if row.verdict == word] for word in verdicts}
    counts = ", ".join(
        f"{len(names)} {word}" + (f" ({', '.join(names)})" if word in {"weak", "unidentifiable"} else "")
        for word, names in named.items()
        if names
    )
    axes = ", ".join(result.axes) or "none"
    return f"{_lacking(result)}Axes: {axes}. Parameters: {counts}."


def _lacking(result: Identified) -> str:
    """Return what a controller needs that no axis shows, as a sentence; nothing where an axis has it all."""
    found = {
        "the payload's mass": result.payload.mass_kg.value is not None,
        "the coupling K_s": any(axis.coupling.stiffness_n_per_m.value is not None for axis in result.axes.values()),
        "the robot r(s)": any(axis.robot.numerator.value is not None for axis in result.axes.values()),
        "a surface": any(
            surface.stiffness_n_per_m.value is not None or surface.secant_stiffness_n_per_m.value is not None
            for axis in result.axes.values()
            for surface in axis.environments
        ),
    }
    missing = [name for name, is_found in found.items() if not is_found]
    if not missing:
        return ""
    listed = missing[0] if len(missing) == 1 else f"{', '.join(missing[:-1])} and {missing[-1]}"
    return f"Not found: {listed}. "


def _worst_tone(result: Identified, rows: Sequence[ParameterRow]) -> Tone:
    if any(finding.severity == "error" for finding in result.findings):
        return "bad"
    doubtful = any(row.verdict in {"weak", "unidentifiable"} for row in rows)
    return "warn" if doubtful or any(finding.severity == "warning" for finding in result.findings) else "good"


def _summary_section(result: Identified, rows: Sequence[ParameterRow], picture: Chart | None) -> Section:
    facts = [
        Fact(
            label=row.name,
            value=f"{row.value} {row.unit}".strip(),
            detail=f"± {row.std}, {row.verdict}" if row.std not in {"", "-"} else row.verdict,
            tone=_TONES.get(row.verdict, ""),
        )
        for row in rows
        if row.name == "payload mass" or row.name.endswith(("coupling K_s", ": K_e", "delay T_d", "robot bandwidth"))
    ]
    figure = () if picture is None else (picture,)
    grave = [each for each in result.findings if each.severity != "info" or each.code in _LACKING]
    return Section(key="result", title="Result", blocks=(Facts(facts=tuple(facts)), *_notes(grave), *figure))


def _parameter_table(rows: Sequence[ParameterRow]) -> Table:
    return build_table(
        "Every parameter with one standard deviation and a verdict",
        ("parameter", "value", "± std", "unit", "verdict", "how"),
        (
            (
                *(row.name, row.value, row.std, row.unit),
                TableCell(text=row.verdict, tone=_TONES.get(row.verdict, "")),
                TableCell(text="; ".join(_plain(part) for part in (row.method, row.note) if part), tone="quiet"),
            )
            for row in rows
        ),
        numbers=(1, 2),
    )


def _notes(findings: Sequence[Finding]) -> Iterator[Note]:
    """Yield the findings, the gravest first; of these, what to do for a parameter that is not known."""
    for finding in sorted(findings, key=lambda each: (_ORDER.index(each.severity), each.code not in _LACKING)):
        lacks = finding.severity == "info" and finding.code in _LACKING
        kind, tone = ("advice", _TONES["warning"]) if lacks else (finding.severity, _TONES[finding.severity])
        yield Note(text=_plain(finding.message), advice=_plain(finding.advice), kind=kind, tone=tone)


def _plain(text: str) -> str:
    """Return text without the marks of the terminal around names."""
    return text.replace("`", "")


def health_blocks(summaries: Sequence[LogSummary], known: Sequence[Finding] = ()) -> Iterator[Block]:
    """Yield the health of each log and its findings, without those of the kinds `known`, which are shown elsewhere."""
    seen = {finding.code for finding in known}
    for summary in summaries:
        yield _health_table(summary)
        yield from _notes([finding for finding in summary.findings if finding.code not in seen])


def summaries_of(
    logs: Sequence[Path], options: "IdentifyOptions", evidence: Sequence[Evidence] = ()
) -> tuple[LogSummary, ...]:
    """Return the summary of each log, as `inspect` makes it; of a part that cannot be used alone there is none.

    `evidence` is what identification kept of these logs: those that it read by themselves are not read once more.
    """
    cell, found = options.declared(), []
    # Start and stop of a recording of several parts are not those of each.
    span = options.span if len(logs) == 1 else LogSpan()
    names = [log.name for log in logs]
    known = {each.log: each.reading for each in evidence if names.count(each.log) == 1}
    for log in logs:
        try:
            found.append(inspect_log(log, cell, salvage=options.salvage, span=span, reading=known.get(log.name)))
        except LogError:
            # A part of a recording need not hold everything by itself.
            continue
    return tuple(found)


def _log_section(result: Identified, evidence: Sequence[Evidence], summaries: Sequence[LogSummary]) -> Section:
    blocks = list(health_blocks(summaries, result.findings))
    blocks += _notes([each for each in result.findings if each.severity == "info" and each.code not in _LACKING])
    for i, each in enumerate(evidence):
        timeline = result.timelines[i] if i < len(result.timelines) else None
        blocks += wrench_charts(each, timeline, f"{i + 1}")
    blocks += [_phase_table(result)] if any(timeline.phases for timeline in result.timelines) else []
    for timeline in result.timelines:
        if timeline.touches:
            caption = f"Touches{f' of {timeline.log}, from its start' if timeline.log else ''}"
            blocks.append(build_table(caption, touch_columns(timeline), touch_rows(timeline), numbers=range(2, 8)))
            if note := touch_note(timeline):
                blocks.append(Note(text=note, kind="info"))
    return Section(key="log", title="The log", blocks=tuple(blocks))


def _health_table(summary: LogSummary) -> Table:
    rows: list[tuple[str | TableCell, ...]] = []
    for channel in summary.channels:
        faults = channel.backwards_steps + channel.duplicates
        rows.append(
            (
                channel.topic,
                str(channel.count),
                _number(channel.rate_hz, 1.0, 2),
                _number(channel.max_gap_s, 1e3, 2),
                TableCell(text=f"{channel.backwards_steps} / {channel.duplicates}", tone="bad" if faults else ""),
                _number(channel.header_minus_log_s, 1e3, 2),
                ", ".join(role.entry for role in summary.roles if role.topic == channel.topic),
            )
        )
    return build_table(
        f"Health of {summary.path.name}: {(summary.end_ns - summary.start_ns) / 1e9:.1f} s, "
        f"{summary.size_bytes / 1e6:.1f} MB",
        (
            *("topic", "messages", "rate [Hz]", "longest gap [ms]", "backwards / duplicate"),
            *("header − recording [ms]", "serves as"),
        ),
        rows,
        numbers=range(1, 6),
    )


def _number(value: float | None, scale: float, digits: int) -> str:
    return "–" if value is None else f"{value * scale:.{digits}f}"


def _phase_table(result: Identified) -> Table:
    rows, many = [], len(result.timelines) > 1
    for timeline in result.timelines:
        spent: dict[str, tuple[int, float]] = {}
        for phase in timeline.phases:
            count, seconds = spent.get(phase.kind.value, (0, 0.0))
            spent[phase.kind.value] = count + 1, seconds + phase.stop_s - phase.start_s
        rows += [
            (timeline.log, kind.replace("-", " "), str(count), f"{seconds:.1f}")[0 if many else 1 :]
            for kind, (count, seconds) in spent.items()
        ]
    columns = ("log", "phase", "times", "seconds")[0 if many else 1 :]
    return build_table("Phases of the log", columns, rows, numbers=range(len(columns) - 2, len(columns)))


def _axis_section(result: Identified, name: str, axis: AxisEstimate, evidence: Sequence[Evidence]) -> Section:
    units = axis_units(name)
    blocks: list[Block] = [_fit_table(axis.fits)] if axis.fits else []
    blocks += [Note(text=line, kind="held out") for line in held_out_lines(name, axis)]
    seen = [(each.period_s, each.axes[name]) for each in evidence if name in each.axes]
    # Of several logs the one with most samples is shown; all are in the table above.
    period_s, shown = max(seen, key=lambda pair: sum(len(span.measured) for span in pair[1].spans), default=(0.0, None))
    period = period_s or result.sample_time_s.value or 1e-3
    blocks += response_charts(name, units, axis, period)
    if shown is not None:
        blocks += _contact_blocks(name, axis, shown, period)
        blocks += residual_charts(name, units, shown, period)
    if axis.covariance is not None:
        blocks.append(correlation_chart(name, axis.covariance))
    return Section(key=f"axis-{name}", title=f"Axis {name}", blocks=tuple(blocks))


def _contact_blocks(name: str, axis: AxisEstimate, evidence: AxisEvidence, period_s: float) -> Iterator[Block]:
    units = axis_units(name)
    seen = [(surface.name, contacts_seen(evidence, i)) for i, surface in enumerate(axis.environments)]
    for surface, contacts in seen:
        yield from contact_charts(name, units, surface, contacts, period_s)
    if any(contacts for _, contacts in seen):
        yield contact_table(name, units, seen, period_s)


def _fit_table(fits: Sequence[FitQuality]) -> Table:
    def share(value: float | None) -> str:
        return "–" if value is None else f"{100.0 * value:.2f} %"

    return build_table(
        "How well the model explains each log",
        (
            *("log", "free spans", "free: explained", "free: residual / noise", "free: left-out span missed by"),
            *("contacts", "contacts: explained", "contacts: residual / noise", "contacts: left-out one missed by"),
        ),
        (
            (
                str(i + 1),
                str(fit.free_spans),
                share(fit.explained_free),
                f"{fit.noise_ratio_free:.2f}",
                share(fit.left_out_free),
                str(fit.contacts),
                share(fit.explained_contact),
                _number(fit.noise_ratio_contact, 1.0, 2),
                share(fit.left_out_contact),
            )
            for i, fit in enumerate(fits)
        ),
        numbers=range(1, 9),
    )


def _sensor_section(result: Identified) -> Section:
    noise = result.sensor.noise
    return Section(key="sensor", title="Sensor", blocks=() if noise is None else (noise_chart(noise),))


def _footer(provenance: Mapping[str, Any]) -> str:
    logs = ", ".join(f"{log['path']} (sha256 {str(log['sha256'])[:12]}…)" for log in provenance.get("logs", ()))
    return f"{provenance.get('tool', '')} · {logs}".strip(" ·")
