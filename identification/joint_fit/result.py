"""Result of the joint fit of one axis: values, one covariance, surfaces and diagnostics."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from problems.arrays import FloatArray
from problems.frozen import freeze
from problems.model.robot import RobotModel

from ..fit_quality import FitQuality
from .covariance import (
    Spread,
    along_stiffness,
    bounded_intervals,
    count_misfits,
    other_minima,
    widened,
    with_competing_minimum,
)
from .data import HeldCommand
from .latency import CompetingMinimum, WrenchLatency
from .model import robot_model
from .noise import whiteness
from .segments import FoundContact, Segment, predict_force
from .solve import Block, Point, Problem, information, linearise, logarithmic, minimise, sizes_of, stiffest_seen_n_per_m

_STEPS = 4
_LARGEST_STEP = 3.0
# A K_s beyond this share of the stiffest that a sampling rate can show is not identified (0.8 of half that rate).
_FASTEST_SEEN = 0.64
_WELL_ABOVE_NOISE = 3.0
MECHANICAL_NAMES = ("stiffness_n_per_m", "damping_n_s_per_m", "drag_n_s_per_m", "mass_kg")


@dataclass(frozen=True, kw_only=True)
class JointSurface:
    """One surface: the secant, K_s and K_e in series, with its deviation out of the joint covariance, and contacts.

    `first_parameter` is where K_e, B_e, M_e are in the fit's vector; `onsets` are samples.
    """

    sign: int
    first_parameter: int
    secant_n_per_m: float
    secant_std_n_per_m: float
    onsets: tuple[int, ...]
    peak_force_n: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class PayloadPart:
    """A part of the payload that swings on the rest: share of mass, frequency, damping ratio with their deviations."""

    mass_share: tuple[float, float]
    frequency_hz: tuple[float, float]
    damping_ratio: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class FittedSpan:
    """One span that the fit used: `measured` and `predicted` force (n,) from sample `start` on, in N or N·m.

    `surface` counts the surfaces of the axis, None in free motion; `white` is the whitened residual, whose deviation is
    1 where the model leaves nothing but the noise.
    """

    start: int
    surface: int | None
    measured: FloatArray
    predicted: FloatArray
    white: FloatArray


@dataclass(frozen=True, kw_only=True)
class HeldOutContact:
    """A contact's peak force as measured, and as all other spans predict it from the recorded command [N, N·m].

    `surface` counts the surfaces of the axis, `onset` is a sample.
    """

    surface: int
    onset: int
    measured_peak: float
    predicted_peak: float


@dataclass(frozen=True, kw_only=True)
class JointFit:
    """All parameters of one axis with one covariance, (p,) and (p, p) in SI, in the order of `names`.

    `ci95` holds intervals where plus and minus two deviations would be wrong (a damping or mass near 0); `latency` is
    the wrench's against pose and command. `is_weighed` where ringing alone gave the coupling, with the mass from
    gravity. `spans` are what was fitted, span by span. `part` swings on the payload and `friction_n`, value and
    deviation, is in the coupling, where the log shows them; `is_payload_unclear` where it shows either without a value.
    Spans and quality are those of one payload on one spring. `unexplained` is how many times the noise is left of the
    force in free motion and in contact beside what is reported, 0 where that is not well above it. `turned_n_per_m` is
    by how much K_s is larger without what the payload turns on its coupling, 0 where the torque does not show that.
    """

    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    ci95: Mapping[str, tuple[float, float]]
    robot: RobotModel | None
    surfaces: tuple[JointSurface, ...]
    quality: FitQuality
    latency: WrenchLatency
    is_weighed: bool = False
    spans: tuple[FittedSpan, ...] = ()
    held_out: tuple[HeldOutContact, ...] = ()
    part: PayloadPart | None = None
    friction_n: tuple[float, float] | None = None
    is_payload_unclear: bool = False
    unexplained: tuple[float, float] = (0.0, 0.0)
    turned_n_per_m: float = 0.0

    def __post_init__(self) -> None:
        freeze(self, "ci95")
        for name in ("values", "covariance"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def std(self) -> FloatArray:
        """Standard deviations in the order of `names`."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def own_frequency_hz(self) -> float:
        """Frequency at which the payload swings on its coupling."""
        return float(np.sqrt(self.value("stiffness_n_per_m")[0] / self.value("mass_kg")[0])) / (2.0 * np.pi)

    def value(self, name: str) -> tuple[float, float]:
        """Return value and standard deviation of a parameter."""
        index = self.names.index(name)
        return float(self.values[index]), float(self.std[index])


