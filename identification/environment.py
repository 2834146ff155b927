"""Contacts, and the stiffness of what was touched."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .coupling import CouplingFit
from .segments import Span, low_pass

FloatArray = NDArray[np.float64]

_BAND_HZ = 60.0
_ONSET_SKIP_S = 0.012
_FURTHEST_BEFORE_S = 3.0
_LONGEST_BOUNCE_S = 0.5
_HOLD_USED_S = 0.4
_SMALLEST_CONTACT_N = 3.0
_SAME_SURFACE_RATIO = 1.25
# Contacts are fitted below 60 Hz and without their first instants: measured on simulated cells, this is what it costs.
_MODEL_STD_SHARE = 0.01


@dataclass(frozen=True, kw_only=True)
class Contact:
    """One contact on one axis; `sign` is +1 when pressing towards +axis.

    `stiffness_n_per_m`, `damping_n_s_per_m`: K_e and B_e with the coupling taken out, `_std` from the fit alone;
    `fit_error` is residual over spread of the contact force;
    `onset_s` from the start of the log.
    """

    sign: int
    onset_s: float
    peak_force_n: float
    hold_force_n: float
    stiffness_n_per_m: float
    stiffness_std_n_per_m: float
    damping_n_s_per_m: float
    damping_std_n_s_per_m: float
    fit_error: float


@dataclass(frozen=True, kw_only=True)
class Surface:
    """Contacts that felt alike: K_e (std includes that of K_s), B_e, and the secant, K_s and K_e in series."""

    contacts: tuple[Contact, ...]
    stiffness_n_per_m: float
    stiffness_std_n_per_m: float
    secant_n_per_m: float
    secant_std_n_per_m: float
    damping_n_s_per_m: float
    damping_std_n_s_per_m: float


def find_holds(still: Sequence[Span], force_n: FloatArray, threshold_n: float) -> tuple[Span, ...]:
    """Return the rests during which the payload presses on something: a force that gravity does not explain."""
    return tuple(span for span in still if abs(float(np.median(force_n[span.slice]))) > threshold_n)


@dataclass(frozen=True, kw_only=True)
class _Payload:
    """The payload behind the coupling and the force on what it touches, pressing counted positive: (n,) each."""

    payload_m: FloatArray
    payload_velocity_m_s: FloatArray
    contact_force_n: FloatArray


def identify_contact(
    hold: Span, position_m: FloatArray, force_n: FloatArray, period_s: float, coupling: CouplingFit, noise_rms_n: float
) -> Contact | None:
    """Fit one contact from its onset through the hold; None if no onset is found before the hold.

    The payload is seen through the coupling: x_p = x + δ with F = K_s δ + B_s dδ/dt; F_e = −F − B_p v_p − M_p a_p is
    then regressed on K_e (x_p − x_w) + B_e v_p (MODEL.md, "Continuous blocks").
    """
    sign = -1 if float(np.median(force_n[hold.slice])) > 0.0 else 1
    margin = round(0.3 / period_s)
    before = max(0, hold.start - round(_FURTHEST_BEFORE_S / period_s))
    after = min(len(position_m), hold.start + round(_HOLD_USED_S / period_s), hold.stop)
    window = slice(before, min(len(position_m), after + margin))
    payload = _see_payload(sign * position_m[window], -sign * force_n[window], period_s, coupling)
    threshold = max(_SMALLEST_CONTACT_N, 8.0 * noise_rms_n)
    onset = _onset(payload.contact_force_n, hold.start - before, threshold)
    if onset is None:
        return None
    used = slice(onset + round(_ONSET_SKIP_S / period_s), after - before)
    if not bool(np.all(np.isfinite(payload.contact_force_n[max(onset - 1, 0) : used.stop]))):
        return None  # a hole of the log hides the onset
    if used.stop - used.start < 20:
        return None
    one = np.ones(used.stop - used.start)
    correlated = 0.5 / (period_s * _BAND_HZ)  # filtered samples carry this many periods each
    columns = [payload.payload_m[used], payload.payload_velocity_m_s[used], one]
    values, stds, error = _regress(columns, payload.contact_force_n[used], correlated)
    damping, damping_std = float(values[1]), float(stds[1])
    if damping < 0.0:
        # No wall drives what presses on it; a slow approach cannot tell damping from stiffness.
        values, stds, error = _regress([columns[0], one], payload.contact_force_n[used], correlated)
        damping = 0.0
    # The filter smears the onset by a few milliseconds, and the highest peak may come before a bounce.
    first = before + _first_touch(payload.contact_force_n[: onset + 1], threshold, round(_LONGEST_BOUNCE_S / period_s))
    pressed = -sign * force_n[max(first - round(_ONSET_SKIP_S / period_s), 0) : hold.stop]
    return Contact(
        sign=sign,
        onset_s=(before + onset) * period_s,
        peak_force_n=float(np.nanmax(pressed)),
        hold_force_n=float(np.median(-sign * force_n[hold.slice])),
        stiffness_n_per_m=float(values[0]),
        stiffness_std_n_per_m=float(stds[0]),
        damping_n_s_per_m=damping,
        damping_std_n_s_per_m=damping_std,
        fit_error=error,
    )


def _see_payload(position: FloatArray, pressing: FloatArray, period_s: float, coupling: CouplingFit) -> _Payload:
    x, force = low_pass(position, period_s, _BAND_HZ), low_pass(pressing, period_s, _BAND_HZ)
    rate = np.gradient(force, period_s)
    # Pressing shortens the coupling: δ = −(force − B_s/K_s dforce/dt)/K_s to first order in B_s s/K_s.
    squeeze = (force - coupling.damping_n_s_per_m / coupling.stiffness_n_per_m * rate) / coupling.stiffness_n_per_m
    payload = x - squeeze
    payload_velocity = np.gradient(payload, period_s)
    payload_acceleration = np.gradient(payload_velocity, period_s)
    moving = coupling.drag_n_s_per_m * payload_velocity + coupling.mass_kg * payload_acceleration
    return _Payload(
        payload_m=payload,
        payload_velocity_m_s=payload_velocity,
        contact_force_n=force - moving,
    )


def _onset(contact_force: FloatArray, hold_start: int, threshold: float) -> int | None:
    """Return the first sample of the last unbroken touch before the hold; after a bounce, of the last touch."""
    below = np.flatnonzero(contact_force[:hold_start] < threshold)
    if below.size == 0 or below[-1] + 1 >= hold_start:
        return None
    return int(below[-1]) + 1


def _first_touch(contact_force: FloatArray, threshold: float, bounce: int) -> int:
    """Return the first touch of those that lead to the last sample with pauses of at most `bounce` samples."""
    touches = np.flatnonzero(contact_force >= threshold)
    pauses = np.flatnonzero(np.diff(touches) > bounce)
    return int(touches[pauses[-1] + 1] if pauses.size else touches[0])


def _regress(columns: list[FloatArray], values: FloatArray, correlated: float) -> tuple[FloatArray, FloatArray, float]:
    """Return coefficients, standard deviations and residual over spread of a linear fit with correlated samples."""
    rows = np.column_stack(columns)
    size = np.maximum(np.max(np.abs(rows), axis=0), 1e-300)
    solution = np.linalg.lstsq(rows / size, values, rcond=None)[0]
    residual = values - rows / size @ solution
    error = float(np.std(residual) / max(float(np.std(values)), 1e-300))
    freedom = max(len(values) / max(correlated, 1.0) - rows.shape[1], 1.0)
    variance = float(residual @ residual) / max(correlated, 1.0) / freedom
    information = (rows / size).T @ (rows / size) / max(correlated, 1.0)
    covariance = variance * np.linalg.pinv(information, hermitian=True)
    return np.asarray(solution / size), np.asarray(np.sqrt(np.diag(covariance)) / size), error


def group_surfaces(contacts: Sequence[Contact], coupling: CouplingFit) -> tuple[Surface, ...]:
    """Put contacts on one side whose K_e lie within 25 % of each other together, softest first, and average them."""
    groups: list[list[Contact]] = []
    for contact in sorted(contacts, key=lambda c: (c.sign, c.stiffness_n_per_m)):
        last = groups[-1] if groups else None
        if (
            last is not None
            and last[0].sign == contact.sign
            and contact.stiffness_n_per_m <= _SAME_SURFACE_RATIO * last[0].stiffness_n_per_m
        ):
            last.append(contact)
        else:
            groups.append([contact])
    return tuple(_averaged(sorted(group, key=lambda c: c.onset_s), coupling) for group in groups)


def _averaged(contacts: list[Contact], coupling: CouplingFit) -> Surface:
    stiffness, stiffness_std = _mean(
        [c.stiffness_n_per_m for c in contacts], [c.stiffness_std_n_per_m for c in contacts]
    )
    secant = coupling.stiffness_n_per_m * stiffness / (coupling.stiffness_n_per_m + stiffness)
    damping, damping_std = _mean([c.damping_n_s_per_m for c in contacts], [c.damping_std_n_s_per_m for c in contacts])
    # 1/K_e = 1/secant − 1/K_s: what is not known of K_s is not known of K_e either.
    through_coupling = (stiffness / coupling.stiffness_n_per_m) ** 2 * float(coupling.std[0])
    # The same for the secant, which is what a contact shows.
    stiffness_std = float(np.hypot(stiffness_std, _MODEL_STD_SHARE * stiffness**2 / secant))
    return Surface(
        contacts=tuple(contacts),
        stiffness_n_per_m=stiffness,
        stiffness_std_n_per_m=float(np.hypot(stiffness_std, through_coupling)),
        secant_n_per_m=secant,
        secant_std_n_per_m=(secant / stiffness) ** 2 * stiffness_std,
        damping_n_s_per_m=damping,
        damping_std_n_s_per_m=damping_std,
    )


def _mean(values: list[float], stds: list[float]) -> tuple[float, float]:
    """Return the mean and its standard deviation: the larger of what the fits say and what the scatter says."""
    count = len(values)
    inside = float(np.sqrt(np.sum(np.square(stds))) / count)
    scatter = float(np.std(values, ddof=1) / np.sqrt(count)) if count > 1 else 0.0
    return float(np.mean(values)), max(inside, scatter)
