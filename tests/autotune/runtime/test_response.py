"""The runtime in closed loop with the simulated cell has the peaks that the file predicts for its response."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.formats.controller import write_controller
from autotune.formats.controller_record import CollisionSettings, Controller, ScenarioPrediction
from autotune.formats.limits import CollisionResponse
from autotune.runtime import RuntimeController, load_controller, step
from autotune.runtime.step import Phase
from problems.arrays import FloatArray
from tests.autotune.runtime.cases import STARTED, Reading, run_contact
from tests.autotune.tuning.responding import responding, varied

# As between a predicted contact and its replay: from rest, the touch falls between two ticks.
SAME_PEAK = 0.02


def test_the_peaks_in_closed_loop_are_those_in_the_file(tmp_path: Path) -> None:
    whole = responding().controller
    responded = _in_closed_loop(whole, whole.predicted["x"].with_collision_response, tmp_path)
    # After the touch, and sooner on the stiffer wall.
    assert 0 < responded[1] < responded[0]


def test_so_are_those_of_a_damping_that_varies(tmp_path: Path) -> None:
    whole = replace(varied(), collision=CollisionSettings(response=CollisionResponse.NONE, threshold_n=None))
    predicted = {"x": replace(whole.predicted["x"], with_collision_response=())}
    stated = whole.predicted["x"].with_variable_damping
    # The peaks are held there; without a response nothing responds.
    assert _in_closed_loop(replace(whole, predicted=predicted), stated, tmp_path) == []


def _in_closed_loop(whole: Controller, stated: Sequence[ScenarioPrediction], tmp_path: Path) -> list[int]:
    """Hold the peaks of the first and the last contact against the runtime's; return when it responded."""
    write_controller(tmp_path / "controller.yaml", whole)
    loaded = load_controller(tmp_path / "controller.yaml", sample_time_s=8e-4, payload_mass_kg=6.3)
    # What is predicted is the law without its deadband.
    runtime = replace(loaded, axes=tuple(replace(axis, deadband=0.0) for axis in loaded.axes))
    domain = whole.certificate.domain["x"]
    responded = []
    for said in (stated[0], stated[-1]):
        driver = _Driver(runtime)
        seen = run_contact(
            driver.increment,
            0,
            force_n=30.0,
            distance_m=0.02,
            duration_s=1.2,
            plant=said.scenario().plant(domain.plants.nominal),
            payload=loaded.payload,
        )
        touch = int(np.flatnonzero(seen.contact_n)[0])
        if Phase.RESPONDED in driver.phases:
            responded.append(driver.phases.index(Phase.RESPONDED) - touch)
        assert np.max(seen.contact_n) == pytest.approx(said.peak_contact_force_n, rel=SAME_PEAK)
        assert np.max(seen.sensor_n[touch:]) == pytest.approx(said.peak_sensor_force_n, rel=SAME_PEAK)
    return responded


class _Driver:
    """Steps the runtime and notes where its response is."""

    def __init__(self, controller: RuntimeController) -> None:
        self.controller, self.state, self.phases = controller, STARTED, list[Phase]()

    def increment(self, reading: Reading) -> FloatArray:
        self.state, command = step(self.controller, self.state, **reading.arguments())  # type: ignore[arg-type]
        self.phases.append(command.phase)
        return np.array(command.increment_S)
