"""The robot's closed position loop and its delay, from command to pose."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy
from scipy.fft import irfft, next_fast_len, rfft
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from problems.arrays import FloatArray
from problems.model.robot import RobotModel
from problems.model.sampled import split_delay

from ..errors import EstimateError

_LONGEST_DELAY_S, _LONGEST_SMOOTH_DELAY_S = 0.05, 0.3
_FASTEST_RAD_PER_S = 2e3
_RESOLVED_SHARE = 0.2
_DELAY_STARTS = (0.5, 2.0, 4.0, 8.0, 16.0)
_BANDWIDTH_STARTS_HZ = (2.0, 8.0)
_SMALLEST_TRAVEL_M = 5e-4
_POOR_FIT = 0.1
_STEPS, _STEPS_NEAR = 60, 12
_FINER = 4
_HARDLY_BETTER, _NEAR_SAMPLE = 1.03, 0.5
# A second pole beyond 106 Hz acts as a delay does.
_LIKE_DELAY_S = 1.5e-3
_ONE_SIDED, _TWO_SIDED = 1.645, 1.96
_TELLING_S, _TELLING_SHARE = 20.0, 0.125
# Below this speed dry friction takes whatever value holds the robot.
_SLIDING_M_PER_S = 1e-4


@dataclass(frozen=True, kw_only=True)
class RobotFit:
    """r(s) and T_d with their standard deviations; `fit_error` is residual RMS over motion RMS.

    `effective_samples` is how many independent ones the residual's colour leaves of the samples, `friction_shift` by
    how much ω, (ζ,) T_d (p,) in SI move where dry friction is estimated beside them; the deviations hold it.
    """

    model: RobotModel
    numerator_std: FloatArray
    denominator_std: FloatArray
    delay_std_s: float
    bandwidth_hz: float
    bandwidth_std_hz: float
    fit_error: float
    effective_samples: float
    friction_shift: FloatArray
    second_pole_s: float = 0.0

    @property
    def second_pole_std_s(self) -> float:
        """The part of the delay's deviation that a second pole makes [s]."""
        return self.second_pole_s / _TWO_SIDED


def identify_robot(command_m: FloatArray, position_m: FloatArray, period_s: float, *, is_held: bool = True) -> RobotFit:
    """Fit r(s) e^(-s T_d) to command and measured position, (n,) each, by output error; both start at rest.

    The command is held from sample to sample, or with `is_held` False a smooth one of which the log has samples: one
    of a controller that runs faster than the log, whose hold counts as part of the delay. One pole and two poles are
    tried; the Bayesian information criterion decides. Raises EstimateError if the command hardly moves or no model
    explains the motion.
    """
    longest_s = _LONGEST_DELAY_S if is_held else _LONGEST_SMOOTH_DELAY_S
    command, position = command_m - command_m[0], position_m - command_m[0]
    travel = float(np.ptp(command))
    if travel < _SMALLEST_TRAVEL_M:
        raise EstimateError(
            f"The position command moves by {travel * 1e3:.3f} mm only, too little to identify the robot; record a "
            "commanded sweep of 0.5 to 50 Hz with at least a few millimetres at its slow end."
        )
    answer = partial(robot_response, command=command, period_s=period_s) if is_held else _smooth(command, period_s)
    informative = _informative_part(command, period_s)
    fits = [_fit(answer, position, period_s, order, longest_s, informative) for order in (1, 2)]
    near_s = fits[0].delay_s - fits[1].delay_s
    if (
        not is_held
        and fits[0].residual_rms < _HARDLY_BETTER * fits[1].residual_rms
        and near_s < _NEAR_SAMPLE * period_s
    ):
        # What a spline through the samples leaves out looks like a second pole near the log's rate: it is delay.
        fits = fits[:1]
    # One count of independent samples for all: criteria of different counts cannot be compared.
    effective = min(fits, key=lambda fit: fit.residual_rms).effective_samples
    chosen = min(fits, key=lambda fit: fit.criterion(effective))
    error = chosen.residual_rms / float(np.std(position))
    if error > _POOR_FIT:
        raise EstimateError(
            f"No first- or second-order robot with a delay up to {longest_s * 1e3:.0f} ms explains the motion "
            f"(residual {100 * error:.0f} % of it); check that the command topic is the position command that this "
            "robot follows, in the same frame and unit as the measured pose."
        )
    fastest = _RESOLVED_SHARE / period_s
    if find_bandwidth_hz(_model(chosen.order, chosen.parameters, period_s)) > fastest:
        raise EstimateError(
            "The measured pose follows the command as if there were no robot between them (a bandwidth above the "
            f"{fastest:.0f} Hz that this rate resolves); check that the pose is measured and no echo of the command."
        )
    if chosen.delay_s > 0.999 * longest_s:
        raise EstimateError(
            f"The measured pose follows the command later than {longest_s * 1e3:.0f} ms, the most that is "
            "searched; check that the header stamps of command and pose come from one clock."
        )
    return _described(chosen, error, effective)


