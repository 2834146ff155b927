"""Estimates of one straight axis out of a recording: robot, coupling, payload, surfaces."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from problems.arrays import FloatArray
from problems.progress import ProgressSlice
from problems.text import significant

from .axes.straight import AXIS_NAMES, AxisMotion, free_motions, unguided_spans
from .axes.turning import rests_after
from .axis_command import AxisKnowledge, CellSignals, behind_command, fit_behind_command
from .axis_findings import (
    contact_findings,
    first_rests,
    fit_findings,
    force_beside,
    mass_findings,
)
from .axis_response import measure_axis, response_findings
from .errors import EstimateError
from .evidence import AxisEvidence
from .fit_quality import HeldOutPeak
from .given import Given, axis_keys, settle_axis
from .joint_fit.data import USUAL_MASS_KG, usual_coupling
from .joint_fit.estimates import COARSE_COMMAND, LOOSEST_DELAY, NO_COMMAND, JointEstimates
from .joint_fit.fit import identify_joint
from .joint_fit.model import COUPLING_NAMES
from .joint_fit.result import JointFit, with_gain_error
from .joint_fit.segments import find_holds
from .result import AxisEstimate, CouplingEstimate, Finding, RobotEstimate, Status
from .robot.coupling import CouplingFit, Noise, identify_coupling
from .robot.logged_command import MODEL_STD_SHARE, LoggedRobot
from .signals.contact_rule import CONTACT
from .signals.segments import Span
from .timeline.payload import AxisContacts
from .verdicts import (
    IDENTIFIED_SHARE,
    WEAK_SHARE,
    judged,
    missing,
    unidentifiable_robot,
    vector,
    weak_at_best,
    without_coupling,
)

_OBLIQUE_CONTACT_DEG = 10.0
_EXACT_SHARE = 1e-6
_MOST_LAG_STDS = 3.0
_REBUILT = "under the command that the known gains make of the wrench"
_STAGES_SHARE = 0.27  # of the time that an axis takes


@dataclass(frozen=True, kw_only=True)
class AxisResult:
    """Result of one axis: the estimate with priors, its findings, and the fit to the log alone.

    `contacts` are its rests under force with the coupling as far as it is known.
    """

    estimate: AxisEstimate
    findings: tuple[Finding, ...]
    contacts: AxisContacts
    fit: JointFit | None


def identify_axis(cell: CellSignals, axis: AxisMotion, progress: ProgressSlice | None = None) -> AxisResult:
    """Estimate one translational axis; what is unidentifiable has a finding of severity `error`.

    `progress` receives the share of the work that is done.
    """
    holds, findings = _holds(cell, axis)
    gravity = cell.gravity
    start = AxisKnowledge(
        mass_kg=None if gravity is None else gravity.mass_kg,
        priors=axis_priors(cell.given, axis.name),
        in_units=partial(with_gain_error, share=0.0 if gravity is None else gravity.gain_error_share),
        weighed=None if gravity is None else (gravity.mass_kg, gravity.mass_std_kg),
    )
    result = fit_axis(cell, axis, holds, start, progress or ProgressSlice())
    findings += result.findings
    if gravity is not None and result.fit is not None and not result.fit.is_weighed:
        disagreement = mass_findings(axis.name, gravity, result.fit)
        findings += disagreement
        if disagreement:
            result = replace(result, estimate=_weakened(result.estimate))
    return replace(result, findings=tuple(findings))


def _weakened(estimate: AxisEstimate) -> AxisEstimate:
    """Return the estimate with nothing more than weak of what hangs on the force's scale."""
    why = "the masses from motion and from gravity disagree"
    coupling = estimate.coupling
    return replace(
        estimate,
        coupling=CouplingEstimate(
            stiffness_n_per_m=weak_at_best(coupling.stiffness_n_per_m, why),
            damping_n_s_per_m=weak_at_best(coupling.damping_n_s_per_m, why),
        ),
        drag_n_s_per_m=weak_at_best(estimate.drag_n_s_per_m, why),
        mass_kg=None if estimate.mass_kg is None else weak_at_best(estimate.mass_kg, why),
    )


