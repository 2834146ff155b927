"""Robot from a logged command: one that is held from sample to sample, or samples of a faster controller's."""

from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray

from ..errors import EstimateError
from .position_loop import RobotFit, identify_robot

TICK_S = 1.5e-3
_SAME_PERIOD = 0.05
_DECISIVE, _DECISIVE_SHARE = 10.0, 0.03
# A controller of robots is hardly slower; where the log's own period is no hold, this bounds the one behind it.
_SLOWEST_CONTROLLER_S = 4e-3
# The spline through the samples of a smooth command: measured on simulated robots, this is what it costs.
_SPLINE_SHARE, _SPLINE_DELAY_SHARE = 0.01, 0.01

# In the note of a delay with half a control period in it that nobody gave.
UNKNOWN_PERIOD = "give `sample_time_s`"


@dataclass(frozen=True, kw_only=True)
class LoggedRobot:
    """The robot behind a logged command; with `is_held` each sample is what acted until the next one.

    `note` says what of the delay the log leaves open.
    """

    fit: RobotFit
    is_held: bool
    note: str = ""


def identify_logged_robot(
    command_m: FloatArray,
    position_m: FloatArray,
    period_s: float,
    *,
    is_uniform: bool = True,
    control_period_s: float | None = None,
) -> LoggedRobot:
    """Fit the robot to command and measured position, (n,) each, and find whether the command was held between them.

    A command logged every 1.5 ms or faster, or at the known control period, is one of each tick. Of a slower one the
    better fit decides. Where the log is slower than the controller, half a control period, which is not known, is part
    of the lag that the log shows: the delay gets the middle and the deviation of what is possible. Raises EstimateError
    as `identify_robot` does.
    """
    known = control_period_s is not None and abs(period_s / control_period_s - 1.0) < _SAME_PERIOD
    if known or (control_period_s is None and period_s <= TICK_S):
        return LoggedRobot(fit=identify_robot(command_m, position_m, period_s), is_held=True)
    held = _held(command_m, position_m, period_s) if is_uniform and control_period_s is None else None
    try:
        smooth = identify_robot(command_m, position_m, period_s, is_held=False)
    except EstimateError:
        if held is None:
            raise
        return LoggedRobot(fit=held, is_held=True)
    samples = smooth.effective_samples if held is None else min(smooth.effective_samples, held.effective_samples)
    # What chance makes of so many samples, and what no stamp is free of.
    decisive = max(_DECISIVE / (2.0 * samples), _DECISIVE_SHARE)
    better = np.inf if held is None else float(np.log(held.fit_error / smooth.fit_error))
    if held is not None and better < -decisive:
        return LoggedRobot(fit=held, is_held=True)
    longest = period_s if better < decisive else min(period_s, _SLOWEST_CONTROLLER_S)
    return _without_hold(smooth, period_s, longest, control_period_s)


def _held(command_m: FloatArray, position_m: FloatArray, period_s: float) -> RobotFit | None:
    try:
        return identify_robot(command_m, position_m, period_s)
    except EstimateError:
        return None


def _without_hold(fit: RobotFit, period_s: float, longest_s: float, control_period_s: float | None) -> LoggedRobot:
    """Take the controller's own hold, half its period, off the delay, and what sampling costs into the deviations."""
    delay = fit.model.delay_s
    if control_period_s is not None:
        hold, hold_std = min(0.5 * control_period_s, delay), 0.0
        note = (
            f"logged every {1e3 * period_s:.3g} ms, {1e3 * hold:.3g} ms of lag taken off for the known control period"
        )
    else:
        # Anything from 0 to half the longest period is as likely.
        hold = 0.5 * min(0.5 * longest_s, delay)
        hold_std = hold / float(np.sqrt(3.0))
        note = (
            f"the log shows {1e3 * delay:.3g} ms with half a control period in it, which is not known and shorter than "
            f"{1e3 * longest_s:.3g} ms; {UNKNOWN_PERIOD}"
        )
    turned = 2.0 * np.pi * fit.bandwidth_hz * period_s
    share = _SPLINE_SHARE * turned**2
    widened = float(np.hypot(1.0, share * fit.bandwidth_hz / max(fit.bandwidth_std_hz, 1e-12)))
    return LoggedRobot(
        fit=replace(
            fit,
            model=replace(fit.model, delay_s=delay - hold),
            numerator_std=widened * fit.numerator_std,
            denominator_std=widened * fit.denominator_std,
            delay_std_s=float(np.hypot(np.hypot(fit.delay_std_s, hold_std), _SPLINE_DELAY_SHARE * period_s)),
            bandwidth_std_hz=widened * fit.bandwidth_std_hz,
        ),
        is_held=False,
        note=note,
    )
