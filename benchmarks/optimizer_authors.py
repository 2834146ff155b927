"""The formulation of the paper's authors: a continuous loop, Padé's delay, Routh's table, H2 norms, one start of IPOPT.

Written from the equations (docs/method.md, "The loop"), after the public design notebook of the authors, which asks
for Routh's first column to be positive at a few stiffnesses and lets IPOPT maximise the H2 norm of the admittance. The
payload, which that notebook does not have, is in the loop here. Polynomials are ascending lists of coefficients of
σ = s/ω_0.
"""

from collections.abc import Sequence
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from autotune.tuning.bounds import Box
from benchmarks.optimizer_ipopt import PAPER_DESIGN, design_of, ipopt_options
from benchmarks.optimizer_judge import DIMENSION, SEEN, Trace, solution_noter
from problems.design.problem import DesignProblem
from problems.design.uncertainty import Scenario

Goal = Literal["contact", "admittance"]
Polynomial = list[Any]

_RATE = 100.0
_PADE_ORDER = 4
# The hold delays by half a sample on average (docs/method.md, "The loop").
_HOLD_SAMPLES = 0.5
_LEAST_OF_ROUTH = 1e-6
_BAND_POINTS = 20


def run_authors(trace: Trace, seed: int, *, goal: Goal) -> None:  # noqa: ARG001 - one start, nothing is drawn
    """Solve from the paper's gains; what comes out is taken as it is."""
    problem, note = trace.problem, solution_noter(trace)
    start = Box(problem).unit(np.array(PAPER_DESIGN))
    unit = ca.MX.sym("unit", DIMENSION)
    design = design_of(problem, unit)
    controller = ca.SX.sym("controller", DIMENSION)
    symbols = [controller[i] for i in range(DIMENSION)]
    rows, squares = [], []
    for scenario in problem.scenarios(*SEEN):
        closed, error = contact_loop(problem, scenario, symbols)
        rows += [ca.vertcat(*routh_column(closed))]
        squares.append((closed, error))
    gain, below = admittance(problem, symbols)
    rows += [ca.vertcat(*routh_column(below)), _gain_rows(problem, gain, below)]
    if goal == "contact":
        cost = sum(h2_squared(closed, error) for closed, error in squares)
    else:
        cost = -h2_squared(below, gain)
    parts = ca.Function("parts", [controller], [cost, ca.vertcat(*rows)])
    scale = abs(float(parts(design_at(problem, start))[0]))
    value, constraint = parts(design)
    options = {**ipopt_options(trace.left_s()), "ipopt.hessian_approximation": "exact"}
    shape = {"x": unit, "f": value / scale, "g": constraint}
    solver = ca.nlpsol("solver", "ipopt", shape, options)
    found = solver(x0=start, lbx=0.0, ubx=1.0, lbg=0.0, ubg=np.inf)
    note(design_at(problem, found["x"]).full().ravel())
    trace.note = f"{solver.stats()['return_status']} after {solver.stats()['iter_count']} iterations"


def design_at(problem: DesignProblem, unit: Any) -> ca.DM:
    """Return the numbers of a design."""
    return ca.evalf(design_of(problem, ca.MX(ca.DM(unit))))


def contact_loop(
    problem: DesignProblem, scenario: Scenario, controller: Sequence[Any]
) -> tuple[Polynomial, Polynomial]:
    """Return χ and e of F_e − F_e(∞) = e/χ after an impact at the steady speed of the approach.

    With x = W (F^d + F), W = N/D, and κ = K_s + B_s s, the payload's compliance to a force on it is
    Y = (D + κ N)/((M_p s² + B_p s)(D + κ N) + κ D); a wall met at speed v answers with F_e = K v/(s² (1 + K Y)).
    """
    drag, mass = problem.plants.nominal.payload.drag_n_s_per_m, scenario.payload_mass_kg
    wall = [scenario.environment_stiffness_n_per_m, problem.plants.nominal.environment.damping_n_s_per_m * _RATE]
    above, below = position_loop(problem, controller)
    coupling = problem.plants.nominal.coupling
    kappa = [coupling.stiffness_n_per_m, coupling.damping_n_s_per_m * _RATE]
    driven = _sum(below, _product(kappa, above))
    free = _sum(_product([0.0, drag * _RATE, mass * _RATE**2], driven), _product(kappa, below))
    closed = _sum(_product(wall, driven), free)
    force_n, speed_m_s, _, _ = problem.approach.numbers()
    speed = force_n / (controller[1] + drag) if force_n > 0.0 else speed_m_s
    # Free motion has its integrator, so `free` begins with a zero: one s of the two goes.
    force = _product([speed / _RATE], _product(wall, free[1:]))
    rest = force[0] / closed[0]
    # The last part of a wall with damping answers at once and is left out of a norm that it would make infinite.
    error = [_at(force, k) - rest * _at(closed, k) for k in range(1, len(closed))]
    return closed, error


