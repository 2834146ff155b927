"""How far |G| rises above what it is at rest: closed forms, both evaluations, and what a payload that starts does."""

from dataclasses import replace

import numpy as np
import pytest

from autotune.validation.replay import equation_gains, robot_alone
from autotune.validation.replay_kernel import follow_forces
from problems.design.batch_evaluation import build_batch_evaluator
from problems.design.evaluation import build_scenarios
from problems.design.requirements import Requirements
from problems.design.requirements.admittance_peak import AdmittancePeak
from problems.errors import ParameterError
from problems.model.controller import AdmittanceController
from tests.autotune.tuning.cases import design_problem
from tests.problems.axes import PERIOD_S
from tests.problems.design.test_batch_evaluation import EASY, random_designs

ASKED = replace(EASY, further={"admittance_peak": 1.3})
FAR_AHEAD = (268.0, 1517.0, 0.6, 0.0)


def achieved(design: tuple[float, ...]) -> float:
    problem = design_problem(requirements=ASKED)
    prepared = build_scenarios(problem, problem.scenarios(2, 2))
    return AdmittancePeak().achieved(1.3, prepared.stable(problem.controller(design)), 0)


@pytest.mark.parametrize("design", [(13.0, 1500.0, 0.02, 0.0), (60.0, 1500.0, 0.15, 0.0), FAR_AHEAD])
def test_it_is_that_of_the_continuous_law_and_robot(design: tuple[float, ...]) -> None:
    """B_a G = (1 + K_l s) r(s)/(1 + M_a s/B_a); sampling moves neither where it peaks, a decade below its corner."""
    mass, damping, lead, _ = design
    s = 2j * np.pi * np.geomspace(0.01, 20.0, 4000)
    robot = design_problem().plants.nominal.robot
    follows = np.polyval(robot.numerator, s) / np.polyval(robot.denominator, s)
    gain = np.abs((1.0 + lead * s) * follows / (1.0 + mass / damping * s))
    assert achieved(design) == pytest.approx(np.max(gain) / gain[0], rel=5e-3)


def test_a_payload_that_starts_runs_ahead_by_it() -> None:
    """F^d comes at once: the speed of the robot, by the difference equation, over the steady one."""
    robot, problem = design_problem().plants.nominal.robot, design_problem()
    for design, least, most in ((13.0, 1500.0, 0.02, 0.0), 0.99, 1.02), (FAR_AHEAD, 1.8, 3.0):
        law = problem.controller(design)
        assert isinstance(law, AdmittanceController)
        position = follow_forces(robot_alone(robot, PERIOD_S), equation_gains(law, PERIOD_S), np.full(4000, 30.0))
        ahead = np.max(np.diff(position)) / PERIOD_S * law.damping_n_s_per_m / 30.0
        assert least < ahead < most
        assert (achieved(design) > 1.05) == (ahead > 1.05)


@pytest.mark.parametrize("asked", [ASKED, replace(ASKED, soft_n={"admittance_peak": 5.0})])
def test_the_batch_finds_the_same(asked: Requirements) -> None:
    problem = design_problem(requirements=asked)
    prepared = build_scenarios(problem, problem.scenarios(3, 2))
    # Rising ones are among them.
    screen, designs = build_batch_evaluator(prepared), random_designs(60) * [4.0, 1.0, 8.0, 0.0]
    found = screen.evaluate(designs, peaks_if_missed=True)
    rows, seen = {**found.rows, **found.soft_rows}["admittance_peak"], []
    assert screen.is_compiled
    for row, design in zip(rows[found.is_stable], designs[found.is_stable], strict=True):
        again = AdmittancePeak().ratios(1.3, prepared.stable(problem.controller(design)))
        np.testing.assert_allclose(row, again, rtol=1e-9)
        seen.append(row[0] > 1.0)
    assert 3 < sum(seen) < len(seen) - 3
    # A hard limit is one more thing to miss: of what rises no contact is simulated.
    peaks = screen.evaluate(designs).objective_rows[found.is_stable]
    assert bool(np.all(np.isinf(peaks[seen]))) == (not asked.soft_n)


def test_less_than_at_rest_cannot_be_asked() -> None:
    with pytest.raises(ParameterError, match=r"admittance_peak must be at least 1, what \|G\| is at rest"):
        Requirements(further={"admittance_peak": 0.9})
