"""Noise of the sensor per axis: size, spectrum, resolution, and a deadband applied before recording."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from scipy.ndimage import median_filter

from problems.arrays import FloatArray

from ..result import Estimate, Finding, NoiseSpectrum, Status
from .aligned import AlignedLog
from .constant_runs import FoundDeadband, find_deadband
from .recording import AXES, WrenchSignal
from .segments import Span

_TRIM_S = 0.12
_SHAKING = 0.15
_LONGEST_SEGMENT = 4096
_SHORTEST_SEGMENT = 64
_LINE_FACTOR = 30.0
_NEIGHBOURS = 31
_MOST_LINES = 5
_COARSE = 2.0
_LATTICE_SHARE = 0.95
_LATTICE_TOLERANCE = 0.1
_FEWEST_LEVELS = 200
_FINEST_SHARE = 1e-4
_CANDIDATES = 8
_BANDS = 24


@dataclass(frozen=True, kw_only=True)
class SpectralLine:
    """A narrow peak of the noise: its frequency and rms (6,) in N and N·m."""

    frequency_hz: float
    rms: FloatArray


@dataclass(frozen=True, kw_only=True)
class SensorNoise:
    """Noise of Fx, Fy, Fz [N] and Tx, Ty, Tz [N·m] at rest, arrays of 6 columns in that order.

    `frequency_hz` (k,), `density` (k, 6) one-sided [N²/Hz, (N·m)²/Hz]; `rms` (6,) and its deviation `rms_std` (6,),
    linear drift of a rest taken out; `bandwidth_hz` (6,) that of white noise of the same rms and mean low-frequency
    density; `resolution` per axis, None where no quantisation shows above the stored numbers; `deadband` per axis, None
    where there is none; `rest_s` of rests were used. `lines` are narrow peaks, the strongest first.
    """

    frequency_hz: FloatArray
    density: FloatArray
    rms: FloatArray
    rms_std: FloatArray
    bandwidth_hz: FloatArray
    resolution: tuple[float | None, ...]
    deadband: tuple[FoundDeadband | None, ...]
    lines: tuple[SpectralLine, ...]
    rest_s: float
    findings: tuple[Finding, ...]

    def force_rms(self) -> Estimate:
        """Return the root mean square of the three forces' noise [N]."""
        value = float(np.sqrt(np.mean(self.rms[:3] ** 2)))
        std = float(np.sqrt(np.sum((self.rms[:3] * self.rms_std[:3]) ** 2)) / (3.0 * max(value, 1e-30)))
        return Estimate(value=value, std=std, status=Status.IDENTIFIED, method="spread within rests, drift taken out")

    def spectrum(self) -> NoiseSpectrum:
        """Return the spectrum in bands of equal ratio, power kept, and the resolution."""
        first = max(int(np.argmax(self.frequency_hz > 0.0)), 1)
        edges = np.geomspace(self.frequency_hz[first], self.frequency_hz[-1] * (1.0 + 1e-9), _BANDS + 1)
        band = np.digitize(self.frequency_hz, edges)
        shown = [band == i for i in range(1, _BANDS + 1) if np.any(band == i)]
        force, torque = np.mean(self.density[:, :3], axis=1), np.mean(self.density[:, 3:], axis=1)
        return NoiseSpectrum(
            frequency_hz=tuple(float(np.mean(self.frequency_hz[inside])) for inside in shown),
            force_n2_per_hz=tuple(float(np.mean(force[inside])) for inside in shown),
            torque_n2_m2_per_hz=tuple(float(np.mean(torque[inside])) for inside in shown) if np.any(torque) else (),
            resolution=self.resolution,
        )


