"""Compiled margins of a loop so near to a known one that they lie where those of the known one do, to first order.

Where |1 + L| is least its slope over frequency is zero, so that a step p of the law changes the minimum as it changes
the value at that frequency, but for O(p²) (the envelope theorem). A crossover moves so that L stays on the real axis,
or on the unit circle: one step of Newton's method finds it to O(p²) (the implicit function theorem).
"""

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from .margin_kernel import (
    AT_COMMAND,
    AT_FORCE,
    BOTH,
    DELAY_BREAK,
    DELAY_RAD_PER_S,
    DELAY_S,
    GAIN_BREAK,
    GAIN_DB,
    GAIN_RAD_PER_S,
    MODULUS,
    MODULUS_BREAK,
    MODULUS_RAD_PER_S,
    PHASE_BREAK,
    PHASE_RAD,
    PHASE_RAD_PER_S,
    PolynomialLoop,
    delay_s_of,
    differences_at,
    gain_db_of,
    level,
)

# Of the frequency, for the slope of a level.
_STEP = 1e-7


@compiled
def modulus_beside(near: PolynomialLoop, omega: float, at_break: float) -> float:
    """Return min |1 + L| of a loop beside one whose minimum is known by its frequency [rad/s] and break point."""
    at_force, at_command = differences_at(near, omega)
    if at_break == BOTH:
        return float(min(abs(at_force), abs(at_command)))
    return float(abs(at_force) if at_break == AT_FORCE else abs(at_command))


@compiled
def margins_beside(near: PolynomialLoop, known: PolynomialLoop, at: FloatArray, found: FloatArray) -> None:
    """Write modulus, gain, phase and delay margin of a loop beside a `known` one into `found` (MARGINS,).

    `at` (MARGINS,) is what `find_loop_margins` wrote of the known one. What is infinite there, for nothing crosses or
    nobody asked, stays so; a margin that is read at no crossover (its frequency is NaN) is not a number.
    """
    found[:] = at
    found[MODULUS] = modulus_beside(near, at[MODULUS_RAD_PER_S], at[MODULUS_BREAK])
    for margin, place, of_break in (
        (GAIN_DB, GAIN_RAD_PER_S, GAIN_BREAK),
        (PHASE_RAD, PHASE_RAD_PER_S, PHASE_BREAK),
        (DELAY_S, DELAY_RAD_PER_S, DELAY_BREAK),
    ):
        if at[margin] == np.inf:
            continue
        found[margin] = np.nan if np.isnan(at[place]) else np.inf
        for signal in (AT_FORCE, AT_COMMAND):
            if at[of_break] in (signal, BOTH):
                found[margin] = min(found[margin], _crossing(near, known, at[place], signal, margin))


@compiled
def _crossing(near: PolynomialLoop, known: PolynomialLoop, omega: float, signal: int, margin: int) -> float:
    """Return one margin at the crossover of a loop beside a `known` one, which crosses at `omega`."""
    of_phase = margin == GAIN_DB
    here = level(differences_at(known, omega)[signal], of_phase)
    rise = here - level(differences_at(known, omega * (1.0 - _STEP))[signal], of_phase)
    missed = level(differences_at(near, omega)[signal], of_phase) - here
    # Of a curve that only touches, the extremum stays where it is.
    moved = omega - missed * omega * _STEP / rise if rise != 0.0 else omega
    gain = differences_at(near, moved)[signal] - 1.0
    if of_phase:
        return gain_db_of(gain)
    return float(abs(np.angle(-gain))) if margin == PHASE_RAD else delay_s_of(gain, moved)
