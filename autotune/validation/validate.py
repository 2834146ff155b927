"""Verify a controller from its file alone: every claim is made again by code that the optimizer does not use."""

from collections.abc import Callable, Iterator, Mapping

import numpy as np

from autotune.formats.controller_record import AxisDomain, CollisionResponse, Controller, Proof, Reach
from autotune.formats.records import ROTATIONAL_AXES
from autotune.formats.units import axis_units
from problems.design.requirements import NoiseLimit, PassivityTarget
from problems.design.uncertainty import SYMBOLS, Scenario
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import NO_FILTER, Coupling
from problems.model.robot import RobotModel

from .bouncing import search_bouncing
from .certified_requirements import asked_of, limit_n
from .continuous import prove_over, refuted_inside, told_false
from .limits import verify_limits
from .margins import sweep_margins
from .peaks import verify_peaks
from .proof import StabilityProof, UncertainPlant, prove_stability
from .refuted import RefutedError
from .report import Check, ValidationReport
from .requirements import check_admittance, check_command, check_margins, check_requirements
from .response import has_response, verify_response
from .statements import stability_statement, wrong_statements
from .validation_samples import build_other_plants, recorded_plants

_STIFFNESS_POINTS, _MASS_POINTS = 25, 3
_MOST_DEADBAND = 0.5  # of the force that drives the approach
_SAME_NUMBER = 1e-6
_CHECKS = 12  # per axis, all passing; that of the payload's mass is none of a rotational axis


def validate_controller(
    controller: Controller, progress: Callable[[float], None] | None = None, *, is_short: bool = False
) -> ValidationReport:
    """Verify all axes; `progress` is told the share of the work done since the last call.

    `is_short` leaves it at what an export asks of every file: stability proved over the domain, the margins at its
    corners and at the plants at which the file says that they are smallest, and the limits.
    Nothing is raised for a check that fails: the report holds it (`ValidationReport.require` raises).
    """
    checks: list[Check] = []
    for name in controller.axes:
        commands = sum(isinstance(each, NoiseLimit | PassivityTarget) for each in asked_of(controller, name).values())
        proofs = len((controller.certificate.continuous or {}).get(name, ()))
        count = _CHECKS - (name in ROTATIONAL_AXES) + commands + proofs + has_response(controller, name)
        for check in _axis_checks(controller, name, is_short):
            checks.append(check)
            if progress is not None:
                progress(1.0 / (count * len(controller.axes)))
    return ValidationReport(checks=tuple(checks))


def _axis_checks(controller: Controller, name: str, is_short: bool) -> Iterator[Check]:
    domain, margins = controller.certificate.domain.get(name), controller.certificate.margins.get(name)
    if domain is None or margins is None or name not in controller.predicted:
        yield Check(axis=name, name="certificate", passed=False, message="the file holds no certificate for this axis")
        return
    unsupported = _unsupported(controller, name)
    if unsupported:
        yield Check(axis=name, name="controller", passed=False, message=unsupported)
        return
    try:
        law, plants = admittance_controller(controller, name), uncertain_plant(domain)
        others = build_other_plants(domain, margins, controller.predicted[name])
        recorded = recorded_plants(domain, margins)
    except (ParameterError, TypeError, ValueError, LookupError) as error:
        yield Check(axis=name, name="parameters", passed=False, message=str(error))
        return
    h = controller.sample_time_s
    yield Check(axis=name, name="parameters", passed=True, message="gains and plant are within their ranges")
    if name not in ROTATIONAL_AXES:
        yield _payload(controller, name, domain)
    yield _delay(controller, name, domain)
    yield from _deadband(controller, name, domain)
    proofs: dict[str, StabilityProof] = {}
    for where, these in _places(plants):
        proofs[where] = prove_stability(these, law, h)
        yield _stability(name, proofs[where], where, plants, nominal=bool(others.plants))
        if not proofs[where].holds:
            return
    yield _statements(controller, name, proofs)
    if is_short:
        swept = sweep_margins(plants, law, h, stiffness=2, mass=2, others=recorded)
        yield check_margins(name, margins, swept)
        yield check_requirements(controller, name, swept)
        yield _limits(controller, name, domain, law)
        return
    for reach in (controller.certificate.continuous or {}).get(name, ()):
        yield _continuous(name, domain, law, h, reach)
    swept = sweep_margins(plants, law, h, stiffness=_STIFFNESS_POINTS, mass=_MASS_POINTS, others=others.plants)
    yield check_margins(name, margins, swept)
    yield check_requirements(controller, name, swept)
    yield check_admittance(controller, name, plants, others, law)
    yield from check_command(controller, name, plants, others, law)
    told, missed = verify_peaks(
        domain,
        controller.predicted[name].scenarios,
        others,
        law,
        h,
        limit_n=limit_n(controller, name),
        units=axis_units(name),
    )
    yield Check(axis=name, name="peak force", passed=not missed, message="; ".join(missed) or told)
    yield from _further(controller, name, domain, law)


