"""Certify any linear law over the domain of a controller file: stability, margins, peaks and what was asked.

The certificate of a controller is for the law that it holds. Another controller runs another law, whose certificate
is made here: the same domain, the same requirements, its own difference equation.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autotune.certificate.certify import prove
from autotune.certificate.family import Claim, CombinedCertificate
from autotune.errors import CertificateError
from autotune.formats.certificate_record import Asked, AxisDomain, AxisMargins
from autotune.formats.controller_record import (
    AxisPrediction,
    Controller,
    FreeSpaceAdmittance,
    PeakPerSpeed,
    ScenarioPrediction,
)
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.plugins import find_requirement
from autotune.prediction.as_run_by import as_run_by, designed_for
from autotune.text import scenario_text
from problems.contact.linear_controller_contact import (
    force_per_speed,
    simulate_linear_contact,
    trace_linear_contact,
)
from problems.contact.transient import Approach, build_sampled_contact
from problems.design.requirements import (
    HANDS,
    AdmittanceRequirement,
    AdmittanceTarget,
    DecayRate,
    LoopRequirement,
    Margin,
    PassivityRequirement,
    PeakForceLimit,
    Requirement,
    hand_approach,
    led_contacts,
    led_mass_kg,
)
from problems.design.uncertainty import ENVIRONMENT_MASS, PlantSet, Scenario
from problems.model.axis_kind import LEVER_M
from problems.model.linear_controllers import LinearController
from problems.model.plant import Plant
from problems.model.response import controller_response, free_space_admittance, plant_response
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError, frequency_grid
from problems.stability.passivity import passive_below_hz

from .axis_proof import STABILITY_WORK, describe_unstable
from .margins import SweptMargins, sweep_margins
from .report import Check
from .requirements import worst_of_loops
from .validation_samples import ValidationSamples, build_validation_samples

_STIFFNESS_POINTS, _MASS_POINTS = 25, 3
_PEAK_STIFFNESS_POINTS = 9
_BAND_POINTS = 41
# What a requirement may be missed by: the frequency grid's share of a margin, as in `validate`.
_MISSED = 1e-3
# The same contacts computed again; the numbers are written whole.
_SAME_NUMBER = 1e-6
_DEFAULT_BAND_HZ = (0.1, 2.0)
# The peaks per speed are the same at any.
_LED_M_S = 0.05
# How much of the room of a weak spring may be used, see `spring_share`.
_SPRING_ROOM = 0.1


@dataclass(frozen=True, kw_only=True)
class AxisTask:
    """What one axis of a controller file was certified for and asked, and what its own law was predicted to do."""

    axis: str
    domain: AxisDomain
    asked: Asked
    margins: AxisMargins
    predicted: AxisPrediction
    sample_time_s: float

    def others(self) -> ValidationSamples:
        """Return the plants of the domain beyond K_e and M_p."""
        return build_validation_samples(self.domain, self.margins, self.predicted)

    def approach(self) -> Approach:
        """Return how the contacts of the file begin; of a speed and a force, the speed."""
        return self.domain.approach

    def contacts(self) -> tuple[Scenario, ...]:
        """Return the contacts that are looked at: those of the file, a grid over K_e × M_p, and the further plants."""
        low, high = self.domain.environment_stiffness_n_per_m
        stiffness = np.unique(np.clip(np.geomspace(low, high, _PEAK_STIFFNESS_POINTS), low, high))
        masses = np.unique(np.linspace(*self.domain.payload_mass_kg, _MASS_POINTS))
        grid = (
            Scenario(environment_stiffness_n_per_m=float(k), payload_mass_kg=float(m))
            for m in masses
            for k in stiffness
        )
        named = (each.scenario() for each in self.predicted.scenarios)
        return tuple(dict.fromkeys((*named, *grid, *self.others().scenarios)))

    def promised_n(self) -> float:
        """Return the largest contact force that the file predicts for its own law."""
        return max(each.peak_contact_force_n for each in self.predicted.scenarios)


@dataclass(frozen=True, kw_only=True)
class LawCertificate:
    """What was found of one law; `missed` says in words what of it is not as was asked, empty when all is.

    `spring_share` is the share of its room that a spring takes (None without one). Without stability there are no
    margins and no peaks. `is_unproved` where a proof ran out and no plant refutes it: narrower ranges may be proved.
    """

    stability: CombinedCertificate
    spring_share: float | None
    margins: SweptMargins | None
    worst: ScenarioPrediction | None
    admittance: FreeSpaceAdmittance | None
    missed: tuple[str, ...]
    is_unproved: bool = False

    @property
    def holds(self) -> bool:
        """Whether everything that was asked is met."""
        return not self.missed


def axis_task(controller: Controller, name: str) -> AxisTask:
    """Return what one axis was certified for; raises CertificateError for what cannot be certified again."""
    asked, domain = controller.certificate.requirements_of(name), controller.certificate.domain[name]
    if asked is None:
        raise CertificateError(f"Axis {name}: the certificate does not say what was asked (rotational_requirements).")
    if domain.plants.range_of(ENVIRONMENT_MASS)[1] != 0.0:
        raise CertificateError(f"Axis {name}: an environment with mass cannot be certified by this release.")
    if domain.approach_force_n is None and domain.approach_speed_m_s is None:
        raise CertificateError(f"Axis {name}: the domain names no approach.")
    if not controller.predicted[name].scenarios:
        raise CertificateError(f"Axis {name}: the file predicts no contact to compare with.")
    return AxisTask(
        axis=name,
        domain=domain,
        asked=asked,
        margins=controller.certificate.margins[name],
        predicted=controller.predicted[name],
        sample_time_s=controller.sample_time_s,
    )


def check_targets(controller: Controller) -> Iterator[Check]:
    """Certify again what the export target runs that a file was designed for; yield nothing for other files."""
    for axis in controller.axes:
        stated = as_run_by(controller, axis)
        if stated is None:
            continue
        found, unit = certify_law(axis_task(controller, axis), stated.law), axis_units(axis).force
        wrong = list(found.missed)
        if found.worst is not None and abs(found.worst.peak_contact_force_n / stated.peak - 1.0) > _SAME_NUMBER:
            wrong.append(f"its largest peak is {found.worst.peak_contact_force_n:.4g} {unit}, not {stated.peak:.4g}")
        led, said = led_by_hand(axis_task(controller, axis), stated.law), stated.peak_per_speed
        wrong += [
            f"its peak per speed of a hand that {hand.replace('_', ' ')} is {getattr(led, hand):.4g}, not "
            f"{getattr(said, hand):.4g}"
            for hand in (() if said is None else said.hands)
            if abs(getattr(led, hand) / getattr(said, hand) - 1.0) > _SAME_NUMBER
        ]
        good = f"stable, all that was asked is met, at most {stated.peak:.1f} {unit} at the contact, as stated"
        yield Check(axis=axis, name=f"as {stated.target} runs it", passed=not wrong, message="; ".join(wrong) or good)


def of_own_law(controller: Controller, checks: Sequence[Check]) -> tuple[Check, ...]:
    """Return checks of the law that a file holds, named so where an export target runs another one."""
    if not designed_for(controller):
        return tuple(checks)
    return tuple(replace(each, name=f"our own law, {each.name}") for each in checks)


def certify_law(task: AxisTask, law: LinearController) -> LawCertificate:
    """Prove the law stable over the domain, sweep its margins, simulate its contacts and compare with what is asked."""
    units, plants, others = axis_units(task.axis), task.domain.plants, task.others()
    stability, share = prove_law(plants, law)
    missed = [] if stability.holds else [describe_unstable(stability, units)]
    if share is not None and not share < _SPRING_ROOM:
        missed.append(f"the return spring takes {100.0 * share:.3g} % of the room that it has, more than 10 %")
    if missed:
        return LawCertificate(
            stability=stability,
            spring_share=share,
            margins=None,
            worst=None,
            admittance=None,
            missed=tuple(missed),
            is_unproved=not stability.holds and stability.false is None,
        )
    h = law.sample_time_s
    swept = sweep_margins(plants, law, h, stiffness=_STIFFNESS_POINTS, mass=_MASS_POINTS, others=others.plants)
    if not swept.largest_radius < 1.0:
        missed.append(f"a plant of the domain is unstable (largest |z| = {swept.largest_radius:.6f})")
        worst = None
    else:
        worst = worst_contact(task, law)
    admittance = _admittance(task, law)
    missed += _missed(task, law, swept, worst, others)
    return LawCertificate(
        stability=stability,
        spring_share=share,
        margins=swept,
        worst=worst,
        admittance=admittance,
        missed=tuple(missed),
    )


def prove_law(plants: PlantSet, law: LinearController) -> tuple[CombinedCertificate, float | None]:
    """Prove stability in free space and in contact; return the proof, and the largest `spring_share` of a spring."""
    claim = Claim(
        plants=plants.only(),
        law=law,
        sample_time_s=law.sample_time_s,
        modulus=None,
        work=STABILITY_WORK,
    )
    found = prove(claim)
    if not law.holds_position:
        return found, None
    masses = np.unique(np.linspace(*plants.payload_mass_kg, _MASS_POINTS))
    return found, max(spring_share(plants.at(float(mass), 0.0), law) for mass in masses)


def spring_share(plant: Plant, law: LinearController) -> float:
    """Return the largest −Re K H(e^{jωh}), H the position per force that the law's spring K closes its loop around.

    The loop with the spring has 1 + K H for its characteristic function over that of the loop without. H is analytic
    outside of the unit circle but for a pole at z = 1 with a positive residue, and 1/(z − 1) has a real part of at
    least −1/2 there: where the loop without spring is stable and −Re K H < 1 on the circle, that with it is stable.
    """
    sampled = build_sampled_plant(plant, law.sample_time_s)
    seen = plant_response(sampled, frequency_grid(sampled))
    loose = replace(law, matrix=law.steady(), approach=None, holds_position=False)
    forward, feedback = controller_response(loose, seen.z, law.sample_time_s)
    _, sprung = controller_response(law, seen.z, law.sample_time_s)
    gain = (sprung - feedback) * seen.position / (1.0 - forward * seen.force + feedback * seen.position)
    return float(np.max(-gain.real))


def led_by_hand(task: AxisTask, law: LinearController) -> PeakPerSpeed:
    """Return the worst peaks per speed of a payload that a hand leads, over the contacts of the domain.

    A hand that pushes on acts as the F^d of that speed; one that lets go leaves what the coupling and the law hold.
    """
    nominal, worst = task.domain.plants.nominal, dict.fromkeys(HANDS, 0.0)
    mass = led_mass_kg(task.asked, LEVER_M if task.axis in ROTATIONAL_AXES else 1.0)
    for scenario in task.contacts():
        pair = build_sampled_contact(build_sampled_plant(scenario.plant(nominal), law.sample_time_s))
        for hand in HANDS:
            approach = hand_approach(_LED_M_S, hand) if hand == "lets_go" else Approach(speed_m_s=_LED_M_S)
            for led in led_contacts(pair, hand, mass):
                try:
                    peak = trace_linear_contact(led, law, approach).peak_contact_force_n
                except UnstableLoopError:
                    if hand != "holds":
                        raise
                    peak = math.inf
                worst[hand] = max(worst[hand], peak / _LED_M_S)
    return PeakPerSpeed.of(worst, mass)


def worst_contact(task: AxisTask, law: LinearController) -> ScenarioPrediction:
    """Return the contact of the domain with the largest force on the environment."""
    units, nominal, approach, found = axis_units(task.axis), task.domain.plants.nominal, task.approach(), []
    for scenario in task.contacts():
        pair = build_sampled_contact(build_sampled_plant(scenario.plant(nominal), law.sample_time_s))
        seen = simulate_linear_contact(pair, law, approach)
        found.append((seen.peak_contact_force_n, scenario, seen))
    _, scenario, seen = max(found, key=lambda each: each[0])
    return ScenarioPrediction.of(scenario_text(scenario, units), scenario, seen)


def smallest_admittance(task: AxisTask, law: LinearController, band_hz: tuple[float, float]) -> float:
    """Return the least |G| over the band, for the nominal robot and the slowest and fastest of the domain."""
    omega = 2.0 * np.pi * np.unique(np.clip(np.geomspace(*band_hz, _BAND_POINTS), *band_hz))
    nominal = task.domain.plants.at(task.domain.payload_mass_kg[0], 0.0)
    ports = (nominal.port, *task.others().extreme_ports())
    return min(
        float(
            np.min(
                np.abs(
                    free_space_admittance(
                        build_sampled_plant(replace(nominal, robot=robot, wrench_filter=wrench), law.sample_time_s),
                        law,
                        omega,
                    )
                )
            )
        )
        for robot, wrench in ports
    )


def _admittance(task: AxisTask, law: LinearController) -> FreeSpaceAdmittance:
    bands = [each.band_hz for each in task.asked.values() if isinstance(each, AdmittanceTarget)]
    band = bands[0] if bands else _DEFAULT_BAND_HZ
    pair = build_sampled_contact(build_sampled_plant(task.domain.plants.nominal, law.sample_time_s))
    return FreeSpaceAdmittance(
        band_hz=band,
        min_m_s_per_n=smallest_admittance(task, law, band),
        hand_force_n_per_m_s=force_per_speed(pair, law),
    )


def _missed(
    task: AxisTask,
    law: LinearController,
    swept: SweptMargins,
    worst: ScenarioPrediction | None,
    others: ValidationSamples,
) -> Iterator[str]:
    """Say which requirements are not met, with both numbers."""
    units, turning = axis_units(task.axis), task.axis in ROTATIONAL_AXES
    for name, asked in dict[str, Any](task.asked).items():
        requirement = find_requirement(name)
        if isinstance(requirement, PeakForceLimit):
            if worst is not None and worst.peak_contact_force_n > asked:
                found_n = f"found {worst.peak_contact_force_n:.4g} {units.force} at {worst.name}"
                yield f"the peak {units.force_name} must be at most {asked:g} {units.force}, {found_n}"
            continue
        found = None if requirement is None else _achieved(requirement, asked, task, law, swept, others)
        if requirement is None or found is None:
            yield f"{name} cannot be verified by this release"
        elif requirement.ratio(asked, found) * (1.0 - _MISSED) > 1.0:
            must = f"at {'most' if requirement.is_upper_limit else 'least'} {requirement.threshold(asked):.4g}"
            unit = requirement.unit_on(turning=turning) if requirement.shown_scale == 1.0 else ""
            yield f"{name} must be {must}{' ' * bool(unit)}{unit}, found {found:.4g}"


def _achieved(
    requirement: Requirement[Any],
    asked: Any,
    task: AxisTask,
    law: LinearController,
    swept: SweptMargins,
    others: ValidationSamples,
) -> float | None:
    """Return what a law achieves of one requirement; None where only the requirement's own code could say it."""
    h, nominal = law.sample_time_s, task.domain.plants.nominal
    if isinstance(requirement, Margin):
        return swept.values[requirement.margin]
    if isinstance(requirement, DecayRate):
        return -math.log(swept.largest_radius) / h
    if isinstance(requirement, AdmittanceRequirement):
        return smallest_admittance(task, law, asked.band_hz)
    if isinstance(requirement, PassivityRequirement):
        extremes = (replace(nominal, robot=robot, wrench_filter=wrench) for robot, wrench in others.extreme_ports())
        return min(passive_below_hz(build_sampled_plant(plant, h), law) for plant in (nominal, *extremes))
    if isinstance(requirement, LoopRequirement):
        return worst_of_loops(requirement, asked, [each.plant(nominal) for each in task.contacts()], law, h)
    return None
