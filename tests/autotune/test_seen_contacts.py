"""A wall that chatters in the log is in the file, and in the range that a controller is certified for."""

from pathlib import Path

import pytest

from autotune.formats.problem import ProblemSpec
from autotune.pipeline import identify_log
from autotune.tuning.problems import DesignOptions, build_problems
from identification.result import Status


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
    low, high = build_problems(found, ProblemSpec(), DesignOptions())["z"].plants.environment_stiffness_n_per_m
    assert low < 3e4
    assert high > 2e5
    # Dry friction of 20 N makes the wrench look 0.11 ms late, which is no filter.
    assert found.sensor.wrench_filter is None
