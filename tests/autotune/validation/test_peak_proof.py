"""The force that a file says no first contact exceeds is proved again from the file, and not believed."""

from dataclasses import replace

import pytest

from autotune.formats.controller_record import CollisionSettings, Controller, admittance_controller
from autotune.formats.limits import CollisionResponse
from autotune.formats.proof_records import PeakProof
from autotune.report.controller_tables import proof_table
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.bouncing import RefutedError
from autotune.validation.peak_proof import check_peaks, prove_peaks
from autotune.validation.report import Check
from problems.model.plant import WrenchFilter
from tests.autotune.tuning.cases import small_controller


def stated(**changes: object) -> PeakProof:
    return replace((small_controller().certificate.peaks or {})["x"], **changes)  # type: ignore[arg-type]


def with_peak(peak: PeakProof) -> Controller:
    whole = small_controller()
    return replace(whole, certificate=replace(whole.certificate, peaks={"x": peak}))


def check(peak: PeakProof) -> Check:
    (found,) = check_peaks(with_peak(peak), "x", admittance_controller(small_controller(), "x"), Prover())
    return found


def test_every_design_comes_with_the_largest_peak_plus_the_slack_proved() -> None:
    largest = max(each.peak_contact_force_n for each in small_controller().predicted["x"].scenarios)
    peak = stated()
    assert peak.share == 1.0
    assert largest < peak.force_n <= 1.06 * largest
    found = check(peak)
    assert found.passed
    assert found.message.startswith(f"no first contact exceeds {peak.force_n:.4g} N, over K_e, M_p and the moment")
    claims = [each.claim for each in small_controller().certificate.proved_further]
    assert f"axis x: no first contact exceeds {peak.force_n:.4g} N" in claims


def test_a_part_of_the_set_is_not_said_to_be_all_of_it() -> None:
    whole, part = (
        next(c for c in with_peak(peak).certificate.proved_further if "first contact" in c.claim)
        for peak in (stated(), replace(stated(), share=0.375))
    )
    assert whole.over_text().startswith("every K_e and M_p")
    assert part.over_text().startswith("only 37.5 % of this set, the rest is swept: every K_e and M_p")
    page = proof_table(with_peak(replace(stated(), share=0.375)))
    words = [row[1].text for row in page.rows if "first contact" in row[0].text]
    assert words == ["proved in part"]


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"force_n": 31.0}, "refuted at K_e"),
        ({"budget_s": 1e-3}, "claimed for the share 1, proved for 0"),
    ],
)
def test_more_than_is_true_is_not_believed(changes: dict[str, object], reported: str) -> None:
    found = check(stated(**changes))
    assert not found.passed
    assert reported in found.message


def test_a_file_with_a_collision_response_says_nothing_of_the_law_without_it() -> None:
    response = CollisionSettings(response=CollisionResponse.RESET, threshold_n=20.0)
    reset = replace(with_peak(stated()), collision=response)
    assert list(check_peaks(reset, "x", admittance_controller(reset, "x"), Prover())) == []


def test_a_claim_that_is_false_names_the_plant_and_one_that_is_not_covered_is_none() -> None:
    whole = small_controller()
    domain, law = whole.certificate.domain["x"], admittance_controller(whole, "x")
    with pytest.raises(RefutedError, match=r"Axis x: a first contact of K_e .* exceeds 31\.5 N") as raised:
        prove_peaks(Prover(), domain.plants, law, 8e-4, "x", domain.approach, 30.0, ProofOptions())
    assert domain.plants.contains(raised.value.scenario)
    filtered = replace(domain, wrench_filter=WrenchFilter(time_constant_s=1e-3)).plants
    assert prove_peaks(Prover(), filtered, law, 8e-4, "x", domain.approach, 60.0, ProofOptions()) is None
