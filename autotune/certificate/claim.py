"""A claim about one loop in contact and in free space together, and what its proof found."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from problems.design.uncertainty import PlantSet
from problems.model.sampled import Controller

from .certify import ProofOutcome, Verdict, certify
from .family import build_families

METHOD = "zero exclusion on the unit circle in ball arithmetic"
# A proof's work is counted, not timed, so that the same input gives the same file; this many are done in a second.
WORK_PER_SECOND = 40_000


@dataclass(frozen=True, kw_only=True)
class Claim:
    """That a sampled loop is stable, with |1 + L| > `modulus` at both break points, in contact and in free space.

    It is claimed of every plant in the box of `plants`, whatever cuts that. A `modulus` of None claims stability alone.
    `work` bounds the effort of the proof.
    """

    plants: PlantSet
    law: Controller
    sample_time_s: float
    modulus: float | None
    work: int


@dataclass(frozen=True, kw_only=True)
class CombinedCertificate:
    """What came of the parts of a claim: one part per family of plants; of a refuted claim those before are left out.

    `free_space` and `contact` hold the same parts by where they hold.
    """

    free_space: tuple[ProofOutcome, ...]
    contact: tuple[ProofOutcome, ...]

    @cached_property
    def parts(self) -> tuple[ProofOutcome, ...]:
        """All parts, those of free space first."""
        return (*self.free_space, *self.contact)

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
    families = build_families(claim.plants.nominal, claim.plants.ranges, claim.sample_time_s)
    every = [each for family in families for each in (family.in_free_space(), family)]

    def part_done(done: float) -> None:
        if progress is not None:
            progress(done / len(every))

    parts: list[ProofOutcome] = []
    for family in every:
        left = max(claim.work - sum(part.work for part in parts), 0)
        parts.append(certify(family, claim.law, claim.modulus, work=left, progress=part_done))
        if parts[-1].verdict is Verdict.REFUTED:
            break
    return CombinedCertificate(free_space=tuple(parts[0::2]), contact=tuple(parts[1::2]))
