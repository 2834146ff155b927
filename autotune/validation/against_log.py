"""Predicted against measured force of every contact in a log that was recorded under the controller of a file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from autotune.errors import UsageError
from autotune.formats.certificate_record import AxisDomain
from autotune.formats.controller_record import Controller, admittance_controller, is_linear
from autotune.formats.units import ROTATIONAL_AXES, axis_units
from autotune.prediction.as_run_by import designed_for
from autotune.prediction.contact import simulate_on
from autotune.prediction.law import law_of
from identification.errors import LogError
from identification.signals.recording import Frames, Recording
from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.design.uncertainty import Scenario

from .log_contacts import ContactLog, LawFit, LogContact, find_log_contacts, follow_law
from .monte_carlo import SAME_PEAK
from .report import Check

_BAND_PLANTS, _SEED = 32, 3
_LAW_BEFORE_S, _LAW_AFTER_S = 0.15, 0.6
# Measured: the right law leaves 0.2 %, a B_a off by a tenth 7 to 9 %.
_FOLLOWS = 0.05
_COMPARED_S = 0.4
_EARLIEST_S, _LATEST_S, _SHIFTS_PER_SAMPLE = 0.02, 0.01, 4
# Of 500 samples of white noise one in 3500 traces leaves the band somewhere.
_NOISE_STDS = 5.0
# Deviation of K_e from one contact alone and of M_p from the log.
_OUTSIDE = 0.1


# Contacts of which a picture is drawn, the strongest; their traces are what is large of a comparison.
MOST_DRAWN = 12


@dataclass(frozen=True, kw_only=True)
class ContactTrace:
    """The pressing force of one contact from the touch on: measured (m,) at `measured_s`, the others (n,) at `time_s`.

    `low` and `high` are the ends of what the certified set allows, noise included.
    """

    measured_s: FloatArray
    measured: FloatArray
    time_s: FloatArray
    predicted: FloatArray
    low: FloatArray
    high: FloatArray


@dataclass(frozen=True, kw_only=True)
class ComparedContact:
    """One contact: what was measured, and what the file's plant predicts at its speed, F^d and K_e.

    `band_peaks_n` are the smallest and the largest peak over the certified set at the same speed and F^d, and
    `share_inside` is the share of the trace between the lowest and the highest of its forces. `outside` says where
    the contact lies outside of what is certified. `trace` is for pictures; of a long log the strongest contacts alone
    have one. What the log shows of no command or of a wrench whose gravity was taken off is the peak alone: then
    `law_left_share`, `share_inside`, `rms_error_n` and `trace` are None.
    """

    axis: str
    onset_s: float
    speed_m_s: float
    desired_force_n: float
    law_left_share: float | None
    stiffness_n_per_m: float | None
    measured_peak_n: float
    predicted_peak_n: float
    band_peaks_n: tuple[float, float]
    share_inside: float | None
    rms_error_n: float | None
    outside: str
    trace: ContactTrace | None = field(compare=False)

    @property
    def is_inside(self) -> bool:
        """Whether the whole trace lies inside the band, or the peak where that is all there is."""
        if self.share_inside is None:
            low, high = self.band_peaks_n
            return low <= self.measured_peak_n <= high
        return self.share_inside == 1.0

    @property
    def peak_error_n(self) -> float:
        """Predicted − measured."""
        return self.predicted_peak_n - self.measured_peak_n


@dataclass(frozen=True, kw_only=True)
class LogComparison:
    """All contacts under this controller; `passed_over` counts those whose command follows another law.

    `notes` are sentences on windows of a long log in which nothing was compared.
    """

    contacts: tuple[ComparedContact, ...]
    passed_over: int
    mass_kg: float
    is_weighed: bool
    notes: tuple[str, ...] = ()

    @property
    def inside_share(self) -> float:
        """The share of traces that lie inside the band from touch to rest."""
        return sum(each.is_inside for each in self.contacts) / len(self.contacts)


def compare_with_log(
    controller: Controller,
    recording: Recording,
    frames: Frames | None = None,
    progress: Callable[[float], None] | None = None,
) -> LogComparison:
    """Compare every contact of a log; `progress` takes shares of the work.

    Raises LogError for a log without a contact along an axis of the file, or whose command no contact explains by this
    law; EstimateError for a log without raw wrench or pose; UsageError for a file with a collision response or
    variable damping.
    """
    refuse_other_law(controller)
    found = find_log_contacts(recording, controller, frames)
    if not found.contacts:
        raise LogError(
            f"The log must hold contacts along {', '.join(controller.axes)} from free motion into a rest, found none; "
            "record the approach, the touch and a second of holding, of an axis that turns three "
            "times or more. (Or coupling and drag of this cell are so far "
            "from the file's that its touches do not show.)"
        )
    followed = [_followed(controller, contact, found.period_s) for contact in found.contacts]
    pairs = [pair for pair in zip(found.contacts, followed, strict=True) if pair[1].left_share <= _FOLLOWS]
    if not pairs:
        raise LogError(_refusal(followed))
    compared = []
    for contact, law in pairs:
        compared.append(_compared(controller, found, contact, law))
        if progress is not None:
            progress(1.0 / len(pairs))
    return LogComparison(
        contacts=tuple(compared),
        passed_over=len(followed) - len(pairs),
        mass_kg=found.mass_kg,
        is_weighed=found.is_weighed,
    )


def refuse_other_law(controller: Controller) -> None:
    """Raise UsageError for a file whose law is not that of the log's commands: another target's, or with a response."""
    target = designed_for(controller)
    if target:
        raise UsageError(
            f"The file was designed for {target}, whose law moved the robot, and the comparison with a log follows our "
            "own law's commands. Hold its peaks against the log: autotune predict identified.yaml --controller FILE "
            "--log LOG."
        )
    if not is_linear(controller):
        raise UsageError(
            "The comparison with a log knows neither collision response nor variable damping, and the file has one: "
            "the command follows other equations there. Record the contacts under the same gains without it."
        )


def _refusal(followed: Sequence[LawFit]) -> str:
    best = min(each.left_share for each in followed)
    return (
        "The log was recorded with another controller: the law of the file must explain the command by the measured "
        f"force to {100.0 * _FOLLOWS:g} %, found {100.0 * best:.3g} % left in the best of {len(followed)} contacts. "
        "Give the file that was running, or record again with this one."
    )


def _followed(controller: Controller, contact: LogContact, period_s: float) -> LawFit:
    """Replay the law around the touch, on the controller's own clock."""
    h = controller.sample_time_s
    start = max((contact.onset * period_s) - _LAW_BEFORE_S, 0.0)
    stop = min(contact.onset * period_s + _LAW_AFTER_S, (contact.times.hold.stop - 1) * period_s)
    time = np.arange(start, stop, h)
    clock = np.arange(len(contact.force_n)) * period_s
    command, position, force = (
        contact.sign * np.interp(time, clock, values)
        for values in (contact.command_m, contact.position_m, contact.force_n)
    )
    if not np.all(np.isfinite([command, position, force])):
        return LawFit(desired_force=np.nan, left_share=np.inf)
    law = admittance_controller(controller, contact.axis)
    return follow_law(law, controller.axes[contact.axis], h, command, position, force)