def admittance(problem: DesignProblem, controller: Sequence[Any]) -> tuple[Polynomial, Polynomial]:
    """Return numerator and denominator of G = s W, force to velocity, without its integrator."""
    above, below = position_loop(problem, controller)
    return [each * _RATE for each in above], below[1:]


def position_loop(problem: DesignProblem, controller: Sequence[Any]) -> tuple[Polynomial, Polynomial]:
    """Return N and D of W = A (1 + C_ff) T/(1 + T C_fb), force to position, with T = r e^(−s T_d) by Padé."""
    mass, damping, lead, feedback = controller
    robot, corner = problem.plants.nominal.robot, problem.velocity_filter_rad_per_s
    late, early = pade(robot.delay_s + _HOLD_SAMPLES * problem.sample_time_s, _PADE_ORDER)
    above = _product(_scaled(robot.numerator), late)
    below = _product(_scaled(robot.denominator), early)
    filtered = [corner, _RATE]
    damped = _sum(_product(below, filtered), _product(above, [0.0, feedback * corner * _RATE]))
    forward = _product(_product(above, filtered), [1.0, lead * _RATE])
    return forward, _product([0.0, damping * _RATE, mass * _RATE**2], damped)


def pade(delay_s: float, order: int) -> tuple[Polynomial, Polynomial]:
    """Return numerator and denominator of the diagonal approximation of e^(−s T): Σ c_k (∓s T)^k."""
    coefficients, value = [], 1.0
    for k in range(order + 1):
        coefficients.append(value * (delay_s * _RATE) ** k)
        value *= (order - k) / ((2 * order - k) * (k + 1))
    return [c * (-1.0) ** k for k, c in enumerate(coefficients)], coefficients


def routh_column(polynomial: Polynomial) -> Polynomial:
    """Return Routh's first column of a polynomial made monic, without its leading one; stable where all are above 0."""
    coefficients = [each / polynomial[-1] for each in reversed(polynomial)]
    above, below = coefficients[0::2], coefficients[1::2]
    column = []
    while below:
        column.append(below[0])
        ratio = above[0] / below[0]
        above, below = below, [above[i + 1] - ratio * _at(below, i + 1) for i in range(len(above) - 1)]
    return [each - _LEAST_OF_ROUTH for each in column]


def h2_squared(below: Polynomial, above: Polynomial) -> Any:
    """Return ∫ y² dt of the impulse response of b/a, in units of the scaled time; a must be stable.

    Σ β_k²/(2 α_k) with α_k, β_k the ratios that Routh's table of a takes off a and b (Åström, *Introduction to
    Stochastic Control Theory*, 1970, chapter 5).
    """
    n = len(below) - 1
    a = [each / below[-1] for each in reversed(below)]
    b = [_at(above, n - 1 - k) / below[-1] for k in range(n)]
    total: Any = 0.0
    while b:
        alpha, beta = a[0] / a[1], b[0] / a[1]
        total += beta**2 / (2.0 * alpha)
        b = [b[i] - (beta * a[i + 1] if i % 2 == 0 else 0.0) for i in range(1, len(b))]
        a = [a[i] - (alpha * _at(a, i + 1) if i % 2 == 0 else 0.0) for i in range(1, len(a))]
    return total


def _gain_rows(problem: DesignProblem, above: Polynomial, below: Polynomial) -> Any:
    """Return |G|²/Y_min² − 1 on a grid of the band."""
    target = problem.requirements.free_space_admittance
    if target is None:
        return ca.SX(0, 1)
    sigma = 2.0 * np.pi * np.geomspace(*target.band_hz, _BAND_POINTS) / _RATE
    rows = [_squared(above, w) / _squared(below, w) / target.min_m_s_per_n**2 - 1.0 for w in sigma]
    return ca.vertcat(*rows)


def _squared(polynomial: Polynomial, sigma: float) -> Any:
    even = sum(c * (-1.0) ** (k // 2) * sigma**k for k, c in enumerate(polynomial) if k % 2 == 0)
    odd = sum(c * (-1.0) ** (k // 2) * sigma**k for k, c in enumerate(polynomial) if k % 2 == 1)
    return even**2 + odd**2


def _scaled(descending: NDArray[np.float64]) -> Polynomial:
    return [float(c) * _RATE**k for k, c in enumerate(descending[::-1])]


def _at(polynomial: Polynomial, k: int) -> Any:
    return polynomial[k] if 0 <= k < len(polynomial) else 0.0


def _sum(first: Polynomial, second: Polynomial) -> Polynomial:
    return [_at(first, k) + _at(second, k) for k in range(max(len(first), len(second)))]


def _product(first: Polynomial, second: Polynomial) -> Polynomial:
    found: Polynomial = [0.0] * (len(first) + len(second) - 1)
    for i, a in enumerate(first):
        for j, b in enumerate(second):
            found[i + j] = found[i + j] + a * b
    return found
