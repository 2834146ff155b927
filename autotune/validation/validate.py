"""Verify a controller from its file alone: every claim is made again by code that the optimizer does not use."""

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from autotune.errors import CertificateError
from autotune.files.controller_record import (
    AdmittanceRequirement,
    AxisDomain,
    AxisMargins,
    CollisionResponse,
    Controller,
    Proof,
    Reach,
)
from autotune.files.records import ROTATIONAL_AXES
from autotune.files.units import axis_units
from problems.controller import AdmittanceController
from problems.errors import ParameterError
from problems.plant import NO_FILTER, Coupling, Plant
from problems.requirements import NoiseLimit, PassivityTarget
from problems.robot import RobotModel
from problems.uncertainty import SYMBOLS, Scenario

from .admittance import sampled_admittance
from .bouncing import search_bouncing
from .command import passive_band_hz, worst_speed_rms
from .continuous import prove_over, refuted_inside, told_false
from .limits import verify_limits
from .margins import SweptMargins, sweep_margins
from .peaks import verify_peaks
from .promises import asked_of, limit_n, soft_told
from .proof import StabilityProof, UncertainPlant, prove_stability
from .refuted import RefutedError
from .response import has_response, verify_response
from .statements import stability_statement, wrong_statements
from .whole_set import OtherPlants, build_other_plants, recorded_plants

_STIFFNESS_POINTS, _MASS_POINTS = 25, 3
_NOISE_STIFFNESS_POINTS = 9
_MOST_DEADBAND = 0.5  # of the force that drives the approach
# Two roads to the same margin differ by their frequency grids (measured: 1e-4); what differs by more is another margin.
_SAME_MARGIN = 0.01
_SAME_NUMBER = 1e-6
_CHECKS = 12  # per axis, all passing; that of the payload's mass is none of a rotational axis
_MARGIN_OF = {
    "modulus_margin": "modulus",
    "gain_margin_db": "gain_db",
    "phase_margin_deg": "phase_deg",
    "delay_margin_s": "delay_s",
}


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that was verified on one axis, in words; `passed` is the verdict.

    `warns`: nothing is wrong, but nothing was shown either, or somebody should look at it.
    """

    axis: str
    name: str
    passed: bool
    message: str
    warns: bool = False

    @property
    def verdict(self) -> str:
        """Return the verdict in a word: ok, note or FAILED."""
        return ("note" if self.warns else "ok") if self.passed else "FAILED"


@dataclass(frozen=True, kw_only=True)
class ValidationReport:
    """All checks of a controller, in the order in which they ran."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    def require(self) -> None:
        """Raise CertificateError with the first check that failed."""
        failed = [check for check in self.checks if not check.passed]
        if failed:
            more = f" ({len(failed) - 1} more checks failed)" if len(failed) > 1 else ""
            raise CertificateError(f"Axis {failed[0].axis}, {failed[0].name}: {failed[0].message}{more}")


