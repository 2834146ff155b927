"""The contacts of a log against the model: a figure of each, and a table of all."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from autotune.charts.chart import Chart, Line, Panel, Scale
from autotune.formats.units import AxisUnits
from identification.evidence import AxisEvidence
from identification.joint_fit.result import FittedSpan

from .page import Cell, Table

_PANELS = 3
# What is beyond is in the table: a page of sixty contacts would be no page that anybody reads.
_MOST_DRAWN = 9
_BEFORE_S, _AFTER_S = 0.2, 0.6
_HEADROOM = 0.05


@dataclass(frozen=True, kw_only=True)
class ContactSeen:
    """One contact that was fitted: `place` is the sample of its measured peak within the span."""

    span: FittedSpan
    place: int

    @property
    def measured(self) -> float:
        """The measured peak, N or N·m."""
        return float(np.max(np.abs(self.span.measured)))

    @property
    def model(self) -> float:
        """The peak of the model, N or N·m."""
        return float(np.max(np.abs(self.span.predicted)))

    @property
    def error(self) -> float:
        """How far the model's peak lies above the measured one, of that."""
        return self.model / self.measured - 1.0

    def time_s(self, period_s: float) -> float:
        """Return when the peak was, in s after the start of the log."""
        return period_s * (self.span.start + self.place)


def contacts_seen(told: AxisEvidence, surface: int) -> tuple[ContactSeen, ...]:
    """Return the fitted contacts of one surface in the order of time."""
    spans = sorted((span for span in told.spans if span.surface == surface), key=lambda span: span.start)
    return tuple(ContactSeen(span=span, place=int(np.argmax(np.abs(span.measured)))) for span in spans)


def contact_charts(
    axis: str, units: AxisUnits, surface: str, seen: Sequence[ContactSeen], period_s: float
) -> Iterator[Chart]:
    """Draw the contacts of one surface, measured and modelled, all on one scale of force."""
    strongest = sorted(seen, key=lambda each: -each.measured)[:_MOST_DRAWN]
    shown = [each for each in seen if each in strongest]
    if not shown:
        return
    lowest = min(float(min(each.span.measured.min(), each.span.predicted.min())) for each in shown)
    highest = max(float(max(each.span.measured.max(), each.span.predicted.max())) for each in shown)
    room = _HEADROOM * (highest - lowest)
    y = Scale(label=f"{units.force_name} [{units.force}]", limits=(lowest - room, highest + room))
    share = 100.0 * max(abs(each.error) for each in seen)
    rows = -(-len(shown) // _PANELS)
    beside = -(-len(shown) // rows)
    groups = [shown[i : i + beside] for i in range(0, len(shown), beside)]
    for number, group in enumerate(groups, 1):
        part = f" ({number} of {rows})" if rows > 1 else ""
        which = "" if len(shown) == len(seen) else f" The strongest {len(shown)} are drawn; the table has all."
        yield Chart(
            key=f"{axis}-{surface}-contacts" + (f"-{number}" if number > 1 else ""),
            title=f"Contacts with {surface}, measured and modelled{part}",
            alternative=f"{len(group)} of {len(seen)} contacts with {surface}; in all of them the model's peak is "
            f"within {share:.1f} % of the measured one.",
            caption=f"In all {len(seen)} contacts the peak of the model is within {share:.1f} % of the measured "
            f"one.{which}"
            if number == rows
            else "",
            panels=tuple(_panel(each, y, period_s) for each in group),
            beside=True,
        )


def _panel(seen: ContactSeen, y: Scale, period_s: float) -> Panel:
    span, place = seen.span, seen.place
    begin = max(0, place - round(_BEFORE_S / period_s))
    stop = min(len(span.measured), place + round(_AFTER_S / period_s))
    time = 1e3 * period_s * (np.arange(begin, stop) - place)
    return Panel(
        title=f"at {seen.time_s(period_s):.1f} s",
        x=Scale(label="time from the peak [ms]"),
        y=y,
        elements=(
            Line(x=time, y=span.measured[begin:stop], label="measured", wide=True),
            Line(x=time, y=span.predicted[begin:stop], label="model", role="model"),
        ),
    )


def contact_table(
    axis: str, units: AxisUnits, surfaces: Sequence[tuple[str, Sequence[ContactSeen]]], period_s: float
) -> Table:
    """Return every contact that was fitted: when, with what, both peaks and the error."""
    rows = []
    seen = [(name, each) for name, group in surfaces for each in group]
    for name, each in sorted(seen, key=lambda pair: pair[1].span.start):
        rms = float(np.sqrt(np.mean((each.span.measured - each.span.predicted) ** 2)))
        numbers = (f"{each.measured:.4g}", f"{each.model:.4g}", f"{100.0 * each.error + 0.0:+.1f}", f"{rms:.3g}")
        time = Cell(text=f"{each.time_s(period_s):.2f}", is_number=True)
        rows.append((time, Cell(text=name), *(Cell(text=text, is_number=True) for text in numbers)))
    force = units.force
    return Table(
        caption=f"Every contact along {axis}, measured against the model",
        columns=(
            "peak at [s]",
            "surface",
            f"measured peak [{force}]",
            f"model's peak [{force}]",
            "error [%]",
            f"residual RMS [{force}]",
        ),
        rows=tuple(rows),
    )
