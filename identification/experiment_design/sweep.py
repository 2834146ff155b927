"""Sine sweep that identifies coupling, payload and robot best, by the Fisher information."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from problems.arrays import ComplexArray, FloatArray
from problems.frozen import AboveZero
from problems.model.robot import RobotModel

from ..joint_fit.covariance import HIGHEST_PART_HZ, SHARPEST_DELAY_SAMPLES, UNSEEN_SHARE
from ..merging.values import shared_std
from ..robot.coupling import felt_impedance
from .values import Known, PlanValues, WorstCase, worst_case

_POINTS = 400
_STARTS_HZ = (0.5, 1.0, 2.0)
_ENDS = 12
_DURATIONS_S = (8.0, 12.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0)
_HIGHEST_HZ = 70.0  # identification looks at nothing faster
_SAMPLES_PER_CYCLE = 8.0
_PASSED_SHARE = 0.05
_AIM = 0.5
# What the model misses bends each parameter by a part that no length of recording takes away.
_MODEL_SHARE = 0.3  # of the misfit
_MODEL_DAMPING_SHARE = 0.1  # of the misfit, times the critical damping
_INDEPENDENT_MISFITS = 40.0
_GUESSED_SHARE = 0.5
_RESERVE = 0.9  # of the force limit: what starting, stopping and the noise add
_FADE_S = 0.25
_WORTH_REPEATING = 1.5
_BEYOND_SWING = 1.15
_NOISE_PEAKS = 4.0  # deviations that the largest of some thousand samples reaches
_SINGULAR = 1e13
_SYMBOLS = ("K_s", "B_s", "B_p", "M_p")
_STEP = 1e-5
_PARTS, _PART_RATIO, _LATENCY_SAMPLES = 16, 0.03, 0.1


@dataclass(frozen=True, kw_only=True)
class SweepLimits:
    """What the cell allows: speed of the command, force at the sensor, travel to each side, length, frequency."""

    max_speed_m_s: float = 0.25
    max_force_n: float = 100.0
    max_stroke_m: float = 0.02
    max_duration_s: float = 60.0
    max_frequency_hz: float | None = None


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """A logarithmic sine sweep whose flange keeps one speed amplitude; the command makes up for r(s)."""

    low_hz: float
    high_hz: float
    flange_speed_m_s: float
    duration_s: float

    def frequency_hz(self) -> FloatArray:
        """Return the frequencies (n,) at equal steps of time."""
        return np.geomspace(self.low_hz, self.high_hz, _POINTS)

    def command_speed_m_s(self, robot: RobotModel) -> FloatArray:
        """Return the speed amplitude of the command (n,) at those frequencies."""
        return self.flange_speed_m_s / _passed(robot, self.frequency_hz())


@dataclass(frozen=True, kw_only=True)
class Repeat:
    """The same sweep once more, all amplitudes times `aim_force_n` over the peak force that the first one showed.

    Peak and amplitude are proportional, whatever the cell is. The factor is at most `largest_factor`, where speed or
    stroke end; `expected_factor` is that of the values of the plan.
    """

    aim_force_n: AboveZero
    largest_factor: AboveZero
    expected_factor: AboveZero


@dataclass(frozen=True, kw_only=True)
class SweepPlan:
    """The sweep to begin with, and the deviations (keyed as `PlanValues`) after it or, where there is one, its repeat.

    `peak_force_n` is its largest force amplitude with the plan's values, `worst_peak_force_n` that of the plausible
    cell `worst`; above `abort_force_n` at the sensor it is to be stopped. Its amplitude rises and falls over `fade_s`.
    `bound_by` shows which limit keeps the speed down. `robot_limit_hz`: above it the robot passes less than a twentieth
    of the command.
    """

    sweep: Sweep
    std: dict[str, float]
    peak_force_n: float
    worst: WorstCase
    abort_force_n: float
    fade_s: float
    bound_by: str
    robot_limit_hz: float
    repeat: Repeat | None = None

    @property
    def worst_peak_force_n(self) -> float:
        """The largest force amplitude of the first sweep on a cell within what is known."""
        return self.worst.force_per_speed_n_s_per_m * self.sweep.flange_speed_m_s


@dataclass(frozen=True, kw_only=True)
class FastestSweep:
    """The sweep over a band that is as fast as the limits let the worst plausible cell be driven."""

    sweep: Sweep
    worst: WorstCase
    bound_by: str
    largest_factor: float  # to the next limit, were the force none


def plan_sweep(
    values: PlanValues, limits: SweepLimits, allowed: dict[str, float], *, aim_force_n: float | None = None
) -> SweepPlan:
    """Search the band for the smallest worst std/allowed, and the shortest length that brings it to a half.

    Where nothing does, the longest that is allowed. `allowed` is keyed as `PlanValues`; only its entries count. The
    first sweep keeps the force limit on the worst plausible cell; where the cell is likely to bear more, it is repeated
    up to `aim_force_n`, by default the limit's half.
    """
    robot_limit = robot_limit_hz(values.robot)
    highest = min(_HIGHEST_HZ, robot_limit, 1.0 / (_SAMPLES_PER_CYCLE * values.sample_time_s.value))
    highest = min(highest, limits.max_frequency_hz or highest)
    lowest = [start for start in _STARTS_HZ if start < 0.4 * highest] or [0.1 * highest]
    ends = np.geomspace(0.25 * highest, highest, _ENDS)
    # Both flanks of the payload's swing distinguish stiffness, mass and drag, where the robot reaches that far.
    beyond = _BEYOND_SWING * values.payload_frequency_hz
    ends = ends[ends >= beyond] if highest > beyond else ends
    lengths = [length for length in _DURATIONS_S if length < limits.max_duration_s] + [limits.max_duration_s]
    aim = _GUESSED_SHARE * limits.max_force_n if aim_force_n is None else aim_force_n

    def worst(plan: SweepPlan) -> float:
        return max(plan.std[name] / limit for name, limit in allowed.items())

    bands = [(low, float(high)) for low, high in product(lowest, ends) if high > 2.0 * low]
    fastest = [fastest_sweep(values, limits, low, high, lengths[0]) for low, high in bands]
    for length in lengths:
        plans = [_predicted(values, limits, found, length, robot_limit, aim) for found in fastest]
        best = min(plans, key=worst)
        if worst(best) <= _AIM:
            break
    return best


def robot_limit_hz(robot: RobotModel) -> float:
    """Return the highest frequency [Hz] up to which the robot passes a twentieth of the command."""
    frequency = np.geomspace(0.1, 1000.0, 2000)
    passed = _passed(robot, frequency) >= _PASSED_SHARE
    return float(frequency[np.flatnonzero(passed)[-1]]) if np.any(passed) else float(frequency[0])


def sweep_information(values: PlanValues, sweep: Sweep) -> FloatArray:
    """Return the information (5 + n, 5 + n) in pose and force about what lies between command and force.

    Parameters: K_s, B_s, B_p, M_p in SI, then the relative sizes of the n coefficients of r(s)'s monic denominator (the
    numerator follows from r(0) = 1) and of T_d. x = R x^d with R = r(s) e^(-s T_d), and F = Z x of the measured x, as
    it is fitted: the force shows nothing of the robot.

    White noise of σ per sample gives (1/(σ² h)) ∫ (dy/dθ)² dt (Kay 1993, 3.9); a sweep slow beside the payload's
    ringing stays a sine, whose square is half that of its amplitude on average. The misfit counts as noise that is
    smooth over the band: what shows in less of the force than that is not identified, however long the sweep.
    """
    s = _s(sweep.frequency_hz())
    payload, impedance = _gradients(values, s)
    robot, passed = _robot_gradients(values.robot, s)
    command = sweep.command_speed_m_s(values.robot)[:, None] / np.abs(s)[:, None]
    none = np.zeros_like(payload)
    position = command * np.concatenate([none, robot], axis=1)
    force = command * np.concatenate([payload * passed[:, None], np.zeros_like(robot)], axis=1)
    per_sample = 2.0 * values.sample_time_s.value / sweep.duration_s
    force_spread = _force_spread(values, sweep, impedance * passed * command[:, 0])
    position_spread = per_sample * values.position_noise_rms_m.value**2
    total = np.conj(force).T @ (force / force_spread[:, None]) + np.conj(position).T @ position / position_spread
    return np.asarray(np.real(total) / len(s))


def _force_spread(values: PlanValues, sweep: Sweep, force: ComplexArray) -> FloatArray:
    """Return the variance (n,) of the force per frequency: noise, and a misfit that is smooth over the band."""
    noise = 2.0 * values.sample_time_s.value / sweep.duration_s * values.force_noise_rms_n.value**2
    return np.asarray(noise + values.misfit_share.value**2 / _INDEPENDENT_MISFITS * np.abs(force) ** 2)


def unseen_part(values: PlanValues, sweep: Sweep) -> FloatArray:
    """Return by how much a part that a sweep does not show may move K_s, B_s, B_p and M_p (4,), one deviation.

    The wrench's latency is known to a tenth of a sample. A share μ of M_p on a spring of its own, known as the force
    shows it and 0 ± 5 % beforehand, makes M_p a mass of M_p (1 − μ + μ T), T = (2 ζ ω_2 s + ω_2²)/(s² + 2 ζ ω_2 s +
    ω_2²). The ω_2 above the payload's own counts that moves K_s most, as identification states it.
    """
    s = _s(sweep.frequency_hz())
    payload, impedance = _gradients(values, s)
    flange = sweep.command_speed_m_s(values.robot) / np.abs(s) * values.robot.position_response(s.imag)
    late = -s * values.sample_time_s.value * impedance
    columns = np.column_stack([payload, late]) * flange[:, None]
    rows = columns / np.sqrt(_force_spread(values, sweep, impedance * flange))[:, None]
    known = np.diag([0.0, 0.0, 0.0, 0.0, _LATENCY_SAMPLES**-2.0])
    covariance = covariance_of(np.real(np.conj(rows).T @ rows) / len(s) + known)
    worst = np.zeros(4)
    if not np.all(np.isfinite(covariance)):
        return worst
    own_hz = min(values.payload_frequency_hz, HIGHEST_PART_HZ)
    for omega in 2.0 * np.pi * np.geomspace(own_hz, HIGHEST_PART_HZ, _PARTS):
        lag = 2.0 * _PART_RATIO * omega * s + omega**2
        column = rows[:, 3] * values.theta[3] * (lag / (s**2 + lag) - 1.0)
        follows = -covariance @ np.real(np.conj(rows).T @ column) / len(s)
        left = float(np.real(np.conj(column) @ (column + rows @ follows))) / len(s)
        move = follows[:4] * (max(left, 0.0) + UNSEEN_SHARE**-2.0) ** -0.5
        worst = move if abs(move[0]) > abs(worst[0]) else worst
    return worst


def _robot_gradients(robot: RobotModel, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return dR (n, p) per relative change of each denominator coefficient and of T_d, and R (n,)."""
    count = robot.order + 1
    gradients = [
        (
            _changed(robot, which, _STEP).position_response(s.imag)
            - _changed(robot, which, -_STEP).position_response(s.imag)
        )
        / (2.0 * _STEP)
        for which in range(count)
    ]
    return np.stack(gradients, axis=1), robot.position_response(s.imag)


