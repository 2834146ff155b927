"""The contact transient: approach in free space, impact, unilateral contact (MODEL.md, "The contact transient")."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ._checks import positive
from .contact_kernel import run_contact
from .controller import AdmittanceController, controller_blocks
from .errors import ParameterError
from .margins import UnstableLoopError
from .plant import FREE_SPACE
from .sampled import SampledLoop, SampledPlant, build_loop, build_sampled_plant, spectral_radius

FloatArray = NDArray[np.float64]

# The transient is followed until its slowest part has decayed to exp(-7), a thousandth of the peak.
_DECAY_EXPONENTS = 7.0
_SHORTEST_SAMPLES = 64
_LONGEST_S = 10.0


@dataclass(frozen=True, kw_only=True)
class Approach:
    """How the payload meets the wall: exactly one of the two is given.

    `force_n`: F^d is held until the speed is steady, and after the impact (the paper's contact experiments).
    `speed_m_s`: contact at this speed; the force that sustains it in free space goes on after the impact, as a hand
    that keeps pushing does.
    """

    force_n: float | None = None
    speed_m_s: float | None = None

    def __post_init__(self) -> None:
        if (self.force_n is None) == (self.speed_m_s is None):
            raise ParameterError("approach", (self.force_n, self.speed_m_s), "one of force_n and speed_m_s")
        for name, value in (("force_n", self.force_n), ("speed_m_s", self.speed_m_s)):
            if value is not None:
                object.__setattr__(self, name, positive(f"approach.{name}", value))


@dataclass(frozen=True, kw_only=True)
class ContactTransient:
    """Forces at the controller's ticks from the impact on, `time_s` (n,), and their peaks.

    `sensor_force_n` is −F, positive when pressing; `contact_force_n` is F_e.
    """

    time_s: FloatArray
    sensor_force_n: FloatArray
    contact_force_n: FloatArray
    contact_speed_m_s: float
    driving_force_n: float

    @property
    def peak_sensor_force_n(self) -> float:
        """Largest pressing force that the sensor shows."""
        return float(np.max(self.sensor_force_n))

    @property
    def peak_contact_force_n(self) -> float:
        """Largest force on the environment."""
        return float(np.max(self.contact_force_n))

    @property
    def time_of_peak_s(self) -> float:
        """Time from impact to the peak of the contact force."""
        return float(self.time_s[int(np.argmax(self.contact_force_n))])


@dataclass(frozen=True, kw_only=True)
class SampledContact:
    """A plant in contact and the same plant in free space, both sampled."""

    contact: SampledPlant
    free: SampledPlant


def build_sampled_contact(contact: SampledPlant) -> SampledContact:
    """Pair a sampled plant in contact with its free-space twin."""
    if contact.plant.environment.is_free_space:
        raise ParameterError("environment", contact.plant.environment, "a surface to touch, not free space")
    free = build_sampled_plant(contact.plant.in_contact_with(FREE_SPACE), contact.sample_time_s)
    return SampledContact(contact=contact, free=free)


@dataclass(frozen=True, kw_only=True)
class SteadyApproach:
    """The loop state at the moment of contact (x_p = 0) while everything moves at `speed_m_s`."""

    state: FloatArray
    speed_m_s: float
    force_n: float


def steady_approach(free: SampledPlant, free_loop: SampledLoop, approach: Approach) -> SteadyApproach:
    """Solve for the free-space state that moves by the same step every period.

    (a − 1) s − v h·translation + b F^d = 0 with x_p = 0 and either F^d or v given: linear, one solution.
    """
    size = len(free_loop.a)
    h, payload = free.sample_time_s, free.state_count - 2
    system = np.zeros((size + 2, size + 2))
    right = np.zeros(size + 2)
    system[:size, :size] = free_loop.a - np.eye(size)
    system[:size, size] = -h * free_loop.translation
    system[:size, size + 1] = free_loop.b
    system[size, payload] = 1.0
    if approach.force_n is not None:
        system[size + 1, size + 1], right[size + 1] = 1.0, approach.force_n
    else:
        system[size + 1, size], right[size + 1] = 1.0, approach.speed_m_s
    solution = np.linalg.solve(system, right)
    return SteadyApproach(
        state=np.asarray(solution[:size], dtype=np.float64),
        speed_m_s=float(solution[size]),
        force_n=float(solution[size + 1]),
    )


def settling_samples(radius: float, sample_time_s: float) -> int:
    """Return how many samples the transient of a loop with this spectral radius needs."""
    longest = math.ceil(_LONGEST_S / sample_time_s)
    if radius <= 0.0:
        return _SHORTEST_SAMPLES
    return int(min(longest, max(_SHORTEST_SAMPLES, math.ceil(_DECAY_EXPONENTS / -math.log(radius)))))


def simulate_contact(
    pair: SampledContact, controller: AdmittanceController, approach: Approach, *, samples: int | None = None
) -> ContactTransient:
    """Simulate one impact of the exact sampled loop, leaving and touching again where the motion says so.

    Between the ticks the plant is integrated exactly; the moment of leaving and of touching is located inside the
    sample. Raises UnstableLoopError if the loop in contact or in free space is not stable.
    """
    free_loop, contact_loop = build_loop(pair.free, controller), build_loop(pair.contact, controller)
    radius = max(spectral_radius(free_loop), spectral_radius(contact_loop))
    if not radius < 1.0:
        raise UnstableLoopError(radius)
    count = samples if samples is not None else settling_samples(spectral_radius(contact_loop), pair.free.sample_time_s)
    return transient_from(pair, free_loop, controller, approach, count)


def transient_from(
    pair: SampledContact, free_loop: SampledLoop, controller: AdmittanceController, approach: Approach, samples: int
) -> ContactTransient:
    """Simulate `samples` periods of a loop that the caller has found stable."""
    contact, free = pair.contact, pair.free
    start = steady_approach(free, free_loop, approach)
    environment = contact.plant.environment
    force, contact_force = run_contact(
        (contact.phi, contact.gamma, contact.gamma_old, contact.rate),
        (free.phi, free.gamma, free.gamma_old, free.rate),
        free.drive,
        (free.c_position, free.c_force, free.d_force),
        (free.whole_delay, free.chain_length, free.fraction),
        (environment.stiffness_n_per_m, environment.damping_n_s_per_m / free.sample_time_s),
        controller_blocks(controller.parameters(), free.sample_time_s),
        start.state,
        start.force_n,
        samples,
    )
    return ContactTransient(
        time_s=np.asarray(np.arange(samples) * free.sample_time_s, dtype=np.float64),
        sensor_force_n=-force,
        contact_force_n=contact_force,
        contact_speed_m_s=start.speed_m_s,
        driving_force_n=start.force_n,
    )
