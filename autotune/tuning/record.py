"""Write a search result down as a controller with everything that the certificate claims."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

from autotune.formats.certificate_record import (
    AxisDomain,
    AxisMargins,
    Certificate,
    Requirement,
    SoftRequirement,
)
from autotune.formats.controller_record import (
    AxisGains,
    AxisPrediction,
    CollisionSettings,
    Controller,
    ControllerStatus,
    Filters,
    FreeSpaceAdmittance,
    PeakPerSpeed,
    RuntimePayload,
    ScenarioPrediction,
)
from autotune.formats.limits import Biquad, CollisionResponse
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.text import scenario_text
from autotune.validation.axis_proof import AxisProof
from autotune.validation.driving_arm import driven_plants
from autotune.validation.validation_samples import sampled_claims
from identification.errors import EstimateError
from identification.result import Identified, Status
from problems.contact.nonlinearities import DeadbandType
from problems.design.batch_evaluation import batch_led_peaks
from problems.design.driving_hand import REACTION_S, largest_driven_peak
from problems.design.evaluation import PlantMargins, build_scenarios
from problems.design.hand import HandImpedance
from problems.design.problem import DesignProblem, Requirements
from problems.design.requirements import (
    HANDS,
    HeldByHand,
    hand_approach,
    led_contacts,
    led_mass_kg,
    smallest_admittance,
)
from problems.design.stable_design import Peak
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.axis_kind import LEVER_M
from problems.model.controller import AdmittanceController
from problems.model.response import hand_force_per_speed

from .problems import has_no_weight, is_mass_range
from .search import SearchResult

_DEFAULT_DEADBAND_N = 5.0
_DEFAULT_BAND_HZ = (0.1, 2.0)
_PREDICTED_STIFFNESS, _PREDICTED_MASS = 5, 2
# Any speed gives the same ratio.
_LED_M_S = 0.1
MARGIN_NAMES = ("modulus", "gain_db", "phase_deg", "delay_s")


def build_controller(
    results: Mapping[str, SearchResult],
    payload: RuntimePayload,
    proved: Mapping[str, AxisProof],
    provenance: Mapping[str, Any],
) -> Controller:
    """Assemble the controller of all tuned axes.

    The axes share h, filters and payload, and axes of a kind their requirements; they come from one identified file
    and one problem. `payload` is what the runtime compensates.
    """
    first = next(iter(results.values())).problem
    controllers = {name: result.problem.controller(result.design) for name, result in results.items()}
    law = next(iter(controllers.values()))
    domain = {name: build_domain(result.problem) for name, result in results.items()}
    margins = {name: _margins(result.margins) for name, result in results.items()}
    predicted = {name: _prediction(name, results[name], c) for name, c in controllers.items()}
    soft = {name: _soft(result) for name, result in results.items() if result.problem.requirements.soft_n}
    asked = {name in ROTATIONAL_AXES: _requirements(result.problem.requirements) for name, result in results.items()}
    return Controller(
        status=ControllerStatus.VALIDATED,
        sample_time_s=first.sample_time_s,
        discretization="tustin",
        delay_samples=max(_longest_delay_s(r.problem) for r in results.values()) / first.sample_time_s,
        axes={name: _gains(name, controller) for name, controller in controllers.items()},
        filters=Filters(
            velocity_rad_per_s=law.velocity_filter_rad_per_s,
            acceleration_rad_per_s=law.acceleration_filter_rad_per_s,
        ),
        compensation_mass_kg=law.compensation_mass_kg,
        collision=CollisionSettings(response=CollisionResponse.NONE, threshold_n=None),
        payload=payload,
        predicted=predicted,
        certificate=Certificate(
            domain=domain,
            sample_time_s=first.sample_time_s,
            requirements=asked.get(False, {}),
            rotational_requirements=asked.get(True),
            proved=tuple(proof for each in proved.values() for proof in each.proofs),
            sampled=tuple(
                claim
                for name in results
                for claim in sampled_claims(
                    domain[name], margins[name], predicted[name], name, proved[name].regions, proved[name].bouncing
                )
            ),
            margins=margins,
            soft=soft or None,
            continuous={name: each.regions for name, each in proved.items()} or None,
            held={name: each.held for name, each in proved.items() if each.held is not None} or None,
            peaks={name: each.peak for name, each in proved.items() if each.peak is not None} or None,
            bouncing={name: each.bouncing for name, each in proved.items() if each.bouncing is not None} or None,
        ),
        provenance=provenance,
    )


def _longest_delay_s(problem: DesignProblem) -> float:
    return max(problem.plants.nominal.robot.delay_s, problem.plants.range_of("delay_s")[1])


def _gains(name: str, controller: AdmittanceController) -> AxisGains:
    return AxisGains(
        mass=controller.mass_kg,
        damping=controller.damping_n_s_per_m,
        lead_s=controller.lead_s,
        feedback_damping_s=controller.feedback_damping_s,
        deadband=_DEFAULT_DEADBAND_N * LEVER_M if name in ROTATIONAL_AXES else _DEFAULT_DEADBAND_N,
        deadband_type=DeadbandType.THRESHOLD,
        biquad=_biquad(controller),
    )


def _biquad(law: AdmittanceController) -> Biquad | None:
    if not law.has_biquad:
        return None
    return Biquad(
        zero_s=law.biquad_zero_s,
        zero_damping_ratio=law.biquad_zero_damping_ratio,
        pole_s=law.biquad_pole_s,
        pole_damping_ratio=law.biquad_pole_damping_ratio,
    )


def runtime_payload(identified: Identified, mass_kg: float, *, is_chosen: bool) -> RuntimePayload:
    """Return what gravity compensation needs; raises EstimateError for a log that showed no centre of mass or bias.

    Where a person wrote the plant and left them out, or gave a range of mass of which none was chosen (`is_chosen`),
    or the log's wrench has no weight, the payload must be set in the cell.
    """
    is_range = is_mass_range(identified) and not is_chosen
    estimates = (identified.payload.com_m, identified.sensor.force_bias_n, identified.sensor.torque_bias_n_m)
    com, force, torque = (each.value for each in estimates)
    is_written = all(each.value is not None or each.status is Status.GIVEN for each in estimates)
    if (is_written or has_no_weight(identified)) and (is_range or None in (com, force, torque)):
        none = (0.0, 0.0, 0.0)
        return RuntimePayload(mass_kg=mass_kg, com_m=none, force_bias_n=none, torque_bias_n_m=none, set_in_cell=True)
    if com is None or force is None or torque is None:
        raise EstimateError(
            "payload.com_m, sensor.force_bias_n and sensor.torque_bias_n_m must be identified, because the runtime "
            "compensates gravity with them; record poses at rest, forces and torques, or write those that you know "
            "into identified.yaml with the status given."
        )
    return RuntimePayload(
        mass_kg=mass_kg,
        com_m=(com[0], com[1], com[2]),
        force_bias_n=(force[0], force[1], force[2]),
        torque_bias_n_m=(torque[0], torque[1], torque[2]),
    )


def admittance_band_hz(requirements: Requirements) -> tuple[float, float]:
    """Return the band over which the free-space admittance is given: that of the target, if there is one."""
    target = requirements.free_space_admittance
    return target.band_hz if target is not None else _DEFAULT_BAND_HZ


def _prediction(name: str, result: SearchResult, controller: AdmittanceController) -> AxisPrediction:
    """Predict a grid of contacts of the nominal plant, and the worst ones that the search found anywhere."""
    problem = result.problem
    prepared = build_scenarios(problem, problem.scenarios(_PREDICTED_STIFFNESS, _PREDICTED_MASS))
    peaks = prepared.peaks(controller)
    worst = [
        max(result.evaluation.peaks, key=attrgetter(kind)) for kind in ("peak_contact_force_n", "peak_sensor_force_n")
    ]
    known = set(prepared.scenarios)
    peaks += tuple(dict.fromkeys(peak for peak in worst if peak.scenario not in known))
    band = admittance_band_hz(problem.requirements)
    return AxisPrediction(
        scenarios=tuple(
            ScenarioPrediction.of(scenario_text(peak.scenario, axis_units(name)), peak.scenario, peak) for peak in peaks
        ),
        free_space_admittance=FreeSpaceAdmittance(
            band_hz=band,
            min_m_s_per_n=smallest_admittance(prepared.free[0], controller, band),
            hand_force_n_per_m_s=hand_force_per_speed(problem.plants.nominal, controller),
        ),
        peak_per_speed=_peak_per_speed(name, result, peaks, controller),
    )


def _peak_per_speed(
    name: str, result: SearchResult, peaks: Sequence[Peak], controller: AdmittanceController
) -> PeakPerSpeed:
    """Return the worst peaks of a payload led by hand, over these contacts and those that the search ended with."""
    every = (peak.scenario for peak in (*peaks, *result.evaluation.peaks))
    pairs = build_scenarios(result.problem, tuple(dict.fromkeys(every))).pairs
    mass = led_mass_kg(result.problem.requirements.asked(), LEVER_M if name in ROTATIONAL_AXES else 1.0)
    worst = dict.fromkeys(HANDS, 0.0)
    alone, *held = zip(*(led_contacts(pair, "holds", mass) for pair in pairs), strict=True)
    for led, hands in ((alone, HANDS), *((each, ("holds",)) for each in held)):
        forces = batch_led_peaks(led, controller, [hand_approach(_LED_M_S, hand) for hand in hands])
        for hand, force in zip(hands, forces.max(axis=1).tolist(), strict=True):
            worst[hand] = max(worst[hand], force / _LED_M_S)
    found = PeakPerSpeed.of(worst, mass)
    hardest = max(peaks, key=attrgetter("peak_contact_force_n")).scenario
    return replace(found, **_driven(result, hardest, controller, certified_hand(name, result.problem)))


def _driven(
    result: SearchResult, hardest: Scenario, controller: AdmittanceController, arm: HandImpedance
) -> dict[str, Any]:
    """Return the worst peak of a payload that an arm drives on, as the record has it; nothing where it is unknown."""
    plants, h = driven_plants(build_domain(result.problem), hardest), result.problem.sample_time_s
    try:
        largest = largest_driven_peak(plants, controller, arm, h) if arm.stiffness_n_per_m > 0.0 else math.inf
    except ParameterError:
        # A surface with a mass, or a command that acts at once through a coupling with damping.
        return {}
    return {"drives": largest, "drives_for_s": REACTION_S, "arm": arm} if math.isfinite(largest) else {}


def certified_hand(name: str, problem: DesignProblem) -> HandImpedance:
    """Return the hand that an axis is certified with: the one of the requirement `held_by_hand`, else the default."""
    asked = problem.requirements.asked().get("held_by_hand")
    if isinstance(asked, HeldByHand):
        return asked.hand
    return HandImpedance().turned(LEVER_M) if name in ROTATIONAL_AXES else HandImpedance()


def build_domain(problem: DesignProblem) -> AxisDomain:
    """Return the set of plants that a design problem asks to be safe."""
    return AxisDomain.of(problem.plants, problem.approach)


def _requirements(requirements: Requirements) -> dict[str, Requirement]:
    """Return what must be met."""
    return {name: asked for name, asked in requirements.asked().items() if name not in requirements.soft_n}


def _soft(result: SearchResult) -> dict[str, SoftRequirement]:
    """Return what need not be met, and what the design achieves over the whole uncertainty."""
    requirements, ratios = result.problem.requirements, result.evaluation.soft
    return {
        name: SoftRequirement(
            asked=asked,
            soft_n=requirements.soft_n[name],
            achieved=requirements.kind(name).achieved_at(asked, ratios[name]),
        )
        for name, asked in requirements.asked().items()
        if name in requirements.soft_n
    }


def _margins(found: tuple[PlantMargins, ...]) -> AxisMargins:
    """Return the smallest margins over the dense grid of the domain and free space, each with its plant."""
    worst = {name: min(found, key=lambda f: float(getattr(f.margins, name))) for name in MARGIN_NAMES}
    return AxisMargins(
        **{name: float(getattr(plant.margins, name)) for name, plant in worst.items()},
        worst={
            name: {
                "environment_stiffness_n_per_m": plant.environment_stiffness_n_per_m,
                "payload_mass_kg": plant.payload_mass_kg,
                **plant.scenario.further(),
            }
            for name, plant in worst.items()
        },
    )
