"""Verify a controller from its file alone: one table of checks, by code that the optimizer does not use."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

from autotune.formats.certificate_record import AxisDomain, Proof
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from problems.design.uncertainty import PlantSet
from problems.errors import ParameterError
from problems.model.axis_kind import AxisKind
from problems.model.controller import AdmittanceController

from .axis_proof import Answers, Prover
from .bouncing import search_bouncing
from .bouncing_proof import check_bouncing
from .bumper import check_stated_bumper
from .certified_requirements import limit_n
from .contacts import find_early, verify_led, verify_peaks, verify_response, verify_varied
from .coupled import check_coupled
from .coupled_proof import check_proofs
from .held import check_held
from .limits import unsafe_speed, verify_limits
from .margins import SweptMargins, sweep_margins
from .peak_proof import check_peaks
from .proof_checks import check_continuous, check_stability, check_statements
from .report import Check, ValidationReport
from .requirements import check_admittance, check_further, check_margins, check_requirements
from .validation_samples import ValidationSamples, build_validation_samples, recorded_plants
from .variable_damping import check_variable_damping

# An early touch that peaks this much above what is stated is reported.
_EARLIER = 1.05
_STIFFNESS_POINTS, _MASS_POINTS = 25, 3
_MOST_DEADBAND = 0.5  # of the force that drives the approach
_SAME_NUMBER = 1e-6


def validate_controller(
    controller: Controller,
    progress: Callable[[float], None] | None = None,
    *,
    is_short: bool = False,
    proved: Answers = (),
) -> ValidationReport:
    """Verify all axes of a controller.

    Parameters
    ----------
    controller
        What a file holds.
    progress
        Is passed the share of the work done since the last call.
    is_short
        Leaves it at what an export asks of every file: stability proved over the domain, the margins at its corners
        and at the plants at which the file says that they are smallest, and the limits.
    proved
        What was proved for this certificate in the same run; it is not proved again, and the checks say so.

    Returns
    -------
    ValidationReport
        All checks. Nothing is raised for one that fails: `ValidationReport.require` raises.
    """
    checks: list[Check] = []
    rows = [row for row in _TABLE if row.is_short or not is_short]
    for name in controller.axes:
        case = AxisCase(controller, name, Prover(proved), is_short=is_short)
        for row in rows:
            found = list(row.check(case))
            checks += found
            if progress is not None:
                progress(1.0 / (len(rows) * len(controller.axes)))
            if row.is_needed and not all(each.passed for each in found):
                break
    return ValidationReport(checks=tuple(checks))


class AxisCase:
    """One axis of a controller file, and what several checks of it take, made once."""

    def __init__(self, controller: Controller, name: str, prover: Prover, *, is_short: bool) -> None:
        self.controller, self.name, self.prover, self.is_short = controller, name, prover, is_short
        self.proved: tuple[Proof, ...] = ()

    @property
    def domain(self) -> AxisDomain:
        """The plants that the certificate speaks of."""
        return self.controller.certificate.domain[self.name]

    @property
    def units(self) -> AxisKind:
        """The units of the axis."""
        return axis_units(self.name)

    @cached_property
    def law(self) -> AdmittanceController:
        """The control law."""
        return admittance_controller(self.controller, self.name)

    @cached_property
    def plants(self) -> PlantSet:
        """The plants of the domain."""
        return self.domain.plants

    @cached_property
    def others(self) -> ValidationSamples:
        """The plants beyond K_e and M_p."""
        margins, predicted = self.controller.certificate.margins[self.name], self.controller.predicted[self.name]
        return build_validation_samples(self.domain, margins, predicted)

    @cached_property
    def swept(self) -> SweptMargins:
        """The margins, on the corners and the recorded worst plants only where the validation is short."""
        h = self.controller.sample_time_s
        if self.is_short:
            recorded = recorded_plants(self.domain, self.controller.certificate.margins[self.name])
            return sweep_margins(self.plants, self.law, h, stiffness=2, mass=2, others=recorded)
        return sweep_margins(
            self.plants, self.law, h, stiffness=_STIFFNESS_POINTS, mass=_MASS_POINTS, others=self.others.plants
        )

    def check(self, name: str, wrong: str, message: str = "", *, warns: bool = False) -> Check:
        """Return a check that fails where something is `wrong`."""
        return Check(axis=self.name, name=name, passed=not wrong, message=wrong or message, warns=warns)


def _certificate(case: AxisCase) -> Iterator[Check]:
    certificate = case.controller.certificate
    if any(case.name not in each for each in (certificate.domain, certificate.margins, case.controller.predicted)):
        yield case.check("certificate", "the file holds no certificate for this axis")


def _supported(case: AxisCase) -> Iterator[Check]:
    """Yield what in the file this release cannot verify; a claim that cannot be verified does not hold."""
    controller, rotates = case.controller, case.name in ROTATIONAL_AXES
    wrong = ""
    if controller.certificate.requirements_of(case.name) is None:
        wrong = "the certificate does not say what was asked of rotational axes (rotational_requirements)"
    elif controller.compensation_mass_kg != 0.0 and rotates:
        wrong = "compensation_mass_kg is a mass and says nothing of an axis that turns; it must be 0"
    if wrong:
        yield case.check("controller", wrong)


def _parameters(case: AxisCase) -> Iterator[Check]:
    wrong = ""
    try:
        _ = case.law, case.plants, case.others
        recorded_plants(case.domain, case.controller.certificate.margins[case.name])
    except (ParameterError, TypeError, ValueError, LookupError) as error:
        wrong = str(error)
    yield case.check("parameters", wrong, "gains and plant are within their ranges")


def _payload(case: AxisCase) -> Iterator[Check]:
    if case.name in ROTATIONAL_AXES:
        return
    (low, high), mass = case.domain.payload_mass_kg, case.controller.payload.mass_kg
    certified = f"the certified {low:g} to {high:g} kg"
    carried = f"the runtime takes off the weight of {mass:.4g} kg"
    wrong = "" if low <= mass <= high else f"{carried}, which is outside {certified}"
    yield case.check("payload", wrong, f"{carried}, inside {certified}")


def _delay(case: AxisCase) -> Iterator[Check]:
    domain, assumed = case.domain, case.controller.delay_samples
    _, longest = domain.plants.range_of("delay_s")
    samples = longest / case.controller.sample_time_s
    covered = samples <= assumed * (1.0 + _SAME_NUMBER)
    wrong = f"delay_samples says {assumed:.6g}, the certificate's plant has {samples:.6g}"
    message = f"delay_samples {assumed:.4g} covers the {samples:.4g} samples of the certified plant"
    yield case.check("delay", "" if covered else wrong, message)


def _deadband(case: AxisCase) -> Iterator[Check]:
    """Warn of a deadband that hides most of what drives the approach; the certificate is that of the law without it."""
    gains, domain, units = case.controller.axes[case.name], case.domain, case.units
    speed, resistance = domain.approach_speed_m_s or 0.0, gains.damping + domain.drag_n_s_per_m
    driving = speed * resistance if domain.approach_force_n is None else domain.approach_force_n
    if gains.deadband > _MOST_DEADBAND * driving > 0.0:
        message = (
            f"{gains.deadband:g} {units.force} are {100.0 * gains.deadband / driving:.0f} % of the {driving:.4g} "
            f"{units.force} that drive the approach; below it no contact is felt, and margins and predicted peaks are "
            "those of the law without it"
        )
        yield case.check("deadband", "", message, warns=True)


def _stability(case: AxisCase) -> Iterator[Check]:
    checks, case.proved = check_stability(case.controller, case.name, case.law, case.prover, is_short=case.is_short)
    yield from checks


def _variable_damping(case: AxisCase) -> Iterator[Check]:
    checks, proved = check_variable_damping(case.controller, case.name, case.law, case.prover)
    case.proved += proved
    yield from checks


def _statements(case: AxisCase) -> Iterator[Check]:
    yield check_statements(case.controller, case.name, case.proved)


def _continuous(case: AxisCase) -> Iterator[Check]:
    yield from check_continuous(case.controller, case.name, case.law, case.prover)


def _held(case: AxisCase) -> Iterator[Check]:
    yield from check_held(case.controller, case.name, case.law, case.prover)


def _margins(case: AxisCase) -> Iterator[Check]:
    yield check_margins(case.name, case.controller.certificate.margins[case.name], case.swept)


def _requirements(case: AxisCase) -> Iterator[Check]:
    yield check_requirements(case.controller, case.name, case.swept)


def _admittance(case: AxisCase) -> Iterator[Check]:
    yield check_admittance(case.controller, case.name, case.plants, case.others, case.law)


def _command(case: AxisCase) -> Iterator[Check]:
    yield from check_further(case.controller, case.name, case.plants, case.others, case.law)


def _peaks(case: AxisCase) -> Iterator[Check]:
    message, wrong = verify_peaks(
        case.domain,
        case.controller.predicted[case.name].scenarios,
        case.others,
        case.law,
        case.controller.sample_time_s,
        limit_n=limit_n(case.controller, case.name),
        units=case.units,
    )
    yield case.check("peak force", "; ".join(wrong), message)
    scenarios = case.controller.predicted[case.name].scenarios
    if not message or not scenarios:
        return
    stated = max(each.peak_contact_force_n for each in scenarios)
    early, after = find_early(case.domain, scenarios, case.law, case.controller.sample_time_s)
    if early > _EARLIER * stated:
        unit = case.units.force
        said = (
            f"the peaks are of a steady approach; a touch {after:g} s after F^d comes from rest peaks at {early:.3g} "
            f"{unit} where {stated:.3g} {unit} is stated, since the lead starts with a leap: begin farther away, let "
            "F^d rise slowly, or bound lead_s"
        )
        yield case.check("early touch", "", said, warns=True)


def _proved_peaks(case: AxisCase) -> Iterator[Check]:
    yield from check_peaks(case.controller, case.name, case.law, case.prover)


def _led(case: AxisCase) -> Iterator[Check]:
    try:
        message, wrong = verify_led(case.controller, case.name, case.others, case.law)
    except ParameterError as refusal:
        yield case.check(
            "led by hand", "", f"not confirmed: the second method takes no such plant, {refusal}", warns=True
        )
        return
    if message or wrong:
        yield case.check("led by hand", "; ".join(wrong), message)


def _bouncing(case: AxisCase) -> Iterator[Check]:
    yield from check_bouncing(case.controller, case.name, case.law, case.prover)
    variable, h = case.controller.damping_of(case.name), case.controller.sample_time_s
    for damping in () if variable is None else dict.fromkeys((variable.lowest, variable.highest)):
        law = replace(case.law, damping_n_s_per_m=damping)
        found = search_bouncing(case.name, case.domain, law, h, is_short=True)
        message = f"at a constant B_a of {damping:g}, {found.message()}"
        yield case.check("bouncing", "" if found.passed else message, message)


def _bumper(case: AxisCase) -> Iterator[Check]:
    yield from check_stated_bumper(case.controller, case.name, case.prover)


def _together(case: AxisCase) -> Iterator[Check]:
    """Yield the check of all axes together, once."""
    if case.name == next(iter(case.controller.axes)):
        yield from check_coupled(case.controller)
        yield from check_proofs(case.controller, case.prover)


def _limits(case: AxisCase) -> Iterator[Check]:
    message, wrong = verify_limits(case.controller, case.name, case.domain, case.law)
    yield case.check("limits", "; ".join(wrong), message, warns=case.controller.limits is None)
    if unsafe := unsafe_speed(case.controller, case.name):
        yield case.check("speed limit", "", f"{unsafe}: keep a led payload slower by other means", warns=True)


def _response(case: AxisCase) -> Iterator[Check]:
    for name, verify in (("varied peaks", verify_varied), ("collision response", verify_response)):
        message, wrong = verify(case.controller, case.name, case.domain, case.law)
        if message or wrong:
            yield case.check(name, "; ".join(wrong), message)


class _Row(NamedTuple):
    """A check; without one that `is_needed` nothing more is looked at, and a short validation takes `is_short` ones."""

    check: Callable[[AxisCase], Iterator[Check]]
    is_short: bool = True
    is_needed: bool = False


_TABLE = (
    _Row(_certificate, is_needed=True),
    _Row(_supported, is_needed=True),
    _Row(_parameters, is_needed=True),
    _Row(_payload),
    _Row(_delay),
    _Row(_deadband),
    _Row(_stability, is_needed=True),
    _Row(_variable_damping),
    _Row(_statements),
    _Row(_continuous, is_short=False),
    _Row(_held, is_short=False),
    _Row(_margins),
    _Row(_requirements),
    _Row(_admittance, is_short=False),
    _Row(_command, is_short=False),
    _Row(_peaks, is_short=False),
    _Row(_proved_peaks, is_short=False),
    _Row(_led, is_short=False),
    _Row(_bouncing, is_short=False),
    _Row(_bumper, is_short=False),
    _Row(_together, is_short=False),
    _Row(_limits),
    _Row(_response, is_short=False),
)
