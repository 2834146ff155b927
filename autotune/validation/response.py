"""Verify what a controller file says of its collision response: every contact is replayed with it, from rest."""

from collections.abc import Iterator, Mapping

from autotune.formats.controller_record import AxisDomain, CollisionResponse, Controller, ScenarioPrediction
from autotune.formats.records import ROTATIONAL_AXES
from autotune.formats.units import axis_units
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController

from .peaks import Replays, inside

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
    told = predicted.with_collision_response
    if not has_response(controller, name) or threshold is None:
        reason = "contacts with a collision response are predicted, and the file has none on this axis"
        return "", [reason] if told else []
    if not told:
        return "", ["the file has a collision response and predicts no contact with it"]
    with_response = {each.scenario(): each for each in told}
    wrong = [
        f"{each.name}: no contact with the collision response is predicted"
        for each in predicted.scenarios
        if each.scenario() not in with_response
    ]
    wrong += _risen(controller, name)
    replays = Replays(domain, law, controller.sample_time_s, reset_threshold_n=threshold)
    begun = 0
    for scenario, each in with_response.items():
        if not _is_certified(domain, scenario):
            wrong.append(f"{each.name}: the contact lies outside of the certified domain")
            continue
        seen = replays.play(scenario)
        begun += seen.detected_after_s is not None
        if seen.detected_after_s is not None and seen.detected_after_s < 0.0:
            wrong.append(f"{each.name}: free motion passes the threshold of {threshold:g} N before the touch")
        else:
            wrong += _differences(each, vars(seen), replays, axis_units(name).force)
    message = (
        f"reset at {threshold:g} N: {len(with_response)} contacts replayed, it begins in {begun} and never before the "
        f"touch; largest {replays.largest_n:.1f} N, as predicted"
    )
    return message, wrong


def _is_certified(domain: AxisDomain, scenario: Scenario) -> bool:
    return (
        inside(scenario.environment_stiffness_n_per_m, domain.environment_stiffness_n_per_m)
        and inside(scenario.payload_mass_kg, domain.payload_mass_kg)
        and (not scenario.further() or domain.uncertainty().contains(scenario))
    )


def _risen(controller: Controller, name: str) -> Iterator[str]:
    """Yield the worst peaks that the file itself says are higher with the response."""
    predicted = controller.predicted[name]
    for what, key in _KINDS.items():
        without = max(float(getattr(each, key)) for each in predicted.scenarios)
        found = max(float(getattr(each, key)) for each in predicted.with_collision_response)
        if found > (1.0 + _NO_HIGHER) * without:
            yield f"the worst peak {what} force is {found:.2f} N with the response, {without:.2f} N without"


def _differences(said: ScenarioPrediction, seen: Mapping[str, float], replays: Replays, unit: str) -> Iterator[str]:
    for what, key in _KINDS.items():
        predicted, found = float(getattr(said, key)), seen[key]
        if abs(found - predicted) > replays.tolerance_n(said.scenario(), predicted):
            yield (
                f"{said.name}: with the response the peak {what} force is predicted as {predicted:.2f} {unit}, "
                f"replayed {found:.2f} {unit}"
            )
