"""Logged commands: what the logger lost restored, and the robot behind them, held or samples of a faster command."""

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from problems.arrays import FloatArray

from ..errors import EstimateError
from ..result import TICK_S
from ..signals.medians import median
from ..signals.recording import PoseSignal, find_gaps
from .position_loop import RobotFit, identify_robot

_SAME_PERIOD = 0.05
_LOST = 1.5
_DECISIVE, _DECISIVE_SHARE = 10.0, 0.03
# A controller of robots is hardly slower; where the log's own period is no hold, this bounds the one behind it.
_SLOWEST_CONTROLLER_S = 4e-3
# The spline through the samples of a smooth command: measured on simulated robots, this is what it costs.
_SPLINE_SHARE, _SPLINE_DELAY_SHARE = 0.01, 0.01

# What fits of a pole to sampled signals leave open of it besides: measured on simulated cells.
MODEL_STD_SHARE = 0.003
# In the note of a delay with half a control period in it that nobody gave.
UNKNOWN_PERIOD = "give `sample_time_s`"
# In the note of a delay that may be a second pole of the robot in part.
SECOND_POLE = "the log does not exclude a second pole"


@dataclass(frozen=True, kw_only=True)
class LoggedRobot:
    """The robot behind a logged command.

    `fit` is r(s) with the delay behind the controller's own hold. `behind_hold` is the robot behind a command that is
    held for the log's period, None where the log contradicts such a hold. Where the controller may hold for less, its
    delay is longer than that of `behind_hold` by `longer_s` (mean, standard deviation), since a log shows the delay and
    half a hold together. `behind_samples` is the robot behind a command that is smooth between its samples, with half
    the controller's own hold in its delay, None where each command was held until the next; the delay is longer than
    that by `longer_than_samples_s`, less than 0. `note` says what a hold leaves open of the delay.
    """

    fit: RobotFit
    behind_hold: RobotFit | None
    longer_s: tuple[float, float] = (0.0, 0.0)
    behind_samples: RobotFit | None = None
    longer_than_samples_s: tuple[float, float] = (0.0, 0.0)
    note: str = ""

    @property
    def is_held(self) -> bool:
        """Whether each command is known to act until the next one that was logged."""
        return self.behind_hold is self.fit

    @property
    def delay_note(self) -> str:
        """What of the delay the log leaves open: the controller's hold, and a second pole in the place of delay."""
        second_s, delay_s = self.fit.second_pole_s, self.fit.model.delay_s
        second = (
            f"{SECOND_POLE} of {1e3 * second_s:.2g} ms or less, which would leave {1e3 * (delay_s - second_s):.2g} ms "
            f"of the {1e3 * delay_s:.2g} ms"
        )
        return "; ".join(filter(None, (self.note, second if second_s else "")))


def identify_logged_robot(
    command_m: FloatArray,
    position_m: FloatArray,
    period_s: float,
    *,
    is_uniform: bool = True,
    control_period_s: float | None = None,
) -> LoggedRobot:
    """Fit the robot to command and measured position, (n,) each, and find whether the command was held between them.

    A command logged every 1.5 ms or faster, or no slower than the known control period, is one of each tick. Of a
    slower one the better fit decides. Where the log may be slower than the controller, half a control period, which is
    not known, is part of the lag that the log shows: the delay gets the middle and the deviation of what is possible.
    Raises EstimateError as `identify_robot` does.
    """
    if period_s <= (TICK_S if control_period_s is None else (1.0 + _SAME_PERIOD) * control_period_s):
        held = identify_robot(command_m, position_m, period_s)
        return LoggedRobot(fit=held, behind_hold=held)
    behind_hold = _held(command_m, position_m, period_s) if is_uniform else None
    try:
        smooth = identify_robot(command_m, position_m, period_s, is_held=False)
    except EstimateError:
        if behind_hold is None:
            raise
        return LoggedRobot(fit=behind_hold, behind_hold=behind_hold)
    samples = smooth.effective_samples
    if behind_hold is not None:
        samples = min(samples, behind_hold.effective_samples)
    # What chance makes of so many samples, and what no stamp is free of.
    decisive = max(_DECISIVE / (2.0 * samples), _DECISIVE_SHARE)
    better = np.inf if behind_hold is None else float(np.log(behind_hold.fit_error / smooth.fit_error))
    if behind_hold is not None and better < -decisive and control_period_s is None:
        return LoggedRobot(fit=behind_hold, behind_hold=behind_hold)
    longest = period_s if better < decisive else min(period_s, _SLOWEST_CONTROLLER_S)
    return _without_hold(smooth, behind_hold if better < decisive else None, period_s, longest, control_period_s)


