"""The ends of a panel's sides: the same force scale beside each other, and circles that are round."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from .charts import Band, Limit, Line, Panel, Points

Span = tuple[float, float]
_AIR = 0.06


def level_panels(panels: Sequence[Panel]) -> tuple[Panel, ...]:
    """Return panels that stand beside each other with one scale for y, which holds what any of them shows."""
    values = np.concatenate([each for panel in panels for each in _heights(panel)])
    values = values[np.isfinite(values)]
    low, high = float(np.min(values, initial=0.0)), float(np.max(values, initial=0.0))
    air = _AIR * (high - low) or 1.0
    ends = (low - air if low < 0.0 else 0.0, high + air if high > 0.0 else 0.0)
    return tuple(replace(panel, y=replace(panel.y, limits=ends)) for panel in panels)


def _heights(panel: Panel) -> Iterator[np.ndarray]:
    for element in panel.elements:
        if isinstance(element, Line | Points):
            yield element.y
        elif isinstance(element, Band):
            yield element.low
            yield element.high
        elif isinstance(element, Limit) and element.along == "y":
            yield np.array([element.value])


def fitted_limits(x: Span, y: Span, shape: float) -> tuple[Span, Span]:
    """Return limits that hold the given ones and have the same length per unit in both; `shape` is width by height."""
    wide, high = x[1] - x[0], y[1] - y[0]
    return _widened(x, max(wide, high * shape)), _widened(y, max(high, wide / shape))


def _widened(span: Span, length: float) -> Span:
    middle = 0.5 * (span[0] + span[1])
    return middle - 0.5 * length, middle + 0.5 * length
