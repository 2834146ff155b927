"""Joint maximum-likelihood fit of all parameters of one axis to the raw force and pose."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.signal import detrend

from problems.arrays import FloatArray
from problems.progress import ProgressSlice

from ..errors import EstimateError
from .covariance import deepest_stiffness, deepest_surfaces
from .data import JointData
from .latency import compare_delay_hypotheses, filter_or_delay, fit_filter, fit_latency, forces_left
from .model import ParameterLayout
from .noise import Smoother, fit_smoother, fit_whitener
from .result import JointFit, build_joint_fit
from .segments import ContactCandidate, FoundContact, Segment, contact_segment, group_contacts, start_contact
from .solve import Point, Problem, Signals, linearise, minimise
from .start import fit_alone, start_coupling, start_surface

_ROUNDS = 2
_STEPS_FIRST, _STEPS_LATER = 8, 4
_SHORTEST_FREE_S = 1.0
_LARGEST_MISFIT, _LARGEST_RING_MISFIT = 0.4, 0.2
_SAME_SECANT = 1.12
_POSE_EDGE_S = 0.3
_FREE_EDGE_S = 0.12
_SETTLING_S = 0.3
_SHAKING = 1.3
_LIGHTEST_SHARE = 0.2
_LIGHT_KG = 0.1
_LEAST_EXPLAINED = 0.8
_AT_LIMIT = 0.2
_RING_STARTS, _AS_WELL = 2, 1.05
_FEWEST_RINGS = 2
_MASS = 3
_OUTLYING, _ENOUGH_TO_TELL = 8.0, 3
# Shares of the time, as measured: free motion, each contact alone, all of them together, the last rounds.
_BEGUN, _TOUCHED, _JOINED, _ROUNDED = 0.4, 0.55, 0.72, 0.8


def identify_joint(data: JointData, progress: ProgressSlice | None = None) -> JointFit:
    """Fit force and pose of all usable spans together (MODEL.md, "Continuous blocks", exact under the held command).

    The likelihood is that of the pose given the command times that of the force given both: the flange's path is the
    robot's exact answer to the command plus what Wiener's filter keeps of the rest, and what remains of the force is
    whitened by an autoregression, fitted again after every round. Where free motion does not show the payload, what
    rings after taps and releases may, with the mass that gravity shows (`JointFit.is_weighed`). `progress` is known the
    share of the work that is done. Raises EstimateError when no span can be used.
    """
    progress = progress or ProgressSlice()
    try:
        return _identify(data, _free_motion, progress)
    except EstimateError:
        try:
            return replace(_identify(data, _ringing_alone, progress), is_weighed=True)
        except EstimateError:
            pass
        raise


_Beginning = Callable[[JointData, Problem, FloatArray], tuple[Problem, Point]]


def _identify(data: JointData, begin: _Beginning, progress: ProgressSlice) -> JointFit:
    """Fit everything, beginning with the payload alone."""
    start = np.concatenate([data.coupling, _robot_values(data), np.zeros(3)])
    start[3] = max(start[3], _LIGHTEST_SHARE * (data.mass_kg if data.mass_kg is not None else _LIGHT_KG))
    base, start = _robot_first(data, start)
    problem, point = begin(data, base, start[:-3])
    blurred = data.command is not None and data.command.is_mean
    problem, point, latency = fit_latency(problem, point, data.force_n, data.latency_s, 0.0, blurred=blurred)
    problem, point, latency = filter_or_delay(problem, point, data.force_n, latency, data.shifted_s)
    progress.advance_to(_BEGUN)
    contacts = _starts(data, problem, np.concatenate([point.values, start[-3:]]))
    alone = [fit_alone(problem, point, contact) for contact in contacts]
    progress.advance_to(_TOUCHED)
    problem, point, found = _together(data, problem, point, [c for c in alone if c.is_sound])
    progress.advance_to(_JOINED)
    for _ in range(_ROUNDS):
        problem = _recoloured(problem, point)
        point, _ = minimise(problem, point, _STEPS_LATER)
    if latency.is_filter:
        problem, point, std = fit_filter(problem, point)
        latency = replace(latency, seconds=problem.signals.sensor_dynamics.time_constant_s, std_s=std)
    elif not latency.is_whole:
        again = fit_latency(problem, point, data.force_n, data.latency_s, latency.applied_s, blurred=blurred)
        problem, point, latency = again[0], again[1], replace(again[2], evidence=latency.evidence)
    progress.advance_to(_ROUNDED)
    problem, point = deepest_surfaces(problem, deepest_stiffness(problem, point))
    problem = _recoloured(problem, point)
    point, competing = compare_delay_hypotheses(problem, point)
    _require_mass(problem, float(point.values[3]))
    resting = np.concatenate([_settled(data.force_n[s]) for s in _quiet_rests(data)])
    fit = build_joint_fit(
        problem, point, found, competing, command=data.command, latency=latency, rest_rms_n=float(np.std(resting))
    )
    if not np.all(np.isfinite(fit.covariance)) or fit.diagnostics.fit_share[0] < _LEAST_EXPLAINED:
        explained = 100.0 * max(fit.diagnostics.fit_share[0], 0.0)
        raise EstimateError(
            f"One payload on one spring explains {explained:.0f} % of the force in free motion, "
            f"{100.0 * _LEAST_EXPLAINED:.0f} % are needed; record a commanded sweep of 0.5 to 50 Hz in free space "
            "without a hand on the payload, with the command that the robot receives. If the log has one: a filter in "
            "the sensor or its driver, or a robot that is not one of one or two poles, does this too."
        )
    return fit


def _require_mass(problem: Problem, mass_kg: float) -> None:
    """Raise EstimateError when the mass ran to the limits of its search: then motion does not show it."""
    low, high = (1.0 + _AT_LIMIT) * problem.lightest_kg, problem.heaviest_kg / (1.0 + _AT_LIMIT)
    if not low < mass_kg < high:
        raise EstimateError(
            "The payload's acceleration hardly shows in the force, so motion shows neither its mass nor the coupling; "
            "record a commanded sweep of 0.5 to 50 Hz in free space without a hand on the payload."
        )


def _starts(data: JointData, problem: Problem, values: FloatArray) -> list[ContactCandidate]:
    """Return the contacts, with what a coarse search says of each, for one value of the shared parameters."""
    layout = ParameterLayout(robot_order=problem.layout.robot_order, surfaces=1)
    path = problem.path(values)
    starts = [start_contact(hold, path, data.force_n, values.copy(), layout, data.period_s) for hold in data.holds]
    return [s for s in starts if s is not None]


def _robot_values(data: JointData) -> FloatArray:
    """Return ω, (ζ,) T_d, or nothing without a robot."""
    if data.robot is None or data.command is None:
        return np.empty(0)
    denominator, delay = data.robot.denominator, data.robot.delay_s + data.command.shift_s
    if data.robot.order == 1:
        return np.array([denominator[1], delay])
    omega = float(np.sqrt(denominator[2]))
    return np.array([omega, 0.5 * float(denominator[1]) / omega, delay])


def _robot_first(data: JointData, start: FloatArray) -> tuple[Problem, FloatArray]:
    """Fit the robot to the pose alone; only then what the pose shows beside it can be determined from a wrong robot."""
    layout, rests = ParameterLayout(robot_order=data.robot_order, surfaces=0), _quiet_rests(data)
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
    )
    rest_noise = fit_whitener([_settled(data.force_n[s]) for s in rests])
    problem = Problem(
        signals=signals,
        layout=layout,
        segments=(),
        pose_spans=_pose_spans(data) if layout.robot_order else (),
        free_noise=rest_noise,
        contact_noise=rest_noise,
        pose_noise=fit_whitener([_settled(data.position_m[signals.at_poses(s)]) for s in rests]),
        fixed=(0, 1, 2, 3),
        lightest_kg=_LIGHTEST_SHARE * (data.mass_kg if data.mass_kg is not None else _LIGHT_KG),
        heaviest_kg=np.inf if data.mass_kg is None else data.mass_kg / _LIGHTEST_SHARE,
    )
    point = Point(values=start[: len(layout)], nuisances=())
    if layout.robot_order:
        point, _ = minimise(problem, point, _STEPS_FIRST)
    misfit = problem.path(point.values).misfit
    moving, resting = [misfit(s.slice) for s in data.moving], [misfit(s) for s in rests]
    smoother = fit_smoother(moving, resting, data.period_s)
    problem = replace(problem, signals=replace(signals, smoother=smoother), fixed=())
    return problem, np.concatenate([point.values, start[len(layout) :]])


def _quiet_rests(data: JointData) -> list[slice]:
    """Return the rests without their first part, in which the cell still settles, and without those that shake."""
    settling = round(_SETTLING_S / data.period_s)
    if not data.rests:
        return []
    inner = [slice(s.start + min(settling, len(s) // 2), s.stop) for s in data.rests]
    spread = np.array([[np.std(_settled(v[s])) for v in (data.force_n, data.position_m)] for s in inner])
    usual = np.median(spread, axis=0)
    return [s for s, seen in zip(inner, spread, strict=True) if np.all(seen <= _SHAKING * usual)]


def _settled(values: FloatArray) -> FloatArray:
    return np.asarray(detrend(values))


def _centred(values: FloatArray) -> FloatArray:
    return np.asarray(values - np.mean(values))


def _pose_spans(data: JointData) -> tuple[slice, ...]:
    edge, count = round(_POSE_EDGE_S / data.period_s), len(data.position_m)
    return tuple(slice(max(0, s.start - edge), min(count, s.stop + edge)) for s in data.moving)


def _free_motion(data: JointData, base: Problem, values: FloatArray) -> tuple[Problem, Point]:
    """Fit the most informative spans alone, let the best one choose its like, and fit those together."""
    edge = round(_FREE_EDGE_S / data.period_s)
    path = base.path(values)
    cuts = [contact_segment(hold, path, data.force_n, values[:4], data.period_s) for hold in data.holds]
    contacts = [cut[0] for cut in cuts if cut is not None]
    candidates = []
    for span in data.free:
        segment = Segment(start=max(0, span.start - edge), stop=min(len(data.force_n), span.stop + edge))
        touched = any(c.start < segment.stop and segment.start < c.stop for c in contacts)
        if len(segment) * data.period_s >= _SHORTEST_FREE_S and not touched:
            candidates.append(segment)
    rings = [Segment(start=s.start, stop=s.stop) for s in data.rings]
    by_force = _strongest(data, candidates)
    explained = [s for s in by_force if _misfit(base, values, s) < _LARGEST_MISFIT]
    telling = list(dict.fromkeys(by_force[:1] + explained[:1]))
    starts = [start_coupling(base, values, segment, data.mass_kg)[0] for segment in telling]
    best = min(
        zip(starts, telling, strict=True), key=lambda pair: _misfit(base, pair[0], pair[1]), default=(values, None)
    )[0]
    used = _explained(base, best, candidates, rings)
    if len(used) < len(candidates) + len(rings) and telling:
        # A sweep that ends below the resonance leaves K_s open: what rings shows it, with the mass that motion known.
        for ring in _strongest(data, rings)[:_RING_STARTS]:
            start = start_coupling(base, best, ring, float(best[3]))[0]
            more = _explained(base, start, candidates, rings)
            if len(more) > len(used) and _misfit(base, start, telling[0]) < _AS_WELL * _misfit(base, best, telling[0]):
                best, used = start, more
    if not used:
        raise EstimateError(
            f"Of {len(data.free)} spans of free motion, none that lasts {_SHORTEST_FREE_S:g} s is explained by one "
            "payload on one spring; record a commanded sweep of 0.5 to 50 Hz in free space without a hand on it."
        )
    problem = replace(base, segments=used, signals=_smoothed_for(data, base, best, used))
    point, _ = minimise(problem, Point(values=best, nuisances=tuple(np.zeros(3) for _ in used)), _STEPS_FIRST)
    problem = _recoloured(problem, point)
    point, _ = minimise(problem, point, _STEPS_LATER)
    return problem, point


def _ringing_alone(data: JointData, base: Problem, values: FloatArray) -> tuple[Problem, Point]:
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
    point, _ = minimise(weighed, Point(values=best, nuisances=tuple(np.zeros(3) for _ in used)), _STEPS_FIRST)
    return weighed, point


def _strongest(data: JointData, segments: Sequence[Segment]) -> list[Segment]:
    return sorted(segments, key=lambda s: -float(np.sum(_centred(data.force_n[s.slice]) ** 2)))


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
    resting = [misfit(s) for s in _quiet_rests(data)]
    return replace(problem.signals, smoother=fit_smoother([misfit(s.slice) for s in used], resting, data.period_s))


def _misfit(problem: Problem, values: FloatArray, segment: Segment) -> float:
    """Return residual over force of a span whose own parameters are fitted, as energies within the noise's weights."""
    alone = replace(problem, segments=(segment,), pose_spans=(), known_path=problem.path(values))
    block = linearise(alone, Point(values=values, nuisances=(np.zeros(segment.nuisance_count),)))[0]
    force = problem.noise(segment).apply(_centred(problem.signals.force_n[segment.slice]))
    excess = max(float(block.residual @ block.residual) - len(force), 0.0)
    return float(np.sqrt(excess / max(float(force @ force), 1e-300)))


