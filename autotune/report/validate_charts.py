"""The figures of a validation: contacts of many plants beside what is promised, and of a log beside the prediction."""

from collections.abc import Iterator

import numpy as np

from autotune.charts.chart import Band, Chart, Limit, Line, Panel, Scale, level_panels
from autotune.formats.units import axis_units
from autotune.validation.against_log import ComparedContact, LogComparison
from autotune.validation.monte_carlo import BAND, AxisMonteCarlo

_PANELS = 3
# What is beyond is in the table.
_MOST_CONTACTS = 12


def band_chart(found: AxisMonteCarlo) -> Chart | None:
    """Draw the contact force of the simulated plants over time; None where nothing could be simulated."""
    if found.band is None or found.contact is None:
        return None
    units, time = axis_units(found.axis), 1e3 * found.band.time_s
    lowest, low, middle, high, highest = found.band.levels
    promised, limit = found.contact.predicted, found.contact.limit
    return Chart(
        key=f"{found.axis}-band",
        title=f"{found.count} contacts simulated with everything that disturbs",
        alternative=f"Contact {units.force_name} over time of {found.count} plants of the certified set with deadband, "
        f"noise, clipping and late commands; the largest is {found.contact.observed.largest:.4g} {units.force}, where "
        f"{promised:.4g} {units.force} is predicted.",
        caption=f"Dark: {100.0 * BAND[0]:g} to {100.0 * BAND[-1]:g} % of the contacts; pale: all of them. What is "
        f"disturbed may reach {limit:.4g} {units.force}.",
        panels=(
            Panel(
                x=Scale(label="time after touching [ms]"),
                y=Scale(label=f"{units.force_name} [{units.force}]"),
                elements=(
                    Band(x=time, low=lowest, high=highest, label="all", role="quiet"),
                    Band(x=time, low=low, high=high, label=f"{100.0 * (BAND[-1] - BAND[0]):g} %", role="after"),
                    Line(x=time, y=middle, label="median", role="after"),
                    Limit(value=promised, label="largest predicted", role="target"),
                    Limit(value=limit, label="limit", role="bad"),
                ),
            ),
        ),
    )


def measured_charts(found: LogComparison) -> Iterator[Chart]:
    """Draw the contacts of a log beside the prediction and what the certified set allows, in the order of time."""
    strongest = sorted(found.contacts, key=lambda each: -each.measured_peak_n)[:_MOST_CONTACTS]
    shown = sorted(strongest, key=lambda each: each.onset_s)
    errors = [100.0 * abs(each.peak_error_n) / each.measured_peak_n for each in found.contacts]
    inside = sum(each.is_inside for each in found.contacts)
    told = (
        f"of {len(found.contacts)} contacts the predicted peak is within {max(errors):.1f} % of the measured one; "
        f"{inside} lie inside the band all the time."
    )
    which = "" if len(shown) == len(found.contacts) else f" The strongest {len(shown)} are drawn; the table has all."
    panels = level_panels([_measured_panel(each) for each in shown])
    for number, start in enumerate(range(0, len(shown), _PANELS), 1):
        is_last = start + _PANELS >= len(shown)
        yield Chart(
            key="measured" + (f"-{number}" if number > 1 else ""),
            title="Measured contacts beside the prediction" + (f" ({number})" if len(shown) > _PANELS else ""),
            alternative=f"Force at the sensor over time after touching, measured and predicted: {told}",
            caption=f"O{told[1:]} Shaded: what the certified set allows.{which}" if is_last else "",
            panels=panels[start : start + _PANELS],
            beside=True,
        )


def _measured_panel(contact: ComparedContact) -> Panel:
    units, trace = axis_units(contact.axis), contact.trace
    last = min(float(trace.measured_s[-1]), float(trace.time_s[-1]))
    used = trace.time_s <= last
    time = 1e3 * trace.time_s[used]
    return Panel(
        title=f"{contact.axis} at {contact.onset_s:.2f} s",
        x=Scale(label="time after touching [ms]", limits=(0.0, 1e3 * last)),
        y=Scale(label=f"{units.force_name} at the sensor [{units.force}]"),
        elements=(
            Band(x=time, low=trace.low[used], high=trace.high[used], label="certified", role="target"),
            Line(x=1e3 * np.asarray(trace.measured_s), y=trace.measured, label="measured", wide=True),
            Line(x=time, y=trace.predicted[used], label="predicted", role="model", dashed=True),
        ),
    )
