"""The windows of a long log: what each identifies, and its parameters over the log."""

from collections.abc import Iterator, Sequence

import numpy as np

from autotune.charts.chart import Band, Chart, Panel, Points, Scale
from autotune.drift import parameter_name, parameter_text
from autotune.text import with_deviation
from autotune.windows import Window, use_text

from .page import Block, Section, build_table

_FEWEST_POINTS, _MOST_PANELS = 3, 6


def window_section(windows: Sequence[Window]) -> Section:
    """Build the section on the windows of a log; without windows it is empty."""
    return Section(key="windows", title="The log window by window", blocks=tuple(_blocks(windows)))


def _blocks(windows: Sequence[Window]) -> Iterator[Block]:
    if not windows:
        return
    names = list(dict.fromkeys(name for each in windows for name in each.values))
    heads = [f"{label} [{unit}]" for label, unit in (parameter_text(name)[:2] for name in names)]
    shown = [name for name in names if sum(name in each.values for each in windows) >= _FEWEST_POINTS]
    if shown:
        yield _drift_chart(windows, shown[:_MOST_PANELS])
    rows = [(each.name, use_text(each), *(_value(each, name) for name in names)) for each in windows]
    numbers = range(2, 2 + len(names))
    yield build_table("Value ± standard deviation", ("window", "use", *heads), rows, numbers=tuple(numbers))


def _value(window: Window, name: str) -> str:
    return " ± ".join(with_deviation(*window.values[name], parameter_name(name)[1])) if name in window.values else ""


def _drift_chart(windows: Sequence[Window], names: Sequence[str]) -> Chart:
    panels = []
    for name in names:
        label, scale, unit = parameter_name(name)
        held = [each for each in windows if name in each.values]
        hours = np.array([(each.start_s + each.stop_s) / 7200.0 for each in held])
        values, stds = scale * np.array([each.values[name] for each in held]).T
        band = Band(x=hours, low=values - 2.0 * stds, high=values + 2.0 * stds, label="two standard deviations")
        dots = Points(x=hours, y=values, label="value")
        panels.append(
            Panel(x=Scale(label="time in the log [h]"), y=Scale(label=f"{label} [{unit}]"), elements=(band, dots))
        )
    return Chart(
        key="window-parameters",
        title="Parameters over the log",
        alternative=f"{len(names)} parameters over the windows of the log, with two standard deviations.",
        caption="Each dot is a window on its own.",
        panels=tuple(panels),
    )
