"""Estimates of one axis about which the tool turns, in rotational units."""

from dataclasses import replace
from functools import partial

import numpy as np
import scipy

from problems.model.axis_kind import LEVER_M
from problems.progress import ProgressSlice

from .axes.turning import AxisTurn, Unrolled, rests_after, unroll
from .axis_command import AxisKnowledge, CellSignals
from .axis_estimate import AxisResult, axis_priors, fit_axis
from .errors import EstimateError
from .joint_fit.model import COUPLING_NAMES
from .joint_fit.result import MECHANICAL_NAMES, JointFit
from .joint_fit.segments import find_holds
from .payload.inertia import InertiaFit
from .result import Finding
from .signals.contact_rule import CONTACT

_DISAGREEMENT_STDS = 3.0
_DISAGREEMENT_SHARE = 0.03


def identify_turn(
    cell: CellSignals, turn: AxisTurn, inertia: InertiaFit, progress: ProgressSlice | None = None
) -> AxisResult | None:
    """Estimate one rotational axis in N·m/rad, N·m·s/rad and kg·m²; None, with its reason, where it shows nothing.

    The turn is seen as motion along a straight path 0.2 m off the centre, for which all thresholds hold; the inertia is
    compared with that of the tensor. What is missing is a warning: a log whose translations are identified is good.
    `progress` receives the share of the work that is done.
    """
    if cell.gravity is None:
        return None
    try:
        unrolled = unroll(turn, cell.recording, cell.log)
    except EstimateError:
        return None
    holds = find_holds(
        cell.motion.still,
        unrolled.axis.force_n,
        CONTACT.hold_threshold_n(cell.gravity.torque_residual_rms_n_m / LEVER_M),
    )
    tensor = inertia.components[turn.index]
    known = axis_priors(cell.given, turn.name).items()
    result = fit_axis(
        replace(cell, recording=unrolled.recording, log=unrolled.log, noise_rms_n=_noise(cell, unrolled)),
        unrolled.axis,
        rests_after(unrolled.axis.spans, holds),
        AxisKnowledge(
            mass_kg=None if tensor.value is None or tensor.std is None else path_of((tensor.value, tensor.std))[0],
            priors={name: each if name == "delay_s" else path_of(each) for name, each in known},
            in_units=partial(fit_about_axis, turn=turn),
        ),
        progress or ProgressSlice(),
    )
    if result.fit is None:
        return None
    findings = [replace(f, severity="warning") if f.severity == "error" else f for f in result.findings]
    return replace(result, findings=(*findings, *inertia_findings(result.fit, turn, inertia)))


def is_change_of_pose(turn: AxisTurn, result: AxisResult) -> bool:
    """Return whether the tool only turned from rest to rest, pressed nothing by that, and shows nothing of K_s."""
    stiffness = result.estimate.coupling.stiffness_n_per_m
    is_unknown = stiffness.value is None and stiffness.ci95 is None
    return is_unknown and not turn.is_swept and not result.contacts.holds


def unidentified_turn(turn: AxisTurn) -> Finding:
    """Return the finding that the coupling about an axis was not identified though the tool turned."""
    return Finding(
        code="turn-not-identified",
        severity="info",
        message=f"The tool turned about axis {turn.name}, but its coupling is not identified: it is left out.",
        advice="To tune this axis, record a commanded sweep of 0.5 to 50 Hz about it in free space, hands off.",
    )


def _noise(cell: CellSignals, unrolled: Unrolled) -> float:
    """Return the force's noise at rest on the path, drift taken out, as the median rest has it."""
    rests = [unrolled.axis.force_n[span.slice] for span in cell.motion.still]
    return float(np.median([np.std(scipy.signal.detrend(force)) for force in rests]))


def path_of(torque: tuple[float, float]) -> tuple[float, float]:
    """Return what a stiffness, damping or inertia about the axis, value and deviation, is on the unrolled path."""
    return torque[0] / LEVER_M**2, torque[1] / LEVER_M**2


def fit_about_axis(fit: JointFit, turn: AxisTurn) -> JointFit:
    """Return the joint fit of an unrolled turn in N·m/rad, N·m·s/rad, kg·m² and N·m, under the same names.

    The payload's weight turns with the payload, which the coupling lets turn further than the flange; what is taken off
    turns with the flange. With κ = (the weight's stiffness)/K_s that makes K_s and B_s look smaller by κ, and all that
    lies behind them by 2 κ, to first order. No model holds this, so as much is added to the covariance, in common.
    """
    scale = np.array([LEVER_M**2 if name.endswith(MECHANICAL_NAMES) else 1.0 for name in fit.names])
    values = fit.values * scale
    share = abs(turn.weight_n_m_per_rad) / float(values[fit.names.index("stiffness_n_per_m")])
    common = np.where(scale == 1.0, 0.0, 2.0 * share * values)
    common[[fit.names.index(name) for name in COUPLING_NAMES[:2]]] *= 0.5
    surfaces = tuple(
        replace(
            surface,
            secant_n_per_m=LEVER_M**2 * surface.secant_n_per_m,
            secant_std_n_per_m=LEVER_M**2
            * float(np.hypot(surface.secant_std_n_per_m, 2.0 * share * surface.secant_n_per_m)),
            peak_force_n=tuple(LEVER_M * peak for peak in surface.peak_force_n),
        )
        for surface in fit.surfaces
    )
    return replace(
        fit,
        values=values,
        covariance=fit.covariance * np.outer(scale, scale) + np.outer(common, common),
        ci95={name: (LEVER_M**2 * low, LEVER_M**2 * high) for name, (low, high) in fit.ci95.items()},
        surfaces=surfaces,
        friction_n=None if fit.friction_n is None else (LEVER_M * fit.friction_n[0], LEVER_M * fit.friction_n[1]),
        spans=tuple(
            replace(span, measured=LEVER_M * span.measured, predicted=LEVER_M * span.predicted) for span in fit.spans
        ),
        held_out=tuple(
            replace(each, measured_peak=LEVER_M * each.measured_peak, predicted_peak=LEVER_M * each.predicted_peak)
            for each in fit.held_out
        ),
    )


def inertia_findings(fit: JointFit, turn: AxisTurn, inertia: InertiaFit) -> tuple[Finding, ...]:
    """Compare the inertia from turning about an axis of S with the tensor's: two methods, one payload.

    `fit` is in rotational units. Both hold about the origin of S; a tensor that is not identified says nothing.
    """
    tensor = inertia.components[turn.index]
    if tensor.value is None or tensor.std is None:
        return ()
    moved, moved_std = fit.value("mass_kg")
    together = float(np.hypot(moved_std, tensor.std))
    if abs(moved - tensor.value) <= max(_DISAGREEMENT_STDS * together, _DISAGREEMENT_SHARE * tensor.value):
        return ()
    return (
        Finding(
            code="inertia-disagreement",
            severity="warning",
            message=f"Axis {turn.name}: the inertia from turning about it, {moved:.4g} ± {moved_std:.2g} kg m², and "
            f"from moves that turn the tool, {tensor.value:.4g} ± {tensor.std:.2g} kg m², disagree.",
            advice="Check the torque's unit, the clocks of wrench and pose, and that the payload is the same.",
        ),
    )
