"""Watch readings and commands beside the control law: limits in periods, readings that do not change, and weight.

Each line is the same operation in the same order as in the exported C, which has no square root.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

from autotune.formats.limits import Limits

from .frames import Nine, Place, Six, into_sensor
from .law import AxisLaw, Payload

# A pose that comes at a lower rate than the periods may make up at once for so many of them.
MOST_HELD = 10
# Command that a wrench, or a pose (which may be coarse, and lags), need not answer: the sum over the axes, m and rad.
UNFELT_WAY, UNSEEN_WAY = 1e-4, 1e-3
# A weight is judged by its first-order mean over so many periods, and once it was constant for so long.
MEAN_PERIODS, WEIGHT_S = 32.0, 0.5
# How far it must have moved the command, m up or down; no sensor's noise and no contact does that at a constant force.
WEIGHT_WAY = 5e-3
# A force is a weight where so little of it, tan² of 10°, lies across gravity, beside `rest_force_n`.
ACROSS = 0.03125
# Smaller ones are left alone: this share of the mass that is compensated, and twice the smallest deadband.
LEAST_SHARE, LEAST_DEADBANDS = 0.1, 2.0
MOST_PERIODS = 2**30
UNLIMITED = 1e300


@dataclass(frozen=True, kw_only=True)
class Guard:
    """The limits of a controller in its periods: ways per period, numbers of periods, squares of magnitudes.

    `speeds` and `changes` of the tuned axes are the largest speed and its largest change in a period, `followed` the
    largest speed behind a lag, `weights` what a period adds to it (`UNLIMITED` and 1 without such a limit).
    `least_weight` is (N)² below which no missing weight is looked for.
    """

    limits: Limits
    sample_time_s: float
    axes: tuple[AxisLaw, ...]
    way_m: float = field(init=False)
    way_rad: float = field(init=False)
    wrench_periods: int = field(init=False)
    pose_periods: int = field(init=False)
    weight_periods: int = field(init=False)
    rest_force: float = field(init=False)
    rest_torque: float = field(init=False)
    least_weight: float = field(init=False)
    speeds: tuple[float, ...] = field(init=False)
    changes: tuple[float, ...] = field(init=False)
    followed: tuple[float, ...] = field(init=False)
    weights: tuple[float, ...] = field(init=False)

    def __post_init__(self) -> None:
        limits, h = self.limits, self.sample_time_s
        commands = [limits.axes[axis.name] for axis in self.axes]
        least = LEAST_DEADBANDS * max(limits.rest_force_n, _smallest_deadband(self.axes))
        derived = {
            "way_m": limits.pose_speed_m_s * h,
            "way_rad": limits.pose_speed_rad_s * h,
            "wrench_periods": _periods(limits.stale_wrench_s, h),
            "pose_periods": _periods(limits.stale_pose_s, h),
            "weight_periods": _periods(WEIGHT_S, h),
            "rest_force": limits.rest_force_n * limits.rest_force_n,
            "rest_torque": limits.rest_torque_n_m * limits.rest_torque_n_m,
            "least_weight": least * least,
            "speeds": tuple(each.speed for each in commands),
            "changes": tuple(each.acceleration * h for each in commands),
            "followed": tuple(each.followed_speed or UNLIMITED for each in commands),
            "weights": tuple(each.followed_weight(h) for each in commands),
        }
        for name, value in derived.items():
            object.__setattr__(self, name, value)


def _periods(duration_s: float, h: float) -> int:
    return max(1, min(MOST_PERIODS, round(duration_s / h)))


def _smallest_deadband(axes: tuple[AxisLaw, ...]) -> float:
    return min((axis.deadband for axis in axes if not axis.turns), default=0.0)


class Watch(NamedTuple):
    """What is kept of the readings: the last ones, how many periods they did not change, and the way sent meanwhile.

    `resting` readings were taken at the start, and `sums` is theirs. `missing_kg` is the mean of what the compensation
    leaves along gravity; for `weight_since` periods it was `weight_kg` and did `weight_work` [J] on the command.
    """

    wrench: Six | None = None
    wrench_same: int = 0
    wrench_way: float = 0.0
    pose_same: int = 0
    pose_way: float = 0.0
    resting: int = 0
    sums: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    missing_kg: float = 0.0
    weight_kg: float = 0.0
    weight_since: int = 0
    weight_work: float = 0.0


def see(watch: Watch, wrench: Six, before: Place | None, place: Place) -> Watch:
    """Return the watch after a reading: what did not change counts on, what did begins again."""
    same = watch.wrench is not None and wrench == watch.wrench
    still = before is not None and place == before
    return watch._replace(
        wrench=wrench,
        wrench_same=_one_more(watch.wrench_same) if same else 0,
        wrench_way=watch.wrench_way if same else 0.0,
        pose_same=_one_more(watch.pose_same) if still else 0,
        pose_way=watch.pose_way if still else 0.0,
    )


def _one_more(count: int) -> int:
    return count + 1 if count < MOST_PERIODS else count


def send(watch: Watch, increment: Six) -> Watch:
    """Return the watch after a command."""
    way = 0.0
    for each in increment:
        way += abs(each)
    return watch._replace(wrench_way=watch.wrench_way + way, pose_way=watch.pose_way + way)


def rest(guard: Guard, payload: Payload, watch: Watch, external: Six, R: Nine) -> tuple[Watch, bool]:
    """Return the watch after one of the first readings, and whether their mean is no rest: too much is left.

    With the last of them `missing_kg` is what their mean leaves along gravity.
    """
    s, count = watch.sums, watch.resting + 1
    sums: Six = (
        s[0] + external[0],
        s[1] + external[1],
        s[2] + external[2],
        s[3] + external[3],
        s[4] + external[4],
        s[5] + external[5],
    )
    watch = watch._replace(resting=count, sums=sums)
    if count < guard.limits.rest_samples:
        return watch, False
    n = float(count)
    x, y, z = sums[0] / n, sums[1] / n, sums[2] / n
    rx, ry, rz = sums[3] / n, sums[4] / n, sums[5] / n
    left, turning = x * x + y * y + z * z, rx * rx + ry * ry + rz * rz
    missing = missing_mass_kg(payload, (x, y, z, rx, ry, rz), R)
    return watch._replace(missing_kg=missing), left > guard.rest_force or turning > guard.rest_torque


def missing_mass_kg(payload: Payload, external: Six, R: Nine) -> float:
    """Return F·g/g², the mass whose weight the compensation leaves of the wrench; 0 without gravity."""
    g = payload.gravity_W_m_s2
    square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2]
    if not square > 0.0:
        return 0.0
    down = into_sensor(R, g)
    return (external[0] * down[0] + external[1] * down[1] + external[2] * down[2]) / square


def weigh(guard: Guard, payload: Payload, watch: Watch, external: Six, R: Nine, increment: Six) -> tuple[Watch, bool]:
    """Return the watch, and whether a weight that nobody compensates moves the command: the payload is another one.

    A hand is not that steady and a contact not that constant: it is a force along gravity that is constant to
    `rest_force_n` for `WEIGHT_S` while it moves the command by `WEIGHT_WAY` up or down, in its own direction.
    """
    g = payload.gravity_W_m_s2
    square = g[0] * g[0] + g[1] * g[1] + g[2] * g[2]
    x, y, z = external[0], external[1], external[2]
    now = missing_mass_kg(payload, external, R)
    mean = watch.missing_kg + (now - watch.missing_kg) / MEAN_PERIODS
    along, moved = mean * mean * square, mean - watch.weight_kg
    across = (x * x + y * y + z * z) - now * now * square
    least = LEAST_SHARE * payload.mass_kg
    is_constant = (
        moved * moved * square <= guard.rest_force
        and across <= ACROSS * along + guard.rest_force
        and along >= guard.least_weight
        and mean * mean >= least * least
    )
    if not is_constant:
        return watch._replace(missing_kg=mean, weight_kg=mean, weight_since=0, weight_work=0.0), False
    since = _one_more(watch.weight_since)
    work = watch.weight_work + (x * increment[0] + y * increment[1] + z * increment[2])
    watch = watch._replace(missing_kg=mean, weight_since=since, weight_work=work)
    is_other = since >= guard.weight_periods and work > 0.0 and work * work >= WEIGHT_WAY * WEIGHT_WAY * along
    return watch, is_other
