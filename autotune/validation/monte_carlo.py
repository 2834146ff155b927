"""The full nonlinear simulation over seeded plants of the certified set, its peaks against the predicted ones."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.units import axis_units
from problems.arrays import FloatArray
from problems.contact.nonlinear_simulation import NonlinearRun, needed_substeps, simulate_nonlinear
from problems.contact.nonlinearities import NO_NONLINEARITIES, Nonlinearities
from problems.design.uncertainty import Scenario
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.plant import Plant
from problems.stability.margins import UnstableLoopError

from .disturbances import Disturbances, axis_effects
from .report import Check

SAMPLES, SEED = 256, 1
QUANTILES = (0.5, 0.95, 0.99)
BAND = (0.05, 0.5, 0.95)
# As of a replayed contact (`peaks`): an impact anywhere between two samples.
SAME_PEAK = 0.02
_PEAKS_LATER, _SHORTEST_S, _LONGEST_S = 4.0, 0.3, 10.0


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
    """The contact force of all runs with disturbances over `time_s` (n,) from the touch on.

    `levels` (5, n): the smallest, the quantiles `BAND`, and the largest at each moment.
    """

    time_s: FloatArray
    levels: FloatArray


@dataclass(frozen=True, kw_only=True)
class AxisMonteCarlo:
    """What came of `count` runs on one axis with `effects`; `unstable` is the first plant whose loop is not stable.

    `refusal` says what the full simulation cannot do; `is_left_out` where that is so of every plant of the set,
    none of which has a delay. `band` is for pictures.
    """

    axis: str
    count: int
    seed: int
    effects: Nonlinearities
    driving_force: float
    contact: SampledPeaks | None = None
    sensor: SampledPeaks | None = None
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
    return domain.environment_mass_kg == 0.0 and (domain.approach_force_n or domain.approach_speed_m_s) is not None


@dataclass(frozen=True, kw_only=True)
class _Contacts:
    """Contacts of one axis, as its certificate says."""

    domain: AxisDomain
    law: AdmittanceController
    sample_time_s: float
    duration_s: float

    def driving(self) -> tuple[float, float]:
        """Return force and speed of the approach of the linear loop, F^d = (B_a + B_p) v."""
        resistance = self.law.damping_n_s_per_m + self.domain.drag_n_s_per_m
        force, speed = self.domain.approach_force_n or 0.0, self.domain.approach_speed_m_s
        return (force, force / resistance) if speed is None else (speed * resistance, speed)

    def run(self, plant: Plant, effects: Nonlinearities, noise: np.random.Generator) -> NonlinearRun:
        """Simulate one contact."""
        return simulate_nonlinear(
            plant,
            self.law,
            self.domain.approach,
            sample_time_s=self.sample_time_s,
            duration_s=self.duration_s,
            effects=effects,
            substeps=needed_substeps(plant, self.sample_time_s),
            noise=noise,
        )


def _axis_monte_carlo(
    controller: Controller,
    name: str,
    count: int,
    seed: int,
    disturbances: Disturbances,
    advance: Callable[[float], None],
) -> AxisMonteCarlo:
    """Run one axis.

    An error of the felt force of b, held all the time, changes every force of the linear contact in the ratio of
    (F^d + b)/F^d, since the unilateral contact scales with what drives it. The deadband and one deviation of the noise
    are such an error at most, and mostly less; so the limit is that of the prediction, plus 2 %, plus b/F^d.
    """
    domain, scenarios = controller.certificate.domain[name], controller.predicted[name].scenarios
    latest = max(scenario.time_of_peak_s for scenario in scenarios)
    contacts = _Contacts(
        domain=domain,
        law=admittance_controller(controller, name),
        sample_time_s=controller.sample_time_s,
        duration_s=min(max(_SHORTEST_S, _PEAKS_LATER * latest), _LONGEST_S),
    )
    force, speed = contacts.driving()
    effects = axis_effects(controller, name, disturbances, speed)
    plants = tuple(_drawn(domain, count, seed))
    result = AxisMonteCarlo(axis=name, count=count, seed=seed, effects=effects, driving_force=force)
    nominal, rows, traces = domain.plants.nominal, list[tuple[float, ...]](), list[FloatArray]()
    for i, scenario in enumerate(plants):
        noise = np.random.default_rng((seed, i))
        try:
            plant = scenario.plant(nominal)
            linear, full = contacts.run(plant, NO_NONLINEARITIES, noise), contacts.run(plant, effects, noise)
        except UnstableLoopError:
            return replace(result, unstable=scenario)
        except ParameterError as error:
            return replace(result, refusal=str(error), is_left_out=_never_delayed(domain))
        rows.append(
            (
                linear.peak_contact_force_n,
                linear.peak_sensor_force_n,
                full.peak_contact_force_n,
                full.peak_sensor_force_n,
            )
        )
        traces.append(full.contact_force_n)
        advance(1.0 / count)
    bias = (effects.deadband.width_n if effects.deadband is not None else 0.0) + effects.force_noise_rms_n
    share = 1.0 + SAME_PEAK + bias / force
    peaks = np.array(rows)
    contact, sensor = (
        SampledPeaks(
            predicted=predicted,
            linear=_peaks(peaks[:, column], plants),
            observed=_peaks(peaks[:, column + 2], plants),
            limit=share * max(predicted, force),
        )
        for column, predicted in (
            (0, max(each.peak_contact_force_n for each in scenarios)),
            (1, max(each.peak_sensor_force_n for each in scenarios)),
        )
    )
    return replace(result, contact=contact, sensor=sensor, band=_band(traces, controller.sample_time_s))


def _never_delayed(domain: AxisDomain) -> bool:
    """Say whether no plant has a delay, and damping in the coupling hands each command on to the force of its tick."""
    delays = (domain.plants.range_of(name)[1] for name in ("delay_s", "wrench_delay_s"))
    least, _ = domain.plants.range_of("coupling_damping_n_s_per_m")
    return sum(delays) == 0.0 and least > 0.0 and domain.plants.nominal.wrench_filter.time_constant_s == 0.0


def _band(traces: Sequence[FloatArray], h: float) -> ForceBand:
    together = np.array(traces)
    levels = np.quantile(together, (0.0, *BAND, 1.0), axis=0)
    return ForceBand(time_s=np.asarray(h * np.arange(together.shape[1]), dtype=np.float64), levels=levels)


def _drawn(domain: AxisDomain, count: int, seed: int) -> Iterator[Scenario]:
    """Yield `count` plants of the set, the same again where it holds fewer."""
    different = domain.plants.samples(count, seed=seed)
    for i in range(count):
        yield different[i % len(different)]


def _peaks(values: FloatArray, plants: Sequence[Scenario]) -> Peaks:
    worst = int(np.argmax(values))
    return Peaks(
        largest=float(values[worst]),
        plant=plants[worst],
        quantiles=tuple(float(value) for value in np.quantile(values, QUANTILES)),
    )


def monte_carlo_checks(found: Sequence[AxisMonteCarlo]) -> tuple[Check, ...]:
    """Return the verdicts: the file's own model on the sampled plants, then the full simulation."""
    return tuple(check for each in found for check in _axis_checks(each))


