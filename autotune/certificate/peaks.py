"""A bound of the contact force over a continuous set of plants: the first contact, tick by tick, in balls.

A cell is K_e × 1/M_p × ρ, the way that the payload would have gone into the wall up to the first tick behind the touch.
In contact the loop is linear, and its deviation z from rest under F^d follows z⁺ = A z. With A and z in the middle of
the cell and their derivatives all over it, z = p + Σ δ_i q_i + e for |δ_i| ≤ 1: p and q follow the middle's matrix, e
is bounded entry by entry. All of this in coordinates in which that matrix is all but diagonal, so that bounds decay as
the loop does; what is left is bounded at once by a weighted maximum that no further step can raise. Between two ticks
F_e departs from a straight line by an eighth of its largest curvature at most.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import expm

from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController

from .balls import Balls, as_series, derivative_of, enclose, exact, similar
from .contact_loop import ContactLoop, contact_loop
from .family import Family
from .peak_kernel import CellLoop, ForceBounds, walk

_LONGEST, _STRIDE = 6000, 50
# Work of a cell in arcs judged, the unit of `certify`.
CELL_WORK = 600
_NARROWEST, _NARROW = 1e-4, 0.01
_FIRST_RHO = 4
_LEAST = 1e-300
_OUT = 1.0 + 1e-9


@dataclass(frozen=True, kw_only=True)
class PeakOutcome:
    """What came of an attempt: `limit_n` holds for the `share` of the set, in `cells`, by `work`.

    `staying` is the share in which the payload stays on the wall, so that its first contact is all of it. A limit that
    is false is `refuted_by` a plant.
    """

    limit_n: float
    share: float
    staying: float
    cells: int
    work: int
    refuted_by: Scenario | None = None

    @property
    def holds(self) -> bool:
        """Whether the limit is proved for the whole set."""
        return self.share == 1.0


def prove_peak(
    family: Family,
    law: AdmittanceController,
    approach: Approach,
    limit_n: float,
    *,
    work: int,
    progress: Callable[[float], None] | None = None,
) -> PeakOutcome:
    """Prove that no first contact of these plants exceeds `limit_n`, wherever between two ticks it begins.

    Parameters
    ----------
    family
        Plants in contact; K_e and M_p may vary.
    law
        The control law under the hold of the family.
    approach
        A force or a speed, under F^d that goes on.
    limit_n
        The force [N].
    work
        Bound of the effort, `CELL_WORK` for a cell.
    progress
        Is passed the share of the set proved since the last call.

    Returns
    -------
    PeakOutcome
        The share proved; a plant and a start that exceed the limit refute it.

    Raises
    ------
    ParameterError
        For a filter of the wrench, other parameters that vary, and an approach that is not under F^d.
    """
    family.nominal.require_one_piece()
    box = family.box()
    waiting = [(box, (i / _FIRST_RHO, (i + 1) / _FIRST_RHO), 1.0 / _FIRST_RHO) for i in range(_FIRST_RHO)]
    spent, cells, share, staying, is_left = 0, 0, 0.0, 0.0, False
    # What is false is mostly false at a corner of the set, and one plant is judged at once.
    corners = [np.stack([end, end], axis=1) for end in map(np.array, itertools.product(*box.tolist()))]
    refuted = next((_middle(family, each) for each in corners if _exceeds(family, law, approach, each, limit_n)), None)
    while waiting and spent < work and refuted is None:
        cell, rho, part = waiting.pop()
        spent += CELL_WORK
        found = _walk_cell(family, law, approach, cell, rho, limit_n)
        # Where the middle stays on the wall the others may be shown to, for an eighth of the work.
        could_stay = (
            found.lowest <= 0.0 < found.middle_low and 8 * spent < work and np.max(_widths(cell), initial=0.0) > _NARROW
        )
        halves = _halves(cell, rho, found)
        if found.is_bounded and (halves is None or not could_stay):
            cells, share = cells + 1, share + part
            staying += part if found.lowest > 0.0 else 0.0
            if progress is not None:
                progress(part)
            continue
        if found.middle > limit_n and _exceeds(family, law, approach, cell, limit_n):
            refuted = _middle(family, cell)
            break
        is_left = is_left or halves is None
        waiting += [(*each, 0.5 * part) for each in halves or ()]
    whole = not (waiting or is_left) and refuted is None
    return PeakOutcome(
        limit_n=limit_n,
        share=1.0 if whole and share > 0.0 else share,
        staying=min(staying, 1.0),
        cells=cells,
        work=spent,
        refuted_by=refuted,
    )


Part = tuple[FloatArray, tuple[float, float]]


def _halves(cell: FloatArray, rho: tuple[float, float], found: ForceBounds) -> tuple[Part, Part] | None:
    """Cut where the bound loses most."""
    d = len(cell)
    side = int(np.argmax(found.shares))
    if side == d:
        middle = 0.5 * (rho[0] + rho[1])
        return None if rho[1] - rho[0] < _NARROWEST else ((cell, (rho[0], middle)), (cell, (middle, rho[1])))
    if _widths(cell)[side] < _NARROWEST:
        return None
    lower, upper = cell.copy(), cell.copy()
    lower[side, 1] = upper[side, 0] = 0.5 * (cell[side, 0] + cell[side, 1])
    return (lower, rho), (upper, rho)


def _widths(cell: FloatArray) -> FloatArray:
    """Return the widths of a cell's sides beside their ends (d,)."""
    return np.asarray(np.ptp(cell, axis=1) / np.maximum(np.max(np.abs(cell), axis=1), _LEAST))


