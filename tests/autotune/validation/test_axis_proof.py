"""What a certificate says of continuous ranges: the claim, how far it was proved, and what is refused."""

from dataclasses import replace
from typing import Any

import pytest

from autotune.certificate.certify import METHOD, prove
from autotune.certificate.family import CombinedCertificate, ProofOutcome, Verdict
from autotune.errors import CertificateError
from autotune.formats.certificate_record import AxisDomain, ConfidenceSet
from autotune.formats.controller_record import admittance_controller
from autotune.formats.units import axis_units
from autotune.text import scenario_text
from autotune.tuning.record import build_domain
from autotune.validation.axis_proof import (
    ProofOptions,
    Prover,
    describe_unstable,
    modulus_claim,
    prove_axis,
    refuted_inside,
    stability_claim,
)
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from tests.autotune.tuning.cases import fast_optimized

FURTHER = {"coupling_stiffness_n_per_m": (2.9e5, 3.1e5), "drag_n_s_per_m": (320.0, 340.0)}
BOTH = ("environment_stiffness_n_per_m", "payload_mass_kg")


def case() -> tuple[AxisDomain, AdmittanceController, float]:
    found = fast_optimized().controller
    return found.certificate.domain["x"], admittance_controller(found, "x"), found.certificate.margins["x"].modulus


def test_optimize_writes_down_what_is_proved_of_the_swept_modulus() -> None:
    found = fast_optimized().controller
    (reach,) = (found.certificate.continuous or {})["x"]
    domain = found.certificate.domain["x"]
    assert (reach.share, reach.over) == (1.0, BOTH)
    assert reach.environment_stiffness_n_per_m == domain.environment_stiffness_n_per_m
    assert reach.modulus == pytest.approx(0.95 * found.certificate.margins["x"].modulus, rel=1e-12)


def test_a_swept_modulus_that_is_none_is_refused_with_its_point() -> None:
    domain, law, swept = case()
    with pytest.raises(
        CertificateError, match=r"Axis x: stability with a modulus of .* is refuted at K_e .* M_p 16 kg.* Hz"
    ):
        prove_axis(domain.plants, law, 8e-4, "x", 1.1 * swept)


def test_all_that_is_uncertain_is_proved_as_far_as_the_budget_goes() -> None:
    domain, law, swept = case()
    wide = replace(domain, uncertain=FURTHER)
    (alone,) = prove_axis(wide.plants, law, 8e-4, "x", 0.9 * swept, ProofOptions(further_s=0.0)).regions
    assert alone.over == BOTH
    first, second = prove_axis(wide.plants, law, 8e-4, "x", 0.9 * swept, ProofOptions(further_s=2.0)).regions
    assert first == alone
    assert second.over == (*BOTH, *FURTHER)
    assert second.share == 1.0
    _, cut = prove_axis(wide.plants, law, 8e-4, "x", 0.9 * swept, ProofOptions(further_s=0.02)).regions
    assert cut.share < 1.0
    assert cut.environment_stiffness_n_per_m[1] < domain.environment_stiffness_n_per_m[1]


def test_what_is_false_beside_a_confidence_set_is_not_held_against_it() -> None:
    """The proof looks at the box around the set; a corner of it may be false and no plant of the set."""
    domain, law, swept = case()
    ranges = {"drag_n_s_per_m": (5.0, 655.0)}
    spread = ConfidenceSet(
        level=0.95, centre={"drag_n_s_per_m": 330.0}, covariance={"drag_n_s_per_m": {"drag_n_s_per_m": 1.0}}
    )
    over = (*BOTH, "drag_n_s_per_m")
    for confidence, is_false in ((None, True), (spread, False)):
        of = replace(domain, uncertain=ranges, confidence=confidence)
        found = prove(modulus_claim(of.plants, law, 8e-4, over, 0.95 * swept, 200_000))
        assert found.false is not None
        assert (refuted_inside(of.plants, found) is not None) == is_false


def test_what_the_modulus_proves_is_not_proved_again_for_stability() -> None:
    domain, law, swept = case()
    found = prove_axis(domain.plants, law, 8e-4, "x", swept)
    ((claim, answer),) = found.answers
    assert claim.modulus == pytest.approx(0.95 * swept)
    for stated, parts in zip(found.proofs, (answer.free_space, answer.contact), strict=True):
        assert stated.method == METHOD
        assert stated.numbers == {"modulus": claim.modulus, "cells": parts[0].cells, "arcs": parts[0].arcs}


def test_where_the_budget_ends_stability_is_proved_alone() -> None:
    domain, law, swept = case()
    found = prove_axis(domain.plants, law, 8e-4, "x", swept, ProofOptions(budget_s=1e-4))
    assert [claim.modulus is None for claim, _ in found.answers] == [False, True]
    (reach,) = found.regions
    assert reach.share < 1.0
    assert found.answers[1][0] == stability_claim(domain.plants, law, 8e-4, found.regions)
    assert found.answers[1][1].holds
    assert all("modulus" not in (stated.numbers or {}) for stated in found.proofs)


def test_a_claim_is_proved_once_and_where_its_answer_is_from_is_said() -> None:
    domain, law, swept = case()
    claim = modulus_claim(domain.plants, law, 8e-4, BOTH, 0.9 * swept, 60.0)
    first = Prover()
    assert first.origin(claim) == ""
    found = first.prove(claim)
    assert first.prove(claim) is found
    assert first.origin(claim) == ", the same proof as above"
    later = Prover(first.answers)
    assert later.origin(claim) == ", proved when this certificate was made"
    assert later.prove(claim) is found
    assert later.origin(stability_claim(domain.plants, law, 8e-4)) == ""


@pytest.mark.parametrize("change", [{"slack": 0.0}, {"slack": 1.0}, {"budget_s": 0.0}, {"further_s": float("inf")}])
def test_soft_limits_that_cannot_be_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="must be"):
        ProofOptions(**change)


def test_the_domain_of_a_file_is_the_set_that_was_proved() -> None:
    """Else a claim of the file would not be one that was answered when it was made, and would be proved twice."""
    problem = fast_optimized().searches["x"].problem
    assert build_domain(problem).plants == problem.plants


def outcome(verdict: Verdict, plant: Scenario | None = None) -> ProofOutcome:
    return ProofOutcome(verdict=verdict, modulus=0.0, cells=1, arcs=1, work=1, share=1.0, plant=plant)


def test_what_is_not_proved_is_said_with_where_the_loop_is_and_its_plant() -> None:
    good, plant = outcome(Verdict.PROVED), Scenario(environment_stiffness_n_per_m=1e5, payload_mass_kg=16.0)
    bad = outcome(Verdict.REFUTED, plant)
    units = axis_units("x")
    free = CombinedCertificate(free_space=(good, bad), contact=())
    contact = CombinedCertificate(free_space=(good,), contact=(good, bad))
    at = f": fails at {scenario_text(plant, units)}"
    assert describe_unstable(free, units) == f"stability in free space does not hold or cannot be proved{at}"
    assert describe_unstable(contact, units) == f"stability in contact does not hold or cannot be proved{at}"
