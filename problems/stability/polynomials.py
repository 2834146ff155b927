"""The sampled loop as polynomials in w = (z − 1)/(z + 1): the fast form for stability and margins.

The unit disk becomes the left half-plane and z = exp(jωh) becomes w = j tan(ωh/2), so stability is the test of Hurwitz.
The Tustin form of a controller is the continuous one with s = 2w/h; the other forms differ by ρ = 1 + (2θ − 1) w in
s = (2/h) w/ρ. Poles that crowd around z = 1 lie apart in w, where double precision is enough; where it is not, the
test says so and eigenvalues decide. The exact loop of `problems.model.sampled` is the oracle.
"""

import numpy as np

from ..arrays import FloatArray
from ..compiled import compiled
from ..model.controller import biquad_in_s, forward_in_s
from ..model.difference import PLAIN_PARAMETERS

STABLE, UNSTABLE, DOUBTFUL = 1, 0, -1
# Rows of the plant's polynomials and, without whole delays, of what `plant_at` takes; rows of a controller's.
DENOMINATOR, FORCE, POSITION, DELAY = 0, 1, 2, 3
OWN, SENSED, FED = 0, 1, 2
# An entry of the Routh array that is this small against its terms decides nothing.
_CANCELLED = 1e-6
# The delay chain is a power of 1 + w, whose coefficients hold its roots ever less well: from degree 100 or so the
# rounded polynomial is another one. Far below that, eigenvalues decide.
_HIGHEST_DEGREE = 64
# Coefficients of the controller's polynomials in s: M_a s² + B_a s with two filters and a biquad, and room to
# multiply in.
CONTROLLER_POWERS = 9


@compiled
def plant_polynomials(
    phi: FloatArray,
    gamma: FloatArray,
    gamma_old: FloatArray,
    outputs: FloatArray,
    delay: tuple[int, int, float],
    free: bool,
) -> FloatArray:
    """Return the denominator and the numerators of F/x^d and x/x^d, (3, n + chain + 1), ascending powers of w.

    `outputs` holds the rows of x and F over (state, held command, outside force). In free space F vanishes at rest;
    that coefficient is set to zero exactly.
    """
    n, (whole, chain, _) = len(gamma), delay
    size = n + chain + 1
    shifted = np.eye(n) + phi
    matrix = np.linalg.solve(shifted, phi - np.eye(n))
    inputs = np.linalg.solve(shifted, np.ascontiguousarray(np.stack((gamma, gamma_old)).T))
    # Faddeev and LeVerrier: det(wI − W), and adj(wI − W) applied to the inputs, one power at a time.
    base, numerators = np.zeros(n + 1), np.zeros((2, 2, n + 1))
    base[n] = 1.0
    adjugate = np.eye(n)
    for k in range(n - 1, -1, -1):
        reached = adjugate @ inputs
        for i in range(2):
            for j in range(2):
                numerators[i, j, k] = np.sum(outputs[1 - i, :n] * reached[:, j])
        product = matrix @ adjugate
        base[k] = -np.trace(product) / (n - k)
        adjugate = product + base[k] * np.eye(n)
    newer, older = 0, 1
    falling, rising = np.array([1.0, -1.0]), np.array([1.0, 1.0])
    out = np.zeros((3, size))
    out[DENOMINATOR] = _times_power(base, rising, chain, size)
    for i in range(2):
        one = _times_power(numerators[i, newer], falling, 1, size)
        if chain > whole:
            one = _times_power(one, rising, 1, size) + _times_power(numerators[i, older], falling, 2, size)
        direct = _times_power(base, falling if chain > whole else rising, 1 if chain > whole else 0, size)
        out[FORCE + i] = _times_power(one + outputs[1 - i, n] * direct, falling, whole, size)
    if free:
        out[FORCE, 0] = 0.0
    return out


@compiled
def _times_power(polynomial: FloatArray, factor: FloatArray, power: int, size: int) -> FloatArray:
    """Return polynomial·(c_0 + c_1 w)^power, cut to `size` coefficients."""
    out = np.zeros(size)
    count = min(len(polynomial), size)
    out[:count] = polynomial[:count]
    c_0, c_1 = factor[0], factor[1]
    for _ in range(power):
        for i in range(size - 1, 0, -1):
            out[i] = c_0 * out[i] + c_1 * out[i - 1]
        out[0] = c_0 * out[0]
    return out


@compiled
def controller_polynomials(parameters: FloatArray, ideal: bool, out: FloatArray) -> int:
    """Write what multiplies denominator, F and x in the loop's polynomial, ascending powers of s; return their degree.

    With A(1 + C_ff) = (1 + K_l s)/(s (M_a s + B_a)): s (M_a s + B_a) D − (1 + K_l s)(F + P̂ O_a X) + s (M_a s + B_a)
    C_fb X, times the filters' denominators as far as they are in use; with a biquad its numerator multiplies what
    comes from the force, its denominator the rest.
    """
    numerator, denominator = forward_in_s(parameters)
    feedback, corner, acceleration, compensation = parameters[3], parameters[4], parameters[5], parameters[6]
    filtered = compensation > 0.0 and not ideal
    out[:] = 0.0
    for power, each in enumerate(denominator):
        out[OWN, power] = each
    for power, each in enumerate(numerator):
        out[SENSED, power] = each
    degree = 2
    if compensation > 0.0:
        gain = compensation * corner * acceleration if filtered else compensation
        for power, each in enumerate(numerator):
            out[FED, power + 2] = -gain * each
        if ideal and numerator[1] > 0.0:
            degree = 3
    if feedback > 0.0 or filtered:
        for row in range(3 if ideal else 2):
            _times_filter(out, row, corner)
        degree += 1
    if filtered:
        for row in range(2):
            _times_filter(out, row, acceleration)
        degree += 1
    degree += _times_biquad(parameters, out)
    if feedback > 0.0:
        _add_feedback(parameters, filtered, out)
    return degree


