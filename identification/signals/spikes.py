"""Single samples of the wrench that are no force."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..result import Finding
from .recording import Recording, WrenchSignal

FloatArray = NDArray[np.float64]

_NOISES, _OTHERS = 12.0, 6.0
_AROUND, _FEWEST, _LONGEST_PERIOD_S = 8, 20, 2.5e-3
_TO_STD = 1.4826  # of a normal distribution, over its median absolute deviation
_ADVICE = "Check the sensor's cable, shield and driver; they were replaced by the mean of their neighbours."


def without_spikes(recording: Recording) -> tuple[Recording, tuple[Finding, ...]]:
    """Return the recording with single samples replaced that leave both neighbours, and come back.

    They must stand out by 12 noises (of second differences, as the median sample has it) and by six times what any
    other of the 12 samples around them leaves of a cubic through its own neighbours: near a resonance all of them do. A
    wrench below 400 Hz, which may show an impact in one sample, and an axis without noise (a deadband) are left alone.
    """
    wrench = recording.wrench
    if len(wrench.stamp_ns) < _FEWEST or float(np.median(np.diff(wrench.stamp_ns))) * 1e-9 > _LONGEST_PERIOD_S:
        return recording, ()
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
    for k, axis in np.argwhere(spikes).tolist():
        spikes[k, axis] = _stands_out(values[max(k + 1 - _AROUND, 0) : k + 2 + _AROUND, axis], min(k + 1, _AROUND))
    if not np.any(spikes):
        return values, 0
    clean = values.copy()
    clean[1:-1][spikes] = (0.5 * (values[:-2] + values[2:]))[spikes]
    return clean, int(np.count_nonzero(spikes))


def _stands_out(values: FloatArray, at: int) -> bool:
    """Return whether one of a few values leaves a cubic through its neighbours by far more than all others do."""
    left = np.abs(values[2:-2] - (4.0 * (values[1:-3] + values[3:-1]) - values[:-4] - values[4:]) / 6.0)
    # The cubics of the two on each side go through the suspect.
    others = np.delete(left, [i for i in range(at - 4, at + 1) if 0 <= i < len(left)])
    return 2 <= at < len(values) - 2 and bool(left[at - 2] > _OTHERS * np.max(others, initial=0.0))
