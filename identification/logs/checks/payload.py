"""Weigh the payload at rest: unit and sign of the wrench, tare jumps, changes of payload or bias."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from problems.arrays import BoolArray, FloatArray
from problems.compiled import compiled

from ...errors import EstimateError, LogError
from ...payload.static_poses import StaticPose, collect_static_poses, rows_as_poses
from ...result import Finding
from ...signals.aligned import AlignedLog, align
from ...signals.constant_runs import find_runs
from ...signals.medians import column_medians
from ...signals.recording import AXES, Recording
from ...signals.segments import find_motion, low_pass
from ...signals.sweeps import second_differences, steps

_STILL_M_S = 1.5e-3
_STILL_RAD_S = 0.02
_POSE_BAND_HZ = 10.0
_SIDE_S = 0.15
_FEWEST = 8
_STEP_S = 4e-3
_NOISE_FACTOR = 8.0
_SMALLEST = np.array([0.3, 0.3, 0.3, 0.03, 0.03, 0.03])
_QUIET_SHARE = 0.15
_DISTINCT_COSINE = float(np.cos(np.radians(2.0)))
_FEWEST_ORIENTATIONS = 4
_FEWEST_AFTER = 3
_LARGEST_CONDITION = 40.0
_ROUNDS = 30
_SCATTER_N = 0.05
_SCATTER_SHARE = 3e-3
_SIGNIFICANT = 6.0
_MASS_SHARE = 0.03
_SMALLEST_STEP_N = 0.5
_EXPLAINED = 0.9
_TOGETHER = 0.6
_FOLLOWED = 0.6
_SMALLEST_KG = 0.1
_HARMLESS_N = 3.0
_FEWEST_BESIDE = 3
_SAME_PLACE_M = 1e-3


@dataclass(frozen=True, kw_only=True)
class TareJump:
    """A step of the wrench at rest, `time_s` after the start of the aligned log: `force_n`, `torque_n_m` (3,)."""

    time_s: float
    force_n: FloatArray
    torque_n_m: FloatArray

    def finding(self, topic: str) -> Finding:
        """Say it."""
        force = ", ".join(f"{value:+.2f}" for value in self.force_n)
        torque = ", ".join(f"{value:+.3f}" for value in self.torque_n_m)
        return Finding.warning(
            "tare-jump",
            f"The wrench of {topic} steps by ({force}) N and ({torque}) N·m at {self.time_s:.3f} s while the "
            "robot is still and nothing rings: its bias was set there.",
            "Tare before recording, not during it, or cut the log there.",
        )


def find_tare_jumps(log: AlignedLog) -> tuple[TareJump, ...]:
    """Find steps within 4 ms (or one sample) between two quiet stretches of a wrench, the pose still all along.

    A contact or a hand takes longer, moves the robot or leaves a swing behind.
    """
    wrench = np.hstack([log.force_S_n, log.torque_S_n_m if log.has_torque else np.zeros_like(log.force_S_n)])
    side, width = max(_FEWEST, round(_SIDE_S / log.period_s)), max(1, round(_STEP_S / log.period_s))
    if len(wrench) < 2 * side + width + 2:
        return ()
    noise = column_medians(second_differences(wrench).T) / (0.6745 * np.sqrt(6.0))
    least = np.maximum(_NOISE_FACTOR * noise, _SMALLEST)
    steep = find_runs(steps(wrench, width, least))
    moving = np.concatenate([[0], np.cumsum(~_still(log))])
    found = []
    for start, stop in zip(steep.starts.tolist(), steep.stops.tolist(), strict=True):
        first, last = start - side, stop + width + side
        if stop - start > 2 * width or first < 0 or last > len(wrench) or moving[first] != moving[last]:
            continue
        # The step lies between the last sample that the first steep difference starts from and the last one's end.
        jump = _jump(wrench[first:start], wrench[stop + width : last], noise, least)
        if jump is not None:
            time = float(log.time_s[(start + stop + width) // 2])
            found.append(TareJump(time_s=time, force_n=jump[:3], torque_n_m=jump[3:]))
    return tuple(found)


def _still(log: AlignedLog) -> BoolArray:
    """Return where the pose alone shows no motion."""
    velocity = np.gradient(low_pass(log.position_B_m, log.period_s, _POSE_BAND_HZ), log.period_s, axis=0)
    lag = log.lag
    turning = maximum_filter1d(np.concatenate([log.turned_rad, np.zeros(lag)]), 2 * lag + 1) / (lag * log.period_s)
    return np.asarray((np.linalg.norm(velocity, axis=1) < _STILL_M_S) & (turning < _STILL_RAD_S))


def _jump(before: FloatArray, after: FloatArray, noise: FloatArray, least: FloatArray) -> FloatArray | None:
    """Return the step between two stretches, None unless both are flat for its size."""
    change = np.asarray(after.mean(axis=0) - before.mean(axis=0))
    if not bool(np.any(np.abs(change) > least)):
        return None
    swing = np.maximum(before.std(axis=0), after.std(axis=0))
    allowed = np.hypot(2.0 * noise, _QUIET_SHARE * np.max(np.abs(change) / least) * least)
    return change if bool(np.all(swing < allowed)) else None


def check_payload(recording: Recording) -> tuple[Finding, ...]:
    """Report tare jumps, a payload or a bias that changed midway, kilonewtons and a flipped sign, with their times.

    Needs raw forces, a whole pose, and for all but the tare jumps rests in at least 4 orientations; says nothing
    where they are missing or where wrench and pose do not fit together. A tare jump is an error where the rests beside
    it do not determine both biases: contacts would be weighed wrongly.
    """
    wrench, pose = recording.wrench, recording.pose
    if wrench.gravity_compensated or wrench.deadband is not None or pose.is_displacement:
        return ()
    if {*AXES[:3]} - {*wrench.measured_axes} or {*AXES[3 if recording.rows_are_poses else 0 :]} - {*pose.measured_axes}:
        return ()
    if recording.rows_are_poses:
        return tuple(_unit_findings(wrench.topic, rows_as_poses(recording)))
    try:
        log = align(recording)
    except (EstimateError, LogError):
        return ()
    return weigh_rests(wrench.topic, log, collect_static_poses(log, find_motion(log).still))


def weigh_rests(topic: str, log: AlignedLog, poses: tuple[StaticPose, ...]) -> tuple[Finding, ...]:
    """Do what `check_payload` does on a raw log that is aligned already, with its rests."""
    jumps = find_tare_jumps(log)
    found = [_judged(jump.finding(topic), jump, jumps, log, poses) for jump in jumps]
    # A tare in the middle of the poses is reported once.
    change = None if jumps else _find_change(topic, log, poses)
    return (*found, *(() if change is None else (change[0],)), *_unit_findings(topic, poses))


def payload_change(recording: Recording) -> tuple[int, float] | None:
    """Return the first stamp of the log [ns], and how long after it payload or bias change [s]; None if they do not."""
    log = align(recording)
    poses, topic = collect_static_poses(log, find_motion(log).still), recording.wrench.topic
    jumps = find_tare_jumps(log)
    judged = (jump for jump in jumps if _judged(jump.finding(topic), jump, jumps, log, poses).severity == "error")
    change = None if jumps else _find_change(topic, log, poses)
    jump = next(judged, None)
    times_s = [*(() if jump is None else (jump.time_s,)), *(() if change is None else (change[1],))]
    return (log.start_ns, times_s[0]) if times_s else None


def _judged(
    finding: Finding, jump: TareJump, jumps: Sequence[TareJump], log: AlignedLog, poses: tuple[StaticPose, ...]
) -> Finding:
    """Return the finding as an error where the rests on one side of a jump cannot determine the bias there."""
    if float(np.linalg.norm(jump.force_n)) < _HARMLESS_N:
        return finding
    edges = [-np.inf, *(each.time_s for each in jumps), np.inf]
    sides = [
        tuple(pose for pose in poses if start <= log.time_s[pose.span.start] < stop) for start, stop in pairwise(edges)
    ]
    # Of a side without more than the rest of the jump itself nothing is asked.
    asked = [_distinct(_rests(side)[0]) for side in sides if len(side) > 1]
    if len(asked) <= 2 and min(asked, default=_FEWEST_BESIDE) >= _FEWEST_BESIDE:
        return finding
    return replace(
        finding,
        severity="error",
        message=f"{finding.message} The bias beside it is unknown: the tool rests in {', '.join(map(str, asked))} "
        f"orientations on its sides, and {_FEWEST_BESIDE} are needed on each of two.",
    )


def _rests(poses: Sequence[StaticPose]) -> tuple[FloatArray, FloatArray]:
    """Return gravity and force of rests, (n, 3) each."""
    return np.array([pose.gravity_S_m_s2 for pose in poses]), np.array([pose.force_S_n for pose in poses])


def _directions(gravity: FloatArray) -> FloatArray:
    return np.asarray(gravity / np.linalg.norm(gravity, axis=1, keepdims=True))


def _distinct(gravity: FloatArray) -> int:
    """Count the directions of gravity (n, 3), each taken for all within 2 degrees of it."""
    if not len(gravity):
        return 0
    left, count = _directions(gravity), 0
    while len(left):
        left, count = left[left @ left[0] < _DISTINCT_COSINE], count + 1
    return count


def _weigh(gravity: FloatArray, force: FloatArray) -> tuple[FloatArray, float, float] | None:
    """Return (m, b) of f = m g_S + b by an L1 fit, the mass's standard deviation and the scatter [N]; None if vague."""
    if _distinct(gravity) < _FEWEST_ORIENTATIONS:
        return None
    swing = float(np.max(np.ptp(force, axis=0)))
    floor = min(_SCATTER_N, _SCATTER_SHARE * swing) + 1e-9
    rows = np.column_stack([gravity.ravel(), np.tile(np.eye(3), (len(force), 1))])
    if np.linalg.cond(rows / np.array([9.81, 1.0, 1.0, 1.0])) > _LARGEST_CONDITION:
        return None
    bias, misfit = np.empty(3), np.empty(len(force))
    mass = _fit_weight(gravity, force, floor, bias, misfit)
    scatter = max(1.4826 * float(np.median(misfit)), floor)
    inverse = np.linalg.inv(rows.T @ rows)
    return np.concatenate([[mass], bias]), scatter * float(np.sqrt(inverse[0, 0])), scatter


