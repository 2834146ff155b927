"""What the full simulation adds to the linear loop of a certificate: what the file says, and what it cannot say."""

from collections.abc import Callable
from dataclasses import dataclass

from autotune.formats.controller_record import Controller, file_deadband
from autotune.formats.limits import CollisionResponse, VariableDampingSettings
from autotune.formats.units import ROTATIONAL_AXES
from problems.contact.nonlinearities import Collision, CommandLimits, Nonlinearities, Response, VariableDamping
from problems.design.requirements import NoiseLimit
from problems.errors import ParameterError

# A good six-axis sensor at rest, N and N·m; taken where neither the file nor the caller says more.
_USUAL_NOISE = 0.2, 0.02
# The reduced speed of ISO 10218-1, at which a robot is led by hand.
_REDUCED_SPEED_M_S = 0.25
_USUAL_LATE_SHARE = 0.01
# A limit on the command that the approach itself would meet is none that the cell has.
_ABOVE_APPROACH = 2.0


@dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What the caller knows of the cell, as pairs for x, y, z and for rx, ry, rz; None where it is not said.

    `noise_rms` of the sensor per tick [N, N·m], `sensor_range` at which it clips [N, N·m], `speed_limit` of the command
    [m/s, rad/s]; `late_share` of the commands is a period late.
    """

    noise_rms: tuple[float | None, float | None] = (None, None)
    sensor_range: tuple[float | None, float | None] = (None, None)
    speed_limit: tuple[float | None, float | None] = (None, None)
    late_share: float | None = None

    def __post_init__(self) -> None:
        for name, is_sound, must in _RULES:
            for value in getattr(self, name):
                if value is not None and not is_sound(value):
                    raise ParameterError(name, value, must)
        if self.late_share is not None and not 0.0 <= self.late_share < 1.0:
            raise ParameterError("late_share", self.late_share, "at least 0 and below 1")


_RULES: tuple[tuple[str, Callable[[float], bool], str], ...] = (
    ("noise_rms", lambda value: 0.0 <= value < float("inf"), "not below 0"),
    ("sensor_range", lambda value: 0.0 < value < float("inf"), "above 0"),
    ("speed_limit", lambda value: 0.0 < value < float("inf"), "above 0"),
)


def axis_effects(
    controller: Controller, name: str, disturbances: Disturbances, approach_speed: float
) -> Nonlinearities:
    """Return deadband, noise, clipping, limit on the command and late commands of one axis.

    The deadband is the file's. The noise is what the caller says, else that of the file's limit on the command's noise,
    else 0.2 N or 0.02 N·m; the sensor clips only where its range is said; the command of x, y, z is limited to 0.25 m/s
    unless the approach alone is nearly as fast; 1 % of the commands are late. Collision response and variable damping
    are the file's.
    """
    turns, variable = name in ROTATIONAL_AXES, controller.damping_of(name)
    speed = disturbances.speed_limit[turns]
    if speed is None and not turns:
        speed = max(_REDUCED_SPEED_M_S, _ABOVE_APPROACH * approach_speed)
    return Nonlinearities(
        deadband=file_deadband(controller.axes[name]),
        force_limit_n=disturbances.sensor_range[turns],
        force_noise_rms_n=_noise_rms(controller, name, disturbances),
        limits=None if speed is None else CommandLimits(speed_m_s=speed),
        late_share=_USUAL_LATE_SHARE if disturbances.late_share is None else disturbances.late_share,
        collision=_file_response(controller, name),
        variable_damping=None if variable is None else simulated_damping(variable, controller.sample_time_s),
    )


def file_strategy(controller: Controller, name: str) -> Nonlinearities:
    """Return collision response and variable damping of one axis, and nothing else."""
    variable = controller.damping_of(name)
    return Nonlinearities(
        collision=_file_response(controller, name),
        variable_damping=None if variable is None else simulated_damping(variable, controller.sample_time_s),
    )


def simulated_damping(variable: VariableDampingSettings, sample_time_s: float) -> VariableDamping:
    """Return the variable damping of a file as the full simulation takes it."""
    return VariableDamping(
        scale_n_s_per_m=variable.highest,
        decay_s_per_m=variable.decay_s_per_m,
        floor_n_s_per_m=variable.lowest,
        update_period_s=variable.update_periods * sample_time_s,
        largest_change_n_s_per_m=variable.largest_change,
    )


def _file_response(controller: Controller, name: str) -> Collision | None:
    """Return the collision response of an axis; the motion of axes that turn is not watched."""
    collision = controller.collision
    if collision.threshold_n is None or name in ROTATIONAL_AXES:
        return None
    kind: Response = "reset" if collision.response is CollisionResponse.RESET else "stop"
    return Collision(response=kind, threshold_n=collision.threshold_n)


def _noise_rms(controller: Controller, name: str, disturbances: Disturbances) -> float:
    turns = name in ROTATIONAL_AXES
    said = disturbances.noise_rms[turns]
    if said is not None:
        return said
    limit = (controller.certificate.requirements_of(name) or {}).get("command_noise")
    if isinstance(limit, NoiseLimit) and limit.force_noise_rms_n is not None:
        return limit.force_noise_rms_n
    return _USUAL_NOISE[turns]
