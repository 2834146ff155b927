"""Sensor noise: white, coloured and quantised signals of known size."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, detrend, sosfilt
from scipy.spatial.transform import Rotation

from identification.result import Status
from identification.signals.aligned import AlignedLog
from identification.signals.recording import WrenchSignal
from identification.signals.segments import Span
from identification.signals.sensor_noise import (
    SensorNoise,
    SpectralLine,
    _line_findings,
    _lines,
    _quiet,
    _spectrum,
    find_resolution,
    identify_sensor_noise,
)
from problems.arrays import FloatArray

RATE_HZ = 1000.0
REST = 2000
RMS = np.array([0.2, 0.15, 0.3, 0.01, 0.02, 0.015])


def log_of(signal: FloatArray) -> tuple[AlignedLog, WrenchSignal]:
    log = AlignedLog(
        start_ns=0,
        period_s=1.0 / RATE_HZ,
        time_s=np.asarray(np.arange(len(signal)) / RATE_HZ),
        force_S_n=signal[:, :3],
        torque_S_n_m=signal[:, 3:],
        position_B_m=np.zeros((len(signal), 3)),
        orientation_BS=Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (len(signal), 1))),
        pose_rate_hz=RATE_HZ,
    )
    wrench = WrenchSignal(
        topic="/ft",
        frame_id="ft",
        stamp_ns=np.arange(len(signal), dtype=np.int64) * 1_000_000,
        force_n=signal[:, :3],
        torque_n_m=signal[:, 3:],
    )
    return log, wrench


def described(signal: FloatArray, *, count: int = 10) -> SensorNoise:
    """Rests of 2 s, one beside the other."""
    assert len(signal) == count * REST
    log, wrench = log_of(signal)
    found = identify_sensor_noise(log, [Span(start=REST * i, stop=REST * (i + 1)) for i in range(count)], wrench)
    assert found is not None
    return found


def white(seed: int, count: int = 10) -> FloatArray:
    return RMS * np.random.default_rng(seed).standard_normal((count * REST, 6)) + 5.0


def test_white_noise_has_its_rms_and_a_flat_density() -> None:
    found = described(white(0))
    # 17600 samples: 0.5 %; four deviations, over six axes.
    np.testing.assert_allclose(found.rms, RMS, rtol=0.025)
    # The density of white noise is 2 σ² / rate; averaged over all bins it is known like the rms.
    inner = found.density[2:-2].mean(axis=0)
    np.testing.assert_allclose(inner, 2.0 * RMS**2 / RATE_HZ, rtol=0.06)
    np.testing.assert_allclose(found.bandwidth_hz, 0.5 * RATE_HZ, rtol=0.5)  # from 5 % of the bins of ten rests
    assert found.lines == ()
    assert found.resolution == (None,) * 6
    assert found.deadband == (None,) * 6
    assert found.findings == ()
    assert found.rest_s == pytest.approx(10 * (2.0 - 0.24))


def test_the_spectrum_integrates_to_the_variance() -> None:
    found = described(white(1))
    step = found.frequency_hz[1] - found.frequency_hz[0]
    # Parseval, but for the window that weighs the samples of a rest unlike each other: 1 % over ten rests, and 4 of it.
    np.testing.assert_allclose(np.sum(found.density, axis=0) * step, found.rms**2, rtol=0.06)


@pytest.mark.parametrize("corner_hz", [20.0, 100.0, None])
def test_the_stated_deviation_is_that_of_repetition(corner_hz: float | None) -> None:
    scores, rng = [], np.random.default_rng(5)
    for _ in range(25):
        noise = rng.standard_normal((10 * REST + 500, 6))
        if corner_hz is not None:
            noise = sosfilt(butter(1, corner_hz, fs=RATE_HZ, output="sos"), noise, axis=0)
            gain = np.pi * corner_hz / RATE_HZ  # the variance of a first-order filter, up to warping
            noise = noise / np.sqrt(gain)
        found = described(noise[500:])
        scores.append((found.rms - found.rms.mean()) / found.rms_std)
    # 150 numbers: a spread known to 6 %; the six axes' common mean takes 9 % away. Rests that happen to
    # differ widen the stated one.
    assert 0.55 < float(np.std(scores)) < 1.25


def test_a_line_is_reported_with_its_frequency_and_size() -> None:
    signal = white(2)
    signal[:, 1] += 0.2 * np.sqrt(2.0) * np.sin(2.0 * np.pi * 50.0 * np.arange(len(signal)) / RATE_HZ)
    found = described(signal)
    (line,) = found.lines
    assert line.frequency_hz == pytest.approx(50.0, abs=1.0)
    assert line.rms[1] == pytest.approx(0.2, rel=0.1)  # the window's skirts beyond two bins are left out
    (reported,) = found.findings
    assert reported.code == "noise-line"
    assert "axis y" in reported.message


def test_a_payload_that_swings_is_not_the_sensors_noise() -> None:
    signal = white(3)
    time = np.arange(REST) / RATE_HZ
    signal[3 * REST : 4 * REST, 0] += 2.0 * np.exp(-time) * np.sin(2.0 * np.pi * 12.0 * time)
    found = described(signal)
    assert found.rms[0] == pytest.approx(RMS[0], rel=0.025)
    assert found.rest_s == pytest.approx(9 * (2.0 - 0.24))
    assert found.force_rms().value == pytest.approx(float(np.sqrt(np.mean(RMS[:3] ** 2))), rel=0.02)
    assert found.force_rms().status is Status.IDENTIFIED


@settings(max_examples=40, deadline=None)
@given(
    step=st.floats(1e-3, 2.0),
    noise=st.floats(0.05, 3.0),
    offset=st.floats(-300.0, 300.0),
)
def test_a_quantisation_step_is_found_and_none_invented(step: float, noise: float, offset: float) -> None:
    rng = np.random.default_rng(1)
    smooth = offset + noise * rng.standard_normal(8000)
    assert find_resolution(smooth) is None
    found = find_resolution(step * np.round(smooth / step))
    if found is None:
        # Too many steps within the noise: none of them stands beside a neighbour often enough, or none ever changes.
        assert step < 2e-3 * noise or step > 3.0 * noise
    else:
        assert found == pytest.approx(step, rel=1e-6)


def test_single_precision_is_no_resolution_of_the_sensor() -> None:
    values = (400.0 + 0.2 * np.random.default_rng(4).standard_normal(20000)).astype(np.float32).astype(np.float64)
    assert find_resolution(values) is None


def test_steps_larger_than_the_noise_are_warned_of() -> None:
    signal = white(6) + np.linspace(0.0, 20.0, 10 * REST)[:, None]
    signal[:, 2] = 1.5 * np.round(signal[:, 2] / 1.5)
    found = described(signal)
    assert found.resolution[2] == pytest.approx(1.5)
    assert "coarse-sensor" in {finding.code for finding in found.findings}


def test_a_deadband_is_reported_with_kind_and_width() -> None:
    time = np.arange(10 * REST) / RATE_HZ
    signal = white(7)
    pressed = 12.0 * np.sin(2.0 * np.pi * 0.31 * time) + 0.05 * np.random.default_rng(9).standard_normal(len(time))
    signal[:, 0] = np.where(np.abs(pressed) > 5.0, pressed, 0.0)
    found = described(signal)
    band = found.deadband[0]
    assert band is not None
    assert band.kind == "threshold"
    assert band.width == pytest.approx(5.0, abs=0.1)
    (reported,) = (finding for finding in found.findings if finding.code == "deadband-applied")
    assert reported.severity == "error"
    assert "x threshold, 5" in reported.message


def test_without_rest_nothing_is_said() -> None:
    log, wrench = log_of(white(8))
    assert identify_sensor_noise(log, [Span(start=0, stop=250)], wrench) is None


def test_the_spectrum_that_is_reported_keeps_the_power() -> None:
    """White noise: every band has 2 σ²/rate, mean of the axes; coloured noise falls where the filter does."""
    reported = described(white(4)).spectrum()
    np.testing.assert_allclose(reported.force_n2_per_hz, 2.0 * np.mean(RMS[:3] ** 2) / RATE_HZ, rtol=0.4)
    wide = [i for i, f in enumerate(reported.frequency_hz) if f > 20.0]
    force, torque = np.array(reported.force_n2_per_hz)[wide], np.array(reported.torque_n2_m2_per_hz)[wide]
    np.testing.assert_allclose(force, 2.0 * np.mean(RMS[:3] ** 2) / RATE_HZ, rtol=0.2)
    np.testing.assert_allclose(torque, 2.0 * np.mean(RMS[3:] ** 2) / RATE_HZ, rtol=0.2)
    assert list(reported.frequency_hz) == sorted(reported.frequency_hz)
    assert reported.frequency_hz[-1] < 0.5 * RATE_HZ
    assert reported.resolution == (None,) * 6
    sections = butter(2, 50.0, fs=RATE_HZ, output="sos")
    dull = described(np.asarray(sosfilt(sections, white(5) - 5.0, axis=0))).spectrum()
    assert dull.force_n2_per_hz[-1] < 1e-2 * max(dull.force_n2_per_hz)
    stepped = described(np.round(white(6) / 0.05) * 0.05).spectrum()
    assert stepped.resolution[0] == pytest.approx(0.05, rel=1e-6)


@pytest.mark.parametrize(
    ("lengths", "length"), [((10000, 4500), 4096), ((1000, 1300, 900), 1000), ((50, 60, 64), 64), ((40, 50, 45), 50)]
)
def test_the_density_is_the_mean_of_segments_that_overlap_by_half(lengths: tuple[int, ...], length: int) -> None:
    """Of no more than 4096 samples, of no fewer than 64 where a rest is that long, and of what most rests hold."""
    rng = np.random.default_rng(11)
    pieces = [rng.standard_normal((count, 6)) + np.linspace(0.0, 3.0, count)[:, None] for count in lengths]
    frequency, density, segments = _spectrum(pieces, RATE_HZ)
    assert frequency[1] == pytest.approx(RATE_HZ / length)
    window = np.sin(np.pi * np.arange(length) / length) ** 2
    periodograms = []
    for piece in pieces:
        for begin in range(0, len(piece) - length + 1, length // 2):
            values = detrend(piece[begin : begin + length], axis=0)
            power = np.abs(np.fft.rfft(window[:, None] * values, axis=0)) ** 2 / (RATE_HZ * np.sum(window**2))
            power[1 : (length + 1) // 2] *= 2.0
            periodograms.append(power)
    assert segments == len(periodograms)
    # Rounding, at no frequency of what the detrending left none of.
    np.testing.assert_allclose(density, np.mean(periodograms, axis=0), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(("samples", "more"), [(20000, 0.15), (512, 0.25), (128, 0.5)])
def test_a_rest_may_shake_more_by_15_percent_or_four_deviations_of_chance(samples: int, more: float) -> None:
    """Of the variance of n samples the deviation is √(2/n) of it."""
    shape = np.random.default_rng(12).standard_normal((samples, 6))
    quiet, loud = (np.sqrt(1.0 + share * more) * shape for share in (0.98, 1.02))
    assert [each is not loud for each in _quiet([shape, shape, shape, quiet])] == [True] * 4
    assert len(_quiet([shape, shape, shape, loud])) == 3
    # Where each shakes on an axis of its own, none is quieter than the others.
    apart = [np.where(np.arange(6) == axis, 3.0, 1.0) * shape for axis in (0, 1)]
    assert len(_quiet(apart)) == 2


def test_lines_are_five_at_most_the_strongest_first_and_have_the_power_above_their_neighbours() -> None:
    frequency = 0.5 * np.arange(1000, dtype=np.float64)
    density = np.full((1000, 6), 2e-3)
    for i, size in zip((100, 200, 300, 400, 500, 600, 700), (0.3, 0.9, 0.5, 0.058, 0.7, 0.4, 0.8), strict=True):
        density[i - 1 : i + 2, 2] += size * np.array([0.5, 1.0, 0.5])
    lines = _lines(frequency, density, 8)
    assert [line.frequency_hz for line in lines] == [100.0, 350.0, 250.0, 150.0, 300.0]
    assert lines[0].rms == pytest.approx([0.0, 0.0, np.sqrt(0.9 * 2.0 * 0.5), 0.0, 0.0, 0.0])
    # 30 times the neighbours, of four segments and more; with one alone chance reaches twice as far.
    for height, segments, count in ((29.0, 4, 0), (31.0, 4, 1), (59.0, 1, 0), (61.0, 1, 1), (61.0, 99, 1)):
        alone = np.full((1000, 6), 2e-3)
        alone[321, 4] *= height
        assert len(_lines(frequency, alone, segments)) == count
    # Fewer bins than twice the neighbours say no median.
    assert _lines(frequency[:61], density[80:141], 8) == ()
    assert len(_lines(frequency[:62], density[80:142], 8)) == 1


def test_the_deviation_of_the_mean_of_three_forces() -> None:
    three = replace(described(white(13)), rms=np.array([2.0, 2.0, 2.0, 9.0, 9.0, 9.0]), rms_std=np.full(6, 0.3))
    assert three.force_rms().value == pytest.approx(2.0)
    # Three that are as well known each.
    assert three.force_rms().std == pytest.approx(0.3 / np.sqrt(3.0))
    one = replace(three, rms=np.array([5.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
    assert one.force_rms().value == pytest.approx(5.0 / np.sqrt(3.0))
    assert one.force_rms().std == pytest.approx(0.3 / np.sqrt(3.0))


def test_a_rest_counts_from_64_samples_on_between_the_edges() -> None:
    """Of 0.12 s at each end nothing is used."""
    log, wrench = log_of(white(14))
    assert identify_sensor_noise(log, [Span(start=1000, stop=1304)], wrench) is None
    found = identify_sensor_noise(log, [Span(start=1000, stop=1305)], wrench)
    assert found is not None
    assert found.rest_s == pytest.approx(0.065)
    # A line takes two degrees of freedom of its 65 samples.
    values, time = np.hstack([log.force_S_n, log.torque_S_n_m])[1120:1185], np.arange(65)
    left = values - np.polynomial.polynomial.polyval(time, np.polynomial.polynomial.polyfit(time, values, 1)).T
    assert found.rms == pytest.approx(np.sqrt(np.sum(left**2, axis=0) / 63.0))


def test_of_one_rest_of_white_noise_the_deviation_is_that_of_as_many_samples() -> None:
    log, wrench = log_of(white(15, 30))
    found = identify_sensor_noise(log, [Span(start=0, stop=60000)], wrench)
    assert found is not None
    # 28 segments show how broad it is, to some per cent.
    assert found.rms_std == pytest.approx(found.rms / np.sqrt(2.0 * 59760.0), rel=0.1)
    ratios = np.array(found.spectrum().frequency_hz)
    # 24 bands of equal ratio from the first bin to the last.
    assert ratios[-1] / ratios[-2] == pytest.approx(2048.0 ** (1.0 / 24.0), rel=0.01)
    assert len(ratios) <= 24


def test_a_line_is_told_from_a_tenth_of_the_power_on_with_the_unit_of_its_axis() -> None:
    for axis, unit in ((2, "N"), (3, "N·m")):
        of_line = np.where(np.arange(6) == axis, 1.0, 0.0)
        line = SpectralLine(frequency_hz=49.96, rms=np.sqrt(0.11) * of_line)
        (said,) = _line_findings((line,), np.ones(6))
        assert said.message == (
            f"The noise of axis {('x', 'y', 'z', 'rx', 'ry', 'rz')[axis]} has a line at 50.0 Hz of 0.332 {unit} rms, "
            "11 % of its power."
        )
        assert _line_findings((SpectralLine(frequency_hz=50.0, rms=np.sqrt(0.09) * of_line),), np.ones(6)) == ()


def test_200_steps_say_a_resolution() -> None:
    stairs = 0.5 * (np.arange(201, dtype=np.float64) % 7.0)
    assert find_resolution(stairs) == pytest.approx(0.5)
    assert find_resolution(stairs[:-1]) is None
