"""The contacts in a log as validation sees them: through the payload and the coupling of the file, not of a fit."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import AxisGains, Controller
from autotune.formats.units import ROTATIONAL_AXES
from identification.axes.straight import AxisMotion, find_axes
from identification.axes.turning import Unrolled, find_turns, rests_after, unroll
from identification.conventions.choice import read_by_weight
from identification.errors import EstimateError, LogError
from identification.joint_fit.segments import find_holds
from identification.payload.gravity import GravityFit, identify_gravity
from identification.payload.static_poses import GRAVITY_B_M_S2, collect_static_poses
from identification.signals.aligned import AlignedLog, align
from identification.signals.contact_rule import CONTACT
from identification.signals.recording import AXES, Frames, Recording
from identification.signals.segments import MotionSpans, Span, find_motion
from identification.timeline.contacts import ContactTimes, find_contacts, learn_law
from identification.timeline.payload import AxisContacts, observe_payload, press_sign
from problems.arrays import FloatArray
from problems.contact.nonlinearities import DeadbandType
from problems.model.axis_kind import LEVER_M
from problems.model.controller import AdmittanceController

from .replay import equation_gains
from .replay_kernel import equation_commands, rest_at

_UNEXPLAINED_N, _UNEXPLAINED_SHARE = 5.0, 0.05
_BEFORE_S, _SPEED_S = 0.06, 0.01
_TARE_S = 0.5
_SAME_GAIN = 0.01


@dataclass(frozen=True, kw_only=True)
class LogContact:
    """One contact on one axis of S, in samples of the log's clock; about rx, ry, rz in rad and N·m for m and N.

    `force_n` (n,) is that of the whole log along the axis, free of weight and bias, `position_m` and `command_m` (n,)
    the flange's; `sign` is +1 where the payload presses towards +axis. `speed_m_s` is that of the approach;
    `stiffness_n_per_m` K_e estimated from this contact alone, None where it cannot be.
    """

    axis: str
    times: ContactTimes
    onset: int
    sign: float
    speed_m_s: float
    stiffness_n_per_m: float | None
    force_n: FloatArray
    position_m: FloatArray
    command_m: FloatArray
    noise_rms_n: float


@dataclass(frozen=True, kw_only=True)
class ContactLog:
    """All contacts of a log; `mass_kg` is the payload's, weighed in the log (`is_weighed`) or from the file."""

    period_s: float
    mass_kg: float
    is_weighed: bool
    contacts: tuple[LogContact, ...]


def find_log_contacts(recording: Recording, controller: Controller, frames: Frames | None = None) -> ContactLog:
    """Find the contacts along the controller's axes.

    The weight is that of the rests in the log where they determine it, else that of the file's payload. Raises LogError
    for a log without command, with other gains or another payload, EstimateError for one without raw wrench or pose.
    """
    _check_gains(recording, controller)
    if recording.command is None:
        raise LogError(
            "The log must hold the commanded pose, found none: without it nothing shows whether this controller was "
            "running. Record the position command, or name it with --command-topic."
        )
    log = align(recording)
    motion = find_motion(log)
    weighed = _weighed(recording, log, motion, controller, frames)
    mass = controller.payload.mass_kg if weighed.gravity is None else weighed.gravity.mass_kg
    turns = _turns(weighed, controller)
    turned = {rest for turn in turns for rest in turn.holds}
    contacts = [
        contact
        for axis in find_axes(weighed.log, weighed.motion, weighed.force_S_n).axes
        if axis.name in controller.axes
        for contact in _straight_contacts(axis, controller.certificate.domain[axis.name], mass, weighed, turned)
    ]
    contacts += [
        contact
        for turn in turns
        for contact in _turned_contacts(turn, controller.certificate.domain[turn.name], weighed)
    ]
    return ContactLog(
        period_s=log.period_s, mass_kg=mass, is_weighed=weighed.gravity is not None, contacts=tuple(contacts)
    )


