"""Rests of a payload written down from the equations alone, and logs of them."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from identification.payload.static_poses import StaticPose
from identification.signals.segments import Span
from problems.arrays import FloatArray

G_M_S2 = 9.80665
SAMPLES = 1000


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What hangs on the sensor, and the sensor."""

    mass_kg: float = 16.2
    com_m: FloatArray = field(default_factory=lambda: np.array([0.02, -0.015, 0.14]))
    force_bias_n: FloatArray = field(default_factory=lambda: np.array([4.0, -7.0, 11.0]))
    torque_bias_n_m: FloatArray = field(default_factory=lambda: np.array([0.3, -0.2, 0.1]))


PAYLOAD = Truth()


def poses_at(
    orientation: Rotation,
    rng: np.random.Generator | None = None,
    *,
    truth: Truth = PAYLOAD,
    noise_n: float = 0.0,
    torque_noise_n_m: float = 0.0,
    sign: float = 1.0,
    down: FloatArray | None = None,
    mounting: Rotation | None = None,
) -> tuple[StaticPose, ...]:
    """Rests of `SAMPLES` samples; the means carry noise over its square root.

    `down` is the true direction of gravity in the base, `mounting` turns the true sensor axes from the assumed ones.
    """
    found = []
    turn_by = Rotation.identity() if mounting is None else mounting
    for number, turn in enumerate(orientation):
        gravity = (turn * turn_by).as_matrix().T @ (G_M_S2 * np.array([0.0, 0.0, -1.0] if down is None else down))
        force = truth.mass_kg * gravity + truth.force_bias_n
        torque = np.cross(truth.com_m, truth.mass_kg * gravity) + truth.torque_bias_n_m
        if rng is not None:
            force = force + noise_n / np.sqrt(SAMPLES) * rng.standard_normal(3)
            torque = torque + torque_noise_n_m / np.sqrt(SAMPLES) * rng.standard_normal(3)
        found.append(
            StaticPose(
                span=Span(start=2 * SAMPLES * number, stop=2 * SAMPLES * number + SAMPLES),
                time_s=2.0 * number,
                quaternion_xyzw=turn.as_quat(),
                gravity_S_m_s2=turn.as_matrix().T @ np.array([0.0, 0.0, -G_M_S2]),
                force_S_n=sign * force,
                torque_S_n_m=sign * torque,
                force_noise_n=noise_n,
                force_mean_std_n=noise_n / np.sqrt(SAMPLES),
                torque_mean_std_n_m=torque_noise_n_m / np.sqrt(SAMPLES),
            )
        )
    return tuple(found)


def turned_about_the_vertical(orientation: Rotation, rng: np.random.Generator) -> Rotation:
    """The same tilts with the base turned at random: orientations that share no axis."""
    return Rotation.from_rotvec(np.outer(rng.uniform(-2.0, 2.0, len(orientation)), [0.0, 0.0, 1.0])) * orientation