def _together(
    data: JointData, problem: Problem, point: Point, found: Sequence[FoundContact]
) -> tuple[Problem, Point, list[FoundContact]]:
    """Join the contacts, grouped by surface, to the free motion, and fit all; a span far off all others drops out."""
    groups = group_contacts(
        [(c.start.segment.sign, c.secant_n_per_m, c.secant_std_n_per_m) for c in found], _SAME_SECANT
    )
    layout = ParameterLayout(robot_order=problem.layout.robot_order, surfaces=max(groups, default=-1) + 1)
    order = sorted(range(len(found)), key=lambda i: groups[i])
    surfaces: list[FloatArray] = []
    own: list[FloatArray] = []
    for index in range(layout.surfaces):
        surface, nuisances = start_surface(problem, point, [found[i] for i in order if groups[i] == index])
        surfaces.append(surface)
        own += nuisances
    places = {name: i for i, name in enumerate(layout.names)}
    joined = replace(
        problem,
        layout=layout,
        segments=problem.segments + tuple(replace(found[i].start.segment, surface=groups[i]) for i in order),
        priors=(
            *problem.priors,
            *((places[name], *known) for name, known in data.priors.items() if name in places),
        ),
    )
    whole = Point(values=np.concatenate([point.values, *surfaces]), nuisances=(*point.nuisances, *own))
    whole, _ = minimise(joined, whole, _STEPS_FIRST)
    kept = _unsuspicious(joined, whole)
    if len(kept) < len(joined.segments):
        joined = replace(joined, segments=tuple(joined.segments[i] for i in kept))
        whole = replace(whole, nuisances=tuple(whole.nuisances[i] for i in kept))
        whole, _ = minimise(joined, whole, _STEPS_FIRST)
    free = len(problem.segments)
    return joined, whole, [found[order[i - free]] for i in kept if i >= free]


