"""Compiled margins of one loop at its two break points, from the polynomials of `problems.stability.polynomials`.

A grid finds where to look; every minimum of |1 + L| and every crossover near it is then searched on the loop itself.
"""

from typing import NamedTuple

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..compiled import compiled
from .polynomials import DELAY, DENOMINATOR, FED, FORCE, OWN, POSITION, SENSED

# Increasing frequencies ω up to just short of the Nyquist frequency, tan(ωh/2), and the plant's F/x^d and x/x^d there.
Grid = tuple[FloatArray, FloatArray, ComplexArray, ComplexArray]


class PolynomialLoop(NamedTuple):
    """A plant's polynomials (4, n), see `plant_at`, a controller's (3, m) and their degree, h [s] and θ of its rule."""

    plant: FloatArray
    controller: FloatArray
    degree: int
    h: float
    theta: float


# What `find_loop_margins` returns, the smaller of both break points; then the frequency of each crossover (NaN at the
# end, where there is none), and at which break point each margin but the disk's was found.
MODULUS, MODULUS_RAD_PER_S, DISK, GAIN_DB, PHASE_RAD, DELAY_S = 0, 1, 2, 3, 4, 5
GAIN_RAD_PER_S, PHASE_RAD_PER_S, DELAY_RAD_PER_S = 6, 7, 8
MODULUS_BREAK, GAIN_BREAK, PHASE_BREAK, DELAY_BREAK, MARGINS = 9, 10, 11, 12, 13
# The two break points, and both where they see one loop.
AT_FORCE, AT_COMMAND, BOTH = 0, 1, 2
# How much is asked: the modulus margin, also the crossovers' margins, also the disk margin.
MODULUS_ALONE, WITH_CROSSOVERS, EVERY_MARGIN = 0, 1, 2

_SECTIONS = 30
_BISECTIONS = 60
_ROOT = 5e-13
_CLOSE = 1.5
# The tangent of the largest angle between neighbours, seen from the point that they must stay away from: 35°. The
# straight line between them comes no nearer than cos 17.5° = 0.954 of the nearer one.
MAX_TURN = 0.7
_SMALL_LOOP = 0.03
# How finely a segment is refined, where in it a point is added if its middle is an undamped pole, and how many in all.
_NARROWEST, _BESIDE = 1e-8, 0.4
_DEEPEST = 40
_ADDED_POINTS = 2000
_REAL = 1e-3
# From this ratio of its sides on a bracket spoils the parabola; where its values differ by less it is not searched on.
_LOPSIDED = 8.0
_FLAT = 1e-8


@compiled
def plant_at(plant: FloatArray, w: complex) -> tuple[complex, complex]:
    """Return F/x^d and x/x^d at one point of the w-plane.

    `plant` (4, n) holds denominator and numerators without the whole samples of delay, and their number in its last
    row: a power of (1 − w)/(1 + w), which as a polynomial would lose all digits for a long delay.
    """
    denominator, force, position = 0.0 + 0.0j, 0.0 + 0.0j, 0.0 + 0.0j
    count = plant.shape[1]
    # Near the Nyquist frequency w is huge: the ratios are the same with the powers of 1/w in reverse.
    large = w.real * w.real + w.imag * w.imag > 1.0
    step = _quotient(1.0 + 0.0j, w) if large else w
    for k in range(count):
        i = k if large else count - 1 - k
        denominator = denominator * step + plant[DENOMINATOR, i]
        force = force * step + plant[FORCE, i]
        position = position * step + plant[POSITION, i]
    late, sample = 1.0 + 0.0j, _quotient(1.0 - w, 1.0 + w)
    for _ in range(int(plant[DELAY, 0])):
        late *= sample
    late = _quotient(late, denominator)
    return late * force, late * position


