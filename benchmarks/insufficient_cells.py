"""Logs that do not suffice: each lacks what one parameter needs, and identification has to say so."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np

from autotune.simulation import simulate as cell_simulation
from autotune.simulation.phases import Program, Script, build_script
from benchmarks.cells import DrawnCell, Writing, simulate
from identification.signals.recording import Recording

_TILT_2_DEG = np.radians(2.0)
_HAND_N, _HAND_HZ = 15.0, 1.3


@dataclass(frozen=True, kw_only=True)
class Untold:
    """A case: what it is called, which parameters it must not claim, how the drawn cell is changed and simulated."""

    name: str
    hidden: tuple[str, ...]
    changed: Callable[[DrawnCell], DrawnCell]
    simulated: Callable[[DrawnCell], Recording] = simulate


def _with(**changes: Any) -> Callable[[DrawnCell], DrawnCell]:
    def changed(drawn: DrawnCell) -> DrawnCell:
        return replace(drawn, program=replace(drawn.program, **changes), writing=_plain(drawn.writing))

    return changed


def _plain(writing: Writing) -> Writing:
    """Return a writing without anything else that could be the reason for a refusal."""
    return replace(writing, container="mcap", pose_every=1, wrench_every=1, lost_share=0.0, gap_periods=0)


def _simulate_with_hand(drawn: DrawnCell) -> Recording:
    """Let a hand hold on to the payload during the contacts: a steady pull, swaying."""

    def script_with_hand(program: Program, sample_time_s: float, rng: np.random.Generator) -> Script:
        script = build_script(program, sample_time_s, rng)
        time = np.arange(len(script)) * sample_time_s
        hand = _HAND_N * (1.0 + 0.5 * np.sin(2.0 * np.pi * _HAND_HZ * time))
        pressing = script.desired_force_n > 0.0
        return replace(script, hand_force_n=script.hand_force_n + np.where(pressing, hand, 0.0))

    with mock.patch.object(cell_simulation, "build_script", script_with_hand):
        return simulate(drawn)


def _one_surface(drawn: DrawnCell) -> DrawnCell:
    return _with()(replace(drawn, surfaces=drawn.surfaces[:1]))


def _no_contact(drawn: DrawnCell) -> DrawnCell:
    return _with(contact_count=0)(replace(drawn, surfaces=drawn.surfaces[:1]))


GRAVITY = ("mass", "centre of mass")
CONTACT = ("K_e", "secant", "B_e", "M_e")
CASES = (
    Untold(name="one pose", hidden=GRAVITY, changed=_with(pose_count=1)),
    Untold(name="poses tilted by 2 degrees", hidden=GRAVITY, changed=_with(tilts_rad=(_TILT_2_DEG, _TILT_2_DEG))),
    Untold(name="no contact", hidden=CONTACT, changed=_no_contact),
    Untold(name="no free motion", hidden=("K_s", "B_s", "B_p"), changed=_with(jogging_s=0.0, sweep_s=0.0)),
    Untold(
        name="a hand on the payload in contact", hidden=("K_e",), changed=_one_surface, simulated=_simulate_with_hand
    ),
)
