"""How the pictures look, and how their bytes come out the same on every run."""

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from autotune.formats.replaceable import PICTURE_MARK
from problems.contact.transient import Approach
from problems.maps.maps import MapAxis
from problems.maps.parameters import MAP_PARAMETERS, MapParameter

from .plan import MapPlan
from .text import approach_text, number, with_unit

STABLE_COLOUR, UNSTABLE_COLOUR, HATCH_COLOUR = "#d6e8f7", "#e4e4e4", "#9a9a9a"
DESIGN_COLOUR = "#d55e00"

_PNG_DOTS_PER_INCH = 160
_LINE_LENGTH = 112
_TOP = 0.985
_FEW_DECADES, _FEW_DECADES_CROWDED = 2.2, 1.5
_LETTERS = {"ω": r"\omega", "ζ": r"\zeta", "P̂": r"\hat{P}"}


def render(draw: Callable[[], Figure], suffix: str) -> bytes:
    """Return the bytes of a picture, PNG or SVG by `suffix`; the same figure gives the same bytes."""
    kind = suffix.lower().removeprefix(".")
    stream = io.BytesIO()
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rc("font", size=10.0)
        mpl.rc("hatch", linewidth=0.6, color=HATCH_COLOUR)
        # Ids and outlines that depend neither on the run nor on the fonts of whoever looks.
        mpl.rc("svg", hashsalt="autotune", fonttype="path")
        metadata = {"Software": PICTURE_MARK} if kind == "png" else {"Date": None, "Creator": PICTURE_MARK}
        draw().savefig(stream, format=kind, dpi=_PNG_DOTS_PER_INCH, metadata=metadata)
    return stream.getvalue()


def symbol(parameter: MapParameter) -> str:
    """Return the symbol for a picture, with its index set low."""
    letter, _, index = parameter.symbol.partition("_")
    letter = _LETTERS.get(letter, letter)
    return f"${letter}_{{{index}}}$" if index else f"${letter}$"


def axis_label(plan: MapPlan, parameter: MapParameter) -> str:
    """Return name, symbol and unit of a parameter."""
    unit = plan.unit(parameter)
    return f"{parameter.label} {symbol(parameter)}" + (f" [{unit}]" if unit else "")


def told(plan: MapPlan, approach: Approach | None = None) -> str:
    """Return in lines for a title what is fixed; what is off, or filters that nothing passes, are left out."""
    parts = [(each := f"{plan.source.path.name}, axis {plan.source.axis}", each)]
    for name, value in plan.fixed.items():
        if value > 0.0 and not _is_idle(plan, name):
            parameter = MAP_PARAMETERS[name]
            ending = with_unit(f" = {number(value)}", plan.unit(parameter))
            parts.append((parameter.symbol + ending, symbol(parameter) + ending))
    parts.append((each := f"h = {number(plan.source.sample_time_s)} s", f"$h${each.removeprefix('h')}"))
    if approach is not None:
        parts.append((each := approach_text(approach, rotational=plan.source.is_rotational), each))
    return _lines(parts)


def _is_idle(plan: MapPlan, name: str) -> bool:
    """Whether a filter stands in no path: a parameter that varies is not fixed, and counts as used."""
    compensates = plan.fixed.get("compensation_mass", 1.0) > 0.0
    if name == "acceleration_filter_rad_per_s":
        return not compensates
    return name == "velocity_filter_rad_per_s" and not (compensates or plan.fixed.get("feedback_damping_s", 1.0) > 0.0)


def _lines(parts: Sequence[tuple[str, str]]) -> str:
    """Join parts, (as counted, as written), into lines that fit above a picture."""
    lines: list[list[str]] = [[]]
    length = 0
    for plain, pretty in parts:
        if length + len(plain) > _LINE_LENGTH:
            lines.append([])
            length = 0
        lines[-1].append(pretty)
        length += len(plain) + 3
    return "\n".join(" · ".join(line) for line in lines)


def set_axis(axes: Axes, which: str, axis: MapAxis, label: str, *, crowded: bool = False) -> None:
    """Give one side of the axes its label, limits and readable ticks; fewer of them where it is `crowded`."""
    if which == "x":
        axes.set_xscale(axis.spacing)
        axes.set_xlim(axis.low, axis.high)
        side: Any = axes.xaxis
    else:
        axes.set_yscale(axis.spacing)
        axes.set_ylim(axis.low, axis.high)
        side = axes.yaxis
    side.set_label_text(label)
    if axis.spacing == "log":
        log_ticks(side, axis.low, axis.high, crowded=crowded)


def log_ticks(side: Any, low: float, high: float, *, crowded: bool = False) -> None:
    """Set ticks at 1, 2 and 5 of every decade, or at 1 only where there are many decades, with their numbers."""
    few = np.log10(high / low) < (_FEW_DECADES_CROWDED if crowded else _FEW_DECADES)
    side.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=30))
    side.set_major_formatter(FuncFormatter(lambda value, _position: number(value)))
    side.set_minor_formatter(NullFormatter())


def title(figure: Figure, headline: str, below: str) -> None:
    """Write a headline and, in small letters, what is fixed, both above the left end of the first axes."""
    # The blank lines hold the place of the headline, for which the layout would not make room by itself.
    fixed = figure.suptitle("\n\n" + below, ha="left", fontsize=8.0, color="0.3", linespacing=1.5)
    figure.draw_without_rendering()
    left = float(figure.get_axes()[0].get_position().x0)
    fixed.set_x(left)
    figure.text(left, _TOP, headline, ha="left", va="top", fontsize=12.0, fontweight="bold")