def _changed(robot: RobotModel, which: int, step: float) -> RobotModel:
    """Return the robot with one coefficient of the denominator, or last the delay, changed by a share.

    No delay is below 0: one at 0 is changed about a step above it.
    """
    size = _delay_size(robot)
    scale = np.ones(robot.order + 1)
    if which < robot.order:
        scale[1 + which] += step
    denominator = robot.denominator * scale
    return RobotModel(
        numerator=robot.numerator / robot.numerator[-1] * denominator[-1],
        denominator=denominator,
        delay_s=max(robot.delay_s, _STEP * size) + step * size * (which == robot.order),
    )


def _delay_size(robot: RobotModel) -> float:
    return max(robot.delay_s, 1e-4)


def _predicted(
    values: PlanValues, limits: SweepLimits, found: FastestSweep, length: float, robot_limit: float, aim_n: float
) -> SweepPlan:
    sweep = replace(found.sweep, duration_s=length)
    peak = _force_per_speed(values, sweep) * sweep.flange_speed_m_s
    factor = min(found.largest_factor, aim_n / (peak + _NOISE_PEAKS * values.force_noise_rms_n.value))
    repeat = (
        Repeat(aim_force_n=aim_n, largest_factor=found.largest_factor, expected_factor=factor)
        if factor >= _WORTH_REPEATING
        else None
    )
    return SweepPlan(
        sweep=sweep,
        std=_std_after(values, sweep if repeat is None else _louder(sweep, factor)),
        peak_force_n=peak,
        worst=found.worst,
        abort_force_n=_RESERVE * limits.max_force_n,
        fade_s=_FADE_S,
        bound_by=found.bound_by,
        robot_limit_hz=robot_limit,
        repeat=repeat,
    )