@dataclass(frozen=True, kw_only=True)
class _Fit:
    order: int
    parameters: FloatArray  # log ω [rad/s], (ζ,) 1 + delay in samples
    period_s: float
    covariance: FloatArray
    residual_rms: float
    effective_samples: float
    moved: FloatArray
    second_pole_s: float

    @property
    def delay_s(self) -> float:
        """The delay as the last parameter says it."""
        return float(self.parameters[-1] - 1.0) * self.period_s

    def criterion(self, effective_samples: float) -> float:
        """Return the Bayesian information criterion; the constant offset counts as a parameter."""
        misfit = 2.0 * effective_samples * np.log(max(self.residual_rms, 1e-15))
        return float(misfit + (len(self.parameters) + 1) * np.log(effective_samples))


def robot_response(model: RobotModel, command: FloatArray, period_s: float, count: int | None = None) -> FloatArray:
    """Return the sampled position of the held robot, starting at rest at zero; of the first `count` samples."""
    command = command[:count]
    whole, fraction = split_delay(model.delay_s, period_s)
    numerator, denominator = held_robot(model, period_s, fraction)
    late = np.concatenate([np.zeros(whole), command[: len(command) - whole]])
    return np.asarray(scipy.signal.lfilter(numerator, denominator, late))


def _smooth(command: FloatArray, period_s: float) -> Callable[..., FloatArray]:
    """Return the answer (count,) of a robot to the cubic spline through the command, steady before its first sample.

    The spline is straight between points that lie four times as close.
    """
    path = CubicSpline(np.arange(len(command)) * period_s, command)
    step = period_s / _FINER

    def answer(model: RobotModel, count: int | None = None) -> FloatArray:
        samples = len(command) if count is None else count
        time = np.arange(samples * _FINER) * step - model.delay_s
        late = path(np.clip(time, 0.0, path.x[-1]))
        discrete = scipy.signal.cont2discrete((model.numerator, model.denominator), step, method="foh")
        return np.asarray(scipy.signal.lfilter(np.squeeze(discrete[0]), discrete[1], late)[::_FINER])

    return answer


def held_robot(model: RobotModel, period_s: float, fraction: float) -> tuple[FloatArray, FloatArray]:
    """Return z-transfer polynomials of r(s) under the hold with a delay of `fraction` periods, by partial fractions.

    Step response 1 + Σ c_i e^(p_i t) with c_i the residues of r(s)/s: exact for distinct poles.
    """
    poles = np.roots(model.denominator).astype(complex)
    if len(poles) > 1 and abs(poles[0] - poles[1]) < 1e-6 * abs(poles[0]):
        poles = poles * np.array([1.0 + 1e-6, 1.0 - 1e-6])
    residues = [
        np.polyval(model.numerator, p)
        / (p * model.denominator[0] * np.prod([p - q for j, q in enumerate(poles) if j != i]))
        for i, p in enumerate(poles)
    ]
    roots = np.exp(poles * period_s)
    denominator = np.real(np.poly(roots))
    # Sampled step response at t = (k − fraction)·h for k ≥ 1, times the denominator's differences, gives the numerator.
    count = len(poles) + 2
    time = (np.arange(count) - fraction) * period_s
    step = np.array([1.0 + sum(c * np.exp(p * t) for c, p in zip(residues, poles, strict=True)) for t in time]).real
    step[time < 0.0] = 0.0
    if fraction == 0.0:
        step[0] = 0.0
    pulse = np.diff(np.concatenate([[0.0], step]))
    return np.convolve(pulse, denominator)[:count], denominator


