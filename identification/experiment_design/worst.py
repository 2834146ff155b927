"""The largest force that a sweep can make on a cell of which little is known yet."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from problems.model.robot import RobotModel

from ..robot.coupling import felt_impedance
from .values import Known, PlanValues

FloatArray = NDArray[np.float64]

SMALLEST_DAMPING_RATIO = 0.01
"""A bare steel gripper; less is taken only where less was identified."""

_POINTS = 400
_STIFFNESSES = 41
_DEVIATIONS = 3.0
# How far off a usual value may be, and one that a person guessed.
_STIFFNESS_FACTOR = 2.5
_ROBOT_FACTOR = 4.0  # a bandwidth of 13 Hz
_USUAL_MASS_FACTOR, _GUESSED_MASS_FACTOR = 1.5, 1.1
_DRAG_FACTOR = 3.0
_SMALLEST_SHARE = 0.1


@dataclass(frozen=True, kw_only=True)
class WorstCase:
    """The plausible cell on which a sweep makes the most force, and that force per speed of the flange [N/(m/s)].

    The flange's speed is what the command was made for; a robot of `bandwidth_hz`, faster than that, moves more.
    `damping_ratio` is (B_s + B_p)/(2 sqrt(K_s M_p)).
    """

    force_per_speed_n_s_per_m: float
    frequency_hz: float
    stiffness_n_per_m: float
    mass_kg: float
    damping_ratio: float
    bandwidth_hz: float


def worst_case(values: PlanValues, low_hz: float, high_hz: float) -> WorstCase:
    """Return the cell within what is known that feels most force between two frequencies.

    K_s, M_p and the robot's bandwidth run over three standard deviations, or over factors of 2.5, 1.1 (1.5 where nobody
    guessed a mass) and 4 where nothing was measured. The damping is the least of three deviations, at least 1 % of the
    critical one; beside resonances more drag makes more force, so that the most (a factor of 3) counts too, and the
    plan's own values. The force is that of a sine that lasts: a sweep passes through a resonance and stays below.
    """
    frequency = np.geomspace(low_hz, high_hz, _POINTS)
    factor = _robot_factor(values.bandwidth_hz)
    best: WorstCase | None = None
    for theta in _cells(values):
        stiffness, mass = float(theta[0]), float(theta[3])
        own = np.sqrt(stiffness / mass) / (2.0 * np.pi)
        # The grid is coarser than the resonance of the least damped cell is wide.
        at = np.append(frequency, np.clip(own, low_hz, high_hz))
        s = np.asarray(2j * np.pi * at, dtype=np.complex128)
        felt = np.abs(felt_impedance(theta, s) / s)
        for speedup in (1.0, factor):
            force = felt * _speedup(values.robot, at, speedup)
            i = int(np.argmax(force))
            if best is None or force[i] > best.force_per_speed_n_s_per_m:
                best = WorstCase(
                    force_per_speed_n_s_per_m=float(force[i]),
                    frequency_hz=float(at[i]),
                    stiffness_n_per_m=stiffness,
                    mass_kg=mass,
                    damping_ratio=float((theta[1] + theta[2]) / (2.0 * np.sqrt(stiffness * mass))),
                    bandwidth_hz=float(values.bandwidth_hz.value * speedup),
                )
    if best is None:
        raise AssertionError("unreachable: there is always a stiffness and a mass")
    return best


def _cells(values: PlanValues) -> Iterator[FloatArray]:
    """Yield K_s, B_s, B_p, M_p (4,) of the plan's own values and of the ends of what is plausible."""
    yield values.theta
    drag = values.drag_n_s_per_m
    most = drag.value * _DRAG_FACTOR if drag.std is None else drag.value + _DEVIATIONS * drag.std
    for stiffness, mass in product(_stiffnesses(values.stiffness_n_per_m), _masses(values.mass_kg)):
        yield _least_damped(values, stiffness, mass)
        yield np.array([stiffness, values.damping_n_s_per_m.value, most, mass])


def _stiffnesses(known: Known) -> FloatArray:
    low, high = _range(known, _STIFFNESS_FACTOR)
    return np.geomspace(low, high, _STIFFNESSES) if high > low else np.array([low])


def _masses(known: Known) -> tuple[float, ...]:
    return tuple(dict.fromkeys(_range(known, _USUAL_MASS_FACTOR if known.is_assumed else _GUESSED_MASS_FACTOR)))


def _range(known: Known, factor: float) -> tuple[float, float]:
    if known.std is None:
        return known.value / factor, known.value * factor
    spread = _DEVIATIONS * known.std
    return max(known.value - spread, _SMALLEST_SHARE * known.value), known.value + spread


def _robot_factor(bandwidth: Known) -> float:
    return _ROBOT_FACTOR if bandwidth.std is None else 1.0 + _DEVIATIONS * bandwidth.std / bandwidth.value


def _least_damped(values: PlanValues, stiffness: float, mass: float) -> FloatArray:
    """Return K_s, B_s, B_p, M_p (4,) with the least damping that is plausible."""
    critical = float(2.0 * np.sqrt(stiffness * mass))
    told = values.damping_n_s_per_m, values.drag_n_s_per_m
    least = [0.0 if each.std is None else max(each.value - _DEVIATIONS * each.std, 0.0) for each in told]
    floor = SMALLEST_DAMPING_RATIO * critical
    if all(each.std is not None for each in told):
        floor = min(floor, told[0].value + told[1].value)
    missing = max(floor - sum(least), 0.0)
    return np.array([stiffness, least[0] + missing, least[1], mass])


def _speedup(robot: RobotModel, frequency_hz: FloatArray, factor: float) -> FloatArray:
    """Return |r(s/factor)|/|r(s)|: what a robot faster by a factor makes of a command that was made for this one."""
    omega = 2.0 * np.pi * frequency_hz
    return np.asarray(np.abs(robot.position_response(omega / factor)) / np.abs(robot.position_response(omega)))
