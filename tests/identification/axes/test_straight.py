"""Which axis of the sensor a motion went along, and who made it."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from identification.axes.straight import AxisMotion, commanded_motion, find_axes, free_motions, unguided_spans
from identification.errors import EstimateError
from identification.signals.aligned import AlignedLog
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from identification.signals.segments import Span, find_motion
from tests.identification.synthetic import Load, felt_force, ramp, tapered

FloatArray = NDArray[np.float64]

RATE_HZ = 500.0
H_S = 1.0 / RATE_HZ
ORIENTATION = Rotation.from_euler("xyz", [2.8, 0.3, 0.7])


def log_of(position_S_m: FloatArray, orientation: Rotation | None = None) -> AlignedLog:
    """A log whose motion is given along the axes of a sensor that does not turn."""
    n = len(position_S_m)
    return AlignedLog(
        start_ns=10**18,
        period_s=H_S,
        time_s=np.asarray(np.arange(n) * H_S, dtype=np.float64),
        force_S_n=np.zeros((n, 3)),
        torque_S_n_m=np.zeros((n, 3)),
        position_B_m=ORIENTATION.apply(position_S_m),
        orientation_BS=Rotation.concatenate([ORIENTATION] * n) if orientation is None else orientation,
        pose_rate_hz=RATE_HZ,
    )


def there_and_back(direction_S: FloatArray, distance_m: float = 0.04) -> FloatArray:
    """Rest, out, rest, back, rest."""
    out, rest = ramp(500), np.ones(400)
    profile = np.concatenate([0.0 * rest, out, rest, out[::-1], 0.0 * rest])
    return np.outer(profile, distance_m * np.asarray(direction_S))


@pytest.mark.parametrize("index", [0, 1, 2])
def test_a_motion_is_assigned_to_its_axis(index: int) -> None:
    log = log_of(there_and_back(np.eye(3)[index]))
    force = np.arange(3.0 * len(log)).reshape(-1, 3)
    travel = find_axes(log, find_motion(log), force)
    (axis,) = travel.axes
    assert axis.name == "xyz"[index]
    assert len(axis.spans) == 2
    assert travel.oblique_share == 0.0
    np.testing.assert_allclose(axis.direction_B, ORIENTATION.as_matrix()[:, index], rtol=0.0, atol=1e-9)
    assert np.ptp(axis.position_m) == pytest.approx(0.04, rel=1e-6)
    np.testing.assert_array_equal(axis.force_n, force[:, index])


def test_motions_along_two_axes_are_kept_apart() -> None:
    log = log_of(np.concatenate([there_and_back(np.eye(3)[0]), there_and_back(np.eye(3)[2])]))
    travel = find_axes(log, find_motion(log), np.zeros((len(log), 3)))
    assert [axis.name for axis in travel.axes] == ["x", "z"]
    assert [len(axis.spans) for axis in travel.axes] == [2, 2]


def test_motion_between_the_axes_is_used_by_none_and_counted() -> None:
    log = log_of(there_and_back(np.array([0.6, 0.8, 0.0])))
    travel = find_axes(log, find_motion(log), np.zeros((len(log), 3)))
    assert travel.axes == ()
    assert travel.oblique_share == pytest.approx(1.0, abs=1e-6)


def test_motion_while_turning_is_used_by_none() -> None:
    position = there_and_back(np.eye(3)[0])
    angle = position[:, :1] * 20.0
    log = log_of(position, ORIENTATION * Rotation.from_rotvec(angle * np.eye(3)[1]))
    assert find_axes(log, find_motion(log), np.zeros((len(log), 3))).axes == ()


def test_motion_of_a_millimetre_is_no_travel() -> None:
    log = log_of(there_and_back(np.eye(3)[0], 1.5e-3))
    assert find_axes(log, find_motion(log), np.zeros((len(log), 3))).axes == ()


def axis_of(position: FloatArray, force: FloatArray, *spans: Span) -> AxisMotion:
    return AxisMotion(name="x", direction_B=np.array([1.0, 0.0, 0.0]), position_m=position, force_n=force, spans=spans)


def test_a_span_in_which_a_hand_did_work_is_left_out() -> None:
    samples = 2500
    t = np.arange(samples) * H_S
    position = 0.02 * np.sin(2.0 * np.pi * 0.8 * t) * tapered(samples, 500)
    load = Load(drag=300.0)
    passive = felt_force(position, H_S, load)
    # A hand that moves flange and payload along: it gives what the payload's drag takes, and more.
    velocity = np.gradient(position, H_S)
    led = felt_force(position, H_S, load, 900.0 * velocity)
    whole = Span(start=0, stop=samples)
    assert unguided_spans(axis_of(position, passive, whole)) == (whole,)
    assert unguided_spans(axis_of(position, led, whole)) == ()


def test_free_motions_take_a_little_rest_along() -> None:
    axis = axis_of(np.arange(1000.0), -np.arange(1000.0), Span(start=300, stop=500), Span(start=980, stop=1000))
    first, last = free_motions(axis, axis.spans, H_S)
    assert first.position_m[0] == 300 - 60  # 0.12 s at 500 Hz
    assert first.position_m[-1] == 500 + 60 - 1
    assert last.position_m[-1] == 999
    np.testing.assert_array_equal(first.force_n, -first.position_m)


def pose(stamps: NDArray[np.int64], along_m: FloatArray) -> PoseSignal:
    turns = np.tile(ORIENTATION.as_quat(), (len(stamps), 1))
    position = ORIENTATION.apply(np.outer(along_m, np.eye(3)[1]))
    return PoseSignal(topic="/p", frame_id="base", stamp_ns=stamps, position_m=position, quaternion_xyzw=turns)


def commanded(shift_ns: int = 0) -> tuple[Recording, PoseSignal, AlignedLog, AxisMotion]:
    position_S = there_and_back(np.eye(3)[1])
    log = log_of(position_S)
    stamps = log.start_ns + np.round(log.time_s * 1e9).astype(np.int64)
    along = position_S[:, 1]
    every = stamps[::2] + 300_000 + shift_ns
    command = pose(every, np.interp(every - stamps[0], stamps - stamps[0], along))
    wrench = WrenchSignal(
        topic="/w", frame_id="ft", stamp_ns=stamps, force_n=log.force_S_n, torque_n_m=log.torque_S_n_m
    )
    recording = Recording(wrench=wrench, pose=pose(stamps, along), command=command)
    (axis,) = find_axes(log, find_motion(log), log.force_S_n).axes
    return recording, command, log, axis


def test_command_and_measurement_are_compared_at_the_commands_stamps() -> None:
    moved = commanded_motion(*commanded())
    assert moved.period_s == pytest.approx(2.0 * H_S, rel=1e-9)
    assert np.ptp(moved.command_m) == pytest.approx(0.04, rel=1e-3)
    # The same path on both: linear interpolation of the command errs by h²/8 of 0.4 m/s², far below a micrometre.
    np.testing.assert_allclose(moved.position_m, moved.command_m, rtol=0.0, atol=1e-6)
    # From rest to rest, with 0.3 s on both sides, and nothing of the rest of the log.
    assert len(moved.command_m) * moved.period_s < len(commanded()[2]) * H_S - 0.5


def test_a_command_from_another_time_is_refused_in_words() -> None:
    with pytest.raises(EstimateError, match=r"`/p`.*clock"):
        commanded_motion(*commanded(shift_ns=10**12))


def test_a_command_that_covers_half_of_the_motion_is_refused() -> None:
    recording, command, log, axis = commanded()
    half = len(command.stamp_ns) // 2
    part = PoseSignal(
        topic="/p",
        frame_id="base",
        stamp_ns=command.stamp_ns[:half],
        position_m=command.position_m[:half],
        quaternion_xyzw=command.quaternion_xyzw[:half],
    )
    with pytest.raises(EstimateError, match=r"must cover the .* s in which the tool moves"):
        commanded_motion(recording, part, log, axis)
