"""Spans that the joint fit uses: contacts cut out of the log, and the force that the model predicts in a span."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from problems.arrays import FloatArray

from ..signals.contact_rule import CONTACT
from ..signals.segments import Span, low_pass
from .force_kernel import ModeArray, run_contact, run_free
from .kernel import Body, returns_at_once
from .model import Array, ParameterLayout, body, payload_step, swing_step
from .path import FlangePath, PathSegment

_NO_SURFACE = np.zeros(3)
OFFSET = 2
FREE = -1
_SLOW_HZ = 20.0
_BEFORE_ONSET_S = 0.25
_HOLD_USED_S = 0.4
_LONGEST_S = 3.0
_LARGEST_MISFIT = 0.35
_LARGEST_STD = 0.3
_STIFFNESSES = np.geomspace(1.5e3, 3.0e6, 24)
_DAMPING_RATIOS = (0.02, 0.3)


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Samples `start` up to `stop`; `surface` is what is touched on the way, `FREE` for nothing.

    `sign` is +1 when pressing towards +axis. Nuisance parameters: the payload's offset and speed against the flange
    at the start, counted in N of the coupling, the force's offset [N], and the wall's place x_w [m] in a contact.
    """

    start: int
    stop: int
    surface: int = FREE
    sign: int = 1

    @property
    def slice(self) -> slice:
        """The samples as an index."""
        return slice(self.start, self.stop)

    @property
    def is_contact(self) -> bool:
        """Whether something is touched."""
        return self.surface != FREE

    @property
    def nuisance_count(self) -> int:
        """Parameters that only this span has."""
        return 4 if self.is_contact else 3

    def __len__(self) -> int:
        return self.stop - self.start


def predict_force(
    values: FloatArray,
    nuisance: FloatArray,
    segment: Segment,
    path: FlangePath,
    layout: ParameterLayout,
    period_s: float,
) -> FloatArray:
    """Return F (n,) of a segment; `values` as `ParameterLayout` orders them, `nuisance` as `Segment` does.

    F = K_s (x_p − x) + B_s (v_p − v) + offset, with F_e = M_e dv_p/dt + B_e v_p + K_e (x_p − x_w) ≥ 0 in contact.
    """
    cut = path.cut(segment.slice)
    law = segment_model(values, nuisance, segment, path, layout, period_s)
    return np.asarray(segment.sign * run(law, cut, segment).force + nuisance[OFFSET])


class SegmentModel(NamedTuple):
    """What a span's motion follows.

    `phi` (2, 2, 2) and `gamma` (2, 2, m) of free motion and contact, `swing` (2, 2) of a freed environment; `wall` is
    where all is counted from in the direction of pressing, `start` the payload's place and velocity at first.
    """

    phi: FloatArray
    gamma: FloatArray
    swing: FloatArray
    body: Body
    wall: float
    start: tuple[float, float]


def segment_model(
    values: FloatArray,
    nuisance: FloatArray,
    segment: Segment,
    path: FlangePath,
    layout: ParameterLayout,
    period_s: float,
) -> SegmentModel:
    """Return what a span's motion follows, for what `predict_force` takes."""
    of = body(values[:4], surface_of(values, segment, layout), period_s)
    x, v = (segment.sign * float(end) for end in path.cut(segment.slice).ends[0, :2])
    wall = segment.sign * float(nuisance[3]) if segment.is_contact else x
    start = x - wall + float(nuisance[0]) / of[0].real, v + float(nuisance[1]) / of[0].real
    phi, gamma, swing = steps_of(of, path.robot, path.hold.fraction, touches=segment.is_contact)
    return SegmentModel(phi=phi, gamma=gamma, swing=swing, body=of, wall=wall, start=start)


def surface_of(values: FloatArray, segment: Segment, layout: ParameterLayout) -> FloatArray:
    """Return K_e, B_e, M_e of what a segment touches, zeros for nothing."""
    return values[layout.surface(segment.surface)] if segment.is_contact else _NO_SURFACE


