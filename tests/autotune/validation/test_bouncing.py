"""The search for contacts that bounce for ever: what it draws, what it finds, what the file says, exit code 6."""

import itertools
import math
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from autotune.formats.controller import write_controller
from autotune.formats.controller_record import admittance_controller
from autotune.validation import bouncing
from autotune.validation.bouncing import (
    LEAST_FORCE,
    RUNS,
    SPEEDS,
    bouncing_claim,
    drawn_plants,
    drawn_ratios,
    search_bouncing,
)
from autotune.validation.validate import validate_controller
from tests.autotune.tuning.cases import small_controller, uncertain_optimized
from tests.autotune.validation.bouncing_cases import bouncing_controller, written
from tests.problems.axes import linear_controller
from tests.problems.contact.test_bouncing import BOUNCY, CALMED, PERIOD_S

RunCli = Callable[..., "subprocess.CompletedProcess[str]"]


def test_plants_are_corners_and_samples_of_the_set_and_ratios_fill_the_range() -> None:
    domain = uncertain_optimized().controller.certificate.domain["x"]
    plants, whole = drawn_plants(domain), domain.plants
    assert all(whole.contains(each) for each in plants)
    assert set(whole.corners()) <= set(plants)
    ratios = drawn_ratios(len(plants))
    assert len(ratios) == len(plants)
    assert sum(map(len, ratios)) >= RUNS
    low, high = SPEEDS[0], SPEEDS[1] / LEAST_FORCE
    every = sorted(each for of_plant in ratios for each in of_plant)
    assert low <= every[0]
    assert every[-1] <= high
    # Of a thousand ratios in a range of ln 80 none are further apart than a twentieth of it.
    assert max(math.log(b / a) for a, b in itertools.pairwise(every)) < math.log(high / low) / 20


def test_a_file_whose_contact_bounces_for_ever_is_refused_with_plant_speed_and_force() -> None:
    report = validate_controller(bouncing_controller())
    failed = [check for check in report.checks if not check.passed]
    assert [check.name for check in failed] == ["bouncing"]
    for reported in ("K_e 3120 N/mm", "M_p 4 kg", "m/s with F^d = ", "times a second"):
        assert reported in failed[0].message


def test_the_same_plant_with_less_lead_passes_and_the_file_says_what_was_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # This near to bouncing every impact takes long to follow; the next test searches the full number.
    monkeypatch.setattr(bouncing, "RUNS", 128)
    calm = written(CALMED)
    assert validate_controller(calm).passed
    claim = next(each for each in calm.certificate.sampled if "bounces" in each.claim)
    assert (claim.numbers or {})["runs"] >= 128.0
    assert "a search, no proof" in claim.method
    assert all("while it stays" in each.claim for each in calm.certificate.proved)


def test_the_example_of_the_documents_does_not_bounce() -> None:
    controller = small_controller()
    law, domain = admittance_controller(controller, "x"), controller.certificate.domain["x"]
    seen = search_bouncing("x", domain, law, controller.sample_time_s)
    assert seen.passed
    assert seen.runs >= RUNS
    assert "come to rest" in seen.message()


def test_a_law_as_a_matrix_is_searched_too() -> None:
    domain = bouncing_controller().certificate.domain["x"]
    seen = search_bouncing("x", domain, linear_controller(BOUNCY, PERIOD_S), PERIOD_S)
    assert seen.found is not None
    # The force that a law takes per speed is computed with the ripple between the ticks, a ten thousandth here.
    assert seen.found.speed <= 2.0 * 10.0 / (BOUNCY.damping_n_s_per_m + domain.drag_n_s_per_m) * (1.0 + 1e-3)


def test_a_turning_axis_is_searched_in_its_own_units() -> None:
    domain = bouncing_controller().certificate.domain["x"]
    seen = search_bouncing("rx", domain, BOUNCY, PERIOD_S)
    for reported in ("N·m/rad", "kg·m²", "rad/s", "N·m:"):
        assert reported in seen.message()
    assert "torque" in str(bouncing_claim("rx", domain, "").over)


def test_a_set_that_is_approached_in_no_way_is_refused() -> None:
    domain = replace(bouncing_controller().certificate.domain["x"], approach_force_n=None)
    seen = search_bouncing("x", domain, BOUNCY, PERIOD_S)
    assert (seen.passed, seen.message()) == (False, "the domain names no approach")


def test_an_older_file_that_says_nothing_of_bouncing_is_still_searched() -> None:
    controller = bouncing_controller()
    certificate = controller.certificate
    older = replace(
        certificate,
        sampled=(),
        proved=tuple(
            replace(each, claim=each.claim.replace("stable while it stays", "stable")) for each in certificate.proved
        ),
    )
    report = validate_controller(replace(controller, certificate=older))
    assert {check.name: check.passed for check in report.checks}["statements"]
    assert [check.name for check in report.checks if not check.passed] == ["bouncing"]


def test_through_the_command_line(run_cli: RunCli, tmp_path: Path) -> None:
    write_controller(tmp_path / "controller.yaml", bouncing_controller())
    done = run_cli("validate", "controller.yaml", "--samples", "0")
    assert done.returncode == 6
    assert "bounces for ever" in done.stderr
    assert "touched at" in done.stderr
