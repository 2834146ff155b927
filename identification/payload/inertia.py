"""Inertia tensor of the payload from moves that turn the tool; the mass a second time, from its acceleration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from problems.arrays import BoolArray, FloatArray, IntArray

from ..result import Estimate, Finding
from ..signals.aligned import AlignedLog
from ..signals.segments import MotionSpans
from ..verdicts import judged, unidentifiable
from .gravity import GravityFit
from .gravity_verdicts import WITHOUT_TORQUE
from .inertia_rows import MotionRows, build_motion_rows
from .static_poses import StaticPose

_FEWEST_MOVES = 3
_ROUNDS = 6
_OUTLIER_FACTOR = 4.0
_DISAGREEMENT = 4.0
_DISAGREEMENT_SHARE = 0.03
_INCONSISTENT = 16.0
_PRODUCT_FLOOR = 0.2
# The equations are of a rigid payload: a gripper that swings at 20 Hz adds 1 % to a turn that takes half a second.
_MODEL_STD_SHARE = 0.01
# Of the moments beside it, what is known of a product at best: windows of one log differ by a tenth of that.
_PRODUCT_STD_SHARE = 1e-3
# Directions that no move excites stay 0 with a deviation far above any payload (kg, kg·m, kg·m², N, N·m; s).
_PRIOR_STD = np.concatenate([np.full(16, 1e2), [1.0]])
_METHOD = "Newton-Euler least squares over moves that turn the tool, below 8 Hz"
_ADVICE = (
    "Record moves of 0.5 to 1 s each that turn the tool by 40 degrees or more and back, about each of its three axes, "
    "at rest before and after and with nothing touching it."
)
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Places of the six numbers of an inertia tensor: xx, yy, zz, xy, xz, yz."""
_LOWER = np.tril_indices(4)
_ROW, _COLUMN = _LOWER
_DIAGONAL = np.flatnonzero(_ROW == _COLUMN)
_LARGEST_LOG = 30.0
_SMALLEST_SHARE = 1e-4
_EVALUATIONS = 300
_AS_GOOD_AS_EQUAL = 1e-4  # half the squared distance, in standard deviations, which no other start could better


@dataclass(frozen=True, kw_only=True)
class InertiaFit:
    """The inertia tensor about the sensor's origin in S [kg·m²]: `components` xx, yy, zz, xy, xz, yz with verdicts.

    They are those of the physically consistent estimate. `mass_kg` is the inertial mass where the origin was
    accelerated, free of the weight. `lag_s` is how much the wrench comes after the pose, `lag_std_s` its deviation (NaN
    without moves). `moves` took part, `left_out` did not fit.
    """

    components: tuple[Estimate, ...]
    mass_kg: Estimate
    lag_s: float
    lag_std_s: float
    moves: int
    left_out: int
    findings: tuple[Finding, ...]


@dataclass(frozen=True, kw_only=True)
class MotionSolution:
    """Unconstrained m, h, I, biases, lag (17,) with covariance; which moves fit (moves,)."""

    values: FloatArray
    covariance: FloatArray
    fits: BoolArray


