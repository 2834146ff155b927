"""Compiled margins of one loop at its two break points, from the polynomials of `problems.polynomials`.

A grid finds where to look; every minimum of |1 + L| and every crossover near it is then searched on the loop itself.
"""

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# Increasing frequencies ω up to just short of the Nyquist frequency, tan(ωh/2), and the plant's F/x^d and x/x^d there.
Grid = tuple[FloatArray, FloatArray, ComplexArray, ComplexArray]

# What `find_loop_margins` returns, the smaller of both break points.
MODULUS, MODULUS_RAD_PER_S, DISK, GAIN_DB, PHASE_RAD, DELAY_S, MARGINS = 0, 1, 2, 3, 4, 5, 6

_SECTIONS = 10
_BISECTIONS = 60
_CLOSE = 1.5
# The tangent of the angle between neighbours from which a turn is followed.
_TURN = 0.7
_REAL = 1e-3


@compiled
def plant_at(plant: FloatArray, w: complex) -> tuple[complex, complex]:
    """Return F/x^d and x/x^d at one point of the w-plane."""
    denominator, force, position = 0.0 + 0.0j, 0.0 + 0.0j, 0.0 + 0.0j
    for i in range(plant.shape[1] - 1, -1, -1):
        denominator = denominator * w + plant[0, i]
        force = force * w + plant[1, i]
        position = position * w + plant[2, i]
    return _quotient(force, denominator), _quotient(position, denominator)


@compiled
def differences(
    controller: FloatArray, degree: int, s: complex, force: complex, position: complex
) -> tuple[complex, complex]:
    """Return 1 + L at the force signal and at the command, for the plant's responses at the same frequency."""
    own, sensed, fed = 0.0 + 0.0j, 0.0 + 0.0j, 0.0 + 0.0j
    for i in range(degree, -1, -1):
        own = own * s + controller[0, i]
        sensed = sensed * s + controller[1, i]
    if controller[2, 2] == 0.0:
        both = _quotient(own - sensed * force, own)
        return both, both
    for i in range(degree, -1, -1):
        fed = fed * s + controller[2, i]
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
def differences_at(
    plant: FloatArray, controller: FloatArray, degree: int, h: float, theta: float, omega: float
) -> tuple[complex, complex]:
    """Return 1 + L at both break points at one frequency [rad/s] below the Nyquist frequency."""
    w = 1j * np.tan(0.5 * omega * h)
    force, position = plant_at(plant, w)
    s = (2.0 / h) * w / (1.0 + (2.0 * theta - 1.0) * w)
    return differences(controller, degree, s, force, position)


@compiled
def squared_distance(difference: complex, disk: bool) -> float:
    """Return |1 + L|², or the square of what the balanced disk margin minimises, 2|1 + L|/|1 − L|."""
    size = difference.real * difference.real + difference.imag * difference.imag
    if not disk:
        return size
    other = 2.0 - difference.real
    return 4.0 * size / (other * other + difference.imag * difference.imag)


@compiled
def find_loop_margins(
    plant: FloatArray,
    grid: Grid,
    controller: FloatArray,
    degree: int,
    sampling: tuple[float, float],
    everything: bool,
    found: FloatArray,
) -> None:
    """Write the margins of a stable loop into `found` (6,); without `everything` only the modulus margin.

    `sampling` is (h, θ).
    """
    (omega, tangent, force, position), (h, theta), count = grid, sampling, len(grid[0])
    found[:] = np.inf
    # Without feedback of the position both break points see the same loop.
    signals = 1 if np.all(controller[2] == 0.0) else 2
    points = np.empty((signals, count), dtype=np.complex128)
    for k in range(count):
        s = (2.0 / h) * 1j * tangent[k]
        if theta != 0.5:
            s = s / (1.0 + (2.0 * theta - 1.0) * 1j * tangent[k])
        at_force, at_command = differences(controller, degree, s, force[k], position[k])
        points[0, k] = at_force
        if signals == 2:
            points[1, k] = at_command
    for signal in range(signals):
        for disk in range(2 if everything else 1):
            value, where = _smallest(plant, controller, degree, sampling, omega, points[signal], signal, disk == 1)
            if disk == 1:
                found[DISK] = min(found[DISK], value)
            elif value < found[MODULUS]:
                found[MODULUS], found[MODULUS_RAD_PER_S] = value, where
        if everything:
            _crossovers(plant, controller, degree, sampling, omega, points[signal], signal, found)


