"""The trace of one contact with declared gains and F^d shows the robot's pole: physics of its own."""

import re
from collections import deque

import numpy as np
import pytest

from autotune.formats.identified import IN_MEMORY, IdentifiedFile
from autotune.prediction.contact import Law
from autotune.prediction.plants import Surface, build_plants
from autotune.prediction.result import predict_contact
from identification.partial import identify_partial
from identification.result import Estimate, Status
from identification.robot.admittance_estimates import identify_admittance_robots
from identification.signals.recording import GainsSignal, PoseSignal, Recording, WrenchSignal
from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.model.controller import AdmittanceController

MASS_KG, DAMPING, LEAD_S, DESIRED_N = 13.0, 1000.0, 0.02, 30.0
STEP_S, DURATION_S = 1e-3, 1.5
PERIOD = Estimate(value=STEP_S, std=0.0, status=Status.IDENTIFIED)


def pressed(
    pole: float, stiffness: float, damping: float, *, poles: int, delay_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return depth and pressing force of an approach at F^d/B_a into a spring with a damper, every 0.1 ms."""
    step_s = 0.1 * STEP_S
    asked = speed = DESIRED_N / DAMPING
    rate = depth = 0.0
    late = deque([asked] * round(delay_s / step_s))
    rows = []
    for _ in range(round(DURATION_S / step_s)):
        force = max(0.0, stiffness * depth + damping * speed) if depth > 0.0 else 0.0
        rows.append((depth, force))
        by_admittance = (DESIRED_N - force - DAMPING * asked) / MASS_KG
        late.append(asked + LEAD_S * by_admittance)
        apart = late.popleft() - speed
        asked += step_s * by_admittance
        depth += step_s * speed
        if poles == 1:
            speed += step_s * pole * apart
        else:
            speed += step_s * rate
            rate += step_s * (pole**2 * apart - 2.0 * pole * rate)
    every = np.array(rows[::10])
    return every[:, 0], every[:, 1]


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
    ("pole", "stiffness", "poles", "delay_s", "bandwidth_rad_per_s"),
    # Of two equal poles |r|² = 1/2 at ω² (√2 − 1).
    [
        (9.0, 18e3, 1, 0.0, 9.0),
        (9.0, 18e3, 1, 0.04, 9.0),
        (20.0, 10e3, 1, 0.0, 20.0),
        (14.0, 7e3, 2, 0.0, 14.0 * np.sqrt(np.sqrt(2.0) - 1.0)),
        (17.0, 17e3, 2, 0.02, 17.0 * np.sqrt(np.sqrt(2.0) - 1.0)),
    ],
    ids=["slow", "slow and late", "fast", "two poles", "two poles, late"],
)
def test_one_contact_shows_the_pole_as_far_as_it_determines_it(
    pole: float, stiffness: float, poles: int, delay_s: float, bandwidth_rad_per_s: float
) -> None:
    found = identify_admittance_robots(traced(*pressed(pole, stiffness, 200.0, poles=poles, delay_s=delay_s)))
    bandwidth = found.robots["z"].bandwidth_hz
    assert bandwidth.status is Status.WEAK
    assert bandwidth.value is not None
    assert bandwidth.std is not None
    assert abs(bandwidth.value - bandwidth_rad_per_s / (2.0 * np.pi)) < 2.0 * bandwidth.std
    assert bandwidth.std < 0.35 * bandwidth.value
    assert "no feedback damping" in bandwidth.note
    shown = next(f.message for f in found.findings if f.code == "wrench-to-motion-lag")
    lag_ms, std_ms = (float(number) for number in re.findall(r"([\d.]+) ± ([\d.]+) ms", shown)[0])
    # The message is in whole milliseconds.
    assert abs(lag_ms - 1e3 * (delay_s + poles / pole)) < 2.0 * std_ms + 1.0


def test_a_soft_surface_leaves_poles_and_delay_open_and_shows_their_lag() -> None:
    found = identify_admittance_robots(traced(*pressed(16.0, 4e3, 200.0, poles=1)))
    robot, known = found.robots["z"], found.covariances["z"]
    assert robot.numerator.status is Status.WEAK
    assert "trade against each other" in robot.numerator.note
    assert robot.bandwidth_hz.value is not None
    assert robot.bandwidth_hz.std is not None
    assert abs(robot.bandwidth_hz.value - 16.0 / (2.0 * np.pi)) < 2.0 * robot.bandwidth_hz.std
    # lag = T_d + c/ω: an error of ω is made up for by one of T_d.
    assert known.names == ("omega", "T_d")
    assert robot.denominator.value is not None
    poles = robot.denominator.value[-2] / robot.denominator.value[-1]
    slope = np.array([-poles / known.values[0], 1.0])
    lag_std = float(np.sqrt(slope @ np.array(known.matrix) @ slope))
    assert abs(known.values[1] + poles - 1.0 / 16.0) < 2.0 * lag_std < 0.5 / 16.0
    assert lag_std**2 < float(slope**2 @ np.diag(known.matrix))


@pytest.mark.parametrize("stiffness", [8e3, 17e3])
def test_a_robot_of_which_a_soft_surface_shows_the_lag_predicts_the_peak_on_a_harder_one(stiffness: float) -> None:
    soft = identify_partial(traced(*pressed(16.0, 4e3, 0.0, poles=1)), PERIOD)
    source = IdentifiedFile(result=soft, provenance={}, path=IN_MEMORY, sha256="")
    law = AdmittanceController(mass_kg=MASS_KG, damping_n_s_per_m=DAMPING, lead_s=LEAD_S)
    found = predict_contact(
        build_plants(source, Surface(stiffness=stiffness)), Law(controller=law), Approach(force_n=DESIRED_N)
    )
    peak = float(np.max(pressed(16.0, stiffness, 0.0, poles=1)[1]))
    low, high = found.interval.sensor
    assert low < peak < (np.inf if high is None else high)
    assert found.peak_sensor_force == pytest.approx(peak, rel=0.15)


def test_without_a_desired_force_a_second_is_too_short() -> None:
    depth, force = pressed(9.0, 18e3, 200.0, poles=1)
    recording = traced(depth, force)
    found = identify_admittance_robots(
        Recording(wrench=recording.wrench, pose=recording.pose, command=None, gains=recording.gains)
    )
    assert not found.robots
    assert "for 3 s" in found.findings[0].message
