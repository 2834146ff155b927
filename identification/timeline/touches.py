"""Touches of a log whose payload is known, from its contacts, its rests in a hand, and what is unclear."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ..result import LogPhase, Touch, TouchCause
from ..signals.aligned import AlignedLog
from ..signals.recording import AXES, Recording
from ..touches.find import describe_touch
from ..touches.signals import AxisSignals, desired_force_of, gains_of, lead_of, sample_noise
from .contacts import ContactTimes
from .left_contacts import ObservedAxis
from .payload import press_sign


def touches_of(
    recording: Recording, log: AlignedLog, axes: Sequence[ObservedAxis], phases: Sequence[LogPhase]
) -> tuple[Touch, ...]:
    """Return every touch by its time; `phases` say which surface a contact is of.

    What presses on a surface is a wall, where a hand is suspected undetermined; what is softer than any surface or does
    work is a hand, and what the way in or out does not show is undetermined.
    """
    found = [touch for axis in axes for touch in _on_axis(recording, log, axis, phases)]
    return tuple(
        sorted(found, key=lambda touch: (touch.peak_s if touch.onset_s is None else touch.onset_s, touch.axis))
    )


def _on_axis(recording: Recording, log: AlignedLog, axis: ObservedAxis, phases: Sequence[LogPhase]) -> Iterator[Touch]:
    pressed = axis.pressed
    judged = [(each, _cause(each)) for each in pressed.contacts]
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
        hold = contact.hold if contact.is_held else None
        touch = describe_touch(signals, sign, contact.span, hold=hold, cause=cause, is_led=contact.hand_suspected).touch
        yield replace(
            touch,
            onset_s=None if contact.onset is None else contact.onset * log.period_s,
            approach_speed=None if contact.onset is None else touch.approach_speed,
            impulse=None if contact.onset is None else touch.impulse,
            release_s=None if contact.release is None else contact.release * log.period_s,
            bounces_s=tuple(left * log.period_s for left in contact.bounces),
            surface=surfaces.get(contact.span.start),
        )


def _cause(contact: ContactTimes) -> TouchCause:
    return TouchCause.UNDETERMINED if contact.hand_suspected else TouchCause.WALL


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
