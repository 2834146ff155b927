"""Ranges are held against what was identified before any search: a unit mistaken by a thousand is a usage error."""

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.errors import UsageError
from autotune.formats.problem import ProblemSpec
from autotune.tuning.problems import DesignOptions, build_problems
from tests.autotune.tuning.cases import identified_plant, write_plant

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]
IDENTIFIED = identified_plant()
SURFACE = IDENTIFIED.axes["x"].environments[0].stiffness_n_per_m.value or 0.0
MASS = IDENTIFIED.payload.mass_kg.value or 0.0


@pytest.mark.parametrize(
    ("options", "meant"),
    [
        (DesignOptions(environment_stiffness_n_per_m=(20.0, 500.0)), "did you mean 2e4:5e5"),
        (DesignOptions(environment_stiffness_n_per_m=(1e3 * SURFACE, 2e3 * SURFACE)), "did you mean"),
        (DesignOptions(payload_mass_kg=(1e3 * MASS, 1e3 * MASS)), "did you mean"),
        (DesignOptions(payload_mass_kg=(1e-3 * MASS, 1e-3 * MASS)), "did you mean"),
        (DesignOptions(payload_mass_kg=(200.0 * MASS, 300.0 * MASS)), "a payload of"),
    ],
)
def test_a_range_in_another_unit_is_refused_with_what_was_identified(options: DesignOptions, meant: str) -> None:
    with pytest.raises(UsageError, match=meant):
        build_problems(IDENTIFIED, ProblemSpec(), options)


def test_a_payload_that_no_file_holds_is_refused_before_a_search_whatever_its_unit() -> None:
    options = DesignOptions(payload_mass_kg=(16200.0, 16200.0), with_unit=frozenset({"payload_mass_kg"}))
    with pytest.raises(UsageError, match="asks for 16200 kg; a payload of 1000 kg is the heaviest"):
        build_problems(IDENTIFIED, ProblemSpec(), options)


def test_a_problem_file_is_held_against_it_too() -> None:
    with pytest.raises(UsageError, match="identified"):
        build_problems(IDENTIFIED, ProblemSpec(environment_stiffness_n_per_m=(20.0, 500.0)), DesignOptions())


@pytest.mark.parametrize(
    "options",
    [
        DesignOptions(environment_stiffness_n_per_m=(20.0, 5e5)),  # wide, and holds what was identified
        DesignOptions(environment_stiffness_n_per_m=(0.1 * SURFACE, 0.2 * SURFACE)),
        DesignOptions(environment_stiffness_n_per_m=(5e3, 6e3)),  # foam instead of the wall
        DesignOptions(
            environment_stiffness_n_per_m=(20.0, 500.0), with_unit=frozenset({"environment_stiffness_n_per_m"})
        ),
        DesignOptions(payload_mass_kg=(0.5 * MASS, 2.0 * MASS)),
    ],
)
def test_what_is_meant_passes(options: DesignOptions) -> None:
    assert build_problems(IDENTIFIED, ProblemSpec(), options)


def test_without_a_surface_there_is_nothing_to_compare_with() -> None:
    bare = replace(IDENTIFIED, axes={"x": replace(IDENTIFIED.axes["x"], environments=())})
    assert build_problems(bare, ProblemSpec(), DesignOptions(environment_stiffness_n_per_m=(20.0, 500.0)))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--environment-stiffness", "20:500"), "N/mm ="),
        (("--payload-mass", "16200"), "did you mean 16.2?"),
    ],
)
def test_through_the_command_line_nothing_is_searched(
    run_cli: RunCli, tmp_path: Path, options: tuple[str, str], told: str
) -> None:
    write_plant(tmp_path)
    done = run_cli("optimize", "identified.yaml", *options, timeout_s=60.0)
    assert done.returncode == 2
    assert told in done.stderr
    assert len(done.stderr) < 400
    assert not (tmp_path / "controller.yaml").exists()
