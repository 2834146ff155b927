"""Logs whose weight was removed: synthetic ones, and those of the NJ60 cell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autotune.formats.cell import read_cell
from identification.errors import EstimateError
from identification.logs import read_recording
from identification.partial import identify_partial
from identification.result import Estimate, Identified, Status
from identification.robot.admittance_robot import (
    AdmittanceRobotFit,
    _estimate,
    identify_admittance_robots,
    with_compensated_force,
)
from identification.signals.aligned import align
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from identification.touches.trace import describe_trace, identify_trace
from problems.arrays import FloatArray
from problems.model.robot import RobotModel

from .led_robot import ONE_POLE, hand_force, led, recorded

PERIOD = Estimate(value=1e-3, std=0.0, status=Status.WEAK)
H_S = 1e-3
TIME_S = np.arange(1500) * H_S
DEPTH_M = np.asarray(0.01 * (1.0 - np.exp(-TIME_S / 0.2)))
SPRING_N_PER_M = 3000.0
BLOW_S = 0.03


def lively() -> Recording:
    return recorded(led(ONE_POLE, 0.0125, hand_force(12.0, np.random.default_rng(1))))


def told(result: Identified) -> dict[str, str]:
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
    assert told(result)["gravity-removed"] == told(result)["coupling"] == told(result)["no-contact"] == "error"
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
    robot = _estimate(fit)
    assert {robot.delay_s.status, robot.bandwidth_hz.status, robot.denominator.status} == {Status.WEAK}


def test_gains_that_foretell_another_speed_are_told() -> None:
    recording = recorded(led(ONE_POLE, 0.0125, hand_force(12.0, np.random.default_rng(1))), damping_n_s_per_m=700.0)
    found = identify_admittance_robots(recording)
    assert next(f.message for f in found.findings if f.code == "admittance-gain").startswith(
        "Axis x: the robot moves at 0.7"
    )


def test_without_gains_nothing_is_told_and_that_is_an_error() -> None:
    with pytest.raises(EstimateError, match=r"Gravity is already removed.*declare `gains`"):
        identify_partial(replace(lively(), gains=None), PERIOD)


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
def test_a_trace_tells_the_same_secant_on_both_sides(stiffness: float, sign: float) -> None:
    result = identify_partial(trace(stiffness, sign), PERIOD)
    (surface,) = result.axes["z"].environments
    assert surface.secant_stiffness_n_per_m.value == pytest.approx(stiffness, rel=1e-12)
    assert surface.stiffness_n_per_m.value is None
    assert told(result)["no-command"] == "error"


def test_a_trace_of_the_wrong_sign_is_no_contact() -> None:
    with pytest.raises(EstimateError, match="Gravity is already removed"):
        identify_partial(trace(-3e3, 1.0), PERIOD)


@pytest.mark.parametrize(
    ("name", "peak_n", "secant_n_per_m", "status"),
    [
        ("yellow_feet_imco.csv", 55.6, 11.2e3, Status.WEAK),
        ("flex_jt_imco.csv", 34.4, 2.7e3, Status.IDENTIFIED),
    ],
)
def test_the_traces_have_the_published_rows(
    repository: Path, shared_data: Path, name: str, peak_n: float, secant_n_per_m: float, status: Status
) -> None:
    cell = read_cell(repository / "examples" / "nj60" / "traces.yaml").cell
    result = identify_partial(read_recording(shared_data / "nj60" / name, cell), PERIOD)
    (surface,) = result.axes["z"].environments
    assert surface.peak_force_n[0] == pytest.approx(peak_n, abs=0.1)
    secant = surface.secant_stiffness_n_per_m
    assert secant.value == pytest.approx(secant_n_per_m, rel=0.03)
    assert secant.std is not None
    assert abs((secant.value or 0.0) - secant_n_per_m) < 2.0 * secant.std
    assert secant.status is status
    assert told(result)["impact-spike"] == told(result)["secant-only"] == "warning"


@pytest.mark.parametrize(
    ("name", "axes", "gain"),
    # The controller of the first log reckoned with 4 ms where 5.11 ms passed (`examples/nj60/cell.yaml`).
    [("single_mode_middle.bag", {"x", "z"}, 4.0 / 5.11), ("yellow_table_1.bag", {"x", "y", "z", "rx", "rz"}, 1.0)],
)
def test_the_bags_tell_bandwidth_and_lag_but_no_delay(
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
        assert axis.robot.delay_s.status is Status.UNIDENTIFIABLE
    assert sum(axis.robot.bandwidth_hz.status is Status.WEAK for axis in result.axes.values()) >= 2
    speeds = [f.message for f in result.findings if f.code == "wrench-to-motion-lag"]
    assert len(speeds) == len(axes)
    for message in speeds:
        # 1/20 s of the paper's robot, and the delays of command, hold and logger on top.
        assert 60.0 < float(message.split("wrench ")[1].split(" ")[0]) < 190.0
        # Turning that the lever takes for travel moves the gain by up to a tenth.
        assert float(message.split("at ")[-1].split(" ")[0]) == pytest.approx(gain, rel=0.12)
    assert ("admittance-halted" in told(result)) == (name == "yellow_table_1.bag")


def blow(force_n: float) -> FloatArray:
    """Half a sine of 30 ms from the contact on, and a payload that then leaves the surface until 0.12 s."""
    sine = force_n * np.sin(np.pi * TIME_S / BLOW_S) * (TIME_S < BLOW_S)
    off = (TIME_S >= BLOW_S) & (TIME_S < 0.12)
    return np.asarray(sine - SPRING_N_PER_M * DEPTH_M * off)


@given(stiffness=st.floats(1e3, 1e6))
@settings(max_examples=20, deadline=None)
def test_a_spring_is_found_to_rounding(stiffness: float) -> None:
    contact = identify_trace(DEPTH_M, stiffness * DEPTH_M, H_S)
    assert contact.secant_n_per_m == pytest.approx(stiffness, rel=1e-12)
    assert contact.hold_secant_n_per_m == pytest.approx(stiffness, rel=1e-12)
    assert contact.peak_force_n == pytest.approx(stiffness * DEPTH_M[-1], rel=1e-12)
    assert contact.spike is None
    # The last sample below 5 % of the peak lies less than 5 % of the depth away from the beginning.
    assert 0.0 <= contact.touch_m <= 0.05 * DEPTH_M[-1]


def test_the_secant_minimises_the_squares_of_the_loaded_samples() -> None:
    force = SPRING_N_PER_M * DEPTH_M + 3.0 * np.sin(2.0 * np.pi * 14.0 * TIME_S) * np.exp(-TIME_S / 0.3)
    contact = identify_trace(DEPTH_M, force, H_S)
    loaded = force > 0.2 * np.max(force)
    expected = np.linalg.lstsq(DEPTH_M[loaded, None], force[loaded], rcond=None)[0][0]
    assert contact.secant_n_per_m == pytest.approx(expected, rel=1e-9)
    assert abs(contact.secant_n_per_m - SPRING_N_PER_M) < 3.0 * contact.secant_std_n_per_m


def test_a_blow_is_noticed_and_leaves_the_secant_alone() -> None:
    contact = identify_trace(DEPTH_M, SPRING_N_PER_M * DEPTH_M + blow(40.0), H_S)
    assert contact.spike is not None
    # The spring adds 4.2 N at the end of the blow to the sine's 40 N in its middle.
    assert contact.spike.force_n == pytest.approx(40.0 + SPRING_N_PER_M * 0.01 * (1.0 - np.exp(-0.015 / 0.2)), abs=0.3)
    # ∫ sin = 2/π of the duration; the end of the blow, below half of its force, is not counted: 1 − cos(5π/6) of 2.
    assert contact.spike.impulse_n_s == pytest.approx(40.0 * BLOW_S * 2.0 / np.pi, rel=0.1)
    # 30 ms of half a sine weigh x·F = 0.03 N·m·s at most beside x²·k = 0.3.
    assert contact.secant_n_per_m == pytest.approx(SPRING_N_PER_M, rel=0.02)
    environment, findings = describe_trace(contact, "z1")
    assert "impact-spike" in [finding.code for finding in findings]
    assert environment.mass_kg.value is None
    assert "N·s" in environment.mass_kg.note


def test_the_hold_is_where_it_was_held_and_not_the_end_of_the_trace() -> None:
    """Pressed for 1.5 s and let go for as long: the last fifth is off the surface."""
    depth = np.concatenate([DEPTH_M, DEPTH_M[::-1][::10], np.zeros(1350)])
    # Stiffer under way than at rest, by the viscous force of the approach.
    force = SPRING_N_PER_M * depth + 200.0 * np.gradient(depth, H_S) * (depth > 0.0)
    contact = identify_trace(depth, np.maximum(force, 0.0), H_S)
    # Within 5 % of the hold's depth the approach still has up to 5 % of 50 mm/s: 0.4 N of 30 N on average.
    assert contact.hold_secant_n_per_m == pytest.approx(SPRING_N_PER_M, rel=0.02)
    environment, _ = describe_trace(contact, "z1")
    assert "over the hold" in environment.secant_stiffness_n_per_m.note


def test_a_trace_that_only_goes_in_and_out_has_no_hold() -> None:
    depth = 0.01 * (1.0 - np.abs(np.linspace(-1.0, 1.0, 2001)))
    contact = identify_trace(depth, SPRING_N_PER_M * depth, H_S)
    assert contact.hold_secant_n_per_m is None
    assert "no hold" in describe_trace(contact, "z1")[0].secant_stiffness_n_per_m.note


def test_where_the_contact_begins_is_part_of_the_deviation() -> None:
    gap = 1e-3
    force = SPRING_N_PER_M * np.maximum(DEPTH_M - gap, 0.0)
    contact = identify_trace(DEPTH_M, force, H_S)
    assert contact.touch_m == pytest.approx(gap, abs=5e-4)
    assert abs(contact.secant_n_per_m - SPRING_N_PER_M) < 2.0 * contact.secant_std_n_per_m
    environment, findings = describe_trace(contact, "z1")
    assert environment.secant_stiffness_n_per_m.status is Status.WEAK
    assert findings == ()  # told as a deviation; force and way fit each other within a tenth


def test_only_the_secant_is_told() -> None:
    environment, _ = describe_trace(identify_trace(DEPTH_M, SPRING_N_PER_M * DEPTH_M, H_S), "z1")
    assert environment.secant_stiffness_n_per_m.value == pytest.approx(SPRING_N_PER_M)
    assert "least squares through the origin" in environment.secant_stiffness_n_per_m.method
    for parameter in (environment.stiffness_n_per_m, environment.damping_n_s_per_m, environment.mass_kg):
        assert parameter.status is Status.UNIDENTIFIABLE
        assert parameter.note


@pytest.mark.parametrize(
    ("displacement", "force"),
    [(DEPTH_M, -SPRING_N_PER_M * DEPTH_M), (DEPTH_M, 200.0 * DEPTH_M), (0.01 * DEPTH_M, SPRING_N_PER_M * DEPTH_M)],
    ids=["pulling", "no force", "no way"],
)
def test_what_is_no_contact_is_refused(displacement: FloatArray, force: FloatArray) -> None:
    with pytest.raises(EstimateError, match="no contact from which a stiffness can be determined"):
        identify_trace(displacement, force, H_S)
