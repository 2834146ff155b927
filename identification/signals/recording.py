"""Signals that identification works on, free of any log format, and the frames in which they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from problems.arrays import FloatArray, IntArray
from problems.frozen import freeze

from ..errors import EstimateError, LogError
from ..result import Finding
from .medians import median
from .sweeps import turn_between

StampArray = NDArray[np.int64]

WEIGHT_NEEDS_ORIENTATION = (
    "without which the weight cannot be separated from the bias: record it, or take it from joint positions (`--urdf`);"
    " of a wrench whose weight was removed before recording (`gravity_compensated: true`) robot and contacts need none"
)

AXES = ("x", "y", "z", "rx", "ry", "rz")
"""Names of the six columns of a wrench, a twist, gains, and of what a pose has: translations, then rotations."""

LARGEST_GAP_PERIODS = 12.0
"""A longer gap is a hole: nothing can be said of the motion in it, and a log is refused that did not lose a part."""
_GAP_PERIODS = 1.5


@dataclass(frozen=True, kw_only=True)
class Frames:
    """What the cell declares: `R_FS` flange from sensor, `R_WB` our base (gravity along −z) from the log's."""

    R_FS: Rotation
    R_WB: Rotation

    @classmethod
    def plain(cls) -> "Frames":
        """Return frames that are all the same."""
        return cls(R_FS=Rotation.identity(), R_WB=Rotation.identity())