def identify_inertia(
    log: AlignedLog, motion: MotionSpans, poses: Sequence[StaticPose], gravity: GravityFit
) -> InertiaFit:
    """Solve the Newton–Euler equations over free moves for I, with m and m c as the rests show them.

    The inertia is that of the payload and of the sensor's outer part, about the origin of the pose's frame. Components
    that the moves do not turn about are unidentifiable. What no distribution of mass can have is replaced by the
    consistent tensor of highest likelihood within the uncertainty, and refused beyond.
    """
    if not gravity.has_torque:
        return replace(_nothing(WITHOUT_TORQUE), findings=())
    solution = solve_motion(log, motion, poses, gravity)
    if solution is None:
        return _nothing("fewer than three moves turn the tool freely")
    free = _combined(solution, gravity, tied=False)
    mass = judged(
        float(solution.values[0]), float(np.sqrt(solution.covariance[0, 0])), method=_METHOD, note="from acceleration"
    )
    findings = _disagreement(solution, gravity)
    tied = free if findings else _combined(solution, gravity, tied=True)
    values, distance = nearest_consistent(*tied)
    std = np.hypot(np.sqrt(np.diag(tied[1]))[4:], _model_std(values[4:]))
    lag, lag_std = float(solution.values[16]), float(np.sqrt(solution.covariance[16, 16]))
    refused = distance > _INCONSISTENT
    if refused:
        findings += (_unphysical(distance),)
    components = tuple(
        unidentifiable(method=_METHOD, note="no payload has the tensor that fits best")
        if refused
        else _component(index, values[4:], std, bool(findings))
        for index in range(6)
    )
    return InertiaFit(
        components=components,
        mass_kg=mass,
        lag_s=lag,
        lag_std_s=lag_std,
        moves=int(np.count_nonzero(solution.fits)),
        left_out=int(np.count_nonzero(~solution.fits)),
        findings=(*findings, *_missing(components)),
    )


def inertial_sign(log: AlignedLog, motion: MotionSpans, poses: Sequence[StaticPose], gravity: GravityFit) -> float:
    """Return the inertia over its standard deviation, of the axis that the moves show best; 0 without moves.

    Below −5 the forces of acceleration have the sign of the weight: gravity points the other way in the base than
    assumed. Rests cannot show that from a wrench of the other body, moves can, with their torques.
    """
    solution = solve_motion(log, motion, poses, gravity) if gravity.has_torque else None
    if solution is None:
        return 0.0
    scores = solution.values[4:7] / np.sqrt(np.diag(solution.covariance)[4:7])
    return float(scores[np.argmax(np.abs(scores))])


def solve_motion(
    log: AlignedLog, motion: MotionSpans, poses: Sequence[StaticPose], gravity: GravityFit
) -> MotionSolution | None:
    """Solve for m, h, I, biases and lag without constraint, leaving out moves that do not fit; None if too few do."""
    data = build_motion_rows(log, motion, poses, gravity)
    if data is None:
        return None
    fits = np.ones(int(data.move.max()) + 1, dtype=bool)
    for _ in range(_ROUNDS):
        if np.count_nonzero(fits) < _FEWEST_MOVES:
            return None
        values, spread = _solve(data, fits[data.move])
        left = np.sqrt(np.mean(((data.values - data.rows @ values) / spread) ** 2, axis=1))
        each = np.array([float(np.sqrt(np.mean(left[data.move == i] ** 2))) for i in range(len(fits))])
        following = each < _OUTLIER_FACTOR * max(float(np.median(each[fits])), 1e-9)
        if np.array_equal(following, fits):
            break
        fits = following
    inside = fits[data.move]
    values, spread = _solve(data, inside)
    covariance = _covariance(
        data.rows[inside] / spread[:, None], (data.values - data.rows @ values)[inside] / spread, data.move[inside]
    )
    # Noise in a column makes its parameter too small by its share of the column's power.
    covariance[np.diag_indices(10)] += (data.attenuation * values[:10]) ** 2
    return MotionSolution(values=values, covariance=covariance, fits=fits)