def steps_of(of: Body, robot: Array | None, fraction: complex, *, touches: bool) -> tuple[Array, Array, Array]:
    """Return phi, gamma and swing as `SegmentModel` has them; those of a contact are of use only if it `touches`."""
    free = payload_step(of, robot, fraction, touching=False)
    touched = payload_step(of, robot, fraction, touching=True) if touches else free
    swing = swing_step(of, back_at_once=not touches or returns_at_once(plain(of)))
    return np.stack([free[0], touched[0]]), np.stack([free[1], touched[1]]), swing


def plain(of: Body) -> Body:
    """Return the real parts."""
    k_s, b_s, b_p, m_p, k_e, b_e, m_e = (value.real for value in of)
    return Body(k_s, b_s, b_p, m_p, k_e, b_e, m_e)


class Run(NamedTuple):
    """A span's motion: the coupling's force (n,), states (n, 2), or (n, 4) with a wall, and `run_contact`'s modes."""

    force: FloatArray
    states: FloatArray
    modes: ModeArray


def run(law: SegmentModel, cut: PathSegment, segment: Segment) -> Run:
    """Return a span's motion in the direction of pressing."""
    count = len(segment)
    states, modes = np.empty((count, 4 if segment.is_contact else 2)), np.zeros(count, dtype=np.int8)
    of, start, place = plain(law.body), law.start, (float(segment.sign), law.wall)
    if segment.is_contact:
        force = run_contact(law.phi, law.gamma, law.swing, cut.drive, cut.ends, of, place, start, states, modes)
    else:
        force = run_free(law.phi[0], law.gamma[0], cut.drive, cut.ends, of, place, start, states)
    return Run(force, states, modes)


def shared_indices(segment: Segment, layout: ParameterLayout, *, through_robot: bool) -> NDArray[np.intp]:
    """Return which shared parameters a segment's force depends on."""
    robot = np.arange(layout.robot.start, layout.robot.stop if through_robot else layout.robot.start)
    surface = np.arange(*layout.surface(segment.surface).indices(len(layout))) if segment.is_contact else np.empty(0)
    return np.concatenate([np.arange(4), robot, surface]).astype(np.intp)


@dataclass(frozen=True, kw_only=True)
class ContactCandidate:
    """A span from free motion into a hold, where its onset is, and the best of a coarse search for K_e, B_e and x_w.

    `softer` is the same of the next softer stiffness, from where a descent comes to another side of the onset's sample.
    `misfit_share` is the residual's RMS over that of the force in the span; `peak_force_n` the highest pressing force.
    """

    segment: Segment
    onset: int
    surface: FloatArray
    nuisance: FloatArray
    softer: tuple[FloatArray, FloatArray]
    misfit_share: float
    peak_force_n: float


@dataclass(frozen=True, kw_only=True)
class FoundContact:
    """A contact fitted alone, the coupling known: K_e, B_e, M_e, the span's own parameters, and the secant."""

    start: ContactCandidate
    surface: FloatArray
    nuisance: FloatArray
    secant_n_per_m: float
    secant_std_n_per_m: float
    misfit_share: float

    @property
    def is_sound(self) -> bool:
        """Whether it looks like pressing on something elastic: a hand that holds does not."""
        return self.misfit_share < _LARGEST_MISFIT and self.secant_std_n_per_m < _LARGEST_STD * self.secant_n_per_m


def find_holds(still: Sequence[Span], force_n: FloatArray, threshold_n: float) -> tuple[Span, ...]:
    """Return the rests during which the payload presses on something: a force that gravity does not explain."""
    return tuple(span for span in still if abs(float(np.median(force_n[span.slice]))) > threshold_n)


def find_onset(hold: Span, path: FlangePath, force_n: FloatArray, coupling: FloatArray, period_s: float) -> int | None:
    """Return the first touch that leads to the hold, bounces included; None when the force was always there.

    F_e = −F − B_p v − M_p a of the flange, below 20 Hz: good to a few hundredths of a second.
    """
    sign = -1.0 if float(np.median(force_n[hold.slice])) > 0.0 else 1.0
    before = max(0, hold.start - round(CONTACT.furthest_s / period_s))
    window = slice(before, min(hold.stop, hold.start + round(_HOLD_USED_S / period_s)))
    speed = low_pass(sign * path.cut(window).velocity / period_s, period_s, _SLOW_HZ)
    pressing = low_pass(-sign * force_n[window], period_s, _SLOW_HZ)
    touching = pressing - coupling[2] * speed - coupling[3] * np.gradient(speed, period_s)
    at_hold = float(np.median(touching[hold.start - before :]))
    apart = touching < CONTACT.touch_threshold_n(at_hold)
    apart[hold.start - before :] = False
    touches = np.flatnonzero(~apart)
    pauses = np.flatnonzero(np.diff(touches) > CONTACT.longest_bounce_s / period_s)
    first = int(touches[pauses[-1] + 1] if pauses.size else touches[0])
    return before + first if first > CONTACT.smallest_lead_of_fit_s / period_s else None