def turned_rad(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the angle [rad], 0 to π, between orientations (n, 4) or one (4,): 2 atan2(|v|, |w|) of before⁻¹ after."""
    if before.ndim == after.ndim == 2:
        cosine, sine = turn_between(before, after)
        return np.asarray(2.0 * np.arctan2(sine, cosine))
    same, across = _between(before, after)
    return np.asarray(2.0 * np.arctan2(_length(across), np.abs(same)))


def turn_vectors_rad(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return the rotation vectors (n, 3) [rad], at most π long, of before⁻¹ · after, as `before` sees them."""
    same, across = _between(before, after)
    sine = _length(across)
    # Where nothing turns the angle is twice the sine, and 0/0 is left out.
    ratio = np.full(len(sine), 2.0)
    np.divide(2.0 * np.arctan2(sine, np.abs(same)), sine, out=ratio, where=sine > 0.0)
    ratio[same < 0.0] *= -1.0
    return np.column_stack([each * ratio for each in across])


def _between(before: FloatArray, after: FloatArray) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Return w and the three components of v of before⁻¹ · after, (n,) each."""
    x, y, z, w = before.T
    a, b, c, d = after.T
    across = (w * a - d * x - y * c + z * b, w * b - d * y - z * a + x * c, w * c - d * z - x * b + y * a)
    return w * d + x * a + y * b + z * c, across


def _length(across: tuple[FloatArray, FloatArray, FloatArray]) -> FloatArray:
    x, y, z = across
    square = x * x
    square += y * y
    square += z * z
    return np.asarray(np.sqrt(square, out=square))


def slerp(time_s: FloatArray, quaternion_xyzw: FloatArray, at_s: FloatArray) -> FloatArray:
    """Interpolate orientations (m, 4) at rising `time_s` (m,) at `at_s` (n,) within them, (n, 4).

    q = (q0 sin(1 − u)θ + q1 sin uθ)/sin θ the shorter way round (Shoemake 1985, section 3.3).
    """
    before = quaternion_xyzw[:-1]
    sign = np.where(np.einsum("ij,ij->i", before, quaternion_xyzw[1:]) < 0.0, -1.0, 1.0)
    after = sign[:, None] * quaternion_xyzw[1:]
    angle = 2.0 * np.arctan2(np.linalg.norm(after - before, axis=1), np.linalg.norm(after + before, axis=1))
    index = np.clip(np.searchsorted(time_s, at_s, side="right") - 1, 0, len(time_s) - 2)
    share = (at_s - time_s[index]) / np.diff(time_s)[index]
    turn = angle[index] / np.pi
    # sin(uθ)/sin(θ) written so that an orientation that rests is no division by zero.
    whole = np.sinc(turn)
    found = before[index]
    found *= ((1.0 - share) * np.sinc((1.0 - share) * turn) / whole)[:, None]
    found += (share * np.sinc(share * turn) / whole)[:, None] * after[index]
    return np.asarray(found)


def _frozen_array(values: NDArray[np.generic], dtype: type, width: int | None, name: str) -> NDArray[np.generic]:
    array: NDArray[Any] = np.asarray(values)
    # What is read-only and owns its memory was frozen before: a changed signal shares the columns that it keeps.
    is_mine = array.flags.c_contiguous and array.base is None
    is_frozen = array.dtype == dtype and not array.flags.writeable and (is_mine or not any(array.strides))
    if not is_frozen:
        array = np.array(values, dtype=dtype, order="C")
    expected = 1 if width is None else 2
    if array.ndim != expected or (width is not None and array.shape[1] != width):
        raise LogError(f"{name} must have {expected} dimension(s) of width {width}, found shape {array.shape}.")
    array.setflags(write=False)
    return array


def _freeze(signal: object, **widths: int) -> None:
    """Replace the arrays of a signal by read-only copies of the given widths, all as long as its stamps."""
    stamps = _frozen_array(signal.stamp_ns, np.int64, None, "stamp_ns")  # type: ignore[attr-defined]
    object.__setattr__(signal, "stamp_ns", stamps)
    for name, width in widths.items():
        array = _frozen_array(getattr(signal, name), np.float64, width, name)
        if len(array) != len(stamps):
            raise LogError(f"{name} must have a row per stamp ({len(stamps)}), found {len(array)}.")
        object.__setattr__(signal, name, array)


@dataclass(frozen=True, kw_only=True)
class AppliedDeadband:
    """A deadband that was applied before recording.

    `type` is `subtractive` (the band is taken off what exceeds it) or `threshold` (what exceeds it is left as it is);
    the widths are None where they are not known.
    """

    type: str
    force_n: float | None = None
    torque_n_m: float | None = None


@dataclass(frozen=True, kw_only=True)
class WrenchSignal:
    """A wrench of the payload on the sensor, in the sensor frame, as the sensor shows it: gravity and bias still in.

    `stamp_ns` (n,) header stamps, strictly increasing; `force_n` (n, 3); `torque_n_m` (n, 3). What was done before
    recording: `gravity_compensated` and `deadband`. Axes that are not among `measured_axes` are NaN throughout.
    """

    topic: str
    frame_id: str
    stamp_ns: StampArray
    force_n: FloatArray
    torque_n_m: FloatArray
    gravity_compensated: bool = False
    deadband: AppliedDeadband | None = None
    measured_axes: tuple[str, ...] = AXES

    def __post_init__(self) -> None:
        _freeze(self, force_n=3, torque_n_m=3)

    @property
    def has_torque(self) -> bool:
        """Whether all three torques were logged, without which the centre of mass does not show."""
        return {*AXES[3:]} <= {*self.measured_axes}


def unmeasured(count: int) -> FloatArray:
    """Return (count, 3) that are NaN throughout, and take no memory."""
    return np.broadcast_to(np.nan, (count, 3))


def no_wrench(pose: "PoseSignal") -> WrenchSignal:
    """Return what replaces the wrench of a log without one: nothing measured, at the pose's stamps."""
    nothing = unmeasured(len(pose.stamp_ns))
    return WrenchSignal(
        topic="",
        frame_id="",
        stamp_ns=pose.stamp_ns,
        force_n=nothing,
        torque_n_m=nothing,
        gravity_compensated=True,
        measured_axes=(),
    )


@dataclass(frozen=True, kw_only=True)
class PoseSignal:
    """A flange pose in the base frame: `position_m` (n, 3), `quaternion_xyzw` (n, 4) of base from flange.

    With `is_displacement` the pose is relative to one that is not known. Axes that are not among `measured_axes` are
    NaN throughout, the quaternion too where any rotation is missing.
    """

    topic: str
    frame_id: str
    stamp_ns: StampArray
    position_m: FloatArray
    quaternion_xyzw: FloatArray
    is_displacement: bool = False
    measured_axes: tuple[str, ...] = AXES

    def __post_init__(self) -> None:
        _freeze(self, position_m=3, quaternion_xyzw=4)

    @property
    def has_position(self) -> bool:
        """Whether all three coordinates were logged."""
        return {*AXES[:3]} <= {*self.measured_axes}


Measured = TypeVar("Measured", WrenchSignal, PoseSignal)


def stamped_between(signal: Measured, first_ns: int, stop_ns: int) -> Measured:
    """Return the samples that are stamped from `first_ns` up to, not including, `stop_ns`."""
    kept = slice(*np.searchsorted(signal.stamp_ns, (first_ns, stop_ns)).tolist())
    arrays: dict[str, Any] = {name: each[kept] for name, each in vars(signal).items() if isinstance(each, np.ndarray)}
    return replace(signal, **arrays)


def shifted(wrench: WrenchSignal, offset_s: float) -> WrenchSignal:
    """Return the wrench with `offset_s` taken off its stamps."""
    stamps: StampArray = wrench.stamp_ns - np.int64(round(offset_s * 1e9))
    return wrench if offset_s == 0.0 else replace(wrench, stamp_ns=stamps)


@dataclass(frozen=True, kw_only=True)
class TwistSignal:
    """A flange velocity in the base frame: `linear_m_s` (n, 3), `angular_rad_s` (n, 3); NaN as in a wrench."""

    topic: str
    frame_id: str
    stamp_ns: StampArray
    linear_m_s: FloatArray
    angular_rad_s: FloatArray
    measured_axes: tuple[str, ...] = AXES

    def __post_init__(self) -> None:
        _freeze(self, linear_m_s=3, angular_rad_s=3)


@dataclass(frozen=True, kw_only=True)
class GainsSignal:
    """The controller's gains per axis of the control frame, in SI of the axis.

    `mass` (n, 6) is M_a (kg, kg·m²), `damping` (n, 6) is B_a (N·s/m, N·m·s/rad); one row where they are constant.
    `lead_s` is K_l of each axis, None where it is not known, and `deadband` what the controller takes off the force.
    """

    topic: str
    stamp_ns: StampArray
    mass: FloatArray
    damping: FloatArray
    lead_s: tuple[float, ...] | None = None
    deadband: AppliedDeadband | None = None

    def __post_init__(self) -> None:
        _freeze(self, mass=6, damping=6)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """The channels of one or more logs that `identify` needs, each on its own clock.

    `sha256` maps every log path to the digest of its bytes; `clocks` maps each role to the clock that stamps it
    (`header` or `log`); `findings` show what was chosen, assumed or left out on the way. With `keeps_holes` (a salvaged
    log) times without messages are kept as holes, of which nothing is known, instead of being refused. `wrench_lag_s`
    is how late the wrench is stamped against the pose, value and standard deviation, where the log shows it, after
    `wrench_shifted_s` were taken off its stamps as an offset between clocks that are said to be one. With
    `rows_are_poses` row i of wrench and pose is the mean of a rest, and the stamps only number them.
    """

    wrench: WrenchSignal
    pose: PoseSignal
    command: PoseSignal | None
    twist: TwistSignal | None = None
    gains: GainsSignal | None = None
    desired_force: WrenchSignal | None = None
    sha256: Mapping[str, str] = field(default_factory=dict)
    clocks: Mapping[str, str] = field(default_factory=dict)
    wrench_lag_s: tuple[float, float] | None = None
    wrench_shifted_s: float = 0.0
    findings: tuple[Finding, ...] = ()
    keeps_holes: bool = False
    rows_are_poses: bool = False

    def __post_init__(self) -> None:
        freeze(self, "sha256", "clocks")

    def require_raw(self) -> None:
        """Raise EstimateError unless this holds three raw forces and an orientation in the base frame."""
        if self.wrench.gravity_compensated:
            raise EstimateError(
                f"Gravity is already removed from the force of topic {self.wrench.topic}, so the payload's mass, its "
                "centre and the sensor's bias cannot be determined from it; record the sensor's wrench before gravity "
                "compensation."
            )
        what = f"The wrench of topic {self.wrench.topic}"
        advice = (
            "mass and bias are identified together from them, so record all three (torques may be missing, which "
            "leaves the centre of mass unknown)"
        )
        _require_axes(what, self.wrench.measured_axes, AXES[:3], advice)
        if self.pose.is_displacement:
            raise EstimateError(
                f"Topic {self.pose.topic} shows a displacement from an unknown pose, so the direction of gravity in "
                "the sensor frame cannot be determined from it; record the flange pose in the base frame."
            )
        what = f"The pose of topic {self.pose.topic}"
        _require_axes(what, self.pose.measured_axes, AXES[3:], WEIGHT_NEEDS_ORIENTATION)


def find_gaps(stamp_ns: StampArray) -> IntArray:
    """Return the numbers of the messages after which a hole of more than 12 periods begins."""
    steps = np.diff(stamp_ns)
    return np.flatnonzero(steps > LARGEST_GAP_PERIODS * median(steps)) if len(steps) else np.zeros(0, np.int64)


def sampling_rate_hz(steps_s: FloatArray) -> float | None:
    """Return the rate of a topic from the steps (n,) between its stamps, None where no time passes.

    Holes are no steps: it is that of the samples that were read.
    """
    limit = LARGEST_GAP_PERIODS * median(steps_s) if len(steps_s) else 0.0
    within = steps_s[steps_s <= limit] if limit > 0.0 else steps_s
    span_s = float(np.sum(within))
    return len(within) / span_s if span_s > 0.0 else None


def _require_axes(what: str, measured: tuple[str, ...], needed: tuple[str, ...], advice: str) -> None:
    missing = [axis for axis in needed if axis not in measured]
    if missing:
        all_of_them = "forces along x, y and z" if needed == AXES[:3] else "an orientation"
        raise EstimateError(f"{what} must have {all_of_them}, found none for {', '.join(missing)}; {advice}.")


def join_recordings(parts: Sequence[Recording]) -> Recording:
    """Join recordings that hold the same topics in the same frames, in the order of their stamps.

    What a part repeats of the one before (the same stamps with the same values) is dropped; parts that overlap
    otherwise are refused with LogError, as are parts that differ in topics, frames or channels. Digests and findings
    of all parts are kept, and a gap at a seam is a finding.
    """
    if not parts:
        raise LogError("Joining needs at least one log, found none.")
    ordered = sorted(parts, key=lambda part: int(part.wrench.stamp_ns[0]) if len(part.wrench.stamp_ns) else 0)
    changes: dict[str, Any] = {
        "sha256": {path: digest for part in ordered for path, digest in part.sha256.items()},
        "clocks": _same("clocks", [dict(part.clocks) for part in ordered]),
    }
    findings = [finding for part in ordered for finding in part.findings]
    for each in fields(Recording):
        signals = [getattr(part, each.name) for part in ordered]
        if any(hasattr(signal, "stamp_ns") for signal in signals):
            lacking = [
                ", ".join(part.sha256) or "one of them"
                for part, signal in zip(ordered, signals, strict=True)
                if signal is None
            ]
            if lacking:
                raise LogError(
                    f"All parts of a log must hold the same channels; the {each.name} is missing in "
                    f"{', '.join(lacking)}. Join only logs of one run, or leave that part out."
                )
            changes[each.name] = _joined(each.name, signals, findings)
    return replace(ordered[0], **changes, findings=tuple(dict.fromkeys(findings)))


def _joined(role: str, signals: Sequence[Any], findings: list[Finding]) -> Any:
    names = [each.name for each in fields(signals[0])]
    rows = [name for name in names if isinstance(getattr(signals[0], name), np.ndarray)]
    for name in names:
        if name not in rows:
            _same(f"the {name} of the {role}", [getattr(signal, name) for signal in signals])
    whole = {name: getattr(signals[0], name) for name in rows}
    for signal in signals[1:]:
        whole = _appended(role, signals[0].topic, whole, {name: getattr(signal, name) for name in rows}, findings)
    return replace(signals[0], **whole)


def _same(what: str, values: Sequence[Any]) -> Any:
    """Return what all parts agree in; raise LogError when they do not."""
    for value in values[1:]:
        if value != values[0]:
            raise LogError(
                f"All parts of a log must agree in {what}, found {values[0]!r} and {value!r}. Join only logs of "
                "one run."
            )
    return values[0]


def _appended(
    role: str, topic: str, before: dict[str, Any], after: dict[str, Any], findings: list[Finding]
) -> dict[str, Any]:
    """Return two parts as one, without what the second repeats of the first."""
    stamps, following = before["stamp_ns"], after["stamp_ns"]
    if not len(stamps) or not len(following):
        return after if not len(stamps) else before
    repeated = int(np.searchsorted(following, stamps[-1], side="right"))
    if repeated:
        start = len(stamps) - repeated
        same = start >= 0 and all(
            np.array_equal(before[name][start:], after[name][:repeated], equal_nan=before[name].dtype.kind == "f")
            for name in before
        )
        if not same:
            raise LogError(
                f"Parts of a log must follow each other; those of the {role} `{topic}` overlap by "
                f"{(stamps[-1] - following[0]) * 1e-9:.3f} s with different samples. Join only logs of one run, each "
                "once."
            )
        after = {name: value[repeated:] for name, value in after.items()}
        following = after["stamp_ns"]
    if len(following) and len(stamps) > 1:
        gap, period = int(following[0] - stamps[-1]), float(np.median(np.diff(stamps)))
        if gap > _GAP_PERIODS * period:
            findings.append(
                Finding.warning(
                    "gap-between-parts",
                    f"{gap * 1e-9:.4f} s of `{topic}` are missing between two parts of the log (its period is "
                    f"{period * 1e-9:.6f} s).",
                    "Give all parts of the log, and let the recorder split without losing messages.",
                )
            )
    return {name: np.concatenate([before[name], after[name]]) for name in before}
