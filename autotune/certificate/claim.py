"""A claim about a sampled loop on all plants of a set, in free space, in contact and held by a hand, and its proof."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from problems.design.hand import HandImpedance
from problems.design.uncertainty import PlantSet
from problems.model.sampled import Controller

from .certify import WORK_PER_SECOND, ProofOutcome, Verdict, certify
from .family import Family, build_families


@dataclass(frozen=True, kw_only=True)
class Claim:
    """That a sampled loop is stable, with |1 + L| > `modulus` at both break points, in contact and in free space.

    It is claimed of every plant in the box of `plants`, whatever cuts that; with a `hand`, of each of them held by
    every such hand, with its spring or without. A `modulus` of None claims stability alone. `work` bounds the effort of
    the proof.
    """

    plants: PlantSet
    law: Controller
    sample_time_s: float
    modulus: float | None
    work: int
    hand: HandImpedance | None = None


@dataclass(frozen=True, kw_only=True)
class CombinedCertificate:
    """What came of the parts of a claim: one part per family of plants; behind a refuted one they are left out.

    `free_space`, `contact` and `held` (by the spring of a hand alone) hold the parts by where they hold.
    """

    free_space: tuple[ProofOutcome, ...]
    contact: tuple[ProofOutcome, ...]
    held: tuple[ProofOutcome, ...] = ()

    @cached_property
    def parts(self) -> tuple[ProofOutcome, ...]:
        """All parts, those of free space first."""
        return (*self.free_space, *self.held, *self.contact)

    @property
    def holds(self) -> bool:
        """Whether all of it is proved."""
        return all(part.holds for part in self.parts)

    @property
    def false(self) -> ProofOutcome | None:
        """Return the part whose claim is false."""
        return next((part for part in self.parts if part.verdict is Verdict.REFUTED), None)

    @property
    def failed(self) -> ProofOutcome | None:
        """Return the part that is false, or else one that is not proved; None where all is."""
        return self.false or next((part for part in self.parts if not part.holds), None)

    @property
    def share(self) -> float:
        """Return the share proved of that part of which least is proved."""
        return min(part.share for part in self.parts)

    @property
    def cells(self) -> int:
        """Return the number of cells of plants that were proved."""
        return sum(part.cells for part in self.parts)

    @property
    def arcs(self) -> int:
        """Return the number of pairs of cell and arc that were proved."""
        return sum(part.arcs for part in self.parts)

    @property
    def run_time_s(self) -> float:
        """Return the work spent in seconds of `WORK_PER_SECOND`, which no clock makes differ from run to run."""
        return sum(part.work for part in self.parts) / WORK_PER_SECOND

    def up_to(self, lowest: float) -> float:
        """Return the K_e up to which everything is proved, free space too; `lowest` where nothing is."""
        open_parts = [part for part in self.parts if not part.holds]
        ends = [lowest if p.stiffness_up_to_n_per_m is None else p.stiffness_up_to_n_per_m for p in open_parts]
        return min(ends, default=math.inf)


def prove(claim: Claim, progress: Callable[[float], None] | None = None) -> CombinedCertificate:
    """Prove a claim, or find out where that ends.

    Parameters
    ----------
    claim
        What is to be proved; its work is shared by all parts.
    progress
        Is passed the share of the work done since the last call.

    Returns
    -------
    CombinedCertificate
        The parts in free space and in contact; the first that is refuted is the last.

    Raises
    ------
    ParameterError
        For parameters that cannot be proved over.
    """
    places = _places(claim)
    every = [family for of_place in zip(*places.values(), strict=True) for family in of_place]

    def part_done(done: float) -> None:
        if progress is not None:
            progress(done / len(every))

    parts: list[ProofOutcome] = []
    for family in every:
        left = max(claim.work - sum(part.work for part in parts), 0)
        parts.append(certify(family, claim.law, claim.modulus, work=left, progress=part_done))
        if parts[-1].verdict is Verdict.REFUTED:
            break
    return CombinedCertificate(**{name: tuple(parts[i :: len(places)]) for i, name in enumerate(places)})


def _places(claim: Claim) -> dict[str, list[Family]]:
    """Return the families of a claim by the fields of `CombinedCertificate`."""
    plants, hand = claim.plants, claim.hand
    if hand is not None:
        # A hand holds what bears a bumper, and not what touches.
        plants.nominal.require_one_piece()
        plants = hand.on_contact(plants)
    contact = build_families(plants.nominal, plants.ranges, claim.sample_time_s)
    free = [family.in_free_space() for family in contact]
    found = {"free_space": free, "contact": list(contact)}
    if hand is not None and hand.stiffness_n_per_m > 0.0:
        found["held"] = [family.on_springs_up_to(hand.stiffness_n_per_m) for family in free]
    return found
