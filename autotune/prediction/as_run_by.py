"""What an export target runs in place of our own law, as the file that was designed for it holds it."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

from autotune.formats.controller_record import Controller, PeakPerSpeed
from autotune.formats.units import axis_units
from autotune.shown import plain_tree
from problems.design.requirements import Hand
from problems.model.linear_controllers import LinearController
from problems.text import rounded_down

from .contact import AnyLaw, TargetLaw
from .law import law_of

_KEY = "as_run_by"
_ARRAYS, _FLAGS = ("matrix", "rest", "approach"), ("holds_position", "follows_position")


@dataclass(frozen=True, kw_only=True)
class AsRunBy:
    """What an export target runs on one axis and was certified to do; peaks at the contact [N, N·m].

    `parameters` are the numbers as written into its file, `hand_force` the
    force over steady speed in free motion [N·s/m, N·m·s/rad], `least_admittance` over the band asked [m/s/N,
    rad/s/(N·m)], `margins` by name with None for no limit, `peak_per_speed` the peaks of a payload that is led by
    hand, None in files of an earlier release.
    """

    target: str
    parameters: Mapping[str, float]
    peak: float
    hand_force: float
    least_admittance: float
    margins: Mapping[str, float | None]
    law: LinearController
    peak_per_speed: PeakPerSpeed | None = None

    def text(self, axis: str) -> str:
        """Say what is certified."""
        return f"certified as {self.target} runs it: at most {self.peak:.1f} {axis_units(axis).force} at the contact"


def with_target(
    controller: Controller,
    target: str,
    exported: Mapping[str, Mapping[str, Any]],
    laws: Mapping[str, LinearController],
    led: Mapping[str, PeakPerSpeed],
) -> Controller:
    """Return a controller whose provenance holds what the target that it was designed for runs.

    `exported` is what an export says of each axis, `laws` are those that it certified, `led` are their peaks of a
    payload that is led by hand.
    """
    axes = {}
    for name, each in exported.items():
        law = plain_tree(laws[name])
        axes[name] = {
            "parameters": dict(each["parameters"]),
            "peak": each["peak_contact_force"],
            "hand_force": each["hand_force"],
            "least_admittance": each["least_admittance"],
            "margins": dict(each["margins"]),
            "law": {key: law[key] for key in (*_ARRAYS, *_FLAGS)},
            "peak_per_speed": asdict(led[name]),
        }
    return replace(controller, provenance={**controller.provenance, _KEY: {"target": target, "axes": axes}})


def designed_for(controller: Controller) -> str:
    """Return the export target that a file was designed for, "" for none."""
    return str(controller.provenance.get(_KEY, {}).get("target", ""))


def as_run_by(controller: Controller, axis: str) -> AsRunBy | None:
    """Return what a target runs on an axis of a file that was designed for one, None for other files."""
    said = controller.provenance.get(_KEY, {})
    if axis not in said.get("axes", {}):
        return None
    tree = dict(said["axes"][axis])
    law = LinearController(**tree.pop("law"), sample_time_s=controller.sample_time_s)
    led = tree.pop("peak_per_speed", None)
    return AsRunBy(target=said["target"], law=law, peak_per_speed=led and PeakPerSpeed(**led), **tree)


def led_speed_text(controller: Controller, name: str, force: float, hand: Hand) -> str:
    """Return up to which speed [m/s, rad/s] a payload led by hand does not exceed `force` [N, N·m]: "0.12".

    Where our own law goes no faster anyway, it is the limit of the command that is named: "0.3*".
    """
    found = peak_per_speed(controller, name)
    return capped_speed_text(controller, name, math.inf if found is None else found.largest_speed(force, hand))


def capped_speed_text(controller: Controller, name: str, speed: float) -> str:
    """Return a speed that is safe [m/s, rad/s], rounded down, or the limit of the command with a star: "0.3*"."""
    limits = controller.limits
    if limits is None or designed_for(controller) or speed < limits.axes[name].speed:
        return f"{rounded_down(speed):g}"
    return f"{limits.axes[name].speed:g}*"


def peak_per_speed(controller: Controller, axis: str) -> PeakPerSpeed | None:
    """Return the peaks per speed of a payload that is led by hand, under the law that runs in the cell."""
    target = as_run_by(controller, axis)
    return controller.predicted[axis].peak_per_speed if target is None else target.peak_per_speed


def running_law(controller: Controller, axis: str) -> AnyLaw:
    """Return the law that runs in the cell: that of the target which the file was designed for, else our own.

    Raises UsageError for an axis that the file does not hold.
    """
    own, target = law_of(controller, axis), as_run_by(controller, axis)
    return own if target is None else TargetLaw(controller=target.law, target=target.target)


def own_law_notes(controller: Controller) -> Iterator[str]:
    """Yield, of a file that was designed for a target, that figures are of our own law, and what the target does."""
    target = designed_for(controller)
    if target:
        found = ((axis, as_run_by(controller, axis)) for axis in controller.axes)
        does = "; ".join(f"axis {axis}: {each.text(axis)}" for axis, each in found if each is not None)
        yield f"these are gains and figures of our own law, from which that of {target} was made; {does}"
