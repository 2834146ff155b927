"""What the user asks of a map, and how a range and a setting are written: NAME=LO:HI[:N][:log|lin], NAME=VALUE."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from autotune.errors import UsageError
from autotune.quantities import parse_quantities
from problems.errors import ParameterError
from problems.maps.loops import Where
from problems.maps.maps import MapAxis, Spacing
from problems.maps.parameters import MapParameter, MapQuantity, find_parameter

STABLE_DAMPING, STABLE_LEAD = "stable-damping", "stable-lead"
PICTURES, TABLES = (".png", ".svg"), (".csv", ".json")

# Of translational axes; about the others a number is in SI.
_KINDS = {"kg": "mass", "N/m": "stiffness", "N·s/m": "damping", "s": "time"}
_SPACINGS: dict[str, Spacing] = {"lin": "linear", "log": "log"}
# Ranges that cover this factor are spaced by equal ratios unless given otherwise.
_WIDE = 10.0


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """The request as it was typed; None or empty where nothing was said."""

    source: Path
    picture: Path
    data: Path | None = None
    axis: str | None = None
    controller: Path | None = None
    show: str = MapQuantity.STABILITY.value
    where: Where = "both"
    x: str | None = None
    y: str | None = None
    search: str | None = None
    settings: Sequence[str] = ()
    approach_force: float | None = None

    @property
    def table(self) -> Path:
        """Where the data goes: beside the picture unless given otherwise."""
        return self.picture.with_suffix(".csv") if self.data is None else self.data


def check_targets(options: MapOptions) -> None:
    """Raise UsageError for a picture or data file that cannot be what its suffix says, or that is an input."""
    for path, suffixes, what in ((options.picture, PICTURES, "the picture"), (options.table, TABLES, "the data file")):
        if path.suffix.lower() not in suffixes:
            raise UsageError(f"{what} must end in {' or '.join(suffixes)}, found {path.name}.")
        for given in (options.source, options.controller):
            if given is not None and path.resolve() == given.resolve():
                raise UsageError(f"{path} is the file that is read; name another one for {what}.")


def parse_range(text: str, *, count: int) -> MapAxis:
    """Return the axis that NAME=LO:HI[:N][:log|lin] says; `count` is N where none is said.

    Without a spacing, a range that covers a factor of 10 or more is logarithmic. Raises UsageError.
    """
    name, separator, rest = text.partition("=")
    return _axis(text, _parameter(name), rest.split(":") if separator else [], count)


def parse_search(text: str, name: str, *, count: int) -> MapAxis:
    """Return the axis of a known parameter that LO:HI[:N][:log|lin] says; as `parse_range`."""
    return _axis(text, find_parameter(name), text.split(":"), count)


def parse_settings(texts: Sequence[str]) -> dict[str, float]:
    """Return the values that a list of NAME=VALUE sets; raises UsageError."""
    found: dict[str, float] = {}
    for text in texts:
        name, separator, value = text.partition("=")
        if not separator:
            raise UsageError(f"a setting must be NAME=VALUE, found {text!r}.")
        parameter = _parameter(name)
        if parameter.name in found:
            raise UsageError(f"{parameter.name} is set twice.")
        found[parameter.name] = _numbers([value], parameter, text)[0]
        _check_value(parameter, found[parameter.name])
    return found


def _check_value(parameter: MapParameter, value: float) -> None:
    if not math.isfinite(value) or value < 0.0 or (value == 0.0 and not parameter.may_be_zero):
        raise ParameterError(parameter.name, value, f"finite and {'not below' if parameter.may_be_zero else 'above'} 0")


def _axis(text: str, parameter: MapParameter, parts: Sequence[str], count: int) -> MapAxis:
    words = list(parts)
    spacing = _SPACINGS.get(words[-1].strip().lower()) if words else None
    if spacing is not None:
        words.pop()
    if len(words) not in {2, 3}:
        raise UsageError(f"a range must be NAME=LOW:HIGH[:N][:log|lin], found {text!r}.")
    low, high = _numbers(words[:2], parameter, text)
    if spacing is None:
        spacing = "log" if low > 0.0 and high >= _WIDE * low else "linear"
    if len(words) == 3:
        count = _whole(words[2], text)
    try:
        return MapAxis(name=parameter.name, low=low, high=high, count=count, spacing=spacing)
    except ParameterError as error:
        raise UsageError(f"{text!r}: {error}") from error


def _parameter(name: str) -> MapParameter:
    try:
        return find_parameter(name.strip())
    except ParameterError as error:
        raise UsageError(str(error)) from error


def _numbers(words: list[str], parameter: MapParameter, text: str) -> list[float]:
    """Return numbers with or without the unit of a parameter; one behind the last is that of all."""
    try:
        return [each.value for each in parse_quantities(words, _KINDS.get(parameter.unit, "number"))]
    except ValueError as error:
        raise UsageError(str(error).replace(" is not a number", f" in {text!r} is not a number")) from None


def _whole(word: str, text: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise UsageError(f"{word!r} in {text!r} must be how many values, a whole number, or log or lin.") from None