def _louder(sweep: Sweep, factor: float) -> Sweep:
    return replace(sweep, flange_speed_m_s=factor * sweep.flange_speed_m_s)


def careful_force_n(max_force_n: float, stds: Iterable[float | None]) -> float:
    """Return the limit, half of it where what shapes the peak is a guess: a resonance or a surface may surprise."""
    return max_force_n * (_GUESSED_SHARE if any(std is None for std in stds) else 1.0)


def fastest_sweep(
    values: PlanValues, limits: SweepLimits, low_hz: float, high_hz: float, duration_s: float
) -> FastestSweep:
    """Return the sweep over a band with the highest flange speed that keeps the limits on the worst plausible cell."""
    frequency = np.geomspace(low_hz, high_hz, _POINTS)
    worst = worst_case(values, low_hz, high_hz)
    speeds = {
        "max-speed": limits.max_speed_m_s * float(np.min(_passed(values.robot, frequency))),
        "max-force": _RESERVE * limits.max_force_n / worst.force_per_speed_n_s_per_m,
        "max-stroke": limits.max_stroke_m * 2.0 * np.pi * low_hz,
    }
    bound_by = min(speeds, key=lambda name: speeds[name])
    return FastestSweep(
        sweep=Sweep(low_hz=low_hz, high_hz=high_hz, flange_speed_m_s=speeds[bound_by], duration_s=duration_s),
        worst=worst,
        bound_by=bound_by,
        largest_factor=min(speeds["max-speed"], speeds["max-stroke"]) / speeds[bound_by],
    )


