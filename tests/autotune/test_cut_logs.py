"""A log or a window that cuts the sweep says what its part shows, with deviations that hold, or nothing."""

import json
from pathlib import Path

import pytest

import autotune as at
from autotune.simulation.truth import SimulatedCell
from identification.result import AxisEstimate, Estimate, Status


def _is_told(estimate: Estimate | None, truth: float) -> bool:
    """Whether an estimate is within three deviations of the truth, or says that the log does not show it."""
    if estimate is None or estimate.value is None or estimate.std is None:
        return estimate is None or estimate.status is Status.UNIDENTIFIABLE
    return abs(estimate.value - truth) < 3.0 * estimate.std


def _untold(axis: AxisEstimate, truths: dict[str, float]) -> list[str]:
    coupling, robot = axis.coupling, axis.robot
    estimates = {
        "K_s": coupling.stiffness_n_per_m,
        "B_s": coupling.damping_n_s_per_m,
        "B_p": axis.drag_n_s_per_m,
        "M_p": axis.mass_kg,
        "T_d": robot.delay_s,
    }
    return [name for name, truth in truths.items() if not _is_told(estimates[name], truth)]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return at.simulate_log(tmp_path_factory.mktemp("cut") / "cell.mcap")


@pytest.mark.parametrize("until_s", [38.0, 38.5, 40.5, 45.0])
def test_a_sweep_that_ends_too_early_shows_no_wrong_spring(log: Path, until_s: float) -> None:
    """Far below its resonance a spring hardly gives: many K_s explain the force alike, each as sharp as if alone."""
    cell = SimulatedCell()
    truths = {
        "K_s": cell.coupling.stiffness_n_per_m,
        "B_s": cell.coupling.damping_n_s_per_m,
        "B_p": cell.drag_n_s_per_m,
        "M_p": cell.payload_mass_kg,
        "T_d": cell.robot.delay_s,
    }
    found = at.identify(at.read_log(log, stop=until_s), allow_partial=True).result.axes["x"]
    assert _untold(found, truths) == []
    # What has passed the resonance shows the spring all the same.
    assert (found.coupling.stiffness_n_per_m.status is Status.IDENTIFIED) == (until_s > 44.0)


@pytest.mark.slow
@pytest.mark.parametrize("window_s", [40.0, 35.0])
def test_a_window_that_begins_while_a_hand_leads_shows_the_cell(shared_data: Path, window_s: float) -> None:
    """What the robot was told before is unknown, and the only rest is short and disturbed."""
    path = shared_data / "cases" / "hand_then_sweep.mcap"
    if not path.is_file():
        pytest.skip("needs the recorded logs in ../shared/data")
    truth = json.loads(path.with_suffix(".truth.json").read_text())
    found = at.identify(path, windows=window_s, allow_partial=True).result.axes["z"]
    period = truth["sample_time_s"]
    truths = {"K_s": truth["Ks"], "B_s": truth["Bs"], "M_p": truth["mass"]}
    assert _untold(found, truths) == []
    delay = found.robot.delay_s.value
    assert delay == pytest.approx(truth["delay"] * period, abs=0.14 * period)
