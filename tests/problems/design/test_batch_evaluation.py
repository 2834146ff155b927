"""Screening many designs at once says what evaluating them one by one does."""

from dataclasses import replace

import numpy as np
import pytest

from problems.arrays import FloatArray
from problems.contact.transient import Approach
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.evaluation import build_scenarios
from problems.design.objectives import BUILT_IN, SensorForce
from problems.design.problem import (
    AdmittanceTarget,
    DesignProblem,
    NoiseLimit,
    PassivityTarget,
    Requirements,
    biquad_bounds,
)
from problems.design.requirements import HANDS, ContactAtSpeed, Hand
from problems.stability.margins import margin_grid
from tests.autotune.tuning.cases import design_problem

EVERYTHING = Requirements(
    modulus_margin=0.3,
    gain_margin_db=4.0,
    phase_margin_deg=20.0,
    delay_margin_s=1e-3,
    decay_rate_per_s=0.5,
    max_peak_force_n=400.0,
    free_space_admittance=AdmittanceTarget(min_m_s_per_n=1.5e-4),
)
EASY = Requirements(free_space_admittance=AdmittanceTarget(min_m_s_per_n=1.5e-4))
NOTHING = Requirements(
    modulus_margin=None,
    gain_margin_db=None,
    phase_margin_deg=None,
    delay_margin_s=None,
    free_space_admittance=None,
)
COMMANDED = replace(
    EVERYTHING,
    command_noise=NoiseLimit(max_speed_rms_m_s=6e-4, force_noise_rms_n=0.14),
    passivity=PassivityTarget(passive_below_hz=20.0),
)
# Both noises, of which a law that feeds the position back makes more.
OF_BOTH = NoiseLimit(max_speed_rms_m_s=6e-4, force_noise_rms_n=0.14, position_noise_rms_m=1e-6)


def led_by(hand: Hand) -> ContactAtSpeed:
    # With a light hand no loop is unstable that is stable without it, where the force would be no number.
    return ContactAtSpeed(speed_m_s=0.05, max_force_n=220.0, hand=hand, hand_mass_kg=0.2)


PROBLEMS = [
    pytest.param(design_problem(requirements=COMMANDED), id="noise and passivity"),
    pytest.param(
        design_problem(requirements=replace(COMMANDED, soft_n={"passivity": 5.0, "phase_margin_deg": 20.0})),
        id="some soft",
    ),
    pytest.param(
        design_problem(requirements=replace(COMMANDED, soft_n=dict.fromkeys(COMMANDED.asked(), 2.0))), id="all soft"
    ),
    pytest.param(design_problem(requirements=replace(EASY, command_noise=OF_BOTH)), id="noise of the pose too"),
    pytest.param(
        design_problem(requirements=replace(COMMANDED, command_noise=OF_BOTH, soft_n={"command_noise": 5.0})),
        id="soft noise of the pose too",
    ),
    pytest.param(design_problem(requirements=EASY), id="usual"),
    pytest.param(design_problem(requirements=replace(EASY, further={"min_damping_ratio": 0.1})), id="not compiled"),
    pytest.param(design_problem(requirements=EVERYTHING), id="everything"),
    pytest.param(design_problem(requirements=replace(EVERYTHING, gain_margin_db=None)), id="no gain margin"),
    pytest.param(
        design_problem(requirements=NOTHING),
        id="stability alone",
    ),
    pytest.param(
        replace(design_problem(requirements=EASY), objective=SensorForce(), approach=Approach(speed_m_s=0.04)),
        id="sensor",
    ),
    *(
        pytest.param(replace(design_problem(requirements=asked), objective=BUILT_IN[name]), id=f"{name}, {said}")
        for name in ("robustness", "admittance", "hand_force")
        for said, asked in (("everything asked", EVERYTHING), ("nothing asked", NOTHING))
    ),
    *(
        pytest.param(
            design_problem(requirements=replace(EASY, further={"contact_at_speed": led_by(hand)})), id=f"led, {hand}"
        )
        for hand in HANDS
    ),
]


def random_designs(count: int, seed: int = 3) -> FloatArray:
    """Return designs all over the box, every third beside one that is known to be good."""
    rng = np.random.default_rng(seed)
    lead = rng.uniform(0.0, 0.03, count) * (rng.uniform(size=count) < 0.7)
    feedback = rng.uniform(1e-3, 0.02, count) * (rng.uniform(size=count) < 0.7)
    mass, damping = (
        np.geomspace(*bounds, 997)[rng.integers(997, size=count)] for bounds in ((5.0, 80.0), (300.0, 9000.0))
    )
    designs = np.column_stack([mass, damping, lead, feedback])
    designs[::3] = np.array([6.0, 3000.0, 0.02, 0.008]) * rng.uniform(0.8, 1.25, (len(designs[::3]), 4))
    return designs