def contact_segment(
    hold: Span, path: FlangePath, force_n: FloatArray, coupling: FloatArray, period_s: float
) -> tuple[Segment, int] | None:
    """Return the span from a little before the onset into the hold, and the onset; None without an onset."""
    onset = find_onset(hold, path, force_n, coupling, period_s)
    if onset is None:
        return None
    sign = -1 if float(np.median(force_n[hold.slice])) > 0.0 else 1
    stop = min(hold.start + round(_HOLD_USED_S / period_s), hold.stop, onset + round(_LONGEST_S / period_s))
    return Segment(start=max(0, onset - round(_BEFORE_ONSET_S / period_s)), stop=stop, surface=0, sign=sign), onset


def start_contact(
    hold: Span, path: FlangePath, force_n: FloatArray, values: FloatArray, layout: ParameterLayout, period_s: float
) -> ContactCandidate | None:
    """Cut the contact out and search K_e and B_e on a grid; the hold's balance of forces shows x_w for each.

    `values` holds the shared parameters of a `layout` with one surface, which is overwritten. None without an onset.
    """
    cut = contact_segment(hold, path, force_n, values[:4], period_s)
    if cut is None:
        return None
    segment, onset = cut
    sign, stop = segment.sign, segment.stop
    measured = force_n[segment.slice]
    settled = slice(max(hold.start, stop - round(0.2 / period_s)), stop)
    held_force = float(np.mean(force_n[settled]))
    at_hold = float(np.mean(path.cut(settled).position)) + held_force / values[0]
    entering = float(np.mean(measured[: max(5, round(0.02 / period_s))]))

    def nuisance_of(stiffness: float) -> FloatArray:
        return np.array([sign * entering, 0.0, 0.0, at_hold + held_force / stiffness])

    best: tuple[float, FloatArray] | None = None
    for stiffness in _STIFFNESSES:
        for ratio in _DAMPING_RATIOS:
            surface = np.array([stiffness, 2.0 * ratio * np.sqrt(stiffness * values[3]), 0.0])
            values[layout.surface(0)] = surface
            error = predict_force(values, nuisance_of(stiffness), segment, path, layout, period_s) - measured
            cost = float(error @ error)
            if np.isfinite(cost) and (best is None or cost < best[0]):
                best = cost, surface
    if best is None:
        return None
    softer = best[1] * np.array([_STIFFNESSES[0] / _STIFFNESSES[1], 1.0, 1.0])
    pressed = -sign * force_n[onset - round(0.02 / period_s) : hold.stop]
    return ContactCandidate(
        segment=segment,
        onset=onset,
        surface=best[1],
        nuisance=nuisance_of(best[1][0]),
        softer=(softer, nuisance_of(softer[0])),
        misfit_share=float(np.sqrt(best[0] / max(float(measured @ measured), 1e-300))),
        peak_force_n=float(np.max(pressed)),
    )


def group_contacts(starts: Sequence[tuple[int, float, float]], ratio: float) -> list[int]:
    """Return the surface of each contact, softest first on each side; `starts` are sign, secant [N/m] and its std.

    Contacts are of one surface when their secants lie within `ratio` of the softest one, or within 4 deviations.
    """
    order = sorted(range(len(starts)), key=lambda i: starts[i][:2])
    out, surface = [0] * len(starts), -1
    first: tuple[int, float, float] | None = None
    for i in order:
        sign, secant, std = starts[i]
        if (
            first is None
            or first[0] != sign
            or secant > max(ratio * first[1], first[1] + 4.0 * np.hypot(std, first[2]))
        ):
            first, surface = starts[i], surface + 1
        out[i] = surface
    return out
