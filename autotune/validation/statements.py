"""The sentences of a certificate, composed from its domain: written once, and compared when the file is verified.

The checksum only tells that nobody changed a file by accident, so a sentence is believed because it says what the
verified domain says, not because it stands in the file.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from autotune.formats.controller_record import AxisDomain, Controller, Proof
from autotune.formats.units import axis_units

from .continuous import METHOD
from .proof import StabilityProof
from .validation_samples import sampled_claims

# Counts of cells and decreases of two machines differ where a cell is proved by no more than rounding.
_SAME_SHARE, _SAME_DECREASE = 0.01, 1e-9


def stability_statement(domain: AxisDomain, proof: StabilityProof, where: str, name: str) -> Proof:
    """Return what a proof of stability says of one axis; `where` is "in free space" or "in contact".

    It says nothing of a contact that is left and made again, which `bouncing_claim` is about.
    """
    low, high = domain.environment_stiffness_n_per_m
    light, heavy = domain.payload_mass_kg
    units = axis_units(name)
    stiffness = f", K_e in [{low:g}, {high:g}] {units.stiffness}" if where == "in contact" else ""
    others = "" if domain.uncertain is None else ", everything else at its nominal value"
    return Proof(
        claim=f"axis {name}: the exact sampled loop is stable while it stays {where}",
        method="interval Lyapunov, double precision with a bound on rounding",
        over=f"every M_p in [{light:g}, {heavy:g}] {units.mass}{stiffness}{others}",
        numbers={"cells": float(proof.cells), "smallest_decrease": float(proof.slack)},
    )


def wrong_statements(controller: Controller, name: str, proofs: Mapping[str, StabilityProof]) -> list[str]:
    """Return what the certificate states of one axis and the verified domain does not; `proofs` by where they hold.

    Less may be stated than could be. What is stated of no tuned axis belongs to the first one.
    """
    certificate, first = controller.certificate, next(iter(controller.axes))
    domain, reaches = certificate.domain[name], (certificate.continuous or {}).get(name, ())
    composed = [stability_statement(domain, proof, where, name) for where, proof in proofs.items()]
    # As files of 0.1 say it: of the same loops, which a contact that is left and made again changes between.
    composed += [replace(each, claim=each.claim.replace("stable while it stays", "stable")) for each in composed]
    sampled = sampled_claims(domain, certificate.margins[name], controller.predicted[name], name, reaches)
    wrong = [
        f"{kind} states {stated.claim!r} over {stated.over!r}{_expected(stated, known)}"
        for kind, stated_all, known in (
            ("proved", certificate.proved, composed),
            ("sampled", certificate.sampled, sampled),
        )
        for stated in stated_all
        if _axis_of(stated, controller, first) == name and not any(_says(stated, each) for each in known)
    ]
    wrong += [
        f"continuous states the method {each.method!r}, which is {METHOD!r}"
        for each in reaches
        if each.method != METHOD
    ]
    return wrong


def _axis_of(stated: Proof, controller: Controller, first: str) -> str:
    return next((name for name in controller.axes if stated.claim.startswith(f"axis {name}: ")), first)


def _expected(stated: Proof, known: Sequence[Proof]) -> str:
    """Say what is verified in its place, and what differs where the words are the same."""
    same = next((each for each in known if each.claim == stated.claim), None)
    if same is None:
        return ", which nothing verifies"
    if same.over != stated.over:
        return f", verified over {same.over!r}"
    if same.method != stated.method:
        return f" by {stated.method!r}, verified by {same.method!r}"
    return f" with {_told(stated.numbers)}, found {_told(same.numbers)}"


def _told(numbers: Mapping[str, float] | None) -> str:
    return ", ".join(f"{key} {value:g}" for key, value in (numbers or {}).items()) or "no numbers"


def _says(stated: Proof, found: Proof) -> bool:
    said, numbers = stated.numbers or {}, found.numbers or {}
    return (
        (stated.claim, stated.method, stated.over) == (found.claim, found.method, found.over)
        and said.keys() == numbers.keys()
        and all(
            math.isclose(value, numbers[key], rel_tol=_SAME_SHARE, abs_tol=_SAME_DECREASE)
            for key, value in said.items()
        )
    )