def _compared(controller: Controller, log: ContactLog, contact: LogContact, followed: LawFit) -> ComparedContact:
    domain = controller.certificate.domain[contact.axis]
    simulate = _Simulator(controller, contact, followed)
    stiffness = contact.stiffness_n_per_m
    at = {} if stiffness is None else {"environment_stiffness_n_per_m": stiffness}
    # What turns is an inertia, of which the log's weight says nothing.
    mass = float(np.mean(domain.payload_mass_kg)) if contact.axis in ROTATIONAL_AXES else log.mass_kg
    predicted = simulate.trace(_middle(domain, mass, **at))
    band = np.array([simulate.trace(each) for each in _plants(domain)])
    time, measured = _shifted(contact, log.period_s, predicted, simulate.h)
    noise = _NOISE_STDS * contact.noise_rms_n
    # The touch falls anywhere between two ticks.
    low, high = _spread(np.min(band, axis=0), np.minimum) - noise, _spread(np.max(band, axis=0), np.maximum) + noise
    inside = (measured >= np.interp(time, simulate.time, low)) & (measured <= np.interp(time, simulate.time, high))
    peaks = np.max(band, axis=1)
    return ComparedContact(
        axis=contact.axis,
        onset_s=contact.onset * log.period_s,
        speed_m_s=contact.speed_m_s,
        desired_force_n=followed.desired_force,
        law_left_share=followed.left_share,
        stiffness_n_per_m=stiffness,
        measured_peak_n=float(np.max(measured)),
        predicted_peak_n=float(np.max(predicted)),
        band_peaks_n=(float(np.min(peaks)), float(np.max(peaks))),
        share_inside=float(np.mean(inside)),
        rms_error_n=float(np.sqrt(np.mean((np.interp(time, simulate.time, predicted) - measured) ** 2))),
        outside=_outside(domain, contact.axis, stiffness, log),
        trace=ContactTrace(
            measured_s=time,
            measured=measured,
            time_s=np.asarray(simulate.time, dtype=np.float64),
            predicted=predicted,
            low=low,
            high=high,
        ),
    )


