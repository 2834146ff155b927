"""Ranges are held against what was identified before any search: a unit mistaken by a thousand is a usage error."""

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats.problem import ProblemSpec
from autotune.tuning.plausible import doubtful_ranges, left_out_contacts
from autotune.tuning.problems import build_problems
from identification.result import CONTACT_UNEXPLAINED, Finding
from problems.design.problem import DesignProblem
from problems.design.uncertainty import STIFFNESS
from problems.model.plant_parameters import with_values
from tests.autotune.tuning.cases import design_problem, identified_axis, identified_plant, known, with_axis, write_plant

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
IDENTIFIED, with_ranges = identified_plant(), ProblemSpec().with_options
SURFACE = IDENTIFIED.axes["x"].environments[0].stiffness_n_per_m.value or 0.0
MASS = IDENTIFIED.payload.mass_kg.value or 0.0


@pytest.mark.parametrize(
    ("spec", "meant"),
    [
        (with_ranges(environment_stiffness=(20.0, 500.0)), "did you mean 2e4:5e5"),
        (with_ranges(environment_stiffness=(1e3 * SURFACE, 2e3 * SURFACE)), "did you mean"),
        (with_ranges(payload_mass=(1e3 * MASS, 1e3 * MASS)), "did you mean"),
        (with_ranges(payload_mass=(1e-3 * MASS, 1e-3 * MASS)), "did you mean"),
        (with_ranges(payload_mass=(200.0 * MASS, 300.0 * MASS)), "a payload of"),
    ],
)
def test_a_range_in_another_unit_is_refused_with_what_was_identified(spec: ProblemSpec, meant: str) -> None:
    with pytest.raises(UsageError, match=meant):
        build_problems(IDENTIFIED, spec)


def test_a_payload_that_no_file_holds_is_refused_before_a_search_whatever_its_unit() -> None:
    spec = with_ranges(payload_mass=(16200.0, 16200.0), with_unit=frozenset({"payload_mass"}))
    with pytest.raises(UsageError, match="asks for 16200 kg; a payload of 1000 kg is the heaviest"):
        build_problems(IDENTIFIED, spec)


def test_a_problem_file_is_held_against_it_too_and_its_key_named() -> None:
    with pytest.raises(UsageError, match=r"^environment_stiffness_n_per_m asks .* and the plant has 110 N/mm") as found:
        build_problems(IDENTIFIED, ProblemSpec(environment_stiffness=(20.0, 500.0)))
    assert str(found.value).endswith(": `autotune optimize … --environment-stiffness 20:500N/m`.")
    with pytest.raises(UsageError, match=r"^payload_mass_kg asks for 16200 kg"):
        build_problems(IDENTIFIED, ProblemSpec(payload_mass=(16200.0, 16200.0)))


@pytest.mark.parametrize(
    "spec",
    [
        with_ranges(environment_stiffness=(20.0, 5e5)),  # wide, and holds what was identified
        with_ranges(environment_stiffness=(0.1 * SURFACE, 0.2 * SURFACE)),
        with_ranges(environment_stiffness=(5e3, 6e3)),  # foam instead of the wall
        with_ranges(environment_stiffness=(20.0, 500.0), with_unit=frozenset({"environment_stiffness"})),
        with_ranges(payload_mass=(0.5 * MASS, 2.0 * MASS)),
    ],
)
def test_what_is_meant_passes(spec: ProblemSpec) -> None:
    assert build_problems(IDENTIFIED, spec)


def test_without_a_surface_there_is_nothing_to_compare_with() -> None:
    bare = replace(IDENTIFIED, axes={"x": replace(IDENTIFIED.axes["x"], environments=())})
    assert build_problems(bare, with_ranges(environment_stiffness=(20.0, 500.0)))


