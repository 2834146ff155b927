"""Joint maximum-likelihood fit of all parameters of one axis to the raw force and pose."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from problems.arrays import FloatArray
from problems.progress import ProgressSlice

from ..errors import EstimateError
from .covariance import deepest_stiffness, deepest_surfaces
from .data import JointData
from .extension import extend_payload, with_extension
from .free_motion import (
    STEPS_FIRST,
    STEPS_LATER,
    detrended,
    fit_free_motion,
    fit_ringing,
    fit_robot,
    left_at_rest,
    quiet_rests,
    robot_of_pose,
    with_fitted_noise,
)
from .latency import compare_delay_hypotheses, filter_or_delay, fit_filter, fit_latency
from .model import ParameterLayout
from .result import JointFit, build_joint_fit, with_robot_of_pose, with_turning, with_unexplained
from .segments import ContactCandidate, FoundContact, group_contacts, start_contact
from .solve import Point, Problem, linearise, minimise
from .start import fit_alone, start_surface
from .turning_payload import take_out_turning

_ROUNDS = 2
_SAME_SECANT = 1.12
_LEAST_EXPLAINED = 0.8
_NOTHING_BUT_NOISE, _LEAST_BESIDE_NOISE = 1.2, 0.5
_AT_LIMIT = 0.2
_MORE_THAN_NOISE, _VAGUE_SAMPLES = 1.5, 0.05
_OUTLYING, _ENOUGH_TO_TELL = 8.0, 3
# Shares of the time, as measured: free motion, each contact alone, all of them together, the last rounds.
_BEGUN, _TOUCHED, _JOINED, _ROUNDED = 0.4, 0.55, 0.72, 0.8


def identify_joint(data: JointData, progress: ProgressSlice | None = None) -> JointFit:
    """Fit force and pose of all usable spans together (docs/method.md, "The loop", exact under the held command).

    The likelihood is that of the pose given the command times that of the force given both: the flange's path is the
    robot's exact answer to the command plus what Wiener's filter keeps of the rest, and what remains of the force is
    whitened by an autoregression, fitted again after every round. Where free motion does not show the payload, what
    rings after taps and releases may, with the mass that gravity shows (`JointFit.is_weighed`). `progress` receives the
    share of the work that is done. Raises EstimateError when no span can be used.
    """
    progress = progress or ProgressSlice()
    try:
        return _identify(data, fit_free_motion, progress)
    except EstimateError:
        try:
            return replace(_identify(data, fit_ringing, progress), is_weighed=True)
        except EstimateError:
            pass
        raise


_Beginning = Callable[[JointData, Problem, FloatArray], tuple[Problem, Point]]


def _identify(data: JointData, begin: _Beginning, progress: ProgressSlice) -> JointFit:
    """Fit everything, beginning with the payload alone."""
    base, start = fit_robot(data)
    problem, point = begin(data, base, start[:-3])
    turning = take_out_turning(data, problem, point)
    data, problem, point = turning.data, turning.problem, turning.point
    if problem.layout.robot_order == 1:
        # On the wrong side of a whole sample the jumps of the force look like a latency.
        point, _ = compare_delay_hypotheses(problem, point)
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
        problem = with_fitted_noise(problem, point)
        point, _ = minimise(problem, point, STEPS_LATER)
    if latency.is_filter:
        problem, point, std = fit_filter(problem, point)
        latency = replace(latency, seconds=problem.signals.sensor_dynamics.time_constant_s, std_s=std)
    elif not latency.is_whole:
        again = fit_latency(problem, point, data.force_n, data.latency_s, latency.applied_s, blurred=blurred)
        problem, point, latency = again[0], again[1], replace(again[2], evidence=latency.evidence)
    progress.advance_to(_ROUNDED)
    problem, point = deepest_surfaces(problem, deepest_stiffness(problem, point))
    problem = with_fitted_noise(problem, point)
    point, competing = compare_delay_hypotheses(problem, point)
    _require_mass(problem, float(point.values[3]))
    resting = np.concatenate([detrended(data.force_n[s]) for s in quiet_rests(data)])
    rest_rms_n = max(float(np.std(resting)), data.least_noise_n)
    fit = build_joint_fit(
        problem, point, found, competing, command=data.command, latency=latency, rest_rms_n=rest_rms_n
    )
    _require_explained(fit)
    is_held = data.robot_order > 0 and not blurred and not problem.signals.is_smooth
    wider = extend_payload(
        problem, point, latency, quiet_rms_n=rest_rms_n, is_held=is_held, force_n=data.force_n, shifted_s=data.shifted_s
    )
    noise_n = float(np.std(np.concatenate(left_at_rest(problem, point, quiet_rests(data)))))
    fit = with_unexplained(with_extension(fit, wider), wider.left_n, rest_rms_n, max(noise_n, rest_rms_n))
    is_vague = data.robot_order > 0 and not blurred and fit.value("delay_s")[1] > _VAGUE_SAMPLES * data.period_s
    if data.robot_order and (is_vague or wider.is_wider or fit.quality.noise_ratio_free > _MORE_THAN_NOISE):
        fit = with_robot_of_pose(fit, *robot_of_pose(data, base, start[problem.layout.robot]))
    return with_turning(fit, turning.move, turning.std)


def _require_explained(fit: JointFit) -> None:
    """Raise EstimateError where the fit leaves more of the force in free motion than its noise and a fifth of it."""
    quality = fit.quality
    # Of a motion that hardly shows in the noise little can be explained, and nothing but that noise is left.
    is_noise = quality.noise_ratio_free < _NOTHING_BUT_NOISE and quality.explained_free > _LEAST_BESIDE_NOISE
    if np.all(np.isfinite(fit.covariance)) and (quality.explained_free >= _LEAST_EXPLAINED or is_noise):
        return
    raise EstimateError(
        f"One payload on one spring explains {100.0 * max(quality.explained_free, 0.0):.0f} % of the force in free "
        f"motion, {100.0 * _LEAST_EXPLAINED:.0f} % are needed; record a commanded sweep of 0.5 to 50 Hz in free space "
        "without a hand on the payload, with the command that the robot receives. If the log has one: a filter in the "
        "sensor or its driver, or a robot that is not one of one or two poles, does this too."
    )


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
    whole, _ = minimise(joined, whole, STEPS_FIRST)
    kept = _unsuspicious(joined, whole)
    if len(kept) < len(joined.segments):
        joined = replace(joined, segments=tuple(joined.segments[i] for i in kept))
        whole = replace(whole, nuisances=tuple(whole.nuisances[i] for i in kept))
        whole, _ = minimise(joined, whole, STEPS_FIRST)
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