def _check_gains(recording: Recording, controller: Controller) -> None:
    """Raise LogError where the log holds gains, and other ones than the file."""
    if recording.gains is None:
        return
    for name, asked in controller.axes.items():
        column = AXES.index(name)
        for symbol, logged, stated in (
            ("M_a", recording.gains.mass, asked.mass),
            ("B_a", recording.gains.damping, asked.damping),
        ):
            usual = float(np.nanmedian(logged[:, column])) if np.any(np.isfinite(logged[:, column])) else stated
            if abs(usual / stated - 1.0) > _SAME_GAIN:
                topic = recording.gains.topic
                says = f"topic {topic}" if topic else "cell.yaml (`gains`)"
                raise LogError(
                    f"The log was recorded with another controller: {says} says {symbol} = {usual:.6g} on axis {name}, "
                    f"the file {stated:.6g}. Give the file that was running{'' if topic else ', or correct cell.yaml'}."
                )


@dataclass(frozen=True, kw_only=True)
class _Weighed:
    """A log as its weight reads it, the force (n, 3) without weight and bias; `gravity` None where the file weighs."""

    recording: Recording
    log: AlignedLog
    motion: MotionSpans
    force_S_n: FloatArray
    gravity: GravityFit | None


def _weighed(
    recording: Recording, log: AlignedLog, motion: MotionSpans, controller: Controller, frames: Frames | None
) -> _Weighed:
    try:
        identify_gravity(collect_static_poses(log, motion.still))
        read = read_by_weight(recording, log, motion, frames)
        gravity = identify_gravity(read.poses)
    except EstimateError:
        payload = controller.payload
        if payload.set_in_cell:
            raise
        weight = payload.mass_kg * log.orientation_BS.inv().apply(GRAVITY_B_M_S2)
        force = np.asarray(log.force_S_n - np.array(payload.force_bias_n) - weight)
        _check_weight(force, motion, controller)
        return _Weighed(recording=recording, log=log, motion=motion, force_S_n=force, gravity=None)
    force = gravity.compensated_force_S_n(read.log)
    return _Weighed(recording=read.recording, log=read.log, motion=read.motion, force_S_n=force, gravity=gravity)


@dataclass(frozen=True, kw_only=True)
class _Turn:
    """A turn as motion along a straight path (`rotation.unroll`), and the rests that it ends in under a torque."""

    name: str
    unrolled: Unrolled
    holds: tuple[Span, ...]


def _turns(weighed: _Weighed, controller: Controller) -> list[_Turn]:
    """Return the axes of the file about which the tool turned to and fro.

    Raises LogError where the file turns only and the log does not determine the weight, which makes most of the torque.
    """
    names = ROTATIONAL_AXES.intersection(controller.axes)
    if not names:
        return []
    if weighed.gravity is None:
        if names == set(controller.axes):
            raise LogError(
                f"To compare torques about {', '.join(sorted(names))} the log must show the payload's weight and its "
                "centre; record 6 to 12 tilted poses with the contacts."
            )
        return []
    found = []
    least = CONTACT.hold_threshold_n(weighed.gravity.torque_residual_rms_n_m / LEVER_M)
    for turn in find_turns(weighed.recording, weighed.log, weighed.motion, weighed.gravity):
        if turn.name in names:
            unrolled = unroll(turn, weighed.recording, weighed.log)
            holds = rests_after(unrolled.axis.spans, find_holds(weighed.motion.still, unrolled.axis.force_n, least))
            found.append(_Turn(name=turn.name, unrolled=unrolled, holds=holds))
    return found


def _check_weight(force_S_n: FloatArray, motion: MotionSpans, controller: Controller) -> None:
    """Raise LogError where no rest is free of force: another payload, another bias or another sign."""
    left = [float(np.linalg.norm(np.median(force_S_n[span.slice], axis=0))) for span in motion.still]
    limit = _UNEXPLAINED_N + _UNEXPLAINED_SHARE * 9.81 * controller.payload.mass_kg
    if not left or min(left) > limit:
        found = f"{min(left):.1f} N" if left else "no rest"
        raise LogError(
            f"At rest and free the force must be explained by the file's payload of {controller.payload.mass_kg:.4g} "
            f"kg and its bias to {limit:.1f} N, found {found} left; this is another payload, or the sensor was tared. "
            "Record 6 to 12 tilted poses with the contacts, which show the weight."
        )


