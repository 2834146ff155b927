"""Noise with a spectrum: a filter beside the loop, white noise, a closed form of the filter, and simulations."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov
from scipy.signal import lfilter

from problems.arrays import FloatArray
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.evaluation import build_scenarios
from problems.design.problem import NoiseLimit, Requirements
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from problems.model.sampled import SampledLoop, build_loop, relative_loop
from problems.stability.noise import command_speed_gain, spectral_speed_gain
from problems.stability.noise_spectrum import RelativeSpectrum
from tests.autotune.tuning.cases import design_problem
from tests.problems.axes import PERIOD_S, admittance, paper_plant
from tests.problems.random_loops import sampled_of, stable_loops

WHITE = RelativeSpectrum(frequency_hz=(2.0, 50.0, 300.0), relative_density=(7.0, 7.0, 7.0))


def filtered(pole: float) -> RelativeSpectrum:
    """Return the spectrum of n_{k+1} = ρ n_k + w_k, 1/|1 − ρ/z|²."""
    frequency = np.geomspace(0.05, 0.5 / PERIOD_S, 4000)
    density = 1.0 / np.abs(1.0 - pole * np.exp(-2j * np.pi * PERIOD_S * frequency)) ** 2
    return RelativeSpectrum(frequency_hz=tuple(frequency), relative_density=tuple(density))


def with_filter(loop: SampledLoop, pole: float) -> float:
    """Return the speed RMS per RMS of that noise, whose state stands beside those of the loop, by Lyapunov."""
    a, b, row = relative_loop(loop, loop.c_command @ loop.a - loop.c_command)
    n = len(a)
    whole, drive = np.zeros((n + 1, n + 1)), np.zeros(n + 1)
    whole[:n, :n], whole[:n, n], whole[n, n], drive[n] = a, b, pole, math.sqrt(1.0 - pole**2)
    covariance = solve_discrete_lyapunov(whole, np.outer(drive, drive), method="bilinear")
    # x^d_{k+1} − x^d_k = row s_k + (c b − d) n_k + d n_{k+1}.
    moves = np.append(row, float(loop.c_command @ loop.b) - loop.d_command * (1.0 - pole))
    return math.sqrt(float(moves @ covariance @ moves) + (loop.d_command * drive[n]) ** 2) / PERIOD_S


def least_damping(loop: SampledLoop) -> float:
    """Return the least damping ratio of the loop's vibrations."""
    poles = np.linalg.eigvals(loop.a)
    rates = np.log(poles[(poles.imag > 0.0) & (np.abs(poles) > 1e-3)])
    return float(np.min(-rates.real / np.abs(rates), initial=1.0))


@pytest.mark.parametrize("pole", [-0.7, 0.8, 0.97])
def test_a_spectrum_is_that_of_noise_that_is_filtered_before_the_law(pole: float) -> None:
    """A law, and resonances down to a damping of 0.005, that the sum over frequencies has to find."""
    spectrum, seen = filtered(pole), 0
    for sampled, law in stable_loops(np.random.default_rng(74), 60, below=0.999):
        loop = build_loop(sampled, law)
        if least_damping(loop) < 0.005:
            continue
        seen += 1
        assert spectral_speed_gain(loop, spectrum) == pytest.approx(with_filter(loop, pole), rel=1e-3)
    assert seen > 30


def test_a_constant_spectrum_is_white_noise() -> None:
    for sampled, law in stable_loops(np.random.default_rng(75), 20, below=0.99995):
        white = command_speed_gain(sampled, law)
        assert command_speed_gain(sampled, law, WHITE) == pytest.approx(white, rel=1e-9)


