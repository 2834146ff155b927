"""What is fed to the runtime to see what it notices: a robot that follows its command, under readings that go wrong."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from autotune.runtime import AXES, Fault, Payload, RuntimeController
from autotune.validation.replay import robot_alone
from autotune.validation.replay_kernel import over_sample
from problems.arrays import FloatArray
from problems.model.robot import RobotModel
from tests.autotune.runtime.cases import Reading

NOISE = np.array([0.14] * 3 + [0.012] * 3)
POSE_NOISE_M = 2e-6
# Rest, then a hand that leads the tool, then what goes wrong.
REST_S, LED_S = 0.3, 1.0
PUSH_N = 30.0
# What the table speaks of lasts up to so long.
_WRONG_S = 5.0


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One period of a case: seconds since it went wrong (below 0 before), and what is there without anything wrong.

    `before` is the reading of the period before, `count` that of the periods.
    """

    time_s: float
    reading: Reading
    before: Reading
    payload: Payload
    controller: RuntimeController
    axis: int
    count: int


Change = Callable[[Moment], Reading | None]


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is fed, in words; how a reading is changed (None: this period is missed); which fault must follow.

    `load` is what the cell carries, as a share of what is compensated. `tilt_rad` turns the tool about y. `or_else` are
    faults that may come first, for a controller that reacts faster.
    """

    fed: str
    fault: Fault
    change: Change
    load: float = 1.0
    tilt_rad: float = 0.0
    push_n: float = PUSH_N
    or_else: tuple[Fault, ...] = ()
    lasts_s: float = _WRONG_S


def _nothing(moment: Moment) -> Reading:
    return moment.reading


def _added(wrench: FloatArray, lasts_s: float) -> Change:
    def change(moment: Moment) -> Reading:
        acts = 0.0 <= moment.time_s < lasts_s
        return replace(moment.reading, wrench_S=moment.reading.wrench_S + wrench) if acts else moment.reading

    return change


def _along(moment: Moment, size: float) -> FloatArray:
    out = np.zeros(6)
    out[moment.axis] = size
    return out


def _force(size: float, lasts_s: float) -> Change:
    return lambda moment: _added(_along(moment, size), lasts_s)(moment)


def _once(make: Callable[[Reading, Moment], Reading]) -> Change:
    def change(moment: Moment) -> Reading:
        now = 0.0 <= moment.time_s < 0.5 * moment.controller.sample_time_s
        return make(moment.reading, moment) if now else moment.reading

    return change


def _from_then(make: Callable[[Reading, Moment], Reading]) -> Change:
    return lambda moment: make(moment.reading, moment) if moment.time_s >= 0.0 else moment.reading


def _glitch(reading: Reading, moment: Moment) -> Reading:
    return replace(reading, position_W_m=reading.position_W_m + 0.09 * reading.R_WS[:, moment.axis % 3])


def _frozen_pose(reading: Reading, moment: Moment) -> Reading:
    return replace(reading, position_W_m=moment.before.position_W_m, R_WS=moment.before.R_WS)


def _half_missed(moment: Moment) -> Reading | None:
    return None if moment.time_s >= 0.0 and moment.count % 2 else moment.reading


def _payload_gone(reading: Reading, moment: Moment) -> Reading:
    """The sensor shows what the hand let go of: its bias and noise."""
    bias = np.array([*moment.payload.force_bias_S_n, *moment.payload.torque_bias_S_n_m])
    noise = np.random.default_rng(moment.count).standard_normal(6) * NOISE
    return replace(reading, wrench_S=bias + noise)


CASES = (
    Case(fed="nothing wrong: led by hand for 5 s", fault=Fault.NONE, change=_nothing),
    Case(fed="nothing wrong: rest for 5 s", fault=Fault.NONE, change=_nothing, push_n=0.0),
    Case(fed="1e6 N for one tick", fault=Fault.FORCE_RANGE, change=_once(lambda r, m: _plus(r, m, 1e6))),
    Case(fed="500 N stuck for 1 s", fault=Fault.FORCE_RANGE, change=_force(500.0, 1.0)),
    Case(fed="250 N for 1 s, inside the sensor's range", fault=Fault.SPEED, change=_force(250.0, 1.0)),
    Case(
        fed="F^d of 1e5 N",
        fault=Fault.SPEED,
        change=_from_then(lambda r, m: replace(r, desired_S=_along(m, 1e5))),
    ),
    Case(fed="pose glitch of 0.09 m", fault=Fault.JUMP, change=_once(_glitch)),
    Case(fed="pose frozen for 5 s", fault=Fault.STALE_POSE, change=_from_then(_frozen_pose)),
    Case(
        fed="wrench frozen for 5 s",
        fault=Fault.STALE_WRENCH,
        change=_from_then(lambda r, m: replace(r, wrench_S=m.before.wrench_S)),
    ),
    Case(fed="half the ticks missed", fault=Fault.MISSED_TICK, change=_half_missed),
    Case(
        fed="a tick twice",
        fault=Fault.REPEATED_TICK,
        change=_once(lambda r, m: replace(r, tick=m.count - 1)),
    ),
    Case(
        fed="payload gone, tool tilted by 30 degrees",
        fault=Fault.OTHER_PAYLOAD,
        change=_from_then(_payload_gone),
        tilt_rad=np.pi / 6.0,
        push_n=0.0,
        or_else=(Fault.SPEED, Fault.ACCELERATION),
    ),
    Case(fed="payload 20 % heavier than stated", fault=Fault.RESIDUAL_WRENCH, change=_nothing, load=1.2),
    Case(fed="payload 5 % heavier than stated", fault=Fault.RESIDUAL_WRENCH, change=_nothing, load=1.05),
    Case(fed="no payload at the start", fault=Fault.RESIDUAL_WRENCH, change=_nothing, load=0.0),
    Case(
        fed="a number that is none",
        fault=Fault.NOT_FINITE,
        change=_once(lambda r, m: _plus(r, m, float("nan"))),
    ),
    Case(
        fed="R_WS mirrored",
        fault=Fault.NOT_A_ROTATION,
        change=_once(lambda r, _: replace(r, R_WS=-r.R_WS)),
    ),
)


def _plus(reading: Reading, moment: Moment, size: float) -> Reading:
    return replace(reading, wrench_S=reading.wrench_S + _along(moment, size))


@dataclass(frozen=True, kw_only=True)
class Fed:
    """What came of one case: the fault, when after it went wrong, what was commanded from there on, and the way."""

    case: Case
    fault: Fault
    after_s: float
    largest_speed_m_s: float
    way_m: float
    missing_mass_kg: float


class Cell:
    """A robot that follows the increments of its command along the first straight axis; the rest of it stands."""

    def __init__(self, controller: RuntimeController, case: Case) -> None:
        self.controller, self.case = controller, case
        self.axis = next(axis.index for axis in controller.axes if not axis.turns)
        self.robot = robot_alone(
            RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=2.4e-3), controller.sample_time_s
        )
        self.state, self.sent = np.zeros(len(self.robot.output)), [0.0] * (self.robot.whole + 2)
        self.R = Rotation.from_rotvec([0.0, case.tilt_rad, 0.0])
        self.rng, self.command, self.count = np.random.default_rng(0), 0.0, 0
        self.position = 0.0
        self.before = self._sound()

    @property
    def time_s(self) -> float:
        """Seconds since the case went wrong."""
        return self.count * self.controller.sample_time_s - REST_S - LED_S

    def readings(self) -> Iterator[Reading]:
        """Yield what the runtime gets, period by period; `follow` is to be called with each command."""
        while self.time_s < self.case.lasts_s:
            sound = self._sound()
            moment = Moment(
                time_s=self.time_s + 1e-9,
                reading=sound,
                before=self.before,
                payload=self.controller.payload,
                controller=self.controller,
                axis=self.axis,
                count=self.count,
            )
            fed = self.case.change(moment)
            if fed is not None:
                self.before = fed
                yield fed
            else:
                self.follow(0.0)

    def follow(self, increment_m: float) -> None:
        """Go on by a period, with the command further by `increment_m`."""
        self.command += increment_m
        self.sent = [*self.sent[1:], self.command]
        older, newer, *_ = self.sent
        self.state = over_sample(self.robot.sample, self.state, older, newer)
        self.position = float(self.robot.output @ self.state)
        self.count += 1

    def _sound(self) -> Reading:
        """Return what a cell without fault shows: weight, bias, noise, and the hand, which no hand holds constant."""
        payload, t = self.controller.payload, self.count * self.controller.sample_time_s
        weight = self.case.load * payload.mass_kg * self.R.inv().apply(payload.gravity_W_m_s2)
        raw = np.concatenate([weight, np.cross(payload.com_S_m, weight)])
        raw += [*payload.force_bias_S_n, *payload.torque_bias_S_n_m]
        raw += NOISE * self.rng.standard_normal(6)
        if t >= REST_S:
            hand = 1.0 + 0.15 * np.sin(2.0 * np.pi * 0.9 * t) + 0.05 * np.sin(2.0 * np.pi * 7.0 * t)
            raw[self.axis] += self.case.push_n * hand * min(1.0, (t - REST_S) / 0.1)
        away = np.zeros(3)
        away[self.axis] = self.position
        noise = POSE_NOISE_M * self.rng.standard_normal(3)
        return Reading(
            wrench_S=raw,
            position_W_m=np.array([0.4, -0.2, 0.9]) + self.R.apply(away) + noise,
            R_WS=self.R.as_matrix(),
            desired_S=np.zeros(6),
            tick=self.count,
        )


def random_episodes(controller: RuntimeController, rng: np.random.Generator) -> Iterator[list[Reading]]:
    """Yield runs of readings without end, each to be begun from the start: a tool wanders until one thing is wrong.

    Some have nothing wrong, and behind what is wrong come some more good readings.
    """
    count = controller.limits.rest_samples
    while True:
        length = int(rng.integers(20, 160))
        readings = _wander(controller, rng, count + length)
        kind = int(rng.integers(0, len(_SPOIL) + 1))
        if kind < len(_SPOIL):
            readings = _SPOIL[kind](readings, count + int(rng.integers(5, length)), controller, rng)
        yield readings


def _wander(controller: RuntimeController, rng: np.random.Generator, length: int) -> list[Reading]:
    """Return readings at rest, then of a tool that goes and turns slowly under a wrench that pushes."""
    rest, payload = controller.limits.rest_samples, controller.payload
    slow = np.cumsum(rng.standard_normal((length, 6)), axis=0)
    slow[:rest] = 0.0
    turned = Rotation.random(rng=rng) * Rotation.from_rotvec(1e-5 * slow[:, 3:])
    weight = payload.mass_kg * turned.inv().apply(payload.gravity_W_m_s2)
    wrench = np.concatenate([weight, np.cross(payload.com_S_m, weight)], axis=1)
    wrench += [*payload.force_bias_S_n, *payload.torque_bias_S_n_m]
    wrench += NOISE * rng.standard_normal((length, 6))
    wrench[rest:] += rng.uniform(0.0, 20.0) * rng.standard_normal(6) + 0.3 * slow[rest:]
    desired = np.where(rng.random((length, 6)) < 0.01, 5.0, 0.0)
    first = int(rng.integers(0, 2**32))
    ticks = [None] * length if rng.random() < 0.2 else [(first + k) % 2**32 for k in range(length)]
    return [
        Reading(wrench_S=wrench[k], position_W_m=1e-5 * slow[k, :3], R_WS=matrix, desired_S=desired[k], tick=ticks[k])
        for k, matrix in enumerate(turned.as_matrix())
    ]


Spoil = Callable[[list[Reading], int, RuntimeController, np.random.Generator], list[Reading]]


def _spoil_wrench(size: float, first: int, last: int) -> Spoil:
    def spoil(
        readings: list[Reading], at: int, _controller: RuntimeController, rng: np.random.Generator
    ) -> list[Reading]:
        wrench = readings[at].wrench_S.copy()
        wrench[int(rng.integers(first, last))] = size
        return _replaced(readings, at, wrench_S=wrench)

    return spoil


def _replaced(readings: list[Reading], at: int, **change: object) -> list[Reading]:
    return [*readings[:at], replace(readings[at], **change), *readings[at + 1 :]]  # type: ignore[arg-type]  # fields


def _spoil_pose(readings: list[Reading], at: int, _c: RuntimeController, rng: np.random.Generator) -> list[Reading]:
    away = rng.choice([1e-4, 1e-2, 0.09, 1.0]) * rng.standard_normal(3)
    return _replaced(readings, at, position_W_m=readings[at].position_W_m + away)


def _spoil_turn(readings: list[Reading], at: int, _c: RuntimeController, rng: np.random.Generator) -> list[Reading]:
    turn = Rotation.from_rotvec(rng.choice([1e-3, 1e-2, 1.0]) * rng.standard_normal(3)).as_matrix()
    return _replaced(readings, at, R_WS=rng.choice([1.0, 1.0, 1.002]) * readings[at].R_WS @ turn)


def _spoil_desired(readings: list[Reading], at: int, _c: RuntimeController, rng: np.random.Generator) -> list[Reading]:
    size = float(rng.choice([200.0, 1e4, 1e308, np.inf]))
    return _replaced(readings, at, desired_S=size * rng.choice([-1.0, 1.0], 6))


def _spoil_tick(readings: list[Reading], at: int, _c: RuntimeController, rng: np.random.Generator) -> list[Reading]:
    before = readings[at].tick
    choices = [None] if before is None else [before + 1, before - 1, before + 2**31, before - 7, None]
    return _replaced(readings, at, tick=choices[int(rng.integers(0, len(choices)))])


def _freeze_wrench(readings: list[Reading], at: int, _c: RuntimeController, _r: np.random.Generator) -> list[Reading]:
    return [*readings[:at], *(replace(each, wrench_S=readings[at].wrench_S) for each in readings[at:])]


def _freeze_pose(readings: list[Reading], at: int, _c: RuntimeController, _r: np.random.Generator) -> list[Reading]:
    kept = readings[at]
    return [*readings[:at], *(replace(each, position_W_m=kept.position_W_m, R_WS=kept.R_WS) for each in readings[at:])]


def _load(readings: list[Reading], _at: int, controller: RuntimeController, rng: np.random.Generator) -> list[Reading]:
    """Another payload from the first reading on."""
    share = float(rng.choice([-1.0, -0.05, -0.005, 0.005, 0.05, 0.2]))
    return [replace(each, wrench_S=each.wrench_S + _weight(each, controller, share)) for each in readings]


def _lose(readings: list[Reading], at: int, controller: RuntimeController, rng: np.random.Generator) -> list[Reading]:
    """The payload, or some of it, falls; what is left of the wrench is noise, for long enough."""
    kept, share = readings[at], -float(rng.choice([0.12, 0.15, 1.0]))
    payload, count = controller.payload, controller.guard.weight_periods + 200
    weight = (1.0 + share) * payload.mass_kg * (kept.R_WS.T @ np.array(payload.gravity_W_m_s2))
    raw = np.concatenate([weight, np.cross(payload.com_S_m, weight)])
    raw += [*payload.force_bias_S_n, *payload.torque_bias_S_n_m]
    noise = NOISE * rng.standard_normal((count, 6))
    away = POSE_NOISE_M * rng.standard_normal((count, 3))
    first = kept.tick
    lost = [
        replace(
            kept,
            wrench_S=raw + noise[k],
            position_W_m=kept.position_W_m + away[k],
            desired_S=np.zeros(6),
            tick=None if first is None else first + k,
        )
        for k in range(count)
    ]
    return [*readings[:at], *lost]


def _weight(reading: Reading, controller: RuntimeController, share: float) -> FloatArray:
    payload = controller.payload
    weight = share * payload.mass_kg * (reading.R_WS.T @ np.array(payload.gravity_W_m_s2))
    return np.concatenate([weight, np.cross(payload.com_S_m, weight)])


_SPOIL: tuple[Spoil, ...] = (
    _spoil_wrench(float("nan"), 0, 6),
    _spoil_wrench(1e6, 0, 3),
    _spoil_wrench(-1e6, 3, 6),
    _spoil_wrench(300.0, 0, 3),
    _spoil_pose,
    _spoil_turn,
    _spoil_desired,
    _spoil_tick,
    _freeze_wrench,
    _freeze_pose,
    _load,
    _lose,
)

__all__ = ["AXES", "CASES", "Case", "Cell", "Fed", "random_episodes"]
