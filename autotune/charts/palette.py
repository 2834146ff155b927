"""Colours that everybody can distinguish, on white and on black paper (after Okabe and Ito)."""

import re
from collections.abc import Mapping

from problems.frozen import FrozenDict

COLOURS: Mapping[str, str] = FrozenDict(
    {
        "measured": "#3b4a5a",
        "model": "#d55e00",
        "before": "#7f858c",
        "after": "#0072b2",
        "target": "#009e73",
        "residual": "#cc79a7",
        "quiet": "#9fb4c7",
        "bad": "#b3261e",
        "good": "#009e73",
        "other": "#e69f00",
    }
)
# What a figure has besides its data. The hole of a map, where there is no number, is neither paper nor on the scale.
FURNITURE: Mapping[str, str] = FrozenDict(
    {"ink": "#333333", "frame": "#7a7f85", "grid": "#d9dde1", "paper": "#fefefe", "hole": "#c3c8cd"}
)
_ON_DARK: Mapping[str, str] = FrozenDict(
    {
        "measured": "#c9d4de",
        "model": "#ff8f45",
        "before": "#8a939c",
        "after": "#56b4e9",
        "target": "#2fc79a",
        "residual": "#e8a5ca",
        "quiet": "#5c7891",
        "bad": "#ff7a70",
        "good": "#2fc79a",
        "other": "#f0b93a",
        "ink": "#d3d9df",
        "frame": "#7d868e",
        "grid": "#2c343b",
        "paper": "#14181c",
        "hole": "#59626b",
    }
)
# One-sided numbers grow from dark to pale; two-sided ones have a pale middle. Maps keep their colours on any paper.
ONE_SIDED, TWO_SIDED = "viridis", "RdBu_r"
# Of a map of stability, which no page shows on dark paper.
MAP_COLOURS: Mapping[str, str] = FrozenDict(
    {"stable": "#d6e8f7", "unstable": "#e4e4e4", "hatch": "#9a9a9a", "edge": "#000000"}
)
_ON_LIGHT = {**COLOURS, **FURNITURE}
_NAMES = {colour: name for name, colour in _ON_LIGHT.items()}
_COLOUR = re.compile("|".join(sorted(_NAMES)))


def colour_variables(*, dark: bool) -> str:
    """Return the colours as declarations of a style sheet, `--draw-…`."""
    colours = _ON_DARK if dark else _ON_LIGHT
    return " ".join(f"--draw-{name}: {colour};" for name, colour in colours.items())


def named_colours(drawing: str) -> str:
    """Return a drawing whose colours are taken from the style sheet of the page that holds it."""
    return _COLOUR.sub(lambda match: f"var(--draw-{_NAMES[match[0]]})", drawing)


def dark_colours() -> dict[str, str]:
    """Return for each colour on light paper the one on dark."""
    return {colour: _ON_DARK[name] for name, colour in _ON_LIGHT.items()}