class _Simulator:
    """The simulation of one contact of the log, with the deadband of the file and without noise."""

    def __init__(self, controller: Controller, contact: LogContact, followed: LawFit) -> None:
        self.h = controller.sample_time_s
        self.law = law_of(controller, contact.axis)
        self.nominal = controller.certificate.domain[contact.axis].plants.nominal
        self.approach = Approach(speed_m_s=contact.speed_m_s, after_impact_n=followed.desired_force)
        self.time = np.arange(round((_COMPARED_S + _EARLIEST_S) / self.h)) * self.h

    def trace(self, scenario: Scenario) -> FloatArray:
        """Return the pressing force at the sensor (n,), from the touch on."""
        plant = scenario.plant(self.nominal)
        return simulate_on(plant, self.law, self.approach, self.h, samples=len(self.time)).sensor_force_n


def _shifted(contact: LogContact, period_s: float, predicted: FloatArray, h: float) -> tuple[FloatArray, FloatArray]:
    """Return time after the touch and the pressing force, the touch being where the prediction fits best.

    The time line finds the touch by a threshold, up to some milliseconds late.
    """
    last = min(contact.onset + round(_COMPARED_S / period_s), contact.times.span.stop, len(contact.force_n))
    samples = np.arange(contact.onset, last)
    clock, pressing = (samples - contact.onset) * period_s, -contact.sign * contact.force_n[samples]
    ticks = np.arange(len(predicted)) * h
    shifts = np.arange(-_LATEST_S, _EARLIEST_S, period_s / _SHIFTS_PER_SAMPLE)
    errors = [float(np.mean((np.interp(clock + shift, ticks, predicted) - pressing) ** 2)) for shift in shifts]
    shift = float(shifts[int(np.argmin(errors))])
    kept = clock + shift >= 0.0
    return np.asarray(clock[kept] + shift), np.asarray(pressing[kept])


def _plants(domain: AxisDomain) -> tuple[Scenario, ...]:
    whole = domain.plants
    return tuple(dict.fromkeys((*whole.corners(), *whole.samples(_BAND_PLANTS, seed=_SEED))))


def _middle(domain: AxisDomain, mass_kg: float, **at: float) -> Scenario:
    """Return the nominal plant with this payload, and the K_e of the contact or the middle of the certified."""
    low, high = domain.environment_stiffness_n_per_m
    scenario = Scenario(environment_stiffness_n_per_m=float(np.sqrt(low * high)), payload_mass_kg=mass_kg)
    return replace(scenario, **at)


def _spread(values: FloatArray, choose: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
    """Return the extreme of each value and its neighbours."""
    padded = np.pad(values, 1, mode="edge")
    return choose(choose(padded[:-2], padded[2:]), values)


def _outside(domain: AxisDomain, axis: str, stiffness: float | None, log: ContactLog) -> str:
    is_weighed = log.is_weighed and axis not in ROTATIONAL_AXES
    text = [
        f"{what} {value:.4g} {unit} outside of {low:g} to {high:g}"
        for what, value, unit, (low, high) in (
            ("K_e", stiffness, axis_units(axis).stiffness, domain.environment_stiffness_n_per_m),
            ("M_p", log.mass_kg if is_weighed else None, "kg", domain.payload_mass_kg),
        )
        if value is not None and not low * (1.0 - _OUTSIDE) <= value <= high * (1.0 + _OUTSIDE)
    ]
    return ", ".join(text)


def share_text(contact: ComparedContact) -> str:
    """Return the share of the trace inside the band, or whether the peak is where there is no trace."""
    if contact.share_inside is None:
        return "yes" if contact.is_inside else "no"
    return f"{100.0 * contact.share_inside:.1f}"


def log_checks(found: LogComparison) -> tuple[Check, ...]:
    """Return a verdict per contact: its peak is not above the largest of the certified set, and it lies inside it."""
    checks = []
    for each in found.contacts:
        limit = each.band_peaks_n[1] * (1.0 + SAME_PEAK)
        share, unit = 100.0 * each.peak_error_n / each.measured_peak_n, axis_units(each.axis).force
        digits, (low, high) = 2 if each.axis in ROTATIONAL_AXES else 1, each.band_peaks_n
        text = (
            f"measured {each.measured_peak_n:.{digits}f} {unit}, predicted {each.predicted_peak_n:.{digits}f} {unit} "
            f"({each.peak_error_n:+.{digits}f} {unit}, {share:+.1f} %), {low:.{digits}f} to {high:.{digits}f} {unit} "
            "over the certified set"
        )
        wrong = each.outside or ("above the certified set" if each.measured_peak_n > limit else "")
        checks.append(
            Check(
                axis=each.axis,
                name=f"contact at {each.onset_s:.2f} s",
                passed=not wrong,
                message=f"{text}; {wrong}" if wrong else text,
            )
        )
    return tuple(checks)
