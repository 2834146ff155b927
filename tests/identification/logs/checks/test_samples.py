"""Dead, stuck and saturated axes, deadbands, units: found where they are, and nowhere else."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from autotune.simulation.phases import Program
from autotune.simulation.simulate import simulate_cell
from autotune.simulation.truth import SimulatedCell
from identification.logs.checks.clocks import measure_clock
from identification.logs.checks.samples import frame_faults, pose_faults, turn_faults, wrench_faults
from identification.logs.checks.stamps import stamp_faults
from identification.result import Finding
from identification.signals.constant_runs import find_deadband
from identification.signals.recording import Recording
from problems.arrays import FloatArray
from problems.model.controller import AdmittanceController
from tests.autotune.simulation.runs import SHORT, silent


def wrench(recording: Recording) -> tuple[FloatArray, FloatArray]:
    signal = recording.wrench
    since = (signal.stamp_ns - signal.stamp_ns[0]) * 1e-9
    return np.hstack([signal.force_n, signal.torque_n_m]), since


def pose(recording: Recording) -> tuple[FloatArray, FloatArray]:
    signal = recording.pose
    since = (signal.stamp_ns - signal.stamp_ns[0]) * 1e-9
    return np.hstack([signal.position_m, signal.quaternion_xyzw]), since


def changed(recording: Recording, change: Callable[[FloatArray, FloatArray], None]) -> list[Finding]:
    """Faults of the wrench after `change(values, seconds)` in place."""
    values, since = wrench(recording)
    change(values, since)
    return list(wrench_faults("/ft", values, since))


@pytest.mark.parametrize("h_s", [8e-4, 2e-3, 4e-3])
@pytest.mark.parametrize("mass_kg", [1.0, 16.0, 50.0])
@pytest.mark.parametrize("noisy", [True, False])
def test_a_sound_cell_has_no_fault(h_s: float, mass_kg: float, noisy: bool) -> None:
    slow = AdmittanceController(mass_kg=max(10.0, mass_kg), damping_n_s_per_m=3500.0)
    cell = replace(SimulatedCell(), payload_mass_kg=mass_kg, sample_time_s=h_s, controller=slow)
    recording = simulate_cell(cell if noisy else silent(cell), SHORT, seed=int(mass_kg)).recording
    assert list(wrench_faults("/ft", *wrench(recording))) == []
    assert list(pose_faults("/tcp", *pose(recording))) == []


@pytest.mark.parametrize("step", [0.01, 0.1])
def test_a_quantised_sensor_is_neither_stuck_nor_saturated(demo_recording: Recording, step: float) -> None:
    def rounded(values: FloatArray, _: FloatArray) -> None:
        values[:] = np.round(values / step) * step

    assert [each.code for each in changed(demo_recording, rounded) if each.severity == "error"] == []


def test_steps_coarser_than_the_noise_are_reported(demo_recording: Recording) -> None:
    def rounded(values: FloatArray, _: FloatArray) -> None:
        values[:, 0] = np.round(values[:, 0])

    (found,) = changed(demo_recording, rounded)
    assert (found.code, found.severity) == ("coarse-steps", "warning")
    assert "steps of 1," in found.message


@pytest.mark.parametrize(("start_s", "length_s"), [(10.0, 0.15), (40.0, 5.0), (5.0, 45.0)])
@pytest.mark.parametrize("axis", [1, 5])
def test_an_axis_that_freezes_is_reported_with_its_times(
    demo_recording: Recording, start_s: float, length_s: float, axis: int
) -> None:
    def freeze(values: FloatArray, since: FloatArray) -> None:
        inside = (since >= start_s) & (since < start_s + length_s)
        values[inside, axis] = values[inside, axis][0]

    (found,) = changed(demo_recording, freeze)
    assert (found.code, found.severity) == ("stuck-axis", "error")
    assert ("force y", "torque z")[axis == 5] in found.message
    first, last = (float(text) for text in found.message.split(": ")[1].removesuffix(" s.").split(" to "))
    # The stamps are 0.8 ms apart and written to a millisecond.
    assert first == pytest.approx(start_s, abs=2e-3)
    assert last == pytest.approx(start_s + length_s, abs=2e-3)


def test_a_driver_that_dies_freezes_every_axis(demo_recording: Recording) -> None:
    def freeze(values: FloatArray, since: FloatArray) -> None:
        values[since >= 60.0] = values[np.flatnonzero(since >= 60.0)[0]]

    found = changed(demo_recording, freeze)
    assert [each.code for each in found] == ["stuck-axis"] * 6


def test_a_dead_axis_is_reported(demo_recording: Recording) -> None:
    def kill(values: FloatArray, _: FloatArray) -> None:
        values[:, 3] = 0.0

    (found,) = changed(demo_recording, kill)
    assert (found.code, found.severity) == ("stuck-axis", "error")
    assert "torque x axis of topic /ft is 0 in all" in found.message


@pytest.mark.parametrize("step", [0.0, 0.1])
def test_a_stuck_maximum_is_saturation(demo_recording: Recording, step: float) -> None:
    level = -30.0

    def clip(values: FloatArray, _: FloatArray) -> None:
        column = np.round(values[:, 0] / step) * step if step else values[:, 0]
        values[:, 0] = np.maximum(column, level)

    (found,) = [each for each in changed(demo_recording, clip) if each.code == "saturation"]
    values, since = wrench(demo_recording)
    first = float(since[np.flatnonzero(values[:, 0] <= level + 0.5 * step)[0]])
    assert found.severity == "error"
    assert "force x axis" in found.message
    assert "(30)" in found.message
    # Rounding to steps moves the crossing by a sample at most.
    assert float(found.message.split("the first ")[1].split(" s")[0]) == pytest.approx(first, abs=2e-3)


@pytest.mark.parametrize(("moving", "expected"), [(False, []), (True, ["saturation"])])
def test_a_rest_without_noise_is_no_end_of_the_range(moving: bool, expected: list[str]) -> None:
    """Twice up a ramp and a plateau: a limit only if another axis goes on moving meanwhile."""
    ramp = np.tile(np.concatenate([np.linspace(0.0, 9.0, 500), np.full(500, 9.0), np.linspace(9.0, 0.0, 500)]), 2)
    values = ramp[:, None] * np.array([1.0, -0.3, 0.2, 0.1, 0.05, 0.02])
    if moving:
        values[:, 1:] = np.sin(np.arange(len(ramp)) * 0.01)[:, None] * np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    assert [each.code for each in wrench_faults("/ft", values, np.linspace(0.0, 3.0, len(ramp)))] == expected


def test_a_declared_range_is_believed(demo_recording: Recording) -> None:
    values, since = wrench(demo_recording)
    highest = float(np.abs(values[:, 2]).max())
    for limit, expected in ((highest, ["saturation"]), (1.01 * highest, [])):
        found = wrench_faults("/ft", values, since, (None, None, limit, None, None, None))
        assert [each.code for each in found] == expected


@pytest.mark.parametrize("kind", ["threshold", "subtractive"])
@pytest.mark.parametrize("width_n", [2.0, 5.0])
def test_a_deadband_is_found_with_kind_and_width(demo_recording: Recording, kind: str, width_n: float) -> None:
    def cut(values: FloatArray, _: FloatArray) -> None:
        centred = values[:, 0] - np.median(values[:, 0])
        inside = np.abs(centred) < width_n
        left = centred if kind == "threshold" else centred - width_n * np.sign(centred)
        values[:, 0] = np.where(inside, 0.0, left)

    (found,) = changed(demo_recording, cut)
    assert (found.code, found.severity) == ("deadband", "warning")
    assert f"A {kind} deadband" in found.message
    reported = float(found.message.split("roughly ")[1].split(" ")[0])
    # The threshold is seen to a sample's noise, the other only by extrapolating slopes.
    assert reported == pytest.approx(width_n, rel=0.03 if kind == "threshold" else 0.5)


def test_messages_that_repeat_are_reported(demo_recording: Recording) -> None:
    def hold(values: FloatArray, _: FloatArray) -> None:
        values[:] = np.repeat(values[::4], 4, axis=0)[: len(values)]

    (found,) = changed(demo_recording, hold)
    assert (found.code, found.severity) == ("repeated-samples", "warning")
    assert found.message.startswith("75 %")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_reported_with_their_times(demo_recording: Recording, bad: float) -> None:
    def spoil(values: FloatArray, since: FloatArray) -> None:
        values[(since >= 20.0) & (since < 20.01), 4] = bad

    (found,) = changed(demo_recording, spoil)
    assert (found.code, found.severity) == ("not-finite", "error")
    assert "the first 20.000 s and the last 20.0" in found.message


def test_a_pose_in_millimetres_is_reported(demo_recording: Recording) -> None:
    values, since = pose(demo_recording)
    values[:, :3] *= 1e3
    assert [(each.code, each.severity) for each in pose_faults("/tcp", values, since)] == [("length-unit", "error")]


@pytest.mark.parametrize(
    ("offset_m", "travel_m", "severities"),
    [
        (9.0, 0.5, []),
        (9.9, 19.7, []),
        (11.0, 0.5, []),
        (49.0, 0.5, []),
        (51.0, 0.5, ["warning"]),
        (9.0, 20.5, ["error"]),
    ],
)
def test_a_pose_may_be_far_away_and_may_not_travel_far(
    demo_recording: Recording, offset_m: float, travel_m: float, severities: list[str]
) -> None:
    values, since = pose(demo_recording)
    place = values[:, 0] - np.min(values[:, 0])
    values[:, 0] = offset_m - travel_m * place / np.max(place)
    assert [each.severity for each in pose_faults("/tcp", values, since)] == severities


def test_a_pose_that_never_changes_is_no_measurement(demo_recording: Recording) -> None:
    values, since = pose(demo_recording)
    values[:] = values[0]
    assert [each.code for each in pose_faults("/tcp", values, since)] == ["stuck-pose"]


def test_a_turn_beyond_a_whole_one_is_in_degrees() -> None:
    turns = np.array([[0.0, 0.1, 3.1], [170.0, 0.0, 0.0], [0.0, 0.0, 0.2]])
    (found,) = turn_faults("/js", turns, np.array([0.0, 0.5, 1.0]))
    assert (found.code, found.severity) == ("turn-unit", "error")
    assert "the first 0.500 s" in found.message
    assert list(turn_faults("/js", turns[[0, 2]], np.array([0.0, 1.0]))) == []


def test_a_frame_that_changes_is_reported() -> None:
    assert list(frame_faults("/ft", ("tool0",))) == []
    assert [each.code for each in frame_faults("/ft", ("base", "tool0"))] == ["several-frames"]


def test_programs_without_motion_raise_no_alarm() -> None:
    quiet = Program(pose_count=1, jogging_s=0.0, sweep_s=0.0, contact_count=0)
    recording = simulate_cell(SimulatedCell(), quiet, seed=2).recording
    assert list(wrench_faults("/ft", *wrench(recording))) == []


@pytest.mark.parametrize(("bag", "offset_s"), [("single_mode_middle", -2745.5), ("yellow_table_1", -53.9)])
def test_a_real_log_has_its_deadband_and_nothing_else(shared_data: Path, bag: str, offset_s: float) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    stamps, logged, efforts, turns = [], [], [], []
    with Reader(shared_data / "nj60" / f"{bag}.bag") as reader:
        for connection, recorded_ns, raw in reader.messages():
            if connection.topic == "/robot_state":
                message: Any = store.deserialize_ros1(raw, connection.msgtype)
                stamps.append(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)
                logged.append(recorded_ns)
                efforts.append(message.effort)
                turns.append(message.position[3:6])
    stamp_ns, log_ns = np.array(stamps), np.array(logged)
    since = (log_ns - log_ns[0]) * 1e-9
    found = list(wrench_faults("/robot_state", np.array(efforts), since))
    # Its README: gravity removed and a subtractive deadband applied, on all six axes.
    assert [each.code for each in found] == ["deadband"] * 6
    assert all("A subtractive deadband" in each.message for each in found)
    assert list(stamp_faults("/robot_state", stamp_ns, since)) == []
    assert list(turn_faults("/robot_state", np.array(turns), since)) == []
    clock = measure_clock("/robot_state", stamp_ns, log_ns)
    assert clock is not None
    assert clock.offset_s == pytest.approx(offset_s, abs=0.1)
    assert clock.jumps == ()


def test_an_axis_with_a_single_value_beside_zero_has_a_deadband() -> None:
    """One blow in a log whose force stays within the band otherwise: between a single value there is no step."""
    found = find_deadband(np.eye(1, 400, 200)[0])
    assert found is not None
    assert (found.kind, found.width, found.zero_share) == ("subtractive", None, 399 / 400)
