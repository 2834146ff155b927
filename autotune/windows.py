"""Windows of a long log: what each of them identifies, what changed between them, and which of them give the result."""

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from autotune.drift import MASS, Change, Values, change_text, differences, drifts, parameter_name
from autotune.quantities import parse_quantity
from autotune.text import clock_text, with_deviation
from identification.errors import EstimateError
from identification.result import Finding

_SHORTEST_S = 20.0
_LONGEST_S = 1e7  # 116 days
"""A window must hold a few poses at rest, a sweep or a contact."""
_MOST_USED = 8
_OF_A_SURFACE, _OF_A_COUPLING = ".stiffness_n_per_m", ".coupling_stiffness_n_per_m"
# Contacts of one surface in other places differ by some percent.
_OTHER_STDS, _OTHER_SHARE = 3.0, 0.05


@dataclass(frozen=True, kw_only=True)
class Window:
    """A part of a long log, from `start_s` to `stop_s` after its first message on the recording clock.

    `log` names it where there are several.
    `has_pauses` says that the recorder paused in it, or that messages are lost; what lies around them is not used.
    `values` are value and standard deviation in SI of what it identifies, by name; `refused` says why there is nothing,
    `is_used` whether it is one of those that give the result. `payload_from` names the window whose payload was taken
    in the place of its own; the values hold that too. `changed` says what changed within it, or where it begins.
    """

    start_s: float
    stop_s: float
    log: str = ""
    values: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    refused: str = ""
    is_used: bool = False
    has_pauses: bool = False
    payload_from: str = ""
    changed: str = ""

    @property
    def name(self) -> str:
        """How people find it in the log."""
        return f"{self.log} {clock_text(self.start_s)} to {clock_text(self.stop_s)}".lstrip()

    def tree(self) -> dict[str, Any]:
        """Return it as plain data for the provenance."""
        values = {name: list(each) for name, each in self.values.items()}
        refused = {"refused": self.refused} if self.refused else {}
        log = ({"log": self.log} if self.log else {}) | ({"pauses": True} if self.has_pauses else {})
        log |= {name: text for name in ("payload_from", "changed") if (text := getattr(self, name))}
        return {**log, "from_s": self.start_s, "to_s": self.stop_s, "used": self.is_used, **refused, "values": values}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> "Window":
        """Return the window that a provenance holds."""
        values = {name: (float(value), float(std)) for name, (value, std) in tree["values"].items()}
        start_s, stop_s = float(tree["from_s"]), float(tree["to_s"])
        said = {
            "log": tree.get("log", ""),
            "refused": tree.get("refused", ""),
            "is_used": bool(tree["used"]),
            "has_pauses": bool(tree.get("pauses")),
            "payload_from": tree.get("payload_from", ""),
            "changed": tree.get("changed", ""),
        }
        return cls(start_s=start_s, stop_s=stop_s, values=values, **said)


def window_length_s(said: float | str) -> float:
    """Return the length of windows [s] out of a number or a text as `10min`; raises ValueError where it is none."""
    seconds = parse_quantity(str(said), "duration").value
    if not _SHORTEST_S <= seconds <= _LONGEST_S:
        raise ValueError(f"must be from {_SHORTEST_S:g} s to {_LONGEST_S:g} s, for example 10min.")
    return seconds


def windows_of(provenance: Mapping[str, Any]) -> tuple[Window, ...]:
    """Return the windows in which a plant was identified; none where the log was read as a whole."""
    return tuple(map(Window.from_tree, provenance.get("windows", ())))


def most_telling(windows: Sequence[Window]) -> tuple[int, ...]:
    """Return which windows give the result: of the largest set that agrees, those that say most and say it best.

    Windows agree where payload, coupling and robot do; a surface may be another one. Of equally large sets the one with
    the later windows is taken.

    Raises EstimateError where no window identifies anything.
    """
    having = [k for k, each in enumerate(windows) if each.values]
    if not having:
        reasons = Counter(each.refused or "what is needed is not in it" for each in windows)
        reason, count = reasons.most_common(1)[0]
        raise EstimateError(f"Of {len(windows)} windows none identifies anything, {count} of them since: {reason}")
    ranked = sorted(having, key=lambda k: _unsure(windows[k].values))
    plants = {k: _plant(windows[k].values) for k in having}
    pairs = itertools.product(having, having)
    agree = {(i, j): not any(differences("", ("", plants[i]), ("", plants[j]))) for i, j in pairs}
    sets = []
    for first in ranked:
        chosen = [first]
        for k in ranked:
            if k != first and all(agree[k, other] for other in chosen):
                chosen.append(k)
        sets.append(chosen)
    agreeing = max(sets, key=lambda each: (len(each), max(each)))
    chosen = [k for k in ranked if k in agreeing]
    weighing = [k for k in chosen if MASS in windows[k].values and not windows[k].payload_from]
    # What the payload of a window without its own is from takes part.
    if weighing and weighing[0] not in chosen[:_MOST_USED]:
        chosen.insert(_MOST_USED - 1, weighing[0])
    return tuple(sorted(chosen[:_MOST_USED]))


