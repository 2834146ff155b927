"""What a certificate says of continuous ranges: the claim, how far it was proved, and what is refused."""

from dataclasses import replace

import pytest

from autotune.errors import CertificateError
from autotune.formats.controller_record import AxisDomain, ConfidenceSet
from autotune.validation.continuous import ProofWishes, prove_over, prove_reach, refuted_inside
from autotune.validation.validate import admittance_controller
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
        CertificateError, match=r"Axis x: stability with a modulus of .* is refuted at M_p = 16 kg.* Hz"
    ):
        prove_reach(domain, law, 8e-4, "x", 1.1 * swept, ProofWishes())


def test_all_that_is_uncertain_is_proved_as_far_as_the_budget_goes() -> None:
    domain, law, swept = case()
    wide = replace(domain, uncertain=FURTHER)
    (alone,) = prove_reach(wide, law, 8e-4, "x", 0.9 * swept, ProofWishes(further_s=0.0))
    assert alone.over == BOTH
    first, second = prove_reach(wide, law, 8e-4, "x", 0.9 * swept, ProofWishes(further_s=2.0))
    assert first == alone
    assert second.over == (*BOTH, *FURTHER)
    assert second.share == 1.0
    _, cut = prove_reach(wide, law, 8e-4, "x", 0.9 * swept, ProofWishes(further_s=0.02))
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
        found = prove_over(of, law, 8e-4, over, 0.95 * swept, 200_000)
        assert found.false is not None
        assert (refuted_inside(of, found) is not None) == is_false


@pytest.mark.parametrize("change", [{"slack": 0.0}, {"slack": 1.0}, {"budget_s": 0.0}, {"further_s": float("inf")}])
def test_wishes_that_cannot_be_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be"):
        ProofWishes(**change)
