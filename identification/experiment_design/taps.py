"""What taps on the payload tell: where the robot cannot excite the payload's swing on its coupling, a hand can."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .sweep import standard_deviations
from .values import PlanValues

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_LARGEST_IMPULSE_N_S = 1.0  # a soft hammer in the hand
_TAPS = 5
_SPACING_S = 2.0
_BAND_HZ = 250.0
_YIELD_SHARE = 0.02  # a robot that holds its position gives way a little
_POINTS = 20_000


@dataclass(frozen=True, kw_only=True)
class TapPlan:
    """Taps along the axis while the robot holds its position: each peaks at the sensor near `peak_force_n`.

    `std` is keyed as `PlanValues`: K_s and the total damping B_s + B_p (as `damping_n_s_per_m`) that the ring-down
    shows, with the mass taken from the poses.
    """

    count: int
    impulse_n_s: float
    peak_force_n: float
    spacing_s: float
    std: dict[str, float]


def plan_taps(values: PlanValues, *, max_force_n: float, mass_std_kg: float) -> TapPlan:
    """Predict K_s and the total damping from the ring-down after taps of unknown strength, the flange held.

    F(s) = J C/(M_p s² + B s + K_s), C = K_s, B = B_s + B_p: what rings is told by frequency and decay alone, so the
    mass, known to `mass_std_kg`, turns them into stiffness and damping. Information (2/(σ² h)) ∫ |dF/dθ|² df.
    """
    mass, stiffness = values.mass_kg.value, values.stiffness_n_per_m.value
    damping = values.damping_n_s_per_m.value + values.drag_n_s_per_m.value
    swing = float(np.sqrt(stiffness / mass))
    impulse = min(_LARGEST_IMPULSE_N_S, max_force_n / swing)
    highest = min(_BAND_HZ, 0.4 / values.sample_time_s.value)
    frequency = np.linspace(0.1, highest, _POINTS)
    s = np.asarray(2j * np.pi * frequency, dtype=np.complex128)
    slope = _slopes(s, stiffness, damping, mass, impulse)
    density = 2.0 * (highest - 0.1) / _POINTS / (values.force_noise_rms_n.value**2 * values.sample_time_s.value)
    information = np.real(np.conj(slope).T @ slope) * density
    # Every tap has a strength of its own; alike, they are one tap seen so many times.
    information *= _TAPS
    information[2, 2] += 1.0 / max(mass_std_kg, 1e-6 * mass) ** 2
    std = standard_deviations(np.asarray(information))
    return TapPlan(
        count=_TAPS,
        impulse_n_s=impulse,
        peak_force_n=min(impulse * swing, max_force_n),
        spacing_s=_SPACING_S,
        std={
            "stiffness_n_per_m": float(np.hypot(std[0], _YIELD_SHARE * stiffness)),
            "damping_n_s_per_m": float(np.hypot(std[1], _YIELD_SHARE * values.critical_damping_n_s_per_m)),
        },
    )


def _slopes(s: ComplexArray, stiffness: float, damping: float, mass: float, impulse: float) -> ComplexArray:
    """Return dF/dθ (n, 4) for K_s, B, M_p and J of F = J K_s/(M_p s² + B s + K_s)."""
    below = mass * s**2 + damping * s + stiffness
    force = impulse * stiffness / below
    return np.stack(
        [force / stiffness - force / below, -force * s / below, -force * s**2 / below, force / impulse], axis=1
    )
