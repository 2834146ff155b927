"""What the joint refinement starts from, put together from the stages of one axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from problems.robot import RobotModel

from .aligned import AlignedLog
from .axes import AxisMotion, unguided_spans
from .coupling import CouplingFit
from .recording import PoseSignal
from .segments import Motion, Span

FloatArray = NDArray[np.float64]

_SAME_PHASE = 0.05
_ROUNDING = 1e-3
_USUAL_RESONANCE_HZ = 25.0
_USUAL_DRAG_N_S_PER_M = 200.0


@dataclass(frozen=True, kw_only=True)
class HeldCommand:
    """The command on the log's clock: `command_m[k]` (n,) is what was issued from tick k until before the next.

    It was issued `shift_s` after the tick, always, so a delay counted from the ticks is `shift_s` too long.
    """

    command_m: FloatArray
    shift_s: float


@dataclass(frozen=True, kw_only=True)
class JointData:
    """One axis of an aligned log, its spans, and the estimates of the stages.

    `position_m`, `force_n` (n,) on one clock of period `period_s`, the force without weight and bias; `command` on the
    same clock, or None. `rests`, spans at rest for the noise; `moving`, all spans of motion along this axis; `free`,
    those without a hand; `holds`, rests under force. `coupling` is K_s, B_s, B_p, M_p (4,), `robot` r(s) of one or two
    poles and T_d. `mass_kg`, from gravity, is a start too and no information; M_p is looked for
    between a fifth of it and five times it. `priors` maps names of `Layout.names` to value and standard deviation
    known from elsewhere.
    """

    period_s: float
    position_m: FloatArray
    force_n: FloatArray
    command: HeldCommand | None
    rests: Sequence[Span]
    moving: Sequence[Span]
    free: Sequence[Span]
    holds: Sequence[Span]
    coupling: FloatArray
    robot: RobotModel | None
    mass_kg: float | None = None
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def robot_order(self) -> int:
        """Poles of the robot that is fitted, 0 without one."""
        return 0 if self.robot is None or self.command is None else self.robot.order


def hold_command(command: PoseSignal, log: AlignedLog, axis: AxisMotion) -> HeldCommand | None:
    """Put the command on the log's clock; None when its stamps do not lie at one phase of that clock, or not over it.

    The exact answer of a held command needs to know when in a sample it changes: a command at the log's rate or at a
    whole fraction of it does so always at the same time.
    """
    period = log.period_s
    ticks = (command.stamp_ns - log.start_ns) * 1e-9 / period
    inside = (ticks >= 0.0) & (ticks <= len(log) - 1)
    if np.count_nonzero(inside) < 2 or ticks[0] > 1.0 or ticks[-1] < len(log) - 2:
        return None
    # A stamp that rounding puts just before its tick belongs to that tick.
    phase = np.mod(ticks[inside] + _ROUNDING, 1.0) - _ROUNDING
    shift = float(np.median(phase))
    if float(np.max(np.abs(phase - shift))) > _SAME_PHASE:
        return None
    latest = np.searchsorted(ticks, np.arange(len(log)) + 1.0 - _ROUNDING, side="left") - 1
    issued = (command.position_m[np.maximum(latest, 0)] - log.position_B_m[0]) @ axis.direction_B
    return HeldCommand(command_m=np.asarray(issued), shift_s=max(shift, 0.0) * period)


def build_joint_data(
    log: AlignedLog,
    motion: Motion,
    axis: AxisMotion,
    holds: Sequence[Span],
    coupling: CouplingFit | None,
    robot: RobotModel | None,
    command: PoseSignal | None,
    mass_kg: float,
) -> JointData:
    """Gather what `identify_joint` needs; `holds` are the rests that press along this axis, `mass_kg` from gravity.

    Where the stage refused the coupling (None), the refinement starts from the mass and a usual resonance.
    """
    held = None if command is None or robot is None else hold_command(command, log, axis)
    pressed = {(s.start, s.stop) for s in holds}
    return JointData(
        period_s=log.period_s,
        position_m=axis.position_m,
        force_n=axis.force_n,
        command=held,
        rests=tuple(s for s in motion.still if (s.start, s.stop) not in pressed),
        moving=axis.spans,
        free=unguided_spans(axis),
        holds=tuple(holds),
        coupling=_start(mass_kg) if coupling is None else _values(coupling),
        robot=robot,
        mass_kg=mass_kg,
    )


def _values(coupling: CouplingFit) -> FloatArray:
    return np.array([coupling.stiffness_n_per_m, coupling.damping_n_s_per_m, coupling.drag_n_s_per_m, coupling.mass_kg])


def _start(mass_kg: float) -> FloatArray:
    omega = 2.0 * np.pi * _USUAL_RESONANCE_HZ
    return np.array([mass_kg * omega**2, 0.1 * mass_kg * omega, _USUAL_DRAG_N_S_PER_M, mass_kg])
