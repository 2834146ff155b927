"""The noise of the command from polynomials is that of the exact loop's covariance, and a closed form."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.batch_kernel import find_speed_noises
from problems.design.evaluation import build_scenarios
from problems.design.problem import NoiseLimit, Requirements
from problems.model.controller import AdmittanceController
from problems.model.sampled import SampledPlant, build_loop, position_input
from problems.stability.margins import loop_polynomials
from problems.stability.noise import speed_rms
from problems.stability.polynomial_noise import command_speed_rms
from problems.stability.polynomials import CONTROLLER_POWERS, controller_polynomials
from tests.autotune.tuning.cases import design_problem
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant
from tests.problems.random_loops import sampled_of, stable_loops

BIQUAD: dict[str, Any] = {
    "biquad_zero_s": 0.004,
    "biquad_zero_damping_ratio": 0.3,
    "biquad_pole_s": 0.002,
    "biquad_pole_damping_ratio": 0.8,
}


def found_of(sampled: SampledPlant, law: AdmittanceController, force: float, position: float) -> float:
    """Return the RMS by the compiled form, which has to be that of its Python."""
    factors = np.zeros((3, CONTROLLER_POWERS))
    degree = controller_polynomials(law.parameters(), law.is_ideal, factors)
    first = 0 if sampled.plant.environment.is_anchored else 1
    arguments = (loop_polynomials(sampled), first, factors, degree, (PERIOD_S, law.theta), (force, position))
    found = float(command_speed_rms(*arguments))
    assert found == pytest.approx(command_speed_rms.py_func(*arguments), rel=1e-9)  # type: ignore[attr-defined]
    return found


def test_random_loops_have_the_rms_of_their_covariance() -> None:
    rng, seen = np.random.default_rng(73), 0
    for sampled, plain in stable_loops(rng, 40, below=0.99995):
        laws = [plain]
        if not plain.is_ideal and plain.theta > 0.0:
            laws.append(replace(plain, **BIQUAD))
        for law in laws:
            loop = build_loop(sampled, law)
            if max(abs(np.linalg.eigvals(loop.a))) > 1.0 + 1e-9:
                continue
            force, position = (loop.b, loop.d_command, 0.7), (*position_input(sampled, law), 2e-5)
            seen += law.has_biquad
            # Routh's array and sums of squares: two ways of rounding.
            assert found_of(sampled, law, 0.7, 0.0) == pytest.approx(speed_rms(loop, [force]), rel=1e-8)
            assert found_of(sampled, law, 0.7, 2e-5) == pytest.approx(speed_rms(loop, [force, position]), rel=1e-8)
    assert seen > 10


def test_a_lead_of_the_time_constant_passes_noise_through_the_damping_alone() -> None:
    """K_l = M_a/B_a on a coupling so soft that no force comes back: the speed is the mean of two samples over B_a."""
    sampled = sampled_of(paper_plant(stiffness=0.0, coupling=1e-3, robot=one_pole(3.0 * PERIOD_S)))
    assert found_of(sampled, admittance(13.0, 1000.0, 0.013), 1.0, 0.0) == pytest.approx(
        1.0 / (1000.0 * np.sqrt(2.0)), rel=1e-6
    )


def test_where_the_array_fails_the_covariance_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    limit = NoiseLimit(max_speed_rms_m_s=6e-4, force_noise_rms_n=0.14, position_noise_rms_m=1e-7)
    problem = design_problem(requirements=Requirements(command_noise=limit))
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(2, 2)))
    designs = np.array([[6.0, 3000.0, 0.02, 0.008], [9.0, 3500.0, 0.015, 0.0]])
    found = screen.evaluate(designs, peaks_if_missed=True).rows["command_noise"]

    def failing(*arguments: Any) -> None:
        find_speed_noises(*arguments)
        arguments[-1][0, 1] = np.nan

    monkeypatch.setattr("problems.design.batch_evaluation.find_speed_noises", failing)
    asked = screen.evaluate(designs, peaks_if_missed=True).rows["command_noise"]
    assert np.all(np.isfinite(found))
    np.testing.assert_allclose(asked, found, rtol=1e-9)
