"""Measured frequency responses of one axis, out of the spans of free motion that its joint fit used."""

from .axes.straight import AXIS_NAMES
from .axes.turning import LEVER_M
from .joint_fit.data import JointData
from .joint_fit.result import JointFit
from .measured_response import FrequencyResponse
from .robot.frequency_response import MotionRecord, measure_responses
from .signals.recording import Recording

# Of the wrench's rate, and of the pose's, which is interpolated between its samples.
_HIGHEST_RATE_SHARE, _HIGHEST_POSE_SHARE = 0.4, 0.4


def measure_axis(
    name: str, data: JointData, fit: JointFit, pose_rate_hz: float, recording: Recording
) -> FrequencyResponse | None:
    """Return the frequency responses that free motion shows without a model; `fit` is that of the signals of `data`.

    A command that the gains make of the force is no reference: what is measured would be the gains.
    """
    command = data.command if recording.command is not None else None
    used = [slice(span.start, span.start + len(span.measured)) for span in fit.spans if span.surface is None]
    records = [
        MotionRecord(
            position=data.position_m[part],
            force=data.force_n[part],
            command=None if command is None else command.command_m[part],
        )
        for part in used
    ]
    highest_hz = min(_HIGHEST_RATE_SHARE / data.period_s, _HIGHEST_POSE_SHARE * pose_rate_hz)
    found = measure_responses(records, data.period_s, highest_hz)
    if found is None:
        return None
    lever = 1.0 if name in AXIS_NAMES else LEVER_M
    return found.on_time(
        command_s=0.0 if command is None else command.shift_s,
        force_s=fit.latency.applied_s - fit.latency.advanced_s,
        time_constant_s=fit.latency.seconds if fit.latency.is_filter else 0.0,
        force_scale=lever**2,
    )
