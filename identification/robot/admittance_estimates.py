"""Verdicts on the robot as it is seen through the admittance, axis by axis."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import EstimateError
from ..result import Finding, RobotEstimate, Status
from ..signals.aligned import AlignedLog
from ..signals.recording import Recording
from ..verdicts import judged, missing, unidentifiable_vector, vector, weak_at_best
from .admittance_motion import AdmittanceMotion, admittance_motions
from .admittance_robot import AdmittanceRobotFit, identify_admittance_robot

FloatArray = NDArray[np.float64]

_GAIN_SHARE = 0.05
_SIGNIFICANT_STDS = 3.0
_SMALLEST_LEVER_M = 0.1
_LOOSEST_SHARE, _LOOSEST_BOUND = 0.5, 0.25
_NOT_SPLIT = "loop delay, half a control period and the logger's lag together, which only a logged command tells apart"
_ASSUMED = "holds if neither lead nor feedback damping ran in the controller"


@dataclass(frozen=True, kw_only=True)
class AdmittanceRobots:
    """The robot per axis of S, of those axes that tell something, and what to know about it."""

    robots: Mapping[str, RobotEstimate]
    findings: tuple[Finding, ...]


def identify_admittance_robots(recording: Recording) -> AdmittanceRobots:
    """Tell r(s) and the total delay of every axis from wrench, gains and pose.

    Nothing is more than weak: the delay holds what the logger put between wrench and pose, r(s) what lead and feedback
    damping the controller had. Axes of which no robot is
    told are named with the reason; a finding of severity `error` stands where there is none at all.
    """
    try:
        motions = admittance_motions(recording)
    except EstimateError as error:
        return AdmittanceRobots(robots={}, findings=(missing("no-command", str(error)),))
    robots: dict[str, RobotEstimate] = {}
    findings = [_halted(motions[0].halted_s)] if motions and motions[0].halted_s > 0.0 else []
    for motion in motions:
        try:
            fit = identify_admittance_robot(motion)
        except EstimateError as error:
            findings.append(
                Finding(code="robot", severity="warning", message=f"Axis {motion.axis}: {error}", advice="")
            )
            continue
        robots[motion.axis] = _estimate(fit)
        findings += _about(motion, fit)
    if robots:
        findings.insert(0, _lag_not_split(recording))
    else:
        findings.append(
            missing(
                "no-command",
                "The log has no commanded pose, and wrench, gains and motion tell no robot on any axis.",
                "Record the position command, or lead the tool by hand with quick pushes along each axis.",
            )
        )
    return AdmittanceRobots(robots=robots, findings=tuple(findings))


def with_compensated_force(recording: Recording, log: AlignedLog, force_S_n: FloatArray) -> Recording:
    """Return a recording whose wrench is the force that a controller sees behind gravity compensation (n, 3).

    Torques are left out (their compensation is not told by the force alone), as are the samples in holes.
    """
    told = np.isfinite(force_S_n).all(axis=1)
    stamps = log.start_ns + np.round(log.time_s * 1e9).astype(np.int64)
    wrench = replace(
        recording.wrench,
        stamp_ns=stamps[told],
        force_n=force_S_n[told],
        torque_n_m=np.full((int(np.count_nonzero(told)), 3), np.nan),
        gravity_compensated=True,
        measured_axes=("x", "y", "z"),
    )
    return replace(recording, wrench=wrench)


def _estimate(fit: AdmittanceRobotFit) -> RobotEstimate:
    method = f"output error behind the admittance of the known gains, residual {100.0 * fit.fit_error:.2g} % of speed"
    lag = f"lag at low frequency {1e3 * fit.lag_s:.0f} ± {1e3 * fit.lag_std_s:.0f} ms, poles and delay together"
    bandwidth = weak_at_best(judged(fit.bandwidth_hz, fit.bandwidth_std_hz, method=method), _ASSUMED)
    # A bound may be looser than a value.
    delay = judged(fit.model.delay_s, fit.delay_std_s, method=method, note=f"{_NOT_SPLIT}; {lag}", weak=_LOOSEST_SHARE)
    loosest = float(np.max(fit.denominator_std[1:] / fit.model.denominator[1:]))
    if bandwidth.value is None or loosest > _LOOSEST_SHARE:
        numerator = denominator = unidentifiable_vector(f"poles and delay trade against each other: {lag}")
    else:
        stds = fit.denominator_std
        numerator = vector(fit.model.numerator, stds[-1:], method=method, status=Status.WEAK)
        denominator = vector(fit.model.denominator, stds, method=method, status=Status.WEAK)
    return RobotEstimate(
        numerator=numerator,
        denominator=denominator,
        delay_s=weak_at_best(delay, "no more than a bound of the loop delay"),
        bandwidth_hz=bandwidth,
    )


def _about(motion: AdmittanceMotion, fit: AdmittanceRobotFit) -> list[Finding]:
    found = [
        Finding(
            code="wrench-to-motion-lag",
            severity="info",
            message=f"Axis {motion.axis}: the motion follows the admittance of the wrench {1e3 * fit.lag_s:.0f} ± "
            f"{1e3 * fit.lag_std_s:.0f} ms late at low frequency (poles and delay together), at {fit.gain:.3f} ± "
            f"{fit.gain_std:.3f} of its speed.",
            advice="",
        )
    ]
    if abs(fit.gain - 1.0) > max(_GAIN_SHARE, _SIGNIFICANT_STDS * fit.gain_std):
        found.append(
            Finding(
                code="admittance-gain",
                severity="warning",
                message=f"Axis {motion.axis}: the robot moves at {fit.gain:.3f} ± {fit.gain_std:.3f} of the speed that "
                "the known gains make of the wrench.",
                advice="Check B_a, the unit of the force, and that the controller integrates with the period at which "
                "it really runs.",
            )
        )
    lever = float(np.linalg.norm(fit.lever_m))
    if lever > max(_SMALLEST_LEVER_M, _SIGNIFICANT_STDS * float(np.linalg.norm(fit.lever_std_m))):
        found.append(
            Finding(
                code="control-point",
                severity="warning",
                message=f"Axis {motion.axis}: the logged point moves with the tool's turning as if the admittance "
                f"moved a point {lever:.2f} m off it, across this axis.",
                advice="Log the pose of the point that the admittance controls (the TCP).",
            )
        )
    return found


def _lag_not_split(recording: Recording) -> Finding:
    wrench, pose = recording.wrench, recording.pose
    together = wrench.topic == pose.topic and np.array_equal(wrench.stamp_ns, pose.stamp_ns)
    where = "in one message, so their own ages in it are not told" if together else "with stamps of their own"
    return Finding(
        code="delay-not-split",
        severity="warning",
        message=f"Without a logged command the delay is that from wrench to pose: {_NOT_SPLIT}. Wrench and pose come "
        f"{where}. A lead K_l or feedback damping B_fb that ran in the controller counts as part of the robot.",
        advice="Record the position command that the robot receives.",
    )


def _halted(duration_s: float) -> Finding:
    return Finding(
        code="admittance-halted",
        severity="warning",
        message=f"For {duration_s:.1f} s the robot stands still although the admittance of the wrench asks for motion; "
        "these parts, with 0.3 s before and 1 s after them, were left out.",
        advice="",
    )
