"""The trace of one contact with declared gains and F^d shows the robot's pole: physics integrated by scipy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from identification.result import Status
from identification.robot.admittance_robot import identify_admittance_robots
from identification.signals.recording import GainsSignal, PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray

MASS_KG, DAMPING, LEAD_S, DESIRED_N = 13.0, 1000.0, 0.02, 30.0
STEP_S, DURATION_S = 1e-3, 1.5


def pressed(pole: float, stiffness: float, damping: float, *, poles: int) -> tuple[FloatArray, FloatArray]:
    """Return depth and pressing force of an approach at F^d/B_a that meets a spring with a damper."""

    def pressing(state: FloatArray) -> float:
        return max(0.0, stiffness * state[3] + damping * state[1]) if state[3] > 0.0 else 0.0

    def rates(_: float, state: FloatArray) -> list[float]:
        asked, speed, rate = state[:3]
        by_admittance = (DESIRED_N - pressing(state) - DAMPING * asked) / MASS_KG
        apart = asked + LEAD_S * by_admittance - speed
        if poles == 1:
            return [by_admittance, pole * apart, 0.0, speed]
        return [by_admittance, rate, pole**2 * apart - 2.0 * pole * rate, speed]

    time = np.arange(0.0, DURATION_S, STEP_S)
    steady = DESIRED_N / DAMPING
    found = solve_ivp(rates, (0.0, DURATION_S), [steady, steady, 0.0, 0.0], t_eval=time, max_step=STEP_S, rtol=1e-7)
    return np.asarray(found.y[3]), np.array([pressing(state) for state in found.y.T])


def traced(depth_m: FloatArray, force_n: FloatArray) -> Recording:
    rng, count = np.random.default_rng(8), len(depth_m)
    stamps = np.round(np.arange(count) * STEP_S * 1e9).astype(np.int64)
    depth, wrench = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    depth[:, 2] = depth_m + 5e-6 * rng.standard_normal(count)
    wrench[:, 2] = -force_n - 0.5 * rng.standard_normal(count)
    nothing = np.full((count, 3), np.nan)
    return Recording(
        wrench=WrenchSignal(
            topic="trace",
            frame_id="",
            stamp_ns=stamps,
            force_n=wrench,
            torque_n_m=nothing,
            gravity_compensated=True,
            measured_axes=("z",),
        ),
        pose=PoseSignal(
            topic="trace",
            frame_id="",
            stamp_ns=stamps,
            position_m=depth,
            quaternion_xyzw=np.full((count, 4), np.nan),
            is_displacement=True,
            measured_axes=("z",),
        ),
        command=None,
        gains=GainsSignal(
            topic="",
            stamp_ns=stamps[:1],
            mass=np.full((1, 6), MASS_KG),
            damping=np.full((1, 6), DAMPING),
            lead_s=(LEAD_S,) * 6,
        ),
        desired_force=WrenchSignal(
            topic="",
            frame_id="",
            stamp_ns=stamps[:1],
            force_n=np.array([[0.0, 0.0, DESIRED_N]]),
            torque_n_m=np.zeros((1, 3)),
        ),
    )


@pytest.mark.parametrize(
    ("pole", "stiffness", "poles", "bandwidth_rad_per_s"),
    # Of two equal poles |r|² = 1/2 at ω² (√2 − 1).
    [(9.0, 18e3, 1, 9.0), (20.0, 10e3, 1, 20.0), (14.0, 7e3, 2, 14.0 * np.sqrt(np.sqrt(2.0) - 1.0))],
    ids=["slow", "fast", "two poles"],
)
def test_one_contact_shows_the_pole_as_far_as_it_determines_it(
    pole: float, stiffness: float, poles: int, bandwidth_rad_per_s: float
) -> None:
    found = identify_admittance_robots(traced(*pressed(pole, stiffness, 200.0, poles=poles)))
    bandwidth = found.robots["z"].bandwidth_hz
    assert bandwidth.status is Status.WEAK
    assert bandwidth.value is not None
    assert bandwidth.std is not None
    assert abs(bandwidth.value - bandwidth_rad_per_s / (2.0 * np.pi)) < 2.0 * bandwidth.std
    assert bandwidth.std < 0.35 * bandwidth.value
    assert "no feedback damping" in bandwidth.note


def test_a_soft_surface_that_hardly_asks_the_robot_leaves_its_pole_unidentifiable() -> None:
    found = identify_admittance_robots(traced(*pressed(16.0, 4e3, 200.0, poles=1)))
    assert found.robots["z"].bandwidth_hz.status is Status.UNIDENTIFIABLE


def test_without_a_desired_force_a_second_is_too_short() -> None:
    depth, force = pressed(9.0, 18e3, 200.0, poles=1)
    recording = traced(depth, force)
    found = identify_admittance_robots(
        Recording(wrench=recording.wrench, pose=recording.pose, command=None, gains=recording.gains)
    )
    assert not found.robots
    assert "for 3 s" in found.findings[0].message
