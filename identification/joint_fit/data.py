"""Data of the joint fit of one axis: signals on one clock, spans, and start values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import make_interp_spline

from problems.arrays import FloatArray
from problems.model.robot import RobotModel

from ..axes.straight import AxisMotion, find_ringing, keeps_orientation, unguided_spans
from ..robot.coupling import CouplingFit
from ..signals.aligned import AlignedLog
from ..signals.recording import PoseSignal, StampArray, find_gaps
from ..signals.segments import MotionSpans, Span

_SAME_PHASE = 0.05
_ROUNDING = 1e-3
_USUAL_RESONANCE_HZ = 25.0
_USUAL_DRAG_N_S_PER_M = 200.0
USUAL_MASS_KG = 10.0
_USUAL_LAG_S = 1e-3
_USUAL_LAG_PERIODS = 1.5
_SETTLED_S = 1.5
_MOST_MOVING_S, _MOST_FREE_S, _PIECE_S = 120.0, 60.0, 15.0
_MOST_PER_PLACE, _SAME_PLACE_M = 8, 3e-3
_LONGEST_APPROACH_S = 3.25
_BEFORE_HOLE_S = 0.35


@dataclass(frozen=True, kw_only=True)
class HeldCommand:
    """The command on the log's clock: `command_m[k]` (n,) is what was issued from tick k until before the next.

    It was issued `shift_s` after the tick, always, so a delay counted from the ticks is `shift_s` too long. With
    `is_mean` each is the mean of what was issued in that sample; with `is_smooth` it is the command at the tick, which
    is a spline between, and leaves the flange's speed open by `untimed_share` of half a sample.
    """

    command_m: FloatArray
    shift_s: float
    is_mean: bool = False
    is_smooth: bool = False
    untimed_share: float = 1.0


@dataclass(frozen=True, kw_only=True)
class JointData:
    """One axis of an aligned log, its spans, and the estimates of the stages.

    `position_m`, `force_n` (n,) on one clock of period `period_s`, the force without weight and bias; `command` on
    the same clock, or None. `rests`, spans at rest for the noise; `moving`, all spans of motion along this axis;
    `free`, those without a hand, and `mixed`, those in which one does work; `rings`, where the payload swings after
    something let go; `holds`, rests under
    force. `coupling` is K_s, B_s, B_p, M_p (4,), `robot` r(s) of one or two poles and T_d. `latency_s` is how late the
    wrench may be stamped, mean and standard deviation, after `shifted_s` was taken off its stamps when it was read;
    `measured`, first tick at which the pose was measured and every how many it was (between them it is interpolated).
    `mass_kg`, from gravity, is a start too and no information; M_p is looked for between a fifth of it and five times
    it. `priors` maps names of `ParameterLayout.names` to value and standard deviation known from elsewhere; `weighed`
    is M_p from gravity with its deviation, for ringing that has nothing else to go by. `least_noise_n` is the force's
    noise where a deadband may hide it at rest; `turning_n` (n,) is what of the force turns a payload that is free.
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
    mixed: Sequence[Span] = ()
    rings: Sequence[Span] = ()
    latency_s: tuple[float, float] = (0.0, _USUAL_LAG_S)
    measured: tuple[int, int] = (0, 1)
    shifted_s: float = 0.0
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    weighed: tuple[float, float] | None = None
    least_noise_n: float = 0.0
    turning_n: FloatArray | None = None

    @property
    def is_smooth(self) -> bool:
        """Whether the command is smooth between its samples."""
        return self.command is not None and self.command.is_smooth

    @property
    def robot_order(self) -> int:
        """Poles of the robot that is fitted, 0 without one."""
        return 0 if self.robot is None or self.command is None else self.robot.order


