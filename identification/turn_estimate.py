"""Everything that a recording tells of one axis about which the tool turns."""

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.signal import detrend

from problems.progress import ProgressSlice

from .axes.turning import LEVER_M, AxisTurn, Unrolled, rests_after, unroll
from .axis_estimate import AxisTold, AxisView, CellSignals, axis_priors, fit_axis
from .errors import EstimateError
from .joint_fit.contacts import find_holds, hold_threshold_n
from .joint_fit.rotation_fit import fit_about_axis, inertia_findings, path_of
from .payload.inertia import InertiaFit
from .result import Finding


def identify_turn(
    cell: CellSignals, turn: AxisTurn, inertia: InertiaFit, progress: ProgressSlice | None = None
) -> AxisTold | None:
    """Estimate one rotational axis in N·m/rad, N·m·s/rad and kg·m²; None, with its reason, where it tells nothing.

    The turn is seen as motion along a straight path 0.2 m off the centre, for which all thresholds hold; the inertia is
    compared with that of the tensor. What is missing is a warning: a log whose translations are told is a good log.
    `progress` is told the share of the work that is done.
    """
    try:
        unrolled = unroll(turn, cell.recording, cell.log)
    except EstimateError:
        return None
    holds = find_holds(
        cell.motion.still,
        unrolled.axis.force_n,
        hold_threshold_n(cell.gravity.torque_residual_rms_n_m / LEVER_M),
    )
    tensor = inertia.components[turn.index]
    told = fit_axis(
        cell,
        AxisView(
            recording=unrolled.recording,
            log=unrolled.log,
            axis=unrolled.axis,
            holds=rests_after(unrolled.axis.spans, holds),
            noise_rms_n=_noise(cell, unrolled),
            mass_kg=None if tensor.value is None or tensor.std is None else path_of((tensor.value, tensor.std))[0],
            priors={
                name: known if name == "delay_s" else path_of(known)
                for name, known in axis_priors(cell.given, turn.name).items()
            },
            in_units=partial(fit_about_axis, turn=turn),
        ),
        progress or ProgressSlice(),
    )
    if told.fit is None:
        return None
    findings = [replace(f, severity="warning") if f.severity == "error" else f for f in told.findings]
    return replace(told, findings=(*findings, *inertia_findings(told.fit, turn, inertia)))


def not_told(turn: AxisTurn) -> Finding:
    """Return the finding that an axis about which the tool turned does not tell its coupling."""
    return Finding(
        code="turn-not-told",
        severity="info",
        message=f"The tool turned about axis {turn.name}, but that does not tell its coupling, and it is left out.",
        advice="To tune this axis, record a commanded sweep of 0.5 to 50 Hz about it in free space, hands off.",
    )


def _noise(cell: CellSignals, unrolled: Unrolled) -> float:
    """Return the force's noise at rest on the path, drift taken out, as the median rest has it."""
    rests = [unrolled.axis.force_n[span.slice] for span in cell.motion.still]
    return float(np.median([np.std(detrend(force)) for force in rests]))
