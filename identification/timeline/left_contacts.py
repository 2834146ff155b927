"""Stiffness of the surfaces of contacts that no fit used, from the slope of force over depth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.frozen import freeze

from ..result import CONTACT_UNEXPLAINED, EnvironmentEstimate, Estimate, Finding, LogPhase, Status
from ..signals.contact_rule import CONTACT
from ..verdicts import unidentifiable
from .contacts import ContactTimes, Pressed, lead_samples
from .payload import AxisContacts, PayloadMotion, press_sign

_FEWEST_SAMPLES = 12
_CLEAR_SHARE = 0.9
# What a slope leaves out: dry friction, a payload seen up to two of its resonances, a surface that is no spring.
_LEFT_OUT_SHARE = 0.07
_MOST_SHARE = 0.5
_STDS = 3.0
_SAME_SURFACE = 1.25
_LEAST_SHARE = 0.2
_MOST_LISTED = 10
_BESIDE_S = 0.5
"""Nearer to a hole the way in or out of a contact may be missing."""
_BEGINNING, _END, _HOLE = "the beginning of what is read", "the end of what is read", "a hole of the log"
_METHOD = "slope of the contact force over the payload's way, of contacts that the fit did not use"
_ADVICE = (
    "Press there again at 1 to 3 cm/s with 20 to 50 N, hold for 1 s, hands off; or give optimize a range that holds "
    "its stiffness (--environment-stiffness, or problem.yaml)."
)


@dataclass(frozen=True, kw_only=True)
class ContactSlope:
    """K_e of what is touched lies between `low_n_per_m` and `high_n_per_m`; `sign` is that of the direction."""

    sign: int
    low_n_per_m: float
    high_n_per_m: float

    @property
    def stiffness_n_per_m(self) -> float:
        """Return the middle of both ends."""
        return 0.5 * (self.low_n_per_m + self.high_n_per_m)


def learn_slope(
    of: AxisContacts, payload: PayloadMotion, contact: ContactTimes, coupling: Estimate
) -> ContactSlope | None:
    """Return the slope of F_e = K_e (x_p − x_w) over the samples in which a contact touches, None if it is not clear.

    The lower end is the slope of force over way, the upper end the inverse of that of way over force (errors in either
    of them), both wider by three deviations of what K_s, `coupling` [N/m], and the model leave open, with
    dK_e = K_e² d(1/K_s). Clear: nine tenths of the variance, no softer than a surface may be, and open by half at most;
    and the log shows the onset, since on the way out alone damping makes a surface seem stiffer.
    """
    if contact.onset is None:
        return None
    sign = int(press_sign(of, contact.hold))
    force, way = sign * payload.touch_n[contact.span.slice], sign * payload.position_m[contact.span.slice]
    known = np.isfinite(force) & np.isfinite(way)
    highest = float(np.max(force, initial=0.0, where=known))
    touches = known & (force > CONTACT.touch_threshold_n(highest))
    if np.count_nonzero(touches) < _FEWEST_SAMPLES or coupling.value is None or coupling.std is None:
        return None
    spread = np.cov(way[touches], force[touches])
    if not (spread[0, 0] > 0.0 and spread[0, 1] > 0.0):
        return None
    low, high = float(spread[0, 1] / spread[0, 0]), float(spread[1, 1] / spread[0, 1])
    left_open = _STDS * float(np.hypot(_LEFT_OUT_SHARE, high * coupling.std / coupling.value**2))
    if low < _CLEAR_SHARE * high or low < of.softest_n_per_m or left_open > _MOST_SHARE:
        return None
    return ContactSlope(sign=sign, low_n_per_m=low * (1.0 - left_open), high_n_per_m=high * (1.0 + left_open))


@dataclass(frozen=True, kw_only=True)
class ObservedAxis:
    """An axis with its contacts, and what the fit says: K_s, and each surface with the sign of its direction.

    On a turning axis `of` and `payload` are on the path with the lever `lever_m`, estimates in N·m/rad.
    """

    of: AxisContacts
    payload: PayloadMotion
    pressed: Pressed
    coupling: Estimate
    surfaces: tuple[tuple[int, EnvironmentEstimate], ...] = ()
    lever_m: float = 1.0

    @property
    def name(self) -> str:
        """Return what the axis is called."""
        return self.of.axis.name


@dataclass(frozen=True, kw_only=True)
class Accounted:
    """The time line with every contact's surface, the surfaces that were added by axis, and what is left."""

    phases: tuple[LogPhase, ...]
    surfaces: Mapping[str, tuple[EnvironmentEstimate, ...]]
    findings: tuple[Finding, ...]

    def __post_init__(self) -> None:
        freeze(self, "surfaces")


@dataclass(frozen=True, kw_only=True)
class _Left:
    """A contact that no fit used: its place in the time line or None, and its slope if that is clear.

    `cut_by` names what of the log cuts it where a surface is known on its side, and is empty otherwise.
    """

    phase: int | None
    slope: ContactSlope | None
    cut_by: str
    start_s: float
    peak_n: float


