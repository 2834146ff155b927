"""Frequency responses of one axis from sweeps and taps, without a model: best linear approximations and their regions.

The local polynomial method (Pintelon and Schoukens 2012, *System Identification: A Frequency Domain Approach*, chapter
7): about every frequency the response and the transient of a record are polynomials of second degree over a few bins,

    Y(k + r) = (G + g₁ r + g₂ r²) U(k + r) + t₀ + t₁ r + t₂ r² + V(k + r),

which leaves no leakage to speak of and shows the noise V in what it cannot explain. It is assumed that the command is
known exactly, that V has one power over a window, and that neither response nor transient bends by more than the
polynomial over it. One sweep cannot separate a distortion from noise: of a sine that goes through all frequencies the
harmonics come at other times than the sine of the same frequency, so that they scatter from bin to bin and count as V.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from problems.arrays import ComplexArray, FloatArray

from ..measured_response import FrequencyResponse, MeasuredResponse, measured_response

_PER_DECADE, _LOWEST_DECADES, _POINTS = 18, -1.0, 60
GRID_HZ = 10.0 ** (_LOWEST_DECADES + np.arange(_POINTS) / _PER_DECADE)
"""Frequencies (60,) that every log is asked at, so that several logs can be joined point by point."""
_DEGREE = 2
_PARAMETERS = 2 * (_DEGREE + 1)
_HALF_BINS, _HALF_SHARE = 7, 0.02
_FEWEST_BINS = _PARAMETERS + 2
_SHORTEST_S = 2.0
_NEIGHBOURS = 2
_OUTSIDE = 0.05
# A value whose circle reaches half way to zero says neither gain nor phase.
_LARGEST_RADIUS = 0.5
# What polynomials leave of a response that bends, and interpolated samples of theirs; no circle claims more.
_SMALLEST_RADIUS = 1e-3


@dataclass(frozen=True, kw_only=True)
class MotionRecord:
    """One stretch of free motion of an axis: `position`, `force` (n,) and, where it is known, the held `command`."""

    position: FloatArray
    force: FloatArray
    command: FloatArray | None


@dataclass(frozen=True, kw_only=True)
class _Local:
    """What one frequency shows: `value` (m,) of m outputs, covariance (m, m) of it by noise and between the records."""

    value: ComplexArray
    noise: ComplexArray
    between: ComplexArray
    freedom: int
    records: int


def measure_responses(records: Sequence[MotionRecord], period_s: float, highest_hz: float) -> FrequencyResponse | None:
    """Return the frequency responses that records of free motion show, None where they show none.

    Parameters
    ----------
    records
        Stretches of free motion, on a clock of `period_s` [s]; shorter than 2 s they are passed over. With a command
        in all of them it is the reference of pose and force, whose noises then bias nothing (Pintelon and Schoukens
        2012, section 7.2.7, the indirect method); without, the pose is the input of the force.
    period_s
        Period of the samples [s].
    highest_hz
        Highest frequency at which the samples mean something [Hz].

    Returns
    -------
    FrequencyResponse
        At the frequencies of `GRID_HZ` that the motion excites: those whose 95 % circle is smaller than half of the
        value.
    """
    long = [record for record in records if len(record.position) * period_s >= _SHORTEST_S]
    if not long:
        return None
    with_command = all(record.command is not None for record in long)
    spectra = [_spectra(record, with_command=with_command) for record in long]
    lengths_s = [period_s * (len(record.position) - 1) for record in long]
    lowest = (_HALF_BINS + 1) / max(lengths_s)
    grid = GRID_HZ[(lowest <= GRID_HZ) & (highest_hz >= GRID_HZ)]
    found = [(f, at) for f in grid.tolist() if (at := _at(f, spectra, lengths_s)) is not None]
    if not found:
        return None
    frequency, points = np.array([f for f, _ in found]), [at for _, at in found]
    hold = _hold(frequency, period_s)
    if not with_command:
        return FrequencyResponse(pose_to_force=_described(frequency, points, np.array([1.0 + 0j])))
    ratio = [np.array([-at.value[1] / at.value[0], 1.0]) / at.value[0] for at in points]
    return FrequencyResponse(
        command_to_pose=_described(frequency, points, np.array([1.0, 0.0]), 1.0 / hold),
        command_to_force=_described(frequency, points, np.array([0.0, 1.0]), 1.0 / hold),
        pose_to_force=_described(
            frequency, points, np.array(ratio), values=[at.value[1] / at.value[0] for at in points]
        ),
    )


def _hold(frequency_hz: FloatArray, period_s: float) -> ComplexArray:
    """Return what holding a sample for one period makes of it, (1 − e^(−h s))/(h s)."""
    s = 2j * np.pi * frequency_hz * period_s
    return np.asarray(-np.expm1(-s) / s)


def _spectra(record: MotionRecord, *, with_command: bool) -> tuple[ComplexArray, ComplexArray]:
    """Return input (k,) and outputs (k, m) of a record by bins.

    Of the steps from sample to sample: they are as large at high frequencies as at low ones, and the same filter before
    input and output leaves the response what it is.
    """
    outputs = [record.position, record.force] if with_command else [record.force]
    given = record.command if with_command and record.command is not None else record.position
    n = len(given) - 1
    transformed = [np.fft.rfft(np.diff(each)) / np.sqrt(n) for each in (given, *outputs)]
    return transformed[0], np.stack(transformed[1:], axis=1)


def _at(
    frequency_hz: float, spectra: Sequence[tuple[ComplexArray, ComplexArray]], lengths_s: Sequence[float]
) -> _Local | None:
    """Return the local polynomial estimate at one frequency from all records that have enough bins about it.

    Records count by the information that their excitation gives; the noise is pooled over them.
    """
    half_hz = max(_HALF_BINS / max(lengths_s), _HALF_SHARE * frequency_hz)
    values, weights, squares, freedom = [], [], [], 0
    for (given, answer), length_s in zip(spectra, lengths_s, strict=True):
        first = max(1, int(np.ceil((frequency_hz - half_hz) * length_s - 1e-9)))
        last = min(len(given) - 1, int(np.floor((frequency_hz + half_hz) * length_s + 1e-9)))
        if last - first + 1 < _FEWEST_BINS:
            continue
        bins = slice(first, last + 1)
        powers = ((np.arange(first, last + 1) / length_s - frequency_hz) / half_hz)[:, None] ** np.arange(_DEGREE + 1)
        size = float(np.max(np.abs(given[bins])))
        if size == 0.0:
            continue
        matrix = np.concatenate([powers * (given[bins, None] / size), powers.astype(complex)], axis=1)
        orthogonal, upper = np.linalg.qr(matrix)
        if np.min(np.abs(np.diag(upper))) < 1e-9 * np.max(np.abs(np.diag(upper))):
            continue
        inverse = np.linalg.inv(upper)
        left = answer[bins] - orthogonal @ (orthogonal.conj().T @ answer[bins])
        values.append((inverse @ (orthogonal.conj().T @ answer[bins]))[0] / size)
        weights.append(size**2 / float(np.sum(np.abs(inverse[0]) ** 2)))
        squares.append(left.conj().T @ left)
        freedom += last - first + 1 - _PARAMETERS
    if not values:
        return None
    shares, all_of_them = np.array(weights), np.array(values)
    total = float(np.sum(shares))
    mean = shares @ all_of_them / total
    apart = all_of_them - mean
    between = np.zeros_like(squares[0])
    if len(values) > 1:
        between = (apart * shares[:, None]).conj().T @ apart / (len(values) - 1) / total
    noise = np.sum(squares, axis=0) / freedom / total
    return _Local(value=mean, noise=noise, between=between, freedom=freedom, records=len(values))


def _described(
    frequency_hz: FloatArray,
    points: Sequence[_Local],
    directions: ComplexArray,
    factor: ComplexArray | None = None,
    values: Sequence[complex] | None = None,
) -> MeasuredResponse | None:
    """Return a combination of the outputs, `directions` (m,) or (k, m), with its circles; None where none is sharp.

    The circle of a complex value whose variance was estimated with ν degrees of freedom: |Ĝ − G|²/σ² is distributed as
    F(2, 2ν), whose 95 % quantile is ν (0.05^(−1/ν) − 1).
    """
    rows = np.broadcast_to(directions, (len(points), directions.shape[-1]))
    scale = np.ones(len(points), dtype=complex) if factor is None else factor
    value = np.array([row @ at.value for row, at in zip(rows, points, strict=True)]) if values is None else values
    # A row v takes errors e to Σ v e, whose variance is v* S vᵀ with S the mean of eᴴ e.
    noise, between = (
        np.array([float((row.conj() @ matrix @ row).real) for row, matrix in zip(rows, matrices, strict=True)])
        for matrices in ([at.noise for at in points], [at.between for at in points])
    )
    several = np.array([at.records > 1 for at in points])
    excess = np.where(several, between / np.maximum(noise, 1e-300), 1.0)
    # One frequency alone has too few records to say what they differ by.
    wide = np.ones(2 * _NEIGHBOURS + 1)
    smooth = np.convolve(excess, wide, "same") / np.convolve(np.ones(len(points)), wide, "same")
    freedom = np.array([float(at.freedom) for at in points])
    quantile = freedom * (_OUTSIDE ** (-1.0 / freedom) - 1.0)
    alone = np.sqrt(noise * quantile) * np.abs(scale)
    response = np.asarray(value) * scale
    alone = np.hypot(alone, _SMALLEST_RADIUS * np.abs(response))
    radius = alone * np.sqrt(np.where(several, np.maximum(smooth, 1.0), 1.0))
    sharp = radius < _LARGEST_RADIUS * np.abs(response)
    if not np.any(sharp):
        return None
    records = max(at.records for at, kept in zip(points, sharp, strict=True) if kept)
    return measured_response(frequency_hz[sharp], response[sharp], radius[sharp], alone[sharp], records)
