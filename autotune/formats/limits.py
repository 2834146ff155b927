"""The `limits` of `controller.yaml`: which readings the runtime takes, and which commands it sends."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from problems.errors import ParameterError
from problems.frozen import FrozenDict, freeze

MOST_REST_SAMPLES = 100_000

_POSITIVE = (
    "force_n",
    "torque_n_m",
    "pose_speed_m_s",
    "pose_speed_rad_s",
    "stale_wrench_s",
    "stale_pose_s",
    "rest_force_n",
    "rest_torque_n_m",
)


class CollisionResponse(StrEnum):
    """What the runtime does on collision: nothing, the position reset of the paper's Algorithm 1, or a full stop."""

    NONE = "none"
    RESET = "reset"
    STOP = "stop"


@dataclass(frozen=True, kw_only=True)
class AxisLimits:
    """Largest commanded speed (m/s, rad/s) and acceleration (m/s², rad/s²) of one axis.

    Speed is |x^d_k − x^d_{k−1}|/h, acceleration the change of the speed from one period to the next, per h.

    Raises ParameterError unless both are positive and finite.
    """

    speed: float
    acceleration: float

    def __post_init__(self) -> None:
        _check_positive(self, ("speed", "acceleration"))


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a reading and a command must stay within; the runtime holds the command once they do not.

    `force_n` and `torque_n_m` are the range of each component of the raw wrench, `axes` what is commanded, by axis.
    The measured pose goes no faster than `pose_speed_m_s` and `pose_speed_rad_s`, counted over the time since it
    last changed. A wrench, or pose, that does not change for `stale_wrench_s`, or `stale_pose_s`, while the command
    moves is stale. The mean of the first `rest_samples` wrenches, without weight and bias, is at most `rest_force_n`
    and `rest_torque_n_m` in magnitude. `reasons` says by name why a value is what it is.

    Raises ParameterError unless every number is positive and finite and `rest_samples` is between 1 and 100000.
    """

    force_n: float
    torque_n_m: float
    axes: Mapping[str, AxisLimits]
    pose_speed_m_s: float
    pose_speed_rad_s: float
    stale_wrench_s: float
    stale_pose_s: float
    rest_samples: int
    rest_force_n: float
    rest_torque_n_m: float
    reasons: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_positive(self, _POSITIVE)
        if not 1 <= self.rest_samples <= MOST_REST_SAMPLES or self.rest_samples != int(self.rest_samples):
            raise ParameterError("rest_samples", self.rest_samples, f"a whole number from 1 to {MOST_REST_SAMPLES}")
        object.__setattr__(self, "rest_samples", int(self.rest_samples))
        freeze(self, "axes", "reasons")


@dataclass(frozen=True, kw_only=True)
class ResidualPeaks:
    """The worst peaks (N) where the gravity compensation leaves `force_n` along F^d, as the runtime allows."""

    force_n: float
    peak_sensor_force_n: float
    peak_contact_force_n: float


@dataclass(frozen=True, kw_only=True)
class LimitsSpec:
    """What `problem.yaml` says of the limits: `values` by name, and by axis in `axes` speed and acceleration."""

    values: Mapping[str, float] = field(default_factory=dict)
    axes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "values")
        of_axes = {name: FrozenDict(each) for name, each in self.axes.items()}
        object.__setattr__(self, "axes", FrozenDict(of_axes))


def _check_positive(record: object, names: tuple[str, ...]) -> None:
    for name in names:
        value = float(getattr(record, name))
        if not 0.0 < value < math.inf:
            raise ParameterError(name, value, "greater than 0")
        object.__setattr__(record, name, value)