def build_joint_fit(
    problem: Problem,
    point: Point,
    found: Sequence[FoundContact],
    competing: CompetingMinimum | None,
    *,
    command: HeldCommand | None,
    latency: WrenchLatency,
    rest_rms_n: float,
) -> JointFit:
    """Turn the minimum into a result; the delay counts from the command and not from the tick before it."""
    layout, blocks = problem.layout, linearise(problem, point)
    share, ratio = _fit(problem, point, rest_rms_n)
    spread = along_stiffness(problem, point, blocks, widened(blocks, len(layout), problem.signals.period_s))
    spread = other_minima(problem, point, spread)
    blurred = command is not None and command.is_mean
    spread = with_competing_minimum(problem, point, spread, competing, blurred=blurred)
    spread = count_misfits(problem, spread, ratio)
    sizes = sizes_of(point.values, layout, problem.signals.period_s)
    covariance = spread.covariance * np.outer(sizes, sizes)
    values = point.values.copy()
    covariance = without_aliases(values, covariance, problem.signals.period_s)
    if layout.robot_order:
        shift = 0.0 if command is None else command.shift_s
        values[layout.robot.stop - 1] = max(values[layout.robot.stop - 1] - shift, 0.0)
    surfaces = tuple(_surface(i, problem, point, covariance, found) for i in range(layout.surfaces))
    return JointFit(
        names=layout.names,
        values=values,
        covariance=covariance,
        ci95=bounded_intervals(problem, point, blocks, spread),
        robot=robot_model(values[layout.robot]) if layout.robot_order else None,
        surfaces=surfaces,
        quality=_quality(problem, point, blocks, spread, share, ratio, latency),
        latency=latency,
        spans=_spans(problem, point, blocks),
        held_out=_held_out(problem, point, blocks, found),
    )


def _spans(problem: Problem, point: Point, blocks: Sequence[Block]) -> tuple[FittedSpan, ...]:
    """Return what was fitted beside what the model says at the minimum."""
    spans = []
    for i, segment in enumerate(problem.segments):
        measured = problem.signals.force_n[segment.slice].copy()
        spans.append(
            FittedSpan(
                start=segment.start,
                surface=segment.surface if segment.is_contact else None,
                measured=measured,
                predicted=measured + _force_error(problem, point, segment, i),
                white=blocks[i].residual,
            )
        )
    return tuple(spans)


def without_aliases(values: FloatArray, covariance: FloatArray, period_s: float) -> FloatArray:
    """Return the covariance (p, p) with a K_s that is known to itself only, where it swings too fast to be sampled.

    Such a spring hardly gives, and what the samples show of it they show of many others: the curvature of one minimum
    among them says nothing.
    """
    if values[0] <= _FASTEST_SEEN * stiffest_seen_n_per_m(float(values[3]), period_s):
        return covariance
    out = covariance.copy()
    out[0, :] = out[:, 0] = 0.0
    out[0, 0] = values[0] ** 2
    return out


def secant_of(values: FloatArray, covariance: FloatArray, first: int) -> tuple[float, float]:
    """Return K_s and K_e in series with the deviation out of the covariance (p, p), K_e being parameter `first`."""
    k_s, k_e = float(values[0]), float(values[first])
    secant, slope = k_s * k_e / (k_s + k_e), np.zeros(len(values))
    slope[0], slope[first] = (secant / k_s) ** 2, (secant / k_e) ** 2
    return secant, float(np.sqrt(slope @ covariance @ slope))


def _surface(
    index: int, problem: Problem, point: Point, covariance: FloatArray, found: Sequence[FoundContact]
) -> JointSurface:
    first = problem.layout.surface(index).start
    secant, secant_std = secant_of(point.values, covariance, first)
    touched = [s for s in problem.segments if s.is_contact]
    mine = [c.start for s, c in zip(touched, found, strict=True) if s.surface == index]
    return JointSurface(
        sign=mine[0].segment.sign,
        first_parameter=first,
        secant_n_per_m=secant,
        secant_std_n_per_m=secant_std,
        onsets=tuple(c.onset for c in mine),
        peak_force_n=tuple(c.peak_force_n for c in mine),
    )


