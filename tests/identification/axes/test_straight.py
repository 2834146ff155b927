"""Which axis of the sensor a motion went along, and who made it."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from autotune.simulation.phases import Program
from autotune.simulation.simulate import CellRun, simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.axes.straight import (
    AxisMotion,
    commanded_motion,
    find_axes,
    find_ringing,
    free_motions,
    unguided_spans,
)
from identification.errors import EstimateError
from identification.joint_fit import fit as joint_fit
from identification.joint_fit.fit import identify_joint
from identification.joint_fit.free_motion import fit_ringing
from identification.signals.aligned import AlignedLog
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from identification.signals.segments import Span, find_motion
from problems.arrays import FloatArray, IntArray
from problems.progress import ProgressSlice
from tests.identification.joint_fit.test_fit import gathered, scores
from tests.identification.synthetic import Load, felt_force, ramp, tapered

RATE_HZ = 500.0
H_S = 1.0 / RATE_HZ
ORIENTATION = Rotation.from_euler("xyz", [2.8, 0.3, 0.7])
MS = 1e-3
# A sweep that ends far below the payload's own 22 Hz tells its mass and little of the spring.
SLOW_SWEEP = Program(jogging_s=0.0, sweep_hz=(0.4, 6.0), contact_count=0, pose_count=5)
TAPPED = dataclasses.replace(SLOW_SWEEP, tap_count=3)


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


def pose(stamps: IntArray, along_m: FloatArray) -> PoseSignal:
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


def ringing(start: int, samples: int, amplitude: float) -> "np.ndarray[tuple[int], np.dtype[np.float64]]":
    """A decaying oscillation of 20 Hz from `start` on, nothing before."""
    t = np.maximum(np.arange(samples) - start, 0) * MS
    return np.asarray(amplitude * np.exp(-8.0 * t) * np.sin(2.0 * np.pi * 20.0 * t))


def on_axis(force: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> AxisMotion:
    return AxisMotion(name="x", direction_B=np.eye(3)[0], position_m=np.zeros(len(force)), force_n=force, spans=())


def test_a_ring_begins_when_the_tap_is_over_and_ends_before_the_next() -> None:
    force = ringing(1000, 4000, 40.0) + ringing(2000, 4000, 30.0)
    first, second = find_ringing(on_axis(force), [Span(start=990, stop=3000)], [], [], 0.1, MS)
    # The highest force comes a quarter of a period (12 ms) after each beginning; 25 ms later a hand is off.
    assert first.start == pytest.approx(1000 + 12 + 25, abs=3)
    assert first.stop == pytest.approx(2000 + 12 - 25, abs=3)
    assert second.start == pytest.approx(2000 + 12 + 25, abs=3)


def test_what_is_free_anyway_or_no_louder_than_noise_is_not_reported_twice() -> None:
    span = Span(start=990, stop=3000)
    assert find_ringing(on_axis(ringing(1000, 4000, 40.0)), [span], [span], [], 0.1, MS) == ()
    assert find_ringing(on_axis(ringing(1000, 4000, 0.5)), [span], [], [], 0.1, MS) == ()


def test_after_a_hold_the_payload_is_free_where_the_force_changes_its_sign() -> None:
    force = np.concatenate([np.full(1000, -20.0), np.linspace(-20.0, 5.0, 500), np.full(1000, 5.0)])
    (ring,) = find_ringing(on_axis(force), [Span(start=1000, stop=2400)], [], [Span(start=200, stop=1000)], 0.1, MS)
    assert ring.start == 1000 + round(500 * 20.0 / 25.0) + 25
    assert ring.stop == 2400
    pressed = np.full(2500, -20.0)
    assert (
        find_ringing(on_axis(pressed), [Span(start=1000, stop=2400)], [], [Span(start=200, stop=1000)], 0.1, MS) == ()
    )


@pytest.fixture(scope="module")
def tapped() -> CellRun:
    return simulate_cell(SimulatedCell(), TAPPED, seed=5)


def test_taps_show_the_spring_where_a_slow_sweep_does_not(tapped: CellRun) -> None:
    slow = identify_joint(gathered(simulate_cell(SimulatedCell(), SLOW_SWEEP, seed=5).recording))
    fit = identify_joint(gathered(tapped.recording))
    # 4.4 deviations: the quantile of 1e-4 for six values.
    for found in (slow, fit):
        assert np.max(np.abs(scores(found, SimulatedCell()))) < 4.4
    assert (fit.quality.free_spans, fit.quality.contacts) == (1 + TAPPED.tap_count, 0)
    for name, gain in (("stiffness_n_per_m", 3.0), ("damping_n_s_per_m", 50.0)):
        assert fit.value(name)[1] < slow.value(name)[1] / gain


def test_a_delay_of_whole_samples_is_not_surer_than_its_two_readings_allow(tapped: CellRun) -> None:
    """The demo's delay is 3 samples: the force may be read before or after the command's step."""
    fit = identify_joint(gathered(tapped.recording))
    period = tapped.cell.sample_time_s
    delay, std = fit.value("delay_s")
    assert abs(delay - 3.0 * period) < 4.4 * std
    assert std >= 1e-3 * period


def test_taps_alone_show_the_spring_with_the_mass_from_gravity() -> None:
    """Taps and contacts, and no free motion that shows the payload's mass: the weight stands in for it."""
    cell = SimulatedCell()
    data = gathered(simulate_cell(cell, dataclasses.replace(TAPPED, contact_count=3), seed=5).recording)
    data = dataclasses.replace(data, free=(), weighed=(cell.payload_mass_kg, 2e-3 * cell.payload_mass_kg))
    fit = joint_fit._identify(data, fit_ringing, ProgressSlice())
    assert np.max(np.abs(scores(fit, cell))) < 4.4
    assert fit.value("stiffness_n_per_m")[1] < 5e-3 * cell.coupling.stiffness_n_per_m
    # One tap is no witness.
    with pytest.raises(EstimateError, match="No two spans"):
        joint_fit._identify(dataclasses.replace(data, rings=data.rings[:1]), fit_ringing, ProgressSlice())


def test_where_free_motion_shows_nothing_taps_are_asked() -> None:
    cell = SimulatedCell()
    data = gathered(simulate_cell(cell, dataclasses.replace(TAPPED, contact_count=3), seed=5).recording)
    deaf = dataclasses.replace(data, free=(), coupling=np.array([5e6, 0.0, 0.0, 1.0]))
    with pytest.raises(EstimateError):
        identify_joint(deaf)
    fit = identify_joint(dataclasses.replace(deaf, weighed=(cell.payload_mass_kg, 2e-3 * cell.payload_mass_kg)))
    assert fit.is_weighed
    assert fit.value("stiffness_n_per_m")[0] == pytest.approx(cell.coupling.stiffness_n_per_m, rel=0.01)
