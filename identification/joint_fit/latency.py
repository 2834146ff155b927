"""How late the wrench is against pose and command: a shift in time of one signal, fitted beside everything else."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from .problem import Point, Problem
from .solve import information, linearise, minimise

FloatArray = NDArray[np.float64]

_ROUNDS = 6
_STEPS = 4
_SETTLED = 0.1
_SIGNIFICANT_STDS = 2.0
_BETWEEN_SAMPLES, _BLURRED_SAMPLES = 0.03, 0.06


@dataclass(frozen=True, kw_only=True)
class Lag:
    """The force is stamped `seconds` ± `std_s` late; `applied_s` of it was taken out of the problem's force.

    Where `is_filter`, that is the time constant of a first-order low-pass, which the problem's prediction passes.
    Where `is_whole`, it is a number of samples that is deeper than what lies about it.
    `evidence` is by how much −2 log L prefers that to a delay, None where the two were not compared.
    """

    seconds: float
    std_s: float
    applied_s: float
    is_filter: bool = False
    is_whole: bool = False
    evidence: float | None = None


def fit_lag(
    problem: Problem,
    point: Point,
    force_n: FloatArray,
    prior: tuple[float, float],
    applied_s: float,
    *,
    blurred: bool,
) -> tuple[Problem, Point, Lag]:
    """Fit the wrench's lag, take it out where it shows, and fit all again; the problem then doubts what is left of it.

    `force_n` (n,) is the force as logged, `prior` the lag's mean and deviation [s], `applied_s` what the problem's
    force is already shifted by. One Gauss-Newton step of the lag beside all other parameters, -F'(t) being what it does
    to the force, repeated while it moves. A lag within two deviations of what is applied is left where it is: shifting
    interpolates the noise. `blurred`: the command is a mean over every sample.
    """
    period = problem.signals.period_s
    for _ in range(_ROUNDS):
        step, std = step_lag(problem, point, prior, applied_s)
        if abs(step) < _SIGNIFICANT_STDS * std:
            break
        applied_s += step
        signals = replace(problem.signals, force_n=sooner(force_n, applied_s / period))
        problem = replace(problem, signals=signals)
        point, _ = minimise(problem, point, _STEPS)
        if abs(step) < _SETTLED * std:
            break
    step, std = step_lag(problem, point, prior, applied_s)
    if blurred or applied_s != 0.0:
        # Between its samples the force has the steps of the held command, which no spline and no mean knows.
        std = float(np.hypot(std, (_BLURRED_SAMPLES if blurred else _BETWEEN_SAMPLES) * period))
    # What may be left: the deviation, and the part that was not worth a shift.
    left = float(np.hypot(std, step))
    problem = replace(problem, signals=replace(problem.signals, lag_std_s=left))
    return problem, point, Lag(seconds=applied_s + step, std_s=std, applied_s=applied_s)


def sooner(force_n: FloatArray, samples: float) -> FloatArray:
    """Return the force (n,) that was logged `samples` later, by a cubic spline."""
    if samples == 0.0:
        return force_n
    ticks = np.arange(len(force_n), dtype=np.float64)
    return np.asarray(make_interp_spline(ticks, force_n, k=3)(np.clip(ticks + samples, 0.0, ticks[-1])))


def step_lag(problem: Problem, point: Point, prior: tuple[float, float], applied_s: float) -> tuple[float, float]:
    """Return by how much the lag should grow, and its deviation with all other parameters free [s]."""
    mean, std = prior
    blocks = linearise(replace(problem, signals=replace(problem.signals, lag_std_s=std)), point)
    count = len(problem.layout)
    matrix, gradient = information(blocks, count)
    free = np.setdiff1d(np.arange(count), problem.fixed)
    coupled, own, slope = np.zeros(count), 1.0, (mean - applied_s) / std
    for block in blocks:
        if block.doubts is not None:
            column = block.doubts[:, -1]
            coupled[block.indices] += block.jacobian.T @ column
            own += float(column @ column)
            slope += float(column @ block.residual)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix)[free], 1e-300))
    inverse = np.linalg.pinv(matrix[np.ix_(free, free)] * np.outer(scale, scale), hermitian=True)
    inverse *= np.outer(scale, scale)
    left = own - float(coupled[free] @ inverse @ coupled[free])
    step = (slope - float(coupled[free] @ inverse @ gradient[free])) / left
    return float(step * std), float(std / np.sqrt(left))
