"""The figures of an identification: what was logged, what the model says, and what it leaves."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.signal import csd, welch
from scipy.stats import norm

from autotune.files.units import AxisUnits
from identification.evidence import AxisEvidence, Evidence
from identification.joint_result import FittedSpan
from identification.result import AxisEstimate, Covariance, NoiseSpectrum
from identification.timeline_phases import Kind, Timeline

from .charts import Band, Bars, Chart, Element, Heat, Limit, Line, Panel, Points, Role, Scale, Stretch
from .framing import level_panels

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_TIME = "time [s]"
_WINDOW_S = 2.0
_COHERENT = 0.9
_MOST_LAGS = 60
_CHANCE_95 = 1.96
_MOST_CONTACTS = 3
_BEFORE_S, _AFTER_S = 0.05, 0.6
_ROLES: dict[Kind, Role] = {
    Kind.TURNING: "other",
    Kind.FREE_MOTION: "good",
    Kind.COMMANDED_MOTION: "after",
    Kind.HAND_LED_MOTION: "residual",
    Kind.CONTACT: "bad",
    Kind.UNKNOWN: "before",
}


def wrench_chart(evidence: Evidence, timeline: Timeline | None, key: str) -> Chart:
    """Draw the three forces of the sensor, as logged and without weight and bias, over the phases of the log."""
    time = evidence.period_s * np.arange(len(evidence.raw_S_n))
    shades = () if timeline is None else tuple(_shades(timeline))
    panels = tuple(
        Panel(
            x=Scale(label=_TIME),
            y=Scale(label=f"F{name} [N]"),
            elements=(
                *shades,
                Line(x=time, y=evidence.raw_S_n[:, i], label="as logged", role="before"),
                Line(x=time, y=evidence.compensated_S_n[:, i], label="without weight and bias", role="measured"),
            ),
        )
        for i, name in enumerate("xyz")
    )
    left = evidence.compensated_S_n[np.isfinite(evidence.compensated_S_n).all(axis=1)]
    largest = float(np.max(np.linalg.norm(left, axis=1), initial=0.0))
    return Chart(
        key=key,
        title="Force of the sensor, and what happened when",
        alternative=f"Three curves over {time[-1]:.0f} s, Fx, Fy, Fz in the sensor frame, as logged and without weight "
        f"and bias; without them the force reaches {largest:.1f} N. {_told(timeline)}",
        caption="Shaded: the phases that were found. What is not shaded is rest.",
        panels=panels,
        linked=True,
    )


def _shades(timeline: Timeline) -> Iterator[Stretch]:
    for phase in timeline.phases:
        if phase.kind in _ROLES:
            label = phase.kind.value.replace("-", " ")
            yield Stretch(low=phase.start_s, high=phase.stop_s, label=label, role=_ROLES[phase.kind])


def _told(timeline: Timeline | None) -> str:
    if timeline is None:
        return ""
    contacts = [p.contact for p in timeline.phases if p.contact is not None]
    kinds = ", ".join(dict.fromkeys(p.kind.value.replace("-", " ") for p in timeline.phases))
    return f"Phases: {kinds}; {len(contacts)} contacts."


def residual_charts(axis: str, units: AxisUnits, told: AxisEvidence, period_s: float) -> Iterator[Chart]:
    """Draw what the fit leaves: over time, as a histogram, as a spectrum and as an autocorrelation."""
    if not told.spans:
        return
    time, left = _over_time(told.spans, period_s)
    free, touching = (_joined(told.spans, period_s, contact=kind) for kind in (False, True))
    rms = float(np.sqrt(np.nanmean(left**2)))
    yield Chart(
        key=f"{axis}-residual",
        title="What the model leaves of the force",
        alternative=f"The residual of axis {axis} over the spans that were fitted, RMS {rms:.3g} {units.force}.",
        panels=(
            Panel(
                x=Scale(label=_TIME),
                y=Scale(label=f"residual [{units.force}]"),
                elements=(Line(x=time, y=left, label="residual", role="residual"),),
            ),
        ),
    )
    white = np.concatenate([span.white for span in told.spans])
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
            _autocorrelation([span.white for span in told.spans], period_s),
        ),
    )


def _over_time(spans: Sequence[FittedSpan], period_s: float) -> tuple[FloatArray, FloatArray]:
    """Return times and residuals with a NaN between spans."""
    times, values = [], []
    for span in sorted(spans, key=lambda s: s.start):
        times += [period_s * (span.start + np.arange(len(span.measured) + 1))]
        values += [span.measured - span.predicted, np.array([np.nan])]
    return np.concatenate(times), np.concatenate(values)


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
            Line(x=grid, y=norm.pdf(grid), label="normal distribution", role="model"),
        ),
    )


def _spectra(
    units: AxisUnits,
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
    found = [welch(signal, 1.0 / period_s, nperseg=window) for signal in kept]
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


def response_charts(
    axis: str, units: AxisUnits, estimate: AxisEstimate, told: AxisEvidence | None, period_s: float
) -> Iterator[Chart]:
    """Draw the frequency responses of robot and coupling: measured where the motion excites them, and the fit."""
    top = min(0.4 / period_s, 200.0)
    frequency = np.geomspace(0.2, top, 400)
    robot = _robot_response(estimate, frequency, period_s)
    if robot is not None:
        measured = (
            None if told is None or told.command is None else _measured(told, told.command, told.position, period_s)
        )
        delay, bandwidth = estimate.robot.delay_s.value, estimate.robot.bandwidth_hz.value
        facts = (
            "" if delay is None or bandwidth is None else f" Bandwidth {bandwidth:.2f} Hz, delay {1e3 * delay:.2f} ms."
        )
        yield _bode(f"{axis}-robot", "Robot: from command to pose", "|x / x_d|", frequency, robot, measured, facts)
    coupling = _coupling_response(estimate, frequency)
    if coupling is not None:
        measured = None if told is None else _measured(told, told.position, told.force, period_s)
        angle = "m" if units.force == "N" else "rad"
        name = f"|F / x| [{units.force}/{angle}]"
        yield _bode(
            f"{axis}-coupling", "Coupling and payload: from pose to force", name, frequency, coupling, measured, ""
        )


def _robot_response(estimate: AxisEstimate, frequency: FloatArray, period_s: float) -> ComplexArray | None:
    robot = estimate.robot
    if robot.numerator.value is None or robot.denominator.value is None:
        return None
    s = 2j * np.pi * frequency
    held = (1.0 - np.exp(-s * period_s)) / (s * period_s)
    late = np.exp(-s * (robot.delay_s.value or 0.0))
    return np.asarray(held * late * np.polyval(robot.numerator.value, s) / np.polyval(robot.denominator.value, s))


def _coupling_response(estimate: AxisEstimate, frequency: FloatArray) -> ComplexArray | None:
    """Return F/x of a payload on its spring, MODEL.md: −(M_p s² + B_p s)(B_s s + K_s)/(M_p s² + (B_p + B_s)s + K_s)."""
    if estimate.covariance is None:
        return None
    values = dict(zip(estimate.covariance.names, estimate.covariance.values, strict=True))
    s = 2j * np.pi * frequency
    spring, inertia = values["B_s"] * s + values["K_s"], values["M_p"] * s**2 + values["B_p"] * s
    return np.asarray(-inertia * spring / (inertia + spring))


def _measured(
    told: AxisEvidence, drive: FloatArray, answer: FloatArray, period_s: float
) -> tuple[FloatArray, ComplexArray] | None:
    """Return frequency and response where free motion excites it: coherence above 0.9 (Welch's method)."""
    window = round(_WINDOW_S / period_s)
    total = np.zeros((3, window // 2 + 1), dtype=np.complex128)
    frequency = None
    for span in told.free:
        u, y = drive[span.slice], answer[span.slice]
        if len(span) < window or not (np.isfinite(u).all() and np.isfinite(y).all()):
            continue
        for i, (a, b) in enumerate(((u, y), (u, u), (y, y))):
            frequency, power = csd(a, b, 1.0 / period_s, nperseg=window, detrend="linear")
            total[i] += power * len(span)
    if frequency is None:
        return None
    cross, drive_power, answer_power = total[0], total[1].real, total[2].real
    with np.errstate(divide="ignore", invalid="ignore"):
        coherence = np.abs(cross) ** 2 / (drive_power * answer_power)
        response = cross / drive_power
    good = (coherence > _COHERENT) & (frequency > 0.0) & (frequency < 0.4 / period_s)
    return (frequency[good], response[good]) if np.any(good) else None


def _bode(
    key: str,
    title: str,
    label: str,
    frequency: FloatArray,
    model: ComplexArray,
    measured: tuple[FloatArray, ComplexArray] | None,
    facts: str,
) -> Chart:
    panels = []
    for scale, of in (
        (Scale(label=label, spacing="log"), np.abs),
        (Scale(label="phase [°]"), lambda values: np.degrees(np.unwrap(np.angle(values)))),
    ):
        elements: list[Element] = []
        if measured is not None:
            elements.append(
                Points(
                    x=measured[0],
                    y=_near(of(measured[1]), measured[0], of(model), frequency, scale),
                    label="measured",
                    role="measured",
                )
            )
        elements.append(Line(x=frequency, y=of(model), label="fit", role="model"))
        panels.append(Panel(x=Scale(label="frequency [Hz]", spacing="log"), y=scale, elements=tuple(elements)))
    seen = (
        "no measured response"
        if measured is None
        else (f"measured from {measured[0][0]:.2g} to {measured[0][-1]:.3g} Hz, where free motion excites it")
    )
    return Chart(
        key=key,
        title=title,
        alternative=f"{title}: magnitude and phase of the fit, {seen}.{facts}",
        panels=tuple(panels),
        linked=True,
        caption=facts.strip(),
    )


def _near(values: FloatArray, at: FloatArray, model: FloatArray, frequency: FloatArray, scale: Scale) -> FloatArray:
    """Return phases on the model's turn; magnitudes as they are."""
    if scale.spacing == "log":
        return values
    turns = np.round((np.interp(at, frequency, model) - values) / 360.0)
    return values + 360.0 * turns


def contact_chart(
    axis: str, units: AxisUnits, surface: str, index: int, told: AxisEvidence, period_s: float
) -> Chart | None:
    """Draw the contacts of one surface, measured against the model: the strongest, from the touch on."""
    spans = [span for span in told.spans if span.surface == index]
    if not spans:
        return None
    strongest = sorted(spans, key=lambda span: -float(np.max(np.abs(span.measured))))[:_MOST_CONTACTS]
    worst = [_peak_error(span) for span in spans]
    panels = []
    for span in strongest:
        place = int(np.argmax(np.abs(span.measured)))
        begin = max(0, place - round((_BEFORE_S + 0.15) / period_s))
        stop = min(len(span.measured), place + round(_AFTER_S / period_s))
        time = 1e3 * period_s * (np.arange(begin, stop) - place)
        panels.append(
            Panel(
                title=f"at {period_s * (span.start + place):.1f} s",
                x=Scale(label="time from the peak [ms]"),
                y=Scale(label=f"{units.force_name} [{units.force}]"),
                elements=(
                    Line(x=time, y=span.measured[begin:stop], label="measured", wide=True),
                    Line(x=time, y=span.predicted[begin:stop], label="model", role="model"),
                ),
            )
        )
    share = 100.0 * float(np.max(np.abs(worst)))
    return Chart(
        key=f"{axis}-{surface}-contacts",
        title=f"Contacts with {surface}, measured and modelled",
        alternative=f"{len(spans)} contacts with {surface}; the model's peak is within {share:.1f} % of the measured.",
        caption=f"The strongest {len(strongest)} of {len(spans)} contacts. In all of them the peak of the model is "
        f"within {share:.1f} % of the measured one.",
        panels=level_panels(panels),
        beside=True,
    )


def _peak_error(span: FittedSpan) -> float:
    measured = float(np.max(np.abs(span.measured)))
    return float(np.max(np.abs(span.predicted))) / measured - 1.0


def correlation_chart(axis: str, covariance: Covariance) -> Chart:
    """Draw how the errors of the parameters go together."""
    matrix = np.array(covariance.matrix)
    std = np.sqrt(np.diag(matrix))
    correlation = matrix / np.outer(std, std)
    off = correlation - np.eye(len(std))
    i, j = np.unravel_index(int(np.argmax(np.abs(off))), off.shape)
    places = np.arange(len(std), dtype=np.float64)
    names = covariance.names
    return Chart(
        key=f"{axis}-correlation",
        title="How the errors go together",
        alternative=f"Correlation of the errors of {len(names)} parameters; the largest is {off[i, j]:+.2f}, between "
        f"{names[i]} and {names[j]}.",
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


def noise_chart(noise: NoiseSpectrum) -> Chart:
    """Draw the sensor's noise at rest."""
    return Chart(
        key="noise",
        title="Noise of the sensor at rest",
        alternative=f"Power density of the force's noise from {noise.frequency_hz[0]:.2g} to "
        f"{noise.frequency_hz[-1]:.3g} Hz, the mean of three axes.",
        panels=(
            Panel(
                x=Scale(label="frequency [Hz]", spacing="log"),
                y=Scale(label="force [N²/Hz]", spacing="log"),
                elements=(Line(x=np.array(noise.frequency_hz), y=np.array(noise.force_n2_per_hz), role="measured"),),
            ),
        ),
    )