def fit_axis(
    cell: CellSignals, axis: AxisMotion, holds: tuple[Span, ...], start: AxisKnowledge, progress: ProgressSlice
) -> AxisResult:
    """Find start values by the stages, then values and uncertainty by the joint fit; `holds` press along the axis."""
    findings = list[Finding]()
    behind, robot = _robot(cell, axis, findings)
    coupling = _coupling(cell, axis)
    progress.advance_to(_STAGES_SHARE)
    try:
        mass_kg = start.mass_kg if coupling is None or start.mass_kg is not None else coupling.mass_kg
        part = progress.part((0.5 if start.priors else 1.0) - _STAGES_SHARE)
        commanded = fit_behind_command(cell, axis, holds, coupling, behind, replace(start, mass_kg=mass_kg), part)
        data, found = commanded.data, commanded.fit
        if cell.gravity is None:
            _check_lag(found, cell.recording.wrench_lag_s)
        fit = commanded.with_robot_errors(start.in_units(found))
        with_priors = None
        if start.priors:
            known = identify_joint(replace(data, priors=start.priors))
            with_priors = commanded.with_robot_errors(start.in_units(known))
    except EstimateError as error:
        findings.append(missing("coupling", f"Axis {axis.name}: {error}"))
        estimate, contradictions = settle_axis(axis.name, without_coupling(robot, str(error)), None, cell.given)
        mass_kg = USUAL_MASS_KG if cell.gravity is None else cell.gravity.mass_kg
        contacts = AxisContacts(axis=axis, holds=holds, coupling=usual_coupling(mass_kg))
        return AxisResult(estimate=estimate, findings=(*findings, *contradictions), contacts=contacts, fit=None)
    left_n = force_beside(axis, cell.motion.still, holds)
    findings += contact_findings(axis.name, first_rests(cell.motion.still, data.holds), fit, left_n)
    findings += fit_findings(axis.name, fit, cell.recording.wrench_shifted_s)
    # With a robot but without a held command, what is logged is smooth between its samples.
    is_logged = cell.recording.command is not None and robot.denominator.value is not None
    why = COARSE_COMMAND if is_logged else NO_COMMAND
    note = "" if behind is None else behind.delay_note
    of = partial(
        JointEstimates,
        name=axis.name,
        period_s=data.period_s,
        without_command=why,
        delay_note=note,
        is_smooth=data.is_smooth,
    )
    alone = _estimate(of(fit=fit), robot)
    both = alone if with_priors is None else _estimate(of(fit=with_priors), robot)
    if data.command is not None and cell.recording.command is None:
        alone, both = (_of_rebuilt(each, robot, fit) for each in (alone, both))
    measured = measure_axis(axis.name, data, found, cell.log.pose_rate_hz, cell.recording)
    if measured is not None:
        alone, both = (replace(each, frequency_response=measured) for each in (alone, both))
        own = found.values[: len(COUPLING_NAMES)]
        # A response that is not measured behind a hold is held against that of a smooth motion.
        findings += response_findings(axis.name, own, None if data.is_smooth else found.robot, measured, data.period_s)
    estimate, contradictions = settle_axis(axis.name, alone, both, cell.given)
    contacts = AxisContacts(axis=axis, holds=holds, coupling=found.values[: len(COUPLING_NAMES)])
    return AxisResult(estimate=estimate, findings=(*findings, *contradictions), contacts=contacts, fit=fit)