def validate_controller(
    controller: Controller, progress: Callable[[float], None] | None = None, *, is_short: bool = False
) -> ValidationReport:
    """Verify all axes; `progress` is told the share of the work done since the last call.

    `is_short` leaves it at what an export asks of every file: stability proved over the domain, and the margins at its
    corners and at the plants at which the file says that they are smallest. Nothing is raised for a check that fails:
    the report holds it (`ValidationReport.require` raises).
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
        yield _margins(name, margins, swept)
        yield _requirements(controller, name, swept)
        return
    for reach in (controller.certificate.continuous or {}).get(name, ()):
        yield _continuous(name, domain, law, h, reach)
    swept = sweep_margins(plants, law, h, stiffness=_STIFFNESS_POINTS, mass=_MASS_POINTS, others=others.plants)
    yield _margins(name, margins, swept)
    yield _requirements(controller, name, swept)
    yield _admittance(controller, name, plants, others, law)
    yield from _command(controller, name, plants, others, law)
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
    told, missed = verify_limits(controller, name, domain, law)
    message = "; ".join(missed) or told
    yield Check(axis=name, name="limits", passed=not missed, message=message, warns=controller.limits is None)
    told, missed = verify_response(controller, name, domain, law)
    if told or missed:
        yield Check(axis=name, name="collision response", passed=not missed, message="; ".join(missed) or told)


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


def _margins(name: str, claimed: AxisMargins, swept: SweptMargins) -> Check:
    wrong = []
    for key in ("modulus", "gain_db", "phase_deg", "delay_s"):
        said = getattr(claimed, key)
        found = swept.values[key]
        said = math.inf if said is None else float(said)
        if said > found * (1.0 + _SAME_MARGIN) and not (math.isinf(said) and math.isinf(found)):
            wrong.append(f"{key} is claimed as {said:.6g}, found {found:.6g}")
    told = ", ".join(f"{key} {swept.values[key]:.4g}" for key in ("modulus", "gain_db", "phase_deg", "delay_s"))
    return Check(
        axis=name,
        name="margins",
        passed=not wrong and swept.largest_radius < 1.0,
        message="; ".join(wrong) or f"confirmed on {swept.plants} plants: {told}",
    )


def _requirements(controller: Controller, name: str, swept: SweptMargins) -> Check:
    missed, known = [], 0
    for key, required in asked_of(controller, name).items():
        if isinstance(required, AdmittanceRequirement | NoiseLimit | PassivityTarget):
            continue
        if key in _MARGIN_OF:
            reached = swept.values[_MARGIN_OF[key]]
        elif key == "decay_rate_per_s":
            reached = -math.log(swept.largest_radius) / controller.sample_time_s
        elif key == "max_peak_force_n":
            continue
        else:
            missed.append(f"{key} cannot be verified by this release")
            continue
        known += 1
        if reached < float(required) * (1.0 - _SAME_MARGIN * 0.1):
            missed.append(f"{key} must be at least {required:.6g}, found {reached:.6g}")
    return Check(
        axis=name,
        name="requirements",
        passed=not missed,
        message="; ".join(missed) or f"all {known} margins that were asked are met{soft_told(controller, name)}",
    )


def _admittance(
    controller: Controller, name: str, plants: UncertainPlant, others: OtherPlants, law: AdmittanceController
) -> Check:
    predicted = controller.predicted[name].free_space_admittance
    found = sampled_admittance(plants.port, law, controller.sample_time_s, predicted.band_hz)
    wrong = []
    units = axis_units(name)
    hand = law.damping_n_s_per_m + plants.drag_n_s_per_m
    if abs(predicted.hand_force_n_per_m_s / hand - 1.0) > _SAME_MARGIN:
        said = f"{predicted.hand_force_n_per_m_s:.6g} {units.hand}"
        wrong.append(f"the hand {units.force_name} is claimed as {said}, found {hand:.6g}")
    if abs(found / predicted.min_m_s_per_n - 1.0) > _SAME_MARGIN:
        wrong.append(f"|G| is claimed as {predicted.min_m_s_per_n:.6g} {units.admittance}, found {found:.6g}")
    for required in asked_of(controller, name).values():
        if isinstance(required, AdmittanceRequirement):
            # G does not hang on the payload; among the robots the slowest and the fastest stand for all.
            reached = min(
                sampled_admittance(port, law, controller.sample_time_s, required.band_hz)
                for port in (plants.port, *others.extreme_ports())
            )
            if reached < required.min_m_s_per_n * (1.0 - 0.1 * _SAME_MARGIN):
                wrong.append(
                    f"|G| must be at least {required.min_m_s_per_n:.6g} {units.admittance}, found {reached:.6g}"
                )
    band = f"{predicted.band_hz[0]:g} to {predicted.band_hz[1]:g} Hz"
    return Check(
        axis=name,
        name="free-space admittance",
        passed=not wrong,
        message="; ".join(wrong) or f"at least {found:.4g} {units.admittance} from {band}",
    )


def _command(
    controller: Controller, name: str, plants: UncertainPlant, others: OtherPlants, law: AdmittanceController
) -> Iterator[Check]:
    """Check the command's noise and the passive band, where they were asked."""
    h, units = controller.sample_time_s, axis_units(name)
    for required in asked_of(controller, name).values():
        if isinstance(required, NoiseLimit):
            found = (required.force_noise_rms_n or 0.0) * worst_speed_rms(_noise_plants(plants, others), law, h)
            met = found <= required.max_speed_rms_m_s * (1.0 + 0.1 * _SAME_MARGIN)
            told = f"{found:.4g} {units.speed} under {units.force_name} noise of {required.force_noise_rms_n:g}"
            limit = f"at most {required.max_speed_rms_m_s:.4g} {units.speed}"
            message = f"the command's speed RMS is {told} {units.force}, {limit}"
            yield Check(
                axis=name, name="command noise", passed=met, message=message if met else f"{message} is claimed"
            )
        if isinstance(required, PassivityTarget):
            ports = (plants.port, *others.extreme_ports())
            reached = min(passive_band_hz(port, law, h, required.passive_below_hz) for port in ports)
            met = reached >= required.passive_below_hz * (1.0 - 0.1 * _SAME_MARGIN)
            message = f"the port is passive up to {reached:.4g} Hz"
            must = f"{message}, claimed up to {required.passive_below_hz:.4g} Hz"
            yield Check(axis=name, name="passivity", passed=met, message=message if met else must)


def _noise_plants(plants: UncertainPlant, others: OtherPlants) -> tuple[Plant, ...]:
    """Return a grid of the set, ends included, and the further plants, all in contact."""
    masses = np.linspace(*plants.payload_mass_kg, _MASS_POINTS)
    low, high = plants.environment_stiffness_n_per_m
    stiffnesses = np.clip(np.geomspace(low, high, _NOISE_STIFFNESS_POINTS), low, high)
    grid = dict.fromkeys((float(m), float(k)) for m in masses for k in stiffnesses)
    return tuple(dict.fromkeys((*(plants.at(m, k) for m, k in grid), *others.plants)))
