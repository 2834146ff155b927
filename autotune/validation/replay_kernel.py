"""Step the paper's own difference equation and a finely stepped plant through a contact, compiled.

None of these equations is shared with the kernels of `problems`, so that the two can be held against each other.
"""

from typing import NamedTuple

import numpy as np

from problems.arrays import FloatArray
from problems.compiled import compiled, equation

SUBSTEPS = 20
# Of the plant's states: the robot's first, and at the end those of the payload; the wall's surface is at 0.
_ROBOT, _PAYLOAD, _VELOCITY = 0, -2, -1
# The speed of an approach has come to rest when it changes by less than this share in an e-folding of the loop; looked
# at every so many a part of the shortest approach.
_STEADY, _LOOKS = 5e-4, 7


class EquationGains(NamedTuple):
    """Coefficients of the paper's eq. (discretized admittance); corners in rad/s, `h` in s.

    The force passes a biquad first, y_k = Σ b_i u_{k−i} − a_1 y_{k−1} − a_2 y_{k−2}.
    """

    old: float
    new: float
    gain: float
    now_weight: float
    last_weight: float
    before_weight: float
    feedback: float
    compensation: float
    corner: float
    second_corner: float
    h: float
    b_0: float
    b_1: float
    b_2: float
    a_1: float
    a_2: float


class DampingSchedule(NamedTuple):
    """B_a = max(highest e^(−decay |v|), lowest), updated every `period` ticks by `change` at most; 0 is never."""

    period: int
    highest: float
    lowest: float
    decay: float
    change: float


class EquationMemory(NamedTuple):
    """What the difference equation remembers from tick to tick; `sent` is the command x^d.

    `force_before` and `force_last` have passed the biquad, `push_before` and `push_last` not.
    """

    before: float
    last: float
    force_before: float
    force_last: float
    seen: float
    velocity: float
    acceleration: float
    sent: float
    push_before: float
    push_last: float


class SampleStep(NamedTuple):
    """The plant over one sample: the older command acts during the first part, the newer one during the rest."""

    phi_older: FloatArray
    gamma_older: FloatArray
    phi_newer: FloatArray
    gamma_newer: FloatArray


class Substep(NamedTuple):
    """The plant over a twentieth of a sample under a held command."""

    phi: FloatArray
    gamma: FloatArray


class FineContact(NamedTuple):
    """The plant in contact and in free space; commands act `whole` samples and `late` substeps late.

    `stiffness` and `damping` (times the sample time) are those of the wall. A wall that moves with a mass takes
    `share` M_p/(M_p + M_e) of the payload's speed; `alone` steps its place and speed while nothing touches it, and
    `pressed` and `pressed_direct` are F_e while they move together, by state and command. Without a mass `share` is 1.
    """

    near: Substep
    far: Substep
    near_sample: SampleStep
    far_sample: SampleStep
    c_force: FloatArray
    c_position: FloatArray
    d_force: float
    stiffness: float
    damping: float
    whole: int
    late: int
    share: float
    alone: FloatArray
    pressed: FloatArray
    pressed_direct: float


class RobotAlone(NamedTuple):
    """A robot without payload, whose commands act `whole` samples and a part of one late; `output` is its position."""

    sample: SampleStep
    output: FloatArray
    whole: int


class ReplayedContact(NamedTuple):
    """Peaks and largest steps of a replayed contact; `touch` and `detection` are ticks, -1 for none.

    `opposed` is the largest force against the motion before the touch, `followed` the largest step behind the lag.
    """

    sensor: float
    contact: float
    touch: int
    detection: int
    fastest: float
    hardest: float
    is_touching: bool
    opposed: float
    followed: float


@equation
def rest_at(position: float) -> EquationMemory:
    """Return the memory at rest: C_fb x is zero there, so the admittance's own position is the command."""
    return EquationMemory(position, position, 0.0, 0.0, position, 0.0, 0.0, position, 0.0, 0.0)


@equation
def filtered(value: float, moved: float, corner: float, h: float) -> float:
    """Return a first-order filter's output after an input's change, by the trapezoidal rule."""
    half = 0.5 * corner * h
    return ((1.0 - half) * value + corner * moved) / (1.0 + half)