@compiled
def _smallest(
    plant: FloatArray,
    controller: FloatArray,
    degree: int,
    sampling: tuple[float, float],
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
        if values[k] < best:
            best, where = values[k], omega[k]
    limit = _CLOSE * _CLOSE * best
    for k in range(count - 1):
        if k > 0 and values[k] <= limit and values[k] <= values[k - 1] and values[k] <= values[k + 1]:
            bracket = (omega[k - 1], omega[k], omega[k + 1])
        elif _turns(points[k], points[k + 1]):
            # 1 + L turns fast where a lightly damped mode of the loop is: the distance may dip between two points.
            bracket = _follow_turn(plant, controller, degree, sampling, (omega[k], omega[k + 1]), signal)
        else:
            continue
        value, at = _descend(plant, controller, degree, sampling, bracket, signal, disk)
        if value < best:
            best, where = value, at
    return np.sqrt(best), where


@compiled
def _turns(one: complex, two: complex) -> bool:
    """Tell whether the angle between two points is large."""
    along = one.real * two.real + one.imag * two.imag
    across = one.real * two.imag - one.imag * two.real
    return bool(along <= 0.0 or abs(across) > _TURN * along)


@compiled
def _follow_turn(
    plant: FloatArray,
    controller: FloatArray,
    degree: int,
    sampling: tuple[float, float],
    bracket: tuple[float, float],
    signal: int,
) -> tuple[float, float, float]:
    """Narrow a bracket to where 1 + L turns fastest, until it turns slowly over it."""
    low, high = bracket
    at_low = differences_at(plant, controller, degree, *sampling, low)[signal]
    at_high = differences_at(plant, controller, degree, *sampling, high)[signal]
    width = high - low
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        at_middle = differences_at(plant, controller, degree, *sampling, middle)[signal]
        if not _turns(at_low, at_middle) and not _turns(at_middle, at_high):
            break
        width = high - low
        if abs(np.angle(at_middle / at_low)) > abs(np.angle(at_high / at_middle)):
            high, at_high = middle, at_middle
        else:
            low, at_low = middle, at_middle
    return max(bracket[0], low - width), 0.5 * (low + high), min(bracket[1], high + width)


@compiled
def _descend(
    plant: FloatArray,
    controller: FloatArray,
    degree: int,
    sampling: tuple[float, float],
    bracket: tuple[float, float, float],
    signal: int,
    disk: bool,
) -> tuple[float, float]:
    """Return the smallest squared distance inside a bracket: parabolas through three points of the squared distance."""
    low, middle, high = bracket
    at_low = squared_distance(differences_at(plant, controller, degree, *sampling, low)[signal], disk)
    at_middle = squared_distance(differences_at(plant, controller, degree, *sampling, middle)[signal], disk)
    at_high = squared_distance(differences_at(plant, controller, degree, *sampling, high)[signal], disk)
    for _ in range(_SECTIONS):
        left, right = (middle - low) * (at_middle - at_high), (middle - high) * (at_middle - at_low)
        bottom = 2.0 * (left - right)
        trial = middle - ((middle - low) * left - (middle - high) * right) / bottom if bottom != 0.0 else middle
        if not low < trial < high or abs(trial - middle) < 1e-3 * (high - low):
            trial = 0.5 * (middle + (high if high - middle > middle - low else low))
        if abs(trial - middle) <= 1e-7 * middle:
            break
        value = squared_distance(differences_at(plant, controller, degree, *sampling, trial)[signal], disk)
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
    plant: FloatArray,
    controller: FloatArray,
    degree: int,
    sampling: tuple[float, float],
    omega: FloatArray,
    points: ComplexArray,
    signal: int,
    found: FloatArray,
) -> None:
    """Update gain, phase and delay margin with every crossover between neighbouring points."""
    end = points[-1] - 1.0
    # At the Nyquist frequency the loop is real, unless an ideal derivative makes it infinite.
    if end.real < 0.0 and abs(end.imag) < _REAL * abs(end.real):
        found[GAIN_DB] = min(found[GAIN_DB], abs(20.0 * np.log10(-end.real)))
    for k in range(len(omega) - 1):
        one, two = points[k] - 1.0, points[k + 1] - 1.0
        if (one.imag > 0.0) != (two.imag > 0.0) and (one.real < 0.0 or two.real < 0.0):
            at = _root(plant, controller, degree, sampling, (omega[k], omega[k + 1]), signal, True)
            loop = differences_at(plant, controller, degree, *sampling, at)[signal] - 1.0
            if loop.real < 0.0:
                found[GAIN_DB] = min(found[GAIN_DB], abs(20.0 * np.log10(-loop.real)))
        if (abs(one) > 1.0) != (abs(two) > 1.0):
            at = _root(plant, controller, degree, sampling, (omega[k], omega[k + 1]), signal, False)
            loop = differences_at(plant, controller, degree, *sampling, at)[signal] - 1.0
            angle = np.angle(-loop)
            found[PHASE_RAD] = min(found[PHASE_RAD], abs(angle))
            found[DELAY_S] = min(found[DELAY_S], (angle if angle > 0.0 else angle + 2.0 * np.pi) / at)


@compiled
def _root(
    plant: FloatArray,
    controller: FloatArray,
    degree: int,
    sampling: tuple[float, float],
    bracket: tuple[float, float],
    signal: int,
    of_phase: bool,
) -> float:
    """Return where L crosses the real axis, or the unit circle, in a bracket with a change of sign."""
    low, high = bracket
    first = differences_at(plant, controller, degree, *sampling, low)[signal] - 1.0
    side = first.imag > 0.0 if of_phase else abs(first) > 1.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        loop = differences_at(plant, controller, degree, *sampling, middle)[signal] - 1.0
        if (loop.imag > 0.0 if of_phase else abs(loop) > 1.0) == side:
            low = middle
        else:
            high = middle
        if high - low <= 1e-12 * high:
            break
    return 0.5 * (low + high)
