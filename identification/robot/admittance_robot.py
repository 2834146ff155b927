"""Robot response from wrench to motion through an admittance with known gains: for logs without a command."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares
from scipy.special import stdtrit

from problems.arrays import FloatArray
from problems.model.robot import RobotModel

from ..errors import EstimateError
from ..verdicts import scatter
from .admittance_motion import AdmittanceMotion
from .position_loop import find_bandwidth_hz

_SMALLEST_TRAVEL, _SMALLEST_TRACE_TRAVEL = 5e-3, 1e-3  # m or rad
_FEWEST_STEPS = 100
_MEAN_S = 0.1
_AGAINST_STDS = 3.0
_CONSTANT_SHARE = 1e-9  # rounding of a constant
_SMALLEST_TURN_RAD_S = 2e-4
_LONGEST_DELAY_S = 0.3
_DELAY_UNIT_S = 0.01
_DELAY_STARTS_S = (0.003, 0.03, 0.1)
_TRACE_STARTS = 3
_BANDWIDTH_STARTS_RAD_PER_S = (6.0, 20.0, 60.0)
_SLOWEST_RAD_PER_S, _FASTEST_RAD_PER_S = 0.5, 400.0
_POOR_FIT, _POOR_TRACE_FIT = 0.2, 0.4
# What is left besides the white noise of the pose, where that alone makes more than _POOR_FIT.
_POOR_BUT_NOISE = 0.1
_RIVAL_RATIO = 1.25
_NUDGE = 1e-5
# A force that is linear between the samples of the log: measured on simulated robots, this is what it costs.
_BANDWIDTH_SHARE, _DELAY_SAMPLES = 0.01, 0.05

_PART_S, _MOST_PARTS, _BLOCK_S = 5.0, 12, 1.0
_FEWEST_BLOCKS = 3
_FEWEST_OF_ALL = 8
# A part with less of the motion's energy than this share of the usual says more of what else goes on.
_INFORMATIVE_SHARE = 0.2


@dataclass(frozen=True, kw_only=True)
class PartSpread:
    """Standard deviations between parts of a log beyond their noise, 0 without two parts with enough motion."""

    gain: float
    lag_s: float


def spread_of_parts(moved: FloatArray, predicted: FloatArray, time_s: FloatArray) -> PartSpread:
    """Fit moved = g predicted − δ d(predicted)/dt to each part of 5 s or more; arrays (n,), time increasing.

    The noise of g and δ comes from the scores of blocks of a second within each part.
    """
    count = min(int((time_s[-1] - time_s[0]) / _PART_S), _MOST_PARTS)
    if count < 2:
        return PartSpread(gain=0.0, lag_s=0.0)
    columns = np.column_stack([predicted, -np.gradient(predicted, time_s)])
    edges = np.searchsorted(time_s, np.linspace(time_s[0], time_s[-1], count + 1)[1:-1])
    parts = list(
        zip(np.split(columns, edges), np.split(moved, edges), np.split(np.floor(time_s / _BLOCK_S), edges), strict=True)
    )
    energy = np.array([float(np.sum(rows[:, 0] ** 2)) for rows, _, _ in parts])
    is_informative = energy > _INFORMATIVE_SHARE * float(np.mean(energy))
    found = [_line_fit(*part) for part, use in zip(parts, is_informative, strict=True) if use]
    known = np.array([each for each in found if each is not None])
    if len(known) < 2:
        return PartSpread(gain=0.0, lag_s=0.0)
    gain, lag = (float(np.sqrt(scatter(known[:, 0, i], known[:, 1, i])[1])) for i in (0, 1))
    return PartSpread(gain=gain, lag_s=lag)


def _line_fit(columns: FloatArray, moved: FloatArray, block: FloatArray) -> FloatArray | None:
    """Return gain and lag with their deviations (2, 2), None where the part has too few seconds."""
    starts = np.flatnonzero(np.diff(block, prepend=-1.0))
    square = columns.T @ columns
    if len(starts) < _FEWEST_BLOCKS or np.linalg.matrix_rank(columns) < 2:
        return None
    inverse = np.linalg.inv(square)
    values = inverse @ (columns.T @ moved)
    scores = np.add.reduceat(columns * (moved - columns @ values)[:, None], starts, axis=0)
    spread = inverse @ (scores.T @ scores) @ inverse * len(starts) / max(len(starts) - 2, 1)
    return np.array([values, np.sqrt(np.maximum(np.diag(spread), 0.0))])


def coloured_covariance(jacobian: FloatArray, residual: FloatArray, time: FloatArray) -> FloatArray:
    """Return H⁻¹ Ω H⁻¹, H = JᵀJ and Ω the scores Jᵀr summed over blocks of a second: true for any colour within it.

    A log below 8 s has eight blocks, and its deviations Student's factor for so few. The larger of this and of a white
    residual's counts, parameter by parameter.
    """
    count = jacobian.shape[1]
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0.0] = 1.0
    inverse = np.linalg.pinv((jacobian / size).T @ (jacobian / size), rcond=1e-12)
    scores = jacobian / size * residual[:, None]
    length_s = min(_BLOCK_S, float(time[-1] - time[0]) / _FEWEST_OF_ALL)
    starts = np.flatnonzero(np.diff(np.floor((time - time[0]) / length_s), prepend=-1.0))
    sums = np.add.reduceat(scores, starts, axis=0)
    blocks = len(sums)
    freedom = max(blocks - count, 1)
    coloured = inverse @ (sums.T @ sums) @ inverse * blocks / freedom
    if blocks <= 2 * _FEWEST_OF_ALL:
        coloured *= (float(stdtrit(freedom, 0.975)) / 1.96) ** 2
    white = inverse * float(residual @ residual) / max(len(residual) - count, 1)
    widening = np.sqrt(np.maximum(np.diag(white) / np.maximum(np.diag(coloured), 1e-300), 1.0))
    return np.asarray(coloured * np.outer(widening / size, widening / size))


@dataclass(frozen=True, kw_only=True)
class AdmittanceRobotFit:
    """r(s) with T from wrench to motion, the hold of the controller and the logger's lag included in `model.delay_s`.

    `lag_s` is the lag at low frequency, T + (d_1 − n_1)/d_0, known far better than its parts. `gain` is measured over
    expected speed; `lever_m` (2 or 0) the two components across the axis of a point that the admittance moves, seen
    from the logged one; `fit_error` is residual RMS over motion RMS.
    """

    model: RobotModel
    denominator_std: FloatArray
    delay_std_s: float
    bandwidth_hz: float
    bandwidth_std_hz: float
    lag_s: float
    lag_std_s: float
    gain: float
    gain_std: float
    lever_m: FloatArray
    lever_std_m: FloatArray
    fit_error: float


def identify_admittance_robot(motion: AdmittanceMotion) -> AdmittanceRobotFit:
    """Fit V = g r(s) e^(−sT) (F + F^d)/(M_a s + B_a) + lever × turning to one axis by output error.

    One pole or two, with or without a lever, by the Bayesian information criterion. Deviations are those of coloured
    residuals (scores summed over seconds), with what gain and lag of parts of the log differ by beyond that; where the
    other number of poles fits within a quarter as well, its answer with its deviation lies inside them too, since a
    slow hand shows the sum of the lags better than their kind. Raises EstimateError when the axis hardly moves or no
    such robot explains the motion.
    """
    moved = motion.moved_m_s[motion.used]
    travel = _travel(motion)
    if (
        travel < (_SMALLEST_TRACE_TRAVEL if motion.is_trace else _SMALLEST_TRAVEL)
        or len(moved) < _FEWEST_STEPS
        or not np.all(np.isfinite(motion.asked_m_s))
    ):
        raise EstimateError(
            f"The tool travels {1e3 * travel:.1f} mm (mrad) in {len(moved)} samples under the admittance with known "
            "gains, too little to identify the robot's response; lead it by hand for 10 s, in quick pushes."
        )
    if float(np.ptp(motion.asked_m_s)) <= _CONSTANT_SHARE * float(np.max(np.abs(motion.asked_m_s))):
        raise EstimateError(
            "The wrench asks for no change of speed on this axis (it is constant, or within its deadband), so its "
            "motion shows no response; lead the tool by hand along it, in quick pushes."
        )
    if motion.is_trace:
        return _identify_trace(motion)
    turns = bool(np.any(np.sqrt(np.mean(motion.turning_rad_s[motion.used] ** 2, axis=0)) > _SMALLEST_TURN_RAD_S))
    levers = (False, True) if turns else (False,)
    fits = [_fit(motion, order, with_lever=lever) for order in (1, 2) for lever in levers]
    effective = min(fits, key=lambda fit: fit.residual_rms).effective_samples
    chosen = min(fits, key=lambda fit: fit.criterion(effective))
    error = chosen.residual_rms / max(float(np.std(moved)), 1e-15)
    _check(chosen, error if error * chosen.coloured_share > _POOR_BUT_NOISE else 0.0, _POOR_FIT)
    rivals = [fit for fit in fits if len(fit.linear) == len(chosen.linear) and fit.rivals(chosen)]
    between = spread_of_parts(*_without_lever(motion, chosen), motion.edge_s[:-1][motion.used])
    return _described(chosen, rivals, error, motion.period_s, between)


def _travel(motion: AdmittanceMotion) -> float:
    """Return how far the axis travels to and fro [m or rad], over means of 0.1 s: noise of the pose adds little."""
    steps = (motion.moved_m_s * np.diff(motion.edge_s))[motion.used]
    if motion.is_trace or len(steps) < _FEWEST_STEPS:
        return float(np.sum(np.abs(steps)))
    width = max(1, round(_MEAN_S / float(np.median(np.diff(motion.edge_s)))))
    places = np.cumsum(steps)[: len(steps) // width * width].reshape(-1, width).mean(axis=1)
    return float(np.sum(np.abs(np.diff(places))))


def _identify_trace(motion: AdmittanceMotion) -> AdmittanceRobotFit:
    """Fit the displacement of one contact with a gain of 1: it began at F^d/B_a, and a free gain takes the lag's place.

    What it would be if free is reported, and its robot lies inside the deviations.
    """
    fits = [_fit(motion, 1 + k // 2, with_lever=False, with_delay=k % 2 == 1, with_gain=False) for k in range(4)]
    effective = min(fits, key=lambda fit: fit.residual_rms).effective_samples
    chosen = min(fits, key=lambda fit: fit.criterion(effective))
    free = _fit(motion, chosen.order, with_lever=False, with_delay=bool(chosen.parameters[-1] > 0.0))
    error = chosen.residual_rms / max(float(np.std(_observed(motion, motion.moved_m_s[motion.used]))), 1e-15)
    _check(chosen, error, _POOR_TRACE_FIT)
    rivals = [free, *(fit for fit in fits if fit.rivals(chosen))]
    described = _described(chosen, rivals, error, motion.period_s, PartSpread(gain=0.0, lag_s=0.0))
    return replace(described, gain=float(free.linear[0]), gain_std=float(np.sqrt(free.covariance[-1, -1])))


def _observed(motion: AdmittanceMotion, velocity: FloatArray) -> FloatArray:
    """Return what is fitted of a velocity (m, …): itself, or the displacement of a trace, whose noise is white."""
    if not motion.is_trace:
        return velocity
    return np.asarray(np.cumsum((velocity.T * np.diff(motion.edge_s)[motion.used]).T, axis=0))


def _without_lever(motion: AdmittanceMotion, fit: "_Fit") -> tuple[FloatArray, FloatArray]:
    """Return the velocity that was measured, less what the lever explains, and that of a gain of 1."""
    moved = motion.moved_m_s[motion.used]
    if len(fit.linear) > 1:
        moved = moved - motion.turning_rad_s[motion.used] @ fit.linear[1:]
    return moved, robot_response(motion, _model(fit.order, fit.parameters))


@dataclass(frozen=True, kw_only=True)
class _Fit:
    order: int
    parameters: FloatArray  # log ω [rad/s], (ζ,) T in units of 10 ms
    linear: FloatArray  # gain, (two components of the lever [m])
    covariance: FloatArray  # of both, 0 of what was fixed
    free_count: int
    residual_rms: float
    effective_samples: float
    coloured_share: float = 1.0

    def summary(self, parameters: FloatArray | None = None) -> FloatArray:
        """Return bandwidth [Hz], delay [s] and lag at low frequency [s]."""
        model = _model(self.order, self.parameters if parameters is None else parameters)
        poles = float(model.denominator[-2] / model.denominator[-1])
        return np.array([find_bandwidth_hz(model), model.delay_s, model.delay_s + poles])

    def summary_std(self) -> FloatArray:
        """Return the deviations of what is known."""
        count = len(self.parameters)
        gradients = (
            np.array([self.summary(self.parameters + _NUDGE * row) - self.summary() for row in np.eye(count)]) / _NUDGE
        )
        variance = np.einsum("ik,ij,jk->k", gradients, self.covariance[:count, :count], gradients)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def rivals(self, chosen: "_Fit") -> bool:
        """Return whether this is another fit, within a quarter of the chosen one."""
        return self is not chosen and self.residual_rms < _RIVAL_RATIO * chosen.residual_rms

    def criterion(self, effective_samples: float) -> float:
        misfit = 2.0 * effective_samples * np.log(max(self.residual_rms, 1e-15))
        return float(misfit + self.free_count * np.log(effective_samples))


def _check(fit: _Fit, error: float, poor: float) -> None:
    if error > poor:
        raise EstimateError(
            f"No first- or second-order robot behind the admittance with the known gains explains the motion (residual "
            f"{100.0 * error:.0f} % of it, {100.0 * poor:.0f} % at most); check that these gains ran throughout, "
            "with no other force, constraint or point of control than the logged ones."
        )
    gain, gain_std = float(fit.linear[0]), float(np.sqrt(fit.covariance[len(fit.parameters), len(fit.parameters)]))
    if -_AGAINST_STDS * gain_std < gain <= 0.0:
        raise EstimateError(
            "The motion on this axis does not follow its force, so it shows no response; lead the tool by hand along "
            "it, in quick pushes."
        )
    if gain <= 0.0:
        raise EstimateError(
            "The robot moves against the force that should drive it; check the sign of the wrench (`exerted_by`)."
        )
    if fit.summary()[1] > 0.999 * _LONGEST_DELAY_S:
        raise EstimateError(
            f"The robot follows the wrench later than {_LONGEST_DELAY_S * 1e3:.0f} ms, the most that is searched; "
            "check that the stamps of wrench and pose come from one clock."
        )


def _model(order: int, parameters: FloatArray) -> RobotModel:
    omega, delay = float(np.exp(parameters[0])), float(parameters[-1]) * _DELAY_UNIT_S
    if order == 1:
        return RobotModel.from_bandwidth(bandwidth_rad_per_s=omega, delay_s=delay)
    return RobotModel(
        numerator=np.array([omega**2]),
        denominator=np.array([1.0, 2.0 * float(parameters[1]) * omega, omega**2]),
        delay_s=delay,
    )


def robot_response(motion: AdmittanceMotion, model: RobotModel) -> FloatArray:
    """Return the mean velocities of a robot that was steady before the log began, (used steps,).

    The admittance's velocity is taken as linear between its samples; the antiderivative of the response, which is
    smooth, is read T before the stamps of the pose.
    """
    discrete = scipy.signal.cont2discrete((model.numerator, model.denominator), motion.period_s, method="foh")
    begin = motion.asked_m_s[0] if motion.approach_m_s is None else motion.approach_m_s
    velocity = begin + scipy.signal.lfilter(np.squeeze(discrete[0]), discrete[1], motion.asked_m_s - begin)
    path = CubicSpline(np.arange(len(velocity)) * motion.period_s, velocity).antiderivative()
    read_s = motion.edge_s - model.delay_s
    late = path(np.maximum(read_s, 0.0)) + begin * np.minimum(read_s, 0.0)
    return np.asarray((np.diff(late) / np.diff(motion.edge_s))[motion.used])


def _fit(
    motion: AdmittanceMotion, order: int, *, with_lever: bool, with_delay: bool = True, with_gain: bool = True
) -> _Fit:
    moved = _observed(motion, motion.moved_m_s[motion.used])
    turning = motion.turning_rad_s[motion.used] if with_lever else np.zeros((len(moved), 0))

    def solved(parameters: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        columns = np.column_stack([_observed(motion, robot_response(motion, _model(order, parameters))), turning])
        linear = np.linalg.lstsq(columns, moved, rcond=None)[0] if with_gain else np.ones(1)
        return columns @ linear - moved, np.asarray(linear, dtype=np.float64), columns

    middle = [] if order == 1 else [0.8]
    low = [np.log(_SLOWEST_RAD_PER_S), *(0.1 for _ in middle), 0.0]
    high = [np.log(_FASTEST_RAD_PER_S), *(5.0 for _ in middle), _LONGEST_DELAY_S / _DELAY_UNIT_S]
    starts = [
        np.array([np.log(omega), *middle, delay / _DELAY_UNIT_S])
        for omega in _BANDWIDTH_STARTS_RAD_PER_S
        for delay in _DELAY_STARTS_S
    ]
    scale = float(np.sqrt(np.mean(moved**2))) or 1.0  # tolerances without a unit
    starts.sort(key=lambda start: float(np.sum(solved(start)[0] ** 2)))
    # Pole and delay of one contact have several minima.
    varied = order + with_delay
    fixed = np.zeros(order + 1 - varied)
    limits = (low[:varied], high[:varied])

    def misfit(free: FloatArray) -> FloatArray:
        return solved(np.append(free, fixed))[0] / scale

    found = min(
        (
            least_squares(misfit, start[:varied], bounds=limits, diff_step=1e-4, ftol=1e-7, gtol=None, max_nfev=40)
            for start in starts[: _TRACE_STARTS if motion.is_trace else 1]
        ),
        key=lambda each: float(each.cost),
    )
    parameters = np.append(found.x, fixed)
    residual, linear, columns = solved(parameters)
    derivatives = _observed(motion, _gradients(motion, order, parameters)) * linear[0]
    is_free = np.concatenate([np.arange(order + 1) < varied, np.full(len(linear), with_gain)])
    jacobian = np.column_stack([derivatives, columns])[:, is_free]
    covariance = np.zeros((len(is_free), len(is_free)))
    covariance[np.ix_(is_free, is_free)] = coloured_covariance(jacobian, residual, motion.edge_s[:-1][motion.used])
    next_to = float(residual[1:] @ residual[:-1] / max(float(residual @ residual), 1e-300))
    rho = float(np.clip(next_to, 0.0, 0.999))
    return _Fit(
        order=order,
        parameters=parameters,
        linear=linear,
        covariance=covariance,
        free_count=int(np.count_nonzero(is_free)),
        residual_rms=float(np.sqrt(np.mean(residual**2))),
        # What first-order colour leaves of n samples.
        effective_samples=max(len(residual) * (1.0 - rho) / (1.0 + rho), 2.0),
        # White noise of the pose makes neighbouring mean velocities err by opposite halves: that is no misfit.
        coloured_share=float(np.sqrt(max(1.0 + 2.0 * min(next_to, 0.0), 0.0))),
    )


def _gradients(motion: AdmittanceMotion, order: int, parameters: FloatArray) -> FloatArray:
    """Return the response's derivatives by central differences, one-sided where the delay ends at 0."""
    columns = []
    for i in range(len(parameters)):
        up, down = parameters.copy(), parameters.copy()
        up[i] += 1e-3
        down[i] = max(down[i] - 1e-3, 0.0) if i == len(parameters) - 1 else down[i] - 1e-3
        columns.append(
            (robot_response(motion, _model(order, up)) - robot_response(motion, _model(order, down)))
            / (up[i] - down[i])
        )
    return np.column_stack(columns)