@equation
def difference_step(
    gains: EquationGains, past: EquationMemory, force: float, position: float, reset: bool
) -> EquationMemory:
    """Return the memory after a tick with F^d + F and the measured position; `reset` repeats the last command.

    C_fb and P̂ O_a are discretised by the trapezoidal rule: dv/dt = ω_v dx/dt − ω_v v and da/dt = ω_a dv/dt − ω_a a.
    """
    velocity = filtered(past.velocity, position - past.seen, gains.corner, gains.h)
    acceleration = filtered(past.acceleration, velocity - past.velocity, gains.second_corner, gains.h)
    push = force + gains.compensation * acceleration
    driven = gains.b_0 * push + gains.b_1 * past.push_last + gains.b_2 * past.push_before
    driven = driven - gains.a_1 * past.force_last - gains.a_2 * past.force_before
    pushed = gains.gain * (
        gains.now_weight * driven + gains.last_weight * past.force_last + gains.before_weight * past.force_before
    )
    following, before = (2.0 * past.last - gains.old * past.before + pushed) / gains.new, past.last
    if reset:
        # What the admittance put out is the command without C_fb, which goes on seeing the robot move.
        following = before = past.sent + gains.feedback * velocity
    sent = following - gains.feedback * velocity
    return EquationMemory(
        before, following, past.force_last, driven, position, velocity, acceleration, sent, past.push_last, push
    )


@equation
def with_damping(gains: EquationGains, mass: float, damping: float) -> EquationGains:
    """Return the equation with another B_a."""
    ratio = damping * gains.h / (2.0 * mass)
    return EquationGains(
        1.0 - ratio,
        1.0 + ratio,
        gains.gain,
        gains.now_weight,
        gains.last_weight,
        gains.before_weight,
        gains.feedback,
        gains.compensation,
        gains.corner,
        gains.second_corner,
        gains.h,
        gains.b_0,
        gains.b_1,
        gains.b_2,
        gains.a_1,
        gains.a_2,
    )


@equation
def next_damping(schedule: DampingSchedule, damping: float, speed: float) -> float:
    """Return B_a after an update at a speed [m/s]."""
    wanted = max(schedule.highest * np.exp(-schedule.decay * speed), schedule.lowest)
    return float(min(max(wanted, damping - schedule.change), damping + schedule.change))


@equation
def moved(phi: FloatArray, gamma: FloatArray, state: FloatArray, command: float) -> FloatArray:
    """Return phi state + gamma command, row by row: for so few states a call of BLAS takes longer than its work."""
    out = gamma * command
    for row in range(len(out)):
        for column in range(len(state)):
            out[row] += phi[row, column] * state[column]
    return out


@equation
def over_sample(step: SampleStep, state: FloatArray, older: float, newer: float) -> FloatArray:
    """Return the state one sample later."""
    between = moved(step.phi_older, step.gamma_older, state, older)
    return moved(step.phi_newer, step.gamma_newer, between, newer)


@equation
def wall_force(contact: FineContact, state: FloatArray) -> float:
    """Return the force on the environment of a payload behind the wall."""
    return float(max(0.0, contact.stiffness * state[_PAYLOAD] + contact.damping * state[_VELOCITY]))


@equation
def is_touching(contact: FineContact, state: FloatArray) -> bool:
    """Whether the payload presses on the wall."""
    return bool(state[_PAYLOAD] > 0.0 and wall_force(contact, state) > 0.0)


@equation
def is_far(contact: FineContact, state: FloatArray, far_samples: float) -> bool:
    """Say whether no surface is reached within some samples at this speed, which is that per sample."""
    away = state[_PAYLOAD]
    return bool(abs(away) > far_samples * abs(state[_VELOCITY]) and (away < 0.0 or contact.damping == 0.0))