def hold_command(command: PoseSignal, log: AlignedLog, axis: AxisMotion, *, is_smooth: bool = False) -> HeldCommand:
    """Put the command on the log's clock.

    A command at the log's rate or at a whole fraction of it changes always at one phase of a sample, and the robot's
    answer is exact. Any other is replaced by its mean over every sample: the same push at slightly another time, which
    makes the delay wrong by about ω h²/12. Before its first message the command is that one; `uncovered` shows where it
    says nothing. One that `is_smooth` between its samples is a spline through them.
    """
    period = log.period_s
    ticks = (command.stamp_ns - log.start_ns) * 1e-9 / period
    issued = (command.position_m - log.position_B_m[0]) @ axis.direction_B
    if is_smooth:
        path = make_interp_spline(ticks, issued, k=3)
        at_ticks = path(np.clip(np.arange(len(log)), ticks[0], ticks[-1]))
        return HeldCommand(command_m=np.asarray(at_ticks), shift_s=0.0, is_smooth=True)
    inside = (ticks >= 0.0) & (ticks <= len(log) - 1)
    # A stamp that rounding puts just before its tick belongs to that tick.
    phase = np.mod(ticks[inside] + _ROUNDING, 1.0) - _ROUNDING
    shift = float(np.median(phase)) if phase.size else 0.0
    if phase.size and float(np.max(np.abs(phase - shift))) <= _SAME_PHASE:
        latest = np.searchsorted(ticks, np.arange(len(log)) + 1.0 - _ROUNDING, side="left") - 1
        return HeldCommand(command_m=np.asarray(issued[np.maximum(latest, 0)]), shift_s=max(shift, 0.0) * period)
    pushed = np.concatenate([[0.0], np.cumsum(issued[:-1] * np.diff(ticks))])
    edges = np.arange(len(log) + 1.0)
    total = np.interp(edges, ticks, pushed)
    total += np.minimum(edges - ticks[0], 0.0) * issued[0] + np.maximum(edges - ticks[-1], 0.0) * issued[-1]
    return HeldCommand(command_m=np.diff(total), shift_s=0.0, is_mean=True)


def uncovered(command: PoseSignal, log: AlignedLog) -> tuple[Span, ...]:
    """Return the parts of the log about which the command says nothing: before it, after it, in its gaps."""
    ticks = (command.stamp_ns - log.start_ns) * 1e-9 / log.period_s
    usual = 2.0 * float(np.median(np.diff(ticks)))
    edges = [(0.0, ticks[0] - usual), (ticks[-1] + usual, len(log) - 1.0)]
    edges += [(ticks[i], ticks[i + 1]) for i in find_gaps(command.stamp_ns).tolist()]
    return tuple(Span(start=int(max(a, 0.0)), stop=int(min(b, len(log) - 1.0)) + 1) for a, b in edges if b > a)


def build_joint_data(
    log: AlignedLog,
    motion: MotionSpans,
    axis: AxisMotion,
    holds: Sequence[Span],
    coupling: CouplingFit | None,
    robot: RobotModel | None,
    command: PoseSignal | None,
    mass_kg: float | None,
    noise_rms_n: float = 0.0,
    latency_s: tuple[float, float] | None = None,
    pose_stamp_ns: StampArray | None = None,
    *,
    is_smooth: bool = False,
) -> JointData:
    """Gather what `identify_joint` needs.

    `holds` are the rests that press along this axis, `mass_kg` is from gravity if that is known, `noise_rms_n` the
    force's at rest; a command that `is_smooth` is one between its samples. Where the stage refused the coupling (None),
    the refinement starts from the mass and a usual resonance.
    """
    known = command is not None and robot is not None
    holes = (*log.holes, *(uncovered(command, log) if known and command is not None else ()))
    if known and any(span.start == 0 for span in motion.moving):
        # The commands before the log, to a robot that moves already, are as unknown as those in a hole.
        holes = (*holes, Span(start=0, stop=1))
    free = unguided_spans(axis)
    mixed = [span for span in axis.spans if span not in free]
    steady = [s for s in motion.moving if keeps_orientation(log, s)]
    pressed = {(s.start, s.stop) for s in holds}
    return JointData(
        period_s=log.period_s,
        position_m=_without_holes(axis.position_m, log.holes),
        force_n=_without_holes(axis.force_n, log.holes),
        command=hold_command(command, log, axis, is_smooth=is_smooth) if known and command is not None else None,
        rests=tuple(s for s in motion.still if (s.start, s.stop) not in pressed),
        moving=_most_informative(_off_holes(axis.spans, holes, log.period_s), axis, log.period_s, _MOST_MOVING_S),
        free=_most_informative(_off_holes(free, holes, log.period_s), axis, log.period_s, _MOST_FREE_S),
        mixed=_off_holes(mixed, holes, log.period_s),
        rings=_off_holes(find_ringing(axis, steady, free, holds, noise_rms_n, log.period_s), holes, log.period_s),
        holds=_few_of_each_place(_approached(holds, holes, log.period_s), axis),
        coupling=usual_coupling(mass_kg or USUAL_MASS_KG) if coupling is None else _values(coupling),
        robot=robot,
        mass_kg=mass_kg,
        measured=(0, 1) if pose_stamp_ns is None else _measured(pose_stamp_ns, log),
        latency_s=(0.0, max(_USUAL_LAG_S, _USUAL_LAG_PERIODS * log.period_s)) if latency_s is None else latency_s,
    )