@compiled
def differences(
    controller: FloatArray, degree: int, s: complex, force: complex, position: complex
) -> tuple[complex, complex]:
    """Return 1 + L at the force signal and at the command, for the plant's responses at the same frequency."""
    own, sensed, fed = 0.0 + 0.0j, 0.0 + 0.0j, 0.0 + 0.0j
    if s.real == 0.0 and degree <= 3:
        # On the imaginary axis, as Tustin's rule has it, the most frequent case in real numbers.
        y, square = s.imag, -s.imag * s.imag
        even, odd = controller[OWN, 0] + square * controller[OWN, 2], controller[OWN, 1] + square * controller[OWN, 3]
        own = complex(even, y * odd)
        even = controller[SENSED, 0] + square * controller[SENSED, 2]
        sensed = complex(even, y * (controller[SENSED, 1] + square * controller[SENSED, 3]))
    else:
        for i in range(degree, -1, -1):
            own = own * s + controller[OWN, i]
            sensed = sensed * s + controller[SENSED, i]
    if controller[FED, 2] == 0.0:
        both = _quotient(own - sensed * force, own)
        return both, both
    for i in range(degree, -1, -1):
        fed = fed * s + controller[FED, i]
    damped = own + fed * position
    whole = damped - sensed * force
    return _quotient(whole, damped), _quotient(whole, own)


@compiled
def _quotient(one: complex, two: complex) -> complex:
    """Return one/two without the care for overflow that complex division takes; nothing here is that large."""
    share = 1.0 / (two.real * two.real + two.imag * two.imag)
    return complex(
        (one.real * two.real + one.imag * two.imag) * share, (one.imag * two.real - one.real * two.imag) * share
    )


@compiled
def differences_at(loop: PolynomialLoop, omega: float) -> tuple[complex, complex]:
    """Return 1 + L at both break points at one frequency [rad/s] below the Nyquist frequency."""
    w = 1j * np.tan(0.5 * omega * loop.h)
    force, position = plant_at(loop.plant, w)
    s = (2.0 / loop.h) * w / (1.0 + (2.0 * loop.theta - 1.0) * w)
    return differences(loop.controller, loop.degree, s, force, position)


@compiled
def squared_distance(difference: complex, disk: bool) -> float:
    """Return |1 + L|², or the square of what the balanced disk margin minimises, 2|1 + L|/|1 − L|."""
    size = difference.real * difference.real + difference.imag * difference.imag
    if not disk:
        return size
    other = 2.0 - difference.real
    return 4.0 * size / (other * other + difference.imag * difference.imag)


@compiled
def find_loop_margins(loop: PolynomialLoop, grid: Grid, depth: int, found: FloatArray) -> None:
    """Write the margins of a stable loop into `found` (MARGINS,), as far as `depth` says (the rest is infinite).

    A response that is not a number makes all of them NaN: it must not pass for a large margin.
    """
    found[:] = np.inf
    omega, points = _refined_response(loop, grid)
    for signal in range(len(points)):
        for disk in range(2 if depth == EVERY_MARGIN else 1):
            value, where = _smallest(loop, omega, points[signal], signal, disk == 1)
            if np.isnan(value):
                found[:] = np.nan
                return
            if disk == 1:
                found[DISK] = min(found[DISK], value)
            elif value < found[MODULUS]:
                found[MODULUS], found[MODULUS_RAD_PER_S], found[MODULUS_BREAK] = value, where, signal
        if depth != MODULUS_ALONE:
            _crossovers(loop, omega, points[signal], signal, found)
    if len(points) == 1:
        found[MODULUS_BREAK] = found[GAIN_BREAK] = found[PHASE_BREAK] = found[DELAY_BREAK] = BOTH


@compiled
def _refined_response(loop: PolynomialLoop, grid: Grid) -> tuple[FloatArray, ComplexArray]:
    """Return frequencies and 1 + L there, (1 or 2, n), with points added where the curve turns fast.

    1 + L turns where a lightly damped mode of the loop is, and may dip between two points; L turns where an inner loop
    has one, and with a long delay everywhere. Without feedback of the position both break points see one loop.
    """
    (omega, tangent, force, position), (_, controller, degree, h, theta) = grid, loop
    count = len(omega)
    signals = 1 if np.all(controller[FED] == 0.0) else 2
    room = count + _ADDED_POINTS
    moments, points = np.empty(room), np.empty((signals, room), dtype=np.complex128)
    used, last_force, last_command = 0, 1.0 + 0.0j, 1.0 + 0.0j
    for k in range(count):
        s = complex(0.0, (2.0 / h) * tangent[k])
        if theta != 0.5:
            s = s / (1.0 + (2.0 * theta - 1.0) * 1j * tangent[k])
        at_force, at_command = differences(controller, degree, s, force[k], position[k])
        turns = _turns_between(last_force, at_force) or (signals == 2 and _turns_between(last_command, at_command))
        if turns and used > 0:
            most = room - (count - k) - _DEEPEST
            target = (omega[k], (at_force, at_command))
            used = _refine_segment(loop, target, (moments, points), used, most)
        moments[used], points[AT_FORCE, used] = omega[k], at_force
        if signals == 2:
            points[AT_COMMAND, used] = at_command
        used, last_force, last_command = used + 1, at_force, at_command
    return moments[:used], points[:, :used].copy()


