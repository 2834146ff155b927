"""What drives a motion: a hand, a program, or nothing that the log tells."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from ..signals.segments import low_pass

FloatArray = NDArray[np.float64]

_FOLLOWED_SHARE = 0.3
_SMALLEST_TRAVEL_M = 5e-4
_BAND_HZ = 8.0
_LAG_S = 0.05
_EVERY_S = 5e-3
_ROUNDS = 20
_WRENCH_DRIVEN = 0.5
_UNEXPLAINED = 0.5
_SHORTEST_S = 0.2
_FEWEST = 10
_FEWEST_FILTERED = 30
_STEPPED = 0.2


def is_hand_led(position_m: FloatArray, force_n: FloatArray, period_s: float, mass_kg: float, offset_n: float) -> bool:
    """Return whether the force does more work on the flange than the payload brought along, (n,) each.

    ∫ F dx ≤ ½ M_p v² at the start for a payload that nobody drives; `offset_n` is what the force at rest may be off.
    """
    if len(position_m) < 3:
        return False
    work = float(np.sum(force_n[:-1] * np.diff(position_m)))
    count = max(2, min(len(position_m), round(0.02 / period_s)))
    speed = float(position_m[count - 1] - position_m[0]) / ((count - 1) * period_s)
    travel = float(np.sum(np.abs(np.diff(position_m[:: max(1, round(0.02 / period_s))]))))
    return work > 0.5 * mass_kg * speed**2 + offset_n * travel


@dataclass(frozen=True, kw_only=True)
class Admittance:
    """M_a and B_a as the command shows them."""

    mass_kg: float
    damping_n_s_per_m: float


def find_admittance(command_m: FloatArray, force_n: FloatArray, period_s: float) -> Admittance | None:
    """Return the admittance that explains how the command moves, M_a a + B_a v = F + F^d, (n,) each; None if none.

    Changes over 50 ms below 8 Hz, fitted by least absolute deviations with M_a, B_a ≥ 0: F^d may step a few times. A
    passive payload that follows a program has the opposite sign, F = −M_p a − B_p v, and is not explained.
    """
    changes = _changes(command_m, force_n, period_s)
    if len(changes) < _FEWEST:
        return None
    rows, target = changes[:, :2], changes[:, 2]
    size = np.maximum(np.std(rows, axis=0), 1e-300)
    floor = 1e-3 * float(np.mean(np.abs(target))) + 1e-300
    weight, found, left = np.ones(len(target)), np.zeros(2), target
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found, _ = nnls(rows / size * root[:, None], target * root)
        left = target - rows / size @ found
        weight = 1.0 / np.maximum(np.abs(left), floor)
    # Where the force changes counts, and not where F^d steps.
    explained = np.abs(left) < _UNEXPLAINED * np.abs(target)
    if not np.sum(np.abs(target)[explained]) > _WRENCH_DRIVEN * np.sum(np.abs(target)):
        return None
    mass, damping = (found / size).tolist()
    return Admittance(mass_kg=mass, damping_n_s_per_m=damping)


def is_stepped(command_m: FloatArray, force_n: FloatArray, period_s: float, law: Admittance) -> bool:
    """Return whether all that drives the command through an admittance, beyond the force, is F^d that steps.

    M_a a + B_a v − F then changes at few instants and rests in between.
    """
    changes = _changes(command_m, force_n, period_s)
    if len(changes) < _FEWEST:
        return False
    desired = np.abs(changes @ np.array([law.mass_kg, law.damping_n_s_per_m, -1.0]))
    return bool(np.median(desired) < _STEPPED * np.mean(desired))


def _changes(command_m: FloatArray, force_n: FloatArray, period_s: float) -> FloatArray:
    """Return changes of acceleration, speed and force over 50 ms, (m, 3), every 5 ms."""
    if len(command_m) < max(_FEWEST_FILTERED, _SHORTEST_S / period_s):
        return np.zeros((0, 3))
    velocity = np.gradient(low_pass(command_m - command_m[0], period_s, _BAND_HZ), period_s)
    signals = np.column_stack([np.gradient(velocity, period_s), velocity, low_pass(force_n, period_s, _BAND_HZ)])
    lag, every = max(1, round(_LAG_S / period_s)), max(1, round(_EVERY_S / period_s))
    return np.asarray((signals[lag:] - signals[:-lag])[::every])


def follows(command_m: FloatArray, position_m: FloatArray) -> bool:
    """Return whether the command moves as far as to explain the flange's motion, (n,) each."""
    moved = float(np.std(command_m))
    return moved > _SMALLEST_TRAVEL_M and moved > _FOLLOWED_SHARE * float(np.std(position_m))