def _solve(data: MotionRows, inside: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the parameters and the spread (6,) of what is left, by which the equations are weighed."""
    spread = np.concatenate([np.full(3, np.std(data.values[:, :3])), np.full(3, np.std(data.values[:, 3:]))])
    values = np.zeros(17)
    for _ in range(4):
        spread = np.maximum(spread, np.maximum(data.noise, 1e-9))
        rows = np.vstack([(data.rows[inside] / spread[:, None]).reshape(-1, 17), np.diag(1.0 / _PRIOR_STD)])
        shown = np.concatenate([(data.values[inside] / spread).reshape(-1), np.zeros(17)])
        scale = np.linalg.norm(rows, axis=0)
        values = np.linalg.lstsq(rows / scale, shown, rcond=None)[0] / scale
        left = data.values[inside] - data.rows[inside] @ values
        spread = np.sqrt(np.mean(left**2, axis=0))
        spread = np.repeat([np.sqrt(np.mean(spread[:3] ** 2)), np.sqrt(np.mean(spread[3:] ** 2))], 3)
    return values, np.maximum(spread, np.maximum(data.noise, 1e-9))


def _covariance(rows: FloatArray, left: FloatArray, move: IntArray) -> FloatArray:
    """Return the covariance (17, 17) of a whitened fit, widened by what whole moves misfit together."""
    flat = rows.reshape(-1, 17)
    freedom = max(left.size - 17, 1)
    inverse = np.linalg.inv(flat.T @ flat + np.diag(1.0 / _PRIOR_STD**2))
    covariance = max(1.0, float(np.sum(left**2)) / freedom) * inverse
    meat = np.zeros((17, 17))
    for number in np.unique(move):
        score = np.einsum("nij,ni->j", rows[move == number], left[move == number])
        meat += np.outer(score, score)
    count = len(np.unique(move))
    sandwich = inverse @ meat @ inverse * count / max(count - 1, 1)
    widened = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(covariance), 1.0))
    return np.asarray(widened[:, None] * covariance * widened)


def _combined(solution: MotionSolution, gravity: GravityFit, *, tied: bool) -> tuple[FloatArray, FloatArray]:
    """Return m, h, I (10,) and their covariance, with m and h = m c of the rests as a second measurement if `tied`."""
    values, covariance = solution.values[:10], solution.covariance[:10, :10]
    if not tied:
        return values, covariance
    mass, com = gravity.mass_kg, gravity.com_S_m
    jacobian = np.zeros((4, 4))
    jacobian[0, 0] = 1.0
    jacobian[1:, 0], jacobian[1:, 1:] = com, mass * np.eye(3)
    rest = jacobian @ gravity.covariance[:4, :4] @ jacobian.T
    pick = np.eye(4, 10)
    gain = covariance @ pick.T @ np.linalg.inv(pick @ covariance @ pick.T + rest)
    updated = values + gain @ (np.concatenate([[mass], mass * com]) - values[:4])
    left = np.eye(10) - gain @ pick
    return updated, np.asarray(left @ covariance @ left.T + gain @ rest @ gain.T)


def _model_std(six: FloatArray) -> FloatArray:
    """Return what the rigid model leaves open of xx, yy, zz, xy, xz, yz (6,)."""
    sizes = np.sqrt(np.array([abs(six[i] * six[j]) for i, j in PAIRS]))
    products = _PRODUCT_STD_SHARE * sizes * (np.arange(6) > 2)
    return np.asarray(np.hypot(_MODEL_STD_SHARE * np.abs(six), products))


def _component(index: int, six: FloatArray, std: FloatArray, is_doubtful: bool) -> Estimate:
    """Judge one component; a product of inertia is small beside the moments, and is judged by their size."""
    i, j = PAIRS[index]
    known = [float(six[k]) for k in range(3) if std[k] < 0.25 * abs(six[k])]
    floor = 0.0 if i == j else _PRODUCT_FLOOR * max(known, default=0.0)
    note = "mass and its moment from motion disagree with those from rests" if is_doubtful else ""
    limit = 0.0 if is_doubtful else 0.05
    return judged(float(six[index]), float(std[index]), method=_METHOD, note=note, identified=limit, floor=floor)


def _disagreement(solution: MotionSolution, gravity: GravityFit) -> tuple[Finding, ...]:
    """Return findings where inertial mass or moment is not what the rests show."""
    mass, std = float(solution.values[0]), float(np.sqrt(solution.covariance[0, 0]))
    apart, both = abs(mass - gravity.mass_kg), float(np.hypot(std, gravity.mass_std_kg))
    found = []
    if apart > max(_DISAGREEMENT * both, _DISAGREEMENT_SHARE * gravity.mass_kg):
        found.append(
            Finding(
                code="mass-disagreement",
                severity="warning",
                message=f"Where the tool turns, the mass from acceleration, {mass:.3f} ± {std:.3f} kg, and from "
                f"gravity, {gravity.mass_kg:.3f} ± {gravity.mass_std_kg:.3f} kg, disagree.",
                advice="Check force and length units, the clocks of wrench and pose, and that the payload is the same.",
            )
        )
    moment = gravity.mass_kg * gravity.com_S_m
    off = solution.values[1:4] - moment
    std_h = np.sqrt(np.diag(solution.covariance)[1:4] + (gravity.mass_kg * gravity.com_std_m) ** 2)
    if bool(np.any(np.abs(off) > np.maximum(_DISAGREEMENT * std_h, 0.01 * gravity.mass_kg))):
        shown = ", ".join(f"{1e3 * value / gravity.mass_kg:+.0f}" for value in off)
        found.append(
            Finding(
                code="origin-offset",
                severity="warning",
                message=f"The centre of mass from motion lies ({shown}) mm from the one at rest: the pose's origin is "
                "not the sensor's, or the wrench lags.",
                advice="Record the pose of the sensor's own frame; the inertia is about neither origin.",
            )
        )
    return tuple(found)


def _unphysical(distance: float) -> Finding:
    return Finding(
        code="inertia-unphysical",
        severity="warning",
        message=f"The inertia tensor that fits best is that of no payload ({np.sqrt(distance):.1f} standard deviations "
        "from the nearest one that is).",
        advice="Check the torque's unit and frame and that nothing touches the payload as it turns.",
    )


def _missing(components: tuple[Estimate, ...]) -> tuple[Finding, ...]:
    names = [f"{'xyz'[i]}{'xyz'[j]}" for each, (i, j) in zip(components, PAIRS, strict=True) if each.value is None]
    if not names:
        return ()
    return (
        Finding(
            code="inertia-not-excited",
            severity="info",
            message=f"The moves do not identify {', '.join(names)} of the payload's inertia tensor.",
            advice=_ADVICE,
        ),
    )


def _nothing(note: str) -> InertiaFit:
    unknown = unidentifiable(method=_METHOD, note=note)
    return InertiaFit(
        components=(unknown,) * 6,
        mass_kg=unknown,
        lag_s=float("nan"),
        lag_std_s=float("nan"),
        moves=0,
        left_out=0,
        findings=_missing((unknown,) * 6),
    )


def inertia_matrix(six: FloatArray) -> FloatArray:
    """Return the symmetric matrix (3, 3) of xx, yy, zz, xy, xz, yz."""
    matrix = np.zeros((3, 3))
    for value, (i, j) in zip(six, PAIRS, strict=True):
        matrix[i, j] = matrix[j, i] = value
    return matrix


def pseudo_inertia(parameters: FloatArray) -> FloatArray:
    """Return [[Σ, h], [hᵀ, m]] (4, 4) with Σ = ½ tr(I) 1 − I from (m, h, I) (10,), I about the same point as h.

    It is the second moment of the mass in homogeneous coordinates, so it is positive definite for every payload
    (Wensing, Kim and Slotine, "Linear matrix inequalities for physically consistent inertial parameter
    identification", 2018, equation 12).
    """
    inertia = inertia_matrix(parameters[4:])
    matrix = np.empty((4, 4))
    matrix[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    matrix[:3, 3] = matrix[3, :3] = parameters[1:4]
    matrix[3, 3] = parameters[0]
    return matrix


def parameters_of(matrix: FloatArray) -> FloatArray:
    """Return (m, h, I) (10,) of a pseudo-inertia matrix."""
    second = matrix[:3, :3]
    inertia = np.trace(second) * np.eye(3) - second
    return np.concatenate([[matrix[3, 3]], matrix[:3, 3], [inertia[i, j] for i, j in PAIRS]])


_PARAMETERS = np.array([parameters_of(unit.reshape(4, 4)) for unit in np.eye(16)]).T


def is_consistent(parameters: FloatArray) -> bool:
    """Return whether some distribution of positive mass has these parameters."""
    return bool(np.all(np.linalg.eigvalsh(pseudo_inertia(parameters)) > 0.0))


def nearest_consistent(parameters: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Return the consistent (m, h, I) of highest likelihood and its squared distance in standard deviations.

    The pseudo-inertia matrix is written as L Lᵀ, the diagonal of L as exponentials, so that every iterate is
    consistent (log-Cholesky, after Rucker and Wensing, "Smooth parameterization of rigid-body inertia", 2022).
    """
    if is_consistent(parameters):
        return parameters, 0.0
    scale = np.sqrt(np.diag(covariance))
    # Correlations have a condition that a Cholesky factor allows even where some directions are unknown.
    whitening = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(scale, scale))) / scale

    def misfit(free: FloatArray) -> FloatArray:
        return np.asarray(whitening @ (parameters_of(_unfold(free)) - parameters))

    def jacobian(free: FloatArray) -> FloatArray:
        return np.asarray(whitening @ _unfold_jacobian(free))

    starts = (parameters, _rounded_off(parameters, covariance))
    found = []
    for start in starts:
        found.append(least_squares(misfit, _fold(start), jacobian, x_scale="jac", max_nfev=_EVALUATIONS))
        if found[-1].cost < _AS_GOOD_AS_EQUAL:
            break
    best = min(found, key=lambda each: float(each.cost))
    return parameters_of(_unfold(best.x)), float(2.0 * best.cost)


