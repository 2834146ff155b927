"""The unilateral contact of a payload on several axes at one of its points, tick by tick (docs/method.md).

Between two events the plant is integrated exactly over parts of a sample; the moments of leaving and of touching are
located inside a part, as in the transient of one axis (`events`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..compiled import compiled
from ..errors import ParameterError
from ..model.controller import (
    CONTROLLER_STATES,
    control_tuple,
    controller_blocks,
    controller_step,
    keep_control,
    needed_states,
)
from ..model.coupled import (
    CoupledLoop,
    CoupledPlant,
    CoupledSampledPlant,
    Law,
    PointSurface,
    build_coupled_loop,
    build_coupled_sampled_plant,
    coupled_poles,
)
from ..model.difference import BLOCK_ROWS
from ..model.hold import hold
from ..stability.margins import UnstableLoopError
from .bouncing import BOUNCING, SETTLED, Ending, judge_window
from .events import advance

# Parts of a sample in which forces are looked at, at least; a contact of 100 Hz turns by 0.1 rad in one.
_PARTS = 4
_LONGEST_S, _SHORTEST_WINDOW, _WINDOWS = 10.0, 64, 12
_DECAY_EXPONENTS = 7.0
_BISECTIONS, _SHORTEST_PART, _MOST_CHANGES = 44, 1e-9, 8


@dataclass(frozen=True, kw_only=True)
class CoupledContact:
    """How one contact at a point went: peak F_e and its time, how often it was left, and how it ended.

    `approach_speed_m_s` is that of the point along the normal at the touch, `rest_n` the force in the end,
    `peak_sensor_force_n` the largest −F along the normal (of the axes x, y, z) at the ticks.
    """

    peak_contact_force_n: float
    peak_sensor_force_n: float
    time_of_peak_s: float
    approach_speed_m_s: float
    rest_n: float
    leaves: int
    ending: Ending


@dataclass(frozen=True, kw_only=True, eq=False)
class CoupledPair:
    """A cell that touches and the same in free space, both sampled, and their loops under the same laws.

    `normal` (k,) weighs the axes' forces in the force at the sensor.
    """

    contact: CoupledSampledPlant
    free: CoupledSampledPlant
    laws: tuple[Law, ...]
    contact_loop: CoupledLoop
    free_loop: CoupledLoop
    normal: FloatArray

    @property
    def surface(self) -> PointSurface:
        """What is touched."""
        found = self.contact.plant.surface
        if found is None:
            raise ParameterError("surface", None, "there")
        return found


def build_coupled_pair(
    plant: CoupledPlant,
    laws: Sequence[Law],
    sample_time_s: float,
    *,
    free: tuple[CoupledSampledPlant, CoupledLoop] | None = None,
    normal: FloatArray | None = None,
) -> CoupledPair:
    """Pair a cell that touches something with its free-space twin (`free` where it is known already).

    `normal` (k,) weighs the axes' forces in the force at the sensor; by default it is the surface's direction.
    """
    if plant.surface is None:
        raise ParameterError("surface", None, "there")
    if free is None:
        apart = build_coupled_sampled_plant(plant.touching(None), sample_time_s)
        free = apart, build_coupled_loop(apart, laws)
    touching = build_coupled_sampled_plant(plant, sample_time_s)
    along = plant.surface.direction if normal is None else normal
    return CoupledPair(
        contact=touching,
        free=free[0],
        laws=tuple(laws),
        contact_loop=build_coupled_loop(touching, laws),
        free_loop=free[1],
        normal=along,
    )


def steady_motion(loop: CoupledLoop, force: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the state (N,) that moves on by the same way in every sample under a constant force, and that way (N,).

    The state has no part along the motions that nothing holds.
    """
    n, moves = len(loop.a), loop.translations
    count = moves.shape[1]
    system = np.zeros((n + count, n + count))
    system[:n, :n], system[:n, n:] = loop.a - np.eye(n), -moves
    system[n:, :n] = moves.T
    right = np.concatenate([-loop.b @ force, np.zeros(count)])
    found = np.linalg.solve(system, right)
    return found[:n], moves @ found[n:]


def simulate_coupled_contact(pair: CoupledPair, force: FloatArray, speed_m_s: float | None = None) -> CoupledContact:
    """Simulate one contact under F^d = `force` (k,), approached steadily under it, at `speed_m_s` with as much of it.

    Raises UnstableLoopError if the loop in contact or in free space is not stable, ParameterError for a force under
    which the point does not go towards the surface.
    """
    radii = [float(np.max(np.abs(coupled_poles(each)[0]))) for each in (pair.free_loop, pair.contact_loop)]
    if not max(radii) < 1.0:
        raise UnstableLoopError(max(radii))
    surface, h = pair.surface, pair.contact.sample_time_s
    places = np.array(pair.free.matrices.places)
    state, way = steady_motion(pair.free_loop, force)
    speed = float(surface.direction @ way[places]) / h
    if not speed > 0.0:
        raise ParameterError("force", force.tolist(), "one that moves the point towards the surface")
    if speed_m_s is not None:
        factor = speed_m_s / speed
        force, state, speed = factor * force, factor * state, speed_m_s
    # Where the point is in this state the surface begins.
    offset = float(surface.direction @ state[places])
    rest_state, _ = steady_motion(pair.contact_loop, force)
    rest = float(pair.contact.matrices.pressed @ rest_state[: pair.contact_loop.state_count])
    decay = math.ceil(_DECAY_EXPONENTS / -math.log(max(radii)))
    window = min(max(_SHORTEST_WINDOW, decay), math.ceil(_LONGEST_S / h))
    return _follow(pair, force, _Start(state, offset, rest, window, speed))


