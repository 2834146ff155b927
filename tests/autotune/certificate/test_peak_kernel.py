"""The walk of a cell from tick to tick against members of it: loops, starts and rows of F_e that are drawn from it."""

from dataclasses import dataclass

import numpy as np
import pytest

from autotune.certificate.peak_kernel import CellLoop, CellState, force_at, later_change, least_largest, size_of, walk
from problems.arrays import ComplexArray, FloatArray

_DESIRED, _TOUCHING, _TICKS = 30.0, 12.0, 60
# No tick has a remainder of 1: a walk with this stride never looks ahead.
_NEVER = 1


def _complex(values: FloatArray) -> ComplexArray:
    return np.asarray(values, dtype=np.complex128)


def _cell(rng: np.random.Generator, width: float = 1.0) -> CellLoop:
    """Three coordinates that decay, of very different sizes; a cell of one parameter and one that the start has too."""
    weights = np.array([0.02, 1.0, 50.0])
    scale = weights[:, None] / weights
    change = np.diag([0.9, 0.8, 0.85]) + 0.02 * scale * rng.uniform(-1.0, 1.0, (3, 3))
    derivatives = width * 0.01 * scale * rng.uniform(-1.0, 1.0, (1, 3, 3))
    row = rng.uniform(-1.0, 1.0, 3) * [9.0, 5.0, 0.2]
    curved = rng.uniform(-1.0, 1.0, 3) * [2.0, 1.0, 0.04]
    return CellLoop(
        change=_complex(change),
        derivatives=_complex(derivatives),
        spread=width * 1e-3 * scale,
        place=_complex(weights * rng.uniform(-1.0, 1.0, 3)),
        shifts=_complex(width * 0.05 * weights * rng.uniform(-1.0, 1.0, (2, 3))),
        unknown=width * 0.01 * weights,
        row=_complex(row),
        row_derivatives=_complex(width * 0.05 * rng.uniform(-1.0, 1.0, (1, 3)) * np.abs(row)),
        row_spread=width * 0.01 * np.abs(row),
        curved=_complex(curved),
        curved_spread=width * 0.05 * np.abs(curved),
        bent=width * 0.02 * np.abs(curved),
        weights=weights,
        desired=_DESIRED,
        touching=_TOUCHING,
    )


@dataclass(frozen=True)
class _Member:
    """F_e of one loop of a cell at the ticks (n,), its curvature there (n,) and the size of the state (n, m)."""

    force: FloatArray
    curvature: FloatArray
    size: FloatArray


def _member(cell: CellLoop, rng: np.random.Generator) -> _Member:
    """Draw a loop at the ends of what is left open, where bounds that are too narrow show first."""
    place = rng.choice([-1.0, 1.0], 2)

    def end(values: FloatArray) -> FloatArray:
        return np.asarray(values * rng.choice([-1.0, 1.0], values.shape))

    change = cell.change + place[0] * cell.derivatives[0] + end(cell.spread)
    row = cell.row + place[0] * cell.row_derivatives[0] + end(cell.row_spread)
    curved = cell.curved + end(cell.curved_spread + cell.bent)
    state = cell.place + place @ cell.shifts + end(cell.unknown)
    states = []
    for _ in range(_TICKS):
        states.append(state)
        state = change @ state
    z = np.array(states)
    return _Member(force=_DESIRED + (z @ row).real, curvature=(z @ curved).real, size=np.abs(z))


def _state(cell: CellLoop) -> CellState:
    return CellState(cell.place, cell.shifts, cell.unknown, size_of(cell.place, cell.shifts, cell.unknown))


@pytest.mark.parametrize("seed", range(20))
def test_no_member_of_a_cell_is_outside_of_its_bounds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cell = _cell(rng)
    members = [_member(cell, rng) for _ in range(40)]
    start = force_at(cell, _state(cell))
    found = walk(cell, 1e6, _TICKS, _NEVER)
    assert not found.is_bounded
    later = later_change(cell, _state(cell).size)
    least = least_largest(cell, 10)
    for member in members:
        assert abs(member.force[0] - start.middle) <= np.sum(start.shares) + start.rest
        assert abs(member.curvature[0]) <= start.curvature
        # Between two ticks a parabola has an eighth of its curvature more than the line from one to the other.
        above = 0.125 * np.abs(member.curvature)
        assert np.max(member.force + above) <= found.largest or found.largest == _TOUCHING
        assert np.min(member.force[1:] - above[1:]) >= found.lowest
        assert np.max(np.abs(member.force - _DESIRED) + above) <= later
        assert np.max(member.force[:10]) >= least


def test_of_a_cell_of_one_loop_the_bounds_are_what_it_does() -> None:
    rng = np.random.default_rng(3)
    cell = _cell(rng, width=0.0)
    only = _member(cell, rng)
    found = walk(cell, 1e6, _TICKS, _NEVER)
    above = 0.125 * np.maximum(np.abs(only.curvature), np.abs(np.concatenate([[0.0], only.curvature[:-1]])))
    assert found.largest == pytest.approx(max(np.max(only.force + above), _TOUCHING), rel=1e-9)
    assert found.lowest == pytest.approx(np.min((only.force - above)[1:]), rel=1e-9)
    assert (found.middle, found.middle_low) == pytest.approx((np.max(only.force), np.min(only.force[1:])), rel=1e-9)
    for ticks in (1, 2, 10):
        assert least_largest(cell, ticks) == pytest.approx(np.max(only.force[:ticks]), rel=1e-9)


def test_what_never_decays_reaches_the_bound_of_what_is_to_come() -> None:
    """Without a loop's change |z| stays what it is; all signs are those of the row."""
    still = _cell(np.random.default_rng(1), width=0.0)._replace(change=np.eye(3, dtype=np.complex128))
    size = 0.3 * still.weights
    force, curvature = np.abs(still.row) @ size, np.abs(still.curved) @ size
    assert later_change(still, size) == pytest.approx(force + 0.125 * curvature, rel=1e-8)
    # One coordinate alone counts for all: the weights bound the others by it.
    alone = np.where(np.arange(3) == 1, size, 0.0)
    assert later_change(still, alone) == pytest.approx(later_change(still, size), rel=1e-12)


def test_a_walk_ends_where_the_limit_is_passed_and_where_all_that_is_to_come_is_below_it() -> None:
    drawn = _cell(np.random.default_rng(0))
    cell = drawn._replace(place=_complex(0.5 * drawn.weights * np.sign(drawn.row.real)))
    whole = walk(cell, 1e6, _TICKS, 4)
    assert whole.is_bounded
    assert whole.largest > _DESIRED
    at_the_limit = walk(cell, whole.largest, 10 * _TICKS, 4)
    assert at_the_limit.is_bounded
    assert at_the_limit.largest == whole.largest
    passed = walk(cell, whole.largest * (1.0 - 1e-9), 10 * _TICKS, 4)
    assert not passed.is_bounded
    # A sample of the touch above the limit is passed at once.
    touched = walk(cell, 0.5 * _TOUCHING, _TICKS, 4)
    assert (touched.largest, touched.lowest, touched.is_bounded) == (_TOUCHING, np.inf, False)
    # A force that is not a number is none.
    assert not walk(cell._replace(desired=np.nan), 1e6, _TICKS, 4).is_bounded
