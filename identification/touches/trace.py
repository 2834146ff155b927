"""The secant stiffness of a contact trace: displacement since contact, and force."""

from dataclasses import dataclass

import numpy as np

from problems.arrays import BoolArray, FloatArray

from ..errors import EstimateError
from ..result import EnvironmentEstimate, Finding
from ..signals.aligned import check_regular, spans_of
from ..signals.contact_rule import CONTACT
from ..signals.recording import AXES, Recording
from ..verdicts import judged, unidentifiable

_SMALLEST_TRAVEL_M = 2e-4
_FEWEST = 50
# Below a fifth of the peak a payload that rebounds is off the surface, and a deadband weighs most.
_LOADED_SHARE = 0.2
# A hold is where the trace stays longest at one depth, to this share of the deepest, for this share of the load.
_SAME_DEPTH_SHARE = 0.05
_HOLD_SHARE = 0.2
_SPIKE_RATIO = 2.0
_FALLEN_SHARE = 0.5
_BLOCKS = 12
_NOT_A_SPRING = 0.1


def identify_trace_surfaces(recording: Recording, findings: list[Finding]) -> dict[str, EnvironmentEstimate]:
    """Return the surface that a trace of displacement and force shows on each axis, and append what is to be said."""
    wrench, pose = recording.wrench, recording.pose
    period = check_regular(wrench.topic, wrench.stamp_ns, keeps_holes=recording.keeps_holes)
    surfaces = {}
    for i, axis in enumerate(AXES[:3]):
        if axis not in wrench.measured_axes or axis not in pose.measured_axes:
            continue
        inside = (wrench.stamp_ns >= pose.stamp_ns[0]) & (wrench.stamp_ns <= pose.stamp_ns[-1])
        start = int(pose.stamp_ns[0])
        displacement = np.interp(
            wrench.stamp_ns[inside] - start, pose.stamp_ns - start, np.array(pose.position_m[:, i], dtype=np.float64)
        )
        # Pressing towards +axis reads F < 0 (the payload's force on the flange).
        sign = 1.0 if abs(float(np.max(displacement))) >= abs(float(np.min(displacement))) else -1.0
        try:
            contact = identify_trace(sign * displacement, -sign * wrench.force_n[inside, i], period)
        except EstimateError as error:
            findings.append(Finding(code="no-contact", severity="warning", message=f"Axis {axis}: {error}", advice=""))
            continue
        surfaces[axis], about = describe_trace(contact, f"{axis}1")
        findings += about
    return surfaces


@dataclass(frozen=True, kw_only=True)
class Spike:
    """The first blow: its force, where it came, and ∫(F − k x)dt, the momentum that no spring took."""

    force_n: float
    depth_m: float
    impulse_n_s: float


@dataclass(frozen=True, kw_only=True)
class TraceContact:
    """Force over displacement since contact. `secant_n_per_m` k minimises Σ(F − k x)² over the loaded samples.

    `secant_std_n_per_m` holds the scatter about it and what the place of the first touch does to it;
    `hold_secant_n_per_m` is mean force over mean displacement of the hold, the longest stretch under load at one depth,
    None without one; `fit_error` RMS(F − k x) over RMS(F).
    """

    peak_force_n: float
    secant_n_per_m: float
    secant_std_n_per_m: float
    hold_secant_n_per_m: float | None
    touch_m: float
    fit_error: float
    spike: Spike | None


def identify_trace(displacement_m: FloatArray, pressing_n: FloatArray, period_s: float) -> TraceContact:
    """Fit k through the origin of displacement (n,), counted from contact, and pressing force (n,), both into the wall.

    Samples from a fifth of the peak force on count. The trace says where the contact began, and so does the force
    (the last sample below 5 % of the peak before the load): the difference between both secants goes into the
    deviation. Raises EstimateError where nothing presses, or too little.
    """
    x, force = displacement_m, pressing_n
    peak, depth = float(np.max(force, initial=0.0)), float(np.max(x, initial=0.0))
    loaded = (force > _LOADED_SHARE * peak) & (x > 0.0)
    if peak < CONTACT.smallest_trace_peak_n or depth < _SMALLEST_TRAVEL_M or np.count_nonzero(loaded) < _FEWEST:
        raise EstimateError(
            f"A force of {peak:.2f} N at most, over {1e3 * depth:.2f} mm into the surface, is no contact from which a "
            "stiffness can be determined; press with 20 N or more, and check `exerted_by` if the trace does press."
        )
    stiffness, scatter = _through_origin(x[loaded], force[loaded])
    first = int(np.argmax(loaded))
    before = np.flatnonzero(force[:first] < CONTACT.trace_share * peak)
    touch = int(before[-1]) if before.size else 0
    farther = x[touch]
    beyond = loaded & (x > farther)
    apart = _through_origin(x[beyond] - farther, force[beyond])[0] - stiffness if np.any(beyond) else np.inf
    misfit = force[loaded] - stiffness * x[loaded]
    return TraceContact(
        peak_force_n=peak,
        secant_n_per_m=stiffness,
        secant_std_n_per_m=float(np.hypot(scatter, apart)),
        hold_secant_n_per_m=_hold_secant(x, force, loaded),
        touch_m=float(farther),
        fit_error=float(np.sqrt(np.mean(misfit**2) / np.mean(force[loaded] ** 2))),
        spike=_spike(x, force, stiffness, touch, period_s),
    )


