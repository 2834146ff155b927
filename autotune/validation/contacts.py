"""Replay the contacts that a certificate predicts: their peaks, the collision response, and the runtime's limits."""

import math
from collections.abc import Iterator, Mapping, Sequence

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, ScenarioPrediction
from autotune.formats.limits import CollisionResponse
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.text import scenario_text
from problems.contact.nonlinear_simulation import needed_substeps, simulate_nonlinear
from problems.design.requirements import Hand, hand_approach, led_plants
from problems.design.uncertainty import Scenario
from problems.model.axis_kind import AxisKind
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.stability.margins import UnstableLoopError

from .certified_requirements import limit_n
from .driving_arm import find_driven
from .false_triggers import describe_false_triggers, wrong_false_triggers
from .replay import NO_STRATEGY, SHORTEST_AFTER_S, Replay, Strategy, replay_contact, settling_samples
from .validation_samples import ValidationSamples

# Replayed contacts begin between two samples, predicted ones on a sample (measured: up to 0.5 %).
_SAME_PEAK = 0.02
_SAME_NUMBER = 1e-6
# Moments after the start from rest at which an early touch is looked at.
_EARLY_S = (0.02, 0.04, 0.07, 0.12, 0.2, 0.35, 0.6)


def verify_peaks(
    domain: AxisDomain,
    scenarios: Sequence[ScenarioPrediction],
    others: ValidationSamples,
    law: AdmittanceController,
    sample_time_s: float,
    *,
    limit_n: float | None,
    units: AxisKind,
) -> tuple[str, list[str]]:
    """Return what was confirmed, and what is wrong: contacts that differ, lie outside or exceed `limit_n`."""
    if domain.approach_force_n is None and domain.approach_speed_m_s is None:
        return "", ["the domain names no approach"]
    if not scenarios:
        return "", ["the file predicts no contact"]
    wrong = [f"{case} lies outside of the certified domain" for case in others.outside]
    replays = Replays(domain, law, sample_time_s)
    for scenario in scenarios:
        stiffness, mass = scenario.environment_stiffness_n_per_m, scenario.payload_mass_kg
        if not inside(stiffness, domain.environment_stiffness_n_per_m) or not inside(mass, domain.payload_mass_kg):
            wrong.append(f"{scenario.name}: the contact lies outside of the certified domain")
        else:
            wrong += _compared(scenario, replays, units)
    # What was promised has been replayed; the rest of the domain must not be worse.
    promised = max(scenario.peak_contact_force_n for scenario in scenarios)
    for other in others.replayed:
        found = replays.play(other).peak_contact_force_n
        if found > promised + replays.tolerance_n(other, promised):
            wrong.append(
                f"{scenario_text(other, units)}: the peak contact {units.force_name} is {found:.2f} {units.force}, "
                f"more than the largest predicted, {promised:.2f} {units.force}"
            )
    if limit_n is not None:
        # The limit is promised for the whole domain, whatever contacts the file lists.
        for corner in _corners(domain):
            replays.play(corner)
        if replays.largest_n > limit_n * (1.0 + _SAME_PEAK):
            wrong.append(
                f"the peak {units.force_name} must be at most {limit_n:g} {units.force}, found {replays.largest_n:.2f} "
                f"{units.force}"
            )
    count = len(scenarios) + len(others.replayed)
    return f"{count} contacts replayed, largest {replays.largest_n:.1f} {units.force}, as predicted", wrong


