"""The picture of a map over two parameters."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from problems.maps.maps import MapPoint, MapResult, distance_at_boundary
from problems.maps.parameters import MapQuantity

from .plan import MapPlan
from .style import HATCH_COLOUR, STABLE_COLOUR, UNSTABLE_COLOUR, axis_label, log_ticks, set_axis, title, told
from .text import WHERE, number, with_unit

FloatArray = NDArray[np.float64]

_SIZE_INCHES = (7.6, 5.6)
# Beyond this multiple of what nearly all points have, a value would only take the colours from the others.
_OUTLYING, _NEARLY_ALL = 1.5, 97.0
_WIDE = 8.0
_LEVELS = 7
_FAR = 1.0
_ON_THE_EDGE = 1e-15


def draw_map(plan: MapPlan, result: MapResult, design: MapPoint | None) -> Figure:
    """Draw values or stability, the boundary, and the design if it lies inside the ranges."""
    figure = Figure(figsize=_SIZE_INCHES, layout="constrained")
    axes = figure.add_subplot()
    request, quantity = result.request, result.request.quantity
    x, y = request.x.values(), request.y.values()
    set_axis(axes, "x", request.x, axis_label(plan, request.x.parameter))
    set_axis(axes, "y", request.y, axis_label(plan, request.y.parameter))
    handles: list[Any] = []
    if quantity is MapQuantity.STABILITY:
        axes.set_facecolor(STABLE_COLOUR)
        handles.append(Patch(facecolor=STABLE_COLOUR, edgecolor="0.6", label="stable"))
    elif np.any(result.is_stable):
        _draw_values(figure, axes, plan, result, x, y)
    _draw_unstable(axes, result, x, y)
    if not np.all(result.is_stable):
        hatched: dict[str, Any] = {"facecolor": UNSTABLE_COLOUR, "edgecolor": HATCH_COLOUR, "hatch": "////"}
        handles.append(Patch(**hatched, linewidth=0.0, label="unstable"))
        if np.any(result.is_stable):
            handles.append(Line2D([], [], color="black", linewidth=1.4, label="limit of stability"))
    if design is not None:
        handles.append(_draw_design(axes, plan, quantity, design))
    if handles:
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=9.0)
    headline = f"{quantity.label.capitalize()} {WHERE[request.where]}"
    if quantity.is_peak:
        headline = f"{quantity.label.capitalize()} of the transient"
    title(figure, headline, told(plan, request.approach if quantity.is_peak else None))
    return figure


def shown(plan: MapPlan, quantity: MapQuantity) -> tuple[float, str]:
    """Return factor and unit in which a picture shows a quantity: delays are told in milliseconds."""
    if quantity is MapQuantity.DELAY:
        return 1e3, "ms"
    return 1.0, quantity.unit_of(rotational=plan.source.is_rotational)


def _draw_values(figure: Figure, axes: Axes, plan: MapPlan, result: MapResult, x: FloatArray, y: FloatArray) -> None:
    quantity = result.request.quantity
    factor, unit = shown(plan, quantity)
    values = result.values * factor
    usual = values[np.isfinite(values)]
    if not len(usual):
        return
    norm, extend = _norm(quantity, usual, bool(np.any(np.isposinf(values))))
    clipped = np.minimum(_filled(values, result.is_stable), norm.vmax or 1.0)
    clipped = np.maximum(clipped, norm.vmin or 0.0)
    colours = "viridis_r" if quantity.is_peak else "viridis"
    mesh = axes.pcolormesh(x, y, clipped, norm=norm, cmap=colours, shading="gouraud", rasterized=True)
    bar = figure.colorbar(mesh, ax=axes, extend=extend, pad=0.02)
    bar.set_label(quantity.label + (f" [{unit}]" if unit else ""))
    if isinstance(norm, LogNorm):
        log_ticks(bar.ax.yaxis, float(norm.vmin or 1.0), float(norm.vmax or 1.0))
        bar.minorticks_off()
        levels = np.array(
            LogLocator(subs=(1.0, 2.0, 5.0)).tick_values(float(norm.vmin or 1.0), float(norm.vmax or 1.0))
        )
    else:
        levels = np.array(MaxNLocator(_LEVELS).tick_values(float(norm.vmin or 0.0), float(norm.vmax or 1.0)))
    inside = levels[(levels > np.min(usual)) & (levels < min(np.max(usual), float(norm.vmax or 1.0)))]
    if len(inside):
        finite = np.ma.masked_invalid(values)
        lines = axes.contour(x, y, finite, levels=inside, colors="white", linewidths=0.7, alpha=0.75)
        axes.clabel(lines, fontsize=7.5, fmt=lambda value: f"{value:.3g}")


def _norm(quantity: MapQuantity, usual: FloatArray, unlimited: bool) -> tuple[Normalize, str]:
    """Return the scale of the colours, and at which ends values lie beyond it.

    A peak or a delay that varies much is told by its order of magnitude; margins begin at 0.
    """
    low, high = float(np.min(usual)), float(np.max(usual))
    most = float(np.percentile(usual, _NEARLY_ALL))
    above = unlimited or high > _OUTLYING * most
    high = most if high > _OUTLYING * most else high
    below = False
    is_log = quantity.is_peak and low > 0.0 and high > _WIDE * low
    if quantity is MapQuantity.DELAY and high > 0.0:
        least = float(np.percentile(usual, 100.0 - _NEARLY_ALL))
        is_log, below, low = True, low < least, least
    elif not quantity.is_peak:
        low = 0.0
    if not high > low:
        high = low + (abs(low) or 1.0) * 1e-3
    extend = ("both" if above else "min") if below else ("max" if above else "neither")
    return (LogNorm(low, high) if is_log else Normalize(low, high)), extend


def _filled(values: FloatArray, stable: NDArray[np.bool_]) -> FloatArray:
    """Let the nearest stable value stand for an unstable one: the grey over it hides it, and the colours meet it."""
    good = stable & ~np.isnan(values)
    _, nearest = distance_transform_edt(~good, return_indices=True)
    return np.asarray(values[tuple(nearest)])


def _draw_unstable(axes: Axes, result: MapResult, x: FloatArray, y: FloatArray) -> None:
    if np.all(result.is_stable):
        return
    if not np.any(result.is_stable):
        axes.set_facecolor(UNSTABLE_COLOUR)
        axes.patch.set_hatch("////")
        axes.text(0.5, 0.5, "unstable everywhere", transform=axes.transAxes, ha="center", backgroundcolor="white")
        return
    distance = distance_at_boundary(result)
    far = np.where(result.is_stable, -_FAR, _FAR)
    # A loop on the edge itself must still lie on one side of it.
    near = np.copysign(np.maximum(np.abs(distance), _ON_THE_EDGE), far)
    field = np.where(np.isnan(distance), far, near)
    axes.contourf(x, y, field, levels=[0.0, np.inf], colors=[UNSTABLE_COLOUR], hatches=["////"])
    axes.contour(x, y, field, levels=[0.0], colors="black", linewidths=1.4)


def _draw_design(axes: Axes, plan: MapPlan, quantity: MapQuantity, design: MapPoint) -> Line2D:
    factor, unit = shown(plan, quantity)
    if not design.is_stable:
        label = "design: unstable"
    elif quantity is MapQuantity.STABILITY:
        label = "design: stable"
    else:
        label = (
            with_unit(f"design: {number(design.value * factor)}", unit)
            if np.isfinite(design.value)
            else "design: no limit"
        )
    marker: dict[str, Any] = {
        "marker": "o",
        "markersize": 8.0,
        "markerfacecolor": "#d55e00",
        "markeredgecolor": "white",
    }
    axes.plot([design.x], [design.y], linestyle="none", zorder=5, clip_on=False, **marker)
    return Line2D([], [], linestyle="none", label=label, **marker)
