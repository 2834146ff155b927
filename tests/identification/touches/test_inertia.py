"""A payload that is shaken by its own motion, with and without something in its way, by Newton's law."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import StateSpace, lfilter, lsim, tf2ss
from scipy.spatial.transform import Rotation

from identification.result import PhaseKind, TouchCause
from identification.touches.surfaces import Touched, identify_touches
from problems.arrays import FloatArray

from .test_find import logged

PAYLOAD_KG, DRAG_N_S_PER_M = 12.0, 150.0


def led_s(found: Touched) -> float:
    """Return how long a hand is said to lead [s]."""
    hands = [phase for phase in found.timeline.phases if phase.kind is PhaseKind.HAND_LED_MOTION]
    return sum(phase.stop_s - phase.start_s for phase in hands)


def shaken(time: FloatArray, amplitude_m: float = 0.01, frequency_hz: float = 1.2) -> tuple[FloatArray, FloatArray]:
    """Return travel and force of a payload that a position loop moves to and fro."""
    omega = 2.0 * np.pi * frequency_hz
    edge = np.clip(np.minimum(time - 0.5, time[-1] - 0.5 - time), 0.0, 1.0)
    travel = amplitude_m * edge**3 * (10.0 - 15.0 * edge + 6.0 * edge**2) * np.sin(omega * time)
    speed = np.gradient(travel, time)
    return travel, -(PAYLOAD_KG * np.gradient(speed, time) + DRAG_N_S_PER_M * speed)


@pytest.mark.parametrize("rate_hz", [100.0, 250.0, 1000.0])
@pytest.mark.parametrize("deadband_n", [0.0, 1.5])
def test_the_payloads_own_inertia_is_no_touch(rate_hz: float, deadband_n: float) -> None:
    time = np.arange(0.0, 8.0, 1.0 / rate_hz)
    rng = np.random.default_rng(1)
    travel, force = shaken(time)
    force = force + 0.2 * rng.standard_normal(len(time))
    force = np.sign(force) * np.maximum(np.abs(force) - deadband_n, 0.0)
    assert np.max(np.abs(force)) > 6.0
    found = identify_touches(logged(travel + 5e-6 * rng.standard_normal(len(time)), force, 1.0 / rate_hz, 0.0))
    assert not found.timeline.touches
    (about,) = (finding for finding in found.findings if finding.code == "payload-inertia")
    assert led_s(found) == 0.0
    # Its mass is a guess at the true one, for the reader.
    assert abs(float(about.message.split("(")[1].split(" kg")[0]) - PAYLOAD_KG) < 0.2 * PAYLOAD_KG


def test_what_pushes_beside_the_inertia_stays_a_touch() -> None:
    """A hand of 15 N for 0.3 s, twice, on a payload at rest."""
    time = np.arange(0.0, 10.0, 4e-3)
    travel, force = shaken(time[time < 8.0])
    rest = np.zeros(len(time) - len(travel))
    travel, force = np.append(travel, rest), np.append(force, rest)
    pushed_s = (8.4, 9.2)
    for begin in pushed_s:
        now = (time >= begin) & (time < begin + 0.3)
        force[now] -= 15.0 * np.sin(np.pi * (time[now] - begin) / 0.3) ** 2
    touches = identify_touches(logged(travel, force, 4e-3, 0.0)).timeline.touches
    assert [touch.cause for touch in touches] == [TouchCause.UNDETERMINED] * 2
    assert [touch.peak_s for touch in touches] == pytest.approx([begin + 0.15 for begin in pushed_s], abs=0.02)


def test_a_hand_that_shakes_an_admittance_is_not_its_inertia() -> None:
    """F = M_a a + B_a v has the other sign, whatever its size."""
    time = np.arange(0.0, 8.0, 4e-3)
    travel, force = shaken(time)
    found = identify_touches(logged(travel, -force, 4e-3, 0.0))
    assert "payload-inertia" not in {finding.code for finding in found.findings}


def turned(time: FloatArray) -> tuple[Rotation, FloatArray]:
    """Return a tool that turns about two axes at one place, and the force (n, 3) of what hangs off its origin."""
    edge = np.clip(np.minimum(time - 0.5, 8.0 - time), 0.0, 1.0)
    edge = edge**3 * (10.0 - 15.0 * edge + 6.0 * edge**2)
    turn = Rotation.from_euler("XY", edge[:, None] * np.sin(np.outer(time, [4.0, 3.1])) * [0.5, 0.4])
    period = time[1] - time[0]
    between = (turn[:-1].inv() * turn[1:]).as_rotvec() / period
    rate = np.vstack([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
    change = np.gradient(rate, period, axis=0)
    arm = np.array([0.01, -0.02, 0.15])
    return turn, -PAYLOAD_KG * (np.cross(change, arm) + np.cross(rate, np.cross(rate, arm)))


@pytest.mark.parametrize("pressed_n", [0.0, 20.0])
def test_the_inertia_of_a_payload_in_a_tool_that_turns_is_no_touch(pressed_n: float) -> None:
    """What pushes meanwhile, once, stays a touch, with what the tool's turning makes at that time."""
    time = np.arange(0.0, 9.0, 4e-3)
    turn, force = turned(time)
    assert np.max(np.abs(force)) > 8.0
    now = (time >= 4.0) & (time < 4.3)
    force[now, 2] -= pressed_n * np.sin(np.pi * (time[now] - 4.0) / 0.3) ** 2
    log = logged(np.zeros(len(time)), force[:, 2], 4e-3, 0.0)
    log = replace(
        log,
        wrench=replace(log.wrench, force_n=force),
        pose=replace(log.pose, quaternion_xyzw=turn.as_quat(canonical=False)),
        gains=None,
        desired_force=None,
    )
    found = identify_touches(log)
    touches = found.timeline.touches
    assert all(abs(touch.peak_s - 4.15) < 0.25 for touch in touches)
    largest = float(np.max(np.abs(force[now, 2]))) if pressed_n else 0.0
    assert max((touch.peak_force for touch in touches), default=0.0) == pytest.approx(largest, rel=1e-6)
    (about,) = (finding.message for finding in found.findings if finding.code == "payload-inertia")
    assert "While the tool turned" in about
    assert led_s(found) == 0.0
    turning = [phase for phase in found.timeline.phases if phase.kind is PhaseKind.TURNING]
    assert sum(phase.stop_s - phase.start_s for phase in turning) > 5.0


