"""First contacts of a controller in the full simulation, with its strategies for contacts and nothing else besides."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import (
    AxisPrediction,
    Controller,
    ScenarioPrediction,
    admittance_controller,
    file_deadband,
)
from autotune.formats.limits import VariableDampingSettings
from autotune.formats.units import axis_units
from autotune.text import scenario_text
from autotune.validation.disturbances import simulated_damping
from problems.arrays import FloatArray
from problems.contact.nonlinear_simulation import NonlinearRun, needed_substeps, simulate_nonlinear
from problems.contact.nonlinearities import Collision, Deadband, Nonlinearities, Response
from problems.contact.transient import Approach
from problems.design.uncertainty import Scenario
from problems.model.controller import AdmittanceController

# Peaks at the contact and at the sensor, N.
Pair = tuple[float, float]

# A response begins before the peak that it lowers, and what follows the peak may be higher.
_PEAKS_LATER, _SHORTEST_S, _LONGEST_S = 4.0, 0.3, 10.0
# The start of an approach, until its speed is steady.
_APPROACH_S = 1.0
_FAR = 5.0


@dataclass(frozen=True, kw_only=True)
class FirstContacts:
    """Contacts of one axis, each `duration_s` long, from the steady approach of its certificate.

    `variable` is what B_a does with the speed, `response` what a detected collision is answered with.
    """

    domain: AxisDomain
    law: AdmittanceController
    deadband: Deadband
    sample_time_s: float
    duration_s: float
    variable: VariableDampingSettings | None = None
    response: Response = "reset"

    @property
    def approach(self) -> Approach:
        """The approach that the certificate speaks of."""
        return self.domain.approach

    def run(self, scenario: Scenario, threshold_n: float | None) -> NonlinearRun:
        """Simulate one contact from its impact on; `threshold_n` None is no response."""
        collision = None if threshold_n is None else Collision(response=self.response, threshold_n=threshold_n)
        return self._simulate(scenario, self._effects(collision=collision), self.duration_s, None)

    def _effects(self, *, collision: Collision | None = None, deadband: Deadband | None = None) -> Nonlinearities:
        variable = None if self.variable is None else simulated_damping(self.variable, self.sample_time_s)
        return Nonlinearities(collision=collision, deadband=deadband, variable_damping=variable)

    def _starts(self) -> tuple[Nonlinearities, Nonlinearities]:
        """Return what acts in free motion, with the file's deadband and without."""
        return self._effects(), self._effects(deadband=self.deadband)

    def free_motion_n(self, scenarios: Iterable[Scenario]) -> float:
        """Return the largest force against the motion, N, as the approach begins from rest and until it is steady.

        The force is switched on at once, the payload is all that the flange carries; with the file's deadband and
        without, for every corner of the certified set and the given scenarios.
        """
        softest = self.domain.environment_stiffness_n_per_m[0]
        corners = (*scenarios, *self.domain.plants.corners())
        different = dict.fromkeys(replace(each, environment_stiffness_n_per_m=softest) for each in corners)
        speed = self.domain.approach_speed_m_s or (self.domain.approach_force_n or 0.0) / self.law.damping_n_s_per_m
        distance = _FAR * speed * _APPROACH_S
        largest = 0.0
        for scenario in different:
            for effects in self._starts():
                run = self._simulate(scenario, effects, _APPROACH_S, distance)
                largest = max(largest, float(np.max(opposing_force(run, begins_moving=False))))
        return largest

    def starts(self, scenarios: Iterable[Scenario]) -> Iterator[FloatArray]:
        """Yield the command (n,) of an approach from rest far from the wall, with the file's deadband and without."""
        speed = self.domain.approach_speed_m_s or (self.domain.approach_force_n or 0.0) / self.law.damping_n_s_per_m
        for scenario in scenarios:
            for effects in self._starts():
                yield self._simulate(scenario, effects, _APPROACH_S, _FAR * speed * _APPROACH_S).command_m

    def _simulate(
        self, scenario: Scenario, effects: Nonlinearities, duration_s: float, distance_m: float | None
    ) -> NonlinearRun:
        plant = scenario.plant(self.domain.plants.nominal)
        return simulate_nonlinear(
            plant,
            self.law,
            self.approach,
            sample_time_s=self.sample_time_s,
            duration_s=duration_s,
            effects=effects,
            start_distance_m=distance_m,
            substeps=needed_substeps(plant, self.sample_time_s),
        )