@compiled
def _fit_weight(gravity: FloatArray, force: FloatArray, floor: float, bias: FloatArray, misfit: FloatArray) -> float:
    """Return m of f = m g_S + b by an L1 fit (least squares, weighted anew); fill in b (3,) and what it misses (n,)."""
    mass = 0.0
    weights, mean_gravity, mean_force = np.ones(len(force)), np.empty(3), np.empty(3)
    for _ in range(_ROUNDS):
        # With the means taken out: the bias is what the mean force has beyond the mean weight.
        total, along, swung = np.sum(weights), 0.0, 0.0
        for k in range(3):
            mean_gravity[k] = np.sum(weights * gravity[:, k]) / total
            mean_force[k] = np.sum(weights * force[:, k]) / total
        for i in range(len(force)):
            for k in range(3):
                off = gravity[i, k] - mean_gravity[k]
                along += weights[i] * off * (force[i, k] - mean_force[k])
                swung += weights[i] * off**2
        mass = along / swung
        bias[:] = mean_force - mass * mean_gravity
        for i in range(len(force)):
            square = 0.0
            for k in range(3):
                square += (force[i, k] - mass * gravity[i, k] - bias[k]) ** 2
            misfit[i] = np.sqrt(square)
            weights[i] = 1.0 / max(misfit[i], floor)
    return mass


