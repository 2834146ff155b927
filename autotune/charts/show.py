"""Draw a chart on axes of the caller, or as a figure of its own, for scripts and notebooks."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from autotune.errors import UsageError
from problems.errors import shown

from .chart import Chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    AxesLike = Axes | Sequence[Axes]


def show(chart: Chart, ax: "AxesLike | None" = None, *, panel: int = 0) -> "Figure":
    """Draw a chart and return its figure.

    Parameters
    ----------
    chart
        What to draw.
    ax
        Axes to draw on: one for each panel of the chart, or a single one, which takes the panel number `panel`. None
        makes a figure that `matplotlib.pyplot.show` and notebooks show.
    panel
        Which panel a single axes takes.

    Raises
    ------
    UsageError
        `ax` are no axes, or their number is neither one nor that of the panels.

    """
    from matplotlib.axes import Axes  # noqa: PLC0415 - half a second, which only who draws pays

    from autotune.charts.matplotlib_renderer import draw  # noqa: PLC0415

    if ax is None:
        from matplotlib import pyplot as plt  # noqa: PLC0415

        return draw(chart, make=plt.figure)
    said: object = ax
    given = [said] if isinstance(said, Axes) else list(said) if isinstance(said, Iterable) else []
    if not given or not all(isinstance(each, Axes) for each in given):
        raise UsageError(f"ax must be matplotlib axes, or several of them, found {shown(ax)}.")
    if len(given) not in {1, len(chart.panels)}:
        raise UsageError(f"{chart.title!r} takes one axes, or {len(chart.panels)} for its panels; found {len(given)}.")
    one = Chart(key=chart.key, title=chart.title, alternative=chart.alternative, panels=(chart.panels[panel],))
    return draw(one if len(given) == 1 else chart, given)
