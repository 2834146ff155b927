"""Charts and tables of the fit: contacts, signals and residuals, frequency responses, correlation of the errors."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from autotune.charts.chart import (
    Band,
    Bars,
    Chart,
    Element,
    Heat,
    Limit,
    Line,
    Panel,
    Points,
    Role,
    Scale,
    level_panels,
)
from identification.evidence import AxisEvidence
from identification.joint_fit.result import FittedSpan
from identification.measured_response import FrequencyResponse, MeasuredResponse
from identification.result import AxisEstimate, Covariance
from problems.arrays import ComplexArray, FloatArray
from problems.model.axis_kind import AxisKind

from .page import Table, build_table

_TIME = "time [s]"
_MOST_LAGS = 60
_CHANCE_95 = 1.96
_PANELS = 3
# What is beyond is in the table: a page of sixty contacts would be no page that anybody reads.
_MOST_DRAWN = 9
_BEFORE_S, _AFTER_S = 0.2, 0.6
_ROBOT_NAMES = {"omega": "robot ω", "zeta": "robot ζ"}


@dataclass(frozen=True, kw_only=True)
class ContactSeen:
    """One contact that was fitted: `place` is the sample of its measured peak within the span."""

    span: FittedSpan
    place: int

    @property
    def measured(self) -> float:
        """The measured peak, N or N·m."""
        return float(np.max(np.abs(self.span.measured)))

    @property
    def model(self) -> float:
        """The peak of the model, N or N·m."""
        return float(np.max(np.abs(self.span.predicted)))

    @property
    def error(self) -> float:
        """How far the model's peak lies above the measured one, of that."""
        return self.model / self.measured - 1.0

    def time_s(self, period_s: float) -> float:
        """Return when the peak was, in s after the start of the log."""
        return period_s * (self.span.start + self.place)


def contacts_seen(evidence: AxisEvidence, surface: int) -> tuple[ContactSeen, ...]:
    """Return the fitted contacts of one surface in the order of time."""
    spans = sorted((span for span in evidence.spans if span.surface == surface), key=lambda span: span.start)
    return tuple(ContactSeen(span=span, place=int(np.argmax(np.abs(span.measured)))) for span in spans)


