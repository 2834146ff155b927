"""The sampled controller as polynomials in w = z − 1, in balls."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.model.controller import (
    CONTROLLER_STATES,
    AdmittanceController,
    controller_blocks,
    controller_step,
    needed_states,
    write_blocks,
)

from . import rational
from .balls import number, precise


@dataclass(frozen=True, kw_only=True)
class LawPolynomials:
    """X^d = (β_F (F^d + F) + β_x X)/α, ascending in w, as flint balls; `position` is empty where x is not fed back.

    α and β_x have no constant term: A has its integrator at z = 1, and what is fed back of x has none.
    """

    denominator: tuple[Any, ...]
    force: tuple[Any, ...]
    position: tuple[Any, ...]


@precise
def law_polynomials(law: AdmittanceController, sample_time_s: float) -> LawPolynomials:
    """Return the controller's polynomials from its difference equation, answered to unit states and inputs."""
    kept = needed_states(controller_blocks(law, sample_time_s))
    blocks = np.empty((6, 3), dtype=object)
    blocks.fill(number(0))
    numbers = [number(value) for value in law.numbers()]
    write_blocks(blocks, numbers, number(sample_time_s), law.theta, law.is_ideal)
    r = len(kept)
    rows = np.empty((r + 1, r + 2), dtype=object)
    for j in range(r + 2):
        unit = [number(0)] * (CONTROLLER_STATES + 2)
        unit[int(kept[j]) if j < r else CONTROLLER_STATES + j - r] = number(1)
        command, following = controller_step(blocks, tuple(unit[:4]), unit[4], unit[5])
        rows[r, j] = command
        for i in range(r):
            rows[i, j] = following[int(kept[i])] - (1 if i == j else 0)
    alpha, adjugate = rational.resolvent(rows[:r, :r])
    found = []
    for column in (r, r + 1):
        through = rational.numerator(rows[r, :r], adjugate, rows[:r, column])
        found.append(rational.add(through, [rows[r, column] * each for each in alpha]))
    feeds_back = law.feedback_damping_s > 0.0 or law.compensates
    return LawPolynomials(
        denominator=tuple(without_constant(alpha)),
        force=tuple(number(each) for each in found[0]),
        position=tuple(without_constant(found[1])) if feeds_back else (),
    )


def without_constant(polynomial: list[Any]) -> list[Any]:
    """Return a polynomial whose constant term is known to vanish with exactly 0 there."""
    if not number(polynomial[0]).contains(0):
        raise ArithmeticError(f"constant term {polynomial[0]} of a polynomial that vanishes at z = 1")
    return [number(0), *(number(each) for each in polynomial[1:])]
