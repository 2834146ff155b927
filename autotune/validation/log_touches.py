"""The touches of a log without a command, or whose gravity was taken off, beside what the certified set allows."""

from collections.abc import Callable, Iterator

from autotune.formats.controller_record import Controller
from autotune.prediction.against_touches import touch_time_s
from autotune.prediction.certified import certified_plants
from autotune.prediction.law import law_of
from autotune.prediction.result import predict_contact
from identification.errors import LogError
from identification.identify import identify_cell
from identification.result import Touch, TouchCause
from identification.signals.recording import Frames, Recording
from problems.contact.transient import Approach
from problems.stability.margins import UnstableLoopError

from .against_log import ComparedContact, LogComparison, refuse_other_law

_SAME_GAIN = 0.01


def compare_touches_of_log(
    controller: Controller,
    recording: Recording,
    frames: Frames | None = None,
    progress: Callable[[float], None] | None = None,
) -> LogComparison:
    """Compare the peak of every touch of a wall along the axes of a file with the peaks over its certified plants.

    That this controller was running is known only as far as the log holds mass and damping. Raises LogError for a log
    with other gains, or without a touch along an axis of the file; EstimateError for one that shows nothing; UsageError
    for a file with a collision response or variable damping.
    """
    refuse_other_law(controller)
    found = identify_cell(recording, frames)
    touches = [touch for line in found.timelines for touch in line.touches if touch.axis in controller.axes]
    _check_gains(controller, touches)
    compared = []
    for touch in touches:
        # A force without an approach is also what the payload's mass shows where a motion begins.
        is_whole = touch.cause is TouchCause.WALL and not touch.is_withdrawn and not touch.is_led
        compared += list(_compared(controller, touch)) if is_whole else []
        if progress is not None:
            progress(1.0 / len(touches))
    if not compared:
        raise LogError(
            f"The log must hold contacts with a wall along {', '.join(controller.axes)} of known speed or F^d, "
            f"found none among {len(touches)} touches; record the approach, the touch and a hold without hands."
        )
    return LogComparison(
        contacts=tuple(compared),
        passed_over=len(touches) - len(compared),
        mass_kg=controller.payload.mass_kg,
        is_weighed=False,
    )


def _check_gains(controller: Controller, touches: list[Touch]) -> None:
    """Raise LogError where the log holds gains, and other ones than the file."""
    for touch in touches:
        asked = controller.axes[touch.axis]
        for symbol, logged, stated in (("M_a", touch.mass, asked.mass), ("B_a", touch.damping, asked.damping)):
            if logged is not None and abs(logged / stated - 1.0) > _SAME_GAIN:
                raise LogError(
                    f"The log was recorded with another controller: at {touch_time_s(touch):.2f} s it says {symbol} = "
                    f"{logged:.6g} on axis {touch.axis}, the file {stated:.6g}. Give the file that was running."
                )


def _compared(controller: Controller, touch: Touch) -> Iterator[ComparedContact]:
    """Yield the touch beside the certified plants; nothing where speed and F^d are unknown or loops unstable."""
    speed, force = touch.approach_speed, touch.desired_force
    if speed is not None and speed > 0.0:
        approach = Approach(speed_m_s=speed, after_impact_n=None if force is None else abs(force))
    elif force:
        approach = Approach(force_n=abs(force))
    else:
        return
    domain = controller.certificate.domain[touch.axis]
    plants = certified_plants(domain, touch.axis, controller.sample_time_s)
    try:
        predicted = predict_contact(plants, law_of(controller, touch.axis), approach)
    except UnstableLoopError:
        return
    low, high = predicted.interval.sensor
    if high is None:
        return
    yield ComparedContact(
        axis=touch.axis,
        onset_s=touch_time_s(touch),
        speed_m_s=predicted.contact.contact_speed_m_s,
        desired_force_n=predicted.contact.driving_force_n if force is None else abs(force),
        law_left_share=None,
        stiffness_n_per_m=None,
        measured_peak_n=touch.peak_force,
        predicted_peak_n=predicted.peak_sensor_force,
        band_peaks_n=(low, high),
        share_inside=None,
        rms_error_n=None,
        outside="",
        trace=None,
    )
