"""Peaks of a log as all other logs predict them."""

from collections.abc import Callable, Sequence
from dataclasses import replace

from autotune.formats.identified import IN_MEMORY, IdentifiedFile
from identification.fit_quality import HeldOutPeak
from identification.merging.combine import NamedResult
from identification.result import Identified, Touch, TouchCause
from problems.errors import AutotuneError
from problems.model.controller import AdmittanceController

from .against_touches import Running, touch_time_s
from .contact import Law, nominal_peak
from .plants import Surface, build_plants


def with_left_out_logs(
    result: Identified,
    parts: Sequence[NamedResult],
    combine: Callable[[Sequence[NamedResult]], Identified],
) -> Identified:
    """Return the result of several logs with the peaks of each log as the others predict them.

    Predicted are touches of a wall whose gains and speed or desired force the log holds, on axes with one surface in
    all logs: another one is not known to be the same. A lead that nobody says counts as part of the robot, as where it
    was identified.
    """
    axes = dict(result.axes)
    for index, part in enumerate(parts if len(parts) > 1 else ()):
        try:
            others = combine([*parts[:index], *parts[index + 1 :]])
        except AutotuneError:
            continue
        source = IdentifiedFile(result=others, provenance={}, path=IN_MEMORY, sha256="")
        for line in part.result.timelines:
            for touch in line.touches:
                axis = axes.get(touch.axis)
                if axis is None or len(axis.environments) != 1:
                    continue
                found = _predicted(source, touch, part.name)
                axes[touch.axis] = replace(axis, held_out=(*axis.held_out, *found))
    return replace(result, axes=axes)


def _predicted(source: IdentifiedFile, touch: Touch, log: str) -> tuple[HeldOutPeak, ...]:
    """Return the touch beside its prediction, nothing where the others or the log do not show what it takes."""
    if touch.cause is not TouchCause.WALL or touch.is_withdrawn or touch.mass is None or touch.damping is None:
        return ()
    law = AdmittanceController(mass_kg=touch.mass, damping_n_s_per_m=touch.damping)
    try:
        running = Running(law=Law(controller=law))
        plants = build_plants(source, Surface(), axis=touch.axis)
        peak = nominal_peak(plants, running.law_at(touch), running.approach_at(touch))
    except AutotuneError:
        return ()
    if not (peak > 0.0 and touch.peak_force > 0.0):
        return ()
    return (
        HeldOutPeak(
            without="log",
            surface=plants.surface,
            time_s=touch_time_s(touch),
            measured_peak=touch.peak_force,
            predicted_peak=peak,
            log=log,
        ),
    )
