"""Further free variables: filters and compensation in the search, the file, and its validation."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from autotune.errors import UsageError
from autotune.formats.controller import read_controller, write_controller
from autotune.formats.controller_record import admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.problem import ProblemSpec
from autotune.tuning.bounds import Box, presentable
from autotune.tuning.compare import start_design
from autotune.tuning.optimality import active_rows, unit_widths
from autotune.tuning.optimize import Optimized, optimize
from autotune.tuning.problems import build_problems
from autotune.validation.validate import validate_controller
from problems.design.evaluation import build_scenarios
from problems.design.problem import VARIABLES
from problems.model.controller import AdmittanceController
from tests.autotune.tuning.cases import (
    FAST_SPEC,
    ROOM,
    design_problem,
    fast_optimized,
    identified_plant,
    solved,
)
from tests.autotune.tuning.turning import two_axes

FREE = {
    "velocity_filter_rad_per_s": (60.0, 300.0),
    "acceleration_filter_rad_per_s": (60.0, 400.0),
    "compensation_mass_kg": (0.0, 12.0),
}


# Far enough from none that its part in the loop shows.
COMPENSATED = {**FREE, "compensation_mass_kg": (4.0, 16.0)}


@cache
def free_optimized() -> Optimized:
    plant = IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)
    return optimize(plant, replace(FAST_SPEC, free=COMPENSATED), seed=1)


def test_the_box_maps_its_corners_and_back() -> None:
    problem = design_problem(bounds={**ROOM, **FREE})
    box = Box(problem)
    for unit in (np.zeros(7), np.ones(7), np.linspace(0.1, 0.9, 7)):
        assert box.unit(box.design(unit)) == pytest.approx(unit, abs=1e-12)
    assert box.design(np.zeros(7))[4:] == pytest.approx([60.0, 60.0, 0.0])
    # Corner frequencies by equal ratios, what may be zero by equal steps.
    assert box.design(np.full(7, 0.5))[4:] == pytest.approx([np.sqrt(60.0 * 300.0), np.sqrt(60.0 * 400.0), 6.0])


@pytest.mark.parametrize("compensation", [0.0, 4.0])
def test_the_gradients_by_the_further_variables_are_those_of_the_evaluation(compensation: float) -> None:
    """Also without compensation, where the symbolic form does not know P̂."""
    problem = design_problem(bounds={**ROOM, **FREE})
    prepared = build_scenarios(problem, problem.scenarios(2, 2))
    design = np.array([*solved().design * [1.1, 1.0, 0.9, 1.0], 150.0, 120.0, compensation])
    widths = unit_widths(problem, design)
    _, limits = active_rows(prepared, design, near=10.0)
    for name in ("modulus_margin", "free_space_admittance"):
        row = max((each for each in limits if each.name == name), key=lambda each: each.value)
        for i in (4, 6):
            step = np.zeros(7)
            step[i] = 1e-5 * widths[i]
            down = design if design[i] == 0.0 else design - step
            values = [prepared.evaluate(d, peaks_if_missed=True).requirements[name] for d in (design + step, down)]
            slope = np.log(values[0] / values[1]) * widths[i] / (design[i] + step[i] - down[i])
            assert row.gradient[i] == pytest.approx(slope, abs=0.01 * float(np.linalg.norm(row.gradient)))


def test_more_freedom_makes_a_gentler_contact_that_validates() -> None:
    found, fixed = free_optimized(), fast_optimized()
    assert found.report.passed
    assert found.searches["x"].evaluation.cost < 0.99 * fixed.searches["x"].evaluation.cost
    assert found.optimality_reports["x"].optimality.relative_residual < 5e-3
    assert found.controller.compensation_mass_kg >= 4.0


def test_the_file_shows_what_was_chosen_and_is_read_back(tmp_path: Path) -> None:
    found = free_optimized()
    write_controller(tmp_path / "controller.yaml", found.controller)
    read = read_controller(tmp_path / "controller.yaml").controller
    assert read == found.controller
    search = found.searches["x"]
    reported = (read.filters.velocity_rad_per_s, read.filters.acceleration_rad_per_s, read.compensation_mass_kg)
    assert reported == tuple(search.design[len(VARIABLES) :])
    assert start_design(admittance_controller(read, "x"), search.problem) == pytest.approx(search.design, rel=0.0)


@pytest.mark.parametrize(
    "changed",
    [
        lambda c: replace(c, compensation_mass_kg=0.0),
        lambda c: replace(c, compensation_mass_kg=3.0 * c.compensation_mass_kg),
        lambda c: replace(c, filters=replace(c.filters, velocity_rad_per_s=15.0)),
        lambda c: replace(c, filters=replace(c.filters, acceleration_rad_per_s=1500.0)),
    ],
)
def test_another_filter_or_compensation_is_not_what_was_certified(changed) -> None:  # type: ignore[no-untyped-def]
    assert not validate_controller(changed(free_optimized().controller)).passed


def test_a_file_has_room_for_one_choice() -> None:
    spec = ProblemSpec(free=FREE)
    with pytest.raises(UsageError, match="one axis at a time"):
        build_problems(two_axes(), spec)
    turning = replace(spec, axes=("ry",))
    with pytest.raises(UsageError, match="compensation_mass_kg is a mass, and ry turns"):
        build_problems(two_axes(), turning)
    filters = replace(turning, free={"velocity_filter_rad_per_s": (60.0, 300.0)})
    assert build_problems(two_axes(), filters)["ry"].variables[-1] == "velocity_filter_rad_per_s"


def test_a_compensation_that_may_be_zero_is_none_there() -> None:
    law = design_problem(bounds={**ROOM, **FREE}).controller([6.0, 1200.0, 0.02, 0.005, 100.0, 90.0, 0.0])
    assert law == AdmittanceController(
        mass_kg=6.0,
        damping_n_s_per_m=1200.0,
        lead_s=0.02,
        feedback_damping_s=0.005,
        velocity_filter_rad_per_s=100.0,
        acceleration_filter_rad_per_s=90.0,
    )
    assert not law.compensates


def test_a_compensation_that_is_nothing_beside_its_bounds_is_written_as_none() -> None:
    problem = design_problem(bounds={**ROOM, **FREE})
    design = np.array([6.0, 1200.0, 0.02, 0.005, 100.0, 90.0, 1.7e-16])
    assert presentable(problem, design)[-1] == 0.0
    assert presentable(problem, np.array([*design[:-1], 0.1234567]))[-1] == 0.123457