def _measured(pose_stamp_ns: StampArray, log: AlignedLog) -> tuple[int, int]:
    """Return the first tick with a measured pose and every how many there is one; (0, 1) where they keep no step."""
    ticks = (pose_stamp_ns - log.start_ns) * 1e-9 / log.period_s
    step = float(np.median(np.diff(ticks)))
    every = round(step)
    phase = np.mod(ticks + 0.5, 1.0) - 0.5
    if every < 2 or abs(step - every) > _SAME_PHASE or float(np.max(np.abs(phase))) > _SAME_PHASE:
        return 0, 1
    counts = np.bincount(np.mod(np.round(ticks).astype(np.int64), every), minlength=every)
    return int(np.argmax(counts)), every


def _most_informative(spans: Sequence[Span], axis: AxisMotion, period_s: float, most_s: float) -> tuple[Span, ...]:
    """Return the spans, cut into pieces where they are too long, with most force until `most_s` are full.

    Ten minutes show no more than the best of them.
    """
    left = round(most_s / period_s)
    if sum(len(span) for span in spans) <= left:
        return tuple(spans)
    piece = round(_PIECE_S / period_s)
    cut = [
        Span(start=start, stop=min(start + piece, span.stop))
        for span in spans
        for start in range(span.start, span.stop, piece)
    ]
    kept = []
    for span in sorted(cut, key=lambda s: -float(np.var(axis.force_n[s.slice]))):
        if left > 0:
            kept.append(span)
            left -= len(span)
    return tuple(sorted(kept, key=lambda s: s.start))


def _few_of_each_place(holds: Sequence[Span], axis: AxisMotion) -> tuple[Span, ...]:
    """Return at most 8 rests under force at each place, to a few millimetres, and on each side, spread over the log."""
    places: dict[tuple[int, bool], list[Span]] = {}
    for hold in holds:
        place = round(float(np.median(axis.position_m[hold.slice])) / _SAME_PLACE_M)
        side = bool(np.median(axis.force_n[hold.slice]) > 0.0)
        near = next((key for key in places if abs(key[0] - place) <= 1 and key[1] == side), (place, side))
        places.setdefault(near, []).append(hold)
    few = [
        each[i]
        for each in places.values()
        for i in np.unique(np.linspace(0, len(each) - 1, min(len(each), _MOST_PER_PLACE)).round().astype(int)).tolist()
    ]
    return tuple(sorted(few, key=lambda s: s.start))


def _without_holes(values: FloatArray, holes: Sequence[Span]) -> FloatArray:
    """Return values (n,) with straight lines across the holes, which no span that is used comes near."""
    filled = np.array(values) if holes else values
    for hole in holes:
        edges = [i for i in (hole.start - 1, hole.stop) if 0 <= i < len(values)]
        filled[hole.slice] = np.interp(np.arange(hole.start, hole.stop), edges, values[edges])
    return filled


def _off_holes(spans: Sequence[Span], holes: Sequence[Span], period_s: float) -> tuple[Span, ...]:
    """Return what is left of spans of motion that begin 1.5 s after a hole at the earliest, and end before the next.

    After a hole of the command the robot's answer is known again once what it did before has died away.
    """
    behind, before = round(_SETTLED_S / period_s), round(_BEFORE_HOLE_S / period_s)
    left = list(spans)
    for hole in holes:
        first, last = hole.start - before, hole.stop + behind
        left = [
            Span(start=a, stop=b)
            for s in left
            for a, b in ((s.start, min(s.stop, first)), (max(s.start, last), s.stop))
            if b > a
        ]
    return tuple(left)


def _approached(holds: Sequence[Span], holes: Sequence[Span], period_s: float) -> tuple[Span, ...]:
    """Return the holds before which, as long as an approach may take, and in which the log has no hole."""
    longest = round((_SETTLED_S + _LONGEST_APPROACH_S) / period_s)
    return tuple(s for s in holds if not any(s.start - longest < h.stop and h.start < s.stop for h in holes))


def _values(coupling: CouplingFit) -> FloatArray:
    return np.array([coupling.stiffness_n_per_m, coupling.damping_n_s_per_m, coupling.drag_n_s_per_m, coupling.mass_kg])


def usual_coupling(mass_kg: float) -> FloatArray:
    """Return K_s, B_s, B_p, M_p (4,) of a usual cell with this payload: where a search may start."""
    omega = 2.0 * np.pi * _USUAL_RESONANCE_HZ
    return np.array([mass_kg * omega**2, 0.1 * mass_kg * omega, _USUAL_DRAG_N_S_PER_M, mass_kg])
