"""Two controllers side by side: one evaluator, the same scenarios, and nothing told of an unstable loop."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.cli._common import json_text
from autotune.cli._optimized import compare_lines, compare_tree
from autotune.errors import InfeasibleError, UsageError
from autotune.formats.controller import ControllerFile
from autotune.formats.controller_record import (
    CollisionSettings,
    Controller,
    ControllerStatus,
    Filters,
    admittance_controller,
)
from autotune.formats.limits import CollisionResponse
from autotune.prediction.law import PresentGains
from autotune.tuning import search as search_module
from autotune.tuning.compare import check_comparable, compare, judge_design, start_design
from autotune.tuning.search import solve_design
from problems.design.problem import VARIABLES
from problems.model.controller import AdmittanceController
from tests.autotune.tuning.cases import fast_optimized
from tests.autotune.tuning.turning import both_optimized

GAINS = {"mass": 6.0, "damping": 1300.0, "lead_s": 0.02, "feedback_damping_s": 0.005}


def old_with(**gains: float) -> Controller:
    controller = fast_optimized().controller
    return replace(controller, axes={"x": replace(controller.axes["x"], **{**GAINS, **gains})})  # type: ignore[arg-type]


def old_law(**gains: float) -> AdmittanceController:
    return admittance_controller(old_with(**gains), "x")


def file_of(controller: Controller) -> PresentGains:
    file = ControllerFile(controller=controller, checksum="ab" * 32, path=Path("old.yaml"), sha256="0" * 64)
    return PresentGains.of_file(file)


def test_a_controller_beside_itself_is_the_same_and_shows_what_its_file_says() -> None:
    found = fast_optimized()
    both = compare(file_of(found.controller), found.searches)["x"]
    assert both.old == both.new
    assert both.is_start
    does, margins = both.old.performance, found.controller.certificate.margins["x"]
    assert does is not None
    assert {name: getattr(margins, name) for name in does.margins} == dict(does.margins)
    assert does.min_m_s_per_n == found.controller.predicted["x"].free_space_admittance.min_m_s_per_n
    assert does.missed == {}
    # The file lists 5 of the 33 surfaces, the ends among them; the worst contact is no gentler than its worst.
    said = max(s.peak_contact_force_n for s in found.controller.predicted["x"].scenarios)
    assert said <= does.peak_contact_force_n <= 1.01 * said


def test_what_the_old_one_misses_is_reported_with_its_share() -> None:
    # |G| is about 1/B_a: more damping than the target allows misses it by the ratio.
    both = compare(file_of(old_with(damping=2000.0)), fast_optimized().searches)["x"]
    assert both.old.performance is not None
    assert set(both.old.performance.missed) == {"free_space_admittance"}
    share = both.old.performance.min_m_s_per_n / 6.5e-4
    assert both.old.performance.missed["free_space_admittance"] == pytest.approx(1.0 / share)
    assert not both.is_start  # 2000 is above the bound of 1600
    message = "\n".join(compare_lines(file_of(old_with(damping=2000.0)), {"x": both}))
    assert f"old: misses free_space_admittance (only {100.0 * share:.4g} % of what is asked)" in message
    assert "new: meets every requirement" in message


@pytest.mark.parametrize(("end", "share"), [(0, 0.999), (1, 1.001)], ids=["below", "above"])
def test_a_design_outside_of_its_bounds_is_not_judged(end: int, share: float) -> None:
    found = fast_optimized().searches["x"]
    for i, name in enumerate(found.problem.variables):
        design = found.design.copy()
        design[i] = share * found.problem.bounds[name][end]
        with pytest.raises(InfeasibleError, match=f"{name} must lie within"):
            judge_design(found.problem, design)


def test_an_unstable_old_controller_has_no_numbers_but_a_place() -> None:
    old = old_with(damping=300.0, lead_s=0.0, feedback_damping_s=0.0)
    both = compare(file_of(old), fast_optimized().searches)["x"]
    assert both.old.performance is None
    assert both.old.spectral_radius >= 1.0
    assert both.old.unstable_at is not None
    mass, stiffness = both.old.unstable_at
    assert mass == 16.0
    assert stiffness == 0.0 or 1e5 <= stiffness <= 1.2e5
    message = "\n".join(compare_lines(file_of(old), {"x": both}))
    assert "old: UNSTABLE in" in message
    tree = compare_tree(file_of(old), {"x": both})["axes"]["x"]["old"]
    assert (tree["is_stable"], tree["peak_contact_force_n"], tree["margins"], tree["missed"]) == (False,) + (None,) * 3
    json_text(tree)


def test_a_rotational_axis_is_reported_in_its_units() -> None:
    found = both_optimized()
    both = compare(file_of(found.controller), found.searches)
    message = "\n".join(compare_lines(file_of(found.controller), both))
    assert all(unit in message for unit in ("M_a [kg·m²]", "B_a [N·m·s/rad]", "[rad/s/(N·m)]", "M_a [kg]", "[m/s/N]"))
    tree = compare_tree(file_of(found.controller), both)
    assert "peak_contact_torque_n_m" in tree["axes"]["ry"]["new"]
    assert "peak_contact_force_n" in tree["axes"]["x"]["new"]


def bare(**changes: object) -> Controller:
    """Return the controller with changes that its certificate would not allow."""
    whole = fast_optimized().controller
    h = changes.get("sample_time_s", whole.sample_time_s)
    certificate = replace(whole.certificate, domain={}, margins={}, continuous=None, sample_time_s=h)  # type: ignore[arg-type]  # a float
    fields = {"status": ControllerStatus.UNVALIDATED, "predicted": {}, "certificate": certificate, **changes}
    return replace(whole, **fields)  # type: ignore[arg-type]  # fields of the dataclass


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axes": "z", "limits": None}, "old.yaml holds z, and x is tuned here"),
        ({"sample_time_s": 1e-3}, "runs every 1 ms and this cell every 0.8 ms"),
        ({"collision": CollisionSettings(response=CollisionResponse.STOP, threshold_n=50.0)}, "responds to collisions"),
    ],
)
def test_a_controller_that_is_another_thing_is_refused(changes: dict[str, object], message: str) -> None:
    found = fast_optimized()
    problems = {"x": found.searches["x"].problem}
    if "axes" in changes:
        changes = {**changes, "axes": {changes["axes"]: found.controller.axes["x"]}}
    check_comparable(file_of(bare()), problems)
    with pytest.raises(UsageError, match=message):
        check_comparable(file_of(bare(**changes)), problems)


def test_axes_in_common_are_compared_and_the_others_left() -> None:
    """An old controller of x alone beside a new one of x and ry."""
    found = both_optimized()
    problems = {name: search.problem for name, search in found.searches.items()}
    check_comparable(file_of(old_with()), problems)
    assert list(compare(file_of(old_with()), found.searches)) == ["x"]


# --- the start ----------------------------------------------------------------------------------------------------


def test_only_gains_inside_the_bounds_and_under_the_same_filter_start_the_search() -> None:
    problem = fast_optimized().searches["x"].problem
    design = start_design(old_law(), problem)
    assert design is not None
    assert list(design) == [GAINS[name] for name in VARIABLES]
    assert start_design(old_law(mass=6.1), problem) is None  # the bounds say 6
    slow = replace(old_with(), filters=Filters(velocity_rad_per_s=60.0, acceleration_rad_per_s=200.0))
    assert start_design(admittance_controller(slow, "x"), problem) is None


def test_a_started_search_is_never_worse_than_its_start_and_repeats_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four trials, a local search and a polish that go nowhere: what is good comes from the start."""
    monkeypatch.setattr(search_module, "_POPULATION", 1)
    monkeypatch.setattr(search_module, "_GENERATIONS", 1)
    monkeypatch.setattr(search_module.Search, "local", lambda _self, _prepared, unit: unit)
    monkeypatch.setattr(search_module, "polish_exactly", lambda _screen, design, **_options: design)
    found = fast_optimized().searches["x"]
    runs = [solve_design(found.problem, seed=9, start=found.design) for _ in range(2)]
    assert np.array_equal(runs[0].design, runs[1].design)
    assert runs[0].evaluation.cost <= found.evaluation.cost
    try:
        alone = solve_design(found.problem, seed=9).evaluation.cost
    except InfeasibleError:
        alone = np.inf
    # Half a percent is what the crippled search alone stays behind; the start is met to the bit.
    assert alone > 1.002 * runs[0].evaluation.cost
