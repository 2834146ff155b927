"""A sampled law as polynomials in w = z − 1, in balls."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from problems.errors import ParameterError
from problems.model.controller import (
    CONTROLLER_STATES,
    AdmittanceController,
    controller_blocks,
    controller_step,
    needed_states,
    write_blocks,
)
from problems.model.difference import BLOCK_ROWS
from problems.model.linear_controllers import LinearController
from problems.model.sampled import Controller, controller_matrix

from . import rational
from .balls import as_series, number, precise

# A `LinearController` rests at one metre to rounding only (it checks that); what is left of it is not a pole.
_ROUNDING = 1e-9


@dataclass(frozen=True, kw_only=True)
class LawCell:
    """Control laws of a cell: `middle` with some of its `values`, in the order of `numbers`, as balls or series."""

    middle: AdmittanceController
    values: Mapping[int, Any]

    def numbers(self) -> tuple[Any, ...]:
        """Return the numbers of `AdmittanceController.numbers` over the cell."""
        return tuple(self.values.get(i, as_series(each)) for i, each in enumerate(self.middle.numbers()))

    @property
    def damping_n_s_per_m(self) -> Any:
        """B_a over the cell."""
        return self.numbers()[1]


@dataclass(frozen=True, kw_only=True, eq=False)
class LawPolynomials:
    """α X^d = β_F (F^d + F) + β_x X, ascending in w, as flint balls; `position` is β_x, less α where it `follows`.

    A law that follows the position adds to it, x^d = x + u. `position` is empty where nothing is left of it. Unless
    the law `holds_position`, nothing of it has a constant term but α where it follows: a translation changes nothing.
    """

    denominator: tuple[Any, ...]
    force: tuple[Any, ...]
    position: tuple[Any, ...]
    follows: bool = False
    holds_position: bool = False


@precise
def law_polynomials(law: Controller, sample_time_s: float) -> LawPolynomials:
    """Return the law's polynomials from its difference equation at h.

    Those of an `AdmittanceController` are exact, from its physical numbers; those of a `LinearController` are exact for
    the doubles that it holds, but for the rounding by which they miss their rest at one metre. Raises ParameterError
    for one of another h, and for one that neither holds a position, follows it, nor integrates.
    """
    settle, follows, holds = without_constant, False, False
    if isinstance(law, LinearController):
        rows, settle = _matrix(law, sample_time_s), _without_rounding
        follows, holds = law.follows_position, law.holds_position
    else:
        rows = controller_rows(law, sample_time_s)
    r = len(rows) - 1
    change = rows[:r, :r] - np.array([[int(i == j) for j in range(r)] for i in range(r)], dtype=object).reshape(r, r)
    alpha, adjugate = rational.resolvent(change)
    found = []
    for column in (r, r + 1):
        through = rational.numerator(rows[r, :r], adjugate, rows[:r, column])
        found.append(rational.add(through, [rows[r, column] * each for each in alpha]))
    force, position = found
    if follows:
        position = rational.add(position, [-1 * each for each in alpha])
    if not holds:
        position, alpha = settle(position), alpha if follows else settle(alpha)
    reads = any(number(each) != 0 for each in position)
    return LawPolynomials(
        denominator=tuple(number(each) for each in alpha),
        force=tuple(number(each) for each in force),
        position=tuple(number(each) for each in position) if reads else (),
        follows=follows,
        holds_position=holds,
    )


def _matrix(law: LinearController, sample_time_s: float) -> Any:
    """Return the law's rows (states, command) over columns (states, e, x) as balls without radius."""
    matrix = controller_matrix(law, sample_time_s)
    rows = np.empty(matrix.shape, dtype=object)
    for place, value in np.ndenumerate(matrix):
        rows[place] = number(float(value))
    return rows


def blocks_in_balls(law: AdmittanceController | LawCell, sample_time_s: float) -> Any:
    """Return the blocks of a controller's difference equation, from its physical numbers."""
    blocks = np.empty((BLOCK_ROWS, 3), dtype=object)
    blocks.fill(number(0))
    middle = law.middle if isinstance(law, LawCell) else law
    numbers = law.numbers() if isinstance(law, LawCell) else [number(value) for value in law.numbers()]
    write_blocks(blocks, numbers, number(sample_time_s), middle.theta, middle.is_ideal)
    return blocks


def states_needed(law: AdmittanceController | LawCell, sample_time_s: float) -> list[int]:
    """Return the places of the states that the command can see."""
    middle = law.middle if isinstance(law, LawCell) else law
    return [int(each) for each in needed_states(controller_blocks(middle, sample_time_s))]


def controller_rows(law: AdmittanceController | LawCell, sample_time_s: float) -> Any:
    """Return the same rows of a controller: what its equations answer to unit states and inputs."""
    kept, blocks = states_needed(law, sample_time_s), blocks_in_balls(law, sample_time_s)
    r = len(kept)
    rows = np.empty((r + 1, r + 2), dtype=object)
    for j in range(r + 2):
        unit = [number(0)] * (CONTROLLER_STATES + 2)
        unit[kept[j] if j < r else CONTROLLER_STATES + j - r] = number(1)
        states = tuple(unit[:CONTROLLER_STATES])
        command, following = controller_step(blocks, states, *unit[CONTROLLER_STATES:])
        rows[r, j] = command
        for i in range(r):
            rows[i, j] = following[kept[i]]
    return rows


def without_constant(polynomial: list[Any]) -> list[Any]:
    """Return a polynomial whose constant term is known to vanish with exactly 0 there."""
    if not number(polynomial[0]).contains(0):
        raise ArithmeticError(f"constant term {polynomial[0]} of a polynomial that vanishes at z = 1")
    return [number(0), *(number(each) for each in polynomial[1:])]


def _without_rounding(polynomial: list[Any]) -> list[Any]:
    """Return a polynomial without its constant term; raises ParameterError where that is more than rounding."""
    constant, others = number(polynomial[0]), [number(each) for each in polynomial[1:]]
    if not constant.contains(0) and not abs(constant) <= _ROUNDING * sum((abs(each) for each in others), number(0)):
        raise ParameterError("law", str(constant), "one that integrates, or follows or holds the position")
    return [number(0), *others]
