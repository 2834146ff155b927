"""The noise of the command from the polynomials of a loop, compiled; `problems.stability.noise` is the exact form.

White noise of the force n and of the position m reach the command as x^d = (S n − T m) D/P, with the polynomials in w
of `problems.stability.polynomials`: P of the closed loop, D of the plant, S and T what multiplies F and x in P. Its
speed is 2w/(h (1 + w)) x^d, and since dωh = 2 dy/(1 + y²) at w = jy its mean square is the integral of a rational
function along the imaginary axis, which the Routh array gives (Åström, *Introduction to Stochastic Control Theory*,
1970, chapter 5).
"""

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from .polynomials import CONTROLLER_POWERS, DENOMINATOR, FED, SENSED, controller_in_w, loop_polynomial

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
