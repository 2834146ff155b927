"""What the command line gives beside a log: `mass_kg=16.2±0.1`."""

import math
import re
from collections.abc import Sequence

from autotune.errors import UsageError
from autotune.formats.records import AXES
from identification.given import Given, axis_keys

_FORM = re.compile(r"(?P<name>[a-z][a-z_.]*)=(?P<value>[^±]+?)(?:(?:±|\+-|\+/-)(?P<std>.+))?")

_MAY_VANISH = (
    "delay_s",
    "coupling_damping_n_s_per_m",
    "coupling_damping_n_m_s_per_rad",
    "drag_n_s_per_m",
    "drag_n_m_s_per_rad",
)


def parse_given(texts: Sequence[str]) -> dict[str, Given]:
    """Read priors; raise UsageError for a form, number or repetition that is none."""
    found: dict[str, Given] = {}
    for text in texts:
        match = _FORM.fullmatch(text.strip())
        if match is None:
            raise UsageError(f"--given must be NAME=VALUE±STD (or +- for ±), found {text!r}.")
        name, value, std = match["name"], _number(text, match["value"]), _number(text, match["std"] or "0")
        _check_name(name)
        if std < 0.0:
            raise UsageError(f"The deviation in --given {text} must not be negative.")
        if value < 0.0 or (value == 0.0 and not name.endswith(_MAY_VANISH)):
            raise UsageError(f"--given {text}: {name} must be {'at least' if value < 0.0 else 'above'} 0.")
        if name in found:
            raise UsageError(f"--given {name} stands there twice; give it once.")
        found[name] = Given(value=value, std=std)
    return found


def _check_name(name: str) -> None:
    axis, _, key = name.rpartition(".")
    if name in ("mass_kg", "sample_time_s") or (axis in AXES and key in axis_keys(axis)):
        return
    known = ", ".join(
        ["mass_kg", "sample_time_s", *(f"{axis if axis in AXES else 'x'}.{key}" for key in axis_keys(axis))]
    )
    raise UsageError(f"Nothing called {name} can be given; what can: {known}.")


def _number(text: str, written: str) -> float:
    try:
        value = float(written)
    except ValueError as error:
        raise UsageError(f"--given {text} must hold numbers, found {written.strip()!r}.") from error
    if not math.isfinite(value):
        raise UsageError(f"--given {text} must hold finite numbers, found {written.strip()!r}.")
    return value