def _further(controller: Controller, name: str, domain: AxisDomain, law: AdmittanceController) -> Iterator[Check]:
    """Yield what else contacts must do: end, stay within the limits, and be as told with a collision response."""
    bouncing = search_bouncing(name, domain, law, controller.sample_time_s)
    yield Check(axis=name, name="bouncing", passed=bouncing.passed, message=bouncing.message())
    yield _limits(controller, name, domain, law)
    told, missed = verify_response(controller, name, domain, law)
    if told or missed:
        yield Check(axis=name, name="collision response", passed=not missed, message="; ".join(missed) or told)


def _limits(controller: Controller, name: str, domain: AxisDomain, law: AdmittanceController) -> Check:
    told, missed = verify_limits(controller, name, domain, law)
    message = "; ".join(missed) or told
    return Check(axis=name, name="limits", passed=not missed, message=message, warns=controller.limits is None)


def _unsupported(controller: Controller, name: str) -> str:
    """Say what in the file this release cannot verify; a claim that cannot be verified does not hold."""
    if controller.certificate.requirements_of(name) is None:
        return "the certificate does not say what was asked of rotational axes (rotational_requirements)"
    if controller.compensation_mass_kg != 0.0 and name in ROTATIONAL_AXES:
        return "compensation_mass_kg is a mass and says nothing of an axis that turns; it must be 0"
    if controller.collision.response is CollisionResponse.STOP:
        return "a full stop on collision cannot be verified by this release; collision.response must be none or reset"
    if controller.certificate.domain[name].environment_mass_kg != 0.0:
        return "an environment with mass cannot be verified by this release; environment_mass_kg must be 0"
    return ""


def admittance_controller(controller: Controller, name: str) -> AdmittanceController:
    """Return the control law of one axis."""
    gains = controller.axes[name]
    return AdmittanceController(
        mass_kg=gains.mass,
        damping_n_s_per_m=gains.damping,
        lead_s=gains.lead_s,
        feedback_damping_s=gains.feedback_damping_s,
        velocity_filter_rad_per_s=controller.filters.velocity_rad_per_s,
        acceleration_filter_rad_per_s=controller.filters.acceleration_rad_per_s,
        compensation_mass_kg=controller.compensation_mass_kg,
    )


def uncertain_plant(domain: AxisDomain) -> UncertainPlant:
    """Return the set of plants that a certificate speaks of."""
    return UncertainPlant(
        robot=RobotModel(
            numerator=np.array(domain.robot_numerator),
            denominator=np.array(domain.robot_denominator),
            delay_s=domain.delay_s,
        ),
        coupling=Coupling(
            stiffness_n_per_m=domain.coupling_stiffness_n_per_m,
            damping_n_s_per_m=domain.coupling_damping_n_s_per_m,
        ),
        drag_n_s_per_m=domain.drag_n_s_per_m,
        environment_damping_n_s_per_m=domain.environment_damping_n_s_per_m,
        payload_mass_kg=domain.payload_mass_kg,
        environment_stiffness_n_per_m=domain.environment_stiffness_n_per_m,
        wrench_filter=domain.wrench_filter or NO_FILTER,
    )


def prove_axis(domain: AxisDomain, law: AdmittanceController, sample_time_s: float, name: str) -> tuple[Proof, ...]:
    """Return what can be proved of one axis, for its certificate; raises CertificateError if stability cannot be."""
    plants = uncertain_plant(domain)
    proofs = []
    for where, these in _places(plants):
        proof = prove_stability(these, law, sample_time_s)
        if not proof.holds:
            message = f"Axis {name}: {_stability(name, proof, where, plants).message}"
            raise RefutedError(message, axis=name, scenario=_failed_at(domain, proof))
        proofs.append(stability_statement(domain, proof, where, name))
    return tuple(proofs)


def _failed_at(domain: AxisDomain, proof: StabilityProof) -> Scenario:
    """Return the plant at which a proof failed; in free space every surface stands for none."""
    return Scenario(
        environment_stiffness_n_per_m=proof.failed_stiffness_n_per_m or domain.environment_stiffness_n_per_m[0],
        payload_mass_kg=proof.failed_mass_kg or domain.payload_mass_kg[0],
    )


def _places(plants: UncertainPlant) -> tuple[tuple[str, UncertainPlant], ...]:
    return ("in free space", plants.in_free_space()), ("in contact", plants)


def _statements(controller: Controller, name: str, proofs: Mapping[str, StabilityProof]) -> Check:
    """Hold the sentences of the certificate against those that the verified domain makes."""
    wrong = wrong_statements(controller, name, proofs)
    message = "; ".join(wrong) or "proved and sampled state what the certified domain says"
    return Check(axis=name, name="statements", passed=not wrong, message=message)