def _force_per_speed(values: PlanValues, sweep: Sweep) -> float:
    """Return the largest force amplitude per flange speed [N/(m/s)] with the plan's values."""
    s = _s(sweep.frequency_hz())
    return float(np.max(np.abs(felt_impedance(values.theta, s) / s)))


def _std_after(values: PlanValues, sweep: Sweep) -> dict[str, float]:
    """Return what is known after the sweep: what it shows by itself, merged with what is known as logs are merged."""
    known: dict[str, Known] = {
        "stiffness_n_per_m": values.stiffness_n_per_m,
        "damping_n_s_per_m": values.damping_n_s_per_m,
        "drag_n_s_per_m": values.drag_n_s_per_m,
        "motion_mass_kg": values.motion_mass_kg,
    }
    misfit = values.misfit_share.value
    model = misfit * _MODEL_SHARE * np.array([entry.value for entry in known.values()])
    model[1] = np.hypot(model[1], misfit * _MODEL_DAMPING_SHARE * values.critical_damping_n_s_per_m)
    robot = values.robot
    gradient = np.array(
        [
            (_bandwidth_hz(_changed(robot, k, _STEP)) - _bandwidth_hz(_changed(robot, k, -_STEP))) / (2.0 * _STEP)
            for k in range(robot.order + 1)
        ]
    )
    beside = misfit * _MODEL_SHARE * values.bandwidth_hz.value
    covariance = covariance_of(sweep_information(values, sweep))
    std = np.sqrt(np.diag(covariance))
    shared = [shared_std(symbol, entry.value) for symbol, entry in zip(_SYMBOLS, known.values(), strict=True)]
    alone = np.hypot(np.hypot(np.hypot(std[:4], model), shared), unseen_part(values, sweep))
    found = {
        name: entry.std_after(float(own), symbol)
        for (name, entry), symbol, own in zip(known.items(), _SYMBOLS, alone, strict=True)
    }
    spread = float(np.sqrt(gradient @ covariance[4:, 4:] @ gradient)) if np.all(np.isfinite(std)) else np.inf
    found["bandwidth_hz"] = values.bandwidth_hz.std_after(float(np.hypot(spread, beside)))
    sharpest = SHARPEST_DELAY_SAMPLES * values.sample_time_s.value
    found["delay_s"] = values.delay_s.std_after(float(np.hypot(std[-1] * _delay_size(robot), sharpest)))
    return found


def covariance_of(information: FloatArray) -> FloatArray:
    """Invert an information matrix whose parameters differ by decades; infinite where something is not identified."""
    size = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information * np.outer(size, size)
    if np.linalg.cond(scaled) > _SINGULAR:
        return np.full_like(information, np.inf)
    return np.asarray(np.linalg.inv(scaled) * np.outer(size, size))


def standard_deviations(information: FloatArray) -> FloatArray:
    """Return the roots of the covariance's diagonal."""
    return np.sqrt(np.diag(covariance_of(information)))


def _gradients(values: PlanValues, s: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
    """Return dZ/dθ (n, 4) for K_s, B_s, B_p, M_p by central differences, and Z (n,)."""
    theta = values.theta
    critical = values.critical_damping_n_s_per_m
    steps = 1e-5 * np.array([theta[0], critical, critical, theta[3]])
    gradients = [
        (felt_impedance(theta + step, s) - felt_impedance(theta - step, s)) / (2.0 * np.sum(step))
        for step in np.diag(steps)
    ]
    return np.stack(gradients, axis=1), felt_impedance(theta, s)


def _s(frequency_hz: FloatArray) -> ComplexArray:
    return np.asarray(2j * np.pi * frequency_hz, dtype=np.complex128)


def _passed(robot: RobotModel, frequency_hz: FloatArray) -> FloatArray:
    return np.abs(robot.position_response(2.0 * np.pi * frequency_hz))


def _bandwidth_hz(robot: RobotModel) -> float:
    """Return where |r| falls to 1/√2, by straight line between close points."""
    frequency = np.geomspace(0.01, 1000.0, 4001)
    passed = np.asarray(_passed(robot, frequency))
    above = np.flatnonzero(passed > np.sqrt(0.5))
    i = int(above[-1]) if above.size else 0
    if i + 1 >= len(frequency):
        return float(frequency[-1])
    share = (passed[i] - np.sqrt(0.5)) / (passed[i] - passed[i + 1])
    return float(frequency[i] + share * (frequency[i + 1] - frequency[i]))
