"""Time line, touches and surfaces of a log, by the payload and the coupling that the fit of each axis knows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from problems.model.axis_kind import LEVER_M

from .axes.straight import AXIS_NAMES
from .axis_command import CellSignals
from .axis_estimate import AxisResult
from .result import (
    CONTACT_UNEXPLAINED,
    AxisEstimate,
    EnvironmentEstimate,
    Finding,
    LogPhase,
    PhaseKind,
    Timeline,
    Touch,
    TouchCause,
)
from .robot.admittance_motion import with_compensated_force
from .signals.aligned import AlignedLog
from .signals.recording import AXES, Recording
from .timeline.contacts import find_contacts
from .timeline.left_contacts import Accounted, ObservedAxis, account_for_contacts
from .timeline.payload import observe_payload, press_sign
from .timeline.timeline import build_timeline, name_surfaces
from .touches.find import approach_speed, describe_touch, desired_speed
from .touches.inertia import KnownMotion
from .touches.signals import AxisSignals, desired_force_of, gains_of, lead_of, sample_noise
from .touches.surfaces import identify_touches

# A hand that helps, or holds back, by less than this of F^d leaves the approach as it is.
_SPEED_SHARE = 0.2


def account_for_log(cell: CellSignals, results: Mapping[str, AxisResult], mass_kg: float) -> tuple[Accounted, Timeline]:
    """Return the surfaces of all contacts, and what happened when.

    Parameters
    ----------
    cell
        The signals that the axes share.
    results
        The axes by name, with the contacts and the fit of each.
    mass_kg
        M_p [kg].

    """
    contacts, period = [axis.contacts for axis in results.values()], cell.log.period_s
    payloads = [observe_payload(of, period) for of in contacts]
    pressed = [find_contacts(of, seen, cell.motion, period) for of, seen in zip(contacts, payloads, strict=True)]
    phases = build_timeline(
        cell.log, cell.motion, cell.force_S_n, contacts, cell.recording.command, mass_kg, pressed, payloads
    )
    axes = []
    for (name, axis), payload, found in zip(results.items(), payloads, pressed, strict=True):
        surfaces = () if axis.fit is None else axis.fit.surfaces
        # What the fit leaves without a stiffness is none of its surfaces: the slope of force over depth may show one.
        known = [each.stiffness_n_per_m.value is not None for each in axis.estimate.environments]
        onsets = [[t * period for t in each.onsets] if ok else [] for each, ok in zip(surfaces, known, strict=True)]
        phases = name_surfaces(phases, name, onsets)
        signs = [surface.sign for surface in surfaces]
        axes.append(
            ObservedAxis(
                of=axis.contacts,
                payload=payload,
                pressed=found,
                coupling=axis.estimate.coupling.stiffness_n_per_m,
                surfaces=tuple(zip(signs, axis.estimate.environments, strict=True)),
                lever_m=1.0 if name in AXIS_NAMES else LEVER_M,
            )
        )
    accounted = account_for_contacts(phases, axes, period)
    touches = touches_of(cell.recording, cell.log, axes, accounted.phases)
    return accounted, Timeline(phases=accounted.phases, touches=touches)


def with_unfitted_touches(
    cell: CellSignals, results: Mapping[str, AxisResult], accounted: Accounted, timeline: Timeline
) -> tuple[Accounted, Timeline]:
    """Return both with what force over the flange's way shows of axes on which motion shows no coupling.

    There the payload's way is not known, so the stiffness is that of surface and coupling in series, as in a log
    without the payload's weight.
    """
    pressed = {touch.axis for touch in timeline.touches}
    unknown = {
        name
        for name, axis in results.items()
        if name in AXIS_NAMES
        and name in pressed
        and axis.estimate.coupling.stiffness_n_per_m.value is None
        and not accounted.surfaces.get(name)
    }
    if not unknown:
        return accounted, timeline
    known = KnownMotion(axes=frozenset(AXIS_NAMES) - unknown, turning_s=turning_spans(timeline))
    touched = identify_touches(with_compensated_force(cell.recording, cell.log, cell.force_S_n), known)
    shown = {name: touched.surfaces[name] for name in unknown if touched.surfaces.get(name)}
    if not shown:
        return accounted, timeline
    others = [each for each in timeline.touches if each.axis not in shown]
    found = [each for each in touched.timeline.touches if each.axis in shown]
    about = [each for each in accounted.findings if each.code != CONTACT_UNEXPLAINED or each.axis not in shown]
    return (
        replace(accounted, surfaces={**accounted.surfaces, **shown}, findings=(*about, *touched.findings)),
        replace(timeline, touches=_in_time((*others, *found))),
    )


def turning_spans(timeline: Timeline) -> tuple[tuple[float, float], ...]:
    """Return when the tool turned, (start, stop) [s] each."""
    return tuple((each.start_s, each.stop_s) for each in timeline.phases if each.kind is PhaseKind.TURNING)


def with_surfaces(axis: AxisEstimate, added: Sequence[EnvironmentEstimate]) -> AxisEstimate:
    """Return the axis with the surfaces that slopes show, in place of those that the fit leaves without a stiffness."""
    fitted = [each for each in axis.environments if not added or each.stiffness_n_per_m.value is not None]
    return replace(axis, environments=(*fitted, *added))


def without_surface(findings: Sequence[Finding], accounted: Accounted) -> Iterator[Finding]:
    """Yield the findings without those that no contact was found where a slope shows the surface."""
    return (each for each in findings if each.code != "no-contact" or not accounted.surfaces.get(each.axis or ""))


def hand_findings(timeline: Timeline) -> list[Finding]:
    """Report of contacts during which somebody pushed."""
    pushed = [p for p in timeline.phases if p.contact is not None and p.contact.hand_suspected]
    if not pushed:
        return []
    when = ", ".join(f"{phase.start_s:.1f} s" for phase in pushed)
    return [
        Finding(
            code="hand-in-contact",
            severity="warning",
            message=f"During the contact at {when} the force does not follow depth and speed as on a surface: a hand "
            "may have pushed, or what is touched gave way.",
            advice="Keep hands off the payload while it touches, clamp what it presses on, and record these contacts "
            "again.",
        )
    ]


def touches_of(
    recording: Recording, log: AlignedLog, axes: Sequence[ObservedAxis], phases: Sequence[LogPhase]
) -> tuple[Touch, ...]:
    """Return every touch by its time; `phases` say which surface a contact is of.

    What presses on a surface is a wall, where a hand is suspected undetermined; what is softer than any surface or does
    work is a hand, and what the way in or out does not show is undetermined, unless F^d alone drove the flange there.
    """
    return _in_time([touch for axis in axes for touch in _on_axis(recording, log, axis, phases)])


def _in_time(touches: Sequence[Touch]) -> tuple[Touch, ...]:
    return tuple(
        sorted(touches, key=lambda touch: (touch.peak_s if touch.onset_s is None else touch.onset_s, touch.axis))
    )


def is_driven_alone(axis: AxisSignals, onset: int, sign: int) -> bool:
    """Return whether the approach is as fast as F^d/B_a, false where that is not known: no hand drove it then."""
    asked, speed = desired_speed(axis, onset), approach_speed(axis, onset, sign)
    return asked is not None and speed is not None and abs(speed - sign * asked) <= _SPEED_SHARE * speed


def _on_axis(recording: Recording, log: AlignedLog, axis: ObservedAxis, phases: Sequence[LogPhase]) -> Iterator[Touch]:
    pressed = axis.pressed
    judged = [(each, TouchCause.UNDETERMINED if each.hand_suspected else TouchCause.WALL) for each in pressed.contacts]
    judged += [(each, TouchCause.UNDETERMINED) for each in (*pressed.unclear, *pressed.restless)]
    judged += [(each, TouchCause.HAND) for each in pressed.by_hand]
    if not judged:
        return
    signals = _signals(recording, log, axis)
    surfaces = {
        round(phase.start_s / log.period_s): phase.contact.surface
        for phase in phases
        if phase.contact is not None and phase.axis == axis.name
    }
    for contact, cause in judged:
        sign = int(press_sign(axis.of, contact.hold))
        hold, onset, is_led = contact.hold if contact.is_held else None, contact.onset, contact.hand_suspected
        # No spring explains a hard wall that was logged at 100 Hz, but the way there shows no hand.
        is_open = cause is TouchCause.UNDETERMINED and is_led is None
        is_met = is_open and onset is not None and is_driven_alone(signals, onset, sign)
        of = (TouchCause.WALL, False) if is_met else (cause, is_led)
        touch = describe_touch(signals, sign, contact.span, hold=hold, cause=of[0], is_led=of[1]).touch
        yield replace(
            touch,
            onset_s=None if onset is None else onset * log.period_s,
            approach_speed=None if onset is None else touch.approach_speed,
            impulse=None if onset is None else touch.impulse,
            release_s=None if contact.release is None else contact.release * log.period_s,
            bounces_s=tuple(left * log.period_s for left in contact.bounces),
            surface=surfaces.get(contact.span.start),
        )


def _signals(recording: Recording, log: AlignedLog, axis: ObservedAxis) -> AxisSignals:
    """Return the axis in its own units; what a hole swallowed shows no force."""
    number, lever = AXES.index(axis.name), axis.lever_m
    motion = axis.of.axis
    force = np.asarray(np.nan_to_num(motion.force_n) * lever)
    stamps = log.start_ns + np.round(1e9 * log.time_s).astype(np.int64)
    mass, damping = gains_of(recording.gains, stamps, number)
    return AxisSignals(
        axis=axis.name,
        time_s=log.time_s,
        period_s=log.period_s,
        force_n=force,
        travel_m=motion.position_m / lever,
        level_n=axis.of.smallest_n * lever,
        noise_n=sample_noise(force),
        mass_kg=mass,
        damping_n_s_per_m=damping,
        desired_n=desired_force_of(recording.desired_force, stamps, number),
        lead_s=lead_of(recording.gains, number),
    )
