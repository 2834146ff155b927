"""Whether the command in a log is what the law of a controller file makes of the force and the motion in it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autotune.formats.controller_record import AxisGains, DeadbandType
from problems.model.controller import AdmittanceController

from .replay import DifferenceEquation

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class ContactOutcome:
    """How a stretch of command follows the law: the constant F^d that explains it best, and what is left unexplained.

    `left_share` is the RMS of what is left over that of the command's way off a straight line.
    """

    desired_force: float
    left_share: float


def felt(gains: AxisGains, force: FloatArray) -> FloatArray:
    """Return the force (n,) behind the deadband of the file."""
    beyond = np.abs(force) > gains.deadband
    less = gains.deadband if gains.deadband_type is DeadbandType.SUBTRACTIVE else 0.0
    return np.where(beyond, force - np.copysign(less, force), 0.0)


def follow_law(
    law: AdmittanceController, gains: AxisGains, h: float, command: FloatArray, position: FloatArray, force: FloatArray
) -> ContactOutcome:
    """Hold a stretch of command (n,) against the law, with force and position (n,) at the controller's ticks.

    The law is linear behind the deadband, so that F^d and what it remembered at the beginning are found by least
    squares: the answers to force and motion from rest, to a unit of F^d, and to each memory alone add up.
    """
    origin = position[0]
    seen, way = felt(gains, force), position - origin
    quiet = np.zeros(len(command))
    answers = [_answer(law, h, quiet + 1.0, quiet, "steady")]
    answers += [_answer(law, h, quiet, quiet, memory) for memory in _memories(law)]
    answered = _answer(law, h, seen, way, "")
    rows = np.column_stack(answers)[2:]
    wanted = (command - origin - answered)[2:]
    size = np.maximum(np.max(np.abs(rows), axis=0), 1e-300)
    solution = np.linalg.lstsq(rows / size, wanted, rcond=None)[0] / size
    left = wanted - rows @ solution
    time = np.arange(len(command))
    bend = command - np.polyval(np.polyfit(time, command, 1), time)
    share = float(np.sqrt(np.mean(left**2)) / max(float(np.sqrt(np.mean(bend**2))), 1e-12))
    return ContactOutcome(desired_force=float(solution[0]), left_share=share)


def _memories(law: AdmittanceController) -> tuple[str, ...]:
    """Name what the difference equation remembers and the command shows."""
    filtered = law.compensation_mass_kg > 0.0
    return (
        "last",
        "before",
        "force_last",
        *(("velocity",) if law.feedback_damping_s > 0.0 or filtered else ()),
        *(("acceleration",) if filtered else ()),
    )


def _answer(law: AdmittanceController, h: float, force: FloatArray, position: FloatArray, memory: str) -> FloatArray:
    """Return the commands (n,) to force and position, from rest but for one memory of unit size.

    `steady` has felt the same force before; `force_last` is both forces before, which the command shows apart
    in its first sample only.
    """
    equation = DifferenceEquation(law, h)
    if memory == "steady":
        equation.force_before = equation.force_last = 1.0
    elif memory:
        setattr(equation, memory, 1.0)
    pairs = zip(force.tolist(), position.tolist(), strict=True)
    return np.array([equation.step(felt_force, place) for felt_force, place in pairs])
