"""A robot led by hand through an admittance, by scipy on a fine clock: no code of the project takes part."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.signal import butter, cont2discrete, lfilter, sosfilt
from scipy.spatial.transform import Rotation

from identification.signals.recording import GainsSignal, PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray

FINE_S = 1e-4
LOG_S = 5e-3
MASS_KG, DAMPING_N_S_PER_M = 12.0, 900.0
ONE_POLE = (np.array([20.0]), np.array([1.0, 20.0]))
TWO_POLES = (np.array([900.0]), np.array([1.0, 36.0, 900.0]))
TOOL_DOWN = Rotation.from_euler("xz", [np.pi, 0.4])


@dataclass(frozen=True, kw_only=True)
class Led:
    """Wrench force as the controller saw it and the flange's way, (n,) each at the log's rate."""

    force_n: FloatArray
    position_m: FloatArray


def hand_force(duration_s: float, rng: np.random.Generator, *, band_hz: float = 4.0, rms_n: float = 15.0) -> FloatArray:
    """Pushes of a lively hand on the fine clock, at rest for the first 0.3 s, less a subtractive deadband of 2 N."""
    samples = round(duration_s / FINE_S)
    force = np.asarray(sosfilt(butter(2, band_hz, fs=1.0 / FINE_S, output="sos"), rng.standard_normal(samples)))
    force *= rms_n / float(np.std(force)) * np.clip((np.arange(samples) * FINE_S - 0.3) / 0.2, 0.0, 1.0)
    return np.asarray(np.sign(force) * np.maximum(np.abs(force) - 2.0, 0.0))


def _answer(system: tuple[ArrayLike, ArrayLike], drive: FloatArray) -> FloatArray:
    numerator, denominator, _ = cont2discrete(system, FINE_S, method="foh")
    return np.asarray(lfilter(np.squeeze(numerator), denominator, drive))


def led(
    robot: tuple[FloatArray, FloatArray], delay_s: float, force_n: FloatArray, extra_n: FloatArray | float = 0.0
) -> Led:
    """Integrate M_a dv/dt + B_a v = F, then r(s) and the delay, then the way; `extra_n` drives but is not logged."""
    asked = _answer(([1.0], [MASS_KG, DAMPING_N_S_PER_M]), force_n + extra_n)
    velocity = _answer(robot, asked)
    late = round(delay_s / FINE_S)
    velocity = np.concatenate([np.zeros(late), velocity[: len(velocity) - late]])
    position = np.concatenate([[0.0], np.cumsum(0.5 * FINE_S * (velocity[1:] + velocity[:-1]))])
    every = round(LOG_S / FINE_S)
    return Led(force_n=force_n[::every], position_m=position[::every])


def recorded(
    run: Led,
    *,
    axis: int = 0,
    noise_m: float = 2e-6,
    mass_kg: float = MASS_KG,
    damping_n_s_per_m: float = DAMPING_N_S_PER_M,
    force_sign: float = 1.0,
    turned: Rotation | None = None,
    offset_B_m: FloatArray | None = None,
) -> Recording:
    """Log the run along one axis of the tool, wrench and pose in one message, the weight already removed."""
    n = len(run.force_n)
    stamps = 1_700_000_000_000_000_000 + np.round(np.arange(n) * LOG_S * 1e9).astype(np.int64)
    direction = np.eye(3)[axis]
    orientation = TOOL_DOWN * Rotation.identity(n) if turned is None else turned
    position = run.position_m[:, None] * TOOL_DOWN.apply(direction)
    position = position + noise_m * np.random.default_rng(3).standard_normal((n, 3))
    if offset_B_m is not None:
        position = position + offset_B_m
    return Recording(
        wrench=WrenchSignal(
            topic="/state",
            frame_id="tool",
            stamp_ns=stamps,
            force_n=force_sign * run.force_n[:, None] * direction,
            torque_n_m=np.zeros((n, 3)),
            gravity_compensated=True,
        ),
        pose=PoseSignal(
            topic="/state", frame_id="base", stamp_ns=stamps, position_m=position, quaternion_xyzw=orientation.as_quat()
        ),
        command=None,
        gains=GainsSignal(
            topic="", stamp_ns=stamps[:1], mass=np.full((1, 6), mass_kg), damping=np.full((1, 6), damping_n_s_per_m)
        ),
    )
