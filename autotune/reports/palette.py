"""Colours that can be told apart by everybody, on white and on black paper (after Okabe and Ito)."""

from collections.abc import Mapping
from types import MappingProxyType

COLOURS: Mapping[str, str] = MappingProxyType(
    {
        "measured": "#3b4a5a",
        "model": "#d55e00",
        "before": "#8a8f96",
        "after": "#0072b2",
        "target": "#009e73",
        "residual": "#cc79a7",
        "quiet": "#9fb4c7",
        "bad": "#b3261e",
        "good": "#009e73",
        "other": "#e69f00",
    }
)
# One-sided numbers grow from pale to dark; two-sided ones have a pale middle.
ONE_SIDED, TWO_SIDED = "viridis", "RdBu_r"