class _Start(NamedTuple):
    """The state at the touch, where the surface begins, the force in the end, a settling time in ticks, the speed."""

    state: FloatArray
    offset: float
    rest_n: float
    window: int
    speed_m_s: float


class _Cell(NamedTuple):
    """What the kernel takes of a cell: exact steps over parts of a sample, apart (0) and in contact (1), and rates.

    `ends` (parts,) are where in the sample the parts end; `older` (parts, k) is 1 where the command of one tick more
    acts. The last input is where along the normal the surface begins.
    """

    steps: FloatArray
    inputs: FloatArray
    rates: FloatArray
    drives: FloatArray
    ends: FloatArray
    older: NDArray[np.int64]
    blocks: FloatArray
    driven: NDArray[np.int64]
    wholes: NDArray[np.int64]
    chains: NDArray[np.int64]
    position: FloatArray
    force: FloatArray
    direct: FloatArray
    pressed: FloatArray
    gap: FloatArray
    along: FloatArray
    stiffness: float


class _Moment(NamedTuple):
    """The state of a cell at a tick, which the kernel writes over; `flags` are whether it touches, and changes."""

    plant: FloatArray
    past: FloatArray
    control: FloatArray
    flags: NDArray[np.int64]


# Of the flags: whether the point touches, and how often that changed.
_TOUCHING, _CHANGES = 0, 1
# Age 0 of the past commands is the newest.
_NEWEST = 0
# Peak F_e and its time in ticks, largest sensor force, how often it was left.
_PEAK, _TIME, _SENSED, _LEFT, _FOUND = 0, 1, 2, 3, 4


def _follow(pair: CoupledPair, force: FloatArray, start: _Start) -> CoupledContact:
    cell, moment, h = _cell(pair), _begin(pair, start.state), pair.contact.sample_time_s
    peaks, switches, found = np.zeros(_WINDOWS), np.zeros(_WINDOWS, dtype=np.int64), np.zeros(_FOUND)
    verdict, peak, when, sensed, left = -1, 0.0, 0.0, 0.0, 0
    for w in range(_WINDOWS):
        found[:], before = 0.0, int(moment.flags[_CHANGES])
        _walk(cell, moment, force, start.offset, start.window, found)
        peaks[w], switches[w] = found[_PEAK], int(moment.flags[_CHANGES]) - before
        left, sensed = left + int(found[_LEFT]), max(sensed, float(found[_SENSED]))
        if found[_PEAK] > peak:
            peak, when = float(found[_PEAK]), (w * start.window + float(found[_TIME])) * h
        verdict = judge_window(peaks, switches, w, bool(moment.flags[_TOUCHING] == 1), start.rest_n)
        if verdict >= 0:
            break
    return CoupledContact(
        peak_contact_force_n=max(peak, start.rest_n),
        peak_sensor_force_n=sensed,
        time_of_peak_s=when,
        approach_speed_m_s=start.speed_m_s,
        rest_n=start.rest_n,
        leaves=left,
        ending={SETTLED: Ending.SETTLED, BOUNCING: Ending.BOUNCING}.get(verdict, Ending.DECAYING),
    )


def _begin(pair: CoupledPair, state: FloatArray) -> _Moment:
    """Return plant (n,), past commands (k, longest) and all states of every controller of a loop state."""
    at, chains = pair.free_loop.state_count, pair.free.chains
    plant, past, control = (
        state[:at].copy(),
        np.zeros((len(chains), max(*chains, 1))),
        np.zeros((len(chains), CONTROLLER_STATES)),
    )
    for i, length in enumerate(chains):
        past[i, :length] = state[at : at + length]
        at += length
    for i, law in enumerate(pair.laws):
        if law is not None:
            kept = needed_states(controller_blocks(law, pair.free.sample_time_s))
            control[i, kept] = state[at : at + len(kept)]
            at += len(kept)
    return _Moment(plant=plant, past=past, control=control, flags=np.array([1, 0], dtype=np.int64))


