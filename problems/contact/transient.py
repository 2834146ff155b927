"""The contact transient: approach in free space, impact, unilateral contact (docs/method.md, "Contact")."""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np

from .._checks import finite, positive
from ..arrays import FloatArray
from ..compiled import equation
from ..errors import ParameterError
from ..model.axis_kind import AxisKind
from ..model.controller import AdmittanceController, controller_blocks
from ..model.hold import hold
from ..model.plant import FREE_SPACE
from ..model.sampled import (
    KEPT_PLANTS,
    SampledPlant,
    build_loop,
    build_sampled_plant,
    check_wrench_delay,
    spectral_radius,
)
from ..stability.margins import UnstableLoopError
from .events import MOST_SUBSTEPS, SUBSTEPS_PER_RADIAN
from .kernel import contact_forces, run_contact, steady_start
from .kernel_types import (
    CONTACT_PEAK,
    CONTACT_TIME,
    FOUND,
    IMPULSE,
    MOVING,
    PUSHED,
    SENSOR_PEAK,
    SENSOR_TICK,
    Contact,
    Delay,
    Forces,
    Start,
    Traces,
    Wall,
)

LONGEST_TRANSIENT_S = 10.0
# Faster contacts, in radians and e-foldings per sample, would take seconds to follow and say nothing about a robot.
_FASTEST_SWING = 16.0
_FASTEST_DECAY = 1000.0
# The first state of the robot's chain, whose gain is 1 at rest.
_FIRST = 0


@dataclass(frozen=True, kw_only=True)
class Approach:
    """How the payload meets the wall: exactly one of `force_n` and `speed_m_s` is given.

    `force_n`: this force is held until the speed is steady (the paper's contact experiments). `speed_m_s`: contact at
    this steady speed, under the force that sustains it in free space. The force is F^d, or with `driven_by` "hand" a
    hand's on the payload. It goes on after the impact, unless `after_impact_n` says what it is from then on (0: the
    hand lets go).
    """

    force_n: float | None = None
    speed_m_s: float | None = None
    driven_by: Literal["desired_force", "hand"] = "desired_force"
    after_impact_n: float | None = None

    def __post_init__(self) -> None:
        if (self.force_n is None) == (self.speed_m_s is None):
            raise ParameterError("approach", (self.force_n, self.speed_m_s), "one of force_n and speed_m_s")
        for name, value in (("force_n", self.force_n), ("speed_m_s", self.speed_m_s)):
            if value is not None:
                object.__setattr__(self, name, positive(f"approach.{name}", value))
        if self.driven_by not in {"desired_force", "hand"}:
            raise ParameterError("approach.driven_by", self.driven_by, "desired_force or hand")
        if self.after_impact_n is not None:
            object.__setattr__(self, "after_impact_n", finite("approach.after_impact_n", self.after_impact_n))

    def text(self, units: AxisKind) -> str:
        """Return force or speed as people read it."""
        if self.force_n is not None:
            return f"{self.force_n:g} {units.force}"
        return f"{self.speed_m_s:g} {units.speed}"

    def numbers(self) -> tuple[float, float, bool, float]:
        """Return (force or 0, speed or 0, whether a hand drives, force after the impact or NaN) for the kernels."""
        after = math.nan if self.after_impact_n is None else self.after_impact_n
        return self.force_n or 0.0, self.speed_m_s or 0.0, self.driven_by == "hand", after


@dataclass(frozen=True, kw_only=True)
class ContactTransient:
    """Forces at the controller's ticks from the impact on, `time_s` (n,), and their peaks.

    `sensor_force_n` is −F (−F_m behind a filter of the wrench), positive when pressing, its peak that of the ticks, as
    in a log; `contact_force_n` is F_e, whose peak is searched between the ticks as well, at `time_of_peak_s`. A force
    that only creeps up to its value at rest counts with that value. `impulse_n_s` is what an environment with mass
    takes in the impact itself, on top. `is_settled` is False when the run was ended by its longest time.
    """

    time_s: FloatArray
    sensor_force_n: FloatArray
    contact_force_n: FloatArray
    contact_speed_m_s: float
    driving_force_n: float
    peak_sensor_force_n: float
    time_of_sensor_peak_s: float
    peak_contact_force_n: float
    time_of_peak_s: float
    impulse_n_s: float
    is_settled: bool


