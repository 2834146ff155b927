"""What of all axes together is proved: for the certificate, and again from it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial

from autotune.certificate.coupled import METHOD, CoupledOutcome, prove_coupled
from autotune.certificate.coupled_system import BREAK_POINTS, CoupledFamily
from autotune.certificate.family import WORK_PER_SECOND
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import AxisGains, Controller
from autotune.formats.coupled_record import CoupledBody, CoupledCertificate, CoupledProof, Vector
from problems.model.coupled import PointSurface

from .axis_proof import ProofOptions, Prover
from .coupled_cell import CoupledCell
from .coupled_points import swept_at_points
from .report import Check

_SAME_NUMBER = 1e-6


@dataclass(frozen=True, kw_only=True)
class _CoupledClaim:
    """That a group of axes is stable together with σ_min(I + L) above a modulus."""

    axes: Mapping[str, AxisGains]
    domain: Mapping[str, AxisDomain]
    body: CoupledBody
    group: tuple[str, ...]
    points: Mapping[str, tuple[Vector, ...]]
    at: str
    modulus: float
    work: int

    @classmethod
    def of(cls, controller: Controller, stated: CoupledCertificate, proof: CoupledProof) -> "_CoupledClaim":
        """Return the claim that a file makes."""
        return cls(
            axes=controller.axes,
            domain=controller.certificate.domain,
            body=stated.body,
            group=proof.axes,
            points=proof.points,
            at=proof.at,
            modulus=proof.modulus,
            work=int(proof.budget_s * WORK_PER_SECOND),
        )


def prove_together(controller: Controller, prover: Prover, options: ProofOptions) -> Controller:
    """Return the controller with what can be proved: the swept modulus less the slack.

    Of each group in free space and on surfaces square to its axes, and of all axes touching with the points that were
    simulated, the loops cut at the forces and at the commands.
    """
    stated = controller.certificate.coupled
    if stated is None:
        return controller
    proofs = []
    for wanted in _wanted(controller, stated, options):
        outcome = _prove(controller, prover, _CoupledClaim.of(controller, stated, wanted))
        proofs.append(
            replace(
                wanted,
                share=outcome.share,
                cells=float(outcome.cells),
                run_time_s=outcome.work / WORK_PER_SECOND,
            )
        )
    coupled = replace(stated, proofs=tuple(proofs))
    return replace(controller, certificate=replace(controller.certificate, coupled=coupled))


def _wanted(controller: Controller, stated: CoupledCertificate, options: ProofOptions) -> Iterator[CoupledProof]:
    """Yield what is to be proved, nothing of it shown yet."""
    nothing = CoupledProof(
        axes=stated.axes,
        modulus=(1.0 - options.slack) * min(stated.modulus, 1.0),
        method=METHOD,
        share=0.0,
        cells=0.0,
        budget_s=options.budget_s,
        run_time_s=0.0,
    )
    # The change of a command is proved from the one before it, which a loop without delay does not keep.
    is_late = all(controller.certificate.domain[name].delay_s > 0.0 for name in controller.axes)
    cuts = BREAK_POINTS if is_late else BREAK_POINTS[:1]
    for group in stated.groups:
        if len(group) > 1 and any(name in controller.axes for name in group):
            yield from (replace(nothing, axes=group, at=at) for at in cuts)
    points = {name: tuple(each.point_m for each in contacts) for name, contacts in stated.points.items()}
    if any(points.values()):
        cell = CoupledCell.of(controller, stated.body)
        modulus = (1.0 - options.slack) * min(swept_at_points(cell, points), 1.0)
        yield from (replace(nothing, axes=cell.names, modulus=modulus, points=points, at=at) for at in cuts)


def check_proofs(controller: Controller, prover: Prover) -> Iterator[Check]:
    """Prove again what the file states of axes together."""
    stated = controller.certificate.coupled
    check = partial(Check, axis=next(iter(controller.axes)), name="proved together")
    for proof in () if stated is None else stated.proofs:
        if stated is None or proof.share == 0.0:
            continue
        claim = _CoupledClaim.of(controller, stated, proof)
        origin, found = prover.origin(claim), _prove(controller, prover, claim)
        bound = f"{proof.of_what()}: stable with σ_min(I + L) > {proof.modulus:.4g} at the {proof.at}s"
        if found.refuted is not None or proof.share > found.share + _SAME_NUMBER:
            message = f"{bound}: claimed for the share {proof.share:.4g}, proved for {found.share:.4g}"
            yield check(passed=False, message=message)
            continue
        part = "" if proof.share == 1.0 else f" for {100.0 * proof.share:.4g} % of the set"
        yield check(passed=True, message=f"{bound}: proved{part} ({found.cells} cells{origin})", warns=part != "")


def _prove(controller: Controller, prover: Prover, claim: _CoupledClaim) -> CoupledOutcome:
    return prover.once(claim, lambda: _families_proved(CoupledCell.of(controller, claim.body), claim))


def _families_proved(cell: CoupledCell, claim: _CoupledClaim) -> CoupledOutcome:
    """Prove free space and each surface; the share is that of the part of which least is proved."""
    group, mass = claim.group, cell.payload.mass_kg
    factors = cell.masses_kg[0] / mass, cell.masses_kg[-1] / mass
    share, cells, work = 1.0, 0, 0
    for surface, stiffness in _surfaces(cell, claim):
        family = CoupledFamily(
            plant=cell.plant(group, mass, surface),
            laws=cell.law(group),
            scale=cell.scale(group),
            sample_time_s=cell.sample_time_s,
            stiffness_n_per_m=stiffness,
            mass_factors=factors,
            at="command" if claim.at == "command" else "force",
        )
        found = prove_coupled(family, claim.modulus, work=max(claim.work - work, 0))
        share, cells, work = min(share, found.share), cells + found.cells, work + found.work
        if found.refuted is not None:
            return replace(found, share=0.0, cells=cells, work=work)
    return CoupledOutcome(share=share, cells=cells, work=work)


def _surfaces(cell: CoupledCell, claim: _CoupledClaim) -> Iterator[tuple[PointSurface | None, tuple[float, float]]]:
    """Yield what is touched, None for free space, with its range of K_e."""
    group = claim.group
    if not claim.points:
        yield None, (0.0, 0.0)
        for name in (each for each in group if each in cell.domains):
            stiffness = cell.domains[name].environment_stiffness_n_per_m
            yield cell.surface(group, name, max(stiffness)), stiffness
    for name, points in claim.points.items():
        stiffness = cell.domains[name].environment_stiffness_n_per_m
        for point in points:
            yield cell.surface_at(group, name, point, max(stiffness)), stiffness
