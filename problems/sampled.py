"""The exact sampled loop: held plant by matrix exponential, delay as a shift chain."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ._checks import positive
from .compiled import compiled
from .controller import AdmittanceController, controller_blocks
from .plant import Plant, build_plant_matrices

FloatArray = NDArray[np.float64]

# A delay this close to a whole number of samples (in samples) is that number; it is far below any clock's resolution.
_WHOLE = 1e-9
_CONTROLLER_STATES = 3


@dataclass(frozen=True, kw_only=True)
class SampledPlant:
    """The plant between two ticks of the controller, T_d = (`whole_delay` + fraction)·h.

    s_{k+1} = phi s_k + gamma_old u_{k−d−1} + gamma u_{k−d} with u = x^d and d = `whole_delay`; `gamma_old` is zero
    for a whole delay. Outputs right after the hold's update at the tick: x_k = c_x s_k, F_k = c_F s_k + d_F·(held
    input). `rate` and `drive` are the continuous ds/dτ = rate·s + drive·u over τ in [0, 1] (one period).
    """

    plant: Plant
    sample_time_s: float
    phi: FloatArray
    gamma: FloatArray
    gamma_old: FloatArray
    c_position: FloatArray
    c_force: FloatArray
    d_force: float
    whole_delay: int
    fraction: float
    rate: FloatArray
    drive: FloatArray

    @property
    def state_count(self) -> int:
        """Continuous states, the delay chain not counted."""
        return len(self.gamma)

    @property
    def chain_length(self) -> int:
        """Past commands that the plant still has to see."""
        return self.whole_delay + (1 if self.fraction > 0.0 else 0)


def split_delay(delay_s: float, sample_time_s: float) -> tuple[int, float]:
    """Return the whole samples and the remaining fraction of a sample in `delay_s`."""
    samples = delay_s / sample_time_s
    whole = math.floor(samples + _WHOLE)
    fraction = samples - whole
    return whole, fraction if fraction > _WHOLE else 0.0


def build_sampled_plant(plant: Plant, sample_time_s: float) -> SampledPlant:
    """Discretise the plant under a zero-order hold, exactly, with its delay."""
    h = positive("sample_time_s", sample_time_s)
    m = build_plant_matrices(plant, h)
    whole, fraction = split_delay(plant.robot.delay_s, h)
    phi, gamma = hold(m.a, m.b, 1.0)
    gamma_old = np.zeros_like(gamma)
    if fraction > 0.0:
        # The older command acts during the first `fraction` of the period, the newer one during the rest.
        _, gamma_new = hold(m.a, m.b, 1.0 - fraction)
        gamma_old, gamma = gamma - gamma_new, gamma_new
    return SampledPlant(
        plant=plant,
        sample_time_s=h,
        phi=phi,
        gamma=gamma,
        gamma_old=gamma_old,
        c_position=m.c_position,
        c_force=m.c_force,
        d_force=m.d_force,
        whole_delay=whole,
        fraction=fraction,
        rate=m.a,
        drive=m.b,
    )


def hold(a: FloatArray, b: FloatArray, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return exp(a·duration) and ∫ exp(a σ) b dσ over [0, duration], from one augmented exponential."""
    n = len(b)
    augmented = np.zeros((n + 1, n + 1))
    augmented[:n, :n], augmented[:n, n] = a, b
    whole = expm(augmented * duration)
    return np.ascontiguousarray(whole[:n, :n]), np.ascontiguousarray(whole[:n, n])


@dataclass(frozen=True, kw_only=True)
class SampledLoop:
    """s_{k+1} = a s_k + b F^d_k, F_k = c_F s_k + d_F F^d_k; states: plant, past commands (newest first), controller.

    `d_force` is non-zero only when the delay is zero and the coupling has damping. `translation` is the state's
    change when everything moves by one metre: the eigenvector of the integrator at z = 1 in free space.
    """

    a: FloatArray
    b: FloatArray
    c_force: FloatArray
    d_force: float
    translation: FloatArray
    sample_time_s: float
    is_free_space: bool


