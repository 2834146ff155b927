"""Fits that precede the joint one: the robot to the pose alone, the coupling to free motion or to ringing."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import scipy

from problems.arrays import FloatArray

from ..errors import EstimateError
from .covariance import widened
from .data import JointData
from .latency import forces_left
from .model import ParameterLayout
from .noise import Smoother, Whitener, fit_smoother, fit_whitener
from .segments import Segment, contact_segment, predict_force
from .solve import Block, Point, Problem, Signals, linearise, minimise, sizes_of
from .start import start_coupling
from .windows import SHORTEST_S, informative_pieces, joined, outside, windows_of
from .yielding_robot import with_yielding_robot

STEPS_FIRST, STEPS_LATER = 8, 4
_LIGHTEST_SHARE = 0.2
_LIGHT_KG = 0.1
_LARGEST_MISFIT, _LARGEST_RING_MISFIT, _LARGEST_WINDOW_MISFIT = 0.4, 0.2, 0.2
_HAND_SHARE = 0.5
_PIECE_STARTS, _ROUNDS = 4, 3
_OUTLYING, _OUTLYING_SHARE, _OUTLYING_END = 8.0, 0.3, 1.3
_POSE_EDGE_S = 0.3
_FREE_EDGE_S = 0.12
_SETTLING_S = 0.3
_SHAKING = 1.3
_LOADED = 2.0
_RING_STARTS, _AS_WELL = 2, 1.05
_FEWEST_RINGS = 2
_MASS = 3


def _robot_values(data: JointData) -> FloatArray:
    """Return ω, (ζ,) T_d, or nothing without a robot."""
    if data.robot is None or data.command is None:
        return np.empty(0)
    denominator, delay = data.robot.denominator, data.robot.delay_s + data.command.shift_s
    if data.robot.order == 1:
        return np.array([denominator[1], delay])
    omega = float(np.sqrt(denominator[2]))
    return np.array([omega, 0.5 * float(denominator[1]) / omega, delay])


def fit_robot(data: JointData) -> tuple[Problem, FloatArray]:
    """Fit the robot to the pose alone, before what the pose shows beside it can be separated from a wrong robot.

    Returns the problem with the noise of force and pose, and start values of all parameters, one surface included.
    """
    start = np.concatenate([data.coupling, _robot_values(data), np.zeros(3)])
    lightest = _LIGHTEST_SHARE * (data.mass_kg if data.mass_kg is not None else _LIGHT_KG)
    start[3] = max(start[3], lightest)
    layout, rests = ParameterLayout(robot_order=data.robot_order, surfaces=0), quiet_rests(data)
    if not rests:
        raise EstimateError(
            "The noise is measured at rest without contact, found no such span; keep the robot at rest for 1 s."
        )
    signals = Signals(
        period_s=data.period_s,
        position_m=data.position_m,
        force_n=data.force_n,
        command_m=None if data.command is None or data.robot is None else data.command.command_m,
        smoother=Smoother(taps=None),
        measured=data.measured,
        is_smooth=data.is_smooth,
        untimed_share=1.0 if data.command is None else data.command.untimed_share,
    )
    rest_noise = fit_whitener([detrended(data.force_n[s]) for s in rests])
    if rest_noise.rms < data.least_noise_n:
        rest_noise = Whitener(coefficients=np.ones(1), rms=data.least_noise_n)
    problem = Problem(
        signals=signals,
        layout=layout,
        segments=(),
        pose_spans=_pose_spans(data) if layout.robot_order else (),
        free_noise=rest_noise,
        contact_noise=rest_noise,
        pose_noise=fit_whitener([detrended(data.position_m[signals.at_poses(s)]) for s in rests]),
        fixed=(0, 1, 2, 3),
        lightest_kg=lightest,
        heaviest_kg=np.inf if data.mass_kg is None else data.mass_kg / _LIGHTEST_SHARE,
    )
    point = Point(values=start[: len(layout)], nuisances=())
    if layout.robot_order:
        point, _ = minimise(problem, point, STEPS_FIRST)
        if not signals.is_smooth:
            problem, point = with_yielding_robot(problem, point)
        signals = problem.signals
    misfit = problem.path(point.values).misfit
    moving, resting = [misfit(s.slice) for s in data.moving], [misfit(s) for s in rests]
    smoother = fit_smoother(moving, resting, data.period_s)
    problem = replace(problem, signals=replace(signals, smoother=smoother), fixed=())
    if smoother.taps is not None:
        noise = _noise_of_both(problem, point, rests)
        problem = replace(problem, free_noise=noise, contact_noise=noise)
    return problem, np.concatenate([point.values, start[len(layout) :]])


def _noise_of_both(problem: Problem, point: Point, rests: Sequence[slice]) -> Whitener:
    """Return the noise of the force with what that of the pose makes of it through the coupling, both as at rest."""
    both = fit_whitener(left_at_rest(problem, point, rests))
    return both if both.rms > problem.free_noise.rms else problem.free_noise


def left_at_rest(problem: Problem, point: Point, rests: Sequence[slice]) -> list[FloatArray]:
    """Return what the fit leaves of the force [N] in rests: its noise, and what the coupling makes of the pose's."""
    path, left = problem.path(point.values), []
    for rest in rests:
        segment = Segment(start=rest.start, stop=rest.stop)
        felt = predict_force(point.values, np.zeros(3), segment, path, problem.layout, problem.signals.period_s)
        left.append(detrended(problem.signals.force_n[rest] - felt))
    return left


