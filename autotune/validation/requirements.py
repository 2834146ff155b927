"""Margins, requirements, admittance, noise and passivity: what was asked of a controller, found again."""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from autotune.formats.certificate_record import AxisMargins
from autotune.formats.controller_record import Controller
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.plugins import find_requirement
from problems.design.evaluation import build_scenarios
from problems.design.problem import DesignProblem
from problems.design.requirements import (
    AdmittanceRequirement,
    AdmittanceTarget,
    DecayRate,
    LoopRequirement,
    Margin,
    NoiseLimit,
    PassivityTarget,
    PeakForceLimit,
    Requirement,
)
from problems.design.uncertainty import PlantSet
from problems.model.controller import AdmittanceController
from problems.model.plant import FREE_SPACE, Plant
from problems.model.sampled import Controller as LoopController
from problems.model.sampled import build_sampled_plant

from .certified_requirements import asked_of, certified_problem_requirements, describe_soft
from .margins import SweptMargins
from .report import Check
from .simulated_responses import passive_band_hz, sampled_admittance, worst_speed_rms
from .validation_samples import ValidationSamples

_MASS_POINTS, _NOISE_STIFFNESS_POINTS = 3, 9
# Two roads to the same margin differ by their frequency grids (measured: 1e-4); what differs by more is another margin.
_SAME_MARGIN = 0.01
_GRID = 5, 2


def check_margins(name: str, claimed: AxisMargins, swept: SweptMargins) -> Check:
    """Hold the margins that a file claims against those of a sweep: less may be claimed, more may not."""
    wrong = []
    for key in ("modulus", "gain_db", "phase_deg", "delay_s"):
        said = getattr(claimed, key)
        found = swept.values[key]
        said = math.inf if said is None else float(said)
        if said > found * (1.0 + _SAME_MARGIN) and not (math.isinf(said) and math.isinf(found)):
            wrong.append(f"{key} is claimed as {said:.6g}, found {found:.6g}")
    text = ", ".join(f"{key} {swept.values[key]:.4g}" for key in ("modulus", "gain_db", "phase_deg", "delay_s"))
    return Check(
        axis=name,
        name="margins",
        passed=not wrong and swept.largest_radius < 1.0,
        message="; ".join(wrong) or f"confirmed on {swept.plants} plants: {text}",
    )


def check_requirements(controller: Controller, name: str, swept: SweptMargins) -> Check:
    """Check that the margins and the decay of a sweep meet what was asked of the axis."""
    missed, known, asked = [], 0, dict[str, Any](asked_of(controller, name))
    for key, required in asked.items():
        requirement = find_requirement(key)
        if requirement is None:
            missed.append(f"{key} cannot be verified: no requirement of that name is installed")
            continue
        if isinstance(required, bool):
            missed.append(f"{key} cannot be verified by this release, which asks for its number, found {required}")
            continue
        if isinstance(requirement, Margin):
            reached = swept.values[requirement.margin]
        elif isinstance(requirement, DecayRate):
            reached = -math.log(swept.largest_radius) / controller.sample_time_s
        else:
            continue
        known += 1
        if requirement.ratio(required, reached) * (1.0 - 0.1 * _SAME_MARGIN) > 1.0:
            missed.append(f"{key} must be at least {required:.6g}, found {reached:.6g}")
    return Check(
        axis=name,
        name="requirements",
        passed=not missed,
        message="; ".join(missed) or f"all {known} margins that were asked are met{describe_soft(controller, name)}",
    )


