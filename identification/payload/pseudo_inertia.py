"""Physical consistency of mass, first moment and inertia: some distribution of positive mass has them."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

FloatArray = NDArray[np.float64]

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Places of the six numbers of an inertia tensor: xx, yy, zz, xy, xz, yz."""

_LOWER = np.tril_indices(4)
_ROW, _COLUMN = _LOWER
_DIAGONAL = np.flatnonzero(_ROW == _COLUMN)
_LARGEST_LOG = 30.0
_SMALLEST_SHARE = 1e-4
_EVALUATIONS = 300
_AS_GOOD_AS_EQUAL = 1e-4  # half the squared distance, in standard deviations, which no other start could better


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
    # Correlations have a condition that a Cholesky factor can stand even where some directions are unknown.
    whitening = np.linalg.inv(np.linalg.cholesky(covariance / np.outer(scale, scale))) / scale

    def misfit(free: FloatArray) -> FloatArray:
        return np.asarray(whitening @ (parameters_of(_unfold(free)) - parameters))

    def slope(free: FloatArray) -> FloatArray:
        return np.asarray(whitening @ _unfold_slope(free))

    starts = (parameters, _rounded_off(parameters, covariance))
    found = []
    for start in starts:
        found.append(least_squares(misfit, _fold(start), slope, x_scale="jac", max_nfev=_EVALUATIONS))
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


def _unfold_slope(free: FloatArray) -> FloatArray:
    """Return how (m, h, I) (10,) change with the free numbers (10,): d(L Lᵀ) = dL Lᵀ + L dLᵀ, as columns."""
    factor = _factor(free)
    changes = np.zeros((len(free), 4, 4))
    changes[np.arange(len(free)), _ROW] = factor[:, _COLUMN].T
    changes[_DIAGONAL] *= np.diag(factor)[:, None, None]
    return _PARAMETERS @ (changes + changes.transpose(0, 2, 1)).reshape(len(free), 16).T
