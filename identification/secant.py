"""The secant stiffness of contacts where nothing tells the coupling: force over flange travel."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .axes import AxisMotion
from .joint_contacts import group_contacts
from .result import EnvironmentEstimate
from .segments import Span, low_pass
from .verdicts import judged, unidentifiable, weak_at_best

FloatArray = NDArray[np.float64]

_BAND_HZ = 20.0
_FURTHEST_BEFORE_S = 3.0
_APPROACH_S, _CLEAR_S, _LONGEST_BOUNCE_S = 0.2, 0.05, 0.3
_NOISES, _SAMPLES = 5.0, 3.0
_LARGEST_DRAG_SHARE = 0.5
_SAME_SECANT = 1.12
_SMALLEST_TRAVEL_M = 5e-5
_MODEL_SHARE = 0.03
_UNKNOWN = "what the payload does behind its coupling is not told"


def secant_surfaces(axis: AxisMotion, holds: Sequence[Span], period_s: float) -> tuple[EnvironmentEstimate, ...]:
    """Return surfaces with the secant and the peaks only: K_s and K_e in series, from touch to hold of each contact.

    k = F_hold/(x_hold − x_touch) of the flange; the touch is where the force last leaves what the approach shows.
    `weak` at best: half of the approach's drag counts as doubt.
    """
    found = []
    for hold in holds:
        told = _secant(axis, hold, period_s)
        if told is not None:
            sign = -1 if float(np.median(axis.force_n[hold.slice])) > 0.0 else 1
            found.append((sign, *told))
    groups = group_contacts([(sign, secant, std) for sign, secant, std, _ in found], _SAME_SECANT)
    surfaces = []
    for index in range(max(groups, default=-1) + 1):
        mine = [each for each, group in zip(found, groups, strict=True) if group == index]
        secants, stds = np.array([each[1] for each in mine]), np.array([each[2] for each in mine])
        spread = float(np.hypot(np.min(stds), np.std(secants)))
        secant = judged(float(np.mean(secants)), spread, method="force over flange travel, touch to hold")
        surfaces.append(
            EnvironmentEstimate(
                name=f"{axis.name}{index + 1}",
                stiffness_n_per_m=unidentifiable(note="in series with a coupling that is not told"),
                secant_stiffness_n_per_m=weak_at_best(secant, "the coupling is not told"),
                damping_n_s_per_m=unidentifiable(note=_UNKNOWN),
                mass_kg=unidentifiable(note=_UNKNOWN),
                contacts=len(mine),
                peak_force_n=tuple(each[3] for each in mine),
            )
        )
    return tuple(surfaces)


def _secant(axis: AxisMotion, hold: Span, period_s: float) -> tuple[float, float, float] | None:
    """Return secant, deviation and peak of one contact; None where its beginning does not show."""
    sign = -1.0 if float(np.median(axis.force_n[hold.slice])) > 0.0 else 1.0
    before = max(0, hold.start - round(_FURTHEST_BEFORE_S / period_s))
    window = slice(before, hold.stop)
    pressing, place = -sign * axis.force_n[window], sign * axis.position_m[window]
    if not bool(np.all(np.isfinite(pressing))) or hold.start == before:
        return None
    smooth, rest = low_pass(pressing, period_s, _BAND_HZ), slice(hold.start - before, None)
    held, noise = float(np.mean(pressing[rest])), float(np.std(pressing[rest]))
    touches = np.flatnonzero(smooth[: hold.start - before + 1] >= 0.5 * held)
    approach, clear = round(_APPROACH_S / period_s), round(_CLEAR_S / period_s)
    if not touches.size:
        return None
    pauses = np.flatnonzero(np.diff(touches) > _LONGEST_BOUNCE_S / period_s)
    half = int(touches[pauses[-1] + 1] if pauses.size else touches[0])
    if half < approach + clear:
        return None
    moving = pressing[half - approach - clear : half - clear]
    drag, shake = float(np.median(moving)), float(np.std(moving))
    quiet = np.flatnonzero(pressing[: half + 1] < drag + _NOISES * shake)
    touch = int(quiet[-1]) if quiet.size else half
    travel = float(np.mean(place[rest])) - float(place[touch])
    if travel < _SMALLEST_TRAVEL_M or drag > _LARGEST_DRAG_SHARE * held:
        return None
    secant = held / travel
    # At the touch the payload lags by what the drag squeezes the coupling, and the touch is told to a few samples.
    speed = abs(float(place[touch]) - float(place[touch - clear])) / clear
    doubts = (noise / held, 0.5 * abs(drag) / held, _SAMPLES * speed / travel, _MODEL_SHARE)
    return secant, secant * float(np.linalg.norm(doubts)), float(np.max(pressing[touch:]))
