"""The threshold of the collision response: chosen after the gains, in the full simulation of their worst contacts."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from autotune.errors import InfeasibleError, UsageError
from autotune.formats.controller_record import AxisPrediction, CollisionSettings, Controller
from autotune.formats.limits import CollisionResponse
from autotune.formats.problem import ProblemSpec
from autotune.formats.units import ROTATIONAL_AXES
from autotune.validation.false_triggers import (
    MOST_PER_HOUR,
    correlation_of,
    count_false_triggers,
    needed_deviations,
    noise_in_free_space,
)
from autotune.validation.variable_damping import METHOD as VARIED
from identification.result import Identified, NoiseSpectrum
from problems.arrays import FloatArray
from problems.contact.nonlinearities import Response
from problems.design.objectives import PLACES, PeakObjective, force_of
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError

from .first_contacts import RespondingContact, build_contact, contacts_of, peaks_of, predictions
from .search import SearchResult

Interval = tuple[float, float]

SAME_PEAK = 1e-3
"""Peaks this close, as a share, are one peak: the higher threshold counts then, for fewer false alarms."""
ASSUMED_NOISE_N = 0.5
"""RMS that is taken, and named, where none was identified: two to three times that of a good sensor."""
# Intervals between the thresholds at which a detection moves by a tick; only a very fast controller has more.
_MOST_INTERVALS = 2048
_SPLIT_DIGITS = range(4, 16)


@dataclass(frozen=True, kw_only=True)
class ThresholdSettings:
    """What is asked: the bounds of the threshold, and the RMS of the sensor's noise, N, known or assumed.

    `response` is what a detected collision is answered with, `noise` is the noise's spectrum.
    """

    bounds_n: Interval
    response: CollisionResponse = CollisionResponse.RESET
    noise: NoiseSpectrum | None = None
    noise_rms_n: float = ASSUMED_NOISE_N
    is_assumed: bool = False


def threshold_settings(identified: Identified, spec: ProblemSpec) -> ThresholdSettings | None:
    """Return what a problem asks of the collision response, with the identified noise; None where it asks for none.

    Where no noise was identified a conservative one is taken, and the choice says so.
    """
    if spec.collision_threshold is None:
        return None
    noise = identified.sensor.force_noise_rms_n.value
    return ThresholdSettings(
        bounds_n=spec.collision_threshold,
        response=spec.collision_response,
        noise_rms_n=ASSUMED_NOISE_N if noise is None else noise,
        is_assumed=noise is None,
        noise=None if noise is None else identified.sensor.noise,
    )


@dataclass(frozen=True, kw_only=True)
class ThresholdChoice:
    """The best threshold inside the bounds, and whether it is worth a response (`is_used`).

    `free_motion_n` is the largest force against the motion as the approach begins and goes on in free space,
    `lowest_n` what a threshold must be above; `worst_without_n` and `worst_with_n` are the worst peaks of the
    objective's force. `limited_by` names which end of the range the best ones reach, if they do.
    """

    settings: ThresholdSettings
    free_motion_n: float
    lowest_n: float
    threshold_n: float
    worst_without_n: float
    worst_with_n: float
    is_used: bool
    limited_by: str | None

    def tree(self, objective: PeakObjective) -> dict[str, Any]:
        """Return the choice as plain data, for the provenance of a controller."""
        return {
            "bounds_n": list(self.settings.bounds_n),
            "noise_rms_n": self.settings.noise_rms_n,
            **({"noise_is_assumed": True} if self.settings.is_assumed else {}),
            "free_motion_n": self.free_motion_n,
            "lowest_n": self.lowest_n,
            "objective": objective.name,
            "best_threshold_n": self.threshold_n,
            "limited_by": self.limited_by,
            "worst_peak_n": {"without": self.worst_without_n, "with": self.worst_with_n},
            "response": self.settings.response.value if self.is_used else "none",
        }


def choose_threshold(
    controller: Controller,
    searches: Mapping[str, SearchResult],
    settings: ThresholdSettings,
) -> tuple[Controller, ThresholdChoice]:
    """Return the controller with the response that is asked, or without one where none lowers the worst peak.

    Minimised is the worst peak of the objective's force (at the contact where the objective is no force) over the
    predicted contacts and the scenarios of the search of every tuned x, y, z; of none of these axes may the worst peak
    rise, at the contact or at the sensor. What was predicted and certified stays as it is, and
    `predicted.<axis>.with_collision_response` holds the same contacts with the response.

    Raises InfeasibleError where free motion alone would pass every threshold asked for, UsageError where no axis is a
    straight one or the full simulation cannot do the contact.
    """
    straight = [name for name in controller.axes if name not in ROTATIONAL_AXES]
    if not straight:
        raise UsageError("collision_threshold_n is a force, and only axes that turn are tuned; leave it out of free.")
    objective = force_of(searches[straight[0]].problem.objective)
    kind: Response = "stop" if settings.response is CollisionResponse.STOP else "reset"
    simulations = {name: replace(contacts_of(controller, name), response=kind) for name in straight}
    scenarios = {name: predicted_scenarios(controller.predicted[name], searches[name]) for name in straight}
    try:
        free = max(simulations[name].free_motion_n(scenarios[name]) for name in straight)
        lowest = _lowest(controller, straight, settings, free)
        contacts = {name: [build_contact(simulations[name], each) for each in scenarios[name]] for name in straight}
    except ParameterError as error:
        raise UsageError(
            f"free.collision_threshold_n: the contact cannot be simulated with a response: {error}"
        ) from error
    choice = _choose(contacts, settings, free, lowest, PLACES.index(objective.place))
    provenance = {**controller.provenance, "collision": choice.tree(objective)}
    if not choice.is_used:
        return replace(controller, provenance=provenance), choice
    predicted = {
        name: _with_response(name, controller.predicted[name], contacts[name], choice.threshold_n)
        if name in contacts
        else controller.predicted[name]
        for name in controller.axes
    }
    collision = CollisionSettings(response=settings.response, threshold_n=choice.threshold_n)
    controller = replace(controller, collision=collision, predicted=predicted, provenance=provenance)
    false_triggers = count_false_triggers(
        controller,
        free_motion_n=free,
        noise_rms_n=settings.noise_rms_n,
        correlation=correlation_of(settings.noise, controller.sample_time_s),
    )
    return replace(controller, collision=replace(collision, false_triggers=false_triggers)), choice


def without_response(controller: Controller) -> Controller:
    """Return the same gains and certificate, but what is proved of a B_a that varies, without any strategy."""
    return replace(
        controller,
        collision=CollisionSettings(response=CollisionResponse.NONE, threshold_n=None),
        variable_damping=None,
        predicted={
            name: replace(each, with_collision_response=(), with_variable_damping=())
            for name, each in controller.predicted.items()
        },
        certificate=replace(
            controller.certificate,
            proved=tuple(each for each in controller.certificate.proved if each.method != VARIED),
        ),
    )


def predicted_scenarios(predicted: AxisPrediction, search: SearchResult) -> tuple[Scenario, ...]:
    """Return the contacts that are predicted, and those that the search ended with."""
    return tuple(dict.fromkeys((*(each.scenario() for each in predicted.scenarios), *search.active.scenarios)))


def _lowest(controller: Controller, straight: Sequence[str], settings: ThresholdSettings, free_n: float) -> float:
    """Return what the threshold must be above; refuse bounds that hold nothing of it."""
    deadband = max(controller.axes[name].deadband for name in straight)
    h = controller.sample_time_s
    felt = [noise_in_free_space(controller, name, correlation_of(settings.noise, h)) for name in straight]
    deviations = max(each.gain * needed_deviations(each.correlation, h, len(straight)) for each in felt)
    lowest = max(free_n + deviations * settings.noise_rms_n, deadband)
    low, high = settings.bounds_n
    if high <= lowest:
        asked = f"{low:g} N" if low == high else f"{low:g} to {high:g} N"
        raise InfeasibleError(
            f"free.collision_threshold_n asks for {asked}, and a threshold must be above {lowest:.4g} N: as the "
            f"approach begins in free space {free_n:.3g} N oppose the motion, the sensor's noise is "
            f"{settings.noise_rms_n:.3g} N RMS ({deviations:.3g} of them are passed {MOST_PER_HOUR:g} times an hour) "
            f"and the deadband hides {deadband:g} N. The response would be spent before the contact; raise the upper "
            "bound, or leave the entry out."
        )
    return lowest


def _choose(
    contacts: Mapping[str, Sequence[RespondingContact]],
    settings: ThresholdSettings,
    free_n: float,
    lowest_n: float,
    kind: int,
) -> ThresholdChoice:
    """Find the least worst peak of one `kind`, 0 at the contact or 1 at the sensor, and the highest threshold of it.

    The worst peak is constant between the levels at which the detection of some contact moves by a tick.
    """
    every = [contact for of_axis in contacts.values() for contact in of_axis]
    low, high = max(settings.bounds_n[0], math.nextafter(lowest_n, math.inf)), settings.bounds_n[1]
    tried = [_inside(*each) for each in _intervals(every, low, high)]
    without = _worst(contacts, None)
    hardest = max(every, key=lambda each: peaks_of(each.plain)[kind])
    first = np.array([hardest.peaks(each)[kind] for each in tried])
    acts = np.array([hardest.run(each) is not hardest.plain for each in tried])
    guess = int(np.argmin(np.where(acts, first, math.inf) if acts.any() else first))
    guessed = _worst(contacts, tried[guess])
    enough = (1.0 - SAME_PEAK) * float(np.max(without[:, kind]))
    # The worst of all contacts is no lower than that of one: what is beaten there needs no look at the others.
    limit = enough if _rises(guessed, without) else min(enough, (1.0 + SAME_PEAK) * float(np.max(guessed[:, kind])))
    found = {i: _worst(contacts, tried[i]) for i in np.flatnonzero(first <= limit).tolist()}
    lowered = {i: float(np.max(each[:, kind])) for i, each in found.items() if not _rises(each, without)}
    lowered = {i: peak for i, peak in lowered.items() if peak <= enough}
    least = min(lowered.values(), default=math.inf)
    as_good = [i for i, peak in lowered.items() if peak <= (1.0 + SAME_PEAK) * least] or [guess]
    best = max(as_good)
    return ThresholdChoice(
        settings=settings,
        free_motion_n=free_n,
        lowest_n=lowest_n,
        threshold_n=tried[best],
        worst_without_n=float(np.max(without[:, kind])),
        worst_with_n=lowered.get(best, float(np.max(guessed[:, kind]))),
        is_used=bool(lowered),
        limited_by=_limited_by(as_good, len(tried), settings, lowest_n),
    )


def _worst(contacts: Mapping[str, Sequence[RespondingContact]], threshold_n: float | None) -> FloatArray:
    """Return the worst peaks of every axis (axes, 2), at the contact and at the sensor; None is no response."""
    peaks = [
        [peaks_of(each.plain if threshold_n is None else each.run(threshold_n)) for each in of_axis]
        for of_axis in contacts.values()
    ]
    return np.array([np.max(np.array(of_axis), axis=0) for of_axis in peaks])


def _rises(worst: FloatArray, without: FloatArray) -> bool:
    """Say whether the worst peak of one of the forces on one of the axes is higher than without a response."""
    return bool(np.any(worst > (1.0 + SAME_PEAK) * without))


def _intervals(contacts: Sequence[RespondingContact], low: float, high: float) -> list[Interval]:
    """Return the intervals over which every contact is the same run, from low to high; the most of them at most."""
    levels = np.unique(np.concatenate([each.levels for each in contacts]))
    edges = [low, *levels[(levels > low) & (levels < high)].tolist(), high]
    pairs = list(itertools.pairwise(edges))
    kept = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MOST_INTERVALS)).round().astype(int))
    return [pairs[i] for i in kept]


def _inside(low: float, high: float) -> float:
    """Return the middle of an interval with as few digits as lie in it, far from where a detection moves by a tick."""
    middle = math.sqrt(low * high)
    for digits in _SPLIT_DIGITS:
        value = float(f"{middle:.{digits - 1}e}")
        if low < value < high:
            return value
    return high


def _limited_by(as_good: Sequence[int], count: int, settings: ThresholdSettings, lowest_n: float) -> str | None:
    """Say at which end of the range the best intervals lie; at both of them nothing is limited."""
    at_low, at_high = min(as_good) == 0, max(as_good) == count - 1
    if at_low == at_high:
        return None
    if at_high:
        return "upper bound"
    return "free motion" if settings.bounds_n[0] <= lowest_n else "lower bound"


def _with_response(
    name: str, predicted: AxisPrediction, contacts: Sequence[RespondingContact], threshold_n: float
) -> AxisPrediction:
    """Return the prediction with the same contacts under the response, and the worst of all contacts under it."""
    runs = {each.scenario: each.run(threshold_n) for each in contacts}
    return replace(predicted, with_collision_response=predictions(name, predicted, runs))
