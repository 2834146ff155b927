"""Stability of the continuous loop (delay exact) and of the sampled one, and where it begins and ends."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from examples.paper.continuous import continuous_loop
from examples.paper.modes import Mode, analyse_modes
from problems.arrays import BoolArray, FloatArray
from problems.maps.loops import Designs, build_plant_loops
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.model.sampled import SampledPlant, build_loop

_LOWEST_RAD_PER_S, _HIGHEST_RAD_PER_S = 1e-3, 3e4
_POINTS = 12_000
_OSCILLATION_HZ = (0.1, 150.0)
_PARTS = 17
_ROUNDS = 3


class Interval(NamedTuple):
    """A stretch of a parameter in which the loop is stable."""

    low: float
    high: float


def continuous_is_stable(
    plant: Plant, controller: AdmittanceController, *, half_sample_of_s: float | None = None
) -> bool:
    """Return whether the continuous loop is stable, by the turns of 1 + L_x along the imaginary axis (Nyquist).

    Its only pole that does not decay is the integrator of a contact. Without zeros on the right its phase rises by a
    quarter turn in contact and by none in free space (where the integrator meets a zero); each pair on the right
    takes a full turn off.
    """
    omega = np.geomspace(_LOWEST_RAD_PER_S, _HIGHEST_RAD_PER_S, _POINTS)
    distance = 1.0 + continuous_loop(plant, controller, omega, half_sample_of_s=half_sample_of_s).at_command
    phase = np.unwrap(np.angle(distance))
    expected = 0.5 * np.pi if plant.environment.is_anchored else 0.0
    return bool(abs(phase[-1] - phase[0] - expected) < 0.5 * np.pi)


def slowest_mode(sampled: SampledPlant, controller: AdmittanceController, above_hz: float = 0.0) -> Mode | None:
    """Return the mode that decays last, or grows fastest, among those that oscillate faster than `above_hz`."""
    modes = analyse_modes(build_loop(sampled, controller)).modes
    return next((mode for mode in modes if mode.oscillation_hz > above_hz), None)


def least_damped(sampled: SampledPlant, controller: AdmittanceController) -> Mode:
    """Return the mode with the smallest damping ratio among those that oscillate like a payload or a contact."""
    modes = analyse_modes(build_loop(sampled, controller)).modes
    slow, fast = _OSCILLATION_HZ
    return min((mode for mode in modes if slow < mode.oscillation_hz < fast), key=lambda mode: mode.damping_ratio)


def stable_intervals(
    plants: Sequence[SampledPlant],
    make: Callable[[float], AdmittanceController],
    values: FloatArray,
) -> list[Interval]:
    """Return where the sampled loops of all `plants` are stable over one parameter of the controller.

    `values` is the first scan; each edge is then narrowed to less than 1/4000 of a step of it. An interval that
    reaches the end of the scan ends there.
    """

    loops = build_plant_loops([each.plant for each in plants], plants[0].sample_time_s)

    def judge(points: FloatArray) -> BoolArray:
        laws = [make(float(value)) for value in points]
        designs = Designs(kind=laws[0], parameters=np.array([each.parameters() for each in laws]))
        return np.asarray(np.all(loops.stable(designs), axis=1))

    verdicts = judge(values)
    changes = np.flatnonzero(verdicts[1:] != verdicts[:-1])
    edges = [_edge(judge, float(values[i]), float(values[i + 1])) for i in changes]
    if verdicts[0]:
        edges.insert(0, float(values[0]))
    if verdicts[-1]:
        edges.append(float(values[-1]))
    return [Interval(low, high) for low, high in zip(edges[::2], edges[1::2], strict=True)]


def _edge(judge: Callable[[FloatArray], BoolArray], low: float, high: float) -> float:
    for _ in range(_ROUNDS):
        points = np.linspace(low, high, _PARTS)
        verdicts = judge(points)
        first = int(np.flatnonzero(verdicts[1:] != verdicts[:-1])[0])
        low, high = float(points[first]), float(points[first + 1])
    return 0.5 * (low + high)


def last_interval(intervals: Sequence[Interval], end: float) -> Interval | None:
    """Return the interval that reaches the end of the scan, if there is one."""
    return intervals[-1] if intervals and intervals[-1].high == end else None
