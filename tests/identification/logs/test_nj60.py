"""The recorded bags and traces of the NJ60 cell, read with the cell files that ship as examples."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from autotune.formats.cell import read_cell
from identification.errors import EstimateError
from identification.identify import identify_cell
from identification.logs.inspect import inspect_log
from identification.logs.read import read_checked_recording, read_recording
from identification.logs.roles.cell import Cell, PoseSource
from identification.signals.recording import Recording
from identification.touches.trace import identify_trace

BAGS = ("single_mode_middle.bag", "yellow_table_1.bag")
Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def cell(repository: Path) -> Cell:
    return read_cell(repository / "examples" / "nj60" / "cell.yaml").cell


@pytest.fixture(scope="module")
def traces(repository: Path) -> Cell:
    return read_cell(repository / "examples" / "nj60" / "traces.yaml").cell


@pytest.fixture(scope="module")
def recordings(shared_data: Path, cell: Cell) -> dict[str, Recording]:
    return {name: read_recording(shared_data / "nj60" / name, cell) for name in BAGS}


def rotated(orientation: Rotation, vectors: Array) -> Array:
    return np.asarray(orientation.apply(np.array(vectors)))


@pytest.mark.parametrize("name", BAGS)
def test_numbers_are_those_of_another_reader(shared_data: Path, recordings: dict[str, Recording], name: str) -> None:
    recording = recordings[name]
    with AnyReader([shared_data / "nj60" / name]) as reader:
        messages: dict[str, list[Any]] = {
            topic: [
                reader.deserialize(data, connection.msgtype)
                for connection, _, data in reader.messages()
                if connection.topic == topic
            ]
            for topic in ("/robot_state", "/impedance_gains")
        }
    state = messages["/robot_state"]
    position = np.array([message.position for message in state])
    effort = np.array([message.effort for message in state])
    velocity = np.array([message.velocity[:6] for message in state])
    gains = np.array([message.effort for message in messages["/impedance_gains"]])
    assert np.array_equal(recording.pose.position_m, position[:, :3])
    assert np.array_equal(recording.wrench.force_n, -effort[:, :3])
    assert np.array_equal(recording.wrench.torque_n_m, -effort[:, 3:])
    assert recording.twist is not None
    assert np.array_equal(recording.twist.linear_m_s, velocity[:, :3])
    assert recording.gains is not None
    assert np.array_equal(recording.gains.mass, gains[:, :6])
    assert recording.desired_force is not None
    assert np.array_equal(recording.desired_force.force_n, gains[:, 6:9])


@pytest.mark.parametrize("name", BAGS)
def test_the_tool_points_down_and_moves_with_the_force_on_every_axis(
    recordings: dict[str, Recording], name: str
) -> None:
    recording = recordings[name]
    orientation = Rotation.from_quat(recording.pose.quaternion_xyzw)
    tilt = np.degrees(np.arccos(-rotated(orientation, np.tile([0.0, 0.0, 1.0], (len(orientation), 1)))[:, 2]))
    assert np.max(tilt) < 3.0
    assert np.max(np.linalg.norm(np.diff(recording.pose.quaternion_xyzw, axis=0), axis=1)) < 0.01
    # The controller moves with the force behind a lag of about 0.1 s and a delay of as much.
    assert recording.twist is not None
    force = rotated(orientation, recording.wrench.force_n)
    period = float(np.median(np.diff(recording.wrench.stamp_ns))) * 1e-9
    smooth = lfilter([1.0 - np.exp(-period / 0.1)], [1.0, -np.exp(-period / 0.1)], force, axis=0)
    late = round(0.08 / period)
    for axis in range(3):
        velocity = recording.twist.linear_m_s[late:, axis]
        assert np.corrcoef(smooth[:-late, axis], velocity)[0, 1] > 0.8


def test_the_twist_confirms_the_sequence_of_the_angles_and_refutes_others(
    shared_data: Path, cell: Cell, recordings: dict[str, Recording]
) -> None:
    def reported(recording: Recording) -> list[str]:
        return [finding.code for finding in recording.findings if finding.severity != "info"]

    path = shared_data / "nj60" / "yellow_table_1.bag"
    assert "twist-disagrees" not in reported(recordings[path.name])
    for kind in ("rotation_vector", "euler_xyz", "euler_zyz"):
        wrong = replace(cell, pose=replace(cell.pose or PoseSource(), orientation_as=kind))
        assert "twist-disagrees" in reported(read_recording(path, wrong))
    # Formed with a period of 4 ms where 5.11 ms passed.
    other = [f.message for f in recordings[BAGS[0]].findings if f.code == "twist-disagrees"]
    assert any("translation" in message and "times 0.782 it fits within 1 %" in message for message in other)


@pytest.mark.parametrize("name", BAGS)
def test_what_was_done_before_recording_is_known(recordings: dict[str, Recording], name: str) -> None:
    recording = recordings[name]
    assert recording.wrench.gravity_compensated
    assert recording.wrench.deadband is not None
    assert recording.wrench.deadband.type == "subtractive"
    assert set(recording.clocks.values()) == {"header"}
    found = identify_cell(recording)
    (removed,) = (f for f in found.findings if f.code == "gravity-removed")
    assert "Gravity is already removed from the force of topic /robot_state" in removed.message
    assert removed.severity == "error"
    assert found.payload.mass_kg.value is None


def test_axes_whose_force_never_leaves_the_deadband_crash_nothing(shared_data: Path, cell: Cell) -> None:
    """Turning about z is asked of nothing throughout; a warning would be an error here."""
    found = identify_cell(read_recording(shared_data / "nj60" / "acc_rail_slide.bag", cell))
    assert found.payload.mass_kg.value is None


@pytest.mark.parametrize("name", ["acc_rail_slide.bag", "hard_low_1.bag"])
def test_compensation_that_is_not_declared_is_suspected(shared_data: Path, cell: Cell, name: str) -> None:
    assert cell.wrench is not None
    undeclared = replace(cell, wrench=replace(cell.wrench, gravity_compensated=None))
    recording = read_checked_recording(shared_data / "nj60" / name, undeclared)
    with pytest.raises(EstimateError, match=r"gravity was taken off before recording, say so with .*compensated: true"):
        identify_cell(recording)


def test_clocks_are_reported_to_be_off(shared_data: Path, cell: Cell) -> None:
    summary = inspect_log(shared_data / "nj60" / "yellow_table_1.bag", cell)
    assert any("53.938 s ahead of the recording clock" in finding.message for finding in summary.findings)
    assert not [finding for finding in summary.findings if finding.severity == "error"]
    assert {role.entry: role.topic for role in summary.roles}["gains"] == "/impedance_gains"


@pytest.mark.parametrize(
    ("name", "peak_n", "secant_n_per_mm", "printed_n_per_mm"),
    [("yellow_feet_imco.csv", 55.6, 11.1, 11.2), ("flex_jt_imco.csv", 34.4, 2.62, 2.7)],
)
def test_traces_have_the_published_peak_and_stiffness(
    shared_data: Path, traces: Cell, name: str, peak_n: float, secant_n_per_mm: float, printed_n_per_mm: float
) -> None:
    recording = read_recording(shared_data / "nj60" / name, traces)
    depth, force = recording.pose.position_m[:, 2], -recording.wrench.force_n[:, 2]
    assert recording.pose.measured_axes == recording.wrench.measured_axes == ("z",)
    assert np.max(force) == pytest.approx(peak_n, abs=0.05)
    # Told to three digits, by a fit whose details are not.
    assert depth @ force / (depth @ depth) / 1e3 == pytest.approx(secant_n_per_mm, rel=0.01)
    (surface,) = identify_cell(recording).axes["z"].environments
    assert surface.peak_force_n == pytest.approx((peak_n,), abs=0.1)
    # What is printed is the secant of the whole trace, the hold with the loading.
    whole = identify_trace(depth, force, 1e-3)
    assert whole.secant_n_per_m == pytest.approx(printed_n_per_mm * 1e3, rel=0.03)
    assert surface.stiffness_n_per_m.value is None
