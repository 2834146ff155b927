"""What changed in a cell from one identification to the next."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from autotune.formats.units import axis_units
from identification.result import Identified
from problems.model.axis_kind import for_people
from problems.model.plant_parameters import PARAMETERS

MASS = "payload.mass_kg"
CLOCK = "clocks.wrench_offset_s"
BIAS = "sensor.force_bias_n"
_CHANGED_STDS = 3.0
# Changes below this share of the value matter to no controller, however well they are known.
_LEAST_CHANGE = 0.002
_LEAST_OFFSET_S, _LEAST_BIAS_N = 1e-4, 0.5

Values = Mapping[str, tuple[float, float]]
"""Value and standard deviation in SI, by name."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """What changed in a cell from one run to the next: `stds` deviations of the difference."""

    cell: str
    before: str
    after: str
    name: str
    old: float
    new: float
    stds: float


def identified_values(result: Identified) -> dict[str, tuple[float, float]]:
    """Return what is identified of payload, axes and surfaces; what has no value or deviation is left out."""
    named = {MASS: result.payload.mass_kg}
    for name, axis in result.axes.items():
        named |= {f"{name}.{key}": each for key, each in axis.plant_estimates().items()}
        named |= {f"{name}.{each.name}.stiffness_n_per_m": each.stiffness_n_per_m for each in axis.environments}
    return {
        name: (each.value, each.std) for name, each in named.items() if each.value is not None and each.std is not None
    }


def bias_values(result: Identified) -> dict[str, tuple[float, float]]:
    """Return the force that the sensor shows without a load, by component: of one sensor, and until it is tared."""
    bias = result.sensor.force_bias_n
    if bias.value is None or bias.std is None:
        return {}
    return {f"{BIAS}.{axis}": each for axis, each in zip("xyz", zip(bias.value, bias.std, strict=True), strict=True)}


def differences(cell: str, before: tuple[str, Values], after: tuple[str, Values]) -> Iterator[Change]:
    """Yield what differs between two named runs by more than three deviations of the difference and 0.2 %.

    Clocks differ by more than 0.1 ms, biases by more than 0.5 N: both are mostly about none.
    """
    for name in before[1]:
        if name not in after[1]:
            continue
        (old, old_std), (new, new_std) = before[1][name], after[1][name]
        std = math.hypot(old_std, new_std)
        stds = abs(new - old) / std if std > 0.0 else math.inf
        least = _LEAST_BIAS_N if name.startswith(BIAS) else _LEAST_CHANGE * abs(old)
        least = _LEAST_OFFSET_S if name == CLOCK else least
        if stds > _CHANGED_STDS and abs(new - old) > least:
            yield Change(cell=cell, before=before[0], after=after[0], name=name, old=old, new=new, stds=stds)


def drifts(cell: str, runs: Sequence[tuple[str, Values]]) -> Iterator[Change]:
    """Yield what differs between each named run and the one before it, or has crept away since it last changed."""
    last: dict[str, tuple[str, tuple[float, float]]] = {}
    since: dict[str, tuple[str, tuple[float, float]]] = {}
    for run, values in runs:
        for name, value in values.items():
            for known, of_known in (each[name] for each in (last, since) if name in each):
                if change := next(differences(cell, (known, {name: of_known}), (run, {name: value})), None):
                    since[name] = run, value
                    yield change
                    break
            last[name] = run, value
            since.setdefault(name, last[name])


def parameter_name(name: str) -> tuple[str, float, str]:
    """Return what a parameter is called for people, and factor and unit in which it is shown."""
    axis, _, key = name.rpartition(".")
    if name == MASS:
        label, unit = "payload mass", "kg"
    elif name == CLOCK:
        label, unit = "lateness of the wrench's clock", "s"
    elif axis == BIAS:
        label, unit = f"force bias {key}", "N"
    elif key in PARAMETERS:
        label, unit = f"{axis}: {PARAMETERS[key].symbol}", axis_units(axis).unit(PARAMETERS[key].kind)
    else:
        label, unit = f"{axis.replace('.', ': ')}: K_e", axis_units(axis.partition(".")[0]).stiffness
    return label, *for_people(unit)


def parameter_text(name: str, *values: float) -> tuple[str, ...]:
    """Return a parameter's name for people, its unit, and the values in that unit."""
    label, scale, unit = parameter_name(name)
    return label, unit, *(f"{scale * value:.4g}" for value in values)


def change_text(change: Change) -> str:
    """Say what changed in a cell in a sentence."""
    label, unit, old, new = parameter_text(change.name, change.old, change.new)
    runs = f"{change.cell}: from {change.before} to" if change.cell else f"Between {change.before} and"
    return f"{runs} {change.after}, {label} went from {old} to {new} {unit}, {change.stds:.1f} standard deviations."
