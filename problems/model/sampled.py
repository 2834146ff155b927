"""The exact sampled loop: held plant by matrix exponential, delay as a shift chain."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from .._checks import positive
from ..arrays import FloatArray
from ..compiled import compiled, equation
from ..errors import ParameterError
from .controller import CONTROLLER_STATES, AdmittanceController, controller_blocks, controller_step, needed_states
from .difference import rest_states
from .linear_controllers import LinearController
from .plant import Plant, build_plant_matrices

Controller = AdmittanceController | LinearController

# A delay this close to a whole number of samples (in samples) is that number; it is far below any clock's resolution.
_WHOLE = 1e-9
MOST_DELAY_SAMPLES = 1000
# With a norm of at most 1/2 the series below is exact to rounding.
_TAYLOR_TERMS = 14
_MOST_SQUARINGS, _HOPELESS_SQUARINGS = 12, 60


@dataclass(frozen=True, kw_only=True)
class SampledPlant:
    """The plant between two ticks of the controller, T_d + θ = (`whole_delay` + fraction)·h.

    With a delay θ of the wrench time is that of the wrench: tick k is the moment at which the force that the
    controller reads θ later acted. For a law of the force alone that is the same loop as without it and T_d longer by
    θ; a law that also reads the position, which is not late, is refused (`check_wrench_delay`).

    s_{k+1} = phi s_k + gamma_old u_{k−d−1} + gamma u_{k−d} + gamma_push f_k with u = x^d, d = `whole_delay` and f a
    held outside force on the payload; `gamma_old` is zero for a whole delay. Outputs right after the hold's update at
    the tick: x_k = c_x s_k, F_k = c_F s_k + d_F·(held input), and in contact F_e,k = c_e s_k + d_e·(held input) +
    p_e f_k. `rate`, `drive` and `push` are the continuous ds/dτ = rate·s + drive·u + push·f over τ in [0, 1] (one
    period).
    """

    plant: Plant
    sample_time_s: float
    phi: FloatArray
    gamma: FloatArray
    gamma_old: FloatArray
    gamma_push: FloatArray
    c_position: FloatArray
    c_force: FloatArray
    d_force: float
    c_contact: FloatArray
    d_contact: float
    push_contact: float
    whole_delay: int
    fraction: float
    rate: FloatArray
    drive: FloatArray
    push: FloatArray

    @property
    def state_count(self) -> int:
        """Continuous states, the delay chain not counted."""
        return len(self.gamma)

    @property
    def places(self) -> tuple[int, ...]:
        """Which states are one metre more when everything rests one metre further on.

        The robot chain's first state has unit gain at rest (r(0) = 1); then x_p, and the place of what bears a bumper.
        """
        n = self.state_count
        return (0, n - 2) if self.plant.bumper is None else (0, n - 4, n - 2)

    @property
    def chain_length(self) -> int:
        """Past commands that the plant still has to see."""
        return self.whole_delay + (1 if self.fraction > 0.0 else 0)


def split_delay(delay_s: float, sample_time_s: float) -> tuple[int, float]:
    """Return the whole samples and the remaining fraction of a sample in `delay_s`."""
    samples = delay_s / sample_time_s
    whole = int(np.floor(samples + _WHOLE))
    fraction = samples - whole
    return whole, fraction if fraction > _WHOLE else 0.0


@equation
def exponential(matrix: Any, identity: Any, squarings: int) -> Any:
    """Return exp(matrix): the Taylor series of matrix/2^squarings (norm at most 1/2 for full precision), squared."""
    small = matrix / 2.0**squarings
    out = identity + small
    term = small
    for k in range(2, _TAYLOR_TERMS + 1):
        term = (term @ small) / k
        out = out + term
    for _ in range(squarings):
        out = out @ out
    return out


@compiled
def squarings_for(matrix: FloatArray) -> int:
    """Return how often the argument of `exponential` must be halved."""
    largest = 0.0
    for i in range(len(matrix)):
        largest = max(largest, np.sum(np.abs(matrix[i])))
    return max(0, int(np.ceil(np.log2(max(2.0 * largest, 1e-300)))))


@compiled
def hold_columns(a: FloatArray, columns: FloatArray, duration: float) -> FloatArray:
    """Return exp of (a, columns; 0, 0) times `duration`: its upper part is exp(a·t) beside ∫ exp(a σ) columns dσ."""
    n, inputs = columns.shape
    augmented = np.zeros((n + inputs, n + inputs))
    augmented[:n, :n] = a * duration
    augmented[:n, n:] = columns * duration
    whole: FloatArray = exponential(augmented, np.eye(n + inputs), squarings_for(augmented))
    return whole


def hold(a: FloatArray, b: FloatArray, duration: float) -> tuple[FloatArray, FloatArray]:
    """Return exp(a·duration) and ∫ exp(a σ) b dσ over [0, duration]; `b` is (n,) or (n, inputs)."""
    n, a, columns = len(a), np.ascontiguousarray(a), np.ascontiguousarray(b).reshape(len(a), -1)
    if _MOST_SQUARINGS < squarings_for(a) <= _HOPELESS_SQUARINGS:
        # So stiff a plant loses digits in repeated squaring; scipy scales it more carefully. Beyond all reason the
        # squaring overflows, and what is not finite is refused.
        whole = expm(np.pad(np.hstack([a, columns]) * duration, ((0, columns.shape[1]), (0, 0))))
    else:
        whole = hold_columns(a, columns, duration)
    return np.ascontiguousarray(whole[:n, :n]), np.ascontiguousarray(whole[:n, n:]).reshape(b.shape)


def build_sampled_plant(plant: Plant, sample_time_s: float) -> SampledPlant:
    """Discretise the plant under a zero-order hold, exactly, with its delay."""
    h = positive("sample_time_s", sample_time_s)
    m = build_plant_matrices(plant, h)
    whole, fraction = split_delay(plant.loop_delay_s, h)
    if whole > MOST_DELAY_SAMPLES:
        raise ParameterError(
            "delay_s", plant.loop_delay_s, f"at most {MOST_DELAY_SAMPLES} samples of {h:g} s (the loop holds each one)"
        )
    phi, held = hold(m.a, np.stack([m.b, m.push], axis=1), 1.0)
    gamma, gamma_push = np.ascontiguousarray(held[:, 0]), np.ascontiguousarray(held[:, 1])
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
        gamma_push=gamma_push,
        c_position=m.c_position,
        c_force=m.c_force,
        d_force=m.d_force,
        c_contact=m.c_contact,
        d_contact=m.d_contact,
        push_contact=m.push_contact,
        whole_delay=whole,
        fraction=fraction,
        rate=m.a,
        drive=m.b,
        push=m.push,
    )


@dataclass(frozen=True, kw_only=True)
class SampledLoop:
    """s_{k+1} = a s_k + b F^d_k + b_push f_k; states: plant, past commands (newest first), controller.

    F_k = c_force s_k + d_force F^d_k and x^d_k = c_command s_k + d_command F^d_k; whatever is added to the measured
    force (noise) acts as F^d does. `d_force` is non-zero only when the delay is zero and the coupling has damping.
    `translation` is the state's change when everything moves by one metre: the eigenvector of the integrator at
    z = 1 that a loop has of which neither environment nor law holds a position (`is_anchored`).
    """

    a: FloatArray
    b: FloatArray
    b_push: FloatArray
    c_force: FloatArray
    d_force: float
    c_command: FloatArray
    d_command: float
    translation: FloatArray
    sample_time_s: float
    is_anchored: bool


@equation
def write_open_loop(
    m: Any,
    plant: tuple[Any, Any, Any, Any, Any, Any, Any],
    whole: int,
    chain: int,
    controller: Any,
) -> None:
    """Fill the zeroed `m` with the loop cut at both break points.

    Rows: states (plant, chain, controller), F, x^d. Columns: states, the force e = F^d + F into the controller, the
    command w into the robot, the force f on the payload. `plant` is (phi, gamma, gamma_old, gamma_push, c_x, c_F,
    d_F); `controller` as `controller_matrices` returns it.
    """
    phi, gamma, gamma_old, gamma_push, c_position, c_force, d_force = plant
    n, r = gamma.shape[0], controller.shape[0] - 1
    first, size = n + chain, n + chain + r
    force, command = size, size + 1
    e, w, f = size, size + 1, size + 2
    # The input that acts from the tick on: the command `whole` ticks ago, and the one before it for a fraction.
    newer = w if whole == 0 else n + whole - 1
    older = w if chain == 0 else n + chain - 1
    for i in range(n):
        for j in range(n):
            m[i, j] = phi[i, j]
        m[i, newer] = gamma[i]
        if chain > whole:
            m[i, older] = gamma_old[i]
        m[i, f] = gamma_push[i]
        m[force, i] = c_force[i]
    m[force, older] = d_force
    if chain > 0:
        m[n, w] = 1.0
        for i in range(1, chain):
            m[n + i, n + i - 1] = 1.0
    for i in range(r):
        for j in range(r):
            m[first + i, first + j] = controller[i, j]
        m[first + i, e] = controller[i, r]
        for j in range(n):
            m[first + i, j] = controller[i, r + 1] * c_position[j]
        m[command, first + i] = controller[r, i]
    for j in range(n):
        m[command, j] = controller[r, r + 1] * c_position[j]
    m[command, e] = controller[r, r]


@equation
def close_loop(m: Any, row: int, column: int, rows: int, columns: int) -> None:
    """Feed the signal of `row` into the input of `column`; what enters that column is added to the signal."""
    share = 1.0 / (1.0 - m[row, column])
    for i in range(rows):
        if i != row:
            factor = m[i, column] * share
            for j in range(columns):
                m[i, j] = m[i, j] + factor * m[row, j]
    for j in range(columns):
        m[row, j] = m[row, j] * share


@dataclass(frozen=True, kw_only=True)
class CutLoop:
    """Rows (states, F, x^d) over columns (states, e, w, f), see `write_open_loop`; nothing is connected yet."""

    matrix: FloatArray
    state_count: int

    @property
    def force(self) -> int:
        """Row of F, and column of the force e that enters the controller."""
        return self.state_count

    @property
    def command(self) -> int:
        """Row of x^d, and column of the command w that enters the robot."""
        return self.state_count + 1

    def closed_at(self, *signals: int) -> FloatArray:
        """Return the matrix with the given signals connected."""
        m = self.matrix
        for signal in signals:
            m = _closed(m, signal)
        return m


@compiled
def controller_matrices(blocks: FloatArray, kept: NDArray[np.int64]) -> FloatArray:
    """Return rows (kept states, command) over columns (kept states, e, x) of the difference equation.

    The equation is linear, so its columns are what it answers to one unit state or input each.
    """
    r = len(kept)
    m = np.zeros((r + 1, r + 2))
    # The states, then e and x.
    e, unit = CONTROLLER_STATES, np.zeros(CONTROLLER_STATES + 2)
    for j in range(r + 2):
        place = kept[j] if j < r else CONTROLLER_STATES + j - r
        unit[place] = 1.0
        state = (unit[0], unit[1], unit[2], unit[3], unit[4], unit[5])
        m[r, j], following = controller_step(blocks, state, unit[e], unit[e + 1])
        for i in range(r):
            m[i, j] = np.array(following)[kept[i]]
        unit[place] = 0.0
    return m


@compiled
def _cut_loop(
    plant: tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, float],
    whole: int,
    chain: int,
    controller: FloatArray,
) -> FloatArray:
    _, gamma, _, _, _, _, _ = plant
    size = len(gamma) + chain + len(controller) - 1
    m = np.zeros((size + 2, size + 3))
    write_open_loop(m, plant, whole, chain, controller)
    return m


@compiled
def _closed(m: FloatArray, signal: int) -> FloatArray:
    out = m.copy()
    close_loop(out, signal, signal, out.shape[0], out.shape[1])
    return out


def check_wrench_delay(plant: Plant, law: Controller) -> None:
    """Raise ParameterError for a law that reads the position beside a wrench that is a delay late.

    Position and wrench then belong to different moments, which the loop's shift chain does not hold.
    """
    if plant.wrench_filter.delay_s == 0.0:
        return
    if isinstance(law, LinearController):
        reads = bool(np.any(law.matrix[:, law.state_count + 1]) or np.any(law.steady()[:, law.state_count + 1]))
    else:
        reads = law.feedback_damping_s != 0.0 or law.compensates
    if reads:
        own = "set B_fb and P̂ to 0" if isinstance(law, AdmittanceController) else "its difference equation always does"
        must = f"0 for a law that reads the position too, which is not late ({own})"
        raise ParameterError("wrench_filter.delay_s", plant.wrench_filter.delay_s, must)


def controller_matrix(law: Controller, sample_time_s: float) -> FloatArray:
    """Return the difference equation at h as `LinearController` holds it; raises ParameterError for another h."""
    if isinstance(law, AdmittanceController):
        blocks = controller_blocks(law, sample_time_s)
        return controller_matrices(blocks, needed_states(blocks))
    if law.sample_time_s != sample_time_s:
        raise ParameterError("sample_time_s", law.sample_time_s, f"that of the plant, {sample_time_s:g} s")
    return law.matrix


def build_cut_loop(sampled: SampledPlant, controller: Controller) -> CutLoop:
    """Lay out plant and sampled controller as one system that is cut at the force signal and at the command.

    Of a controller that follows the position (`LinearController.follows_position`) the cut at the command is that of
    what it adds.
    """
    cut = _build_whole_cut(sampled, controller)
    if isinstance(controller, LinearController) and controller.follows_position:
        # The position is added behind the cut: whatever enters there moves the robot from where it is.
        m, n = cut.matrix, sampled.state_count
        m[:, :n] += np.outer(m[:, cut.command], sampled.c_position)
        m[cut.command, :n] -= sampled.c_position
    return cut


def _build_whole_cut(sampled: SampledPlant, controller: Controller) -> CutLoop:
    check_wrench_delay(sampled.plant, controller)
    matrix = controller_matrix(controller, sampled.sample_time_s)
    plant = (
        sampled.phi,
        sampled.gamma,
        sampled.gamma_old,
        sampled.gamma_push,
        sampled.c_position,
        sampled.c_force,
        sampled.d_force,
    )
    m = _cut_loop(plant, sampled.whole_delay, sampled.chain_length, matrix)
    return CutLoop(matrix=m, state_count=len(m) - 2)


def build_loop(sampled: SampledPlant, controller: Controller) -> SampledLoop:
    """Close the loop of `sampled` and the sampled form of `controller`, without approximation."""
    cut = _build_whole_cut(sampled, controller)
    m, n = cut.closed_at(cut.command, cut.force), cut.state_count
    return SampledLoop(
        a=np.ascontiguousarray(m[:n, :n]),
        b=m[:n, n].copy(),
        b_push=m[:n, n + 2].copy(),
        c_force=m[cut.force, :n].copy(),
        d_force=float(m[cut.force, n]),
        c_command=m[cut.command, :n].copy(),
        d_command=float(m[cut.command, n]),
        translation=translation_state(sampled, controller),
        sample_time_s=sampled.sample_time_s,
        is_anchored=sampled.plant.environment.is_anchored
        or (isinstance(controller, LinearController) and controller.holds_position),
    )


def translation_state(sampled: SampledPlant, controller: Controller) -> FloatArray:
    """Return the loop state in which flange, payload and command all rest at one metre and F = 0."""
    plant = np.zeros(sampled.state_count)
    plant[list(sampled.places)] = 1.0
    if isinstance(controller, LinearController):
        rest = controller.rest
    else:
        blocks = controller_blocks(controller, sampled.sample_time_s)
        rest = controller_rest(blocks)[needed_states(blocks)]
    return np.concatenate([plant, np.ones(sampled.chain_length), rest])


def controller_rest(blocks: FloatArray) -> FloatArray:
    """Return the controller's states (4,) at rest at one metre: the filters see no motion, the command is one metre."""
    return np.array(rest_states(blocks))


def stability_matrix(loop: SampledLoop) -> FloatArray:
    """Return the matrix whose eigenvalues decide: all of `a`, but for the integrator at z = 1 of an unanchored loop.

    Without an anchor position is relative: subtracting the translation from every state by way of the payload position
    removes exactly one eigenvalue, 1, and leaves the others (no rounding decides whether 1.0000001 is unstable).
    """
    if loop.is_anchored:
        return loop.a
    pivot = int(np.argmax(np.abs(loop.translation)))
    reduced = loop.a - np.outer(loop.translation / loop.translation[pivot], loop.a[pivot])
    keep = np.arange(len(loop.a)) != pivot
    return np.ascontiguousarray(reduced[np.ix_(keep, keep)])


def spectral_radius(loop: SampledLoop) -> float:
    """Return the largest |z| of the loop; below 1 is stable."""
    return float(np.max(np.abs(np.linalg.eigvals(stability_matrix(loop)))))