@pytest.mark.parametrize(
    ("options", "output"),
    [
        (("--environment-stiffness", "20:500"), "N/mm ="),
        (("--payload-mass", "16200"), "did you mean 16.2?"),
    ],
)
def test_through_the_command_line_nothing_is_searched(
    run_cli: RunCli, tmp_path: Path, options: tuple[str, str], output: str
) -> None:
    write_plant(tmp_path)
    done = run_cli("optimize", "identified.yaml", *options)
    assert done.returncode == 2
    assert output in done.stderr
    assert len(done.stderr) < 400
    assert not (tmp_path / "controller.yaml").exists()


def touching(problem: DesignProblem, stiffness: tuple[float, float]) -> DesignProblem:
    return replace(problem, plants=problem.plants.with_ranges({STIFFNESS: stiffness}))


def delayed(low: float, high: float) -> DesignProblem:
    """As `optimize` builds it: the nominal value moves into the range that was said."""
    problem = design_problem()
    inside = min(max(problem.plants.nominal.robot.delay_s, low), high)
    nominal = with_values(problem.plants.nominal, {"delay_s": inside})
    return replace(problem, plants=replace(problem.plants, nominal=nominal).with_ranges({"delay_s": (low, high)}))


@pytest.mark.parametrize(
    ("interval", "output"),
    [
        ((0.0, 0.0), "delay_s in problem.yaml, 0, lies 1200 deviations off what was identified, 0.0024 ± 2e-06;"),
        ((2.5e-3, 3e-3), "delay_s in problem.yaml, 0.0025 to 0.003, lies 50 deviations off"),
        ((2.409e-3, 3e-3), ""),
        ((2.0e-3, 3e-3), ""),
    ],
)
def test_a_range_far_from_what_was_identified_is_reported(interval: tuple[float, float], output: str) -> None:
    axis = identified_axis()
    axis = replace(axis, robot=replace(axis.robot, delay_s=known(2.4e-3, 2e-6)))
    found = list(doubtful_ranges(delayed(*interval), axis, "x"))
    assert [line.startswith(f"axis x: {output}") for line in found] == ([True] if output else [])


def test_what_is_known_without_deviation_or_not_at_all_is_no_conflict() -> None:
    problem = delayed(0.0, 0.0)
    for delay in (known(2.4e-3, 0.0), replace(known(2.4e-3), value=None, std=None)):
        axis = replace(identified_axis(), robot=replace(identified_axis().robot, delay_s=delay))
        assert list(doubtful_ranges(problem, axis, "x")) == []


def test_a_contact_that_a_said_range_leaves_out_is_stated() -> None:
    axis = identified_axis()
    stiff = replace(axis.environments[0], name="x2", stiffness_n_per_m=known(2e5, 1e4), peak_force_n=(75.7,))
    plant = with_axis(replace(axis, environments=(stiff,)))
    narrow = touching(design_problem(), (2e4, 5e4))
    (line,) = left_out_contacts(narrow, plant, "x")
    assert line.startswith("axis x: surface x2, touched with up to 75.7 N in the log, has K_e = 200 N/mm")
    # Of a plant that somebody wrote there is no log.
    written = with_axis(replace(axis, environments=(replace(stiff, peak_force_n=()),)))
    (line,) = left_out_contacts(narrow, written, "x")
    assert line.startswith("axis x: surface x2 has K_e = 200 N/mm")
    wide = touching(narrow, (2e4, 5e5))
    assert list(left_out_contacts(wide, plant, "x")) == []


def test_a_contact_of_unknown_stiffness_is_stated_beside_any_range() -> None:
    message = "Axis x: what was touched at 52.7 s (75.7 N) is none of the surfaces."
    finding = Finding(code=CONTACT_UNEXPLAINED, severity="error", message=message, advice="", axis="x")
    plant = replace(identified_plant(), findings=(finding,))
    wide = touching(design_problem(), (2e4, 5e5))
    (line,) = left_out_contacts(wide, plant, "x")
    assert line.startswith(message)
    assert "20 to 500 N/mm" in line
