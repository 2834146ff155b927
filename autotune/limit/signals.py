"""What a command and an approaching wall do to the forces of one plant in contact, tick by tick and in frequency.

In contact the loop is linear. Relative to the steady free motion that it would have gone on with, the payload is at
rest and the wall comes towards it with the speed of the approach v, so that every force of a first contact is the
answer of the loop to one ramp, whatever the controller's state was: F = F_0 + S w with w what the ramp does to the
plant alone and S = 1/(1 + L) (docs/limit.md, "How").
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from problems.arrays import ComplexArray, FloatArray
from problems.contact.kernel_types import MOVING
from problems.contact.transient import SampledContact
from problems.model.linear_controllers import LinearController
from problems.model.response import plant_response
from problems.model.sampled import SampledPlant, build_cut_loop


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenPlant:
    """x_{k+1} = a x_k + b u_k and F_k = c x_k + d u_k with u = x^d: plant and delay, no controller."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    d: float

    @classmethod
    def of(cls, sampled: SampledPlant) -> "OpenPlant":
        """Return the plant between the command and the measured force."""
        idle = LinearController(matrix=np.array([[0.0, 1.0]]), rest=np.zeros(0), sample_time_s=sampled.sample_time_s)
        cut = build_cut_loop(sampled, idle)
        m, n, w = cut.matrix, cut.state_count, cut.command
        return cls(a=m[:n, :n].copy(), b=m[:n, w + 0].copy(), c=m[cut.force, :n].copy(), d=float(m[cut.force, w]))

    def pulse(self, row: FloatArray, direct: float, count: int) -> FloatArray:
        """Return what a command of one metre at tick 0 does to `row` x + `direct` u at the ticks (count,)."""
        out, state = np.empty(count), self.b
        out[0] = direct
        for k in range(1, count):
            out[k] = row @ state
            state = self.a @ state
        return out


@dataclass(frozen=True, kw_only=True, eq=False)
class ContactSignals:
    """One plant in contact, approached at a speed; arrays are (n,) at the ticks from the touch on.

    `force_pulse` and `contact_pulse` are what a command of one metre at tick 0 does to −F and F_e, `wall_force` and
    `wall_contact` what the coming wall does to F and F_e while the command stays; `steady_force_n` is F of the
    approach, and `ramp_force_n` what F grows by in the end per tick of the ramp.
    """

    pair: SampledContact
    open: OpenPlant
    free: OpenPlant
    force_pulse: FloatArray
    contact_pulse: FloatArray
    wall_force: FloatArray
    wall_contact: FloatArray
    steady_force_n: float
    ramp_force_n: float

    def response(self, omega: FloatArray, *, free: bool = False) -> ComplexArray:
        """Return −F/x^d of the plant in contact, or in free space, at the frequencies (k,) [rad/s]."""
        return -plant_response(self.pair.free if free else self.pair.contact, omega).force


def contact_signals(pair: SampledContact, speed_m_s: float, count: int) -> ContactSignals:
    """Return the signals of a touch at a tick after a steady approach at `speed_m_s`, for `count` ticks."""
    contact, opened = pair.contact, OpenPlant.of(pair.contact)
    h, n = contact.sample_time_s, contact.state_count
    row = np.zeros(len(opened.a))
    row[:n] = contact.c_contact
    force, pressed = _ramp(contact, speed_m_s, count)
    return ContactSignals(
        pair=pair,
        open=opened,
        free=OpenPlant.of(pair.free),
        force_pulse=-opened.pulse(opened.c, opened.d, count),
        contact_pulse=opened.pulse(row, contact.d_contact, count),
        wall_force=force,
        wall_contact=pressed,
        steady_force_n=float(pair.ramp[MOVING, -1]) * speed_m_s * h,
        ramp_force_n=_held_force(contact) * speed_m_s * h,
    )


def _ramp(contact: SampledPlant, speed_m_s: float, count: int) -> tuple[FloatArray, FloatArray]:
    """Return F and F_e at the ticks (count,) while the command stays and the wall comes at `speed_m_s`."""
    h, n = contact.sample_time_s, contact.state_count
    stiffness, damping, _ = contact.plant.environment.coefficients
    # States: those of the plant, the way of the wall in samples, and 1. Time is in samples.
    rate = np.zeros((n + 2, n + 2))
    rate[:n, :n] = contact.rate
    rate[:n, n] = -stiffness * speed_m_s * h * contact.push
    rate[:n, n + 1] = -damping * speed_m_s * contact.push
    rate[n, n + 1] = 1.0
    step, state = expm(rate), np.zeros(n + 2)
    state[n + 1] = 1.0
    force, pressed = np.empty(count), np.empty(count)
    for k in range(count):
        force[k] = contact.c_force @ state[:n]
        pressed[k] = contact.c_contact @ state[:n] + stiffness * speed_m_s * h * k + damping * speed_m_s
        state = step @ state
    return force, pressed


def _held_force(contact: SampledPlant) -> float:
    """Return how much F changes in the end per metre that the wall moves while the command stays [N/m]."""
    stiffness = contact.plant.environment.stiffness_n_per_m
    coupling = contact.plant.coupling.stiffness_n_per_m
    return -stiffness * coupling / (stiffness + coupling)