class Replays:
    """Replays of contacts of one domain, and the largest force of them; by default of the gains alone."""

    def __init__(
        self,
        domain: AxisDomain,
        law: AdmittanceController,
        sample_time_s: float,
        strategy: Strategy = NO_STRATEGY,
    ) -> None:
        self.domain, self.law, self.h = domain, law, sample_time_s
        self.strategy = strategy
        self.nominal = domain.plants.nominal
        self.largest_n = 0.0

    def force_n(self, plant: Plant) -> float:
        """Return the force that drives the approach; a speed takes more of it where the payload drags more."""
        speed = self.domain.approach_speed_m_s
        if speed is None:
            return self.domain.approach_force_n or 0.0
        return speed * (self.law.damping_n_s_per_m + plant.payload.drag_n_s_per_m)

    def tolerance_n(self, scenario: Scenario, peak_n: float) -> float:
        """Return by how much two roads to the same peak may differ.

        A full stop may come a tick sooner or later, and what the approach goes on by in a tick then stays.
        """
        plant = scenario.plant(self.nominal)
        same = _SAME_PEAK * max(peak_n, self.force_n(plant))
        if not self.strategy.stops:
            return same
        k_s, k_e = plant.coupling.stiffness_n_per_m, plant.environment.stiffness_n_per_m
        speed = self.force_n(plant) / (self.law.damping_n_s_per_m + plant.payload.drag_n_s_per_m)
        return same + speed * self.h * k_s * k_e / (k_s + k_e)

    def play(self, scenario: Scenario) -> Replay:
        """Replay one contact."""
        plant = scenario.plant(self.nominal)
        seen = replay_contact(plant, self.law, self.h, self.force_n(plant), strategy=self.strategy)
        self.largest_n = max(self.largest_n, seen.peak_contact_force_n)
        return seen


def find_early(
    domain: AxisDomain, scenarios: Sequence[ScenarioPrediction], law: AdmittanceController, sample_time_s: float
) -> tuple[float, float]:
    """Return the largest peak of the hardest contact where it comes soon after F^d does, from rest, and when [s].

    Predicted contacts are of a steady approach. A lead far above M_a/B_a and the robot's lag makes the approach leap
    first, and a contact during that is harder.
    """
    hardest = max(scenarios, key=lambda each: each.peak_contact_force_n).scenario().plant(domain.plants.nominal)
    force = Replays(domain, law, sample_time_s).force_n(hardest)
    return max(
        (replay_contact(hardest, law, sample_time_s, force, touch_after_s=after).peak_contact_force_n, after)
        for after in _EARLY_S
    )


def _compared(scenario: ScenarioPrediction, replays: Replays, units: AxisKind) -> Iterator[str]:
    seen = replays.play(scenario.scenario())
    for what, said, found in (
        ("contact", scenario.peak_contact_force_n, seen.peak_contact_force_n),
        ("sensor", scenario.peak_sensor_force_n, seen.peak_sensor_force_n),
    ):
        if abs(found - said) > replays.tolerance_n(scenario.scenario(), said):
            yield (
                f"{scenario.name}: the peak {what} {units.force_name} is predicted as {said:.2f} {units.force}, "
                f"replayed {found:.2f} {units.force}"
            )


def inside(value: float, interval: tuple[float, float]) -> bool:
    """Say whether a value lies in an interval to the digits of a file."""
    return interval[0] * (1.0 - _SAME_NUMBER) <= value <= interval[1] * (1.0 + _SAME_NUMBER)


def _corners(domain: AxisDomain) -> list[Scenario]:
    """Return the corners of K_e × M_p at the nominal plant."""
    return [
        Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass)
        for mass in sorted(set(domain.payload_mass_kg))
        for stiffness in sorted(set(domain.environment_stiffness_n_per_m))
    ]


_KINDS = {"contact": "peak_contact_force_n", "sensor": "peak_sensor_force_n"}
# A threshold is chosen so that no worst peak rises; what is called the same there is so here.
_NO_HIGHER = 2e-3


def has_response(controller: Controller, name: str) -> bool:
    """Say whether the motion of this axis is watched for a collision; that of axes that turn is not."""
    return controller.collision.response is not CollisionResponse.NONE and name not in ROTATIONAL_AXES