def _coupling(domain: AxisDomain, mass: float) -> FloatArray:
    return np.array([domain.coupling_stiffness_n_per_m, domain.coupling_damping_n_s_per_m, domain.drag_n_s_per_m, mass])


def _straight_contacts(
    axis: AxisMotion, domain: AxisDomain, mass_kg: float, weighed: _Weighed, turned: Collection[Span]
) -> Iterator[LogContact]:
    """Yield the contacts along an axis; a rest that a turn ended in is pressed sideways, and belongs to the turn."""
    holds = find_holds(weighed.motion.still, axis.force_n, CONTACT.hold_threshold_n(CONTACT.unweighed_residual_n))
    mine = tuple(hold for hold in holds if hold not in turned)
    command = _command_along(weighed.recording, weighed.log, axis, weighed.log.position_B_m[0])
    yield from _axis_contacts(axis, mine, _coupling(domain, mass_kg), command, weighed)


def _turned_contacts(turn: _Turn, domain: AxisDomain, weighed: _Weighed) -> Iterator[LogContact]:
    """Yield the contacts at the end of turns: found on the path, described about the axis."""
    inertia = float(np.mean(domain.payload_mass_kg))
    path = turn.unrolled
    command = _command_along(path.recording, path.log, path.axis, np.zeros(3))
    for found in _axis_contacts(path.axis, turn.holds, _coupling(domain, inertia) / LEVER_M**2, command, weighed):
        stiffness = found.stiffness_n_per_m
        yield replace(
            found,
            speed_m_s=found.speed_m_s / LEVER_M,
            stiffness_n_per_m=None if stiffness is None else stiffness * LEVER_M**2,
            force_n=found.force_n * LEVER_M,
            position_m=found.position_m / LEVER_M,
            command_m=found.command_m / LEVER_M,
            noise_rms_n=found.noise_rms_n * LEVER_M,
        )


def _axis_contacts(
    axis: AxisMotion, holds: tuple[Span, ...], coupling: FloatArray, command: FloatArray, weighed: _Weighed
) -> Iterator[LogContact]:
    log, motion = weighed.log, weighed.motion
    of = AxisContacts(axis=axis, holds=holds, coupling=coupling)
    payload = observe_payload(of, log.period_s)
    free = [span for span in motion.still if span not in holds]
    for times in find_contacts(of, payload, motion, log.period_s).contacts:
        if times.onset is None:
            continue
        law = learn_law(times, of, payload, log.period_s)
        sign = press_sign(of, times.hold)
        tare, noise = _at_rest_before(axis.force_n, free, times.span, log.period_s)
        yield LogContact(
            axis=axis.name,
            times=times,
            onset=times.onset,
            sign=sign,
            speed_m_s=sign * _speed_before(axis.position_m, times.onset, log.period_s),
            stiffness_n_per_m=law.stiffness if law is not None and law.is_clear else None,
            force_n=axis.force_n - tare,
            position_m=axis.position_m,
            command_m=command,
            noise_rms_n=noise,
        )


def _command_along(recording: Recording, log: AlignedLog, axis: AxisMotion, origin_B_m: FloatArray) -> FloatArray:
    """Return the commanded position (n,) along the axis on the log's clock, NaN where it is not covered."""
    command = recording.command
    if command is None:
        return np.full(len(log), np.nan)
    along = (command.position_m - origin_B_m) @ axis.direction_B
    time = (command.stamp_ns - log.start_ns) * 1e-9
    return np.asarray(np.interp(log.time_s, time, along, left=np.nan, right=np.nan))


