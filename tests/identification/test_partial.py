"""Logs whose weight was removed: synthetic ones, and those of the NJ60 cell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.formats.cell import read_cell
from autotune.report.sensor_charts import wrench_charts
from identification.errors import EstimateError
from identification.identify import identify_with_evidence
from identification.logs.read import read_recording
from identification.partial import identify_partial
from identification.result import Estimate, Identified, Status
from identification.robot.admittance_estimates import _estimate, identify_admittance_robots
from identification.robot.admittance_motion import admittance_motions, with_compensated_force
from identification.robot.admittance_robot import AdmittanceRobotFit
from identification.signals.aligned import align
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.model.robot import RobotModel

from .led_robot import ONE_POLE, hand_force, led, recorded

PERIOD = Estimate(value=1e-3, std=0.0, status=Status.WEAK)


def lively() -> Recording:
    return recorded(led(ONE_POLE, 0.0125, hand_force(12.0, np.random.default_rng(1))))


def reported(result: Identified) -> dict[str, str]:
    return {finding.code: finding.severity for finding in result.findings}


def test_a_led_robot_is_weak_at_best_since_its_logger_is_not_known() -> None:
    result = identify_partial(lively(), PERIOD)
    robot = result.axes["x"].robot
    assert list(result.axes) == ["x"]
    assert robot.denominator.value == pytest.approx((1.0, 20.0), rel=0.02)
    assert robot.delay_s.value == pytest.approx(0.0125, abs=5e-4)
    assert robot.bandwidth_hz.value == pytest.approx(20.0 / (2.0 * np.pi), rel=0.01)
    assert {robot.denominator.status, robot.delay_s.status, robot.bandwidth_hz.status} == {Status.WEAK}
    assert "only a logged command distinguishes" in robot.delay_s.note
    assert "neither lead nor feedback damping" in robot.bandwidth_hz.note
    messages = {finding.code: finding.message for finding in result.findings}
    assert "in one message" in messages["delay-not-split"]
    assert (
        reported(result)["gravity-removed"] == reported(result)["coupling"] == reported(result)["no-contact"] == "error"
    )
    assert result.axes["x"].coupling.stiffness_n_per_m.status is Status.UNIDENTIFIABLE
    assert result.payload.mass_kg.value is None


def test_however_well_it_fits_a_delay_with_the_logger_in_it_is_weak() -> None:
    fit = AdmittanceRobotFit(
        model=RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=0.02),
        denominator_std=np.array([0.0, 0.02]),
        delay_std_s=2e-5,
        bandwidth_hz=20.0 / (2.0 * np.pi),
        bandwidth_std_hz=3e-3,
        lag_s=0.07,
        lag_std_s=2e-5,
        gain=1.0,
        gain_std=1e-3,
        lever_m=np.zeros(0),
        lever_std_m=np.zeros(0),
        fit_error=0.01,
    )
    (motion,) = (each for each in admittance_motions(lively()) if each.axis == "x")
    robot = _estimate(fit, motion)
    assert {robot.delay_s.status, robot.bandwidth_hz.status, robot.denominator.status} == {Status.WEAK}


def test_gains_that_foretell_another_speed_are_reported() -> None:
    recording = recorded(led(ONE_POLE, 0.0125, hand_force(12.0, np.random.default_rng(1))), damping_n_s_per_m=700.0)
    found = identify_admittance_robots(recording)
    assert next(f.message for f in found.findings if f.code == "admittance-gain").startswith(
        "Axis x: the robot moves at 0.7"
    )


def test_without_gains_nothing_is_reported_and_that_is_an_error() -> None:
    with pytest.raises(EstimateError, match=r"Gravity is already removed.*declare `gains`"):
        identify_partial(replace(lively(), gains=None), PERIOD)


def test_the_pictures_of_a_log_without_weight_show_its_force_and_when_it_touched() -> None:
    recording = lively()
    found, evidence = identify_with_evidence(recording)
    assert evidence is not None
    assert evidence.compensated_S_n is None
    assert np.array_equal(evidence.raw_S_n, recording.wrench.force_n)
    # Without rests under weight nothing shows how wrong the force's scale is.
    assert evidence.gain_error_share == 0.0
    charts = list(wrench_charts(evidence, found.timelines[0], "1"))
    assert [len(chart.panels) for chart in charts] == [3, 3]
    assert "its weight removed before; the force reaches" in charts[0].alternative
    # Axes that were not measured are no empty pictures.
    along_x = np.where([True, False, False], recording.wrench.force_n, np.nan)
    trace = replace(evidence, raw_S_n=along_x, raw_torque_S_n_m=np.full_like(along_x, np.nan))
    assert [len(chart.panels) for chart in wrench_charts(trace, None, "1")] == [1]


def test_a_sign_that_nothing_shows_is_said_to_be_assumed() -> None:
    """Without gains, command and contact, but with a touch of undetermined cause."""
    recording = lively()
    assert "force-sign-assumed" not in reported(identify_partial(recording, PERIOD))
    force = np.zeros_like(recording.wrench.force_n)
    force[2000:2060, 0] = 25.0
    still = replace(recording.pose, position_m=np.zeros_like(recording.pose.position_m))
    pushed = replace(recording, gains=None, wrench=replace(recording.wrench, force_n=force), pose=still)
    assert reported(identify_partial(pushed, PERIOD))["force-sign-assumed"] == "warning"


def test_a_raw_log_is_fitted_with_its_compensated_force() -> None:
    recording = lively()
    weight_N = np.array([3.0, -5.0, 90.0])
    raw = replace(
        recording,
        wrench=replace(recording.wrench, force_n=recording.wrench.force_n + weight_N, gravity_compensated=False),
    )
    log = align(raw)
    found = identify_admittance_robots(with_compensated_force(raw, log, log.force_S_n - weight_N))
    assert found.robots["x"].bandwidth_hz.value == pytest.approx(20.0 / (2.0 * np.pi), rel=0.01)


def trace(stiffness: float, sign: float) -> Recording:
    n = 1200
    stamps = np.arange(n, dtype=np.int64) * 1_000_000
    depth = np.full((n, 3), np.nan)
    depth[:, 2] = sign * 0.01 * (1.0 - np.exp(-np.arange(n) / 200.0))
    return Recording(
        wrench=WrenchSignal(
            topic="trace.csv",
            frame_id="",
            stamp_ns=stamps,
            force_n=-stiffness * depth,
            torque_n_m=np.full((n, 3), np.nan),
            gravity_compensated=True,
            measured_axes=("z",),
        ),
        pose=PoseSignal(
            topic="trace.csv",
            frame_id="",
            stamp_ns=stamps,
            position_m=depth,
            quaternion_xyzw=np.full((n, 4), np.nan),
            is_displacement=True,
            measured_axes=("z",),
        ),
        command=None,
    )


@given(stiffness=st.floats(1e3, 1e6), sign=st.sampled_from([-1.0, 1.0]))
@settings(max_examples=10, deadline=None)
def test_a_trace_shows_the_same_secant_on_both_sides(stiffness: float, sign: float) -> None:
    result = identify_partial(trace(stiffness, sign), PERIOD)
    (surface,) = result.axes["z"].environments
    assert surface.secant_stiffness_n_per_m.value == pytest.approx(stiffness, rel=1e-9)
    assert surface.secant_stiffness_n_per_m.status is Status.WEAK  # one contact says nothing of the next
    assert surface.stiffness_n_per_m.value is None
    assert reported(result)["no-command"] == "error"


def test_a_trace_of_the_wrong_sign_is_no_contact() -> None:
    with pytest.raises(EstimateError, match="Gravity is already removed"):
        identify_partial(trace(-3e3, 1.0), PERIOD)


@pytest.mark.parametrize(
    ("name", "axes", "gain"),
    # The controller of the first log reckoned with 4 ms where 5.11 ms passed (`examples/nj60/cell.yaml`).
    [("single_mode_middle.bag", {"x", "z"}, 4.0 / 5.11), ("yellow_table_1.bag", {"x", "y", "z", "rx", "rz"}, 1.0)],
)
def test_the_bags_show_bandwidth_and_lag_and_a_delay_with_poles_alone(
    repository: Path, shared_data: Path, name: str, axes: set[str], gain: float
) -> None:
    cell = read_cell(repository / "examples" / "nj60" / "cell.yaml").cell
    result = identify_partial(read_recording(shared_data / "nj60" / name, cell), PERIOD)
    assert set(result.axes) == axes
    for axis in result.axes.values():
        # The paper speaks of a position loop of 3 Hz.
        if axis.robot.bandwidth_hz.value is not None:
            assert 1.5 < axis.robot.bandwidth_hz.value < 3.5
        assert axis.robot.bandwidth_hz.status is not Status.IDENTIFIED
        # A delay only beside poles that need it, and then with an interval down to none.
        has_poles = axis.robot.denominator.value is not None
        assert axis.robot.delay_s.status is (Status.WEAK if has_poles else Status.UNIDENTIFIABLE)
        if has_poles:
            assert axis.robot.delay_s.ci95 is not None
            assert axis.robot.delay_s.ci95[0] == 0.0 < axis.robot.delay_s.ci95[1] < 0.19
    assert sum(axis.robot.bandwidth_hz.status is Status.WEAK for axis in result.axes.values()) >= 2
    speeds = [f.message for f in result.findings if f.code == "wrench-to-motion-lag"]
    assert len(speeds) == len(axes)
    for message in speeds:
        # 1/20 s of the paper's robot, and the delays of command, hold and logger on top.
        assert 60.0 < float(message.split("wrench ")[1].split(" ")[0]) < 190.0
        # Turning that the lever takes for travel moves the gain by up to a tenth.
        assert float(message.split("at ")[-1].split(" ")[0]) == pytest.approx(gain, rel=0.12)
    assert ("admittance-halted" in reported(result)) == (name == "yellow_table_1.bag")