@equation
def contact_sample(
    contact: FineContact, state: FloatArray, older: float, newer: float, far_samples: float
) -> FloatArray:
    """Return the state one sample later; far from the wall's surface, on either side, two steps are enough."""
    if is_far(contact, state, far_samples):
        step = contact.near_sample if state[_PAYLOAD] > 0.0 else contact.far_sample
        ahead = over_sample(step, state, older, newer)
        if is_far(contact, ahead, far_samples) and (ahead[_PAYLOAD] > 0.0) == (state[_PAYLOAD] > 0.0):
            return ahead
    for sub in range(SUBSTEPS):
        side = contact.near if is_touching(contact, state) else contact.far
        state = moved(side.phi, side.gamma, state, older if sub < contact.late else newer)
    return state


# Of a wall with a mass: its place and speed, 1 while it is touched and else 0, and F_e at the end of the sample.
_PLACE, _SPEED, _JOINED, _FORCE = 0, 1, 2, 3


@equation
def joined_force(contact: FineContact, state: FloatArray, command: float) -> float:
    """Return F_e of a payload that moves with the wall's mass."""
    return float(contact.pressed @ state + contact.pressed_direct * command)


@equation
def moving_sample(
    contact: FineContact, state: FloatArray, wall: FloatArray, older: float, newer: float
) -> tuple[FloatArray, FloatArray]:
    """Return payload and wall with a mass one sample later: one mass while they press, met without rebound."""
    for sub in range(SUBSTEPS):
        command = older if sub < contact.late else newer
        if wall[_JOINED] == 0.0 and state[_PAYLOAD] > wall[_PLACE]:
            common = contact.share * state[_VELOCITY] + (1.0 - contact.share) * wall[_SPEED]
            state[_VELOCITY], wall[_JOINED] = common, 1.0
        if wall[_JOINED] == 1.0:
            force = joined_force(contact, state, command)
            if force < 0.0:
                wall[_JOINED], wall[_PLACE], wall[_SPEED] = 0.0, state[_PAYLOAD], state[_VELOCITY]
        if wall[_JOINED] == 1.0:
            state = moved(contact.near.phi, contact.near.gamma, state, command)
            wall[_PLACE], wall[_SPEED] = state[_PAYLOAD], state[_VELOCITY]
            wall[_FORCE] = joined_force(contact, state, command)
        else:
            state = moved(contact.far.phi, contact.far.gamma, state, command)
            wall[:2], wall[_FORCE] = contact.alone @ wall[:2], 0.0
    return state, wall


@equation
def presses(contact: FineContact, state: FloatArray, wall: FloatArray) -> bool:
    """Whether the payload presses on the wall, with a mass or without."""
    return bool(wall[_JOINED] == 1.0) if contact.share < 1.0 else is_touching(contact, state)


@equation
def pressed_by(contact: FineContact, state: FloatArray, wall: FloatArray) -> float:
    """Return the force on the wall, with a mass or without."""
    return max(0.0, wall[_FORCE]) if contact.share < 1.0 else wall_force(contact, state)


@equation
def moved_back(past: EquationMemory, way: float) -> EquationMemory:
    """Return the memory of the same motion so much further behind."""
    return EquationMemory(
        past.before - way,
        past.last - way,
        past.force_before,
        past.force_last,
        past.seen - way,
        past.velocity,
        past.acceleration,
        past.sent - way,
        past.push_before,
        past.push_last,
    )


