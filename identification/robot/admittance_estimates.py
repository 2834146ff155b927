"""The robot per axis behind an admittance with known gains, with verdicts, and the command that those gains make."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import scipy

from problems.arrays import FloatArray
from problems.text import significant

from ..errors import EstimateError
from ..result import Covariance, Estimate, Finding, RobotEstimate, Status
from ..signals.recording import AXES, Recording
from ..verdicts import TWO_SIDED, judged, missing, unidentifiable_vector, vector, weak_at_best
from .admittance_motion import AdmittanceMotion, admittance_motions
from .admittance_robot import AdmittanceRobotFit, identify_admittance_robot, robot_response

_GAIN_SHARE = 0.05
_SIGNIFICANT_STDS = 3.0
_SMALLEST_LEVER_M = 0.1
_LOOSEST_SHARE = 0.5
# Poles and delay that trade against each other are known together where their sum, the lag, is known to this share.
_LOOSEST_LAG = 0.25
# What drives the tool slower than this is no property of the robot.
_SLOW_HZ = 0.3
_DELAY_FLOOR = 0.1  # of the lag: a delay near zero is known well enough beside what the poles make
_NOT_SPLIT = (
    "loop delay, half a control period and the logger's lag together, which only a logged command distinguishes"
)
_ASSUMED = "holds if neither lead nor feedback damping ran in the controller"
_ASSUMED_OF_KNOWN_LEAD = "holds if no feedback damping ran in the controller"


@dataclass(frozen=True, kw_only=True)
class AdmittanceRobots:
    """The robot per axis of S, of those axes that show something, and what to know about it.

    `covariances` holds, by axis, how the errors of poles and delay go together: their sum, the lag, is known better.
    `beside` holds, by straight axis, times from the first common sample [s] and how far the flange is, below 0.3 Hz,
    from what the admittance makes of the robot [m]; nothing where the gains do not explain the motion throughout.
    """

    robots: Mapping[str, RobotEstimate]
    findings: tuple[Finding, ...]
    covariances: Mapping[str, Covariance] = field(default_factory=dict)
    beside: Mapping[str, tuple[FloatArray, FloatArray]] = field(default_factory=dict)


def identify_admittance_robots(recording: Recording) -> AdmittanceRobots:
    """Identify r(s) and the total delay of every axis from wrench, gains and pose.

    Nothing is more than weak: the delay holds what the logger put between wrench and pose, r(s) what lead and feedback
    damping the controller had. Axes without a robot are named with the reason, in an `error` where no axis has one.
    """
    try:
        motions = admittance_motions(recording)
    except EstimateError as error:
        return AdmittanceRobots(robots={}, findings=(missing("no-command", str(error)),))
    robots: dict[str, RobotEstimate] = {}
    fits: list[tuple[AdmittanceMotion, AdmittanceRobotFit]] = []
    findings = [_halted(motions[0].halted_s)] if motions and motions[0].halted_s > 0.0 else []
    for motion in motions:
        try:
            fit = identify_admittance_robot(motion)
        except EstimateError as error:
            findings.append(
                Finding(code="robot", severity="warning", message=f"Axis {motion.axis}: {error}", advice="")
            )
            continue
        fits.append((motion, fit))
        robots[motion.axis] = _estimate(fit, motion)
        findings += _about(motion, fit)
    if robots:
        findings.insert(0, _lag_not_split(recording))
    else:
        findings.append(
            missing(
                "no-command",
                "The log has no commanded pose, and wrench, gains and motion identify no robot on any axis.",
                "Record the position command, or lead the tool by hand with quick pushes along each axis.",
            )
        )
    return AdmittanceRobots(
        robots=robots,
        findings=tuple(findings),
        covariances={motion.axis: _covariance(fit) for motion, fit in fits},
        beside=_beside_all(recording, fits),
    )


def _beside_all(
    recording: Recording, fits: Sequence[tuple[AdmittanceMotion, AdmittanceRobotFit]]
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return by straight axis how far the flange is slowly beside the admittance, none where that does not drive it."""
    straight = [(motion, fit) for motion, fit in fits if motion.axis in AXES[:3]]
    is_driven = all(motion.halted_s == 0.0 and not _is_off(fit) for motion, fit in straight)
    if not is_driven or recording.pose.is_displacement:
        return {}
    return {motion.axis: _beside(motion, fit) for motion, fit in straight}


def _beside(motion: AdmittanceMotion, fit: AdmittanceRobotFit) -> tuple[FloatArray, FloatArray]:
    """Return times [s] and how far the flange is slowly beside what the admittance makes of the robot [m]."""
    whole = replace(motion, used=np.ones_like(motion.used))
    steps = (motion.moved_m_s - robot_response(whole, fit.model)) * np.diff(motion.edge_s)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    usual_s = float(np.median(np.diff(motion.edge_s)))
    slow = scipy.signal.butter(2, min(2.0 * _SLOW_HZ * usual_s, 0.9), output="sos")
    return motion.edge_s, np.asarray(scipy.signal.sosfiltfilt(slow, way, padlen=0))


