"""The report of an identification: how healthy the log is, what was found, and how well the model explains it."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from autotune.files.units import axis_units
from autotune.parameter_rows import ParameterRow, parameter_rows
from identification.evidence import AxisEvidence, Evidence
from identification.logs.summary import ChannelSummary, LogSummary
from identification.result import AxisEstimate, Finding, FitQuality, Identified

from .identify_charts import (
    contact_chart,
    correlation_chart,
    noise_chart,
    residual_charts,
    response_charts,
    wrench_chart,
)
from .page import Block, Cell, Fact, Facts, Note, Page, Section, Table, Tone

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


def build_identify_page(
    result: Identified,
    provenance: Mapping[str, Any],
    evidence: Sequence[Evidence] = (),
    summaries: Sequence[LogSummary] = (),
) -> Page:
    """Build the report of what `identify` found.

    `evidence` has the signals of every log, in the order of `result.timelines`; without it (a report from the file
    alone) the figures are those that the parameters tell. `summaries` are the logs as `inspect` tells them.
    """
    rows = list(parameter_rows(result))
    axes = [_axis_section(result, name, axis, evidence) for name, axis in result.axes.items()]
    sections = [_summary_section(result, rows)]
    if evidence or summaries or result.timelines:
        sections.append(_log_section(result, evidence, summaries))
    sections += [*axes, _sensor_section(result)]
    return Page(
        title="What the log tells of the cell",
        lead=_lead(result, rows),
        tone=_worst_tone(result, rows),
        sections=tuple(section for section in sections if section.blocks),
        footer=_footer(provenance),
    )


def _lead(result: Identified, rows: Sequence[ParameterRow]) -> str:
    counts = {
        word: sum(row.verdict == word for row in rows) for word in ("identified", "given", "weak", "unidentifiable")
    }
    told = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    axes = ", ".join(result.axes) or "none"
    return f"Axes: {axes}. Parameters: {told}."


def _worst_tone(result: Identified, rows: Sequence[ParameterRow]) -> Tone:
    if any(finding.severity == "error" for finding in result.findings):
        return "bad"
    doubtful = any(row.verdict in {"weak", "unidentifiable"} for row in rows)
    return "warn" if doubtful or any(finding.severity == "warning" for finding in result.findings) else "good"


def _summary_section(result: Identified, rows: Sequence[ParameterRow]) -> Section:
    facts = [
        Fact(
            label=row.name,
            value=f"{row.value} {row.unit}".strip(),
            detail=_detail(row),
            tone=_TONES.get(row.verdict, ""),
        )
        for row in rows
        if row.name == "payload mass" or row.name.endswith(("coupling K_s", ": K_e", "delay T_d", "robot bandwidth"))
    ]
    return Section(
        key="result",
        title="Result",
        blocks=(Facts(facts=tuple(facts)), _parameter_table(rows), *_notes(result.findings)),
    )


def _detail(row: ParameterRow) -> str:
    return f"± {row.std}, {row.verdict}" if row.std not in {"", "-"} else row.verdict


def _parameter_table(rows: Sequence[ParameterRow]) -> Table:
    return Table(
        caption="Every parameter with one standard deviation and a verdict",
        columns=("parameter", "value", "± std", "unit", "verdict", "how"),
        rows=tuple(
            (
                Cell(text=row.name),
                Cell(text=row.value, is_number=True),
                Cell(text=row.std, is_number=True),
                Cell(text=row.unit),
                Cell(text=row.verdict, tone=_TONES.get(row.verdict, "")),
                Cell(text="; ".join(part for part in (row.method, row.note) if part), tone="quiet"),
            )
            for row in rows
        ),
    )


def _notes(findings: Sequence[Finding]) -> Iterator[Note]:
    """Yield the findings, the gravest first."""
    for finding in sorted(findings, key=lambda each: _ORDER.index(each.severity)):
        yield Note(text=finding.message, advice=finding.advice, kind=finding.severity, tone=_TONES[finding.severity])


def _log_section(result: Identified, evidence: Sequence[Evidence], summaries: Sequence[LogSummary]) -> Section:
    blocks: list[Block] = [_health_table(summary) for summary in summaries]
    for summary in summaries:
        blocks += list(_notes(summary.findings))
    for i, each in enumerate(evidence):
        timeline = result.timelines[i] if i < len(result.timelines) else None
        blocks.append(wrench_chart(each, timeline, f"wrench-{i + 1}"))
    blocks += [_phase_table(result)] if any(timeline.phases for timeline in result.timelines) else []
    return Section(key="log", title="The log", blocks=tuple(blocks))


def _health_table(summary: LogSummary) -> Table:
    return Table(
        caption=f"Health of {summary.path.name}: {(summary.end_ns - summary.start_ns) / 1e9:.1f} s, "
        f"{summary.size_bytes / 1e6:.1f} MB",
        columns=(
            "topic",
            "messages",
            "rate [Hz]",
            "longest gap [ms]",
            "backwards / duplicate",
            "header − recording [ms]",
            "serves as",
        ),
        rows=tuple(_channel_row(summary, channel) for channel in summary.channels),
    )


def _channel_row(summary: LogSummary, channel: ChannelSummary) -> tuple[Cell, ...]:
    serves = ", ".join(role.entry for role in summary.roles if role.topic == channel.topic)
    faults = channel.backwards_steps + channel.duplicates
    return (
        Cell(text=channel.topic),
        Cell(text=str(channel.count), is_number=True),
        Cell(text=_number(channel.rate_hz, 1.0, 2), is_number=True),
        Cell(text=_number(channel.max_gap_s, 1e3, 2), is_number=True),
        Cell(text=f"{channel.backwards_steps} / {channel.duplicates}", is_number=True, tone="bad" if faults else ""),
        Cell(text=_number(channel.header_minus_log_s, 1e3, 2), is_number=True),
        Cell(text=serves),
    )


def _number(value: float | None, scale: float, digits: int) -> str:
    return "–" if value is None else f"{value * scale:.{digits}f}"


def _phase_table(result: Identified) -> Table:
    rows = []
    for timeline in result.timelines:
        spent: dict[str, tuple[int, float]] = {}
        for phase in timeline.phases:
            count, seconds = spent.get(phase.kind.value, (0, 0.0))
            spent[phase.kind.value] = count + 1, seconds + phase.stop_s - phase.start_s
        rows += [
            (
                Cell(text=timeline.log or "log"),
                Cell(text=kind.replace("-", " ")),
                Cell(text=str(count), is_number=True),
                Cell(text=f"{seconds:.1f}", is_number=True),
            )
            for kind, (count, seconds) in spent.items()
        ]
    return Table(caption="Phases of the log", columns=("log", "phase", "times", "seconds"), rows=tuple(rows))


def _axis_section(result: Identified, name: str, axis: AxisEstimate, evidence: Sequence[Evidence]) -> Section:
    units = axis_units(name)
    blocks: list[Block] = [_fit_table(axis.fits)] if axis.fits else []
    seen = [(each.period_s, each.axes[name]) for each in evidence if name in each.axes]
    # Of several logs the one that told most is shown; all are in the table above.
    period_s, told = max(seen, key=lambda pair: sum(len(span.measured) for span in pair[1].spans), default=(0.0, None))
    period = period_s or result.sample_time_s.value or 1e-3
    blocks += list(response_charts(name, units, axis, told, period))
    if told is not None:
        blocks += list(_contact_charts(name, axis, told, period))
        blocks += list(residual_charts(name, units, told, period))
    if axis.covariance is not None:
        blocks.append(correlation_chart(name, axis.covariance))
    return Section(key=f"axis-{name}", title=f"Axis {name}", blocks=tuple(blocks))


def _contact_charts(name: str, axis: AxisEstimate, told: AxisEvidence, period_s: float) -> Iterator[Block]:
    for index, surface in enumerate(axis.environments):
        chart = contact_chart(name, axis_units(name), surface.name, index, told, period_s)
        if chart is not None:
            yield chart


def _fit_table(fits: Sequence[FitQuality]) -> Table:
    def share(value: float | None) -> Cell:
        return Cell(text="–" if value is None else f"{100.0 * value:.2f} %", is_number=True)

    return Table(
        caption="How well the model explains each log",
        columns=(
            "log",
            "spans",
            "explained",
            "residual / noise",
            "left-out spans missed by",
            "contacts",
            "explained",
            "residual / noise",
            "left-out contacts missed by",
        ),
        rows=tuple(
            (
                Cell(text=str(i + 1)),
                Cell(text=str(fit.free_spans), is_number=True),
                share(fit.explained_free),
                Cell(text=f"{fit.noise_ratio_free:.2f}", is_number=True),
                share(fit.left_out_free),
                Cell(text=str(fit.contacts), is_number=True),
                share(fit.explained_contact),
                Cell(text="–" if fit.noise_ratio_contact is None else f"{fit.noise_ratio_contact:.2f}", is_number=True),
                share(fit.left_out_contact),
            )
            for i, fit in enumerate(fits)
        ),
    )


def _sensor_section(result: Identified) -> Section:
    noise = result.sensor.noise
    return Section(key="sensor", title="Sensor", blocks=() if noise is None else (noise_chart(noise),))


def _footer(provenance: Mapping[str, Any]) -> str:
    logs = ", ".join(f"{log['path']} (sha256 {str(log['sha256'])[:12]}…)" for log in provenance.get("logs", ()))
    return f"{provenance.get('tool', '')} · {logs}".strip(" ·")