def contact_charts(
    axis: str, units: AxisKind, surface: str, seen: Sequence[ContactSeen], period_s: float
) -> Iterator[Chart]:
    """Draw the contacts of one surface, measured and modelled, all on one scale of force."""
    strongest = sorted(seen, key=lambda each: -each.measured)[:_MOST_DRAWN]
    shown = [each for each in seen if each in strongest]
    if not shown:
        return
    panels = level_panels([_contact_panel(each, units, period_s) for each in shown])
    share = 100.0 * max(abs(each.error) for each in seen)
    rows = -(-len(shown) // _PANELS)
    beside = -(-len(shown) // rows)
    groups = [panels[i : i + beside] for i in range(0, len(panels), beside)]
    for number, group in enumerate(groups, 1):
        part = f" ({number} of {rows})" if rows > 1 else ""
        which = "" if len(shown) == len(seen) else f" The strongest {len(shown)} are drawn; the table has all."
        yield Chart(
            key=f"{axis}-{surface}-contacts" + (f"-{number}" if number > 1 else ""),
            title=f"Contacts with {surface}, measured and modelled{part}",
            alternative=f"{len(group)} of {len(seen)} contacts with {surface}; in all of them the model's peak is "
            f"within {share:.1f} % of the measured one.",
            caption=f"In all {len(seen)} contacts the peak of the model is within {share:.1f} % of the measured "
            f"one.{which}"
            if number == rows
            else "",
            panels=group,
            beside=True,
        )


def _contact_panel(seen: ContactSeen, units: AxisKind, period_s: float) -> Panel:
    span, place = seen.span, seen.place
    begin = max(0, place - round(_BEFORE_S / period_s))
    stop = min(len(span.measured), place + round(_AFTER_S / period_s))
    time = 1e3 * period_s * (np.arange(begin, stop) - place)
    return Panel(
        title=f"at {seen.time_s(period_s):.1f} s",
        x=Scale(label="time from the peak [ms]"),
        y=Scale(label=f"{units.force_name} [{units.force}]"),
        elements=(
            Line(x=time, y=span.measured[begin:stop], label="measured", wide=True),
            Line(x=time, y=span.predicted[begin:stop], label="model", role="model"),
        ),
    )


def contact_table(
    axis: str, units: AxisKind, surfaces: Sequence[tuple[str, Sequence[ContactSeen]]], period_s: float
) -> Table:
    """Return every contact that was fitted: when, with what, both peaks and the error."""
    rows = []
    seen = [(name, each) for name, group in surfaces for each in group]
    for name, each in sorted(seen, key=lambda pair: pair[1].span.start):
        rms = float(np.sqrt(np.mean((each.span.measured - each.span.predicted) ** 2)))
        numbers = (f"{each.measured:.4g}", f"{each.model:.4g}", f"{100.0 * each.error + 0.0:+.1f}", f"{rms:.3g}")
        rows.append((f"{each.time_s(period_s):.2f}", name, *numbers))
    force = f"[{units.force}]"
    columns = ("peak at [s]", "surface", f"measured peak {force}", f"model's peak {force}", "error [%]")
    caption = f"Every contact along {axis}, measured against the model"
    return build_table(caption, (*columns, f"residual RMS {force}"), rows, numbers=(0, 2, 3, 4, 5))


def residual_charts(axis: str, units: AxisKind, evidence: AxisEvidence, period_s: float) -> Iterator[Chart]:
    """Draw the signal that was fitted and what the fit leaves: over time, as histogram, spectrum, autocorrelation."""
    if not evidence.spans:
        return
    time, measured, model = _over_time(evidence.spans, period_s)
    left = measured - model
    free, touching = (_joined(evidence.spans, period_s, contact=kind) for kind in (False, True))
    rms = float(np.sqrt(np.nanmean(left**2)))
    yield Chart(
        key=f"{axis}-residual",
        title=f"The {units.force_name} that was fitted, and what the model leaves of it",
        alternative=f"The {units.force_name} of axis {axis} over the spans that were fitted, measured and modelled, up "
        f"to {float(np.nanmax(np.abs(measured))):.3g} {units.force}, and the residual, RMS {rms:.3g} {units.force}.",
        linked=True,
        panels=(
            Panel(
                x=Scale(label=_TIME),
                y=Scale(label=f"{units.force_name} [{units.force}]"),
                elements=(
                    Line(x=time, y=measured, label="measured", role="measured"),
                    Line(x=time, y=model, label="model", role="model", dashed=True),
                ),
            ),
            Panel(
                x=Scale(label=_TIME),
                y=Scale(label=f"residual [{units.force}]"),
                height=0.7,
                elements=(Line(x=time, y=left, label="residual", role="residual"),),
            ),
        ),
    )
    white = np.concatenate([span.white for span in evidence.spans])
    yield Chart(
        key=f"{axis}-white",
        title="Whether it is noise",
        alternative=f"Histogram, spectrum and autocorrelation of the residual of axis {axis}. Its whitened deviation "
        f"is {float(np.std(white)):.2f}, where 1 is noise alone.",
        caption="The whitened residual beside a normal distribution; spectra; autocorrelation of the whitened "
        "residual, which is chance within the band (95 %).",
        beside=True,
        panels=(
            _histogram(white),
            _spectra(units, free, touching, period_s),
            _autocorrelation([span.white for span in evidence.spans], period_s),
        ),
    )


def _over_time(spans: Sequence[FittedSpan], period_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times, what was measured and what the model says, with a NaN between spans."""
    times, measured, model = [], [], []
    gap = np.array([np.nan])
    for span in sorted(spans, key=lambda s: s.start):
        times += [period_s * (span.start + np.arange(len(span.measured) + 1))]
        measured += [span.measured, gap]
        model += [span.predicted, gap]
    return np.concatenate(times), np.concatenate(measured), np.concatenate(model)


def _joined(spans: Sequence[FittedSpan], period_s: float, *, contact: bool) -> list[tuple[FloatArray, FloatArray]]:
    longest = round(1.0 / period_s)
    return [
        (span.measured, span.measured - span.predicted)
        for span in spans
        if (span.surface is not None) == contact and len(span.measured) > longest
    ]


def _histogram(white: FloatArray) -> Panel:
    edges = np.linspace(-5.0, 5.0, 51)
    heights = np.histogram(np.clip(white, edges[0], edges[-1]), edges, density=True)[0]
    grid = np.linspace(-5.0, 5.0, 201)
    return Panel(
        x=Scale(label="residual over its deviation"),
        y=Scale(label="density"),
        elements=(
            Bars(edges=edges, heights=heights, label="whitened residual"),
            Line(x=grid, y=np.exp(-0.5 * grid**2) / np.sqrt(2.0 * np.pi), label="normal distribution", role="model"),
        ),
    )


def _spectra(
    units: AxisKind,
    free: Sequence[tuple[FloatArray, FloatArray]],
    touching: Sequence[tuple[FloatArray, FloatArray]],
    period_s: float,
) -> Panel:
    lines: list[Element] = []
    roles: tuple[tuple[Role, Role], ...] = (("measured", "residual"), ("after", "other"))
    for spans, what, pair in ((free, "free", roles[0]), (touching, "contact", roles[1])):
        for which, (name, role) in enumerate(zip(("force", "residual"), pair, strict=True)):
            found = _spectrum([span[which] for span in spans], period_s)
            if found is not None:
                lines.append(Line(x=found[0], y=found[1], label=f"{name}, {what}", role=role))
    unit = units.force if "·" not in units.force else f"({units.force})"
    return Panel(
        x=Scale(label="frequency [Hz]", spacing="log"),
        y=Scale(label=f"power density [{unit}²/Hz]", spacing="log"),
        elements=tuple(lines),
    )


def _spectrum(signals: Sequence[FloatArray], period_s: float) -> tuple[FloatArray, FloatArray] | None:
    """Return frequency and mean power density of spans that are long enough, without the value at 0."""
    window = round(1.0 / period_s)
    kept = [signal for signal in signals if len(signal) >= window]
    if not kept:
        return None
    found = [scipy.signal.welch(signal, 1.0 / period_s, nperseg=window) for signal in kept]
    power = np.average([p for _, p in found], axis=0, weights=[len(signal) for signal in kept])
    return np.asarray(found[0][0][1:]), np.asarray(power[1:])


def _autocorrelation(spans: Sequence[FloatArray], period_s: float) -> Panel:
    count = sum(len(span) for span in spans)
    lags = min(_MOST_LAGS, min(len(span) for span in spans) - 1)
    power = sum(float(span @ span) for span in spans)
    values = [sum(float(span[k:] @ span[:-k]) for span in spans) / power for k in range(1, lags + 1)]
    time = 1e3 * period_s * np.arange(1, lags + 1)
    chance = np.full(lags, _CHANCE_95 / np.sqrt(count))
    return Panel(
        x=Scale(label="lag [ms]"),
        y=Scale(label="autocorrelation"),
        elements=(
            Band(x=time, low=-chance, high=chance, label="chance (95 %)", role="quiet"),
            Line(x=time, y=np.array(values), label="autocorrelation", role="residual"),
            Limit(value=0.0, role="quiet"),
        ),
    )


def response_charts(axis: str, units: AxisKind, estimate: AxisEstimate, period_s: float) -> Iterator[Chart]:
    """Draw the frequency responses of robot and coupling: as motion shows them without a model, and the fit."""
    frequency = np.geomspace(0.2, min(0.4 / period_s, 200.0), 400)
    shown = estimate.frequency_response or FrequencyResponse()
    robot = _robot_response(estimate, frequency)
    if robot is not None:
        delay, bandwidth = estimate.robot.delay_s.value, estimate.robot.bandwidth_hz.value
        facts = (
            "" if delay is None or bandwidth is None else f" Bandwidth {bandwidth:.2f} Hz, delay {1e3 * delay:.2f} ms."
        )
        named = f"{axis}-robot", "Robot: from command to pose", "|x / x_d|"
        yield _bode(*named, frequency, robot, shown.command_to_pose, facts)
    coupling = _coupling_response(estimate, frequency)
    if coupling is not None:
        angle = "m" if units.force == "N" else "rad"
        named = f"{axis}-coupling", "Coupling and payload: from pose to force", f"|F / x| [{units.force}/{angle}]"
        yield _bode(*named, frequency, coupling, shown.pose_to_force, "")


def _robot_response(estimate: AxisEstimate, frequency: FloatArray) -> ComplexArray | None:
    robot = estimate.robot
    if robot.numerator.value is None or robot.denominator.value is None:
        return None
    s = 2j * np.pi * frequency
    late = np.exp(-s * (robot.delay_s.value or 0.0))
    return np.asarray(late * np.polyval(robot.numerator.value, s) / np.polyval(robot.denominator.value, s))


def _coupling_response(estimate: AxisEstimate, frequency: FloatArray) -> ComplexArray | None:
    """Return F/x of a payload on its spring: −(M_p s² + B_p s)(B_s s + K_s)/(M_p s² + (B_p + B_s)s + K_s)."""
    if estimate.covariance is None or "K_s" not in estimate.covariance.names:
        return None
    values = dict(zip(estimate.covariance.names, estimate.covariance.values, strict=True))
    s = 2j * np.pi * frequency
    spring, inertia = values["B_s"] * s + values["K_s"], values["M_p"] * s**2 + values["B_p"] * s
    return np.asarray(-inertia * spring / (inertia + spring))


def _bode(
    key: str,
    title: str,
    label: str,
    frequency: FloatArray,
    model: ComplexArray,
    measured: MeasuredResponse | None,
    facts: str,
) -> Chart:
    panels = []
    turned = np.degrees(np.unwrap(np.angle(model)))
    magnitude, phase = Scale(label=label, spacing="log"), Scale(label="phase [°]")
    for scale, of_model in ((magnitude, np.abs(model)), (phase, turned)):
        elements: list[Element] = []
        if measured is not None:
            at, values, radius = measured.frequency_hz, np.abs(measured.values), measured.radius_95
            if scale is phase:
                angle = np.degrees(np.angle(measured.values))
                values = angle + 360.0 * np.round((np.interp(at, frequency, turned) - angle) / 360.0)
                radius = np.degrees(np.arcsin(radius / np.abs(measured.values)))
            elements = [
                Band(x=at, low=values - radius, high=values + radius, label="measured, 95 %", role="measured"),
                Points(x=at, y=values, label="measured", role="measured"),
            ]
        elements.append(Line(x=frequency, y=of_model, label="fit", role="model"))
        panels.append(Panel(x=Scale(label="frequency [Hz]", spacing="log"), y=scale, elements=tuple(elements)))
    seen = "no measured response"
    if measured is not None:
        at, share = measured.frequency_hz, float(np.median(measured.radius_95 / np.abs(measured.values)))
        seen = (
            f"measured without a model at {len(at)} frequencies from {at[0]:.2g} to {at[-1]:.3g} Hz, where free motion "
            f"excites it, to ±{100.0 * share:.2g} % (95 %) in the middle"
        )
    return Chart(
        key=key,
        title=title,
        alternative=f"{title}: magnitude and phase of the fit, {seen}.{facts}",
        panels=tuple(panels),
        linked=True,
        caption=facts.strip(),
    )


def correlation_chart(axis: str, covariance: Covariance) -> Chart:
    """Draw how the errors of the parameters go together."""
    matrix = np.array(covariance.matrix)
    std = np.sqrt(np.diag(matrix))
    # To the digits that are written; adding nothing makes 0 of what would be written as -0.
    correlation = np.round(matrix / np.outer(std, std), 2) + 0.0
    off = correlation - np.eye(len(std))
    i, j = np.unravel_index(int(np.argmax(np.abs(off))), off.shape)
    places = np.arange(len(std), dtype=np.float64)
    names = tuple(_ROBOT_NAMES.get(name, name) for name in covariance.names)
    return Chart(
        key=f"{axis}-correlation",
        title="How the errors go together",
        alternative=f"Correlation of the errors of {len(names)} parameters; the largest is {off[i, j]:+.2f}, between "
        f"{names[i]} and {names[j]}.",
        caption="Robot ω and ζ: natural frequency and damping ratio of the model whose bandwidth is in the table."
        if "omega" in covariance.names and "zeta" in covariance.names
        else "Robot ω: the pole of the model whose bandwidth is in the table."
        if "omega" in covariance.names
        else "",
        panels=(
            Panel(
                x=Scale(label=""),
                y=Scale(label=""),
                height=1.6,
                elements=(
                    Heat(
                        x=places,
                        y=places,
                        values=correlation,
                        label="correlation",
                        limits=(-1.0, 1.0),
                        names=(names, names),
                        written=len(names) <= 20,
                    ),
                ),
            ),
        ),
    )
