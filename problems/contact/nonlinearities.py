"""What the linear loop leaves out: sensor, limits on the command, collision response, variable damping."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from .._checks import non_negative, positive
from ..errors import ParameterError

Response = Literal["none", "reset", "stop"]


class DeadbandType(StrEnum):
    """What happens to a force beyond the deadband: it passes whole, or less the deadband."""

    THRESHOLD = "threshold"
    SUBTRACTIVE = "subtractive"


@dataclass(frozen=True, kw_only=True)
class Deadband:
    """A force of at most `width_n` counts as none.

    The paper's deadband is of the type `threshold`.
    """

    width_n: float
    kind: DeadbandType = DeadbandType.THRESHOLD

    def __post_init__(self) -> None:
        object.__setattr__(self, "width_n", non_negative("deadband.width_n", self.width_n))
        if self.kind not in set(DeadbandType):
            raise ParameterError("deadband.kind", self.kind, "threshold or subtractive")
        object.__setattr__(self, "kind", DeadbandType(self.kind))


@dataclass(frozen=True, kw_only=True)
class CommandLimits:
    """Limits on speed and acceleration of the position command from tick to tick; None is no limit.

    The controller's difference equation goes on from the command that was sent, so nothing winds up behind a limit.
    """

    speed_m_s: float | None = None
    acceleration_m_s2: float | None = None

    def __post_init__(self) -> None:
        for name in ("speed_m_s", "acceleration_m_s2"):
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, positive(f"limits.{name}", value))


@dataclass(frozen=True, kw_only=True)
class Collision:
    """Collision detection, and what follows the first tick with −F·sign(v) above `threshold_n`.

    F is what the controller sees, v the flange's way over the last period. "reset" is the paper's Algorithm 1: the
    command stays for one tick and the admittance's velocity is zero from there; "stop" holds the command for good;
    "none" reports the time only. C_fb goes on working on the measured motion, so after a reset the command follows
    the flange as it slows down.
    """

    response: Response = "reset"
    threshold_n: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "threshold_n", positive("collision.threshold_n", self.threshold_n))
        if self.response not in {"none", "reset", "stop"}:
            raise ParameterError("collision.response", self.response, "none, reset or stop")


@dataclass(frozen=True, kw_only=True)
class VariableDamping:
    """B_a(|v|) = max(scale·exp(−decay·|v|), floor), in place of the controller's B_a; the paper's by default.

    B_a is updated every `update_period_s`, at the first tick that is not earlier, by `largest_change_n_s_per_m` at
    most; v is the flange's way over the last period. The difference equation goes on from its last two commands, so
    the command and its velocity stay continuous.
    """

    scale_n_s_per_m: float = 800.0
    decay_s_per_m: float = 8.0
    floor_n_s_per_m: float = 550.0
    update_period_s: float = 0.01
    largest_change_n_s_per_m: float = 20.0

    def __post_init__(self) -> None:
        for name in ("scale_n_s_per_m", "floor_n_s_per_m", "update_period_s", "largest_change_n_s_per_m"):
            object.__setattr__(self, name, positive(f"variable_damping.{name}", getattr(self, name)))
        object.__setattr__(self, "decay_s_per_m", non_negative("variable_damping.decay_s_per_m", self.decay_s_per_m))

    @property
    def bounds_n_s_per_m(self) -> tuple[float, float]:
        """Lowest and highest B_a."""
        return self.floor_n_s_per_m, max(self.scale_n_s_per_m, self.floor_n_s_per_m)


@dataclass(frozen=True, kw_only=True)
class Nonlinearities:
    """What the linear loop leaves out; by default nothing is.

    To the measured force comes first white noise of `force_noise_rms_n` per tick, then clipping at ±`force_limit_n`
    (the sensor's range), then the deadband. Of the commands a share of `late_share`, drawn at random, is a period late:
    the robot goes on with the command before, and has both when the next one arrives.
    """

    deadband: Deadband | None = None
    force_limit_n: float | None = None
    force_noise_rms_n: float = 0.0
    limits: CommandLimits | None = None
    collision: Collision | None = None
    variable_damping: VariableDamping | None = None
    late_share: float = 0.0

    def __post_init__(self) -> None:
        if self.force_limit_n is not None:
            object.__setattr__(self, "force_limit_n", positive("force_limit_n", self.force_limit_n))
        object.__setattr__(self, "force_noise_rms_n", non_negative("force_noise_rms_n", self.force_noise_rms_n))
        if not 0.0 <= self.late_share < 1.0:
            raise ParameterError("late_share", self.late_share, "at least 0 and below 1")


NO_NONLINEARITIES = Nonlinearities()
