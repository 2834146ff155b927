"""What a file says of a payload that a hand holds is proved again from the file, and not believed."""

from dataclasses import replace

import pytest

from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.proof_records import HeldProof
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.held import check_held, prove_held
from autotune.validation.report import Check
from problems.design.hand import HandImpedance
from tests.autotune.tuning.cases import small_controller
from tests.problems.axes import admittance


def stated(**changes: object) -> HeldProof:
    return replace((small_controller().certificate.held or {})["x"], **changes)  # type: ignore[arg-type]


def check(held: HeldProof) -> Check:
    whole = small_controller()
    claimed = replace(whole, certificate=replace(whole.certificate, held={"x": held}))
    (found,) = check_held(claimed, "x", admittance_controller(whole, "x"), Prover())
    return found


def test_the_default_hand_is_proved_of_every_design() -> None:
    held = stated()
    assert held.hand == HandImpedance()
    assert held.share == 1.0
    found = check(held)
    assert found.passed
    assert f"|1 + L| > {held.modulus:.4g} and stable with a hand of up to 5 kg, 50 N·s/m and 3 N/mm" in found.message
    claim = small_controller().certificate.proved_further[0]
    assert claim.over.startswith("a hand of up to 5 kg") if isinstance(claim.over, str) else False


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"modulus": 0.95}, "refuted at"),
        ({"hand": HandImpedance(stiffness_n_per_m=3e6)}, "claimed for the share 1, proved for"),
        ({"budget_s": 1e-4}, "claimed for the share 1, proved for"),
    ],
)
def test_more_than_is_true_is_not_believed(changes: dict[str, object], reported: str) -> None:
    found = check(stated(**changes))
    assert not found.passed
    assert reported in found.message


def test_a_hand_that_makes_the_loop_unstable_is_named_and_nothing_claimed() -> None:
    whole: Controller = small_controller()
    plants, hand = whole.certificate.domain["x"].plants, HandImpedance(stiffness_n_per_m=5e5)
    held = prove_held(Prover(), plants, admittance(10.0, 1000.0, 0.0), 8e-4, hand, ProofOptions(budget_s=1.0))
    assert (held.modulus, held.share) == (0.0, 0.0)
    found = check(held)
    assert found.passed
    assert found.warns
    assert "may make the loop unstable" in found.message