def _cell(pair: CoupledPair) -> _Cell:
    free, contact, surface = pair.free, pair.contact, pair.surface
    h, m, k = free.sample_time_s, free.matrices, len(pair.laws)
    fractions = np.array(free.fractions)
    ends = np.array(sorted({*np.linspace(0.0, 1.0, _PARTS + 1)[1:].tolist(), *fractions[fractions > 0.0].tolist()}))
    drives = np.zeros((2, len(m.a), k + 1))
    drives[0, :, :k], drives[1, :, :k] = m.b, contact.matrices.b
    # The surface begins where J q is the last input: K_e times that presses less.
    speeds = [place + 1 for place in m.places]
    push = np.linalg.solve(contact.plant.mass_matrix, surface.direction)
    drives[1, speeds, k] = surface.environment.stiffness_n_per_m * h * h * push
    rates = np.stack([m.a, contact.matrices.a])
    parts = [[hold(rates[mode], drives[mode], float(each)) for each in np.diff([0.0, *ends])] for mode in (0, 1)]
    gap = np.zeros(len(m.a))
    gap[list(m.places)] = surface.direction
    blocks = [np.zeros((BLOCK_ROWS, 3)) if law is None else controller_blocks(law, h) for law in pair.laws]
    return _Cell(
        steps=np.array([[step for step, _ in mode] for mode in parts]),
        inputs=np.array([[held for _, held in mode] for mode in parts]),
        rates=rates,
        drives=drives,
        ends=ends,
        older=(ends[:, None] <= fractions).astype(np.int64),
        blocks=np.array(blocks),
        driven=np.array([int(law is not None) for law in pair.laws], dtype=np.int64),
        wholes=np.array(free.whole, dtype=np.int64),
        chains=np.array(free.chains, dtype=np.int64),
        position=m.c_position,
        force=m.c_force,
        direct=m.d_force,
        pressed=contact.matrices.pressed,
        gap=gap,
        along=pair.normal,
        stiffness=surface.environment.stiffness_n_per_m,
    )


@compiled
def _pressing(cell: _Cell, offset: float, state: FloatArray) -> float:
    """Return K_e d + B_e ḋ of the surface, whose damper acts behind it only: above 0 the point is in contact."""
    depth = np.dot(cell.gap, state) - offset
    if depth < 0.0:
        return float(cell.stiffness * depth)
    return float(np.dot(cell.pressed, state) - cell.stiffness * offset)


@compiled
def _crossed(cell: _Cell, part: int, held: FloatArray, state: FloatArray, touching: int) -> tuple[FloatArray, int, int]:
    """Return the state after part `part` of a sample, whether it touches then, and how often that changed."""
    offset = held[len(held) - 1]
    end = cell.steps[touching, part] @ state + cell.inputs[touching, part] @ held
    if (_pressing(cell, offset, end) > 0.0) == (touching == 1):
        return end, touching, 0
    left, changes, now = cell.ends[part] - (cell.ends[part - 1] if part > 0 else 0.0), 0, state
    while left > _SHORTEST_PART and changes < _MOST_CHANGES:
        rate, push = cell.rates[touching], cell.drives[touching] @ held
        end = advance(rate, push, now, left)
        if (_pressing(cell, offset, end) > 0.0) == (touching == 1):
            return end, touching, changes
        low, high = 0.0, left
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            if (_pressing(cell, offset, advance(rate, push, now, middle)) > 0.0) == (touching == 1):
                low = middle
            else:
                high = middle
        now, left = advance(rate, push, now, high), left - high
        touching, changes = 1 - touching, changes + 1
    return now, touching, changes


@compiled
def _command(cell: _Cell, moment: _Moment, desired: FloatArray, command: FloatArray) -> float:
    """Write what the laws answer at a tick, and return −F along the normal."""
    along = 0.0
    for i in range(len(command)):
        late = moment.past[i, cell.chains[i] - 1] if cell.chains[i] > 0 else 0.0
        force = np.dot(cell.force[i], moment.plant) + cell.direct[i] * late
        along -= cell.along[i] * force
        if cell.driven[i] == 1:
            own = moment.control[i]
            before, position = control_tuple(own), np.dot(cell.position[i], moment.plant)
            command[i], after = controller_step(cell.blocks[i], before, desired[i] + force, position)
            keep_control(own, after)
    return along


@compiled
def _walk(cell: _Cell, moment: _Moment, desired: FloatArray, offset: float, ticks: int, found: FloatArray) -> None:
    """Go on for so many ticks from a moment, which is written over."""
    k, past, flags = len(desired), moment.past, moment.flags
    held, command = np.ones(k + 1), np.zeros(k)
    held[k] = offset
    for tick in range(ticks):
        found[_SENSED] = max(found[_SENSED], _command(cell, moment, desired, command))
        for part in range(len(cell.ends)):
            for i in range(k):
                age = cell.wholes[i] + cell.older[part, i]
                held[i] = command[i] if age == 0 else past[i, age - 1]
            was = flags[_TOUCHING]
            moment.plant[:], flags[_TOUCHING], changes = _crossed(cell, part, held, moment.plant, was)
            flags[_CHANGES] += changes
            found[_LEFT] += (changes + was) // 2
            if flags[_TOUCHING] == 1:
                force = _pressing(cell, offset, moment.plant)
                if force > found[_PEAK]:
                    found[_PEAK], found[_TIME] = force, tick + cell.ends[part]
        for i in range(k):
            for s in range(past.shape[1] - 1, 0, -1):
                past[i, s] = past[i, s - 1]
            past[i, _NEWEST] = command[i]