@equation
def after_tick(
    contact: FineContact,
    state: FloatArray,
    wall: FloatArray,
    older: float,
    newer: float,
    far_samples: float,
    is_apart: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return payload and wall one sample later; while they are kept apart there is no wall."""
    if is_apart:
        return over_sample(contact.far_sample, state, older, newer), wall
    if contact.share < 1.0:
        return moving_sample(contact, state, wall, older, newer)
    return contact_sample(contact, state, older, newer, far_samples), wall


@compiled
def replay_ticks(
    contact: FineContact,
    gains: EquationGains,
    approach: int,
    longest: int,
    after: int,
    desired_force: float,
    deadband: float,
    threshold: float,
    stops: bool,
    schedule: DampingSchedule,
    far_samples: float,
    followed_weight: float,
) -> ReplayedContact:
    """Follow from rest: `approach` to `longest` ticks until steady, then `after`, half a tick's way before the wall."""
    state, wall, past = np.zeros(len(contact.c_force)), np.zeros(4), rest_at(0.0)
    # What acts at the end of a tick is a command of `whole` ticks before; before the first tick the robot rests.
    sent = np.zeros(contact.whole + 1 + longest + after)
    sensor = peak = speed = fastest = hardest = opposed = behind = followed = way = 0.0
    touch = detection = begins = -1
    tick, look = 0, max(1, approach // _LOOKS)
    # M_a is in the gain of the equation, h²/(4 M_a), and B_a in its first two coefficients.
    mass, damping = gains.h * gains.h / (4.0 * gains.gain), schedule.highest
    if schedule.period > 0:
        gains = with_damping(gains, mass, damping)
    while begins < 0 or tick < begins + after:
        if begins < 0 and tick > 0 and (tick % look == 0 or tick == longest):
            slower, way = way, state[_VELOCITY]
            if tick >= longest or (tick >= approach and abs(way - slower) <= _STEADY * abs(way)):
                ahead, begins = state[_PAYLOAD] + 0.5 * way, tick
                state[_ROBOT], state[_PAYLOAD] = state[_ROBOT] - ahead, -0.5 * way
                past, sent = moved_back(past, ahead), sent - ahead
        force = contact.c_force @ state + contact.d_force * sent[tick]
        if touch < 0 and begins >= 0 and presses(contact, state, wall):
            touch = tick
        if touch >= 0:
            # A payload that has left the wall again still shakes the sensor.
            sensor, peak = max(sensor, -force), max(peak, pressed_by(contact, state, wall))
        felt, position = force if abs(force) > deadband else 0.0, float(contact.c_position @ state)
        if schedule.period > 0 and tick > 0 and tick % schedule.period == 0:
            damping = next_damping(schedule, damping, abs(position - past.seen) / gains.h)
            gains = with_damping(gains, mass, damping)
        against = -felt * np.sign(position - past.seen)
        opposed = max(opposed, against) if touch < 0 else opposed
        detection = tick if detection < 0 and against > threshold else detection
        is_held = detection == tick or (stops and detection >= 0)
        past = difference_step(gains, past, desired_force + felt, position, is_held)
        newest = contact.whole + 1 + tick
        sent[newest] = past.sent
        slower, speed = speed, sent[newest] - sent[newest - 1]
        behind = behind + followed_weight * (speed - behind)
        fastest, followed = max(fastest, abs(speed)), max(followed, abs(behind))
        # That a response stops the command is not limited.
        hardest = hardest if is_held else max(hardest, abs(speed - slower))
        state, wall = after_tick(contact, state, wall, sent[tick], sent[tick + 1], far_samples, begins < 0)
        tick += 1
    pressing = presses(contact, state, wall)
    return ReplayedContact(sensor, peak, touch, detection, fastest, hardest, pressing, opposed, followed)


@compiled
def follow_forces(robot: RobotAlone, gains: EquationGains, forces: FloatArray) -> FloatArray:
    """Return the positions of the robot alone at the ticks, at rest before the first of the forces (n,)."""
    positions = np.empty(len(forces))
    sent = np.zeros(robot.whole + 1 + len(forces))
    state = np.zeros(len(robot.output))
    past = rest_at(0.0)
    for tick in range(len(forces)):
        position = float(robot.output @ state)
        positions[tick] = position
        past = difference_step(gains, past, forces[tick], position, False)
        sent[robot.whole + 1 + tick] = past.sent
        state = over_sample(robot.sample, state, sent[tick], sent[tick + 1])
    return positions


@compiled
def equation_commands(
    gains: EquationGains, past: EquationMemory, forces: FloatArray, positions: FloatArray
) -> FloatArray:
    """Return the commands (n,) to F^d + F (n,) and measured positions (n,), from a memory on."""
    commands = np.empty(len(forces))
    for tick in range(len(forces)):
        past = difference_step(gains, past, forces[tick], positions[tick], False)
        commands[tick] = past.sent
    return commands