def _unsuspicious(problem: Problem, point: Point) -> list[int]:
    """Return which spans are no outliers: misfit up to 8 times the usual one of their kind, three of a kind or more.

    A surface keeps its best contact.
    """
    blocks = linearise(problem, point)[: len(problem.segments)]
    misfit = np.array([float(np.mean(block.residual**2)) for block in blocks])
    kept = []
    for i, segment in enumerate(problem.segments):
        alike = [j for j, s in enumerate(problem.segments) if s.is_contact == segment.is_contact]
        same = [j for j in alike if problem.segments[j].surface == segment.surface]
        usual = max(float(np.median(misfit[alike])), 1.0)
        if len(alike) < _ENOUGH_TO_TELL or misfit[i] <= _OUTLYING * usual or misfit[i] == np.min(misfit[same]):
            kept.append(i)
    return kept


def _recoloured(problem: Problem, point: Point) -> Problem:
    """Fit the whiteners to what remains at a point."""
    signals, path = problem.signals, problem.path(point.values)
    left = forces_left(problem, point)
    poses = [_centred(path.misfit(signals.at_poses(span))) for span in problem.pose_spans]
    return replace(
        problem,
        free_noise=fit_whitener(left[False]) if left[False] else problem.free_noise,
        contact_noise=fit_whitener(left[True]) if left[True] else problem.contact_noise,
        pose_noise=fit_whitener(poses) if poses else problem.pose_noise,
    )