def _described(
    fit: _Fit, rivals: Sequence[_Fit], error: float, period_s: float, between: PartSpread
) -> AdmittanceRobotFit:
    model, count = _model(fit.order, fit.parameters), len(fit.parameters)
    summary, own = fit.summary(), fit.summary_std()
    widest = np.max([own, *(np.hypot(rival.summary_std(), rival.summary() - summary) for rival in rivals)], axis=0)
    floor = np.array([_BANDWIDTH_SHARE * summary[0], _DELAY_SAMPLES * period_s, _DELAY_SAMPLES * period_s])
    # A lag that differs between parts of the log is one of the poles: that of the logger is always the same.
    apart = np.array([summary[0] * between.lag_s / max(float(summary[2]), 1e-6), 0.0, between.lag_s])
    stds = np.sqrt(widest**2 + floor**2 + apart**2)
    denominators = [_model(fit.order, fit.parameters + _NUDGE * row).denominator for row in np.eye(count)]
    gradients = (np.array(denominators) - model.denominator) / _NUDGE
    spread = np.einsum("ik,ij,jk->k", gradients, fit.covariance[:count, :count], gradients)
    linear_std = np.sqrt(np.diag(fit.covariance)[count:])
    return AdmittanceRobotFit(
        model=model,
        denominator_std=np.sqrt(np.maximum(spread, 0.0)) * float(stds[0] / max(own[0], 1e-300)),
        delay_std_s=float(stds[1]),
        bandwidth_hz=float(summary[0]),
        bandwidth_std_hz=float(stds[0]),
        lag_s=float(summary[2]),
        lag_std_s=float(stds[2]),
        gain=float(fit.linear[0]),
        gain_std=float(np.hypot(linear_std[0], between.gain)),
        lever_m=fit.linear[1:],
        lever_std_m=linear_std[1:],
        fit_error=error,
    )