def account_for_contacts(phases: Sequence[LogPhase], axes: Sequence[ObservedAxis], period_s: float) -> Accounted:
    """Give every contact of a time line a surface, or name it in a finding of severity `error`.

    One that the beginning or the end of the log cuts, or a hole in it or within half a second of it, is a warning where
    its side has a fitted surface.

    `phases` name the surfaces of the contacts that a fit used. Of the others, `learn_slope` shows the stiffness: that
    of a fitted surface where it lies within 3 deviations or 20 % of that, else a new surface, which is `weak`. Rests
    under force, and presses in motion, that are not in the time line as contacts are asked the same; of them, what
    gives more than a surface or does work is a hand.
    """
    changed, surfaces, findings = list(phases), dict[str, tuple[EnvironmentEstimate, ...]](), list[Finding]()
    for axis in axes:
        left = _left_of(axis, changed, period_s)
        clear = [(each, each.slope) for each in left if each.slope is not None]
        new = _Surfaces(axis=axis, groups=_grouped([slope for _, slope in clear if _fitted(axis, slope) is None]))
        for each, slope in clear:
            phase = None if each.phase is None else changed[each.phase]
            if each.phase is not None and phase is not None and phase.contact is not None:
                named = _fitted(axis, slope) or new.name(slope)
                changed[each.phase] = replace(phase, contact=replace(phase.contact, surface=named))
        surfaces[axis.name] = tuple(
            new.estimate(
                name, [each for each, slope in clear if _fitted(axis, slope) is None and new.name(slope) == name]
            )
            for name in new.names
        )
        findings += [_added(axis, surface) for surface in surfaces[axis.name]]
        unexplained = [each for each in left if each.slope is None and not each.cut_by]
        findings += [_unexplained(axis, unexplained)] if unexplained else []
        for cut_by in (_BEGINNING, _END, _HOLE):
            cut = [each for each in left if each.slope is None and each.cut_by == cut_by]
            findings += [_cut(axis, cut, cut_by)] if cut else []
    return Accounted(phases=tuple(changed), surfaces=surfaces, findings=tuple(findings))


def _left_of(axis: ObservedAxis, phases: Sequence[LogPhase], period_s: float) -> list[_Left]:
    """Return the contacts of an axis that have no surface yet, without those that are a hand's."""
    places = {
        round(phase.start_s / period_s): (i, phase.contact.surface)
        for i, phase in enumerate(phases)
        if phase.contact is not None and phase.axis == axis.name
    }

    def seen(contact: ContactTimes, phase: int | None) -> _Left:
        force = axis.of.axis.force_n[contact.span.slice]
        return _Left(
            phase=phase,
            slope=learn_slope(axis.of, axis.payload, contact, _on_path(axis)),
            cut_by=_cut_by(axis, contact, period_s),
            start_s=contact.span.start * period_s,
            peak_n=axis.lever_m * float(np.nanmax(np.abs(force))),
        )

    left = []
    for contact in axis.pressed.contacts:
        phase, surface = places.get(contact.span.start, (None, None))
        if surface is None:
            left.append(seen(contact, phase))
    left += [seen(contact, None) for contact in axis.pressed.unclear]
    # What looks like a hand is one, unless its force grows with depth as on a surface.
    perhaps = [seen(contact, None) for contact in (*axis.pressed.by_hand, *axis.pressed.restless)]
    return [*left, *(each for each in perhaps if each.slope is not None)]


def _cut_by(axis: ObservedAxis, contact: ContactTimes, period_s: float) -> str:
    """Return what cuts a contact on a side that has a fitted surface: an end of the log, or a hole in or beside it."""
    sign = int(press_sign(axis.of, contact.hold))
    if not any(side == sign and surface.stiffness_n_per_m.value is not None for side, surface in axis.surfaces):
        return ""
    force, span = axis.of.axis.force_n, contact.span
    if contact.onset is None and span.start <= lead_samples(period_s):
        return _BEGINNING
    if contact.release is None and span.stop >= len(force) - lead_samples(period_s):
        return _END
    beside = round(_BESIDE_S / period_s)
    return _HOLE if np.any(np.isnan(force[max(0, span.start - beside) : span.stop + beside])) else ""


def _on_path(axis: ObservedAxis) -> Estimate:
    """Return K_s in N/m of the path on which the axis is seen."""
    known, square = axis.coupling, axis.lever_m**2
    if known.value is None or known.std is None:
        return known
    return replace(known, value=known.value / square, std=known.std / square)


def _fitted(axis: ObservedAxis, slope: ContactSlope) -> str | None:
    """Return the name of the fitted surface that a slope is of."""
    stiffness = axis.lever_m**2 * slope.stiffness_n_per_m
    for sign, surface in axis.surfaces:
        known = surface.stiffness_n_per_m
        if sign != slope.sign or known.value is None:
            continue
        if abs(stiffness - known.value) <= max(_STDS * (known.std or 0.0), _LEAST_SHARE * known.value):
            return surface.name
    return None


