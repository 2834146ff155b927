"""Estimate the offset between the clocks of wrench and pose, and judge it."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ...errors import EstimateError, LogError
from ...result import Finding
from ...signals.aligned import align
from ...signals.recording import PoseSignal, Recording, WrenchSignal, shifted, stamped_between
from .offset_fit import NoEstimate, offset_from_turning

_LONGEST_S = 0.2
_LOOKED_AT_S = 60.0
_LOOK_EVERY_S = 0.02
_TURNING_RAD_S = 0.03
_FEWEST = 100
_SURE_DEVIATIONS = 4.0
_NEGLIGIBLE_PERIODS = 0.05
_NEEDED_PERIODS = 0.25
_NEEDED_S = 2e-4
_APPLIED = (
    "Have both drivers stamp with one clock at the instant of measuring. If they do, the sensor's own filter delays "
    "the force by this much, and the controller sees it as well: `sensor.wrench_filter` holds what matters of it."
)


class OffsetVerdict(StrEnum):
    """What is to be done about an offset."""

    CONSISTENT = "the log shows no offset between the clocks; nothing needs to be done"
    FOUND = "an offset was found; take it off the wrench's stamps"
    UNKNOWN = "the log does not determine the offset; what a fraction of a sample changes is not to be trusted"


@dataclass(frozen=True, kw_only=True)
class ClockOffset:
    """An event stamped t by the pose's clock is stamped t + `offset_s` ± `std_s` (one deviation) by the wrench's.

    Both are None where the log does not determine it; `reason` says why and `advice` what to record.
    """

    verdict: OffsetVerdict
    offset_s: float | None
    std_s: float | None
    method: str
    reason: str
    advice: str

    def finding(self, wrench_topic: str, pose_topic: str) -> Finding:
        """Say it as a finding: info when consistent, a warning otherwise."""
        if self.offset_s is None or self.std_s is None:
            return Finding.warning(
                "clock-offset-unknown",
                f"Whether the clocks of {wrench_topic} and {pose_topic} agree is unknown: {self.reason}.",
                self.advice,
            )
        estimate = f"({1e3 * self.offset_s:+.3f} ± {1e3 * self.std_s:.3f} ms, from {self.method})"
        if self.verdict is OffsetVerdict.CONSISTENT:
            return Finding.info("clocks-agree", f"The clocks of {wrench_topic} and {pose_topic} agree {estimate}.", "")
        return Finding.warning(
            "clock-offset",
            f"The stamps of {wrench_topic} are {'late' if self.offset_s > 0 else 'early'} against those of "
            f"{pose_topic} {estimate}; they are shifted onto the pose's clock.",
            _APPLIED,
        )


def estimate_clock_offset(
    wrench: WrenchSignal, pose: PoseSignal, *, around_s: float = 0.0, longest_s: float = _LONGEST_S
) -> ClockOffset:
    """Find the offset between wrench and pose from the payload's weight in the turning sensor frame.

    `around_s` is where to look (what the recording clock says of two header clocks), `longest_s` how far from there.
    The force filter of a sensor counts as offset: nothing in a log separates the two. The offset between the
    *command* and the pose cannot be found like this: it is the same thing as the robot's delay T_d, which therefore
    needs command and pose stamped by one clock. An estimate vaguer than a quarter of the faster channel's period (or
    0.2 ms) is not handed on. Of a long log, the minute in which the tool turns most is looked at. Never raises for
    what the log holds: that is an `UNKNOWN`.
    """
    if wrench.gravity_compensated or wrench.deadband is not None:
        return _unknown(f"gravity or a deadband was taken out of {wrench.topic}", "Record the sensor's raw wrench.")
    forces, turns = np.isfinite(wrench.force_n).all(), np.isfinite(pose.quaternion_xyzw).all()
    if pose.is_displacement or not (forces and turns and np.isfinite(pose.position_m).all()):
        return _unknown("three forces and a whole pose are needed", "Record the wrench and the flange pose in full.")
    near, pose = _busiest(shifted(wrench, around_s), pose)
    try:
        log = align(Recording(wrench=near, pose=pose, command=None))
    except (EstimateError, LogError) as error:
        return _unknown(str(error).rstrip("."), "Record wrench and pose over the same time, without holes.")
    found = offset_from_turning(log, min(longest_s, 0.05 * float(log.time_s[-1])))
    if isinstance(found, NoEstimate):
        return _unknown(found.reason, found.advice)
    period = min(log.period_s, 1.0 / log.pose_rate_hz)
    needed = max(_NEEDED_PERIODS * period, _NEEDED_S)
    if found.std_s > needed:
        return _unknown(
            f"{found.method} gives {1e3 * (around_s + found.offset_s):+.2f} ± {1e3 * found.std_s:.2f} ms, and "
            f"± {1e3 * needed:.2f} ms are needed",
            "Tilt the tool further, faster and in more directions, hands off, with the payload mounted.",
        )
    offset = around_s + found.offset_s
    agrees = abs(offset) < max(_SURE_DEVIATIONS * found.std_s, _NEGLIGIBLE_PERIODS * period)
    return ClockOffset(
        verdict=OffsetVerdict.CONSISTENT if agrees else OffsetVerdict.FOUND,
        offset_s=offset,
        std_s=found.std_s,
        method=f"{found.method}, {found.spans} turns",
        reason="",
        advice="" if agrees else _APPLIED,
    )


def _busiest(wrench: WrenchSignal, pose: PoseSignal) -> tuple[WrenchSignal, PoseSignal]:
    """Cut both to the minute in which the tool turns most, if they are longer."""
    seconds = (pose.stamp_ns - pose.stamp_ns[:1]) * 1e-9
    if len(seconds) < _FEWEST or seconds[-1] < _LOOKED_AT_S or len(wrench.stamp_ns) < _FEWEST:
        return wrench, pose
    step = max(1, round(_LOOK_EVERY_S * (len(seconds) - 1) / float(seconds[-1])))
    time, turned = seconds[::step], pose.quaternion_xyzw[::step]
    cosine = np.abs(np.sum(turned[1:] * turned[:-1], axis=1))
    angle = 2.0 * np.arccos(np.minimum(cosine, 1.0))
    turning = np.concatenate([[0.0], np.cumsum(np.diff(time) * (angle > _TURNING_RAD_S * np.diff(time)))])
    within = np.interp(time + _LOOKED_AT_S, time, turning) - turning
    first_ns = pose.stamp_ns[0] + np.int64(round(float(time[int(np.argmax(within))]) * 1e9))
    last_ns = first_ns + np.int64(round(_LOOKED_AT_S * 1e9))
    cut = stamped_between(wrench, int(first_ns), int(last_ns))
    return (wrench, pose) if len(cut.stamp_ns) < _FEWEST else (cut, stamped_between(pose, int(first_ns), int(last_ns)))


def _unknown(reason: str, advice: str) -> ClockOffset:
    return ClockOffset(
        verdict=OffsetVerdict.UNKNOWN, offset_s=None, std_s=None, method="", reason=reason, advice=advice
    )
