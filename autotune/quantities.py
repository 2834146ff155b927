"""Numbers as people type them, with units as in `20:500N/mm`, with deviations as in `mass_kg=16.2±0.1`."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from autotune.errors import UsageError
from autotune.formats.units import AXES
from identification.given import Given, axis_keys
from problems.model.plant_parameters import PARAMETERS

_PER_TURN = 180.0 / math.pi
# What a unit is in SI; · and * may be between its parts or be left out.
_UNITS: Mapping[str, Mapping[str, float]] = {
    "stiffness": {"N/m": 1.0, "kN/m": 1e3, "N/mm": 1e3, "MN/m": 1e6, "kN/mm": 1e6, "N/um": 1e6, "N/µm": 1e6},
    "mass": {"kg": 1.0, "g": 1e-3, "t": 1e3},
    "rotational stiffness": {"Nm/rad": 1.0, "kNm/rad": 1e3, "Nm/deg": _PER_TURN, "Nm/mrad": 1e3, "Nmm/rad": 1e-3},
    "inertia": {"kgm²": 1.0, "kgm2": 1.0, "kgm^2": 1.0, "gm²": 1e-3, "gm2": 1e-3, "kgmm²": 1e-6, "kgmm2": 1e-6},
    "damping": {"Ns/m": 1.0, "kNs/m": 1e3, "Ns/mm": 1e3},
    "force": {"N": 1.0, "kN": 1e3},
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2},
    "rotational speed": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": 1.0 / _PER_TURN, "°/s": 1.0 / _PER_TURN},
    "torque": {"Nm": 1.0, "kNm": 1e3, "Nmm": 1e-3},
    "rotational damping": {"Nms/rad": 1.0},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "duration": {"s": 1.0, "min": 60.0, "h": 3600.0},
}
_EMPTY_GRIPPER = (
    " Even empty, the sensor carries the gripper: its mass, as identified from a log without a part, is the least; "
    "for empty and loaded give it first, for example 2,22 with a gripper of 2 kg."
)
_SHOWN = {"rotational stiffness": "N·m/rad", "inertia": "kg·m²", "damping": "N·s/m"}
_NUMBER = re.compile(
    r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[+-]?(?:inf|nan))\s*([A-Za-zµμ].*?)?\s*", re.IGNORECASE
)


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number in SI; `has_unit` where its unit was typed."""

    value: float
    has_unit: bool


def parse_quantity(text: str, kind: str) -> Quantity:
    """Return a number that may be followed by a unit of `kind` (a key of the table above).

    Raises ValueError, with a sentence, for what is no number and for a unit that is none of the kind.
    """
    number, unit = _parted(text)
    return Quantity(value=number * _factor(text, unit, kind), has_unit=unit is not None)


def parse_quantities(parts: list[str], kind: str) -> list[Quantity]:
    """Return several numbers; a unit behind the last one is that of all that have none, as in 20:500N/mm."""
    last = _parted(parts[-1])[1]
    return [parse_quantity(part if _parted(part)[1] or last is None else f"{part}{last}", kind) for part in parts]


def parse_range(parts: list[str], kind: str) -> tuple[Quantity, Quantity]:
    """Return the ends of a range of one or two numbers, as `parse_quantities`.

    Raises ValueError, with a sentence, unless they are finite, above 0 and in order.
    """
    found = parse_quantities(parts, kind)
    low, high = found[0], found[-1]
    name, both = "payload mass" if kind == "mass" else kind, f"found {low.value:g} and {high.value:g}."
    if not (0.0 < low.value < math.inf and 0.0 < high.value < math.inf):
        hint = _EMPTY_GRIPPER if kind == "mass" and low.value == 0.0 else ""
        raise ValueError(f"a {name} must be finite and above 0; {both}{hint}")
    if low.value > high.value:
        raise ValueError(f"a range of {name} must have the lower one first; {both}")
    return low, high


def _parted(text: str) -> tuple[float, str | None]:
    found = _NUMBER.fullmatch(text)
    if found is None:
        raise ValueError(f"{text!r} is not a number.")
    return float(found[1]), found[2]


def _factor(text: str, unit: str | None, kind: str) -> float:
    if unit is None:
        return 1.0
    known, plain = _UNITS.get(kind, {}), re.sub(r"[·*\s]", "", unit).replace("μ", "µ")
    if plain not in known:
        if not known:
            raise ValueError(f"{text!r} is not a number.")
        shown = ", ".join(dict.fromkeys([_SHOWN.get(kind, next(iter(known))), *known]))
        raise ValueError(f"{unit!r} in {text!r} is no unit of {kind}; known are {shown}.")
    return known[plain]


_FORM = re.compile(r"(?P<name>[a-z][a-z_.]*)=(?P<value>[^±]+?)(?:(?:±|\+-|\+/-)(?P<std>.+))?")

_MAY_VANISH = tuple(
    key
    for each in PARAMETERS.values()
    if each.may_be_zero and each.part in {"coupling", "payload", "robot"}
    for key in (each.name, each.rotational_name)
)


def parse_given(texts: Sequence[str]) -> dict[str, Given]:
    """Read priors; raise UsageError for a form, number or repetition that is none."""
    found: dict[str, Given] = {}
    for text in texts:
        match = _FORM.fullmatch(text.strip())
        if match is None:
            raise UsageError(f"--given must be NAME=VALUE±STD (or +- for ±), found {text!r}.")
        name, value, std = match["name"], _number(text, match["value"]), _number(text, match["std"] or "0")
        check_given(name, value, std, f"--given {text}")
        if name in found:
            raise UsageError(f"--given {name} is there twice; give it once.")
        found[name] = Given(value=value, std=std)
    return found


def check_given(name: str, value: float, std: float, said: str) -> None:
    """Raise UsageError for a prior of no such name or out of range; `said` is how it was given."""
    _check_name(name)
    if std < 0.0:
        raise UsageError(f"The deviation in {said} must not be negative.")
    if value < 0.0 or (value == 0.0 and not name.endswith(_MAY_VANISH)):
        raise UsageError(f"{said}: {name} must be {'at least' if value < 0.0 else 'above'} 0.")


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