def test_a_loop_that_is_simulated_with_such_noise_has_its_rms() -> None:
    loop, pole = build_loop(sampled_of(paper_plant(stiffness=3e4)), admittance(lead=0.02)), 0.9
    rng = np.random.default_rng(76)
    runs, ticks = 1000, 2000
    noise = lfilter([math.sqrt(1.0 - pole**2)], [1.0, -pole], rng.standard_normal((ticks, runs)), axis=0)
    state, command = np.zeros((len(loop.a), runs)), np.empty((ticks, runs))
    for k in range(ticks):
        command[k] = loop.c_command @ state + loop.d_command * noise[k]
        state = loop.a @ state + np.outer(loop.b, noise[k])
    speed = np.diff(command[ticks // 2 :], axis=0) / PERIOD_S
    # A thousand runs are independent: 2.2 % even if the ticks of each were one, and three times that.
    assert np.sqrt(np.mean(speed**2)) == pytest.approx(spectral_speed_gain(loop, filtered(pole)), rel=0.06)


def test_the_causal_filter_of_a_first_order_spectrum_is_that_of_first_order() -> None:
    pulse = filtered(0.8).pulse(PERIOD_S, 40)
    # The density lies on straight lines between its points.
    np.testing.assert_allclose(pulse, 0.6 * 0.8 ** np.arange(40), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("density", [(30.0, 30.0, 1.0, 0.01), (1.0, 0.1, 20.0, 0.5)], ids=["low", "hum"])
def test_the_filter_has_the_power_of_its_spectrum(density: tuple[float, ...]) -> None:
    spectrum = RelativeSpectrum(frequency_hz=(3.0, 30.0, 90.0, 400.0), relative_density=density)
    pulse = spectrum.pulse(PERIOD_S, 2000)
    assert np.sum(pulse**2) == pytest.approx(1.0, abs=1e-4)
    frequency = np.array([0.0, 10.0, 60.0, 200.0, 500.0])
    z = np.exp(-2j * np.pi * PERIOD_S * np.outer(frequency, np.arange(2000)))
    np.testing.assert_allclose(np.abs(z @ pulse) ** 2, spectrum.beside_white(frequency, PERIOD_S), rtol=0.02)
    assert spectrum.nodes(PERIOD_S)[1].sum() == pytest.approx(1.0, abs=1e-4)


def noise_rows(spectrum: RelativeSpectrum | None, designs: FloatArray) -> tuple[FloatArray, list[Any]]:
    """Return the requirement's ratios of designs by the compiled form, then by the exact one."""
    limit = NoiseLimit(
        max_speed_rms_m_s=2e-3, force_noise_rms_n=0.14, position_noise_rms_m=3e-7, noise_spectrum=spectrum
    )
    problem = design_problem(requirements=Requirements(command_noise=limit))
    prepared = build_scenarios(problem, problem.scenarios(2, 2))
    screen = build_batch_evaluator(prepared)
    found = screen.evaluate(designs, peaks_if_missed=True).rows["command_noise"].max(axis=1)
    exact = [prepared.evaluate(each, peaks_if_missed=True).requirements["command_noise"] for each in designs]
    return found, exact


def test_the_compiled_form_has_the_exact_one_s_number() -> None:
    designs = np.array([[6.0, 3000.0, 0.02, 0.008], [9.0, 3500.0, 0.015, 0.0], [15.0, 3300.0, 0.005, 0.003]])
    white, _ = noise_rows(None, designs)
    for spectrum in (filtered(0.95), filtered(-0.5)):
        found, exact = noise_rows(spectrum, designs)
        # By Horner's rule in w, and by the Schur form of the loop.
        np.testing.assert_allclose(found, exact, rtol=1e-6)
        assert np.all(np.abs(found / white - 1.0) > 0.005)
    found, _ = noise_rows(WHITE, designs)
    np.testing.assert_allclose(found, white, rtol=1e-9)


@pytest.mark.parametrize(
    ("frequency", "density", "name"),
    [
        ((1.0,), (1.0,), "frequency_hz"),
        ((2.0, 1.0), (1.0, 1.0), "frequency_hz"),
        ((1.0, 2.0), (1.0,), "relative_density"),
        ((1.0, 2.0), (1.0, 0.0), "relative_density"),
        ((1.0, math.inf), (1.0, 1.0), "frequency_hz"),
    ],
)
def test_what_is_no_spectrum_is_refused(frequency: tuple[float, ...], density: tuple[float, ...], name: str) -> None:
    with pytest.raises(ParameterError, match=name):
        RelativeSpectrum(frequency_hz=frequency, relative_density=density)


def test_noise_where_a_heavy_law_lets_it_through_is_more() -> None:
    law = AdmittanceController(mass_kg=30.0, damping_n_s_per_m=1000.0, lead_s=0.0)
    sampled = sampled_of(paper_plant(stiffness=0.0))
    low, white, high = (command_speed_gain(sampled, law, each) for each in (filtered(0.95), None, filtered(-0.9)))
    assert high < 0.8 * white < 0.8 * 0.8 * low
