"""The loop as python-control objects, for its pictures and for whoever wants to check with it."""

from dataclasses import dataclass
from typing import Any

import control
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance

from ..arrays import FloatArray
from ..errors import ParameterError
from .controller import AdmittanceController
from .difference import biquad_in_s, filters_in_s, forward_in_s
from .plant import Environment, Plant
from .sampled import CutLoop, SampledPlant, build_cut_loop, build_sampled_plant, translation_state

Matrices = tuple[FloatArray, FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ControlObjects:
    """Continuous blocks and the exact sampled loop of `plant` under `controller`, sampled every `sample_time_s`.

    Continuous `TransferFunction`s: `robot` r(s), whose delay is apart, `delay_s`; `coupling` C_s, `payload` P,
    `environment` E, `wrench` from F to F_m, whose delay is `wrench_delay_s`, `forward` A(1 + C_ff), `feedback` C_fb,
    `acceleration` O_a, whether P̂ uses it or not. C_s, E and an ideal O_a have more zeros than poles.

    Discrete `StateSpace`s at h: `at_force` L and `at_command` L_x, both closed by negative feedback (1 + L), and
    `closed_loop` from F^d ("F_d") and an outside force on the payload ("f") to F, x^d ("x_d") and F_e. Without an
    anchor L and L_x are given without the integrator at z = 1, which F cannot show and x^d cannot drive (1 + L would
    be 0/0 there); the closed loop keeps it, because x^d shows it.

    Where python-control stops: `stability_margins` warns for loops like these, falls back to a coarse frequency grid
    and now and then misses a crossover (errors up to a factor of two), so take margins from
    `problems.stability.margins`; its
    Nyquist plot cannot pass a pole at z = −1, which L_x of the ideal compensation has in the Tustin form.
    """

    plant: Plant
    controller: AdmittanceController
    sample_time_s: float
    robot: Any
    delay_s: float
    coupling: Any
    payload: Any
    environment: Any
    wrench: Any
    wrench_delay_s: float
    forward: Any
    feedback: Any
    acceleration: Any
    at_force: Any
    at_command: Any
    closed_loop: Any

    def __repr__(self) -> str:
        return (
            f"<ControlObjects: continuous {', '.join(BLOCKS)}; sampled every {1e3 * self.sample_time_s:g} ms "
            "at_force, at_command, closed_loop>"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Build it anew: systems of python-control can be neither pickled nor copied."""
        return _built, (self.plant, self.sample_time_s, self.controller)


BLOCKS = ("robot", "coupling", "payload", "environment", "wrench", "forward", "feedback", "acceleration")


def _built(plant: Plant, sample_time_s: float, controller: AdmittanceController) -> ControlObjects:
    return to_control(build_sampled_plant(plant, sample_time_s), controller)


def to_control(sampled: SampledPlant, controller: AdmittanceController) -> ControlObjects:
    """Return the blocks and the sampled loop of one axis as python-control objects with named signals."""
    plant, cut, h = sampled.plant, build_cut_loop(sampled, controller), sampled.sample_time_s
    plant.require_one_piece()
    feedback, acceleration = filters_in_s(controller.numbers(), controller.compensation == "ideal")
    return ControlObjects(
        plant=plant,
        controller=controller,
        sample_time_s=h,
        robot=_block("robot", plant.robot.numerator, plant.robot.denominator, "x_d", "x"),
        delay_s=plant.robot.delay_s,
        coupling=_block(
            "coupling", [plant.coupling.damping_n_s_per_m, plant.coupling.stiffness_n_per_m], [1.0, 0.0], "v_rel", "F"
        ),
        payload=_block("payload", [1.0], [plant.payload.mass_kg, plant.payload.drag_n_s_per_m], "force", "v_p"),
        environment=_environment(plant.environment),
        wrench=_block("wrench", [1.0], [plant.wrench_filter.time_constant_s, 1.0], "F", "F_m"),
        wrench_delay_s=plant.wrench_filter.delay_s,
        forward=_law_block("forward", _forward(controller), "e", "x_a"),
        feedback=_law_block("feedback", feedback, "x", "x_fb"),
        acceleration=_law_block("acceleration", acceleration, "x", "a"),
        at_force=_system("L", _cut_at_force(cut, sampled, controller), h, ["e"], ["-F"]),
        at_command=_system("L_x", _cut_at_command(cut, sampled), h, ["w"], ["-x_d"]),
        closed_loop=_system("closed_loop", _closed(cut, sampled), h, ["F_d", "f"], ["F", "x_d", "F_e"]),
    )


def _forward(controller: AdmittanceController) -> Any:
    """Return A(1 + C_ff) N: numerator and denominator in ascending powers of s."""
    numbers = controller.numbers()
    parts = forward_in_s(numbers)
    if not controller.has_biquad:
        return parts
    return tuple(np.convolve(one, other) for one, other in zip(parts, biquad_in_s(numbers), strict=True))


def polynomials_of(system: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return numerator and denominator, in descending powers of s, of a continuous python-control system.

    Raises ParameterError for one that is discrete or has not one input and one output.
    """
    if not hasattr(system, "isctime") or not system.isctime():
        raise ParameterError("system", system, "a continuous python-control system")
    if not isinstance(system, control.TransferFunction | control.StateSpace):
        raise ParameterError("system", type(system).__name__, "a TransferFunction or StateSpace of python-control")
    if (system.ninputs, system.noutputs) != (1, 1):
        raise ParameterError("system", (system.ninputs, system.noutputs), "one with one input and one output")
    fraction = control.tf(system)
    numerator, denominator = (np.trim_zeros(each[0][0], "f") for each in (fraction.num, fraction.den))
    return tuple(float(each) for each in numerator), tuple(float(each) for each in denominator)


def _system(name: str, matrices: Matrices, h: float, inputs: list[str], outputs: list[str]) -> Any:
    """Scale the states by powers of two: methods that mix them by rotations (slycot's) would lose six digits."""
    a, b, c, d = matrices
    # One more row and column represent the surroundings, which keep their units.
    whole = np.block([[a, np.sum(np.abs(b), axis=1, keepdims=True)], [np.sum(np.abs(c), axis=0), np.zeros(1)]])
    _, (sizes, _) = matrix_balance(whole, permute=False, separate=True)
    scale = sizes[:-1] / sizes[-1]
    a, b, c = a * scale / scale[:, None], b / scale[:, None], c * scale
    return control.ss(a, b, c, d, h, name=name, inputs=inputs, outputs=outputs)


def _block(name: str, numerator: Any, denominator: Any, source: str, target: str) -> Any:
    return control.tf(numerator, denominator, name=name, inputs=[source], outputs=[target])


def _law_block(name: str, fraction: Any, source: str, target: str) -> Any:
    numerator, denominator = (list(reversed(each)) for each in fraction)
    return _block(name, numerator, denominator, source, target)


def _environment(environment: Environment) -> Any:
    stiffness, damping, mass = environment.coefficients
    if environment.is_anchored:
        return _block("environment", [mass, damping, stiffness], [1.0, 0.0], "v_p", "F_e")
    return _block("environment", [mass, damping], [1.0], "v_p", "F_e")


def _cut_at_force(cut: CutLoop, sampled: SampledPlant, controller: AdmittanceController) -> Matrices:
    """Return A, B, C, D of L; without an anchor a translation (A t = t, C t = 0) is taken out of the state."""
    m, n, signal = cut.closed_at(cut.command), cut.state_count, cut.force
    a, b, c, d = m[:n, :n], m[:n, [signal]], -m[[signal], :n], -m[[signal], signal : signal + 1]
    if sampled.plant.environment.is_anchored:
        return a, b, c, d
    moved = translation_state(sampled, controller)
    pivot = int(np.argmax(np.abs(moved)))
    share, keep = moved / moved[pivot], np.arange(n) != pivot
    a, b = a - np.outer(share, a[pivot]), b - np.outer(share, b[pivot])
    return a[np.ix_(keep, keep)], b[keep], c[:, keep], d


def _cut_at_command(cut: CutLoop, sampled: SampledPlant) -> Matrices:
    """Return A, B, C, D of L_x; without an anchor one state follows from the others: momentum is conserved.

    The impulse of F is the controller's integrator, and it is what the payload has lost of momentum and travel times
    drag: q s stays what it is (q A = q, q B = 0).
    """
    m, n, signal = cut.closed_at(cut.force), cut.state_count, cut.command
    a, b, c, d = m[:n, :n], m[:n, [signal]], -m[[signal], :n], -m[[signal], signal : signal + 1]
    if sampled.plant.environment.is_anchored:
        return a, b, c, d
    pivot = sampled.state_count + sampled.chain_length
    keep = np.arange(n) != pivot
    others = np.linalg.solve((np.eye(n) - a).T[np.ix_(keep, keep)], a[pivot, keep])
    a, c = a - np.outer(a[:, pivot], _row(others, keep)), c - np.outer(c[:, pivot], _row(others, keep))
    return a[np.ix_(keep, keep)], b[keep], c[:, keep], d


def _row(others: FloatArray, keep: NDArray[np.bool_]) -> FloatArray:
    row = np.zeros(len(keep))
    row[keep] = others
    return row


def _closed(cut: CutLoop, sampled: SampledPlant) -> Matrices:
    """Return A, B, C, D from (F^d, f) to (F, x^d, F_e)."""
    m, n = cut.closed_at(cut.command, cut.force), cut.state_count
    inputs, p = [n, n + 2], sampled.state_count
    c, d = m[[cut.force, cut.command], :n], m[np.ix_([cut.force, cut.command], inputs)]
    pressed, direct = np.zeros(n), np.array([0.0, sampled.push_contact])
    pressed[:p] = sampled.c_contact
    if sampled.chain_length > 0:
        pressed[p + sampled.chain_length - 1] += sampled.d_contact
    else:
        pressed, direct = pressed + sampled.d_contact * c[1], direct + sampled.d_contact * d[1]
    return m[:n, :n], m[:n, inputs], np.vstack([c, pressed]), np.vstack([d, direct])
