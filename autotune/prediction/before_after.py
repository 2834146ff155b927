"""Before and after: the contacts of a log beside the same approach with a new controller."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from autotune.charts.chart import Band, Chart, Element, Line, Panel, Points, Scale
from autotune.formats.controller_record import Controller, admittance_controller
from autotune.formats.identified import IdentifiedFile
from autotune.formats.units import axis_units
from autotune.shown import ResultTable, Shown, plain_tree
from autotune.text import COMPARE_EXAMPLE, NO_GAINS_BEFORE, NOTHING_BEFORE, range_text, span_text, speed_text
from identification.result import Touch, TouchCause
from problems.contact.transient import ContactTransient
from problems.errors import AutotuneError
from problems.model.response import hand_force_per_speed
from problems.stability.margins import UnstableLoopError

from .against_touches import ComparedTouch, Running, compare_touches, plants_of_touch, touch_time_s
from .as_run_by import AsRunBy, as_run_by, running_law
from .certified import outside_domain
from .contact import AnyLaw, Law, TargetLaw
from .law import PresentGains, law_of_gains
from .result import interval_notes, predict_contact

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from autotune.charts.show import AxesLike

# Free motion that changes by less, and speeds that differ by less, count as the same.
_SAME_SHARE, _SAME_SPEED = 0.005, 0.1
_SETTLED_SHARE = 0.02
# A plant without deviations predicts an interval without width: peaks that close to it are no contradiction.
_SAME_PEAK = 0.05


@dataclass(frozen=True, kw_only=True)
class ReplayedSurface:
    """The contacts of a log with one surface, and the hardest of them with the new controller at the same speed.

    `touches` are all of them; `after` is the hardest one as predicted with the new gains, `before` the same with the
    gains that ran, None where nobody says them or that loop is unstable. `before_interval` is where the peak with the
    gains that ran lies, None for a high end that is none. Peaks are at the sensor [N, N·m]. `law` is what the new
    controller is called.
    """

    touches: tuple[Touch, ...]
    after: ComparedTouch
    before: ContactTransient | None = None
    before_peak: float | None = None
    law: str = "this controller"
    before_interval: tuple[float, float | None] | None = None
    is_before_unstable: bool = False

    def contradiction(self) -> str:
        """Say where the gains that are said to have run do not predict what the log shows, "" where they do."""
        unit, (low, high) = axis_units(self.after.touch.axis).force, self.measured
        if self.is_before_unstable:
            return (
                f"before: unstable, no contact force on {self.after.predicted.surface}, where your log shows "
                f"{range_text(low, high)} {unit}: these gains did not run there, or the model misses"
            )
        if self.before_peak is None or self.before_interval is None:
            return ""
        least, most = self.before_interval
        if high >= (1.0 - _SAME_PEAK) * least and (most is None or low <= (1.0 + _SAME_PEAK) * most):
            return ""
        digits = 1 if high >= 10.0 else 2
        return (
            f"these gains predict {self.before_peak:.{digits}f} {unit} on {self.after.predicted.surface}, your log "
            f"shows {range_text(low, high)} {unit}: they did not run there, or the model misses"
        )

    @property
    def measured(self) -> tuple[float, float]:
        """The smallest and the largest measured peak."""
        peaks = [touch.peak_force for touch in self.touches]
        return min(peaks), max(peaks)

    def text(self) -> str:
        """Say the measured peaks and the one predicted with the new controller."""
        predicted, unit = self.after.predicted, axis_units(self.after.touch.axis).force
        (low, high), speed = self.measured, self.after.predicted.contact.contact_speed_m_s
        digits = 1 if high >= 10.0 else 2
        speeds = [touch.approach_speed for touch in self.touches if touch.approach_speed is not None]
        is_same = not speeds or max(speeds) - min(speeds) <= _SAME_SPEED * max(speeds)
        where = "at the same speed" if is_same else f"at the hardest one's {speed_text(speed, unit)}"
        ends = predicted.interval.sensor
        upper = "and more" if ends[1] is None else f"{ends[1]:.{digits}f}"
        count = "1 contact" if len(self.touches) == 1 else f"{len(self.touches)} contacts"
        force = predicted.contact.driving_force_n
        # Without F^d and without a hold the log shows no force: what drives the approach under the new law goes on.
        is_shown = self.after.touch.desired_force is not None
        source = "as in the log" if is_shown else "as that speed asks, since the log shows no force that was held"
        pressed = f", pressed on with {force:.3g} {unit} {source}" if force > 0.0 else ""
        return (
            f"in your log {range_text(low, high)} {unit} ({count} on {predicted.surface}, "
            f"{span_text(speeds, unit)}); with {self.law} {where} "
            f"{predicted.peak_sensor_force:.{digits}f} {unit} [{ends[0]:.{digits}f}, {upper}]{pressed}"
            f"{_harder_text(predicted.peak_sensor_force, high)}"
        )


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class BeforeAndAfter(Shown):
    """What a new controller changes on one axis, beside the log and the gains that ran.

    Attributes
    ----------
    axis
        Its name.
    surfaces
        The contacts of the log by surface, that with the hardest one first; empty where it shows none.
    hand
        Force over steady speed in free motion, B_a + B_p, with the gains of today (None where nobody says them) and
        with the new ones [N·s/m, N·m·s/rad].
    worst
        The largest peak at the contact over the certified plants [N, N·m], likewise; infinite where the loop is
        unstable on one of them.
    label
        Where the gains of today are from, "" for nowhere.
    notes
        What of the log could not be replayed and why, and which surface no certificate speaks of, a sentence each.
    as_run_by
        The export target that the controller was designed for; every figure is then of the law that it runs.
    example
        How gains of today are said, named where there are none.

    """

    axis: str
    surfaces: tuple[ReplayedSurface, ...]
    hand: tuple[float | None, float]
    worst: tuple[float | None, float]
    label: str = ""
    notes: tuple[str, ...] = ()
    as_run_by: AsRunBy | None = None
    example: str = COMPARE_EXAMPLE

    @property
    def free_motion_change(self) -> float | None:
        """(B_a + B_p) after over before, less 1: negative where it moves lighter; None without gains of today."""
        before, after = self.hand
        return None if not before else after / before - 1.0

    @property
    def is_empty(self) -> bool:
        """Whether there is nothing to compare with: no contact that could be replayed, and no gains of today."""
        return not self.surfaces and self.hand[0] is None

    def sentence(self) -> str:
        """Return the outcome in a sentence: the contacts of the log, else the certified ones, and free motion."""
        first = self.surfaces[0].text() if self.surfaces else self._worst_text()
        contradiction = self.surfaces[0].contradiction() if self.surfaces else ""
        parts = (first or NOTHING_BEFORE, contradiction, self._unstable_text(), self._free_text(bool(first)))
        return "; ".join(part for part in parts if part).replace(COMPARE_EXAMPLE, self.example)

    def _unstable_text(self) -> str:
        """Say that the gains of today are unstable, where the contacts of the log are replayed with the log's own."""
        before, _ = self.worst
        if before is None or not math.isinf(before) or not self.surfaces or self.surfaces[0].is_before_unstable:
            return ""
        return f"the gains of today ({self.label}) are unstable on a certified plant"

    @property
    def _law(self) -> str:
        return _name_of(self.as_run_by)

    def further(self) -> Iterator[str]:
        """Yield the other surfaces, a sentence each."""
        for each in self.surfaces[1:]:
            yield "; ".join(filter(None, (each.text(), each.contradiction())))

    def _worst_text(self) -> str:
        before, after = self.worst
        unit = axis_units(self.axis).force
        if before is None:
            return ""
        if math.isinf(before):
            return f"the gains of today are unstable on a certified plant; {self._law}: at most {after:.1f} {unit}"
        harder = _harder_text(after, before)
        return (
            f"gains of today: up to {before:.1f} {unit} on a certified plant; {self._law}: {after:.1f} {unit}{harder}"
        )

    def _free_text(self, has_contacts: bool) -> str:
        change = self.free_motion_change
        if change is None:
            return NO_GAINS_BEFORE if has_contacts else ""
        if abs(change) < _SAME_SHARE:
            return "free motion as before"
        moved = f"free motion {100.0 * abs(change):.0f} % {'lighter' if change < 0.0 else 'heavier'}"
        return f"{moved} than with {self.label}" if self.label else moved

    def _headline(self) -> str:
        return f"before → after, axis {self.axis}: {self.sentence()}"

    def _tables(self) -> Iterator[ResultTable]:
        unit = axis_units(self.axis).force
        rows = []
        for each in self.surfaces:
            predicted, (low, high) = each.after.predicted, each.after.predicted.interval.sensor
            rows.append(
                (
                    predicted.surface,
                    f"{1e3 * predicted.contact.contact_speed_m_s:.1f}",
                    f"{each.after.touch.peak_force:.1f}",
                    "" if each.before_peak is None else f"{each.before_peak:.1f}",
                    f"{predicted.peak_sensor_force:.1f}",
                    f"{low:.1f} to {'more' if high is None else f'{high:.1f}'}",
                )
            )
        speed = "mm/s" if unit == "N" else "mrad/s"
        columns = (
            "hardest contact on",
            f"speed [{speed}]",
            f"measured [{unit}]",
            f"predicted with the gains that ran [{unit}]",
            f"with {self._law} [{unit}]",
            f"interval [{unit}]",
        )
        if rows:
            yield ResultTable(title="peaks at the sensor, at the same speed", columns=columns, rows=tuple(rows))

    def _notes(self) -> Sequence[str]:
        notes = (interval_notes(e.after.predicted.interval, e.after.predicted.model_error) for e in self.surfaces[:1])
        return (*self.further(), *(text for each in notes for text in each), *self.notes)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as plain data, with the sentence; peaks at the sensor."""
        before, after = (value if value is None or math.isfinite(value) else None for value in self.worst)
        return {
            "text": self.sentence(),
            "gains_of_today": self.label or None,
            "surfaces": [
                {
                    "surface": each.after.predicted.surface,
                    "log": each.after.log,
                    "time_s": touch_time_s(each.after.touch),
                    "contacts": len(each.touches),
                    "approach_speed": each.after.predicted.contact.contact_speed_m_s,
                    "measured_peaks": list(each.measured),
                    "predicted_before": each.before_peak,
                    "interval_before": plain_tree(each.before_interval),
                    "contradiction": each.contradiction() or None,
                    "predicted_after": each.after.predicted.peak_sensor_force,
                    "interval": plain_tree(each.after.predicted.interval.sensor),
                }
                for each in self.surfaces
            ],
            "free_motion": {"before": self.hand[0], "after": self.hand[1]},
            "largest_certified_peak": {"before": before, "after": after},
            **({} if self.as_run_by is None else {"as_run_by": self.as_run_by.target}),
            "notes": list(self.notes),
        }

    def chart(self) -> Chart | None:
        """Return the picture of the hardest contact: the force at the sensor before and after; None without one."""
        return before_after_chart(self.surfaces[0]) if self.surfaces else None

    def plot(self, ax: "AxesLike | None" = None) -> "Figure | None":
        """Draw the hardest contact of the log before and after; None where there is none."""
        from autotune.charts.show import show  # noqa: PLC0415 - matplotlib

        chart = self.chart()
        return None if chart is None else show(chart, ax)


def compare_before_after(
    source: IdentifiedFile,
    controller: Controller,
    *,
    present: PresentGains | None = None,
    worst_before: Mapping[str, float] | None = None,
) -> dict[str, BeforeAndAfter]:
    """Replay the contacts that `source` holds with a controller, axis by axis, at their measured speeds.

    After the impact acts the F^d of the log, or else the force that it held at rest. Replayed is the hardest contact of
    each surface. `worst_before` is the largest peak of the present gains on the certified plants [N, N·m]. Of a file
    that was designed for an export target it is the law of that.
    """
    found = {}
    for axis, domain in controller.certificate.domain.items():
        law, target = running_law(controller, axis), as_run_by(controller, axis)
        today = None if present is None else present.laws.get(axis)
        surfaces, passed = _replayed_surfaces(source, axis, law, today, controller.sample_time_s)
        surfaces = tuple(replace(each, law=_name_of(target)) for each in surfaces)
        outside = [outside_domain(domain, each.after.predicted) for each in surfaces]
        nominal = domain.plants.nominal
        if target is None:
            hand = hand_force_per_speed(nominal, admittance_controller(controller, axis))
            peak = max(each.peak_contact_force_n for each in controller.predicted[axis].scenarios)
        else:
            hand, peak = target.hand_force, target.peak
        found[axis] = BeforeAndAfter(
            axis=axis,
            surfaces=surfaces,
            hand=(None if today is None else hand_force_per_speed(nominal, today.controller), hand),
            worst=((worst_before or {}).get(axis), peak),
            label="" if today is None or present is None else present.label,
            notes=(
                *(f"outside of what the certificate holds: {'; '.join(each)}" for each in outside if each),
                *passed,
            ),
            as_run_by=target,
        )
    return found


def _harder_text(after: float, before: float) -> str:
    """Say by how much a contact is harder than it was, "" where it is not."""
    return f", {100.0 * (after / before - 1.0):.0f} % HARDER than before" if after > (1.0 + _SAME_PEAK) * before else ""


def _name_of(target: AsRunBy | None) -> str:
    """Return what the new controller is called."""
    return "this controller" if target is None else f"this controller as {target.target} runs it"


def _replayed_surfaces(
    source: IdentifiedFile, axis: str, law: AnyLaw, today: Law | None, sample_time_s: float
) -> tuple[tuple[ReplayedSurface, ...], tuple[str, ...]]:
    """Return the surfaces of an axis with their hardest contact replayed, the hardest first, and what was not."""
    groups: dict[str, list[tuple[str, Touch]]] = {}
    for line in source.result.timelines:
        for touch in line.touches:
            if touch.axis == axis and touch.cause is TouchCause.WALL and not touch.is_withdrawn:
                groups.setdefault(touch.surface or "", []).append((line.log, _with_held_force(touch)))
    surfaces, passed = list[ReplayedSurface](), list[str]()
    running = _running(law)
    for group in groups.values():
        hardest = max(group, key=lambda each: each[1].peak_force)
        try:
            (after,) = compare_touches(source, [hardest], lambda _: running, sample_time_s=sample_time_s).contacts
        except AutotuneError as error:
            passed.append(str(error))
            continue
        whole = ReplayedSurface(touches=tuple(each for _, each in group), after=after)
        surfaces.append(_with_before(whole, source, today, sample_time_s))
    surfaces.sort(key=lambda each: -each.measured[1])
    return tuple(surfaces), tuple(passed)


def _with_held_force(touch: Touch) -> Touch:
    """Return the touch with the force that it held as F^d, where the log does not say that: at rest they are equal."""
    if touch.desired_force is not None or not touch.held_force:
        return touch
    return replace(touch, desired_force=touch.sign * abs(touch.held_force))


def _running(law: AnyLaw) -> Running:
    if isinstance(law, TargetLaw):
        return Running(law=law)
    controller = law.controller
    return Running(law=law, mass=controller.mass_kg, damping=controller.damping_n_s_per_m, lead_s=controller.lead_s)


def _with_before(
    surface: ReplayedSurface, source: IdentifiedFile, today: Law | None, sample_time_s: float
) -> ReplayedSurface:
    """Return a surface with its hardest contact as predicted with the gains that ran, the log's or else those of today.

    Without them where nobody says them.
    """
    touch = surface.after.touch
    if touch.mass is not None and touch.damping is not None:
        running = Running(law=law_of_gains({"mass": 1.0, "damping": 1.0}) if today is None else today)
    elif today is not None:
        running = _running(today)
    else:
        return surface
    try:
        plants = plants_of_touch(source, touch, sample_time_s=sample_time_s)
        found = predict_contact(plants, running.law_at(touch), running.approach_at(touch))
    except UnstableLoopError:
        return replace(surface, is_before_unstable=True)
    except AutotuneError:
        return surface
    peak, ends = found.peak_sensor_force, found.interval.sensor
    return replace(surface, before=found.contact, before_peak=peak, before_interval=ends)


def before_after_chart(surface: ReplayedSurface) -> Chart:
    """Draw one contact before and after: measured peaks, the force predicted with both controllers, and its band."""
    predicted, units = surface.after.predicted, axis_units(surface.after.touch.axis)
    contact, band = predicted.contact, predicted.band
    end = _until(contact, surface.before)
    used, after = contact.time_s <= end, surface.law.replace("this controller", "after")
    elements: list[Element] = [
        Band(
            x=1e3 * band.time_s[used],
            low=band.low[used],
            high=band.high[used],
            label=f"{after}, interval",
            role="after",
        ),
    ]
    if surface.before is not None:
        shown = surface.before.time_s <= end
        time = 1e3 * surface.before.time_s[shown]
        elements.append(Line(x=time, y=surface.before.sensor_force_n[shown], label="before, predicted", role="before"))
    elements.append(
        Line(x=1e3 * contact.time_s[used], y=contact.sensor_force_n[used], label=f"{after}, predicted", role="after")
    )
    seen = [(touch.peak_s - touch.onset_s, touch) for touch in surface.touches if touch.onset_s is not None]
    if seen:
        elements.append(
            Points(
                x=1e3 * np.array([time for time, _ in seen]),
                y=np.array([touch.peak_force for _, touch in seen]),
                label="before, measured peaks",
                names=tuple(f"{touch.axis} at {touch_time_s(touch):.2f} s" for _, touch in seen),
            )
        )
    speed = speed_text(contact.contact_speed_m_s, units.force)
    return Chart(
        key=f"{predicted.axis}-before-after",
        title=f"Before and after: the hardest contact on {predicted.surface}, at {speed}",
        alternative=f"Force at the sensor over time after touching {predicted.surface} on axis {predicted.axis}: "
        f"{surface.text()}.",
        panels=(
            Panel(
                x=Scale(label="time after touching [ms]", limits=(0.0, 1e3 * end)),
                y=Scale(label=f"{units.force_name} at the sensor [{units.force}]"),
                elements=tuple(elements),
            ),
        ),
    )


def _until(after: ContactTransient, before: ContactTransient | None) -> float:
    """Return until when there is something to see [s]."""
    ends = []
    for run in (after, before):
        if run is not None:
            force = run.sensor_force_n
            moving = np.flatnonzero(np.abs(force - force[-1]) > _SETTLED_SHARE * float(np.max(np.abs(force))))
            ends.append(float(run.time_s[min(moving[-1] + 1, len(force) - 1)]) if len(moving) else 0.0)
    return max(1.1 * max(ends), 3.0 * after.time_of_sensor_peak_s, 0.05)