def _speed_before(position: FloatArray, onset: int, period_s: float) -> float:
    """Return the flange's mean speed over the last 50 ms before the touch."""
    stop = max(onset - round(_SPEED_S / period_s), 2)
    start = max(stop - round(_BEFORE_S / period_s), 0)
    return float(np.polyfit(np.arange(start, stop) * period_s, position[start:stop], 1)[0])


def _at_rest_before(force: FloatArray, free: list[Span], contact: Span, period_s: float) -> tuple[float, float]:
    """Return mean and deviation of the force in the rest before the contact, 0 and that of the log's where none is."""
    before = [span for span in free if span.stop <= contact.start]
    if not before:
        rests = [float(np.std(force[span.slice])) for span in free]
        return 0.0, min(rests, default=CONTACT.unweighed_residual_n)
    last = force[before[-1].slice][-max(2, round(_TARE_S / period_s)) :]
    return float(np.mean(last)), float(np.std(last))


@dataclass(frozen=True, kw_only=True)
class LawFit:
    """How a stretch of command follows the law: the constant F^d that explains it best, and what is left unexplained.

    `left_share` is the RMS of what is left over that of the command's way off a straight line.
    """

    desired_force: float
    left_share: float


def felt(gains: AxisGains, force: FloatArray) -> FloatArray:
    """Return the force (n,) behind the deadband of the file."""
    beyond = np.abs(force) > gains.deadband
    less = gains.deadband if gains.deadband_type is DeadbandType.SUBTRACTIVE else 0.0
    return np.where(beyond, force - np.copysign(less, force), 0.0)


def follow_law(
    law: AdmittanceController, gains: AxisGains, h: float, command: FloatArray, position: FloatArray, force: FloatArray
) -> LawFit:
    """Hold a stretch of command (n,) against the law, with force and position (n,) at the controller's ticks.

    The law is linear behind the deadband, so that F^d and what it remembered at the beginning are found by least
    squares: the answers to force and motion from rest, to a unit of F^d, and to each memory alone add up.
    """
    origin = position[0]
    seen, way = felt(gains, force), position - origin
    quiet = np.zeros(len(command))
    answers = [_answer(law, h, quiet + 1.0, quiet, "steady")]
    answers += [_answer(law, h, quiet, quiet, memory) for memory in _memories(law)]
    answered = _answer(law, h, seen, way, "")
    rows = np.column_stack(answers)[2:]
    wanted = (command - origin - answered)[2:]
    size = np.maximum(np.max(np.abs(rows), axis=0), 1e-300)
    solution = np.linalg.lstsq(rows / size, wanted, rcond=None)[0] / size
    left = wanted - rows @ solution
    time = np.arange(len(command))
    bend = command - np.polyval(np.polyfit(time, command, 1), time)
    share = float(np.sqrt(np.mean(left**2)) / max(float(np.sqrt(np.mean(bend**2))), 1e-12))
    return LawFit(desired_force=float(solution[0]), left_share=share)


def _memories(law: AdmittanceController) -> tuple[str, ...]:
    """Name what the difference equation remembers and the command shows."""
    filtered = law.compensation_mass_kg > 0.0
    return (
        "last",
        "before",
        "force_last",
        *(("velocity",) if law.feedback_damping_s > 0.0 or filtered else ()),
        *(("acceleration",) if filtered else ()),
        *(("force_before", "push_before", "push_last") if law.has_biquad else ()),
    )


def _answer(law: AdmittanceController, h: float, force: FloatArray, position: FloatArray, memory: str) -> FloatArray:
    """Return the commands (n,) to force and position, from rest but for one memory of unit size.

    `steady` has felt the same force before; `force_last` is both forces before, which the command shows apart
    in its first sample only.
    """
    steady = ("force_before", "force_last", "push_before", "push_last")
    fields = steady if memory == "steady" else tuple(filter(None, (memory,)))
    past = rest_at(0.0)._replace(**dict.fromkeys(fields, 1.0))
    return equation_commands(equation_gains(law, h), past, force, position)
