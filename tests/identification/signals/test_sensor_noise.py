"""Sensor noise: white, coloured and quantised signals of known size."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import butter, sosfilt
from scipy.spatial.transform import Rotation

from identification.result import Status
from identification.signals.aligned import AlignedLog
from identification.signals.recording import WrenchSignal
from identification.signals.segments import Span
from identification.signals.sensor_noise import SensorNoise, find_resolution, identify_sensor_noise
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