def describe_trace(contact: TraceContact, name: str) -> tuple[EnvironmentEstimate, tuple[Finding, ...]]:
    """Return what a trace shows of a surface: the secant, never K_e, B_e or M_e alone."""
    secant = contact.secant_n_per_m
    method = "force over robot travel: least squares through the origin over the samples above 20 % of the peak force"
    hold = _hold_text(contact)
    blow = contact.spike
    environment = EnvironmentEstimate(
        name=name,
        stiffness_n_per_m=unidentifiable(
            note=f"in series with a coupling that this trace does not identify; above the secant, {secant:.4g} N/m"
        ),
        secant_stiffness_n_per_m=judged(secant, contact.secant_std_n_per_m, method=method, note=hold),
        damping_n_s_per_m=unidentifiable(note="the motion of the payload behind the coupling is not identified"),
        mass_kg=unidentifiable(
            note="no impact spike"
            if blow is None
            else f"an impact spike of {blow.impulse_n_s:.2g} N·s; payload and surface share it"
        ),
        contacts=1,
        peak_force_n=(contact.peak_force_n,),
    )
    return environment, _findings(contact, name)


def _findings(contact: TraceContact, name: str) -> tuple[Finding, ...]:
    found = []
    if contact.spike is not None:
        spike = contact.spike
        found.append(
            Finding(
                code="impact-spike",
                severity="warning",
                message=f"Surface {name}: the contact begins with a blow of {spike.force_n:.1f} N at "
                f"{1e3 * spike.depth_m:.2f} mm, where the secant explains "
                f"{contact.secant_n_per_m * spike.depth_m:.1f} N: masses meet, so a slope fitted there is no "
                "stiffness.",
                advice="Record wrench, whole pose and command, to determine the masses of payload and surface.",
            )
        )
    if contact.fit_error > _NOT_A_SPRING:
        found.append(
            Finding(
                code="secant-only",
                severity="warning",
                message=f"Surface {name}: force and displacement leave {100.0 * contact.fit_error:.0f} % of the force "
                f"unexplained by {contact.secant_n_per_m:.4g} N/m ({_hold_text(contact)}; "
                f"contact felt at {1e3 * contact.touch_m:.2f} mm): the secant "
                "depends on load, on swings of the payload and on where the contact begins.",
                advice="Hold the contact for 1 s after the swings have died out.",
            )
        )
    return tuple(found)


def _hold_text(contact: TraceContact) -> str:
    if contact.hold_secant_n_per_m is None:
        return "the trace has no hold"
    return f"{contact.hold_secant_n_per_m:.4g} N/m over the hold"


def _hold_secant(x: FloatArray, force: FloatArray, loaded: BoolArray) -> float | None:
    """Return mean force over mean displacement of the longest stretch under load at one depth, None without a hold."""
    depths = np.sort(x[loaded])
    width = _SAME_DEPTH_SHARE * float(depths[-1])
    counts = np.searchsorted(depths, depths + width, side="right") - np.arange(len(depths))
    low = float(depths[int(np.argmax(counts))])
    there = loaded & (x >= low) & (x <= low + width)
    hold = max(spans_of(there), key=len)
    if len(hold) < _HOLD_SHARE * np.count_nonzero(loaded):
        return None
    return float(np.mean(force[hold.slice]) / np.mean(x[hold.slice]))


def _through_origin(x: FloatArray, force: FloatArray) -> tuple[float, float]:
    """Return k of F = k x and its deviation, from sums of x (F − k x) over blocks much longer than a swing."""
    square = float(x @ x)
    stiffness = float(x @ force) / square
    sums = np.array([float(np.sum(part)) for part in np.array_split(x * (force - stiffness * x), _BLOCKS)])
    return stiffness, float(np.sqrt(np.sum(sums**2) * _BLOCKS / (_BLOCKS - 1)) / square)


def _spike(x: FloatArray, force: FloatArray, stiffness: float, touch: int, period_s: float) -> Spike | None:
    """Return the first blow: a maximum of more than twice k x, from which the force falls by half and more."""
    after = force[touch:]
    highest = np.maximum.accumulate(after)
    fallen = np.flatnonzero((after < _FALLEN_SHARE * highest) & (highest > _LOADED_SHARE * float(np.max(force))))
    if not fallen.size:
        return None
    blow = slice(touch, touch + int(fallen[0]))
    top = touch + int(np.argmax(force[blow]))
    if force[top] < _SPIKE_RATIO * stiffness * max(float(x[top]), 0.0):
        return None
    return Spike(
        force_n=float(force[top]),
        depth_m=float(x[top]),
        impulse_n_s=float(np.sum(force[blow] - stiffness * x[blow]) * period_s),
    )