@compiled
def _refine_segment(
    loop: PolynomialLoop,
    target: tuple[float, tuple[complex, complex]],
    trace: tuple[FloatArray, ComplexArray],
    used: int,
    most: int,
) -> int:
    """Add points between the last one of a trace and the next on the grid until none turns fast; return their number.

    Halves are taken from the left; what is to the right of the one at hand waits.
    """
    moments, points = trace
    signals = len(points)
    waiting, stack, depth = np.empty(_DEEPEST), np.empty((2, _DEEPEST), dtype=np.complex128), 1
    bottom = 0
    waiting[bottom], (stack[AT_FORCE, bottom], stack[AT_COMMAND, bottom]) = target
    while depth > 0:
        width, fast = waiting[depth - 1] - moments[used - 1], False
        if depth < _DEEPEST and used < most and width > _NARROWEST * waiting[depth - 1]:
            for i in range(signals):
                fast = fast or _turns_between(points[i, used - 1], stack[i, depth - 1])
        if fast:
            waiting[depth] = 0.5 * (moments[used - 1] + waiting[depth - 1])
            stack[AT_FORCE, depth], stack[AT_COMMAND, depth] = differences_at(loop, waiting[depth])
            if np.isnan(stack[AT_FORCE, depth].real + stack[AT_COMMAND, depth].real):
                waiting[depth] = moments[used - 1] + _BESIDE * (waiting[depth - 1] - moments[used - 1])
                stack[AT_FORCE, depth], stack[AT_COMMAND, depth] = differences_at(loop, waiting[depth])
            depth += 1
        else:
            depth -= 1
            # The last one is the grid's own, which the caller adds.
            if depth > 0:
                moments[used] = waiting[depth]
                for i in range(signals):
                    points[i, used] = stack[i, depth]
                used += 1
    return used


@compiled
def _turns_between(one: complex, two: complex) -> bool:
    """Return whether 1 + L turns fast from one point to the next, or L where it is not small."""
    if _turns(one, two):
        return True
    first, second = one - 1.0, two - 1.0
    sizes = (first.real * first.real + first.imag * first.imag, second.real * second.real + second.imag * second.imag)
    return max(sizes) > _SMALL_LOOP * _SMALL_LOOP and _turns(first, second)


@compiled
def _smallest(
    loop: PolynomialLoop,
    omega: FloatArray,
    points: ComplexArray,
    signal: int,
    disk: bool,
) -> tuple[float, float]:
    """Return the smallest distance and where it is: parabolas around every grid minimum that could hold it."""
    count = len(omega)
    values = np.empty(count)
    best, where = np.inf, 0.0
    for k in range(count):
        values[k] = squared_distance(points[k], disk)
        if np.isnan(values[k]):
            return np.nan, np.nan
        if values[k] < best:
            best, where = values[k], omega[k]
    limit = _CLOSE * _CLOSE * best
    for k in range(1, count - 1):
        if values[k] <= limit and values[k] <= values[k - 1] and values[k] <= values[k + 1]:
            bracket = (omega[k - 1], omega[k], omega[k + 1])
            around = (values[k - 1], values[k], values[k + 1])
            value, at = _descend(loop, bracket, around, signal, disk)
            if value < best:
                best, where = value, at
    return np.sqrt(best), where