def _find_change(topic: str, log: AlignedLog, poses: tuple[StaticPose, ...]) -> tuple[Finding, float] | None:
    """Return the split of the rests at which the later ones stop fitting the earlier payload, and its time [s]."""
    best: tuple[tuple[float, float], Finding, float] | None = None
    gravity, force = _rests(poses)
    for split in range(_FEWEST_ORIENTATIONS, len(poses) - _FEWEST_AFTER + 1):
        earlier, later = poses[:split], poses[split:]
        before = _weigh(gravity[:split], force[:split])
        if before is None:
            continue
        solution, _, scatter = before
        # Both halves must be clean: a split in the wrong place mixes two payloads in one of them.
        left = force - solution[0] * gravity - solution[1:]
        off = left[split:]
        size = np.linalg.norm(off, axis=1)
        largest = max(_SIGNIFICANT * scatter, _SMALLEST_STEP_N)
        changed = float(np.mean(size > largest))
        if changed < _EXPLAINED:
            continue
        finding = _payload_change(topic, log, earlier, later)
        if finding is None:
            near = np.linalg.norm(left[:split], axis=1) <= largest
            free = tuple(pose for pose, is_near in zip(earlier, near, strict=True) if is_near)
            finding = _bias_change(topic, _times(log, earlier, later), later, off, returns=_returns(log, free, later))
        if finding is not None and (best is None or (-changed, scatter) < best[0]):
            best = ((-changed, scatter), finding, float(np.mean(_gap_s(log, earlier, later))))
    return None if best is None else best[1:]


