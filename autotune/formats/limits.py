"""What of `controller.yaml` the runtime does beside its law: collision response, variable damping, limits."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, get_type_hints

from problems.errors import ParameterError
from problems.frozen import FrozenDict, Rule, freeze

from .units import AXES

MOST_REST_SAMPLES = 100_000
MOST_POSE_SPEED_M_S, MOST_POSE_SPEED_RAD_S = 20.0, 50.0
Peak = Annotated[float, Rule(minimum=-1_000_000, maximum=1_000_000)]


class CollisionResponse(StrEnum):
    """What the runtime does on collision: nothing, the position reset of the paper's Algorithm 1, or a full stop."""

    NONE = "none"
    RESET = "reset"
    STOP = "stop"


@dataclass(frozen=True, kw_only=True)
class VariableDampingSettings:
    """B_a(|v|) = max(highest·exp(−decay·|v|), lowest) [N·s/m], in place of B_a; v is the flange's way over a period.

    B_a is updated every `update_periods` periods, by `largest_change` at most. The difference equation goes on from its
    last two commands, so that the command and its speed stay continuous.

    Raises ParameterError unless 0 < lowest ≤ highest, the others are positive, and `decay_s_per_m` is not negative.
    """

    highest: Annotated[float, Rule(minimum=1, maximum=1_000_000)]
    lowest: Annotated[float, Rule(minimum=1, maximum=1_000_000)]
    decay_s_per_m: Annotated[float, Rule(minimum=0, maximum=10_000)]
    update_periods: Annotated[int, Rule(minimum=1, maximum=100_000)]
    largest_change: Annotated[float, Rule(exclusiveMinimum=0, maximum=1_000_000)]

    def __post_init__(self) -> None:
        for name in ("highest", "lowest", "largest_change"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "greater than 0")
        if self.lowest > self.highest:
            raise ParameterError("lowest", self.lowest, f"at most the highest, {self.highest:g}")
        if not 0.0 <= self.decay_s_per_m < math.inf:
            raise ParameterError("decay_s_per_m", self.decay_s_per_m, "at least 0")
        if not 1 <= self.update_periods < math.inf:
            raise ParameterError("update_periods", self.update_periods, "at least 1")