@dataclass(frozen=True, kw_only=True)
class SampledContact:
    """A plant in contact and the same plant in free space, both sampled.

    Of many only the loops are looked at, so what their contacts need is computed when it is first asked for.
    """

    contact: SampledPlant
    free: SampledPlant

    @cached_property
    def ramp(self) -> FloatArray:
        """Plant state, command and F at a tick with x_p = 0 (2, n + 2).

        First moving by one metre per sample without outside force, then at rest under an outside force of one newton.
        """
        return _ramp(self.free)

    @cached_property
    def arguments(self) -> Contact:
        """The plant's part of what `run_contact` takes."""
        return _kernel_arguments(self.contact, self.free)


@lru_cache(maxsize=KEPT_PLANTS)
def build_sampled_contact(contact: SampledPlant) -> SampledContact:
    """Pair a sampled plant in contact with its free-space twin; raises ParameterError where it swings too fast."""
    if contact.plant.environment.is_free_space:
        raise ParameterError("environment", contact.plant.environment, "a surface to touch, not free space")
    _fastest_swing(contact)
    free = build_sampled_plant(contact.plant.in_contact_with(FREE_SPACE), contact.sample_time_s)
    return SampledContact(contact=contact, free=free)


def _kernel_arguments(contact: SampledPlant, free: SampledPlant) -> Contact:
    step = [np.column_stack([p.phi, p.gamma, p.gamma_old, p.gamma_push]) for p in (contact, free)]
    flow = [np.column_stack([p.rate, p.drive, p.push]) for p in (contact, free)]
    rows = [
        [*contact.c_position, 0.0, 0.0],
        [*contact.c_force, contact.d_force, 0.0],
        [*contact.c_contact, contact.d_contact, contact.push_contact],
    ]
    delay = Delay(contact.whole_delay, contact.chain_length, contact.fraction)
    return Contact(np.array(step), np.array(flow), np.array(rows), _inside(contact), delay, contact_wall(contact))


def contact_wall(contact: SampledPlant) -> Wall:
    """Return the environment of a sampled plant in units of its period."""
    stiffness, damping, mass = contact.plant.environment.coefficients
    h, payload = contact.sample_time_s, contact.plant.payload.mass_kg
    return Wall(stiffness=stiffness, damping=damping / h, mass=mass / h**2, share=payload / (payload + mass))


def _ramp(free: SampledPlant) -> FloatArray:
    matrices, delay = (free.phi, free.gamma, free.gamma_old, free.gamma_push), (free.whole_delay, free.chain_length)
    ramp: FloatArray = steady_ramp(matrices, delay, free.c_force, free.d_force, -2 if free.plant.bumper is None else -4)
    return ramp


@equation
def steady_ramp(matrices: Any, delay: tuple[int, int], c_force: Any, d_force: float, carried: int) -> Any:
    """Solve for the plant state that repeats itself one step further on (or at rest), with x_p = 0.

    Return what `SampledContact.ramp` is, of (phi, gamma, gamma_old, gamma_push) and the whole samples of delay and
    length of the chain in free space. The state `carried`, from the end, is the place of what the coupling carries.
    """
    (phi, gamma, gamma_old, gamma_push), (whole, chain) = matrices, delay
    n = len(gamma)
    system, right = np.zeros((n + 1, n + 1)), np.zeros((n + 1, 2))
    system[:n, :n] = phi - np.eye(n)
    system[:n, n] = gamma + gamma_old
    system[n, n - 2] = 1.0
    right[_FIRST, MOVING] = right[n - 2, MOVING] = right[n + carried, MOVING] = 1.0
    right[:n, MOVING] += gamma * whole + gamma_old * (whole + 1)
    right[:n, PUSHED] = -gamma_push
    found = np.linalg.solve(system, right)
    out = np.zeros((2, n + 2))
    for row in (MOVING, PUSHED):
        out[row, : n + 1] = found[:, row]
        # What the hold shows at the tick: the command of `chain` ticks ago.
        held = found[n, row] - (chain if row == MOVING else 0.0)
        out[row, n + 1] = np.sum(c_force * found[:n, row]) + d_force * held
    return out


def _fastest_swing(contact: SampledPlant) -> float:
    """Return the fastest swing [rad in a sample]; raises ParameterError for one that cannot be followed."""
    poles = np.linalg.eigvals(contact.rate)
    fastest = float(np.max(np.abs(poles.imag)))
    if not (fastest <= _FASTEST_SWING and np.max(np.abs(poles)) <= _FASTEST_DECAY):
        touching = contact.plant.bumper or contact.plant.payload
        stiffness, mass = contact.plant.environment.stiffness_n_per_m, touching.mass_kg
        raise ParameterError(
            "stiffness and payload",
            f"{stiffness:g} N/m on {mass:g} kg",
            f"so that the contact swings at most {_FASTEST_SWING:g} rad in a sample (softer, or heavier)",
        )
    return fastest


