"""Predicted beside measured peaks: every touch of a log with its own speed, desired force and gains."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.charts.chart import Chart, Line, Panel, Points, Scale
from autotune.errors import UsageError
from autotune.formats.identified import IdentifiedFile
from autotune.formats.units import axis_units
from autotune.shown import ResultTable, Shown, data_frame, plain_tree
from identification.errors import EstimateError
from identification.result import Estimate, Touch, TouchCause
from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.errors import AutotuneError

from .contact import AnyLaw, TargetLaw
from .law import deadband_text
from .plants import PlantEnsemble, Surface, build_plants
from .result import PredictedContact, interval_notes, interval_text, predict_contact

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from autotune.charts.show import AxesLike

# Beyond both of these the stiffness that a log shows is not the one predicted with.
_STDS_APART, _SHARE_APART = 3.0, 0.3
_PHASES = 50
# A difference between peak and sample that is worth a sentence.
_SHOWN_SHARE = 0.005


@dataclass(frozen=True, kw_only=True)
class ComparedTouch:
    """One touch: what was measured, and what is predicted at its speed, F^d and gains, at the sensor.

    `shares` are the largest sample that a log of the touch's rate would hold over the predicted peak: the least and the
    mean over all instants at which the samples may fall, (1, 1) where the rate is not known or that of the controller.
    """

    touch: Touch
    log: str
    predicted: PredictedContact
    shares: tuple[float, float] = (1.0, 1.0)

    @property
    def largest_sample(self) -> float:
        """The largest sample that is to be expected of the predicted force [N, N·m]."""
        return self.shares[1] * self.predicted.peak_sensor_force

    @property
    def interval(self) -> tuple[float, float | None]:
        """Where that sample lies, with the probability of the predicted interval [N, N·m]."""
        low, high = self.predicted.interval.sensor
        return self.shares[0] * low, high

    @property
    def error_share(self) -> float:
        """(Predicted − measured)/measured, of the largest sample."""
        return self.largest_sample / self.touch.peak_force - 1.0

    @property
    def is_inside(self) -> bool:
        """Whether the largest sample lies inside its predicted interval."""
        low, high = self.interval
        return low <= self.touch.peak_force and (high is None or self.touch.peak_force <= high)


def sampled_shares(time_s: FloatArray, force: FloatArray, period_s: float | None) -> tuple[float, float]:
    """Return the largest of samples `period_s` apart over the largest force (n,): the least and the mean of it.

    The first sample may fall on any instant of a period, each as likely; between the ticks of `time_s` (n,) the force
    is a straight line.
    """
    top = float(np.max(force, initial=0.0))
    if period_s is None or len(time_s) < 2 or top <= 0.0 or period_s <= float(time_s[1] - time_s[0]):
        return 1.0, 1.0
    phases = (np.arange(_PHASES) + 0.5) / _PHASES * period_s
    steps = np.arange(float(time_s[0]), float(time_s[-1]) + period_s, period_s)
    largest = np.max(np.interp(phases[:, None] + steps, time_s, force), axis=1) / top
    return float(np.min(largest)), float(np.mean(largest))


def compared_touch(touch: Touch, log: str, predicted: PredictedContact) -> ComparedTouch:
    """Return a touch of a log beside its prediction, both as the log samples a force."""
    contact = predicted.contact
    # Of a first blow no course is predicted, only its force.
    is_course = predicted.plant is not None and predicted.first_blow < contact.peak_sensor_force_n
    shares = sampled_shares(contact.time_s, contact.sensor_force_n, touch.sample_period_s) if is_course else (1.0, 1.0)
    return ComparedTouch(touch=touch, log=log, predicted=predicted, shares=shares)


def other_surface(contact: ComparedTouch, shown: Estimate | None) -> str:
    """Return a sentence where a log shows another stiffness over robot travel than that predicted with, else ""."""
    plant = contact.predicted.plant
    if plant is None or shown is None or shown.value is None or shown.std is None:
        return ""
    coupling, ground = plant.coupling.stiffness_n_per_m, plant.environment.stiffness_n_per_m
    used = coupling * ground / (coupling + ground)
    if abs(shown.value - used) <= max(_STDS_APART * shown.std, _SHARE_APART * used):
        return ""
    factor, unit = axis_units(contact.touch.axis).shown_stiffness
    return (
        f"{contact.log or 'the log'} itself shows {factor * shown.value:.3g} {unit} over robot travel on axis "
        f"{contact.touch.axis}, predicted is with {factor * used:.3g} {unit}: if it is another surface, name it or its "
        "stiffness with the surface (--surface)"
    )


@dataclass(frozen=True, kw_only=True, repr=False)
class TouchComparison(Shown):
    """All touches of logs beside their prediction; `passed_over` says of the others why, a sentence each.

    `other_surfaces` says in sentences which touches of a log were of another stiffness than that predicted with.
    """

    contacts: tuple[ComparedTouch, ...]
    passed_over: tuple[str, ...] = ()
    other_surfaces: tuple[str, ...] = ()

    def _headline(self) -> str:
        inside = sum(each.is_inside for each in self.contacts)
        errors = [each.error_share for each in self.contacts]
        rms = 100.0 * float(np.sqrt(np.mean(np.square(errors))))
        times = "1 contact" if len(errors) == 1 else f"{len(errors)} contacts"
        return f"{times}: RMS error {rms:.1f} % of the peak, {inside} inside their interval"

    def _tables(self) -> Iterator[ResultTable]:
        for unit in ("N", "N·m"):
            rows = [compared_row(each) for each in self.contacts if axis_units(each.touch.axis).force == unit]
            if rows:
                yield ResultTable(title="measured and predicted peaks", columns=_columns(unit), rows=tuple(rows))

    def _notes(self) -> Sequence[str]:
        notes: list[str] = []
        if any(each.touch.mass is None or each.touch.damping is None for each in self.contacts):
            notes.append(
                "the log does not hold the gains that ran: where they were others than those predicted with, the "
                "differences are what the gains change, and no error of the model"
            )
        notes += self._deadband_notes()
        least = min(each.shares[1] for each in self.contacts)
        if least < 1.0 - _SHOWN_SHARE:
            notes.append(
                "measured is the largest sample, and predicted the largest sample that a log of this rate is to be "
                f"expected to hold: the predicted force itself rises up to {100.0 * (1.0 / least - 1.0):.1f} % higher"
            )
        for each in self.contacts:
            said = each.predicted
            notes += [*said.neglected, *interval_notes(said.interval, said.model_error)]
        return (*self.other_surfaces, *dict.fromkeys(notes), *self.passed_over)

    def _deadband_notes(self) -> Iterator[str]:
        for axis, deadband in {each.touch.axis: each.predicted.deadband for each in self.contacts}.items():
            if deadband is None:
                continue
            if deadband.width_n:
                yield f"simulated on axis {axis} with the {deadband_text(deadband, axis)}"
            else:
                yield (
                    f"simulated on axis {axis} without a deadband, as a log does not hold it: where one ran, say it in "
                    "--gains (deadband=5,deadband_type=threshold) or name its file with --controller"
                )

    def chart(self) -> Chart:
        """Return the picture: measured and predicted peaks with their intervals, contact by contact."""
        number = np.arange(1.0, len(self.contacts) + 1.0)
        names = tuple(f"{each.touch.axis} at {touch_time_s(each.touch):.2f} s" for each in self.contacts)
        measured = np.array([each.touch.peak_force for each in self.contacts])
        predicted = np.array([each.largest_sample for each in self.contacts])
        unit = " or ".join(dict.fromkeys(axis_units(each.touch.axis).force for each in self.contacts))
        bars = []
        for place, each in zip(number, self.contacts, strict=True):
            low, high = each.interval
            label = "interval" if place == 1.0 else ""
            ends = np.array([low, each.touch.peak_force if high is None else high])
            bars.append(Line(x=np.array([place, place]), y=ends, label=label, role="model"))
        return Chart(
            key="contacts",
            title="Predicted and measured peaks",
            alternative=f"Measured and predicted peaks of {len(number)} contacts: {self._headline()}",
            panels=(
                Panel(
                    x=Scale(label="contact", limits=(0.5, len(number) + 0.5), counts=True),
                    y=Scale(label=f"peak at the sensor [{unit}]"),
                    elements=(
                        *bars,
                        Points(x=number, y=predicted, label="predicted", role="model", marker="diamond", names=names),
                        Points(x=number, y=measured, label="measured", names=names),
                    ),
                ),
            ),
        )

    def plot(self, ax: "AxesLike | None" = None) -> "Figure":
        """Draw measured and predicted peaks with their intervals, contact by contact."""
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib

        return show(self.chart(), ax)

    def to_dict(self) -> dict[str, Any]:
        """Return every contact as plain data, without the traces."""
        return {
            "contacts": [
                {
                    "log": each.log,
                    "touch": plain_tree(each.touch),
                    "surface": each.predicted.surface,
                    "law": plain_tree(each.predicted.law),
                    "predicted_peak": each.predicted.peak_sensor_force,
                    "interval": plain_tree(each.predicted.interval),
                    "predicted_sample": each.largest_sample,
                    "sample_interval": list(each.interval),
                    "error_percent": 100.0 * each.error_share,
                    "is_inside": each.is_inside,
                }
                for each in self.contacts
            ],
            "inside": sum(each.is_inside for each in self.contacts),
            "passed_over": list(self.passed_over),
        }

    def to_pandas(self) -> Any:
        """Return measured and predicted samples [N, N·m] as a pandas.DataFrame; raises UsageError without pandas."""
        return data_frame(
            {
                "axis": [each.touch.axis for each in self.contacts],
                "time_s": [touch_time_s(each.touch) for each in self.contacts],
                "measured": [each.touch.peak_force for each in self.contacts],
                "predicted": [each.largest_sample for each in self.contacts],
                "low": [each.interval[0] for each in self.contacts],
                "high": [each.interval[1] for each in self.contacts],
            }
        )


def touch_time_s(touch: Touch) -> float:
    """Return when the touch began, or else when its force was largest [s]."""
    return touch.peak_s if touch.onset_s is None else touch.onset_s


def _columns(unit: str) -> tuple[str, ...]:
    speed, desired = ("mm/s", "F^d") if unit == "N" else ("mrad/s", "T^d")
    return (
        "contact",
        "surface",
        f"speed [{speed}]",
        f"{desired} [{unit}]",
        f"measured [{unit}]",
        f"between samples [{unit}]",
        f"predicted [{unit}]",
        "error [%]",
        f"interval [{unit}]",
        "inside",
    )


def compared_row(each: ComparedTouch) -> tuple[str, ...]:
    """Return a contact as texts, in the order of the table's columns."""
    touch, found = each.touch, each.predicted
    return (
        f"{each.log + ', ' if each.log else ''}{touch.axis} at {touch_time_s(touch):.2f} s",
        found.surface,
        f"{1e3 * found.contact.contact_speed_m_s:.1f}",
        "?" if touch.desired_force is None else f"{touch.desired_force:.1f}",
        f"{touch.peak_force:.1f}",
        "" if touch.peak_interval is None else interval_text(touch.peak_interval),
        f"{each.largest_sample:.1f}",
        f"{100.0 * each.error_share:+.1f}",
        interval_text(each.interval),
        "yes" if each.is_inside else "no",
    )