@pytest.mark.parametrize(("rate_hz", "offset_n"), [(125.0, 0.0), (1000.0, 0.8)])
def test_the_swings_of_a_payload_on_its_coupling_are_no_touch(rate_hz: float, offset_n: float) -> None:
    """Pushes on a base that answers fast make it ring at 22 Hz; a sensor's constant offset is no part of it."""
    time = np.arange(0.0, 12.0, 1e-3)
    omega, ratio = 2.0 * np.pi * 22.0, 0.1
    asked = 0.03 * (np.floor(0.5 * time) % 2.0)
    speed = lfilter([1.0 / 30.0], [1.0, 1.0 / 30.0 - 1.0], asked)
    travel = np.cumsum(speed) * 1e-3
    mode = StateSpace(*tf2ss([2.0 * ratio / omega, 1.0], [omega**-2.0, 2.0 * ratio / omega, 1.0]))
    force = -PAYLOAD_KG * lsim(mode, np.gradient(speed, time), time)[1]
    step = round(1e3 / rate_hz)
    rng = np.random.default_rng(2)
    measured = force[::step] + offset_n + 0.3 * rng.standard_normal(len(force[::step]))
    found = identify_touches(logged(travel[::step], measured, 1e-3 * step, 0.0))
    assert np.max(np.abs(force)) > 6.0
    assert not found.timeline.touches
    (about,) = (finding for finding in found.findings if finding.code == "payload-inertia")
    # As above, a guess at it.
    assert float(about.message.split("(")[1].split(" kg")[0]) == pytest.approx(PAYLOAD_KG, rel=0.2)
