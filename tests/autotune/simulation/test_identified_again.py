"""identify ∘ simulate = identity, within what the estimates claim."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation, Slerp

from autotune.simulation.simulate import CellRun
from autotune.simulation.truth import SimulatedCell
from identification.identify import identify_cell
from identification.payload.static_poses import GRAVITY_B_M_S2
from identification.result import AxisEstimate, Estimate, Identified, Status
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from tests.autotune.simulation.runs import demo_run, heavy_run, silent_demo_run

# What the project promises for its demo log.
PROMISED = 0.05
# Beyond five of its own deviations an estimate contradicts itself: once in two million for Gaussian errors.
DEVIATIONS = 5.0


def close(estimate: Estimate, truth: float, *, within: float = PROMISED) -> None:
    assert estimate.status is Status.IDENTIFIED
    assert estimate.value is not None
    assert estimate.std is not None
    assert estimate.value == pytest.approx(truth, rel=within)
    assert abs(estimate.value - truth) < DEVIATIONS * estimate.std


def check_payload(found: Identified, cell: SimulatedCell) -> None:
    # The simulated lab has 9.81 m/s², the estimate assumes the standard 9.80665: the stated deviation covers it.
    assert abs(GRAVITY_B_M_S2[2]) != 9.81
    close(found.payload.mass_kg, cell.payload_mass_kg)
    assert found.payload.com_m.value is not None
    # A centre of mass as far off as a millimetre would be a defect: the noise moves it by micrometres.
    np.testing.assert_allclose(found.payload.com_m.value, cell.com_S_m, rtol=0.0, atol=5e-5)
    assert found.sensor.force_bias_n.value is not None
    assert found.sensor.torque_bias_n_m.value is not None
    # Means over a second of noise of 0.14 N and 0.012 N·m: hundredths and thousandths are left.
    np.testing.assert_allclose(found.sensor.force_bias_n.value, cell.force_bias_S_n, rtol=0.0, atol=0.02)
    np.testing.assert_allclose(found.sensor.torque_bias_n_m.value, cell.torque_bias_S_n_m, rtol=0.0, atol=2e-3)


def check_axis(axis: AxisEstimate, cell: SimulatedCell) -> None:
    coupling, wall = cell.coupling.stiffness_n_per_m, cell.environment.stiffness_n_per_m
    close(axis.coupling.stiffness_n_per_m, coupling)
    close(axis.coupling.damping_n_s_per_m, cell.coupling.damping_n_s_per_m)
    close(axis.drag_n_s_per_m, cell.drag_n_s_per_m)
    assert len(axis.environments) == 1
    close(axis.environments[0].stiffness_n_per_m, wall)
    close(axis.environments[0].secant_stiffness_n_per_m, coupling * wall / (coupling + wall))


def check_robot(axis: AxisEstimate, cell: SimulatedCell) -> None:
    robot = axis.robot
    assert robot.denominator.value is not None
    assert robot.numerator.value is not None
    assert len(robot.denominator.value) == len(cell.robot.denominator)
    np.testing.assert_allclose(robot.denominator.value, cell.robot.denominator, rtol=PROMISED)
    np.testing.assert_allclose(robot.numerator.value, cell.robot.numerator, rtol=PROMISED)
    close(robot.delay_s, cell.robot.delay_s)


@pytest.fixture(scope="module")
def demo() -> Identified:
    return identify_cell(demo_run().recording)


@pytest.fixture(scope="module")
def heavy() -> Identified:
    return identify_cell(heavy_run().recording)


def test_the_demo_cell_is_found_again(demo: Identified) -> None:
    cell = demo_run().cell
    assert list(demo.axes) == [cell.approach_axis]
    check_payload(demo, cell)
    check_axis(demo.axes["x"], cell)
    check_robot(demo.axes["x"], cell)
    assert demo.axes["x"].environments[0].contacts == 4
    assert [f.code for f in demo.findings if f.severity == "error"] == []


def test_the_demo_cells_sensor_is_described(demo: Identified) -> None:
    assert demo.sensor.force_noise_rms_n.value == pytest.approx(demo_run().cell.force_noise_rms_n, rel=0.03)
    assert demo.sample_time_s.value == pytest.approx(8e-4, rel=1e-9)
    assert demo.sensor.deadband_n.value == 0.0  # the log shows the raw sensor, not what the controller makes of it


def test_the_peaks_of_the_contacts_are_those_of_the_sensor(demo: Identified) -> None:
    run = demo_run()
    touching = run.axis.contact_force_n > 0.0
    pressing = run.script.desired_force_n > 0.0
    starts, stops = np.flatnonzero(np.diff(pressing.astype(int)) > 0), np.flatnonzero(np.diff(pressing.astype(int)) < 0)
    truth = [-np.min(run.axis.force_n[a:b][touching[a:b]]) for a, b in zip(starts, stops, strict=True)]
    peaks = demo.axes["x"].environments[0].peak_force_n
    # The largest of some thousand noisy samples exceeds the true peak by up to four deviations of the noise.
    np.testing.assert_allclose(peaks, truth, rtol=0.0, atol=4.0 * run.cell.force_noise_rms_n)


def test_a_heavy_payload_on_another_axis_against_a_softer_wall_is_found_again(heavy: Identified) -> None:
    cell = heavy_run().cell
    assert list(heavy.axes) == ["z"]
    check_payload(heavy, cell)
    check_axis(heavy.axes["z"], cell)
    check_robot(heavy.axes["z"], cell)


def resampled_pose(signal: PoseSignal, stamp_ns: NDArray[np.int64], noise: NDArray[np.float64]) -> PoseSignal:
    old, new = ((s - signal.stamp_ns[0]) * 1e-9 for s in (signal.stamp_ns, stamp_ns))
    turned = Slerp(old, Rotation.from_quat(signal.quaternion_xyzw))(new)
    return replace(
        signal,
        stamp_ns=stamp_ns,
        position_m=make_interp_spline(old, signal.position_m, k=3)(new) + noise,
        quaternion_xyzw=turned.as_quat(canonical=True),
    )


def at_other_rates(run: CellRun, *, wrench_hz: float, pose_hz: float) -> Recording:
    """Clocks of their own for wrench and pose; noise comes after the interpolation, which would smooth it away."""
    recording, cell, rng = run.recording, run.cell, np.random.default_rng(17)
    first, last = recording.wrench.stamp_ns[[0, -1]]

    def clock(rate_hz: float, shift_ns: int) -> NDArray[np.int64]:
        count = int((last - first - shift_ns) * 1e-9 * rate_hz)
        stamps: NDArray[np.int64] = first + shift_ns + np.round(np.arange(count) * 1e9 / rate_hz).astype(np.int64)
        return stamps

    wrench_stamps, pose_stamps = clock(wrench_hz, 310_000), clock(pose_hz, 1_170_000)
    noise = np.array([0.14] * 3 + [0.012] * 3) * rng.standard_normal((len(wrench_stamps), 6))
    old, new = ((s - first) * 1e-9 for s in (recording.wrench.stamp_ns, wrench_stamps))
    both = np.hstack([recording.wrench.force_n, recording.wrench.torque_n_m])
    values = make_interp_spline(old, both, k=3)(new) + noise
    position_noise = SimulatedCell().position_noise_rms_m * rng.standard_normal((len(pose_stamps), 3))
    assert cell.force_noise_rms_n == 0.0
    wrench = WrenchSignal(
        topic="/wrist", frame_id="wrist", stamp_ns=wrench_stamps, force_n=values[:, :3], torque_n_m=values[:, 3:]
    )
    pose = resampled_pose(recording.pose, pose_stamps, position_noise)
    return Recording(wrench=wrench, pose=pose, command=recording.command)


@pytest.mark.parametrize(("wrench_hz", "pose_hz"), [(1000.0, 500.0), (500.0, 1250.0)])
def test_wrench_and_pose_at_their_own_rates_give_the_same_cell(wrench_hz: float, pose_hz: float) -> None:
    run = silent_demo_run()
    found = identify_cell(at_other_rates(run, wrench_hz=wrench_hz, pose_hz=pose_hz))
    cell = run.cell
    axis = found.axes["x"]
    check_payload(found, cell)
    for estimate, truth in (
        (axis.coupling.stiffness_n_per_m, cell.coupling.stiffness_n_per_m),
        (axis.drag_n_s_per_m, cell.drag_n_s_per_m),
        (axis.environments[0].stiffness_n_per_m, cell.environment.stiffness_n_per_m),
    ):
        assert estimate.value == pytest.approx(truth, rel=PROMISED)
    check_robot(axis, cell)