@dataclass(frozen=True, kw_only=True)
class Running:
    """What was running in the cell while the log was recorded; None where the log says it, touch by touch.

    `mass`, `damping` and `lead_s` are M_a, B_a and K_l, `desired_force` F^d; `law` holds the rest (filters, deadband),
    or is that of an export target, whatever the log says. A lead that nobody says is 0.
    """

    law: AnyLaw
    mass: float | None = None
    damping: float | None = None
    lead_s: float | None = None
    desired_force: float | None = None

    def law_at(self, touch: Touch) -> AnyLaw:
        """Return the law at a touch; raises UsageError where neither the log nor anybody says mass and damping."""
        if isinstance(self.law, TargetLaw):
            return self.law
        mass = touch.mass if self.mass is None else self.mass
        damping = touch.damping if self.damping is None else self.damping
        lead_s = touch.lead_s if self.lead_s is None else self.lead_s
        if mass is None or damping is None:
            raise UsageError(
                "The log does not say with which mass and damping it was recorded; give them (--gains or --controller)."
            )
        return replace(
            self.law,
            controller=replace(
                self.law.controller, mass_kg=mass, damping_n_s_per_m=damping, lead_s=0.0 if lead_s is None else lead_s
            ),
        )

    def approach_at(self, touch: Touch) -> Approach:
        """Return how a touch began: at its measured speed under F^d, or where one of both is not known by the other.

        Raises UsageError where neither is known, where F^d of the log points away from what is touched, and where a
        hand led into it.
        """
        if touch.is_led:
            raise UsageError("a hand led the payload into it, and with which force it pushed on is not known.")
        force = self.desired_force
        if force is None and touch.desired_force is not None:
            force = touch.sign * touch.desired_force
            if force < 0.0:
                units, way = axis_units(touch.axis), "+" if touch.sign > 0 else "-"
                raise UsageError(
                    f"F^d of the log, {touch.desired_force:.4g} {units.force}, points away from what is touched in "
                    f"{way}{touch.axis}: correct its sign (`desired_force` in cell.yaml, then identify the log again), "
                    "or say --approach force=F."
                )
        speed = touch.approach_speed
        if speed is not None and speed > 0.0:
            return Approach(speed_m_s=speed, after_impact_n=force)
        if not force:
            raise UsageError(
                "Neither the speed of the approach nor the desired force is known; say --approach force=F."
            )
        return Approach(force_n=force)


