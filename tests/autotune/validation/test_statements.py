"""The sentences of a certificate: those of the verified domain, and no others."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from autotune.formats.controller_record import Controller, Proof
from autotune.validation.proof import StabilityProof
from autotune.validation.statements import wrong_statements
from autotune.validation.validation_samples import sampled_claims
from tests.autotune.tuning.cases import FURTHER, small_controller

Change = Callable[[Controller], Controller]


def proofs(controller: Controller) -> dict[str, StabilityProof]:
    """The proofs as the file states their numbers; that they hold is verified elsewhere."""
    numbers = [stated.numbers or {} for stated in controller.certificate.proved]
    return {
        where: StabilityProof(holds=True, cells=int(of["cells"]), slack=of["smallest_decrease"])
        for where, of in zip(("in free space", "in contact"), numbers, strict=True)
    }


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
    "another method": (proved(method="belief"), "by 'belief', verified by 'interval Lyapunov"),
    "another claim": (proved(claim="axis x: never touches"), "'axis x: never touches' .* which nothing verifies"),
    "of no axis": (
        lambda c: _certified(c, proved=(*c.certificate.proved, HUMANS)),
        "'nobody is hurt' .* nothing verifies",
    ),
    "other numbers": (
        proved(numbers={"cells": 1e9, "smallest_decrease": 0.5}),
        r"with cells 1e\+09, .* found cells \d",
    ),
    "no numbers": (proved(numbers=None), "with no numbers, found cells"),
    "more plants": (sampled(numbers={"plants": 1e9, "replayed": 4.0, "seed": 7919.0}), r"with plants 1e\+09, .* found"),
    "a wider set": (sampled(over="K_e, M_p and all else"), "'K_e, M_p and all else', verified over 'K_e, M_p and K_s"),
}


@pytest.mark.parametrize("name", list(FALSE_STATEMENTS))
def test_a_statement_that_the_domain_does_not_make_is_told(name: str) -> None:
    change, told = FALSE_STATEMENTS[name]
    (wrong,) = wrong_statements(change(uncertain()), "x", proofs(uncertain()))
    with pytest.raises(AssertionError, match=told):
        raise AssertionError(wrong)


def test_another_method_of_the_continuous_proof_is_told() -> None:
    (reach,) = (small_controller().certificate.continuous or {})["x"]
    other = _certified(small_controller(), continuous={"x": (replace(reach, method="belief"),)})
    (wrong,) = wrong_statements(other, "x", proofs(other))
    assert wrong.startswith("continuous states the method 'belief', which is 'zero exclusion")
