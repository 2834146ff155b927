"""How long one controller must run before the next one takes over: a dwell time from quadratic Lyapunov functions.

Controllers that take over from each other go on from what they have in common: the plant, the commands that were sent,
and the controller's memory (the last two drives, positions and outputs of the velocity filter, and the last output of
the acceleration filter). In these coordinates nothing jumps at a change: only the matrix of the loop does.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import eigh, solve_discrete_lyapunov

from ..arrays import FloatArray
from ..errors import ParameterError
from ..model.controller import AdmittanceController, controller_blocks
from ..model.difference import (
    ACCELERATION_DIRECT,
    ACCELERATION_POLE,
    COMPENSATION,
    FEEDBACK_DAMPING,
    VELOCITY_DIRECT,
    VELOCITY_POLE,
    resume,
)
from ..model.sampled import SampledPlant

# Memory behind the plant and the commands: two drives, two positions, two speeds, one acceleration.
_MEMORY = 7
# Longer than this no cell waits; the loops' slowest parts then hardly decay.
MOST_SAMPLES = 2**20
# A decrease that is smaller than this share is rounding.
_ROUNDING = 1e-9


def common_loop(sampled: SampledPlant, controller: AdmittanceController) -> FloatArray:
    """Return the closed loop z⁺ = A z in coordinates that controllers of one cell share, scaled to metres.

    z are the plant's states, the last commands (two, or as many as the delay asks for, newest first), the drives u,
    positions x and speeds v of the last two ticks and the last acceleration. Nothing is driven from outside. Raises
    ParameterError for a loop whose force hangs on the command of the same tick.
    """
    n, chain, h = sampled.state_count, sampled.chain_length, sampled.sample_time_s
    if chain == 0 and sampled.d_force != 0.0:
        raise ParameterError("delay_s", sampled.plant.loop_delay_s, "above 0, with damping in the coupling")
    if controller.has_biquad:
        raise ParameterError(
            "controller", "with a biquad", "without one: its memory is not shared with other controllers"
        )
    blocks, commands = controller_blocks(controller, h), least_commands(sampled)
    stiffness = sampled.plant.coupling.stiffness_n_per_m
    size = n + commands + _MEMORY
    units = np.ones(size)
    units[n + commands :] = (stiffness, stiffness, 1.0, 1.0, 1.0 / h, 1.0 / h, 1.0 / h**2)
    out = np.empty((size, size))
    for j in range(size):
        z = np.zeros(size)
        z[j] = units[j]
        out[:, j] = _following(sampled, blocks, z, n, commands) / units
    return out


def least_commands(sampled: SampledPlant) -> int:
    """Return how many of the last commands are kept."""
    return max(2, sampled.chain_length)


def _following(sampled: SampledPlant, blocks: FloatArray, z: FloatArray, n: int, commands: int) -> FloatArray:
    """Return z one period later (`common_loop`)."""
    state, past = z[:n], z[n : n + commands]
    drive_1, drive_0, place_1, place_0, speed_1, speed_0, rate_1 = z[n + commands :]
    feedback, lag = blocks[FEEDBACK_DAMPING], sampled.chain_length
    position = float(sampled.c_position @ state)
    force = float(sampled.c_force @ state) + (sampled.d_force * past[lag - 1] if lag else 0.0)
    speed = blocks[VELOCITY_POLE] * speed_1 + blocks[VELOCITY_DIRECT] * (position - place_1)
    rate = blocks[ACCELERATION_POLE] * rate_1 + blocks[ACCELERATION_DIRECT] * (speed - speed_1)
    drive = force + blocks[COMPENSATION] * rate
    recent, older = (past[0] + feedback * speed_1, drive_1, place_1), (past[1] + feedback * speed_0, drive_0, place_0)
    integral, slow = resume(blocks, recent, older)
    command = integral + slow + (blocks[0, 0] + blocks[1, 0]) * drive - feedback * speed
    sent = np.concatenate([[command], past])
    whole = sampled.whole_delay
    acting = sampled.gamma * sent[whole]
    if sampled.fraction > 0.0:
        acting = acting + sampled.gamma_old * sent[whole + 1]
    memory = (drive, drive_1, position, place_1, speed, speed_1, rate)
    return np.concatenate([sampled.phi @ state + acting, sent[:commands], memory])


def without_translation(loop: FloatArray, sampled: SampledPlant) -> FloatArray:
    """Return the loop of free space without its translation, by which everything may be anywhere: z less the command's.

    All places count from the last command, which is left out. The same coordinates hold for every controller.
    """
    project, kept = translation_projection(sampled, len(loop))
    return np.asarray(project @ loop @ kept.T)


def translation_projection(sampled: SampledPlant, size: int) -> tuple[FloatArray, FloatArray]:
    """Return the matrices (size − 1, size) that leave out the last command, and take it off all places or not."""
    n, commands = sampled.state_count, least_commands(sampled)
    places = np.zeros(size)
    places[list(sampled.places)] = 1.0
    places[n : n + commands] = 1.0
    places[n + commands + 2 : n + commands + 4] = 1.0
    kept = np.delete(np.eye(size), n, axis=0)
    return kept - np.outer(kept @ places, np.eye(size)[n]), kept


def dwell_samples(modes: Sequence[Sequence[FloatArray]]) -> int:
    """Return after how many samples at least a change from any controller to any other is safe, 0 if always.

    Parameters
    ----------
    modes
        Of each controller the matrices (n, n) of its loop on its plants, all in the same coordinates.

    Returns
    -------
    int
        N such that with P = Σ (A^k)ᵀ A^k of each loop, (A^N)ᵀ P' A^N < P for every P' of another controller: along
        any sequence of controllers and plants that stay N samples at least, the Lyapunov function of the loop that
        runs is lower at each change (Geromel and Colaneri, *SIAM J. Control Optim.* 45(5), 2006).

    Raises
    ------
    ParameterError
        For a loop that is not stable, or one that needs more than `MOST_SAMPLES`.
    """
    shapes = [[_lyapunov(loop) for loop in of] for of in modes]
    longest = 0
    for i, of in enumerate(modes):
        others = [shape for j, each in enumerate(shapes) if j != i for shape in each]
        for loop, own in zip(of, shapes[i], strict=True):
            longest = max(longest, _needed(loop, own, others)) if others else longest
    return longest


def _lyapunov(loop: FloatArray) -> FloatArray:
    radius = float(np.max(np.abs(np.linalg.eigvals(loop))))
    if not radius < 1.0:
        raise ParameterError("modes", radius, "loops that are stable, largest |z| below 1")
    shape = solve_discrete_lyapunov(loop.T, np.eye(len(loop)))
    return np.asarray(0.5 * (shape + shape.T))


def _needed(loop: FloatArray, own: FloatArray, others: Sequence[FloatArray]) -> int:
    """Return the least N from which (A^N)ᵀ P' A^N < P for all others: doubled, then halved, as it holds from N on."""

    def holds(power: FloatArray) -> bool:
        largest = max(float(eigh(power.T @ each @ power, own, eigvals_only=True)[-1]) for each in others)
        return largest < 1.0 - _ROUNDING

    if holds(np.eye(len(loop))):
        return 0
    powers = [loop]
    while not holds(powers[-1]):
        if 2 ** len(powers) > MOST_SAMPLES:
            raise ParameterError("modes", MOST_SAMPLES, "loops that decay within that many samples")
        powers.append(powers[-1] @ powers[-1])
    count, reached = 0, np.eye(len(loop))
    # The highest of those that fail, bit by bit.
    for bit in range(len(powers) - 2, -1, -1):
        further = powers[bit] @ reached
        if not holds(further):
            count, reached = count + 2**bit, further
    return count + 1
