"""A program that is repeated turns the tool again and again from one rest to another: that is no sweep."""

from dataclasses import fields, replace
from typing import Any

import numpy as np

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.advice import advise
from identification.identify import identify_cell
from identification.signals.recording import PoseSignal, WrenchSignal

_TIMES = 4
_PAUSE_NS = 2 * 10**9


def repeated(signal: PoseSignal | WrenchSignal, every_ns: int) -> Any:
    """Return a signal several times, one after the other."""
    arrays: dict[str, Any] = {
        field.name: np.concatenate(_TIMES * [getattr(signal, field.name)])
        for field in fields(signal)
        if isinstance(getattr(signal, field.name), np.ndarray) and len(getattr(signal, field.name)) > 3
    }
    later_ns = np.repeat(np.arange(_TIMES) * every_ns, len(signal.stamp_ns))
    arrays["stamp_ns"] = arrays["stamp_ns"] + later_ns
    return replace(signal, **arrays)


def test_poses_that_are_repeated_are_no_sweep_of_an_axis() -> None:
    program = Program(pose_count=6, jogging_s=0.0, sweep_s=7.0, contact_count=2)
    once = simulate_cell(SimulatedCell(), program, seed=5).recording
    assert once.command is not None
    every_ns = int(once.pose.stamp_ns[-1] - once.pose.stamp_ns[0]) + _PAUSE_NS
    found = identify_cell(
        replace(
            once,
            wrench=repeated(once.wrench, every_ns),
            pose=repeated(once.pose, every_ns),
            command=repeated(once.command, every_ns),
            keeps_holes=True,
        )
    )
    assert list(found.axes) == ["x"]
    (left_out,) = [each for each in found.findings if each.code == "turn-not-identified"]
    assert left_out.severity == "info"
    assert "turned about axis rx" in left_out.message
    assert [each for each in (*found.findings, *advise(found)) if each.severity == "error"] == []