def _middle(family: Family, cell: FloatArray) -> Scenario:
    return family.scenario(np.mean(cell, axis=1))


def _exceeds(family: Family, law: AdmittanceController, approach: Approach, cell: FloatArray, limit_n: float) -> bool:
    """Return whether the plant in the middle of a cell, touching at a tick or between two, exceeds the limit."""
    middle = np.mean(cell, axis=1)
    plant = np.stack([middle, middle], axis=1)
    walks = [_walk_cell(family, law, approach, plant, (rho, rho), math.inf) for rho in (0.5, 1.0)]
    return any(each.is_bounded and each.middle - float(np.sum(each.shares)) - each.rest > limit_n for each in walks)


def _walk_cell(
    family: Family,
    law: AdmittanceController,
    approach: Approach,
    cell: FloatArray,
    rho: tuple[float, float],
    limit_n: float,
) -> ForceBounds:
    middle = np.mean(cell, axis=1)
    half = 0.5 * (cell[:, 1] - cell[:, 0]) * (1.0 + 1e-12) + 2.0 * np.spacing(middle)
    loop = contact_loop(family, law, approach, np.stack([middle, middle], axis=1))
    derivatives = [contact_loop(family, law, approach, cell, along) for along in range(len(cell))]
    prepared = prepare_cell(loop, derivatives, half, rho)
    if not isinstance(prepared, CellLoop):
        return ForceBounds(math.inf, -math.inf, np.append(prepared, 0.0), math.inf, -math.inf, -math.inf, False)
    # F^d of a given speed hangs on the plant.
    unsure = float(_around(loop.force_n, [s.force_n for s in derivatives], half).rad[0])
    found = walk(prepared, limit_n - unsure, _LONGEST, _STRIDE)
    # What is of second order comes from how much each coordinate of the plant changes the loop.
    changes = np.append(np.sum(np.abs(prepared.derivatives), axis=(1, 2)), 0.0)
    of_rest = found.rest * changes / max(float(np.sum(changes)), _LEAST)
    return found._replace(lowest=found.lowest - unsure, shares=found.shares + of_rest)


