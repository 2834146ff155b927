"""From a recording to plant parameters: one driver over the estimators of this floor."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .aligned import AlignedLog, align, check_regular, find_gaps
from .axes import AxisMotion, commanded_motion, find_axes, free_motions, unguided_spans
from .convention_choice import read_by_weight
from .coupling import CouplingFit, Noise, identify_coupling
from .environment import Contact, Surface, find_holds, group_surfaces, identify_contact
from .errors import EstimateError
from .frames import Frames
from .gravity import GravityFit, identify_gravity
from .gravity_verdicts import com_estimate, gravity_findings, mass_estimate
from .inertia import InertiaFit, identify_inertia
from .recording import Recording
from .result import (
    AxisEstimate,
    CouplingEstimate,
    EnvironmentEstimate,
    Estimate,
    Finding,
    Identified,
    InertiaEstimate,
    PayloadEstimate,
    RobotEstimate,
    Status,
)
from .robot import identify_robot
from .segments import Motion, Span, find_motion
from .sensor import describe_sensor
from .verdicts import judged, unidentifiable, unidentifiable_vector, vector

FloatArray = NDArray[np.float64]

_HOLD_THRESHOLD_N = 4.0
_HOLD_RESIDUALS = 6.0
_MASS_DISAGREEMENT_STDS = 3.0
_MASS_DISAGREEMENT_SHARE = 0.02
_OBLIQUE_SHARE = 0.3
_OBLIQUE_CONTACT_DEG = 10.0
# The continuous model is fitted to signals sampled behind a hold: measured on simulated cells, this is what it costs.
_MODEL_STD_SHARE = 0.003
_DAMPING_STD_SHARE = 0.001  # of the critical damping
_POOR_CONTACT_FIT = 0.5
_POOR_CONTACT_STD = 0.2


def identify_cell(recording: Recording, frames: Frames | None = None) -> Identified:
    """Estimate payload, sensor, and per axis robot, coupling and environments, each with a verdict.

    `frames` is what the cell declares (all the same where nothing is): the payload's weight is asked whether the
    declared signs, frames and quaternion order are true, and where only others fit, those are taken and named.
    What the log does not tell is `unidentifiable` and named by a finding of severity `error`. Raises EstimateError
    when not even gravity can be told (nothing else can be without it), LogError when the channels do not fit together.
    """
    first = align(recording)
    read = read_by_weight(recording, first, find_motion(first), frames)
    recording, log, motion = read.recording, read.log, read.motion
    gravity = identify_gravity(read.poses)
    force = gravity.compensated_force_S_n(log)
    findings: list[Finding] = []
    travel = find_axes(log, motion, force)
    if travel.oblique_share > _OBLIQUE_SHARE:
        findings.append(_oblique(travel.oblique_share))
    if not travel.axes:
        findings.append(_no_travel())
    axes = {}
    for axis in travel.axes:
        estimate, found = _identify_axis(recording, log, motion, gravity, force, axis)
        axes[axis.name] = estimate
        findings += found
    sensor, about_sensor = describe_sensor(read, gravity, frames)
    inertia = identify_inertia(log, motion, read.poses, gravity)
    return Identified(
        sample_time_s=_sample_time(recording),
        payload=PayloadEstimate(
            mass_kg=mass_estimate(gravity), com_m=com_estimate(gravity), inertia_kg_m2=_inertia(inertia)
        ),
        axes=axes,
        sensor=sensor,
        findings=(
            *read.findings,
            *findings,
            *gravity_findings(gravity),
            *about_sensor,
            *inertia.findings,
        ),
    )


def _inertia(fit: InertiaFit) -> InertiaEstimate | None:
    """Return the tensor, None where no component is told."""
    if all(component.value is None for component in fit.components):
        return None
    xx, yy, zz, xy, xz, yz = fit.components
    return InertiaEstimate(xx=xx, yy=yy, zz=zz, xy=xy, xz=xz, yz=yz)


@dataclass(frozen=True, kw_only=True)
class _AxisInput:
    """What the estimators of one axis share."""

    axis: AxisMotion
    period_s: float
    holds: tuple[Span, ...]
    noise: Noise


def _identify_axis(
    recording: Recording,
    log: AlignedLog,
    motion: Motion,
    gravity: GravityFit,
    force_S_n: FloatArray,
    axis: AxisMotion,
) -> tuple[AxisEstimate, list[Finding]]:
    findings: list[Finding] = []
    robot = _robot(recording, log, axis, findings)
    threshold = max(_HOLD_THRESHOLD_N, _HOLD_RESIDUALS * gravity.residual_rms_n)
    mine = tuple(
        s for s in find_holds(motion.still, axis.force_n, threshold) if _is_along(s, force_S_n, axis, findings)
    )
    noise = Noise(force_rms_n=gravity.noise_rms_n, position_rms_m=_position_noise(axis, motion.still))
    shared = _AxisInput(axis=axis, period_s=log.period_s, holds=mine, noise=noise)
    fit = _coupling(shared, log.pose_rate_hz, gravity, findings)
    if fit is None:
        missing = unidentifiable(note="no usable free motion")
        coupling, drag = CouplingEstimate(stiffness_n_per_m=missing, damping_n_s_per_m=missing), missing
        environments: tuple[EnvironmentEstimate, ...] = ()
    else:
        coupling, drag = _coupling_estimates(fit)
        environments = _environments(shared, fit, findings)
    return AxisEstimate(coupling=coupling, drag_n_s_per_m=drag, environments=environments, robot=robot), findings


def _robot(recording: Recording, log: AlignedLog, axis: AxisMotion, findings: list[Finding]) -> RobotEstimate:
    if recording.command is None:
        findings.append(
            _missing(
                "no-command",
                "The log has no commanded pose, so neither the robot's response nor its delay can be told.",
                "Record the position command that the robot receives as a PoseStamped topic, or name it with "
                "--command-topic.",
            )
        )
        return _no_robot("no commanded pose in the log")
    try:
        moved = commanded_motion(recording, recording.command, log, axis)
        fit = identify_robot(moved.command_m, moved.position_m, moved.period_s)
    except EstimateError as error:
        findings.append(_missing("robot", f"Axis {axis.name}: {error}", ""))
        return _no_robot(str(error))
    method = f"output error of r(s) behind a hold, residual {100.0 * fit.fit_error:.2g} % of the motion"
    bandwidth_std = float(np.hypot(fit.bandwidth_std_hz, _MODEL_STD_SHARE * fit.bandwidth_hz))
    delay_std = fit.delay_std_s
    delay = judged(
        fit.model.delay_s, delay_std, method=method, identified=np.inf if delay_std < 0.2 * moved.period_s else 0.05
    )
    return RobotEstimate(
        numerator=vector(fit.model.numerator, fit.numerator_std, method=method),
        denominator=vector(fit.model.denominator, fit.denominator_std, method=method),
        delay_s=delay,
        bandwidth_hz=judged(fit.bandwidth_hz, bandwidth_std, method=method),
    )


def _no_robot(note: str) -> RobotEstimate:
    return RobotEstimate(
        numerator=unidentifiable_vector(note),
        denominator=unidentifiable_vector(note),
        delay_s=unidentifiable(note=note),
        bandwidth_hz=unidentifiable(note=note),
    )


def _coupling(
    shared: _AxisInput, pose_rate_hz: float, gravity: GravityFit, findings: list[Finding]
) -> CouplingFit | None:
    axis = shared.axis
    motions = free_motions(axis, unguided_spans(axis), shared.period_s)
    try:
        fit = identify_coupling(motions, shared.period_s, pose_rate_hz, shared.noise)
    except EstimateError as error:
        findings.append(_missing("coupling", f"Axis {axis.name}: {error}", ""))
        return None
    model_std = _MODEL_STD_SHARE * _values(fit)
    model_std[1] = np.hypot(model_std[1], _DAMPING_STD_SHARE * _critical_damping(fit))
    fit = replace(fit, covariance=fit.covariance + np.diag(model_std**2))
    apart = abs(fit.mass_kg - gravity.mass_kg)
    std = float(np.hypot(fit.std[3], gravity.mass_std_kg))
    if apart > max(_MASS_DISAGREEMENT_STDS * std, _MASS_DISAGREEMENT_SHARE * gravity.mass_kg):
        findings.append(
            Finding(
                code="mass-disagreement",
                severity="warning",
                message=f"Axis {axis.name}: the mass from motion, {fit.mass_kg:.3f} ± {fit.std[3]:.3f} kg, and from "
                f"gravity, {gravity.mass_kg:.3f} ± {gravity.mass_std_kg:.3f} kg, disagree.",
                advice="Check force and length units, the clocks of wrench and pose, and that the payload is the same.",
            )
        )
    return fit


def _values(fit: CouplingFit) -> FloatArray:
    return np.array([fit.stiffness_n_per_m, fit.damping_n_s_per_m, fit.drag_n_s_per_m, fit.mass_kg])


def _critical_damping(fit: CouplingFit) -> float:
    return 2.0 * float(np.sqrt(fit.stiffness_n_per_m * fit.mass_kg))


def _coupling_estimates(fit: CouplingFit) -> tuple[CouplingEstimate, Estimate]:
    method = f"flange motion to force in free motion, {fit.band_hz[0]:.2g} to {fit.band_hz[1]:.3g} Hz"
    stiffness_std, damping_std, drag_std, _ = (float(s) for s in fit.std)
    # A damping matters beside the critical one; a tenth of that is the size below which nothing changes.
    critical = _critical_damping(fit)
    coupling = CouplingEstimate(
        stiffness_n_per_m=judged(fit.stiffness_n_per_m, stiffness_std, method=method),
        damping_n_s_per_m=judged(fit.damping_n_s_per_m, damping_std, method=method, floor=0.1 * critical),
    )
    return coupling, judged(fit.drag_n_s_per_m, drag_std, method=method, floor=0.1 * critical)


def _environments(shared: _AxisInput, fit: CouplingFit, findings: list[Finding]) -> tuple[EnvironmentEstimate, ...]:
    axis = shared.axis
    contacts = [
        identify_contact(hold, axis.position_m, axis.force_n, shared.period_s, fit, shared.noise.force_rms_n)
        for hold in shared.holds
    ]
    good = [c for c in contacts if c is not None and _is_spring(c)]
    if len(good) < len(contacts):
        findings.append(
            Finding(
                code="rests-without-spring",
                severity="warning",
                message=f"Axis {axis.name}: {len(contacts) - len(good)} of {len(contacts)} rests under force do not "
                "look like pressing on a surface (a hand, perhaps) and were left out.",
                advice="Keep hands off the payload during contacts.",
            )
        )
    surfaces = group_surfaces(good, fit)
    if not surfaces:
        findings.append(
            _missing(
                "no-contact",
                f"Axis {axis.name}: no contact with an onset and a hold was found, so the environment's stiffness "
                "cannot be told.",
                "Record 3 or more contacts: approach at 1 to 3 cm/s, press with 20 to 50 N, hold for 1 s, back off.",
            )
        )
    return tuple(_environment(surface, f"{axis.name}{i + 1}") for i, surface in enumerate(surfaces))


def _is_spring(contact: Contact) -> bool:
    """Return whether the rest looks like pressing on something elastic: a hand that holds does not."""
    spread = contact.stiffness_std_n_per_m / contact.stiffness_n_per_m if contact.stiffness_n_per_m > 0.0 else np.inf
    return contact.fit_error < _POOR_CONTACT_FIT and spread < _POOR_CONTACT_STD


def _environment(surface: Surface, name: str) -> EnvironmentEstimate:
    method = "payload motion behind the coupling against contact force, onset to hold"
    stiffness = judged(surface.stiffness_n_per_m, surface.stiffness_std_n_per_m, method=method)
    known_mass = "taken as massless; the contact is not resolved finely enough to tell"
    return EnvironmentEstimate(
        name=name,
        stiffness_n_per_m=stiffness,
        secant_stiffness_n_per_m=judged(
            surface.secant_n_per_m, surface.secant_std_n_per_m, method="K_s and K_e in series"
        ),
        damping_n_s_per_m=judged(surface.damping_n_s_per_m, surface.damping_std_n_s_per_m, method=method),
        mass_kg=unidentifiable(note=known_mass),
        contacts=len(surface.contacts),
        peak_force_n=tuple(c.peak_force_n for c in surface.contacts),
    )


def _is_along(hold: Span, force_S_n: FloatArray, axis: AxisMotion, findings: list[Finding]) -> bool:
    """Return whether the hold presses along this axis; an oblique normal is told with its direction."""
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


def _position_noise(axis: AxisMotion, still: tuple[Span, ...]) -> float:
    """Return the white noise of the position at rest, from second differences (they leave drift out)."""
    longest = max(still, key=len)
    second = np.diff(axis.position_m[longest.slice], n=2)
    return max(float(np.std(second) / np.sqrt(6.0)), 1e-9)


def _sample_time(recording: Recording) -> Estimate:
    source = recording.command if recording.command is not None else recording.wrench
    period = check_regular(source.topic, source.stamp_ns, keeps_holes=recording.keeps_holes)
    spread = float(np.std(np.delete(np.diff(source.stamp_ns), find_gaps(source.stamp_ns)))) * 1e-9
    note = f"period of `{source.topic}`, taken as the control period"
    return Estimate(
        value=period,
        std=spread / np.sqrt(len(source.stamp_ns)),
        status=Status.IDENTIFIED if recording.command is not None else Status.WEAK,
        method="header stamps",
        note=note,
    )


def _missing(code: str, message: str, advice: str) -> Finding:
    return Finding(code=code, severity="error", message=message, advice=advice)


def _oblique(share: float) -> Finding:
    return Finding(
        code="oblique-motion",
        severity="warning",
        message=f"{100.0 * share:.0f} % of the travel went along none of the sensor frame's axes and was not used.",
        advice="Move along one axis of the tool at a time.",
    )


def _no_travel() -> Finding:
    return _missing(
        "no-travel",
        "The tool never travels along one axis of the sensor frame with constant orientation, so neither robot, "
        "coupling nor environment can be told.",
        "Record a commanded sweep and contacts along one tool axis.",
    )
