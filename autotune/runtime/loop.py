"""Whether a control law is stable on a certified plant, in plain arithmetic: the exact sampled loop and its powers.

A checksum can be made anew with any number in the file. What a law does with the plant that the file names cannot, and
is found here in milliseconds, without a library. `autotune export` and `validate` prove it over the whole domain.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import mul
from typing import Any

from problems.model.difference import BIQUAD_0, controller_step

from .law import AxisLaw

Matrix = list[list[float]]

MOST_STATES = 48
"""Loops with more states (a delay of more than some 40 periods) are left to `export` and `validate`."""
# The norm of the 2^22-th power distinguishes a decay of less than 1e-5 per period from none.
_SQUARINGS, _SURELY_GROWS = 22, 200.0
_TAYLOR_TERMS = 16
# A delay this close to a whole number of samples is that number.
_WHOLE = 1e-9
_SAME = 1e-6
_CONTROL = 6


@dataclass(frozen=True, kw_only=True)
class LoopPlant:
    """One plant of a domain, in N, m, kg or N·m, rad, kg·m²; `numerator` and `denominator` descend in powers of s."""

    numerator: Sequence[float]
    denominator: Sequence[float]
    delay_s: float
    coupling_stiffness: float
    coupling_damping: float
    mass: float
    drag: float
    stiffness: float
    damping: float
    environment_mass: float
    filter_s: float


def corner_plants(domain: Mapping[str, Any], *, turns: bool) -> list[LoopPlant]:
    """Return the nominal plant at the ends of K_e and M_p, and in free space; none where the wrench is delayed.

    `domain` is an entry of `certificate.domain` as in the file.
    """
    wrench = domain.get("wrench_filter", {})
    if wrench.get("delay_s", 0.0) != 0.0:
        return []
    force, mass, rest = ("n_m", "inertia_kg_m2", "rad") if turns else ("n", "mass_kg", "m")
    low, high = domain[f"environment_stiffness_{force}_per_{rest}"]
    damping = f"damping_{force}_s_per_{rest}"
    return [
        LoopPlant(
            numerator=domain["robot_numerator"],
            denominator=domain["robot_denominator"],
            delay_s=domain["delay_s"],
            coupling_stiffness=domain[f"coupling_stiffness_{force}_per_{rest}"],
            coupling_damping=domain[f"coupling_{damping}"],
            mass=carried,
            drag=domain[f"drag_{force}_s_per_{rest}"],
            stiffness=stiffness,
            damping=domain[f"environment_{damping}"] if stiffness > 0.0 else 0.0,
            environment_mass=domain[f"environment_{mass}"] if stiffness > 0.0 else 0.0,
            filter_s=wrench.get("time_constant_s", 0.0),
        )
        for carried in dict.fromkeys(domain[f"payload_{mass}"])
        for stiffness in dict.fromkeys((0.0, low, high))
    ]


def is_stable(axis: AxisLaw, plant: LoopPlant) -> bool:
    """Return whether every mode of the sampled loop decays; that of free space, which goes nowhere, may stay.

    A loop of more than `MOST_STATES` states is not looked at, and passes. False also where the plant is none: a robot
    that does not go where it is sent (r(0) is not 1), or whose numbers overflow.
    """
    try:
        if plant.delay_s / axis.sample_time_s + len(plant.denominator) + 2 > MOST_STATES:
            return True
        loop, stays = _closed(axis, _Sampled(plant, axis.sample_time_s))
        if plant.stiffness == 0.0:
            moved = [sum(map(mul, row, stays)) for row in loop]
            if max(abs(new - old) for new, old in zip(moved, stays, strict=True)) > _SAME * max(map(abs, stays)):
                return False
            # Wielandt's deflation: the mode that stays goes to 0, the others are as they were.
            length = sum(map(mul, stays, stays))
            loop = [
                [value - v * w / length for value, w in zip(row, stays, strict=True)]
                for row, v in zip(loop, stays, strict=True)
            ]
        return _decays(loop)
    except (ArithmeticError, ValueError, IndexError):
        return False


class _Sampled:
    """The plant under a zero-order hold with its delay: s⁺ = phi s + older u_{k−d−1} + newer u_{k−d}, x and F of it."""

    def __init__(self, plant: LoopPlant, h: float) -> None:
        a, b, self.position, self.force, self.direct = _continuous(plant, h)
        self.payload = len(plant.denominator) - 1
        samples = plant.delay_s / h
        self.whole = math.floor(samples + _WHOLE)
        fraction = samples - self.whole
        self.phi, self.newer = _hold(a, b, 1.0)
        self.older = [0.0] * len(b)
        self.is_split = fraction > _WHOLE
        if self.is_split:
            _, last = _hold(a, b, 1.0 - fraction)
            self.older, self.newer = [both - each for both, each in zip(self.newer, last, strict=True)], last


def _continuous(plant: LoopPlant, h: float) -> tuple[Matrix, list[float], list[float], list[float], float]:
    """Return A, B, rows of x and F, and F's share of the input, over τ = t/h, of (robot, x_p, h v_p, F_m/K_s).

    x = r(s) x^d; F = K_s (x_p − x) + B_s (v_p − v); M_p dv_p/dt = −F − B_p v_p − F_e (docs/method.md, "The loop").
    """
    lead, n = plant.denominator[0], len(plant.denominator) - 1
    den = [value / lead for value in reversed(plant.denominator)]
    num = [value / lead for value in reversed(plant.numerator)] + [0.0] * (n - len(plant.numerator))
    size = n + (3 if plant.filter_s > 0.0 else 2)
    a = [[0.0] * size for _ in range(size)]
    for i in range(n - 1):
        a[i][i + 1] = 1.0
    a[n - 1][:n] = [-den[i] * h ** (n - i) for i in range(n)]
    b = [0.0] * size
    b[n - 1] = den[0] * h**n
    position = [num[i] / den[0] / h**i for i in range(n)] + [0.0] * (size - n)
    velocity = [sum(position[j] * a[j][i] for j in range(n)) for i in range(n)]
    k_s, b_s = plant.coupling_stiffness, plant.coupling_damping / h
    force = [-k_s * position[i] - b_s * velocity[i] for i in range(n)] + [k_s, b_s] + [0.0] * (size - n - 2)
    direct = -b_s * position[n - 1] * b[n - 1]
    scale = h * h / (plant.mass + plant.environment_mass)
    a[n][n + 1] = 1.0
    a[n + 1] = [-scale * value for value in force]
    a[n + 1][n] -= scale * plant.stiffness
    a[n + 1][n + 1] -= scale * (plant.drag + plant.damping) / h
    b[n + 1] = -scale * direct
    if plant.filter_s > 0.0:
        # F_m over K_s, a length as the other states: in newtons the exponential would lose its digits.
        rate = h / plant.filter_s
        a[n + 2] = [rate / k_s * value for value in force]
        a[n + 2][n + 2] = -rate
        b[n + 2] = rate / k_s * direct
        force, direct = [0.0] * (size - 1) + [k_s], 0.0
    return a, b, position, force, direct


def _hold(a: Matrix, b: Sequence[float], duration: float) -> tuple[Matrix, list[float]]:
    """Return exp(A·duration) and ∫ exp(A σ) B dσ over the duration: a Taylor series of small arguments, squared."""
    n = len(b)
    whole = [[value * duration for value in (*row, each)] for row, each in zip(a, b, strict=True)] + [[0.0] * (n + 1)]
    halvings = max(0, math.ceil(math.log2(max(2.0 * _norm(whole), 1.0))))
    small = [[math.ldexp(value, -halvings) for value in row] for row in whole]
    out = [[value + (i == j) for j, value in enumerate(row)] for i, row in enumerate(small)]
    term = small
    for k in range(2, _TAYLOR_TERMS):
        term = [[value / k for value in row] for row in _product(term, small)]
        out = [[x + y for x, y in zip(*rows, strict=True)] for rows in zip(out, term, strict=True)]
    for _ in range(halvings):
        out = _product(out, out)
    return [row[:n] for row in out[:n]], [row[n] for row in out[:n]]


def _closed(axis: AxisLaw, plant: _Sampled) -> tuple[Matrix, list[float]]:
    """Return the loop's matrix over (plant, past commands, controller), and the state that stays in free space."""
    n, chain = len(plant.phi), plant.whole + plant.is_split
    size = n + chain + _CONTROL
    columns = [_next(axis, plant, [float(i == j) for i in range(size)]) for j in range(size)]
    loop = [list(row) for row in zip(*columns, strict=True)]
    rest = [1.0] + [0.0] * (n - 1)
    rest[plant.payload] = 1.0
    return loop, [*rest, *[1.0] * chain, 1.0, 0.0, -axis.blocks[2, 0], 0.0, 0.0, 0.0]


