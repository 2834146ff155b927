"""One predicted contact: its trace on the most likely plant, and the interval of its peaks over all of them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autotune.errors import UsageError
from autotune.formats.bumper_record import describe_bumper
from autotune.formats.units import ROTATIONAL_AXES
from problems.arrays import FloatArray
from problems.contact.linear_controller_contact import trace_linear_contact
from problems.contact.nonlinear_simulation import needed_substeps, simulate_nonlinear
from problems.contact.nonlinearities import Deadband, Nonlinearities
from problems.contact.transient import (
    Approach,
    ContactTransient,
    build_sampled_contact,
    longest_run,
    simulate_contact,
)
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.plant import Bumper, Plant
from problems.model.sampled import build_sampled_plant
from problems.stability.margins import UnstableLoopError

from .plants import PlantEnsemble

LEVEL = 0.95
_FACTORS = 15
"""Of the model's error, for every plant."""
NO_DEADBAND = Deadband(width_n=0.0)


@dataclass(frozen=True, kw_only=True)
class Law:
    """An admittance law and the deadband before it."""

    controller: AdmittanceController
    deadband: Deadband = NO_DEADBAND


@dataclass(frozen=True, kw_only=True)
class TargetLaw:
    """The linear law that another program, the export target of that name, runs."""

    controller: LinearController
    target: str


AnyLaw = Law | TargetLaw


@dataclass(frozen=True, kw_only=True)
class PeakInterval:
    """Where a peak lies with the probability `level`, or over all plants of ranges where that is None.

    `sensor` and `contact` are (low, high) [N, N·m]; a high end is None where loops of that many plants are unstable,
    whose peak is no number. `unstable_share` is the share of plants whose loop is.
    """

    level: float | None
    sensor: tuple[float, float | None]
    contact: tuple[float, float | None]
    unstable_share: float = 0.0


@dataclass(frozen=True, kw_only=True)
class ContactBand:
    """The lowest and highest force at the sensor (n,) over `time_s` (n,) with the level of the interval."""

    time_s: FloatArray
    low: FloatArray
    high: FloatArray


def with_bumper(plants: PlantEnsemble, bumper: Bumper | None) -> PlantEnsemble:
    """Return the plants with a payload that touches with a bumper; None leaves them as they are.

    Raises UsageError about a turning axis and where no payload is known, ParameterError for one that is not lighter.
    """
    if bumper is None:
        return plants
    if plants.axis in ROTATIONAL_AXES:
        raise UsageError(f"A bumper is of straight axes, and {plants.axis} turns; leave it out.")
    if plants.nominal is None or not plants.has_payload:
        raise UsageError("A bumper is a part of the payload, which is not known here; leave it out.")
    soft = tuple(replace(each, bumper=bumper) for each in plants.others)
    said = (*plants.neglected, f"the payload touches with {describe_bumper(bumper)}")
    return replace(plants, nominal=replace(plants.nominal, bumper=bumper), others=soft, neglected=said)


def simulate_on(
    plant: Plant, law: AnyLaw, approach: Approach, sample_time_s: float, *, samples: int | None = None
) -> ContactTransient:
    """Simulate a contact: the exact transient, that of any linear law, or with a deadband the nonlinear simulation.

    Without `samples` it lasts until the force has settled.
    Raises UnstableLoopError where the loop is unstable, ParameterError for a plant that cannot be followed.
    """
    pair = build_sampled_contact(build_sampled_plant(plant, sample_time_s))
    if isinstance(law, TargetLaw):
        plant.require_one_piece()
        return trace_linear_contact(pair, law.controller, approach, samples=samples)
    if law.deadband.width_n == 0.0:
        return simulate_contact(pair, law.controller, approach, samples=samples)
    if plant.bumper is not None:
        raise ParameterError("bumper", plant.bumper, "none beside a deadband: say gains without one")
    linear = simulate_on(plant, Law(controller=law.controller), approach, sample_time_s)
    count = min(2 * len(linear.time_s), longest_run(sample_time_s)) if samples is None else samples
    run = simulate_nonlinear(
        plant,
        law.controller,
        approach,
        sample_time_s=sample_time_s,
        duration_s=count * sample_time_s,
        effects=Nonlinearities(deadband=law.deadband),
        substeps=needed_substeps(plant, sample_time_s),
        leaps=True,
    )
    return ContactTransient(
        time_s=run.time_s,
        sensor_force_n=run.sensor_force_n,
        contact_force_n=run.contact_force_n,
        contact_speed_m_s=run.impact_speed_m_s or 0.0,
        driving_force_n=run.driving_force_n if approach.after_impact_n is None else approach.after_impact_n,
        peak_sensor_force_n=run.peak_sensor_force_n,
        time_of_sensor_peak_s=run.time_of_sensor_peak_s,
        peak_contact_force_n=run.peak_contact_force_n,
        time_of_peak_s=run.time_of_peak_s,
        impulse_n_s=0.0,
        is_settled=linear.is_settled,
    )


def nominal_contact(plants: PlantEnsemble, law: AnyLaw, approach: Approach) -> ContactTransient:
    """Simulate the contact on the most likely plant; of a first blow alone its speed and force, and no trace."""
    if plants.nominal is not None:
        return simulate_on(plants.nominal, law, approach, plants.sample_time_s)
    speed = approach.speed_m_s or _free_speed(law, approach.force_n or 0.0)
    blow = plants.blow * speed
    return ContactTransient(
        time_s=np.zeros(1),
        sensor_force_n=np.array([blow]),
        contact_force_n=np.array([blow]),
        contact_speed_m_s=speed,
        driving_force_n=approach.force_n or 0.0,
        peak_sensor_force_n=blow,
        time_of_sensor_peak_s=0.0,
        peak_contact_force_n=blow,
        time_of_peak_s=0.0,
        impulse_n_s=0.0,
        is_settled=False,
    )