def verify_response(
    controller: Controller, name: str, domain: AxisDomain, law: AdmittanceController
) -> tuple[str, list[str]]:
    """Return what was confirmed of the response on one axis, and what is wrong.

    Confirmed is for every contact that nothing is detected before the touch, from rest under the whole force on, and
    that the peaks are those in the file; of the file's own numbers, that the worst are no higher than without.
    """
    predicted, threshold = controller.predicted[name], controller.collision.threshold_n
    stated = predicted.with_collision_response
    if not has_response(controller, name) or threshold is None:
        reason = "contacts with a collision response are predicted, and the file has none on this axis"
        return "", [reason] if stated else []
    if not stated:
        return "", ["the file has a collision response and predicts no contact with it"]
    with_response = {each.scenario(): each for each in stated}
    wrong = [
        f"{each.name}: no contact with the collision response is predicted"
        for each in predicted.scenarios
        if each.scenario() not in with_response
    ]
    wrong += _risen(stated, predicted.with_variable_damping or predicted.scenarios)
    stops = controller.collision.response is CollisionResponse.STOP
    strategy = Strategy(threshold_n=threshold, stops=stops, variable=controller.damping_of(name))
    replays = Replays(domain, law, controller.sample_time_s, strategy)
    begun, opposed = 0, 0.0
    for scenario, each in with_response.items():
        if not _is_certified(domain, scenario):
            wrong.append(f"{each.name}: the contact lies outside of the certified domain")
            continue
        seen = replays.play(scenario)
        opposed = max(opposed, seen.opposed_n)
        begun += seen.detected_after_s is not None
        if seen.detected_after_s is not None and seen.detected_after_s < 0.0:
            wrong.append(f"{each.name}: free motion passes the threshold of {threshold:g} N before the touch")
        else:
            wrong += _differences(each, vars(seen), replays, axis_units(name).force)
    wrong += wrong_false_triggers(controller, opposed)
    message = (
        f"{controller.collision.response.value} at {threshold:g} N: {len(with_response)} contacts replayed, it begins "
        f"in {begun} and never before the touch; largest {replays.largest_n:.1f} N, as predicted"
    )
    stated_triggers = controller.collision.false_triggers
    if stated_triggers is not None:
        message += f"; {describe_false_triggers(stated_triggers)}"
    return message, wrong


def verify_varied(
    controller: Controller, name: str, domain: AxisDomain, law: AdmittanceController
) -> tuple[str, list[str]]:
    """Return what was confirmed of the contacts under a B_a that varies, and what is wrong.

    A limit of the peak that is asked holds for them, too.
    """
    predicted, variable = controller.predicted[name], controller.damping_of(name)
    stated, limit = predicted.with_variable_damping, limit_n(controller, name)
    if variable is None:
        reason = "contacts with variable damping are predicted, and the file has none on this axis"
        return "", [reason] if stated else []
    if not stated:
        return "", ["the file varies B_a and predicts no contact with it"]
    known = {each.scenario() for each in stated}
    wrong = [
        f"{each.name}: no contact with variable damping is predicted"
        for each in predicted.scenarios
        if each.scenario() not in known
    ]
    replays = Replays(domain, law, controller.sample_time_s, Strategy(variable=variable))
    for each in stated:
        if not _is_certified(domain, each.scenario()):
            wrong.append(f"{each.name}: the contact lies outside of the certified domain")
            continue
        wrong += _differences(each, vars(replays.play(each.scenario())), replays, axis_units(name).force)
    if limit is not None and replays.largest_n > limit * (1.0 + _SAME_PEAK):
        wrong.append(f"the peak force must be at most {limit:g} N, found {replays.largest_n:.2f} with variable damping")
    message = (
        f"B_a from {variable.lowest:g} to {variable.highest:g} N·s/m: {len(stated)} contacts replayed, largest "
        f"{replays.largest_n:.1f} N, as predicted"
    )
    return message, wrong


def _is_certified(domain: AxisDomain, scenario: Scenario) -> bool:
    return (
        inside(scenario.environment_stiffness_n_per_m, domain.environment_stiffness_n_per_m)
        and inside(scenario.payload_mass_kg, domain.payload_mass_kg)
        and (not scenario.further() or domain.plants.contains(scenario))
    )


