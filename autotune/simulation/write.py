"""Write a simulated run as a ROS 2 MCAP, as `autotune.recording` writes one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from autotune.recording.mcap_log import StampedChannel, StampedKind, write_channels
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray


def write_mcap(recording: Recording, path: Path, *, progress: Callable[[int], None] | None = None) -> None:
    """Write wrench, pose and command in the order of their stamps, whole or not at all.

    `progress` receives the number of messages written since the last call.
    """
    signals = (recording.wrench, recording.pose, recording.command)
    write_channels([_channel(signal) for signal in signals if signal is not None], path, progress=progress)


def _channel(signal: WrenchSignal | PoseSignal) -> StampedChannel:
    if isinstance(signal, WrenchSignal):
        return _stamped(signal, StampedKind.WRENCH, (signal.force_n, signal.torque_n_m))
    return _stamped(signal, StampedKind.POSE, (signal.position_m, signal.quaternion_xyzw))


def _stamped(
    signal: WrenchSignal | PoseSignal, kind: StampedKind, parts: tuple[FloatArray, FloatArray]
) -> StampedChannel:
    rows: list[list[float]] = np.hstack(parts).tolist()
    return StampedChannel(
        topic=signal.topic,
        frame_id=signal.frame_id,
        kind=kind,
        stamps_ns=signal.stamp_ns.tolist(),
        row=rows.__getitem__,
    )