def prepare_cell(
    loop: ContactLoop,
    derivatives: list[ContactLoop],
    half: FloatArray,
    rho: tuple[float, float],
    is_endless: bool = True,
) -> CellLoop | FloatArray:
    """Return the loop in its own coordinates.

    Where these plants differ too much to bound all later ticks, return how much each coordinate changes the loop (d,);
    unless `is_endless`, only where they differ too much to be bounded at all.
    """
    m = len(loop.start)
    change = _values(loop.change).shaped(m, m)
    _, basis = np.linalg.eig(change.mid)
    try:
        diagonal, inverse = similar(loop.change, basis)
    except ZeroDivisionError:
        return np.array(
            [float(np.sum(_derivatives(s.change).times(h).magnitude())) for s, h in zip(derivatives, half, strict=True)]
        )
    v = exact(basis)
    sides = [
        (inverse @ _derivatives(s.change).times(h).shaped(m, m)) @ v for s, h in zip(derivatives, half, strict=True)
    ]
    spread = diagonal.rad + np.sum([each.rad for each in sides], axis=0)
    whole = np.abs(diagonal.mid) + spread + np.sum([np.abs(each.mid) for each in sides], axis=0)
    weights, way = _weights(whole, is_endless), _around(loop.way, [s.way for s in derivatives], half)
    touch = _touch(loop, derivatives, half, rho, way)
    if weights is None or touch is None:
        return np.array([float(np.sum(each.magnitude())) for each in sides])
    starts = [inverse @ _derivatives(s.start).times(h) for s, h in zip(derivatives, half, strict=True)]
    lost, touching = touch
    rest = _spread(loop.rest, [s.rest for s in derivatives], half)
    # The way into the wall is that share of a sample's way.
    begun = _values(loop.start) + rest.times(0.5 * (rho[0] + rho[1])) * way + lost
    place = inverse @ begun
    into = inverse @ (rest.times(0.5 * (rho[1] - rho[0])) * way)
    shifts = [*starts, into]
    row = _values(loop.pressed) @ v
    row_derivatives = [_derivatives(s.pressed).times(h) @ v for s, h in zip(derivatives, half, strict=True)]
    curved = _spread(loop.curvature, [s.curvature for s in derivatives], half)
    stepped = _spread(loop.stepped, [s.stepped for s in derivatives], half)
    turn, jump = (_around(value, [s.jump[i] for s in derivatives], half) for i, value in enumerate(loop.jump))
    curved_z = curved @ v
    size_v = np.abs(basis)
    # A turn of the slope within the sample lets F_e depart by a quarter of it from the straight line.
    bent = (_bend(loop, derivatives, half) + (2.0 * turn.magnitude() + jump.magnitude()) * stepped.magnitude()) @ size_v
    return CellLoop(
        change=diagonal.mid,
        derivatives=np.array([each.mid for each in sides]).reshape(-1, m, m).astype(np.complex128),
        spread=spread * _OUT,
        place=place.mid,
        shifts=np.array([each.mid for each in shifts]).astype(np.complex128),
        unknown=(place.rad + np.sum([each.rad for each in shifts], axis=0)) * _OUT,
        row=row.mid,
        row_derivatives=np.array([each.mid for each in row_derivatives]).reshape(-1, m).astype(np.complex128),
        row_spread=(row.rad + np.sum([each.rad for each in row_derivatives], axis=0)) * _OUT,
        curved=curved_z.mid,
        curved_spread=curved_z.rad * _OUT,
        bent=bent * _OUT,
        weights=weights,
        desired=float(_around(loop.force_n, [s.force_n for s in derivatives], half).mid[0]),
        touching=touching,
    )


