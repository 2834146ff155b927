import numpy as np
import pytest

from problems.passivity import check_passivity
from problems.response import free_space_admittance
from problems.sampled import build_sampled_plant
from tests.problems.axes import PERIOD_S, admittance, one_pole, paper_plant


def test_a_delayed_robot_is_not_passive_and_the_frequency_is_where_the_phase_passes_90_degrees() -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    law = admittance(mass=10.0, damping=1000.0, lead=0.0)
    found = check_passivity(sampled, law)
    assert found.fails_above_hz is not None
    # Continuous closed form: phase of 1/(M_a s + B_a) · 20/(s + 20) · delay of T_d and half a sample.
    omega = 2.0 * np.pi * found.fails_above_hz
    phase = np.arctan(0.01 * omega) + np.arctan(omega / 20.0) + omega * (2.4e-3 + 0.5 * PERIOD_S)
    assert phase == pytest.approx(np.pi / 2.0, rel=2e-3)  # Tustin warps by (ωh)²/12, far below; the hold is 1e-3 here


def test_the_worst_real_part_bounds_every_frequency() -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=0.0), PERIOD_S)
    law = admittance(mass=10.0, damping=1000.0, lead=0.02)
    found = check_passivity(sampled, law)
    omega = np.random.default_rng(0).uniform(1.0, np.pi / PERIOD_S, 5000)
    # The grid is log-spaced with 0.5 % steps; the minimum is flat, so it is met to 1e-4 of itself.
    assert np.min(free_space_admittance(sampled, law, omega).real) >= found.worst_real_m_s_per_n * (1.0 + 1e-4)


def test_below_the_failing_frequency_the_port_is_passive() -> None:
    sampled = build_sampled_plant(paper_plant(stiffness=0.0, robot=one_pole(1e-3, 60.0)), PERIOD_S)
    law = admittance(mass=20.0, damping=800.0, lead=0.01)
    found = check_passivity(sampled, law)
    assert found.fails_above_hz is not None
    omega = 2.0 * np.pi * np.linspace(0.05, found.fails_above_hz * 0.9999, 3000)
    assert np.all(free_space_admittance(sampled, law, omega).real >= 0.0)
    assert not found.is_passive