def _free_speed(law: AnyLaw, force: float) -> float:
    """Return the speed that a force holds in free space without payload; raises ParameterError for another law."""
    if isinstance(law, TargetLaw):
        raise ParameterError("approach", force, "a speed, where no payload is known")
    return force / law.controller.damping_n_s_per_m


def simulate_others(plants: PlantEnsemble, law: AnyLaw, approach: Approach) -> list[ContactTransient | None]:
    """Return the contact of every other plant, None where its loop is unstable; of a first blow alone none."""
    runs: list[ContactTransient | None] = []
    for plant in plants.others:
        try:
            runs.append(simulate_on(plant, law, approach, plants.sample_time_s))
        except UnstableLoopError:
            runs.append(None)
    return runs


def nominal_peak(plants: PlantEnsemble, law: AnyLaw, approach: Approach) -> float:
    """Return the peak at the sensor on the most likely plant, the first blow included [N, N·m]."""
    contact = nominal_contact(plants, law, approach)
    return with_blow(contact.peak_sensor_force_n, plants.blow, contact)


def peak_interval(
    plants: PlantEnsemble, nominal: ContactTransient, runs: Sequence[ContactTransient | None]
) -> PeakInterval:
    """Return where the peaks lie: over all plants of ranges, or with `LEVEL` over the draws and the model's error."""
    blows = plants.other_blows or (0.0,) * len(runs)
    if plants.nominal is None:
        span_of_blows = _span(plants, nominal.contact_speed_m_s * np.array([plants.blow, *blows]))
        return PeakInterval(level=LEVEL, sensor=span_of_blows, contact=span_of_blows)

    def span(key: str) -> tuple[float, float | None]:
        others = [
            with_blow(getattr(run, key), blow, run) for run, blow in zip(runs, blows, strict=True) if run is not None
        ]
        lost = [math.inf] * (len(runs) - len(others))
        return _span(plants, np.array([*others, *lost, with_blow(getattr(nominal, key), plants.blow, nominal)]))

    return PeakInterval(
        level=None if plants.is_range else LEVEL,
        sensor=span("peak_sensor_force_n"),
        contact=span("peak_contact_force_n"),
        unstable_share=sum(run is None for run in runs) / max(len(runs), 1),
    )


def with_blow(peak: float, blow: float, contact: ContactTransient) -> float:
    """Return the larger of a peak and the first blow, which goes with the speed."""
    return max(peak, blow * contact.contact_speed_m_s)


def _span(plants: PlantEnsemble, peaks: FloatArray) -> tuple[float, float | None]:
    """Return the ends of the interval of peaks (n,), infinite of unstable loops; None for an end that is none."""
    if plants.is_range:
        low, high = float(np.min(peaks)), float(np.max(peaks))
    else:
        error = plants.model_error
        every = peaks if error is None else np.outer(peaks, error.factors(4 * _FACTORS)).ravel()
        tail = 0.5 * (1.0 - LEVEL)
        low = float(np.quantile(every, tail, method="lower"))
        high = float(np.quantile(every, 1.0 - tail, method="higher"))
    return low, high if math.isfinite(high) else None


def contact_band(
    plants: PlantEnsemble, nominal: ContactTransient, runs: Sequence[ContactTransient | None]
) -> ContactBand:
    """Return lowest and highest force at the sensor over the time of the nominal contact, as the interval has them.

    The model's error is one of the blow and the swings: it fades with them, to F^d at rest, which no model changes.
    """
    time = nominal.time_s
    if plants.nominal is None:
        low, high = peak_interval(plants, nominal, runs).sensor
        return ContactBand(time_s=time, low=np.array([low]), high=np.array([low if high is None else high]))
    stable = [np.interp(time, run.time_s, run.sensor_force_n) for run in (nominal, *runs) if run is not None]
    forces = np.array(stable)
    if plants.is_range:
        return ContactBand(time_s=time, low=np.min(forces, axis=0), high=np.max(forces, axis=0))
    error, tail = plants.model_error, 0.5 * (1.0 - LEVEL)
    factors = np.ones(1) if error is None else error.factors(_FACTORS)
    every = (factors[:, None, None] ** _left_of_swing(nominal) * forces[None]).reshape(-1, len(time))
    low, high = np.quantile(every, (tail, 1.0 - tail), axis=0)
    return ContactBand(time_s=time, low=low, high=high)


def _left_of_swing(contact: ContactTransient) -> FloatArray:
    """Return the largest distance from the force at rest from each time on (n,), over that of the peak, 1 at most."""
    force = contact.sensor_force_n
    at_rest = float(force[-1]) if contact.is_settled else contact.driving_force_n
    distance = np.maximum.accumulate(np.abs(force - at_rest)[::-1])[::-1]
    # Before the peak, and in a contact without one above the force at rest, nothing has faded.
    peak = int(np.argmax(force))
    return np.asarray(np.minimum(distance / max(float(distance[peak]), 1e-12), 1.0))


def check_approach(approach: Approach, *, fastest: float = 5.0, strongest: float = 1e4) -> None:
    """Raise ParameterError for a speed or force that no contact experiment has."""
    for name, value, most in (
        ("approach_speed", approach.speed_m_s, fastest),
        ("approach_force", approach.force_n, strongest),
    ):
        if value is not None and not 0.0 < value <= most:
            raise ParameterError(name, value, f"greater than 0 and at most {most:g}")