def _model(order: int, parameters: FloatArray, period_s: float) -> RobotModel:
    omega = float(np.exp(parameters[0]))
    delay = float(parameters[-1] - 1.0) * period_s
    if order == 1:
        return RobotModel.from_bandwidth(bandwidth_rad_per_s=omega, delay_s=delay)
    return RobotModel(
        numerator=np.array([omega**2]),
        denominator=np.array([1.0, 2.0 * parameters[1] * omega, omega**2]),
        delay_s=delay,
    )


def _fit(
    answer: Callable[..., FloatArray],
    position: FloatArray,
    period_s: float,
    order: int,
    longest_s: float,
    some: int | None,
) -> _Fit:
    def residual(parameters: FloatArray, count: int | None = None) -> FloatArray:
        # Command and measurement may differ by a constant (calibration, sag), which says nothing about r(s).
        model = _model(order, parameters, period_s)
        difference = answer(model, count=count) - position[:count]
        return np.asarray(difference - np.mean(difference))

    middle = [] if order == 1 else [0.8]
    # Counted from 1, the delay has a size: the differences that make the Jacobian do not vanish at a delay of 0.
    longest = longest_s / period_s
    bounds = (
        [np.log(0.5)] + [0.1] * len(middle) + [1.0],
        [np.log(_FASTEST_RAD_PER_S)] + [5.0] * len(middle) + [1.0 + longest],
    )
    starts = [
        np.array([np.log(2.0 * np.pi * hz), *middle, 1.0 + min(d, 0.9 * longest)])
        for hz in _BANDWIDTH_STARTS_HZ
        for d in _DELAY_STARTS
    ]
    # The gradient's size depends on the unit, so it ends nothing; two poles fitted to a robot of one creep along a
    # valley, where the limit on evaluations ends what the criterion will not choose.
    descend = partial(
        least_squares, bounds=bounds, method="dogbox", x_scale="jac", diff_step=1e-5, gtol=None, max_nfev=_STEPS
    )
    best = min(starts, key=lambda start: float(np.sum(residual(start) ** 2)))
    most_steps = _STEPS
    if some is not None:
        near = descend(residual, best, args=(some,)).x
        if np.sum(residual(near) ** 2) < np.sum(residual(best) ** 2):
            best, most_steps = near, _STEPS_NEAR
    found = descend(residual, best, max_nfev=most_steps)
    n, count = len(position), len(found.x) + 1
    factor = _correlation_factor(found.fun)
    variance = float(2.0 * found.cost) / (n - count) * factor
    model = _model(order, found.x, period_s)
    path = answer(model)
    slid = _slid_by_friction(path, model, period_s)
    moved = _moved_beside(found.jac, found.fun, slid)[0][:-1]
    second_s = (
        _slowest_second_pole(path, period_s, np.column_stack([found.jac, slid]), found.fun) if order == 1 else 0.0
    )
    return _Fit(
        order=order,
        parameters=found.x,
        period_s=period_s,
        covariance=variance * np.linalg.inv(found.jac.T @ found.jac) + np.outer(moved, moved),
        residual_rms=float(np.sqrt(2.0 * found.cost / n)),
        effective_samples=n / factor,
        moved=moved,
        second_pole_s=min(second_s, float(found.x[-1] - 1.0) * period_s),
    )


def _informative_part(command: FloatArray, period_s: float) -> int | None:
    """Return how many samples from the start, 20 s or more, hold an eighth of the way; None where most are needed.

    From what they show the whole of a long log is a few steps away.
    """
    way = np.cumsum(np.abs(np.diff(command)))
    some = max(round(_TELLING_S / period_s), int(np.searchsorted(way, _TELLING_SHARE * way[-1])))
    return some if some < len(command) // 2 else None


