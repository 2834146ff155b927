"""Tare, a change of payload, units and signs: told from the weight, with their times."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.logs.checks.payload import check_payload, find_tare_jumps, weigh_rests
from identification.payload.static_poses import collect_static_poses
from identification.signals.aligned import align
from identification.signals.recording import Recording
from identification.signals.segments import find_motion
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from tests.autotune.simulation.runs import silent
from tests.identification.signals.test_segments import RATE_HZ, held, line, log_of

IN_REST_S = 12.5
IN_MOTION_S = 14.2
STEP_N = np.array([1.5, -2.5, 3.0])


def seconds(recording: Recording) -> FloatArray:
    return np.asarray((recording.wrench.stamp_ns - recording.wrench.stamp_ns[0]) * 1e-9)[:, None]


def with_force(recording: Recording, force_n: FloatArray) -> Recording:
    return replace(recording, wrench=replace(recording.wrench, force_n=force_n))


def gravity_S(recording: Recording) -> FloatArray:
    return np.asarray(Rotation.from_quat(recording.pose.quaternion_xyzw).inv().apply([0.0, 0.0, -9.81]))


@pytest.mark.parametrize("mass_kg", [2.0, 16.2, 50.0])
@pytest.mark.parametrize("noisy", [True, False])
def test_a_sound_cell_has_nothing_to_show(mass_kg: float, noisy: bool) -> None:
    slow = AdmittanceController(mass_kg=max(10.0, mass_kg), damping_n_s_per_m=3500.0)
    cell = replace(SimulatedCell(), payload_mass_kg=mass_kg, controller=slow, sample_time_s=2e-3)
    recording = simulate_cell(cell if noisy else silent(cell), Program(sweep_s=4.0), seed=int(mass_kg)).recording
    assert check_payload(recording) == ()


def test_a_tare_at_rest_is_reported_with_time_and_size(demo_recording: Recording) -> None:
    wrench = demo_recording.wrench
    stepped = with_force(demo_recording, wrench.force_n + STEP_N * (seconds(demo_recording) >= IN_REST_S))
    (jump,) = find_tare_jumps(align(stepped))
    assert jump.time_s == pytest.approx(IN_REST_S, abs=5e-3)
    # Means of 0.15 s on either side: 0.14 N/√188 each, five deviations.
    np.testing.assert_allclose(jump.force_n, STEP_N, rtol=0.0, atol=5.0 * np.sqrt(2.0) * 0.14 / np.sqrt(188))
    np.testing.assert_allclose(jump.torque_n_m, 0.0, rtol=0.0, atol=0.01)
    (found,) = check_payload(stepped)
    assert (found.code, found.severity) == ("tare-jump", "warning")


def test_a_knock_that_rings_is_no_tare(demo_recording: Recording) -> None:
    t = seconds(demo_recording) - IN_REST_S
    ringing = 8.0 * np.exp(-np.maximum(t, 0.0) / 0.05) * np.cos(2.0 * np.pi * 22.0 * t) * (t >= 0.0)
    knocked = with_force(demo_recording, demo_recording.wrench.force_n + ringing * np.array([1.0, 0.0, 0.0]))
    assert find_tare_jumps(align(knocked)) == ()


def test_a_hand_that_leans_on_slowly_is_no_tare(demo_recording: Recording) -> None:
    lean = 8.0 / (1.0 + np.exp(-(seconds(demo_recording) - IN_REST_S) / 0.02))
    leaned = with_force(demo_recording, demo_recording.wrench.force_n + lean * np.array([0.0, 1.0, 0.0]))
    assert find_tare_jumps(align(leaned)) == ()


def test_a_tare_while_moving_shows_at_the_rests(demo_recording: Recording) -> None:
    stepped = with_force(
        demo_recording, demo_recording.wrench.force_n + STEP_N * (seconds(demo_recording) >= IN_MOTION_S)
    )
    (found,) = check_payload(stepped)
    assert (found.code, found.severity) == ("bias-change", "warning")
    message = [float(text) for text in found.message.split("(")[1].split(")")[0].split(", ")]
    # A median over rests of 0.14 N/√900 each, and the fit before.
    np.testing.assert_allclose(message, STEP_N, rtol=0.0, atol=0.05)
    last, first = (float(text) for text in found.message.split("between ")[1].split(" s")[0].split(" and "))
    assert last < IN_MOTION_S < first + 0.2


def test_a_change_of_payload_is_reported_with_both_masses(demo_recording: Recording) -> None:
    added = 5.0 * gravity_S(demo_recording) * (seconds(demo_recording) >= IN_MOTION_S)
    (found,) = check_payload(with_force(demo_recording, demo_recording.wrench.force_n + added))
    assert (found.code, found.severity) == ("payload-change", "error")
    message = [float(part.split(" ±")[0].split(" ")[-1]) for part in found.message.split("kg")[:2]]
    assert message == [pytest.approx(16.2, rel=0.01), pytest.approx(21.2, rel=0.01)]
    last, first = (float(text) for text in found.message.split("between ")[1].split(" s")[0].split(" and "))
    assert last < IN_MOTION_S < first + 0.2


def test_kilonewtons_and_a_flipped_sign_are_reported(demo_recording: Recording) -> None:
    force = demo_recording.wrench.force_n
    (unit,) = check_payload(with_force(demo_recording, 1e-3 * force))
    assert (unit.code, unit.severity) == ("force-unit", "error")
    assert "16.2 kg" in unit.message
    (sign,) = check_payload(with_force(demo_recording, -force))
    assert (sign.code, sign.severity) == ("force-sign", "warning")


def test_what_cannot_be_weighed_is_left_alone(demo_recording: Recording) -> None:
    compensated = replace(demo_recording.wrench, gravity_compensated=True)
    assert check_payload(replace(demo_recording, wrench=compensated)) == ()
    late = replace(demo_recording.pose, stamp_ns=demo_recording.pose.stamp_ns + 10**12)
    assert check_payload(replace(demo_recording, pose=late)) == ()


@pytest.mark.parametrize(("place_m", "codes"), [(0.04, []), (0.0, ["bias-change"])])
def test_holds_on_one_surface_are_no_tare_unless_nothing_was_touched_there(place_m: float, codes: list[str]) -> None:
    """Eight tilted rests, one more, then four under 30 N at one place, where without contact nobody was before."""
    angles = np.radians([30.0, -30.0, 40.0, -40.0, 20.0, -20.0, 35.0, -25.0])
    tilts = [Rotation.from_euler("xy"[i % 2], angle) for i, angle in enumerate(angles)]
    rests = [(tilt, 0.0, 0.0) for tilt in tilts] + [(Rotation.identity(), 0.0, 0.0)]
    rests += [(Rotation.identity(), place_m, -30.0)] * 4
    turns, position, force = [], [], []
    for tilt, x, pressed in rests:
        pieces = (tilt, x, pressed), (Rotation.from_euler("x", 0.4), x - 0.05, 0.0)
        for (orientation, at, push), seconds in zip(pieces, (1.0, 0.1), strict=True):
            turns += [orientation] * round(seconds * RATE_HZ)
            position.append(held(seconds, at))
            force.append(np.tile([0.0, 0.0, push], (len(position[-1]), 1)))
    orientation = Rotation.concatenate(turns)
    weight = 10.0 * orientation.inv().apply([0.0, 0.0, -9.81])
    log = log_of(line(*position), force=weight + np.concatenate(force), orientation=orientation)
    found = weigh_rests("/wrench", log, collect_static_poses(log, find_motion(log).still))
    assert [finding.code for finding in found] == codes


@pytest.mark.parametrize(("missing", "count"), [(0, 1), (1, 0)])
def test_a_tare_needs_a_rest_of_150_ms_on_either_side(missing: int, count: int) -> None:
    side, width = round(0.15 * RATE_HZ), round(4e-3 * RATE_HZ)
    force = np.zeros((2 * (side + width) - missing, 3))
    force[side + width :] = STEP_N
    jumps = find_tare_jumps(log_of(line(np.zeros(len(force))), force=force, noise_n=1e-3))
    assert len(jumps) == count
    for jump in jumps:
        np.testing.assert_allclose(jump.force_n, STEP_N, rtol=0.0, atol=1e-3)
        assert jump.time_s == pytest.approx((side + width) / RATE_HZ, abs=width / RATE_HZ)