def _grouped(gradients: Sequence[ContactSlope]) -> tuple[tuple[ContactSlope, ...], ...]:
    """Return the slopes by surface: of one side, and none above 1.25 times the softest."""
    groups: list[list[ContactSlope]] = []
    for slope in sorted(gradients, key=lambda s: (s.sign, s.stiffness_n_per_m)):
        first = groups[-1][0] if groups else None
        is_same_side = first is not None and first.sign == slope.sign
        if is_same_side and slope.stiffness_n_per_m <= _SAME_SURFACE * groups[-1][0].stiffness_n_per_m:
            groups[-1].append(slope)
        else:
            groups.append([slope])
    return tuple(tuple(group) for group in groups)


@dataclass(frozen=True, kw_only=True)
class _Surfaces:
    """The new surfaces of an axis, named after the fitted ones."""

    axis: ObservedAxis
    groups: tuple[tuple[ContactSlope, ...], ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Return their names in the order of the groups."""
        return tuple(f"{self.axis.name}{len(self.axis.surfaces) + i + 1}" for i in range(len(self.groups)))

    def name(self, slope: ContactSlope) -> str:
        """Return the name of the surface that a slope is of."""
        return next(name for name, group in zip(self.names, self.groups, strict=True) if slope in group)

    def estimate(self, name: str, contacts: Sequence[_Left]) -> EnvironmentEstimate:
        """Return what the contacts show of their surface: K_e over all that their slopes leave open."""
        group, square = self.groups[self.names.index(name)], self.axis.lever_m**2
        low, high = (
            square * min(slope.low_n_per_m for slope in group),
            square * max(slope.high_n_per_m for slope in group),
        )
        stiffness, coupling = 0.5 * (low + high), self.axis.coupling.value or np.inf
        note = "no hold that the fit could use"
        nothing = unidentifiable(method=_METHOD, note=note)

        def weak(value: float, ends: tuple[float, float]) -> Estimate:
            std = (ends[1] - ends[0]) / (2.0 * _STDS)
            return Estimate(value=value, std=std, status=Status.WEAK, method=_METHOD, note=note, ci95=ends)

        def in_series(value: float) -> float:
            return value / (1.0 + value / coupling)

        return EnvironmentEstimate(
            name=name,
            stiffness_n_per_m=weak(stiffness, (low, high)),
            secant_stiffness_n_per_m=weak(in_series(stiffness), (in_series(low), in_series(high))),
            damping_n_s_per_m=nothing,
            mass_kg=nothing,
            contacts=len(contacts),
            peak_force_n=tuple(each.peak_n for each in contacts),
        )


def _added(axis: ObservedAxis, surface: EnvironmentEstimate) -> Finding:
    ends, unit = surface.stiffness_n_per_m.ci95 or (0.0, 0.0), "N/m" if axis.lever_m == 1.0 else "N·m/rad"
    force = "N" if axis.lever_m == 1.0 else "N·m"
    times = "1 contact" if surface.contacts == 1 else f"{surface.contacts} contacts"
    return Finding(
        code="contact-without-fit",
        severity="warning",
        message=f"Axis {axis.name}: {times} of up to {max(surface.peak_force_n):.1f} {force} could not be fitted; the "
        f"slope of force over depth gives surface {surface.name} a stiffness of {ends[0]:.3g} to {ends[1]:.3g} {unit}.",
        advice="Press there again at 1 to 3 cm/s with 20 to 50 N and hold for 1 s, with a controller that does not "
        "bounce there.",
        axis=axis.name,
    )


def _listed(axis: ObservedAxis, left: Sequence[_Left]) -> str:
    unit = "N" if axis.lever_m == 1.0 else "N·m"
    shown = ", ".join(f"{each.start_s:.1f} s ({each.peak_n:.1f} {unit})" for each in left[:_MOST_LISTED])
    return f"{shown} and {len(left) - _MOST_LISTED} more" if len(left) > _MOST_LISTED else shown


def _cut(axis: ObservedAxis, left: Sequence[_Left], cut_by: str) -> Finding:
    return Finding(
        code="contact-cut",
        severity="warning",
        message=f"Axis {axis.name}: what was touched at {_listed(axis, left)} is not used: {cut_by} cuts it, "
        "and which surface it was is not known.",
        advice="Press there again if it is none of the surfaces of this axis.",
        axis=axis.name,
    )


def _unexplained(axis: ObservedAxis, left: Sequence[_Left]) -> Finding:
    return Finding(
        code=CONTACT_UNEXPLAINED,
        severity="error",
        message=f"Axis {axis.name}: what was touched at {_listed(axis, left)} is none of the surfaces, and force over "
        "depth does not identify its stiffness.",
        advice=_ADVICE,
        axis=axis.name,
    )