def _risen(stated: Sequence[ScenarioPrediction], plain: Sequence[ScenarioPrediction]) -> Iterator[str]:
    """Yield the worst peaks that the file itself says are higher with the response."""
    for what, key in _KINDS.items():
        without = max(float(getattr(each, key)) for each in plain)
        found = max(float(getattr(each, key)) for each in stated)
        if found > (1.0 + _NO_HIGHER) * without:
            yield f"the worst peak {what} force is {found:.2f} N with the response, {without:.2f} N without"


def _differences(said: ScenarioPrediction, seen: Mapping[str, float], replays: Replays, unit: str) -> Iterator[str]:
    for what, key in _KINDS.items():
        predicted, found = float(getattr(said, key)), seen[key]
        if abs(found - predicted) > replays.tolerance_n(said.scenario(), predicted):
            yield (
                f"{said.name}: with it the peak {what} force is predicted as {predicted:.2f} {unit}, "
                f"replayed {found:.2f} {unit}"
            )


_LED_M_S = 0.05


def verify_led(
    controller: Controller, name: str, others: ValidationSamples, law: AdmittanceController
) -> tuple[str, list[str]]:
    """Return what was confirmed of the peaks per speed of a payload that is led by hand, and what is wrong.

    The contacts are those of the file and samples of the domain, integrated by Runge-Kutta steps with the hand's force
    on the payload; none of them may be above what the file says. Raises ParameterError for a plant that they cannot
    take.
    """
    stated, domain = controller.predicted[name].peak_per_speed, controller.certificate.domain[name]
    if stated is None:
        return "", []
    listed = controller.predicted[name].scenarios
    scenarios = tuple(dict.fromkeys((*(each.scenario() for each in listed), *_corners(domain), *others.replayed)))
    plants = [each.plant(domain.plants.nominal) for each in scenarios]
    h, units, mass = controller.sample_time_s, axis_units(name), stated.hand_mass_kg or 0.0
    found = {
        hand: max(_led_peak(led, law, hand, h) for plant in plants for led in led_plants(plant, hand, mass)[-1:])
        for hand in stated.hands
    }
    wrong = [
        f"the peak per speed of a hand that {hand.replace('_', ' ')} is stated as {getattr(stated, hand):.4g} "
        f"{units.damping}, found {largest:.4g}"
        for hand, largest in found.items()
        if largest > getattr(stated, hand) * (1.0 + _SAME_PEAK)
    ]
    hardest = max(listed, key=lambda each: each.peak_contact_force_n, default=None)
    driven = 0.0 if hardest is None else find_driven(stated, domain, hardest.scenario(), law, h)
    if driven > (stated.drives or 0.0) * (1.0 + _SAME_PEAK):
        wrong.append(
            f"the peak per speed where an arm drives on is stated as {stated.drives or 0.0:.4g} {units.damping}, found "
            f"{driven:.4g}"
        )
    at_most = {hand: f"{_LED_M_S * getattr(stated, hand):.4g} {units.force}" for hand in stated.hands}
    held = f", {at_most['holds']} with {mass:g} {units.mass} of it on the payload" if "holds" in at_most else ""
    held += f", {_LED_M_S * driven:.4g} {units.force} where an arm drives on" if driven > 0.0 else ""
    return (
        f"{len(scenarios)} contacts at {_LED_M_S:g} {units.speed} peak at most {at_most['pushes_on']} while the hand "
        f"pushes on{held}, {at_most['lets_go']} when it lets go"
    ), wrong


def _led_peak(plant: Plant, law: AdmittanceController, hand: Hand, h: float) -> float:
    """Return the peak contact force per speed of one contact of a payload that is led by hand."""
    try:
        run = simulate_nonlinear(
            plant,
            law,
            hand_approach(_LED_M_S, hand),
            sample_time_s=h,
            duration_s=h * settling_samples(plant, law, h, SHORTEST_AFTER_S),
            substeps=needed_substeps(plant, h),
        )
    except UnstableLoopError:
        if hand != "holds":
            raise
        return math.inf
    rest = 0.0 if hand == "lets_go" else run.driving_force_n
    return max(run.peak_contact_force_n, rest) / _LED_M_S
