"""Rest and motion on logs whose motion is written down."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import binary_closing, binary_opening
from scipy.spatial.transform import Rotation

from identification.signals.aligned import AlignedLog
from identification.signals.segments import Span, find_motion, low_pass, without_pauses, without_short
from problems.arrays import FloatArray
from tests.identification.synthetic import ramp

RATE_HZ = 500.0


def log_of(
    position: FloatArray,
    *,
    force: FloatArray | None = None,
    orientation: Rotation | None = None,
    noise_n: float = 0.1,
) -> AlignedLog:
    n = len(position)
    shown = noise_n * np.random.default_rng(1).standard_normal((n, 3)) + (0.0 if force is None else force)
    return AlignedLog(
        start_ns=0,
        period_s=1.0 / RATE_HZ,
        time_s=np.arange(n) / RATE_HZ,
        force_S_n=shown,
        torque_S_n_m=np.zeros((n, 3)),
        position_B_m=position,
        orientation_BS=Rotation.identity(n) if orientation is None else orientation,
        pose_rate_hz=RATE_HZ,
    )


def line(*pieces: FloatArray) -> FloatArray:
    """Positions along x of the base."""
    x = np.concatenate(pieces)
    return np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])


def moved(seconds: float, distance_m: float) -> FloatArray:
    return distance_m * ramp(round(seconds * RATE_HZ))


def held(seconds: float, at_m: float = 0.0) -> FloatArray:
    return np.full(round(seconds * RATE_HZ), at_m)


def test_a_move_between_two_rests_is_found() -> None:
    motion = find_motion(log_of(line(held(1.0), moved(1.0, 0.1), held(1.0, 0.1))))
    assert len(motion.still) == 2
    (span,) = motion.moving
    # 1.5 mm/s is passed 60 ms after a minimum-jerk move of 0.1 m/s² began; 25 Hz smear it by 20 ms.
    assert span.start / RATE_HZ == pytest.approx(1.0, abs=0.1)
    assert span.stop / RATE_HZ == pytest.approx(2.0, abs=0.1)


def test_turning_on_the_spot_is_motion() -> None:
    angle = np.concatenate([held(1.0), moved(1.0, 0.8), held(1.0, 0.8)])
    turns = Rotation.from_rotvec(np.column_stack([angle, np.zeros_like(angle), np.zeros_like(angle)]))
    motion = find_motion(log_of(np.zeros((len(angle), 3)), orientation=turns))
    assert len(motion.still) == 2
    assert len(motion.moving) == 1


def test_vibration_faster_than_the_speed_estimate_is_no_rest() -> None:
    """0.02 mm at 60 Hz are 7.5 mm/s, which a low pass at 25 Hz hides; 16 kg behind it shake the force by 45 N."""
    t = np.arange(round(3.0 * RATE_HZ)) / RATE_HZ
    shaking = (t > 1.0) & (t < 2.0)
    wave = np.where(shaking, np.sin(2.0 * np.pi * 60.0 * t), 0.0)
    position = line(2e-5 * wave)
    silent, shaken = (find_motion(log_of(position, force=amplitude * wave[:, None])) for amplitude in (0.0, 45.0))
    assert len(silent.still) == 1  # the speed alone does not show it
    assert len(shaken.still) == 2
    inside = [s for s in shaken.still if s.start / RATE_HZ < 1.9 and s.stop / RATE_HZ > 1.1]
    assert inside == []


def test_a_reversal_is_part_of_the_motion() -> None:
    t = np.arange(round(3.0 * RATE_HZ)) / RATE_HZ
    motion = find_motion(log_of(line(held(1.0), 0.02 * (1.0 - np.cos(2.0 * np.pi * t)), held(1.0))))
    assert len(motion.moving) == 1


def test_a_short_stop_is_no_rest() -> None:
    stop = find_motion(
        log_of(line(held(1.0), moved(0.6, 0.05), held(0.3, 0.05), 0.05 + moved(0.6, 0.05), held(1.0, 0.1)))
    )
    rest = find_motion(
        log_of(line(held(1.0), moved(0.6, 0.05), held(0.8, 0.05), 0.05 + moved(0.6, 0.05), held(1.0, 0.1)))
    )
    assert len(stop.still) == 2
    assert len(rest.still) == 3


def test_velocity_is_reported_in_the_sensor_frame() -> None:
    position = line(held(0.5), moved(1.0, 0.1), held(0.5, 0.1))
    quarter = Rotation.from_rotvec(np.tile([0.0, 0.0, np.pi / 2.0], (len(position), 1)))
    velocity = find_motion(log_of(position, orientation=quarter)).velocity_S_m_s
    fastest = int(np.argmax(np.linalg.norm(velocity, axis=1)))
    # 15/8 of the mean speed at the middle of a minimum-jerk move; along +x of the base is along −y of the sensor.
    np.testing.assert_allclose(velocity[fastest], [0.0, -0.1 * 15.0 / 8.0, 0.0], rtol=0.0, atol=2e-3)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(0.05, 1.0), st.floats(-0.1, 0.1)), min_size=1, max_size=6))
def test_every_sample_is_either_rest_or_motion(pieces: list[tuple[float, float]]) -> None:
    parts, here = [held(0.5)], 0.0
    for seconds, distance in pieces:
        parts += [here + moved(seconds, distance), held(seconds, here + distance)]
        here += distance
    log = log_of(line(*parts))
    motion = find_motion(log)
    count = np.zeros(len(log), dtype=int)
    for span in motion.still + motion.moving:
        count[span.slice] += 1
    assert np.all(count == 1)
    assert all(len(span) >= round(0.4 * RATE_HZ) for span in motion.still)


def test_the_low_pass_keeps_phase_and_slow_signals() -> None:
    t = np.arange(2000) / RATE_HZ
    slow, fast = np.sin(2.0 * np.pi * 2.0 * t), np.sin(2.0 * np.pi * 100.0 * t)
    kept = low_pass(slow + fast, 1.0 / RATE_HZ, 25.0)
    # Third order, twice: (2/25)^6 of the slow wave is lost, (25/100)^6 of the fast one is left.
    assert np.max(np.abs(kept - slow)[200:-200]) < 1e-3


def with_hole(log: AlignedLog, start_s: float, stop_s: float) -> AlignedLog:
    hole = Span(start=round(start_s * RATE_HZ), stop=round(stop_s * RATE_HZ))
    force, position = log.force_S_n.copy(), log.position_B_m.copy()
    force[hole.slice] = position[hole.slice] = np.nan
    return replace(log, force_S_n=force, position_B_m=position, holes=(hole,))


@pytest.mark.parametrize("at_s", [0.5, 1.6, 2.05, 2.6, 4.3])
@pytest.mark.parametrize("length_s", [0.03, 0.14, 0.7])
def test_no_span_holds_a_hole_and_the_rest_of_the_log_is_as_before(at_s: float, length_s: float) -> None:
    log = log_of(line(held(1.5), moved(1.0, 0.05), held(1.5, 0.05), 0.05 + moved(1.0, 0.05), held(1.5, 0.1)))
    holed = with_hole(log, at_s, at_s + length_s)
    (hole,) = holed.holes
    motion, usual = find_motion(holed), find_motion(log)
    margin = round(0.15 * RATE_HZ)
    for span in motion.still:
        assert span.stop <= hole.start or span.start >= hole.stop
    for span in motion.moving:
        assert span.stop <= hole.start - margin or span.start >= hole.stop + margin
    near = round(0.5 * RATE_HZ)
    for mine, theirs in ((motion.still, usual.still), (motion.moving, usual.moving)):
        far = [s for s in theirs if s.stop < hole.start - near or s.start > hole.stop + near]
        assert {*far} <= {*mine}


def test_a_filter_does_not_see_across_a_hole() -> None:
    t = np.arange(2000) / RATE_HZ
    values = np.column_stack([np.sin(2.0 * np.pi * 2.0 * t), t])
    values[900:1000] = np.nan
    thrown = values + 100.0 * (np.arange(2000) >= 1000)[:, None]
    first, second = (low_pass(each, 1.0 / RATE_HZ, 25.0) for each in (values, thrown))
    np.testing.assert_array_equal(first[:900], second[:900])
    np.testing.assert_array_equal(first[:900], low_pass(values[:900], 1.0 / RATE_HZ, 25.0))
    assert np.all(np.isnan(first[900:1000]))
    assert np.all(np.isfinite(first[1000:]))


def test_a_span_is_an_index() -> None:
    span = Span(start=3, stop=7)
    assert len(span) == 4
    assert list(np.arange(10)[span.slice]) == [3, 4, 5, 6]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 12)), min_size=1, max_size=20), st.integers(1, 10))
def test_pauses_and_short_stretches_are_those_of_mathematical_morphology(
    runs: list[tuple[bool, int]], length: int
) -> None:
    mask = np.concatenate([np.full(count, value) for value, count in runs])
    # Beyond its ends the line goes on without the mask.
    padded = np.pad(mask, 2 * length + 1)
    closed = binary_closing(padded, structure=np.ones(length + 1))[2 * length + 1 : -2 * length - 1]
    np.testing.assert_array_equal(without_pauses(mask, length), closed)
    np.testing.assert_array_equal(without_short(mask, length), binary_opening(mask, structure=np.ones(length)))