def robot_of_pose(data: JointData, base: Problem, robot: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return ω, (ζ,) T_d (p,) of command and pose alone and their covariance (p, p) [SI]; `base` is `fit_robot`'s.

    The covariance holds what one deviation of how far the robot gives way moves.
    """
    values = np.concatenate([data.coupling, robot])
    problem = replace(base, fixed=(0, 1, 2, 3))
    problem = with_fitted_noise(problem, Point(values=values, nuisances=()))
    point, _ = minimise(problem, Point(values=values, nuisances=()), STEPS_LATER)
    mine, period, signals = problem.layout.robot, problem.signals.period_s, problem.signals
    blocks = [replace(block, indices=block.indices - mine.start) for block in linearise(problem, point)]
    sizes = sizes_of(point.values, problem.layout, period)[mine]
    found = point.values[mine].copy()
    covariance = widened(blocks, len(sizes), period).covariance * np.outer(sizes, sizes)
    for std in signals.yielded_stds:
        further = replace(signals, yielded=std if signals.yielded is None else signals.yielded + std)
        other, _ = minimise(replace(problem, signals=further), point, STEPS_LATER)
        covariance = covariance + np.outer(other.values[mine] - found, other.values[mine] - found)
    # A delay of 0 falls below it by rounding.
    found[-1] = max(found[-1] - (0.0 if data.command is None else data.command.shift_s), 0.0)
    return found, covariance


def quiet_rests(data: JointData) -> list[slice]:
    """Return the rests without their first part, in which the cell still settles, and without those that shake."""
    settling = round(_SETTLING_S / data.period_s)
    if not data.rests:
        return []
    inner = [slice(s.start + min(settling, len(s) // 2), s.stop) for s in data.rests]
    spread = np.array([[np.std(detrended(v[s])) for v in (data.force_n, data.position_m)] for s in inner])
    usual = np.median(spread, axis=0)
    return [s for s, seen in zip(inner, spread, strict=True) if np.all(seen <= _SHAKING * usual)]


def detrended(values: FloatArray) -> FloatArray:
    """Return values (n,) without their straight line."""
    return np.asarray(scipy.signal.detrend(values))


def centred(values: FloatArray) -> FloatArray:
    """Return values (n,) without their mean."""
    return np.asarray(values - np.mean(values))


def _pose_spans(data: JointData) -> tuple[slice, ...]:
    edge, count = round(_POSE_EDGE_S / data.period_s), len(data.position_m)
    return tuple(slice(max(0, s.start - edge), min(count, s.stop + edge)) for s in data.moving)


def fit_free_motion(data: JointData, base: Problem, values: FloatArray) -> tuple[Problem, Point]:
    """Fit the most informative spans alone, let the best one choose its like, and fit those together.

    A motion without a hand and without a contact is one span. Any other is cut into windows, of which those are used
    that the payload explains; so is one that the fit explains in part only.
    """
    whole, mixed = _candidates(data, base, values)
    rings = [Segment(start=s.start, stop=s.stop) for s in data.rings]
    best = _start(data, base, values, whole, mixed)
    used = _explained(base, best, whole, rings)
    informative = _strongest(data, whole)[:1]
    if len(used) < len(whole) + len(rings) and informative:
        span = informative[0]
        # A sweep that ends below the resonance leaves K_s open: what rings shows it, with the mass that motion known.
        for ring in _strongest(data, rings)[:_RING_STARTS]:
            start = start_coupling(base, best, ring, float(best[3]))[0]
            more = _explained(base, start, whole, rings)
            # What has been explained stays so: a few moves to and fro are also explained by a spring that is none.
            keeps = len(more) > len(used) and all(each in more for each in used)
            if keeps and _misfit(base, start, span) < _AS_WELL * _misfit(base, best, span):
                best, used = start, more
    used += _clean(data, base, best, [*mixed, *(s for s in whole if s not in used)], used)
    if not used:
        raise EstimateError(
            f"Of {len(data.free) + len(data.mixed)} spans of motion, none holds {SHORTEST_S:g} s that one payload on "
            "one spring explains; record a commanded sweep of 0.5 to 50 Hz in free space without a hand on it."
        )
    for _ in range(_ROUNDS):
        problem = replace(base, segments=used, signals=_smoothed_for(data, base, best, used))
        point, _ = minimise(problem, Point(values=best, nuisances=tuple(np.zeros(3) for _ in used)), STEPS_FIRST)
        kept = _uniform(data, problem, point)
        if kept in (used, ()):
            break
        used = kept
    problem = with_fitted_noise(problem, point)
    point, _ = minimise(problem, point, STEPS_LATER)
    return problem, point


def _uniform(data: JointData, problem: Problem, point: Point) -> tuple[Segment, ...]:
    """Return what is left of the spans without windows that a contact reaches into, or that stand out.

    Those leave 8 times the usual of the noise, and three tenths of their force or more: somebody touched the payload
    there. What friction or a part that swings leaves is less, and is looked at beside the fit (`extension.py`).
    Where a span was cut out of a motion, its first and last window are left out for less.
    """
    contacts, edge = _contacts(data, problem, point.values), round(_FREE_EDGE_S / data.period_s)
    at_rest = {t for span in (*data.free, *data.mixed) for t in (span.start - edge, span.stop + edge)}
    blocks = linearise(problem, point)[: len(problem.segments)]
    parts = [windows_of([segment], data.period_s) for segment in problem.segments]
    left = [_left(problem, *each) for each in zip(problem.segments, blocks, parts, strict=True)]
    usual = max(float(np.median(np.concatenate(left)[:, 0])), 1.0)
    used: list[Segment] = []
    for segment, windows, shown in zip(problem.segments, parts, left, strict=True):
        is_out = (shown[:, 0] > _OUTLYING * usual) & (shown[:, 0] > _OUTLYING_SHARE**2 * shown[:, 1])
        for end, tick in ((0, segment.start), (-1, segment.stop)):
            is_out[end] |= tick not in at_rest and shown[end, 0] > _OUTLYING_END * usual
        clean = [w for w, out in zip(windows, is_out, strict=True) if not out and outside(w, contacts)]
        used += [segment] if len(clean) == len(windows) else joined(clean, data.period_s)
    return tuple(used)


def _left(problem: Problem, segment: Segment, block: Block, windows: Sequence[Segment]) -> FloatArray:
    """Return the mean squares of the whitened residual and of the whitened force of each window of a span, (m, 2).

    Without what goes with the force or its rate: a wrench that is late or filtered leaves that, and nobody's hand.
    """
    noise = problem.noise(segment)
    white = noise.apply(centred(problem.signals.force_n[segment.slice]))
    edges = [max(w.start - segment.start - noise.order, 0) for w in windows] + [len(white)]
    shown = []
    for first, last in pairwise(edges):
        if last <= first:  # a window without a past of its own shows nothing
            shown.append((0.0, 0.0))
            continue
        residual, own = block.residual[first:last], np.column_stack([white, np.gradient(white)])[first:last]
        shares = np.linalg.lstsq(own, residual, rcond=None)[0]
        # Half of the force is no lag any more: it is a hand's.
        left = residual - own @ shares if abs(shares[0]) < _HAND_SHARE else residual
        shown.append((float(np.mean(left**2)), float(np.mean(own[:, 0] ** 2))))
    return np.array(shown)


def _contacts(data: JointData, problem: Problem, values: FloatArray) -> list[Segment]:
    """Return the spans from before a first touch into a hold, as these parameters show them."""
    path = problem.path(values)
    cuts = [contact_segment(hold, path, data.force_n, values[:4], data.period_s) for hold in data.holds]
    return [found[0] for found in cuts if found is not None]


def _candidates(data: JointData, base: Problem, values: FloatArray) -> tuple[list[Segment], list[Segment]]:
    """Return the motions without a hand or a contact, and those with one, that last a second or more."""
    edge, contacts = round(_FREE_EDGE_S / data.period_s), _contacts(data, base, values)
    whole: list[Segment] = []
    mixed: list[Segment] = []
    for span in (*data.free, *data.mixed):
        segment = Segment(start=max(0, span.start - edge), stop=min(len(data.force_n), span.stop + edge))
        if len(segment) * data.period_s >= SHORTEST_S:
            is_whole = span in data.free and outside(segment, contacts)
            (whole if is_whole else mixed).append(segment)
    return whole, mixed


def _start(
    data: JointData, base: Problem, values: FloatArray, whole: Sequence[Segment], mixed: Sequence[Segment]
) -> FloatArray:
    """Return shared parameters that explain the span with most force, or else most of the windows of the others."""
    by_force = _strongest(data, whole)
    explained = [s for s in by_force if _misfit(base, values, s) < _LARGEST_MISFIT]
    pieces = informative_pieces([*whole, *mixed], data.position_m, data.force_n, data.period_s)[:_PIECE_STARTS]
    informative = [s for s in whole if pieces and s.start <= pieces[0].start < s.stop]
    best, least = values, np.inf
    for span in dict.fromkeys(by_force[:1] + explained[:1] + informative):
        start = start_coupling(base, values, span, data.mass_kg)[0]
        left = _misfit(base, start, span)
        if left < least:
            best, least = start, left
    if least < _LARGEST_MISFIT and (not pieces or informative):
        return best
    # Moves to and fro show drag and hardly a spring: a motion with a hand or a contact in it may show more.
    values = best if least < _LARGEST_MISFIT else values
    windows = [w for w in windows_of([*whole, *mixed], data.period_s) if _is_loaded(base, w)]

    def shown_by(start: FloatArray) -> list[Segment]:
        return [window for window in windows if _misfit(base, start, window) < _LARGEST_WINDOW_MISFIT]

    # What the frequency domain shows up to where the log resolves the motion may explain more than any piece does.
    best, shown = values, shown_by(values)
    holding = max(whole, key=lambda span: sum(not outside(window, [span]) for window in shown), default=None)
    most = len(shown)
    for piece in [*([] if holding is None or not shown else [holding]), *pieces]:
        start = start_coupling(base, values, piece, data.mass_kg)[0]
        count = len(shown_by(start))
        if count > most:
            best, most = start, count
    return best


def _is_loaded(problem: Problem, window: Segment) -> bool:
    """Return whether there is more force in a window than noise: any payload explains what is none."""
    force = problem.noise(window).apply(centred(problem.signals.force_n[window.slice]))
    return float(force @ force) > _LOADED * len(force)


def _clean(
    data: JointData, problem: Problem, values: FloatArray, spans: Sequence[Segment], used: Sequence[Segment]
) -> tuple[Segment, ...]:
    """Return what the payload explains of spans, a second or more at a time, beside what is used."""
    windows = sorted(windows_of(spans, data.period_s), key=lambda s: s.start)
    clean = [w for w in windows if outside(w, used) and _misfit(problem, values, w) < _LARGEST_WINDOW_MISFIT]
    return tuple(joined(clean, data.period_s))


def fit_ringing(data: JointData, base: Problem, values: FloatArray) -> tuple[Problem, Point]:
    """Fit what taps and releases alone show, with the mass that gravity shows.

    A payload that swings on a flange at rest shows K_s/M_p and the dampings over M_p, and nothing of M_p itself.
    """
    if data.weighed is None:
        raise EstimateError("The payload's mass is not known.")
    weighed = replace(base, priors=(*base.priors, (_MASS, *data.weighed)))
    rings = [Segment(start=s.start, stop=s.stop) for s in data.rings]
    used: tuple[Segment, ...] = ()
    best = values
    # A strong tap may end its search in another valley; the values that explain most rings count.
    for ring in _strongest(data, rings):
        start = start_coupling(weighed, values, ring, data.weighed[0])[0]
        # On a flange at rest both dampings look alike; how they share is left as it was, for contacts to decide.
        together = start[1] + start[2]
        start[2] = min(values[2], together)
        start[1] = together - start[2]
        more = _explained(base, start, (), rings)
        if len(more) > len(used):
            used, best = more, start
        if len(used) == len(rings):
            break
    if len(used) < _FEWEST_RINGS:
        raise EstimateError("No two spans of ringing are explained by one payload on one spring.")
    weighed = replace(weighed, segments=used, signals=_smoothed_for(data, base, best, used))
    point, _ = minimise(weighed, Point(values=best, nuisances=tuple(np.zeros(3) for _ in used)), STEPS_FIRST)
    return weighed, point


def _strongest(data: JointData, segments: Sequence[Segment]) -> list[Segment]:
    return sorted(segments, key=lambda s: -float(np.sum(centred(data.force_n[s.slice]) ** 2)))


def _explained(
    problem: Problem, values: FloatArray, candidates: Sequence[Segment], rings: Sequence[Segment]
) -> tuple[Segment, ...]:
    """Return the spans that these values explain; a ring, which drag alone may look like, must be explained better."""
    return (
        *(s for s in candidates if _misfit(problem, values, s) < _LARGEST_MISFIT),
        *(s for s in rings if _misfit(problem, values, s) < _LARGEST_RING_MISFIT),
    )


def _smoothed_for(data: JointData, problem: Problem, values: FloatArray, used: Sequence[Segment]) -> Signals:
    """Return the signals with a filter made for the motion in these spans."""
    misfit = problem.path(values).misfit
    resting = [misfit(s) for s in quiet_rests(data)]
    return replace(problem.signals, smoother=fit_smoother([misfit(s.slice) for s in used], resting, data.period_s))


def _misfit(problem: Problem, values: FloatArray, segment: Segment) -> float:
    """Return residual over force of a span whose own parameters are fitted, as energies within the noise's weights."""
    alone = replace(problem, segments=(segment,), pose_spans=(), known_path=problem.path(values))
    block = linearise(alone, Point(values=values, nuisances=(np.zeros(segment.nuisance_count),)))[0]
    force = problem.noise(segment).apply(centred(problem.signals.force_n[segment.slice]))
    excess = max(float(block.residual @ block.residual) - len(force), 0.0)
    return float(np.sqrt(excess / max(float(force @ force), 1e-300)))


def with_fitted_noise(problem: Problem, point: Point) -> Problem:
    """Fit the whiteners to what remains at a point."""
    signals, path = problem.signals, problem.path(point.values)
    left = forces_left(problem, point)
    poses = [centred(path.misfit(signals.at_poses(span))) for span in problem.pose_spans]
    return replace(
        problem,
        free_noise=fit_whitener(left[False]) if left[False] else problem.free_noise,
        contact_noise=fit_whitener(left[True]) if left[True] else problem.contact_noise,
        pose_noise=fit_whitener(poses) if poses else problem.pose_noise,
    )