def _payload(controller: Controller, name: str, domain: AxisDomain) -> Check:
    (low, high), mass = domain.payload_mass_kg, controller.payload.mass_kg
    inside = low <= mass <= high
    where = f"{'inside' if inside else 'which is outside'} the certified {low:g} to {high:g} kg"
    message = f"the runtime compensates {mass:.4g} kg, {where}"
    return Check(axis=name, name="payload", passed=inside, message=message)


def _delay(controller: Controller, name: str, domain: AxisDomain) -> Check:
    _, longest = (domain.uncertain or {}).get("delay_s", (domain.delay_s, domain.delay_s))
    samples = longest / controller.sample_time_s
    passed = samples <= controller.delay_samples * (1.0 + _SAME_NUMBER)
    return Check(
        axis=name,
        name="delay",
        passed=passed,
        message=f"delay_samples {controller.delay_samples:.4g} covers the {samples:.4g} samples of the certified plant"
        if passed
        else f"delay_samples says {controller.delay_samples:.6g}, the certificate's plant has {samples:.6g}",
    )


def _deadband(controller: Controller, name: str, domain: AxisDomain) -> Iterator[Check]:
    """Warn of a deadband that hides most of what drives the approach; the certificate is that of the law without it."""
    gains, units = controller.axes[name], axis_units(name)
    speed, resistance = domain.approach_speed_m_s or 0.0, gains.damping + domain.drag_n_s_per_m
    driving = speed * resistance if domain.approach_force_n is None else domain.approach_force_n
    if gains.deadband > _MOST_DEADBAND * driving > 0.0:
        message = (
            f"{gains.deadband:g} {units.force} are {100.0 * gains.deadband / driving:.0f} % of the {driving:.4g} "
            f"{units.force} that drive the approach; below it no contact is felt, and margins and predicted peaks are "
            "those of the law without it"
        )
        yield Check(axis=name, name="deadband", passed=True, message=message, warns=True)


def _stability(name: str, proof: StabilityProof, where: str, plants: UncertainPlant, *, nominal: bool = False) -> Check:
    low, high = plants.environment_stiffness_n_per_m
    light, heavy = plants.payload_mass_kg
    units = axis_units(name)
    if proof.holds:
        stiffness = "" if "free" in where else f" and every K_e in [{low:g}, {high:g}] {units.stiffness}"
        rest = ", the rest of the plant nominal" if nominal else ""
        message = f"proved for every M_p in [{light:g}, {heavy:g}] {units.mass}{stiffness}{rest} ({proof.cells} cells)"
    else:
        message = (
            f"stability in {where.removeprefix('in ')} does not hold or cannot be proved: fails at "
            f"M_p = {proof.failed_mass_kg:.6g} {units.mass}, K_e = {proof.failed_stiffness_n_per_m:.6g} "
            f"{units.stiffness}"
        )
    return Check(axis=name, name=f"stability in {where.removeprefix('in ')}", passed=proof.holds, message=message)


def _continuous(name: str, domain: AxisDomain, law: AdmittanceController, h: float, reach: Reach) -> Check:
    """Prove again how far a modulus holds; more than is claimed may be proved, less may not."""
    units, (low, high) = axis_units(name), reach.environment_stiffness_n_per_m
    over = ", ".join(SYMBOLS.get(each, each) for each in reach.over)
    told = f"|1 + L| > {reach.modulus:.4g} and stable at every frequency, over {over}"
    try:
        found = prove_over(domain, law, h, reach.over, reach.modulus, reach.budget_s)
    except ParameterError as error:
        return Check(axis=name, name="continuous proof", passed=False, message=str(error))
    false = refuted_inside(domain, found)
    wide = domain.environment_stiffness_n_per_m
    proved = wide if found.holds else (wide[0], found.up_to(wide[0]))
    share = 0.0 if found.false else found.share
    passed = (
        false is None and reach.share <= share + _SAME_NUMBER and high <= max(proved[1], low) * (1.0 + _SAME_NUMBER)
    )
    if false is not None:
        message = told_false(false, units)
    elif not passed:
        message = f"{told}: claimed for the share {reach.share:.4g}, proved for {share:.4g}"
    elif reach.share <= 0.0:
        message = f"not proved: nothing could be shown within the budget of {told}"
    elif reach.share < 1.0:
        message = (
            f"{told}: proved up to here, {100.0 * reach.share:.4g} % of the set, K_e up to {high:g} {units.stiffness}"
        )
    else:
        message = f"{told}: proved ({found.cells} cells, {found.arcs} arcs, {found.run_time_s:.1f} s)"
    return Check(axis=name, name="continuous proof", passed=passed, message=message, warns=reach.share <= 0.0)