@pytest.mark.parametrize("peaks_if_missed", [True, False])
@pytest.mark.parametrize("problem", PROBLEMS)
def test_every_number_is_that_of_the_evaluation(problem: DesignProblem, peaks_if_missed: bool) -> None:
    prepared = build_scenarios(problem, problem.scenarios(3, 2))
    designs = random_designs(40)
    found = build_batch_evaluator(prepared).evaluate(designs, peaks_if_missed=peaks_if_missed)
    seen = {"stable": 0, "feasible": 0}
    for i, design in enumerate(designs):
        one = prepared.evaluate(design, peaks_if_missed=peaks_if_missed)
        assert found.is_stable[i] == one.is_stable
        if not one.is_stable:
            assert 1.0 <= found.radius[i] <= one.spectral_radius * (1.0 + 1e-9)
            assert found.violation[i] == np.inf
            assert found.cost[i] == np.inf
            continue
        seen["stable"] += 1
        seen["feasible"] += one.is_feasible
        if peaks_if_missed or one.is_feasible:
            # Margins are those of two searches along the frequency, forces and gains the same numbers.
            is_margin = problem.objective.batch_column == "modulus"
            assert found.cost[i] == pytest.approx(one.cost, rel=1e-7 if is_margin else 1e-9)
            assert {name: value[i] for name, value in found.requirements.items()} == pytest.approx(
                dict(one.requirements), rel=1e-7
            )
            assert {name: np.max(row[i]) for name, row in found.soft_rows.items()} == pytest.approx(
                dict(one.soft), rel=1e-7
            )
            assert found.violation[i] == pytest.approx(max(one.violation, 0.0), abs=1e-7)
        else:
            # Not everything was looked at, but what was is not worse than it is.
            assert 0.0 < found.violation[i] <= one.violation * (1.0 + 1e-7)
    assert 0 < seen["stable"] < len(designs)
    assert seen["feasible"] > 0


def test_a_response_that_is_no_number_is_a_miss() -> None:
    """A grid of NaN stands for a plant whose numbers overflow."""
    problem = design_problem()
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(2, 2)))
    loops, responses, (omega, tangent, force, position, offsets) = screen.plants
    broken = replace(
        screen, plants=(loops, responses, (omega, tangent, np.full_like(force, np.nan), position, offsets))
    )
    stable = random_designs(60)[screen.evaluate(random_designs(60)).is_stable]
    assert np.all(broken.evaluate(stable).violation > 0.0)
    assert margin_grid(screen.prepared.plants[0].sampled)[0][0] == omega[0]


def test_margins_are_found_of_what_is_missed_without_its_peaks() -> None:
    problem = design_problem(requirements=EASY)
    screen = build_batch_evaluator(build_scenarios(problem, problem.scenarios(3, 2)))
    designs = random_designs(40)
    whole = screen.evaluate(designs, peaks_if_missed=True)
    margins = screen.evaluate(designs, margins_if_missed=True)
    missed = whole.is_stable & (whole.violation > 0.0)
    assert np.any(missed)
    assert np.all(np.isinf(margins.cost[missed]))
    assert np.array_equal(margins.cost[~missed], whole.cost[~missed])
    for name, ratios in whole.requirements.items():
        assert np.array_equal(margins.requirements[name], ratios, equal_nan=True)


def test_the_parameters_of_designs_are_those_of_their_controllers() -> None:
    usual = design_problem()
    further = {"compensation_mass_kg": (0.0, 5.0), "acceleration_filter_rad_per_s": (20.0, 400.0)}
    biquad = biquad_bounds(usual.sample_time_s, 12.0)
    rng = np.random.default_rng(8)
    for more in ({}, further, biquad, {"velocity_filter_rad_per_s": (30.0, 300.0), **biquad}):
        problem = replace(usual, bounds={**usual.bounds, **more})
        designs = np.array([[rng.uniform(low, high) for low, high in problem.bounds.values()] for _ in range(20)])
        # Too small to be a value in seconds: none at all.
        designs[3, 3] = 1e-5
        expected = [problem.controller(design).parameters() for design in designs]
        np.testing.assert_array_equal(problem.parameters(designs), expected)
