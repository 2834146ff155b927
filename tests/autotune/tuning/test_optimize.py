"""From identified parameters to a written controller: what it says is what was found and verified."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from autotune.certificate.certify import METHOD
from autotune.errors import CertificateError, InfeasibleError
from autotune.formats.controller_record import ControllerStatus, admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.limits import CollisionResponse
from autotune.tuning import optimize as optimize_module
from autotune.tuning.optimize import check_within_bounds, optimize
from autotune.tuning.record import build_controller as honest
from autotune.tuning.search import SearchResult, solve_design
from autotune.validation.axis_proof import prove_axis
from problems.arrays import FloatArray
from problems.contact.transient import build_sampled_contact, simulate_contact
from problems.design.problem import DesignProblem
from problems.design.requirements import AdmittanceTarget
from problems.model.plant import Environment
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import find_margins
from tests.autotune.tuning.cases import FAST_SPEC, ROOM, fast_optimized, identified_plant


@pytest.fixture
def plant() -> IdentifiedFile:
    return IdentifiedFile(result=identified_plant(), provenance={}, path=Path("identified.yaml"), sha256="0" * 64)


def test_the_controller_is_the_design_and_it_was_validated() -> None:
    found = fast_optimized()
    gains, design = found.controller.axes["x"], found.searches["x"].design
    assert (gains.mass, gains.damping, gains.lead_s, gains.feedback_damping_s) == tuple(design)
    assert found.controller.status is ControllerStatus.VALIDATED
    assert found.report.passed
    assert found.controller.collision.response is CollisionResponse.NONE
    assert found.controller.delay_samples == pytest.approx(3.0)
    assert found.controller.compensation_mass_kg == 0.0


def test_the_domain_is_what_was_asked() -> None:
    domain = fast_optimized().controller.certificate.domain["x"]
    assert domain.payload_mass_kg == FAST_SPEC.payload_mass
    assert domain.environment_stiffness_n_per_m == FAST_SPEC.environment_stiffness
    assert (domain.approach_force_n, domain.approach_speed_m_s) == (30.0, None)
    assert domain.robot_denominator == (1.0, 20.0)


def test_every_predicted_contact_is_the_exact_transient() -> None:
    found = fast_optimized()
    problem = found.searches["x"].problem
    law = problem.controller(found.searches["x"].design)
    scenarios = found.controller.predicted["x"].scenarios
    low, high = problem.plants.environment_stiffness_n_per_m
    assert [scenarios[0].environment_stiffness_n_per_m, scenarios[-1].environment_stiffness_n_per_m] == [low, high]
    for said in scenarios:
        plant = found.searches["x"].active.pairs[0].contact.plant
        here = plant.in_contact_with(
            Environment(stiffness_n_per_m=said.environment_stiffness_n_per_m, damping_n_s_per_m=0.0)
        )
        run = simulate_contact(build_sampled_contact(build_sampled_plant(here, 8e-4)), law, problem.approach)
        assert said.peak_contact_force_n == pytest.approx(run.peak_contact_force_n, rel=1e-9)
        assert said.peak_sensor_force_n == pytest.approx(run.peak_sensor_force_n, rel=1e-9)
        assert said.time_of_peak_s == run.time_of_peak_s


def test_the_margins_are_those_of_the_worst_plants_that_are_named() -> None:
    found = fast_optimized()
    margins, problem = found.controller.certificate.margins["x"], found.searches["x"].problem
    law, plant = problem.controller(found.searches["x"].design), found.searches["x"].active.pairs[0].contact.plant
    for name, case in margins.worst.items():
        stiffness = float(case["environment_stiffness_n_per_m"])
        here = plant.in_contact_with(Environment(stiffness_n_per_m=stiffness))
        there = find_margins(build_sampled_plant(here, 8e-4), law)
        assert getattr(margins, name) == pytest.approx(getattr(there, name), rel=1e-9)
    assert set(margins.worst) == {"modulus", "gain_db", "phase_deg", "delay_s"}


def test_the_requirements_and_proofs_are_written_down() -> None:
    certificate = fast_optimized().controller.certificate
    assert certificate.requirements["modulus_margin"] == 0.5
    target = certificate.requirements["free_space_admittance"]
    assert isinstance(target, AdmittanceTarget)
    assert (target.min_m_s_per_n, target.band_hz) == (6.5e-4, (1.0, 2.0))
    assert "decay_rate_per_s" not in certificate.requirements
    claims = [proof.claim for proof in certificate.proved]
    assert [("free space" in c, "contact" in c) for c in claims] == [(True, False), (False, True)]
    (reach,) = (certificate.continuous or {})["x"]
    numbers = [proof.numbers or {} for proof in certificate.proved]
    assert all(proof.method == METHOD for proof in certificate.proved)
    assert [each["modulus"] for each in numbers] == [reach.modulus, reach.modulus]
    assert sum(each["cells"] for each in numbers) == reach.cells


def test_what_was_proved_for_the_certificate_is_not_proved_again_and_named_so() -> None:
    messages = {check.name: check.message for check in fast_optimized().report.checks}
    for name in ("stability in free space", "stability in contact", "continuous proof"):
        assert messages[name].endswith(", proved when this certificate was made)")


def test_a_design_outside_of_its_bounds_is_never_written() -> None:
    search = fast_optimized().searches["x"]
    check_within_bounds(search, "x")
    for factor in (0.5, 2.0):
        narrow = {**search.problem.bounds, "lead_s": (factor * search.design[2], factor * search.design[2])}
        moved = replace(search, problem=replace(search.problem, bounds=narrow))
        with pytest.raises(CertificateError, match=r"Axis x: the design found has lead_s .*nothing is written"):
            check_within_bounds(moved, "x")


def test_a_claim_that_cannot_be_proved_stops_everything() -> None:
    found = fast_optimized()
    lively = replace(admittance_controller(found.controller, "x"), damping_n_s_per_m=600.0, lead_s=0.0)
    with pytest.raises(
        CertificateError, match=r"Axis x: stability with a modulus of 0\.5 is refuted at K_e .* M_p 16 kg"
    ):
        prove_axis(found.controller.certificate.domain["x"].plants, lively, 8e-4, "x", 0.5 / 0.95)


def test_a_controller_that_validation_refuses_is_not_returned(
    plant: IdentifiedFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Validation is asked before anything is handed out, whatever the search believed."""

    found = fast_optimized().searches["x"]

    def boasting(*arguments: object, **further: object) -> object:
        controller = honest(*arguments, **further)  # type: ignore[arg-type]  # handed on as they came
        margins = replace(controller.certificate.margins["x"], modulus=0.9)
        return replace(controller, certificate=replace(controller.certificate, margins={"x": margins}))

    monkeypatch.setattr(optimize_module, "build_controller", boasting)
    monkeypatch.setattr(optimize_module, "solve_design", lambda *_args, **_kwargs: found)
    with pytest.raises(CertificateError, match=r"modulus is claimed as 0\.9, found 0\.5"):
        optimize(plant, FAST_SPEC, seed=1)


def test_a_search_that_ends_outside_begins_again_at_a_design_that_meets_everything(
    plant: IdentifiedFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What looks for relaxations finds it, so that nothing has to be relaxed."""
    starts: list[FloatArray] = []

    def blind(problem: DesignProblem, **options: Any) -> SearchResult:
        if options.get("start") is None:
            raise InfeasibleError("nothing was found.")
        starts.append(options["start"])
        return solve_design(problem, **options)

    monkeypatch.setattr(optimize_module, "solve_design", blind)
    found = optimize(plant, FAST_SPEC, seed=1)
    assert found.controller.status is ControllerStatus.VALIDATED
    assert all(low <= value <= high for value, (low, high) in zip(starts[0], ROOM.values(), strict=True))
