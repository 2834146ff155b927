"""Single samples of the wrench that are no force."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .recording import Recording, WrenchSignal
from .result import Finding

FloatArray = NDArray[np.float64]

_NOISES = 12.0
_TO_STD = 1.4826  # of a normal distribution, over its median absolute deviation
_ADVICE = "Check the sensor's cable, shield and driver; they were replaced by the mean of their neighbours."


def without_spikes(recording: Recording) -> tuple[Recording, tuple[Finding, ...]]:
    """Return the recording with single samples replaced that jump from both neighbours, and back, by 12 noises.

    The noise is that of second differences, as the median sample has it; an axis that shows none (a deadband) is left
    as it is. An impact stays: its force is there in the next sample too.
    """
    wrench = recording.wrench
    forces, force_count = _replaced(wrench.force_n)
    torques, torque_count = _replaced(wrench.torque_n_m)
    count = force_count + torque_count
    if not count:
        return recording, ()
    clean: WrenchSignal = replace(wrench, force_n=forces, torque_n_m=torques)
    told = Finding(
        code="spikes",
        severity="warning",
        message=f"Topic {wrench.topic} has {count} single values that jump away from both neighbours.",
        advice=_ADVICE,
    )
    return replace(recording, wrench=clean), (told,)


def _replaced(values: FloatArray) -> tuple[FloatArray, int]:
    """Return values (n, 3) without spikes, and how many there were."""
    before, after = values[1:-1] - values[:-2], values[1:-1] - values[2:]
    second = before + after
    noise = _TO_STD * np.nanmedian(np.abs(second), axis=0)
    limit = np.where(noise > 0.0, _NOISES * noise, np.inf)
    # Away and back: both steps are large, of one sign, and alike.
    smaller = np.minimum(np.abs(before), np.abs(after))
    spikes = (before * after > 0.0) & (smaller > limit) & (np.abs(before - after) < smaller)
    if not np.any(spikes):
        return values, 0
    clean = values.copy()
    clean[1:-1][spikes] = (0.5 * (values[:-2] + values[2:]))[spikes]
    return clean, int(np.count_nonzero(spikes))