def _of_rebuilt(estimate: AxisEstimate, led: RobotEstimate, fit: JointFit) -> AxisEstimate:
    """Return the estimate with nothing more than weak of what rests on a command that wrench and gains make.

    The command has the wrench's stamps, so how late those are against the pose is a part of the delay.
    """
    robot, delay = estimate.robot, estimate.robot.delay_s
    late_s = float(np.hypot(fit.latency.seconds, fit.latency.std_s))
    if delay.value is not None and delay.std is not None:
        delay = replace(delay, std=float(np.hypot(delay.std, late_s)))
    return replace(
        estimate,
        environments=tuple(
            replace(
                each,
                stiffness_n_per_m=weak_at_best(each.stiffness_n_per_m, _REBUILT),
                secant_stiffness_n_per_m=weak_at_best(each.secant_stiffness_n_per_m, _REBUILT),
            )
            for each in estimate.environments
        ),
        robot=RobotEstimate(
            numerator=replace(robot.numerator, status=Status.WEAK),
            denominator=replace(robot.denominator, status=Status.WEAK),
            delay_s=weak_at_best(delay, f"{_REBUILT}; what the log puts between wrench and pose is a part of it"),
            bandwidth_hz=weak_at_best(robot.bandwidth_hz, f"{_REBUILT}, which {led.bandwidth_hz.note}"),
        ),
    )


def _check_lag(fit: JointFit, known_s: tuple[float, float] | None) -> None:
    """Raise EstimateError where force and pose fit only with a lag between them that their stamps exclude."""
    if known_s is not None and abs(fit.latency.seconds - known_s[0]) > _MOST_LAG_STDS * known_s[1]:
        late_ms, most_ms = 1e3 * fit.latency.seconds, 1e3 * _MOST_LAG_STDS * known_s[1]
        raise EstimateError(
            f"Force and pose fit one payload on one spring only if the force is stamped {late_ms:.1f} ms late, and the "
            f"stamps leave {most_ms:.1f} ms; record faster, or raw."
        )


def axis_evidence(result: AxisResult) -> AxisEvidence:
    """Return the signals of an axis that the joint fit used, a turn in N·m."""
    return AxisEvidence(spans=() if result.fit is None else result.fit.spans)


def _estimate(result: JointEstimates, robot: RobotEstimate) -> AxisEstimate:
    """Return the estimate of an axis, with `robot` where no command took part in the fit."""
    fit = result.fit
    return AxisEstimate(
        coupling=result.coupling,
        drag_n_s_per_m=result.drag_n_s_per_m,
        environments=result.environments,
        robot=result.robot or robot,
        mass_kg=None if fit.is_weighed else result.mass_kg,
        covariance=result.covariance,
        fits=(fit.quality,),
        held_out=tuple(
            HeldOutPeak(
                without="contact",
                surface=f"{result.name}{each.surface + 1}",
                time_s=each.onset * result.period_s,
                measured_peak=each.measured_peak,
                predicted_peak=each.predicted_peak,
            )
            for each in fit.held_out
        ),
        second_mode=result.second_mode,
        coupling_friction_n=result.coupling_friction_n,
    )


def _robot(cell: CellSignals, axis: AxisMotion, findings: list[Finding]) -> tuple[LoggedRobot | None, RobotEstimate]:
    """Return the robot behind the command, and what is known of the robot where the joint fit cannot use that."""
    recording = cell.recording
    if recording.command is None:
        if axis.name in cell.robots:
            return None, cell.robots[axis.name]
        findings.append(
            missing(
                "no-command",
                "The log has no commanded pose, so neither the robot's response nor its delay can be determined.",
                "Record the position command that the robot receives as a PoseStamped topic, or name it with "
                "--command-topic.",
            )
        )
        return None, unidentifiable_robot("no commanded pose in the log")
    try:
        found, period_s = behind_command(cell, axis, recording.command)
    except EstimateError as error:
        findings.append(missing("robot", f"Axis {axis.name}: {error}"))
        return None, unidentifiable_robot(str(error))
    return found, _logged_robot(found, period_s)


def identify_axis_robot(cell: CellSignals, axis: AxisMotion) -> AxisResult:
    """Estimate the robot alone along an axis, from command and pose."""
    findings: list[Finding] = []
    _, robot = _robot(cell, axis, findings)
    contacts = AxisContacts(axis=axis, holds=(), coupling=usual_coupling(USUAL_MASS_KG))
    estimate = without_coupling(robot, "no motion along this axis alone, with the force on it")
    return AxisResult(estimate=estimate, findings=tuple(findings), contacts=contacts, fit=None)