def _axis_checks(found: AxisMonteCarlo) -> Iterator[Check]:
    if found.unstable is not None:
        message = f"the loop is not stable at {found.unstable.name}"
        yield Check(axis=found.axis, name="sampled peaks", passed=False, message=message)
    elif found.is_left_out:
        message = (
            f"not simulated: {found.refusal.removesuffix('.')}; margins and predicted contacts are verified above, "
            "deadband, noise, limits and late commands are not"
        )
        yield Check(axis=found.axis, name="full simulation", passed=True, message=message, warns=True)
    elif found.contact is None or found.sensor is None:
        yield Check(axis=found.axis, name="full simulation", passed=False, message=f"not possible: {found.refusal}")
    else:
        both = (("contact", found.contact), ("sensor", found.sensor))
        yield _linear_check(found, both)
        yield _full_check(found, both)


def _linear_check(found: AxisMonteCarlo, both: Sequence[tuple[str, SampledPeaks]]) -> Check:
    """Hold the peaks of the file's own model, without disturbances, against the predicted ones."""
    units = axis_units(found.axis)
    above = [
        f"the peak {what} {units.force_name} is {of.linear.largest:.2f} {units.force} at {of.linear.plant.name}, more "
        f"than the largest predicted, {of.predicted:.2f} {units.force}"
        for what, of in both
        if of.linear.largest > of.predicted + SAME_PEAK * max(of.predicted, found.driving_force)
    ]
    text = ", ".join(f"{of.linear.largest:.1f} {units.force} at the {what}" for what, of in both)
    message = "; ".join(above) or f"largest of {found.count} plants {text}, none above the predicted"
    return Check(axis=found.axis, name="sampled peaks", passed=not above, message=message)