@dataclass(frozen=True, kw_only=True)
class Biquad:
    """N = (1 + 2 ζ_z τ_z s + τ_z² s²)/(1 + 2 ζ_p τ_p s + τ_p² s²), which the force passes before the admittance.

    `zero_s` τ_z and `pole_s` τ_p are the time constants 1/ω (s), `zero_damping_ratio` and `pole_damping_ratio` ζ.
    Raises ParameterError unless τ_p and ζ_p are positive and the others not negative.
    """

    zero_s: Annotated[float, Rule(minimum=0, maximum=10)]
    zero_damping_ratio: Annotated[float, Rule(minimum=0, maximum=100)]
    pole_s: Annotated[float, Rule(exclusiveMinimum=0, maximum=10)]
    pole_damping_ratio: Annotated[float, Rule(exclusiveMinimum=0, maximum=100)]

    def __post_init__(self) -> None:
        for name in ("zero_s", "zero_damping_ratio"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "at least 0")
        for name in ("pole_s", "pole_damping_ratio"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ParameterError(name, getattr(self, name), "greater than 0")

    def describe(self) -> str:
        """Return corners and damping in words."""
        ends = {"zero": (self.zero_s, self.zero_damping_ratio), "pole": (self.pole_s, self.pole_damping_ratio)}
        said = [
            f"{name} at {1.0 / (2.0 * math.pi * time):.4g} Hz (ζ {damping:.4g})"
            for name, (time, damping) in ends.items()
            if time > 0.0
        ]
        return ", ".join(said)

    def numbers(self) -> tuple[float, float, float, float]:
        """Return (τ_z, ζ_z, τ_p, ζ_p)."""
        return self.zero_s, self.zero_damping_ratio, self.pole_s, self.pole_damping_ratio


@dataclass(frozen=True, kw_only=True)
class AxisLimits:
    """Largest commanded speed (m/s, rad/s) and acceleration (m/s², rad/s²) of one axis.

    Speed is |x^d_k − x^d_{k−1}|/h, acceleration the change of the speed from one period to the next, per h.
    `followed_speed` is the largest speed behind a first-order lag of `followed_lag_s`: that of a robot which follows
    the command so; None for no such limit.

    Raises ParameterError unless all are positive and finite, and those of the lag given together.
    """

    speed: Annotated[float, Rule(exclusiveMinimum=0, maximum=20)]
    acceleration: Annotated[float, Rule(exclusiveMinimum=0, maximum=100_000)]
    followed_speed: Annotated[float, Rule(exclusiveMinimum=0, maximum=20)] | None = None
    followed_lag_s: Annotated[float, Rule(exclusiveMinimum=0, maximum=10)] | None = None

    def __post_init__(self) -> None:
        _check_positive(self)
        if (self.followed_speed is None) != (self.followed_lag_s is None):
            raise ParameterError("followed_lag_s", self.followed_lag_s, "given with followed_speed, and only with it")

    def describe(self, unit: str) -> str:
        """Return the limits in words; `unit` is that of the speed."""
        lag = f" ({self.followed_speed:g} behind the robot's lag)" if self.followed_speed is not None else ""
        return f"{self.speed:g} {unit}{lag} and {self.acceleration:g} {unit}²"

    def followed_weight(self, sample_time_s: float) -> float:
        """Return by how much of what is missing the followed speed goes on in a period; 1 without a lag."""
        return 1.0 if self.followed_lag_s is None else -math.expm1(-sample_time_s / self.followed_lag_s)


@dataclass(frozen=True, kw_only=True)
class LimitsNoise:
    """The noise that the limits leave room for, RMS: wrench and pose.

    `gravity_residual_n` is what the identified compensation left over in the poses of the log.
    """

    force_n: Annotated[float, Rule(minimum=0, maximum=1000)] = 0.0
    torque_n_m: Annotated[float, Rule(minimum=0, maximum=200)] = 0.0
    position_m: Annotated[float, Rule(minimum=0, maximum=0.1)] = 0.0
    gravity_residual_n: Annotated[float, Rule(minimum=0, maximum=1000)] = 0.0


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a reading and a command must stay within; the runtime holds the command once they do not.

    `force_n` and `torque_n_m` are the range of each component of the raw wrench, `axes` what is commanded, by axis.
    The measured pose goes no faster than `pose_speed_m_s` and `pose_speed_rad_s`, counted over the time since it
    last changed. A wrench, or pose, that does not change for `stale_wrench_s`, or `stale_pose_s`, while the command
    moves is stale. The mean of the first `rest_samples` wrenches, without weight and bias, is at most `rest_force_n`
    and `rest_torque_n_m` in magnitude. `reasons` says by name why a value is what it is, `noise` for which
    noise they were chosen; None in files of an earlier release.

    Raises ParameterError unless every number is positive and finite and `rest_samples` is between 1 and 100000.
    """

    force_n: Annotated[float, Rule(exclusiveMinimum=0, maximum=100_000)]
    torque_n_m: Annotated[float, Rule(exclusiveMinimum=0, maximum=10_000)]
    axes: Annotated[Mapping[Annotated[str, Rule(enum=AXES)], AxisLimits], Rule(minProperties=1)]
    pose_speed_m_s: Annotated[float, Rule(exclusiveMinimum=0, maximum=MOST_POSE_SPEED_M_S)]
    pose_speed_rad_s: Annotated[float, Rule(exclusiveMinimum=0, maximum=MOST_POSE_SPEED_RAD_S)]
    stale_wrench_s: Annotated[float, Rule(exclusiveMinimum=0, maximum=10)]
    stale_pose_s: Annotated[float, Rule(exclusiveMinimum=0, maximum=10)]
    rest_samples: Annotated[int, Rule(minimum=1, maximum=MOST_REST_SAMPLES)]
    rest_force_n: Annotated[float, Rule(exclusiveMinimum=0, maximum=1000)]
    rest_torque_n_m: Annotated[float, Rule(exclusiveMinimum=0, maximum=200)]
    noise: LimitsNoise | None = None
    reasons: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_positive(self)
        if not 1 <= self.rest_samples <= MOST_REST_SAMPLES or self.rest_samples != int(self.rest_samples):
            raise ParameterError("rest_samples", self.rest_samples, f"a whole number from 1 to {MOST_REST_SAMPLES}")
        object.__setattr__(self, "rest_samples", int(self.rest_samples))
        freeze(self, "axes", "reasons")


@dataclass(frozen=True, kw_only=True)
class ResidualPeaks:
    """The worst peaks (N) where the gravity compensation leaves `force_n` along F^d, as the runtime allows."""

    force_n: Annotated[float, Rule(minimum=0)]
    peak_sensor_force_n: Peak
    peak_contact_force_n: Peak


@dataclass(frozen=True, kw_only=True)
class LimitsSpec:
    """What `problem.yaml` says of the limits: `values` by name, and by axis in `axes` speed and acceleration."""

    values: Mapping[str, float] = field(default_factory=dict)
    axes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "values")
        of_axes = {name: FrozenDict(each) for name, each in self.axes.items()}
        object.__setattr__(self, "axes", FrozenDict(of_axes))


def _check_positive(record: AxisLimits | Limits) -> None:
    """Make a float of each that is declared as one; raises ParameterError unless it is positive and finite."""
    for name, kind in get_type_hints(type(record)).items():
        given = getattr(record, name)
        if kind is float or (kind == float | None and given is not None):
            value = float(given)
            if not 0.0 < value < math.inf:
                raise ParameterError(name, value, "greater than 0")
            object.__setattr__(record, name, value)
