"""Prove stability and modulus margin of one axis over its continuous domain, for the certificate and again from it."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial

from autotune.certificate.certify import Certificate, Verdict, certify
from autotune.certificate.family import MASS, PROVABLE, STIFFNESS, build_families
from autotune.errors import CertificateError
from autotune.formats.controller_record import AxisDomain, Reach
from autotune.formats.units import AxisUnits, axis_units
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant

from .refuted import RefutedError

METHOD = "zero exclusion on the unit circle in ball arithmetic"
# A proof's work is counted, not timed, so that the same input gives the same file; this many are done in a second.
WORK_PER_SECOND = 40_000
_MOST_MODULUS = 1.0 - 1e-9
Interval = tuple[float, float]
Progress = Callable[[float], None] | None


@dataclass(frozen=True, kw_only=True)
class ProofWishes:
    """How much is to be proved: the share of the swept modulus that may be given away, and about how long it may take.

    `further_s` is for the proof over everything that is uncertain; 0 leaves it out. Raises ValueError unless 0 <
    `slack` < 1 and the times are positive.
    """

    slack: float = 0.05
    budget_s: float = 60.0
    further_s: float = 10.0

    def __post_init__(self) -> None:
        if not 0.0 < self.slack < 1.0:
            raise ValueError(f"slack must be between 0 and 1, found {self.slack!r}")
        if not (0.0 < self.budget_s < math.inf and 0.0 <= self.further_s < math.inf):
            raise ValueError(f"budgets must be positive seconds, found {self.budget_s!r} and {self.further_s!r}")


def prove_reach(
    domain: AxisDomain,
    law: AdmittanceController,
    sample_time_s: float,
    name: str,
    swept_modulus: float,
    wishes: ProofWishes,
    progress: Progress = None,
) -> tuple[Reach, ...]:
    """Return what is proved of one axis: over K_e and M_p, and over all ranges where more is uncertain.

    The claim is the swept modulus less the slack. Raises CertificateError with plant and frequency if it is false. A
    confidence set is proved over the box around it; a claim that is false there, but not in the set, is proved as far
    as it was before.
    """
    modulus = min((1.0 - wishes.slack) * swept_modulus, _MOST_MODULUS)
    asked: list[tuple[tuple[str, ...], float]] = [((STIFFNESS, MASS), wishes.budget_s)]
    further = tuple(key for key in domain.uncertain or {} if key in PROVABLE)
    if further and wishes.further_s > 0.0:
        asked.append(((STIFFNESS, MASS, *further), wishes.further_s))
    out = []
    for over, budget_s in asked:
        share = None if progress is None else partial(_passed_on, progress, 1.0 / len(asked))
        found = prove_over(domain, law, sample_time_s, over, modulus, budget_s, share)
        false = refuted_inside(domain, found)
        if false is not None:
            raise _refuted(name, domain, false)
        low, high = domain.environment_stiffness_n_per_m
        out.append(
            Reach(
                over=over,
                modulus=modulus,
                slack=wishes.slack,
                method=METHOD,
                share=0.0 if found.false else found.share,
                environment_stiffness_n_per_m=(low, high if found.holds else min(max(low, found.up_to(low)), high)),
                cells=float(found.cells),
                arcs=float(found.arcs),
                budget_s=budget_s,
                run_time_s=found.run_time_s,
            )
        )
    return tuple(out)


def _refuted(name: str, domain: AxisDomain, false: Certificate) -> CertificateError:
    """Return the error of a false claim, with the plant where that is one in contact."""
    message, plant = f"Axis {name}: {told_false(false, axis_units(name))}", false.plant
    if plant is None:
        return CertificateError(message)
    stiffness = plant.environment_stiffness_n_per_m or domain.environment_stiffness_n_per_m[0]
    return RefutedError(message, axis=name, scenario=replace(plant, environment_stiffness_n_per_m=stiffness))


def _passed_on(progress: Callable[[float], None], share: float, done: float) -> None:
    progress(share * done)


@dataclass(frozen=True, kw_only=True)
class Joint:
    """What came of contact and free space together; `false` is what was refuted."""

    parts: tuple[Certificate, ...]

    @property
    def holds(self) -> bool:
        """Whether all of it is proved."""
        return all(part.holds for part in self.parts)

    @property
    def false(self) -> Certificate | None:
        """Return the first part whose claim is false."""
        return next((part for part in self.parts if part.verdict is Verdict.REFUTED), None)

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


def prove_over(
    domain: AxisDomain,
    law: AdmittanceController,
    sample_time_s: float,
    over: tuple[str, ...],
    modulus: float,
    budget_s: float,
    progress: Progress = None,
) -> Joint:
    """Prove a modulus in contact and in free space over the named parameters, the others nominal; `budget_s` in all.

    Raises ParameterError for parameters that cannot be proved over.
    """
    every: Mapping[str, Interval] = {
        STIFFNESS: domain.environment_stiffness_n_per_m,
        MASS: domain.payload_mass_kg,
        **(domain.uncertain or {}),
    }
    for key in over:
        if key not in every:
            raise ParameterError("over", key, f"one of {', '.join(every)}, which the domain gives ranges of")
    return _proved(
        _Question(
            nominal=domain.nominal_plant(),
            ranges=tuple((key, every[key]) for key in over),
            law=law,
            sample_time_s=sample_time_s,
            modulus=modulus,
            work=int(budget_s * WORK_PER_SECOND),
            progress=progress,
        )
    )


@dataclass(frozen=True, kw_only=True)
class _Question:
    """What is to be proved; the same question is answered once, whoever wants to see the progress."""

    nominal: Plant
    ranges: tuple[tuple[str, Interval], ...]
    law: AdmittanceController
    sample_time_s: float
    modulus: float
    work: int
    progress: Progress = field(default=None, compare=False)


@lru_cache(maxsize=16)
def _proved(asked: _Question) -> Joint:
    families = build_families(asked.nominal, dict(asked.ranges), asked.sample_time_s)
    every = [each for family in families for each in (family.in_free_space(), family)]

    def part_done(done: float) -> None:
        if asked.progress is not None:
            asked.progress(done / len(every))

    parts: list[Certificate] = []
    for family in every:
        left = max(asked.work - sum(part.work for part in parts), 0)
        parts.append(certify(family, asked.law, asked.modulus, work=left, progress=part_done))
        if parts[-1].verdict is Verdict.REFUTED:
            break
    return Joint(parts=tuple(parts))


def refuted_inside(domain: AxisDomain, found: Joint) -> Certificate | None:
    """Return what is false at a plant of the domain: the box around a confidence set holds others too."""
    false = found.false
    if false is None or false.plant is None:
        return None
    plant = false.plant
    if plant.environment_stiffness_n_per_m == 0.0:
        plant = replace(plant, environment_stiffness_n_per_m=domain.environment_stiffness_n_per_m[0])
    return false if domain.confidence is None or domain.uncertainty().contains(plant) else None


def told_false(false: Certificate, units: AxisUnits) -> str:
    """Say where a claim is false."""
    plant, frequency = false.plant, false.frequency_rad_per_s
    if plant is None or frequency is None:
        return f"a modulus of {false.modulus:.4g} is not proved"
    return (
        f"stability with a modulus of {false.modulus:.4g} is refuted at "
        f"M_p = {plant.payload_mass_kg:.6g} {units.mass}, "
        f"K_e = {plant.environment_stiffness_n_per_m:.6g} {units.stiffness}{plant.off_nominal}, "
        f"{frequency / (2.0 * math.pi):.4g} Hz"
    )
