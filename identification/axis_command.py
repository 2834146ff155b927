"""Joint fit of one axis behind the command that explains its motion: held, smooth between its samples, or rebuilt."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from problems.arrays import FloatArray
from problems.progress import ProgressSlice

from .axes.straight import AXIS_NAMES, AxisMotion, commanded_motion
from .axes.turning import AxisTurn
from .errors import EstimateError
from .given import Given
from .joint_fit.data import JointData, build_joint_data
from .joint_fit.fit import identify_joint
from .joint_fit.result import JointFit, with_longer_delay, with_robot_shift
from .payload.gravity import GravityFit
from .result import RobotEstimate
from .robot.coupling import CouplingFit
from .robot.logged_command import MODEL_STD_SHARE, LoggedRobot, identify_logged_robot
from .signals.aligned import AlignedLog
from .signals.recording import PoseSignal, Recording
from .signals.segments import MotionSpans, Span

# Swings of the payload per period of the log up to which it does not matter how long each command was held: measured on
# simulated cells whose controller ran two and three times as fast as the log.
_SLOW_MODE = 0.15
# What of half a sample a path may be off in time behind a command that is smooth between its samples: measured on
# simulated cells whose controller ran one to eight times as fast as a log of 125 to 250 Hz. Of one pole behind a
# command that may have been held the speed jumps, and all of it is open, as behind a command that a force makes.
_SMOOTH_SHARE = 0.05


@dataclass(frozen=True, kw_only=True)
class CellSignals:
    """What the axes of a recording share; `force_S_n` (n, 3) is free of weight and bias.

    `gravity` is None where the weight was taken off before recording; `noise_rms_n` is the force's at rest, and
    `rest_residual_n` what weight and bias leave of it. `robots` are those that the admittance's known gains show where
    no command was logged, and `rebuilt` the command that they make of the wrench; `turns`, the axes about which the
    tool turned. `turning_S_n` (n, 3) is what of the force turns the payload, where mass, inertia and torque show it.
    `coupled` are K_s, B_s, B_p, M_p (4,) by axis, where a search starts, as pushes without a hand show
    them.
    """

    recording: Recording
    log: AlignedLog
    motion: MotionSpans
    gravity: GravityFit | None
    noise_rms_n: float
    rest_residual_n: float
    force_S_n: FloatArray
    given: Mapping[str, Given]
    robots: Mapping[str, RobotEstimate]
    rebuilt: PoseSignal | None = None
    turns: tuple[AxisTurn, ...] = ()
    turning_S_n: FloatArray | None = None
    coupled: Mapping[str, FloatArray] = field(default_factory=dict)

    def turning_of(self, axis: str) -> FloatArray | None:
        """Return what of the force along a straight axis turns the payload (n,), None where that is not known."""
        known = self.turning_S_n is not None and axis in AXIS_NAMES
        column = None if not known or self.turning_S_n is None else self.turning_S_n[:, AXIS_NAMES.index(axis)]
        return None if column is None or not np.all(np.isfinite(column)) else column


@dataclass(frozen=True, kw_only=True)
class AxisKnowledge:
    """What is known of an axis before its fit: `mass_kg` is where the search for M_p starts, `priors` what is given.

    `in_units` turns the fit into the units of the axis; `weighed` is M_p from gravity with its deviation.
    """

    mass_kg: float | None
    priors: Mapping[str, tuple[float, float]]
    in_units: Callable[[JointFit], JointFit]
    weighed: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class CommandedFit:
    """The data of an axis under the command that took part, if one did, and their fit.

    What the robot behind that command leaves open moves r(s), T_d by `robot_shift` (p,), its joints' friction, and the
    delay by `longer_s` (mean, standard deviation), how long each command was held and a second pole. Where it is not
    known how the command went between its samples, `pole_share` of the pole is open.
    """

    data: JointData
    fit: JointFit
    robot_shift: FloatArray | None
    longer_s: tuple[float, float]
    pole_share: float = 0.0

    def with_robot_errors(self, fit: JointFit) -> JointFit:
        """Return a fit to these data with what is left open of the robot in its values and deviations."""
        moved = fit if self.robot_shift is None else with_robot_shift(fit, self.robot_shift)
        if self.pole_share and fit.robot is not None:
            shift = np.zeros(fit.robot.order + 1)
            shift[0] = self.pole_share * fit.values[fit.names.index("delay_s") - fit.robot.order]
            moved = with_robot_shift(moved, shift)
        return with_longer_delay(moved, *self.longer_s)


@dataclass(frozen=True, kw_only=True)
class _Axis:
    """What every fit of an axis begins with."""

    cell: CellSignals
    axis: AxisMotion
    holds: tuple[Span, ...]
    coupling: CouplingFit | None
    start: AxisKnowledge
    progress: ProgressSlice

    def joined(self, robot: LoggedRobot | None, command: PoseSignal | None, *, is_smooth: bool = False) -> CommandedFit:
        """Return the fit under a command, held or smooth between its samples; under none without a robot."""
        recording = self.cell.recording
        robot_fit = None if robot is None else robot.behind_samples if is_smooth else robot.behind_hold
        data = build_joint_data(
            self.cell.log,
            self.cell.motion,
            self.axis,
            self.holds,
            self.coupling,
            None if robot_fit is None else robot_fit.model,
            command,
            self.start.mass_kg,
            self.cell.noise_rms_n,
            recording.wrench_lag_s,
            recording.pose.stamp_ns,
            is_smooth=is_smooth,
        )
        data = replace(
            data,
            coupling=data.coupling
            if self.coupling is not None
            else self.cell.coupled.get(self.axis.name, data.coupling),
            weighed=self.start.weighed,
            shifted_s=recording.wrench_shifted_s,
            least_noise_n=self.cell.noise_rms_n if self.cell.gravity is None else 0.0,
            turning_n=self.cell.turning_of(self.axis.name),
        )
        if is_smooth and robot is not None and data.command is not None:
            may_jump = robot.behind_hold is not None and data.robot_order == 1
            share = 1.0 if may_jump or command is self.cell.rebuilt else _SMOOTH_SHARE
            data = replace(data, command=replace(data.command, untimed_share=share))
        longer_s, shift = (0.0, 0.0), None
        if robot is not None and robot_fit is not None:
            longer_s = robot.longer_than_samples_s if is_smooth else robot.longer_s
            longer_s = (longer_s[0], float(np.hypot(longer_s[1], robot_fit.second_pole_std_s)))
            shift = robot_fit.friction_shift
        return CommandedFit(
            data=data,
            fit=identify_joint(data, self.progress),
            robot_shift=shift,
            longer_s=longer_s,
            pole_share=0.0 if robot is None or robot.is_held else MODEL_STD_SHARE,
        )

    def served(self, robot: LoggedRobot, command: PoseSignal) -> CommandedFit | None:
        """Return the fit under a command as it was held, or as a smooth one; None where neither explains the motion."""
        if robot.is_held:
            return self.joined(robot, command)
        with suppress(EstimateError):
            if robot.behind_hold is not None:
                held = self.joined(robot, command)
                if held.fit.own_frequency_hz * held.data.period_s < _SLOW_MODE:
                    return held
        with suppress(EstimateError):
            if robot.behind_samples is not None:
                return self.joined(robot, command, is_smooth=True)
        return None


def fit_behind_command(
    cell: CellSignals,
    axis: AxisMotion,
    holds: tuple[Span, ...],
    coupling: CouplingFit | None,
    behind: LoggedRobot | None,
    start: AxisKnowledge,
    progress: ProgressSlice,
) -> CommandedFit:
    """Fit everything together, under the command that gains make of the wrench where that explains the motion.

    A command that is not known to be held between its samples takes part as a smooth one, where the payload swings fast
    beside the log's rate. Raises EstimateError as `identify_joint` does.
    """
    of = _Axis(cell=cell, axis=axis, holds=holds, coupling=coupling, start=start, progress=progress)
    if cell.rebuilt is not None and axis.name in cell.robots and axis.name in AXIS_NAMES:
        with suppress(EstimateError):
            found = of.served(behind_command(cell, axis, cell.rebuilt)[0], cell.rebuilt)
            if found is not None:
                return found
    command = cell.recording.command
    found = None if behind is None or command is None else of.served(behind, command)
    return of.joined(None, command) if found is None else found


def behind_command(cell: CellSignals, axis: AxisMotion, command: PoseSignal) -> tuple[LoggedRobot, float]:
    """Return the robot behind a command, and the command's period [s]; raises EstimateError without one."""
    period = cell.given.get("sample_time_s")
    moved = commanded_motion(cell.recording, command, cell.log, axis)
    found = identify_logged_robot(
        moved.command_m,
        moved.position_m,
        moved.period_s,
        is_uniform=moved.is_uniform,
        control_period_s=None if period is None else period.value,
    )
    return found, moved.period_s