def _change(of: SampledPeaks) -> float:
    """Return what the disturbances add, to the digit that is shown; adding nothing makes 0 of -0."""
    return round(of.observed.largest - of.linear.largest, 1) + 0.0


def _full_check(found: AxisMonteCarlo, both: Sequence[tuple[str, SampledPeaks]]) -> Check:
    """Hold the peaks with disturbances against what these explain."""
    units = axis_units(found.axis)
    above = [
        f"the peak {what} {units.force_name} is {of.observed.largest:.2f} {units.force} at {of.observed.plant.name}; "
        f"{of.predicted:.2f} {units.force} is predicted, and {_describe_effects(found)} explain {of.limit:.2f} "
        f"{units.force} at most"
        for what, of in both
        if of.observed.largest > of.limit
    ]
    text = ", ".join(
        f"{of.observed.largest:.1f} {units.force} at the {what} ({_change(of):+.1f}; at most {of.limit:.1f})"
        for what, of in both
    )
    message = "; ".join(above) or f"with {_describe_effects(found)} largest {text}"
    return Check(axis=found.axis, name="full simulation", passed=not above, message=message)


def _describe_effects(found: AxisMonteCarlo) -> str:
    effects, units = found.effects, axis_units(found.axis)
    text = [
        f"{effects.deadband.width_n:g} {units.force} deadband" if effects.deadband is not None else "",
        f"{effects.force_noise_rms_n:.3g} {units.force} noise",
        f"clipping at {effects.force_limit_n:g} {units.force}" if effects.force_limit_n is not None else "",
        f"at most {effects.limits.speed_m_s:g} {units.speed}" if effects.limits is not None else "",
        f"{100.0 * effects.late_share:g} % of the commands late",
        f"the collision response at {effects.collision.threshold_n:g} N" if effects.collision is not None else "",
        "B_a that follows the speed" if effects.variable_damping is not None else "",
    ]
    return ", ".join(part for part in text if part)


def monte_carlo_tree(found: Sequence[AxisMonteCarlo]) -> dict[str, object]:
    """Return the results by axis as plain data."""
    return {each.axis: _axis_tree(each) for each in found}


def _axis_tree(found: AxisMonteCarlo) -> dict[str, object]:
    effects = found.effects
    return {
        "samples": found.count,
        "seed": found.seed,
        "unit": axis_units(found.axis).force,
        "effects": {
            "deadband": effects.deadband.width_n if effects.deadband is not None else 0.0,
            "noise_rms": effects.force_noise_rms_n,
            "sensor_range": effects.force_limit_n,
            "command_speed_limit": None if effects.limits is None else effects.limits.speed_m_s,
            "late_share": effects.late_share,
            "collision_threshold": None if effects.collision is None else effects.collision.threshold_n,
            "damping": None if effects.variable_damping is None else list(effects.variable_damping.bounds_n_s_per_m),
        },
        "unstable": None if found.unstable is None else found.unstable.name,
        "refusal": found.refusal or None,
        **{
            what: {
                "predicted": of.predicted,
                "limit": of.limit,
                **{
                    model: {
                        "largest": peaks.largest,
                        "plant": peaks.plant.name,
                        "quantiles": {
                            f"{share:g}": value for share, value in zip(QUANTILES, peaks.quantiles, strict=True)
                        },
                    }
                    for model, peaks in (("linear", of.linear), ("observed", of.observed))
                },
            }
            for what, of in (("contact", found.contact), ("sensor", found.sensor))
            if of is not None
        },
    }
