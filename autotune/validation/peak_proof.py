"""That no first contact of the certified plants exceeds a force: proved for the certificate, and again from it."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from autotune.certificate.family import WORK_PER_SECOND, build_families
from autotune.certificate.peaks import PeakOutcome, prove_peak
from autotune.formats.controller_record import Controller, is_linear
from autotune.formats.proof_records import PeakProof
from autotune.formats.units import axis_units
from autotune.text import scenario_text
from problems.contact.transient import Approach
from problems.design.uncertainty import ENVIRONMENT_MASS, PlantSet
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController

from .axis_proof import ProofOptions, Prover
from .bouncing import RefutedError
from .report import Check

METHOD = "first contact tick by tick, Taylor models in ball arithmetic"
_SAME_NUMBER = 1e-6


@dataclass(frozen=True, kw_only=True)
class _PeakClaim:
    """That no first contact of K_e × M_p exceeds a force."""

    plants: PlantSet
    law: AdmittanceController
    sample_time_s: float
    approach: Approach
    limit_n: float
    work: int

    def prove(self) -> PeakOutcome:
        """Return what comes of it; raises ParameterError for what this proof does not cover."""
        box = self.plants.only()
        moved = box.nominal.environment.mass_kg
        if moved > 0.0:
            raise ParameterError(ENVIRONMENT_MASS, moved, "0: the blow with which a mass is met is not in the proof")
        (family,) = build_families(box.nominal, box.ranges, self.sample_time_s)
        return prove_peak(family, self.law, self.approach, self.limit_n, work=self.work)


def prove_peaks(
    prover: Prover,
    plants: PlantSet,
    law: AdmittanceController,
    sample_time_s: float,
    name: str,
    approach: Approach,
    swept_n: float,
    options: ProofOptions,
) -> PeakProof | None:
    """Prove the largest force that the search found, plus the slack, over all K_e and M_p; None where that cannot be.

    Raises RefutedError with the plant where it is false.
    """
    limit, work = (1.0 + options.slack) * swept_n, int(options.budget_s * WORK_PER_SECOND)
    claim = _PeakClaim(plants=plants, law=law, sample_time_s=sample_time_s, approach=approach, limit_n=limit, work=work)
    try:
        found = prover.once(claim, claim.prove)
    except ParameterError:
        # A filtered wrench, a force that ends at the impact, or a surface with mass.
        return None
    if found.refuted_by is not None:
        units = axis_units(name)
        raise RefutedError(
            f"Axis {name}: a first contact of {scenario_text(found.refuted_by, units)} exceeds {limit:.4g} "
            f"{units.force}, the largest {units.force_name} that was found plus {100.0 * options.slack:g} %.",
            axis=name,
            scenario=found.refuted_by,
        )
    return PeakProof(
        force_n=limit,
        method=METHOD,
        share=found.share,
        staying=found.staying,
        cells=float(found.cells),
        budget_s=options.budget_s,
        run_time_s=found.work / WORK_PER_SECOND,
    )


def check_peaks(controller: Controller, name: str, law: AdmittanceController, prover: Prover) -> Iterator[Check]:
    """Prove again what the file states of first contacts; more may be proved, less may not."""
    stated, domain = (controller.certificate.peaks or {}).get(name), controller.certificate.domain[name]
    if stated is None or not is_linear(controller):
        return
    check, units = partial(Check, axis=name, name="proved peak"), axis_units(name)
    bound = f"no first contact exceeds {stated.force_n:.4g} {units.force}, over K_e, M_p and the moment of the touch"
    try:
        claim = _PeakClaim(
            plants=domain.plants,
            law=law,
            sample_time_s=controller.sample_time_s,
            approach=domain.approach,
            limit_n=stated.force_n,
            work=int(stated.budget_s * WORK_PER_SECOND),
        )
        origin, found = prover.origin(claim), prover.once(claim, claim.prove)
    except ParameterError as error:
        yield check(passed=False, message=str(error))
        return
    if found.refuted_by is not None:
        yield check(passed=False, message=f"{bound}: refuted at {scenario_text(found.refuted_by, units)}")
        return
    if stated.share > found.share + _SAME_NUMBER or stated.staying > found.staying + _SAME_NUMBER:
        message = f"{bound}: claimed for the share {stated.share:.4g}, proved for {found.share:.4g}"
        yield check(passed=False, message=message)
        return
    part = "" if stated.share == 1.0 else f" for {100.0 * stated.share:.4g} % of the set"
    stays = f"in {100.0 * stated.staying:.3g} % of it the payload is shown to stay on the wall"
    message = f"{bound}: proved{part} ({found.cells} cells{origin}; {stays})"
    yield check(passed=True, message=message, warns=stated.share < 1.0)
