"""The noise of the command from the polynomials of a loop, compiled; `problems.stability.noise` is the exact form.

White noise of the force n and of the position m reach the command as x^d = (S n − T m) D/P, with the polynomials in w
of `problems.stability.polynomials`: P of the closed loop, D of the plant, S and T what multiplies F and x in P. Its
speed is 2w/(h (1 + w)) x^d, and since dωh = 2 dy/(1 + y²) at w = jy its mean square is the integral of a rational
function along the imaginary axis, which the Routh array gives (Åström, *Introduction to Stochastic Control Theory*,
1970, chapter 5). With a spectrum it is summed over frequencies.
"""

import numpy as np

from ..arrays import ComplexArray, FloatArray
from ..compiled import compiled
from .polynomials import CONTROLLER_POWERS, DENOMINATOR, FED, OWN, SENSED, controller_in_w, loop_polynomial

# What noises add to the degree of the loop: two powers of 1 + w.
_MORE = 2
_SECOND = 1


@compiled
def command_speed_rms(
    plant: FloatArray,
    first: int,
    controller: FloatArray,
    degree: int,
    sampling: tuple[float, float],
    noises: tuple[float, float],
) -> float:
    """Return the RMS of the commanded speed [m/s] of a stable loop under noise of force and position (their RMS).

    `plant` (3, n) and `controller` (3, CONTROLLER_POWERS) as `loop_polynomial` takes them, `first` the power of w that
    is divided out (1 where the loop has no anchor), `sampling` h and θ. NaN where rounding spoils the array.
    """
    (h, theta), (force, position) = sampling, noises
    below = np.zeros(plant.shape[1] + CONTROLLER_POWERS + _MORE)
    size = loop_polynomial(plant, controller, degree, h, theta, below)
    for _ in range(_MORE):
        size += 1
        for i in range(size, 0, -1):
            below[i] += below[i - 1]
    in_w = controller_in_w(controller, degree, h, theta)
    variance = 0.0
    for row, rms in ((SENSED, force), (FED, position)):
        if rms > 0.0:
            above = np.zeros(len(below))
            for i in range(degree + 1):
                for j in range(plant.shape[1]):
                    above[i + j + 1] += in_w[row, i] * plant[DENOMINATOR, j]
            variance += rms * rms * _integral(above[first : size + 1], below[first : size + 1])
    # 2/h of the difference, twice 1/(2π) of the angle.
    return float(np.sqrt(2.0 * variance) * 2.0 / h)


@compiled
def _integral(above: FloatArray, below: FloatArray) -> float:
    """Return the mean of |B/A|² along the imaginary axis, ∫ dy/(2π), of ascending powers; the degree of B is lower."""
    a, b, total = below[::-1].copy(), above[::-1].copy(), 0.0
    # Descending powers; the first of B is none. Each round takes the highest power off.
    for order in range(len(below) - 1, 0, -1):
        highest, second = a[0], a[1]
        if not highest * second > 0.0:
            return np.nan
        falls, share = highest / second, b[_SECOND] / second
        total += share * share / (2.0 * falls)
        for i in range(order):
            if i % 2 == 0:
                b[i] = b[i + 1] - share * a[i + 1]
                a[i] = a[i + 1]
            else:
                b[i] = b[i + 1]
                a[i] = a[i + 1] - (falls * a[i + 2] if i + 2 <= order else 0.0)
    return total


@compiled
def controller_at(
    controller: FloatArray, degree: int, tangent: FloatArray, h: float, theta: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return from force to command, and from position to command, of a law without a plant (k,), at tan(ωh/2) (k,)."""
    forward, fed = np.empty(len(tangent), dtype=np.complex128), np.empty(len(tangent), dtype=np.complex128)
    for k in range(len(tangent)):
        w = 1j * tangent[k]
        s = (2.0 / h) * w / (1.0 + (2.0 * theta - 1.0) * w)
        own, sensed, back = 0.0 + 0.0j, 0.0 + 0.0j, 0.0 + 0.0j
        for i in range(degree, -1, -1):
            own = own * s + controller[OWN, i]
            sensed = sensed * s + controller[SENSED, i]
            back = back * s + controller[FED, i]
        forward[k], fed[k] = sensed / own, back / own
    return forward, fed


@compiled
def spectral_ratio(
    law: tuple[ComplexArray, ComplexArray],
    force: ComplexArray,
    position: ComplexArray,
    shares: tuple[FloatArray, FloatArray],
) -> float:
    """Return what a spectrum makes of the command's RMS per what white noise does, summed over frequencies.

    `shares` (k,) of the power of both noises weigh |x^d/n|² of a loop, by the responses (k,) of law and plant.
    """
    (forward, fed), (spectral, white) = law, shares
    of_spectrum, of_white = 0.0, 0.0
    for k in range(len(white)):
        below = 1.0 + fed[k] * position[k] - forward[k] * force[k]
        gain = (forward[k].real * forward[k].real + forward[k].imag * forward[k].imag) / (
            below.real * below.real + below.imag * below.imag
        )
        of_spectrum += spectral[k] * gain
        of_white += white[k] * gain
    return float(np.sqrt(of_spectrum / of_white))
