"""That every contact of the certified plants comes to rest: proved by a multiplier, else searched for what bounces."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

from autotune.certificate.bouncing import DAMPING, RestOutcome, prove_rest
from autotune.certificate.family import PROVABLE, WORK_PER_SECOND, build_families
from autotune.certificate.multiplier_search import find_multiplier
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller
from autotune.formats.proof_records import BouncingProof
from autotune.formats.units import axis_units
from problems.contact.multiplier import Multiplier
from problems.design.uncertainty import ALWAYS_UNCERTAIN, ENVIRONMENT_MASS, SYMBOLS, PlantSet
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController

from .axis_proof import ProofOptions, Prover
from .bouncing import BounceSearch, RefutedError, search_bouncing
from .report import Check

METHOD = "Popov and Zames-Falb multiplier of the contact spring in the sampled loop, in ball arithmetic"
PASSIVE = "passivity of the sampled loop at the contact, on every passive surface, in ball arithmetic"
_SAME_NUMBER = 1e-6


@dataclass(frozen=True, kw_only=True)
class _RestClaim:
    """That by this multiplier, or None by passivity, every contact of a set comes to rest."""

    plants: PlantSet
    over: tuple[str, ...]
    law: AdmittanceController
    sample_time_s: float
    multiplier: Multiplier | None
    work: int

    def prove(self) -> RestOutcome:
        """Return what comes of it; raises ParameterError for what this proof does not cover."""
        box = self.plants.only(self.over)
        if self.multiplier is not None:
            _check_massless(box)
        parts: list[RestOutcome] = []
        for family in build_families(box.nominal, box.ranges, self.sample_time_s):
            left = max(self.work - sum(part.work for part in parts), 0)
            parts.append(prove_rest(family, self.law, self.multiplier, work=left))
        return RestOutcome(
            share=min(part.share for part in parts),
            cells=sum(part.cells for part in parts),
            arcs=sum(part.arcs for part in parts),
            work=sum(part.work for part in parts),
        )


@dataclass(frozen=True, kw_only=True)
class _Searched:
    """The search of one axis, as a claim that is answered once."""

    axis: str
    domain: AxisDomain
    law: AdmittanceController
    sample_time_s: float
    is_short: bool

    def search(self) -> BounceSearch:
        """Return what came of it."""
        return search_bouncing(self.axis, self.domain, self.law, self.sample_time_s, is_short=self.is_short)


def _check_massless(box: PlantSet) -> None:
    """Refuse a surface that moves with a mass: its force is no monotone function of the place of the payload."""
    moved = box.range_of(ENVIRONMENT_MASS)[1]
    if moved > 0.0:
        raise ParameterError(ENVIRONMENT_MASS, moved, "0, to be proved over")


def prove_bouncing(
    prover: Prover,
    domain: AxisDomain,
    law: AdmittanceController,
    sample_time_s: float,
    name: str,
    options: ProofOptions,
) -> BouncingProof:
    """Prove that every contact comes to rest, and follow impacts where that does not cover all that is uncertain.

    Raises RefutedError with the impact that bounces for ever.
    """
    found = _proved(prover, domain.plants, law, sample_time_s, options) if options.further_s > 0.0 else None
    stated = found or BouncingProof(
        over=ALWAYS_UNCERTAIN,
        method=METHOD,
        share=0.0,
        multiplier=None,
        impacts=0.0,
        cells=0.0,
        arcs=0.0,
        budget_s=options.further_s,
        run_time_s=0.0,
    )
    if covers(stated, domain):
        return stated
    asked = _Searched(axis=name, domain=domain, law=law, sample_time_s=sample_time_s, is_short=stated.is_proved)
    searched = prover.once(asked, asked.search)
    if searched.found is not None:
        raise RefutedError(
            f"Axis {name}: {searched.message()}. Stability in contact and in free space does not exclude that, so the "
            f"{axis_units(name).force_name} never comes to rest.",
            axis=name,
            scenario=searched.found.scenario,
            impact=searched.found,
        )
    return replace(stated, impacts=float(searched.runs))


def covers(stated: BouncingProof, domain: AxisDomain) -> bool:
    """Return whether a proof is of all that is uncertain, so that no impact need be followed."""
    return stated.is_proved and {*ALWAYS_UNCERTAIN, *(domain.uncertain or ())} <= set(stated.over)


def _proved(
    prover: Prover, plants: PlantSet, law: AdmittanceController, sample_time_s: float, options: ProofOptions
) -> BouncingProof | None:
    """Return the widest set for which a multiplier is found that proves it; None where there is none."""
    further = tuple(key for key in plants.further if key in PROVABLE)
    # A surface with a mass is no spring: on it the loop's passivity decides, whatever else the surface is.
    has_mass = plants.range_of(ENVIRONMENT_MASS)[1] > 0.0
    undamped, mass = tuple(key for key in further if key != DAMPING), tuple(k for k in further if k == ENVIRONMENT_MASS)
    work = int(options.further_s * WORK_PER_SECOND)
    for over in dict.fromkeys((*ALWAYS_UNCERTAIN, *each) for each in (further, undamped, mass)):
        box = plants.only(over)
        try:
            multiplier = None
            if not has_mass:
                multiplier = find_multiplier(build_families(box.nominal, box.ranges, sample_time_s), law)
                if multiplier is None:
                    continue
            claim = _RestClaim(
                plants=plants, over=over, law=law, sample_time_s=sample_time_s, multiplier=multiplier, work=work
            )
            found = prover.once(claim, claim.prove)
        except ParameterError:
            # A late wrench beside a law that reads the position.
            continue
        if found.holds:
            return BouncingProof(
                over=over,
                method=PASSIVE if multiplier is None else METHOD,
                share=found.share,
                multiplier=multiplier,
                impacts=0.0,
                cells=float(found.cells),
                arcs=float(found.arcs),
                budget_s=options.further_s,
                run_time_s=found.work / WORK_PER_SECOND,
            )
    return None


def check_bouncing(controller: Controller, name: str, law: AdmittanceController, prover: Prover) -> Iterator[Check]:
    """Prove again by the multiplier of the file, and follow impacts where that is not all that is uncertain."""
    stated, domain = (controller.certificate.bouncing or {}).get(name), controller.certificate.domain[name]
    check, h = partial(Check, axis=name, name="bouncing"), controller.sample_time_s
    if stated is not None and stated.share > 0.0:
        proved = _check_proof(stated, domain, law, h, prover)
        yield check(passed=not proved[0], message=proved[0] or proved[1])
        if proved[0] or covers(stated, domain):
            return
    asked = _Searched(
        axis=name, domain=domain, law=law, sample_time_s=h, is_short=stated is not None and stated.is_proved
    )
    searched = prover.once(asked, asked.search)
    passed, message = searched.passed, searched.message()
    if passed and stated is not None and stated.impacts != searched.runs:
        passed, message = False, f"the file states {stated.impacts:g} impacts, and {searched.runs} were followed"
    yield check(passed=passed, message=message)


def _check_proof(
    stated: BouncingProof, domain: AxisDomain, law: AdmittanceController, sample_time_s: float, prover: Prover
) -> tuple[str, str]:
    """Return what is wrong with what the file states, and what is proved."""
    bound = f"every contact comes to rest, over {', '.join(SYMBOLS.get(each, each) for each in stated.over)}"
    if stated.method != (PASSIVE if stated.multiplier is None else METHOD):
        return f"{bound}: stated without a multiplier, or by a method that is not {METHOD!r}", ""
    if not set(ALWAYS_UNCERTAIN) <= set(stated.over):
        return f"{bound}: K_e and M_p must be among what it is proved over", ""
    claim = _RestClaim(
        plants=domain.plants,
        over=stated.over,
        law=law,
        sample_time_s=sample_time_s,
        multiplier=stated.multiplier,
        work=int(stated.budget_s * WORK_PER_SECOND),
    )
    try:
        origin, found = prover.origin(claim), prover.once(claim, claim.prove)
    except (KeyError, ParameterError) as error:
        return f"{bound}: {error}", ""
    if stated.share > found.share + _SAME_NUMBER:
        return f"{bound}: claimed for the share {stated.share:.4g}, proved for {found.share:.4g}", ""
    return "", f"{bound}, from any state under any constant force: proved ({found.cells} cells{origin})"
