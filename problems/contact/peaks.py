"""The largest contact force between the ticks: near which ticks it may lie, and where inside a sample it does.

`problems.contact.kernel` steps from tick to tick and asks here; all else reads the peak that was found.
"""

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from .events import advance, contact_force, rate_bound
from .kernel_types import CONTACT_PEAK, CONTACT_TIME, IN_CONTACT, PRESSED, Contact, HeldInputs, Inputs

# Looks are half a radian of the fastest oscillation apart: they miss at most 3 % of its amplitude (which the force may
# exceed only in part), and a parabola through three of them 0.15 %.
_MISSED_BETWEEN_LOOKS = 0.2
_MISSED_BY_PARABOLA = 3e-3
_SERIES_TERMS = 18
# Shares of the force below which a term, or what a crest may still hide, is rounding.
_NEGLIGIBLE, _FLAT = 1e-18, 1e-16
_SLOPE_STEPS = 7
# The first two coefficients of a power series.
_VALUE, _SLOPE = 0, 1


@compiled
def keep_peak(found: FloatArray, k: int, largest: tuple[float, float]) -> None:
    """Keep a contact force and its moment in sample k if it is the largest so far."""
    force, moment = largest
    if force > found[CONTACT_PEAK]:
        found[CONTACT_PEAK], found[CONTACT_TIME] = force, k + moment


@compiled
def may_hide_peak(seen: float, largest: float) -> bool:
    """Return whether a sample may hold a force above the largest one, given the largest that was seen of it."""
    return seen >= (1.0 - _MISSED_BETWEEN_LOOKS) * largest


@compiled
def may_pass(pressed: FloatArray, tick: int, largest: float) -> bool:
    """Return whether the parabola through a tick and its neighbours reaches the largest force."""
    # No force presses less than 0, so the crest of a parabola is at most a quarter above its middle point.
    if pressed[tick] <= largest / (1.25 * (1.0 + _MISSED_BY_PARABOLA)):
        return False
    bend = 2.0 * pressed[tick] - pressed[tick - 1] - pressed[tick + 1]
    if pressed[tick] < pressed[tick - 1] or pressed[tick] < pressed[tick + 1] or bend <= 0.0:
        return False
    top = pressed[tick] + (pressed[tick + 1] - pressed[tick - 1]) ** 2 / (8.0 * bend)
    return bool((1.0 + _MISSED_BY_PARABOLA) * top > largest)


@compiled
def keep_state(crest: FloatArray, state: FloatArray, newer: float, older: float, k: int) -> None:
    """Keep state, newer and older command of tick k: rows of `crest` (2, n + 3), the even ticks in the first."""
    n = len(state)
    crest[k & 1, :n], crest[k & 1, n], crest[k & 1, n + 1], crest[k & 1, n + 2] = state, newer, older, k


@compiled
def keep_three_states(crest: FloatArray, x: float, p: float, v: float, newer: float, held: float, k: int) -> None:
    """Do what `keep_state` does for a state of three numbers."""
    row = crest[k & 1]
    row[0], row[1], row[2], row[3], row[4], row[5] = x, p, v, newer, held, k


@compiled
def is_kept(crest: FloatArray, tick: int) -> bool:
    """Return whether a tick and the one before it were kept."""
    n = crest.shape[1] - 3
    return bool(crest[tick & 1, n + 2] == tick and crest[1 - tick & 1, n + 2] == tick - 1)


@compiled
def search_around(plant: Contact, tick: int, push: float, crest: FloatArray, found: FloatArray) -> None:
    """Search the force of the samples before and behind a tick, as far as they were kept.

    Without a step of the command inside the samples the slopes at the tick show in which of them it is largest. A
    payload that leaves in the sample behind has passed the largest force before.
    """
    flow, rows, fraction, n = plant.flow[IN_CONTACT], plant.rows, plant.delay.fraction, crest.shape[1] - 3
    behind, before = crest[tick & 1], crest[1 - tick & 1]
    whole, state = fraction == 0.0, behind[:n]
    if before[n + 2] == tick - 1:
        falls = contact_force_rate(flow, rows, HeldInputs(before[n], push), state) < 0.0
        if not whole or behind[n + 2] != tick or falls:
            inputs = Inputs(before[n + 1], before[n], push)
            keep_peak(found, tick - 1, largest_in_sample(flow, rows, inputs, before[:n], fraction))
    if behind[n + 2] == tick and not (
        whole and contact_force_rate(flow, rows, HeldInputs(behind[n], push), state) <= 0.0
    ):
        inputs = Inputs(behind[n + 1], behind[n], push)
        keep_peak(found, tick, largest_in_sample(flow, rows, inputs, state, fraction))


