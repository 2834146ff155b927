"""The sentences of a certificate: those of the verified domain, and no others."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from autotune.certificate.certify import METHOD
from autotune.formats.certificate_record import Proof
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.validation.axis_proof import Prover
from autotune.validation.proof_checks import (
    FORMER_METHOD,
    check_continuous,
    check_stability,
    check_statements,
    wrong_statements,
)
from autotune.validation.validation_samples import sampled_claims
from tests.autotune.tuning.cases import FURTHER, small_controller

Change = Callable[[Controller], Controller]


def proofs(controller: Controller) -> tuple[Proof, ...]:
    """What was verified, as the file states it; that it holds is verified elsewhere."""
    return controller.certificate.proved


@cache
def uncertain() -> Controller:
    """A file that speaks of more than K_e and M_p, with the sentences that belong to it."""
    controller = small_controller()
    certificate = controller.certificate
    domain, nominal = replace(certificate.domain["x"], uncertain=FURTHER), ", everything else at its nominal value"
    return replace(
        controller,
        certificate=replace(
            certificate,
            domain={"x": domain},
            proved=tuple(replace(stated, over=f"{stated.over}{nominal}") for stated in certificate.proved),
            sampled=sampled_claims(domain, certificate.margins["x"], controller.predicted["x"], "x"),
            continuous=None,
            # Sampled, as in a file whose contacts no multiplier was found for.
            bouncing=None,
        ),
    )


def proved(**values: Any) -> Change:
    return lambda c: _certified(c, proved=(replace(c.certificate.proved[0], **values), *c.certificate.proved[1:]))


def sampled(**values: Any) -> Change:
    return lambda c: _certified(c, sampled=(replace(c.certificate.sampled[0], **values),))


def _certified(controller: Controller, **parts: Any) -> Controller:
    return replace(controller, certificate=replace(controller.certificate, **parts))


@pytest.mark.parametrize("make", [small_controller, uncertain])
def test_what_was_written_is_what_is_composed_again(make: Callable[[], Controller]) -> None:
    assert wrong_statements(make(), "x", proofs(make())) == []


def test_the_order_of_the_entries_says_nothing() -> None:
    domain = uncertain().certificate.domain["x"]
    turned = replace(domain, uncertain=dict(reversed(list(FURTHER.items()))))
    assert wrong_statements(_certified(uncertain(), domain={"x": turned}), "x", proofs(uncertain())) == []


def test_less_may_be_stated() -> None:
    fewer = _certified(uncertain(), proved=uncertain().certificate.proved[:1], sampled=())
    assert wrong_statements(fewer, "x", proofs(uncertain())) == []


HUMANS = Proof(claim="nobody is hurt", method="belief", over="everybody")
FALSE_STATEMENTS: dict[str, tuple[Change, str]] = {
    "another set": (
        proved(over="every M_p in [1, 100] kg"),
        r"'every M_p in \[1, 100\] kg', verified over 'every M_p in",
    ),
    "another method": (proved(method="belief"), "by 'belief', verified by 'zero exclusion"),
    "another claim": (proved(claim="axis x: never touches"), "'axis x: never touches' .* which nothing verifies"),
    "of no axis": (
        lambda c: _certified(c, proved=(*c.certificate.proved, HUMANS)),
        "'nobody is hurt' .* nothing verifies",
    ),
    "other numbers": (
        proved(numbers={"modulus": 0.5, "cells": 1e9, "arcs": 3.0}),
        r"with modulus 0\.5, cells 1e\+09, .* found modulus 0\.\d",
    ),
    "no numbers": (proved(numbers=None), "with no numbers, found modulus"),
    "more plants": (sampled(numbers={"plants": 1e9, "replayed": 4.0, "seed": 7919.0}), r"with plants 1e\+09, .* found"),
    "a wider set": (sampled(over="K_e, M_p and all else"), "'K_e, M_p and all else', verified over 'K_e, M_p and K_s"),
}


@pytest.mark.parametrize("name", list(FALSE_STATEMENTS))
def test_a_statement_that_the_domain_does_not_make_is_reported(name: str) -> None:
    change, reported = FALSE_STATEMENTS[name]
    (wrong,) = wrong_statements(change(uncertain()), "x", proofs(uncertain()))
    with pytest.raises(AssertionError, match=reported):
        raise AssertionError(wrong)


def test_another_method_of_the_continuous_proof_is_reported() -> None:
    (reach,) = (small_controller().certificate.continuous or {})["x"]
    other = _certified(small_controller(), continuous={"x": (replace(reach, method="belief"),)})
    (wrong,) = wrong_statements(other, "x", proofs(other))
    assert wrong.startswith("continuous states the method 'belief', which is 'zero exclusion")


def former(**numbers: float) -> Controller:
    """A file as releases before this one wrote it, by another method and with its numbers."""
    controller = small_controller()
    stated = (replace(each, method=FORMER_METHOD, numbers=numbers) for each in controller.certificate.proved)
    return _certified(controller, proved=tuple(stated))


def test_what_an_earlier_release_states_is_verified_by_the_one_method_and_that_is_said() -> None:
    controller = former(cells=24.0, smallest_decrease=1e-3)
    check = check_statements(controller, "x", proofs(small_controller()))
    assert check.passed
    assert check.message.endswith(f"{FORMER_METHOD!r} is the method of an earlier release, verified here by {METHOD!r}")
    elsewhere = [replace(each, over="every M_p in [1, 2] kg") for each in proofs(small_controller())]
    assert not check_statements(controller, "x", elsewhere).passed


@pytest.mark.parametrize("is_short", [False, True])
def test_one_proof_answers_for_stability_and_for_the_modulus(is_short: bool) -> None:
    controller = small_controller()
    law, prover = admittance_controller(controller, "x"), Prover()
    checks, verified = check_stability(controller, "x", law, prover, is_short=is_short)
    assert [each.passed for each in checks] == [True, True]
    assert [each.claim for each in verified] == [each.claim for each in controller.certificate.proved]
    assert wrong_statements(controller, "x", verified) == []
    (claim, _), *_ = prover.answers
    assert (claim.modulus is None) == is_short
    (again,) = check_continuous(controller, "x", law, prover)
    assert again.passed
    assert again.message.endswith(", the same proof as above)") != is_short
    assert len(prover.answers) == 1 + is_short


def test_a_proof_without_its_modulus_is_that_of_stability_alone() -> None:
    """A file whose continuous proof was cut out states a modulus that nothing verifies any more."""
    controller = _certified(small_controller(), continuous=None)
    _, verified = check_stability(controller, "x", admittance_controller(controller, "x"), Prover(), is_short=False)
    wrong = wrong_statements(controller, "x", verified)
    assert len(wrong) == 2
    assert "with modulus 0." in wrong[0]
