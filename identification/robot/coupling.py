"""Coupling stiffness and damping, payload drag and moving mass, from free motion without a hand on the payload."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from problems.arrays import ComplexArray, FloatArray

from ..errors import EstimateError

_LOWEST_HZ = 0.25
_HIGHEST_HZ = 70.0
_POSE_RATE_SHARE = 0.12
_SHORTEST_S = 2.0
_LINEAR_ROUNDS = 6
_STEPS = 100  # a span with something else in it has no least squares to end at
_POOR_FIT = 0.15
_SLOW_HZ = 5.0
_RESONANCES_HZ = (8.0, 20.0, 50.0)
_NOISE_ALONE = 1.1
_INDEPENDENT_MISFITS = 40.0
# The least energy of a force, in that of its noise, of which a share explained says something.
_ABOVE_NOISE = 2.0


@dataclass(frozen=True, kw_only=True)
class FreeMotion:
    """One span of free motion that starts and ends at rest: flange position and force on the axis, (n,) each."""

    position_m: FloatArray
    force_n: FloatArray


@dataclass(frozen=True, kw_only=True)
class CouplingFit:
    """K_s, B_s, B_p and M_p with their covariance, in that order; `fit_error` is residual over force beyond noise."""

    stiffness_n_per_m: float
    damping_n_s_per_m: float
    drag_n_s_per_m: float
    mass_kg: float
    covariance: FloatArray
    fit_error: float
    band_hz: tuple[float, float]

    @property
    def std(self) -> FloatArray:
        """Standard deviations of K_s, B_s, B_p, M_p."""
        return np.sqrt(np.diag(self.covariance))


def felt_impedance(parameters: FloatArray, s: ComplexArray) -> ComplexArray:
    """Return X → F of a passive payload, −s Ē = −C_s (M s² + B_p s)/(M s² + B_p s + C_s s), C_s s = B_s s + K_s.

    docs/method.md, "The loop", with E = 0; `parameters` are K_s, B_s, B_p, M_p.
    """
    stiffness, damping, drag, mass = parameters
    coupling = damping * s + stiffness
    payload = (mass * s + drag) * s
    return np.asarray(-coupling * payload / (payload + coupling))


def impedance_gradients(parameters: FloatArray, s: ComplexArray) -> ComplexArray:
    """Return the derivatives (4, n) of `felt_impedance` by K_s, B_s, B_p, M_p.

    With c = B_s s + K_s and p = (M s + B_p) s, Z = −c p/(p + c): ∂Z/∂c = −(p/(p + c))², ∂Z/∂p = −(c/(p + c))².
    """
    stiffness, damping, drag, mass = parameters
    coupling = damping * s + stiffness
    payload = (mass * s + drag) * s
    by_coupling = -((payload / (payload + coupling)) ** 2)
    by_payload = -((coupling / (payload + coupling)) ** 2)
    return np.array([by_coupling, by_coupling * s, by_payload * s, by_payload * s * s])


@dataclass(frozen=True, kw_only=True)
class Noise:
    """White measurement noise: `force_rms_n` of the force, `position_rms_m` of the pose."""

    force_rms_n: float
    position_rms_m: float


def identify_coupling(motions: Sequence[FreeMotion], period_s: float, pose_rate_hz: float, noise: Noise) -> CouplingFit:
    """Find the spans that one payload on one spring explains, and fit X → F over all of them.

    Every span of 2 s or more is fitted alone; the best one chooses its like (prediction error below 15 %), so that
    spans with a contact or a hand in them drop out. Raises EstimateError when no span is explained.
    """
    highest = min(_HIGHEST_HZ, _POSE_RATE_SHARE * pose_rate_hz, 0.2 / period_s)
    long = [m for m in motions if len(m.position_m) * period_s >= _SHORTEST_S]
    alone = [_fit_coupling([motion], period_s, highest, noise) for motion in long]
    best = min(alone, key=lambda fit: fit.fit_error, default=None)
    if best is None or best.fit_error > _POOR_FIT:
        shown = (
            "none lasts that long"
            if best is None
            else f"the best is explained to {100 * max(0.0, 1 - best.fit_error**2):.0f} %"
        )
        raise EstimateError(
            f"The coupling shows in free motion without a hand on the payload, {_SHORTEST_S:g} s or more from rest to "
            f"rest; of {len(motions)} spans {shown}. Record a commanded sweep of 0.5 to 50 Hz in free space, away from "
            "every surface, and check that wrench and pose share one clock."
        )
    like = [m for m in long if prediction_error(best, m, period_s, noise) < _POOR_FIT]
    return best if len(like) == 1 else _fit_coupling(like, period_s, highest, noise)


def prediction_error(fit: CouplingFit, motion: FreeMotion, period_s: float, noise: Noise) -> float:
    """Return residual over force (root of energies in the band, over the noise) of a motion that the fit predicts."""
    s, position, force = _spectra([motion], period_s, fit.band_hz[1])
    parameters = np.array([fit.stiffness_n_per_m, fit.damping_n_s_per_m, fit.drag_n_s_per_m, fit.mass_kg])
    weight = _weights(parameters, s, noise)
    return _unexplained(weight * (force - felt_impedance(parameters, s) * position), weight * force)


def _unexplained(residual: ComplexArray, force: ComplexArray) -> float:
    """Return residual over force (m,), both in units of their noise, as energies beyond it; 1 of a force that is noise.

    Each bin has two values of variance 1.
    """
    noise, all_of = 2.0 * len(force), float(np.linalg.norm(force)) ** 2
    if all_of < _ABOVE_NOISE * noise:
        return 1.0
    return float(np.sqrt(max(float(np.linalg.norm(residual)) ** 2 - noise, 0.0) / (all_of - noise)))


def _weights(parameters: FloatArray, s: ComplexArray, noise: Noise) -> FloatArray:
    """Return 1/σ of real and imaginary part of each bin; the pose's noise gets there through the model.

    White noise of variance σ² puts σ²/2 on each part.
    """
    through = np.abs(felt_impedance(parameters, s)) * noise.position_rms_m
    return np.asarray(np.sqrt(2.0 / (noise.force_rms_n**2 + through**2)))


def _fit_coupling(motions: Sequence[FreeMotion], period_s: float, highest: float, noise: Noise) -> CouplingFit:
    """Fit in the frequency domain: least Σ |F − Z X|²/(σ_F² + |Z|² σ_X²), the errors-in-variables likelihood.

    The weights follow the model: fixed ones would let the pose's noise bias it (Pintelon and Schoukens 2012, 9.11).
    The spans start and end at rest, so their transforms have no leakage.
    """
    s, position, force = _spectra(motions, period_s, highest)
    # Dampings may be zero; stiffness and mass may not. Each is counted in a size of its own.
    low, high = np.array([1e-4, 0.0, 0.0, 1e-4]), np.full(4, 1e6)

    def fitted(start: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        critical = 2.0 * np.sqrt(start[0] * start[3])
        size = np.array([start[0], 0.1 * critical, 0.1 * critical, start[3]])

        def residual(scaled: FloatArray) -> FloatArray:
            difference = force - felt_impedance(scaled * size, s) * position
            difference = _weights(scaled * size, s, noise) * difference
            return np.concatenate([difference.real, difference.imag])

        def jacobian(scaled: FloatArray) -> FloatArray:
            impedance, weight = felt_impedance(scaled * size, s), _weights(scaled * size, s, noise)
            gradients = impedance_gradients(scaled * size, s) * size[:, None]
            by_weight = -0.5 * weight**3 * noise.position_rms_m**2 * (impedance.conj() * gradients).real
            rows = by_weight * (force - impedance * position) - weight * gradients * position
            return np.concatenate([rows.real, rows.imag], axis=1).T

        inside = np.clip(start / size, low + 1e-6, 0.5 * high)
        found = least_squares(residual, inside, jacobian, bounds=(low, high), max_nfev=_STEPS)
        return float(found.cost), found.x * size, found.jac / size, found.fun

    starts = [_starting_point(s, position, force), *_resonant_starts(s, position, force)]
    cost, values, jacobian, residuals = min((fitted(start) for start in starts), key=lambda fit: fit[0])
    mean_square = 2.0 * cost / (len(residuals) - 4)
    # What exceeds the noise is no noise: it is smooth over the band, worth a few independent values only.
    variance = max(mean_square, 1.0) + max(mean_square - _NOISE_ALONE, 0.0) * len(residuals) / _INDEPENDENT_MISFITS
    return CouplingFit(
        stiffness_n_per_m=float(values[0]),
        damping_n_s_per_m=float(values[1]),
        drag_n_s_per_m=float(values[2]),
        mass_kg=float(values[3]),
        covariance=np.asarray(variance * np.linalg.pinv(jacobian.T @ jacobian, hermitian=True), dtype=np.float64),
        fit_error=_unexplained(residuals[: len(s)] + 1j * residuals[len(s) :], _weights(values, s, noise) * force),
        band_hz=(_LOWEST_HZ, highest),
    )


def _starting_point(s: ComplexArray, position: ComplexArray, force: ComplexArray) -> FloatArray:
    """Return K_s, B_s, B_p, M_p from linear equations: F (s² + a1 s + a0) = −(b3 s³ + b2 s² + b1 s) X.

    Reweighted by the last denominator (Sanathanan and Koerner 1963); K_s ≈ b2, M_p = K_s/a0, B_p = b1/a0, B_s = b3.
    """
    size = 2.0 * np.pi * 20.0  # one size for every column
    p = s / size
    weight = np.ones(len(s), dtype=complex)
    solution = np.zeros(5)
    for _ in range(_LINEAR_ROUNDS):
        columns = np.column_stack([p * force, force, p**3 * position, p**2 * position, p * position])
        rows, values = weight[:, None] * columns, -weight * p**2 * force
        stacked = np.concatenate([rows.real, rows.imag])
        solution = np.linalg.lstsq(stacked, np.concatenate([values.real, values.imag]), rcond=None)[0]
        weight = 1.0 / (p**2 + solution[0] * p + solution[1])
    _, a0, b3, b2, b1 = solution
    stiffness, square = max(b2, 1.0), max(a0, 1e-6) * size**2
    return np.maximum([stiffness, b3 / size, b1 * size / square, stiffness / square], [1.0, 1.0, 1.0, 1e-3])


def _resonant_starts(s: ComplexArray, position: ComplexArray, force: ComplexArray) -> list[FloatArray]:
    """Return starts with the mass and drag that the slow half shows, and a resonance at several frequencies.

    Where the pose's noise hides the spring, the linear equations of `_starting_point` find a spring that is not there.
    """
    slow = np.abs(s) <= 2.0 * np.pi * _SLOW_HZ
    columns = np.column_stack([s * position, s * s * position])[slow]
    stacked = np.concatenate([columns.real, columns.imag])
    drag, mass = np.linalg.lstsq(stacked, np.concatenate([-force[slow].real, -force[slow].imag]), rcond=None)[0]
    mass, drag = max(float(mass), 1e-3), max(float(drag), 1.0)
    resonances = 2.0 * np.pi * np.array(_RESONANCES_HZ)
    return [np.array([mass * w * w, 0.1 * mass * w, drag, mass]) for w in resonances]


def _spectra(
    motions: Sequence[FreeMotion], period_s: float, highest_hz: float
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """Return s = jω and orthonormal transforms of position and force in the band."""
    parts: list[tuple[ComplexArray, ComplexArray, ComplexArray]] = []
    for motion in motions:
        n = len(motion.position_m)
        frequency = np.fft.rfftfreq(n, period_s)
        band = (frequency >= _LOWEST_HZ) & (frequency <= highest_hz)
        s = np.asarray(2j * np.pi * frequency[band], dtype=np.complex128)
        # The span may end elsewhere than it began: transform the steps, which begin and end at zero.
        steps = np.diff(motion.position_m, append=motion.position_m[-1])
        position = np.asarray(np.fft.rfft(steps, norm="ortho")[band] / np.expm1(s * period_s), dtype=np.complex128)
        rest = 0.5 * (motion.force_n[0] + motion.force_n[-1])
        force = np.fft.rfft(motion.force_n - rest, norm="ortho")[band]
        parts.append((s, position, force))
    s, position, force = (np.concatenate(column) for column in zip(*parts, strict=True))
    return s, position, force
