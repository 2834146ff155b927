"""What a prediction is: one contact with its interval, and how it shows itself."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.charts.chart import Band, Chart, Line, Panel, Points, Scale
from autotune.formats.units import axis_units
from autotune.shown import ResultTable, Shown, data_frame, plain_tree
from autotune.text import stiffness_text
from problems.contact.nonlinearities import Deadband
from problems.contact.transient import Approach, ContactTransient
from problems.model.axis_kind import AxisKind
from problems.model.controller import AdmittanceController
from problems.model.linear_controllers import LinearController
from problems.model.plant import Plant
from problems.text import significant

from .contact import (
    AnyLaw,
    ContactBand,
    PeakInterval,
    TargetLaw,
    contact_band,
    nominal_contact,
    peak_interval,
    simulate_others,
)
from .model_error import ELSEWHERE_TEXT, ModelError
from .plants import PlantEnsemble

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from autotune.charts.show import AxesLike

_UNSAID = ", so the file does not speak of this contact"


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class PredictedContact(Shown):
    """One contact as the model predicts it.

    Attributes
    ----------
    axis, surface
        Name of the axis, and what is touched.
    law
        The gains that were running, or the law of the export target `run_by`.
    plant
        The most likely plant, in contact; without payload where that is not known (`neglected`), None where the first
        blow alone is.
    contact
        Forces at the controller's ticks from the impact on, and their peaks, on that plant.
    interval
        Where the peaks lie, and with which probability.
    band
        The same for the force at the sensor over time.
    neglected
        What is not known of the plant and left out, a sentence each.
    model_error
        What the interval holds beyond the deviations of the parameters; None where no log is behind the plant.
    blow
        Force of the first blow over the speed [N·s/m, N·m·s/rad], 0 where it is in the plant or not known.
    certified
        Whether the contact lies in the domain of a controller file and its peak is no higher than `certified_peak`.
    certified_peak
        The largest peak that the file predicts over its domain, computed on a grid and no proved bound [N, N·m]; None
        outside of the domain, or without such a file.
    outside
        What of plant, approach and payload the certificate of the controller does not hold for, one text each.
    run_by
        The export target whose law it is, "" for our own.
    deadband
        The deadband that was simulated before our own law; None for that of an export target.
    law_notes
        Which law was simulated and where it is from, and what of a controller file was not, a sentence each.

    """

    axis: str
    surface: str
    law: AdmittanceController | LinearController
    plant: Plant | None
    contact: ContactTransient
    interval: PeakInterval
    band: ContactBand = field(compare=False)
    has_payload: bool = True
    neglected: tuple[str, ...] = ()
    model_error: ModelError | None = None
    blow: float = 0.0
    certified: bool = False
    certified_peak: float | None = None
    outside: tuple[str, ...] = ()
    run_by: str = ""
    deadband: Deadband | None = None
    law_notes: tuple[str, ...] = ()

    @property
    def first_blow(self) -> float:
        """Force of the first blow where the plant holds no payload and a log showed it, else 0 [N, N·m]."""
        return self.blow * self.contact.contact_speed_m_s

    @property
    def peak_force(self) -> float:
        """Largest force at the surface, between the ticks too [N, N·m]."""
        return max(self.contact.peak_contact_force_n, self.first_blow)

    @property
    def peak_sensor_force(self) -> float:
        """Largest force at the sensor at the ticks [N, N·m]."""
        return max(self.contact.peak_sensor_force_n, self.first_blow)

    @property
    def time_of_peak(self) -> float | None:
        """When the force at the surface is largest [s after touching]; None where it rises until the run ends."""
        if self.first_blow > self.contact.peak_contact_force_n:
            return 0.0
        return None if self._still_rises(self.contact.time_of_peak_s) else self.contact.time_of_peak_s

    def _still_rises(self, time_of_peak_s: float) -> bool:
        """Whether a force that is largest at this time still rises where the run was ended by its longest time."""
        time = self.contact.time_s
        return not self.contact.is_settled and len(time) > 1 and time_of_peak_s >= float(time[-2])

    def _headline(self) -> str:
        units, whose = axis_units(self.axis), f" as {self.run_by} runs it" if self.run_by else ""
        if self.plant is None:
            return (
                f"Predicted contact on axis {self.axis}{whose}: first blow of {self.peak_force:.4g} {units.force} at "
                f"{self.contact.contact_speed_m_s:.3g} {units.speed} on surface {self.surface}"
            )
        stiffness = self.plant.environment.stiffness_n_per_m * (1.0 if self.has_payload else 0.5)
        mass = f"a payload of {self.plant.payload.mass_kg:.4g} {units.mass}" if self.has_payload else "no payload"
        when = self.time_of_peak
        if when is None:
            end = f"{self.contact.contact_force_n[-1]:.3g} {units.force} {self.contact.time_s[-1]:.3g} s"
            peak = f"still rises to {self.peak_force:.4g} {units.force} at the surface when the run ends, {end}"
        else:
            peak = f"peak {self.peak_force:.4g} {units.force} at the surface, {1e3 * when:.3g} ms"
        return (
            f"Predicted contact on axis {self.axis}{whose}: {peak} after touching "
            f"{stiffness_text(stiffness, units)} at {self.contact.contact_speed_m_s:.3g} {units.speed} with {mass}"
        )

    def __repr__(self) -> str:
        if self.outside:
            return f"<{self._headline()}; {self._outside_note()}>"
        if self.certified_peak is None or self.certified:
            return super().__repr__()
        above = f"{self.certified_peak:.4g} {axis_units(self.axis).force} that the controller file predicts at most"
        return f"<{self._headline()}; above the {above}{_UNSAID}>"

    def _outside_note(self) -> str:
        return f"outside of what the certificate holds: {'; '.join(self.outside)}"

    def _tables(self) -> Iterator[ResultTable]:
        unit, contact = axis_units(self.axis).force, self.contact
        of = "over all plants" if self.interval.level is None else f"{100.0 * self.interval.level:g} % interval"
        rows = (
            ("sensor", self.peak_sensor_force, self.interval.sensor, contact.time_of_sensor_peak_s),
            ("surface", self.peak_force, self.interval.contact, contact.time_of_peak_s),
        )
        yield ResultTable(
            title="peaks",
            columns=("at the", f"peak [{unit}]", f"{of} [{unit}]", "after [ms]"),
            rows=tuple(
                (
                    name,
                    f"{peak:.1f}",
                    interval_text(span),
                    self._when(peak, time),
                )
                for name, peak, span, time in rows
            ),
        )

    def _when(self, peak: float, time_s: float) -> str:
        if peak == self.first_blow:
            return "0 (first blow)"
        return "still rises" if self._still_rises(time_s) else f"{1e3 * time_s:.1f}"

    def _notes(self) -> Sequence[str]:
        return (
            *self._certificate_notes(),
            *self.law_notes,
            *self.neglected,
            *interval_notes(self.interval, self.model_error),
        )

    def _certificate_notes(self) -> Iterator[str]:
        if self.outside:
            yield self._outside_note()
        if self.certified_peak is not None:
            yield (
                f"largest peak that the controller file predicts over its domain"
                f"{f' as {self.run_by} runs it' if self.run_by else ''}: {self.certified_peak:.4g} "
                f"{axis_units(self.axis).force}, computed on a grid and no proved bound"
            )
            if not self.certified:
                yield f"this peak is above that{_UNSAID}"

    def to_dict(self) -> dict[str, Any]:
        """Return plant, series, peaks and interval as plain data, with the names and units of the fields."""
        return {
            "axis": self.axis,
            "surface": self.surface,
            "certified": self.certified,
            "certified_peak": self.certified_peak,
            "outside": list(self.outside),
            "law": plain_tree(self.law),
            "run_by": self.run_by or None,
            "deadband": plain_tree(self.deadband),
            "law_notes": list(self.law_notes),
            "plant": None if self.plant is None else {**_plant_tree(self.plant), "has_payload": self.has_payload},
            "contact": plain_tree(self.contact),
            "peak_force": self.peak_force,
            "peak_sensor_force": self.peak_sensor_force,
            "first_blow": self.first_blow,
            "interval": plain_tree(self.interval),
            "band": plain_tree(self.band),
            "model_error": plain_tree(self.model_error),
            "neglected": list(self.neglected),
        }

    def to_pandas(self) -> Any:
        """Return the forces [N, N·m] over the time after touching [s] as a pandas.DataFrame."""
        series = {
            "contact_force": self.contact.contact_force_n,
            "sensor_force": self.contact.sensor_force_n,
            "sensor_force_low": self.band.low,
            "sensor_force_high": self.band.high,
        }
        return data_frame(series, self.contact.time_s, "time [s]")

    def chart(self) -> Chart:
        """Return the picture: the force at the surface and at the sensor over time, and the band."""
        return contact_chart(self.contact, axis_units(self.axis), "Predicted contact", self.band)

    def plot(self, ax: "AxesLike | None" = None) -> "Figure":
        """Draw the force at the surface and at the sensor over time, and the band in which it lies."""
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib

        return show(self.chart(), ax)


def _plant_tree(plant: Plant) -> dict[str, Any]:
    robot = {name: plain_tree(getattr(plant.robot, name)) for name in ("numerator", "denominator", "delay_s")}
    parts = ("coupling", "payload", "environment", "wrench_filter")
    return {"robot": robot, **{name: plain_tree(getattr(plant, name)) for name in parts}}


def interval_text(span: tuple[float, float | None]) -> str:
    """Return an interval of forces for a table."""
    low, high = span
    return f"{low:.1f} to {high:.1f}" if high is not None else f"{low:.1f} and more"


def interval_notes(interval: PeakInterval, error: ModelError | None) -> Iterator[str]:
    """Yield what the interval holds, and where it has no upper end."""
    if interval.level is None:
        of_ranges = "the corners of the ranges and plants drawn from within"
        if interval.unstable_share > 0.0:
            share = f"{significant(100.0 * interval.unstable_share)} %"
            yield (
                f"on {share} of {of_ranges} the loop is unstable, so that the interval has no upper end; it holds the "
                "others, and nothing of the model's own error"
            )
        else:
            yield f"the interval holds {of_ranges}, and nothing of the model's own error"
        return
    if interval.unstable_share > 0.0:
        yield (
            f"on {significant(100.0 * interval.unstable_share)} % of the plants inside the uncertainty the loop is "
            "unstable, and its peak is no number"
        )
    level = f"{100.0 * interval.level:g} % interval"
    if error is None:
        yield f"the {level} holds the deviations of the parameters, and nothing of the model's own error"
        return
    seen = ", ".join(
        text
        for count, text in (
            (error.logs, f"{error.logs} contacts of logs that took no part"),
            (error.contacts, f"{error.contacts} contacts that took no part"),
        )
        if count
    )
    yield (
        f"the {level} holds the joint deviations of the parameters and a model error of {100.0 * error.share:.1f} % "
        f"({f'from {seen} and ' if seen else 'from '}the {ELSEWHERE_TEXT})"
    )


def predict_contact(plants: PlantEnsemble, law: AnyLaw, approach: Approach) -> PredictedContact:
    """Predict one contact: its trace on the most likely plant, the interval over the others.

    Raises UnstableLoopError where the loop on the most likely plant is unstable.
    """
    contact = nominal_contact(plants, law, approach)
    runs = simulate_others(plants, law, approach)
    return PredictedContact(
        axis=plants.axis,
        surface=plants.surface,
        law=law.controller,
        run_by=law.target if isinstance(law, TargetLaw) else "",
        deadband=None if isinstance(law, TargetLaw) else law.deadband,
        plant=plants.nominal,
        contact=contact,
        interval=peak_interval(plants, contact, runs),
        band=contact_band(plants, contact, runs),
        has_payload=plants.has_payload,
        blow=plants.blow,
        neglected=plants.neglected,
        model_error=plants.model_error,
    )


def contact_chart(contact: ContactTransient, units: AxisKind, title: str, band: ContactBand) -> Chart:
    """Draw one predicted contact: the force at the surface and at the sensor over the time after touching.

    `band` is where the force at the sensor lies at each time; peaks come at different times, so theirs reach further.
    """
    time = 1e3 * contact.time_s
    ground = Band(x=1e3 * band.time_s, low=band.low, high=band.high, label="interval at each time, at the sensor")
    # What a force only rises to until the run ends is no point of its curve.
    is_seen = contact.is_settled or contact.time_of_peak_s < float(contact.time_s[-1])
    peak = np.array([1e3 * contact.time_of_peak_s]), np.array([contact.peak_contact_force_n])
    marks = (Points(x=peak[0], y=peak[1], role="after", marker="diamond", label="peak", names=("peak",)),)
    return Chart(
        key="contact",
        title=title,
        alternative=f"The force after touching; its peak is {contact.peak_contact_force_n:.4g} {units.force}.",
        panels=(
            Panel(
                x=Scale(label="time after touching [ms]"),
                y=Scale(label=f"{units.force_name} [{units.force}]"),
                elements=(
                    ground,
                    Line(x=time, y=contact.contact_force_n, label="at the surface", role="after"),
                    Line(x=time, y=contact.sensor_force_n, label="at the sensor", role="after", dashed=True),
                    *(marks if is_seen else ()),
                ),
            ),
        ),
    )
