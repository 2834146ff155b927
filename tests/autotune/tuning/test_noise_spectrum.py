"""What is said of noise that is not white."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.formats.controller_record import Controller
from autotune.formats.problem import ProblemSpec
from autotune.tuning.noise_spectrum import spectrum_notes
from autotune.tuning.problems import build_problems
from identification.result import Identified, NoiseSpectrum
from problems.design.problem import DesignProblem, NoiseLimit, Requirements
from tests.autotune.tuning.cases import identified_plant, small_controller

PERIOD, RMS = 8e-4, 0.14
FREQUENCY = np.linspace(1.0, 600.0, 120)
LIMIT = NoiseLimit(max_speed_rms_m_s=2e-3, force_noise_rms_n=RMS)


def measured(density: np.ndarray) -> Identified:
    """Return the plant with a spectrum of the sensor."""
    spectrum = NoiseSpectrum(
        frequency_hz=tuple(FREQUENCY),
        force_n2_per_hz=tuple(density),
        torque_n2_m2_per_hz=(),
        resolution=(None,) * 6,
    )
    plant = identified_plant()
    return replace(plant, sensor=replace(plant.sensor, noise=spectrum))


def problem_of(plant: Identified, limit: NoiseLimit | None = LIMIT) -> dict[str, DesignProblem]:
    return build_problems(plant, ProblemSpec(requirements=Requirements(command_noise=limit)))


@pytest.fixture(scope="module")
def controller() -> Controller:
    return small_controller()


WHITE = np.full(len(FREQUENCY), 2.0 * PERIOD * RMS**2)
# A sensor behind a low pass of 3 Hz, and one that hears the mains.
LOW = 1.0 / (1.0 + (FREQUENCY / 3.0) ** 2) ** 4
HUM = np.exp(-(((FREQUENCY - 50.0) / 5.0) ** 2))


def test_white_noise_is_nothing_to_be_said(controller: Controller) -> None:
    plant = measured(WHITE)
    assert list(spectrum_notes(controller, problem_of(plant), plant)) == []


@pytest.mark.parametrize(("shape", "is_less"), [(LOW, True), (HUM, False)], ids=["low pass", "hum"])
def test_noise_of_the_same_rms_elsewhere_is_said(controller: Controller, shape: np.ndarray, is_less: bool) -> None:
    plant = measured(shape * RMS**2 / np.trapezoid(shape, FREQUENCY))
    (note,) = spectrum_notes(controller, problem_of(plant), plant)
    logged, white = (float(part.split(" mm/s")[0].split()[-1]) for part in note.split(";"))
    assert (logged < 0.8 * white) if is_less else (logged > 1.2 * white)
    assert note.startswith("Axis x: with the spectrum as logged the sensor's noise makes ")


def test_nothing_is_said_where_no_noise_is_limited_or_no_spectrum_known(controller: Controller) -> None:
    plant = measured(HUM)
    assert list(spectrum_notes(controller, problem_of(plant, None), plant)) == []
    assert list(spectrum_notes(controller, problem_of(identified_plant()), identified_plant())) == []
    # Nor of noise that somebody said, whatever the log's spectrum is.
    said = problem_of(plant, replace(LIMIT, force_noise_rms_n=1.0))
    assert list(spectrum_notes(controller, said, plant)) == []
