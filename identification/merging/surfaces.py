"""The surfaces of several logs under common names."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..phases import Timeline
from ..result import AxisEstimate, EnvironmentEstimate, Identified
from .values import is_told

_SAME_SURFACE_STDS = 3.0


def common_surfaces(results: Sequence[Identified]) -> list[dict[str, str]]:
    """Return for each log what its surfaces are called among those of all logs.

    Surfaces whose secant (else K_e) agrees within three deviations are one; each log has a surface at most once.
    """
    renamed: list[dict[str, str]] = [{} for _ in results]
    for axis in dict.fromkeys(name for result in results for name in result.axes):
        groups: list[dict[int, EnvironmentEstimate]] = []
        for log, result in enumerate(results):
            for surface in result.axes[axis].environments if axis in result.axes else ():
                fitting = [g for g in groups if log not in g and all(_alike(surface, other) for other in g.values())]
                if fitting:
                    fitting[0][log] = surface
                else:
                    groups.append({log: surface})
        for i, group in enumerate(groups):
            for log, surface in group.items():
                renamed[log][surface.name] = f"{axis}{i + 1}"
    return renamed


def rename_surfaces(result: Identified, names: Mapping[str, str]) -> Identified:
    """Return a result with its surfaces renamed, in the table and in the covariance."""
    return replace(result, axes={name: _renamed(axis, names) for name, axis in result.axes.items()})


def rename_timeline(line: Timeline, names: Mapping[str, str]) -> Timeline:
    """Return a time line with the surfaces of its contacts renamed."""
    phases = tuple(
        phase
        if phase.contact is None or phase.contact.surface is None
        else replace(
            phase, contact=replace(phase.contact, surface=names.get(phase.contact.surface, phase.contact.surface))
        )
        for phase in line.phases
    )
    return replace(line, phases=phases)


def rename_in_text(text: str, names: Mapping[str, str]) -> str:
    """Return a message with the surfaces that it names under their common names."""
    return re.sub(r"\b\w+\b", lambda word: names.get(word[0], word[0]), text)


def _renamed(axis: AxisEstimate, names: Mapping[str, str]) -> AxisEstimate:
    covariance = axis.covariance
    if covariance is not None:
        covariance = replace(covariance, names=tuple(_symbol(symbol, names) for symbol in covariance.names))
    surfaces = tuple(replace(s, name=names.get(s.name, s.name)) for s in axis.environments)
    return replace(axis, environments=surfaces, covariance=covariance)


def _symbol(symbol: str, names: Mapping[str, str]) -> str:
    surface, dot, kind = symbol.rpartition(".")
    return f"{names.get(surface, surface)}{dot}{kind}"


def _alike(one: EnvironmentEstimate, other: EnvironmentEstimate) -> bool:
    first, second = one.secant_stiffness_n_per_m, other.secant_stiffness_n_per_m
    if not is_told(first) or not is_told(second):
        first, second = one.stiffness_n_per_m, other.stiffness_n_per_m
    if first.value is None or second.value is None or first.std is None or second.std is None:
        return False
    return abs(first.value - second.value) <= _SAME_SURFACE_STDS * float(np.hypot(first.std, second.std))