def _fit(problem: Problem, point: Point, rest_rms_n: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return, free and touching, the share of the force's variance that is explained, and residual over noise."""
    share, ratio = [], []
    for kind in (False, True):
        mine = [(i, s) for i, s in enumerate(problem.segments) if s.is_contact == kind]
        seen = [slice(problem.noise(s).order, None) for _, s in mine]
        forces = [problem.signals.force_n[s.slice][part] for (_, s), part in zip(mine, seen, strict=True)]
        errors = [_force_error(problem, point, s, i)[part] for (i, s), part in zip(mine, seen, strict=True)]
        left = float(sum(np.sum(error**2) for error in errors))
        all_of = float(sum(np.sum((f - np.mean(f)) ** 2) for f in forces))
        count = sum(len(f) for f in forces)
        share.append(1.0 - left / all_of if all_of > 0.0 else 0.0)
        ratio.append(float(np.sqrt(left / count)) / rest_rms_n if count else 0.0)
    return (share[0], share[1]), (ratio[0], ratio[1])


def _quality(
    problem: Problem,
    point: Point,
    blocks: Sequence[Block],
    spread: Spread,
    explained: tuple[float, float],
    noise_ratio: tuple[float, float],
    latency: WrenchLatency,
) -> FitQuality:
    free, contact = ([i for i, s in enumerate(problem.segments) if s.is_contact == kind] for kind in (False, True))
    return FitQuality(
        free_spans=len(free),
        explained_free=explained[0],
        whiteness_free=whiteness([blocks[i].residual for i in free]),
        noise_ratio_free=noise_ratio[0],
        left_out_free=_left_out(problem, point, blocks, free),
        contacts=len(contact),
        explained_contact=explained[1] if contact else None,
        whiteness_contact=whiteness([blocks[i].residual for i in contact]) if contact else None,
        noise_ratio_contact=noise_ratio[1] if contact else None,
        left_out_contact=_left_out(problem, point, blocks, contact),
        widening=spread.widening,
        wrench_lag_s=latency.seconds,
        wrench_lag_std_s=latency.std_s,
    )


def _force_error(problem: Problem, point: Point, segment: Segment, index: int) -> FloatArray:
    path = problem.path(point.values)
    period = problem.signals.period_s
    predicted = predict_force(point.values, point.nuisances[index], segment, path, problem.layout, period)
    felt = problem.signals.sensor_dynamics.shown(predicted, path, segment.slice, float(point.values[1]), period)
    return np.asarray(felt - problem.signals.force_n[segment.slice])


def _left_out(problem: Problem, point: Point, blocks: Sequence[Block], kind: Sequence[int]) -> float | None:
    """Predict the last span of a kind with the parameters that all others show."""
    predicted = _predicted_by_others(problem, point, blocks, kind, kind[-1]) if kind else None
    if predicted is None:
        return None
    force = problem.signals.force_n[problem.segments[kind[-1]].slice]
    return float(np.linalg.norm(predicted - force) / max(float(np.linalg.norm(force - np.mean(force))), 1e-300))


def _held_out(
    problem: Problem, point: Point, blocks: Sequence[Block], found: Sequence[FoundContact]
) -> tuple[HeldOutContact, ...]:
    """Predict every contact whose surface was touched more than once from all others."""
    contact = [i for i, s in enumerate(problem.segments) if s.is_contact]
    held = []
    for index, touched in zip(contact, found, strict=True):
        segment = problem.segments[index]
        predicted = _predicted_by_others(problem, point, blocks, contact, index)
        if predicted is not None and segment.surface is not None:
            force = problem.signals.force_n[segment.slice]
            peaks = (float(np.max(-segment.sign * each)) for each in (force, predicted))
            measured, other = peaks
            if measured > 0.0 and other > 0.0:
                held.append(
                    HeldOutContact(
                        surface=segment.surface, onset=touched.start.onset, measured_peak=measured, predicted_peak=other
                    )
                )
    return tuple(held)


def _predicted_by_others(
    problem: Problem, point: Point, blocks: Sequence[Block], kind: Sequence[int], index: int
) -> FloatArray | None:
    """Return the force (n,) of a span as the parameters that all others show make it; None where none is like it."""
    segment = problem.segments[index]
    if not any(i != index and problem.segments[i].surface == segment.surface for i in kind):
        return None
    matrix, gradient = information([b for i, b in enumerate(blocks) if i != index], len(problem.layout))
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    step = -scale * (np.linalg.pinv(matrix * np.outer(scale, scale), hermitian=True) @ (scale * gradient))
    sizes = sizes_of(point.values, problem.layout, problem.signals.period_s)
    values = np.where(
        logarithmic(problem.layout),
        point.values * np.exp(np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)),
        np.maximum(point.values + step * sizes, 0.0),
    )
    alone = replace(
        problem, segments=(segment,), pose_spans=(), fixed=tuple(range(len(values))), known_path=problem.path(values)
    )
    moved, _ = minimise(alone, Point(values=values, nuisances=(point.nuisances[index],)), _STEPS)
    return np.asarray(problem.signals.force_n[segment.slice] + _force_error(alone, moved, segment, 0))