def _is_off(fit: AdmittanceRobotFit) -> bool:
    """Return whether the robot moves at another speed than the known gains ask for."""
    return abs(fit.gain - 1.0) > max(_GAIN_SHARE, _SIGNIFICANT_STDS * fit.gain_std)


def _estimate(fit: AdmittanceRobotFit, motion: AdmittanceMotion) -> RobotEstimate:
    residual = significant(100.0 * fit.fit_error)
    method = f"output error behind the admittance of the known gains, residual {residual} % of speed"
    lag = f"lag at low frequency {1e3 * fit.lag_s:.0f} ± {1e3 * fit.lag_std_s:.0f} ms, poles and delay together"
    assumed = _ASSUMED if motion.lead_s is None else _ASSUMED_OF_KNOWN_LEAD
    traded = f"poles and delay trade against each other: {lag}"
    bandwidth = judged(fit.bandwidth_hz, fit.bandwidth_std_hz, method=method, note=assumed, weak=_LOOSEST_SHARE)
    if bandwidth.status is Status.IDENTIFIED:
        bandwidth = replace(bandwidth, status=Status.WEAK)
    # A bound may be looser than a value.
    delay = judged(
        fit.model.delay_s,
        fit.delay_std_s,
        method=method,
        note=f"{_NOT_SPLIT}; {lag}",
        weak=_LOOSEST_SHARE,
        floor=_DELAY_FLOOR * fit.lag_s,
    )
    loosest = float(np.max(fit.denominator_std[1:] / fit.model.denominator[1:]))
    is_traded = bandwidth.value is None or loosest > _LOOSEST_SHARE
    if is_traded and fit.lag_std_s > _LOOSEST_LAG * fit.lag_s:
        numerator = denominator = unidentifiable_vector(traded)
    else:
        stds, note = fit.denominator_std, traded if is_traded else ""
        numerator = replace(vector(fit.model.numerator, stds[-1:], method=method, status=Status.WEAK), note=note)
        denominator = replace(vector(fit.model.denominator, stds, method=method, status=Status.WEAK), note=note)
        if delay.value is None:
            # Poles and delay are one model: without the delay the poles alone would lag less than the robot does.
            value, std = fit.model.delay_s, fit.delay_std_s
            ends = max(value - TWO_SIDED * std, 0.0), value + TWO_SIDED * std
            delay = Estimate(value=value, std=std, status=Status.WEAK, method=method, note=delay.note, ci95=ends)
    return RobotEstimate(
        numerator=numerator,
        denominator=denominator,
        delay_s=weak_at_best(delay, "no more than a bound of the loop delay"),
        bandwidth_hz=bandwidth,
    )


def _covariance(fit: AdmittanceRobotFit) -> Covariance:
    """Return the covariance of ω [rad/s] and T_d [s]: ω is off by its own share, and T_d by the lag's error and ω's.

    The lag at low frequency is T_d and what the poles make, in inverse proportion to ω.
    """
    omega = float(fit.model.denominator[-1]) ** (1.0 / (len(fit.model.denominator) - 1))
    of_poles, share = fit.lag_s - fit.model.delay_s, fit.bandwidth_std_hz / fit.bandwidth_hz
    error = np.array([[omega * share, 0.0], [of_poles * share, fit.lag_std_s]])
    matrix = error @ error.T
    return Covariance(
        names=("omega", "T_d"),
        values=(omega, fit.model.delay_s),
        matrix=tuple(tuple(row) for row in (0.5 * (matrix + matrix.T)).tolist()),
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
    if _is_off(fit):
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
    is_known = recording.gains is not None and recording.gains.lead_s is not None
    unknown = "Feedback damping B_fb" if is_known else "A lead K_l or feedback damping B_fb"
    where = "in one message, so their own ages are not known" if together else "with stamps of their own"
    return Finding(
        code="delay-not-split",
        severity="warning",
        message=f"Without a logged command the delay is that from wrench to pose: {_NOT_SPLIT}. Wrench and pose come "
        f"{where}. {unknown} that ran in the controller counts as part of the robot.",
        advice="Record the position command that the robot receives.",
    )


def _halted(duration_s: float) -> Finding:
    return Finding(
        code="admittance-halted",
        severity="warning",
        message=f"For {duration_s:.1f} s the robot is at rest although the admittance of the wrench asks for motion; "
        "these parts, with 0.3 s before and 1 s after them, were left out.",
        advice="",
    )
