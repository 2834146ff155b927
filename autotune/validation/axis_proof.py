"""Prove stability and modulus margin of one axis over its plants: for the certificate, and again from it."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeVar

from autotune.certificate.certify import METHOD, prove
from autotune.certificate.family import PROVABLE, WORK_PER_SECOND, Claim, CombinedCertificate, ProofOutcome
from autotune.errors import CertificateError
from autotune.formats.certificate_record import Proof, ProvenRegion
from autotune.formats.proof_records import BouncingProof, HeldProof, PeakProof
from autotune.formats.units import axis_units
from autotune.text import scenario_text
from problems.design.uncertainty import ALWAYS_UNCERTAIN, PlantSet
from problems.errors import ParameterError
from problems.model.axis_kind import AxisKind
from problems.model.sampled import Controller

from .bouncing import RefutedError

# What a proof of stability alone may take, and one of which the file names no budget.
STABILITY_WORK = 60 * WORK_PER_SECOND
_MOST_MODULUS = 1.0 - 1e-9
Progress = Callable[[float], None] | None


@dataclass(frozen=True, kw_only=True)
class ProofOptions:
    """How much is to be proved: the share of the swept modulus that may be given away, and about how long it may take.

    `further_s` is for the proof over everything that is uncertain; 0 leaves it out. `axes` says what of axes on one
    payload: "apart" nothing, "checked" a sweep, "together" a proof too. Raises ValueError unless 0 < `slack` < 1 and
    the times are positive.
    """

    slack: float = 0.05
    budget_s: float = 60.0
    further_s: float = 10.0
    axes: Literal["apart", "checked", "together"] = "checked"

    def __post_init__(self) -> None:
        if not 0.0 < self.slack < 1.0:
            raise ValueError(f"slack must be between 0 and 1, found {self.slack!r}")
        if not (0.0 < self.budget_s < math.inf and 0.0 <= self.further_s < math.inf):
            raise ValueError(f"budgets must be positive seconds, found {self.budget_s!r} and {self.further_s!r}")


Answers = tuple[tuple[Any, Any], ...]
"""Claims with what came of them."""
Found = TypeVar("Found")


class Prover:
    """Proves each claim once; `known` are the answers of whoever made the certificate in the same run."""

    def __init__(self, known: Answers = ()) -> None:
        self._known = len(known)
        self._found = list(known)

    def origin(self, claim: object) -> str:
        """Return in words where the answer to a claim is from, if it is not to be proved anew."""
        place = next((i for i, (each, _) in enumerate(self._found) if each == claim), None)
        if place is None:
            return ""
        return ", proved when this certificate was made" if place < self._known else ", the same proof as above"

    def prove(self, claim: Claim, progress: Progress = None) -> CombinedCertificate:
        """Return what came of a claim; raises ParameterError for parameters that cannot be proved over."""
        return self.once(claim, lambda: prove(claim, progress))

    def once(self, claim: object, make: Callable[[], Found]) -> Found:
        """Return what came of a claim, which is made where it is not known yet."""
        for each, known in self._found:
            if each == claim:
                found: Found = known
                return found
        made = make()
        self._found.append((claim, made))
        return made

    @property
    def answers(self) -> Answers:
        """Return every claim with what came of it."""
        return tuple(self._found)


@dataclass(frozen=True, kw_only=True)
class AxisProof:
    """What is proved of one axis, as its certificate states it, and the `answers` that say so.

    `held` is of a payload that a hand holds, `peak` of first contacts, `bouncing` of contacts that come to rest; None
    where that was not looked at.
    """

    proofs: tuple[Proof, ...]
    regions: tuple[ProvenRegion, ...]
    answers: Answers
    held: HeldProof | None = None
    peak: PeakProof | None = None
    bouncing: BouncingProof | None = None


def prove_axis(
    plants: PlantSet,
    law: Controller,
    sample_time_s: float,
    name: str,
    swept_modulus: float,
    options: ProofOptions | None = None,
    progress: Progress = None,
) -> AxisProof:
    """Prove stability and modulus of one axis over K_e and M_p, and over all ranges where more is uncertain.

    Parameters
    ----------
    plants
        All plants of the axis that must be safe.
    law
        The law of the axis.
    sample_time_s
        The period of its hold [s].
    name
        The axis.
    swept_modulus
        The least |1 + L| that a sweep found; the claim is that less the slack. Where the budget ends before, stability
        over K_e and M_p is proved alone.
    options
        Slack and budgets.
    progress
        Is passed the share of the work done since the last call.

    Returns
    -------
    AxisProof
        Statements and regions for the certificate.

    Raises
    ------
    RefutedError
        With plant and frequency, where the claim is false or stability cannot be proved. A confidence set is proved
        over the box around it; a claim that is false there, but not in the set, is proved as far as it was before.
    """
    options = options or ProofOptions()
    modulus = min((1.0 - options.slack) * swept_modulus, _MOST_MODULUS)
    asked: list[tuple[tuple[str, ...], float]] = [(ALWAYS_UNCERTAIN, options.budget_s)]
    further = tuple(key for key in plants.further if key in PROVABLE)
    if further and options.further_s > 0.0:
        asked.append(((*ALWAYS_UNCERTAIN, *further), options.further_s))
    prover, regions = Prover(), []
    for over, budget_s in asked:
        share = None if progress is None else partial(_passed_on, progress, 1.0 / len(asked))
        found = prover.prove(modulus_claim(plants, law, sample_time_s, over, modulus, budget_s), share)
        false = refuted_inside(plants, found)
        if false is not None:
            raise _refuted(name, plants, false, describe_false(false, axis_units(name)))
        low, high = plants.environment_stiffness_n_per_m
        regions.append(
            ProvenRegion(
                over=over,
                modulus=modulus,
                slack=options.slack,
                method=METHOD,
                share=0.0 if found.false else found.share,
                environment_stiffness_n_per_m=(low, high if found.holds else min(max(low, found.up_to(low)), high)),
                cells=float(found.cells),
                arcs=float(found.arcs),
                budget_s=budget_s,
                run_time_s=found.run_time_s,
            )
        )
    claim = stability_claim(plants, law, sample_time_s, regions)
    stable = prover.prove(claim)
    if stable.failed is not None:
        raise _refuted(name, plants, stable.failed, describe_unstable(stable, axis_units(name)))
    proofs = stability_statements(plants, claim, stable, name)
    return AxisProof(proofs=proofs, regions=tuple(regions), answers=prover.answers)


def _passed_on(progress: Callable[[float], None], share: float, done: float) -> None:
    progress(share * done)


def _refuted(name: str, plants: PlantSet, failed: ProofOutcome, message: str) -> CertificateError:
    """Return the error of a claim that fails at a plant; free space is reported as the softest surface."""
    plant = failed.plant
    if plant is None:
        return CertificateError(f"Axis {name}: {message}")
    stiffness = plant.environment_stiffness_n_per_m or plants.environment_stiffness_n_per_m[0]
    scenario = replace(plant, environment_stiffness_n_per_m=stiffness)
    return RefutedError(f"Axis {name}: {message}", axis=name, scenario=scenario)


def modulus_claim(
    plants: PlantSet, law: Controller, sample_time_s: float, over: tuple[str, ...], modulus: float, budget_s: float
) -> Claim:
    """Return the claim of a modulus over the named parameters, the others nominal, with a budget for all its parts.

    Raises ParameterError for a parameter that the set has no range of.
    """
    for key in over:
        if key not in plants.ranges:
            known = ", ".join(plants.ranges)
            raise ParameterError("over", key, f"one of {known}, of which ranges are given")
    return Claim(
        plants=plants.only(over),
        law=law,
        sample_time_s=sample_time_s,
        modulus=modulus,
        work=int(budget_s * WORK_PER_SECOND),
    )


def stability_claim(
    plants: PlantSet, law: Controller, sample_time_s: float, regions: Iterable[ProvenRegion] = ()
) -> Claim:
    """Return the claim by which stability over K_e and M_p is proved.

    It is the claim of the modulus where that is proved over all of K_e and M_p, and otherwise that of stability alone.
    """
    for each in regions:
        if each.over == ALWAYS_UNCERTAIN and each.share == 1.0:
            return modulus_claim(plants, law, sample_time_s, each.over, each.modulus, each.budget_s)
    alone = modulus_claim(plants, law, sample_time_s, ALWAYS_UNCERTAIN, _MOST_MODULUS, 1.0)
    return replace(alone, modulus=None, work=STABILITY_WORK)


def stability_statements(plants: PlantSet, claim: Claim, found: CombinedCertificate, name: str) -> tuple[Proof, ...]:
    """Return what a proof of stability says of one axis, in free space and in contact.

    It says nothing of a contact that is left and made again, which `bouncing_claim` is about.
    """
    low, high = plants.environment_stiffness_n_per_m
    light, heavy = plants.payload_mass_kg
    units = axis_units(name)
    others = "" if not plants.further else ", everything else at its nominal value"
    with_modulus = {} if claim.modulus is None else {"modulus": claim.modulus}
    return tuple(
        Proof(
            claim=f"axis {name}: the exact sampled loop is stable while it stays {where}",
            method=METHOD,
            over=f"every M_p in [{light:g}, {heavy:g}] {units.mass}{stiffness}{others}",
            numbers={
                **with_modulus,
                "cells": float(sum(part.cells for part in parts)),
                "arcs": float(sum(part.arcs for part in parts)),
            },
        )
        for where, parts, stiffness in (
            ("in free space", found.free_space, ""),
            ("in contact", found.contact, f", K_e in [{low:g}, {high:g}] {units.stiffness}"),
        )
    )


def refuted_inside(plants: PlantSet, found: CombinedCertificate) -> ProofOutcome | None:
    """Return what is false at a plant of the set: the box around a confidence set holds others too."""
    false = found.false
    if false is None or false.plant is None:
        return None
    plant = false.plant
    if plant.environment_stiffness_n_per_m == 0.0:
        plant = replace(plant, environment_stiffness_n_per_m=plants.environment_stiffness_n_per_m[0])
    return false if plants.ellipsoid is None or plants.contains(plant) else None


def describe_false(false: ProofOutcome, units: AxisKind) -> str:
    """Say where a claim is false."""
    plant, frequency = false.plant, false.frequency_rad_per_s
    if plant is None or frequency is None:
        return f"a modulus of {false.modulus:.4g} is not proved"
    return (
        f"stability with a modulus of {false.modulus:.4g} is refuted at {scenario_text(plant, units)}, "
        f"{frequency / (2.0 * math.pi):.4g} Hz"
    )


def describe_unstable(found: CombinedCertificate, units: AxisKind) -> str:
    """Say where stability is not proved."""
    failed = found.failed
    where = "free space" if failed in found.free_space else "contact"
    plant = None if failed is None else failed.plant
    at = "" if plant is None else f": fails at {scenario_text(plant, units)}"
    return f"stability in {where} does not hold or cannot be proved{at}"
