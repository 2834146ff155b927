"""The exact sampled loop: held plant by matrix exponential, delay as a shift chain."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._checks import positive
from ..arrays import FloatArray
from ..compiled import compiled, equation
from ..errors import ParameterError
from .controller import CONTROLLER_STATES, AdmittanceController, controller_blocks, controller_step, needed_states
from .difference import rest_states
from .hold import hold
from .linear_controllers import LinearController
from .plant import Plant, build_plant_matrices

Controller = AdmittanceController | LinearController

# Plants that are kept sampled: those of one search, which looks at each several times.
KEPT_PLANTS = 4096
# A delay this close to a whole number of samples (in samples) is that number; it is far below any clock's resolution.
_WHOLE = 1e-9
MOST_DELAY_SAMPLES = 1000


@dataclass(frozen=True, kw_only=True, eq=False)
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


@lru_cache(maxsize=KEPT_PLANTS)
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


@compiled
def _split(m: FloatArray) -> tuple[FloatArray, ...]:
    """Close a cut loop at the command, then at the force; return a, b, b_push and F's and x^d's rows with F^d's d."""
    n = len(m) - 2
    closed = _closed(_closed(m, n + 1), n)
    return closed[:n, :n].copy(), closed[:n, n].copy(), closed[:n, n + 2].copy(), closed[n:, : n + 1].copy()


@compiled
def _position_input(cut: FloatArray, controller: FloatArray) -> tuple[FloatArray, float]:
    """Close a cut loop with a further input beside the position, and return the states' and the command's entries."""
    n, r = len(cut) - 2, len(controller) - 1
    whole = np.zeros((n + 2, n + 4))
    whole[:, : n + 3] = cut
    for i in range(r):
        whole[n - r + i, n + 3] = controller[i, r + 1]
    whole[n + 1, n + 3] = controller[r, r + 1]
    closed = _closed(_closed(whole, n + 1), n)
    return closed[:n, n + 3].copy(), closed[n + 1, n + 3]


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
        matrix, _ = _difference(law, sample_time_s)
        return matrix
    if law.sample_time_s != sample_time_s:
        raise ParameterError("sample_time_s", law.sample_time_s, f"that of the plant, {sample_time_s:g} s")
    return law.matrix


@lru_cache(maxsize=256)
def _difference(law: AdmittanceController, sample_time_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the difference equation (`controller_matrices`) and the kept states at rest at one metre, read-only."""
    blocks = controller_blocks(law, sample_time_s)
    kept = needed_states(blocks)
    found = controller_matrices(blocks, kept), controller_rest(blocks)[kept]
    for each in found:
        each.setflags(write=False)
    return found


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
    a, b, b_push, (force, command) = _split(_build_whole_cut(sampled, controller).matrix)
    return SampledLoop(
        a=a,
        b=b,
        b_push=b_push,
        c_force=force[:-1],
        d_force=float(force[-1]),
        c_command=command[:-1],
        d_command=float(command[-1]),
        translation=translation_state(sampled, controller),
        sample_time_s=sampled.sample_time_s,
        is_anchored=sampled.plant.environment.is_anchored
        or (isinstance(controller, LinearController) and controller.holds_position),
    )


def position_input(sampled: SampledPlant, controller: Controller) -> tuple[FloatArray, float]:
    """Return b (n,) and d of what is added to the position that the controller reads, as of F^d in `SampledLoop`."""
    matrix = controller_matrix(controller, sampled.sample_time_s)
    b, d = _position_input(_build_whole_cut(sampled, controller).matrix, matrix)
    return b, float(d)


def translation_state(sampled: SampledPlant, controller: Controller) -> FloatArray:
    """Return the loop state in which flange, payload and command all rest at one metre and F = 0."""
    plant = np.zeros(sampled.state_count)
    plant[list(sampled.places)] = 1.0
    if isinstance(controller, LinearController):
        rest = controller.rest
    else:
        _, rest = _difference(controller, sampled.sample_time_s)
    return np.concatenate([plant, np.ones(sampled.chain_length), rest])


def controller_rest(blocks: FloatArray) -> FloatArray:
    """Return the controller's states (4,) at rest at one metre: the filters see no motion, the command is one metre."""
    return np.array(rest_states(blocks))


def stability_matrix(loop: SampledLoop) -> FloatArray:
    """Return the matrix whose eigenvalues decide: all of `a`, but for the integrator at z = 1 of an unanchored loop.

    Without an anchor position is relative: subtracting the translation from every state by way of the payload position
    removes exactly one eigenvalue, 1, and leaves the others (no rounding decides whether 1.0000001 is unstable).
    """
    a, _, _ = relative_loop(loop, loop.c_force)
    return a


def relative_loop(
    loop: SampledLoop, row: FloatArray, drive: FloatArray | None = None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a, an input's b and the row (n,) of an output that sees no translation, without it where it is free.

    Of such an output row·translation is zero, so that dropping one state loses nothing. The input is F^d unless a
    `drive` (n,) is given.
    """
    b = loop.b if drive is None else drive
    return (loop.a, b, row) if loop.is_anchored else _relative(loop.a, b, row, loop.translation)


@compiled
def _relative(
    a: FloatArray, b: FloatArray, row: FloatArray, translation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Take the translation off by way of its largest entry, whose state is dropped."""
    n, pivot = len(a), int(np.argmax(np.abs(translation)))
    reduced, drive, output = np.empty((n - 1, n - 1)), np.empty(n - 1), np.empty(n - 1)
    for i in range(n - 1):
        of = i + (1 if i >= pivot else 0)
        share = translation[of] / translation[pivot]
        drive[i], output[i] = b[of] - share * b[pivot], row[of]
        for j in range(n - 1):
            column = j + (1 if j >= pivot else 0)
            reduced[i, j] = a[of, column] - share * a[pivot, column]
    return reduced, drive, output


def spectral_radius(loop: SampledLoop) -> float:
    """Return the largest |z| of the loop; below 1 is stable."""
    return float(np.max(np.abs(np.linalg.eigvals(stability_matrix(loop)))))