def _gap_s(log: AlignedLog, earlier: tuple[StaticPose, ...], later: tuple[StaticPose, ...]) -> tuple[float, float]:
    return float(log.time_s[earlier[-1].span.stop - 1]), float(log.time_s[later[0].span.start])


def _times(log: AlignedLog, earlier: tuple[StaticPose, ...], later: tuple[StaticPose, ...]) -> str:
    last, first = _gap_s(log, earlier, later)
    return f"between {last:.2f} and {first:.2f} s"


def _payload_change(
    topic: str, log: AlignedLog, earlier: tuple[StaticPose, ...], later: tuple[StaticPose, ...]
) -> Finding | None:
    before, after = _weigh(*_rests(earlier)), _weigh(*_rests(later))
    if before is None or after is None:
        return None
    first, second = float(before[0][0]), float(after[0][0])
    apart = abs(second - first)
    if apart < max(_SIGNIFICANT * float(np.hypot(before[1], after[1])), _MASS_SHARE * abs(first), _SMALLEST_KG):
        return None
    return Finding.error(
        "payload-change",
        f"The payload of {topic} weighs {first:.2f} ± {before[1]:.2f} kg in the {len(earlier)} rests before "
        f"and {second:.2f} ± {after[1]:.2f} kg in the {len(later)} after: it changed {_times(log, earlier, later)}.",
        "Record one log per payload, or cut the log there.",
    )


def _bias_change(
    topic: str, times: str, later: tuple[StaticPose, ...], off: FloatArray, *, returns: bool
) -> Finding | None:
    """Return a step that all later rests share, where it cannot be a contact: as it `returns`, or as it turns."""
    step = np.median(off, axis=0)
    spread = 1.4826 * float(np.median(np.linalg.norm(off - step, axis=1)))
    together = np.mean(np.linalg.norm(off - step, axis=1) < max(_SIGNIFICANT * spread, _SMALLEST_STEP_N))
    size = float(np.linalg.norm(step))
    if size < max(_SIGNIFICANT * spread, _SMALLEST_STEP_N) or together < _TOGETHER:
        return None
    if _distinct(_rests(later)[0]) < 2 and not returns:
        return None
    components = ", ".join(f"{value:+.2f}" for value in step)
    return Finding.warning(
        "bias-change",
        f"The force of {topic} at rest steps by ({components}) N {times} and stays so: "
        "the sensor was tared, or something was added to or taken off the payload.",
        "Tare before recording and keep the payload as it is, or cut the log there.",
    )


def _returns(log: AlignedLog, earlier: tuple[StaticPose, ...], later: tuple[StaticPose, ...]) -> bool:
    """Return whether most later rests are where an earlier one was; `earlier` are those without contact."""
    if not earlier:
        return False

    def places(poses: tuple[StaticPose, ...]) -> FloatArray:
        return np.array([log.position_B_m[pose.span.slice].mean(axis=0) for pose in poses])

    apart: NDArray[np.float64] = np.linalg.norm(places(later)[:, None] - places(earlier)[None], axis=2)
    alike = _directions(_rests(later)[0]) @ _directions(_rests(earlier)[0]).T > _DISTINCT_COSINE
    return bool(np.mean(np.any((apart < _SAME_PLACE_M) & alike, axis=1)) > 0.5)


def _unit_findings(topic: str, poses: tuple[StaticPose, ...]) -> Iterator[Finding]:
    gravity, force = _rests(poses)
    fit = _weigh(gravity, force)
    if fit is None:
        return
    solution, _, scatter = fit
    mass = float(solution[0])
    weight = mass * gravity
    fits = np.linalg.norm(force - weight - solution[1:], axis=1) < _SIGNIFICANT * scatter
    # The weight has to swing by far more than what is left over, or it may be anything.
    if np.mean(fits) < _FOLLOWED or float(np.max(np.ptp(weight[fits], axis=0))) < 2.0 * _SIGNIFICANT * scatter:
        return
    if mass < 0.0:
        yield Finding.warning(
            "force-sign",
            f"The force of {topic} follows gravity with the opposite sign (it would be {mass:.3g} kg).",
            "Declare `exerted_by` of the wrench or `gravity_direction`; `identify` finds which is true.",
        )
    if abs(mass) < _SMALLEST_KG:
        yield Finding.error(
            "force-unit",
            f"The force of {topic} follows gravity, but of {1e3 * abs(mass):.3g} g only; in kilonewtons it "
            f"would be {1e3 * abs(mass):.3g} kg.",
            "Declare the unit of the force as kN if it is in kilonewtons.",
        )
