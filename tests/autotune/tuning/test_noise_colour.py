"""The sensor's noise counts with the spectrum that was logged where that is not white, from the search to the file."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from autotune.formats.controller import read_controller, write_controller
from autotune.formats.problem import ProblemSpec
from autotune.tuning.noise_limit import NoiseOf, find_noise_spectrum, spectrum_notes
from autotune.tuning.optimize import optimize
from autotune.tuning.problems import build_problems
from autotune.tuning.search import solve_design
from autotune.tuning.structure import equal_noise, limited_problem
from autotune.validation.axis_proof import ProofOptions
from identification.result import Identified, NoiseSpectrum
from problems.arrays import FloatArray
from problems.design.problem import NoiseLimit, Requirements
from problems.model.plant import FREE_SPACE
from problems.model.sampled import build_sampled_plant
from problems.stability.noise import command_speed_gain
from problems.stability.noise_spectrum import RelativeSpectrum
from tests.autotune.tuning.cases import design_problem, identified_plant, in_memory_plant, small_controller

RMS = 0.14
FREQUENCY = np.geomspace(1.0, 600.0, 24)
# A sensor behind a low pass, behind a slow one, and one that hears the mains.
LOW = 1.0 / (1.0 + (FREQUENCY / 40.0) ** 4)
SLOW = 1.0 / (1.0 + (FREQUENCY / 3.0) ** 2) ** 4
HUM = 0.02 + 20.0 * np.exp(-(((FREQUENCY - 55.0) / 10.0) ** 2))
LIMIT = NoiseLimit(max_speed_rms_m_s=2e-3)


def measured(force: FloatArray, torque: FloatArray | None = None) -> Identified:
    """Return the plant with a spectrum of the sensor."""
    spectrum = NoiseSpectrum(
        frequency_hz=tuple(FREQUENCY),
        force_n2_per_hz=tuple(force),
        torque_n2_m2_per_hz=() if torque is None else tuple(torque),
        resolution=(None,) * 6,
    )
    plant = identified_plant()
    return replace(plant, sensor=replace(plant.sensor, noise=spectrum))


def limit_of(plant: Identified, limit: NoiseLimit | None = LIMIT) -> NoiseLimit | None:
    return build_problems(plant, ProblemSpec(requirements=Requirements(command_noise=limit)))[
        "x"
    ].requirements.command_noise


@pytest.mark.parametrize("shape", [LOW, HUM, 1.0 / LOW], ids=["low pass", "hum", "high pass"])
def test_noise_that_is_not_white_counts_with_its_spectrum(shape: FloatArray) -> None:
    found = limit_of(measured(1e-4 * shape))
    assert found is not None
    assert found.noise_spectrum is not None
    assert found.force_noise_rms_n == RMS
    density = np.array(found.noise_spectrum.relative_density)
    np.testing.assert_allclose(density / density[0], shape / shape[0], rtol=1e-3)


def test_noise_that_is_white_as_far_as_a_log_can_tell_has_none() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        # Few averages at low frequency, where a drift is taken out too.
        shaken = 1.0 + 0.5 * rng.uniform(-1.0, 1.0, len(FREQUENCY)) * np.minimum(1.0, 10.0 / FREQUENCY)
        shaken[0] *= 0.5
        assert find_noise_spectrum(measured(shaken), "x") is None
    assert limit_of(identified_plant()) == replace(LIMIT, force_noise_rms_n=RMS)


def test_noise_that_somebody_says_is_white_and_torques_have_a_spectrum_of_their_own() -> None:
    said = replace(LIMIT, force_noise_rms_n=1.0)
    assert limit_of(measured(LOW), said) == said
    plant = measured(np.ones(len(FREQUENCY)), HUM)
    assert find_noise_spectrum(plant, "x") is None
    assert find_noise_spectrum(plant, "ry") is not None
    # A log without torques says nothing of them, and one without noise nothing at all.
    assert find_noise_spectrum(measured(LOW), "ry") is None
    assert find_noise_spectrum(measured(0.0 * LOW), "x") is None


@pytest.mark.parametrize(("shape", "is_less"), [(SLOW, True), (HUM, False)], ids=["low pass", "hum"])
def test_what_the_spectrum_makes_is_said_where_it_matters(shape: FloatArray, is_less: bool) -> None:
    controller = small_controller()

    def notes(plant: Identified) -> list[str]:
        problems = build_problems(plant, ProblemSpec(requirements=Requirements(command_noise=LIMIT)))
        return list(spectrum_notes(controller, problems))

    assert notes(identified_plant()) == []
    (note,) = notes(measured(shape))
    logged, white = (float(part.split(" mm/s")[0].split()[-1]) for part in note.split(";"))
    assert (logged < 0.8 * white) if is_less else (logged > 1.2 * white)
    assert note.startswith("Axis x: the sensor's noise counts with its spectrum as logged, and makes ")


def test_a_default_limit_is_the_noise_that_the_four_gains_make_of_the_spectrum() -> None:
    plain = solve_design(design_problem())
    spectrum = RelativeSpectrum(frequency_hz=tuple(FREQUENCY), relative_density=tuple(HUM))
    law, h = plain.problem.controller(plain.design), plain.problem.sample_time_s
    plants = [plain.problem.plant(each) for each in plain.active.scenarios]
    worst = max(
        command_speed_gain(build_sampled_plant(each, h), law, spectrum)
        for each in (*plants, *(each.in_contact_with(FREE_SPACE) for each in plants))
    )
    assert equal_noise(plain, spectrum) == pytest.approx(worst, rel=1e-5)
    assert abs(equal_noise(plain) / worst - 1.0) > 0.05
    problem = limited_problem(plain.problem, worst, has_biquad=False, measured=NoiseOf(0.05, None, spectrum))
    limit = problem.requirements.command_noise
    assert limit is not None
    assert limit.noise_spectrum == spectrum
    # One newton of a sensor that nobody knows is white.
    unknown = limited_problem(plain.problem, worst, has_biquad=False, measured=NoiseOf(None, None, spectrum))
    assert unknown.requirements.command_noise == NoiseLimit(
        max_speed_rms_m_s=float(f"{worst:.6g}"), force_noise_rms_n=1.0
    )


def test_a_design_is_at_its_limit_under_the_spectrum_and_the_file_says_which(tmp_path: Path) -> None:
    """The limit holds the peak up: by the exact loop the worst plant has it, and no more."""
    asked = Requirements(command_noise=NoiseLimit(max_speed_rms_m_s=5e-4))
    found = optimize(
        replace(in_memory_plant(), result=measured(HUM)),
        ProblemSpec(requirements=asked, structure="noise"),
        proof=ProofOptions(further_s=0.0),
    )
    search = found.searches["x"]
    limit = search.problem.requirements.command_noise
    assert limit is not None
    assert limit.noise_spectrum is not None
    unlimited = solve_design(
        replace(search.problem, requirements=replace(search.problem.requirements, command_noise=None))
    )
    noise = RMS * equal_noise(search, limit.noise_spectrum)
    assert RMS * equal_noise(unlimited, limit.noise_spectrum) > noise
    assert noise == pytest.approx(5e-4, rel=2e-3)
    assert noise <= 5e-4 * (1.0 + 2e-6)
    path = tmp_path / "controller.yaml"
    write_controller(path, found.controller)
    assert read_controller(path).controller.certificate.requirements["command_noise"] == limit