def _logged_robot(found: LoggedRobot, period_s: float) -> RobotEstimate:
    """Return the verdicts on what the command shows of the robot alone."""
    fit, between = found.fit, "behind a hold" if found.is_held else "behind a command that is smooth between samples"
    method = f"output error of r(s) {between}, residual {significant(100.0 * fit.fit_error)} % of the motion"
    bandwidth_std = float(np.hypot(fit.bandwidth_std_hz, MODEL_STD_SHARE * fit.bandwidth_hz))
    return RobotEstimate(
        numerator=vector(fit.model.numerator, fit.numerator_std, method=method),
        denominator=vector(fit.model.denominator, fit.denominator_std, method=method),
        delay_s=judged(
            fit.model.delay_s,
            fit.delay_std_s,
            method=method,
            note=found.delay_note,
            identified=np.inf if found.is_held and fit.delay_std_s < 0.2 * period_s else IDENTIFIED_SHARE,
            weak=LOOSEST_DELAY if found.delay_note else WEAK_SHARE,
        ),
        bandwidth_hz=judged(fit.bandwidth_hz, bandwidth_std, method=method),
    )


def _coupling(cell: CellSignals, axis: AxisMotion) -> CouplingFit | None:
    """Return a start for the joint fit, None where free motion does not show the coupling in the frequency domain."""
    period = cell.log.period_s
    noise = Noise(force_rms_n=cell.noise_rms_n, position_rms_m=_position_noise(axis.position_m, cell.motion.still))
    try:
        return identify_coupling(free_motions(axis, unguided_spans(axis), period), period, cell.log.pose_rate_hz, noise)
    except EstimateError:
        return None


def _position_noise(position_m: FloatArray, still: tuple[Span, ...]) -> float:
    """Return the white noise of the position at rest, from second differences (they leave drift out)."""
    longest = max(still, key=len)
    second = np.diff(position_m[longest.slice], n=2)
    return max(float(np.std(second) / np.sqrt(6.0)), 1e-9)


def _holds(cell: CellSignals, axis: AxisMotion) -> tuple[tuple[Span, ...], list[Finding]]:
    """Return the rests that press along this axis; an oblique normal is reported with its direction.

    What is touched at the end of a turn is pressed sideways, and belongs to the turn.
    """
    findings: list[Finding] = []
    holds = find_holds(cell.motion.still, axis.force_n, CONTACT.hold_threshold_n(cell.rest_residual_n))
    turned = {hold for turn in cell.turns for hold in rests_after(turn.motion.spans, holds)}
    mine = tuple(h for h in holds if h not in turned and _is_along(h, cell.force_S_n, axis, findings))
    return mine, findings


def _is_along(hold: Span, force_S_n: FloatArray, axis: AxisMotion, findings: list[Finding]) -> bool:
    normal = np.median(force_S_n[hold.slice], axis=0)
    normal = normal / np.linalg.norm(normal)
    angle = float(np.degrees(np.arccos(np.clip(np.max(np.abs(normal)), 0.0, 1.0))))
    along = axis.name == "xyz"[int(np.argmax(np.abs(normal)))]
    if along and angle > _OBLIQUE_CONTACT_DEG:
        text = ", ".join(f"{component:+.2f}" for component in normal)
        findings.append(
            Finding(
                code="oblique-contact",
                severity="warning",
                message=f"A contact's normal lies {angle:.0f} degrees off axis {axis.name}: ({text}) in S.",
                advice="Touch a surface square to one axis, or turn the tool.",
            )
        )
    return along


def axis_priors(given: Mapping[str, Given], axis: str) -> dict[str, tuple[float, float]]:
    """Return what is given of an axis under the names of the joint fit; what is exact is known to a millionth."""
    known = {name: given[f"{axis}.{key}"] for key, name in axis_keys(axis).items() if f"{axis}.{key}" in given}
    if "mass_kg" in given and axis in AXIS_NAMES:
        known["mass_kg"] = given["mass_kg"]
    return {name: (g.value, max(g.std, _EXACT_SHARE * abs(g.value))) for name, g in known.items()}