def _inside(contact: SampledPlant) -> FloatArray:
    """Return F_e at equal parts of a sample, for contacts so stiff that they swing between the ticks."""
    n, fastest = contact.state_count, _fastest_swing(contact)
    substeps = min(MOST_SUBSTEPS, max(1, math.ceil(SUBSTEPS_PER_RADIAN * fastest)))
    rows = np.zeros((substeps - 1, n + 3))
    inputs = np.stack([contact.drive, contact.push], axis=1)
    for j in range(1, substeps):
        moment = j / substeps
        older, newer = min(moment, contact.fraction), max(0.0, moment - contact.fraction)
        (phi_1, gamma_1), (phi_2, gamma_2) = hold(contact.rate, inputs, older), hold(contact.rate, inputs, newer)
        rows[j - 1, :n] = contact.c_contact @ phi_2 @ phi_1
        rows[j - 1, n] = contact.c_contact @ gamma_2[:, 0]
        rows[j - 1, n + 1] = contact.c_contact @ phi_2 @ gamma_1[:, 0]
        rows[j - 1, n + 2] = contact.c_contact @ (phi_2 @ gamma_1[:, 1] + gamma_2[:, 1]) + contact.push_contact
        rows[j - 1, n + 1 if moment < contact.fraction else n] += contact.d_contact
    return rows


def simulate_contact(
    pair: SampledContact, controller: AdmittanceController, approach: Approach, *, samples: int | None = None
) -> ContactTransient:
    """Simulate one impact of the exact sampled loop, leaving and touching again where the motion says so.

    Between the ticks the plant is integrated exactly; the moment of leaving and of touching is located inside the
    sample. Without `samples` the run lasts until the force has settled. Raises UnstableLoopError if the loop in
    contact or in free space is not stable.
    """
    radius = max(spectral_radius(build_loop(plant, controller)) for plant in (pair.free, pair.contact))
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    return transient_from(pair, controller, approach, samples=samples)


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactStart:
    """The moment of contact as the kernels take it, at `speed_m_s`: controller blocks, states, forces from then on."""

    blocks: FloatArray
    start: Start
    forces: Forces
    speed_m_s: float


def begin_contact(pair: SampledContact, controller: AdmittanceController, approach: Approach) -> ContactStart:
    """Return the state of the loop at the end of a steady approach, see `steady_start`."""
    free, h = pair.free, pair.free.sample_time_s
    check_wrench_delay(free.plant, controller)
    blocks = controller_blocks(controller, h)
    # B_a + B_p, but for the ripple of F between the ticks, which the controller does not see.
    resistance = controller.damping_n_s_per_m - float(pair.ramp[MOVING, -1]) * h
    speed, push, forces = contact_forces(approach.numbers(), resistance)
    force = controller.damping_n_s_per_m * speed
    start = steady_start(pair.ramp, free.c_position, blocks, free.chain_length, h, speed, push, force)
    return ContactStart(blocks=blocks, start=start, forces=forces, speed_m_s=speed)


def longest_run(sample_time_s: float) -> int:
    """Return after how many samples a transient that does not settle is ended."""
    return math.ceil(LONGEST_TRANSIENT_S / sample_time_s)


def transient_from(
    pair: SampledContact, controller: AdmittanceController, approach: Approach, *, samples: int | None = None
) -> ContactTransient:
    """Simulate the impact of a loop that the caller has found stable, see `simulate_contact`."""
    h = pair.free.sample_time_s
    begun = begin_contact(pair, controller, approach)
    longest = samples if samples is not None else longest_run(h)
    traces, found = Traces(np.empty(longest), np.empty(longest)), np.zeros(FOUND)
    count = run_contact(pair.arguments, begun.blocks, begun.start, begun.forces, traces, found, samples is None)
    return ContactTransient(
        time_s=np.asarray(np.arange(count) * h, dtype=np.float64),
        sensor_force_n=-traces.sensed[:count],
        contact_force_n=traces.pressed[:count].copy(),
        contact_speed_m_s=begun.speed_m_s,
        driving_force_n=sum(begun.forces),
        peak_sensor_force_n=float(found[SENSOR_PEAK]),
        time_of_sensor_peak_s=float(found[SENSOR_TICK] * h),
        peak_contact_force_n=float(found[CONTACT_PEAK]),
        time_of_peak_s=float(found[CONTACT_TIME] * h),
        impulse_n_s=float(found[IMPULSE] * h),
        is_settled=samples is not None or count < longest,
    )