@compiled
def _turns(one: complex, two: complex) -> bool:
    """Return whether the angle between two points is large."""
    along = one.real * two.real + one.imag * two.imag
    across = one.real * two.imag - one.imag * two.real
    return bool(along <= 0.0 or abs(across) > MAX_TURN * along)


@compiled
def _descend(
    loop: PolynomialLoop,
    bracket: tuple[float, float, float],
    values: tuple[float, float, float],
    signal: int,
    disk: bool,
) -> tuple[float, float]:
    """Return the smallest squared distance inside a bracket, by parabolas through three points of it."""
    (low, middle, high), (at_low, at_middle, at_high) = bracket, values
    for _ in range(_SECTIONS):
        trial = _vertex((low, middle, high), (at_low, at_middle, at_high))
        if max(at_low, at_high) - at_middle <= _FLAT * at_middle:
            break
        wide, narrow = max(high - middle, middle - low), min(high - middle, middle - low)
        if wide > _LOPSIDED * narrow:
            # A far end spoils the parabola: bring it near.
            into_wide = 1.0 if high - middle > middle - low else -1.0
            trial = middle + into_wide * max(np.sqrt(narrow * wide), into_wide * (trial - middle))
        if not low < trial < high or abs(trial - middle) < 1e-3 * (high - low):
            trial = 0.5 * (middle + (high if high - middle > middle - low else low))
        if abs(trial - middle) <= 1e-7 * middle:
            break
        value = squared_distance(differences_at(loop, trial)[signal], disk)
        if value < at_middle:
            if trial > middle:
                low, at_low = middle, at_middle
            else:
                high, at_high = middle, at_middle
            middle, at_middle = trial, value
        elif trial > middle:
            high, at_high = trial, value
        else:
            low, at_low = trial, value
    return at_middle, middle


@compiled
def _crossovers(
    loop: PolynomialLoop,
    omega: FloatArray,
    points: ComplexArray,
    signal: int,
    found: FloatArray,
) -> None:
    """Update gain, phase and delay margin with every crossover between neighbouring points."""
    end = points[len(points) - 1] - 1.0
    # At the Nyquist frequency the loop is real, unless an ideal derivative makes it infinite.
    if end.real < 0.0 and abs(end.imag) < _REAL * abs(end.real):
        _keep(found, (GAIN_DB, GAIN_RAD_PER_S, GAIN_BREAK), (gain_db_of(end), np.nan, signal))
    # As in continuous time a loop gain that stays above 1 tolerates no delay: z^−d changes its sign at the end.
    if not abs(end) < 1.0:
        found[DELAY_S], found[DELAY_RAD_PER_S], found[DELAY_BREAK] = 0.0, np.nan, signal
    for of_phase in (True, False):
        for k in range(len(omega) - 1):
            low, high = omega[k], omega[k + 1]
            one, two = level(points[k], of_phase), level(points[k + 1], of_phase)
            if (one > 0.0) != (two > 0.0):
                _cross(loop, (low, high), signal, of_phase, found)
            elif k > 0 and abs(one) <= abs(two) and one * level(points[k - 1], of_phase) >= one * one:
                # It comes closest here; between the points it may cross and come back.
                before = level(points[k - 1], of_phase)
                bracket = (omega[k - 1], low, high)
                middle = _vertex(bracket, (before, one, two))
                closest = differences_at(loop, middle)[signal]
                if (level(closest, of_phase) > 0.0) != (one > 0.0):
                    _cross(loop, (omega[k - 1], middle), signal, of_phase, found)
                    _cross(loop, (middle, high), signal, of_phase, found)


@compiled
def level(difference: complex, of_phase: bool) -> float:
    """Return what is zero where L crosses the real axis, or the unit circle."""
    loop = difference - 1.0
    return float(loop.imag if of_phase else loop.real * loop.real + loop.imag * loop.imag - 1.0)


@compiled
def _vertex(at: tuple[float, float, float], values: tuple[float, float, float]) -> float:
    """Return where the parabola through three points turns, inside them."""
    (low, middle, high), (at_low, at_middle, at_high) = at, values
    left, right = (middle - low) * (at_middle - at_high), (middle - high) * (at_middle - at_low)
    bottom = 2.0 * (left - right)
    if bottom == 0.0:
        return middle
    vertex = middle - ((middle - low) * left - (middle - high) * right) / bottom
    return min(max(vertex, low), high)