@compiled
def _add_feedback(parameters: FloatArray, filtered: bool, out: FloatArray) -> None:
    """Add s (M_a s + B_a) B_fb ω_v s, times s + ω_a when that filter is there, and times the biquad's denominator."""
    feedback, corner, acceleration = parameters[3], parameters[4], parameters[5]
    _, (_, damping, mass) = forward_in_s(parameters)
    gain, share = feedback * corner, 1.0 if filtered else 0.0
    c_2 = gain * damping * (acceleration if filtered else 1.0)
    c_3 = gain * (mass * (acceleration if filtered else 1.0) + share * damping)
    c_4 = gain * share * mass
    out[FED, 2] += c_2
    out[FED, 3] += c_3
    out[FED, 4] += c_4
    if len(parameters) > PLAIN_PARAMETERS:
        _, (_, d_1, d_2) = biquad_in_s(parameters)
        out[FED, 3] += d_1 * c_2
        out[FED, 4] += d_1 * c_3 + d_2 * c_2
        out[FED, 5] += d_1 * c_4 + d_2 * c_3
        out[FED, 6] += d_2 * c_4


@compiled
def _times_biquad(parameters: FloatArray, out: FloatArray) -> int:
    """Multiply what comes from the force by the biquad's numerator, the rest by its denominator; return its degree."""
    if len(parameters) == PLAIN_PARAMETERS:
        return 0
    (_, n_1, n_2), (_, d_1, d_2) = biquad_in_s(parameters)
    _times_quadratic(out, OWN, d_1, d_2)
    _times_quadratic(out, SENSED, n_1, n_2)
    # So far that is the compensation alone, which passes the biquad too.
    _times_quadratic(out, FED, n_1, n_2)
    return 2


@compiled
def _times_quadratic(out: FloatArray, row: int, linear: float, quadratic: float) -> None:
    """Multiply a row by 1 + linear s + quadratic s²."""
    for i in range(out.shape[1] - 1, 1, -1):
        out[row, i] += linear * out[row, i - 1] + quadratic * out[row, i - 2]
    out[row, 1] += linear * out[row, 0]


@compiled
def _times_filter(out: FloatArray, row: int, corner: float) -> None:
    """Multiply a row by s + corner."""
    for i in range(out.shape[1] - 1, 0, -1):
        out[row, i] = corner * out[row, i] + out[row, i - 1]
    out[row, 0] *= corner


@compiled
def controller_in_w(controller: FloatArray, degree: int, h: float, theta: float) -> FloatArray:
    """Return a controller's polynomials (3, CONTROLLER_POWERS) in w, all times the same power of h/2 and ρ."""
    in_w, power = np.zeros((3, CONTROLLER_POWERS)), np.zeros(CONTROLLER_POWERS)
    slope, scale = 2.0 * theta - 1.0, 2.0 / h
    for k in range(degree + 1):
        # (2/h)^k w^k ρ^(degree − k)
        power[:] = 0.0
        power[k] = scale ** (k - degree)
        for _ in range(degree - k if slope != 0.0 else 0):
            for i in range(degree, 0, -1):
                power[i] += slope * power[i - 1]
        for row in range(3):
            for i in range(k, degree + 1):
                in_w[row, i] += controller[row, k] * power[i]
    return in_w


@compiled
def loop_polynomial(
    plant: FloatArray, controller: FloatArray, degree: int, h: float, theta: float, out: FloatArray
) -> int:
    """Write the characteristic polynomial of the closed loop into `out`, ascending powers of w; return its degree."""
    order = int(plant.shape[1] - 1)
    in_w = controller_in_w(controller, degree, h, theta)
    out[: order + degree + 1] = 0.0
    for i in range(degree + 1):
        for j in range(order + 1):
            out[i + j] += (
                in_w[OWN, i] * plant[DENOMINATOR, j]
                - in_w[SENSED, i] * plant[FORCE, j]
                + in_w[FED, i] * plant[POSITION, j]
            )
    return order + degree


@compiled
def hurwitz(polynomial: FloatArray, degree: int, first: int) -> int:
    """Return whether Σ c_k w^k, k from `first` on (divided by w^first), has all its roots left of the axis.

    Routh's array; STABLE, UNSTABLE, or DOUBTFUL where rounding could decide.
    """
    if degree > _HIGHEST_DEGREE:
        return DOUBTFUL
    sign = 1.0 if polynomial[degree] > 0.0 else -1.0
    count = degree - first + 1
    upper, lower, following = (np.zeros(count // 2 + 2), np.zeros(count // 2 + 2), np.zeros(count // 2 + 2))
    for i in range(count):
        value = sign * polynomial[degree - i]
        if not value > 0.0:
            return UNSTABLE if value < 0.0 else DOUBTFUL
        if i % 2 == 0:
            upper[i // 2] = value
        else:
            lower[i // 2] = value
    for row in range(count - 2):
        ratio, width = upper[0] / lower[0], (count - row) // 2
        if abs(upper[1] - ratio * lower[1]) <= _CANCELLED * (upper[1] + ratio * lower[1]):
            return DOUBTFUL
        for i in range(width):
            following[i] = upper[i + 1] - ratio * lower[i + 1]
        if following[0] < 0.0:
            return UNSTABLE
        for i in range(width + 1):
            upper[i] = lower[i]
            lower[i] = following[i] if i < width else 0.0
    return STABLE