def check_admittance(
    controller: Controller, name: str, plants: PlantSet, others: ValidationSamples, law: AdmittanceController
) -> Check:
    """Check the steady hand force and |G| in free space against what is claimed and what was asked."""
    predicted = controller.predicted[name].free_space_admittance
    found = sampled_admittance(plants.nominal.port, law, controller.sample_time_s, predicted.band_hz)
    wrong = []
    units = axis_units(name)
    hand = law.damping_n_s_per_m + plants.nominal.payload.drag_n_s_per_m
    if abs(predicted.hand_force_n_per_m_s / hand - 1.0) > _SAME_MARGIN:
        said = f"{predicted.hand_force_n_per_m_s:.6g} {units.hand}"
        wrong.append(f"the hand {units.force_name} is claimed as {said}, found {hand:.6g}")
    if abs(found / predicted.min_m_s_per_n - 1.0) > _SAME_MARGIN:
        wrong.append(f"|G| is claimed as {predicted.min_m_s_per_n:.6g} {units.admittance}, found {found:.6g}")
    for required in asked_of(controller, name).values():
        if isinstance(required, AdmittanceTarget):
            # G does not hang on the payload; among the robots the slowest and the fastest cover all.
            reached = min(
                sampled_admittance(port, law, controller.sample_time_s, required.band_hz)
                for port in (plants.nominal.port, *others.extreme_ports())
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


def check_further(
    controller: Controller, name: str, plants: PlantSet, others: ValidationSamples, law: AdmittanceController
) -> Iterator[Check]:
    """Check the command's noise, the passive band and every other requirement, where they were asked."""
    h = controller.sample_time_s
    for key, required in asked_of(controller, name).items():
        requirement = find_requirement(key)
        if isinstance(required, bool):
            continue  # refused by `check_requirements`
        if isinstance(requirement, Margin | DecayRate | PeakForceLimit | AdmittanceRequirement | None):
            continue  # margins are swept, peaks and the admittance have checks of their own
        if isinstance(required, NoiseLimit):
            reached = required.speed_rms_m_s(worst_speed_rms(_loop_plants(plants, others), law, h))
        elif isinstance(required, PassivityTarget):
            ports = (plants.nominal.port, *others.extreme_ports())
            reached = min(passive_band_hz(port, law, h, required.passive_below_hz) for port in ports)
        elif isinstance(requirement, LoopRequirement):
            reached = worst_of_loops(requirement, required, _loop_plants(plants, others), law, h)
        else:
            reached = _worst_of_scenarios(controller, name, requirement, required, others, law)
        yield _compared(name, requirement, required, reached)


def _compared(name: str, requirement: Requirement[Any], required: Any, reached: float) -> Check:
    met = requirement.ratio(required, reached) * (1.0 - 0.1 * _SAME_MARGIN) <= 1.0
    turning = name in ROTATIONAL_AXES
    found = f"{requirement.shown_scale * reached:.4g} {requirement.unit_on(turning=turning)}".strip()
    asked = requirement.describe(required, turning=turning)
    message = f"found {found}, required: {asked}"
    return Check(axis=name, name=requirement.title, passed=met, message=message)


def worst_of_loops(
    requirement: LoopRequirement[Any], required: Any, plants: Sequence[Plant], law: LoopController, h: float
) -> float:
    """Return what is achieved by the worst of the loops of these plants, in contact and in free space."""
    both = dict.fromkeys((*plants, *(plant.in_contact_with(FREE_SPACE) for plant in plants)))
    found = [requirement.verified(required, build_sampled_plant(plant, h), law) for plant in both]
    return max(found) if requirement.is_upper_limit else min(found)


def _worst_of_scenarios(
    controller: Controller,
    name: str,
    requirement: Requirement[Any],
    required: Any,
    others: ValidationSamples,
    law: AdmittanceController,
) -> float:
    """Return what is achieved on a grid of the domain, by the requirement's own code."""
    domain = controller.certificate.domain[name]
    problem = DesignProblem(
        plants=domain.plants,
        sample_time_s=controller.sample_time_s,
        approach=domain.approach,
        requirements=certified_problem_requirements(controller, name),
    )
    named = (each.scenario() for each in controller.predicted[name].scenarios)
    scenarios = dict.fromkeys((*problem.scenarios(*_GRID), *named, *others.scenarios))
    design = build_scenarios(problem, tuple(scenarios)).stable(law)
    ratio = float(np.max(requirement.ratios(required, design)))
    return requirement.achieved_at(required, ratio)


def _loop_plants(plants: PlantSet, others: ValidationSamples) -> tuple[Plant, ...]:
    """Return a grid of the set, ends included, and the further plants, all in contact."""
    masses = np.linspace(*plants.payload_mass_kg, _MASS_POINTS)
    low, high = plants.environment_stiffness_n_per_m
    stiffnesses = np.clip(np.geomspace(low, high, _NOISE_STIFFNESS_POINTS), low, high)
    grid = dict.fromkeys((float(m), float(k)) for m in masses for k in stiffnesses)
    return tuple(dict.fromkeys((*(plants.at(m, k) for m, k in grid), *others.plants)))