def _touch(
    loop: ContactLoop, derivatives: list[ContactLoop], half: FloatArray, rho: tuple[float, float], way: Balls
) -> tuple[Balls, float] | None:
    """Return what the wall changes of the state in the sample of the touch, and a bound of F_e there; None without one.

    The payload, which would go on with a speed between `slow` and `fast`, goes into the wall for a time between ρ/fast
    and ρ/slow; the impulse of K_e x + B_e v is bounded with these, its effect by what springs and dampers take back.
    """
    near, m, n = float(way.magnitude()[0]), len(loop.start), len(loop.before) - 1
    spans = [_around(value, [s.newtons[i] for s in derivatives], half) for i, value in enumerate(loop.newtons)]
    wall, wall_damping, coupling, dampings, per_mass = (float(each.magnitude()[0]) for each in spans)
    soft, soft_damping, heaviest = (float(spans[i].mid[0] - spans[i].rad[0]) for i in (0, 1, 4))
    state = _spread(loop.before, [s.before for s in derivatives], half)
    flow = _spread(loop.free_flow, [s.free_flow for s in derivatives], half).shaped(n + 1, n + 1).magnitude()
    begins = [np.dot(each.free_flow[n - 1], each.before) for each in (loop, *derivatives)]
    first = float(_around(begins[0], begins[1:], half).magnitude()[0])
    after = expm(flow) @ (state.magnitude() + np.eye(n + 1)[n] * near)
    change = (first + flow[n - 1, n] * near + (flow @ flow)[n - 1] @ after) * _OUT
    fast = float(state.mid[n - 1] + state.rad[n - 1]) + change
    slow = float(state.mid[n - 1] - state.rad[n - 1]) - change
    if not slow > 0.0:
        return None
    longest, shortest = rho[1] * near / slow, rho[0] * (near - 2.0 * float(way.rad[0])) / fast
    taken = per_mass * ((0.5 * wall + wall_damping) * fast / slow + 0.5 * coupling + dampings)
    most = per_mass * fast * (0.5 * wall * longest**2 + wall_damping * longest)
    least = max(1.0 - taken, 0.0) * heaviest * slow * (0.5 * soft * shortest**2 + soft_damping * shortest)
    moved = per_mass * fast * (wall * longest**3 / 6.0 + 0.5 * wall_damping * longest**2)
    mid, rad = np.zeros(m), np.zeros(m)
    mid[n - 1], rad[n - 1] = -0.5 * (most + least), 0.5 * (most - least) * _OUT
    mid[n - 2], rad[n - 2] = -0.5 * moved, 0.5 * moved * _OUT
    return Balls(mid=mid, rad=rad), (wall * longest + wall_damping) * fast * _OUT


def _bend(loop: ContactLoop, derivatives: list[ContactLoop], half: FloatArray) -> FloatArray:
    """Return a bound of the third derivative of F_e within a sample by |z| (m,): |c| |a|³ exp |a|."""
    m, n = len(loop.start), len(loop.before) - 1
    flow = _spread(loop.flow, [s.flow for s in derivatives], half).shaped(n + 1, n + 1).magnitude()
    moves = _spread(loop.moves, [s.moves for s in derivatives], half).magnitude()
    row = moves @ flow @ flow @ flow @ expm(flow) * _OUT
    held = _spread(loop.held, [s.held for s in derivatives], half).magnitude()
    newer = held + _spread(loop.stepped, [s.stepped for s in derivatives], half).magnitude()
    out = np.zeros(m)
    out[:n] = row[:n]
    return np.asarray(out + row[n] * (held + newer))


def _weights(whole: FloatArray, is_endless: bool) -> FloatArray | None:
    """Return a bound of |z| that no step raises, w ≥ M w; None if there is none, or ones where none is needed."""
    if not is_endless:
        return np.ones(len(whole))
    w = np.ones(len(whole))
    for _ in range(200):
        w = whole @ w + 1e-9 * w.max()
        w /= w.max()
    return w if np.all(np.isfinite(whole)) and np.all(whole @ w * _OUT < w) else None


def _values(entries: Any) -> Balls:
    return enclose([as_series(each).value for each in np.ravel(entries)])


def _derivatives(entries: Any) -> Balls:
    return enclose([derivative_of(each) for each in np.ravel(entries)])


def _spread(entries: Any, derivatives: list[Any], half: FloatArray) -> Balls:
    """Return entries all over a cell as balls: those of its middle, widened by what the derivatives allow."""
    value = _values(entries)
    rad = value.rad + sum(
        (h * _derivatives(each).magnitude() for each, h in zip(derivatives, half, strict=False)), np.zeros(1)
    )
    return Balls(mid=value.mid, rad=rad * _OUT)


def _around(entry: Any, derivatives: list[Any], half: FloatArray) -> Balls:
    return _spread([entry], [[each] for each in derivatives], half)