@compiled
def _cross(loop: PolynomialLoop, bracket: tuple[float, float], signal: int, of_phase: bool, found: FloatArray) -> None:
    """Update the margins with the crossover in a bracket."""
    at = _root(loop, bracket, signal, of_phase)
    gain = differences_at(loop, at)[signal] - 1.0
    if of_phase:
        if gain.real < 0.0:
            _keep(found, (GAIN_DB, GAIN_RAD_PER_S, GAIN_BREAK), (gain_db_of(gain), at, signal))
    else:
        _keep(found, (PHASE_RAD, PHASE_RAD_PER_S, PHASE_BREAK), (abs(np.angle(-gain)), at, signal))
        _keep(found, (DELAY_S, DELAY_RAD_PER_S, DELAY_BREAK), (delay_s_of(gain, at), at, signal))


@compiled
def _keep(found: FloatArray, columns: tuple[int, int, int], margin: tuple[float, float, int]) -> None:
    """Keep a margin with its frequency and break point if it is the smallest so far."""
    if margin[0] < found[columns[0]]:
        found[columns[0]], found[columns[1]], found[columns[2]] = margin


@compiled
def gain_db_of(gain: complex) -> float:
    """Return the change of gain [dB], up or down, that brings L to −1 where it is real and negative."""
    return float(abs(20.0 * np.log10(-gain.real)))


@compiled
def delay_s_of(gain: complex, omega: float) -> float:
    """Return the least lag [s] that brings L to −1 where |L| = 1."""
    angle = np.angle(-gain)
    return float((angle if angle > 0.0 else angle + 2.0 * np.pi) / omega)


@compiled
def _root(
    loop: PolynomialLoop,
    bracket: tuple[float, float],
    signal: int,
    of_phase: bool,
) -> float:
    """Return where L crosses the real axis, or the unit circle, in a bracket with a change of sign.

    Brent's method (Algorithms for Minimization without Derivatives, 1973, chapter 4): interpolation that falls back to
    bisection. Where rounding hides the change of sign, the end that is nearer to the crossing is returned.
    """
    (last, best), tolerance = bracket, _ROOT * bracket[1]
    at_last = level(differences_at(loop, last)[signal], of_phase)
    at_best = level(differences_at(loop, best)[signal], of_phase)
    if (at_last > 0.0) == (at_best > 0.0):
        return last if abs(at_last) < abs(at_best) else best
    other, at_other = last, at_last
    step = before = best - last
    for _ in range(_BISECTIONS):
        if (at_best > 0.0) == (at_other > 0.0):
            other, at_other = last, at_last
            step = before = best - last
        if abs(at_other) < abs(at_best):
            last, best, other = best, other, best
            at_last, at_best, at_other = at_best, at_other, at_best
        half = 0.5 * (other - best)
        if abs(half) <= tolerance or at_best == 0.0:
            break
        trial = _interpolated((last, best, other), (at_last, at_best, at_other))
        near = abs(trial) < min(1.5 * abs(half) - 0.5 * tolerance, 0.5 * abs(before))
        if trial * half > 0.0 and near and abs(before) >= tolerance and abs(at_last) > abs(at_best):
            before, step = step, trial
        else:
            before = step = half
        last, at_last = best, at_best
        best += step if abs(step) > tolerance else np.copysign(tolerance, half)
        at_best = level(differences_at(loop, best)[signal], of_phase)
    return best


@compiled
def _interpolated(at: tuple[float, float, float], values: tuple[float, float, float]) -> float:
    """Return the step from the second of three points to where the inverse parabola through them, or a secant, is zero.

    The first and the last point may be the same.
    """
    (last, best, other), (at_last, at_best, at_other) = at, values
    if last == other:
        return (best - last) * at_best / (at_last - at_best)
    one, two, three = at_best / at_last, at_last / at_other, at_best / at_other
    above = one * ((best - last) * (three - 1.0) - (other - best) * two * (two - three))
    return above / ((two - 1.0) * (three - 1.0) * (one - 1.0))
