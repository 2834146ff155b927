"""The nonlinear simulation of many plants at once, compiled: of each its stability and its peak forces.

Each plant is built, judged and run as `nonlinear_simulation` does it, which is the oracle; samples in which nothing
happens are crossed by the plant's exponential.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..arrays import BoolArray, FloatArray, IntArray
from ..compiled import compiled, equation, released
from ..model import sampled
from ..model.controller import AdmittanceController
from ..model.plant import ENVIRONMENT_STIFFNESS, OF_FORCE, PLANT_PARAMETERS, write_plant
from ..model.plant_arrays import PlantArrays
from ..stability.polynomials import (
    CONTROLLER_POWERS,
    DOUBTFUL,
    STABLE,
    controller_polynomials,
    hurwitz,
    loop_polynomial,
    plant_polynomials,
)
from .events import rate_bound
from .kernel_types import APART, CONTACT_PEAK, IN_CONTACT, POSITION, SENSED, SENSOR_PEAK, Wall
from .leaps import EARLY, LATE, SLOW, Motion, multiply, write_part
from .nonlinear_kernel import (
    CONTACT,
    FOUND,
    IMPACT_SPEED,
    IMPACT_TIME,
    TRACES,
    KernelOutputs,
    NonlinearController,
    run_nonlinear,
)
from .nonlinear_simulation import FEWEST_SUBSTEPS, DrawnNoise, build_controller
from .nonlinearities import NO_NONLINEARITIES, Nonlinearities
from .steady_approach import POSSIBLE, begin_steadily, drag_of, find_drive
from .transient import Approach, steady_ramp

# A verdict beside those of `stability.polynomials`: the scalar simulation says why it takes no such plant.
REFUSED = -2
# Columns of the peaks: of the contact force without and with the effects, then of the sensor's.
LINEAR_CONTACT, LINEAR_SENSOR, FULL_CONTACT, FULL_SENSOR, PEAKS = 0, 1, 2, 3, 4

# Places of K_e, B_e and M_e among the parameters of a plant.
_K_E, _B_E, _M_E = ENVIRONMENT_STIFFNESS, 5, 6
# The row of v h (`Motion.rows`).
_VELOCITY = 2
# The place of the payload in the plant state, from the end.
_PAYLOAD = -2
# As of an exact contact (`transient`): faster motions per sample would take seconds to follow.
_FASTEST = 1000.0

split_delay = equation(sampled.split_delay)


class Side(NamedTuple):
    """A plant in contact or in free space: `flow` and `rows` as in `Motion`, and the parts of a sample.

    `parts` (2, n, n + 2) are those of `Motion.leap`; `step` are phi, gamma, gamma_old and gamma_push of the whole,
    `turn` bounds how fast it moves in one (`rate_bound`); they are zero where that is beyond all reason.
    """

    flow: FloatArray
    rows: FloatArray
    parts: FloatArray
    step: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    turn: float


@compiled
def build_side(
    numerator: FloatArray, denominator: FloatArray, parameters: FloatArray, h: float, fraction: float
) -> Side:
    """Return the equations of motion of one plant and their exponentials, as `build_sampled_plant` does."""
    n = len(denominator) + 1 + len(parameters) - PLANT_PARAMETERS
    flow, rows, parts = np.zeros((n, n + 2)), np.zeros((3, n + 1)), np.zeros((2, n, n + 2))
    a, b, push, c_contact, direct = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(3)
    write_plant(
        a, b, push, rows[POSITION, :n], rows[SENSED, :n], c_contact, direct, numerator, denominator, parameters, h
    )
    rows[SENSED, n] = direct[OF_FORCE]
    for i in range(n):
        flow[i, n], flow[i, n + 1] = b[i], push[i]
        for j in range(n):
            flow[i, j] = a[i, j]
        # v h is what the position makes of the rate of the state.
        for j in range(n + 1):
            rows[_VELOCITY, j] += rows[POSITION, i] * flow[i, j]
    turn, whole = rate_bound(a), np.zeros((n, n + 2))
    if turn <= _FASTEST:
        write_part(flow, fraction, turn, parts[EARLY])
        write_part(flow, 1.0 - fraction, turn, parts[LATE])
    multiply(parts[LATE], parts[EARLY], whole)
    phi, gamma, gamma_old, gamma_push = np.zeros((n, n)), np.zeros(n), np.zeros(n), np.zeros(n)
    for i in range(n):
        gamma[i], gamma_old[i], gamma_push[i] = parts[LATE, i, n], whole[i, n], whole[i, n + 1] + parts[LATE, i, n + 1]
        for j in range(n):
            phi[i, j] = whole[i, j]
    return Side(flow, rows, parts, (phi, gamma, gamma_old, gamma_push), turn)


@compiled
def judge_side(
    side: Side, delay: tuple[int, int, float], laws: tuple[FloatArray, bool, float, float], free: bool
) -> int:
    """Return the first verdict that is not STABLE of controllers (m, 7) on one side of a plant, see `hurwitz`.

    `laws` are the controllers with whether they compensate ideally, h and θ.
    """
    (phi, gamma, gamma_old, _), (controllers, ideal, h, theta) = side.step, laws
    n = len(gamma)
    outputs = np.zeros((2, n + 2))
    outputs[:, : n + 1] = side.rows[:2]
    plant = plant_polynomials(phi, gamma, gamma_old, outputs, delay, free)
    controller, work = np.zeros((3, CONTROLLER_POWERS)), np.zeros(plant.shape[1] + CONTROLLER_POWERS)
    for i in range(len(controllers)):
        degree = controller_polynomials(controllers[i], ideal, controller)
        total = loop_polynomial(plant, controller, degree, h, theta, work)
        verdict = hurwitz(work, total, 1 if free else 0)
        if verdict != STABLE:
            return verdict
    return STABLE


@compiled
def build_motion(contact: Side, free: Side, wall: Wall, delay: tuple[int, int, float], fewest: int) -> Motion:
    """Return what `run_nonlinear` takes of a plant, with no fewer substeps than `needed_substeps` says."""
    (whole, chain, fraction), n, turn = delay, len(contact.flow), max(contact.turn, free.turn)
    substeps = max(fewest, int(np.ceil(2.0 * turn)))
    before = int(np.ceil(substeps * fraction))
    leap = np.zeros((2 if turn <= SLOW else 0, 2, n, n + 2))
    if len(leap) > 0:
        leap[IN_CONTACT], leap[APART] = contact.parts, free.parts
    return Motion(free.flow, free.rows, wall, whole, chain, fraction, (before, max(1, substeps - before)), leap)


@released
def run_plants(
    robots: tuple[FloatArray, FloatArray],
    parameters: FloatArray,
    delays: FloatArray,
    laws: tuple[FloatArray, bool, float, float],
    runs: tuple[NonlinearController, NonlinearController],
    approach: tuple[float, float, bool, float],
    fewest: int,
    draws: tuple[FloatArray, BoolArray],
    out: tuple[IntArray, FloatArray, FloatArray],
) -> None:
    """Write the verdict (p,) and the peaks (p, PEAKS) of every plant, NaN where it is not STABLE.

    `runs` are the controllers without and with the effects, `draws` the noise and the late commands (p, ticks) of the
    latter. The third of `out` takes its contact force at the ticks (p, ticks), or of no plant (0, ticks).
    """
    (numerators, denominators), (noise, late), (verdicts, peaks, traces) = robots, draws, out
    ticks, (_, _, h, _) = noise.shape[1], laws
    silence, punctual, pulls = np.zeros(ticks), np.zeros(ticks, dtype=np.bool_), np.zeros(ticks + 1)
    found = np.zeros(FOUND)
    untraced = KernelOutputs(np.empty((TRACES, 0)), np.empty(0, dtype=np.int64), found)
    traced = KernelOutputs(np.empty((TRACES, ticks)), np.empty(ticks, dtype=np.int64), found)
    for k in range(len(parameters)):
        peaks[k] = np.nan
        whole, fraction = split_delay(delays[k], h)
        chain, apart = whole + (1 if fraction > 0.0 else 0), parameters[k].copy()
        apart[_K_E], apart[_B_E] = 0.0, 0.0
        contact = build_side(numerators[k], denominators[k], parameters[k], h, fraction)
        free = build_side(numerators[k], denominators[k], apart, h, fraction)
        n = len(free.flow)
        instant = delays[k] == 0.0 and free.rows[SENSED, n] != 0.0
        if parameters[k, _M_E] > 0.0 or instant or not max(free.turn, contact.turn) <= _FASTEST:
            verdicts[k] = REFUSED
            continue
        for side, k_e in ((free, 0.0), (contact, parameters[k, _K_E])):
            verdicts[k] = judge_side(side, (whole, chain, fraction), laws, k_e == 0.0)
            if verdicts[k] != STABLE:
                break
        if verdicts[k] != STABLE:
            continue
        wall = Wall(parameters[k, _K_E], parameters[k, _B_E] / h, 0.0, 1.0)
        motion = build_motion(contact, free, wall, (whole, chain, fraction), fewest)
        ramp = steady_ramp(free.step, (whole, chain), free.rows[SENSED, :n], free.rows[SENSED, n], _PAYLOAD)
        for run in range(2):
            drive, wrong = find_drive(runs[run], drag_of(ramp, h), approach)
            if wrong == POSSIBLE:
                start, seen = begin_steadily(runs[run], drive, ramp, free.rows[POSITION, :n], chain)
            if wrong != POSSIBLE or -seen > runs[run].threshold:
                verdicts[k] = REFUSED
                break
            found[:IMPACT_TIME], found[IMPACT_TIME:] = 0.0, np.nan
            found[IMPACT_TIME], found[IMPACT_SPEED] = 0.0, drive.speed * h
            drawn, lates = (silence, punctual) if run == 0 else (noise[k], late[k])
            outputs = traced if k < len(traces) else untraced
            run_nonlinear(motion, runs[run], start, drive.desired, drive.push, drawn, lates, pulls, outputs)
            peaks[k, 2 * run], peaks[k, 2 * run + 1] = found[CONTACT_PEAK], found[SENSOR_PEAK]
        if k < len(traces):
            traces[k] = traced.traces[CONTACT]


@dataclass(frozen=True, kw_only=True, eq=False)
class ManyContacts:
    """What came of plants: `verdicts` (p,), `peaks_n` (p, PEAKS), and the contact force (t, ticks) of the first."""

    verdicts: IntArray
    peaks_n: FloatArray
    traces_n: FloatArray


def simulate_plants(
    plants: PlantArrays,
    controller: AdmittanceController,
    approach: Approach,
    *,
    sample_time_s: float,
    effects: Nonlinearities,
    draws: DrawnNoise,
    traced: int = 0,
) -> ManyContacts:
    """Simulate a contact of every plant, without and with effects; the interpreter's lock is not held meanwhile.

    Parameters
    ----------
    plants
        The plants (p,), in contact with a massless environment.
    controller, approach, sample_time_s, effects
        As `simulate_nonlinear` takes them; the contact begins at the impact.
    draws
        The noise [N] and the late commands, (p, ticks) each; the run takes as many ticks.
    traced
        Of how many plants, from the first on, the contact force is kept.

    Returns
    -------
    ManyContacts
        Where rounding could decide stability the verdict is DOUBTFUL, of what cannot be simulated REFUSED: of these
        `simulate_nonlinear` says more. Peaks [N] are those of a stable plant.

    """
    h, count = sample_time_s, plants.count
    variable = effects.variable_damping
    dampings = {controller.damping_n_s_per_m, *(() if variable is None else variable.bounds_n_s_per_m)}
    numbers = np.array([replace(controller, damping_n_s_per_m=damping).numbers() for damping in sorted(dampings)])
    own = build_controller(controller, NO_NONLINEARITIES, h), build_controller(controller, effects, h)
    found = ManyContacts(
        verdicts=np.full(count, DOUBTFUL, dtype=np.int64),
        peaks_n=np.empty((count, PEAKS)),
        traces_n=np.zeros((min(traced, count), draws.force_n.shape[1])),
    )
    run_plants(
        (plants.numerators, plants.denominators),
        plants.parameters,
        plants.delay_s,
        (numbers, controller.is_ideal, h, controller.theta),
        own,
        approach.numbers(),
        FEWEST_SUBSTEPS,
        (draws.force_n, draws.late),
        (found.verdicts, found.peaks_n, found.traces_n),
    )
    return found