def _held(command_m: FloatArray, position_m: FloatArray, period_s: float) -> RobotFit | None:
    try:
        return identify_robot(command_m, position_m, period_s)
    except EstimateError:
        return None


def _without_hold(
    fit: RobotFit, behind_hold: RobotFit | None, period_s: float, longest_s: float, control_period_s: float | None
) -> LoggedRobot:
    """Take the controller's own hold, half its period, off the delay, and what sampling costs into the deviations."""
    delay, sampling_std = fit.model.delay_s, _SPLINE_DELAY_SHARE * period_s
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
    longer_std = float(np.hypot(hold_std, sampling_std))
    return LoggedRobot(
        fit=replace(
            fit,
            model=replace(fit.model, delay_s=delay - hold),
            numerator_std=widened * fit.numerator_std,
            denominator_std=widened * fit.denominator_std,
            delay_std_s=float(np.hypot(fit.delay_std_s, longer_std)),
            bandwidth_std_hz=widened * fit.bandwidth_std_hz,
        ),
        behind_hold=behind_hold,
        longer_s=(0.5 * period_s - hold, longer_std),
        behind_samples=fit,
        longer_than_samples_s=(-hold, longer_std),
        note=note,
    )


def restore_commands(command: PoseSignal) -> PoseSignal:
    """Return the command with the messages that are missing between two others, up to a hole of the log.

    A message that the logger lost reached the robot all the same; holding the one before it would make the robot look
    slower. One that came late is followed by shorter steps, which make up for it: nothing is missing there. Positions
    by a cubic spline through the others, orientations by slerp.
    """
    stamps = command.stamp_ns
    steps = np.diff(stamps)
    if not len(steps):
        return command
    period = median(steps)
    lost = np.ones(len(steps), dtype=np.int64)
    for i in np.setdiff1d(np.flatnonzero(steps >= _LOST * period), find_gaps(stamps)):
        lost[i] = 1 + _missing(steps[i:] / period)
    where = np.flatnonzero(lost > 1)
    if not len(where):
        return command
    added = np.concatenate([stamps[i] + np.round(steps[i] * np.arange(1, lost[i]) / lost[i]) for i in where])
    every = np.sort(np.concatenate([stamps, added.astype(np.int64)]))
    known, wanted = (stamps - stamps[0]) * 1e-9, (every - stamps[0]) * 1e-9
    quaternions = np.full((len(every), 4), np.nan)
    if bool(np.all(np.isfinite(command.quaternion_xyzw))):
        quaternions = Slerp(known, Rotation.from_quat(command.quaternion_xyzw))(wanted).as_quat()
    return replace(
        command,
        stamp_ns=every,
        position_m=np.asarray(make_interp_spline(known, command.position_m, k=3)(wanted)),
        quaternion_xyzw=quaternions,
    )


def _missing(steps: FloatArray) -> int:
    """Return how many messages are missing in the first of these steps (n,), counted in periods.

    As many of the following steps as could make up for a late message are looked at.
    """
    excess = float(steps[0]) - 1.0
    following = steps[1 : 2 + math.ceil(excess)]
    made_up = float(np.sum(np.maximum(1.0 - following, 0.0)))
    return max(round(excess - made_up), 0)
