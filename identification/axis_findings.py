"""Findings about the fit of one axis: contacts, masses, latency, misfit."""

from collections.abc import Sequence

import numpy as np

from .axes.straight import AxisMotion
from .joint_fit.latency import is_clear_latency
from .joint_fit.result import JointFit
from .payload.gravity import GravityFit
from .result import Finding
from .signals.segments import Span

_MASS_DISAGREEMENT_STDS = 3.0
_MASS_DISAGREEMENT_SHARE = 0.02
_MORE_THAN_NOISE = 1.5
CLOCKS_AGREE = "clocks-agree"
# What a force must exceed to count as a touch.
_LEFT_AT_REST_N = 2.0
_OFF_ADVICE = (
    "See the findings on the payload's weight: a sensor whose gain or zero changes leaves such a force. Or press "
    "near an orientation in which the poses were held."
)


def force_beside(axis: AxisMotion, still: Sequence[Span], holds: Sequence[Span]) -> float:
    """Return the highest force [N] at the rests next to the holds, in which nothing is touched; 0 without such."""
    free = [span for span in still if span not in holds]
    if not free or not holds:
        return 0.0
    nearest = [min(free, key=lambda span: abs(span.start - hold.start)) for hold in holds]
    return max(abs(float(np.median(axis.force_n[span.slice]))) for span in nearest)


def first_rests(still: Sequence[Span], holds: Sequence[Span]) -> tuple[Span, ...]:
    """Return the holds without those that only a jerk parts from another, no rest without force being in between."""
    before = [None, *still]
    return tuple(span for i, span in enumerate(still) if span in holds and before[i] not in holds)


def contact_findings(axis: str, holds: Sequence[Span], fit: JointFit, left_n: float) -> list[Finding]:
    """Return findings on rests under force that were no contacts; a force without contact explains that best."""
    used = sum(len(surface.onsets) for surface in fit.surfaces)
    is_off = left_n > _LEFT_AT_REST_N
    findings = []
    if used < len(holds):
        findings.append(
            Finding(
                code="rests-without-spring",
                severity="warning",
                message=f"Axis {axis}: {len(holds) - used} of {len(holds)} rests under force do not look like pressing "
                "on a surface after a free approach and were left out: "
                + (
                    f"even without contact weight and bias leave {left_n:.1f} N along the axis."
                    if is_off
                    else "a hand may have pushed."
                ),
                advice=_OFF_ADVICE if is_off else "Keep hands off the payload during contacts.",
            )
        )
    if not fit.surfaces:
        findings.append(
            Finding(
                code="no-contact",
                severity="error",
                message=f"Axis {axis}: no contact with an onset and a hold was found, so the environment's stiffness "
                "cannot be determined.",
                advice=_OFF_ADVICE
                if is_off and holds
                else "Record 3 or more contacts: approach at 1 to 3 cm/s, press with 20 to 50 N, hold for 1 s, back "
                "off.",
                axis=axis,
            )
        )
    return findings


def mass_findings(axis: str, gravity: GravityFit, fit: JointFit) -> list[Finding]:
    """Compare the mass from motion with that from gravity: two methods, one payload."""
    moved, moved_std = fit.value("mass_kg")
    apart, together = abs(moved - gravity.mass_kg), float(np.hypot(moved_std, gravity.mass_std_kg))
    if apart <= max(_MASS_DISAGREEMENT_STDS * together, _MASS_DISAGREEMENT_SHARE * gravity.mass_kg):
        return []
    return [
        Finding(
            code="mass-disagreement",
            severity="warning",
            message=f"Axis {axis}: the mass from motion, {moved:.3f} ± {moved_std:.2g} kg, and from gravity, "
            f"{gravity.mass_kg:.3f} ± {gravity.mass_std_kg:.2g} kg, disagree.",
            advice="Check force and length units, the clocks of wrench and pose, and that the payload is the same.",
        )
    ]


def fit_findings(axis: str, fit: JointFit, shifted_s: float) -> list[Finding]:
    """Return what the fit shows of the wrench's latency (see `latency_findings`), of its misfit and of the payload."""
    return [*latency_findings(axis, fit, shifted_s), *misfit_findings(axis, fit), *payload_findings(axis, fit)]