def _next(axis: AxisLaw, plant: _Sampled, state: list[float]) -> list[float]:
    """Return the state of the loop one period later."""
    n = len(plant.phi)
    s, past = state[:n], state[n : len(state) - _CONTROL]
    control = (state[-6], state[-5], state[-4], state[-3], state[-2], state[-1])
    position = sum(map(mul, plant.position, s))
    lag = plant.whole + plant.is_split
    force = sum(map(mul, plant.force, s))
    if lag > 0:
        force += plant.direct * past[lag - 1]
        command, following = controller_step(axis.blocks, control, force, position)
    else:
        # The command acts on the force within the period: solved for, since both are linear.
        command, _ = controller_step(axis.blocks, control, force, position)
        command /= 1.0 - (axis.blocks[0, 0] + axis.blocks[1, 0]) * axis.blocks[BIQUAD_0] * plant.direct
        _, following = controller_step(axis.blocks, control, force + plant.direct * command, position)
    sent = [command, *past]
    newer, older = sent[plant.whole], sent[plant.whole + 1] if plant.is_split else 0.0
    moved = [
        sum(map(mul, row, s)) + first * older + second * newer
        for row, first, second in zip(plant.phi, plant.older, plant.newer, strict=True)
    ]
    return [*moved, *sent[: len(past)], *following]


def _decays(loop: Matrix) -> bool:
    """Return whether the powers of a matrix go to 0: once a norm of one is below 1, all that follow do."""
    log_norm, power = 0.0, loop
    for _ in range(_SQUARINGS):
        size = _norm(power)
        if not math.isfinite(size):
            return False
        log_norm += math.log(size) if size > 0.0 else -math.inf
        if log_norm < 0.0:
            return True
        if log_norm > _SURELY_GROWS:
            return False
        power = [[value / size for value in row] for row in power]
        power, log_norm = _product(power, power), 2.0 * log_norm
    return False


def _norm(matrix: Matrix) -> float:
    return max(sum(map(abs, row)) for row in matrix)


def _product(left: Matrix, right: Matrix) -> Matrix:
    columns = list(zip(*right, strict=True))
    return [[sum(map(mul, row, column)) for column in columns] for row in left]
