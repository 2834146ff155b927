"""Whether the wrench is filtered, late or neither, beside friction of the coupling or a part that swings.

One mass on one spring takes for a latency, or for a low-pass, what friction does. Beside it, a delay and a low-pass are
fitted again from the force as logged.
"""

from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray

from .extended_fit import with_own_noise
from .extended_problem import ExtendedProblem, PayloadFit
from .latency import WrenchLatency, is_clear_latency, is_significant_latency, taken_for_filter
from .path import SensorDynamics

# How well a delay, or a low-pass as a share of itself, is known before.
_DELAY_SAMPLES, _FILTER_SHARE = 1.0, 0.5


@dataclass(frozen=True, kw_only=True)
class SettledLatency:
    """A problem with what its wrench passes, the fit to it, and the latency."""

    of: ExtendedProblem
    fit: PayloadFit
    latency: WrenchLatency


def settle_latency(before: SettledLatency, force_n: FloatArray, shifted_s: float) -> SettledLatency:
    """Return a low-pass where that is clearly one and deeper than a delay, no latency where none is clear, or `before`.

    `force_n` (n,) is the force as it was read, with `shifted_s` taken off its stamps as a clock's offset.
    """
    latency, period = before.latency, before.of.problem.signals.period_s
    clock = taken_for_filter(shifted_s)
    is_late = is_significant_latency(latency.seconds + clock, latency.std_s, period)
    if latency.is_whole or not (latency.is_filter or latency.applied_s != 0.0 or is_late):
        return before
    delayed = _refitted(before, force_n, SensorDynamics(), _DELAY_SAMPLES)
    late_s = float(delayed.fit.theta[delayed.of.shared]) * period
    if latency.is_filter:
        filtered = before
    elif late_s + clock > 0.0:
        dynamics = SensorDynamics(time_constant_s=late_s + clock, delay_s=-clock)
        filtered = _refitted(before, force_n, dynamics, _FILTER_SHARE * dynamics.time_constant_s / period)
    else:
        filtered = None
    std_s = latency.std_s
    if filtered is not None:
        evidence = _depth(delayed) - _depth(filtered)
        sensor = filtered.of.sensor_dynamics(filtered.fit.theta)
        if evidence > 0.0 and is_significant_latency(sensor.time_constant_s, std_s, period):
            passed = WrenchLatency(
                seconds=sensor.time_constant_s,
                std_s=std_s,
                applied_s=0.0,
                is_filter=True,
                evidence=evidence,
                advanced_s=-sensor.delay_s,
            )
            return replace(filtered, latency=passed)
    none = WrenchLatency(seconds=late_s, std_s=std_s, applied_s=0.0)
    return before if is_clear_latency(late_s, std_s) and not latency.is_filter else replace(delayed, latency=none)


def _refitted(
    before: SettledLatency, force_n: FloatArray, dynamics: SensorDynamics, latency_std_samples: float
) -> SettledLatency:
    """Return the same payload fitted behind another sensor, to the force as logged."""
    of, fit = before.of, before.fit
    signals = replace(of.problem.signals, force_n=force_n, sensor_dynamics=dynamics)
    other = replace(of, problem=replace(of.problem, signals=signals), latency_std_samples=latency_std_samples)
    theta = np.concatenate([fit.theta[: of.shared], np.zeros(other.lags), fit.theta[of.shared + of.lags :]])
    return replace(before, of=other, fit=with_own_noise(other, replace(fit, theta=theta)))


def _depth(settled: SettledLatency) -> float:
    """Return −2 log L but for a constant, under the noise that the fit leaves."""
    of, fit = settled.of, settled.fit
    count = sum(len(each) for each in of.segments)
    return of.cost(fit.theta, fit.own, fit.kind, fit.noise) + 2.0 * count * float(np.log(fit.noise.rms))
