"""Logs of other people's simulators: a wall that chatters, a hand that goes over into a sweep and into contacts."""

import json
from pathlib import Path

import pytest

from autotune.formats.problem import ProblemSpec
from autotune.pipeline import identify_log
from autotune.tuning.problems import build_problems
from identification.result import PhaseKind, Status, TouchCause


@pytest.mark.slow
def test_a_wall_that_chatters_is_a_weak_surface_and_in_the_default_range(shared_data: Path) -> None:
    path = shared_data / "cases" / "chattering_wall.mcap"
    if not path.is_file():
        pytest.skip("needs the recorded logs in ../shared/data")
    found = identify_log(path).result
    soft, wall = found.axes["z"].environments
    assert soft.stiffness_n_per_m.value == pytest.approx(3e4, rel=0.02)  # what is called identified is good to 5 %
    assert wall.stiffness_n_per_m.status is Status.WEAK
    assert wall.stiffness_n_per_m.ci95 is not None
    low, high = wall.stiffness_n_per_m.ci95
    assert low < 2e5 < high
    assert wall.contacts == 3
    touches = [phase.contact for phase in found.timelines[0].phases if phase.contact is not None]
    assert [touch.surface for touch in touches] == [soft.name] * 3 + [wall.name] * 3
    low, high = build_problems(found, ProblemSpec())["z"].plants.environment_stiffness_n_per_m
    assert low < 3e4
    assert high > 2e5
    # Dry friction of 20 N makes the wrench look 0.11 ms late, which is no filter.
    assert found.sensor.wrench_filter is None
    # Nor is it a clock's offset: the clocks agree, and with it taken out the delay leaves the truth of 2.6 ms.
    assert not {"clock-offset", "wrench-lag"}.intersection(finding.code for finding in found.findings)
    delay = found.axes["z"].robot.delay_s
    assert delay.value is not None
    assert delay.std is not None
    assert abs(delay.value - 2.6e-3) < 2.0 * delay.std


@pytest.mark.slow
def test_a_sweep_between_a_hand_and_a_contact_identifies_the_cell(shared_data: Path) -> None:
    """No rest lies between the hand and the sweep, and 0.3 s between the sweep and the first approach."""
    path = shared_data / "cases" / "hand_then_sweep.mcap"
    if not path.is_file():
        pytest.skip("needs the recorded logs in ../shared/data")
    truth = json.loads(path.with_suffix(".truth.json").read_text())
    found = identify_log(path).result
    axis = found.axes["z"]
    # The targets of docs/accuracy.md.
    for estimate, value, share in (
        (found.payload.mass_kg, truth["mass"], 0.005),
        (axis.mass_kg, truth["mass"], 0.005),
        (axis.coupling.stiffness_n_per_m, truth["Ks"], 0.04),
        (axis.coupling.damping_n_s_per_m, truth["Bs"], 0.15),
        (axis.environments[0].stiffness_n_per_m, truth["Ke"][0], 0.05),
    ):
        assert estimate is not None
        assert estimate.value == pytest.approx(value, rel=share)
    delay, period = axis.robot.delay_s.value, truth["sample_time_s"]
    assert delay == pytest.approx(truth["delay"] * period, abs=0.14 * period)
    assert not [finding.code for finding in found.findings if finding.severity == "error"]
    begin, sweep = (truth["phases"]["n1"] * period, 7.0)
    (commanded,) = [phase for phase in found.timelines[0].phases if phase.kind is PhaseKind.COMMANDED_MOTION]
    assert commanded.start_s == pytest.approx(begin + 7.0, abs=0.3)
    assert commanded.stop_s - commanded.start_s == pytest.approx(sweep, abs=0.5)
    walls = [touch for touch in found.timelines[0].touches if touch.cause is TouchCause.WALL]
    assert [touch.surface for touch in walls] == ["z1"] * truth["contacts"]