def _rounded_off(parameters: FloatArray, covariance: FloatArray) -> FloatArray:
    """Fill what is unknown with a body that is alike about all axes: the start from which no direction is infinite."""
    known = np.sqrt(np.diag(covariance))[4:7] < np.abs(parameters[4:7])
    size = float(np.max(np.abs(parameters[4:7][known]), initial=0.0)) or float(np.max(np.abs(parameters[4:7])))
    alike, spread = np.array([size, size, size, 0.0, 0.0, 0.0]), np.full(6, size)
    gain = covariance[:, 4:] @ np.linalg.inv(covariance[4:, 4:] + np.diag(spread**2))
    return np.asarray(parameters + gain @ (alike - parameters[4:]))


def _fold(parameters: FloatArray) -> FloatArray:
    """Return the ten free numbers of the nearest pseudo-inertia matrix that is positive definite."""
    size, axes = np.linalg.eigh(pseudo_inertia(parameters))
    clipped = axes @ np.diag(np.maximum(size, _SMALLEST_SHARE * np.max(np.abs(size)) + 1e-12)) @ axes.T
    factor = np.linalg.cholesky(clipped)
    factor[np.diag_indices(4)] = np.log(np.diag(factor))
    return np.asarray(factor[_LOWER])


def _factor(free: FloatArray) -> FloatArray:
    factor = np.zeros((4, 4))
    factor[_LOWER] = free
    factor[np.diag_indices(4)] = np.exp(np.clip(np.diag(factor), -_LARGEST_LOG, _LARGEST_LOG))
    return factor


def _unfold(free: FloatArray) -> FloatArray:
    factor = _factor(free)
    return np.asarray(factor @ factor.T)


def _unfold_jacobian(free: FloatArray) -> FloatArray:
    """Return how (m, h, I) (10,) change with the free numbers (10,): d(L Lᵀ) = dL Lᵀ + L dLᵀ, as columns."""
    factor = _factor(free)
    changes = np.zeros((len(free), 4, 4))
    changes[np.arange(len(free)), _ROW] = factor[:, _COLUMN].T
    changes[_DIAGONAL] *= np.diag(factor)[:, None, None]
    return _PARAMETERS @ (changes + changes.transpose(0, 2, 1)).reshape(len(free), 16).T
