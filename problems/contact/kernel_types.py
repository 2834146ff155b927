"""The named values that the compiled kernels of a contact hand to each other."""

from typing import NamedTuple

from ..arrays import FloatArray

# Rows of the outputs, and halves of the plant's matrices.
POSITION, SENSED, PRESSED = 0, 1, 2
IN_CONTACT, APART = 0, 1
# Entries of the state of an environment that moves by itself.
PLACE, SPEED = 0, 1
# Rows of the ramp of `SampledContact`: moving without outside force, at rest under one newton.
MOVING, PUSHED = 0, 1
# The newest of the past commands of a chain.
NEWEST = 0
# Entries of `found`: the largest pressing sensor force and its tick, the largest contact force and its time in samples,
# the impulse of the impact times 1/h.
SENSOR_PEAK, SENSOR_TICK, CONTACT_PEAK, CONTACT_TIME, IMPULSE, FOUND = 0, 1, 2, 3, 4, 5
# Entries of `flags`: head of the ring of past commands, contact (0 or 1), samples in which it began or ended.
HEAD, TOUCHING, SWITCHES, FLAGS = 0, 1, 2, 3


class Wall(NamedTuple):
    """The environment in units of one period: K_e, B_e/h, M_e/h².

    `share` of the speed is what the payload keeps in an impact with the resting environment, M_p/(M_p + M_e).
    """

    stiffness: float
    damping: float
    mass: float
    share: float


class Delay(NamedTuple):
    """Whole samples of delay, the length of the chain of past commands, and the fraction of a sample."""

    whole: int
    chain: int
    fraction: float


class Contact(NamedTuple):
    """The plant in contact and in free space.

    `step` (2, n, n + 3) is (phi, gamma, gamma_old, gamma_push) of one sample, `flow` (2, n, n + 2) is (rate, drive,
    push) of the continuous plant over one period. `rows` (3, n + 2) are x, F and F_e over (state, held command, outside
    force), `inside` (m, n + 3) F_e inside a sample over (state, newer command, older command, outside force).
    """

    step: FloatArray
    flow: FloatArray
    rows: FloatArray
    inside: FloatArray
    delay: Delay
    wall: Wall


class HeldInputs(NamedTuple):
    """What acts on the plant and stays: the command and the outside force on the payload."""

    command: float
    push: float


class Inputs(NamedTuple):
    """What acts during one sample: the older and the newer command, and the outside force."""

    older: float
    newer: float
    push: float


class Forces(NamedTuple):
    """F^d and the outside force on the payload after the impact."""

    desired: float
    push: float


class Start(NamedTuple):
    """Plant state, past commands (a ring of 2^k places, newest first) and controller states (6,)."""

    state: FloatArray
    past: FloatArray
    control: FloatArray


class Moment(NamedTuple):
    """The same with position and speed of the environment."""

    state: FloatArray
    past: FloatArray
    control: FloatArray
    surface: FloatArray


class Traces(NamedTuple):
    """F and F_e at every tick."""

    sensed: FloatArray
    pressed: FloatArray


class RunResults(NamedTuple):
    """What a run writes: the traces, the peaks (FOUND,), and the states of the ticks beside the largest force.

    Row k mod 2 of `crest` (2, n + 3) is what `peaks.keep_state` writes of tick k.
    """

    traces: Traces
    found: FloatArray
    crest: FloatArray


class TickRange(NamedTuple):
    """The first tick of a walk, the tick that it aims at, and the last one that the aim may be moved to."""

    first: int
    aim: int
    last: int


class Crossing(NamedTuple):
    """The end of a sample with events: contact, the largest impulse (times 1/h), the largest F_e and its moment."""

    touching: bool
    impulse: float
    largest: float
    moment: float
