"""The full nonlinear simulation over seeded plants of the certified set, its peaks against the predicted ones."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, ScenarioPrediction, admittance_controller
from problems.arrays import FloatArray
from problems.contact.many_contacts import (
    FULL_CONTACT,
    FULL_SENSOR,
    LINEAR_CONTACT,
    LINEAR_SENSOR,
    PEAKS,
    ManyContacts,
)
from problems.contact.nonlinearities import Nonlinearities
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.stability.polynomials import STABLE

from .disturbances import Disturbances, axis_effects
from .sampled_contacts import CHUNK, SampledContacts, largest_share

SAMPLES, SEED = 256, 1
QUANTILES = (0.5, 0.95, 0.99)
BAND = (0.05, 0.5, 0.95)
# As of a replayed contact (`peaks`): an impact anywhere between two samples.
SAME_PEAK = 0.02
WORST = 10
_PEAKS_LATER, _SHORTEST_S, _LONGEST_S = 4.0, 0.3, 10.0
# A duration this close to a whole number of samples is that number.
_WHOLE = 1e-9
_BINS = 60


@dataclass(frozen=True, kw_only=True)
class Peaks:
    """Peaks over all runs: the largest, of which plant, and the quantiles `QUANTILES`."""

    largest: float
    plant: Scenario
    quantiles: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class SampledPeaks:
    """One force of one axis: `predicted` is the file's worst, `linear` what its own model makes of the sampled plants.

    `observed` is that of the full simulation; `limit` is its largest (`axis_monte_carlo`). N, about a turning axis N·m,
    pressing positive.
    """

    predicted: float
    linear: Peaks
    observed: Peaks
    limit: float


@dataclass(frozen=True, kw_only=True)
class ForceBand:
    """The contact force of the first `count` runs with disturbances over `time_s` (n,) from the touch on.

    `levels` (5, n): the smallest, the quantiles `BAND`, and the largest at each moment.
    """

    count: int
    time_s: FloatArray
    levels: FloatArray


@dataclass(frozen=True, kw_only=True)
class WorstPlant:
    """One of the plants with the largest contact forces: its place among those drawn, and what it is.

    `contact` and `sensor` are its peaks with the disturbances, `repeated` that of the contact in a run of its own, in
    steps of Runge–Kutta alone (N, about a turning axis N·m).
    """

    index: int
    plant: Scenario
    contact: float
    sensor: float
    repeated: float


@dataclass(frozen=True, kw_only=True)
class PeakDistribution:
    """How many plants had their largest contact force with the disturbances between `edges` (n + 1)."""

    edges: tuple[float, ...]
    counts: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class AxisMonteCarlo:
    """What came of `count` runs on one axis with `effects`; `unstable` is the first plant whose loop is not stable.

    Of these `violating` plants broke a limit or were not stable, and with the confidence `CONFIDENCE` no more than
    `largest_share` of all plants drawn alike do. `refusal` says what the full simulation cannot do; `is_left_out` where
    that is so of every plant of the set, none of which has a delay. `band` is for pictures.
    """

    axis: str
    count: int
    seed: int
    effects: Nonlinearities
    driving_force: float
    contact: SampledPeaks | None = None
    sensor: SampledPeaks | None = None
    violating: int = 0
    largest_share: float = 1.0
    worst: tuple[WorstPlant, ...] = ()
    distribution: PeakDistribution | None = None
    unstable: Scenario | None = None
    refusal: str = ""
    is_left_out: bool = False
    band: ForceBand | None = field(default=None, compare=False)


def run_monte_carlo(
    controller: Controller,
    *,
    count: int = SAMPLES,
    seed: int = SEED,
    disturbances: Disturbances | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[AxisMonteCarlo, ...]:
    """Simulate contacts with `count` plants of every axis' certified set; `progress` takes shares of the work.

    Axes whose certificate names no approach or no contact, or what cannot be simulated, are left out: other checks
    refuse them. Raises ParameterError for a count below 1, and for what the caller says of the cell and cannot be.
    """
    if count < 1:
        raise ParameterError("samples", count, "at least 1")
    found = []
    for name in controller.axes:

        def advance(share: float) -> None:
            if progress is not None:
                progress(share / len(controller.axes))

        if _is_simulated(controller, name):
            found.append(_axis_monte_carlo(controller, name, count, seed, disturbances or Disturbances(), advance))
    return tuple(found)


def _is_simulated(controller: Controller, name: str) -> bool:
    domain, predicted = controller.certificate.domain.get(name), controller.predicted.get(name)
    if domain is None or predicted is None or not predicted.scenarios:
        return False
    return (domain.approach_force_n or domain.approach_speed_m_s) is not None


def _driving(domain: AxisDomain, law: AdmittanceController) -> tuple[float, float]:
    """Return force and speed of the approach of the linear loop, F^d = (B_a + B_p) v."""
    resistance = law.damping_n_s_per_m + domain.drag_n_s_per_m
    force, speed = domain.approach_force_n or 0.0, domain.approach_speed_m_s
    return (force, force / resistance) if speed is None else (speed * resistance, speed)


def build_contacts(
    controller: Controller, name: str, seed: int, disturbances: Disturbances | None = None
) -> SampledContacts:
    """Return the contacts of one axis with plants drawn by a seed, as long as four times its latest predicted peak."""
    domain, h, law = (
        controller.certificate.domain[name],
        controller.sample_time_s,
        admittance_controller(controller, name),
    )
    latest = max(scenario.time_of_peak_s for scenario in controller.predicted[name].scenarios)
    _, speed = _driving(domain, law)
    return SampledContacts(
        domain=domain,
        law=law,
        sample_time_s=h,
        ticks=math.ceil(min(max(_SHORTEST_S, _PEAKS_LATER * latest), _LONGEST_S) / h - _WHOLE),
        effects=axis_effects(controller, name, disturbances or Disturbances(), speed),
        seed=seed,
    )


def _axis_monte_carlo(
    controller: Controller,
    name: str,
    count: int,
    seed: int,
    disturbances: Disturbances,
    advance: Callable[[float], None],
) -> AxisMonteCarlo:
    """Run one axis."""
    domain, scenarios = controller.certificate.domain[name], controller.predicted[name].scenarios
    contacts = build_contacts(controller, name, seed, disturbances)
    force, _ = _driving(domain, contacts.law)
    result = AxisMonteCarlo(axis=name, count=count, seed=seed, effects=contacts.effects, driving_force=force)
    try:
        found = contacts.simulate(count, advance, traced=CHUNK)
    except ParameterError as error:
        return replace(result, refusal=str(error), is_left_out=_never_delayed(domain))
    unstable = np.flatnonzero(found.verdicts != STABLE)
    limits = _limits(contacts.effects, force, scenarios)
    bad = (found.verdicts != STABLE) | np.any(found.peaks_n > limits, axis=1)
    result = replace(result, violating=int(np.sum(bad)), largest_share=largest_share(bad))
    if len(unstable):
        return replace(result, unstable=contacts.scenario(int(unstable[0])))
    counts, edges = np.histogram(found.peaks_n[:, FULL_CONTACT], bins=_BINS)
    return replace(
        result,
        contact=_sampled_peaks(contacts, found, LINEAR_CONTACT, limits, scenarios),
        sensor=_sampled_peaks(contacts, found, LINEAR_SENSOR, limits, scenarios),
        worst=tuple(_worst(contacts, found)),
        distribution=PeakDistribution(edges=tuple(edges.tolist()), counts=tuple(counts.tolist())),
        band=_band(found.traces_n, contacts.sample_time_s),
    )


def _largest_predicted(scenarios: Sequence[ScenarioPrediction]) -> tuple[float, float]:
    """Return the largest contact and sensor force that the file predicts."""
    contact = max(each.peak_contact_force_n for each in scenarios)
    return contact, max(each.peak_sensor_force_n for each in scenarios)


def _limits(effects: Nonlinearities, force: float, scenarios: Sequence[ScenarioPrediction]) -> FloatArray:
    """Return what no peak may exceed, in the order of the peaks of `many_contacts`.

    Without disturbances that is what is predicted, plus 2 %. An error of the felt force of b, held all the time,
    changes every force of the linear contact in the ratio of (F^d + b)/F^d, since the unilateral contact scales with
    what drives it. The deadband and one deviation of the noise are such an error at most, and mostly less; so the limit
    with them is that of the prediction, plus 2 %, plus b/F^d.
    """
    bias = (effects.deadband.width_n if effects.deadband is not None else 0.0) + effects.force_noise_rms_n
    limits = np.empty(PEAKS)
    columns = (LINEAR_CONTACT, FULL_CONTACT), (LINEAR_SENSOR, FULL_SENSOR)
    for predicted, (linear, full) in zip(_largest_predicted(scenarios), columns, strict=True):
        limits[linear] = predicted + SAME_PEAK * max(predicted, force)
        limits[full] = (1.0 + SAME_PEAK + bias / force) * max(predicted, force)
    return limits


def _sampled_peaks(
    contacts: SampledContacts,
    found: ManyContacts,
    column: int,
    limits: FloatArray,
    scenarios: Sequence[ScenarioPrediction],
) -> SampledPeaks:
    """Return what came of one force, `column` that without disturbances."""
    full = FULL_CONTACT if column == LINEAR_CONTACT else FULL_SENSOR
    return SampledPeaks(
        predicted=_largest_predicted(scenarios)[column],
        linear=_peaks(contacts, found.peaks_n[:, column]),
        observed=_peaks(contacts, found.peaks_n[:, full]),
        limit=float(limits[full]),
    )


def _worst(contacts: SampledContacts, found: ManyContacts) -> Iterator[WorstPlant]:
    """Yield the plants with the largest contact forces, each simulated once more on its own."""
    for index in contacts.worst(found, WORST).tolist():
        draws, place = contacts.draw(index // CHUNK), index % CHUNK
        yield WorstPlant(
            index=index,
            plant=draws.scenario(place),
            contact=float(found.peaks_n[index, FULL_CONTACT]),
            sensor=float(found.peaks_n[index, FULL_SENSOR]),
            repeated=contacts.run(draws, place).peak_contact_force_n,
        )


def _never_delayed(domain: AxisDomain) -> bool:
    """Say whether no plant has a delay, and damping in the coupling hands each command on to the force of its tick."""
    delays = (domain.plants.range_of(name)[1] for name in ("delay_s", "wrench_delay_s"))
    least, _ = domain.plants.range_of("coupling_damping_n_s_per_m")
    return sum(delays) == 0.0 and least > 0.0 and domain.plants.nominal.wrench_filter.time_constant_s == 0.0


def _band(traces: FloatArray, h: float) -> ForceBand:
    levels = np.quantile(traces, (0.0, *BAND, 1.0), axis=0)
    time = np.asarray(h * np.arange(traces.shape[1]), dtype=np.float64)
    return ForceBand(count=len(traces), time_s=time, levels=levels)


def _peaks(contacts: SampledContacts, values: FloatArray) -> Peaks:
    worst = int(np.argmax(values))
    return Peaks(
        largest=float(values[worst]),
        plant=contacts.scenario(worst),
        quantiles=tuple(float(value) for value in np.quantile(values, QUANTILES)),
    )