def axes_shown(used: Sequence[Window]) -> tuple[frozenset[str], tuple[str, ...]]:
    """Return the axes of which windows show coupling or a surface, and those of which they show less.

    A motion among hundreds of windows can look like the sweep of an axis that nobody swept. Where no axis shows its
    coupling or a surface, all are of the first kind.
    """
    names = [name for window in used for name in window.values if name != MASS]
    every = dict.fromkeys(name.partition(".")[0] for name in names)
    shown = {name.partition(".")[0] for name in names if name.endswith((_OF_A_COUPLING, _OF_A_SURFACE))}
    return frozenset(shown or every), tuple(axis for axis in every if shown and axis not in shown)


def _plant(values: Values) -> dict[str, tuple[float, float]]:
    return {name: each for name, each in values.items() if not name.endswith(_OF_A_SURFACE)}


def _unsure(values: Values) -> tuple[int, float]:
    """Return what sorts windows: first those with many values, then those with small relative deviations."""
    shares = [std / abs(value) for value, std in values.values() if value]
    return -len(values), float(np.median(shares)) if shares else 0.0


def window_changes(windows: Sequence[Window]) -> tuple[Change, ...]:
    """Return what changed in the plant from a window that identifies something to a later one."""
    return tuple(drifts("", [(each.name, _own(each)) for each in windows]))


def new_surfaces(windows: Sequence[Window]) -> tuple[str, ...]:
    """Return a sentence on each surface that no earlier window has touched, but for the first of an axis."""
    seen: dict[str, list[tuple[float, float]]] = {}
    said = []
    for window in windows:
        for name in (name for name in window.values if name.endswith(_OF_A_SURFACE)):
            axis, (value, std) = name.partition(".")[0], window.values[name]
            known = seen.setdefault(axis, [])
            if not all(_is_another((value, std), each) for each in known):
                continue
            _, scale, unit = parameter_name(name)
            others = ", ".join(f"{scale * each:.3g}" for each, _ in known)
            text = f"{window.name}: on axis {axis} a surface of {scale * value:.3g} {unit} is touched that no window"
            said += [f"{text} before has touched ({others} {unit})."] if known else []
            known.append((value, std))
    return tuple(said)


def _is_another(one: tuple[float, float], other: tuple[float, float]) -> bool:
    apart = abs(one[0] - other[0])
    return apart > _OTHER_STDS * math.hypot(one[1], other[1]) and apart > _OTHER_SHARE * other[0]


def _own(window: Window) -> dict[str, tuple[float, float]]:
    """Return what a window itself shows of the plant."""
    return {name: each for name, each in _plant(window.values).items() if not (name == MASS and window.payload_from)}


def window_columns() -> tuple[str, ...]:
    """Return the columns of a table of windows."""
    return "window", "payload mass [kg]", "± std", "identified", "use"


def window_rows(windows: Sequence[Window]) -> tuple[tuple[str, ...], ...]:
    """Return a row of each window; those that are refused one after the other for the same reason are one row."""
    rows: list[tuple[str, ...]] = []
    for refused, group in itertools.groupby(windows, key=lambda each: each.refused):
        held = list(group)
        if refused:
            name = f"{held[0].name.partition(' to ')[0]} to {held[-1].name.rpartition(' to ')[2]}"
            rows.append((f"{name} ({len(held)})" if len(held) > 1 else name, "-", "-", "0", refused))
            continue
        for each in held:
            mass = with_deviation(*each.values[MASS]) if MASS in each.values else ("-", "-")
            rows.append((each.name, *mass, str(len(each.values)), use_text(each)))
    return tuple(rows)


def use_text(window: Window) -> str:
    """Say whether a window gives the result, and whose payload it was read with."""
    payload = f"payload from {window.payload_from}" if window.payload_from else ""
    if window.refused or not window.values:
        return window.refused or "nothing known of it"
    return ", ".join(filter(None, ("gives the result" if window.is_used else "", payload)))


def window_findings(windows: Sequence[Window]) -> tuple[Finding, ...]:
    """Report what changed within a log, and how many windows gave the result."""
    used, silent = [each for each in windows if each.is_used], sum(not each.values for each in windows)
    pauses = sum(each.has_pauses for each in used)
    taken = sum(bool(each.payload_from) for each in windows)
    shared = f" {taken} have too few poses: their payload is that of the nearest that shows it." if taken else ""
    seen = [each.changed for each in windows if each.changed]
    changed = [*seen, *map(change_text, window_changes(windows))]
    left_out = [
        Finding.warning(
            "axis-left-out",
            f"Axis {axis}: a motion like a sweep is in a window, but none of those that give the result identifies its "
            "coupling or a surface, so that it is left out.",
            "Sweep about this axis, or press along it, where it is to be tuned.",
        )
        for axis in axes_shown(used)[1]
    ]
    advice = "Record each payload on its own where this was no drift; the result is of the windows that agree."
    return (
        *(Finding.warning("changed-within-log", text, advice) for text in changed),
        *left_out,
        *(Finding.info("surface-within-log", text, "") for text in new_surfaces(windows)),
        Finding.info(
            "windows",
            f"Of {len(windows)} windows {len(used)} give the result ({', '.join(each.name for each in used)}); "
            f"{silent} identify nothing; in {pauses} of those used the recorder paused or lost messages.{shared}",
            "",
        ),
    )