def with_gain_error(fit: JointFit, share: float) -> JointFit:
    """Return the fit with a deviation of `share` common to all stiffnesses, dampings and masses, secants included.

    F = Z(s) X: a force that is wrong by a share makes every coefficient of Z wrong by it, and no residual shows it.
    """
    if share == 0.0:
        return fit
    common = np.where([name.endswith(MECHANICAL_NAMES) for name in fit.names], share * fit.values, 0.0)
    surfaces = tuple(
        replace(surface, secant_std_n_per_m=float(np.hypot(surface.secant_std_n_per_m, share * surface.secant_n_per_m)))
        for surface in fit.surfaces
    )
    return replace(fit, covariance=fit.covariance + np.outer(common, common), surfaces=surfaces)


def with_unexplained(fit: JointFit, left_n: float, rest_rms_n: float, noise_n: float) -> JointFit:
    """Return the fit with what nothing explains: `left_n` in free motion, and what contacts leave.

    `rest_rms_n` is the force's noise at rest, `noise_n` that with what the coupling makes of the pose's. A part or
    friction that is reported is in contacts, too, whose residuals are those of one payload on one spring. A filter of
    the wrench is known less by as much, since it may be what it was fitted to, and a delay may be a filter.
    """
    is_reported = fit.part is not None or fit.friction_n is not None or fit.is_payload_unclear
    touching = 0.0 if is_reported else (fit.quality.noise_ratio_contact or 0.0) * rest_rms_n
    free, contact = (left / noise_n if left > _WELL_ABOVE_NOISE * noise_n else 0.0 for left in (left_n, touching))
    times = max(free, 1.0) if fit.latency.is_filter else 1.0
    latency = replace(fit.latency, std_s=times * fit.latency.std_s, is_doubtful=free > 0.0)
    quality = replace(fit.quality, wrench_lag_std_s=times * fit.quality.wrench_lag_std_s)
    return replace(fit, unexplained=(free, contact), latency=latency, quality=quality)


def with_turning(fit: JointFit, move: FloatArray | None, std: FloatArray | None) -> JointFit:
    """Return the fit with by how much the payload's turning moved coupling and robot (a,), and what may be wrong of it.

    As it is where nothing was taken out, which is None.
    """
    if move is None or std is None:
        return fit
    wrong = np.zeros(len(fit.values))
    wrong[: len(std)] = std
    return replace(fit, covariance=fit.covariance + np.outer(wrong, wrong), turned_n_per_m=float(move[0]))


def with_robot_of_pose(fit: JointFit, robot: FloatArray, covariance: FloatArray) -> JointFit:
    """Return the fit with ω, (ζ,) T_d (p,) of command and pose alone, with their covariance (p, p) [SI].

    It stays as it is where the force made T_d no vaguer: one that the payload's model does not explain shows no robot.
    """
    if fit.robot is None or covariance[-1, -1] >= fit.value("delay_s")[1] ** 2:
        return fit
    last = fit.names.index("delay_s")
    mine = slice(last + 1 - len(robot), last + 1)
    values, whole = fit.values.copy(), fit.covariance.copy()
    values[mine] = robot
    whole[mine], whole[:, mine] = 0.0, 0.0
    whole[mine, mine] = covariance
    return replace(fit, values=values, covariance=whole, robot=robot_model(robot))


def with_robot_shift(fit: JointFit, shift: FloatArray) -> JointFit:
    """Return the fit with what may be wrong of ω, (ζ,) T_d, by `shift` (p,) in SI, in their deviations.

    Nothing is added where the robot that was fitted has another number of poles.
    """
    if fit.robot is None or fit.robot.order + 1 != len(shift):
        return fit
    moved = np.zeros(len(fit.values))
    last = fit.names.index("delay_s")
    moved[last + 1 - len(shift) : last + 1] = shift
    return replace(fit, covariance=fit.covariance + np.outer(moved, moved))


def with_longer_delay(fit: JointFit, seconds: float, std_s: float) -> JointFit:
    """Return the fit with a delay T_d that is longer by `seconds`, give or take `std_s`; as it is without a robot."""
    if fit.robot is None or (seconds, std_s) == (0.0, 0.0):
        return fit
    at = fit.names.index("delay_s")
    values, covariance = fit.values.copy(), fit.covariance.copy()
    values[at] += seconds
    covariance[at, at] += std_s**2
    robot = replace(fit.robot, delay_s=fit.robot.delay_s + seconds)
    return replace(fit, values=values, covariance=covariance, robot=robot)
