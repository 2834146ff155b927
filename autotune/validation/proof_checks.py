"""Check what a certificate says is proved: stability, the continuous modulus, and the sentences that state it.

The checksum only shows that nobody changed a file by accident, so a sentence is believed because it says what the
verified domain says, not because the file holds it.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from autotune.certificate.certify import METHOD
from autotune.formats.certificate_record import AxisDomain, Proof, ProvenRegion
from autotune.formats.controller_record import Controller
from autotune.formats.units import axis_units
from problems.design.uncertainty import SYMBOLS
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController

from .axis_proof import (
    Prover,
    describe_false,
    describe_unstable,
    modulus_claim,
    refuted_inside,
    stability_claim,
    stability_statements,
)
from .report import Check
from .validation_samples import sampled_claims

FORMER_METHOD = "interval Lyapunov, double precision with a bound on rounding"
"""How releases before this one proved stability; what they state is verified by `METHOD`, but for the numbers."""
_SAME_NUMBER = 1e-6
# Counts of cells of two machines differ where a cell is proved by no more than rounding.
_SAME_SHARE = 0.01


def check_stability(
    controller: Controller, name: str, law: AdmittanceController, prover: Prover, *, is_short: bool
) -> tuple[tuple[Check, ...], tuple[Proof, ...]]:
    """Prove an axis stable over K_e and M_p; return the checks, and what a certificate may state of it.

    `is_short` proves stability alone where the file states a modulus with it, and says nothing of its numbers. So it
    is proved, too, where the modulus of the file is false.
    """
    certificate, units = controller.certificate, axis_units(name)
    domain, regions = certificate.domain[name], (certificate.continuous or {}).get(name, ())
    claim = stability_claim(domain.plants, law, controller.sample_time_s, () if is_short else regions)
    origin, found = prover.origin(claim), prover.prove(claim)
    if not found.holds and claim.modulus is not None:
        claim = stability_claim(domain.plants, law, controller.sample_time_s)
        origin, found = prover.origin(claim), prover.prove(claim)
    (low, high), (light, heavy) = domain.environment_stiffness_n_per_m, domain.payload_mass_kg
    rest = "" if domain.uncertain is None else ", the rest of the plant nominal"
    scale, unit = units.shown_stiffness
    checks = []
    for where, parts, stiffness in (
        ("free space", found.free_space, ""),
        ("contact", found.contact, f" and every K_e in [{scale * low:g}, {scale * high:g}] {unit}"),
    ):
        passed = all(part.holds for part in parts)
        cells = f"{sum(part.cells for part in parts)} cells{origin}"
        message = f"proved for every M_p in [{light:g}, {heavy:g}] {units.mass}{stiffness}{rest} ({cells})"
        message = message if passed else describe_unstable(found, units)
        checks.append(Check(axis=name, name=f"stability in {where}", passed=passed, message=message))
        if not passed:
            break
    statements = stability_statements(domain.plants, claim, found, name)
    return tuple(checks), tuple(replace(each, numbers=None) for each in statements) if is_short else statements


def check_statements(controller: Controller, name: str, proved: Sequence[Proof]) -> Check:
    """Hold the sentences of the certificate against those that the verified domain makes."""
    wrong = wrong_statements(controller, name, proved)
    message = "; ".join(wrong) or "proved and sampled state what the certified domain says"
    if any(each.method == FORMER_METHOD for each in controller.certificate.proved):
        message += f"; {FORMER_METHOD!r} is the method of an earlier release, verified here by {METHOD!r}"
    return Check(axis=name, name="statements", passed=not wrong, message=message)


def wrong_statements(controller: Controller, name: str, proved: Sequence[Proof]) -> list[str]:
    """Return what the certificate states of one axis and the verified domain does not.

    `proved` is what was verified; of a statement there without numbers those of the file are not looked at. Less may
    be stated than could be. What is stated of no tuned axis belongs to the first one.
    """
    certificate, first = controller.certificate, next(iter(controller.axes))
    domain, regions = certificate.domain[name], (certificate.continuous or {}).get(name, ())
    # As releases before this one say it: by another method, and before that of the same loops in fewer words.
    composed = [*proved, *(replace(each, method=FORMER_METHOD, numbers=None) for each in proved)]
    composed += [replace(each, claim=each.claim.replace("stable while it stays", "stable")) for each in composed]
    bouncing = (certificate.bouncing or {}).get(name)
    sampled = sampled_claims(domain, certificate.margins[name], controller.predicted[name], name, regions, bouncing)
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
        for each in regions
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
    return f" with {_listed(stated.numbers)}, found {_listed(same.numbers)}"


def _listed(numbers: Mapping[str, float] | None) -> str:
    return ", ".join(f"{key} {value:g}" for key, value in (numbers or {}).items()) or "no numbers"


def _says(stated: Proof, found: Proof) -> bool:
    if (stated.claim, stated.method, stated.over) != (found.claim, found.method, found.over):
        return False
    said, numbers = stated.numbers or {}, found.numbers
    return numbers is None or (
        said.keys() == numbers.keys()
        and all(math.isclose(value, numbers[key], rel_tol=_SAME_SHARE) for key, value in said.items())
    )


def check_continuous(controller: Controller, name: str, law: AdmittanceController, prover: Prover) -> Iterator[Check]:
    """Prove again how far a modulus holds; more than is claimed may be proved, less may not."""
    for region in (controller.certificate.continuous or {}).get(name, ()):
        domain = controller.certificate.domain[name]
        yield _continuous(name, domain, region, law, controller.sample_time_s, prover)


def _continuous(
    name: str, domain: AxisDomain, region: ProvenRegion, law: AdmittanceController, sample_time_s: float, prover: Prover
) -> Check:
    units, (low, high) = axis_units(name), region.environment_stiffness_n_per_m
    over = ", ".join(SYMBOLS.get(each, each) for each in region.over)
    bound = f"|1 + L| > {region.modulus:.4g} and stable at every frequency, over {over}"
    try:
        claim = modulus_claim(domain.plants, law, sample_time_s, region.over, region.modulus, region.budget_s)
        origin, found = prover.origin(claim), prover.prove(claim)
    except ParameterError as error:
        return Check(axis=name, name="continuous proof", passed=False, message=str(error))
    false = refuted_inside(domain.plants, found)
    wide = domain.environment_stiffness_n_per_m
    proved = wide if found.holds else (wide[0], found.up_to(wide[0]))
    share = 0.0 if found.false else found.share
    passed = (
        false is None and region.share <= share + _SAME_NUMBER and high <= max(proved[1], low) * (1.0 + _SAME_NUMBER)
    )
    if false is not None:
        message = describe_false(false, units)
    elif not passed:
        message = f"{bound}: claimed for the share {region.share:.4g}, proved for {share:.4g}"
    elif region.share <= 0.0:
        message = f"not proved: nothing could be shown within the budget of {bound}"
    elif region.share < 1.0:
        scale, unit = units.shown_stiffness
        reached = f"{100.0 * region.share:.4g} % of the set, K_e up to {scale * high:g} {unit}"
        message = f"{bound}: proved up to here, {reached}"
    else:
        counts = f"{found.cells} cells, {found.arcs} arcs, {found.run_time_s:.1f} s{origin}"
        message = f"{bound}: proved ({counts})"
    return Check(axis=name, name="continuous proof", passed=passed, message=message, warns=region.share <= 0.0)