def latency_findings(axis: str, fit: JointFit, shifted_s: float = 0.0) -> list[Finding]:
    """Return the finding that the wrench was late, or early, against the motion; it was taken out.

    `shifted_s` was taken off its stamps before, as a clock's offset: where both together are none, the clocks agree.
    """
    latency = fit.latency
    if latency.is_filter and shifted_s != 0.0 and not is_clear_latency(shifted_s - latency.advanced_s, latency.std_s):
        agree = Finding.info(
            CLOCKS_AGREE,
            f"Axis {axis}: the wrench's stamps as logged agree with pose and command "
            f"({1e3 * (shifted_s - latency.advanced_s):+.3f} ± {1e3 * latency.std_s:.2g} ms); the "
            f"{1e3 * shifted_s:+.3f} ms that the weight in the turning tool showed are its low-pass's.",
            "",
        )
        return [agree]
    if latency.is_filter or latency.applied_s == 0.0 or not is_clear_latency(latency.seconds, latency.std_s):
        return []
    if shifted_s != 0.0 and not is_clear_latency(shifted_s + latency.seconds, latency.std_s):
        agree = Finding.info(
            CLOCKS_AGREE,
            f"Axis {axis}: the wrench's stamps as logged agree with pose and command "
            f"({1e3 * (shifted_s + latency.seconds):+.3f} ± {1e3 * latency.std_s:.2g} ms); the "
            f"{1e3 * shifted_s:+.3f} ms that the weight in the turning tool showed are put back.",
            "",
        )
        return [agree]
    late = "late" if fit.latency.seconds > 0.0 else "early"
    return [
        Finding(
            code="wrench-lag",
            severity="info",
            message=f"Axis {axis}: the wrench is stamped {1e3 * abs(fit.latency.seconds):.3f} ± "
            f"{1e3 * fit.latency.std_s:.2g} ms {late} against pose and command, which was taken out.",
            advice="A filter of the sensor or of its driver does this as well as a clock."
            if fit.latency.seconds > 0.0
            else "No sensor shows a force before it is there: have both drivers stamp with one clock.",
        )
    ]


def misfit_findings(axis: str, fit: JointFit) -> list[Finding]:
    """Return the finding that the residual exceeds the noise."""
    parts = ("free motion", fit.quality.noise_ratio_free), ("contacts", fit.quality.noise_ratio_contact or 0.0)
    result = [f"{ratio:.1f} times in {where}" for where, ratio in parts if ratio > _MORE_THAN_NOISE]
    if not result:
        return []
    free, contact = fit.unexplained
    weak = "K_s, B_s, B_p, K_e and B_e are" if free > 0.0 else "K_e and B_e are" if contact > 0.0 else ""
    return [
        Finding(
            code="model-misfit",
            severity="warning" if weak else "info",
            message=f"Axis {axis}: what the fit leaves of the force is larger than the sensor's noise at rest, "
            f"{' and '.join(result)}; the stated deviations are wider by what that costs."
            + (f" Nothing explains it, so {weak} weak at best." if weak else ""),
            advice="The pose's noise, which K_s turns into force (2 µm on 200 N/mm are 0.4 N), and a log slower than "
            "the motion do this; so do a payload that is not one mass on one spring, friction, a hand, or clocks that "
            "drift.",
        )
    ]


_NOT_DESIGNED_FOR = (
    "A controller is designed for one mass on one spring: fasten what moves, or let `validate --identified` compute "
    "|1 + L| on the measured response, which holds it."
)


def payload_findings(axis: str, fit: JointFit) -> list[Finding]:
    """Return what the payload has beside one mass on one spring, of which the coupling is free."""
    findings = []
    if fit.turned_n_per_m != 0.0:
        share = 100.0 * fit.turned_n_per_m / fit.value("stiffness_n_per_m")[0]
        findings.append(
            Finding.info(
                "payload-turns",
                f"Axis {axis}: the payload's centre of mass is off the axis, so it turns on its coupling as it swings. "
                f"Torque and inertia show it, and it is taken out: K_s would look {share:.2g} % softer.",
                "",
            )
        )
    if fit.is_payload_unclear:
        findings.append(
            Finding.warning(
                "payload-unclear",
                f"Axis {axis}: there is something beside one mass on one spring, dry friction in the coupling or a "
                "part that swings; the log does not show how much of which, so neither has a value.",
                _NOT_DESIGNED_FOR,
            )
        )
    if fit.part is not None:
        (share, share_std), (at, at_std), (ratio, _) = (
            fit.part.mass_share,
            fit.part.frequency_hz,
            fit.part.damping_ratio,
        )
        findings.append(
            Finding.warning(
                "second-mode",
                f"Axis {axis}: a part of {100.0 * share:.2g} ± {100.0 * share_std:.1g} % of the payload's mass swings "
                f"on it at {at:.3g} ± {at_std:.2g} Hz (damping ratio {ratio:.2g}). K_s, B_s and B_p are those beside "
                "it, and their deviations hold how well it is known.",
                _NOT_DESIGNED_FOR,
            )
        )
    if fit.friction_n is not None:
        friction, std = fit.friction_n
        unit = "N·m" if axis.startswith("r") else "N"
        findings.append(
            Finding.warning(
                "coupling-friction",
                f"Axis {axis}: the coupling rubs with {friction:.3g} ± {std:.1g} {unit}. K_s, B_s and B_p are "
                "those beside it, and their deviations hold what its law leaves open.",
                _NOT_DESIGNED_FOR,
            )
        )
    return findings
