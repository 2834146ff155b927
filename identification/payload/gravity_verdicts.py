"""Verdicts on mass and centre of mass, and findings on what the residual of the weight follows."""

from collections.abc import Sequence

import numpy as np

from ..result import Estimate, Finding, Status, VectorEstimate
from ..verdicts import judged, unidentifiable_vector
from .gravity import GravityFit
from .pose_fit import ResidualTerm, TermKind
from .static_poses import GRAVITY_B_M_S2

WITHOUT_TORQUE = "the log has no three torques: force and orientation show mass and force bias only"

METHOD = "least squares over static poses"
_COM_IDENTIFIED_M = 5e-3
_COM_WEAK_M = 25e-3
_LARGE_SHARE = 0.02
_SMALL_DRIFT_N = 0.2
_GROWTH_FACTOR = 2.0
_ADVICE = {
    TermKind.DRIFT: "Warm the sensor up for half an hour and record again, quickly; a tare takes no drift away.",
    TermKind.AXIS_GAIN: "Have the sensor calibrated, and look for cables and hoses that carry a part of the load.",
    TermKind.LOAD_CURVE: "The load is near the sensor's range or the mounting yields: use a sensor of a larger range, "
    "and identify at the load that the controller will carry.",
}


def mass_estimate(fit: GravityFit) -> Estimate:
    """Return the mass with its verdict: identified within 5 %, weak within 25 %."""
    return judged(fit.mass_kg, fit.mass_std_kg, method=METHOD, note="includes the unknown local gravity")


def com_estimate(fit: GravityFit) -> VectorEstimate:
    """Return the centre of mass with its verdict: identified within 5 mm, weak within 25 mm, per component at worst."""
    if not fit.has_torque:
        return unidentifiable_vector(WITHOUT_TORQUE)
    worst = float(np.max(fit.com_std_m))
    if not fit.com_is_excited or not worst <= _COM_WEAK_M:
        why = (
            f"standard deviation up to {1e3 * worst:.0f} mm"
            if fit.com_is_excited
            else "the poses tilt about one axis only"
        )
        return unidentifiable_vector(f"{why}; record poses tilted by 30 to 70 degrees about two axes")
    return VectorEstimate(
        value=tuple(float(v) for v in fit.com_S_m),
        std=tuple(float(s) for s in fit.com_std_m),
        status=Status.IDENTIFIED if worst <= _COM_IDENTIFIED_M else Status.WEAK,
        method=METHOD,
    )


def gravity_findings(fit: GravityFit) -> tuple[Finding, ...]:
    """Return what the rests say beside mass and bias: contacts, a tare, drift, load that the sensor does not follow."""
    found: list[Finding] = []
    if not fit.has_torque:
        text = f"Centre of mass and torque bias are not identified: {WITHOUT_TORQUE}."
        found.append(Finding(code="no-torque", severity="info", message=text, advice=""))
    if fit.rejected:
        found.append(
            Finding(
                code="rests-with-contact",
                severity="info",
                message=f"{fit.rejected} rests did not fit the payload's weight and were left out (contacts).",
                advice="",
            )
        )
    step = fit.bias_step
    if step is not None:
        shown = ", ".join(f"{-value:+.2f}" for value in step.force_before_S_n)
        when = f"{step.after_s:.2f} and {step.before_s:.2f} s"
        if not np.isfinite(step.after_s):
            when = f"rows {step.sample} and {step.sample + 1}"
        found.append(
            Finding(
                code="bias-step",
                severity="warning",
                message=f"The sensor's bias steps by ({shown}) N between {when}; "
                "both parts of the log were used, each with its own bias.",
                advice="Tare before recording, not during it.",
            )
        )
    found += [
        _term_finding(term)
        for term in fit.terms
        if term.is_significant and (term.kind is not TermKind.DRIFT or np.max(term.effect_n) > _SMALL_DRIFT_N)
    ]
    weight = fit.mass_kg * float(np.linalg.norm(GRAVITY_B_M_S2))
    if fit.residual_rms_n > _LARGE_SHARE * weight:
        found.append(
            Finding(
                code="gravity-residual",
                severity="warning",
                message=f"The rests leave {fit.residual_rms_n:.2f} N rms, {100.0 * fit.residual_rms_n / weight:.1f} % "
                f"of a load of {weight:.0f} N.",
                advice="Compare with a lighter payload: what grows faster than the load is the sensor's nonlinearity "
                "or a mounting that yields; what does not is a cable, a wrong frame or a touched payload.",
            )
        )
    return tuple(found)


def _term_finding(term: ResidualTerm) -> Finding:
    effect = ", ".join(f"{value:.2f}" for value in term.effect_n)
    values = ", ".join(
        f"{value:.4g} ± {std:.2g}" for value, std in zip(term.coefficient, term.coefficient_std, strict=True)
    )
    unit = {TermKind.DRIFT: "N/s", TermKind.AXIS_GAIN: "kg by axis", TermKind.LOAD_CURVE: "1/N"}[term.kind]
    return Finding(
        code=f"force-follows-{term.kind.name.lower().replace('_', '-')}",
        severity="warning",
        message=f"What the weight leaves of the force at rest follows {term.kind.value}: {values} {unit}, up to "
        f"({effect}) N; it takes the residual from {term.rms_before_n:.2f} to {term.rms_after_n:.2f} N rms.",
        advice=_ADVICE[term.kind],
    )


def load_growth_findings(loads: Sequence[tuple[float, float]]) -> tuple[Finding, ...]:
    """Compare logs of different payloads: a residual that grows faster than the load is the sensor's nonlinearity.

    `loads` are the payload's mass [kg] and what its weight leaves [N rms] in each log. The paper finds 1.1 N at 16 kg
    and 23.3 N at 50 kg: three times the load, twenty times the residual.
    """
    if len(loads) < 2:
        return ()
    (light, before), (heavy, after) = min(loads), max(loads)
    load, residual = heavy / light, after / max(before, 1e-9)
    if load < 1.2 or residual < _GROWTH_FACTOR * load:
        return ()
    return (
        Finding(
            code="residual-grows-with-load",
            severity="warning",
            message=f"From {light:.1f} to {heavy:.1f} kg the load grows {load:.1f} times and what the weight leaves "
            f"{residual:.1f} times ({before:.2f} to {after:.2f} N rms).",
            advice=_ADVICE[TermKind.LOAD_CURVE],
        ),
    )