@compiled
def largest_in_sample(
    flow: FloatArray,
    outputs: FloatArray,
    inputs: Inputs,
    state: FloatArray,
    fraction: float,
) -> tuple[float, float]:
    """Return the largest F_e with its moment over a sample without switch."""
    n = len(state)
    if fraction == 0.0:
        return largest_force(flow, outputs, HeldInputs(inputs.newer, inputs.push), state, 1.0)
    best, moment = largest_force(flow, outputs, HeldInputs(inputs.older, inputs.push), state, fraction)
    drive = flow[:, n] * inputs.older + flow[:, n + 1] * inputs.push
    middle = advance(flow[:, :n].copy(), drive, state, fraction)
    value, where = largest_force(flow, outputs, HeldInputs(inputs.newer, inputs.push), middle, 1.0 - fraction)
    return (value, fraction + where) if value > best else (best, moment)


@compiled
def contact_force_rate(flow: FloatArray, outputs: FloatArray, inputs: HeldInputs, state: FloatArray) -> float:
    """Return dF_e/dτ of a payload that stays on the environment."""
    n, total = len(state), 0.0
    for i in range(n):
        rate = flow[i, n] * inputs.command + flow[i, n + 1] * inputs.push
        for j in range(n):
            rate += flow[i, j] * state[j]
        total += outputs[PRESSED, i] * rate
    return total


@compiled
def largest_force(
    flow: FloatArray,
    outputs: FloatArray,
    inputs: HeldInputs,
    state: FloatArray,
    duration: float,
) -> tuple[float, float]:
    """Return the largest F_e over [0, duration] with its moment: a power series in pieces, maximised in each."""
    n = len(state)
    pieces = max(1, int(np.ceil(rate_bound(flow[:, :n]) * duration)))
    step = duration / pieces
    best, moment, weight = contact_force(state, outputs, inputs), 0.0, np.sum(np.abs(outputs[PRESSED, :n]))
    current, term, next_term, series = state.copy(), np.empty(n), np.empty(n), np.empty(_SERIES_TERMS)
    for piece in range(pieces):
        count = 1
        series[_VALUE] = contact_force(current, outputs, inputs)
        for i in range(n):
            total = flow[i, n] * inputs.command + flow[i, n + 1] * inputs.push
            for j in range(n):
                total += flow[i, j] * current[j]
            term[i] = total * step
        for order in range(1, _SERIES_TERMS):
            series[order], longest = 0.0, 0.0
            for i in range(n):
                current[i] += term[i]
                series[order] += outputs[PRESSED, i] * term[i]
                longest = max(longest, abs(term[i]))
            count = order + 1
            # The terms shrink from here on: by the bound on the rate, two orders at a time.
            if longest * weight < _NEGLIGIBLE * abs(series[_VALUE]):
                break
            for i in range(n):
                total = 0.0
                for j in range(n):
                    total += flow[i, j] * term[j]
                next_term[i] = total * (step / (order + 1.0))
            for i in range(n):
                term[i] = next_term[i]
        value, where = _largest_of_series(series[:count])
        if value > best:
            best, moment = value, (piece + where) * step
    return best, moment


@compiled
def _largest_of_series(series: FloatArray) -> tuple[float, float]:
    """Return the largest value of a smooth power series on [0, 1]: where its slope turns from up to down, else an end.

    A piece is short against the fastest oscillation (its argument is below one), so the slope turns once at most.
    """
    start, stop = series[_VALUE], _sum_series(series, 1.0)
    best, where = (start, 0.0) if start >= stop else (stop, 1.0)
    low, high = 0.0, 1.0
    if series[_SLOPE] > 0.0 and _slope_of_series(series, 1.0) < 0.0:
        left, right = series[_SLOPE], _slope_of_series(series, 1.0)
        for _ in range(_SLOPE_STEPS):
            middle = low + (high - low) * min(0.95, max(0.05, left / (left - right)))
            slope = _slope_of_series(series, middle)
            if slope > 0.0:
                low, left = middle, slope
            else:
                high, right = middle, slope
            # The value at the crest is off by less than slope times width.
            if abs(slope) * (high - low) < _FLAT * abs(best):
                low = high = middle
                break
        middle = 0.5 * (low + high)
        value = _sum_series(series, middle)
        if value > best:
            best, where = value, middle
    return best, where


@compiled
def _sum_series(series: FloatArray, at: float) -> float:
    total = 0.0
    for j in range(len(series) - 1, -1, -1):
        total = total * at + series[j]
    return total


@compiled
def _slope_of_series(series: FloatArray, at: float) -> float:
    total = 0.0
    for j in range(len(series) - 1, 0, -1):
        total = total * at + j * series[j]
    return total
