"""Replay the contacts that a certificate predicts, and others of its domain that must not be worse."""

import math
from collections.abc import Iterator, Sequence

from autotune.formats.controller_record import AxisDomain, ScenarioPrediction
from autotune.formats.units import AxisUnits
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant

from .replay import Replay, replay_contact
from .validation_samples import OtherPlants

# Replayed contacts begin anywhere between two samples, predicted ones on a sample (measured: up to 0.5 %).
_SAME_PEAK = 0.02
_SAME_NUMBER = 1e-6


def verify_peaks(
    domain: AxisDomain,
    scenarios: Sequence[ScenarioPrediction],
    others: OtherPlants,
    law: AdmittanceController,
    sample_time_s: float,
    *,
    limit_n: float | None,
    units: AxisUnits,
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
                f"{other.name}: the peak contact {units.force_name} is {found:.2f} {units.force}, more than the "
                f"largest predicted, {promised:.2f} {units.force}"
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
    """Replays of contacts of one domain, and the largest force of them; by default without a collision response."""

    def __init__(
        self,
        domain: AxisDomain,
        law: AdmittanceController,
        sample_time_s: float,
        *,
        reset_threshold_n: float = math.inf,
    ) -> None:
        self.domain, self.law, self.h = domain, law, sample_time_s
        self.reset_threshold_n = reset_threshold_n
        self.nominal = domain.nominal_plant()
        self.largest_n = 0.0

    def force_n(self, plant: Plant) -> float:
        """Return the force that drives the approach; a speed takes more of it where the payload drags more."""
        speed = self.domain.approach_speed_m_s
        if speed is None:
            return self.domain.approach_force_n or 0.0
        return speed * (self.law.damping_n_s_per_m + plant.payload.drag_n_s_per_m)

    def tolerance_n(self, scenario: Scenario, peak_n: float) -> float:
        """Return by how much two roads to the same peak may differ."""
        return _SAME_PEAK * max(peak_n, self.force_n(scenario.plant(self.nominal)))

    def play(self, scenario: Scenario) -> Replay:
        """Replay one contact."""
        plant = scenario.plant(self.nominal)
        force, threshold = self.force_n(plant), self.reset_threshold_n
        seen = replay_contact(plant, self.law, self.h, force, reset_threshold_n=threshold)
        self.largest_n = max(self.largest_n, seen.peak_contact_force_n)
        return seen


def _compared(scenario: ScenarioPrediction, replays: Replays, units: AxisUnits) -> Iterator[str]:
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
    """Say whether a value lies in an interval as far as a file tells it."""
    return interval[0] * (1.0 - _SAME_NUMBER) <= value <= interval[1] * (1.0 + _SAME_NUMBER)


def _corners(domain: AxisDomain) -> list[Scenario]:
    """Return the corners of K_e × M_p at the nominal plant."""
    return [
        Scenario(environment_stiffness_n_per_m=stiffness, payload_mass_kg=mass)
        for mass in sorted(set(domain.payload_mass_kg))
        for stiffness in sorted(set(domain.environment_stiffness_n_per_m))
    ]
