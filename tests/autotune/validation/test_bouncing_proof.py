"""That every contact comes to rest is proved again by the multiplier of the file, and not believed."""

from dataclasses import replace

import pytest

from autotune.cli._proved import rest_lines
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.proof_records import BouncingProof
from autotune.validation import bouncing
from autotune.validation.axis_proof import ProofOptions, Prover
from autotune.validation.bouncing import RUNS, RefutedError, drawn_plants, drawn_ratios
from autotune.validation.bouncing_proof import PASSIVE, check_bouncing, covers, prove_bouncing
from autotune.validation.report import Check
from problems.contact.multiplier import Multiplier
from problems.design.uncertainty import ALWAYS_UNCERTAIN
from tests.autotune.tuning.cases import small_controller, uncertain_optimized
from tests.autotune.validation.bouncing_cases import bouncing_controller, written
from tests.problems.contact.test_bouncing import BOUNCY, CALMED, PERIOD_S

WRONG = Multiplier(
    rate_s=0.0, shifts_s=(0.05,), shift_weights=(1.0,), fading_per_s=(300.0,), fading_weights=(0.01,), damper_s=0.0
)


def stated(of: Controller, **changes: object) -> BouncingProof:
    return replace((of.certificate.bouncing or {})["x"], **changes)  # type: ignore[arg-type]


def checks(of: Controller, said: BouncingProof) -> tuple[Check, ...]:
    changed = replace(of, certificate=replace(of.certificate, bouncing={"x": said}))
    return tuple(check_bouncing(changed, "x", admittance_controller(of, "x"), Prover()))


def test_a_design_over_stiffness_and_mass_is_proved_and_nothing_of_it_is_sampled() -> None:
    of = small_controller()
    said = stated(of)
    assert covers(said, of.certificate.domain["x"])
    assert said.impacts == 0.0
    (found,) = checks(of, said)
    assert found.passed
    assert found.message.startswith("every contact comes to rest, over K_e, M_p, from any state")
    assert not any("bounces" in each.claim for each in of.certificate.sampled)
    claims = [each.claim for each in of.certificate.proved_further]
    assert "axis x: every contact comes to rest, whatever it begins with" in claims


@pytest.mark.parametrize(
    ("changes", "reported"),
    [
        ({"multiplier": WRONG}, "claimed for the share 1, proved for 0"),
        ({"multiplier": None}, "stated without a multiplier"),
        ({"method": "trust"}, "by a method that is not"),
        ({"over": (*ALWAYS_UNCERTAIN, "delay_s")}, "delay_s"),
        # Over the mass alone it would be of the softest surface.
        ({"over": ("payload_mass_kg",)}, "K_e and M_p must be among"),
        ({"budget_s": 1e-3}, "proved for 0"),
    ],
)
def test_more_than_is_true_is_not_believed(changes: dict[str, object], reported: str) -> None:
    of = small_controller()
    found = checks(of, stated(of, **changes))[0]
    assert not found.passed
    assert reported in found.message


def test_what_bounces_is_refuted_whatever_is_stated_of_it() -> None:
    of = bouncing_controller()
    domain = of.certificate.domain["x"]
    with pytest.raises(RefutedError, match="bounces for ever") as refuted:
        prove_bouncing(Prover(), domain, BOUNCY, PERIOD_S, "x", ProofOptions())
    assert refuted.value.impact is not None
    (found,) = checks(of, replace(stated(small_controller()), budget_s=10.0))
    assert not found.passed


def test_the_same_plant_with_less_lead_is_proved() -> None:
    found = prove_bouncing(Prover(), written(CALMED).certificate.domain["x"], CALMED, PERIOD_S, "x", ProofOptions())
    assert (found.share, found.impacts) == (1.0, 0.0)


def test_without_a_budget_or_a_multiplier_the_search_speaks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bouncing, "RUNS", 64)
    of = small_controller()
    law, domain = admittance_controller(of, "x"), of.certificate.domain["x"]
    found = prove_bouncing(Prover(), domain, law, of.sample_time_s, "x", ProofOptions(further_s=0.0))
    assert found.multiplier is None
    assert found.share == 0.0
    assert found.impacts >= 64.0
    assert checks(of, found)[0].passed
    wrong = checks(of, replace(found, impacts=found.impacts + 1.0))[0]
    assert "impacts, and" in wrong.message
    assert not wrong.passed


def test_everything_that_is_uncertain_is_proved_with_damped_surfaces_among_it() -> None:
    of = uncertain_optimized().controller
    said, domain = stated(of), of.certificate.domain["x"]
    assert set(said.over) == {*ALWAYS_UNCERTAIN, *(domain.uncertain or {})}
    assert covers(said, domain)
    assert (said.share, said.impacts) == (1.0, 0.0)


def test_the_terminal_says_over_what_it_is_proved_or_how_many_impacts_were_followed() -> None:
    of = small_controller()
    (line,) = rest_lines(of)
    assert line == "axis x: every contact comes to rest, over K_e, M_p, proved"
    searched = stated(of, share=0.0, multiplier=None, impacts=1044.0)
    (line,) = rest_lines(replace(of, certificate=replace(of.certificate, bouncing={"x": searched})))
    assert line.endswith("1044 impacts on plants of the whole set come to rest, sampled")


def test_where_only_stiffness_and_mass_are_proved_fewer_impacts_are_followed() -> None:
    of = uncertain_optimized().controller
    said = stated(of, over=ALWAYS_UNCERTAIN)
    plants = drawn_plants(of.certificate.domain["x"])
    followed = sum(map(len, drawn_ratios(len(plants), is_short=True)))
    assert followed < RUNS
    proved, searched = checks(of, replace(said, impacts=float(followed)))
    assert proved.passed
    assert searched.message.startswith(f"none found: {followed} impacts on {len(plants)} plants")


def test_a_surface_with_a_mass_is_proved_by_passivity_and_that_again_from_the_file() -> None:
    of = small_controller()
    domain, law = of.certificate.domain["x"], admittance_controller(of, "x")
    moved = replace(domain, coupling_damping_n_s_per_m=0.0, uncertain={"environment_mass_kg": (0.0, 3.0)})
    found = prove_bouncing(Prover(), moved, law, 8e-4, "x", ProofOptions())
    assert found.method == PASSIVE
    assert found.multiplier is None
    assert found.over == (*ALWAYS_UNCERTAIN, "environment_mass_kg")
    assert covers(found, moved)
    assert found.impacts == 0.0
    file = replace(of, certificate=replace(of.certificate, domain={"x": moved}, bouncing={"x": found}))
    (check,) = check_bouncing(file, "x", law, Prover())
    assert check.passed
    assert "over K_e, M_p, M_e" in check.message
    # With damping in the coupling the force that is sampled is not bounded: impacts are followed.
    rough = replace(moved, coupling_damping_n_s_per_m=150.0)
    assert prove_bouncing(Prover(), rough, law, 8e-4, "x", ProofOptions()).impacts > 0.0
    forged = replace(file, certificate=replace(file.certificate, domain={"x": rough}))
    assert "proved for 0" in next(check_bouncing(forged, "x", law, Prover())).message