@compiled
def assemble_loop(
    phi: FloatArray,
    gamma: FloatArray,
    gamma_old: FloatArray,
    c_position: FloatArray,
    c_force: FloatArray,
    d_force: float,
    whole: int,
    chain: int,
    blocks: FloatArray,
) -> FloatArray:
    """Return the loop as rows (plant, chain, controller, output F), columns (states, F^d).

    Every signal is a row over (states, F^d): F and x from the plant, x^d from the controller's blocks.
    """
    n = len(gamma)
    size = n + chain + 3
    force, position, forward = np.zeros(size + 1), np.zeros(size + 1), np.zeros(size + 1)
    force[:n] = c_force
    position[:n] = c_position
    direct = blocks[0, 0] + blocks[1, 0]
    # The input that the hold shows at the tick: the oldest command in the chain, or the new one without delay.
    if chain > 0:
        force[n + chain - 1] += d_force
    forward[n + chain : n + chain + 3] = np.array([1.0, 1.0, -1.0])
    forward[size] = direct
    command = forward + direct * force - blocks[2, 0] * position
    if chain == 0:
        command /= 1.0 - direct * d_force
        force += d_force * command
    out = np.zeros((size + 1, size + 1))
    out[:n, :n] = phi
    if chain == 0:
        for i in range(n):
            out[i] += gamma[i] * command
    elif whole == 0:
        out[:n, n] += gamma_old
        for i in range(n):
            out[i] += gamma[i] * command
    else:
        out[:n, n + whole - 1] += gamma
        if chain > whole:
            out[:n, n + chain - 1] += gamma_old
    if chain > 0:
        out[n] = command
        for i in range(1, chain):
            out[n + i, n + i - 1] = 1.0
    for i in range(2):
        out[n + chain + i] = blocks[i, 2] * force
        out[n + chain + i, size] += blocks[i, 2]
        out[n + chain + i, n + chain + i] += blocks[i, 1]
    out[n + chain + 2] = blocks[2, 2] * position
    out[n + chain + 2, n + chain + 2] += blocks[2, 1]
    out[size] = force
    return out


def build_loop(sampled: SampledPlant, controller: AdmittanceController) -> SampledLoop:
    """Close the loop of `sampled` and the Tustin form of `controller`, without approximation."""
    blocks = controller_blocks(controller.parameters(), sampled.sample_time_s)
    whole = assemble_loop(
        sampled.phi,
        sampled.gamma,
        sampled.gamma_old,
        sampled.c_position,
        sampled.c_force,
        sampled.d_force,
        sampled.whole_delay,
        sampled.chain_length,
        blocks,
    )
    return SampledLoop(
        a=whole[:-1, :-1],
        b=whole[:-1, -1],
        c_force=whole[-1, :-1],
        d_force=float(whole[-1, -1]),
        translation=translation_state(sampled, blocks),
        sample_time_s=sampled.sample_time_s,
        is_free_space=sampled.plant.environment.is_free_space,
    )


def translation_state(sampled: SampledPlant, blocks: FloatArray) -> FloatArray:
    """Return the loop state in which flange, payload and command all rest at one metre and F = 0."""
    n, chain = sampled.state_count, sampled.chain_length
    state = np.zeros(n + chain + _CONTROLLER_STATES)
    state[0] = 1.0  # the robot chain's first state has unit gain at rest (r(0) = 1)
    state[n - 2] = 1.0  # x_p
    state[n : n + chain] = 1.0
    feedback_direct, feedback_pole, feedback_gain = blocks[2]
    feedback_rest = feedback_gain / (1.0 - feedback_pole)
    # x^d = 1 = integrator − C_fb x, and C_fb blocks constants: direct + rest = 0.
    state[n + chain] = 1.0 + feedback_direct + feedback_rest
    state[n + chain + 2] = feedback_rest
    return state


def stability_matrix(loop: SampledLoop) -> FloatArray:
    """Return the matrix whose eigenvalues decide: all of `a`, in free space without the integrator at z = 1.

    In free space position is relative: subtracting the translation from every state by way of the payload position
    removes exactly one eigenvalue, 1, and leaves the others (no rounding decides whether 1.0000001 is unstable).
    """
    if not loop.is_free_space:
        return loop.a
    pivot = int(np.argmax(np.abs(loop.translation)))
    reduced = loop.a - np.outer(loop.translation / loop.translation[pivot], loop.a[pivot])
    keep = np.arange(len(loop.a)) != pivot
    return np.ascontiguousarray(reduced[np.ix_(keep, keep)])


def spectral_radius(loop: SampledLoop) -> float:
    """Return the largest |z| of the loop; below 1 is stable."""
    return float(np.max(np.abs(np.linalg.eigvals(stability_matrix(loop)))))