def identify_sensor_noise(log: AlignedLog, still: Sequence[Span], wrench: WrenchSignal) -> SensorNoise | None:
    """Describe the noise by Welch's method over the rests; None where no rest is long enough.

    Resolution and deadband are read from `wrench` as it was logged: interpolation would blur both.
    """
    trim = round(_TRIM_S / log.period_s)
    rests = [slice(r.start + trim, r.stop - trim) for r in still if len(r) > 2 * trim + _SHORTEST_SEGMENT]
    if not rests:
        return None
    torque = log.torque_S_n_m if log.has_torque else np.zeros_like(log.force_S_n)
    held = (np.hstack([log.force_S_n[rest], torque[rest]]) for rest in rests)
    pieces = _quiet([np.asarray(scipy.signal.detrend(each, axis=0)) for each in held])
    frequency, density, segments = _spectrum(pieces, 1.0 / log.period_s)
    samples = np.array([len(piece) for piece in pieces], dtype=np.float64)
    # Detrending takes two degrees of freedom of each rest.
    variance = np.sum([np.sum(piece**2, axis=0) for piece in pieces], axis=0) / np.sum(samples - 2.0)
    rms = np.sqrt(variance)
    low = np.mean(density[1 : max(3, len(density) // 20)], axis=0)
    # Neighbouring samples of coloured noise repeat each other: white is what has ∫ S² = (∫ S)² / bandwidth.
    step = float(frequency[1] - frequency[0])
    breadth = (np.sum(density, axis=0) * step) ** 2 / np.maximum(np.sum(density**2, axis=0) * step, 1e-300)
    independent = np.maximum(2.0 * breadth * float(np.sum(samples)) * log.period_s, 2.0)
    # Rests that differ by more than chance, with a payload that still swings a little, say how far the rms is to trust.
    between = np.std([np.std(piece, axis=0) for piece in pieces], axis=0) / np.sqrt(max(len(pieces) - 1, 1))
    columns = (*wrench.force_n.T, *wrench.torque_n_m.T)
    lines = _lines(frequency, density, segments)
    resolution = tuple(map(find_resolution, columns))
    deadband = tuple(map(find_deadband, columns))
    return SensorNoise(
        frequency_hz=frequency,
        density=density,
        rms=rms,
        rms_std=np.hypot(rms / np.sqrt(2.0 * independent), between),
        bandwidth_hz=np.asarray(np.where(low > 0.0, variance / np.maximum(low, 1e-300), 0.0)),
        resolution=resolution,
        deadband=deadband,
        lines=lines,
        rest_s=float(np.sum(samples)) * log.period_s,
        findings=(*_line_findings(lines, rms), *_coarse(resolution, rms), *_deadbands(deadband)),
    )


def _quiet(pieces: list[FloatArray]) -> list[FloatArray]:
    """Keep the rests that shake no more than the quieter ones: a payload that swings is not the sensor's noise."""
    variance = np.array([np.var(piece, axis=0) for piece in pieces])
    least = np.maximum(np.quantile(variance, 0.25, axis=0), 1e-300)
    chance = np.sqrt(2.0 / np.array([len(piece) for piece in pieces]))
    quiet = np.max(variance / least, axis=1) < 1.0 + np.maximum(_SHAKING, 4.0 * chance)
    return [piece for piece, keep in zip(pieces, quiet, strict=True) if keep] if np.any(quiet) else pieces


def _spectrum(pieces: Sequence[FloatArray], rate_hz: float) -> tuple[FloatArray, FloatArray, int]:
    """Average the spectra of the rests that hold a segment, weighted by length; also return how many segments."""
    longest = max(len(piece) for piece in pieces)
    # Rests of one second each: a segment that most of them hold keeps all of them.
    length = int(min(_LONGEST_SEGMENT, longest, max(_SHORTEST_SEGMENT, np.median([len(piece) for piece in pieces]))))
    held = [piece for piece in pieces if len(piece) >= length]
    total, weight, frequency = np.zeros((length // 2 + 1, 6)), 0, np.zeros(length // 2 + 1)
    for piece in held:
        frequency, power = scipy.signal.welch(piece, fs=rate_hz, nperseg=length, detrend="linear", axis=0)
        count = 1 + 2 * (len(piece) - length) // length
        total, weight = total + count * power, weight + count
    return frequency, total / weight, weight


def _lines(frequency: FloatArray, density: FloatArray, segments: int) -> tuple[SpectralLine, ...]:
    """Find bins that stand out of their neighbours' median by far more than averaged noise can."""
    if len(frequency) < 2 * _NEIGHBOURS:
        return ()
    floor = median_filter(density, size=(_NEIGHBOURS, 1))
    # A bin averaged over n segments reaches 30 times its mean in n = 1 with a chance of 1e-13.
    prominence = np.max(density / np.maximum(floor, 1e-300), axis=1) * min(1.0, np.sqrt(segments / 4.0))
    peaks = [
        i
        for i in range(2, len(frequency) - 2)
        if prominence[i] > _LINE_FACTOR and prominence[i] == np.max(prominence[i - 2 : i + 3])
    ]
    step = float(frequency[1] - frequency[0])
    strongest = sorted(peaks, key=lambda i: -float(prominence[i]))[:_MOST_LINES]
    found = []
    for i in strongest:
        around = slice(i - 2, i + 3)
        power = np.sum(np.maximum(density[around] - floor[around], 0.0), axis=0) * step
        found.append(SpectralLine(frequency_hz=float(frequency[i]), rms=np.sqrt(power)))
    return tuple(found)


def find_resolution(values: FloatArray) -> float | None:
    """Return the quantisation step of one axis (n,), None where the differences are no multiples of one.

    A step finer than 1e-4 of the spread of neighbouring differences is that of the number format, not of the sensor.
    """
    difference = np.abs(np.diff(values[np.isfinite(values)]))
    steps = difference[difference > 0.0]
    if len(steps) < _FEWEST_LEVELS:
        return None
    spread = float(np.median(steps))
    smallest = float(np.max(np.abs(values[np.isfinite(values)]))) * 2.0**-22
    near = np.sort(steps[steps > max(smallest, _FINEST_SHARE * spread)])[:_CANDIDATES]
    for candidate in near:
        multiples = steps / candidate
        rounded = np.round(multiples)
        close = np.abs(multiples - rounded) < _LATTICE_TOLERANCE
        # Beyond some multiples the candidate's own rounding decides, not the lattice.
        sharp = rounded < 0.5 * _LATTICE_TOLERANCE * candidate / max(smallest, 1e-300)
        if np.count_nonzero(sharp) >= _FEWEST_LEVELS and float(np.mean(close[sharp])) > _LATTICE_SHARE:
            return float(np.median(steps[sharp & close & (rounded == 1.0)])) if np.any(rounded == 1.0) else None
    return None


def _line_findings(lines: tuple[SpectralLine, ...], rms: FloatArray) -> tuple[Finding, ...]:
    found = []
    for line in lines:
        share = line.rms**2 / np.maximum(rms**2, 1e-300)
        axis = int(np.argmax(share))
        if share[axis] > 0.1:
            unit = "N" if axis < 3 else "N·m"
            found.append(
                Finding(
                    code="noise-line",
                    severity="info",
                    message=f"The noise of axis {AXES[axis]} has a line at {line.frequency_hz:.1f} Hz of "
                    f"{line.rms[axis]:.3g} {unit} rms, {100.0 * share[axis]:.0f} % of its power.",
                    advice="Look for the mains (50 or 60 Hz), a motor or a resonance; shield or filter it.",
                )
            )
    return tuple(found)


def _coarse(resolution: tuple[float | None, ...], rms: FloatArray) -> tuple[Finding, ...]:
    coarse = [
        f"{AXES[i]} {step:.3g}" for i, step in enumerate(resolution) if step is not None and step > _COARSE * rms[i]
    ]
    if not coarse:
        return ()
    return (
        Finding(
            code="coarse-sensor",
            severity="warning",
            message=f"The sensor's steps are larger than its noise: {', '.join(coarse)} (N, N·m); rests do not average "
            "below a step.",
            advice="Record the wrench with more digits, or choose a smaller range of the sensor.",
        ),
    )


def _deadbands(deadband: tuple[FoundDeadband | None, ...]) -> tuple[Finding, ...]:
    shown = [
        f"{AXES[i]} {band.kind}, {'width unknown' if band.width is None else f'{band.width:.3g}'}, "
        f"{100.0 * band.zero_share:.0f} % of the time"
        for i, band in enumerate(deadband)
        if band is not None
    ]
    if not shown:
        return ()
    return (
        Finding(
            code="deadband-applied",
            severity="error",
            message=f"A deadband was applied before recording ({'; '.join(shown)}); forces below it are lost.",
            advice="Record the wrench before the deadband.",
        ),
    )