def _correlation_factor(residual: FloatArray) -> float:
    """Return how many samples of a coloured residual are worth one independent sample (at least 1)."""
    n = len(residual)
    # Zeros behind keep the ends apart; a length of small factors is transformed several times as fast.
    length = next_fast_len(2 * n, real=True)
    spectrum = np.abs(rfft(residual - residual.mean(), length)) ** 2
    correlation = irfft(spectrum, length)[: n // 10]
    if correlation[0] <= 0.0:
        return 1.0
    correlation = correlation / correlation[0]
    below = np.flatnonzero(correlation < 0.05)
    cutoff = int(below[0]) if below.size else len(correlation)
    return max(1.0, 1.0 + 2.0 * float(np.sum(correlation[1:cutoff])))


def _slid_by_friction(path: FloatArray, model: RobotModel, period_s: float) -> FloatArray:
    """Return what dry friction f of the joints may add to a path (n,), per f over the robot's stiffness k.

    Friction against the motion moves the robot by −(f/k) r(s) sign(v). A sweep of one speed shows it as more damping,
    the same in all its parts, so that no part of the log contradicts another.
    """
    direction = np.tanh(np.gradient(path, period_s) / _SLIDING_M_PER_S)
    return robot_response(replace(model, delay_s=0.0), direction, period_s)


def _moved_beside(jacobian: FloatArray, residual: FloatArray, effect: FloatArray) -> tuple[FloatArray, float]:
    """Return by how much parameters (p,) move beside an effect (n,), with its size (p + 1,), and the size's deviation.

    The deviation counts a coloured residual.
    """
    rows = np.column_stack([jacobian, effect - np.mean(effect)])
    size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    moved = np.linalg.lstsq(rows / size, -residual, rcond=None)[0]
    left = residual + (rows / size) @ moved
    variance = float(left @ left) / len(left) * _correlation_factor(left)
    inverse = np.linalg.pinv((rows / size).T @ (rows / size))
    return moved / size, float(np.sqrt(variance * inverse[-1, -1]) / size[-1])


def _slowest_second_pole(path: FloatArray, period_s: float, jacobian: FloatArray, residual: FloatArray) -> float:
    """Return the time constant τ [s] that a second pole beside one may have with 95 %; 0 where it acts as a delay.

    1/(1 + τs) is e^(−τs) (1 + τ²s²/2 − …): what a shorter delay does not make good is τ²/2 times the acceleration.
    """
    bent = np.gradient(np.gradient(path, period_s), period_s)
    moved, deviation = _moved_beside(jacobian, residual, bent)
    slowest = float(np.sqrt(2.0 * (max(float(moved[-1]), 0.0) + _ONE_SIDED * deviation)))
    return slowest if slowest > _LIKE_DELAY_S else 0.0


def _described(fit: _Fit, error: float, effective_samples: float) -> RobotFit:
    model = _model(fit.order, fit.parameters, fit.period_s)
    bandwidth = find_bandwidth_hz(model)
    denominator_jacobian = np.zeros((fit.order + 1, len(fit.parameters)))
    bandwidth_jacobian = np.zeros(len(fit.parameters))
    for i in range(len(fit.parameters)):
        step = np.zeros(len(fit.parameters))
        step[i] = 1e-6
        moved = _model(fit.order, fit.parameters + step, fit.period_s)
        denominator_jacobian[:, i] = (moved.denominator - model.denominator) / 1e-6
        bandwidth_jacobian[i] = (find_bandwidth_hz(moved) - bandwidth) / 1e-6
    spread = denominator_jacobian @ fit.covariance @ denominator_jacobian.T
    denominator_std = np.sqrt(np.maximum(np.diag(spread), 0.0))
    return RobotFit(
        model=model,
        numerator_std=denominator_std[-1:],
        denominator_std=denominator_std,
        delay_std_s=float(np.hypot(np.sqrt(fit.covariance[-1, -1]) * fit.period_s, fit.second_pole_s / _TWO_SIDED)),
        bandwidth_hz=bandwidth,
        bandwidth_std_hz=float(np.sqrt(bandwidth_jacobian @ fit.covariance @ bandwidth_jacobian)),
        fit_error=error,
        effective_samples=effective_samples,
        friction_shift=fit.moved * np.array([np.exp(fit.parameters[0]), *[1.0] * (fit.order - 1), fit.period_s]),
        second_pole_s=fit.second_pole_s,
    )


def find_bandwidth_hz(model: RobotModel) -> float:
    """Return where |r| falls to 1/√2."""
    low, high = 1e-2, 1e4
    for _ in range(80):
        middle = float(np.sqrt(low * high))
        inside = abs(model.position_response(np.array([2.0 * np.pi * middle]))[0]) > np.sqrt(0.5)
        low, high = (middle, high) if inside else (low, middle)
    return low
