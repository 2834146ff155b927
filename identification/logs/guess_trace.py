"""Guess the displacement and the force of a test along one axis, with the evidence beside each guess."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray

from .names import Meaning, Named, NamedVector, path_length
from .roles.registry import Role

_STEADY, _UNSTEADY = 3.0, 3.0
_DEEPEST_M = 0.5
_BACK_SHARE = 0.25
UNLOADED_SHARE = 0.1
FORCE_UNITS = ("N", "kN", "lbf", "kgf")


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One line of a role or a table in cell.yaml: its key, its value as plain data, and why it is guessed."""

    key: str
    value: object
    evidence: str


@dataclass(frozen=True, kw_only=True)
class NamedChannel:
    """The numbers of one channel: what their names say, and their values (n, k), the columns by path."""

    topic: str
    named: Named
    columns: Mapping[str, FloatArray]

    def of(self, paths: Sequence[str]) -> FloatArray:
        """Return the numbers of these columns (n, k)."""
        return np.column_stack([self.columns[path] for path in paths])


def guess_trace(channel: NamedChannel) -> dict[Role, tuple[Entry, ...]]:
    """Guess the displacement and the force of a test along one axis, from two names or from two columns without any.

    What names say of a commanded place or a desired force along the same axis comes with them.
    """
    named = channel.named
    places, forces = (
        [each for each in named.singles if each.kind is kind] for kind in (Meaning.POSITION, Meaning.FORCE)
    )
    if len(places) == len(forces) == 1 and not named.vectors:
        place, force, why = places[0], forces[0], "by name"
    elif len(named.others) == 2 and not named.vectors and all(path.isdigit() for path in channel.columns):
        paths = sorted(named.others, key=lambda path: path_length(channel.columns[path]))
        lengths = [path_length(channel.columns[path]) for path in paths]
        if not lengths[0] < _STEADY or lengths[1] < _UNSTEADY * lengths[0]:
            return {}
        place, force = (
            NamedVector(kind=kind, paths=(path,), words=(), unit="")
            for kind, path in zip((Meaning.POSITION, Meaning.FORCE), paths, strict=True)
        )
        why = f"of two columns one goes its way {lengths[0]:.2g} times, the other, the force, {lengths[1]:.2g} times"
    else:
        return {}
    return _trace_entries(channel, place, force, why)


def _trace_entries(
    channel: NamedChannel, place: NamedVector, force: NamedVector, why: str
) -> dict[Role, tuple[Entry, ...]]:
    axis = "xyz".index(force.components or place.components or "z")
    travel, load = (channel.columns[each.paths[0]] for each in (place, force))
    topic = Entry(key="topic", value=channel.topic, evidence="")

    def along(each: NamedVector) -> list[str | None]:
        return [each.paths[0] if i == axis else None for i in range(3)]

    assumed = "" if force.components or place.components else "; along which axis is not said, z is taken"
    length = place.unit if place.unit in ("mm", "cm", "m", "in") else ""
    deepest = float(np.nanmax(np.abs(travel)))
    is_travel = _is_displacement(travel, load) or not place.components
    kind = f"a displacement{': it begins near 0' if place.components else ''}" if is_travel else "a place"
    units: dict[str, object] = {"position": length or ("mm" if deepest > _DEEPEST_M else "m")}
    pose = [
        topic,
        Entry(key="fields", value={"position": along(place)}, evidence=f"{why}{assumed}; {kind}"),
        Entry(key="units", value=units, evidence="by name" if length else f"up to {deepest:.4g}"),
    ]
    by_name = force.unit in FORCE_UNITS
    together = _is_force_along(load, travel)
    wrench = [
        topic,
        Entry(key="fields", value={"force": along(force)}, evidence=f"{why}; {span_text(channel, force.paths)}"),
        Entry(
            key="units",
            value={"force": force.unit if by_name else "N"},
            evidence="by name" if by_name else "newtons are usual",
        ),
        Entry(
            key="exerted_by",
            value="sensor" if together else "payload",
            evidence="it points where the displacement does: the tool's force on the surface"
            if together
            else "it points against the displacement: the surface's force on the tool",
        ),
    ]
    if abs(float(load[0])) < UNLOADED_SHARE * float(np.ptp(load)):
        evidence = "it begins near 0, whatever the payload weighs"
        wrench.append(Entry(key="gravity_compensated", value=True, evidence=evidence))
    roles = {Role.POSE: tuple(pose), Role.WRENCH: tuple(wrench)}
    commands = [each for each in channel.named.asked if each.kind is Meaning.POSITION]
    if len(commands) == 1 and commands[0].components == (place.components or force.components):
        fields = Entry(
            key="fields",
            value={"position": along(commands[0])},
            evidence=f"by name; {span_text(channel, commands[0].paths)}",
        )
        roles[Role.COMMAND] = (topic, fields, replace(pose[2], evidence="as of the displacement"))
    return roles


def _is_displacement(travel: FloatArray, load: FloatArray) -> bool:
    """Return whether travel (n,) is one into a surface: from near 0, where the force (n,) begins, to one side."""
    peak, length = int(np.nanargmax(np.abs(load))), float(np.ptp(travel[np.isfinite(travel)]))
    into = np.sign(travel[peak] - travel[0]) * (travel - travel[0])
    off = max(-float(np.nanmin(into)), float(into[_begins_at(load, peak)]))
    return abs(float(travel[0])) < UNLOADED_SHARE * length and off < _BACK_SHARE * length


def _begins_at(load: FloatArray, peak: int) -> int:
    """Return the last sample before the peak with hardly any force, 0 where there is none."""
    light = np.flatnonzero(np.abs(load[:peak]) < UNLOADED_SHARE * abs(load[peak]))
    return int(light[-1]) if light.size else 0


def _is_force_along(load: FloatArray, travel: FloatArray) -> bool:
    """Return whether the largest force (n,) points where the tool goes until then, from where there is hardly any."""
    peak = int(np.nanargmax(np.abs(load)))
    onset = _begins_at(load, peak)
    # A trace may begin with its peak.
    way = travel[peak] - travel[onset] if peak > onset else np.nanmean(travel - travel[0])
    return bool(load[peak] * way > 0.0)


def span_text(channel: NamedChannel, paths: Sequence[str]) -> str:
    """Return the least and the largest of these numbers as text."""
    values = channel.of(paths)
    return f"{np.nanmin(values):.4g} to {np.nanmax(values):.4g}"