def plants_of_touch(
    source: IdentifiedFile, touch: Touch, *, surface: Surface | None = None, sample_time_s: float | None = None
) -> PlantEnsemble:
    """Return the plants of a touch: against `surface`, or else against the surface of `source` that it names.

    Raises UsageError for an axis or a surface that the source does not hold, EstimateError as `build_plants`.
    """
    asked = Surface() if surface is None else surface
    axis = source.result.axes.get(touch.axis)
    if axis is None:
        raise UsageError(f"the plant holds no axis {touch.axis}.")
    names = {each.name for each in axis.environments}
    if asked == Surface() and len(names) > 1 and touch.surface in names:
        asked = Surface(name=touch.surface or "")
    return build_plants(source, asked, axis=touch.axis, sample_time_s=sample_time_s)


def compare_touches(
    source: IdentifiedFile,
    touches: Sequence[tuple[str, Touch]],
    running: Callable[[str], Running],
    *,
    surface: Surface | None = None,
    sample_time_s: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> TouchComparison:
    """Predict every touch, each with the name of its log, from what `source` says of plant and surface.

    `running` gives what was running on an axis. Touches of a hand or of what is undetermined, on axes or of surfaces
    that the source does not hold, and of loops that are unstable are passed over with the reason. Raises EstimateError
    where none is left.
    """
    known: dict[tuple[str, str | None], PlantEnsemble] = {}

    def plants(touch: Touch) -> PlantEnsemble:
        key = touch.axis, touch.surface
        if key not in known:
            known[key] = plants_of_touch(source, touch, surface=surface, sample_time_s=sample_time_s)
        return known[key]

    found, passed = [], []
    for log, touch in touches:
        where = f"{log + ', ' if log else ''}{touch.axis} at {touch_time_s(touch):.2f} s"
        try:
            if touch.cause is TouchCause.HAND:
                raise UsageError("it was a hand.")
            if touch.cause is TouchCause.UNDETERMINED:
                raise UsageError("what was touched is undetermined.")
            if touch.is_withdrawn:
                raise UsageError("F^d turned away before its peak, so it shows no whole blow.")
            said = running(touch.axis)
            predicted = predict_contact(plants(touch), said.law_at(touch), said.approach_at(touch))
            found.append(compared_touch(touch, log, predicted))
        except AutotuneError as error:
            passed.append(f"{where}: {error}")
        if progress is not None:
            progress(1.0 / len(touches))
    if not found:
        why = _by_reason(passed) if passed else "it holds no touch; record the approach and a second of holding"
        raise EstimateError(f"No contact of the log can be predicted: {why}")
    return TouchComparison(contacts=tuple(found), passed_over=tuple(passed))


def _by_reason(passed: Sequence[str]) -> str:
    """Return the reasons (each `where: why`), each once behind all places that it holds at."""
    places: dict[str, list[str]] = {}
    for where, _, why in (each.partition(": ") for each in passed):
        places.setdefault(why, []).append(where)
    return " ".join(f"{', '.join(where)}: {why}" for why, where in places.items())
