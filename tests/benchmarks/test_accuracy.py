"""The accuracy campaign: what it draws can be told, what it writes is what was simulated, what it sums up is right."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.formats.cell import read_cell
from benchmarks.accuracy_table import Row, Run, page, score, wrong_claims
from benchmarks.cell_logs import TURN, write_cell_log
from benchmarks.cell_outcomes import Outcome, approach_axis, bandwidth_hz, surface_outcomes
from benchmarks.cells import DrawnCell, Writing, draw_cell, simulate
from benchmarks.insufficient_cells import CASES
from identification.logs.read import read_checked_recording
from identification.logs.roles.cell import Cell
from identification.result import EnvironmentEstimate, Estimate, Status
from identification.signals.recording import PoseSignal, Recording, WrenchSignal
from problems.model.plant import FREE_SPACE, Environment
from problems.model.robot import RobotModel
from problems.model.sampled import build_loop, build_sampled_plant, spectral_radius

SEVERAL_SURFACES = (1, 2, 6, 68)


def outcome(error: float, std: float, *, name: str = "K_s", status: str = "identified", seed: int = 0) -> Outcome:
    return Outcome(seed=seed, name=name, truth=2.0, size=2.0, status=status, value=2.0 + 2.0 * error, std=std)


def shortened(recording: Recording, count: int) -> Recording:
    def first(pose: PoseSignal) -> PoseSignal:
        return replace(
            pose,
            stamp_ns=pose.stamp_ns[:count],
            position_m=pose.position_m[:count],
            quaternion_xyzw=pose.quaternion_xyzw[:count],
        )

    wrench: WrenchSignal = recording.wrench
    assert recording.command is not None
    return replace(
        recording,
        wrench=replace(
            wrench,
            stamp_ns=wrench.stamp_ns[:count],
            force_n=wrench.force_n[:count],
            torque_n_m=wrench.torque_n_m[:count],
        ),
        pose=first(recording.pose),
        command=first(recording.command),
    )


@pytest.mark.parametrize("seed", range(6))
def test_every_loop_that_is_drawn_is_stable(seed: int) -> None:
    drawn = draw_cell(seed)
    plant, period_s = drawn.cell.contact_plant(), drawn.cell.sample_time_s
    for surface in (FREE_SPACE, *drawn.surfaces):
        sampled = build_sampled_plant(plant.in_contact_with(surface), period_s)
        assert spectral_radius(build_loop(sampled, drawn.cell.controller)) < 1.0


@pytest.mark.parametrize("seed", SEVERAL_SURFACES)
def test_runs_at_several_surfaces_join_without_a_jump_and_end_free_of_contact(seed: int) -> None:
    drawn = draw_cell(seed)
    assert len(drawn.surfaces) > 1
    recording, period_ns = simulate(drawn), round(drawn.cell.sample_time_s * 1e9)
    assert recording.command is not None
    # Stamps are whole nanoseconds.
    assert np.all(np.abs(np.diff(recording.wrench.stamp_ns) - period_ns) <= 1)
    speed_limit_m_s = 0.5
    largest = float(np.max(np.linalg.norm(np.diff(recording.command.position_m, axis=0), axis=1)))
    assert largest < speed_limit_m_s * drawn.cell.sample_time_s
    # Without contact the last force is the first one again, but for the mean of 200 noisy samples (6 deviations).
    first, last = recording.wrench.force_n[:200].mean(axis=0), recording.wrench.force_n[-200:].mean(axis=0)
    assert np.max(np.abs(last - first)) < 6.0 * np.sqrt(2.0 / 200.0) * drawn.cell.force_noise_rms_n


def test_the_seed_decides_everything() -> None:
    assert draw_cell(3) == draw_cell(3)
    assert draw_cell(3) != draw_cell(4)


@pytest.mark.parametrize("container", ["mcap", "sqlite", "bag", "csv"])
@pytest.mark.parametrize("pose_type", ["PoseStamped", "TransformStamped"])
def test_what_is_read_is_what_was_simulated(container: str, pose_type: str, tmp_path: Path) -> None:
    recording = shortened(simulate(draw_cell(0)), 3000)
    writing = Writing(
        container=container,  # type: ignore[arg-type]  # one of the four names
        pose_type=pose_type,  # type: ignore[arg-type]  # one of the two
        turned_sensor=True,
        # Of a log without a declaration the sign is left as it is.
        reversed_wrench=container == "csv",
    )
    log, cell = write_cell_log(recording, replace(draw_cell(0), writing=writing), tmp_path)
    assert cell is not None
    read = read_checked_recording((log,), read_cell(cell).cell)
    assert read.command is not None
    assert recording.command is not None
    # The table has ten digits, of millimetres in the poses; messages have all.
    np.testing.assert_allclose(
        read.wrench.force_n, TURN.inv().apply(np.array(recording.wrench.force_n)), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(read.command.position_m, recording.command.position_m, rtol=1e-9, atol=1e-9)
    assert len(read.pose.stamp_ns) == 3000


def test_lost_messages_gaps_and_slower_channels_are_missing_from_the_file(tmp_path: Path) -> None:
    recording = shortened(simulate(draw_cell(0)), 6000)
    writing = Writing(pose_every=3, lost_share=0.01, gap_periods=8)
    log, cell = write_cell_log(recording, replace(draw_cell(0), writing=writing), tmp_path)
    assert cell is None
    read = read_checked_recording((log,), Cell())
    period_ns = draw_cell(0).cell.sample_time_s * 1e9
    steps = np.round(np.diff(read.pose.stamp_ns) / (3.0 * period_ns))
    assert np.median(steps) == 1.0
    assert np.max(steps) >= 8.0
    # Binomial: 60 of 6000 expected, six deviations of 7.7.
    assert 14 < 6000 - 7 - len(read.wrench.stamp_ns) < 106


@pytest.mark.parametrize(
    "robot",
    [
        RobotModel.from_bandwidth(bandwidth_rad_per_s=20.0, delay_s=1e-3),
        RobotModel(numerator=np.array([400.0]), denominator=np.array([1.0, 24.0, 400.0]), delay_s=0.0),
        RobotModel(numerator=np.array([400.0]), denominator=np.array([1.0, 60.0, 400.0]), delay_s=0.0),
    ],
)
def test_at_the_bandwidth_the_response_is_down_by_three_decibels(robot: RobotModel) -> None:
    response = robot.position_response(np.array([2.0 * np.pi * bandwidth_hz(robot)]))
    assert abs(response[0]) == pytest.approx(np.sqrt(0.5), rel=1e-12)


def test_the_axis_of_a_turned_sensor_is_that_of_the_sensor() -> None:
    drawn = draw_cell(0)
    turned = replace(drawn.writing, turned_sensor=True)
    names = {
        axis: approach_axis(replace(drawn, cell=replace(drawn.cell, approach_axis=axis), writing=turned))
        for axis in ("x", "y", "z")
    }
    assert names == {"x": "y", "y": "x", "z": "z"}


def surface_found(stiffness: float, drawn: DrawnCell) -> EnvironmentEstimate:
    coupling = drawn.cell.coupling.stiffness_n_per_m
    known = Estimate(value=stiffness, std=1.0, status=Status.IDENTIFIED)
    insufficient = Estimate(value=None, std=None, status=Status.UNIDENTIFIABLE)
    return EnvironmentEstimate(
        name="x1",
        stiffness_n_per_m=known,
        secant_stiffness_n_per_m=replace(known, value=stiffness * coupling / (stiffness + coupling)),
        damping_n_s_per_m=insufficient,
        mass_kg=insufficient,
        contacts=3,
        peak_force_n=(),
    )


def test_surfaces_are_paired_by_stiffness_and_the_others_are_counted() -> None:
    surfaces = (Environment(stiffness_n_per_m=2e4), Environment(stiffness_n_per_m=8e4))
    drawn = replace(draw_cell(0), surfaces=surfaces)
    reported = list(surface_outcomes(drawn, [surface_found(k, drawn) for k in (8.1e4, 3.5e5, 2.1e4)]))
    assert [o.value for o in reported if o.name == "K_e"] == [2.1e4, 8.1e4]
    assert sum(o.name == "surfaces beside the true ones" for o in reported) == 1
    only = list(surface_outcomes(drawn, [surface_found(8.1e4, drawn)]))
    assert [o.value for o in only if o.name == "K_e"] == [None, 8.1e4]


def test_a_score_counts_errors_of_all_values_and_the_worst_of_what_is_identified() -> None:
    insufficient = Outcome(seed=5, name="K_s", truth=2.0, size=2.0, status="unidentifiable")
    row = Row(name="K_s", unit="%", scale=100.0, targets=(1.0, 4.0))
    found = score(
        row,
        [
            outcome(0.01, 0.02, seed=1),
            outcome(-0.02, 0.01, seed=2),
            outcome(0.5, 0.01, status="weak", seed=3),
            outcome(9.0, 0.01, name="B_s", seed=4),
            insufficient,
        ],
    )
    assert (found.identified, found.weak, found.insufficient) == (2, 1, 1)
    assert found.median == pytest.approx(2.0)
    assert found.worst == pytest.approx(4.0)
    assert found.worst_seed == 2
    assert found.covered == pytest.approx(1.0 / 3.0)
    assert found.misses == ("median", "95th percentile", "coverage")


def test_a_stated_interval_counts_instead_of_the_deviation() -> None:
    far = outcome(0.5, 0.01)
    assert far.is_covered is False
    assert replace(far, ci95=(1.0, 4.0)).is_covered is True
    assert replace(far, value=None).is_covered is None


def test_a_claim_of_what_a_log_hides_is_wrong_only_beyond_three_deviations() -> None:
    case = CASES[0]
    honest, wrong = (outcome(error, 0.1, name=case.hidden[0]) for error in (0.1, 0.2))
    beside = outcome(9.0, 0.1, name="delay")
    runs = [
        Run(seed=0, case=case.name, outcomes=(honest, wrong, beside), refusal="", findings=(), seconds=1.0),
        Run(seed=1, case=case.name, outcomes=(), refusal="EstimateError: no", findings=(), seconds=1.0),
    ]
    assert wrong_claims(case, runs) == [wrong]
    assert f"| {case.name} | mass, centre of mass | 2 | 1 | 0 | 0 | **1** |" in page(runs)