@dataclass(frozen=True, kw_only=True)
class RespondingContact:
    """One contact of a controller, and what it is with the response; `plain` is without.

    Of all thresholds below `levels[i]` and not below the level before, the detection is at `ticks[i]`: one run each,
    which `known` keeps.
    """

    simulate: FirstContacts
    scenario: Scenario
    plain: NonlinearRun
    ticks: NDArray[np.int64]
    levels: FloatArray
    known: dict[int, NonlinearRun] = field(default_factory=dict)

    def run(self, threshold_n: float) -> NonlinearRun:
        """Return the contact with the response; it is `plain` where nothing passes the threshold."""
        place = int(np.searchsorted(self.levels, threshold_n, side="right"))
        if place == len(self.levels):
            return self.plain
        tick = int(self.ticks[place])
        if tick not in self.known:
            self.known[tick] = self.simulate.run(self.scenario, threshold_n)
        return self.known[tick]

    def peaks(self, threshold_n: float) -> Pair:
        """Return the peaks with the response."""
        return peaks_of(self.run(threshold_n))


def build_contact(simulate: FirstContacts, scenario: Scenario) -> RespondingContact:
    """Simulate a contact without a response and note where a detection would be."""
    plain = simulate.run(scenario, None)
    opposing = opposing_force(plain, begins_moving=True)
    before = np.maximum.accumulate(np.concatenate([[0.0], opposing[:-1]]))
    ticks = np.flatnonzero(opposing > before)
    return RespondingContact(simulate=simulate, scenario=scenario, plain=plain, ticks=ticks, levels=opposing[ticks])


def peaks_of(run: NonlinearRun) -> Pair:
    """Return the peaks at the contact and at the sensor."""
    return run.peak_contact_force_n, run.peak_sensor_force_n


def opposing_force(run: NonlinearRun, *, begins_moving: bool) -> FloatArray:
    """Return −F sign(v) (n,), N, at the ticks as the detection sees it, v being the way over the last period.

    `begins_moving`: the run begins at an impact, under way, and not at rest.
    """
    signs = np.sign(np.diff(run.flange_position_m))
    return np.asarray(run.sensor_force_n * np.concatenate([[float(begins_moving)], signs]))


def contacts_of(controller: Controller, name: str) -> FirstContacts:
    """Return the contacts of one axis of a controller."""
    latest = max(each.time_of_peak_s for each in controller.predicted[name].scenarios)
    return FirstContacts(
        domain=controller.certificate.domain[name],
        law=admittance_controller(controller, name),
        deadband=file_deadband(controller.axes[name]),
        sample_time_s=controller.sample_time_s,
        duration_s=min(max(_SHORTEST_S, _PEAKS_LATER * latest), _LONGEST_S),
        variable=controller.damping_of(name),
    )


def predictions(
    name: str, predicted: AxisPrediction, runs: Mapping[Scenario, NonlinearRun]
) -> tuple[ScenarioPrediction, ...]:
    """Return the predicted contacts as they are in `runs`, and the worst ones of all runs."""
    known = {each.scenario() for each in predicted.scenarios}
    worst = {max(runs, key=lambda each: peaks_of(runs[each])[kind]) for kind in (0, 1)}
    return tuple(
        ScenarioPrediction.of(scenario_text(scenario, axis_units(name)), scenario, run)
        for scenario, run in runs.items()
        if scenario in known or scenario in worst
    )
